"""Compare offline algorithms on recorded mixtures of drivers, on the built-in world's benchmark.

python -m experiments.learning.mixtures run --data BENCHMARK --runs RUNS [--minutes 50]
python -m experiments.learning.mixtures judge --runs RUNS        (means with intervals, stored)
python -m experiments.learning.mixtures table                    (write the stored results to the page)

BENCHMARK is the output of `drivax generate BENCHMARK --benchmark`. ``run`` records the mixtures on the training
scenarios, trains every algorithm with all seeds on each, and evaluates policies and drivers on the split `test`, those
of `expert` data on `test-rare`; it skips what exists, resumes a training, and starts nothing after the minutes given.
Checkpoints are not selected: the last one is evaluated. The presets' settings were chosen for TD3+BC on the split
`validation`, and hold for all algorithms; three seeds of other settings had been evaluated on `test` before
(docs/log/2026-11-28-mixtures.md).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivax.evaluation.episode_table import EpisodeTable
from drivax.files import write_json
from drivax.tracking.run_folder import RunFolder, versions
from experiments.learning.benchmark import Episodes, mean_interval
from experiments.learning.tables import interval, label, table
from experiments.repository import DOCS, RESULTS, fill_places

RESULT = RESULTS / "mixtures.json"
PAGE = DOCS / "results" / "mixtures.md"
SEEDS = 3
#: Mixtures, and the split of the benchmark on which their policies are tested: on `expert` data, at events.
MIXTURES = {"mixed": "test", "expert": "test-rare"}
#: Drivers of `mixed` other than the log.
DRIVERS = ("pdm", "idm", "constant_speed", "zoo:bc", "zoo:aggressive")
#: Algorithms, each with a preset of this name in ``configs/mixed``.
ALGORITHMS = ("bc", "filtered_bc", "td3_bc", "awac", "iql", "cql_bc")
#: On the log, every scenario has one episode, so a filter changes nothing.
ALGORITHMS_OF = {"mixed": ALGORITHMS, "expert": tuple(name for name in ALGORITHMS if name != "filtered_bc")}
#: Further settings: on `expert` data, where critics have no influence, TD3+BC updates its policy as often as cloning.
SETTINGS = {("expert", "td3_bc"): ("--algorithm.delay", "1")}
METRICS = ("success", "vmax_score", "at_fault_collision", "offroad", "progress_ratio")


def steps(data: Path, runs: Path) -> Iterator[tuple[Path, list[str]]]:
    """Yield the output and the arguments of every command, in order."""
    scenarios = data / "train"
    for driver in DRIVERS:
        out = runs / "drivers" / driver.replace(":", "-")
        yield (
            out,
            ["evaluate", "--planner", driver, "--data", str(data / MIXTURES["mixed"]), "--out", str(out)],
        )
    for mixture, split in MIXTURES.items():
        episodes = runs / "episodes" / mixture
        yield episodes, ["record", mixture, "--data", str(scenarios), "--out", str(episodes)]
        for name in ALGORITHMS_OF[mixture]:
            # One after the other, because all cores train one seed faster than several.
            for seed in range(SEEDS):
                folder = runs / mixture / name / f"seed-{seed}"
                train = ["train", f"mixed/{name}", *SETTINGS.get((mixture, name), ())]
                train += ["--data", str(scenarios), "--episodes", str(episodes)]
                yield folder, [*train, "--seed", str(seed), "--out", str(folder)]
                out = runs / "evaluated" / mixture / name / f"seed-{seed}"
                yield (
                    out,
                    ["evaluate", "--planner", str(folder), "--data", str(data / split), "--out", str(out)],
                )


def run(data: Path, runs: Path, minutes: float) -> bool:
    """Run the commands whose output is missing; return whether all are done."""
    begin = time.monotonic()
    for out, arguments in steps(data, runs):
        is_training = arguments[0] == "train"
        if out.exists() and not (is_training and not is_trained(out)):
            continue
        if time.monotonic() - begin > 60 * minutes:
            return False
        if is_training and out.exists():
            arguments = ["train", arguments[1], *arguments[arguments.index("--data") :], "--resume"]
        print(" ".join(arguments), flush=True)
        subprocess.run([sys.executable, "-m", "drivax", *arguments], check=True)
    return True


def is_trained(folder: Path) -> bool:
    """Return whether a training has ended."""
    if not (folder / "metrics.jsonl").is_file():
        return False
    run = RunFolder.open(folder)
    return run.read_metrics()[-1]["step"] >= int(run.settings["total_steps"])


def compute_results(runs: Path) -> dict[str, Any]:
    """Return means of drivers and policies, and differences of policies from both clones and the best drivers."""
    drivers = {path.name: _episodes([path]) for path in sorted((runs / "drivers").iterdir())}
    means = {
        name: {metric: mean_interval(episodes, metric).as_dict() for metric in METRICS}
        for name, episodes in drivers.items()
    }
    best = dict.fromkeys(max(means, key=lambda name: means[name][m]["mean"] or 0.0) for m in METRICS[:2])
    policies = {}
    for mixture in MIXTURES:
        folders = {
            name: sorted((runs / "evaluated" / mixture / name).glob("seed-*"))
            for name in ALGORITHMS_OF[mixture]
        }
        evaluated = {name: _episodes(seeds) for name, seeds in folders.items() if len(seeds) == SEEDS}
        for name, episodes in evaluated.items():
            infos = [RunFolder.open(runs / mixture / name / f"seed-{seed}").info for seed in range(SEEDS)]
            others = {
                key: evaluated[key] for key in ("bc", "filtered_bc") if key in evaluated and key != name
            }
            if mixture == "mixed":
                others |= {driver: drivers[driver] for driver in best}
            policies[f"{mixture}/{name}"] = {
                "means": {metric: mean_interval(episodes, metric).as_dict() for metric in METRICS},
                "critics": [info.get("critics") for info in infos],
                "differences": {
                    other: {
                        metric: mean_interval(episodes, metric, reference).as_dict() for metric in METRICS
                    }
                    for other, reference in others.items()
                },
            }
    command = "python -m experiments.learning.mixtures judge"
    return {"command": command, "drivers": means, "policies": policies, "versions": versions()}


def page_tables(results: dict[str, Any]) -> dict[str, list[str]]:
    """Return the tables of the page: drivers, and policies and their differences for each mixture."""
    heads = [f"`{metric}`" for metric in METRICS]

    def cells(means: dict[str, Any], signed: bool = False) -> list[str]:
        return [interval(means[metric], signed=signed) for metric in METRICS]

    drivers = [[label(name.replace("-", ":")), *cells(means)] for name, means in results["drivers"].items()]
    tables = {"drivers": table(["driver", *heads], drivers)}
    for mixture in MIXTURES:
        rows, differences = [], []
        for name in ALGORITHMS:
            policy = results["policies"].get(f"{mixture}/{name}")
            if policy is None:
                continue
            checked = [problems for problems in policy["critics"] if problems is not None]
            healthy = sum(not problems for problems in checked)
            rows.append(
                [label(name), *cells(policy["means"]), f"{healthy} of {len(checked)}" if checked else "-"]
            )
            differences += [
                [f"{label(name)} - {label(other.replace('-', ':'))}", *cells(values, signed=True)]
                for other, values in policy["differences"].items()
            ]
        tables[mixture] = table(["algorithm", *heads, "healthy critics"], rows)
        tables[f"{mixture} differences"] = table(["difference", *heads], differences)
    return tables


def _episodes(folders: Sequence[Path]) -> Episodes:
    """Return the episodes of a planner, with a row for each seed."""
    tables = [EpisodeTable.read(folder) for folder in folders]
    values = {metric: np.stack([table.metrics[metric] for table in tables]) for metric in METRICS}
    return Episodes(values, np.array(tables[0].clusters), {})


def main() -> None:
    """Run the commands that are missing, or compare what they wrote."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    running = commands.add_parser("run")
    running.add_argument("--data", type=Path, required=True)
    running.add_argument("--minutes", type=float, default=50.0)
    judging = commands.add_parser("judge")
    commands.add_parser("table")
    for command in (running, judging):
        command.add_argument("--runs", type=Path, required=True)
    args = parser.parse_args()
    if args.command == "judge":
        write_json(RESULT, compute_results(args.runs))
    elif args.command == "table":
        tables = page_tables(json.loads(RESULT.read_text()))
        PAGE.write_text(fill_places(PAGE.read_text(), "mixtures.py", tables))
    elif not run(args.data, args.runs, args.minutes):
        print("run again to go on")


if __name__ == "__main__":
    main()
