"""Output files and folders: checked before the work, written under a hidden name, published by one rename.

While the folder ``sets/a`` is being written, ``sets/.a.partial`` holds::

    lock           held by the process that writes
    identity.json  what is being made; only the same is continued
    progress/      one note per part that is finished and on the disk
    content/       what will be ``sets/a``
    spool*/        whatever the writer needs in the meantime
"""

from __future__ import annotations

import contextlib
import fcntl
import glob
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from drivax.errors import UsageError


def sync_and_close(file: IO[bytes]) -> None:
    """Bring a file to the disk and close it."""
    file.flush()
    os.fsync(file.fileno())
    file.close()


def sync_folder(folder: Path) -> None:
    """Bring a folder's names to the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def check_output(path: Path, overwrite: bool, *, folder: bool = False) -> None:
    """Refuse an output that exists, before any work is done.

    Args:
        path: The file, or the folder, to be written.
        overwrite: Whether an existing one of the same kind may be replaced.
        folder: Whether a folder is to be written.

    Raises:
        UsageError: It exists and ``overwrite`` is not given, or it is a file where a folder is to be written, or the
            other way round.
    """
    if not path.exists():
        return
    if path.is_dir() != folder:
        there, wanted = ("a folder", "file") if path.is_dir() else ("a file", "folder")
        raise UsageError(f"output is {there}", file=path, cure=f"name a {wanted} to write")
    if not overwrite:
        kind = "folder" if folder else "file"
        raise UsageError(
            f"output {kind} already exists", file=path, cure="choose another or pass --overwrite"
        )


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[IO[bytes]]:
    """Yield a binary file that takes the name ``path`` once it is complete and on the disk; an error leaves nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial-{os.getpid()}")
    try:
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
        sync_folder(path.parent)
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_write(path) as file:
        file.write(text.encode())


def write_json(path: Path, value: Any) -> None:
    """Write strict JSON atomically."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False))


@contextlib.contextmanager
def replace_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder that takes the place of ``path`` once it is complete; an error changes nothing there."""
    partial, old = (path.parent / f".{path.name}.{name}-{os.getpid()}" for name in ("partial", "old"))
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        if path.exists():
            path.rename(old)
        partial.rename(path)
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


class PartialFolder:
    """The folder in which another one is made.

    Args:
        path: What it will become.
        identity: What is being made, as JSON values by name. None: it is made in one go, under a name of this
            process, and nothing is left of a failure.
    """

    def __init__(self, path: Path, identity: Mapping[str, Any] | None = None) -> None:
        self.path = path
        self.identity = None if identity is None else json.loads(json.dumps(identity))
        self.root = (
            _root(path) if identity is not None else path.parent / f".{path.name}.partial-{os.getpid()}"
        )
        self.content = self.root / "content"
        self._lock: IO[bytes] | None = None

    def open(self, anew: bool = False) -> list[dict[str, Any]]:
        """Take the folder; returns the notes on the parts that an earlier process finished, in order.

        Args:
            anew: Start anew where the folder was begun for something else.

        Raises:
            UsageError: Another process writes it, or it was begun for something else.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._take_lock()
        try:
            notes = self._notes(anew)
        except BaseException:
            self._release()
            raise
        if not notes:
            self._begin()
        return notes

    def note(self, number: int, value: Mapping[str, Any]) -> None:
        """Say that part ``number`` (from 0) is finished and on the disk."""
        if self.identity is not None:
            sync_folder(self.content)
            write_json(self.root / "progress" / f"{number:05d}.json", value)

    def publish(self) -> None:
        """Give the content its name, in place of whatever has it, and remove the rest."""
        sync_folder(self.content)
        old = self.path.parent / f".{self.path.name}.old-{os.getpid()}"
        if self.path.exists():
            self.path.rename(old)
        self.content.rename(self.path)
        sync_folder(self.path.parent)
        for replaced in self.path.parent.glob(f".{glob.escape(self.path.name)}.old-*"):
            shutil.rmtree(replaced, ignore_errors=True)

    def close(self) -> None:
        """Let go; what is finished is kept for a process that continues, the rest is removed."""
        kept = ("content", "progress", "identity.json", "lock")
        finished = self.content.is_dir() and any((self.root / "progress").glob("*.json"))
        self._clear(kept if finished else ("lock",))
        if not finished:  # the lock last: nobody may move in while something is still being removed
            (self.root / "lock").unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                self.root.rmdir()
        self._release()

    def _notes(self, anew: bool) -> list[dict[str, Any]]:
        if self.identity is None:
            return []
        begun = _read_json(self.root / "identity.json")
        if isinstance(begun, dict) and begun != self.identity and not anew:
            differ = [name for name in self.identity if begun.get(name) != self.identity[name]]
            raise UsageError(
                f"was begun before and not finished, from other data or with other options ({', '.join(differ)})",
                file=self.path,
                cure="finish it with the options that it was begun with, or pass --overwrite to start anew",
            )
        notes: list[dict[str, Any]] = []
        while begun == self.identity and self.content.is_dir():
            note = _read_json(self.root / "progress" / f"{len(notes):05d}.json")
            if note is None:
                break
            notes.append(note)
        return notes

    def _begin(self) -> None:
        self._clear(("lock",))
        self.content.mkdir()
        if self.identity is not None:
            (self.root / "progress").mkdir()
            write_json(self.root / "identity.json", self.identity)

    def _clear(self, kept: tuple[str, ...]) -> None:
        for inside in self.root.iterdir():
            if inside.name in kept:
                continue
            if inside.is_dir():
                shutil.rmtree(inside, ignore_errors=True)
            else:
                inside.unlink()

    def _take_lock(self) -> None:
        while True:
            self.root.mkdir(exist_ok=True)
            try:
                file = (self.root / "lock").open("wb")
            except FileNotFoundError:  # its last owner finished, and removed it, in between
                continue
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                held = os.fstat(file.fileno()).st_ino == (self.root / "lock").stat().st_ino
            except BlockingIOError as error:
                file.close()
                raise UsageError(
                    "another process is writing it",
                    file=self.path,
                    cure="wait for it, or choose another name",
                ) from error
            except FileNotFoundError:
                held = False
            if held:
                self._lock = file
                return
            file.close()

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def begun(path: Path) -> bool:
    """Whether ``path`` was begun, not finished, and can be continued."""
    return any((_root(path) / "progress").glob("*.json"))


def _root(path: Path) -> Path:
    return path.parent / f".{path.name}.partial"


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except (FileNotFoundError, ValueError):
        return None
