"""Time the built-in world against another version of it, by turns, and check that both generate the same scenarios.

    python -m experiments.speed.generation --against TREE [--write]

TREE is a checkout of the other version (``git worktree add TREE COMMIT``). One process of each version generates the
same scenarios with the settings of workers, first one, then the other, in CPU time; then ``drivax generate`` runs with
each, start-up included, in wall time: with an empty compilation cache, and again. ``--write`` stores
experiments/results/generation.json.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path
from typing import Any

from drivax.synthetic.generate import portable_workers
from experiments.repository import RESULTS, ROOT

RESULT = RESULTS / "generation.json"
SEED, BATCH, CLI_SCENARIOS = 5, 4, 64
#: Reads first and last index from each line, prints CPU seconds and a digest of the records.
WORKER = f"""
import hashlib, sys, time
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import CAPACITIES
from drivax.synthetic.world import WorldConfig, generate_one
def scenario(index):
    return assemble(generate_one({SEED}, index, WorldConfig()).recording, CAPACITIES["default"])
scenario(10_000)
for line in sys.stdin:
    begin = time.process_time()
    records = [scenario(index).record.tobytes() for index in range(*map(int, line.split()))]
    print(time.process_time() - begin, hashlib.sha256(b"".join(records)).hexdigest(), flush=True)
"""


def environment(tree: Path) -> dict[str, str]:
    """Environment of a process that uses a version."""
    return {**os.environ, "PYTHONPATH": str(tree / "src"), "OPENBLAS_NUM_THREADS": "1"}


class Version:
    """A process that generates scenarios with one version."""

    def __init__(self, tree: Path) -> None:
        with portable_workers():
            command = [sys.executable, "-c", WORKER]
            self._process = subprocess.Popen(
                command, env=environment(tree), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )

    def generate(self, first: int) -> tuple[float, str]:
        """Generate a batch and return CPU seconds and the digest of its records."""
        source, target = self._process.stdout, self._process.stdin
        assert source is not None and target is not None
        print(first, first + BATCH, file=target, flush=True)
        seconds, digest = source.readline().split()
        return float(seconds), digest


def cpu_seconds(trees: tuple[Path, Path], scenarios: int) -> list[tuple[float, float]]:
    """CPU seconds of both versions per batch, measured by turns.

    Raises:
        SystemExit: The versions generate different scenarios.
    """
    versions, result = [Version(tree) for tree in trees], []
    for turn, first in enumerate(range(0, scenarios, BATCH)):
        order = (0, 1) if turn % 2 == 0 else (1, 0)
        batch = {k: versions[k].generate(first) for k in order}
        if batch[0][1] != batch[1][1]:
            raise SystemExit(f"scenarios {first} to {first + BATCH - 1} of seed {SEED} differ")
        result.append((batch[0][0], batch[1][0]))
    return result


def command_seconds(tree: Path, folder: str) -> float:
    """Wall seconds of ``drivax generate`` with the compilation cache of a folder."""
    variables = environment(tree) | {
        "JAX_COMPILATION_CACHE_DIR": f"{folder}/cache",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    words = [
        "generate",
        f"{folder}/set",
        "--scenarios",
        str(CLI_SCENARIOS),
        "--seed",
        str(SEED),
        "--overwrite",
    ]
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-m", "drivax", *words], env=variables, check=True, capture_output=True)
    return time.perf_counter() - begin


def measure(other: Path, scenarios: int) -> dict[str, Any]:
    """Return CPU milliseconds per scenario, their ratio, and wall seconds of the command, of both versions."""
    trees = (other, ROOT)
    pairs = cpu_seconds(trees, scenarios)
    before, after = (1e3 * sum(side) / (BATCH * len(pairs)) for side in zip(*pairs, strict=True))
    with tempfile.TemporaryDirectory() as before_folder, tempfile.TemporaryDirectory() as after_folder:
        folders = (before_folder, after_folder)
        # By turns: an empty cache in the first round, a full one in the second.
        rounds = [
            [round(command_seconds(*pair), 1) for pair in zip(trees, folders, strict=True)] for _ in range(2)
        ]
    return {
        "scenarios": BATCH * len(pairs),
        "cpu_ms_per_scenario": {"before": round(before, 1), "after": round(after, 1)},
        "ratio_of_sums": round(before / after, 3),
        "median_ratio": round(statistics.median(a / b for a, b in pairs), 3),
        "command_scenarios": CLI_SCENARIOS,
        "command_first_s": dict(zip(("before", "after"), rounds[0], strict=True)),
        "command_again_s": dict(zip(("before", "after"), rounds[1], strict=True)),
        "versions": {name: metadata.version(name) for name in ("drivax", "numpy", "jax")}
        | {"python": platform.python_version(), "cores": len(os.sched_getaffinity(0))},
    }


def main() -> None:
    """Measure, print, and with ``--write`` store the JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", type=Path, required=True)
    parser.add_argument("--scenarios", type=int, default=24)
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    text = json.dumps(measure(args.against.resolve(), args.scenarios), indent=1) + "\n"
    print(text, end="")
    if args.write:
        RESULT.write_text(text)


if __name__ == "__main__":
    main()
