"""The built-in world, measured: the expert, the others, the events, how difficult it is, and how much it covers.

Two sets are written (or read, where an earlier run kept them): one at the configured rate of rare events, and one in
which every scenario has an event. Everything is driven through the simulator and its metrics. The comparison with
real recordings is ``benchmarks/world_resemblance.py``.

Run: python benchmarks/world.py --scenarios 256 --workers 2 [--domain ring] [--keep FOLDER] [--write]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import tempfile
from collections import Counter
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from drivax.api import evaluate, load
from drivax.planners.catalogue import PLANNERS
from drivax.scenario.schema import Scenario
from drivax.scenario.store import ScenarioSet
from drivax.synthetic.domains import DOMAINS
from drivax.synthetic.generate import Generation, generate
from drivax.synthetic.world import WORLD_VERSION, WorldConfig
from world_measures import (
    LIMITS,
    NEAR_S,
    broken_limits,
    constant_speed_ttc_s,
    overlapping_pairs,
    share,
)

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
#: Planners whose success says how difficult the world is, and what is wanted of it over all scenarios.
DRIVERS = {
    "constant_velocity": "below 0.45",
    "random": "below 0.15",
    "idm": "0.60 to 0.80",
    "search": "at least 0.95 common, 0.5 rare",
}
EXPERT_METRICS = ("accuracy", "collision", "offroad", "red_light", "comfortable", "success")
#: Scenarios that are on the device at once.
CHUNK = 512


def written(folder: Path, scenarios: int, seed: int, workers: int, world: WorldConfig) -> dict[str, Any]:
    """Generates a set if it is not there, and tells how that went."""
    note = folder.with_suffix(".json")
    if not note.is_file():
        made = generate(folder, scenarios, seed, Generation(workers=workers, world=world, overwrite=True))
        families = {
            name: {"kept": c.kept, "rejection_rate": c.rejection_rate, "causes": c.rejected}
            for name, c in made.families.items()
        }
        rate = made.scenarios / made.seconds
        note.write_text(json.dumps({"scenarios_per_second": rate, "workers": workers, "families": families}))
    return json.loads(note.read_text())


def measured(folder: Path, planners: tuple[str, ...]) -> list[dict[str, Any]]:
    """One row per scenario: tags, what its arrays show, and how every planner drove it."""
    data, rows = ScenarioSet.open(folder), []
    for first in range(0, len(data), CHUNK):
        scenarios = [data[i] for i in range(first, min(first + CHUNK, len(data)))]
        rows += _chunk(scenarios, planners)
        print(f"  {folder.name}: {len(rows)} of {len(data)} scenarios", flush=True)
    return rows


def _chunk(scenarios: list[Scenario], planners: tuple[str, ...]) -> list[dict[str, Any]]:
    loaded = load(scenarios)
    rows = [
        {
            "family": scenario.tags["family"],
            "event": scenario.tags.get("event"),
            "segment": name["segment"],
            "broken_limits": broken_limits(scenario),
            "overlaps": overlapping_pairs(scenario),
            "ttc_s": constant_speed_ttc_s(scenario) if "event" in scenario.tags else None,
        }
        for scenario, name in zip(scenarios, loaded.names, strict=True)
    ]
    for planner in ("expert", *planners):
        metrics = evaluate(planner, loaded).metrics
        wanted = EXPERT_METRICS if planner == "expert" else ("success", "accuracy")
        for i, row in enumerate(rows):
            row |= {f"{planner}.{name}": float(metrics[name][i]) for name in wanted}
    return rows


def rate_of(rows: list[dict[str, Any]], column: str) -> dict[str, float | int]:
    """Share of rows in which a metric is 1, where it is defined."""
    values = [row[column] for row in rows if np.isfinite(row[column])]
    return share(int(sum(value > 0.5 for value in values)), len(values))


def difficulty(rows: list[dict[str, Any]], rare: list[dict[str, Any]], planner: str) -> dict[str, Any]:
    """Success of a planner over all, common and rare scenarios, and how much more often it fails in rare ones."""
    column = f"{planner}.success"
    common = rate_of([row for row in rows if row["event"] is None], column)
    in_rare = rate_of([row for row in rare if row["event"] is not None], column)
    fails, fails_rare = 1.0 - common["share"], 1.0 - in_rare["share"]
    return {
        "all": rate_of(rows, column),
        "common": common,
        "rare": in_rare,
        "failure_ratio": fails_rare / fails if fails else None,
    }


def coverage(rows: list[dict[str, Any]], rare: list[dict[str, Any]], world: WorldConfig) -> dict[str, Any]:
    """Families, events and their rate, with binomial intervals; families are counted by map."""
    maps = {row["segment"]: row["family"] for row in (*rows, *rare)}
    families = Counter(maps.values())
    wanted = {family.name: p for family, p in DOMAINS[world.domain].families}
    table: dict[str, Counter[str]] = {}
    for row in rare:
        table.setdefault(row["family"], Counter())[row["event"] or "none"] += 1
    events = Counter(row["event"] for row in rare if row["event"])
    return {
        "families": {
            name: {**share(families[name], len(maps)), "wanted": wanted[name]} for name in sorted(wanted)
        },
        "rare_rate": {
            **share(sum(row["event"] is not None for row in rows), len(rows)),
            "wanted": world.rare_rate,
        },
        "events": {name: share(count, len(rare)) for name, count in sorted(events.items())},
        "event_by_family": {family: dict(counts) for family, counts in sorted(table.items())},
    }


def summary(rows: list[dict[str, Any]], rare: list[dict[str, Any]], world: WorldConfig) -> dict[str, Any]:
    """Everything that the table shows, from the rows of both sets."""
    common = [row for row in rows if row["event"] is None]
    labelled = [row for row in rare if row["event"] is not None]
    events = sorted({row["event"] for row in labelled})
    near = {
        name: share(
            sum(row["ttc_s"] < NEAR_S for row in labelled if row["event"] == name),
            sum(row["event"] == name for row in labelled),
        )
        for name in events
    }
    planners = [name for name in DRIVERS if f"{name}.success" in rows[0]]
    return {
        "expert": {name: rate_of([*rows, *rare], f"expert.{name}") for name in EXPERT_METRICS},
        "expert_comfortable_common": rate_of(common, "expert.comfortable"),
        "within_limits_common": {
            name: share(sum(name not in row["broken_limits"] for row in common), len(common))
            for name in LIMITS
        },
        "background_overlap": share(
            sum(row["overlaps"] > 0 for row in (*rows, *rare)), len(rows) + len(rare)
        ),
        "difficulty": {name: difficulty(rows, rare, name) for name in planners},
        "near_at_constant_speed": {
            "all": share(sum(row["ttc_s"] < NEAR_S for row in labelled), len(labelled)),
            **near,
        },
        "coverage": coverage(rows, rare, world),
    }


def lines(result: dict[str, Any]) -> list[tuple[str, str]]:
    """The result for people."""

    def text(one: dict[str, Any]) -> str:
        return f"{one['share']:.4f} [{one['low']:.4f}, {one['high']:.4f}] of {one['n']}"

    found = [(f"expert {name}", text(one)) for name, one in result["expert"].items()]
    found.append(("expert comfortable, common (0.95)", text(result["expert_comfortable_common"])))
    found += [(f"  within {name}", text(one)) for name, one in result["within_limits_common"].items()]
    found.append(("background overlaps (0.005)", text(result["background_overlap"])))
    for name, one in result["difficulty"].items():
        ratio = one["failure_ratio"]
        found.append((f"{name} success ({DRIVERS[name]})", text(one["all"])))
        found += [(f"  {where}", text(one[where])) for where in ("common", "rare")]
        found.append(("  failures, rare over common", "" if ratio is None else f"{ratio:.2f}"))
    near = result["near_at_constant_speed"]
    found.append((f"rare: within {NEAR_S:.0f} s at constant speed (0.8)", text(near["all"])))
    found += [(f"  {name}", text(one)) for name, one in near.items() if name != "all"]
    cover = result["coverage"]
    found.append((f"rare events (configured {cover['rare_rate']['wanted']:.3f})", text(cover["rare_rate"])))
    for name, one in cover["families"].items():
        inside = "" if one["low"] <= one["wanted"] <= one["high"] else "  OUTSIDE"
        found.append((f"  {name} (configured {one['wanted']:.3f})", text(one) + inside))
    found += [(f"  event {name}", text(one)) for name, one in cover["events"].items()]
    for name, made in result["generation"].items():
        rate = f"{made['scenarios_per_second']:.1f}/s with {made['workers']} workers"
        found.append((f"generation of {name}", rate))
        for family, one in made["families"].items():
            causes = ", ".join(f"{k} {v}" for k, v in sorted(one["causes"].items()))
            found.append((f"  {family} rejected", f"{one['rejection_rate']:.3f} ({causes})"))
    return found


def measure(args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Generates, drives and sums up."""
    world = replace(WorldConfig(), domain=args.domain, rare_rate=args.rare_rate)
    rare_world = replace(world, rare_rate=1.0)
    name = f"{args.domain}-{args.seed}-{args.scenarios}"
    all_count, rare_count = args.scenarios, args.rare or max(args.scenarios // 4, 1)
    sets = {
        "all": (folder / name, all_count, args.seed, world),
        "rare": (folder / f"{name}-rare-{rare_count}", rare_count, args.seed + 1, rare_world),
    }
    planners = tuple(planner for planner in DRIVERS if planner in PLANNERS)
    made = {key: written(path, n, seed, args.workers, w) for key, (path, n, seed, w) in sets.items()}
    rows = {key: measured(path, planners) for key, (path, *_) in sets.items()}
    return {
        "command": f"python benchmarks/world.py --scenarios {args.scenarios} --domain {args.domain}",
        "scenarios": all_count,
        "rare_scenarios": rare_count,
        "seed": args.seed,
        "domain": args.domain,
        **summary(rows["all"], rows["rare"], world),
        "generation": made,
        "versions": {
            "drivax": metadata.version("drivax"),
            "world": WORLD_VERSION,
            "numpy": np.__version__,
            "jax": metadata.version("jax"),
            "python": platform.python_version(),
            "processor": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
        },
    }


def main() -> None:
    """Measures, prints the table, and writes the JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenarios", type=int, default=256)
    parser.add_argument(
        "--rare", type=int, default=None, help="scenarios of the rare set; a quarter by default"
    )
    parser.add_argument("--rare-rate", type=float, default=0.05)
    parser.add_argument("--domain", choices=sorted(DOMAINS), default="grid")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--keep", type=Path, default=None, help="where sets are kept, and looked for")
    parser.add_argument("--write", action="store_true", help="store benchmarks/results/world_DOMAIN.json")
    args = parser.parse_args()
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
        target = RESULTS / f"world_{args.domain}.json"
        partial = target.with_name(f".{target.name}.partial")
        partial.write_text(json.dumps(result, indent=1) + "\n")
        partial.replace(target)


if __name__ == "__main__":
    main()
