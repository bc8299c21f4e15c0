"""``drivax convert``: public data set -> scenario set."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from drivax.cli import record_of
from drivax.datasets.conversion import Conversion, ConversionPlan, Converted, convert
from drivax.datasets.formats import READERS
from drivax.errors import UsageError
from drivax.escaping import show
from drivax.evaluation.audit import audit
from drivax.files import can_resume, count_text
from drivax.scenario.schema import CAPACITIES
from drivax.tracking.progress import Progress

#: Maximum number of skipped records to list.
_MAX_LISTED = 20


@dataclass(frozen=True, kw_only=True)
class Convert(Conversion):  # noqa: D101
    __doc__ = f"""Convert recordings of a public data set to a scenario set.

    Reads one file, or all files of known formats in a folder, and reports skipped records with the reason.
    The same command resumes an interrupted conversion.

    Formats: {", ".join(reader.name for reader in READERS)}.
    docs/data/index.md explains how to get them; drivax doctor SRC recognises the format of SRC.

    Example: drivax convert womd/training sets/womd --workers 8 --split 80/10/10
    """

    src: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """File or folder to read."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Scenario set to write (a folder)."""
    capacity: Annotated[str, tyro.conf.arg(metavar="|".join(CAPACITIES))] = "default"
    filters: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="filter", metavar="NAME=VALUE")
    ] = ()
    workers: int = os.cpu_count() or 1


def run(args: Convert) -> int:
    """Convert, and print a summary and the skipped records."""
    options = record_of(Conversion, args)
    with Progress("converting", "files") as bar:

        def report(done: int, files: int, scenarios: int) -> None:
            bar.update(done, f"{scenarios:,} scenarios", files)

        try:
            result = convert(args.src, args.out, options, report, audit, _announce)
        except BaseException as error:
            if not isinstance(error, UsageError) and can_resume(args.out):
                show("drivax: finished parts are kept; the same command resumes", sys.stderr)
            raise
    show(summary(result))
    for record in result.skipped[:_MAX_LISTED]:
        show(f"skipped {record.error()}", sys.stderr)
    if len(result.skipped) > _MAX_LISTED:
        show(f"skipped {len(result.skipped) - _MAX_LISTED} more; manifest.json lists all", sys.stderr)
    return 0


def _announce(plan: ConversionPlan) -> None:
    """Print the files by format, the estimated size, and where an interrupted conversion continues."""
    texts = [f"{name} ({count_text(number, 'file')})" for name, number in sorted(plan.data.formats.items())]
    unknown = len(plan.data.inputs) - plan.data.formats.total()
    if unknown:
        texts.append(f"{count_text(unknown, 'file')} of unknown format")
    show(f"found {', '.join(texts)}: {plan.estimate}")
    if plan.written:
        show(f"continuing after {count_text(plan.written, 'scenario')}")


def summary(result: Converted) -> str:
    """Return one line about a conversion."""
    rate = (result.scenarios - result.written) / max(result.seconds, 1e-9)
    texts = [
        f"{count_text(result.scenarios, 'scenario')} from {count_text(result.files, 'file')}"
        f" in {result.seconds:.1f} s ({rate:.1f}/s)",
        f"{count_text(len(result.skipped), 'record')} skipped",
    ]
    if result.written:
        texts.insert(1, f"{result.written:,} of them written before")
    if result.filtered:
        texts.append(f"{count_text(result.filtered, 'scenario')} rejected by filters")
    if result.ignored:
        texts.append(f"{count_text(result.ignored, 'file')} of other formats ignored")
    return f"{result.path}: " + ", ".join(texts)
