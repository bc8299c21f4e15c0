"""Compare the presets, each trained with several seeds, on the built-in world's benchmark.

drivax train PRESET --seed N --data BENCHMARK/train --validation BENCHMARK/validation --out RUNS/PRESET/seed-N
python -m experiments.learning.presets collect RUNS/PRESET --data BENCHMARK
                                                 (the best checkpoints and curves of the seeds)
python -m experiments.learning.benchmark drive --data BENCHMARK --planner PRESET --traffic log
python -m experiments.learning.presets judge     (means with intervals of the evaluations)
python -m experiments.learning.presets table     (the stored results into the pages, and the curves of docs/algorithms)

BENCHMARK is the output of `drivax generate BENCHMARK --benchmark`. Checkpoints are selected on the split `validation`
and evaluated once on `test`. Intervals cover other seeds and other segments of the world (`stats.seeds`).
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivax.learning import TrainConfig
from drivax.learning.policies import export_policy
from drivax.report.runs import TrainingCurves, read_runs
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.tracking.run_folder import RunFolder, versions
from experiments.learning.benchmark import (
    COMPARISONS,
    POLICIES,
    Episodes,
    mean_interval,
    preset_planners,
    read_episodes,
)
from experiments.learning.tables import (
    COLUMNS,
    COMPARED,
    CURVES,
    curve_file,
    draw_curves,
    fill_page,
    pages,
)
from experiments.repository import RESULTS, save_picture

RESULT = RESULTS / "learning.json"
SPEEDS = RESULT.with_name("training.json")
#: File with training time and curves, next to the policies; training time in ``run.json`` of a policy, s.
TRAINING, CORE_SECONDS = "training.json", "training_core_s"
#: ``config.yaml`` of a policy holds its seed and all settings.
COMMAND = "drivax train config.yaml --data {0}/train --validation {0}/validation --out RUN"
#: Name of the output of `drivax generate NAME --benchmark`, for `egos: moving` with `--egos 8`.
DATA = {"recorded": "BENCHMARK", "moving": "BENCHMARK_EGOS_8"}
REFERENCES = ("expert", "idm", "constant_speed", "constant_velocity")


def collect(run: Path, data: ScenarioSet) -> None:
    """Store the policies of all seeds of a preset in experiments/state/policies, and next to them times and curves."""
    policies = POLICIES / run.name
    _, trainings = read_runs(sorted(run.glob("seed-*")))
    seconds = [training_seconds(training) for training in trainings]
    shutil.rmtree(policies, ignore_errors=True)
    bank = ScenarioBank.from_scenarios([data[0]])
    for training, duration in zip(trainings, seconds, strict=True):
        config = RunFolder.open(training.folder).config(TrainConfig)
        notes = {CORE_SECONDS: duration, "command": COMMAND.format(DATA[config.egos])}
        export_policy(training.folder, policies / training.folder.name, bank, notes, overwrite=True)
    record = {"seconds": max(seconds), "seeds": len(trainings), "curves": learning_curves(trainings)}
    (policies / TRAINING).write_text(json.dumps(record, indent=1) + "\n")


def training_seconds(training: TrainingCurves) -> int:
    """Return the seconds that a training takes at its median speed, without compilation and validation.

    Pauses, resumption and other work on the machine for less than half of the time do not count.
    """
    rates = training.curves["steps_per_second"]
    return round(float(rates[-1, 0] / np.median(rates[:, 1])))


def compute_results() -> dict[str, Any]:
    """Compute results and paired differences of all evaluated presets and the references."""
    candidates = {name: read_episodes(name, "log") for name in (*REFERENCES, *preset_planners())}
    episodes = {
        name: planner_episodes
        for name, planner_episodes in candidates.items()
        if planner_episodes is not None
    }
    tests = {planner_episodes.about["test"] for planner_episodes in episodes.values()}
    if len(tests) != 1:
        raise SystemExit(
            f"{len(tests)} test sets instead of one: evaluate the others again (benchmark.py drive)"
        )
    trainings = {name: read_training(name) for name in preset_planners() if name in episodes}
    return {
        "command": "python -m experiments.learning.presets judge",
        "test": {"scenarios": len(next(iter(episodes.values())).segments), "hash": tests.pop()},
        "training": {
            name: {key: training[key] for key in ("seconds", "seeds")} for name, training in trainings.items()
        },
        "planners": {
            name: {metric: _mean(planner_episodes, metric) for metric in COLUMNS}
            for name, planner_episodes in episodes.items()
        },
        "differences": {
            f"{name} - {other}": {
                metric: mean_interval(episodes[name], metric, episodes[other]).as_dict() for metric in CURVES
            }
            for name in trainings
            for other in ("idm", "bc")
            if other in episodes and other != name
        },
        "comparisons": {table: compare_trainings(names) for table, names in COMPARISONS.items()},
        "curves": {name: training["curves"] for name, training in trainings.items()},
        "versions": versions(),
    }


def read_training(name: str) -> dict[str, Any]:
    """Return times and curves of a training, which :func:`collect` stored."""
    return json.loads((POLICIES / name / TRAINING).read_text())


def compare_trainings(names: Sequence[str]) -> dict[str, Any]:
    """Return costs and results of trainings, and their paired differences from the first."""
    evaluated = {name: episodes for name in names if (episodes := read_episodes(name, "log")) is not None}
    if len({episodes.about["test"] for episodes in evaluated.values()}) > 1:
        raise SystemExit(f"{', '.join(evaluated)}: several test sets: evaluate all on one")
    trainings = {}
    for name, episodes in evaluated.items():
        training, reference = read_training(name), evaluated[names[0]]
        trainings[name] = {
            "seeds": training["seeds"],
            "seconds": training["seconds"],
            "results": {metric: mean_interval(episodes, metric).as_dict() for metric in COMPARED},
            "differences": {
                metric: mean_interval(episodes, metric, reference).as_dict() for metric in COMPARED
            }
            if name != names[0]
            else {},
        }
    return trainings


def _mean(results: Episodes, metric: str) -> dict[str, Any]:
    seed_means = [round(float(np.nanmean(row)), 4) for row in results.values[metric]]
    return mean_interval(results, metric).as_dict() | {"by_seed": seed_means}


def learning_curves(trainings: Sequence[TrainingCurves]) -> dict[str, dict[str, list[list[float]]]]:
    """Return quantity -> seed -> points (step, value) of all validations."""
    return {
        metric: {
            training.folder.name: [
                [int(step), round(float(value), 4)] for step, value in training.curves[f"validation/{metric}"]
            ]
            for training in trainings
        }
        for metric in CURVES
    }


def write_tables() -> None:
    """Write the stored results to the pages, and draw the learning curves."""
    learning, training = (json.loads(path.read_text()) for path in (RESULT, SPEEDS))
    for name, curves in learning.get("curves", {}).items():
        seconds = learning["training"][name]["seconds"]
        save_picture(draw_curves(name, curves, seconds), curve_file(name))
    for page in pages():
        page.write_text(fill_page(page, learning, training))


def main() -> None:
    """Collect policies, compare them, or write the stored results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    collection = commands.add_parser("collect")
    collection.add_argument("run", type=Path)
    collection.add_argument("--data", type=Path, required=True)
    commands.add_parser("judge")
    commands.add_parser("table")
    args = parser.parse_args()
    if args.command == "collect":
        collect(args.run, ScenarioSet.open(args.data / "train"))
    elif args.command == "judge":
        RESULT.write_text(json.dumps(compute_results(), indent=1) + "\n")
    else:
        write_tables()


if __name__ == "__main__":
    main()
