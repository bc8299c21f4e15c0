"""How to convert, and the conversion of one file: what worker processes do."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar, get_args

from drivax.datasets.formats import AUTO, detect, reader_named
from drivax.datasets.reader import BadRecord, Reader
from drivax.errors import DataError, DrivaxError, UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.build.routes import RouteStyle
from drivax.scenario.recording import STRIDE, Recording, windows
from drivax.scenario.schema import CAPACITIES, Scenario
from drivax.scenario.select.selection import Selection
from drivax.scenario.select.splits import Shares, parse_shares

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Conversion:
    """How to convert.

    Attributes:
        format: Name of a format, or ``auto``: each file by its content.
        capacity: Name of the padded sizes (``scenario.schema.CAPACITIES``).
        limit: Stop when the set holds so many scenarios; None: all.
        filters: Keep only scenarios that satisfy all of them (``scenario.select.selection``).
        routes: How routes are found (``scenario.build.assemble.assemble``).
        stride: Steps between the starts of two windows of a long recording.
        split: Percentages of recordings for train/validation/test, as ``80/10/10``; None: no split files.
        workers: Processes; with 1 everything happens in this one.
        strict: Fail at the first record that cannot be read instead of skipping it.
        overwrite: Replace an existing scenario set, and start anew where another conversion was begun.
        shard_size: Scenarios per shard of the set, the unit of resume.
    """

    format: str = AUTO
    capacity: str = "default"
    limit: int | None = None
    filters: tuple[str, ...] = ()
    routes: RouteStyle = "graph"
    stride: int = STRIDE
    split: str | None = None
    workers: int = 1
    strict: bool = False
    overwrite: bool = False
    shard_size: int = 512

    def check(self) -> None:
        """Refuse options that cannot be meant.

        Raises:
            UsageError: The first of them.
        """
        if self.format != AUTO:
            reader_named(self.format)
        for name, known in (("capacity", tuple(CAPACITIES)), ("routes", get_args(RouteStyle))):
            if getattr(self, name) not in known:
                raise UsageError(
                    f"there is no {name} {getattr(self, name)!r}", cure=f"use one of {', '.join(known)}"
                )
        for name in ("limit", "stride", "workers", "shard_size"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise UsageError(f"{name} is {value}", cure="use 1 or more")
        Selection.parse(self.filters)
        _ = self.shares

    @property
    def shares(self) -> Shares | None:
        """The percentages of ``split``."""
        return None if self.split is None else parse_shares(self.split)


def convert_file(path: Path, options: Conversion) -> Iterator[Scenario | BadRecord]:
    """The scenarios of one file in file order, and bad records in their places; at most ``limit`` scenarios.

    Args:
        path: The file.
        options: ``format``, ``capacity``, ``routes``, ``stride`` and, without filters, ``limit`` are used.

    Yields:
        Assembled scenarios without audit, or what could not be read or assembled and why.
    """
    reader = _reader(path, options.format)
    if isinstance(reader, BadRecord):
        yield reader
        return
    count = 0
    for item in reader.read(path):
        for result in [item] if isinstance(item, BadRecord) else _scenarios(item, path, options):
            yield result
            count += isinstance(result, Scenario)
            if count == options.limit and not options.filters:
                return


def _reader(path: Path, name: str) -> Reader | BadRecord:
    try:
        return detect(path) if name == AUTO else reader_named(name)
    except DataError as error:
        return BadRecord.of(error, path)


def _scenarios(recording: Recording, path: Path, options: Conversion) -> Iterator[Scenario | BadRecord]:
    parts = _attempt(lambda: list(windows(recording, options.stride)), path, recording.scenario_id)
    if isinstance(parts, BadRecord):
        yield parts
        return
    capacity = CAPACITIES[options.capacity]
    for part in parts:
        yield _attempt(partial(assemble, part, capacity, options.routes), path, part.scenario_id)


def _attempt(call: Callable[[], _Result], path: Path, record: str) -> _Result | BadRecord:
    try:
        return call()
    except DrivaxError as error:
        return BadRecord.of(error, path, record)
    except Exception as error:  # one odd recording must not end a conversion of a hundred thousand
        problem = f"assembling failed ({type(error).__name__}: {error})"
        return BadRecord(path, record, problem, "report it with this file and record")
