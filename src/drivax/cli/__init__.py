"""The command line: one file per command.

``drivax.cli.<command>`` defines a frozen dataclass (``drivax.cli.train.Train``) from which tyro builds the flags, with
examples in its docstring, and ``run(args) -> int``. A command's modules are imported only when it runs, so that
``drivax --help`` answers at once. A command with ``overrides=True`` takes further ``--section.key VALUE`` settings of
its configuration, which ``run`` gets as a second argument.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import shutil
import signal
import sys
import textwrap
import threading
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from importlib import metadata
from inspect import getdoc
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeVar

from drivax.compilation import report_compilation, use_compilation_cache
from drivax.errors import (
    DrivaxError,
    UsageError,
    check_memory_limit,
    did_you_mean,
    explain_library,
    explain_system,
    missing_package,
)
from drivax.escaping import escape_controls, show

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Command:
    """A command: its line in the list of commands, and whether it takes settings of its configuration."""

    summary: str
    overrides: bool = False


#: Flags of all commands.
_FLAGS = ("--debug", "--no-cache", "--edited")
#: Width of tables and help that are not printed to a terminal, and the largest width of tables that are.
_COLUMNS = 100
#: Where Linux says which memory gets huge pages: ``always [madvise] never``.
_HUGE_PAGES = Path("/sys/kernel/mm/transparent_hugepage/enabled")
#: Ends of the paths of Python files whose functions no exception may interrupt.
_UNINTERRUPTIBLE_FILES = (
    "<frozen importlib._bootstrap>", "multiprocessing/popen_spawn_posix.py", "multiprocessing/resource_tracker.py",
    "multiprocessing/synchronize.py", "orbax/checkpoint/_src/asyncio_utils.py",
)  # fmt: skip
#: Delay until a signal that came during such a function is sent again, and time after which it is obeyed anyway, s.
_RESEND_S, _PATIENCE_S = 0.01, 10.0
COMMANDS = {
    "demo": Command("the whole pipeline on the built-in world: generate, train, evaluate, report"),
    "doctor": Command("what is installed, or what a file or folder contains"),
    "generate": Command("generate scenarios of the built-in world", overrides=True),
    "convert": Command("convert a public data set to a scenario set"),
    "export": Command("write a part of a set, or a set or episodes in another format", overrides=True),
    "merge": Command("merge several sets into one"),
    "inspect": Command("summarise, audit and verify scenario sets"),
    "view": Command("browse and play a scenario set on one HTML page"),
    "curate": Command("score how critical each scenario of a set is", overrides=True),
    "record": Command("record episodes of planners to learn from offline", overrides=True),
    "train": Command("train a planner from a configuration file", overrides=True),
    "evaluate": Command("evaluate a planner on a scenario set", overrides=True),
    "judge": Command("evaluate a run again by the rules of another program"),
    "compare": Command("test whether one planner is better than another", overrides=True),
    "study": Command("run an experiment with controls and verdicts", overrides=True),
    "report": Command("one HTML page from runs; or videos, or tables"),
    "bench": Command("measure the speed of the simulator on this machine", overrides=True),
}

Record = TypeVar("Record")


def record_of(cls: type[Record], args: Any, **values: Any) -> Record:
    """Return a configuration record from the flags of the same names; ``values`` replace flags."""
    names = [field.name for field in fields(cls) if field.name not in values]  # type: ignore[arg-type]
    return cls(**{name: getattr(args, name) for name in names}, **values)


def console() -> Console:
    """Return a console of at most 100 columns that prints text as it is."""
    from rich.console import Console

    width = min(_COLUMNS, Console().width) if sys.stdout.isatty() else _COLUMNS
    return Console(width=width, highlight=False, markup=False, emoji=False)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: Arguments without the program's name; those of the process by default.

    Returns:
        Exit status: 0 done, 1 failed, 2 usage, 130 interrupted, 129 stopped by SIGHUP, 143 by SIGTERM.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug, without_cache, edited = (flag in arguments for flag in _FLAGS)
    arguments = [argument for argument in arguments if argument not in _FLAGS]
    if argv is None and arguments[:1] == ["train"]:
        use_huge_pages()
    try:
        with _stop_at_signals():
            status = _dispatch(arguments, not without_cache, edited)
        sys.stdout.flush()
    except SystemExit as stop:  # tyro's --help (0) and its usage errors (2)
        if stop.code is None:
            return 0
        return stop.code if isinstance(stop.code, int) else 1
    except BrokenPipeError:
        # The reader (head, less) has exited; avoid an error when the interpreter flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (Exception, KeyboardInterrupt) as error:
        if debug:
            traceback.print_exc()
        line, status = describe(error)
        with contextlib.suppress(OSError):  # a terminal that hung up
            show(f"drivax: {escape_controls(line)}", sys.stderr)
    finally:
        # The process ends: Ctrl-C stops what JAX does at exit without a traceback.
        if argv is None and signal.getsignal(signal.SIGINT) == signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
    return status


def use_huge_pages() -> None:
    """Start this process again with large arrays in huge pages, where Linux grants them on request.

    This saves page faults (docs/log/2026-11-27-cores-as-devices.md). Only glibc's tunables ask for huge pages, and
    glibc reads them when a process starts. A user's own tunables stay as they are.
    """
    try:
        is_on_request = "[madvise]" in _HUGE_PAGES.read_text()
    except OSError:  # not Linux
        return
    if is_on_request and sys.executable and "GLIBC_TUNABLES" not in os.environ:
        os.environ["GLIBC_TUNABLES"] = "glibc.malloc.hugetlb=1"
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


class Stopped(KeyboardInterrupt):
    """A signal that ends the process stopped the command."""

    def __init__(self, signal: signal.Signals) -> None:
        super().__init__(signal)
        self.signal = signal


@contextlib.contextmanager
def _stop_at_signals() -> Iterator[None]:
    """Raise Stopped at SIGTERM or SIGHUP, and KeyboardInterrupt at Ctrl-C, so that partial output is removed.

    After the first of the three, SIGTERM and SIGHUP are ignored. A signal that the process ignores already (nohup)
    stays ignored. Python handles signals in its main thread only.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    signals = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT) if in_main_thread else ()
    previous = {number: signal.getsignal(number) for number in signals}
    stop = _SignalHandler([n for n in signals if previous[n] in (signal.SIG_DFL, signal.default_int_handler)])
    try:
        stop.install()
        yield
    finally:
        while True:  # a further Ctrl-C may interrupt it
            try:
                stop.remove(previous)
                break
            except KeyboardInterrupt:
                continue


class _SignalHandler:
    """Raises :class:`Stopped`, or KeyboardInterrupt at Ctrl-C, when an exception does no harm.

    A signal waits, 10 s at most, for the end of

    - an import: C++ extension modules crash when an exception interrupts their initialisation;
    - the start of a worker process, which would otherwise miss its arguments;
    - the creation or removal of a semaphore, which Python's resource tracker would otherwise lose;
    - the use of an event loop by Orbax, which would otherwise report an unclosed loop.
    """

    def __init__(self, signals: Sequence[signal.Signals]) -> None:
        self.signals = signals
        self._timers: dict[int, threading.Timer] = {}
        self._first_s: dict[int, float] = {}
        self._report_unraisable = sys.unraisablehook

    def install(self) -> None:
        """Handle the signals, and exceptions that Python drops."""
        sys.unraisablehook = self._raise_again
        for number in self.signals:
            signal.signal(number, self)

    def remove(self, previous: Mapping[signal.Signals, Any]) -> None:
        """Cancel signals that are to be sent again, and restore the ``previous`` handlers."""
        for timer in self._timers.values():
            timer.cancel()
        if sys.unraisablehook == self._raise_again:
            sys.unraisablehook = self._report_unraisable
        for number in self.signals:
            signal.signal(number, previous[number])

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal in the main thread, which executes ``frame``."""
        now_s = time.monotonic()
        waited_s = now_s - self._first_s.setdefault(number, now_s)
        if waited_s < _PATIENCE_S and _is_uninterruptible(frame):
            # Wait longer each time: on a busy machine, a signal every 10 ms would take all of the time.
            self._send_later(number, max(_RESEND_S, waited_s / 2))
            return
        # Another exception would interrupt the removal of partial output, or of this handler. With SIG_IGN,
        # Python would report signals that have already come.
        for other in {signal.SIGTERM, signal.SIGHUP}.intersection(self.signals):
            signal.signal(other, lambda *_: None)
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise Stopped(signal.Signals(number))

    def _raise_again(self, unraisable: sys.UnraisableHookArgs) -> None:
        # Python drops exceptions of callbacks, such as JAX's garbage collection callback.
        error = unraisable.exc_value
        if not isinstance(error, KeyboardInterrupt):
            self._report_unraisable(unraisable)
            return
        self.install()
        self._send_later(error.signal if isinstance(error, Stopped) else signal.SIGINT, _RESEND_S)

    def _send_later(self, number: int, wait_s: float) -> None:
        """Send a signal to the main thread again after ``wait_s``; the signal wakes the thread if it is waiting."""
        if number in self._timers:
            self._timers[number].cancel()
        main_thread = threading.main_thread().ident
        self._timers[number] = threading.Timer(wait_s, signal.pthread_kill, (main_thread, number))
        self._timers[number].daemon = True
        self._timers[number].start()


def _is_uninterruptible(frame: FrameType | None) -> bool:
    """Return whether a function that no exception may interrupt is running."""
    while frame is not None and frame.f_code is not main.__code__:
        if frame.f_code.co_filename.endswith(_UNINTERRUPTIBLE_FILES):
            return True
        frame = frame.f_back
    return False


def describe(error: BaseException) -> tuple[str, int]:
    """Return one line for the user, and the exit status, for an exception that ended a command."""
    if isinstance(error, DrivaxError):
        return str(error), error.status
    if isinstance(error, Stopped):
        return f"stopped by {error.signal.name}", 128 + error.signal
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", 130
    if explained := explain_system(error) or explain_library(error):
        return str(explained), 1
    if isinstance(error, ImportError) and (missing := missing_package(error)):
        return str(missing), 1
    if isinstance(error, OSError) and error.strerror:
        place = "" if error.filename is None else f"{error.filename}: "
        return f"{place}{error.strerror}", 1
    message = " ".join(str(error).split())
    return f"unexpected {type(error).__name__}: {message}; --debug shows where", 1


def overview() -> str:
    """Return the list of commands that ``drivax --help`` prints; at most 100 columns."""
    width = max(map(len, COMMANDS))
    rows = [f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items()]
    return "\n".join((
        "drivax trains and evaluates driving planners on recorded traffic, and curates their training data.",
        "",
        "usage: drivax COMMAND [options]      drivax COMMAND --help  explains one, with an example",
        "",
        *rows,
        "",
        "  --version  print the version      --debug  show the traceback of an error",
        "  --no-cache  compile all programs again, and store none",
        "  --edited    use files that were edited after drivax wrote them; results say so",
    ))  # fmt: skip


def _dispatch(arguments: list[str], use_cache: bool, edited: bool) -> int:
    """Run the command that the first argument names, or print the overview or the version."""
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        show(overview())
        return 0
    name, rest = arguments[0], arguments[1:]
    if name in ("-V", "--version"):
        show(f"drivax {metadata.version('drivax')}")
        return 0
    if name not in COMMANDS:
        kind = "option" if name.startswith("-") else "command"
        cure = did_you_mean(name, COMMANDS, otherwise="see drivax --help")
        raise UsageError(f"unknown {kind} {name!r}", cure=cure)
    from drivax.seal import allow_edited, edited_files  # not for the overview

    with allow_edited(edited):
        status = _run(name, COMMANDS[name], rest, use_cache)
        if files := edited_files():
            show(f"drivax: made with edited files: {', '.join(files)}", sys.stderr)
    return status


def _run(name: str, command: Command, arguments: list[str], use_cache: bool) -> int:
    """Parse the arguments of a command and run it."""
    import tyro

    # Before the module is imported: JAX reads the setting when it is imported.
    cache = use_compilation_cache() if use_cache else None
    if not use_cache:
        # This also disables a cache folder that JAX_COMPILATION_CACHE_DIR names.
        os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"
    check_memory_limit()  # nearly all commands use JAX
    module = importlib.import_module(f"drivax.cli.{name}")
    if cache and "jax" in sys.modules:
        report_compilation(partial(show, file=sys.stderr))
    config = getattr(module, name.capitalize())
    parse: Any = partial(tyro.cli, return_unknown_args=True) if command.overrides else tyro.cli
    parsed = parse(
        config, prog=f"drivax {name}", args=arguments, description=_wrap(getdoc(config) or ""),
        config=(tyro.conf.FlagCreatePairsOff,),
    )  # fmt: skip
    return int(module.run(*parsed) if command.overrides else module.run(parsed))


def _wrap(text: str) -> str:
    """Wrap the paragraphs of a text to the width of the terminal.

    Tyro joins lines unless they begin with a blank, and doubles empty lines, hence the zero-width spaces.
    """
    fill = textwrap.TextWrapper(shutil.get_terminal_size((_COLUMNS, 0)).columns, "  ", "  ").fill
    return "\n\u200b\n".join(fill(" ".join(paragraph.split())) for paragraph in text.split("\n\n"))
