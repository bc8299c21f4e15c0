"""Parts of a report that say where failures come from: kinds of collision, kinds of scenario, training data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from drivax.evaluation.episode_table import ScenarioKey
from drivax.evaluation.tables import (
    READINGS,
    STRATA,
    Row,
    Table,
    collisions_table,
    strata_table,
    summarise,
    transfer_table,
)
from drivax.report.glossary import note
from drivax.report.html_tables import table_html
from drivax.report.loaded_runs import Evaluation

#: Columns of a breakdown: what tells planners apart, few enough for a page.
KEY_METRICS = (
    "success", "accuracy", "collision", "at_fault_collision", "offroad", "red_light", "progress_ratio", "vmax_score",
)  # fmt: skip
#: Metrics of a transfer matrix.
TRANSFERRED = ("success", "vmax_score")
Tags = Mapping[ScenarioKey, Mapping[str, str]]


def collision_section(runs: Sequence[Evaluation]) -> str:
    """Kinds of the first collision with what each says; empty where nobody collided or no run knows kinds."""
    table = collisions_table(runs)
    if not any(cell and cell.interval.mean for row in table.rows for cell in row.cells):
        return ""
    codes = dict(zip((row.labels[0] for row in table.rows), READINGS, strict=True))

    def behind(row: Row, place: int) -> dict[str, Any]:
        return {"run": table.columns[place], "kind": int(codes[row.labels[0]])}

    readings = "".join(
        f"<div><dt>{escape(words)}</dt><dd>{escape(reading[:1].upper() + reading[1:])}.</dd></div>"
        for words, reading in READINGS.values()
    )
    total = ", ".join(
        f"{escape(run.name)} {int((run.metrics['collision_type'] > 0).sum())} of {len(run)}"
        for run in runs
        if run.name in table.columns
    )
    return (
        f"<section><h2>Kinds of collision</h2><p>Episodes with a collision: {total}.</p>"
        f"{table_html(table, runs, behind)}<dl class=metrics>{readings}</dl><p><small>{escape(table.caption)} "
        "(Wilson's).</small></p></section>"
    )


def strata_tables(runs: Sequence[Evaluation], tags: Tags, more: Sequence[str] = ()) -> list[Table]:
    """One table for each of the tags that the scenarios have, over the runs that drove them; with more metrics."""
    driven = [run for run in runs if any(key in tags for key in run.scenarios)]
    known = {name for words in tags.values() for name in words}
    wanted = dict.fromkeys((*KEY_METRICS, *more))
    metrics = [name for name in wanted if any(name in run.metrics for run in driven)]
    return [strata_table(driven, tags, tag, metrics) for tag in STRATA if tag in known]


def strata_section(runs: Sequence[Evaluation], tags: Tags) -> str:
    """Results by kind of scenario; empty without tags."""
    parts = []
    for table in strata_tables(runs, tags):
        tag = table.keys[0]

        def behind(row: Row, place: int, table: Table = table, tag: str = tag) -> dict[str, Any]:
            return {"run": row.labels[1], "metric": table.columns[place], "tags": {tag: row.labels[0]}}

        open_ = " open" if not parts else ""
        parts.append(
            f"<details{open_}><summary>by {escape(tag)}</summary>{table_html(table, runs, behind)}</details>"
        )
    return (
        f"<section><h2>By kind of scenario</h2>{''.join(parts)}<p><small>Tags describe the log as it was driven. Small "
        "strata have wide intervals; many cells are looked at, and some will stand out by chance.</small></p></section>"
        if parts
        else ""
    )


def transfer_tables(runs: Sequence[Evaluation]) -> list[Table]:
    """A matrix of training and evaluation data for each of the metrics; none where all runs drove one set."""
    if len({str(run.data.get("hash") or run.data.get("path")) for run in runs}) < 2:
        return []
    known = [name for name in TRANSFERRED if any(summarise(run, name).n for run in runs)]
    return [transfer_table(runs, name) for name in known]


def transfer_section(runs: Sequence[Evaluation]) -> str:
    """What was trained where and how it drives elsewhere; empty where all runs drove one set."""

    def behind(row: Row, place: int) -> dict[str, Any]:
        cell = row.cells[place]
        return {"run": cell.run, "metric": cell.metric} if cell else {}

    parts = [
        f"<h3>{escape(note(table.name.removeprefix('transfer-'), runs).label)}</h3>"
        f"{table_html(table, runs, behind)}"
        for table in transfer_tables(runs)
    ]
    return (
        f"<section><h2>Transfer</h2>{''.join(parts)}<p><small>Rows: what was trained, and on which data (– where "
        "nothing was trained, or the run does not say). Columns: what was driven. Sets differ in how hard they are: "
        "compare along a column.</small></p></section>"
        if parts
        else ""
    )
