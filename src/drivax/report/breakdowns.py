"""Sections of a report about the sources of failures: kinds of collision, kinds of scenario, training data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from drivax.evaluation.stored import ScenarioKey
from drivax.evaluation.tables import (
    COLLISION_KINDS,
    STRATA,
    collisions_table,
    metric_label,
    set_key,
    strata_table,
    summarise,
    transfer_table,
)
from drivax.report.runs import Evaluation
from drivax.table import Table

#: Columns of a breakdown: what tells planners apart, few enough for a page.
KEY_METRICS = (
    "success", "accuracy", "collision", "at_fault_collision", "offroad", "red_light", "progress_ratio", "vmax_score",
)  # fmt: skip
#: Metrics of a transfer matrix.
TRANSFERRED = ("success", "vmax_score")
Tags = Mapping[ScenarioKey, Mapping[str, str]]


def collision_section(runs: Sequence[Evaluation]) -> str:
    """Return the kinds of the first collision with their meanings; empty without collisions of a known kind."""
    table = collisions_table(runs)
    if not any(cell.interval and cell.interval.mean for row in table.rows for cell in row):
        return ""
    meanings = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(meaning[:1].upper() + meaning[1:])}.</dd></div>"
        for name, meaning in COLLISION_KINDS.values()
    )
    total = ", ".join(
        f"{escape(run.name)} {int((run.metrics['collision_type'] > 0).sum())} of {run.episodes}"
        for run in runs
        if "collision_type" in run.metrics
    )
    return (
        f"<section><h2>Kinds of collision</h2><p>Episodes with a collision: {total}.</p>{table.html()}"
        f"<dl class=metrics>{meanings}</dl><p><small>{escape(table.caption)} (Wilson's).</small></p></section>"
    )


def strata_tables(runs: Sequence[Evaluation], tags: Tags, more: Sequence[str] = ()) -> list[Table]:
    """Return a table for each tag of the scenarios, over the runs on these scenarios; with ``more`` metrics."""
    evaluated = [run for run in runs if any(key in tags for key in run.scenarios)]
    known = {name for values in tags.values() for name in values}
    names = dict.fromkeys((*KEY_METRICS, *more))
    metrics = [name for name in names if any(name in run.metrics for run in evaluated)]
    return [strata_table(evaluated, tags, tag, metrics) for tag in STRATA if tag in known]


def strata_section(runs: Sequence[Evaluation], tags: Tags) -> str:
    """Return the results by kind of scenario; empty without tags."""
    tables = "".join(
        f"<details{'' if place else ' open'}><summary>{escape(table.name.replace('-', ' '))}</summary>"
        f"{table.html()}</details>"
        for place, table in enumerate(strata_tables(runs, tags))
    )
    return (
        f"<section><h2>By kind of scenario</h2>{tables}<p><small>Tags describe the log. Small strata have wide "
        "intervals; of many cells, some stand out by chance.</small></p></section>"
        if tables
        else ""
    )


def transfer_tables(runs: Sequence[Evaluation]) -> list[Table]:
    """Return a matrix of training and evaluation data for each metric; none where all runs share one set."""
    if len({set_key(run.data) for run in runs}) < 2:
        return []
    known = [name for name in TRANSFERRED if any(summarise(run, name).n for run in runs)]
    return [transfer_table(runs, name) for name in known]


def transfer_section(runs: Sequence[Evaluation]) -> str:
    """Return the results by training and evaluation data; empty where all runs share one set."""
    tables = "".join(
        f"<h3>{escape(metric_label(table.name.removeprefix('transfer-'), runs).text)}</h3>{table.html()}"
        for table in transfer_tables(runs)
    )
    return (
        f"<section><h2>Transfer</h2>{tables}<p><small>Rows: planners and their training data (– where nothing was "
        "trained, or the run does not say). Columns: evaluation data. Sets differ in difficulty: compare along a "
        "column.</small></p></section>"
        if tables
        else ""
    )
