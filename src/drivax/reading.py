"""Read untrusted files: sizes are checked before memory is allocated, and damage is reported in one line."""

from __future__ import annotations

import contextlib
import csv
import io
import lzma
import math
import stat
import struct
import threading
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from drivax.errors import DataError, explain_system
from drivax.escaping import csv_rows
from drivax.files import format_bytes, parse_json

Array = np.ndarray[Any, Any]
#: Shape and dtype.
ArrayType = tuple[tuple[int, ...], np.dtype[Any]]

#: Errors by which libraries report bytes that they cannot read. RuntimeError includes RecursionError (deep nesting) and
#: NotImplementedError, and is what ``zipfile`` raises for encrypted members.
DAMAGE = (
    ValueError, TypeError, LookupError, AttributeError, ArithmeticError, EOFError, SyntaxError, RuntimeError,
    SystemError, MemoryError, BufferError, csv.Error, struct.error, zipfile.BadZipFile, zlib.error, lzma.LZMAError,
    tokenize.TokenError,
)  # fmt: skip
#: Largest text file, in bytes: recordings and maps in JSON have 0.1 to 40 MB.
MOST_TEXT = 64 << 20
#: Longest line of a text, and longest row of a table, in characters: those of drivax have up to 5,000. A cell has at
#: most ``csv.field_size_limit`` (131,072).
MOST_LINE = 1 << 20
_HEADER_LIMIT = 100_000
#: One thread at a time parses headers: ``ast`` of Python 3.11 raises SystemError in concurrent threads.
_HEADER_LOCK = threading.Lock()


@contextlib.contextmanager
def explain_damage(file: Path, cure: str, problem: str = "is damaged") -> Iterator[None]:
    """Raise a DataError with file, cause and cure if the block fails to read or parse ``file``.

    Failures of the disk and limits of the process have their own cures (:func:`drivax.errors.explain_system`).
    """
    try:
        yield
    except FileNotFoundError as error:
        raise DataError("file not found", file=file, cure=cure) from error
    except (OSError, *DAMAGE) as error:
        if failure := explain_system(error, file):
            raise failure from error
        problem = "cannot be read" if isinstance(error, OSError) else problem
        raise DataError(f"{problem} ({_cause(error)})", file=file, cure=cure) from error


def _cause(error: BaseException) -> str:
    """Return the message of an error, which may be missing (EOFError) or a bare key."""
    if isinstance(error, RecursionError):
        return "nested too deeply"
    if isinstance(error, KeyError):
        return f"lacks {error}"
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return text or type(error).__name__


def check_regular(file: Path, cure: str) -> None:
    """Raise a DataError if a path is a pipe or device, which might never end, or a folder; a missing file passes."""
    # Not exists(), which takes a link to itself for a missing file.
    with explain_damage(file, cure), contextlib.suppress(FileNotFoundError):
        if not stat.S_ISREG(file.stat().st_mode):
            raise ValueError("not a regular file")


def check_size(file: Path, cure: str, most: int) -> None:
    """Raise a DataError if a file has more than ``most`` bytes."""
    if (size := file.stat().st_size) > most:
        problem = f"has {format_bytes(size)}, more than the {format_bytes(most)} that are read"
        raise DataError(problem, file=file, cure=cure)


def read_bytes(file: Path, cure: str, most: int = MOST_TEXT) -> bytes:
    """Return the content of a file.

    Raises:
        DataError: The file is missing, larger than ``most`` bytes, or not a regular file (a pipe might never end).
    """
    check_regular(file, cure)
    with explain_damage(file, cure):
        check_size(file, cure, most)
        return file.read_bytes()


def read_text(file: Path, cure: str, most: int = MOST_TEXT) -> str:
    """Return the content of a UTF-8 file.

    Raises:
        DataError: The file is missing, larger than ``most`` bytes, or not text.
    """
    data = read_bytes(file, cure, most)
    with explain_damage(file, cure, "is not text"):
        return data.decode()


def read_json(file: Path, cure: str, most: int = MOST_TEXT) -> Any:
    """Return the content of a JSON file.

    Raises:
        DataError: The file is missing, larger than ``most`` bytes, not JSON, nested too deeply, or has too many values.
    """
    data = read_bytes(file, cure, most)
    with explain_damage(file, cure, "is not valid JSON"):
        return parse_json(data)


def read_lines(file: Path, cure: str, most: int = MOST_TEXT) -> Iterator[str]:
    """Yield the lines of a UTF-8 file with their line endings, reading one at a time.

    Raises:
        DataError: The file is missing, larger than ``most`` bytes, or not text, or has a line of more than
            :data:`MOST_LINE` characters.
    """
    check_regular(file, cure)
    with explain_damage(file, cure, "cannot be read"):
        check_size(file, cure, most)
        with file.open(encoding="utf-8", newline="") as stream:
            while line := stream.readline(MOST_LINE + 1):
                _check_length(len(line))
                yield line


def read_csv(file: Path, cure: str, most: int = MOST_TEXT) -> Iterator[list[str]]:
    """Yield the rows of a CSV file, reading one at a time.

    Raises:
        DataError: As for :func:`read_lines`, whose limit also holds for rows of several lines; or a cell is too long.
    """
    length = 0

    def lines() -> Iterator[str]:
        nonlocal length
        for line in read_lines(file, cure, most):
            length += len(line)
            _check_length(length)
            yield line

    with explain_damage(file, cure, "cannot be read"):
        for row in csv_rows(lines()):
            length = 0
            yield row


def _check_length(length: int) -> None:
    if length > MOST_LINE:
        raise ValueError(f"a row of more than {MOST_LINE:,} characters")


def read_arrays(
    file: Path, cure: str, most: int, check: Callable[[Mapping[str, ArrayType]], None] | None = None
) -> dict[str, Array]:
    """Return the arrays of an ``.npz`` file by name; checksums are verified, objects are refused.

    ``check`` gets the shapes and types of all arrays by name before any is unpacked.

    Raises:
        DataError: The file is missing or damaged, or has more than ``most`` bytes, packed or unpacked.
    """
    content = io.BytesIO(read_bytes(file, cure, most))
    with explain_damage(file, cure, "not an .npz file, or damaged"), zipfile.ZipFile(content) as archive:
        members = archive.infolist()
        if (size := sum(member.file_size for member in members)) > most:
            raise ValueError(f"unpacks to {format_bytes(size)}, more than the {format_bytes(most)} expected")
        names = [member.filename.removesuffix(".npy") for member in members]
        if len(set(names)) < len(names):
            raise ValueError("a name occurs twice")
        if any(member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for member in members):
            raise ValueError("compressed by a method other than deflate")
        if check is not None:
            check(dict(zip(names, (_read_type(archive, member) for member in members), strict=True)))
        arrays = (parse_array(_unpack(archive, member)) for member in members)
        return dict(zip(names, arrays, strict=True))


def _read_type(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> ArrayType:
    with archive.open(member) as file:
        shape, _, dtype = read_array_header(cast(io.BufferedIOBase, file))
    return shape, dtype


def _unpack(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """Return the content of a member, up to the size that it states."""
    with archive.open(member) as file:
        # Without a length, zipfile unpacks 2 GiB at a time. One more byte reaches the end and verifies the checksum.
        return file.read(member.file_size + 1)


def parse_array(data: bytes) -> Array:
    """Return the array in ``.npy`` bytes, read-only; the header must state the size of the data.

    Raises:
        Exception: One of :data:`DAMAGE`.
    """
    stream = io.BytesIO(data)
    shape, is_fortran, dtype = read_array_header(stream)
    if dtype.hasobject:
        raise ValueError("an array of Python objects")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(data) - stream.tell():
        raise ValueError("an array whose length differs from its header")
    if not math.prod(shape) or not dtype.itemsize:
        return np.zeros(shape, dtype)
    flat = np.frombuffer(data, dtype, offset=stream.tell())
    return flat.reshape(shape, order="F" if is_fortran else "C")


def read_array_header(file: io.BufferedIOBase) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read shape, Fortran order and dtype of a ``.npy`` file; stop at the first byte of data.

    Raises:
        Exception: One of :data:`DAMAGE`.
    """
    with _HEADER_LOCK:
        version = np.lib.format.read_magic(file)
        try:
            if version == (1, 0):
                return np.lib.format.read_array_header_1_0(file, max_header_size=_HEADER_LIMIT)
            if version == (2, 0):
                return np.lib.format.read_array_header_2_0(file, max_header_size=_HEADER_LIMIT)
        except MemoryError as error:
            raise ValueError("header nested too deeply") from error  # The stack of Python's parser is full.
    raise ValueError(f"version {version} of the .npy format")
