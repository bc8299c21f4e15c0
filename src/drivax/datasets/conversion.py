"""Convert a public data set to a scenario set: worker processes read and assemble files, one process writes.

The result does not depend on the number of workers, nor on interruptions: files are taken in the order of their paths,
records in file order, and a closed shard of the set never changes. Nothing here imports JAX, so workers start in a
fraction of a second; an audit that needs it is passed in.
"""

from __future__ import annotations

import hashlib
import operator
import os
import shutil
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from importlib import metadata
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np

from drivax.datasets.doctor import SizeEstimate, estimate
from drivax.datasets.formats import AUTO, Survey, detect, find_reader, survey
from drivax.datasets.reader import BadRecord, Reader, companion_files, with_steps
from drivax.errors import DataError, DrivaxError, UsageError, did_you_mean, explain_system
from drivax.files import count_text
from drivax.reading import check_regular, explain_damage
from drivax.scenario.build.assemble import assemble
from drivax.scenario.build.routes import RouteStyle
from drivax.scenario.manifest import manifest_entry
from drivax.scenario.recording import STRIDE, Recording, windows
from drivax.scenario.schema import CAPACITIES, SCHEMA_VERSION, Capacity, Scenario, record_dtype
from drivax.scenario.select.selection import Selection
from drivax.scenario.select.splits import Shares, parse_shares
from drivax.scenario.store import ScenarioWriter
from drivax.tracking.workers import worker_pool

_Result = TypeVar("_Result")
#: Options that do not change the bytes of a set.
_WITHOUT_EFFECT = ("workers", "strict", "overwrite")
#: Scenarios that are audited together.
_BATCH = 64
#: Bytes of the head and of the tail of a file that are hashed to identify it.
_ENDS = 1 << 16
#: A scenario or bad record, and the position after it: file number, and number of items read from that file.
_Item = tuple[Scenario | BadRecord, tuple[int, int]]
#: Called with (files done, files, scenarios so far).
Progress = Callable[[int, int, int], None]
#: Returns the audit of each scenario as a dictionary.
Audit = Callable[[list[Scenario]], list[dict[str, Any]]]
#: Placeholder of a record that is in the spool file.
_SPOOLED = np.zeros(())


@dataclass(frozen=True)
class Conversion:
    """Options of a conversion.

    Attributes:
        format: Format of the files; auto detects it file by file.
        capacity: Padded sizes; large for scenarios with more than 80 moving agents or very dense maps.
        limit: Stop when the set holds N scenarios; all by default.
        filters: Only scenarios that meet this condition (NAME=A|B, NAME!=A, NAME>=N); repeat it to combine several.
        routes: How to find routes: drivax's own search, or the published breadth-first search.
        future_s: Seconds of a scenario after its current step, 8 in WOMD, 15 in nuPlan's challenges; longer
            recordings become windows, shorter ones end earlier.
        egos: Vehicles per scenario with a route and a goal, 1 to 8: the recorded ego and moving vehicles near it, which
            training with `egos: moving` drives.
        stride: Steps between the starts of two windows of a longer recording.
        split: Write lists for train/validation/test to OUT/splits, by recording: percentages, such as 80/10/10.
        workers: Processes that read, each a file at a time; 1 reads in the main process.
        strict: Stop at the first record that cannot be converted or is a duplicate instead of skipping it.
        overwrite: Replace an existing scenario set, or discard an interrupted conversion with other options.
        shard_size: Scenarios per shard of the set, the unit of resume.
    """

    format: str = AUTO
    capacity: str = "default"
    limit: int | None = None
    filters: tuple[str, ...] = ()
    routes: RouteStyle = "graph"
    future_s: float = 8.0
    egos: int = 1
    stride: int = STRIDE
    split: str | None = None
    workers: int = 1
    strict: bool = False
    overwrite: bool = False
    shard_size: int = 512

    def check(self) -> None:
        """Check the options."""
        if self.format != AUTO:
            find_reader(self.format)
        for name, choices in (("capacity", tuple(CAPACITIES)), ("routes", get_args(RouteStyle))):
            if (value := getattr(self, name)) not in choices:
                raise UsageError(f"unknown {name} {value!r}", cure=did_you_mean(value, choices))
        for name in ("limit", "stride", "workers", "shard_size"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise UsageError(f"{name} is {value}", cure="use 1 or more")
        Selection.parse(self.filters)
        _ = self.shares, self.sizes

    @property
    def sizes(self) -> Capacity:
        """Padded sizes of the scenarios."""
        return CAPACITIES[self.capacity].with_future(self.future_s).with_egos(self.egos)

    @property
    def shares(self) -> Shares | None:
        """The percentages of ``split``."""
        return None if self.split is None else parse_shares(self.split)


def convert_file(path: Path, options: Conversion) -> Iterator[Scenario | BadRecord]:
    """Yield the scenarios of one file in file order, without audit, and bad records in their places.

    Args:
        path: The file.
        options: ``format``, ``capacity``, ``future_s``, ``egos``, ``routes``, ``stride`` and, without filters,
            ``limit`` are used.
    """
    try:
        check_regular(path, "name a file")
        reader = detect(path) if options.format == AUTO else find_reader(options.format)
    except DataError as error:
        yield BadRecord.of(error, path)
        return
    keys: set[tuple[str, str]] = set()  # the set keeps one of duplicates, so count them once
    for item in _read(with_steps(reader, options.sizes.steps), path):
        for result in [item] if isinstance(item, BadRecord) else _scenarios(item, path, options):
            yield result
            if isinstance(result, Scenario):
                keys.add(_key(result))
            if len(keys) == options.limit and not options.filters:
                return


def _key(scenario: Scenario) -> tuple[str, str]:
    """Return the key of a scenario, data set and id, which is unique in a set."""
    return scenario.text("dataset"), scenario.id


def _read(reader: Reader, path: Path) -> Iterator[Recording | BadRecord]:
    """Yield the recordings of a file, and a bad record for a file or disk that cannot be read.

    Limits of this process (open files, memory) and missing packages are raised, but the readers of Argoverse and nuPlan
    report a lack of memory as damage.
    """
    try:
        yield from reader.read(path)
    except DataError as error:  # the file cannot be opened
        yield BadRecord.of(error, path)
    except OSError as error:
        if not isinstance(failure := explain_system(error, path), DataError):
            raise
        yield BadRecord.of(failure, path)


def _scenarios(recording: Recording, path: Path, options: Conversion) -> Iterator[Scenario | BadRecord]:
    """Yield the scenario of each window of a recording, or a bad record in its place."""
    capacity = options.sizes
    recordings = _attempt(
        lambda: list(windows(recording, options.stride, capacity.steps)), path, recording.scenario_id
    )
    if isinstance(recordings, BadRecord):
        yield recordings
        return
    for window in recordings:
        yield _attempt(partial(assemble, window, capacity, options.routes), path, window.scenario_id)


def _attempt(function: Callable[[], _Result], path: Path, record: str) -> _Result | BadRecord:
    """Return the result of a function, or a bad record for any error but a lack of memory."""
    try:
        return function()
    except DrivaxError as error:
        return BadRecord.of(error, path, record)
    except MemoryError:  # a skipped record would make the set depend on the machine
        raise
    except Exception as error:  # one odd recording must not end a conversion of a hundred thousand
        problem = f"assembling failed ({type(error).__name__}: {error})"
        return BadRecord(path, record, problem, "report it with this file and record")


@dataclass(frozen=True)
class ConversionPlan:
    """Files to convert, expected size, and number of scenarios that an interrupted conversion has written already."""

    data: Survey
    estimate: SizeEstimate
    written: int


@dataclass(frozen=True)
class Converted:
    """Result of a conversion.

    Attributes:
        path: The scenario set.
        scenarios: Number of scenarios in it.
        written: Number of those that an interrupted conversion wrote.
        files: Number of files read.
        ignored: Number of other files in the folder that are not read, companions (maps, poses) not counted.
        formats: Number of files by recognised format.
        skipped: Records that could not be read or converted, and duplicates.
        filtered: Number of scenarios that the filters rejected.
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
    announce: Callable[[ConversionPlan], None] | None = None,
) -> Converted:
    """Convert a file or folder of a public data set to a scenario set.

    Recordings longer than a scenario become windows. Unreadable records are skipped and reported. The set appears under
    ``out`` when it is complete. The same call resumes an interrupted conversion after its last closed shard, to the
    same bytes.

    Args:
        src: A file, or a folder that is searched to any depth.
        out: The scenario set to write.
        options: Options of the conversion.
        progress: Called after every scenario, bad record and file.
        audit: Called in this process with batches of scenarios; its results are stored with them.
        announce: Called once before the work begins.

    Raises:
        UsageError: An option is invalid, ``out`` exists, is being written, or was started with other options, or a
            package that the format needs is missing.
        DataError: ``src`` holds nothing that can be converted, the disk is too small, or with ``strict`` a record
            cannot be converted or is a duplicate.
    """
    options = options or Conversion()
    options.check()
    begin = time.monotonic()
    data = survey(src, options.format)
    capacity = options.sizes
    with ScenarioWriter(
        out, capacity, _source(data, options), options.shard_size, options.overwrite, options.shares,
        _identity(data, options, has_audit=audit is not None),
    ) as writer:  # fmt: skip
        written = len(writer)
        sink = _Sink(writer, data, options, audit)
        expected = estimate(data, Path(out), capacity, options.stride, options.limit)
        if announce is not None:
            announce(ConversionPlan(data, expected, written))
        if not options.filters:  # with filters the size is unknown
            expected.check(Path(out), written)
        done = _drain(data, options, sink, writer, progress)
        if not len(writer):
            raise _empty_error(data, sink)
        writer.source |= sink.skipped_rows()
    return Converted(
        Path(out), len(writer), written, done, data.ignored, dict(data.formats), tuple(sink.skipped),
        sink.filtered, time.monotonic() - begin,
    )  # fmt: skip


def _source(data: Survey, options: Conversion) -> dict[str, Any]:
    """Return the source of the set, for its manifest."""
    return {
        "command": "convert",
        "format": options.format,
        "folder": data.root.name,
        "files": len(data.inputs),
        "formats": dict(sorted(data.formats.items())),
        **{name: getattr(options, name) for name in ("limit", "filters", "routes", "stride", "split")},
    }


def _identity(data: Survey, options: Conversion, has_audit: bool) -> dict[str, Any]:
    """Return the properties that must be equal for a conversion to resume an interrupted one.

    They are versions, options, whether there is an audit, and path, size, format and ends of each file that is read,
    companions (maps, poses, tables) included.
    """
    companions = {
        file: None
        for entry in data.inputs if entry.format is not None
        for file in companion_files(find_reader(entry.format), entry.path)
    }  # fmt: skip
    return {
        "drivax": metadata.version("drivax"),
        "schema": SCHEMA_VERSION,
        "files": _digest(data, {entry.path: entry.format for entry in data.inputs}),
        "companions": _digest(data, companions),
        "audit": has_audit,
        **{name: value for name, value in vars(options).items() if name not in _WITHOUT_EFFECT},
    }


def _digest(data: Survey, formats: Mapping[Path, str | None]) -> str:
    """Return the SHA-256 (hex) of names, sizes, formats and ends of files."""
    digest = hashlib.sha256()
    for path, name in formats.items():
        size, ends = _ends(path)
        digest.update(f"{data.relative_path(path)}\t{size}\t{name}\t{ends}\n".encode())
    return digest.hexdigest()


def _ends(path: Path) -> tuple[int, str]:
    """Return the size of a file and the SHA-256 (hex) of its head and tail; -1 and "" if it cannot be read."""
    try:
        with path.open("rb") as file:
            head, size = file.read(_ENDS), file.seek(0, os.SEEK_END)
            file.seek(max(0, size - _ENDS))
            return size, hashlib.sha256(head + file.read()).hexdigest()
    except OSError:
        return -1, ""


class _Sink:
    """Takes results in order: drops duplicates, audits in batches, filters, writes, and collects bad records.

    Batches end where a shard ends, as they would after an interruption.
    """

    def __init__(
        self, writer: ScenarioWriter, data: Survey, options: Conversion, audit: Audit | None
    ) -> None:
        self._writer = writer
        self._data = data
        self._options = options
        self._audit = audit
        self._selection = Selection.parse(options.filters)
        self._waiting: list[_Item] = []
        self._scenarios_waiting = 0
        self.skipped: list[BadRecord] = []
        self.filtered = 0
        self.place = (0, 0)
        # Continue after the last closed shard of an interrupted conversion.
        with explain_damage(writer.folder, "remove this folder", "unfinished output is damaged"):
            for note in writer.notes:
                file, items = map(operator.index, note["place"])
                if not 0 <= file < len(data.inputs) or items < 0:
                    raise ValueError(f"file {file} of {len(data.inputs)}")
                self.place, self.filtered = (file, items), int(note["filtered"])
                for row in note["skipped"]:
                    path = data.root / row["file"] if data.root.is_dir() else data.root.with_name(row["file"])
                    self.skipped.append(BadRecord(path, row["record"], str(row["problem"]), row["cure"]))
        self._noted_count = len(self.skipped)
        if options.strict and self.skipped:
            raise self.skipped[0].error()

    @property
    def scenarios(self) -> int:
        """Number of scenarios written or waiting; some of the latter may be duplicates or fail the filters."""
        return len(self._writer) + self._scenarios_waiting

    @property
    def full(self) -> bool:
        """Whether the set holds as many scenarios as the limit."""
        return self._options.limit is not None and len(self._writer) >= self._options.limit

    def take(self, item: Scenario | BadRecord, place: tuple[int, int]) -> None:
        """Queue an item, and write the batch if it is full; raise a bad record's error if strict."""
        if isinstance(item, BadRecord) and self._options.strict:
            raise item.error()
        self._waiting.append((item, place))
        self._scenarios_waiting += isinstance(item, Scenario)
        if self._scenarios_waiting >= self._batch_size():
            self._write_batch()

    def flush(self) -> None:
        """Audit and write all waiting items, up to the limit."""
        while self._waiting and not self.full:
            self._write_batch()

    def skipped_rows(self) -> dict[str, Any]:
        """Return number and list of the skipped records, and the number of filtered scenarios, for the manifest."""
        rows = [_row(self._data, record) for record in self.skipped]
        for row in rows:
            del row["cure"]
        return {"skipped": len(rows), "skipped_records": rows, "filtered": self.filtered}

    def _batch_size(self) -> int:
        """Return the number of scenarios to wait for: 1 without an audit, else a batch.

        Without filters a batch ends at the latest where the shard or the limit does.
        """
        if self._audit is None:
            return 1
        if self._options.filters:  # the number of scenarios that pass is unknown
            return _BATCH
        remaining = _BATCH if self._options.limit is None else self._options.limit - len(self._writer)
        return min(_BATCH, self._writer.room, remaining)

    def _write_batch(self) -> None:
        """Audit all waiting items, and write them up to the end of the shard or the limit; queue the rest again."""
        batch, self._waiting, self._scenarios_waiting = self._waiting, [], 0
        items = self._drop_duplicates(batch)
        scenarios = [item for item in items if isinstance(item, Scenario)]
        findings = [{} for _ in scenarios] if self._audit is None else self._audit(scenarios)
        pairs = zip(scenarios, findings, strict=True)
        results = iter([replace(scenario, audit=finding) for scenario, finding in pairs])
        for number, item in enumerate(items):
            if isinstance(item, BadRecord):
                if self._options.strict:
                    raise item.error()
                self.skipped.append(item)
            elif self._write(next(results), batch[number][1]) or self.full:
                # A shard is closed, or the limit is reached: the rest begins a new batch.
                self._waiting = batch[number + 1 :]
                self._scenarios_waiting = sum(isinstance(item, Scenario) for item, _ in self._waiting)
                return

    def _drop_duplicates(self, batch: list[_Item]) -> list[Scenario | BadRecord]:
        """Return the items of a batch, with bad records in place of duplicates."""
        items: list[Scenario | BadRecord] = []
        keys: set[tuple[str, str]] = set()
        for item, (file, _) in batch:
            if isinstance(item, Scenario):
                key = _key(item)
                if key in self._writer or key in keys:
                    problem, cure = "the scenario is in the set already", "give each file once"
                    item = BadRecord(self._data.inputs[file].path, item.id, problem, cure)
                keys.add(key)
            items.append(item)
        return items

    def _write(self, scenario: Scenario, place: tuple[int, int]) -> bool:
        """Write a scenario unless it is filtered out; return whether that closed a shard."""
        if not self._selection.matches(manifest_entry(scenario)):
            self.filtered += 1
            return False
        if self._writer.room > 1:
            self._writer.add(scenario)
            return False
        rows = [_row(self._data, record) for record in self.skipped[self._noted_count :]]
        self._noted_count = len(self.skipped)
        self._writer.add(scenario, {"place": place, "filtered": self.filtered, "skipped": rows})
        return True


def _row(data: Survey, record: BadRecord) -> dict[str, Any]:
    """Return a bad record as JSON values."""
    return {**vars(record), "file": data.relative_path(record.file)}


def _drain(
    data: Survey, options: Conversion, sink: _Sink, writer: ScenarioWriter, progress: Progress | None
) -> int:
    """Move results into the sink until its limit; return the number of files read."""
    report = progress or (lambda done, total, scenarios: None)
    # An interrupted conversion has taken ``skip`` items of the first file, and perhaps reached the limit.
    first, skip = sink.place
    if sink.full:
        return first + 1
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
    """Yield the scenarios and bad records of each file from number ``first`` on."""
    inputs = data.inputs[first:]
    tasks = [(entry.path, replace(options, format=entry.format or options.format)) for entry in inputs]
    if options.workers == 1 or len(tasks) <= 1:
        yield from (convert_file(*task) for task in tasks)
        return
    yield from convert_ahead(tasks, convert_file, options.sizes, options.workers, folder)


def _empty_error(data: Survey, sink: _Sink) -> DataError:
    """Return the error for a conversion that yields no scenario."""
    if sink.filtered:
        problem = f"none of the {sink.filtered} scenarios satisfies the filters"
        return DataError(problem, file=data.root, cure="use wider filters")
    if not sink.skipped:
        return DataError("contains no recording", file=data.root, cure="run drivax doctor on it")
    first, others = sink.skipped[0], len(sink.skipped) - 1
    if others:
        problem = f"{first.problem} ({count_text(others, 'more record')} could not be converted either)"
        first = replace(first, problem=problem)
    return first.error()


def convert_ahead(
    tasks: Sequence[tuple[Any, ...]],
    convert: Callable[..., Iterator[Scenario | BadRecord]],
    capacity: Capacity,
    workers: int,
    folder: Path,
) -> Generator[Iterator[Scenario | BadRecord], None, None]:
    """Yield the scenarios and bad records of each task in order; read them before asking for the next task's.

    Args:
        tasks: Arguments of ``convert``, which can be pickled.
        convert: A module-level function, which workers call.
        capacity: Padded sizes of the scenarios.
        workers: Number of processes.
        folder: An existing folder for the records of about ``workers + 2`` tasks.
    """
    spool = folder / f"spool-{os.getpid()}"
    spool.mkdir()
    waiting: deque[tuple[Path, Future[list[Scenario | BadRecord]]]] = deque()
    remaining = enumerate(tasks)
    try:
        with worker_pool(min(workers, len(tasks))) as pool:
            while True:
                # Two tasks ahead keep all workers busy and bound the space on the disk.
                while len(waiting) < workers + 2 and (item := next(remaining, None)) is not None:
                    number, task = item
                    path = spool / f"{number}.records"
                    waiting.append((path, pool.submit(_spool, task, convert, path)))
                if not waiting:
                    return
                path, future = waiting.popleft()
                yield _unspool(future.result(), path, capacity)
                path.unlink(missing_ok=True)
    finally:
        shutil.rmtree(spool, ignore_errors=True)


def _spool(
    task: tuple[Any, ...], convert: Callable[..., Iterator[Scenario | BadRecord]], path: Path
) -> list[Scenario | BadRecord]:
    """Run one task in a worker: write the records of its scenarios to ``path``, return the items without them."""
    items: list[Scenario | BadRecord] = []
    with path.open("wb") as file:
        for item in convert(*task):
            if isinstance(item, Scenario):
                file.write(item.record.tobytes())
                item = replace(item, record=_SPOOLED)
            items.append(item)
    return items


def _unspool(
    items: Sequence[Scenario | BadRecord], path: Path, capacity: Capacity
) -> Iterator[Scenario | BadRecord]:
    """Yield the results of a task, with their records from ``path``."""
    dtype = record_dtype(capacity)
    with path.open("rb") as file:
        for item in items:
            if isinstance(item, Scenario):
                record = np.frombuffer(file.read(dtype.itemsize), dtype).reshape(())
                item = replace(item, record=record)
            yield item
