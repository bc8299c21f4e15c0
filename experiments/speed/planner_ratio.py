"""Time a planner's evaluation against an earlier state of the source, by turns, in CPU seconds.

Each turn is a process of its own: the first batch compiles and counts as "first", the later ones as "rest".

python -m experiments.speed.planner_ratio --base OTHER/src --data SET [--planner pdm] [--limit 64] [--turns 3] [--write]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from experiments.repository import RESULTS, ROOT

RESULT = RESULTS / "planner_ratio.json"


def worker(planner: str, data: Path, limit: int, episodes: Path) -> None:
    """Evaluate once, print times as JSON, and store the metrics of all episodes."""
    import numpy as np

    from drivax.evaluation.audit import scenario_names
    from drivax.evaluation.runner import evaluate
    from drivax.planners.catalogue import make_planner
    from drivax.scenario.bank.scenario_bank import ScenarioBank
    from drivax.scenario.store import ScenarioSet
    from drivax.tasks.task import Task

    stored = ScenarioSet.open(data)
    scenarios = [stored[row] for row in range(limit)]
    bank, names, task = ScenarioBank.from_scenarios(scenarios), scenario_names(scenarios), Task()
    cpu, wall = [time.process_time()], [time.perf_counter()]

    def progress(done: int, total: int) -> None:
        cpu.append(time.process_time())
        wall.append(time.perf_counter())

    table = evaluate(make_planner(planner, task.actions), bank, names, task=task, progress=progress)
    metrics: dict[str, Any] = dict(table.metrics)
    np.savez(episodes, **metrics)
    first, rest = cpu[1] - cpu[0], cpu[-1] - cpu[1]
    print(json.dumps({"first_cpu_s": first, "rest_cpu_s": rest, "rest_wall_s": wall[-1] - wall[1]}))


def differences(before: Path, after: Path) -> dict[str, float]:
    """Return the largest difference of each metric that moved; NaN equals NaN."""
    import numpy as np

    old, new = np.load(before), np.load(after)
    apart = {}
    for name in old.files:
        a, b = old[name].astype(float), new[name].astype(float)
        if not np.array_equal(a, b, equal_nan=True):
            apart[name] = float(np.nanmax(np.abs(np.nan_to_num(a) - np.nan_to_num(b))))
    return apart


def measured(base: Path, planner: str, data: Path, limit: int, turns: int, folder: Path) -> dict[str, Any]:
    """Median ratios of base to this state, over turns that alternate."""
    times: dict[str, list[dict[str, float]]] = {"base": [], "new": []}
    for turn in range(turns):
        for name, source in (("base", base), ("new", ROOT / "src")):
            environment = os.environ | {"PYTHONPATH": f"{source.resolve()}:{ROOT}"}
            environment.pop("JAX_COMPILATION_CACHE_DIR", None)
            own = [
                sys.executable,
                "-m",
                "experiments.speed.planner_ratio",
                "--worker",
                str(folder / f"{name}.npz"),
            ]
            own += ["--planner", planner, "--data", str(data), "--limit", str(limit)]
            done = subprocess.run(own, env=environment, stdout=subprocess.PIPE, check=True, text=True)
            times[name].append(json.loads(done.stdout.splitlines()[-1]))
            print(turn, name, times[name][-1], flush=True)
    pairs = list(zip(times["base"], times["new"], strict=True))
    ratio = {key: round(statistics.median(b[key] / n[key] for b, n in pairs), 2) for key in times["new"][0]}
    whole = statistics.median(
        (b["first_cpu_s"] + b["rest_cpu_s"]) / (n["first_cpu_s"] + n["rest_cpu_s"]) for b, n in pairs
    )
    apart = differences(folder / "base.npz", folder / "new.npz")
    return {
        "planner": planner,
        "scenarios": limit,
        "ratio": ratio | {"whole_cpu_s": round(whole, 2)},
        "moved": apart,
    }


def main() -> None:
    """Measure, print and store."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--base", type=Path, help="src folder of the earlier state")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--planner", default="pdm")
    parser.add_argument("--limit", type=int, default=64)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--folder", type=Path, default=Path("/tmp"), help="for the metrics of episodes")
    parser.add_argument("--write", action="store_true", help="store the result")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        worker(args.planner, args.data, args.limit, args.worker)
        return
    result = measured(args.base, args.planner, args.data, args.limit, args.turns, args.folder)
    print(json.dumps(result, indent=1))
    if args.write:
        RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
