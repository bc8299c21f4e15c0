"""``drivax export``: write a scenario set, or a part of it, as a set or in another format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from drivax.cli import record_of
from drivax.escaping import show


@dataclass(frozen=True)
class Export:
    """Write a scenario set, or a part of it, as a set again or in another format.

    set: a scenario set with the selected records, bit for bit.

    tfexample: TFRecord shards of WOMD tf.Examples with path_samples, for Waymax and V-Max.

    gpudrive: one JSON file per scenario.

    Example: drivax export sets/womd sets/turns --filter type=turn_left --filter lights=yes
    """

    set: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SET")]
    """Scenario set to read."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder to write."""
    format: Literal["set", "tfexample", "gpudrive"] = "set"
    """Format to write."""
    filter: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Only scenarios with this property (NAME=A|B, NAME!=A, NAME>=N); can be repeated."""
    ids: Path | None = None
    """Only scenarios named in this file: one id per line, or data set, tab and id (a split file)."""
    limit: int | None = None
    """At most N scenarios."""
    paths: Literal["vmax", "published"] = "vmax"
    """Routes in tf.Examples: 10 of 300 points at 1 m, or 10 of 500 points at 0.5 m."""
    shard_size: int = 500
    """Scenarios per TFRecord shard."""
    overwrite: bool = False
    """Replace OUT if it is an earlier export (or a scenario set, for the format set)."""


def run(args: Export) -> int:
    """Export, and print the number of elements that did not fit the format."""
    from drivax.datasets.export import writer
    from drivax.files import count_text
    from drivax.tracking.progress import Progress

    options = record_of(writer.Export, args, filters=args.filter)
    with Progress("exporting", "scenarios") as bar:
        result = writer.export(args.set, args.out, options, lambda done, total: bar.update(done, "", total))
    lost = ", ".join(f"{count:,} {name.replace('_', ' ')}" for name, count in sorted(result.lost.items()))
    content = f"{count_text(result.scenarios, 'scenario')} in {count_text(result.files, 'file')}"
    show(f"{result.path}: {content}" + (f"; no room for {lost}" if lost else ""))
    return 0
