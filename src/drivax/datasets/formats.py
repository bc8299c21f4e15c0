"""Which formats drivax reads, and which of them a file is.

A format is told by content, not by name: public data sets use the same names for different things.
"""

from __future__ import annotations

import difflib
from pathlib import Path

from drivax.datasets.reader import Reader
from drivax.datasets.tfrecord import read_records
from drivax.datasets.womd_example import WomdExample
from drivax.datasets.womd_scenario import WomdScenario
from drivax.errors import DataError, UsageError

#: Every reader; a new format is one module and one entry here.
READERS: tuple[Reader, ...] = (WomdScenario(), WomdExample())
AUTO = "auto"


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


def detect(path: str | Path) -> Reader:
    """The reader whose format a file's content is.

    Raises:
        DataError: The file is missing, damaged at its beginning, or of no format that drivax reads.
    """
    path = Path(path)
    for reader in READERS:
        if reader.recognise(path):
            return reader
    for _, record in read_records(path):
        if isinstance(record, DataError):
            raise record
        break
    raise DataError(
        "a TFRecord file whose records drivax does not know",
        file=path,
        cure=f"drivax reads {', '.join(reader.name for reader in READERS)} (WOMD's motion data set, not perception)",
    )


def find_files(src: str | Path, name: str = AUTO) -> tuple[list[Path], int]:
    """The files to read, sorted by path, and how many others a folder holds.

    A file given by name is always read. In a folder (searched to any depth, hidden names left out) those count that
    are called as the format's files are, damaged ones included, or whose content is of the format.

    Args:
        src: A file or a folder.
        name: A format, or ``auto`` for all of them.

    Raises:
        DataError: ``src`` does not exist, or the folder holds no file of a known format.
        UsageError: There is no such format.
    """
    src = Path(src)
    readers = READERS if name == AUTO else (reader_named(name),)
    if not src.exists():
        raise DataError("does not exist", file=src, cure="check the path")
    if not src.is_dir():
        return [src], 0
    inside = [
        path for path in sorted(src.rglob("*")) if path.is_file() and not _hidden(path.relative_to(src))
    ]
    files = [path for path in inside if any(_belongs(path, reader) for reader in readers)]
    if not files:
        known = ", ".join(reader.name for reader in readers)
        raise DataError(
            f"none of the {len(inside)} files in it is of a known format ({known})",
            file=src,
            cure="name the folder that holds the downloaded shards",
        )
    return files, len(inside) - len(files)


def _hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def _belongs(path: Path, reader: Reader) -> bool:
    return any(path.match(pattern) for pattern in reader.patterns) or reader.recognise(path)
