"""The formats that drivax reads, detected by content: data sets use the same file names for different things.

Also errors for unsupported data, with a cure: other forms of public data sets, archives, scenario sets. Detection reads
the beginning of a file, its first record, or file names.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from drivax.datasets.argoverse.motion import ArgoverseMotion
from drivax.datasets.argoverse.sensor import ArgoverseSensor
from drivax.datasets.gpudrive import GpuDrive
from drivax.datasets.nuplan.reader import NuPlan
from drivax.datasets.nuscenes.reader import NuScenes
from drivax.datasets.reader import Reader
from drivax.datasets.scenarionet.reader import ScenarioNet
from drivax.datasets.womd.example_reader import ScenarioMax, WomdExample
from drivax.datasets.womd.messages import parse
from drivax.datasets.womd.scenario_reader import WomdScenario
from drivax.datasets.womd.tfrecord import read_records
from drivax.errors import DataError, UsageError, did_you_mean, explain_system
from drivax.reading import check_regular, read_json
from drivax.scenario.manifest import AGAIN, MANIFEST

#: Every reader; a new format is one module and one entry here. A file goes to the readers whose patterns it matches,
#: then to the others, both in this order: those that look at a name or a few bytes come first.
READERS: tuple[Reader, ...] = (
    ArgoverseMotion(),
    ArgoverseSensor(),
    ScenarioNet(),
    NuPlan(),
    NuScenes(),
    GpuDrive(),
    WomdScenario(),
    WomdExample(),
    ScenarioMax(),
)
AUTO = "auto"
_NAME_FILE = "name a file"
#: Endings of sensor data and texts, which data sets hold by the hundred thousand: in folders they are never opened.
_UNREAD = (".jpg", ".jpeg", ".png", ".pcd", ".pcd.bin", ".npz", ".md", ".txt", ".csv", ".html", ".pdf")
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


def find_reader(name: str) -> Reader:
    """Return the reader of a format."""
    readers = {reader.name: reader for reader in READERS}
    if name not in readers:
        choices = f"use one of {', '.join((AUTO, *readers))}"
        cure = did_you_mean(name, readers, otherwise=choices)
        raise UsageError(f"unknown format {name!r}", cure=cure)
    return readers[name]


def recognise(path: Path) -> Reader | None:
    """Return the reader that recognises a file, None if none does."""
    # Readers whose patterns match come first: most files of a large folder are opened once.
    readers = sorted(READERS, key=lambda reader: not _matches(path, reader.patterns))
    return next((reader for reader in readers if reader.recognise(path)), None)


def detect(path: str | Path) -> Reader:
    """Return the reader that recognises a file.

    Raises:
        DataError: The file is missing, not a regular file, damaged at its beginning, or of no format that drivax reads.
    """
    check_regular(Path(path), _NAME_FILE)
    if (reader := recognise(Path(path))) is None:
        raise explain(Path(path))
    return reader


@dataclass(frozen=True)
class Input:
    """A file to read; ``format`` is None if the user or its name says to read the file, but no reader recognises it."""

    path: Path
    format: str | None


@dataclass(frozen=True)
class Survey:
    """Content of a file or folder (``root``).

    Attributes:
        inputs: The files to read, sorted by path.
        companions: Number of files that belong to them (maps, poses, indices).
        ignored: Number of other files, images among them.
    """

    root: Path
    inputs: tuple[Input, ...]
    companions: int = 0
    ignored: int = 0

    @property
    def formats(self) -> Counter[str]:
        """Number of files by format, recognised ones only."""
        return Counter(entry.format for entry in self.inputs if entry.format is not None)

    def paths(self, *formats: str | None) -> list[Path]:
        """Return the files of some formats (None: of an unknown one); all without an argument."""
        return [entry.path for entry in self.inputs if not formats or entry.format in formats]

    def relative_path(self, path: Path) -> str:
        """Return a file's name in messages and manifests: its path below the root, or its own name."""
        inside = self.root.is_dir() and path.is_relative_to(self.root)
        return path.relative_to(self.root).as_posix() if inside else path.name


def survey(src: str | Path, name: str = AUTO) -> Survey:
    """Find the files to read, and their formats.

    A file given by name is always read. In a folder (searched to any depth, without hidden files and links to folders),
    the files to read are those that a reader recognises, and those named like a format's files, so that damaged ones
    are reported.

    Args:
        src: A file or a folder.
        name: A format, or ``auto`` for all of them.

    Raises:
        DataError: ``src`` does not exist or is a pipe or device, or the folder holds no such file.
        UsageError: There is no such format.
    """
    src = Path(src)
    requested_reader = None if name == AUTO else find_reader(name)
    if not src.exists():
        raise DataError("does not exist", file=src, cure="check the path")
    if not src.is_dir():
        check_regular(src, _NAME_FILE)
        reader = requested_reader or recognise(src)
        return Survey(src, (Input(src, None if reader is None else reader.name),))
    readers = READERS if requested_reader is None else (requested_reader,)
    kinds = [_kind(path, readers) for path in sorted(src.rglob("*")) if _is_visible_file(path, src)]
    inputs = tuple(kind for kind in kinds if isinstance(kind, Input))
    companions = kinds.count("companion")
    if not inputs:
        raise _no_input_error(src, len(kinds), readers)
    return Survey(src, inputs, companions, len(kinds) - len(inputs) - companions)


def _kind(path: Path, readers: tuple[Reader, ...]) -> Input | str:
    """Classify a file of a folder: input, companion of one, or ignored."""
    if path.name.lower().endswith(_UNREAD):
        return "ignored"
    by_name = any(_matches(path, reader.patterns) for reader in readers)
    if len(readers) == 1:
        # With one format, a file that only has the name goes to its reader, which reports what is wrong.
        if by_name or readers[0].recognise(path):
            return Input(path, readers[0].name)
    elif (reader := recognise(path)) is not None:
        return Input(path, reader.name)
    if any(_matches(path, reader.companions) for reader in readers):
        return "companion"
    return Input(path, None) if by_name else "ignored"


def _matches(path: Path, patterns: tuple[str, ...]) -> bool:
    return any(path.match(pattern) for pattern in patterns)


def _is_visible_file(path: Path, folder: Path) -> bool:
    return not any(part.startswith(".") for part in path.relative_to(folder).parts) and path.is_file()


def _no_input_error(folder: Path, count: int, readers: tuple[Reader, ...]) -> DataError:
    """Return the error for a folder of ``count`` files, none of which can be read."""
    names = ", ".join(reader.name for reader in readers)
    kind = f"of the format {names}" if len(readers) == 1 else f"of a known format ({names})"
    return explain_folder(folder) or DataError(
        f"none of the {count} files in it is {kind}" if count else "has no files",
        file=folder,
        cure="name the folder that holds the downloaded data; links to folders in it are not followed",
    )


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
