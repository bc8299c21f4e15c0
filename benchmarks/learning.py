"""What our presets reach on the built-in world's benchmark: trained with several seeds, judged on the test split.

python benchmarks/learning.py train PRESET --data BENCHMARK --runs RUNS [--seeds 3] [--section.key value ...]
python benchmarks/learning.py judge --data BENCHMARK --runs RUNS [--write]
python benchmarks/learning.py table     (the stored results into the pages, and docs/algorithms/curve-PRESET.png)

BENCHMARK is what `drivax generate BENCHMARK --benchmark` made; RUNS holds a run folder per preset. Checkpoints are
chosen on the split `validation`, and everything is judged once on `test`. Intervals of means over seeds and differences
resample seeds and segments of the world, both with replacement.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from drivax import settings
from drivax.evaluation.audit import scenario_names
from drivax.evaluation.results import Results
from drivax.evaluation.runner import evaluate
from drivax.evaluation.statistics import crossed_bootstrap
from drivax.learning.config import TrainConfig
from drivax.learning.loop import train
from drivax.learning.policies import load_policy
from drivax.planners.catalogue import make_planner
from drivax.scenario.bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.show.runs import read_runs
from drivax.tracking.runs import RunFolder, seed_folders, versions
from learning_tables import COLUMNS, CURVES, drawn, filled, pages, picture

RESULT = Path(__file__).resolve().parent / "results" / "learning.json"
SPEEDS = RESULT.with_name("training.json")
REFERENCES = ("expert", "idm", "constant_velocity")


def trained(args: argparse.Namespace, overrides: list[str]) -> None:
    """Trains one preset, each seed by itself on one core, as many side by side as there are cores.

    The longest time that one of them took is kept beside the runs.
    """
    config = settings.load(TrainConfig, args.preset, overrides)
    out = args.runs / args.preset.replace("/", "-")
    data, validation = (ScenarioSet.open(args.data / split) for split in ("train", "validation"))
    notes: dict[str, Any] = {"kind": "seeds", "seeds": args.seeds, "validation": validation.hash}
    RunFolder.create(out, config, [data], overwrite=True, **notes)
    processes, cores = multiprocessing.get_context("spawn"), sorted(os.sched_getaffinity(0))
    free = processes.SimpleQueue()
    for core in cores:
        free.put(core)
    with ProcessPoolExecutor(len(cores), processes, initializer=_on_one_core, initargs=(free,)) as pool:
        agents = [replace(config, seed=config.seed + number) for number in range(args.seeds)]
        took = list(pool.map(partial(_trained_alone, args.data, out), agents))
    (out / "training_seconds.json").write_text(json.dumps({"seconds": max(took), "seeds": args.seeds}) + "\n")


def _on_one_core(free: Any) -> None:
    # Before JAX starts, which makes as many threads as there are cores.
    os.sched_setaffinity(0, {free.get()})


def _trained_alone(data: Path, out: Path, config: TrainConfig) -> int:
    """Seconds that one agent took."""
    began = time.perf_counter()
    splits = {split: ScenarioSet.open(data / split) for split in ("train", "validation")}
    train(config, splits["train"], out / f"seed-{config.seed}", validation=splits["validation"], say=print)
    return round(time.perf_counter() - began)


def judged(args: argparse.Namespace) -> dict[str, Any]:
    """Every run and the references on the test split, and differences in pairs."""
    stored = ScenarioSet.open(args.data / "test")
    scenarios = list(stored)
    bank, names = ScenarioBank.from_scenarios(scenarios), scenario_names(scenarios)
    segments = np.array([row["segment"] for row in names])
    driven = {name: [evaluate(make_planner(name), bank, names)] for name in REFERENCES}
    about: dict[str, Any] = {}
    curves: dict[str, Any] = {}
    for run in sorted(path for path in args.runs.iterdir() if (path / "training_seconds.json").is_file()):
        folders = seed_folders(run) if RunFolder.open(run).info.get("kind") == "seeds" else [run]
        driven[run.name] = []
        for folder in folders:
            planner, task = load_policy(folder, bank)
            driven[run.name].append(evaluate(planner, bank, names, task=task))
        about[run.name] = json.loads((run / "training_seconds.json").read_text())
        curves[run.name] = learning_curves(run)
    planners = {
        name: {metric: _mean(results, metric, segments) for metric in COLUMNS}
        for name, results in driven.items()
    }
    differences = {
        f"{name} - {other}": {
            metric: _difference(driven[name], driven[other], metric, segments) for metric in CURVES
        }
        for name in about
        for other in ("idm", "bc")
        if other in driven and other != name
    }
    return {
        "command": "python benchmarks/learning.py judge --data BENCHMARK --runs RUNS --write",
        "when": datetime.now(UTC).isoformat(timespec="minutes"),
        "test": {"scenarios": len(scenarios), "hash": stored.hash},
        "training": about,
        "planners": planners,
        "differences": differences,
        "curves": curves,
        "versions": versions(),
    }


def learning_curves(run: Path) -> dict[str, dict[str, list[list[float]]]]:
    """Quantity -> seed -> points (step, value), of every validation of a run or of the agents in it."""
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


def tabled() -> None:
    """Puts what is stored into the pages, and draws its learning curves."""
    learning, training = (json.loads(path.read_text()) for path in (RESULT, SPEEDS))
    for name, curves in learning.get("curves", {}).items():
        drawn(name, curves).savefig(picture(name))
    for page in pages():
        page.write_text(filled(page, learning, training))


def _values(results: list[Results], metric: str) -> np.ndarray[Any, Any]:
    return np.stack([result.metrics[metric] for result in results])


def _mean(results: list[Results], metric: str, segments: np.ndarray[Any, Any]) -> dict[str, Any]:
    values = _values(results, metric)
    each = [round(float(np.nanmean(row)), 4) for row in values]
    return crossed_bootstrap(values, segments, seed=0).as_dict() | {"by_seed": each}


def _difference(
    one: list[Results], other: list[Results], metric: str, segments: np.ndarray[Any, Any]
) -> dict[str, Any]:
    """Each seed of one against the mean over the seeds of the other, scenario by scenario."""
    reference = np.nanmean(_values(other, metric), axis=0)
    return crossed_bootstrap(_values(one, metric) - reference, segments, seed=0).as_dict()


def main() -> None:
    """Trains, judges, or shows what is stored."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    training = commands.add_parser("train")
    training.add_argument("preset")
    training.add_argument("--seeds", type=int, default=3)
    judging = commands.add_parser("judge")
    judging.add_argument("--write", action="store_true", help="store the result")
    commands.add_parser("table")
    for command in (training, judging):
        command.add_argument("--data", type=Path, required=True)
        command.add_argument("--runs", type=Path, required=True)
    args, overrides = parser.parse_known_args()
    if args.command == "train":
        trained(args, overrides)
        return
    if args.command == "table":
        tabled()
        return
    result = judged(args)
    print(json.dumps({"planners": result["planners"], "differences": result["differences"]}, indent=1))
    if args.write:
        RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
