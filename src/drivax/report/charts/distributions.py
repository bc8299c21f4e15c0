"""Distributions as inline SVG: empirical distribution functions of metrics, and histograms."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.evaluation.episode_table import EpisodeTable
from drivax.evaluation.tables import metric_label
from drivax.report.charts.curves import Axes, chart, compact, series_legend, ticks
from drivax.report.pictures.palette import Stroke, stroke

Values = Float[np.ndarray[Any, Any], "_"]
#: Metrics with a chart, in order.
SPREAD = (
    "vmax_score", "progress_ratio", "min_ttc", "average_ttc", "max_jerk", "max_lateral_acceleration", "comfort",
    "speeding_max", "route_deviation_max", "ade", "goal_distance", "distance",
)  # fmt: skip
#: Steps of a drawn line at most, so that a chart does not average its corners.
_LEVELS = 75
#: Bins of a histogram at most.
BINS = 24


def distribution_charts(runs: Sequence[EpisodeTable]) -> str:
    """Return a chart for each metric of :data:`SPREAD` that differs between episodes; empty without any."""
    styles = {run.name: stroke(place) for place, run in enumerate(runs)}
    charts = []
    for name in SPREAD:
        lines = {run.name: distribution(run.metrics[name]) for run in runs if name in run.metrics}
        values = np.concatenate([line[:, 0] for line in lines.values()]) if lines else np.zeros(0)
        if values.size and values.min() < values.max():
            drawn = {run: (styles[run], line) for run, line in lines.items()}
            charts.append(chart(metric_label(name, runs).text, drawn, share=True))
    return f"{series_legend(list(styles))}<div class=charts>{''.join(charts)}</div>" if charts else ""


def distribution(values: Any) -> Float[np.ndarray[Any, Any], "point 2"]:
    """Return the corners of the empirical distribution function: value, share of the values up to it.

    Args:
        values: One per episode; NaN where undefined. More than 75 values are thinned evenly, so that no corner moves by
            more than 1 / 75.
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


def histogram(title: str, series: Mapping[str, Values], unit: str = "per scenario") -> str:
    """Return one histogram as HTML: the share of the values of each series in common bins.

    Args:
        title: Words above it.
        series: Values by name, in the order of ``palette.STROKES``.
        unit: Unit of the values, written below the axis.
    """
    values = np.concatenate(list(series.values()))
    edges = bins(values)
    shares = {name: _shares(numbers, edges) for name, numbers in series.items()}
    levels = ticks(0.0, max(float(share.max()) for share in shares.values()), 4)
    low, high = float(edges[0]), float(edges[-1])
    axes = Axes(low, high, 0.0, levels[-1], left=44)
    shapes = [axes.horizontal(value, f"{compact(100 * value)} %") for value in levels]
    whole = bool((values == np.round(values)).all())
    shapes += [
        axes.mark(value)
        for value in ticks(low, high, 5)
        if low <= value <= high and (not whole or value == round(value))
    ]
    for place, share in enumerate(shares.values()):
        draw = _bars if len(shares) == 1 else _steps
        shapes.append(draw(axes, edges, share, stroke(place)))
    facts = "".join(
        f"<small>{escape(f'{name}: ' if len(series) > 1 else '')}{_facts(numbers)}</small>"
        for name, numbers in series.items()
    )
    return axes.figure(title, shapes, unit, facts)


def bins(values: Values, most: int = BINS) -> Values:
    """Return the edges of at most ``most`` equal bins of a round width that hold all values.

    Whole numbers get bins that are centred on them while each number has its own.
    """
    low, high = float(values.min()), float(values.max())
    whole = bool((values == np.round(values)).all())
    if low == high:
        return low + np.array([-1.5, -0.5, 0.5, 1.5])
    if whole and high - low < most:
        return np.arange(low - 0.5, high + 1.0)
    edges = ticks(min(low, 0.0) if low < 0.5 * high else low, high, most - 1)
    width = edges[1] - edges[0]
    if whole and width < 1.0:
        return np.arange(math.floor(low), math.ceil(high) + 1.5)
    return np.append(edges, edges[-1] + width) if edges[-1] <= high else np.array(edges)


def short(value: Any) -> str:
    """Return a number with about three figures."""
    value = float(value)
    digits = 0 if abs(value) >= 100 or value == round(value) else 1 if abs(value) >= 10 else 2
    return f"{value:,.{digits}f}"


def _shares(values: Values, edges: Values) -> Values:
    counts, _ = np.histogram(values, edges)
    return counts / max(len(values), 1)


def _facts(values: Values) -> str:
    if not len(values):
        return "n 0"
    return f"median {short(np.median(values))}, most {short(values.max())}, n {len(values):,}"


def _bars(axes: Axes, edges: Values, shares: Values, style: Stroke) -> str:
    return "".join(
        f'<rect x="{axes.x(a) + 0.5:.1f}" y="{axes.y(share):.1f}" width="{axes.x(b) - axes.x(a) - 1:.1f}" '
        f'height="{axes.y(0) - axes.y(share):.1f}" fill="{style.colour}">'
        f"<title>{compact(a)} to {compact(b)}: {100 * share:.3g} %</title></rect>"
        for a, b, share in zip(edges[:-1], edges[1:], shares, strict=True)
        if share > 0
    )


def _steps(axes: Axes, edges: Values, shares: Values, style: Stroke) -> str:
    corners = np.column_stack((np.repeat(edges, 2), np.concatenate(([0.0], np.repeat(shares, 2), [0.0]))))
    return f'<polyline {style.svg} points="{axes.path(corners)}"/>'
