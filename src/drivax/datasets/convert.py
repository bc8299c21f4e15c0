"""Public data set -> scenario set: files are read and assembled in worker processes, written by one.

The result does not depend on the number of workers: files are taken in the order of their paths, records in file
order. Nothing here imports JAX, so that workers start in a fraction of a second; an audit that needs it is handed in.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import signal
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from drivax.datasets.formats import AUTO, detect, find_files, reader_named
from drivax.datasets.reader import BadRecord, Reader
from drivax.errors import DataError, UsageError
from drivax.scenario.assemble import assemble, windows
from drivax.scenario.recording import Recording
from drivax.scenario.schema import CAPACITIES, Capacity, Scenario
from drivax.scenario.store import ScenarioWriter

#: Scenarios that are audited together.
_BATCH = 64

_Result = TypeVar("_Result")

#: Called with (files done, files, scenarios so far).
Progress = Callable[[int, int, int], None]
#: Fills the audit of scenarios: one dictionary each.
Audit = Callable[[list[Scenario]], list[dict[str, Any]]]


@dataclass(frozen=True)
class Conversion:
    """How to convert.

    Attributes:
        format: Name of a format, or ``auto``: each file by its content.
        capacity: Name of the padded sizes (``scenario.schema.CAPACITIES``).
        limit: Stop after so many scenarios; None: all.
        workers: Processes; with 1 everything happens in this one.
        strict: Fail at the first record that cannot be read instead of skipping it.
        overwrite: Replace an existing scenario set.
    """

    format: str = AUTO
    capacity: str = "default"
    limit: int | None = None
    workers: int = 1
    strict: bool = False
    overwrite: bool = False

    def check(self) -> None:
        """Refuse options that cannot be meant.

        Raises:
            UsageError: The first of them.
        """
        if self.format != AUTO:
            reader_named(self.format)
        if self.capacity not in CAPACITIES:
            raise UsageError(
                f"there is no capacity {self.capacity!r}", cure=f"use one of {', '.join(CAPACITIES)}"
            )
        if self.limit is not None and self.limit < 1:
            raise UsageError(f"limit is {self.limit}", cure="use 1 or more")
        if self.workers < 1:
            raise UsageError(f"workers is {self.workers}", cure="use 1 or more")


@dataclass(frozen=True)
class Converted:
    """What a conversion did.

    Attributes:
        path: The scenario set.
        scenarios: How many it holds.
        files: How many files were read.
        ignored: How many files of the folder are of no known format.
        skipped: The records that could not be read or converted, duplicates included.
        seconds: Wall time.
    """

    path: Path
    scenarios: int
    files: int
    ignored: int
    skipped: tuple[BadRecord, ...]
    seconds: float


def convert(
    src: str | Path,
    out: str | Path,
    options: Conversion | None = None,
    progress: Progress | None = None,
    audit: Audit | None = None,
) -> Converted:
    """Convert a file or folder of a public data set to a scenario set.

    Recordings longer than 91 steps become windows. Records that cannot be read are skipped and reported. The set
    appears under ``out`` when it is complete.

    Args:
        src: A file, or a folder that is searched to any depth.
        out: The scenario set to write.
        options: How.
        progress: Called after every scenario and every file.
        audit: Called in this process with batches of scenarios; what it returns is stored with them.

    Raises:
        UsageError: Options that cannot be meant, ``out`` exists, or a package that the format needs is missing.
        DataError: ``src`` holds nothing that can be converted, or with ``strict`` a record cannot be read.
    """
    options = options or Conversion()
    options.check()
    begin = time.monotonic()
    files, ignored = find_files(src, options.format)
    capacity = CAPACITIES[options.capacity]
    source = {"command": "convert", "format": options.format, "folder": Path(src).name, "files": len(files)}
    with ScenarioWriter(out, capacity, source=source, overwrite=options.overwrite) as writer:
        sink = _Sink(writer, options, audit)
        with closing(_results(files, options)) as results:
            done = _drain(results, sink, len(files), progress)
        sink.flush()
        if sink.scenarios == 0:
            raise _nothing(sink.skipped)
    return Converted(Path(out), sink.scenarios, done, ignored, tuple(sink.skipped), time.monotonic() - begin)


class _Sink:
    """Takes results in order: counts what is bad, leaves out duplicates, audits in batches, writes them."""

    def __init__(self, writer: ScenarioWriter, options: Conversion, audit: Audit | None) -> None:
        self._writer = writer
        self._options = options
        self._audit = audit
        self._batch: list[Scenario] = []
        self._known: set[tuple[bytes, bytes]] = set()
        self.scenarios = 0
        self.skipped: list[BadRecord] = []

    @property
    def full(self) -> bool:
        """Whether the limit is reached."""
        return self._options.limit is not None and self.scenarios >= self._options.limit

    def take(self, item: Scenario | BadRecord, file: Path) -> None:
        """Keep a scenario, or note a bad record (fail, if strict)."""
        if isinstance(item, Scenario):
            key = (bytes(item.record["dataset"][()]), bytes(item.record["scenario_id"][()]))
            if key not in self._known:
                self._known.add(key)
                self._add(item)
                return
            item = BadRecord(file, item.id, "the scenario is in the set already", "give each recording once")
        if self._options.strict:
            raise item.error()
        self.skipped.append(item)

    def _add(self, scenario: Scenario) -> None:
        self.scenarios += 1
        self._batch.append(scenario)
        if self._audit is None or len(self._batch) == _BATCH:
            self.flush()

    def flush(self) -> None:
        """Audit and write what is waiting."""
        if self._audit is not None and self._batch:
            audits = self._audit(self._batch)
            pairs = zip(self._batch, audits, strict=True)
            self._batch = [dataclasses.replace(scenario, audit=findings) for scenario, findings in pairs]
        for scenario in self._batch:
            self._writer.add(scenario)
        self._batch = []


def _drain(
    results: Iterator[tuple[Path, Iterator[Scenario | BadRecord]]],
    sink: _Sink,
    files: int,
    progress: Progress | None,
) -> int:
    """Moves results into the sink until they or the limit end; returns the number of files read."""
    report = progress or (lambda done, total, scenarios: None)
    done = 0
    for file, items in results:
        for item in items:
            sink.take(item, file)
            report(done, files, sink.scenarios)
            if sink.full:
                return done + 1
        done += 1
        report(done, files, sink.scenarios)
    return done


def _nothing(skipped: list[BadRecord]) -> DataError:
    first = skipped[0]
    if len(skipped) == 1:
        return first.error()
    return DataError(
        f"{first.problem} (and none of the other {len(skipped) - 1} records could be converted)",
        file=first.file,
        record=first.record,
        cure=first.cure,
    )


def _results(
    files: list[Path], options: Conversion
) -> Generator[tuple[Path, Iterator[Scenario | BadRecord]], None, None]:
    if options.workers == 1 or len(files) == 1:
        for file in files:
            yield file, convert_file(file, options)
        return
    _reader(files[0], options.format)  # a missing package is told here, in one line, not by every worker
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(
        min(options.workers, len(files)), mp_context=context, initializer=_start_worker
    )
    waiting: deque[tuple[Path, Future[list[Scenario | BadRecord]]]] = deque()
    todo = iter(files)
    try:
        while True:
            # Two files ahead keep everyone busy and bound what is held in memory.
            while len(waiting) < options.workers + 2 and (file := next(todo, None)) is not None:
                waiting.append((file, pool.submit(_convert_whole_file, file, options)))
            if not waiting:
                return
            file, future = waiting.popleft()
            yield file, iter(_finished(file, future))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _finished(file: Path, future: Future[list[Scenario | BadRecord]]) -> list[Scenario | BadRecord]:
    try:
        return future.result()
    except BrokenProcessPool as error:
        raise DataError(
            "a worker process died (out of memory, or a script without a main guard)",
            file=file,
            cure="use fewer --workers",
        ) from error


def _start_worker() -> None:
    # On Ctrl-C workers die at once and silently; this process cleans up.
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _convert_whole_file(path: Path, options: Conversion) -> list[Scenario | BadRecord]:
    return list(convert_file(path, options))


def convert_file(path: Path, options: Conversion) -> Iterator[Scenario | BadRecord]:
    """The scenarios of one file in file order, and bad records in their places; at most ``limit`` scenarios.

    Args:
        path: The file.
        options: ``format``, ``capacity`` and ``limit`` are used.

    Yields:
        Assembled scenarios without audit, or what could not be read or assembled and why.
    """
    reader = _reader(path, options.format)
    if isinstance(reader, BadRecord):
        yield reader
        return
    capacity = CAPACITIES[options.capacity]
    count = 0
    for item in reader.read(path):
        for result in [item] if isinstance(item, BadRecord) else _scenarios(item, path, capacity):
            yield result
            count += isinstance(result, Scenario)
            if count == options.limit:
                return


def _reader(path: Path, name: str) -> Reader | BadRecord:
    try:
        return detect(path) if name == AUTO else reader_named(name)
    except DataError as error:
        return BadRecord.of(error, path)


def _scenarios(recording: Recording, path: Path, capacity: Capacity) -> Iterator[Scenario | BadRecord]:
    parts = _attempt(lambda: list(windows(recording)), path, recording.scenario_id)
    if isinstance(parts, BadRecord):
        yield parts
        return
    for part in parts:
        yield _attempt(partial(assemble, part, capacity), path, part.scenario_id)


def _attempt(call: Callable[[], _Result], path: Path, record: str) -> _Result | BadRecord:
    try:
        return call()
    except DataError as error:
        return BadRecord.of(error, path, record)
    except Exception as error:  # one odd recording must not end a conversion of a hundred thousand
        problem = f"assembling failed ({type(error).__name__}: {error})"
        return BadRecord(path, record, problem, "report it with this file and record")
