"""The manifest of a scenario set: entries of shards and scenarios, reading and checks."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from drivax.errors import DataError
from drivax.files import restore_folder
from drivax.reading import MOST_TEXT, explain_damage, parse_json, read_bytes
from drivax.scenario.bank.sizes import Sizes
from drivax.scenario.schema import NAMES, SCHEMA_VERSION, Capacity, Scenario, SourceCounts, record_dtype
from drivax.seal import check_seal, require_entries

MANIFEST = "manifest.json"
#: The cure for a set that cannot be repaired.
AGAIN = "convert or generate the set again"
#: Bytes of the largest manifest that is read (some 500,000 scenarios); sparse shards may claim any size.
_MOST_MANIFEST = 1 << 30
#: Types of the values of a manifest entry.
_ENTRY = {**dict.fromkeys(NAMES, str), "flags": list, "overflow": dict, "audit": dict, "tags": dict}
#: Types of the values that are read from a manifest, other than its lists.
_MANIFEST = {"record_bytes": int, "drivax_version": str, "source": dict}


def manifest_entry(scenario: Scenario) -> dict[str, Any]:
    """Return the manifest entry of a scenario."""
    return {
        **{name: scenario.text(name) for name in NAMES},
        "flags": [str(flag.name) for flag in scenario.has],
        "segments": int(scenario.record["segment_blocks"][3]),
        "source": plain(dataclasses.asdict(scenario.source)),
        "overflow": plain(scenario.overflow),
        "audit": plain(scenario.audit),
        "tags": plain(scenario.tags),
    }


def field_table(capacity: Capacity) -> list[dict[str, Any]]:
    """Return name, dtype, shape and byte offset of every field of a record."""
    return [
        {"name": name, "dtype": field[0].base.str, "shape": list(field[0].shape), "offset": field[1]}
        for name, field in (record_dtype(capacity).fields or {}).items()
    ]


def read_manifest(path: Path) -> dict[str, Any]:
    """Read the manifest of the set at ``path``."""
    file = path / MANIFEST
    restore_folder(path)
    if not path.is_dir():
        problem = "is not a scenario set (a folder)" if path.exists() else "folder not found"
        raise DataError(problem, file=path, cure="name the folder that drivax convert or generate wrote")
    if not file.is_file():
        cure = f"if these are recordings, `drivax convert` makes a set of them; otherwise {AGAIN}"
        raise DataError("no manifest.json, so this is not a complete scenario set", file=path, cure=cure)
    check_seal(file)
    # A manifest is shorter than the records that it lists.
    most = _size_on_disk(file.stat(), [shard.stat() for shard in path.glob("shard-*.npy") if shard.is_file()])
    text = read_bytes(file, AGAIN, min(max(MOST_TEXT, most), _MOST_MANIFEST))
    with explain_damage(file, AGAIN, "manifest is damaged"):
        manifest = parse_json(text)
        version = manifest["schema_version"]
    if version != SCHEMA_VERSION:
        is_newer = isinstance(version, int) and version > SCHEMA_VERSION
        problem = f"schema version {version}, this drivax reads {SCHEMA_VERSION}"
        raise DataError(problem, file=file, cure="upgrade drivax" if is_newer else AGAIN)
    with explain_damage(file, AGAIN, "manifest is damaged"):
        _check_manifest(manifest, file)
        is_sealed = any("crc_sha256" in shard for shard in manifest["shards"])
    if is_sealed:  # Sets of earlier versions have neither these digests nor a seal.
        require_entries(path, MANIFEST)
    return manifest


def _size_on_disk(manifest: os.stat_result, shards: Sequence[os.stat_result]) -> int:
    """Return the bytes that shards take on the disk: holes of sparse files take none."""
    # Some network disks report no blocks, not even for the manifest: use the sizes of files there.
    return sum(shard.st_blocks * 512 if manifest.st_blocks else shard.st_size for shard in shards)


def _check_manifest(manifest: dict[str, Any], file: Path) -> None:
    check_entries(manifest["shards"], manifest["scenarios"])
    if any(type(manifest[name]) is not kind for name, kind in _MANIFEST.items()):
        raise ValueError(f"{', '.join(_MANIFEST)} are missing or of another type")
    capacity = Capacity(**manifest["capacity"])
    if manifest["fields"] != field_table(capacity):
        raise DataError("field table is not this version's", file=file, cure=AGAIN)
    for shard in manifest["shards"]:
        if "sizes" in shard:  # Sets of earlier versions have none.
            Sizes.read(shard["sizes"], capacity)


def check_entries(shards: Sequence[Mapping[str, Any]], scenarios: Sequence[Mapping[str, Any]]) -> None:
    """Check the names, types and counts of shards and of scenarios."""
    most = len(scenarios)
    for number, shard in enumerate(shards):
        name, count, digest = itemgetter("file", "count", "sha256")(shard)
        if name != shard_name(number) or type(count) is not int or not 0 <= count <= most:
            raise ValueError(f"shard {number} is {name!r} with {count!r} of {most} records")
        if not isinstance(digest, str):
            raise ValueError(f"shard {number} has no checksum")
    for number, entry in enumerate(scenarios):
        is_typed = all(type(entry[name]) is kind for name, kind in _ENTRY.items())
        if not is_typed or {*map(type, (*entry["tags"].values(), *entry["flags"]))} - {str}:
            raise ValueError(f"scenario {number} has a value of another type")
        steps = entry["source"]["steps"]
        if type(steps) is not int or not 0 <= steps < 1 << 31:
            raise ValueError(f"scenario {number} has {steps!r} steps in its source")
        SourceCounts(**entry["source"])


def shard_name(number: int) -> str:
    """Return the file name of a shard."""
    return f"shard-{number:05d}.npy"


def crc_name(shard: str) -> str:
    """Return the file name of the checksums of a shard file."""
    return shard.removesuffix(".npy") + ".crc.npy"


def plain(value: Any) -> Any:
    """Return a value as strict JSON: NumPy scalars unpacked, paths as text, NaN and infinities as null."""
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
