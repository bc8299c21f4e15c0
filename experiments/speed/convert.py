"""Time conversion (TFRecord to set, with audit) and reading (set to memory) on one core.

    python -m experiments.speed.convert --data ../shared/data [--write]

The Scenario proto of the real data is repeated under new ids. ``--write`` stores experiments/results/convert.json.
Targets per second and core: 8 scenarios converted with routes and audit; 5,000 read with checksums and 20,000 without,
from a warm page cache. The process uses one core. Rates are per second of CPU time, which on an idle machine equals
wall time (also given) and excludes the time of other processes.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from drivax.datasets.conversion import Conversion, convert, convert_file
from drivax.datasets.womd.messages import message_class
from drivax.datasets.womd.scenario_reader import WomdScenario
from drivax.datasets.womd.tfrecord import read_records, write_record
from drivax.evaluation.audit import audit
from drivax.scenario.schema import record_dtype
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from experiments.repository import RESULTS

RESULT = RESULTS / "convert.json"
PROTO = "womd/motion_data_one_scenario.tfrecord"
AIMS = {"convert_audited_per_s": 8, "read_checked_per_s": 5_000, "read_unchecked_per_s": 20_000}
BATCH = 64


def write_copies(source: Path, target: Path, copies: int) -> Path:
    """Write copies of the first record of a TFRecord file of protos under new ids, and return their file."""
    _, payload = next(read_records(source))
    message = message_class("Scenario").FromString(payload)
    with target.open("wb") as file:
        for number in range(copies):
            message.scenario_id = f"{number:016x}"
            write_record(file, message.SerializeToString())
    return target


def time_call(work: Callable[[], object]) -> tuple[float, float]:
    """Return CPU seconds and wall seconds of a call."""
    cpu_start, wall_start = time.process_time(), time.perf_counter()
    work()
    return time.process_time() - cpu_start, time.perf_counter() - wall_start


def conversion(source: Path, folder: Path, scenarios: int) -> dict[str, float]:
    """Scenarios per second that are converted to a stored and audited set, and the time of each part."""
    data = write_copies(source, folder / "data.tfrecord", scenarios)
    few = write_copies(source, folder / "few.tfrecord", 2)
    convert(few, folder / "compiled", audit=audit)  # the audit is compiled once and kept for later runs
    cpu_s, wall_s = time_call(lambda: convert(data, folder / "audited", audit=audit))
    decoding, _ = time_call(lambda: sum(1 for _ in WomdScenario().read(data)))
    assembling, _ = time_call(lambda: sum(1 for _ in convert_file(data, Conversion())))
    batch = ScenarioSet.open(folder / "audited")[:BATCH]
    auditing, _ = time_call(lambda: audit(batch))
    writing, _ = time_call(lambda: large_set(folder / "audited", folder / "written", scenarios))
    return {
        "scenarios": scenarios,
        "convert_audited_per_s": scenarios / cpu_s,
        "convert_audited_per_s_passed": scenarios / wall_s,
        "decode_ms": 1e3 * decoding / scenarios,
        "assemble_ms": 1e3 * (assembling - decoding) / scenarios,
        "audit_ms": 1e3 * auditing / len(batch),
        "write_ms": 1e3 * writing / scenarios,
        "largest_resident_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
    }


def large_set(source: Path, folder: Path, scenarios: int) -> Path:
    """Write a set of copies of one scenario under new ids."""
    (first, *_) = ScenarioSet.open(source)
    record = np.array(first.record)
    with ScenarioWriter(folder, first.capacity) as writer:
        for number in range(scenarios):
            record["scenario_id"] = f"{number:016x}".encode()
            writer.add(
                type(first)(record, first.capacity, first.source, first.overflow, first.audit, first.tags)
            )
    return folder


def reading(path: Path, repeats: int) -> dict[str, float]:
    """Scenarios per second and core from a warm page cache, in random order; the best of some freshly opened sets.

    With checksums: a first pass, in which every record is tested (later passes trust it). Without: a later pass, and
    the first one, in which the kernel maps the pages.
    """
    for shard in path.glob("*.npy"):
        shard.read_bytes()
    count = len(ScenarioSet.open(path))
    order = np.random.default_rng(0).permutation(count)
    batches = [order[at : at + BATCH] for at in range(0, count - BATCH + 1, BATCH)]
    memory = np.zeros(BATCH, record_dtype(ScenarioSet.open(path).capacity))

    def copy_records(opened: ScenarioSet) -> None:
        for batch in batches:
            opened.records(batch, out=memory)

    def view_records(opened: ScenarioSet) -> None:
        for batch in batches:
            for row in batch.tolist():
                opened[row]

    def best(read: Callable[[ScenarioSet], None], verify: bool, again: bool = False) -> float:
        seconds = []
        for _ in range(repeats):
            opened = ScenarioSet.open(path, verify=verify)
            if again:
                read(opened)
            seconds.append(time_call(partial(read, opened))[0])
        return len(batches) * BATCH / min(seconds)

    return {
        "set": count,
        "read_checked_per_s": best(copy_records, verify=True),
        "read_unchecked_first_per_s": best(copy_records, verify=False),
        "read_unchecked_per_s": best(copy_records, verify=False, again=True),
        "view_checked_per_s": best(view_records, verify=True),
        "view_unchecked_per_s": best(view_records, verify=False),
    }


def measure(data: Path, scenarios: int, stored: int, repeats: int) -> dict[str, Any]:
    """Return all measurements of the table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        converted = conversion(data / PROTO, folder, scenarios)
        read = reading(large_set(folder / "audited", folder / "large", stored), repeats)
        record_bytes = ScenarioSet.open(folder / "large").manifest["record_bytes"]
    return {
        "convert": {name: round(value, 2) for name, value in converted.items()},
        "read": {name: round(value, 1) for name, value in read.items()},
        "record_bytes": record_bytes,
        "aims": AIMS,
        "versions": {
            "drivax": metadata.version("drivax"),
            "numpy": np.__version__,
            "jax": metadata.version("jax"),
            "python": platform.python_version(),
            "machine": platform.machine(),
            "cores_used": len(os.sched_getaffinity(0)),
        },
    }


def table(result: dict[str, Any]) -> str:
    """Format the result."""
    rows = []
    for name, value in {**result["convert"], **result["read"]}.items():
        aim = result["aims"].get(name)
        reached = "" if aim is None else f"   aim {aim:,}: {'reached' if value >= aim else 'NOT reached'}"
        rows.append(f"{name:<30}{value:>12,.1f}{reached}")
    return "\n".join(rows)


def main() -> None:
    """Measure, print, and with ``--write`` store the JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--scenarios", type=int, default=256)
    parser.add_argument("--stored", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    # Before anything starts threads.
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    result = measure(args.data, args.scenarios, args.stored, args.repeats)
    print(table(result))
    if args.write:
        partial = RESULT.with_name(f".{RESULT.name}.partial")
        partial.write_text(json.dumps(result, indent=1) + "\n")
        partial.replace(RESULT)


if __name__ == "__main__":
    main()
