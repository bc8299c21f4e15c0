"""Criticality of one scenario over time: its score and what it is made of."""

from __future__ import annotations

from html import escape

import numpy as np

from drivax.curation.scores import ScoreTable
from drivax.report.charts.curves import chart, series_legend
from drivax.report.pictures.palette import stroke
from drivax.scenario.schema import DT_S


def criticality_html(table: ScoreTable, row: int) -> str:
    """A chart of the score and of all components at the steps of one scenario, and the scenario's own score.

    Args:
        table: The scores.
        row: Of the scenario.
    """
    valid = table.valid[row]
    time = np.flatnonzero(valid) * DT_S
    series = {"score": table.steps[row], **{name: part[row] for name, part in table.components.items()}}
    lines = {
        name.replace("_", " "): (stroke(place), np.column_stack([time, values[valid]]))
        for place, (name, values) in enumerate(series.items())
    }
    rank = int(np.flatnonzero(table.order == row)[0]) + 1
    words = f"score {table.scenarios[row]:.3f}, rank {rank:,} of {len(table.scenarios):,} by {table.method}"
    return (
        f"<h3>Criticality</h3><p>{escape(words)}</p>"
        f"{chart('criticality over time', lines, share=True, across='s')}{series_legend(list(lines))}"
    )
