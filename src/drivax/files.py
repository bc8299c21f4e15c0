"""Output files and folders: checked before any work, written under a hidden name, and published by a rename.

While a process writes the folder ``sets/a``, ``sets/.a.partial`` has::

    lock           file locked by that process
    identity.json  description of the content; only the same content is resumed
    progress/      one note per finished part
    content/       becomes ``sets/a``
    old/           the replaced ``sets/a``, on file systems that cannot exchange two folders
    spool*/        temporary files of the writer

The next writer of ``sets/a`` takes over what a killed process left. If a note is damaged, too large or not a regular
file, its part is written again; other entries that drivax does not create there are removed. Symbolic links that the
user names as outputs are followed; links inside outputs, which may be hostile, are replaced or refused.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import hashlib
import json
import os
import re
import resource
import shutil
import stat
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from drivax.errors import MAKE_ROOM, DataError, UsageError

#: Flags of renameat2 (Linux): relative to the current folder, exchange both names.
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
#: Errors of file systems that cannot lock files or exchange two names.
_UNSUPPORTED = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.EXDEV)
#: Files of a partial folder; its other entries are folders.
_FILES = ("identity.json", "lock")
#: What a later process needs to resume a partial folder.
_RESUMABLE = ("content", "progress", *_FILES)
#: Largest identity and largest note that are read, in bytes.
_MOST_IDENTITY, _MOST_NOTE = 1 << 20, 64 << 20
#: Maximum number of values in a JSON text: each takes up to 200 bytes of memory. In recordings, maps and manifests a
#: value has 10 to 30 bytes; texts above 48 MiB, such as the manifests of large sets, may have a value per 12 bytes.
MOST_VALUES, _LEAST_VALUE_BYTES = 4 << 20, 12
#: Files that a process opens besides those of its data.
_OTHER_FILES = 128


class FullDiskError(DataError):
    """The disk is full; ``size`` is the size of the output in bytes, 0 if unknown."""

    size = 0


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
        cure = "choose another or pass --overwrite"
        raise UsageError(f"output {kind} already exists", file=path, cure=cure)


def path_end(path: Path, others: Iterable[Path]) -> str:
    """Return the shortest trailing part of a path that no path of ``others`` ends with, or the whole path."""
    parts, other_parts = path.parts, [other.parts for other in others]
    lengths = (n for n in range(1, len(parts)) if all(parts[-n:] != other[-n:] for other in other_parts))
    return str(Path(*parts[-next(lengths, len(parts)) :]))


def free_bytes(path: Path) -> int:
    """Return the free bytes on the disk of a path, which need not exist."""
    return _disk(path).free


def _disk(path: Path) -> Any:
    path = path.absolute()
    while not path.exists():
        path = path.parent
    return shutil.disk_usage(path)


def format_bytes(size: float) -> str:
    """Return a readable size: ``540 kB``, ``6.6 GB``, ``412 GB``."""
    for unit, scale in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if size >= scale:
            return f"{size / scale:.1f} {unit}" if size < 10 * scale else f"{size / scale:,.0f} {unit}"
    return f"{size / 1e3:.0f} kB" if size >= 1e3 else f"{size:.0f} bytes"


def parse_bytes(text: str) -> int:
    """Return the bytes of a size like ``2GB``, ``1.5 GB`` or ``800MB``, with the units of :func:`format_bytes`.

    Raises:
        UsageError: It is no size.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([kMGT])B\s*", text)
    if match is None:
        raise UsageError(f"invalid size {text!r}", cure="use a number and a unit: 800MB, 2GB")
    return int(float(match[1]) * {"k": 1e3, "M": 1e6, "G": 1e9, "T": 1e12}[match[2]])


def count_text(number: int, noun: str) -> str:
    """Return a number with its noun in the singular or plural."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def check_space(path: Path, size: int, cure: str = MAKE_ROOM) -> None:
    """Check, before any work, that the disk has space for an output of about ``size`` bytes.

    Raises:
        DataError: The disk has less space left.
    """
    disk = _disk(path)
    if disk.total and size > disk.free:  # The total of /proc is 0: let the write fail.
        problem = f"no space: needs about {format_bytes(size)}, the disk has {format_bytes(disk.free)} left"
        raise DataError(problem, file=path, cure=cure)


@contextlib.contextmanager
def explain_full_disk(path: Path, size: int = 0) -> Iterator[None]:
    """Raise a FullDiskError that names ``path``, and the ``size`` of the output, when the block fills the disk.

    The operating system's error for a write names no file. Of nested blocks, the outermost names the output; the size
    is that of the outermost block that has one. Other system errors get ``path`` as filename if they name no file, or a
    hidden one.
    """
    try:
        yield
    except Exception as error:
        if not _is_full_disk(error):
            if isinstance(error, OSError) and error.errno and ".partial" in str(error.filename or ".partial"):
                error.filename = str(path)
            raise
        size = size or getattr(error, "size", 0)
        need = f"of about {format_bytes(size)} needed" if size else "more needed"
        problem = f"no space left on device ({format_bytes(free_bytes(path.parent))} free, {need})"
        full = FullDiskError(problem, file=path, cure=MAKE_ROOM)
        full.size = size
        raise full from error


def _is_full_disk(error: Exception) -> bool:
    """Return whether an error means a full disk: a system error, or a library's (TensorStore) that quotes one."""
    codes = (errno.ENOSPC, errno.EDQUOT)
    has_code = isinstance(error, FullDiskError) or getattr(error, "errno", None) in codes
    return has_code or any(os.strerror(code) in str(error) for code in codes)


@contextlib.contextmanager
def atomic_write(path: Path, size: int = 0, follow: bool = True) -> Iterator[IO[bytes]]:
    """Yield a binary file that appears as ``path`` when the block ends; an error leaves no file behind.

    A full disk is reported with ``size`` in bytes, and with the space that is free once the incomplete file is deleted.
    With ``follow``, a symbolic link stays, and the file that it leads to is written.
    """
    target = _follow(path) if follow else path
    partial = _hidden_path(target)
    if _has_kind(partial, folder=True):  # of an output folder: refuse if it is in use, else remove it
        folder = PartialFolder(target)
        folder.open()
        folder.close()
    with explain_full_disk(path, size), _open_locked(partial, wait=True) as file:
        try:
            file.truncate()  # a killed process may have left it
            yield file
            file.flush()
            os.fsync(file.fileno())
            partial.replace(target)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
        sync_folder(target.parent)


def write_text(path: Path, text: str, follow: bool = True) -> None:
    """Write a text file as :func:`atomic_write` does."""
    content = text.encode()
    with atomic_write(path, len(content), follow) as file:
        file.write(content)


def write_json(path: Path, value: Any, follow: bool = True) -> None:
    """Write strict JSON as :func:`atomic_write` does."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False), follow)


def inside(folder: Path, *names: str) -> Path:
    """Return ``folder/names[0]/names[1]/...``, to write there; ``folder`` itself may be a symbolic link.

    Raises:
        DataError: One of the names is a symbolic link, which in an untrusted folder could lead anywhere.
    """
    path = folder
    for name in names:
        path /= name
        if path.is_symlink():
            raise DataError(
                "is a symbolic link", file=path, cure="replace the link with its target, or remove it"
            )
    return path


def file_digest(path: Path) -> str:
    """Return the SHA-256 (hex) of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextlib.contextmanager
def replace_folder(path: Path, size: int = 0) -> Iterator[Path]:
    """Yield a new folder that replaces ``path`` when the block ends; an error leaves ``path`` unchanged.

    A full disk is reported as by :func:`atomic_write`.
    """
    partial = PartialFolder(path)
    with explain_full_disk(path, size), contextlib.ExitStack() as cleanup:
        partial.open(restart=True)
        cleanup.callback(partial.close)
        yield partial.content
        partial.publish()


class PartialFolder:
    """A hidden folder whose content becomes ``path``, and which a later process can resume.

    Args:
        path: Final name of the content.
        identity: Description of the content as JSON values by name; without it, a failure removes the content.
    """

    def __init__(self, path: Path, identity: Mapping[str, Any] | None = None) -> None:
        self.path = path
        self.identity = None if identity is None else json.loads(json.dumps(identity))
        self._target = _follow(path)
        self.root = _hidden_path(self._target)
        self.content, self._old = self.root / "content", self.root / "old"
        self._lock: IO[bytes] | None = None
        self._new_parents: list[Path] = []

    def open(self, restart: bool = False) -> list[dict[str, Any]]:
        """Lock the folder and return the intact notes of the parts that an earlier process finished, in order.

        Args:
            restart: Discard unfinished content of another identity.

        Raises:
            UsageError: Another process is writing the folder, or its unfinished content has another identity.
        """
        self._new_parents = [parent for parent in self._target.parents if not parent.exists()]
        try:
            self._take_lock()
            self._restore()
            notes = self._read_notes(restart)
        except BaseException:
            self._release()
            raise
        try:
            _clear(self.root, _RESUMABLE if notes else ("lock",))
            if not notes:
                self._start()
            elif self.identity is not None:
                _clear(self.root / "progress", {_note_name(number) for number in range(len(notes))})
        except BaseException:
            self.close()
            raise
        return notes

    def note(self, number: int, value: Mapping[str, Any]) -> None:
        """Record that part ``number`` (from 0) is on disk; :meth:`open` of a later process returns ``value``."""
        if self.identity is not None:
            sync_folder(self.content)
            write_json(self.root / "progress" / _note_name(number), _sealed_note(number, value))

    def publish(self) -> None:
        """Rename the content to its final name; an existing folder keeps the name until that moment."""
        sync_folder(self.content)
        if not self._target.exists():
            self.content.rename(self._target)
        elif not _exchange(self.content, self._target):
            # A process killed between these two lines is repaired by the next one that opens the folder.
            self._target.rename(self._old)
            self.content.rename(self._target)
        sync_folder(self._target.parent)
        shutil.rmtree(self.root / "progress", ignore_errors=True)  # `content` may be the replaced folder
        self._new_parents = []

    def close(self) -> None:
        """Release the lock, and remove all files but finished parts that a later process can resume."""
        self._restore()
        resumable = self.content.is_dir() and any((self.root / "progress").glob("*.json"))
        _clear(self.root, _RESUMABLE if resumable else ("lock",))
        if not resumable:  # The lock goes last: another process must not start while files are being removed.
            (self.root / "lock").unlink(missing_ok=True)
            for folder in (self.root, *self._new_parents):
                with contextlib.suppress(OSError):  # not empty
                    folder.rmdir()
        self._release()

    def restore(self) -> None:
        """Restore the name of a folder if a process was killed while it replaced the folder."""
        if not self._target.exists() and self._old.is_dir():
            # The process is still running, or the disk is read-only.
            with contextlib.suppress(UsageError, OSError):
                self._take_lock()
                self.close()
            self._release()

    def _restore(self) -> None:
        if self._old.is_dir() and not self._target.exists():
            self._old.rename(self._target)

    def _read_notes(self, restart: bool) -> list[dict[str, Any]]:
        identity = _read_json(self.root / "identity.json", _MOST_IDENTITY)
        if isinstance(identity, dict) and identity != self.identity and not restart and can_resume(self.path):
            expected = self.identity or {}
            names = ", ".join(name for name in expected if identity.get(name) != expected[name]) or "command"
            problem = f"an unfinished output was started with other data or other options ({names})"
            cure = "finish it with the same options, or pass --overwrite to start again"
            raise UsageError(problem, file=self.path, cure=cure)
        notes: list[dict[str, Any]] = []
        while self.identity is not None and identity == self.identity and self.content.is_dir():
            note = _read_json(self.root / "progress" / _note_name(len(notes)), _MOST_NOTE)
            if not isinstance(note, dict) or note != _sealed_note(len(notes), note.get("value")):
                break
            notes.append(note["value"])
        return notes

    def _start(self) -> None:
        self.content.mkdir()
        if self.identity is not None:
            (self.root / "progress").mkdir()
            write_json(self.root / "identity.json", self.identity)

    def _take_lock(self) -> None:
        _remove_foreign(self.root, folder=True)
        try:
            self._lock = _open_locked(self.root / "lock")
        except BlockingIOError as error:
            cure = "wait for it, or choose another name"
            raise UsageError("another process is writing it", file=self.path, cure=cure) from error
        for entry in self.root.iterdir():
            _remove_foreign(entry, folder=entry.name not in _FILES)

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def can_resume(path: Path) -> bool:
    """Return whether ``path`` has finished parts that a later process can continue."""
    return any((_hidden_path(_follow(path)) / "progress").glob("*.json"))


def restore_folder(path: Path) -> None:
    """Restore the name ``path`` of a folder if a process was killed while it replaced the folder."""
    PartialFolder(path).restore()


def allow_open_files(path: Path, number: int) -> None:
    """Raise the limit of open files so that ``number`` files of a folder can be open at a time.

    Raises:
        UsageError: The system allows fewer.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    total, infinity = number + _OTHER_FILES, resource.RLIM_INFINITY
    if soft == infinity or total <= soft:
        return
    if hard != infinity and total > hard:
        problem = f"needs {total} open files, the limit is {hard}"
        raise UsageError(problem, file=path, cure=f"raise it: ulimit -Hn {total}, or use a larger shard size")
    resource.setrlimit(resource.RLIMIT_NOFILE, (total, hard))


def _follow(path: Path) -> Path:
    """Return the path behind symbolic links; a rename of the path itself would replace the link."""
    return Path(os.path.realpath(path))


def remove(path: Path) -> None:
    """Remove a folder with its content, a file, or a symbolic link but not its target."""
    if _has_kind(path, folder=True):
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _has_kind(path: Path, folder: bool) -> bool:
    """Return whether a path itself is a folder or, without ``folder``, a regular file; a link or pipe is neither."""
    try:
        mode = path.lstat().st_mode
    except OSError:
        return False
    return stat.S_ISDIR(mode) if folder else stat.S_ISREG(mode)


def _remove_foreign(path: Path, folder: bool) -> None:
    """Remove an entry that is not of the kind, folder or regular file, that drivax creates under its name."""
    if not _has_kind(path, folder):
        remove(path)


def _clear(folder: Path, keep: Collection[str]) -> None:
    """Remove all but some entries of a folder."""
    for entry in folder.iterdir():
        if entry.name not in keep:
            remove(entry)


def _note_name(number: int) -> str:
    return f"{number:05d}.json"


def _hidden_path(path: Path) -> Path:
    return path.parent / f".{path.name}.partial"


def _open_locked(path: Path, wait: bool = False) -> IO[bytes]:
    """Open or create a file, and lock it; if another process holds the lock, ``wait`` or raise BlockingIOError."""
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError), contextlib.ExitStack() as cleanup:
            _remove_foreign(path, folder=False)
            path.touch()
            file = cleanup.enter_context(path.open("r+b"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            except OSError as error:
                if error.errno not in _UNSUPPORTED:
                    raise
            # The previous owner of the lock may have renamed or removed the file in the meantime.
            if os.fstat(file.fileno()).st_ino == path.stat().st_ino:
                cleanup.pop_all()
                return file


def _exchange(first: Path, second: Path) -> bool:
    """Exchange the names of two folders atomically; return False if the system or file system cannot."""
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)  # Linux only
    if rename is None:
        return False
    if rename(_AT_FDCWD, os.fsencode(first), _AT_FDCWD, os.fsencode(second), _RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number not in _UNSUPPORTED:
        raise OSError(number, os.strerror(number), str(second))
    return False


def _sealed_note(number: int, value: Any) -> dict[str, Any]:
    """Return a note: a value, and the SHA-256 (hex) of number and value as JSON with sorted keys."""
    digest = hashlib.sha256(json.dumps([number, value], sort_keys=True).encode()).hexdigest()
    return {"sha256": digest, "value": value}


def parse_json(data: bytes) -> Any:
    """Parse JSON text after counting its values: text such as ``[0],`` takes 30 times its bytes in memory.

    Raises:
        ValueError: The text is not JSON, or has too many values.
        RecursionError: The text is nested too deeply.
    """
    # An upper bound: texts may contain these characters, too.
    count, most = sum(map(data.count, (b",", b"[", b"{"))), max(MOST_VALUES, len(data) // _LEAST_VALUE_BYTES)
    if count > most:
        raise ValueError(f"{count:,} values, more than the {most:,} that are read")
    return json.loads(data)


def _read_json(path: Path, most: int) -> Any:
    """Return the content of a JSON file; None if it is invalid, larger than ``most`` bytes, or not a regular file."""
    try:
        if _has_kind(path, folder=False) and path.stat().st_size <= most:
            return parse_json(path.read_bytes())
    except (ValueError, RecursionError, MemoryError):
        pass
    return None
