"""``drivax merge``: merge several scenario sets into one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from drivax.datasets.export import writer
from drivax.escaping import show


@dataclass(frozen=True, kw_only=True)
class Merge:
    """Merge several scenario sets into one.

    Sets of different capacities are padded to the larger one. Every scenario keeps its data set, recording and tags, by
    which commands filter and tables are divided (dataset=womd).

    Example: drivax merge sets/womd sets/nuplan --out sets/both

    Example: drivax merge sets/womd sets/nuplan --filter type=turn_left --out sets/turns
    """

    sets: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SET")]
    """Scenario sets to read."""
    out: Path
    """Scenario set to write."""
    filters: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="filter", metavar="NAME=VALUE")
    ] = ()
    """Only scenarios with this property (NAME=A|B, NAME!=A, NAME>=N); can be repeated."""
    overwrite: bool = False
    """Replace OUT if it is a scenario set."""


def run(args: Merge) -> int:
    """Merge, and print what was written."""
    from drivax.files import count_text
    from drivax.tracking.progress import Progress

    with Progress("merging", "scenarios") as bar:
        result = writer.merge(
            args.sets, args.out, filters=args.filters, overwrite=args.overwrite,
            progress=lambda done, total: bar.update(done, "", total),
        )  # fmt: skip
    content = f"{count_text(result.scenarios, 'scenario')} in {count_text(result.files, 'shard')}"
    show(f"{result.path}: {content}")
    return 0
