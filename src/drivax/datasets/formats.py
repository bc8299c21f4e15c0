"""Which formats drivax reads, and which of them a file is.

Formats are detected by content: public data sets use the same file names for different things.
"""

from __future__ import annotations

import difflib
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
from drivax.datasets.scenariomax import ScenarioMax
from drivax.datasets.scenarionet.reader import ScenarioNet
from drivax.datasets.womd.example_reader import WomdExample
from drivax.datasets.womd.scenario_reader import WomdScenario
from drivax.errors import DataError, UsageError

#: Every reader; a new format is one module and one entry here. Files are shown to them in this order, so those that
#: look at a name or at a few bytes come first.
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
#: Sensor data and texts, which data sets hold by the hundred thousand.
_NEVER = (".jpg", ".jpeg", ".png", ".pcd", ".pcd.bin", ".npz", ".md", ".txt", ".csv", ".html", ".pdf")


def reader_named(name: str) -> Reader:
    """The reader of a format.

    Raises:
        UsageError: There is no such format.
    """
    readers = {reader.name: reader for reader in READERS}
    if name in readers:
        return readers[name]
    near = difflib.get_close_matches(name, readers, n=1)
    cure = f"did you mean {near[0]!r}?" if near else f"use one of {', '.join((AUTO, *readers))}"
    raise UsageError(f"there is no format {name!r}", cure=cure)


def recognise(path: Path) -> Reader | None:
    """The reader whose format a file's content is, if there is one."""
    # Those first whose files are called so: most files of a large folder are opened once.
    for reader in sorted(READERS, key=lambda reader: not _called(path, reader.patterns)):
        if reader.recognise(path):
            return reader
    return None


def detect(path: str | Path) -> Reader:
    """The reader whose format a file's content is.

    Raises:
        DataError: The file is missing, damaged at its beginning, or of no format that drivax reads.
    """
    path = Path(path)
    reader = recognise(path)
    if reader is None:
        raise unsupported.explain(path)
    return reader


@dataclass(frozen=True)
class Input:
    """One file to read.

    Attributes:
        path: The file.
        format: Its format; None where it is only called as the files of a format are.
    """

    path: Path
    format: str | None


@dataclass(frozen=True)
class Survey:
    """What a file or folder holds.

    Attributes:
        root: The file or folder.
        inputs: The files to read, sorted by path.
        companions: How many files are read along with them (maps, poses).
        ignored: How many other files there are.
    """

    root: Path
    inputs: tuple[Input, ...]
    companions: int = 0
    ignored: int = 0

    @property
    def formats(self) -> Counter[str]:
        """Number of files by format, recognised ones only."""
        return Counter(entry.format for entry in self.inputs if entry.format is not None)

    def relative(self, path: Path) -> str:
        """A file's name for people and manifests: its path below the root, or its own name."""
        inside = self.root.is_dir() and path.is_relative_to(self.root)
        return path.relative_to(self.root).as_posix() if inside else path.name


def survey(src: str | Path, name: str = AUTO) -> Survey:
    """Which files of a folder can be read, and as what.

    A file given by name is always read. In a folder (searched to any depth, hidden names left out) those count whose
    content is of a format, and those that are called as a format's files are: damaged ones shall be reported.

    Args:
        src: A file or a folder.
        name: A format, or ``auto`` for all of them.

    Raises:
        DataError: ``src`` does not exist, or the folder holds no file of a known format.
        UsageError: There is no such format.
    """
    src = Path(src)
    only = None if name == AUTO else reader_named(name)
    if not src.exists():
        raise DataError("does not exist", file=src, cure="check the path")
    if not src.is_dir():
        return Survey(src, (_input(src, only),))
    inside = [
        path for path in sorted(src.rglob("*")) if path.is_file() and not _hidden(path.relative_to(src))
    ]
    inputs, companions = [], 0
    for path in inside:
        kind = _kind(path, READERS if only is None else (only,))
        if isinstance(kind, Input):
            inputs.append(kind)
        companions += kind == "companion"
    if not inputs:
        raise _nothing_in(src, len(inside), only)
    return Survey(src, tuple(inputs), companions, len(inside) - len(inputs) - companions)


def find_files(src: str | Path, name: str = AUTO) -> tuple[list[Path], int]:
    """The files that :func:`survey` finds, and how many others that belong to no format.

    Raises:
        DataError: ``src`` does not exist, or the folder holds no file of a known format.
        UsageError: There is no such format.
    """
    data = survey(src, name)
    return [entry.path for entry in data.inputs], data.ignored


def _input(path: Path, only: Reader | None) -> Input:
    reader = only or recognise(path)
    return Input(path, None if reader is None else reader.name)


def _kind(path: Path, readers: tuple[Reader, ...]) -> Input | str:
    """What a file of a folder is: an input, a companion of one, or nothing that is known."""
    if path.name.lower().endswith(_NEVER):
        return "ignored"
    called = any(_called(path, reader.patterns) for reader in readers)
    if len(readers) == 1:
        # The reader says record by record what is wrong with a file that only bears the name.
        if called or readers[0].recognise(path):
            return Input(path, readers[0].name)
    elif (reader := recognise(path)) is not None:
        return Input(path, reader.name)
    if any(_called(path, reader.companions) for reader in readers):
        return "companion"
    return Input(path, None) if called else "ignored"


def _called(path: Path, patterns: tuple[str, ...]) -> bool:
    return any(path.match(pattern) for pattern in patterns)


def _hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def _nothing_in(folder: Path, files: int, only: Reader | None) -> DataError:
    error = unsupported.explain_folder(folder)
    if error is not None:
        return error
    known = ", ".join(reader.name for reader in (READERS if only is None else (only,)))
    return DataError(
        f"none of the {files} files in it is of a known format ({known})",
        file=folder,
        cure="name the folder that holds the downloaded data; drivax doctor tells more",
    )
