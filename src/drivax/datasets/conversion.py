"""Public data set -> scenario set: files are read and assembled in worker processes, written by one.

The result does not depend on the number of workers, nor on how often the conversion was killed and restarted: files
are taken in the order of their paths, records in file order, and a closed shard of the set is never touched again.
Nothing here imports JAX, so that workers start in a fraction of a second; an audit that needs it is handed in.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from importlib import metadata
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar, get_args

from drivax.datasets.doctor import Estimate, estimate
from drivax.datasets.formats import AUTO, Survey, detect, reader_named, survey
from drivax.datasets.reader import BadRecord, Reader
from drivax.datasets.spool import converted_ahead
from drivax.errors import DataError, DrivaxError, UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.build.routes import RouteStyle
from drivax.scenario.recording import STRIDE, Recording, windows
from drivax.scenario.schema import CAPACITIES, SCHEMA_VERSION, Scenario
from drivax.scenario.select.selection import Selection
from drivax.scenario.select.splits import Shares, parse_shares
from drivax.scenario.store import ScenarioWriter, manifest_entry

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Conversion:
    """How to convert.

    Attributes:
        format: Format of the files; auto detects it file by file.
        capacity: Padded sizes; large for scenarios with more than 80 moving agents or very dense maps.
        limit: Stop when the set holds N scenarios; all by default.
        filters: Only scenarios that meet this condition (NAME=A|B, NAME!=A, NAME>=N); repeat it to combine several.
        routes: How to find routes: our generator, or the published breadth-first search.
        stride: Steps between the starts of two windows of a recording longer than 91 steps.
        split: Write lists for train/validation/test to OUT/splits, by recording: percentages, as 80/10/10.
        workers: Processes that read; 1 reads in the main process.
        strict: Stop at the first unreadable record instead of skipping it.
        overwrite: Replace an existing scenario set, or start again after another, interrupted conversion.
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


__all__ = ["Conversion", "Converted", "Plan", "convert", "convert_file"]

#: Scenarios that are audited together.
_BATCH = 64

#: A scenario or bad record, and the place after it: file number, items read of that file.
_Placed = tuple[Scenario | BadRecord, tuple[int, int]]
#: Called with (files done, files, scenarios so far).
Progress = Callable[[int, int, int], None]
#: Fills the audit of scenarios: one dictionary each.
Audit = Callable[[list[Scenario]], list[dict[str, Any]]]


@dataclass(frozen=True)
class Plan:
    """What a conversion is about to do.

    Attributes:
        data: The files.
        estimate: How large the set will be.
        written: How many scenarios an earlier, interrupted conversion has written already.
    """

    data: Survey
    estimate: Estimate
    written: int


@dataclass(frozen=True)
class Converted:
    """What a conversion did.

    Attributes:
        path: The scenario set.
        scenarios: How many it holds.
        written: How many of them an earlier, interrupted conversion wrote.
        files: How many files were read.
        ignored: How many files of the folder are of no known format.
        formats: Number of files by format.
        skipped: The records that could not be read or converted, duplicates included.
        filtered: How many scenarios the filters left out.
        seconds: Wall time.
    """

    path: Path
    scenarios: int
    written: int
    files: int
    ignored: int
    formats: dict[str, int]
    skipped: tuple[BadRecord, ...]
    filtered: int
    seconds: float


def convert(
    src: str | Path,
    out: str | Path,
    options: Conversion | None = None,
    progress: Progress | None = None,
    audit: Audit | None = None,
    announce: Callable[[Plan], None] | None = None,
) -> Converted:
    """Convert a file or folder of a public data set to a scenario set.

    Recordings longer than 91 steps become windows. Records that cannot be read are skipped and reported. The set
    appears under ``out`` when it is complete. A conversion that was killed is continued after its last closed shard
    by one of the same data with the same options, to the same bytes.

    Args:
        src: A file, or a folder that is searched to any depth.
        out: The scenario set to write.
        options: How.
        progress: Called after every scenario and every file.
        audit: Called in this process with batches of scenarios; what it returns is stored with them.
        announce: Called once before the work begins.

    Raises:
        UsageError: Options that cannot be meant, ``out`` exists, is being written, or was started with other options,
            or a package that the format needs is missing.
        DataError: ``src`` holds nothing that can be converted, the disk is too small, or with ``strict`` a record
            cannot be read.
    """
    options = options or Conversion()
    options.check()
    begin = time.monotonic()
    data = survey(src, options.format)
    capacity = CAPACITIES[options.capacity]
    with ScenarioWriter(
        out, capacity, _source(data, options), options.shard_size, options.overwrite, options.shares,
        _identity(data, options, audited=audit is not None),
    ) as writer:  # fmt: skip
        written = len(writer)
        sink = _Sink(writer, data, options, audit)
        expected = estimate(data, Path(out), capacity, options.stride, options.limit)
        if announce is not None:
            announce(Plan(data, expected, written))
        if not options.filters:  # with filters the size is unknown
            expected.check(Path(out), written)
        done = _drain(data, options, sink, writer, progress)
        if not len(writer):
            raise _nothing(data, sink)
        writer.source |= sink.left_out()
    seconds = time.monotonic() - begin
    return Converted(
        Path(out), len(writer), written, done, data.ignored, dict(data.formats), tuple(sink.skipped),
        sink.filtered, seconds,
    )  # fmt: skip


def _source(data: Survey, options: Conversion) -> dict[str, Any]:
    """Where the set comes from, for its manifest."""
    return {
        "command": "convert",
        "format": options.format,
        "folder": data.root.name,
        "files": len(data.inputs),
        "formats": dict(sorted(data.formats.items())),
        **{name: getattr(options, name) for name in ("limit", "filters", "routes", "stride", "split")},
    }


def _identity(data: Survey, options: Conversion, audited: bool) -> dict[str, Any]:
    """All that the bytes of the set depend on; only a conversion with the same may continue another."""
    digest = hashlib.sha256()
    for entry in data.inputs:
        digest.update(f"{data.relative(entry.path)}\t{entry.path.stat().st_size}\t{entry.format}\n".encode())
    names = ("format", "capacity", "limit", "filters", "routes", "stride", "split", "shard_size")
    return {
        "drivax": metadata.version("drivax"),
        "schema": SCHEMA_VERSION,
        "files": digest.hexdigest(),
        "audit": audited,
        **{name: getattr(options, name) for name in names},
    }


class _Sink:
    """Takes results in order: audits in batches, filters, leaves out duplicates, counts what is bad, writes the rest.

    Batches end where a shard ends: so does everything that depends on what came before.
    """

    def __init__(
        self, writer: ScenarioWriter, data: Survey, options: Conversion, audit: Audit | None
    ) -> None:
        self._writer = writer
        self._data = data
        self._options = options
        self._audit = audit
        self._selection = Selection.parse(options.filters)
        self._waiting: list[_Placed] = []
        self._scenarios_waiting = 0
        self._noted = 0
        self.skipped: list[BadRecord] = []
        self.filtered = 0
        self.place = (0, 0)
        for note in writer.notes:
            self.place = tuple(note["place"])
            self.filtered = note["filtered"]
            self.skipped += [_bad_record(data, row) for row in note["skipped"]]
        self._noted = len(self.skipped)
        if options.strict and self.skipped:
            raise self.skipped[0].error()

    @property
    def scenarios(self) -> int:
        """Scenarios taken so far, those that wait included."""
        return len(self._writer) + self._scenarios_waiting

    @property
    def full(self) -> bool:
        """Whether the limit is reached."""
        return self._options.limit is not None and len(self._writer) >= self._options.limit

    def take(self, item: Scenario | BadRecord, place: tuple[int, int]) -> None:
        """Keep a scenario, or note a bad record (fail, if strict)."""
        if isinstance(item, BadRecord) and self._options.strict:
            raise item.error()
        self._waiting.append((item, place))
        self._scenarios_waiting += isinstance(item, Scenario)
        if self._scenarios_waiting >= self._batch_size():
            self._write_batch()

    def flush(self) -> None:
        """Audit and write what is waiting."""
        while self._waiting and not self.full:
            self._write_batch()

    def left_out(self) -> dict[str, Any]:
        """What is not in the set, for its manifest."""
        rows = [_row(self._data, bad) for bad in self.skipped]
        for row in rows:
            del row["cure"]
        return {"skipped": len(rows), "skipped_records": rows, "filtered": self.filtered}

    def _batch_size(self) -> int:
        if self._audit is None:
            return 1
        if self._options.filters:  # the number of kept scenarios is unknown
            return _BATCH
        left = _BATCH if self._options.limit is None else self._options.limit - len(self._writer)
        return min(_BATCH, self._writer.room, left)

    def _write_batch(self) -> None:
        batch, self._waiting, self._scenarios_waiting = self._waiting, [], 0
        items = self._without_duplicates(batch)
        scenarios = [item for item in items if isinstance(item, Scenario)]
        findings = [{} for _ in scenarios] if self._audit is None else self._audit(scenarios)
        audited = iter(
            [replace(scenario, audit=finding) for scenario, finding in zip(scenarios, findings, strict=True)]
        )
        for number, item in enumerate(items):
            if isinstance(item, BadRecord):
                self._skip(item)
            elif self._write(next(audited), batch[number][1]) or self.full:
                # A shard is closed: the rest begins a new batch, as it would after a kill.
                self._waiting = batch[number + 1 :]
                self._scenarios_waiting = sum(isinstance(item, Scenario) for item, _ in self._waiting)
                return

    def _without_duplicates(self, batch: list[_Placed]) -> list[Scenario | BadRecord]:
        """The items of a batch, with a bad record in the place of a scenario that is in the set or earlier in it."""
        items: list[Scenario | BadRecord] = []
        seen: set[tuple[str, str]] = set()
        for item, (file, _) in batch:
            if isinstance(item, Scenario):
                key = bytes(item.record["dataset"][()]).decode(), item.id
                if key in self._writer or key in seen:
                    path = self._data.inputs[file].path
                    item = BadRecord(
                        path, item.id, "the scenario is in the set already", "give each file once"
                    )
                else:
                    seen.add(key)
            items.append(item)
        return items

    def _write(self, scenario: Scenario, place: tuple[int, int]) -> bool:
        """Write a scenario unless it is filtered out; whether that closed a shard."""
        if not self._selection.matches(manifest_entry(scenario)):
            self.filtered += 1
            return False
        closes = self._writer.room == 1
        self._writer.add(scenario, self._note(place) if closes else None)
        return closes

    def _note(self, place: tuple[int, int]) -> dict[str, Any]:
        new, self._noted = self.skipped[self._noted :], len(self.skipped)
        rows = [_row(self._data, bad) for bad in new]
        return {"place": place, "filtered": self.filtered, "skipped": rows}

    def _skip(self, bad: BadRecord) -> None:
        if self._options.strict:
            raise bad.error()
        self.skipped.append(bad)


def _row(data: Survey, bad: BadRecord) -> dict[str, Any]:
    """A bad record as JSON values."""
    return {"file": data.relative(bad.file), "record": bad.record, "problem": bad.problem, "cure": bad.cure}


def _bad_record(data: Survey, row: dict[str, Any]) -> BadRecord:
    file = data.root / row["file"] if data.root.is_dir() else data.root.with_name(row["file"])
    return BadRecord(file, row["record"], row["problem"], row["cure"])


def _drain(
    data: Survey, options: Conversion, sink: _Sink, writer: ScenarioWriter, progress: Progress | None
) -> int:
    """Moves results into the sink until they or the limit end; returns the number of files read."""
    report = progress or (lambda done, total, scenarios: None)
    first, skip = sink.place
    total = len(data.inputs)
    with closing(_results(data, options, first, writer.folder)) as results:
        for number, items in enumerate(results, start=first):
            for place, item in islice(enumerate(items, start=1), skip, None):
                sink.take(item, (number, place))
                report(number, total, sink.scenarios)
                if sink.full:
                    return number + 1
            skip = 0
            report(number + 1, total, sink.scenarios)
    sink.flush()
    return total


def _results(
    data: Survey, options: Conversion, first: int, folder: Path
) -> Generator[Iterator[Scenario | BadRecord], None, None]:
    """Scenarios and bad records of every file from number ``first`` on."""
    tasks = [
        (entry.path, replace(options, format=entry.format or options.format)) for entry in data.inputs[first:]
    ]
    if options.workers == 1 or len(tasks) <= 1:
        yield from (convert_file(*task) for task in tasks)
        return
    yield from converted_ahead(tasks, convert_file, CAPACITIES[options.capacity], options.workers, folder)


def _nothing(data: Survey, sink: _Sink) -> DataError:
    if sink.filtered:
        problem = f"none of the {sink.filtered} scenarios satisfies the filters"
        return DataError(problem, file=data.root, cure="use wider filters")
    if not sink.skipped:
        return DataError("holds no recording", file=data.root, cure="look at it with drivax doctor")
    first = sink.skipped[0]
    if len(sink.skipped) == 1:
        return first.error()
    others = len(sink.skipped) - 1
    return DataError(
        f"{first.problem} (and none of the other {others} record{'s' if others > 1 else ''} could be converted)",
        file=first.file,
        record=first.record,
        cure=first.cure,
    )
