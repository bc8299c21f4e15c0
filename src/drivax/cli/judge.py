"""``drivax judge``: evaluate stored episodes again, by the rules of another program."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from drivax.escaping import show


@dataclass(frozen=True)
class Judge:
    """Evaluate the episodes of a run by the rules of another program, without simulating them again.

    devkit: nuPlan's closed-loop score as its devkit computes it. RUN/devkit.csv has both scores of every episode, their
    terms, and the names of the terms that differ (docs/guide/metrics.md explains why).

    Example: drivax judge runs/idm --profile devkit
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run folder written by drivax evaluate."""
    profile: Literal["devkit"] = "devkit"
    """Rules of the evaluation."""
    data: Path | None = None
    """Scenario set of the run, if it has moved since."""
    overwrite: bool = False
    """Replace the table of an earlier call."""


def run(args: Judge) -> int:
    """Evaluate, write the table, and print means of both definitions."""
    from drivax.evaluation.episode_table import EpisodeTable
    from drivax.evaluation.profiles import FILE, devkit_rows, format_rows, write_rows
    from drivax.files import check_output, inside
    from drivax.tracking.progress import Progress

    table, out = EpisodeTable.read(args.run), inside(args.run, FILE)
    check_output(out, args.overwrite)
    with Progress("evaluating", "episodes", len(table)) as bar:
        rows = devkit_rows(table, table.open_set(args.data), lambda done, _: bar.update(done))
    write_rows(rows, out)
    show(format_rows(rows))
    show(f"wrote {out}")
    return 0
