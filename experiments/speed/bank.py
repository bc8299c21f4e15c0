"""Time reading a scenario set and building its bank, here and in another source tree.

    python -m experiments.speed.bank --data SET [--against TREE] [--repeats 5]     SET: at least 1,024 scenarios

Each measurement is a process of its own, as a command is: it opens the set, reads all scenarios with their checksums
and builds the bank. The trees take turns; ratios are medians of the ratios of neighbouring processes. Files are in the
page cache. Nothing else may run on the machine.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

_TREE = Path(__file__).resolve().parents[2]
#: The program of a process, which any tree can run: seconds of each part, and the largest resident memory.
_PROGRAM = """
import json, resource, sys, time
import jax
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet

jax.device_put(0).block_until_ready()
clock, seconds = (time.perf_counter, time.process_time), {}

def lap(name, start):
    seconds[name], seconds[name + "_cpu"] = (now() - then for now, then in zip(clock, start))
    return [now() for now in clock]

start = [now() for now in clock]
data = ScenarioSet.open(sys.argv[1])
start = lap("open", start)
scenarios = list(data)
start = lap("read", start)
bank = jax.block_until_ready(ScenarioBank.from_scenarios(scenarios))
lap("build", start)
resident_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
print(json.dumps({"scenarios": len(bank), **seconds, "resident_mb": resident_mb, "bank_mb": bank.nbytes / 1e6}))
"""


def measure(tree: Path, data: Path) -> dict[str, float]:
    """Return scenarios per second (wall, and of CPU time) and memory of a process of a tree."""
    environment = {**os.environ, "PYTHONPATH": str(tree / "src"), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", _PROGRAM, str(data)]
    process = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    result = json.loads(process.stdout)
    count = result["scenarios"]
    for clock in ("", "_cpu"):
        read, build = result["read" + clock], result["build" + clock]
        result |= {"read_per_s" + clock: count / read, "build_per_s" + clock: count / build}
        result |= {"both_per_s" + clock: count / (read + build)}
    return result


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--against", type=Path, help="root of another source tree")
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    for shard in args.data.glob("*.npy"):
        shard.read_bytes()
    trees = [tree for tree in (args.against, _TREE) if tree is not None]
    rounds = [[measure(tree, args.data) for tree in trees] for _ in range(args.repeats)]
    print(f"{rounds[0][0]['scenarios']} scenarios, {args.repeats} processes per tree, medians")
    for name in rounds[0][0]:
        if name.endswith(("_per_s", "_per_s_cpu", "_mb")):
            row = [
                statistics.median(results)
                for results in zip(*([r[name] for r in each] for each in rounds), strict=True)
            ]
            if args.against:
                row.append(statistics.median(each[-1][name] / each[0][name] for each in rounds))
            print(f"{name:<18}" + "".join(f"{value:>12,.2f}" for value in row))


if __name__ == "__main__":
    main()
