"""Data that drivax does not read, and what to use instead: the wrong flavours of public data sets, archives, sets.

Detection reads a few bytes and file names, with the standard library alone.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

from drivax.datasets.womd.tfrecord import read_records
from drivax.errors import DataError, UsageError
from drivax.scenario.store import MANIFEST

#: (where in a file, bytes, what it is, cure)
_MAGIC = (
    (0, b"\x1f\x8b", "the file is gzip-compressed", "decompress it first (gunzip, or tar xzf for a .tgz)"),
    (0, b"PK\x03\x04", "a zip archive", "unpack it first (unzip)"),
    (0, b"BZh", "the file is bzip2-compressed", "decompress it first (bunzip2)"),
    (0, b"\xfd7zXZ", "the file is xz-compressed", "decompress it first (unxz)"),
    (0, b"\x28\xb5\x2f\xfd", "the file is zstd-compressed", "decompress it first (unzstd)"),
    (257, b"ustar", "a tar archive", "unpack it first (tar xf)"),
    (0, b"\x89HDF", "an HDF5 file", "give the files of the data set as they are downloaded"),
    (
        0,
        b"\x93NUMPY",
        "a numpy array, not a file of a public data set",
        "a shard of a scenario set? name its folder",
    ),
    (
        0,
        b"PAR1",
        "a parquet file without the columns of Argoverse 2 motion forecasting (WOMD perception v2 has such files)",
        "use scenario_*.parquet of Argoverse 2, or the motion data set of Waymo (TFRecord)",
    ),
    (
        0,
        b"ARROW1",
        "a feather file that is no table of annotations of Argoverse 2",
        "give the folder of the log (annotations.feather next to city_SE3_egovehicle.feather and map/)",
    ),
    (
        0,
        b"SQLite format 3",
        "a SQLite file without nuPlan's tables (a map, perhaps)",
        "give the logs of nuPlan (splits/*/*.db), with maps/ next to them",
    ),
)
_NEEDED = 262 + 64
_MOTION = "download the motion data set (scenario/*.tfrecord-*)"


def explain(path: Path) -> DataError:
    """The error for a file whose content no reader recognises."""
    try:
        with path.open("rb") as file:
            head = file.read(_NEEDED)
    except OSError as error:
        return DataError(error.strerror or "cannot be opened", file=path, cure="check the path")
    if not head:
        return DataError("the file is empty", file=path, cure="copy or download the file again")
    for place, magic, problem, cure in _MAGIC:
        if head[place : place + len(magic)] == magic:
            return DataError(problem, file=path, cure=cure)
    if head[:1] == b"\x80" and head[1:2] in b"\x02\x03\x04\x05":
        return _pickle(path)
    if head.lstrip()[:1] in (b"{", b"["):
        return _json(path)
    return _tfrecord(path)


def _pickle(path: Path) -> DataError:
    if path.name in ("dataset_summary.pkl", "dataset_mapping.pkl"):
        return DataError(
            "the index of a ScenarioNet database, without scenarios",
            file=path,
            cure="give the folder that holds its sd_*.pkl files",
        )
    return DataError("a pickle that is no ScenarioNet scenario", file=path, cure="give the sd_*.pkl files")


def _json(path: Path) -> DataError:
    with path.open("rb") as file:
        head = file.read(1 << 16)
    if b'"objects"' in head or b'"roads"' in head:
        return DataError(
            "looks like a GPUDrive scene but has no metadata, so the ego is unknown",
            file=path,
            cure="convert the scenes again with a GPUDrive that writes metadata",
        )
    if b'"lane_segments"' in head or b'"drivable_areas"' in head:
        return DataError(
            "a map of Argoverse 2 without its recording",
            file=path,
            cure="give the folder that holds the scenario_*.parquet or annotations.feather as well",
        )
    return DataError(
        "JSON of no data set that drivax knows",
        file=path,
        cure="give the files of the data set as downloaded",
    )


def _tfrecord(path: Path) -> DataError:
    try:
        _, payload = next(read_records(path))
    except UsageError as error:
        return DataError(f"of no known format, but {error.problem}", file=path, cure=error.cure)
    if isinstance(payload, DataError):
        return payload
    for test, problem, cure in _RECORDS:
        if test(payload):
            return DataError(problem, file=path, cure=cure)
    return DataError(
        "a TFRecord file whose records drivax does not know", file=path, cure=f"for Waymo data {_MOTION}"
    )


def fields(payload: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Field numbers and values of a protocol-buffer message, as far as it can be read.

    Yields:
        (field number, value): an int for varints, the bytes for everything else.
    """
    at = 0
    while at < len(payload):
        key, at = _varint(payload, at)
        number, kind = key >> 3, key & 7
        if kind == 0:
            value, at = _varint(payload, at)
            if at > len(payload):
                return
            yield number, value
            continue
        if kind == 2:
            size, at = _varint(payload, at)
        elif kind in (1, 5):
            size = 8 if kind == 1 else 4
        else:
            return
        if number == 0 or at + size > len(payload):
            return
        yield number, payload[at : at + size]
        at += size


def _varint(payload: bytes, at: int) -> tuple[int, int]:
    """A varint and where it ends; beyond the payload where it is cut off."""
    value = shift = 0
    while at < len(payload) and shift < 64:
        byte = payload[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at
    return value, len(payload) + 1


def _is_frame(payload: bytes) -> bool:
    """Whether it is a ``Frame`` of WOMD perception: context with a name (1), timestamp (2), images or lasers."""
    message = dict(fields(payload))
    context = message.get(1)
    if not isinstance(context, bytes) or not isinstance(message.get(2), int):
        return False
    name = dict(fields(context)).get(1)
    return isinstance(name, bytes) and name.isascii() and bool({3, 4, 5} & message.keys())


def _is_end_to_end(payload: bytes) -> bool:
    """Whether it is an ``E2EDFrame``: a ``Frame`` (1) with past or future states of ego (2, 3)."""
    message = dict(fields(payload))
    frame = message.get(1)
    states = (message.get(2), message.get(3))
    if not isinstance(frame, bytes) or not any(isinstance(state, bytes) for state in states):
        return False
    inner = dict(fields(frame))
    return isinstance(inner.get(1), bytes) and bool({3, 4} & inner.keys())


def _is_example(payload: bytes) -> bool:
    """Whether it is a ``tf.Example``: features (1) with entries (1) that have a key (1) and a value (2)."""
    features = dict(fields(payload)).get(1)
    entry = dict(fields(features)).get(1) if isinstance(features, bytes) else None
    message = dict(fields(entry)) if isinstance(entry, bytes) else {}
    return isinstance(message.get(1), bytes) and isinstance(message.get(2), bytes)


_RECORDS: tuple[tuple[Callable[[bytes], bool], str, str], ...] = (
    (_is_frame, "frames of the Waymo perception data set (camera and lidar), not motion data", _MOTION),
    (_is_end_to_end, "frames of the Waymo end-to-end driving data set (cameras), not motion data", _MOTION),
    (_is_example, "tf.Examples without the features of motion data", _MOTION),
)


def explain_folder(folder: Path) -> DataError | None:
    """The error for a folder without any file to convert that is something known all the same; None otherwise."""
    return _first_match(folder, (*_OWN_FOLDERS, *_FOLDERS))


def explain_own(folder: Path) -> DataError | None:
    """The error for a folder that drivax wrote, whatever files are in it; None for others."""
    return _first_match(folder, _OWN_FOLDERS)


_Folders = tuple[tuple[Callable[[Path, set[str]], bool], str, str], ...]


def _first_match(folder: Path, known: _Folders) -> DataError | None:
    names = {path.name for path in folder.iterdir()}
    for test, problem, cure in known:
        if test(folder, names):
            return DataError(problem, file=folder, cure=cure)
    return None


def is_scenario_set(folder: Path) -> bool:
    """Whether a folder is a scenario set of drivax, of any version."""
    try:
        return "schema_version" in json.loads((folder / MANIFEST).read_bytes())
    except (OSError, ValueError, TypeError):
        return False


def _inside(folder: Path, *patterns: str) -> bool:
    return any(next(folder.rglob(pattern), None) is not None for pattern in patterns)


_OWN_FOLDERS: _Folders = (
    (
        lambda folder, names: is_scenario_set(folder),
        "a scenario set of drivax already",
        "look at it with drivax inspect",
    ),
    (
        lambda folder, names: "run.json" in names,
        "a run folder of drivax, not recordings",
        "look at it with drivax report",
    ),
)
_FOLDERS: _Folders = (
    (
        lambda folder, names: "dataset_summary.pkl" in names,
        "a ScenarioNet database with its index (dataset_summary.pkl) but without its scenarios",
        "copy the sd_*.pkl files as well",
    ),
    (
        lambda folder, names: (
            _inside(folder, "city_SE3_egovehicle.feather") and not _inside(folder, "annotations*.feather")
        ),
        "a sensor log of Argoverse 2 without annotations, as those of the test split",
        "use the train or val split",
    ),
    (
        lambda folder, names: _inside(folder, "*.gpkg") and not _inside(folder, "*.db"),
        "maps of nuPlan without logs",
        "put the logs (splits/*/*.db) next to maps/ and name the folder of both",
    ),
    (
        lambda folder, names: _inside(folder, "sample_annotation.json", "ego_pose.json"),
        "tables of nuScenes, but not all that are needed",
        "unpack the whole metadata archive (v1.0-*.tgz) and the map expansion (maps/expansion/)",
    ),
)
