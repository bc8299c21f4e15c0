"""The formats that drivax reads, detected by content: data sets use the same file names for different things."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from drivax.datasets import unsupported
from drivax.datasets.argoverse.motion import ArgoverseMotion
from drivax.datasets.argoverse.sensor import ArgoverseSensor
from drivax.datasets.gpudrive import GpuDrive
from drivax.datasets.nuplan.reader import NuPlan
from drivax.datasets.nuscenes.reader import NuScenes
from drivax.datasets.reader import Reader
from drivax.datasets.scenarionet.reader import ScenarioNet
from drivax.datasets.womd.example_reader import ScenarioMax, WomdExample
from drivax.datasets.womd.scenario_reader import WomdScenario
from drivax.errors import DataError, UsageError, did_you_mean
from drivax.reading import check_regular

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
        raise unsupported.explain(Path(path))
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
    return unsupported.explain_folder(folder) or DataError(
        f"none of the {count} files in it is {kind}" if count else "has no files",
        file=folder,
        cure="name the folder that holds the downloaded data; links to folders in it are not followed",
    )
