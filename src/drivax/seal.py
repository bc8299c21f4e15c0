"""Seals: ``seal.json`` in a folder holds the SHA-256 of the files that decide results, and is written last.

A seal detects accidents and edits, not forgery: a forger can write the seal, too. Files without an entry, such
as the metrics of an unfinished training, are not checked; :func:`require_entries` detects a missing seal.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drivax.errors import DataError
from drivax.files import file_digest, write_json

SEAL = "seal.json"
#: Ends the name of a planner in tables that are made with edited files.
MARK = " (edited)"
_CURE = "restore it, run the command again, or use the edited file with --edited"
_RESTORE = "restore it, or run the command again"
#: Largest seal, and largest sealed file, in bytes.
_MOST_BYTES, _MOST_SEALED_BYTES = 1 << 20, 4 << 30


@dataclass(frozen=True)
class _Block:
    """State of :func:`allow_edited`: whether edited files may be used, and those that were noted, in order."""

    is_allowed: bool
    files: dict[str, None] = field(default_factory=dict)


_block: ContextVar[_Block | None] = ContextVar("block", default=None)


def seal(folder: Path, *names: str) -> None:
    """Record the present state of files in the seal of their folder: their SHA-256, or that they do not exist."""
    edited = edited_files(folder)  # Their entries do not change, so that they stay edited.
    digests = {name: _digest(folder / name) for name in names if str(folder / name) not in edited}
    write_json(folder / SEAL, {**_read(folder / SEAL), **digests}, follow=False)


def unseal(folder: Path, name: str) -> None:
    """Remove the entry of a file that is going to change."""
    entries = _read(folder / SEAL)
    if name in entries and str(folder / name) not in edited_files(folder):
        del entries[name]
        write_json(folder / SEAL, entries, follow=False)


def check_seal(file: Path) -> None:
    """Check that a file is as it was sealed, before it is read.

    Raises:
        DataError: The file changed, appeared or disappeared since, or the seal is damaged (:func:`refuse_edited`).
    """
    entries = _read(file.parent / SEAL)
    if file.name in entries and (digest := _digest(file)) != (sealed := entries[file.name]):
        problem = "changed since drivax wrote it" if sealed else "was added since drivax wrote its folder"
        refuse_edited(file, "is missing" if digest is None else problem)


def require_entries(folder: Path, *names: str) -> None:
    """Check that the seal of a folder that was sealed still exists and has entries for these files.

    Raises:
        DataError: The seal is missing or damaged, or lacks an entry (:func:`refuse_edited`).
    """
    entries = _read(folder / SEAL)
    if missing := [name for name in names if name not in entries]:
        has_seal = (folder / SEAL).exists()
        refuse_edited(folder / SEAL, f"lacks {missing[0]}" if has_seal else "is missing")


def refuse_edited(file: Path, problem: str, record: int | str | None = None) -> None:
    """Raise a DataError about an edited file, or note the file where edited files are allowed."""
    if not is_edited_allowed():
        raise DataError(problem, file=file, record=record, cure=_CURE)
    note_edited(str(file))


@contextlib.contextmanager
def allow_edited(is_allowed: bool = True) -> Iterator[None]:
    """Use edited files in the block instead of refusing them; all tables, pages and runs of the block say so.

    Without ``is_allowed``, edited files are refused, and only the edited files behind earlier runs are noted.
    """
    token = _block.set(_Block(is_allowed))
    try:
        yield
    finally:
        _block.reset(token)


@contextlib.contextmanager
def note_edits() -> Iterator[None]:
    """Note the edited files behind earlier runs in the block, unless an outer block does."""
    with contextlib.nullcontext() if _block.get() is not None else allow_edited(False):
        yield


def is_edited_allowed() -> bool:
    """Return whether edited files are used (:func:`allow_edited`)."""
    return (block := _block.get()) is not None and block.is_allowed


def note_edited(*files: str) -> None:
    """Note edited files that results of this block of :func:`allow_edited` depend on."""
    if (block := _block.get()) is not None:
        block.files.update(dict.fromkeys(files))


def edited_files(folder: Path | None = None) -> list[str]:
    """Return the edited files that this block of :func:`allow_edited` noted, of one folder if it is given."""
    block = _block.get()
    files = [] if block is None else block.files
    return [file for file in files if folder is None or Path(file).parent == folder]


def mark_edited(name: str, is_edited: object) -> str:
    """Return a name for tables, with :data:`MARK` if ``is_edited`` is true."""
    return f"{name}{MARK}" if is_edited and not name.endswith(MARK) else name


def _digest(file: Path) -> str | None:
    """Return the SHA-256 of a file (hex); None without the file."""
    from drivax.reading import check_regular, explain_damage  # imports NumPy, which --help does not wait for

    if not file.exists():
        return None
    check_regular(file, _RESTORE)
    with explain_damage(file, _RESTORE):
        if file.stat().st_size > _MOST_SEALED_BYTES:
            raise ValueError("larger than any sealed file")
        return file_digest(file)


def _read(file: Path) -> dict[str, Any]:
    """Return the entries of a seal; none without one."""
    from drivax.reading import parse_json, read_bytes

    data = read_bytes(file, _RESTORE, _MOST_BYTES) if file.exists() else b"{}"
    with contextlib.suppress(ValueError, RecursionError):
        entries = parse_json(data)
        if isinstance(entries, dict):
            return entries
    refuse_edited(file, "is damaged")
    return {}
