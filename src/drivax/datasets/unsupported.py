"""Errors for unsupported data, with a cure: other forms of public data sets, archives, scenario sets.

Detection reads the beginning of a file, its first record, or file names.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from drivax.datasets.womd.messages import parse
from drivax.datasets.womd.tfrecord import read_records
from drivax.errors import DataError, UsageError, explain_system
from drivax.reading import read_json
from drivax.scenario.manifest import AGAIN, MANIFEST

#: Kinds of files by their first bytes (for a tar archive, its bytes from ``_TAR_BYTE`` on), and cures.
_TAR, _TAR_BYTE = b"ustar", 257
_MAGIC = {
    b"\x1f\x8b": ("the file is gzip-compressed", "decompress it first (gunzip, or tar xzf for a .tgz)"),
    b"PK\x03\x04": ("a zip archive", "unpack it first (unzip)"),
    b"BZh": ("the file is bzip2-compressed", "decompress it first (bunzip2)"),
    b"\xfd7zXZ": ("the file is xz-compressed", "decompress it first (unxz)"),
    b"\x28\xb5\x2f\xfd": ("the file is zstd-compressed", "decompress it first (unzstd)"),
    _TAR: ("a tar archive", "unpack it first (tar xf)"),
    b"\x89HDF": ("an HDF5 file", "give the files of the data set as they are downloaded"),
    b"\x93NUMPY": (
        "a numpy array, not a file of a public data set",
        "a shard of a scenario set? name its folder",
    ),
    b"PAR1": (
        "a parquet file not named as a scenario of Argoverse 2 (WOMD perception v2 has such files)",
        "use scenario_*.parquet of Argoverse 2, or the motion data set of Waymo (TFRecord)",
    ),
    b"ARROW1": (
        "a feather file not named as annotations of Argoverse 2, annotations.feather",
        "give the folder of the log (annotations.feather next to city_SE3_egovehicle.feather and map/)",
    ),
    b"SQLite format 3": (
        "a SQLite file without nuPlan's tables (a map, perhaps)",
        "give the logs of nuPlan (splits/*/*.db), with maps/ next to them",
    ),
}
_HEAD = 1 << 16
_MOTION = "download the motion data set (scenario/*.tfrecord-*)"
#: Kinds of JSON files by a pattern at their beginning, and cures.
_JSON = {
    rb'"(objects|roads)"': (
        "JSON with objects or roads, but without GPUDrive's positions or geometries at its beginning",
        "give files of GPUDrive's present converter",
    ),
    rb'"(lane_segments|drivable_areas)"': (
        "a map of Argoverse 2 without its recording",
        "give the folder that holds the scenario_*.parquet or annotations.feather as well",
    ),
    rb'"(first_sample_token|scene_token|sample_token)"': (
        "a table of nuScenes, but not scene.json with sample.json next to it",
        "unpack the whole metadata archive (v1.0-*.tgz) and name its folder",
    ),
    rb"": ("JSON of an unknown data set", "give the files of the data set as downloaded"),
}
_INDICES = ("dataset_summary.pkl", "dataset_mapping.pkl")


def explain(path: Path) -> DataError:
    """Return the error for a file whose content no reader recognises."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError as error:
        cure = getattr(explain_system(error, path), "cure", "check the path")
        return DataError(error.strerror or "cannot be opened", file=path, cure=cure)
    if not head:
        return DataError("the file is empty", file=path, cure="copy or download the file again")
    for magic, (problem, cure) in _MAGIC.items():
        if head[_TAR_BYTE if magic == _TAR else 0 :].startswith(magic):
            return DataError(problem, file=path, cure=cure)
    if re.match(rb"\x80[\x02-\x05]", head):
        problem, cure = "a pickle, but not a ScenarioNet scenario", "give the sd_*.pkl files"
        if path.name in _INDICES:
            problem = "the index of a ScenarioNet database, without scenarios"
            cure = "give the folder that holds its sd_*.pkl files"
        return DataError(problem, file=path, cure=cure)
    if head.lstrip()[:1] in (b"{", b"["):
        problem, cure = next(entry for pattern, entry in _JSON.items() if re.search(pattern, head))
        return DataError(problem, file=path, cure=cure)
    return _tfrecord(path)


def _tfrecord(path: Path) -> DataError:
    """Return the error for a file by its first TFRecord record, or for one that is not a TFRecord file."""
    try:
        _, payload = next(read_records(path))
        if isinstance(payload, DataError):
            return payload
        problem = next((problem for test, problem in _RECORDS if test(payload)), None)
    except UsageError as error:
        return DataError(f"of no known format, but {error.problem}", file=path, cure=error.cure)
    cure = _MOTION if problem else f"for Waymo data {_MOTION}"
    return DataError(problem or "a TFRecord file whose records drivax does not know", file=path, cure=cure)


def _is_frame(payload: bytes) -> bool:
    """Return whether a payload is a ``Frame`` of the Waymo perception data set."""
    frame = parse("Frame", payload)
    if frame is None or not frame.HasField("timestamp_micros"):
        return False
    has_name = frame.context.HasField("name") and frame.context.name.isascii()
    return has_name and bool(frame.HasField("pose") or frame.images or frame.lasers)


def _is_end_to_end(payload: bytes) -> bool:
    """Return whether a payload is an ``E2EDFrame``: a ``Frame`` with past or future states of the ego."""
    message = parse("E2EDFrame", payload)
    if message is None or not (message.HasField("future_states") or message.HasField("past_states")):
        return False
    frame = message.frame
    return frame.HasField("context") and bool(frame.HasField("pose") or frame.images)


def _is_example(payload: bytes) -> bool:
    """Return whether a payload is a ``tf.Example`` with some feature."""
    message = parse("Example", payload)
    entries = () if message is None else message.features.feature
    return any(entry.HasField("key") and entry.HasField("value") for entry in entries)


_RECORDS: tuple[tuple[Callable[[bytes], bool], str], ...] = (
    (_is_frame, "frames of the Waymo perception data set (camera and lidar), not motion data"),
    (_is_end_to_end, "frames of the Waymo end-to-end driving data set (cameras), not motion data"),
    (_is_example, "tf.Examples without the features of motion data"),
)


#: Kinds of folders: tests, problems and cures.
_Folders = tuple[tuple[Callable[[Path], bool], str, str], ...]


def explain_folder(folder: Path) -> DataError | None:
    """Return the error for a known kind of folder without any file to convert; None for others."""
    return _first_match(folder, (*_OWN_FOLDERS, *_FOLDERS))


def explain_own(folder: Path) -> DataError | None:
    """Return the error for a scenario set or run folder of drivax, whatever files are in it; None for others."""
    return _first_match(folder, _OWN_FOLDERS)


def _first_match(folder: Path, kinds: _Folders) -> DataError | None:
    errors = (DataError(problem, file=folder, cure=cure) for test, problem, cure in kinds if test(folder))
    return next(errors, None)


def _is_scenario_set(folder: Path) -> bool:
    """Return whether a folder is a scenario set of drivax, of any version."""
    try:
        manifest = read_json(folder / MANIFEST, AGAIN)
    except DataError:
        return False
    return isinstance(manifest, dict) and "schema_version" in manifest


def _contains(folder: Path, *patterns: str) -> bool:
    return any(next(folder.rglob(pattern), None) is not None for pattern in patterns)


_OWN_FOLDERS: _Folders = (
    (_is_scenario_set, "already a scenario set of drivax", "run drivax inspect on it"),
    (
        lambda folder: (folder / "run.json").exists(),
        "a run folder of drivax, not recordings",
        "run drivax report on it",
    ),
)
_FOLDERS: _Folders = (
    (
        lambda folder: (folder / "dataset_summary.pkl").exists(),
        "a ScenarioNet database with its index (dataset_summary.pkl) but without its scenarios",
        "copy the sd_*.pkl files as well",
    ),
    (
        lambda folder: (
            _contains(folder, "city_SE3_egovehicle.feather") and not _contains(folder, "annotations*.feather")
        ),
        "a sensor log of Argoverse 2 without annotations, like those of the test split",
        "use the train or val split",
    ),
    (
        lambda folder: _contains(folder, "*.gpkg") and not _contains(folder, "*.db"),
        "maps of nuPlan without logs",
        "put the logs (splits/*/*.db) next to maps/ and name the folder of both",
    ),
    (
        lambda folder: _contains(folder, "sample_annotation.json", "ego_pose.json"),
        "tables of nuScenes, but not all that are needed",
        "unpack the whole metadata archive (v1.0-*.tgz) and the map expansion (maps/expansion/)",
    ),
)
