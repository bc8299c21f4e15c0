"""Scenario sets on disk: shards of fixed-size records, a checksum per record, and a manifest.

A set is a folder::

    manifest.json        schema version, capacity, field table, shards, one entry per scenario
    shard-00000.npy      one-dimensional structured array of ``schema.record_dtype(capacity)``
    shard-00000.crc.npy  uint32, ``zlib.crc32`` of every record
    seal.json            SHA-256 of the manifest (``drivax.seal``)
    splits/              optional: lists for training, validation and test (``scenario.select.splits``)
    scores.npz           optional: criticality scores by which scenarios were selected (``curation.scores``)

``numpy.load(path, mmap_mode="r")`` reads a shard; a record lies at a fixed offset, so a scenario is one range read. A
set appears under its name only when it is complete. This module needs no JAX.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import mmap
import threading
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, reduce
from importlib import metadata
from io import BufferedIOBase
from itertools import chain
from pathlib import Path
from typing import IO, Any, Self

import numpy as np

from drivax.errors import DataError, UsageError
from drivax.files import (
    FullDiskError,
    PartialFolder,
    allow_open_files,
    check_output,
    check_space,
    explain_full_disk,
    file_digest,
    remove,
    restore_folder,
    sync_and_close,
    write_json,
)
from drivax.reading import DAMAGE, explain_damage, read_array_header
from drivax.scenario.bank.sizes import Sizes
from drivax.scenario.manifest import (
    AGAIN,
    MANIFEST,
    check_entries,
    crc_name,
    field_table,
    manifest_entry,
    plain,
    read_manifest,
    shard_name,
)
from drivax.scenario.schema import (
    NAMES,
    SCHEMA_VERSION,
    Capacity,
    Scenario,
    SourceCounts,
    find_impossible,
    record_dtype,
    stored_name,
)
from drivax.scenario.select.splits import Shares, write_splits
from drivax.seal import seal

#: Bytes at the beginning of a record that hold its names.
_PAGE = 4096
#: Scenarios that an iteration reads at a time, and that a thread reads in one task.
_BATCH, _PART = 64, 8
#: Held while a shard is mapped, so that threads map it only once.
_MAP_LOCK = threading.Lock()
_Bytes = np.ndarray[Any, Any]


def check_set_space(path: str | Path, capacity: Capacity, scenarios: int) -> None:
    """Raise a DataError if the disk has no space for a set of that many scenarios."""
    check_space(Path(path), scenarios * record_dtype(capacity).itemsize)


class ScenarioWriter:
    """Write a scenario set; it appears as ``path`` when the ``with`` block ends without an exception.

    Args:
        path: Folder to create.
        capacity: Padded sizes of all scenarios.
        source: Origin of the scenarios, as JSON values; callers may add to :attr:`source` until the block ends.
        shard_size: Records per shard.
        overwrite: Replace an existing scenario set; other folders are never replaced.
        shares: Percentages of train, validation and test for the files of ``splits/``; None writes no files.
        identity: Description of the content, for a set that can be resumed: closed shards survive an exception or a
            kill, and the next writer with the same identity continues after the intact ones (:attr:`notes`).
        further: Writes additional files into the complete folder before it is published.

    Raises:
        UsageError: ``path`` exists, another process writes it, a scenario has another capacity, or ``shard_size`` is
            below 1.
        DataError: A scenario of this data set and id is in the set already, no scenario was added, or the disk is full.
    """

    def __init__(
        self, path: str | Path, capacity: Capacity, source: Mapping[str, Any] | None = None,
        shard_size: int = 512, overwrite: bool = False, shares: Shares | None = None,
        identity: Mapping[str, Any] | None = None, further: Callable[[Path], None] | None = None,
    ) -> None:  # fmt: skip
        if shard_size < 1:
            raise UsageError(f"shard_size is {shard_size}", cure="use 1 or more")
        self.path, self.capacity, self.overwrite = Path(path), capacity, overwrite
        self._refuse_existing()
        self.source: dict[str, Any] = plain(dict(source or {}))
        #: Notes given to :meth:`add` with the last scenario of every shard that an earlier writer closed.
        self.notes: list[Any] = []
        self._shard_size, self._shares, self._further = shard_size, shares, further
        self._buffer = np.zeros(1, record_dtype(capacity))
        self._entries: list[dict[str, Any]] = []
        self._known: set[tuple[str, str]] = set()
        self._shards: list[dict[str, Any]] = []
        #: Sizes of the records of the open shard.
        self._sizes: Sizes | None = None
        self._crcs: list[int] = []
        self._file: IO[bytes] | None = None
        self._partial = PartialFolder(self.path, identity)

    def __enter__(self) -> Self:
        check_set_space(self.path, self.capacity, 1)
        with explain_full_disk(self.path):
            summaries = self._partial.open(restart=self.overwrite)
        for summary in summaries:
            if not self._is_finished(summary):  # This shard and all later ones are written again.
                break
            self._shards.append(summary["shard"])
            self._entries += summary["scenarios"]
            self.notes.append(summary.get("note"))
        self._known = {_key(entry) for entry in self._entries}
        names = {name for shard in self._shards for name in (shard["file"], crc_name(shard["file"]))}
        for entry in self._partial.content.iterdir():  # Remove unfinished shards and files.
            if entry.name not in names:
                remove(entry)
        return self

    def _is_finished(self, summary: Mapping[str, Any]) -> bool:
        """Return whether a closed shard is undamaged and full; a last shard of fewer records is written again."""
        with contextlib.suppress(DataError, *DAMAGE):
            shard, entries = summary["shard"], summary["scenarios"]
            check_entries([*self._shards, shard], entries)
            if shard["count"] == len(entries) == self._shard_size:
                Shard(self._partial.content, shard, self._buffer.dtype, entries).check_digest()
                return True
        return False

    @property
    def folder(self) -> Path:
        """The hidden folder that holds the set and temporary files until it is complete."""
        return self._partial.root

    @property
    def room(self) -> int:
        """Number of scenarios that still fit into the current shard."""
        return self._shard_size - len(self._crcs)

    def __len__(self) -> int:
        return len(self._entries)

    def __contains__(self, key: object) -> bool:
        """Return whether a scenario is in the set, by its (dataset, scenario id)."""
        return key in self._known

    def add(self, scenario: Scenario, note: Any = None) -> None:
        """Append a scenario; a later writer finds ``note`` in :attr:`notes` if the scenario fills its shard."""
        if scenario.capacity != self.capacity:
            problem = f"capacity is {scenario.capacity.name!r}, the set's is {self.capacity.name!r}"
            cure = "assemble it with the capacity of the set"
            raise UsageError(problem, file=self.path, record=scenario.id, cure=cure)
        entry = manifest_entry(scenario)
        key = _key(entry)
        if key in self._known:
            problem = f"a scenario {key[1]!r} of {key[0]!r} is in the set already"
            raise DataError(problem, file=self.path, record=len(self), cure="give each file once")
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
        record = self._buffer.reshape(())
        if find_impossible(record) is None:  # others are refused when they are read
            sizes = Sizes.of_record(self.capacity, record)
            self._sizes = sizes if self._sizes is None else self._sizes.join(sizes)
        if self._file is None:
            self._file = (self._partial.content / shard_name(len(self._shards))).open("wb")
            write_header(self._file, self._buffer.dtype, 0)
        self._file.write(data)
        self._crcs.append(zlib.crc32(data))

    def _close_shard(self, note: Any) -> None:
        """Complete the open shard, if any: header, checksums, and a note for a writer that resumes the set."""
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
        shard = {"file": name, "count": count, "sha256": file_digest(folder / name)}
        shard["crc_sha256"] = file_digest(folder / crc_name(name))
        if self._sizes is not None:
            shard["sizes"] = dataclasses.asdict(self._sizes)
        summary = {"shard": shard, "note": note, "scenarios": self._entries[-count:]}
        self._partial.note(len(self._shards), summary)
        self._shards.append(shard)
        self._crcs, self._sizes = [], None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        try:
            with explain_full_disk(self.path, self._buffer.dtype.itemsize):
                # Raise an error of the body again, so that a full disk is reported with the path of the set.
                if isinstance(error, OSError | FullDiskError):
                    raise error
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
        }
        if self._shares is not None:
            write_splits(self._partial.content, self._entries, self._shares)
        write_json(self._partial.content / MANIFEST, manifest | {"scenarios": self._entries})
        seal(self._partial.content, MANIFEST)
        if self._further is not None:
            self._further(self._partial.content)
        self._refuse_existing()  # Another process may have written the set in the meantime.
        self._partial.publish()

    def _refuse_existing(self) -> None:
        """Refuse a path that exists, except an empty folder, or a scenario set if it may be overwritten."""
        path = self.path
        restore_folder(path)
        if path.is_dir() and not any(path.iterdir()):
            return
        if path.exists() and not (path / MANIFEST).is_file():
            raise UsageError("exists and is not a scenario set", file=path, cure="choose another name")
        check_output(path, self.overwrite, folder=True)


class ScenarioSet(Sequence[Scenario]):
    """A memory-mapped scenario set; with ``verify`` the checksum of a record is tested when it is first read.

    ``entries`` holds the manifest entry of every scenario (:func:`manifest_entry`).
    """

    def __init__(self, path: str | Path, manifest: dict[str, Any], verify: bool = True) -> None:
        self.path, self.manifest, self.verify = Path(path), manifest, verify
        self.capacity = Capacity(**manifest["capacity"])
        self.entries: list[dict[str, Any]] = manifest["scenarios"]
        self._dtype = record_dtype(self.capacity)
        self._starts = np.cumsum([0, *(shard["count"] for shard in manifest["shards"])])
        self._shards = [
            Shard(self.path, shard, self._dtype, self.entries[start : start + shard["count"]])
            for shard, start in zip(manifest["shards"], self._starts, strict=False)
        ]

    @classmethod
    def open(cls, path: str | Path, verify: bool = True) -> ScenarioSet:
        """Open a set.

        The manifest and the checksum files are compared with their digests (sets of earlier versions have none), and
        the names in the first and the last record of each shard with their entries; no record is read as a whole.

        Raises:
            DataError: The manifest or a shard is damaged, or belongs to another set or to another place in this one.
            UsageError: The system allows fewer open files than the set has shards.
        """
        result = cls(path, read_manifest(Path(path)), verify)
        if len(result) != int(result._starts[-1]):
            problem = f"lists {len(result)} scenarios but its shards contain {result._starts[-1]}"
            raise DataError(problem, file=result.path / MANIFEST, cure=AGAIN)
        for shard in result._shards:
            shard.check_files()
        allow_open_files(result.path, len(result._shards))  # each memory map keeps a file open
        return result

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[Scenario]:
        for first in range(0, len(self), _BATCH):
            yield from self[first : first + _BATCH]

    def take(self, indices: Iterable[int]) -> list[Scenario]:
        """Return scenarios by index; threads test the checksums of those that were not read before."""
        numbers = list(indices)
        if not self.verify:
            return [self[number] for number in numbers]
        tasks = [numbers[first : first + _PART] for first in range(0, len(numbers), _PART)]
        with ThreadPoolExecutor() as pool:  # zlib releases the lock of the interpreter
            return list(chain.from_iterable(pool.map(lambda task: [self[number] for number in task], tasks)))

    def __getitem__(self, index: Any) -> Any:
        """Return a scenario (a view of the file), or a list for a slice."""
        if isinstance(index, slice):
            return self.take(range(*index.indices(len(self))))
        if not -len(self) <= index < len(self):
            raise IndexError(f"scenario {index} of {len(self)}")
        number = int(index) % len(self)
        entry = self.entries[number]
        shard = int(np.searchsorted(self._starts, number, side="right")) - 1
        data = self._shards[shard].record(number - int(self._starts[shard]), self.verify)
        mappings = {name: dict(entry[name]) for name in ("overflow", "audit", "tags")}
        record = data.view(self._dtype).reshape(())
        names = {name: str(entry[name]) for name in NAMES}
        return Scenario(record, self.capacity, SourceCounts(**entry["source"]), **mappings, names=names)

    def __reduce__(self) -> tuple[Any, ...]:
        return ScenarioSet.open, (self.path, self.verify)  # Each process maps the files itself.

    @cached_property
    def sizes(self) -> Sizes:
        """Sizes that a bank of any of the scenarios fits, from the manifest; older sets are read for them."""
        shards = self.manifest["shards"]
        if all("sizes" in shard for shard in shards):
            return reduce(Sizes.join, (Sizes(**shard["sizes"]) for shard in shards))
        return Sizes.used(iter(ScenarioSet(self.path, self.manifest, verify=False)))

    @property
    def hash(self) -> str:
        """SHA-256 (hex) of the digests of all shards; it does not cover the entries of the manifest (tags, audit)."""
        digests = "".join(shard["sha256"] for shard in self.manifest["shards"])
        return hashlib.sha256(digests.encode()).hexdigest()

    def records(self, indices: Any, out: _Bytes | None = None) -> _Bytes:
        """Copy records into a structured array ``[n]``, in the order of ``indices``; negative ones count from the end.

        ``out`` is the result of an earlier call with as many indices; filling it again is twice as fast as new memory.
        """
        index = np.asarray(indices, np.int64).reshape(-1)
        total = len(self)
        if index.size and (index.min() < -total or index.max() >= total):
            raise IndexError(f"scenario indices must be in [-{total}, {total})")
        index = np.where(index < 0, index + total, index)
        if out is None:
            out = np.empty(index.size, self._dtype)
        if out.shape != index.shape or out.dtype != self._dtype or not out.flags.c_contiguous:
            problem = "out does not have the size and type of the records"
            raise UsageError(problem, file=self.path, cure="leave it out")
        data = out.view(np.uint8).reshape(index.size, self._dtype.itemsize)
        shards = np.searchsorted(self._starts, index, side="right") - 1
        # Copy each record right after the test that brought it into the cache; np.take is slower.
        for row, (shard, number) in enumerate(zip(shards.tolist(), index.tolist(), strict=True)):
            data[row] = self._shards[shard].record(number - int(self._starts[shard]), self.verify)
        return out

    def release(self) -> None:
        """Unload what was read from the files, so that a pass through a large set takes little memory."""
        for shard in self._shards:
            shard.release()

    def check(self) -> None:
        """Test the CRC of every record and the SHA-256 of every shard.

        Raises:
            DataError: One of them differs.
        """
        for shard in self._shards:
            for row in range(shard.count):
                shard.record(row, verify=True)
            shard.check_digest()


class Subset(Sequence[Scenario]):
    """Some scenarios of a set, by their indices, read when they are used."""

    def __init__(self, data: ScenarioSet, indices: Sequence[int]) -> None:
        self.data, self.indices = data, indices

    @property
    def entries(self) -> list[dict[str, Any]]:
        """Manifest entries of the scenarios."""
        return [self.data.entries[index] for index in self.indices]

    @property
    def sizes(self) -> Sizes:
        """Sizes that a bank of any scenario of the set fits."""
        return self.data.sizes

    def __len__(self) -> int:
        return len(self.indices)

    def __iter__(self) -> Iterator[Scenario]:
        for first in range(0, len(self), _BATCH):
            yield from self[first : first + _BATCH]

    def __getitem__(self, index: Any) -> Any:
        """Return a scenario, or a list for a slice."""
        return (
            self.data.take(self.indices[index])
            if isinstance(index, slice)
            else self.data[self.indices[index]]
        )

    def take(self, rows: Iterable[int]) -> list[Scenario]:
        """Return scenarios by their numbers in this subset, as :meth:`ScenarioSet.take`."""
        return self.data.take(self.indices[row] for row in rows)

    def release(self) -> None:
        """Unload what was read: :meth:`ScenarioSet.release`."""
        self.data.release()


def check_lengths(first: ScenarioSet, *others: ScenarioSet) -> None:
    """Refuse sets whose scenarios have room for different numbers of steps."""
    for other in others:
        if other.capacity.steps != first.capacity.steps:
            problem = f"has scenarios of {other.capacity.steps} steps, {first.path} of {first.capacity.steps}"
            raise UsageError(problem, file=other.path, cure="convert both with one --future-s")


class Shard:
    """A shard file: expected layout, memory map, and a mask of the records that passed their checksum.

    ``entry`` is the shard's entry in the manifest, ``scenarios`` are those of its records.
    """

    def __init__(
        self, folder: Path, entry: Mapping[str, Any], dtype: np.dtype[Any], scenarios: Sequence[Mapping[str, Any]]
    ) -> None:  # fmt: skip
        self.path = folder / entry["file"]
        self.crc_path = folder / crc_name(entry["file"])
        self.count = int(entry["count"])
        self._entry, self._scenarios, self._dtype = entry, scenarios, dtype
        self._data: _Bytes | None = None
        self._memory: mmap.mmap | None = None
        self._crcs = np.zeros(0, np.uint32)
        self._intact = np.zeros(self.count, bool)

    def check_files(self) -> int:
        """Test presence, layout, size, checksum file and ids; return the offset of the first record."""
        for path in (self.path, self.crc_path):
            if not path.is_file():
                raise DataError("shard is missing", file=path, cure=f"restore the file or {AGAIN}")
        if self.crc_path.stat().st_size > _PAGE + 4 * self.count:  # A header is shorter than a page.
            raise self._checksum_file_error()
        self._check_file("crc_sha256")
        with self.path.open("rb") as file:
            shape, dtype = read_header(file, self.path)
            offset = file.tell()
            self._check_layout(shape, dtype, offset)
            for row in {0, self.count - 1} if self.count else ():  # a half-copied file may end in zeros
                file.seek(offset + row * self._dtype.itemsize)
                self._check_names(row, np.frombuffer(file.read(_PAGE), np.uint8))
        return offset

    def _check_layout(self, shape: tuple[int, ...], dtype: np.dtype[Any], offset: int) -> None:
        if shape != (self.count,) or dtype != self._dtype:
            raise DataError("shard does not have the layout its manifest names", file=self.path, cure=AGAIN)
        size = self.path.stat().st_size
        if size != offset + self.count * self._dtype.itemsize:
            records = max(0, size - offset) // self._dtype.itemsize
            problem = f"shard is truncated or has trailing bytes: {records} whole records of {self.count}"
            raise self._damage_error(problem, min(records, self.count))

    def _check_names(self, row: int, data: _Bytes) -> None:
        """Compare the names at the beginning of a record with its entry in the manifest."""
        fields = self._dtype.fields or {}
        for name in NAMES:
            size, begin = fields[name][0].itemsize, fields[name][1]
            expected = str(self._scenarios[row][name])
            if data[begin : begin + size].tobytes().rstrip(b"\0") != stored_name(expected, size):
                problem = f"{name} is not {expected!r}, that of the manifest: half copied, or another shard"
                raise self._damage_error(problem, row)

    def record(self, row: int, verify: bool) -> _Bytes:
        """Return a view of the bytes of a record; with ``verify``, test its checksum at first use."""
        data = self._map() if self._data is None else self._data
        if not self._intact[row]:
            if verify and zlib.crc32(data[row].data) != int(self._crcs[row]):
                raise self._damage_error("checksum mismatch, the record is damaged", row)
            self._check_names(row, data[row])
            if problem := find_impossible(data[row].view(self._dtype)[0]):
                raise self._damage_error(problem, row)
            self._intact[row] = verify
        return data[row]

    def check_digest(self) -> None:
        """Test the files as :meth:`check_files` does, and the SHA-256 of all records."""
        self.check_files()
        self._check_file("sha256")

    def _check_file(self, key: str) -> None:
        """Compare a file's SHA-256 with the manifest's; sets of earlier versions have none for checksum files."""
        path = self.crc_path if key == "crc_sha256" else self.path
        if self._entry.get(key) not in (None, file_digest(path)):
            problem = "SHA-256 differs from the manifest's: damaged, or of another set"
            raise DataError(problem, file=path, cure=f"copy the whole set again or {AGAIN}")

    def _map(self) -> _Bytes:
        with _MAP_LOCK:
            return self._read_map() if self._data is None else self._data

    def _read_map(self) -> _Bytes:
        offset = self.check_files()
        with self.crc_path.open("rb") as file:
            shape, dtype = read_header(file, self.crc_path)
            crcs = file.read()
        if shape != (self.count,) or dtype != np.uint32 or len(crcs) != 4 * self.count:
            raise self._checksum_file_error()
        self._crcs = np.frombuffer(crcs, np.uint32)
        with self.path.open("rb") as file:
            self._memory = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        data = np.frombuffer(self._memory, np.uint8, self.count * self._dtype.itemsize, offset)
        # A plain view: indexing a memmap costs Python time. Set last, since several threads may read.
        self._data = data.reshape(self.count, self._dtype.itemsize)
        return self._data

    def release(self) -> None:
        """Unload the pages that were read; they are read again when they are used."""
        if self._memory is not None:
            self._memory.madvise(mmap.MADV_DONTNEED)

    def _checksum_file_error(self) -> DataError:
        return DataError("checksum file does not fit its shard", file=self.crc_path, cure=AGAIN)

    def _damage_error(self, problem: str, record: int) -> DataError:
        return DataError(problem, file=self.path, record=record, cure=f"copy the file again or {AGAIN}")


def _key(entry: Mapping[str, Any]) -> tuple[str, str]:
    return entry["dataset"], entry["scenario_id"]


def write_header(file: IO[bytes], dtype: np.dtype[Any], count: int) -> None:
    """Write the ``.npy`` header of ``count`` records; its length does not depend on ``count``."""
    # numpy pads headers so that a growing first axis never changes their length (numpy.lib.format).
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": (count,)}
    np.lib.format.write_array_header_1_0(file, header)


def read_header(file: BufferedIOBase, path: Path) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Read shape and dtype of a ``.npy`` file, up to the first byte of data."""
    with explain_damage(path, AGAIN, "header is damaged, not a .npy shard"):
        shape, _, dtype = read_array_header(file)
        return shape, dtype
