"""Measure the built-in world: expert, other agents, events, difficulty and coverage.

Writes (or reads from an earlier run) two sets: one at the configured rate of rare events, and one with an event in
every scenario. The simulator evaluates all scenarios on the recorded tracks with perception noise; the generator
checked its expert on noise-free tracks with a margin of 10 cm. ``experiments/world/resemblance.py`` compares with real
recordings.

Run: python -m experiments.world.targets --scenarios 256 --workers 2 [--domain ring] [--keep FOLDER] [--write]
     python -m experiments.world.targets --timed 1000   (scenarios per second, on a machine that does nothing else)
     python -m experiments.world.targets --table        (results of both domains into the guide)
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivax.api import evaluate, load
from drivax.files import write_text
from drivax.scenario.schema import Scenario
from drivax.scenario.store import ScenarioSet
from drivax.synthetic.domains import DOMAINS
from drivax.synthetic.events import EventKind
from drivax.synthetic.events.kinds import SEVERITY_MPS2
from drivax.synthetic.expert.violations import LIMITS
from drivax.synthetic.generate import Generation, generate
from drivax.synthetic.world import WORLD_VERSION, WorldConfig
from drivax.tracking.run_folder import versions
from experiments.repository import RESULTS
from experiments.world.measures import (
    NEAR_S,
    compare_share,
    constant_speed_ttc_s,
    count_overlapping_pairs,
    largest_noise_m,
    share,
    violated_limits,
)
from experiments.world.tables import lines, write_guide

#: Planners whose success measures the difficulty of the world.
PLANNERS = {name: name for name in ("constant_velocity", "random", "idm")} | {
    "search": "search_planner:SearchPlanner"
}
EXPERT_METRICS = ("accuracy", "collision", "offroad", "red_light", "comfortable", "success")
#: Maximum number of scenarios on the device.
CHUNK = 512
#: Errors of the others' recorded poses.
NOISE = WorldConfig().noise


def generate_set(folder: Path, scenarios: int, seed: int, workers: int, world: WorldConfig) -> dict[str, Any]:
    """Generate a set if it does not exist, and return the generation statistics."""
    note = folder.with_suffix(".json")
    if note.is_file():
        source = json.loads((folder / "manifest.json").read_text())["source"]
        if (source["world"], source["config"]) != (WORLD_VERSION, json.loads(json.dumps(asdict(world)))):
            raise SystemExit(f"{folder} has another world version or configuration; remove it")
    else:
        result = generate(folder, scenarios, seed, Generation(workers=workers, world=world, overwrite=True))
        families = {
            name: {
                "kept": count.kept,
                "rejection_rate": count.rejection_rate,
                "causes": count.rejected,
                "unsuited": count.unsuited,
            }
            for name, count in result.families.items()
        }
        note.write_text(json.dumps({"families": families}))
    return json.loads(note.read_text())


def measure_speed(domain: str, scenarios: int, workers: int) -> dict[str, Any]:
    """Time the command that generates a temporary set at the default rare rate."""
    with tempfile.TemporaryDirectory() as folder:
        command = ["generate", str(Path(folder) / "set"), "--domain", domain, "--seed", "3"]
        command += ["--scenarios", str(scenarios), "--workers", str(workers)]
        start = time.monotonic()
        subprocess.run([sys.executable, "-m", "drivax", *command], check=True, capture_output=True)
        seconds = time.monotonic() - start
    return {"scenarios": scenarios, "workers": workers, "scenarios_per_second": scenarios / seconds}


def measure_set(
    folder: Path, planners: tuple[str, ...], evaluated_count: int | None = None
) -> list[dict[str, Any]]:
    """Return a row per scenario: tags, statistics, and results of the expert and the planners.

    With ``evaluated_count`` the planners drive only the chunks of 512 scenarios that begin before it.
    """
    data, rows = ScenarioSet.open(folder), []
    for first in range(0, len(data), CHUNK):
        scenarios = [data[i] for i in range(first, min(first + CHUNK, len(data)))]
        rows += _measure_chunk(
            scenarios, planners if evaluated_count is None or first < evaluated_count else ()
        )
        print(f"  {folder.name}: {len(rows)} of {len(data)} scenarios", flush=True)
    return rows


def _measure_chunk(scenarios: list[Scenario], planners: tuple[str, ...]) -> list[dict[str, Any]]:
    """Return the rows of scenarios that fit on the device together."""
    data = load(scenarios)
    rows = [
        {
            "family": scenario.tags["family"],
            "event": scenario.tags.get("event"),
            "critical": "critical" in scenario.tags,
            "segment": name["segment"],
            "broken_limits": violated_limits(scenario),
            "noise_m": largest_noise_m(scenario, NOISE),
            "severity_mps2": float(scenario.tags.get("severity_mps2", "nan")),
            "overlaps": count_overlapping_pairs(scenario),
            "ttc_s": constant_speed_ttc_s(scenario) if "event" in scenario.tags else None,
        }
        for scenario, name in zip(scenarios, data.names, strict=True)
    ]
    for planner in ("expert", *planners):
        metrics = evaluate(PLANNERS.get(planner, planner), data).metrics
        names = EXPERT_METRICS if planner == "expert" else ("success", "accuracy")
        for i, row in enumerate(rows):
            row |= {f"{planner}.{name}": float(metrics[name][i]) for name in names}
    return rows


def share_of(rows: list[dict[str, Any]], column: str) -> dict[str, float | int]:
    """Return the share of rows where a metric is 1, among rows where it is defined."""
    values = [row[column] for row in rows if np.isfinite(row.get(column, np.nan))]
    return share(int(sum(value > 0.5 for value in values)), len(values))


def difficulty(rows: list[dict[str, Any]], rare: list[dict[str, Any]], planner: str) -> dict[str, Any]:
    """Return a planner's success in all, common and rare scenarios, and the ratio of rare to common failures."""
    column = f"{planner}.success"
    common = share_of([row for row in rows if row["event"] is None], column)
    rare_rate = share_of([row for row in rare if row["event"] is not None], column)
    failures, rare_failures = 1.0 - common["share"], 1.0 - rare_rate["share"]
    return {
        "all": share_of(rows, column),
        "common": common,
        "rare": rare_rate,
        "failure_ratio": rare_failures / failures if failures else None,
    }


def compare_coverage(
    rows: list[dict[str, Any]], rare: list[dict[str, Any]], world: WorldConfig
) -> dict[str, Any]:
    """Compare the shares of families and events with the configuration.

    Families are counted over the maps of common scenarios: scenarios on one map share a draw, and rare scenarios take
    roads that suit their event. Kinds of events are counted over all rare scenarios.
    """
    maps = {row["segment"]: row["family"] for row in rows if row["event"] is None}
    event_rows = [row for row in (*rows, *rare) if row["event"] is not None]
    families, events = Counter(maps.values()), Counter(row["event"] for row in event_rows)
    family_by_event: dict[str, Counter[str]] = {}
    for row in event_rows:
        family_by_event.setdefault(row["event"], Counter())[row["family"]] += 1
    probabilities = {family.name: p for family, p in DOMAINS[world.domain].families}
    kinds = [kind.name.lower() for kind in EventKind if kind]
    comparisons = len(probabilities) + len(kinds) + 1
    event_count = sum(row["event"] is not None for row in rows)
    return {
        "families": {
            name: compare_share(p, families[name], len(maps), comparisons)
            for name, p in sorted(probabilities.items())
        },
        "rare_rate": compare_share(world.rare_rate, event_count, len(rows), comparisons),
        "events": {
            name: compare_share(1 / len(kinds), events[name], len(event_rows), comparisons) for name in kinds
        },
        "family_by_event": {event: dict(counts) for event, counts in sorted(family_by_event.items())},
    }


def severity(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the distribution of required decelerations over thirds of their range, and medians by kind."""
    values = np.array([row["severity_mps2"] for row in rows])
    edges = np.linspace(*SEVERITY_MPS2, 4)
    third = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, 2)
    return {
        "thirds": {
            f"{edges[k]:.1f} to {edges[k + 1]:.1f}": share(int((third == k).sum()), len(values))
            for k in range(3)
        },
        "medians": {
            name: float(np.median([row["severity_mps2"] for row in rows if row["event"] == name]))
            for name in sorted({row["event"] for row in rows})
        },
    }


def near_misses(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the share of events, overall and by kind, in which ego at constant speed is within 1 s of a collision."""
    kinds = {"all": rows}
    for row in rows:
        kinds.setdefault(row["event"], []).append(row)
    return {
        name: share(sum(row["ttc_s"] < NEAR_S for row in group), len(group))
        for name, group in sorted(kinds.items())
    }


def summary(rows: list[dict[str, Any]], rare: list[dict[str, Any]], world: WorldConfig) -> dict[str, Any]:
    """Return all values of the table from the rows of both sets."""
    all_rows = [*rows, *rare]
    common = [row for row in rows if row["event"] is None]
    with_event = [row for row in all_rows if row["event"] is not None]
    planners = [name for name in PLANNERS if f"{name}.success" in rows[0]]
    return {
        "expert": {name: share_of(all_rows, f"expert.{name}") for name in EXPERT_METRICS},
        "expert_comfortable_common": share_of(common, "expert.comfortable"),
        "within_limits_common": {
            name: share(sum(name not in row["broken_limits"] for row in common), len(common))
            for name in LIMITS
        },
        "critical": share(sum(row["critical"] for row in common), len(common)),
        "background_overlap": share(sum(row["overlaps"] > 0 for row in all_rows), len(all_rows)),
        "largest_noise_m": max(row["noise_m"] for row in all_rows),
        "difficulty": {name: difficulty(rows, rare, name) for name in planners},
        "near_at_constant_speed": near_misses(with_event),
        "severity_mps2": severity(with_event),
        "coverage": compare_coverage(rows, rare, world),
    }


def measure(args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Generate, evaluate and summarise."""
    world = replace(WorldConfig(), domain=args.domain, rare_rate=args.rare_rate)
    rare_world = replace(world, rare_rate=1.0)
    name = f"{args.domain}-{args.seed}-{args.scenarios}"
    all_count, rare_count = args.scenarios, args.rare or max(args.scenarios // 4, 1)
    sets = {
        "all": (folder / name, all_count, args.seed, world),
        "rare": (folder / f"{name}-rare-{rare_count}", rare_count, args.seed + 1, rare_world),
    }
    sys.path.append(str(Path(__file__).resolve().parents[1] / "planners"))
    planners = tuple(PLANNERS)
    generation = {
        key: generate_set(path, n, seed, args.workers, w) for key, (path, n, seed, w) in sets.items()
    }
    rows = {key: measure_set(path, planners, args.driven) for key, (path, *_) in sets.items()}
    return {
        "command": command(),
        "scenarios": all_count,
        "rare_scenarios": rare_count,
        "seed": args.seed,
        "domain": args.domain,
        **summary(rows["all"], rows["rare"], world),
        "generation": generation,
        "versions": provenance(),
    }


def provenance() -> dict[str, Any]:
    """Return the provenance of a result."""
    processor = platform.processor() or platform.machine()
    return {**versions(), "world": WORLD_VERSION, "processor": processor, "cores": os.cpu_count()}


def store_result(name: str, result: dict[str, Any]) -> None:
    """Write a result."""
    write_text(RESULTS / name, json.dumps(result, indent=1) + "\n")


def tabulate() -> None:
    """Write the stored results of both domains to the guide."""
    rates = json.loads((RESULTS / "world_speed.json").read_text())
    results = {name: json.loads((RESULTS / f"world_{name}.json").read_text()) for name in DOMAINS}
    for name, result in results.items():
        result["speed"] = rates[name]
    print(write_guide(results))


def measure_speeds(scenarios: int, workers: int) -> None:
    """Time both domains, print and store the result."""
    rates = {name: measure_speed(name, scenarios, workers) for name in DOMAINS}
    for name, rate in rates.items():
        print(f"{name}: {rate['scenarios_per_second']:.1f}/s")
    store_result("world_speed.json", {"command": command(), **rates, "versions": provenance()})


def command() -> str:
    """The command line of this run."""
    return " ".join(["python", "experiments/world/targets.py", *sys.argv[1:]])


def main() -> None:
    """Measure, print the table, and write the JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenarios", type=int, default=256)
    parser.add_argument(
        "--rare", type=int, default=None, help="scenarios of the rare set; a quarter by default"
    )
    parser.add_argument(
        "--timed",
        type=int,
        default=None,
        help="only time sets of this many scenarios of both domains, and store that; nothing else may run",
    )
    parser.add_argument(
        "--driven",
        type=int,
        default=None,
        help="scenarios of each set that planners other than the expert drive, in chunks of 512",
    )
    parser.add_argument("--rare-rate", type=float, default=0.05)
    parser.add_argument("--domain", choices=sorted(DOMAINS), default="grid")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--keep", type=Path, default=None, help="where sets are kept, and looked for")
    parser.add_argument("--write", action="store_true", help="store experiments/results/world_DOMAIN.json")
    parser.add_argument(
        "--table", action="store_true", help="put the stored results of both domains into the guide, no more"
    )
    args = parser.parse_args()
    if args.table:
        tabulate()
        return
    if args.timed is not None:
        measure_speeds(args.timed, args.workers)
        return
    if args.keep is not None:
        args.keep.mkdir(parents=True, exist_ok=True)
        result = measure(args, args.keep)
    else:
        with tempfile.TemporaryDirectory() as folder:
            result = measure(args, Path(folder))
    table = lines(result)
    width = max(len(name) for name, _ in table)
    print("\n".join(f"{name:<{width}}  {value}" for name, value in table))
    if args.write:
        store_result(f"world_{args.domain}.json", result)


if __name__ == "__main__":
    main()
