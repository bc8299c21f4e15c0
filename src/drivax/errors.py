"""User errors in one line: what is wrong, where, and what to do about it."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

#: Extra that installs a package, by its import name.
_EXTRAS = {
    "google": "womd", "google_crc32c": "womd", "pyarrow": "av2", "shapely": "maps", "pyproj": "maps",
    "matplotlib": "show", "av": "show", "tensorboardX": "track", "gymnasium": "gym",
}  # fmt: skip
#: Characters of the longest problem that is kept in full; of others, which quote a value, only the ends.
_LONGEST = 1000


class DrivaxError(Exception):
    """A failure that the user can fix; the command line prints it as one line and exits with ``status``.

    Args:
        problem: What is wrong, without a trailing full stop.
        file: The file or folder.
        record: The record inside the file (number or id).
        cure: What to do about it, without a trailing full stop.
    """

    status = 1

    def __init__(
        self,
        problem: str,
        *,
        file: str | Path | None = None,
        record: int | str | None = None,
        cure: str | None = None,
    ) -> None:
        self.problem = problem if len(problem) <= _LONGEST else f"{problem[:700]} ... {problem[-200:]}"
        self.file = None if file is None else Path(file)
        self.record = record
        self.cure = cure
        super().__init__(problem)

    def __reduce__(self) -> tuple[Any, ...]:
        # Worker processes send errors back; the default would call __init__ with positional arguments.
        return type(self), (self.problem,), {"file": self.file, "record": self.record, "cure": self.cure}

    def __str__(self) -> str:
        location = "" if self.file is None else f"{self.file}: "
        if self.record is not None:
            location += f"record {self.record}: "
        cure = "" if self.cure is None else f"; {self.cure}"
        return " ".join(f"{location}{self.problem}{cure}".split())


class DataError(DrivaxError):
    """A file, shard or record is damaged, missing, of the wrong kind, or of an unknown version."""


class UsageError(DrivaxError):
    """The command, an option or a configuration value is invalid."""

    status = 2


def missing_package(error: ImportError) -> UsageError | None:
    """Return the error for an optional package that is not installed, or None if no extra has it."""
    package = (error.name or str(error)).split(".")[0]
    if package not in _EXTRAS:
        return None
    name = "protobuf" if package == "google" else package
    return UsageError(f"{name} is not installed", cure=f"pip install 'drivax[{_EXTRAS[package]}]'")


def import_extra(package: str) -> Any:
    """Import a package of an extra.

    Raises:
        UsageError: The package is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise missing_package(error) or error from error


def did_you_mean(
    name: str, names: Iterable[str], *, otherwise: str | None = None, cutoff: float = 0.6
) -> str:
    """Return the cure for an unknown name: the closest known name, else ``otherwise``, else all known names."""
    candidates = list(names)
    if matches := difflib.get_close_matches(name, candidates, n=1, cutoff=cutoff):
        return f"did you mean {matches[0]!r}?"
    if otherwise is not None:
        return otherwise
    return f"use one of {', '.join(candidates)}" if candidates else "there are none"
