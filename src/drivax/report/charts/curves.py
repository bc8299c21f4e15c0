"""Learning curves as inline SVG: small charts, one per quantity, one line per training run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.evaluation.results import SHARES
from drivax.report.charts.axes import Axes, compact, series_legend, ticks
from drivax.report.pictures.palette import Stroke, stroke
from drivax.report.runs import Training

Points = Float[np.ndarray[Any, Any], "point 2"]
#: A longer line is averaged into this many bins.
_MOST_POINTS = 150
#: Groups of quantities that are shown; the others are folded away.
_FIRST = ("validation", "evaluation", "rollout")


def curve_sections(runs: Sequence[Training]) -> str:
    """Return all learning curves: the policy's results visible, losses and the rest folded away."""
    names = list(dict.fromkeys(name for run in runs for name in run.curves))
    drawable = [name for name in names if any(len(run.curves.get(name, ())) > 1 for run in runs)]
    if not drawable:
        return "<p>No quantity was logged more than once.</p>"
    first = [name for group in _FIRST for name in drawable if name.split("/")[0] == group]
    first = first or drawable[:6]
    rest = [name for name in drawable if name not in first]
    more = (
        f"<details><summary>{len(rest)} more curves</summary>{_charts(rest, runs)}</details>" if rest else ""
    )
    return series_legend([run.name for run in runs]) + _charts(first, runs) + more


def chart(
    title: str, lines: Mapping[str, tuple[Stroke, Points]], share: bool = False, across: str = ""
) -> str:
    """Return one chart as HTML.

    Args:
        title: Words above it.
        lines: Name of a run -> its stroke and points (horizontal, vertical), sorted by the former.
        share: Whether to draw the vertical axis from 0 to 1 where all values fit.
        across: Words below it.
    """
    drawn = {name: (style, _thinned(points)) for name, (style, points) in lines.items() if len(points)}
    values = np.concatenate([points for _, points in drawn.values()])
    x_ticks = ticks(min(0.0, float(values[:, 0].min())), float(values[:, 0].max()), 5)
    low, high = float(values[:, 1].min()), float(values[:, 1].max())
    y_ticks = [0.0, 0.25, 0.5, 0.75, 1.0] if share and low >= 0 and high <= 1 else ticks(low, high, 5)
    last = max(float(values[:, 0].max()), x_ticks[0] + 1e-9)
    axes = Axes(x_ticks[0], last, y_ticks[0], y_ticks[-1], left=52)
    shapes = [axes.horizontal(value, compact(value)) for value in y_ticks]
    shapes += [axes.mark(value) for value in x_ticks if value <= axes.x1 + 1e-9]
    for name, (style, points) in drawn.items():
        shapes.append(
            f'<polyline {style.svg} points="{axes.path(points)}"><title>{escape(name)}</title></polyline>'
        )
    return axes.figure(title, shapes, across)


def _thinned(points: Points) -> Float[np.ndarray[Any, Any], "bin 2"]:
    """Return points in order of their step, averaged into bins where there are too many."""
    points = points[np.argsort(points[:, 0], kind="stable")]
    if len(points) <= _MOST_POINTS:
        return points
    return np.stack([part.mean(axis=0) for part in np.array_split(points, _MOST_POINTS)])


def _charts(names: Sequence[str], runs: Sequence[Training]) -> str:
    drawn = []
    for name in names:
        lines = {
            run.name: (stroke(place), run.curves[name])
            for place, run in enumerate(runs)
            if name in run.curves
        }
        share = name.split("/")[-1] in (*SHARES, "progress_ratio")
        drawn.append(chart(name, lines, share, across="environment steps"))
    return f"<div class=charts>{''.join(drawn)}</div>"
