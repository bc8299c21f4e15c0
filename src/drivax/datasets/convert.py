"""Public data set -> scenario set: files are read and assembled in worker processes, written by one.

The result does not depend on the number of workers, nor on how often the conversion was killed and begun again: files
are taken in the order of their paths, records in file order, and a closed shard of the set is never touched again.
Nothing here imports JAX, so that workers start in a fraction of a second; an audit that needs it is handed in.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from importlib import metadata
from itertools import islice
from pathlib import Path
from typing import Any

from drivax.datasets.conversion import Conversion, convert_file
from drivax.datasets.estimate import Estimate, estimate
from drivax.datasets.formats import Survey, survey
from drivax.datasets.reader import BadRecord
from drivax.datasets.spool import converted_ahead
from drivax.errors import DataError
from drivax.scenario.schema import CAPACITIES, SCHEMA_VERSION, Scenario
from drivax.scenario.select.selection import Selection
from drivax.scenario.store import ScenarioWriter, manifest_entry

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
        found: The files.
        estimate: How large the set will be.
        written: How many scenarios an earlier, interrupted conversion has written already.
    """

    found: Survey
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
        UsageError: Options that cannot be meant, ``out`` exists, is being written, or was begun with other options, or
            a package that the format needs is missing.
        DataError: ``src`` holds nothing that can be converted, the disk is too small, or with ``strict`` a record
            cannot be read.
    """
    options = options or Conversion()
    options.check()
    begin = time.monotonic()
    found = survey(src, options.format)
    capacity = CAPACITIES[options.capacity]
    with ScenarioWriter(
        out, capacity, _source(found, options), options.shard_size, options.overwrite, options.shares,
        _identity(found, options, audited=audit is not None),
    ) as writer:  # fmt: skip
        written = len(writer)
        sink = _Sink(writer, found, options, audit)
        expected = estimate(found, Path(out), capacity, options.stride, options.limit)
        if announce is not None:
            announce(Plan(found, expected, written))
        if not options.filters:  # with them nobody knows how many will be left
            expected.check(Path(out), written)
        done = _drain(found, options, sink, writer, progress)
        if not len(writer):
            raise _nothing(found, sink)
        writer.source |= sink.left_out()
    seconds = time.monotonic() - begin
    return Converted(
        Path(out), len(writer), written, done, found.ignored, dict(found.formats), tuple(sink.skipped),
        sink.filtered, seconds,
    )  # fmt: skip


def _source(found: Survey, options: Conversion) -> dict[str, Any]:
    """Where the set comes from, for its manifest."""
    return {
        "command": "convert",
        "format": options.format,
        "folder": found.root.name,
        "files": len(found.inputs),
        "formats": dict(sorted(found.formats.items())),
        **{name: getattr(options, name) for name in ("limit", "filters", "routes", "stride", "split")},
    }


def _identity(found: Survey, options: Conversion, audited: bool) -> dict[str, Any]:
    """All that the bytes of the set depend on; only a conversion with the same may continue another."""
    digest = hashlib.sha256()
    for one in found.inputs:
        digest.update(f"{found.relative(one.path)}\t{one.path.stat().st_size}\t{one.format}\n".encode())
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
        self, writer: ScenarioWriter, found: Survey, options: Conversion, audit: Audit | None
    ) -> None:
        self._writer = writer
        self._found = found
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
            self.skipped += [_bad_record(found, row) for row in note["skipped"]]
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
        rows = [_row(self._found, bad) for bad in self.skipped]
        for row in rows:
            del row["cure"]
        return {"skipped": len(rows), "skipped_records": rows, "filtered": self.filtered}

    def _batch_size(self) -> int:
        if self._audit is None:
            return 1
        if self._options.filters:  # nobody knows how many of them will be kept
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
                    path = self._found.inputs[file].path
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
        rows = [_row(self._found, bad) for bad in new]
        return {"place": place, "filtered": self.filtered, "skipped": rows}

    def _skip(self, bad: BadRecord) -> None:
        if self._options.strict:
            raise bad.error()
        self.skipped.append(bad)


def _row(found: Survey, bad: BadRecord) -> dict[str, Any]:
    """A bad record as JSON values."""
    return {"file": found.relative(bad.file), "record": bad.record, "problem": bad.problem, "cure": bad.cure}


def _bad_record(found: Survey, row: dict[str, Any]) -> BadRecord:
    file = found.root / row["file"] if found.root.is_dir() else found.root.with_name(row["file"])
    return BadRecord(file, row["record"], row["problem"], row["cure"])


def _drain(
    found: Survey, options: Conversion, sink: _Sink, writer: ScenarioWriter, progress: Progress | None
) -> int:
    """Moves results into the sink until they or the limit end; returns the number of files read."""
    report = progress or (lambda done, total, scenarios: None)
    first, skip = sink.place
    total = len(found.inputs)
    with closing(_results(found, options, first, writer.folder)) as results:
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
    found: Survey, options: Conversion, first: int, folder: Path
) -> Generator[Iterator[Scenario | BadRecord], None, None]:
    """Scenarios and bad records of every file from number ``first`` on."""
    tasks = [
        (one.path, replace(options, format=one.format or options.format)) for one in found.inputs[first:]
    ]
    if options.workers == 1 or len(tasks) <= 1:
        yield from (convert_file(*task) for task in tasks)
        return
    yield from converted_ahead(tasks, convert_file, CAPACITIES[options.capacity], options.workers, folder)


def _nothing(found: Survey, sink: _Sink) -> DataError:
    if sink.filtered:
        problem = f"none of the {sink.filtered} scenarios satisfies the filters"
        return DataError(problem, file=found.root, cure="use wider filters")
    if not sink.skipped:
        return DataError("holds no recording", file=found.root, cure="look at it with drivax doctor")
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
