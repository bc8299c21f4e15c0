"""The manifest of a scenario set and the layout of its files: what is written and what is refused."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from drivax.errors import DataError
from drivax.scenario.schema import (
    SCHEMA_VERSION,
    Capacity,
    Scenario,
    SourceCounts,
    record_dtype,
    scenario_fields,
)

MANIFEST = "manifest.json"
#: The cure for a set that cannot be repaired.
AGAIN = "convert or generate the set again"
_HEADER_LIMIT = 100_000


def field_table(capacity: Capacity) -> list[dict[str, Any]]:
    """The manifest's description of a record: name, dtype, shape and byte offset of every field."""
    offsets = {name: entry[1] for name, entry in (record_dtype(capacity).fields or {}).items()}
    return [
        {"name": name, "dtype": np.dtype(kind).str, "shape": list(shape), "offset": offsets[name]}
        for name, (kind, shape) in scenario_fields(capacity).items()
    ]


def manifest_entry(scenario: Scenario) -> dict[str, Any]:
    """What the manifest says about one scenario."""
    return {
        "scenario_id": scenario.id,
        "dataset": scenario.text("dataset"),
        "segment": scenario.text("segment"),
        "flags": [str(flag.name) for flag in scenario.has],
        "segments": int(scenario.record["segment_blocks"][3]),
        "source": plain(dataclasses.asdict(scenario.source)),
        "overflow": plain(scenario.overflow),
        "audit": plain(scenario.audit),
        "tags": plain(scenario.tags),
    }


def read_manifest(path: Path) -> dict[str, Any]:
    """The checked manifest of the set at ``path``.

    Raises:
        DataError: No such folder, no manifest, damaged JSON, a missing key, another schema version or layout.
    """
    file = path / MANIFEST
    if not path.is_dir():
        problem = "is not a scenario set (a folder)" if path.exists() else "does not exist"
        raise DataError(problem, file=path, cure="name the folder that drivax convert or generate wrote")
    if not file.is_file():
        raise DataError(
            "no manifest.json, so this is no complete scenario set",
            file=path,
            cure=f"if these are recordings, `drivax convert` makes a set of them; otherwise {AGAIN}",
        )
    try:
        manifest = json.loads(file.read_bytes())
        version = manifest["schema_version"]
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"manifest is damaged ({error})", file=file, cure=AGAIN) from error
    if version != SCHEMA_VERSION:
        newer = isinstance(version, int) and version > SCHEMA_VERSION
        raise DataError(
            f"schema version {version}, this drivax reads {SCHEMA_VERSION}",
            file=file,
            cure="upgrade drivax" if newer else AGAIN,
        )
    _check_manifest(manifest, file)
    return manifest


def _check_manifest(manifest: dict[str, Any], file: Path) -> None:
    try:
        fields_agree = manifest["fields"] == field_table(Capacity(**manifest["capacity"]))
        _need(manifest["shards"], ("file", "count", "sha256"))
        _need(
            manifest["scenarios"], ("scenario_id", "dataset", "segment", "flags", "overflow", "audit", "tags")
        )
        for entry in manifest["scenarios"]:
            SourceCounts(**entry["source"])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"manifest is damaged ({error!r})", file=file, cure=AGAIN) from error
    if not fields_agree:
        raise DataError("field table is not this version's", file=file, cure=AGAIN)


def _need(rows: list[dict[str, Any]], keys: tuple[str, ...]) -> None:
    for row in rows:
        for key in keys:
            if key not in row:
                raise KeyError(key)


def shard_name(number: int) -> str:
    """File name of a shard."""
    return f"shard-{number:05d}.npy"


def crc_name(shard: str) -> str:
    """File name of the checksums of the shard in file ``shard``."""
    return shard.removesuffix(".npy") + ".crc.npy"


def write_header(file: IO[bytes], dtype: np.dtype[Any], count: int) -> None:
    """Write the ``.npy`` header of ``count`` records; its length does not depend on ``count``."""
    # numpy pads headers so that a growing first axis never changes their length (numpy.lib.format).
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": (count,)}
    np.lib.format.write_array_header_1_0(file, header)


def read_header(file: IO[bytes], path: Path) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and dtype that a ``.npy`` file names; leaves ``file`` at the first byte of data.

    Raises:
        DataError: The header is damaged.
    """
    try:
        np.lib.format.read_magic(file)
        shape, _, dtype = np.lib.format.read_array_header_1_0(file, max_header_size=_HEADER_LIMIT)
    except (ValueError, SyntaxError, TypeError) as error:
        raise DataError("header is damaged, not a .npy shard", file=path, cure=AGAIN) from error
    return shape, dtype


class Shard:
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

    def record(self, row: int, verify: bool) -> np.ndarray[Any, Any]:
        """The bytes of a record ``[itemsize]``, a view of the file; tested at its first use, if asked for.

        Raises:
            DataError: It is damaged.
        """
        data = self._map() if self._data is None else self._data
        if verify and not self._intact[row]:
            self._test(data, row)
        return data[row]

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


def plain(value: Any) -> Any:
    """The value as strict JSON: numpy scalars unpacked, paths as text, NaN and infinities as null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value
