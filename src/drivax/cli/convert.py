"""``drivax convert``: public data set -> scenario set."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from drivax.datasets.convert import Conversion, Converted, convert
from drivax.evaluation.audit import audit
from drivax.tracking.progress import Progress

_SHOWN = 20


@dataclass(frozen=True)
class Convert:
    """Convert recordings of a public data set to a scenario set.

    Reads one file, or all files of known formats in a folder.

    Says which records had to be skipped, and why.

    Formats: womd-scenario, womd-example (docs/data/womd.md says how to get them).

    Example: drivax convert womd/training sets/womd --workers 8
    """

    src: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """File or folder to read."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Scenario set to write (a folder)."""
    format: str = "auto"
    """Format of the files; auto looks into each file."""
    capacity: Literal["default", "large"] = "default"
    """Padded sizes; large for scenes with more than 80 moving agents or very dense maps."""
    limit: int | None = None
    """Stop after so many scenarios."""
    workers: int | None = None
    """Processes that read; as many as there are CPU cores by default."""
    strict: bool = False
    """Stop at the first record that cannot be read instead of skipping it."""
    overwrite: bool = False
    """Replace OUT if it is a scenario set."""


def run(args: Convert) -> int:
    """Convert, print what was written and what was skipped."""
    options = Conversion(
        format=args.format,
        capacity=args.capacity,
        limit=args.limit,
        workers=args.workers if args.workers is not None else os.cpu_count() or 1,
        strict=args.strict,
        overwrite=args.overwrite,
    )
    with Progress("converting", "files") as bar:

        def report(done: int, files: int, scenarios: int) -> None:
            bar.update(done, f"{scenarios:,} scenarios", files)

        result = convert(args.src, args.out, options, report, audit)
    print(summary(result))
    for bad in result.skipped[:_SHOWN]:
        print(f"skipped {bad.error()}", file=sys.stderr)
    if len(result.skipped) > _SHOWN:
        print(f"skipped {len(result.skipped) - _SHOWN} more", file=sys.stderr)
    return 0


def summary(result: Converted) -> str:
    """One line about a conversion."""
    rate = result.scenarios / max(result.seconds, 1e-9)
    parts = [
        f"{counted(result.scenarios, 'scenario')} from {counted(result.files, 'file')}"
        f" in {result.seconds:.1f} s ({rate:.1f}/s)",
        f"{counted(len(result.skipped), 'record')} skipped",
    ]
    if result.ignored:
        parts.append(f"{counted(result.ignored, 'file')} of other formats ignored")
    return f"{result.path}: " + ", ".join(parts)


def counted(number: int, noun: str) -> str:
    """A number with its noun, in the plural where it must be."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"
