"""How one reading of a damaged or hostile file ends, by its time, its memory and its error."""

from __future__ import annotations

import re
import resource
import signal
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import jax

from drivax.errors import DrivaxError

#: Time and memory of one reading: the issue's bounds.
SECONDS, MEMORY = 30, 2 << 30
#: Longest message that still is one line.
LONGEST = 2000
#: How messages say that memory was not enough, which is never a refusal: the file decided how much is taken.
_OUT_OF_MEMORY = re.compile(r"MemoryError|allocate memory|out of memory|bad_alloc|malloc", re.IGNORECASE)


class Hang(BaseException):
    """A reading took too long."""


def _alarm(*_: object) -> None:
    raise Hang


def limit_memory(memory: int = MEMORY) -> None:
    """Refuse this process far more memory than a reading may take, so that the machine survives one that takes all."""
    jax.devices()  # takes a stack for each thread of the backend, many on a large machine
    most = _status("VmSize") + 2 * memory
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))


def lift_memory() -> None:
    """Undo :func:`limit_memory`."""
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (hard, hard))


def _status(name: str) -> int:
    """Return a size of this process from ``/proc``, in bytes."""
    (size,) = re.findall(rf"^{name}:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    return int(size) * 1024


def attempt(
    read: Callable[[], tuple[str, str | None]], refused: str, seconds: float = SECONDS, memory: int = MEMORY
) -> tuple[str, str | None]:
    """Read files, and return the end and what is wrong with it.

    Args:
        read: Reads the files, and returns the end and what is wrong.
        refused: End of an error of drivax in one line.
        seconds, memory: What the reading may take, bytes beyond what the process has.
    """
    signal.signal(signal.SIGALRM, _alarm)
    Path("/proc/self/clear_refs").write_text("5")  # The peak (VmHWM) becomes the present size.
    before, begin = _status("VmRSS"), time.monotonic()
    try:
        end, problem = _end(read, refused, seconds)
    except Hang:  # between the end of the reading and that of the alarm
        end, problem = "hang", "at its end"
    seconds_taken, taken = time.monotonic() - begin, _status("VmHWM") - before
    if taken > memory:
        return "memory", f"took {taken / 1e6:,.0f} MB; {end}: {problem}"
    if seconds_taken > seconds:
        return "hang", f"took {seconds_taken:.1f} s; {end}: {problem}"
    return end, problem


def _end(read: Callable[[], tuple[str, str | None]], refused: str, seconds: float) -> tuple[str, str | None]:
    signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)  # again, because callbacks of JAX swallow exceptions
    try:
        return read()
    except DrivaxError as error:
        return ("memory" if ran_out(error) else refused), complaint(error)
    except Hang:
        return "hang", traceback.format_exc()
    except BaseException as error:
        return ("memory" if ran_out(error) else "traceback"), traceback.format_exc()
    finally:
        with suppress(Hang):
            signal.setitimer(signal.ITIMER_REAL, 0)


def complaint(error: DrivaxError) -> str | None:
    """Return what is wrong with the message of an error; None for one line with a cure."""
    line = str(error)
    if "\n" in line or len(line) > LONGEST or not error.cure:
        return f"not one line with a cure: {line}"
    return f"memory: {line}" if ran_out(error) else None


def ran_out(error: BaseException | str) -> bool:
    """Return whether an error, or one behind it, says that memory was not enough."""
    if isinstance(error, str):
        return _OUT_OF_MEMORY.search(error) is not None
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, MemoryError) and not _is_parser(seen):
            return True
        if _OUT_OF_MEMORY.search(str(seen)):
            return True
        seen = seen.__cause__ or seen.__context__
    return False


def _is_parser(error: MemoryError) -> bool:
    """Whether it is Python's parser, which raises a MemoryError for text that is nested too deeply."""
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and Path(frames[-1].filename).name == "ast.py"
