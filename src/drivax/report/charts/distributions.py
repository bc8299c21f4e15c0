"""How a metric is spread over the episodes of each run, as inline SVG: empirical distribution functions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.report.charts.curves import chart, series_legend
from drivax.report.glossary import note
from drivax.report.loaded_runs import Evaluation
from drivax.report.pictures.palette import stroke

#: Metrics whose spread says more than their mean, in the order of their charts.
SPREAD = (
    "vmax_score", "progress_ratio", "min_ttc", "average_ttc", "max_jerk", "max_lateral_acceleration", "comfort",
    "speeding_max", "route_deviation_max", "ade", "goal_distance", "distance",
)  # fmt: skip
#: Steps of a drawn line at most, so that a chart does not average its corners.
_LEVELS = 75


def spread(values: Any) -> Float[np.ndarray[Any, Any], "point 2"]:
    """The empirical distribution function as corners of a staircase: value, share of the values that are at most it.

    Args:
        values: One per episode; NaN where undefined. Of more than 75 values every so many-th step is kept, so that no
            corner is further than 1 / 75 from its place.
    """
    known = np.sort(np.asarray(values, np.float64))
    known = known[~np.isnan(known)]
    if not known.size:
        return np.zeros((0, 2))
    share = np.arange(1, known.size + 1) / known.size
    if known.size > _LEVELS:
        rows = np.unique(np.ceil(np.linspace(1, known.size, _LEVELS)).astype(int)) - 1
        known, share = known[rows], share[rows]
    return np.column_stack((np.repeat(known, 2), np.concatenate(([0.0], np.repeat(share, 2)[:-1]))))


def distribution_charts(runs: Sequence[Evaluation]) -> str:
    """A chart for each metric of :data:`SPREAD` that differs between episodes; empty without any."""
    look = {run.name: stroke(place) for place, run in enumerate(runs)}
    charts = []
    for name in SPREAD:
        lines = {run.name: spread(run.metrics[name]) for run in runs if name in run.metrics}
        values = np.concatenate([line[:, 0] for line in lines.values()]) if lines else np.zeros(0)
        if values.size and values.min() < values.max():
            entry = note(name, runs)
            drawn = {run: (look[run], line) for run, line in lines.items()}
            charts.append(chart(entry.label, drawn, share=True))
    return f"{series_legend(list(look))}<div class=charts>{''.join(charts)}</div>" if charts else ""
