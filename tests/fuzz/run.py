"""Reads and assembles damaged files of one format, under a limit of memory and of time per file.

    python -m fuzz.run FORMAT --files 200 --seed 0       (from the folder tests)

Prints how the files ended. Exit status 1 when one of them ended in anything but a clear error or a sound scenario.
"""

from __future__ import annotations

import argparse
import importlib
import json
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from drivax.datasets.conversion import Conversion, convert_file
from drivax.datasets.formats import find_reader
from drivax.datasets.reader import BadRecord
from drivax.scenario.schema import CAPACITIES, Scenario
from fuzz import mutations
from fuzz.limits import attempt, complaint, limit_memory

#: How the files of a format can be damaged beyond their bytes, by the end of their names.
BY_SUFFIX: dict[str, Callable[[Path, random.Random], None]] = {
    ".json": mutations.json_tree,
    ".pkl": mutations.pickle_tree,
    ".db": mutations.sqlite_cells,
    ".gpkg": mutations.sqlite_cells,
    ".parquet": mutations.arrow_columns,
    ".feather": mutations.arrow_columns,
}
#: Time and memory of a file: damaged samples are small.
SECONDS_PER_FILE, MEMORY_PER_FILE = 20, 1 << 30


def damage(folder: Path, rng: random.Random) -> str:
    """Damage one file of a sample; returns what was done to which."""
    path = rng.choice(sorted(path for path in folder.rglob("*") if path.is_file()))
    meaning = BY_SUFFIX.get(path.suffix, mutations.tfrecord if "tfrecord" in path.name else mutations.raw)
    how = meaning if rng.random() < 0.7 else mutations.raw
    how(path, rng)
    return f"{how.__name__} {path.name}"


def unsound(scenario: Scenario) -> str | None:
    """What is wrong with an assembled scenario, by rules of its own: finite, masked, ego there, indices in range."""
    record, capacity = scenario.record, scenario.capacity
    for name in record.dtype.names or ():
        if record[name].dtype.kind == "f" and not np.isfinite(record[name]).all():
            return f"{name} is not finite"
    now, valid = int(record["current_step"]), record["agent_valid"]
    if not valid[now, 0]:
        return "the ego is not valid at the current step"
    for name in ("agent_xy", "agent_velocity", "agent_heading"):
        if record[name][~valid].any():
            return f"{name} is not zero where it is not valid"
    if not (np.abs(record["agent_heading"]) <= np.float32(np.pi)).all():
        return "a heading is not wrapped"
    if valid.any() and (record["agent_size"][valid.any(axis=0)] <= 0).any():
        return "an agent has no size"
    for name, most in (
        ("segment_lane", capacity.lanes),
        ("route_lane", capacity.lanes),
        ("lane_successor", capacity.lanes),
    ):
        if not ((record[name] >= -1) & (record[name] < most)).all():
            return f"{name} is out of range"
    return None


def outcome(path: Path, format_name: str) -> tuple[str, str | None]:
    """How reading and assembling one file ends: its kind, and what is wrong with that."""

    def read() -> tuple[str, str | None]:
        kinds = []
        for item in convert_file(path, Conversion(format=format_name)):
            if isinstance(item, BadRecord):
                if problem := complaint(item.error()):
                    return "bad error", problem
                if "assembling failed" in str(item.error()):
                    return "bad error", str(item.error())
                kinds.append("bad record")
            elif (wrong := unsound(item)) is not None:
                return "unsound scenario", wrong
            else:
                kinds.append("scenario")
        return ("scenario" if "scenario" in kinds else kinds[0] if kinds else "nothing"), None

    return attempt(read, "error", SECONDS_PER_FILE, MEMORY_PER_FILE)


def _sample(write: Callable[[Path], Path], scratch: Path) -> tuple[Path, Path]:
    """A folder with a sample, and the place of its file therein."""
    folder = Path(tempfile.mkdtemp(dir=scratch))
    return folder, write(folder).relative_to(folder)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the files of one format."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("format")
    parser.add_argument("--files", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="run this file of the series only, with its traceback")
    args = parser.parse_args(argv)
    find_reader(args.format)
    sample = importlib.import_module(f"datasets.samples.{args.format.replace('-', '_')}")
    ends: Counter[str] = Counter()
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as scratch:
        samples = [_sample(write, Path(scratch)) for write in (sample.write, *getattr(sample, "FORMS", ()))]
        for whole, path in samples:  # imports what it needs before memory is limited
            kind, problem = outcome(whole / path, args.format)
            if kind != "scenario" or problem:
                print(f"the sample itself: {kind} {problem}")
                return 1
        limit_memory(MEMORY_PER_FILE)
        for number in range(args.files) if args.only is None else (args.only,):
            rng = random.Random(f"{args.seed} {number}")
            folder = Path(scratch) / "damaged"
            whole, path = samples[number % len(samples)]
            shutil.copytree(whole, folder)
            done = damage(folder, rng)
            begin = time.monotonic()
            kind, problem = outcome(folder / path, args.format)
            ends[kind] += 1
            if problem is not None:
                wrong.append(f"file {number} ({done}, {time.monotonic() - begin:.1f} s): {kind}: {problem}")
            shutil.rmtree(folder)
    print(json.dumps({"format": args.format, "capacity": CAPACITIES["default"].name, "ends": ends}))
    for line in wrong[:20]:
        print(line)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
