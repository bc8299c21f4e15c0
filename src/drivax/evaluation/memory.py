"""Choose the evaluation batch size from available memory, and report when memory runs out."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax

from drivax.errors import DrivaxError
from drivax.files import format_bytes

#: Maximum number of scenarios loaded at a time; in the built-in world they take 4 GB, in ``idm`` traffic 7 GB.
MOST = 10_000
#: Bytes reserved per scenario of a program call; PDM-Closed needs half (docs/log/2026-11-22-evaluation.md).
_PROGRAM_BYTES = 8_000_000
#: Limit and usage files of a control group (a container or a job), version 2 and version 1.
_GROUP_FILES = (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes"))
_GROUPS, _PROCESS_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
_MEMORY_INFO = Path("/proc/meminfo")


def memory_of(device: Any) -> int | None:
    """Return the memory of a device in bytes, None if unknown; for a CPU, that of the machine or container."""
    stats = device.memory_stats() or {}
    if "bytes_limit" in stats:
        return int(stats["bytes_limit"])
    if device.platform != "cpu":
        return None
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return min([total, *(limit for limit, _ in _group_limits())])


def free_memory(device: Any, share: int = 1) -> int | None:
    """Return the free bytes of a device, None if unknown; of a CPU, those of the machine or container over ``share``.

    The page cache of Linux counts as free; on other systems, all memory of a CPU counts as free.
    """
    stats = device.memory_stats() or {}
    if "bytes_limit" in stats:
        return int(stats["bytes_limit"]) - int(stats.get("bytes_in_use", 0))
    if device.platform != "cpu":
        return None
    free = []
    available_kb = _read_numbers(_MEMORY_INFO).get("MemAvailable:") if _MEMORY_INFO.is_file() else None
    if available_kb is not None:
        free.append(1024 * available_kb)
    free += [limit - usage for limit, usage in _group_limits()]
    available = max(min(free), 0) if free else memory_of(device)
    return None if available is None else available // share


def scenarios_at_a_time(scenario_bytes: int, width: int, free: int | None) -> int:
    """Return the number of scenarios to load at a time: as many as fit, with the program, in half of the free memory.

    The number is at least ``width``, the scenarios per program call, and at most :data:`MOST`, which is returned if
    ``free`` (bytes) is None. A scenario exists twice in memory while its bank is built.
    """
    if free is None:
        return MOST
    available = free // 2 - width * _PROGRAM_BYTES
    return int(min(max(available // (2 * scenario_bytes), width), MOST))


@contextmanager
def report_out_of_memory(use: str, cure: str) -> Iterator[None]:
    """Turn an out-of-memory error of Python or XLA into a :class:`DrivaxError` that names the use of memory.

    XLA states the size of the array that did not fit.
    """
    try:
        yield
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        size = re.search(r"allocat\w+ (\d+) bytes", str(error))
        array = f": no room for an array of {format_bytes(int(size[1]))}" if size else ""
        raise DrivaxError(f"out of memory {use}{array}", cure=cure) from error


def _group_limits(groups: Path = _GROUPS, process: Path = _PROCESS_GROUPS) -> list[tuple[int, int]]:
    """Return limit and usage (bytes, without the page cache) of every limited control group of this process.

    The file ``process`` lists them as ``hierarchy:controllers:path`` (cgroups(7)) below the folder ``groups``.
    """
    limits = []
    lines = process.read_text(encoding="utf-8").splitlines() if process.is_file() else []
    for _, controllers, path in (line.split(":", 2) for line in lines):
        if controllers and "memory" not in controllers.split(","):
            continue
        root = groups / "memory" if controllers else groups
        # In a container, the container's own group may be mounted as the root.
        folder = root / path.strip("/")
        for group in {folder, *folder.parents} - {*groups.parents} - ({groups} if controllers else set()):
            for limit_file, usage_file in _GROUP_FILES:
                limit, usage = (_read_number(group / file) for file in (limit_file, usage_file))
                if limit is not None and usage is not None:
                    limits.append((limit, max(usage - _page_cache(group), 0)))
    return limits


def _page_cache(group: Path) -> int:
    statistics = group / "memory.stat"
    numbers = _read_numbers(statistics) if statistics.is_file() else {}
    return numbers.get("active_file", 0) + numbers.get("inactive_file", 0)


def _read_number(file: Path) -> int | None:
    """Return the number in a file, or None if the file is unreadable or not a number ("max")."""
    try:
        text = file.read_text(encoding="ascii").strip()
    except OSError:
        return None
    return int(text) if text.isdecimal() else None


def _read_numbers(file: Path) -> dict[str, int]:
    """Return the numbers of a file by name, from lines that start with a name and its number."""
    lines = (line.split() for line in file.read_text(encoding="ascii").splitlines())
    return {words[0]: int(words[1]) for words in lines if len(words) > 1 and words[1].isdecimal()}
