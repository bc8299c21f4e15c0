"""Learning curves as inline SVG, and the axes of all charts: scales, round ticks, legends."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.evaluation.episode_table import SHARES
from drivax.report.pictures.palette import Stroke, stroke
from drivax.report.runs import Training

WIDTH, HEIGHT = 380, 210
_RIGHT, _TOP, _BOTTOM = 12, 10, 34
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


class Axes:
    """Maps data to the drawing; ``left`` is the margin of the vertical axis, pixels."""

    def __init__(self, x0: float, x1: float, y0: float, y1: float, left: int) -> None:
        self.x0, self.x1, self.y0, self.y1, self.left = x0, x1, y0, y1, left

    def x(self, value: Any) -> Any:
        """Return the horizontal place of a value, pixels."""
        return self.left + (value - self.x0) / (self.x1 - self.x0) * (WIDTH - self.left - _RIGHT)

    def y(self, value: Any) -> Any:
        """Return the vertical place of a value, pixels."""
        return HEIGHT - _BOTTOM - (value - self.y0) / (self.y1 - self.y0) * (HEIGHT - _BOTTOM - _TOP)

    def path(self, points: Any) -> str:
        """Return points ``[n, 2]`` as an SVG path."""
        return " ".join(f"{self.x(x):.1f},{self.y(y):.1f}" for x, y in points)

    def horizontal(self, value: float, text: str) -> str:
        """Return a grid line with its label."""
        y = self.y(value)
        return (
            f'<line class="grid" x1="{self.left}" x2="{WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
            f'<text x="{self.left - 6}" y="{y + 4:.1f}" text-anchor="end">{text}</text>'
        )

    def mark(self, value: float) -> str:
        """Return a label of the horizontal axis."""
        y = HEIGHT - _BOTTOM + 15
        return f'<text x="{self.x(value):.1f}" y="{y}" text-anchor="middle">{compact(value)}</text>'

    def figure(self, title: str, shapes: Iterable[str], across: str, facts: str = "") -> str:
        """Return the chart: a caption (``facts`` is HTML), shapes, and words below the horizontal axis."""
        middle = (self.left + WIDTH - _RIGHT) / 2
        return (
            f"<figure class=chart><figcaption>{escape(title)}{facts}</figcaption>"
            f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">{"".join(shapes)}'
            f'<text x="{middle:.0f}" y="{HEIGHT - 4}" text-anchor="middle">{escape(across)}</text></svg></figure>'
        )


def ticks(low: float, high: float, most: int) -> list[float]:
    """Return evenly spaced round numbers that enclose ``[low, high]``: steps of 1, 2 or 5 times a power of ten."""
    if high - low < 1e-12 * max(1.0, abs(low), abs(high)):
        pad = max(0.5 * abs(low), 0.5)
        low, high = low - pad, high + pad
    rough = (high - low) / most
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [step * place for place in range(first, last + 1)]


def compact(value: float) -> str:
    """Return a number in few letters: ``1.5M``, ``20k``, ``0.25``."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:.4g}{letter}".replace("-", "−")
    return "0" if abs(value) < 1e-12 else f"{value:.4g}".replace("-", "−")


def series_legend(names: Sequence[str]) -> str:
    """Return the legend of charts: names in the order of their strokes."""
    items = "".join(
        f'<li><i style="background:{stroke(place).key}"></i>{escape(name)}</li>'
        for place, name in enumerate(names)
    )
    return f"<ul class=series>{items}</ul>"
