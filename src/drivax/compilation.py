"""The cache of compiled programs on disk: a command that ran before starts without compiling.

JAX stores each compiled program under a key of the program itself, its options and the version of jaxlib; this module
chooses the folder. A folder belongs to one version of jaxlib and one kind of processor. Its entries are machine code:
only the user may read and write them, and no folder of another user is used.
"""

from __future__ import annotations

import hashlib
import os
import platform
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from importlib import metadata
from pathlib import Path

#: Duration after which the compilation of a program is reported (s).
_PATIENCE_S = 2.0
#: Programs that compile faster are not stored (s): reading them takes as long.
_LEAST_COMPILE_S = 0.1
#: Size to which the cache is cut (bytes), and time since the last use of a file after which it may be deleted (s):
#: another process may still be writing a newer file.
_MAX_BYTES, _SETTLED_S = 2 << 30, 600.0


def use_compilation_cache(folder: str | Path | None = None, *, max_bytes: int = _MAX_BYTES) -> Path | None:
    """Store compiled programs on disk, and read those that are there; call it before the first computation.

    Every command does so unless it gets ``--no-cache``. Processes may share the folder. This call deletes the least
    recently used programs until ``max_bytes`` are left, but none that was used in the last ten minutes; later programs
    add to them. JAX warns of a damaged entry and compiles again.

    Args:
        folder: Folder of the cache; ``$XDG_CACHE_HOME/drivax`` or ``~/.cache/drivax`` by default. It is created with
            mode 0700.
        max_bytes: Total size of the cache after this call.

    Returns:
        The folder of this version and processor; None if it cannot be used (read-only, owned by another user, or
        without a home folder) or if ``JAX_COMPILATION_CACHE_DIR`` is set, which JAX itself follows.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return None
    try:
        top = _default_folder() if folder is None else Path(folder)
        programs = top / f"jax-{metadata.version('jaxlib')}-{_processor()}"
        for path in (top, programs):
            path.mkdir(0o700, parents=True, exist_ok=True)
            if path.stat().st_uid != os.getuid():
                return None
            path.chmod(0o700)
        _prune(top, max_bytes, keep=programs)
    except (OSError, RuntimeError):  # RuntimeError: the user has no home folder
        return None
    # Environment variables reach JAX if it is imported later, and the processes that this one starts.
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(programs)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", str(_LEAST_COMPILE_S))
    if jax := sys.modules.get("jax"):
        jax.config.update("jax_compilation_cache_dir", str(programs))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", _LEAST_COMPILE_S)
    return programs


def report_compilation(report: Callable[[str], None]) -> None:
    """Report once, in one line, that a program that is not in the cache takes long to compile."""
    import jax

    reported = threading.Event()
    timers: list[threading.Timer] = []

    def start(event: str, **_: object) -> None:
        if event == "/jax/compilation_cache/compile_requests_use_cache":
            timers.append(threading.Timer(_PATIENCE_S, report_once))
            timers[-1].daemon = True
            timers[-1].start()

    def stop(event: str, duration_secs: float, **_: object) -> None:
        if event == "/jax/core/compile/backend_compile_duration" and timers:
            timers.pop().cancel()

    def report_once() -> None:
        if not reported.is_set():
            reported.set()
            report("compiling (the first time only; may take half a minute)")

    jax.monitoring.register_event_listener(start)
    jax.monitoring.register_event_duration_secs_listener(stop)


def _default_folder() -> Path:
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (base if base.is_absolute() else Path.home() / ".cache") / "drivax"


def _processor() -> str:
    """Return eight hexadecimal digits that identify the kind of processor: XLA compiles for its instruction set."""
    kind = f"{platform.machine()} {platform.processor()}"
    with suppress(OSError):
        lines = set(Path("/proc/cpuinfo").read_text(errors="replace").splitlines())
        prefixes = ("model name", "flags", "Features")
        kind += " ".join(sorted(line for line in lines if line.startswith(prefixes)))
    return hashlib.sha256(kind.encode()).hexdigest()[:8]


def _prune(top: Path, max_bytes: int, keep: Path) -> None:
    """Delete the least recently used files of all versions until the rest fits, and empty folders except ``keep``.

    Files that were used in the last ten minutes stay.
    """
    files = []
    for path in top.glob("jax*/*"):
        with suppress(OSError):  # another process has deleted it
            status = path.stat()
            files.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    total = sum(size for _, size, _ in files)
    for last_use_s, size, path in sorted(files):
        if total <= max_bytes or last_use_s > time.time() - _SETTLED_S:
            break
        path.unlink(missing_ok=True)
        total -= size
    for version in set(top.glob("jax*")) - {keep}:
        with suppress(OSError):  # not empty
            version.rmdir()
