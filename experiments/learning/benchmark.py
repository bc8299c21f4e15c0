"""Evaluate every planner on the benchmark's test split, in log replay and reactive traffic.

python -m experiments.learning.benchmark drive --data BENCHMARK [--planner NAME ...] [--traffic KIND ...]
python -m experiments.learning.benchmark judge     (means with intervals of the episodes, and the page)
python -m experiments.learning.benchmark table     (write the stored result to the page)

`drive` stores the episodes of each planner and traffic in one file. Learned planners are read from
experiments/state/policies, where `presets.py train` stores them, with several seeds each.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from drivax.api import find_planner
from drivax.evaluation.audit import scenario_names
from drivax.evaluation.episode_table import SHARES, EpisodeTable, interval_of
from drivax.evaluation.runner import evaluate
from drivax.learning.policies import find_traffic, load_policy
from drivax.planners.planner import Planner
from drivax.planners.simple import RandomActions
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.stats.intervals import Interval, bootstrap_mean, paired_bootstrap
from drivax.stats.seeds import difference_interval, seeds_interval
from drivax.tasks.actions import Published
from drivax.tasks.task import Task
from drivax.tracking.run_folder import versions
from experiments.learning.tables import interval, table
from experiments.repository import DOCS, RESULTS, STATE, fetch

#: Weights of all seeds of the learned planners, and episodes of all planners; fetched from history if missing.
POLICIES, EPISODES = STATE / "policies", STATE / "benchmark"
#: Episodes of the same planners and scenarios with the definitions before decisions 0011 and 0012.
FORMER_EPISODES = STATE / "benchmark-former"
RESULT = RESULTS / "benchmark.json"
PAGE = DOCS / "results" / "benchmark.md"
TRAFFIC = ("log", "idm")
#: Random actions in the box of the published action space, shown in a separate table.
BOX = "random in the published box"
PLANNERS = ("expert", "pdm", "idm", "constant_velocity", "random", BOX)
#: Columns of the page, with their short names.
COLUMNS = {
    "accuracy": "accuracy", "collision": "collision", "at_fault_collision": "at fault", "offroad": "off-road",
    "red_light": "red light", "progress": "progress (m)", "ttc_ok": "ttc", "comfortable": "comfort",
    "vmax_score": "vmax score",
}  # fmt: skip
#: Planners to compare every learned planner with, and the metrics of the comparison.
REFERENCES, DIFFERENCE_METRICS = ("idm", "pdm"), ("accuracy", "at_fault_collision", "vmax_score")
#: Metrics that decisions 0011 and 0012 changed.
CHANGED_METRICS = {
    "at_fault_collision": "at fault", "offroad": "off-road", "comfortable": "comfort",
    "speed_compliance": "speed compliance", "vmax_score": "vmax score", "nuplan_score": "nuplan score",
}  # fmt: skip
#: Tags for the breakdown of accuracy, and the file with the tags of the scenarios.
TAGS, STRATA = ("difficulty", "type", "density"), "strata.npz"
#: Metrics of random actions until the first failure, where published episodes end.
FAILURE_METRICS = {"steps_until_failure": "steps", "metres_until_failure": "metres driven"}

Metrics = dict[str, np.ndarray[Any, Any]]


@dataclass(frozen=True)
class Episodes:
    """Episodes of one planner in one kind of traffic.

    Attributes:
        values: ``[seeds, scenarios]`` by metric, NaN where undefined.
        segments: Segment of each scenario.
        about: ``planner``, ``traffic``, ``seeds``, ``test`` (hash of the set), ``when``, ``versions``.
    """

    values: Metrics
    segments: np.ndarray[Any, Any]
    about: Mapping[str, Any]


def learned_planners() -> dict[str, list[Path]]:
    """Return the folders of all seeds of every learned planner."""
    return {path.name: sorted(path.glob("seed-*")) for path in sorted(POLICIES.glob("*")) if path.is_dir()}


def load_planners(name: str, bank: ScenarioBank) -> list[tuple[Planner, Task]]:
    """Load the planner of a name, or one planner per seed."""
    if name == BOX:
        return [(RandomActions(), Task(actions=Published()))]
    folders = learned_planners().get(name)
    if not folders:
        return [find_planner(name, bank)]
    # With one name, all seeds share a compiled program.
    loaded = [load_policy(folder, bank) for folder in folders]
    return [(replace(planner, name=name), task) for planner, task in loaded]


def metrics_until_failure(results: EpisodeTable) -> Metrics:
    """Return steps and metres driven until the first collision, off-road step or red light, or to the end."""
    driven = results.trajectories
    events = np.stack([*driven.events.values()])
    last = driven.ego.shape[1] - 1
    steps = np.where(events < 0, last, events - driven.start).min(axis=0)
    moved = np.hypot(*np.moveaxis(np.diff(driven.ego[:, :, :2], axis=1), -1, 0))
    within = np.arange(last) < steps[:, None]
    return {"steps_until_failure": steps, "metres_until_failure": np.where(within, moved, 0.0).sum(axis=1)}


def evaluate_planners(args: argparse.Namespace) -> None:
    """Evaluate the requested planners in each kind of traffic and store the episodes."""
    stored = ScenarioSet.open(args.data / "test")
    scenarios = list(stored)
    bank, names = ScenarioBank.from_scenarios(scenarios), scenario_names(scenarios)
    EPISODES.mkdir(parents=True, exist_ok=True)
    tags = {tag: np.array([entry["tags"][tag] for entry in stored.entries]) for tag in TAGS}
    np.savez_compressed(EPISODES / STRATA, allow_pickle=False, test=np.array(stored.hash), **tags)
    for name in args.planner or (*PLANNERS, *learned_planners()):
        for kind in args.traffic:
            found = [
                evaluate(planner, bank, names, task=task, traffic=find_traffic(kind))
                for planner, task in load_planners(name, bank)
            ]
            about = {
                "planner": name,
                "traffic": kind,
                "seeds": len(found),
                "test": stored.hash,
                "when": datetime.now(UTC).isoformat(timespec="minutes"),
                "versions": versions(),
            }
            values = {metric: [results.metrics[metric] for results in found] for metric in found[0].metrics}
            for results in found:
                for metric, row in metrics_until_failure(results).items():
                    values.setdefault(metric, []).append(row)
            np.savez_compressed(
                episodes_file(name, kind),
                allow_pickle=False,
                about=np.array(json.dumps(about)),
                segment=np.array([row["segment"] for row in names]),
                **{metric: np.array(rows, np.float32) for metric, rows in values.items()},
            )
            print(name, kind, *(round(float(results.metrics["accuracy"].mean()), 3) for results in found))


def episodes_file(name: str, kind: str) -> Path:
    """Return the file of the stored episodes."""
    return EPISODES / f"{name.replace(' ', '_')}-{kind}.npz"


def read_episodes(name: str, kind: str, folder: Path | None = None) -> Episodes | None:
    """Return the stored episodes of a planner, or None without any."""
    file = (folder or EPISODES) / episodes_file(name, kind).name
    if not file.is_file():
        return None
    with np.load(file, allow_pickle=False) as found:
        values = {key: found[key] for key in found.files if key not in ("about", "segment")}
        return Episodes(values, found["segment"], json.loads(str(found["about"])))


def mean_interval(driven: Episodes, metric: str, against: Episodes | None = None) -> Interval:
    """Return the mean, or mean paired difference, with its interval over segments and, if several, seeds."""
    own, segments = driven.values[metric].astype(np.float64), driven.segments
    if against is None:
        if len(own) == 1:
            return interval_of(metric, own[0], segments)
        return seeds_interval(own, segments, share=metric in SHARES)
    other = against.values[metric].astype(np.float64)
    if len(own) == len(other) == 1:
        return paired_bootstrap(own[0], other[0], segments, seed=0)
    return difference_interval(own, other, segments)[0]


def mean_change(driven: Episodes, metric: str, before: Episodes) -> Interval:
    """Return the mean paired difference of the same planner between two kinds of traffic."""
    apart = driven.values[metric].astype(np.float64) - before.values[metric]
    if len(apart) == 1:
        return bootstrap_mean(apart[0], driven.segments, seed=0)
    return seeds_interval(apart, driven.segments)


def compare_definitions(driven: Episodes, former: Episodes) -> dict[str, dict[str, float]]:
    """Return means of the changed metrics before and after, and the share of episodes with a different value."""
    found = {}
    for metric in CHANGED_METRICS:
        before, now = (one.values[metric].astype(np.float64) for one in (former, driven))
        moved = ~np.isclose(before, now, rtol=0, atol=1e-5, equal_nan=True)
        found[metric] = {
            "before": float(np.nanmean(before)), "after": float(np.nanmean(now)), "moved": float(moved.mean())
        }  # fmt: skip
    return found


def compute_results() -> dict[str, Any]:
    """Compute all results of the page from the stored episodes."""
    driven = {
        (name, kind): found
        for name in (*PLANNERS, *learned_planners())
        for kind in TRAFFIC
        if (found := read_episodes(name, kind)) is not None
    }
    tests = {found.about["test"] for found in driven.values()}
    if len(tests) != 1:
        raise SystemExit(f"{len(tests)} test sets: drive all planners on one")
    planners: dict[str, Any] = {}
    for (name, kind), found in driven.items():
        metrics = (*COLUMNS, *FAILURE_METRICS) if name in (BOX, "expert") else COLUMNS
        planners.setdefault(name, {"seeds": found.about["seeds"]})[kind] = {
            metric: mean_interval(found, metric).as_dict() for metric in metrics
        }
    return {
        "command": "python -m experiments.learning.benchmark judge",
        "test": {"hash": tests.pop(), "scenarios": len(next(iter(driven.values())).segments)},
        "planners": planners,
        "reactive": {
            name: {
                metric: mean_change(driven[name, "idm"], metric, driven[name, "log"]).as_dict()
                for metric in COLUMNS
            }
            for name in planners
            if name != BOX and {(name, kind) for kind in TRAFFIC} <= driven.keys()
        },
        "differences": {
            kind: {
                f"{name} - {other}": {
                    metric: mean_interval(driven[name, kind], metric, driven[other, kind]).as_dict()
                    for metric in DIFFERENCE_METRICS
                }
                for other in REFERENCES
                for name in ("expert", *(name for name in ("pdm",) if name != other), *learned_planners())
                if {(name, kind), (other, kind)} <= driven.keys()
            }
            for kind in TRAFFIC
        },
        "strata": stratify(driven),
        "changes": {
            f"{name}, {kind}": compare_definitions(found, former)
            for (name, kind), found in driven.items()
            if (former := read_episodes(name, kind, FORMER_EPISODES)) is not None
        },
        "driven": {f"{name}, {kind}": dict(found.about) for (name, kind), found in driven.items()},
    }


def stratify(driven: Mapping[tuple[str, str], Episodes]) -> list[dict[str, Any]]:
    """Return the accuracy of every planner in log replay traffic, by tag and value."""
    with np.load(EPISODES / STRATA, allow_pickle=False) as stored:
        tags, of = {tag: stored[tag] for tag in TAGS}, str(stored["test"])
    if any(one.about["test"] != of for one in driven.values()):
        raise SystemExit("the tags are those of another test set: evaluate a planner again")
    planners = {name: one for (name, kind), one in driven.items() if kind == "log" and name != BOX}
    found = []
    for tag, values in tags.items():
        for value in np.unique(values):
            rows = values == value
            some = {
                name: mean_interval(
                    replace(
                        one, values={"accuracy": one.values["accuracy"][:, rows]}, segments=one.segments[rows]
                    ),
                    "accuracy",
                )
                for name, one in planners.items()
            }
            intervals = {name: one.as_dict() for name, one in some.items()}
            found.append(
                {"tag": tag, "value": str(value), "scenarios": int(rows.sum()), "planners": intervals}
            )
    return found


def page_tables(result: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the lines of the page's tables by name."""
    planners = result["planners"]
    order = sorted(
        (name for name in planners if name != BOX and "log" in planners[name]),
        key=lambda name: -planners[name]["log"]["vmax_score"]["mean"],
    )
    heads = ("planner", "seeds", *COLUMNS.values())
    found = {
        kind: table(
            heads,
            [
                (f"`{name}`", str(planners[name]["seeds"]), *format_cells(planners[name][kind], COLUMNS))
                for name in order
                if kind in planners[name]
            ],
        )
        for kind in TRAFFIC
    }
    rows = [
        (f"`{name}`", *format_cells(result["reactive"][name], COLUMNS, signed=True))
        for name in order
        if name in result["reactive"]
    ]
    found["reactive"] = table(("planner", *COLUMNS.values()), rows)
    found["differences"] = table(
        ("difference", "traffic", *(COLUMNS[metric] for metric in DIFFERENCE_METRICS)),
        [
            (pair, f"`{kind}`", *format_cells(one, DIFFERENCE_METRICS, signed=True))
            for kind, pairs in result["differences"].items()
            for pair, one in pairs.items()
        ],
    )
    shown = {**FAILURE_METRICS, "collision": "collision", "offroad": "off-road"}
    rows = [
        (name, f"`{kind}`", *format_cells(planners[name][kind], shown))
        for name in (BOX, "expert")
        for kind in TRAFFIC
        if kind in planners.get(name, {})
    ]
    found["random"] = table(("planner", "traffic", *shown.values()), rows)
    found["changes"] = table(
        ("planner", "traffic", *CHANGED_METRICS.values()),
        [
            (
                f"`{name}`",
                f"`{kind}`",
                *(format_change(result["changes"][f"{name}, {kind}"][m]) for m in CHANGED_METRICS),
            )
            for name in order
            for kind in TRAFFIC
            if f"{name}, {kind}" in result["changes"]
        ],
    )
    names = [name for name in order if name in result["strata"][0]["planners"]]
    found["strata"] = table(
        ("tag", "value", "scenarios", *(f"`{name}`" for name in names)),
        [
            (
                one["tag"],
                one["value"],
                f"{one['scenarios']:,}",
                *(interval(one["planners"][n]) for n in names),
            )
            for one in result["strata"]
        ],
    )
    return found


def format_cells(
    found: Mapping[str, Any], metrics: Sequence[str] | Mapping[str, str], signed: bool = False
) -> list[str]:
    """Format means with intervals; metres with one digit."""
    return [
        interval(
            found[metric], signed=signed, digits=1 if "progress" in metric or metric in FAILURE_METRICS else 3
        )
        for metric in metrics
    ]


def format_change(one: Mapping[str, float]) -> str:
    """Format a mean before and after, with the share of changed episodes, or the mean alone if none changed."""
    if one["moved"] == 0.0:
        return f"{one['after']:.3f}"
    return f"{one['before']:.3f} to {one['after']:.3f} ({one['moved']:.1%})"


def fill_page(text: str, result: Mapping[str, Any]) -> str:
    """Return the page with the stored tables."""
    for what, lines in page_tables(result).items():
        begin, end = f"<!-- benchmark.py: {what} -->", "<!-- benchmark.py: end -->"
        before, rest = text.split(begin)
        shown = "\n".join(lines)
        text = f"{before}{begin}\n\n{shown}\n\n{end}{rest.split(end, 1)[1]}"
    return text


def main() -> None:
    """Evaluate, compare, or write the stored results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    driving = commands.add_parser("drive")
    driving.add_argument("--data", type=Path, required=True)
    driving.add_argument("--planner", nargs="+", default=())
    driving.add_argument("--traffic", nargs="+", choices=TRAFFIC, default=TRAFFIC)
    commands.add_parser("judge")
    commands.add_parser("table")
    args = parser.parse_args()
    if args.command != "table":
        fetch("benchmarks/policies", POLICIES)
        fetch("benchmarks/results/benchmark", FORMER_EPISODES)
    if args.command == "drive":
        evaluate_planners(args)
        return
    if args.command == "judge":
        RESULT.write_text(json.dumps(compute_results(), indent=1) + "\n")
    PAGE.write_text(fill_page(PAGE.read_text(), json.loads(RESULT.read_text())))


if __name__ == "__main__":
    main()
