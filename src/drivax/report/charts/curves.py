"""Learning curves as inline SVG: small charts, one per quantity, one line per training run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.report.loaded_runs import Training
from drivax.report.pictures.palette import Stroke, stroke

Points = Float[np.ndarray[Any, Any], "point 2"]
_WIDTH, _HEIGHT = 380, 210
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 12, 10, 34
#: A line of more points is averaged into this many bins.
_MOST_POINTS = 150
#: Quantities whose last part is one of these are drawn from 0 to 1.
_SHARES = frozenset(
    ("success", "accuracy", "collision", "at_fault_collision", "offroad", "red_light", "progress_ratio",
     "reached_goal", "ttc_ok", "comfortable", "vmax_score", "nuplan_score")
)  # fmt: skip
#: Groups of quantities, the telling ones first; the rest is folded away.
_FIRST = ("validation", "evaluation", "rollout")


def curve_sections(runs: Sequence[Training]) -> str:
    """All learning curves: what the policy achieved in sight, losses and the rest folded away."""
    names = list(dict.fromkeys(name for run in runs for name in run.curves))
    drawable = [name for name in names if any(len(run.curves.get(name, ())) > 1 for run in runs)]
    if not drawable:
        return "<p>No quantity was logged more than once.</p>"
    first = sorted(
        (n for n in drawable if n.split("/")[0] in _FIRST), key=lambda n: _FIRST.index(n.split("/")[0])
    )
    first = first or drawable[:6]
    rest = [name for name in drawable if name not in first]
    more = (
        f"<details><summary>{len(rest)} more curves</summary>{_charts(rest, runs)}</details>" if rest else ""
    )
    return series_legend([run.name for run in runs]) + _charts(first, runs) + more


def chart(
    title: str, lines: Mapping[str, tuple[Stroke, Points]], share: bool = False, across: str = ""
) -> str:
    """One chart as HTML.

    Args:
        title: Words above it.
        lines: Name of a run -> its stroke and points (horizontal, vertical), sorted by the former.
        share: Draw the vertical axis from 0 to 1 where all values fit.
        across: Words below it.
    """
    drawn = {name: (look, _thinned(points)) for name, (look, points) in lines.items() if len(points)}
    everything = np.concatenate([points for _, points in drawn.values()])
    x_ticks = ticks(min(0.0, float(everything[:, 0].min())), float(everything[:, 0].max()), 5)
    low, high = float(everything[:, 1].min()), float(everything[:, 1].max())
    y_ticks = [0.0, 0.25, 0.5, 0.75, 1.0] if share and low >= 0 and high <= 1 else ticks(low, high, 5)
    axes = _Axes(x_ticks[0], max(float(everything[:, 0].max()), x_ticks[0] + 1e-9), y_ticks[0], y_ticks[-1])
    shapes = [axes.horizontal(value) for value in y_ticks]
    shapes += [axes.mark(value) for value in x_ticks if value <= axes.x1 + 1e-9]
    for name, (look, points) in drawn.items():
        shapes.append(
            f'<polyline {look.svg} points="{axes.path(points)}"><title>{escape(name)}</title></polyline>'
        )
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    shapes.append(f'<text x="{middle:.0f}" y="{_HEIGHT - 4}" text-anchor="middle">{escape(across)}</text>')
    return (
        f"<figure class=chart><figcaption>{escape(title)}</figcaption>"
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(title)}">'
        f"{''.join(shapes)}</svg></figure>"
    )


def ticks(low: float, high: float, most: int) -> list[float]:
    """Round numbers, evenly spaced, that enclose ``[low, high]``: steps of 1, 2 or 5 times a power of ten."""
    if high - low < 1e-12 * max(1.0, abs(low), abs(high)):
        pad = max(0.5 * abs(low), 0.5)
        low, high = low - pad, high + pad
    rough = (high - low) / most
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [step * place for place in range(first, last + 1)]


def compact(value: float) -> str:
    """A number in few letters: ``1.5M``, ``20k``, ``0.25``."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:.4g}{letter}".replace("-", "−")
    return "0" if abs(value) < 1e-12 else f"{value:.4g}".replace("-", "−")


class _Axes:
    """Maps data to the drawing."""

    def __init__(self, x0: float, x1: float, y0: float, y1: float) -> None:
        self.x0, self.x1, self.y0, self.y1 = x0, x1, y0, y1

    def x(self, value: Any) -> Any:
        return _LEFT + (value - self.x0) / (self.x1 - self.x0) * (_WIDTH - _LEFT - _RIGHT)

    def y(self, value: Any) -> Any:
        return _HEIGHT - _BOTTOM - (value - self.y0) / (self.y1 - self.y0) * (_HEIGHT - _BOTTOM - _TOP)

    def path(self, points: Points) -> str:
        xs, ys = self.x(points[:, 0]), self.y(points[:, 1])
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(xs, ys, strict=True))

    def horizontal(self, value: float) -> str:
        y = self.y(value)
        return (
            f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
            f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{compact(value)}</text>'
        )

    def mark(self, value: float) -> str:
        at = self.x(value)
        return f'<text x="{at:.1f}" y="{_HEIGHT - _BOTTOM + 15}" text-anchor="middle">{compact(value)}</text>'


def _thinned(points: Points) -> Float[np.ndarray[Any, Any], "bin 2"]:
    """Points in order of their step, averaged into bins where there are too many."""
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
        share = name.split("/")[-1] in _SHARES
        drawn.append(chart(name, lines, share, across="environment steps"))
    return f"<div class=charts>{''.join(drawn)}</div>"


def series_legend(names: Sequence[str]) -> str:
    """The legend of charts: names in the order of their strokes."""
    items = "".join(
        f'<li><i style="background:{stroke(place).key}"></i>{escape(name)}</li>'
        for place, name in enumerate(names)
    )
    return f"<ul class=series>{items}</ul>"
