"""Protocol of the readers of public formats, their report of unreadable records, and the head of a file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

from drivax.errors import DataError, DrivaxError
from drivax.scenario.recording import Recording

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class BadRecord:
    """A record that could not be read or converted, as plain data that worker processes can send.

    ``record`` is its number in the file (from 0) or its scenario id, None for the whole file; ``cure`` is what to do.
    """

    file: Path
    record: int | str | None
    problem: str
    cure: str | None = None

    @classmethod
    def of(cls, error: DrivaxError, file: Path, record: int | str | None = None) -> BadRecord:
        """Return the bad record of an error; ``file`` and ``record`` count if the error names none."""
        record = record if error.record is None else error.record
        return cls(error.file or file, record, error.problem, error.cure)

    def error(self) -> DataError:
        """Return the error to raise."""
        return DataError(self.problem, file=self.file, record=self.record, cure=self.cure)


def attempt(
    function: Callable[..., _Result], *args: Any, file: Path, record: int | str | None = None
) -> _Result | BadRecord:
    """Call a function; return the bad record of its DataError in place of a result."""
    try:
        return function(*args)
    except DataError as error:
        return BadRecord.of(error, file, record)


def read_head(path: Path, size: int) -> bytes:
    """Return the first bytes of a file, none if it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(size)
    except (OSError, ValueError):  # ValueError: a path with a null character
        return b""


@dataclass(frozen=True)
class Description:
    """Description of one file of a format by ``drivax doctor``.

    Attributes:
        dataset: Full name of the public data set; ``flavour`` describes the file, ``version`` is None if it is unknown.
        recordings: Number of recordings; None for a file that would have to be read whole.
        notes: What the file holds or lacks that its user should know, one short sentence each.
        missing: Files that have to lie next to it but do not exist.
    """

    dataset: str
    flavour: str
    version: str | None = None
    recordings: int | None = None
    notes: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()


@runtime_checkable
class Reader(Protocol):
    """One public format: a module with such a class, listed in ``formats.READERS``.

    Readers hold no state and no open files: worker processes receive them by name. They read one file at a time, the
    one that names the recordings (a shard, pickle, parquet file or database), and find its companions (a map, poses)
    next to or above it. Packages of extras are imported when they are needed.
    """

    @property
    def name(self) -> str:
        """Name of the format, as in ``--format``."""
        ...

    @property
    def patterns(self) -> tuple[str, ...]:
        """File-name patterns of the format; a matching file that cannot be read is reported."""
        ...

    @property
    def companions(self) -> tuple[str, ...]:
        """File-name patterns of companion files: maps and poses, which are read, and indices."""
        ...

    def recognise(self, path: Path) -> bool:
        """Return whether a file is of this format, by its name, first bytes, tables or first record; never raises."""
        ...

    def describe(self, path: Path) -> Description:
        """Describe the file; some readers look at its first recording only.

        Raises:
            DataError: The file is damaged.
            UsageError: A package of an extra is missing.
        """
        ...

    def count(self, path: Path) -> int:
        """Estimate quickly how many scenarios the file becomes; 0 if it cannot be read."""
        ...

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """Yield the recordings of a file in file order, and a bad record in place of each that cannot be read.

        Raises:
            DataError: The file cannot be opened; some readers yield a bad record instead.
            UsageError: A package of an extra is missing, or a limit of this process is reached.
        """
        ...


def companion_files(reader: Any, path: Path) -> tuple[Path, ...]:
    """Return the files that a reader reads together with ``path``, some of which may be missing: maps, poses, tables.

    Readers that read such files have a method of this name.
    """
    return reader.companion_files(path) if hasattr(reader, "companion_files") else ()


def with_steps(reader: Any, steps: int) -> Reader:
    """Return the reader for scenarios of ``steps`` steps; only those that cut logs into recordings (nuPlan) differ."""
    return replace(reader, steps=steps) if hasattr(reader, "steps") else reader
