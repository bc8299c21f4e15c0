"""The command line: one file per command; parses, calls, prints.

``drivax.cli.<command>`` defines one frozen dataclass (the command's name in CamelCase) from which tyro builds
the flags, with an example in its docstring, and ``run(args) -> int``. Nothing of a command is imported before
it is asked for, so that ``drivax --help`` answers at once. A command that takes free ``--section.key value``
overrides of its configuration is registered with ``overrides=True`` and its ``run`` takes them as a second
argument.
"""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, fields
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

from drivax.errors import DrivaxError, UsageError, did_you_mean, missing_package


@dataclass(frozen=True)
class Command:
    """Where a command lives and what the list of commands says about it."""

    module: str
    config: str
    summary: str
    overrides: bool = False


COMMANDS = {
    "demo": Command(
        "drivax.cli.demo", "Demo", "the whole job on the built-in world: make, train, judge, report"
    ),
    "doctor": Command(
        "drivax.cli.doctor", "Doctor", "what is installed, or what a file or folder of data is"
    ),
    "generate": Command("drivax.cli.generate", "Generate", "scenarios of the built-in world -> scenario set"),
    "convert": Command("drivax.cli.convert", "Convert", "public data set -> scenario set"),
    "export": Command("drivax.cli.export", "Export", "part of a scenario set, or another format, from a set"),
    "inspect": Command("drivax.cli.inspect", "Inspect", "what a scenario set holds, and whether it is sound"),
    "view": Command("drivax.cli.view", "View", "one HTML page in which a scenario set can be browsed"),
    "curate": Command(
        "drivax.cli.curate", "Curate", "how critical each scenario is: scores for a set", overrides=True
    ),
    "train": Command(
        "drivax.cli.train", "Train", "train a planner from a configuration file", overrides=True
    ),
    "evaluate": Command(
        "drivax.cli.evaluate", "Evaluate", "evaluate a planner on a scenario set", overrides=True
    ),
    "compare": Command(
        "drivax.cli.compare", "Compare", "is one planner better than another? a tested answer"
    ),
    "study": Command(
        "drivax.cli.study", "Study", "a whole experiment with controls and verdicts", overrides=True
    ),
    "report": Command("drivax.cli.report", "Report", "one HTML page with tables and pictures from runs"),
    "bench": Command(
        "drivax.cli.bench", "Bench", "simulation speed on this machine, by part", overrides=True
    ),
}


Record = TypeVar("Record")


def record_of(cls: type[Record], args: Any, **values: Any) -> Record:
    """Return a configuration record from the flags of the same names; ``values`` replace flags."""
    names = [field.name for field in fields(cls) if field.name not in values]  # type: ignore[arg-type]
    return cls(**{name: getattr(args, name) for name in names}, **values)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: Arguments without the program's name; those of the process by default.

    Returns:
        Exit status: 0 done, 1 failed, 2 usage, 130 interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    try:
        status = _dispatch(arguments)
        sys.stdout.flush()
    except SystemExit as stop:  # tyro's --help (0) and its usage errors (2)
        return stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 1
    except BrokenPipeError:
        # The reader (head, less) has gone; keep the interpreter from complaining when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (Exception, KeyboardInterrupt) as error:
        if debug:
            traceback.print_exc()
        line, status = describe(error)
        print(f"drivax: {line}", file=sys.stderr)
    return status


def describe(error: BaseException) -> tuple[str, int]:
    """One line for the user, and the exit status, for an exception that ended a command."""
    if isinstance(error, DrivaxError):
        return str(error), error.status
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", 130
    if isinstance(error, ImportError) and (missing := missing_package(error)):
        return str(missing), 1
    if isinstance(error, OSError) and error.strerror:
        place = "" if error.filename is None else f"{error.filename}: "
        return f"{place}{error.strerror}", 1
    message = " ".join(str(error).split())
    return f"unexpected {type(error).__name__}: {message}; --debug shows where", 1


def overview() -> str:
    """The list of commands that ``drivax --help`` prints; at most 100 columns."""
    width = max(map(len, COMMANDS))
    rows = [f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items()]
    return "\n".join(
        (
            "drivax trains, curates and judges driving planners on recorded traffic.",
            "",
            "usage: drivax COMMAND [options]      drivax COMMAND --help  explains one, with an example",
            "",
            *rows,
            "",
            "  --version  print the version      --debug  show the traceback of an error",
        )
    )


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(overview())
        return 0
    name, rest = arguments[0], arguments[1:]
    if name in ("-V", "--version"):
        print(f"drivax {metadata.version('drivax')}")
        return 0
    if name not in COMMANDS:
        kind = "option" if name.startswith("-") else "command"
        raise UsageError(
            f"unknown {kind} {name!r}", cure=did_you_mean(name, COMMANDS, otherwise="see drivax --help")
        )
    return _run(name, COMMANDS[name], rest)


def _run(name: str, command: Command, arguments: list[str]) -> int:
    import tyro

    # Compiled programs are kept between commands: most of a short command's time is compilation.
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path.home() / ".cache" / "drivax" / "jax"))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
    module = importlib.import_module(command.module)
    config = getattr(module, command.config)
    options = (tyro.conf.FlagCreatePairsOff,)
    if not command.overrides:
        return int(module.run(tyro.cli(config, prog=f"drivax {name}", args=arguments, config=options)))
    args, overrides = tyro.cli(
        config, prog=f"drivax {name}", args=arguments, config=options, return_unknown_args=True
    )
    return int(module.run(args, overrides))
