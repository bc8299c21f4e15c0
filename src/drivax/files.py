"""Output files and folders: checked before any work, written under a hidden name, and published by a rename.

While a process writes the folder ``sets/a``, ``sets/.a.partial`` has::

    lock           file locked by that process
    identity.json  description of the content; only the same content is resumed
    progress/      one note per finished part
    content/       becomes ``sets/a``
    spool*/        temporary files of the writer
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from drivax.errors import DataError, UsageError


class FullDiskError(DataError):
    """The disk is full; ``needed`` is the size of the output in bytes, 0 if unknown."""

    needed = 0


def sync_and_close(file: IO[bytes]) -> None:
    """Flush a file to disk and close it."""
    file.flush()
    os.fsync(file.fileno())
    file.close()


def sync_folder(folder: Path) -> None:
    """Flush the entries of a folder to disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def check_output(path: Path, overwrite: bool, *, folder: bool = False) -> None:
    """Check, before any work, that an output can be written.

    Raises:
        UsageError: The output exists and ``overwrite`` is false, or it is a file instead of a folder or vice versa.
    """
    if not path.exists():
        return
    kind, other = ("folder", "file") if folder else ("file", "folder")
    if path.is_dir() != folder:
        raise UsageError(f"output is a {other}", file=path, cure=f"name a {kind} to write")
    if not overwrite:
        raise UsageError(
            f"output {kind} already exists", file=path, cure="choose another or pass --overwrite"
        )


def free_bytes(path: Path) -> int:
    """Return the free bytes on the disk of a path, which need not exist."""
    path = path.absolute()
    while not path.exists():
        path = path.parent
    return shutil.disk_usage(path).free


def format_bytes(size: float) -> str:
    """Return a readable size: ``540 kB``, ``6.6 GB``, ``412 GB``."""
    for unit, scale in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if size >= scale:
            return f"{size / scale:.1f} {unit}" if size < 10 * scale else f"{size / scale:,.0f} {unit}"
    return f"{size / 1e3:.0f} kB" if size >= 1e3 else f"{size:.0f} bytes"


def check_space(path: Path, needed: int, cure: str = "make room, or choose another disk") -> None:
    """Check, before any work, that the disk has space for an output of about ``needed`` bytes.

    Raises:
        DataError: The disk has less space left.
    """
    if needed > (free := free_bytes(path)):
        problem = f"no space: needs about {format_bytes(needed)}, the disk has {format_bytes(free)} left"
        raise DataError(problem, file=path, cure=cure)


@contextlib.contextmanager
def explain_full_disk(path: Path, needed: int = 0) -> Iterator[None]:
    """Raise a FullDiskError that names ``path``, and ``needed`` bytes if known, when the block fills the disk.

    The operating system's error for a write names no file. Of nested blocks, the outermost one names the output, and
    the outermost one that knows them the bytes.
    """
    try:
        yield
    except Exception as error:
        if not _is_full_disk(error):
            raise
        needed = needed or getattr(error, "needed", 0)
        need = f"of about {format_bytes(needed)} needed" if needed else "more needed"
        problem = f"no space left on device ({format_bytes(free_bytes(path.parent))} free, {need})"
        full = FullDiskError(problem, file=path, cure="make room, or choose another disk")
        full.needed = needed
        raise full from error


def _is_full_disk(error: Exception) -> bool:
    """Whether the disk is full: a system error, or one of a library (TensorStore) that quotes it."""
    codes = (errno.ENOSPC, errno.EDQUOT)
    quoted = any(os.strerror(code) in str(error) for code in codes)
    return isinstance(error, FullDiskError) or getattr(error, "errno", None) in codes or quoted


@contextlib.contextmanager
def atomic_write(path: Path, needed: int = 0) -> Iterator[IO[bytes]]:
    """Yield a binary file that appears as ``path`` when the block ends; an error leaves nothing behind.

    A full disk is reported with the space that is free without the part that did fit, and the bytes ``needed``.
    """
    partial = path.with_name(f".{path.name}.partial-{os.getpid()}")
    with explain_full_disk(path, needed), contextlib.ExitStack() as cleanup:
        path.parent.mkdir(parents=True, exist_ok=True)
        cleanup.callback(partial.unlink, missing_ok=True)
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
        sync_folder(path.parent)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    content = text.encode()
    with atomic_write(path, len(content)) as file:
        file.write(content)


def write_json(path: Path, value: Any) -> None:
    """Write strict JSON atomically."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False))


@contextlib.contextmanager
def replace_folder(path: Path, needed: int = 0) -> Iterator[Path]:
    """Yield a new folder that replaces ``path`` when the block ends; an error leaves ``path`` unchanged.

    A full disk is reported as by :func:`atomic_write`.
    """
    partial = _hidden_path(path, f"partial-{os.getpid()}")
    shutil.rmtree(partial, ignore_errors=True)
    with explain_full_disk(path, needed), contextlib.ExitStack() as cleanup:
        cleanup.callback(shutil.rmtree, partial, ignore_errors=True)
        partial.mkdir(parents=True)
        yield partial
        _publish(partial, path)


class PartialFolder:
    """A hidden folder whose content becomes ``path``, and which a later process can resume.

    Args:
        path: Final name of the content.
        identity: Description of the content as JSON values by name; without it, a failure removes the content.
    """

    def __init__(self, path: Path, identity: Mapping[str, Any] | None = None) -> None:
        self.path = path
        self.identity = None if identity is None else json.loads(json.dumps(identity))
        self.root = _hidden_path(path, "partial" if identity is not None else f"partial-{os.getpid()}")
        self.content = self.root / "content"
        self._lock: IO[bytes] | None = None

    def open(self, restart: bool = False) -> list[dict[str, Any]]:
        """Lock the folder and return the notes of the parts that an earlier process finished, in order.

        Args:
            restart: Discard unfinished content of another identity.

        Raises:
            UsageError: Another process is writing the folder, or its unfinished content has another identity.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._take_lock()
        try:
            notes = self._read_notes(restart)
        except BaseException:
            self._release()
            raise
        try:
            if not notes:
                self._start()
        except BaseException:
            self.close()
            raise
        return notes

    def note(self, number: int, value: Mapping[str, Any]) -> None:
        """Record that part ``number`` (from 0) is finished and on disk."""
        if self.identity is not None:
            sync_folder(self.content)
            write_json(self.root / "progress" / f"{number:05d}.json", value)

    def publish(self) -> None:
        """Rename the content to its final name, and replace an existing folder."""
        sync_folder(self.content)
        _publish(self.content, self.path)

    def close(self) -> None:
        """Release the lock, and remove all files but finished parts that a later process can resume."""
        names = ("content", "progress", "identity.json", "lock")
        resumable = self.content.is_dir() and any((self.root / "progress").glob("*.json"))
        self._clear(names if resumable else ("lock",))
        if not resumable:  # The lock goes last: another process must not start while files are being removed.
            (self.root / "lock").unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                self.root.rmdir()
        self._release()

    def _read_notes(self, restart: bool) -> list[dict[str, Any]]:
        if self.identity is None:
            return []
        identity = _read_json(self.root / "identity.json")
        if isinstance(identity, dict) and identity != self.identity and not restart:
            different = [name for name in self.identity if identity.get(name) != self.identity[name]]
            raise UsageError(
                f"an unfinished output was started with other data or other options ({', '.join(different)})",
                file=self.path,
                cure="finish it with the same options, or pass --overwrite to start again",
            )
        notes: list[dict[str, Any]] = []
        while identity == self.identity and self.content.is_dir():
            note = _read_json(self.root / "progress" / f"{len(notes):05d}.json")
            if note is None:
                break
            notes.append(note)
        return notes

    def _start(self) -> None:
        self._clear(("lock",))
        self.content.mkdir()
        if self.identity is not None:
            (self.root / "progress").mkdir()
            write_json(self.root / "identity.json", self.identity)

    def _clear(self, keep: tuple[str, ...]) -> None:
        for entry in self.root.iterdir():
            if entry.name in keep:
                continue
            if entry.is_dir():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink()

    def _take_lock(self) -> None:
        while self._lock is None:
            self.root.mkdir(exist_ok=True)
            try:
                file = (self.root / "lock").open("wb")
            except FileNotFoundError:  # The last owner finished and removed the folder in between.
                continue
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                is_current = os.fstat(file.fileno()).st_ino == (self.root / "lock").stat().st_ino
            except BlockingIOError as error:
                file.close()
                raise UsageError(
                    "another process is writing it",
                    file=self.path,
                    cure="wait for it, or choose another name",
                ) from error
            except FileNotFoundError:
                is_current = False
            if is_current:
                self._lock = file
            else:
                file.close()

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def can_resume(path: Path) -> bool:
    """Return whether ``path`` has finished parts that a later process can continue."""
    return any((_hidden_path(path, "partial") / "progress").glob("*.json"))


def _hidden_path(path: Path, suffix: str) -> Path:
    return path.parent / f".{path.name}.{suffix}"


def _publish(content: Path, path: Path) -> None:
    """Rename a complete folder to ``path``; remove the replaced folder, and leftovers of killed processes."""
    if path.exists():
        path.rename(_hidden_path(path, f"old-{os.getpid()}"))
    content.rename(path)
    sync_folder(path.parent)
    for leftover in path.parent.glob(f".{glob.escape(path.name)}.old-*"):
        shutil.rmtree(leftover, ignore_errors=True)


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except (FileNotFoundError, ValueError):
        return None
