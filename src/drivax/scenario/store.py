"""Scenario sets on disk: shards of fixed-size records, a checksum per record, and a manifest.

A set is a folder::

    manifest.json        schema version, capacity, field table, shards, one entry per scenario
    shard-00000.npy      one-dimensional structured array of ``schema.record_dtype(capacity)``
    shard-00000.crc.npy  uint32, ``zlib.crc32`` of every record

Any tool reads a shard with ``numpy.load(path, mmap_mode="r")``; record ``i`` lies at a fixed offset, so one
scenario is one range read. Sets appear under their name only when they are complete. Numpy only, so that
worker processes never import JAX.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
import zlib
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np

from drivax.errors import DataError, UsageError
from drivax.scenario.manifest import (
    AGAIN,
    MANIFEST,
    crc_name,
    field_table,
    manifest_entry,
    plain,
    read_header,
    read_manifest,
    shard_name,
    sync_and_close,
    sync_folder,
    write_header,
)
from drivax.scenario.schema import SCHEMA_VERSION, Capacity, Scenario, SourceCounts, record_dtype


class ScenarioWriter:
    """Writes a scenario set; it appears under ``path`` when the ``with`` block ends without an exception.

    Args:
        path: Folder to create.
        capacity: Padded sizes that all scenarios of the set share.
        source: Where the scenarios come from, as plain JSON values.
        shard_size: Records per shard.
        overwrite: Replace an existing scenario set; other folders are never replaced.

    Raises:
        UsageError: ``path`` exists, or a scenario has another capacity.
        DataError: A scenario's id is in the set already, or no scenario was added.
    """

    def __init__(
        self,
        path: str | Path,
        capacity: Capacity,
        source: Mapping[str, Any] | None = None,
        shard_size: int = 512,
        overwrite: bool = False,
    ) -> None:
        if shard_size < 1:
            raise UsageError(f"shard_size is {shard_size}", cure="use 1 or more")
        self.path = Path(path)
        self.capacity = capacity
        self.overwrite = overwrite
        self._refuse_existing()
        self._source = plain(dict(source or {}))
        self._shard_size = shard_size
        self._buffer = np.zeros(1, record_dtype(capacity))
        self._entries: list[dict[str, Any]] = []
        self._known: set[tuple[str, str]] = set()
        self._shards: list[dict[str, Any]] = []
        self._crcs: list[int] = []
        self._file: IO[bytes] | None = None
        self._folder = self.path.parent / f".{self.path.name}.partial-{os.getpid()}"

    def __enter__(self) -> Self:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir()
        return self

    def add(self, scenario: Scenario) -> None:
        """Append one scenario."""
        if scenario.capacity != self.capacity:
            raise UsageError(
                f"capacity is {scenario.capacity.name!r}, the set's is {self.capacity.name!r}",
                file=self.path,
                record=scenario.id,
                cure="assemble it with the capacity of the set",
            )
        entry = manifest_entry(scenario)
        key = (entry["dataset"], entry["scenario_id"])
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

    def _write_record(self, scenario: Scenario) -> None:
        # Field by field into a zeroed buffer: the bytes between fields stay zero, so sets are reproducible.
        for name in self._buffer.dtype.names or ():
            self._buffer[name][0] = scenario.record[name]
        data = self._buffer.tobytes()
        if self._file is None:
            self._file = (self._folder / shard_name(len(self._shards))).open("wb")
            write_header(self._file, self._buffer.dtype, 0)
        self._file.write(data)
        self._crcs.append(zlib.crc32(data))
        if len(self._crcs) == self._shard_size:
            self._close_shard()

    def _close_shard(self) -> None:
        if self._file is None:
            return
        name = shard_name(len(self._shards))
        self._file.seek(0)
        write_header(self._file, self._buffer.dtype, len(self._crcs))
        sync_and_close(self._file)
        self._file = None
        with (self._folder / crc_name(name)).open("wb") as file:
            np.save(file, np.array(self._crcs, np.uint32))
            sync_and_close(file)
        with (self._folder / name).open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        self._shards.append({"file": name, "count": len(self._crcs), "sha256": digest})
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
            shutil.rmtree(self._folder, ignore_errors=True)

    def _finish(self) -> None:
        self._close_shard()
        if not self._entries:
            raise DataError("no scenario to write", file=self.path, cure="check what was skipped and why")
        manifest = {
            "schema_version": SCHEMA_VERSION,
            "drivax_version": metadata.version("drivax"),
            "capacity": dataclasses.asdict(self.capacity),
            "fields": field_table(self.capacity),
            "record_bytes": self._buffer.dtype.itemsize,
            "source": self._source,
            "shards": self._shards,
            "scenarios": self._entries,
        }
        with (self._folder / MANIFEST).open("wb") as file:
            file.write(json.dumps(manifest, indent=1, allow_nan=False).encode())
            sync_and_close(file)
        self._publish()

    def _publish(self) -> None:
        sync_folder(self._folder)
        self._refuse_existing()  # someone may have written it in the meantime
        old = self.path.parent / f".{self.path.name}.old-{os.getpid()}"
        if self.path.exists():
            self.path.rename(old)
        self._folder.rename(self.path)
        sync_folder(self.path.parent)
        shutil.rmtree(old, ignore_errors=True)

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
        self._shards = [_Shard(self.path, shard, self._dtype) for shard in manifest["shards"]]
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
        record = self._shards[shard].rows([row], self.verify)[row]
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

    def records(self, indices: Any) -> np.ndarray[Any, Any]:
        """Copies of many records at once: structured array ``[n]``, in the order of ``indices``."""
        wanted = np.asarray(indices, np.int64).reshape(-1)
        total = len(self)
        if wanted.size and (wanted.min() < -total or wanted.max() >= total):
            raise IndexError(f"scenario indices must be in [-{total}, {total})")
        wanted = np.where(wanted < 0, wanted + total, wanted)
        out = np.empty((wanted.size, self._dtype.itemsize), np.uint8)
        owner = np.searchsorted(self._starts, wanted, side="right") - 1
        for number in np.unique(owner):
            places = np.flatnonzero(owner == number)
            rows = wanted[places] - self._starts[number]
            data = self._shards[number].rows(rows, self.verify)
            for place, row in zip(places, rows, strict=True):  # one contiguous copy each; take() is slower
                out[place] = data[row]
        return out.view(self._dtype).reshape(-1)

    def check(self) -> None:
        """Read everything: every record's CRC and every shard's SHA-256.

        Raises:
            DataError: The first damaged record or shard.
        """
        for shard in self._shards:
            shard.rows(range(shard.count), verify=True)
            shard.check_digest()

    def _locate(self, index: int) -> tuple[int, int]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"scenario {index} of {len(self)}")
        index %= len(self)
        shard = int(np.searchsorted(self._starts, index, side="right")) - 1
        return shard, index - int(self._starts[shard])


class _Shard:
    """One shard file: its expected layout, its memory map, and which records were found intact."""

    def __init__(self, folder: Path, entry: Mapping[str, Any], dtype: np.dtype[Any]) -> None:
        self.path = folder / entry["file"]
        self.crc_path = folder / crc_name(entry["file"])
        self.count = int(entry["count"])
        self._sha256 = entry["sha256"]
        self._dtype = dtype
        self._data: np.ndarray[Any, Any] | None = None
        self._crcs = np.zeros(0, np.uint32)
        self._intact = np.zeros(self.count, bool)

    def check_files(self) -> int:
        """Test presence, layout and size; returns the offset of the first record."""
        for path in (self.path, self.crc_path):
            if not path.is_file():
                raise DataError("shard is missing", file=path, cure=f"restore the file or {AGAIN}")
        with self.path.open("rb") as file:
            shape, dtype = read_header(file, self.path)
            offset = file.tell()
        if shape != (self.count,) or dtype != self._dtype:
            raise DataError("shard does not have the layout its manifest names", file=self.path, cure=AGAIN)
        size = self.path.stat().st_size
        if size != offset + self.count * self._dtype.itemsize:
            whole = max(0, size - offset) // self._dtype.itemsize
            raise DataError(
                f"shard is truncated or has trailing bytes: {whole} whole records of {self.count}",
                file=self.path,
                record=min(whole, self.count),
                cure=f"copy the file again or {AGAIN}",
            )
        return offset

    def rows(self, rows: Any, verify: bool) -> np.ndarray[Any, Any]:
        """The shard's records as bytes ``[count, itemsize]``, those in ``rows`` tested before."""
        data = self._map() if self._data is None else self._data
        if verify:
            for row in rows:
                if not self._intact[row]:
                    self._test(data, int(row))
        return data

    def check_digest(self) -> None:
        """Compare the file's SHA-256 with the manifest's."""
        with self.path.open("rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != self._sha256:
                raise DataError("SHA-256 differs from the manifest's", file=self.path, cure=AGAIN)

    def _map(self) -> np.ndarray[Any, Any]:
        offset = self.check_files()
        shape = (self.count, self._dtype.itemsize)
        # A plain view of the map: memmap's own indexing costs Python time per access.
        self._data = np.asarray(np.memmap(self.path, np.uint8, "r", offset, shape))
        with self.crc_path.open("rb") as file:
            shape, dtype = read_header(file, self.crc_path)
            crcs = file.read()
        if shape != (self.count,) or dtype != np.uint32 or len(crcs) != 4 * self.count:
            raise DataError("checksum file does not fit its shard", file=self.crc_path, cure=AGAIN)
        self._crcs = np.frombuffer(crcs, np.uint32)
        return self._data

    def _test(self, data: np.ndarray[Any, Any], row: int) -> None:
        if zlib.crc32(data[row].data) != int(self._crcs[row]):
            raise DataError(
                "checksum mismatch, the record is damaged",
                file=self.path,
                record=row,
                cure=f"copy the file again or {AGAIN}",
            )
        self._intact[row] = True
