"""Choose the evaluation batch size from available memory, and report when memory runs out."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax

from drivax.errors import DrivaxError

#: Maximum number of scenarios loaded at a time; their bank takes about 6 GB.
MOST = 10_000
#: Bytes that a program may need per scenario; PDM-Closed needs half (docs/log/2026-11-22-evaluation.md).
_PROGRAM_BYTES = 8_000_000
#: Files of a control group (of a container or a job): its limit, and its use.
_GROUP_FILES = (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes"))
_GROUPS, _OUR_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
_MACHINE = Path("/proc/meminfo")


def memory_of(device: Any, share: int = 1) -> int | None:
    """Return the bytes available on a device; on a CPU the memory of machine or container, over ``share``."""
    stats = device.memory_stats() or {}
    if "bytes_limit" in stats:
        return int(stats["bytes_limit"])
    if device.platform != "cpu":
        return None
    whole = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return min([whole, *(limit for limit, _ in _group_limits())]) // share


def free_memory(device: Any) -> int | None:
    """Return the free bytes of a device, None where unknown; the page cache of Linux counts as free."""
    stats = device.memory_stats() or {}
    if "bytes_limit" in stats:
        return int(stats["bytes_limit"]) - int(stats.get("bytes_in_use", 0))
    if device.platform != "cpu":
        return None
    free = []
    if _MACHINE.is_file():
        free.append(1024 * _table(_MACHINE)["MemAvailable:"])
    free += [limit - used for limit, used in _group_limits()]
    return max(min(free), 0) if free else memory_of(device)


def scenarios_at_a_time(scenario_bytes: int, lanes: int, free: int | None) -> int:
    """Return the number of scenarios that fit in half of the free memory, at least those of one program call (lanes).

    A scenario exists twice while a bank is made. Free bytes are None where unknown.
    """
    if free is None:
        return MOST
    room = free // 2 - lanes * _PROGRAM_BYTES
    return int(min(max(room // (2 * scenario_bytes), lanes), MOST))


@contextmanager
def report_out_of_memory(count: int) -> Iterator[None]:
    """Turn an out-of-memory error with ``count`` scenarios loaded into a :class:`DrivaxError`."""
    try:
        yield
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        cure = "load fewer at a time (--batch), evaluate fewer (--limit), or free memory"
        raise DrivaxError(f"out of memory with {count:,} scenarios loaded", cure=cure) from error


def _group_limits(groups: Path = _GROUPS, ours: Path = _OUR_GROUPS) -> list[tuple[int, int]]:
    """Return limit and use (bytes, without the page cache) of every control group of this process that has a limit.

    The file ``ours`` names them as ``hierarchy:controllers:path`` (cgroups(7)), ``groups`` is their folder.
    """
    limits = []
    rows = ours.read_text(encoding="utf-8").splitlines() if ours.is_file() else []
    for _, controllers, path in (row.split(":", 2) for row in rows):
        if controllers and "memory" not in controllers.split(","):
            continue
        root = groups / "memory" if controllers else groups
        # In a container our own group may be mounted as the root.
        folder = root / path.strip("/")
        for group in {folder, *folder.parents} - {*groups.parents} - ({groups} if controllers else set()):
            for limit_file, used_file in _GROUP_FILES:
                limit, used = (_number(group / file) for file in (limit_file, used_file))
                if limit is not None and used is not None:
                    statistics = group / "memory.stat"
                    kept = _table(statistics) if statistics.is_file() else {}
                    files = kept.get("active_file", 0) + kept.get("inactive_file", 0)
                    limits.append((limit, max(used - files, 0)))
    return limits


def _number(file: Path) -> int | None:
    """Return the number in a file; None where it cannot be read or holds none ("max")."""
    try:
        text = file.read_text(encoding="ascii").strip()
    except OSError:
        return None
    return int(text) if text.isdecimal() else None


def _table(file: Path) -> dict[str, int]:
    """Return names and numbers of a file with both in every line."""
    rows = (line.split() for line in file.read_text(encoding="ascii").splitlines())
    return {row[0]: int(row[1]) for row in rows if len(row) > 1 and row[1].isdecimal()}
