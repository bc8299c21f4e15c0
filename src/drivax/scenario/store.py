"""Scenario sets on disk: shards of fixed-size records, a checksum per record, and a manifest.

A set is a folder::

    manifest.json        schema version, capacity, field table, shards, one entry per scenario
    shard-00000.npy      one-dimensional structured array of ``schema.record_dtype(capacity)``
    shard-00000.crc.npy  uint32, ``zlib.crc32`` of every record
    splits/              lists for training, validation and test, if asked for (``scenario.select.splits``)
    scores.npz           criticality of its scenarios, if they were chosen by it (``curation.subset``)

Any tool reads a shard with ``numpy.load(path, mmap_mode="r")``; record ``i`` lies at a fixed offset, so one
scenario is one range read. Sets appear under their name only when they are complete. Numpy only, so that
worker processes never import JAX.
"""

from __future__ import annotations

import dataclasses
import hashlib
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np

from drivax.errors import DataError, UsageError
from drivax.files import PartialFolder, sync_and_close, write_json
from drivax.scenario.manifest import (
    AGAIN,
    MANIFEST,
    Shard,
    crc_name,
    field_table,
    manifest_entry,
    plain,
    read_manifest,
    shard_name,
    write_header,
)
from drivax.scenario.schema import SCHEMA_VERSION, Capacity, Scenario, SourceCounts, record_dtype
from drivax.scenario.select.splits import Shares, write_splits


class ScenarioWriter:
    """Writes a scenario set; it appears under ``path`` when the ``with`` block ends without an exception.

    Args:
        path: Folder to create.
        capacity: Padded sizes that all scenarios of the set share.
        source: Where the scenarios come from, as plain JSON values; may be completed until the block ends.
        shard_size: Records per shard.
        overwrite: Replace an existing scenario set; other folders are never replaced.
        shares: Percentages of train, validation and test for the files of ``splits/``; None: no such files.
        identity: What is written, for a set that can be continued: closed shards outlive an exception or a kill, and
            the next writer with the same identity begins after them (:attr:`notes`).
        further: Called with the folder of the whole set before it gets its name, to write what else it shall hold.

    Raises:
        UsageError: ``path`` exists, another process writes it, or a scenario has another capacity.
        DataError: A scenario's id is in the set already, or no scenario was added.
    """

    def __init__(
        self,
        path: str | Path,
        capacity: Capacity,
        source: Mapping[str, Any] | None = None,
        shard_size: int = 512,
        overwrite: bool = False,
        shares: Shares | None = None,
        identity: Mapping[str, Any] | None = None,
        further: Callable[[Path], None] | None = None,
    ) -> None:
        if shard_size < 1:
            raise UsageError(f"shard_size is {shard_size}", cure="use 1 or more")
        self.path = Path(path)
        self.capacity = capacity
        self.overwrite = overwrite
        self._refuse_existing()
        self.source: dict[str, Any] = plain(dict(source or {}))
        #: What :meth:`add` was told with the last scenario of every shard that an earlier writer closed.
        self.notes: list[Any] = []
        self._shard_size = shard_size
        self._shares = shares
        self._further = further
        self._buffer = np.zeros(1, record_dtype(capacity))
        self._entries: list[dict[str, Any]] = []
        self._known: set[tuple[str, str]] = set()
        self._shards: list[dict[str, Any]] = []
        self._crcs: list[int] = []
        self._file: IO[bytes] | None = None
        self._partial = PartialFolder(self.path, identity)

    def __enter__(self) -> Self:
        for part in self._partial.open(anew=self.overwrite):
            if (
                part["shard"]["count"] < self._shard_size
            ):  # closed by the end of the data: that end comes again
                break
            self._shards.append(part["shard"])
            self._entries += part["scenarios"]
            self.notes.append(part["note"])
        self._known = {_key(entry) for entry in self._entries}
        names = {name for shard in self._shards for name in (shard["file"], crc_name(shard["file"]))}
        for left in self._partial.content.iterdir():  # of a shard that was never closed
            if left.name not in names:
                shutil.rmtree(left) if left.is_dir() else left.unlink()
        return self

    @property
    def folder(self) -> Path:
        """Where the set is being made; for files that are needed until it is complete."""
        return self._partial.root

    @property
    def room(self) -> int:
        """How many more scenarios the current shard holds."""
        return self._shard_size - len(self._crcs)

    def __len__(self) -> int:
        return len(self._entries)

    def __contains__(self, key: object) -> bool:
        """Whether a scenario is in the set, by its (dataset, scenario id)."""
        return key in self._known

    def add(self, scenario: Scenario, note: Any = None) -> None:
        """Append one scenario.

        Args:
            scenario: What to append.
            note: What :attr:`notes` shall tell a later writer if this scenario fills its shard, as JSON values.
        """
        if scenario.capacity != self.capacity:
            raise UsageError(
                f"capacity is {scenario.capacity.name!r}, the set's is {self.capacity.name!r}",
                file=self.path,
                record=scenario.id,
                cure="assemble it with the capacity of the set",
            )
        entry = manifest_entry(scenario)
        key = _key(entry)
        if key in self._known:
            raise DataError(
                f"a scenario {key[1]!r} of {key[0]!r} is in the set already",
                file=self.path,
                record=len(self._entries),
                cure="give each file once",
            )
        self._write_record(scenario)
        self._known.add(key)
        self._entries.append(entry)
        if self.room == 0:
            self._close_shard(note)

    def _write_record(self, scenario: Scenario) -> None:
        # Field by field into a zeroed buffer: the bytes between fields stay zero, so sets are reproducible.
        for name in self._buffer.dtype.names or ():
            self._buffer[name][0] = scenario.record[name]
        data = self._buffer.tobytes()
        if self._file is None:
            self._file = (self._partial.content / shard_name(len(self._shards))).open("wb")
            write_header(self._file, self._buffer.dtype, 0)
        self._file.write(data)
        self._crcs.append(zlib.crc32(data))

    def _close_shard(self, note: Any) -> None:
        if self._file is None:
            return
        folder, name, count = self._partial.content, shard_name(len(self._shards)), len(self._crcs)
        self._file.seek(0)
        write_header(self._file, self._buffer.dtype, count)
        sync_and_close(self._file)
        self._file = None
        with (folder / crc_name(name)).open("wb") as file:
            np.save(file, np.array(self._crcs, np.uint32))
            sync_and_close(file)
        with (folder / name).open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        shard = {"file": name, "count": count, "sha256": digest}
        self._partial.note(
            len(self._shards), {"shard": shard, "note": note, "scenarios": self._entries[-count:]}
        )
        self._shards.append(shard)
        self._crcs = []

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            if self._file is not None:
                self._file.close()
            self._partial.close()

    def _finish(self) -> None:
        if not self._entries:
            raise DataError("no scenario to write", file=self.path, cure="check what was skipped and why")
        self._close_shard(None)
        manifest = {
            "schema_version": SCHEMA_VERSION,
            "drivax_version": metadata.version("drivax"),
            "capacity": dataclasses.asdict(self.capacity),
            "fields": field_table(self.capacity),
            "record_bytes": self._buffer.dtype.itemsize,
            "source": plain(self.source),
            "shards": self._shards,
            "scenarios": self._entries,
        }
        if self._shares is not None:
            write_splits(self._partial.content, self._entries, self._shares)
        write_json(self._partial.content / MANIFEST, manifest)
        if self._further is not None:
            self._further(self._partial.content)
        self._refuse_existing()  # someone may have written it in the meantime
        self._partial.publish()

    def _refuse_existing(self) -> None:
        path = self.path
        if not path.exists() and not path.is_symlink():
            return
        if path.is_dir() and not any(path.iterdir()):
            return
        if not (path / MANIFEST).is_file():
            raise UsageError("exists and is not a scenario set", file=path, cure="choose another name")
        if not self.overwrite:
            raise UsageError("exists already", file=path, cure="choose another name or pass --overwrite")


class ScenarioSet(Sequence[Scenario]):
    """A scenario set opened for reading: memory-mapped, every record's checksum tested when first touched.

    Attributes:
        path: The folder.
        capacity: Padded sizes of all records.
        entries: The manifest's entry of every scenario (see :func:`manifest_entry`).
        manifest: The whole manifest.
        verify: Whether checksums are tested.
    """

    def __init__(self, path: str | Path, manifest: dict[str, Any], verify: bool = True) -> None:
        self.path = Path(path)
        self.manifest = manifest
        self.verify = verify
        self.capacity = Capacity(**manifest["capacity"])
        self.entries: list[dict[str, Any]] = manifest["scenarios"]
        self._dtype = record_dtype(self.capacity)
        self._shards = [Shard(self.path, shard, self._dtype) for shard in manifest["shards"]]
        self._starts = np.cumsum([0, *(shard.count for shard in self._shards)])

    @classmethod
    def open(cls, path: str | Path, verify: bool = True) -> ScenarioSet:
        """Open a set and check that it is whole (checksums follow when records are read).

        Raises:
            DataError: Manifest missing, damaged or of another version; a shard missing, cut short or laid out
                otherwise.
        """
        opened = cls(path, read_manifest(Path(path)), verify)
        if len(opened.entries) != int(opened._starts[-1]):
            raise DataError(
                f"lists {len(opened.entries)} scenarios but its shards hold {opened._starts[-1]}",
                file=opened.path / MANIFEST,
                cure=AGAIN,
            )
        for shard in opened._shards:
            shard.check_files()
        return opened

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: Any) -> Any:
        """One scenario (a view of the file), or a list of them for a slice."""
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        shard, row = self._locate(int(index))
        entry = self.entries[self._starts[shard] + row]
        record = self._shards[shard].record(row, self.verify)
        return Scenario(
            record=record.view(self._dtype).reshape(()),
            capacity=self.capacity,
            source=SourceCounts(**entry["source"]),
            overflow=dict(entry["overflow"]),
            audit=dict(entry["audit"]),
            tags=dict(entry["tags"]),
        )

    def __iter__(self) -> Iterator[Scenario]:
        return (self[index] for index in range(len(self)))

    def __reduce__(self) -> tuple[Any, ...]:
        return ScenarioSet.open, (self.path, self.verify)  # a worker maps the files itself

    @property
    def hash(self) -> str:
        """Identity of the data: SHA-256 (hex) over the checksums of the shards."""
        return hashlib.sha256(
            "".join(shard["sha256"] for shard in self.manifest["shards"]).encode()
        ).hexdigest()

    def records(self, indices: Any, out: np.ndarray[Any, Any] | None = None) -> np.ndarray[Any, Any]:
        """Copies of many records at once: structured array ``[n]``, in the order of ``indices``.

        Args:
            indices: Which; negative ones count from the end.
            out: Where to put them: what an earlier call of as many returned. A loader that reads batch after batch
                reads twice as fast into the same memory.

        Raises:
            IndexError: There is no such scenario.
            DataError: A record is damaged.
        """
        wanted = np.asarray(indices, np.int64).reshape(-1)
        total = len(self)
        if wanted.size and (wanted.min() < -total or wanted.max() >= total):
            raise IndexError(f"scenario indices must be in [-{total}, {total})")
        wanted = np.where(wanted < 0, wanted + total, wanted)
        if out is None:
            out = np.empty(wanted.size, self._dtype)
        if out.shape != wanted.shape or out.dtype != self._dtype or not out.flags.c_contiguous:
            raise UsageError(
                "out has not the size and type of the records", file=self.path, cure="leave it out"
            )
        data = out.view(np.uint8).reshape(wanted.size, self._dtype.itemsize)
        owner = np.searchsorted(self._starts, wanted, side="right") - 1
        # One contiguous copy each, right after the test that brought it into the cache; take() is slower.
        for place, (shard, index) in enumerate(zip(owner.tolist(), wanted.tolist(), strict=True)):
            data[place] = self._shards[shard].record(index - int(self._starts[shard]), self.verify)
        return out

    def check(self) -> None:
        """Read everything: every record's CRC and every shard's SHA-256.

        Raises:
            DataError: The first damaged record or shard.
        """
        for shard in self._shards:
            for row in range(shard.count):
                shard.record(row, verify=True)
            shard.check_digest()

    def _locate(self, index: int) -> tuple[int, int]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"scenario {index} of {len(self)}")
        index %= len(self)
        shard = int(np.searchsorted(self._starts, index, side="right")) - 1
        return shard, index - int(self._starts[shard])


def _key(entry: Mapping[str, Any]) -> tuple[str, str]:
    return entry["dataset"], entry["scenario_id"]
