"""User errors in one line: problem, location and cure."""

from __future__ import annotations

import contextlib
import difflib
import errno
import importlib
import os
import re
import resource
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from drivax.escaping import escape_controls

__all__ = ["DataError", "DrivaxError", "UsageError"]

#: Purpose of every extra, and the modules that it installs.
EXTRAS = {
    "womd": ("Waymo, ScenarioMax", ("google.protobuf", "google_crc32c")),
    "av2": ("Argoverse 2", ("pyarrow",)),
    "maps": ("nuPlan, Argoverse 2, nuScenes", ("shapely", "pyproj")),
    "show": ("pictures and videos", ("matplotlib", "av")),
    "track": ("TensorBoard", ("tensorboardX",)),
    "gym": ("Gymnasium", ("gymnasium",)),
    "minari": ("Minari", ("minari", "h5py")),
}
#: Maximum length of a problem, record or cure, in characters; longer texts, which quote a value, keep both ends.
_LONGEST = 1000
#: Cure of a full disk.
MAKE_ROOM = "make room, or choose another disk"
_NO_PERMISSION = "change the permissions of the file or of its folder, or choose another"
_UNREACHABLE = (
    errno.ESTALE, errno.EIO, errno.ENXIO, errno.ENOTCONN, errno.ETIMEDOUT, errno.EHOSTDOWN, errno.ENODEV
)  # fmt: skip
#: Cures of failures of files and disks.
_DISK_CURES = {
    errno.ENOENT: "check the path, and that its disk is mounted",
    errno.EROFS: "choose a folder on a disk that can be written",
    errno.EFBIG: "raise the limit of file sizes: ulimit -f unlimited",
    errno.ENAMETOOLONG: "choose a shorter name",
    **dict.fromkeys((errno.EACCES, errno.EPERM), _NO_PERMISSION),
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), MAKE_ROOM),
    **dict.fromkeys(_UNREACHABLE, "mount the disk again or check it, then repeat the command"),
}
_LESS_MEMORY = "use fewer --workers or a smaller --batch, or raise the limit: ulimit -v unlimited"
#: Limits of a process by error number: name, resource, and cure with a placeholder for twice the limit.
_LIMITS = {
    errno.EMFILE: ("open files", resource.RLIMIT_NOFILE, "raise the limit: ulimit -n {}, or use fewer --workers"),
    errno.ENOMEM: ("memory in kB", resource.RLIMIT_AS, _LESS_MEMORY),
    errno.EAGAIN: ("processes and threads", resource.RLIMIT_NPROC, "raise the limit: ulimit -u {}, or end processes"),
}  # fmt: skip
#: How TensorStore quotes the number of a system error.
_QUOTED_NUMBER = re.compile(r"\[os_error_code='(\d+)'\]")
#: Address space below which JAX aborts a process (bytes).
_LEAST_MEMORY = 1400 << 20


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
        self.problem = _shorten(problem)
        self.file = None if file is None else Path(file)
        self.record = _shorten(record) if isinstance(record, str) else record
        self.cure = None if cure is None else _shorten(cure)
        super().__init__(self.problem)

    def __reduce__(self) -> tuple[Any, ...]:
        # Worker processes send errors back; the default would call __init__ with positional arguments.
        return type(self), (self.problem,), {"file": self.file, "record": self.record, "cure": self.cure}

    def __str__(self) -> str:
        location = "" if self.file is None else f"{escape_controls(self.file)}: "
        if self.record is not None:
            location += f"record {escape_controls(self.record)}: "
        cure = "" if self.cure is None else f"; {self.cure}"
        return escape_controls(" ".join(f"{location}{self.problem}{cure}".split()))


def _shorten(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[:700]} ... {text[-200:]}"


class DataError(DrivaxError):
    """A file, shard or record is damaged, missing, of the wrong kind, or of an unknown version."""


class UsageError(DrivaxError):
    """The command, an option or a configuration value is invalid."""

    status = 2


def explain_system(error: BaseException, file: str | Path | None = None) -> DrivaxError | None:
    """Return the error that explains a failure of a file or disk (DataError) or a limit of this process (UsageError).

    The result names ``file`` if the system's error names none. It is None for all other errors.
    """
    number = getattr(error, "errno", None)
    if isinstance(error, MemoryError):
        number = errno.ENOMEM
    elif isinstance(error, RuntimeError) and "can't start new thread" in str(error):
        number = errno.EAGAIN
    elif not isinstance(error, OSError) or number is None:
        return None
    file, problem = getattr(error, "filename", None) or file, os.strerror(number).lower()
    if number in _LIMITS:
        name, kind, cure = _LIMITS[number]
        limit = resource.getrlimit(kind)[0]
        size = limit // 1024 if number == errno.ENOMEM else limit
        text, twice = ("none", "unlimited") if limit == resource.RLIM_INFINITY else (size, 2 * size)
        return UsageError(f"{problem} (limit of {name}: {text})", file=file, cure=cure.format(twice))
    return DataError(problem, file=file, cure=_DISK_CURES[number]) if number in _DISK_CURES else None


def explain_library(error: BaseException) -> DrivaxError | None:
    """Apply :func:`explain_system` to the system error that TensorStore or XLA quotes; None without one.

    Use it only for errors that end a command: an error about a damaged file may quote untrusted text.
    """
    if quoted := _QUOTED_NUMBER.search(str(error)):
        return explain_system(OSError(int(quoted[1]), quoted[0]))
    is_memory = isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED: Out of memory" in str(error)
    return explain_system(MemoryError()) if is_memory else None


def check_memory_limit() -> None:
    """Raise a UsageError if the memory limit of this process is so low that JAX would abort it."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < _LEAST_MEMORY:
        least, limit = _LEAST_MEMORY // 1024, limit // 1024
        problem = f"JAX needs {least} kB of memory, the limit of this process is {limit}"
        raise UsageError(problem, cure="raise the limit: ulimit -v unlimited")


def not_installed(extra: str, modules: Iterable[str]) -> UsageError:
    """Return the error for modules of an extra that are not installed."""
    names = [module.rpartition(".")[2] for module in modules]
    problem = f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} not installed"
    return UsageError(problem, cure=f"pip install 'drivax[{extra}]'")


def missing_package(error: ImportError) -> UsageError | None:
    """Return the error for an optional package that is not installed; None if it is broken, or belongs to no extra."""
    package = (error.name or str(error)).split(".")[0]
    for extra, (_, modules) in EXTRAS.items():
        for module in modules:
            if module.split(".")[0] == package and isinstance(error, ModuleNotFoundError):
                return not_installed(extra, [module])
    return None


@contextlib.contextmanager
def explain_missing_package() -> Iterator[None]:
    """Raise a UsageError when the block imports a package of an extra that is not installed."""
    try:
        yield
    except ImportError as error:
        raise missing_package(error) or error from error


def import_extra(package: str) -> Any:
    """Import a package of an extra.

    Raises:
        UsageError: The package is not installed.
    """
    with explain_missing_package():
        return importlib.import_module(package)


def did_you_mean(
    name: str, names: Iterable[str], *, otherwise: str | None = None, aliases: Mapping[str, str] | None = None,
    cutoff: float = 0.6,
) -> str:  # fmt: skip
    """Return the cure for an unknown name: the closest known name, else ``otherwise``, else all known names.

    Args:
        name: The unknown name.
        names: The known names.
        otherwise: Cure if no known name is close.
        aliases: Known name behind each further name to compare with.
        cutoff: Least similarity of a close name, 0 to 1.
    """
    candidates = list(names)
    targets = {**(aliases or {}), **dict(zip(candidates, candidates, strict=True))}
    if matches := difflib.get_close_matches(name, targets, n=1, cutoff=cutoff):
        return f"did you mean {targets[matches[0]]!r}?"
    if otherwise is not None:
        return otherwise
    return f"use one of {', '.join(candidates)}" if candidates else "there are none"
