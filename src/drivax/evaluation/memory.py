"""How much memory there is, how many scenarios are loaded at a time, and what is said when it was too little."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax

from drivax.errors import DrivaxError

#: More scenarios are never loaded at a time, however much memory there is: their bank is then some 6 GB.
MOST = 10_000
#: What a program is allowed per scenario that it drives: PDM-Closed takes 4.3 MB, IDM and policies 0.1 MB.
_PROGRAM_BYTES = 8_000_000
#: Limits of containers, and what counts against them.
_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
_USED = ("/sys/fs/cgroup/memory.current", "/sys/fs/cgroup/memory/memory.usage_in_bytes")
_STATISTICS = ("/sys/fs/cgroup/memory.stat", "/sys/fs/cgroup/memory/memory.stat")
_MACHINE = Path("/proc/meminfo")


def memory_of(device: Any, share: int = 1) -> int | None:
    """Bytes that a device has for us; of a CPU the machine's or the container's memory, divided by ``share``."""
    told = device.memory_stats() or {}
    if "bytes_limit" in told:
        return int(told["bytes_limit"])
    if device.platform != "cpu":
        return None
    limits = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"), *_numbers(_LIMITS)]
    return min(limits) // share


def free_memory(device: Any) -> int | None:
    """Bytes that a device has left; None where it does not say.

    Files that Linux keeps in memory only because there is room for them count as free.
    """
    told = device.memory_stats() or {}
    if "bytes_limit" in told:
        return int(told["bytes_limit"]) - int(told.get("bytes_in_use", 0))
    if device.platform != "cpu":
        return None
    free = []
    if _MACHINE.is_file():
        free.append(1024 * _table(_MACHINE)["MemAvailable:"])
    for limit, used, statistics in zip(_LIMITS, _USED, _STATISTICS, strict=True):
        found = _numbers((limit, used))
        if len(found) == 2:
            kept = _table(Path(statistics)) if Path(statistics).is_file() else {}
            free.append(found[0] - found[1] + kept.get("active_file", 0) + kept.get("inactive_file", 0))
    return max(min(free), 0) if free else memory_of(device)


def scenarios_at_a_time(scenario_bytes: int, lanes: int, free: int | None) -> int:
    """How many scenarios are loaded at a time: what fits in half of the free memory, but as many as are driven at once.

    Args:
        scenario_bytes: What one takes; it is there twice while a bank is made.
        lanes: How many a program drives side by side.
        free: Bytes; None where nobody knows.
    """
    if free is None:
        return MOST
    room = free // 2 - lanes * _PROGRAM_BYTES
    return int(min(max(room // (2 * scenario_bytes), lanes), MOST))


@contextmanager
def telling_out_of_memory(count: int) -> Iterator[None]:
    """Turns an error of memory into one line.

    Args:
        count: How many scenarios are loaded.

    Raises:
        DrivaxError: The memory did not suffice.
    """
    try:
        yield
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise DrivaxError(
            f"out of memory with {count:,} scenarios loaded",
            cure="load fewer at a time (--batch), drive fewer (--limit), or free memory",
        ) from error


def _numbers(files: tuple[str, ...]) -> list[int]:
    """The numbers that these files hold, as far as they exist and hold one."""
    texts = [Path(file).read_text(encoding="ascii").strip() for file in files if Path(file).is_file()]
    return [int(text) for text in texts if text.isdecimal()]


def _table(file: Path) -> dict[str, int]:
    """Names and numbers of a file with both in every line."""
    rows = (line.split() for line in file.read_text(encoding="ascii").splitlines())
    return {row[0]: int(row[1]) for row in rows if len(row) > 1 and row[1].isdecimal()}
