"""Train the presets with several seeds and evaluate them on the built-in world's benchmark.

python -m experiments.learning.presets train PRESET --data BENCHMARK --runs RUNS [--seeds 3] [--first 0]
    [--key value ...]
python -m experiments.learning.benchmark drive --data BENCHMARK --planner PRESET --traffic log
python -m experiments.learning.presets judge     (means with intervals of the evaluations)
python -m experiments.learning.presets table     (the stored results into the pages, and the curves of docs/algorithms)

BENCHMARK is the output of `drivax generate BENCHMARK --benchmark`; RUNS holds a run folder per preset. Checkpoints are
selected on the split `validation` and evaluated once on `test`. Intervals of means over seeds and differences
resample seeds and segments of the world, both with replacement.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from drivax import settings
from drivax.learning.config import TrainConfig
from drivax.learning.loop import train
from drivax.learning.policies import export_policy
from drivax.report.runs import read_runs
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.tracking.run_folder import RunFolder, seed_folders, versions
from drivax.tracking.workers import one_core_each
from experiments.learning.benchmark import (
    EPISODES,
    POLICIES,
    Episodes,
    learned_planners,
    mean_interval,
    read_episodes,
)
from experiments.learning.tables import COLUMNS, CURVES, curve_file, draw_curves, fill_page, pages
from experiments.repository import RESULTS, fetch, save_picture

RESULT = RESULTS / "learning.json"
SPEEDS = RESULT.with_name("training.json")
#: File with training time and curves, next to the policies; processor time in ``run.json`` of a policy, s.
TRAINING, CORE_SECONDS = "training.json", "training_core_s"
REFERENCES = ("expert", "idm", "constant_speed", "constant_velocity")


def train_preset(args: argparse.Namespace, overrides: list[str]) -> None:
    """Train the seeds of one preset in parallel, each on one core.

    Store their policies in experiments/state/policies, each with the processor time that it took, and next to them the
    longest of these times and the curves. With --first, add them to the policies of earlier seeds.
    """
    config = settings.load(TrainConfig, args.preset, overrides)
    name = args.preset.replace("/", "-")
    out, policies = args.runs / name, POLICIES / name
    data, validation = (ScenarioSet.open(args.data / split) for split in ("train", "validation"))
    notes: dict[str, Any] = {"kind": "seeds", "seeds": args.seeds, "validation": validation.hash}
    RunFolder.create(out, config, [data], overwrite=True, **notes)
    seeds = range(config.seed + args.first, config.seed + args.first + args.seeds)
    agents = [replace(config, seed=seed) for seed in seeds]
    trained = one_core_each(partial(_train_seed, args.data, out), agents)
    seconds = {agent.seed: duration for agent, duration in trained}
    record: dict[str, Any] = {"seconds": max(seconds.values()), "curves": learning_curves(out)}
    if args.first:
        earlier = json.loads((policies / TRAINING).read_text())
        record["seconds"] = max(record["seconds"], earlier["seconds"])
        record["curves"] = {
            metric: earlier["curves"][metric] | lines for metric, lines in record["curves"].items()
        }
    else:
        shutil.rmtree(policies, ignore_errors=True)
    bank = ScenarioBank.from_scenarios([data[0]])
    for agent, folder in zip(agents, seed_folders(out), strict=True):
        notes = {CORE_SECONDS: seconds[agent.seed]}
        export_policy(folder, policies / folder.name, bank, notes, overwrite=True)
    (policies / TRAINING).write_text(
        json.dumps(record | {"seeds": len(learned_planners()[name])}, indent=1) + "\n"
    )


def _train_seed(data: Path, out: Path, config: TrainConfig) -> int:
    """Train one seed, and return the seconds of processor time that it took: other work on the core does not count."""
    start = time.process_time()
    splits = {split: ScenarioSet.open(data / split) for split in ("train", "validation")}
    train(config, splits["train"], out / f"seed-{config.seed}", validation=splits["validation"], log=print)
    return round(time.process_time() - start)


def compute_results() -> dict[str, Any]:
    """Compute results and paired differences of all evaluated presets and the references."""
    candidates = {name: read_episodes(name, "log") for name in (*REFERENCES, *learned_planners())}
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
    trainings = {
        name: json.loads((POLICIES / name / TRAINING).read_text())
        for name in learned_planners()
        if name in episodes
    }
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
        "curves": {name: training["curves"] for name, training in trainings.items()},
        "versions": versions(),
    }


def _mean(results: Episodes, metric: str) -> dict[str, Any]:
    seed_means = [round(float(np.nanmean(row)), 4) for row in results.values[metric]]
    return mean_interval(results, metric).as_dict() | {"by_seed": seed_means}


def learning_curves(run: Path) -> dict[str, dict[str, list[list[float]]]]:
    """Return quantity -> seed -> points (step, value) of all validations of a run and its seeds."""
    _, agents = read_runs([run])
    return {
        metric: {
            agent.name: [
                [int(step), round(float(value), 4)] for step, value in agent.curves[f"validation/{metric}"]
            ]
            for agent in agents
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
    """Train, compare, or write the stored results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    training = commands.add_parser("train")
    training.add_argument("preset")
    training.add_argument("--seeds", type=int, default=3)
    training.add_argument("--first", type=int, default=0, help="how many seeds were trained before")
    training.add_argument("--data", type=Path, required=True)
    training.add_argument("--runs", type=Path, required=True)
    commands.add_parser("judge")
    commands.add_parser("table")
    args, overrides = parser.parse_known_args()
    if args.command == "judge":
        fetch("benchmarks/policies", POLICIES)
        fetch("benchmarks/results/benchmark", EPISODES)
    if args.command == "train":
        train_preset(args, overrides)
    elif args.command == "judge":
        RESULT.write_text(json.dumps(compute_results(), indent=1) + "\n")
    else:
        write_tables()


if __name__ == "__main__":
    main()
