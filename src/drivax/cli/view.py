"""``drivax view``: browse a scenario set on one HTML page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from drivax.escaping import show


@dataclass(frozen=True)
class View:
    """Write one self-contained HTML page that plays the logs of a set.

    It also shows tags, flags and audit. Each scenario adds some tens of kilobytes.

    Example: drivax view sets/world --limit 20 --out world.html

    Example: drivax view sets/world --scores scores.npz --limit 20 --out critical.html
    """

    set: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SET")]
    """The scenario set (a folder)."""
    out: Path | None = None
    """HTML file to write; SET.html next to the set by default."""
    limit: int = 50
    """At most N scenarios."""
    ids: tuple[str, ...] = ()
    """Only these scenarios, in this order."""
    scores: Path | None = None
    """Scores of SET by drivax curate: shown over time, and the most critical first unless --ids says otherwise."""
    overwrite: bool = False
    """Replace an existing file."""


def run(args: View) -> int:
    """Write the page; print its path and the number of scenarios."""
    from drivax.curation.scores import read_scores, top_rows
    from drivax.report.pages.viewer import criticality_html, select_rows, write_player
    from drivax.scenario.store import ScenarioSet

    data = ScenarioSet.open(args.set)
    folder = args.set.resolve()
    table = None if args.scores is None else read_scores(args.scores, data)
    order = None if table is None else top_rows(table, len(data))
    rows = select_rows(data, args.limit, args.ids, order)
    scenarios = [data[row] for row in rows]
    details = [] if table is None else [criticality_html(table, row) for row in rows]
    out = args.out or folder.with_name(f"{folder.name}.html")
    path = write_player(scenarios, out, args.overwrite, title=folder.name, details=details)
    show(f"{path} ({len(scenarios)} of {len(data)} scenarios, {path.stat().st_size / 1e6:.1f} MB)")
    return 0
