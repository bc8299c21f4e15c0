"""``drivax export``: write a scenario set, or a part of it, as a set or in another format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

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
    from drivax.datasets.export import writer as export
    from drivax.tracking.progress import Progress

    options = export.Export(
        format=args.format,
        filters=args.filter,
        ids=args.ids,
        limit=args.limit,
        paths=args.paths,
        shard_size=args.shard_size,
        overwrite=args.overwrite,
    )
    with Progress("exporting", "scenarios") as bar:
        result = export.export(args.set, args.out, options, lambda done, total: bar.update(done, "", total))
    lost = ", ".join(f"{count:,} {name.replace('_', ' ')}" for name, count in sorted(result.lost.items()))
    files = "1 file" if result.files == 1 else f"{result.files:,} files"
    scenarios = "1 scenario" if result.scenarios == 1 else f"{result.scenarios:,} scenarios"
    show(f"{result.path}: {scenarios} in {files}" + (f"; no room for {lost}" if lost else ""))
    return 0
