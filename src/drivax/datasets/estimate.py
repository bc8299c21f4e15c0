"""How large a scenario set will be, before it is made."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drivax.datasets.formats import Input, Survey, reader_named
from drivax.datasets.reader import Reader
from drivax.errors import DataError, UsageError
from drivax.scenario.recording import STRIDE
from drivax.scenario.schema import STEPS, Capacity, record_dtype

#: Files of a format that are counted; where there are more, the sample is scaled by file size.
_SAMPLE = 48


@dataclass(frozen=True)
class Estimate:
    """What a conversion will need.

    Attributes:
        scenarios: About how many scenarios there will be.
        size_bytes: What they take on the disk.
        free_bytes: What the disk has left.
        sampled: Whether only some of the files were counted.
    """

    scenarios: int
    size_bytes: int
    free_bytes: int
    sampled: bool = False

    def __str__(self) -> str:
        size, free = gigabytes(self.size_bytes), gigabytes(self.free_bytes)
        return f"about {counted(self.scenarios, 'scenario')}, {size}; {free} free"

    def check(self, out: Path, written: int = 0) -> None:
        """Refuse to begin what will not fit.

        Args:
            out: The set.
            written: How many of the scenarios are on the disk already.
        """
        needed = self.size_bytes * max(self.scenarios - written, 0) // max(self.scenarios, 1)
        if needed > self.free_bytes:
            raise DataError(
                f"the disk has {gigabytes(self.free_bytes)} left, the set needs about {gigabytes(needed)}",
                file=out,
                cure="make room, choose another disk, or use --limit",
            )


def estimate(data: Survey, out: Path, capacity: Capacity, stride: int, limit: int | None) -> Estimate:
    """Estimates a conversion by counting, in a sample of the files where there are many.

    Args:
        data: What is converted.
        out: Where the set will lie; the folder need not exist.
        capacity: Padded sizes.
        stride: Steps between the starts of two windows.
        limit: The most scenarios; None: all.
    """
    total, sampled = 0.0, False
    for name in data.formats:
        paths = [entry.path for entry in data.inputs if entry.format == name]
        step = -(-len(paths) // _SAMPLE)
        counted = paths[::step]
        sampled |= step > 1
        scale = _size(paths) / max(_size(counted), 1) if step > 1 else 1.0
        total += scale * sum(count(reader_named(name), path, stride) for path in counted)
    scenarios = round(total) if limit is None else min(round(total), limit)
    return Estimate(scenarios, scenarios * record_dtype(capacity).itemsize, free_bytes(out), sampled)


def count(reader: Reader, path: Path, stride: int = STRIDE) -> int:
    """About how many scenarios a file becomes; 0 where it cannot be read."""
    try:
        scenarios = reader.count(path)
        if stride == STRIDE or scenarios == 0:
            return scenarios
        recordings = reader.describe(path).recordings
    except (DataError, UsageError):
        return 0
    if not recordings or recordings >= scenarios:
        return scenarios
    # Readers count windows of the usual stride: from those, about how long the recordings are.
    steps = STEPS + STRIDE * (scenarios / recordings - 1)
    return round(recordings * ((steps - STEPS) // stride + 1))


def free_bytes(path: Path) -> int:
    """Free bytes of the disk on which a path lies, or would."""
    path = path.absolute()
    while not path.exists():
        path = path.parent
    return shutil.disk_usage(path).free


def gigabytes(size: float) -> str:
    """A size for people: ``540 kB``, ``6.6 GB``, ``412 GB``."""
    for unit, scale in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if size >= scale:
            return f"{size / scale:.1f} {unit}" if size < 10 * scale else f"{size / scale:,.0f} {unit}"
    return f"{size / 1e3:.0f} kB" if size >= 1e3 else f"{size:.0f} bytes"


def counted(number: int, noun: str) -> str:
    """A number with its noun, in the plural where it must be."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def _size(paths: Sequence[Path]) -> int:
    return sum(path.stat().st_size for path in paths)


def input_bytes(inputs: Sequence[Input]) -> int:
    """Bytes of the files to read, companions aside."""
    return _size([entry.path for entry in inputs])
