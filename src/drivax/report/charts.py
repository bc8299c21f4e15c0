"""Charts as inline SVG: learning curves, distributions, histograms, and the signals of the player."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.evaluation.episode_table import SHARES, EpisodeTable
from drivax.evaluation.result_tables import metric_label
from drivax.geometry.vectors import wrap
from drivax.metrics import comfort
from drivax.metrics.comfort import WINDOW, savgol_matrix
from drivax.report.pictures.palette import Stroke, stroke
from drivax.report.runs import TrainingCurves
from drivax.scenario.schema import DT_S

#: Size of a chart, and its margins other than the left one, pixels.
WIDTH, HEIGHT = 380, 210
_RIGHT, _TOP, _BOTTOM = 12, 10, 34
Points = Float[np.ndarray[Any, Any], "point 2"]
#: Maximum number of points of a line; longer lines are averaged into bins.
_MAX_POINTS = 150
#: Groups of quantities whose curves are visible, not collapsed, in order.
_VISIBLE = ("validation", "evaluation", "rollout")


def curve_sections(runs: Sequence[TrainingCurves]) -> str:
    """Return a chart of each quantity that was logged more than once.

    The policy's results (:data:`_VISIBLE`), or else the first six quantities, are visible, all others collapsed.
    """
    names = list(dict.fromkeys(name for run in runs for name in run.curves))
    drawable = [name for name in names if any(len(run.curves.get(name, ())) > 1 for run in runs)]
    if not drawable:
        return "<p>No quantity was logged more than once.</p>"
    visible = [name for group in _VISIBLE for name in drawable if name.split("/")[0] == group] or drawable[:6]
    hidden = [name for name in drawable if name not in visible]
    details = f"<details><summary>{len(hidden)} more curves</summary>{_charts(hidden, runs)}</details>"
    return series_legend([run.name for run in runs]) + _charts(visible, runs) + (details if hidden else "")


def chart(
    title: str, lines: Mapping[str, tuple[Stroke, Points]], share: bool = False, x_label: str = ""
) -> str:
    """Return one chart as HTML, with a title above and ``x_label`` below.

    ``lines`` has the stroke and the points (x, y) of each line; at least one line must have points. With ``share``, the
    vertical axis spans 0 to 1 if all values fit.
    """
    series = {name: (style, _bin_points(points)) for name, (style, points) in lines.items() if len(points)}
    values = np.concatenate([points for _, points in series.values()])
    x_ticks = ticks(min(0.0, float(values[:, 0].min())), float(values[:, 0].max()), 5)
    low, high = float(values[:, 1].min()), float(values[:, 1].max())
    y_ticks = [0.0, 0.25, 0.5, 0.75, 1.0] if share and low >= 0 and high <= 1 else ticks(low, high, 5)
    last = max(float(values[:, 0].max()), x_ticks[0] + 1e-9)  # an axis needs a length above 0
    axes = Axes(x_ticks[0], last, y_ticks[0], y_ticks[-1], left=52)
    shapes = [axes.grid_line(value, format_compact(value)) for value in y_ticks]
    shapes += [axes.tick_label(value) for value in x_ticks if value <= axes.x1 + 1e-9]
    shapes += [
        f'<polyline {style.svg} points="{axes.path(points)}"><title>{escape(name)}</title></polyline>'
        for name, (style, points) in series.items()
    ]
    return axes.figure(title, shapes, x_label)


def _bin_points(points: Points) -> Float[np.ndarray[Any, Any], "bin 2"]:
    """Sort points by step, and average them into bins if there are too many."""
    points = points[np.argsort(points[:, 0], kind="stable")]
    if len(points) <= _MAX_POINTS:
        return points
    return np.stack([bin_points.mean(axis=0) for bin_points in np.array_split(points, _MAX_POINTS)])


def _charts(names: Sequence[str], runs: Sequence[TrainingCurves]) -> str:
    """Return a chart of each quantity, with a line per run that logged it."""
    charts = []
    for name in names:
        lines = {
            run.name: (stroke(index), run.curves[name])
            for index, run in enumerate(runs)
            if name in run.curves
        }
        share = name.split("/")[-1] in (*SHARES, "progress_ratio")
        charts.append(chart(name, lines, share, x_label="environment steps"))
    return f"<div class=charts>{''.join(charts)}</div>"


class Axes:
    """Mapping from data to pixels: axes from ``x0`` to ``x1`` and ``y0`` to ``y1``, right of a margin ``left``."""

    def __init__(self, x0: float, x1: float, y0: float, y1: float, left: int) -> None:
        self.x0, self.x1, self.y0, self.y1, self.left = x0, x1, y0, y1, left

    def x(self, value: Any) -> Any:
        """Return the x coordinate of a value, pixels."""
        return self.left + (value - self.x0) / (self.x1 - self.x0) * (WIDTH - self.left - _RIGHT)

    def y(self, value: Any) -> Any:
        """Return the y coordinate of a value, pixels."""
        return HEIGHT - _BOTTOM - (value - self.y0) / (self.y1 - self.y0) * (HEIGHT - _BOTTOM - _TOP)

    def path(self, points: Any) -> str:
        """Return points ``[n, 2]`` as the ``points`` of an SVG polyline."""
        return " ".join(f"{self.x(x):.1f},{self.y(y):.1f}" for x, y in points)

    def grid_line(self, value: float, text: str) -> str:
        """Return a horizontal grid line with its label."""
        y = self.y(value)
        return (
            f'<line class="grid" x1="{self.left}" x2="{WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
            f'<text x="{self.left - 6}" y="{y + 4:.1f}" text-anchor="end">{text}</text>'
        )

    def tick_label(self, value: float) -> str:
        """Return a label of the horizontal axis."""
        y = HEIGHT - _BOTTOM + 15
        return f'<text x="{self.x(value):.1f}" y="{y}" text-anchor="middle">{format_compact(value)}</text>'

    def figure(self, title: str, shapes: Iterable[str], x_label: str, subtitle: str = "") -> str:
        """Return the chart with its caption, shapes and label of the horizontal axis; ``subtitle`` is HTML."""
        middle = (self.left + WIDTH - _RIGHT) / 2
        return (
            f"<figure class=chart><figcaption>{escape(title)}{subtitle}</figcaption>"
            f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">{"".join(shapes)}'
            f'<text x="{middle:.0f}" y="{HEIGHT - 4}" text-anchor="middle">{escape(x_label)}</text></svg></figure>'
        )


def ticks(low: float, high: float, maximum: int) -> list[float]:
    """Return evenly spaced round numbers that enclose ``[low, high]``: steps of 1, 2 or 5 times a power of ten.

    They enclose it up to rounding, with at most ``maximum + 1`` steps. A single value gets an interval around it.
    """
    if high - low < 1e-12 * max(1.0, abs(low), abs(high)):
        pad = max(0.5 * abs(low), 0.5)
        low, high = low - pad, high + pad
    minimum_step = (high - low) / maximum
    power = 10.0 ** math.floor(math.log10(minimum_step))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= minimum_step * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [step * index for index in range(first, last + 1)]


def format_compact(value: float) -> str:
    """Format a number compactly: ``1.5M``, ``20k``, ``0.25``."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:.4g}{letter}".replace("-", "−")
    return "0" if abs(value) < 1e-12 else f"{value:.4g}".replace("-", "−")


def series_legend(names: Sequence[str]) -> str:
    """Return the legend of charts: names in the order of their strokes."""
    entries = [(stroke(index).key, escape(name)) for index, name in enumerate(names)]
    items = "".join(f'<li><i style="background:{style}"></i>{name}</li>' for style, name in entries)
    return f"<ul class=series>{items}</ul>"


Values = Float[np.ndarray[Any, Any], "_"]
#: Metrics with a distribution chart, in order.
SPREAD = (
    "vmax_score", "progress_ratio", "min_ttc", "average_ttc", "max_jerk", "max_lateral_acceleration", "comfort",
    "speeding_max", "route_deviation_max", "ade", "goal_distance", "distance",
)  # fmt: skip
#: Maximum number of steps of a distribution. Its corners, two per step, must not be averaged into bins.
_MAX_STEPS = _MAX_POINTS // 2
#: Maximum number of bins of a histogram.
BINS = 24


def distribution_charts(runs: Sequence[EpisodeTable]) -> str:
    """Return a chart for each metric of :data:`SPREAD` that varies between episodes, or "" if none does."""
    styles = {run.name: stroke(index) for index, run in enumerate(runs)}
    charts = []
    for name in SPREAD:
        lines = {run.name: distribution(run.metrics[name]) for run in runs if name in run.metrics}
        values = np.concatenate([line[:, 0] for line in lines.values()]) if lines else np.zeros(0)
        if values.size and values.min() < values.max():
            series = {run: (styles[run], line) for run, line in lines.items()}
            charts.append(chart(metric_label(name, runs).text, series, share=True))
    return f"{series_legend(list(styles))}<div class=charts>{''.join(charts)}</div>" if charts else ""


def distribution(values: Any) -> Float[np.ndarray[Any, Any], "point 2"]:
    """Return the corners of the empirical distribution function of the defined values: value, cumulative share.

    More than 75 values are thinned evenly, which lowers the share at a value by less than 1 / 74.
    """
    sorted_values = np.sort(np.asarray(values, np.float64))
    sorted_values = sorted_values[~np.isnan(sorted_values)]
    if not sorted_values.size:
        return np.zeros((0, 2))
    share = np.arange(1, sorted_values.size + 1) / sorted_values.size
    if sorted_values.size > _MAX_STEPS:
        rows = np.unique(np.ceil(np.linspace(1, sorted_values.size, _MAX_STEPS)).astype(int)) - 1
        sorted_values, share = sorted_values[rows], share[rows]
    return np.column_stack((np.repeat(sorted_values, 2), np.concatenate(([0.0], np.repeat(share, 2)[:-1]))))


def histogram(title: str, series: Mapping[str, Values], unit: str = "per scenario") -> str:
    """Return one histogram as HTML: the share of each series in common bins, labelled with the unit.

    At least one series must have values.
    """
    values = np.concatenate(list(series.values()))
    edges = bins(values)
    shares = {name: _shares(numbers, edges) for name, numbers in series.items()}
    levels = ticks(0.0, max(float(share.max()) for share in shares.values()), 4)
    low, high = float(edges[0]), float(edges[-1])
    axes = Axes(low, high, 0.0, levels[-1], left=44)
    shapes = [axes.grid_line(value, f"{format_compact(100 * value)} %") for value in levels]
    are_integers = bool((values == np.round(values)).all())
    x_ticks = [value for value in ticks(low, high, 5) if low <= value <= high]
    shapes += [axes.tick_label(value) for value in x_ticks if not are_integers or value == round(value)]
    draw = _bars if len(shares) == 1 else _outline
    shapes += [draw(axes, edges, share, stroke(index)) for index, share in enumerate(shares.values())]
    prefixes = {name: escape(f"{name}: ") if len(series) > 1 else "" for name in series}
    summaries = (f"<small>{prefixes[name]}{_summary(numbers)}</small>" for name, numbers in series.items())
    return axes.figure(title, shapes, unit, "".join(summaries))


def bins(values: Values, maximum: int = BINS) -> Values:
    """Return the edges of at most ``maximum`` bins of one round width that hold all values.

    Each integer gets a bin centred on it if there are enough bins. A single value gets the middle one of three bins.
    """
    low, high = float(values.min()), float(values.max())
    are_integers = bool((values == np.round(values)).all())
    if low == high:
        return low + np.array([-1.5, -0.5, 0.5, 1.5])
    if are_integers and high - low < maximum:
        return np.arange(low - 0.5, high + 1.0)
    # Begin at zero or below, unless all values are far above it.
    start = min(low, 0.0) if low < 0.5 * high else low
    edges = np.array(ticks(start, high, maximum - 1))
    width = edges[1] - edges[0]
    edges[0] = min(edges[0], start)  # rounding may place it above the least value
    return np.append(edges, edges[-1] + width) if edges[-1] <= high else edges


def format_short(value: Any) -> str:
    """Format a number with three significant digits, but at most two decimals and all digits before the point."""
    value = float(value)
    if abs(value) >= 100 or value == round(value):
        return f"{value:,.0f}"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def _shares(values: Values, edges: Values) -> Values:
    """Return the share of values in each bin; zeros without values."""
    counts, _ = np.histogram(values, edges)
    return counts / max(len(values), 1)


def _summary(values: Values) -> str:
    """Return median, maximum and number of values as text."""
    if not len(values):
        return "n 0"
    return f"median {format_short(np.median(values))}, max {format_short(values.max())}, n {len(values):,}"


def _bars(axes: Axes, edges: Values, shares: Values, style: Stroke) -> str:
    """Return the bins as bars."""
    return "".join(
        f'<rect x="{axes.x(a) + 0.5:.1f}" y="{axes.y(share):.1f}" width="{axes.x(b) - axes.x(a) - 1:.1f}" '
        f'height="{axes.y(0) - axes.y(share):.1f}" fill="{style.colour}">'
        f"<title>{format_compact(a)} to {format_compact(b)}: {100 * share:.3g} %</title></rect>"
        for a, b, share in zip(edges[:-1], edges[1:], shares, strict=True)
        if share > 0
    )


def _outline(axes: Axes, edges: Values, shares: Values, style: Stroke) -> str:
    """Return the bins as one line around all bars."""
    corners = np.column_stack((np.repeat(edges, 2), np.concatenate(([0.0], np.repeat(shares, 2), [0.0]))))
    return f'<polyline {style.svg} points="{axes.path(corners)}"/>'


Array = np.ndarray[Any, Any]
#: Below this speed curvature is undefined: noise dominates the change of heading.
_MIN_SPEED_MPS = 0.5


@dataclass(frozen=True)
class Signal:
    """A plot of the player: title, unit, resolution of packed values (``step``), and low and high comfort limits."""

    name: str
    title: str
    unit: str
    step: float
    limits: tuple[float, ...] = ()


SIGNALS = (
    Signal("speed", "speed", "m/s", 0.01),
    Signal("acceleration", "longitudinal acceleration", "m/s²", 0.01, comfort.LONGITUDINAL_MPS2),
    Signal("jerk", "longitudinal jerk", "m/s³", 0.01, (-comfort.JERK_MPS3, comfort.JERK_MPS3)),
    Signal("curvature", "curvature", "1/m", 0.0001),
    Signal("yaw_rate", "yaw rate", "rad/s", 0.001, (-comfort.YAW_RATE_RPS, comfort.YAW_RATE_RPS)),
    Signal("lateral", "lateral acceleration", "m/s²", 0.01, (-comfort.LATERAL_MPS2, comfort.LATERAL_MPS2)),
)
#: Commands: the first two numbers of an action.
COMMANDS = (
    Signal("longitudinal_command", "longitudinal command", "maximum 1", 0.001),
    Signal("lateral_command", "lateral command", "maximum 1", 0.001),
)


def signals(ego: Float[Array, "step 4"]) -> dict[str, Float[Array, " step"]]:
    """Return the signals of a path by name, differentiated and filtered like the comfort metrics.

    The path has position [m], heading [rad] and speed [m/s], NaN where the agent is absent. Filters are nuPlan's
    Savitzky-Golay windows and orders: 8/2 for accelerations, 15/2 for the jerk of the filtered acceleration, 5/2 for
    the yaw rate (``metrics.comfort``). Curvature is yaw rate over speed, NaN below 0.5 m/s. Steps near the ends take
    values of the first or last window's polynomial. Except for speed, values are NaN outside the last contiguous
    stretch of the path, at its first step, and everywhere if it has fewer than 16 steps.
    """
    present = np.asarray(np.isfinite(ego).all(axis=1))
    values = {signal.name: np.full(len(ego), np.nan) for signal in SIGNALS}
    values["speed"][present] = ego[present, 3]
    if not present.any():
        return values
    end = int(np.flatnonzero(present)[-1]) + 1
    gaps = np.flatnonzero(~present[:end])
    first = int(gaps[-1]) + 1 if gaps.size else 0
    if end - first <= WINDOW:
        return values
    path, steps = np.asarray(ego[first:end], np.float64), slice(first + 1, end)
    heading_changes = np.asarray(wrap(np.diff(path[:, 2])))
    acceleration, speed = np.diff(path[:, 3]) / DT_S, (path[1:, 3] + path[:-1, 3]) / 2
    samples = end - first - 1
    smooth = savgol_matrix(samples, *comfort.SMOOTH)
    yaw_rate = savgol_matrix(samples, *comfort.YAW_RATE) @ np.cumsum(heading_changes) / DT_S
    values["acceleration"][steps] = smooth @ acceleration
    values["lateral"][steps] = smooth @ (speed * heading_changes / DT_S)
    values["jerk"][steps] = savgol_matrix(samples, *comfort.JERK) @ smooth @ acceleration / DT_S
    values["yaw_rate"][steps] = yaw_rate
    values["curvature"][steps] = np.where(
        speed >= _MIN_SPEED_MPS, yaw_rate / np.maximum(speed, _MIN_SPEED_MPS), np.nan
    )
    return values
