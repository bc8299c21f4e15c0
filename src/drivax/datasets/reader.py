"""What every reader of a public format is, and how it reports records that it could not read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from drivax.errors import DataError, DrivaxError
from drivax.scenario.schema import Recording


@dataclass(frozen=True)
class BadRecord:
    """A record that could not be read or converted: plain data, so that worker processes can send it.

    Attributes:
        file: The file that holds it.
        record: Its number in the file (from 0) or its scenario id; None where the whole file is at fault.
        problem: What is wrong.
        cure: What to do about it.
    """

    file: Path
    record: int | str | None
    problem: str
    cure: str | None = None

    @classmethod
    def of(cls, error: DrivaxError, file: Path, record: int | str | None = None) -> BadRecord:
        """The bad record that an error describes; ``file`` and ``record`` where the error does not say."""
        return cls(
            error.file or file, record if error.record is None else error.record, error.problem, error.cure
        )

    def error(self) -> DataError:
        """The error to raise for it."""
        return DataError(self.problem, file=self.file, record=self.record, cure=self.cure)


@runtime_checkable
class Reader(Protocol):
    """One public format. A new format is one module with such a class, listed in ``formats.READERS``.

    Readers hold no state and no open files: worker processes receive them by name.
    """

    @property
    def name(self) -> str:
        """Name of the format, as in ``--format``."""
        ...

    @property
    def patterns(self) -> tuple[str, ...]:
        """File-name patterns of the format; a matching file in a folder is reported when it cannot be read."""
        ...

    def recognise(self, path: Path) -> bool:
        """Whether the content of a file is of this format; looks at the beginning only, never raises."""
        ...

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """The recordings of one file in file order, and in their place the records that cannot be read."""
        ...
