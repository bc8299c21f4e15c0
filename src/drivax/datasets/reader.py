"""What every reader of a public format is, and how it reports records that it could not read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from drivax.errors import DataError, DrivaxError
from drivax.scenario.recording import Recording


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


@dataclass(frozen=True)
class Description:
    """What ``drivax doctor`` tells about one file of a format.

    Attributes:
        dataset: Full name of the public data set, for people.
        flavour: Which of its forms this is.
        version: Its version, as far as the file tells.
        recordings: How many recordings the file holds; None where only reading all of it would tell.
        notes: What the file holds or lacks that its user should know, one short sentence each.
        missing: Files that must lie next to it before it can be converted, and are not there.
    """

    dataset: str
    flavour: str
    version: str | None = None
    recordings: int | None = None
    notes: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()


@runtime_checkable
class Reader(Protocol):
    """One public format. A new format is one module with such a class, listed in ``formats.READERS``.

    Readers hold no state and no open files: worker processes receive them by name. The unit that is read at once is
    one file, the one that names the recording or recordings (a shard, a pickle, a parquet or a database); what
    belongs to it (a map, poses) is found next to it. Packages of extras are imported when they are needed.
    """

    @property
    def name(self) -> str:
        """Name of the format, as in ``--format``."""
        ...

    @property
    def patterns(self) -> tuple[str, ...]:
        """File-name patterns of the format; a matching file in a folder is reported when it cannot be read."""
        ...

    @property
    def companions(self) -> tuple[str, ...]:
        """File-name patterns of what is read along with those files (maps, poses) and is no recording itself."""
        ...

    def recognise(self, path: Path) -> bool:
        """Whether the content of a file is of this format; looks at the beginning only, never raises."""
        ...

    def describe(self, path: Path) -> Description:
        """What the file is, without decoding all of it.

        Raises:
            DataError: It is damaged.
        """
        ...

    def count(self, path: Path) -> int:
        """About how many scenarios the file will become, quickly; 0 where it cannot be read."""
        ...

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """The recordings of one file in file order, and in their place the records that cannot be read."""
        ...
