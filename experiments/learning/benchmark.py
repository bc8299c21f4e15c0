"""Evaluate every planner on the benchmark's test split, in log replay and reactive traffic.

python -m experiments.learning.benchmark drive --data BENCHMARK [--planner NAME ...] [--traffic KIND ...]
python -m experiments.learning.benchmark judge     (means with intervals of the episodes, and the page)
python -m experiments.learning.benchmark table     (write the stored result to the page)

`drive` stores the episodes of each planner and traffic in one file. Learned planners are those in
experiments/state/policies, where `presets.py collect` stores all seeds of each.
"""

from __future__ import annotations

import argparse
import json
import re
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
from drivax.stats.intervals import Interval, bootstrap_mean, paired_bootstrap, per_event
from drivax.stats.seeds import difference_interval, seeds_interval
from drivax.tasks.actions import Published
from drivax.tasks.task import Task
from drivax.tracking.run_folder import versions
from experiments.learning.tables import interval, label, label_pair, table
from experiments.repository import DOCS, RESULTS, ROOT, STATE, fetch, fill_places

CONFIGS = ROOT / "configs"
#: Weights of all seeds of the learned planners, and episodes of all planners.
POLICIES, EPISODES = STATE / "policies", STATE / "benchmark"
#: Episodes of the same planners and scenarios with the definitions before decisions 0011 and 0012.
FORMER_EPISODES = STATE / "benchmark-former"
RESULT = RESULTS / "benchmark.json"
PAGE = DOCS / "results" / "benchmark.md"
TRAFFIC = ("log", "idm")
#: Random actions in the box of the published action space, shown in a separate table.
BOX = "random in the published box"
PLANNERS = ("expert", "pdm", "idm", "constant_speed", "constant_velocity", "random", BOX)
#: Trainings that differ in one setting, by table of the docs; the first is the reference. Trainings that are not
#: presets are in these tables only.
COMPARISONS = {
    "encoders": ("encoder_mlp", "encoder_lq", "encoder_entity"),
    "constraints": ("weights", "constraints"),
    "budget": ("ppo_21m", "ppo"),
}
#: Columns of the page, with their short names.
COLUMNS = {
    "success": "success", "accuracy": "accuracy", "collision": "collision", "at_fault_collision": "at fault",
    "offroad": "off-road", "red_light": "red light", "distance_ratio": "distance ratio", "log_lead": "lead (s)",
    "ttc_ok": "ttc", "comfortable": "comfort", "vmax_score": "vmax score",
}  # fmt: skip
#: Planners to compare every learned planner with, and the metrics of the comparison.
REFERENCES = ("constant_speed", "idm", "pdm", "bc")
DIFFERENCE_METRICS = ("success", "accuracy", "at_fault_collision", "vmax_score")
#: Metrics that decisions 0011 and 0012 changed.
CHANGED_METRICS = {
    "at_fault_collision": "at fault", "offroad": "off-road", "comfortable": "comfort",
    "speed_compliance": "speed compliance", "vmax_score": "vmax score", "nuplan_score": "nuplan score",
}  # fmt: skip
#: Goals, whose values were set before training: what, entry of the result, end of its interval, whether larger is
#: better, the value to reach, and the value to aim for (None: none).
GOALS = (
    ("`ppo`, from scratch", ("planners", "ppo", "log", "accuracy"), "mean", True, 0.93, 0.97),
    ("`ppo`, from scratch", ("planners", "ppo", "log", "success"), "mean", True, 0.87, 0.95),
    ("`ppo_physical`, from scratch", ("planners", "ppo_physical", "log", "accuracy"), "mean", True, 0.88, 0.95),
    ("`ppo_physical`, from scratch", ("planners", "ppo_physical", "log", "success"), "mean", True, 0.80, 0.90),
    ("`sac`, from scratch", ("planners", "sac", "log", "accuracy"), "mean", True, 0.80, 0.95),
    ("`ppo` minus `pdm`", ("differences", "log", "ppo - pdm", "accuracy"), "low", True, 0.0, 0.03),
    ("`ppo` minus `pdm`", ("differences", "log", "ppo - pdm", "vmax_score"), "low", True, 0.0, 0.03),
    ("`ppo` minus `pdm`", ("differences", "log", "ppo - pdm", "at_fault_collision"), "high", False, 0.01, 0.0),
    ("the same in `idm` traffic", ("differences", "idm", "ppo - pdm", "accuracy"), "low", True, 0.0, 0.03),
    ("the same in `idm` traffic", ("differences", "idm", "ppo - pdm", "vmax_score"), "low", True, 0.0, 0.03),
    (
        "the same in `idm` traffic",
        ("differences", "idm", "ppo - pdm", "at_fault_collision"), "high", False, 0.01, 0.0,
    ),
    (
        "`ppo` minus `constant_speed`",
        ("differences", "log", "ppo - constant_speed", "success"), "low", True, 0.15, None,
    ),
    ("`bc_sac` minus `bc`", ("differences", "log", "bc_sac - bc", "success"), "low", True, 0.0, 0.10),
    ("`ppo`, `idm` minus `log` traffic", ("reactive", "ppo", "accuracy"), "low", True, -0.02, 0.0),
    ("`ppo`", ("planners", "ppo", "log", "distance_ratio"), "mean", False, 1.08, None),
    ("`ppo`", ("planners", "ppo", "log", "log_lead"), "mean", False, 0.5, None),
    ("`sac`", ("planners", "sac", "log", "distance_ratio"), "mean", False, 1.08, None),
    ("`sac`", ("planners", "sac", "log", "log_lead"), "mean", False, 0.5, None),
    ("`self_play`", ("planners", "self_play", "log", "km_per_fault"), "low", True, None, 10.0),
)  # fmt: skip
#: Tags for the breakdown of accuracy, and the file with the tags of the scenarios.
TAGS, STRATA = ("difficulty", "type", "density"), "strata.npz"
#: Metrics of random actions until the first failure, where published episodes end.
FAILURE_METRICS = {"steps_until_failure": "steps", "metres_until_failure": "metres driven"}
#: Kilometres driven per episode with an at-fault collision.
KM_PER_FAULT = "km_per_fault"
#: Names of all columns.
NAMES = COLUMNS | {KM_PER_FAULT: "km per fault"}

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


def preset_planners() -> dict[str, list[Path]]:
    """Return the folders of all seeds of the presets."""
    return {
        name: folders for name, folders in learned_planners().items() if (CONFIGS / f"{name}.yaml").is_file()
    }


def load_planners(name: str, bank: ScenarioBank) -> list[tuple[Planner, Task]]:
    """Load the planner of a name, or one planner per seed."""
    if name == BOX:
        return [(RandomActions(), Task(actions=Published()))]
    folders = learned_planners().get(name)
    if not folders:
        return [find_planner(name, bank)]
    # With one name, all seeds share a compiled program.
    policies = [load_policy(folder, bank) for folder in folders]
    return [(replace(planner, name=name), task) for planner, task in policies]


def metrics_until_failure(results: EpisodeTable) -> Metrics:
    """Return steps and metres driven until the first collision, off-road step or red light, or to the end."""
    trajectories = results.trajectories
    events = np.stack([*trajectories.events.values()])
    last = trajectories.ego.shape[1] - 1
    steps = np.where(events < 0, last, events - trajectories.start).min(axis=0)
    distances = np.hypot(*np.moveaxis(np.diff(trajectories.ego[:, :, :2], axis=1), -1, 0))
    within = np.arange(last) < steps[:, None]
    return {
        "steps_until_failure": steps,
        "metres_until_failure": np.where(within, distances, 0.0).sum(axis=1),
    }


def evaluate_planners(args: argparse.Namespace) -> None:
    """Evaluate the requested planners in each kind of traffic and store the episodes."""
    test_set = ScenarioSet.open(args.data / "test")
    scenarios = list(test_set)
    bank, names = ScenarioBank.from_scenarios(scenarios), scenario_names(scenarios)
    EPISODES.mkdir(parents=True, exist_ok=True)
    tags = {tag: np.array([entry["tags"][tag] for entry in test_set.entries]) for tag in TAGS}
    np.savez_compressed(EPISODES / STRATA, allow_pickle=False, test=np.array(test_set.hash), **tags)
    for name in args.planner or (*PLANNERS, *learned_planners()):
        for kind in args.traffic:
            tables = [
                evaluate(planner, bank, names, task=task, traffic=find_traffic(kind))
                for planner, task in load_planners(name, bank)
            ]
            about = {
                "planner": name,
                "traffic": kind,
                "seeds": len(tables),
                "test": test_set.hash,
                "when": datetime.now(UTC).isoformat(timespec="minutes"),
                "versions": versions(),
            }
            values = {
                metric: [episodes.metrics[metric] for episodes in tables] for metric in tables[0].metrics
            }
            for episodes in tables:
                for metric, row in metrics_until_failure(episodes).items():
                    values.setdefault(metric, []).append(row)
            np.savez_compressed(
                episodes_file(name, kind),
                allow_pickle=False,
                about=np.array(json.dumps(about)),
                segment=np.array([row["segment"] for row in names]),
                **{metric: np.array(rows, np.float32) for metric, rows in values.items()},
            )
            print(name, kind, *(round(float(episodes.metrics["accuracy"].mean()), 3) for episodes in tables))


def episodes_file(name: str, kind: str) -> Path:
    """Return the file of the stored episodes."""
    return EPISODES / f"{name.replace(' ', '_')}-{kind}.npz"


def read_episodes(name: str, kind: str, folder: Path | None = None) -> Episodes | None:
    """Return the stored episodes of a planner, or None without any."""
    file = (folder or EPISODES) / episodes_file(name, kind).name
    if not file.is_file():
        return None
    with np.load(file, allow_pickle=False) as arrays:
        values = {key: arrays[key] for key in arrays.files if key not in ("about", "segment")}
        return Episodes(values, arrays["segment"], json.loads(str(arrays["about"])))


def mean_interval(episodes: Episodes, metric: str, against: Episodes | None = None) -> Interval:
    """Return the mean, or mean paired difference, with its interval over segments and, if several, seeds."""
    values, segments = episodes.values[metric].astype(np.float64), episodes.segments
    if against is None:
        if len(values) == 1:
            return interval_of(metric, values[0], segments)
        return seeds_interval(values, segments, share=metric in SHARES)
    other_values = against.values[metric].astype(np.float64)
    if len(values) == len(other_values) == 1:
        return paired_bootstrap(values[0], other_values[0], segments, seed=0)
    return difference_interval(values, other_values, segments)[0]


def distance_ratio(episodes: Episodes, expert: Episodes) -> np.ndarray[Any, Any]:
    """Return the distance driven over that of the expert, NaN where the expert stands."""
    expert_m = expert.values["distance"]
    return episodes.values["distance"] / np.where(expert_m > 0, expert_m, np.nan)


def km_per_fault(episodes: Episodes) -> Interval:
    """Return the kilometres per episode with an at-fault collision, of all seeds together."""
    faults = int(np.nansum(episodes.values["at_fault_collision"]))
    return per_event(faults, float(np.nansum(episodes.values["distance"])) / 1000.0)


def mean_change(episodes: Episodes, metric: str, reference: Episodes) -> Interval:
    """Return the mean paired difference of the same planner between two kinds of traffic."""
    differences = episodes.values[metric].astype(np.float64) - reference.values[metric]
    if len(differences) == 1:
        return bootstrap_mean(differences[0], episodes.segments, seed=0)
    return seeds_interval(differences, episodes.segments)


def compare_definitions(episodes: Episodes, former: Episodes) -> dict[str, dict[str, float]]:
    """Return means of the changed metrics before and after, and the share of episodes with a different value."""
    result = {}
    for metric in CHANGED_METRICS:
        old_values, new_values = (version.values[metric].astype(np.float64) for version in (former, episodes))
        differs = ~np.isclose(old_values, new_values, rtol=0, atol=1e-5, equal_nan=True)
        result[metric] = {
            "before": float(np.nanmean(old_values)),
            "after": float(np.nanmean(new_values)),
            "moved": float(differs.mean()),
        }
    return result


def compute_results() -> dict[str, Any]:
    """Compute all results of the page from the stored episodes."""
    all_episodes = {
        (name, kind): episodes
        for name in (*PLANNERS, *preset_planners())
        for kind in TRAFFIC
        if (episodes := read_episodes(name, kind)) is not None
    }
    tests = {episodes.about["test"] for episodes in all_episodes.values()}
    if len(tests) != 1:
        raise SystemExit(f"{len(tests)} test sets: evaluate all planners on one")
    if ("expert", "log") not in all_episodes:
        raise SystemExit("evaluate the expert in log traffic, too: distances are relative to the expert's")
    for episodes in all_episodes.values():
        episodes.values["distance_ratio"] = distance_ratio(episodes, all_episodes["expert", "log"])
    planners: dict[str, Any] = {}
    for (name, kind), episodes in all_episodes.items():
        metrics = (*COLUMNS, *FAILURE_METRICS) if name in (BOX, "expert") else COLUMNS
        planners.setdefault(name, {"seeds": episodes.about["seeds"]})[kind] = {
            metric: mean_interval(episodes, metric).as_dict() for metric in metrics
        } | {KM_PER_FAULT: km_per_fault(episodes).as_dict()}
    return {
        "command": "python -m experiments.learning.benchmark judge",
        "test": {"hash": tests.pop(), "scenarios": len(next(iter(all_episodes.values())).segments)},
        "planners": planners,
        "reactive": {
            name: {
                metric: mean_change(all_episodes[name, "idm"], metric, all_episodes[name, "log"]).as_dict()
                for metric in COLUMNS
            }
            for name in planners
            if name != BOX and {(name, kind) for kind in TRAFFIC} <= all_episodes.keys()
        },
        "differences": {
            kind: {
                f"{name} - {other}": {
                    metric: mean_interval(
                        all_episodes[name, kind], metric, all_episodes[other, kind]
                    ).as_dict()
                    for metric in DIFFERENCE_METRICS
                }
                for other in REFERENCES
                for name in (*(("expert", "pdm") if other != "bc" else ()), *preset_planners())
                if name != other and {(name, kind), (other, kind)} <= all_episodes.keys()
            }
            for kind in TRAFFIC
        },
        "strata": stratify(all_episodes),
        "changes": {
            f"{name}, {kind}": compare_definitions(episodes, former_episodes)
            for (name, kind), episodes in all_episodes.items()
            if name in PLANNERS
            and (former_episodes := read_episodes(name, kind, FORMER_EPISODES)) is not None
        },
        "driven": {
            f"{name}, {kind}": dict(episodes.about) for (name, kind), episodes in all_episodes.items()
        },
    }


def stratify(all_episodes: Mapping[tuple[str, str], Episodes]) -> list[dict[str, Any]]:
    """Return the accuracy of every planner in log replay traffic, by tag and value."""
    with np.load(EPISODES / STRATA, allow_pickle=False) as arrays:
        tags, test_hash = {tag: arrays[tag] for tag in TAGS}, str(arrays["test"])
    if any(episodes.about["test"] != test_hash for episodes in all_episodes.values()):
        raise SystemExit("the stored tags have another test set: evaluate a planner again")
    planners = {
        name: episodes for (name, kind), episodes in all_episodes.items() if kind == "log" and name != BOX
    }
    strata = []
    for tag, values in tags.items():
        for value in np.unique(values):
            rows = values == value
            intervals = {
                name: mean_interval(
                    replace(
                        episodes,
                        values={"accuracy": episodes.values["accuracy"][:, rows]},
                        segments=episodes.segments[rows],
                    ),
                    "accuracy",
                ).as_dict()
                for name, episodes in planners.items()
            }
            strata.append(
                {"tag": tag, "value": str(value), "scenarios": int(rows.sum()), "planners": intervals}
            )
    return strata


def goals_table(result: Mapping[str, Any]) -> list[str]:
    """Return a table of the goals, what was measured, and whether they and their aims were reached."""
    rows = []
    for what, keys, end, is_more_better, goal, aim in GOALS:
        measured: Any = result
        for key in keys:
            measured = measured.get(key, {})
        if not measured:
            continue
        sign, is_interval = 1 if is_more_better else -1, end != "mean"
        margins = {
            name: sign * (measured[end] - bound)
            for name, bound in (("aim", aim), ("goal", goal))
            if bound is not None
        }
        # An interval that touches the bound does not exclude it.
        reached = [
            name for name, margin in margins.items() if margin > 0 or (margin == 0 and not is_interval)
        ]
        words = ("above", "below") if is_interval else ("at least", "at most")
        rows.append([
            re.sub(r"`(\w+)`", lambda name: label(name[1]), what)
            + f": {NAMES[keys[-1]]}",
            "" if goal is None else f"{'interval ' * is_interval}{words[not is_more_better]} {goal:g}",
            "" if aim is None else f"{aim:g}",
            interval(measured, signed=keys[0] != "planners", digits=4),
            [*reached, "**no**"][0],
        ])  # fmt: skip
    return table(("what", "goal", "aim", "measured", "reached"), rows)


def page_tables(result: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the lines of the page's tables by name."""
    planners = result["planners"]
    order = sorted(
        (name for name in planners if name != BOX and "log" in planners[name]),
        key=lambda name: -planners[name]["log"]["vmax_score"]["mean"],
    )
    headings = ("planner", "seeds", *NAMES.values())
    tables = {
        kind: table(
            headings,
            [
                (
                    label(name),
                    str(planners[name]["seeds"]),
                    *format_cells(planners[name][kind], (*COLUMNS, KM_PER_FAULT)),
                )
                for name in order
                if kind in planners[name]
            ],
        )
        for kind in TRAFFIC
    }
    rows = [
        (label(name), *format_cells(result["reactive"][name], COLUMNS, signed=True))
        for name in order
        if name in result["reactive"]
    ]
    tables["goals"] = goals_table(result)
    tables["reactive"] = table(("planner", *COLUMNS.values()), rows)
    tables["differences"] = table(
        ("difference", "traffic", *(COLUMNS[metric] for metric in DIFFERENCE_METRICS)),
        [
            (label_pair(pair), f"`{kind}`", *format_cells(row, DIFFERENCE_METRICS, signed=True))
            for kind, pairs in result["differences"].items()
            for pair, row in pairs.items()
        ],
    )
    columns = {**FAILURE_METRICS, "collision": "collision", "offroad": "off-road"}
    rows = [
        (name, f"`{kind}`", *format_cells(planners[name][kind], columns))
        for name in (BOX, "expert")
        for kind in TRAFFIC
        if kind in planners.get(name, {})
    ]
    tables["random"] = table(("planner", "traffic", *columns.values()), rows)
    tables["changes"] = table(
        ("planner", "traffic", *CHANGED_METRICS.values()),
        [
            (
                *(f"`{part}`" for part in key.split(", ")),
                *(format_change(changes[m]) for m in CHANGED_METRICS),
            )
            for key, changes in result["changes"].items()
        ],
    )
    names = [name for name in order if name in result["strata"][0]["planners"]]
    tables["strata"] = table(
        ("tag", "value", "scenarios", *map(label, names)),
        [
            (
                row["tag"],
                row["value"],
                f"{row['scenarios']:,}",
                *(interval(row["planners"][n]) for n in names),
            )
            for row in result["strata"]
        ],
    )
    return tables


def format_cells(
    intervals: Mapping[str, Any], metrics: Sequence[str] | Mapping[str, str], signed: bool = False
) -> list[str]:
    """Format means with intervals; distances with one digit."""
    return [
        interval(
            intervals[metric],
            signed=signed,
            digits=1 if metric in (*FAILURE_METRICS, KM_PER_FAULT) else 3,
        )
        for metric in metrics
    ]


def format_change(change: Mapping[str, float]) -> str:
    """Format a mean before and after, with the share of changed episodes, or the mean alone if none changed."""
    if change["moved"] == 0.0:
        return f"{change['after']:.3f}"
    return f"{change['before']:.3f} to {change['after']:.3f} ({change['moved']:.1%})"


def fill_page(text: str, tables: Mapping[str, Sequence[str]]) -> str:
    """Return the page with the lines of each table in its place."""
    return fill_places(text, "benchmark.py", tables)


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
        fetch("benchmarks/results/benchmark", FORMER_EPISODES)
    if args.command == "drive":
        evaluate_planners(args)
        return
    if args.command == "judge":
        result = compute_results()
        # Earlier policies need observations that no longer exist, so their rows cannot be computed again.
        result["changes"] = json.loads(RESULT.read_text())["changes"] | result["changes"]
        RESULT.write_text(json.dumps(result, indent=1) + "\n")
    PAGE.write_text(fill_page(PAGE.read_text(), page_tables(json.loads(RESULT.read_text()))))


if __name__ == "__main__":
    main()
