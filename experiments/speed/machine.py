"""What a speed depends on besides the program: the machine, and what else runs on it."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp


def machine_ms() -> float:
    """Milliseconds of a fixed program on one core, the current speed of a shared machine.

    It reads rows at random and computes on what it read, as a step of the simulator does.
    """
    table = jnp.arange(1 << 24, dtype=jnp.float32).reshape(-1, 64)
    rows = jax.random.randint(jax.random.key(0), (1 << 16,), 0, len(table))
    program = jax.jit(lambda table, rows: jnp.sin(table[rows] * 1e-3).sum(axis=-1))
    times = []
    for _ in range(21):
        begin = time.perf_counter()
        jax.block_until_ready(program(table, rows))
        times.append(time.perf_counter() - begin)
    return round(statistics.median(times) * 1e3, 2)


def processor() -> str:
    """Name of the processor, and the number of cores that this process may use."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    name = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "unknown")
    return f"{name}, {len(os.sched_getaffinity(0))} cores"


@contextmanager
def conditions() -> Iterator[dict[str, Any]]:
    """Record the conditions of a measurement: processor, time, and machine and load just before and after it.

    Yields a dictionary that is complete when the block ends: ``processor``, ``when``, ``machine_ms`` and ``load``.
    """
    record: dict[str, Any] = {
        "processor": processor(),
        "when": datetime.now(UTC).isoformat(timespec="minutes"),
    }
    load, speed = [round(os.getloadavg()[0], 1)], [machine_ms()]
    yield record
    load.append(round(os.getloadavg()[0], 1))
    record |= {"machine_ms": [*speed, machine_ms()], "load": load}


def cells(record: dict[str, Any]) -> str:
    """Return the cells of a table row: fixed program and load, before and after; empty if they were not recorded."""
    if "load" not in record:
        return " | "
    low, high = sorted(record["machine_ms"])
    before, after = record["load"]
    return f"{low:.0f} to {high:.0f} | {before:.1f} to {after:.1f}"


#: Headings of :func:`cells`.
HEADINGS = "fixed program (ms) | load"
