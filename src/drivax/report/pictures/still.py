"""A still picture of a scenario at one step, in the colours of the player."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from drivax.errors import UsageError, explain_missing_package
from drivax.report.pictures.drawing import LIGHTS, Drawing, Shape
from drivax.report.pictures.palette import LEGEND, LIGHT, theme_colours
from drivax.scenario.schema import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Colours = Mapping[str, str]
#: Height of the legend, inches.
_LEGEND_IN = 0.85
#: Points per pixel of a line's width.
_POINTS_PER_PIXEL = 0.9


def draw_scenario(
    scenario: Scenario, step: int, ego: Any = None, reach_m: float = 60.0, theme: str = "light", legend: bool = True
) -> Figure:  # fmt: skip
    """Return a figure of map, agents, lights and route around the ego at one step.

    Args:
        scenario: The scenario.
        step: Step to draw.
        ego: Path ``[step, 4]`` of ego (x, y, heading, speed; local frame), drawn next to the dashed box of the log;
            None draws only the log.
        reach_m: Half the side of the square, metres.
        theme: ``light`` or ``dark``.
        legend: Whether to draw a legend below.

    Raises:
        UsageError: The step is outside the scenario, the theme is unknown, or matplotlib is not installed.
    """
    if not 0 <= step < int(scenario.steps):
        raise UsageError(f"step {step} is not in the scenario", cure=f"use 0 to {int(scenario.steps) - 1}")
    with explain_missing_package():
        from matplotlib.figure import Figure
    path = None if ego is None else np.asarray(ego, dtype=np.float64)
    centre = scenario.agent_xy[step, 0]
    if path is not None and np.isfinite(path[step]).all():
        centre = path[step, :2]
    colours, legend_in = theme_colours(theme), _LEGEND_IN if legend else 0.0
    height_in = 7 + legend_in
    figure = Figure(figsize=(7, height_in), dpi=110, facecolor=colours["ground"])
    axes = figure.add_axes((0, legend_in / height_in, 1, 7 / height_in))
    draw_on(axes, scenario, step, (float(centre[0]), float(centre[1])), reach_m, path, colours)
    if legend:
        _draw_legend(figure, colours)
    return figure


def draw_pixels(scenario: Scenario, path: Any) -> np.ndarray[Any, Any]:
    """Return the scenario at the last step of a path, as ``[height, width, 3]`` bytes.

    Raises:
        UsageError: matplotlib is not installed.
    """
    figure = draw_scenario(scenario, len(path) - 1, ego=path, legend=False)
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3].copy()


def draw_on(
    axes: Axes, scenario: Scenario, step: int, centre: tuple[float, float], reach_m: float, path: Any = None,
    colours: Colours = LIGHT,
) -> None:  # fmt: skip
    """Draw the square around ``centre`` (x, y; local frame, metres) of a scenario on axes.

    ``path`` is ``ego`` of :func:`draw_scenario`, and ``colours`` are those of a theme; other arguments are the same.
    """
    from matplotlib.patches import Rectangle

    # Shapes whose centre lies up to 5 m outside may reach into the square.
    (x, y), half_size_m = centre, reach_m + 5.0
    drawing = Drawing.of(scenario, (x - half_size_m, y - half_size_m, x + half_size_m, y + half_size_m))
    with_log = path is not None
    if path is None:
        path = np.column_stack((scenario.agent_xy[:, 0], scenario.agent_heading[:, 0])).astype(np.float64)
        path[~scenario.agent_valid[:, 0]] = np.nan
    for shape in (*drawing.ground(), *drawing.traffic(step), *drawing.ego(path, step, with_log)):
        _draw(axes, colours, shape)
    axes.set(xlim=(x - reach_m, x + reach_m), ylim=(y - reach_m, y + reach_m))
    axes.set_aspect("equal")
    axes.set_axis_off()
    # Axes that are switched off paint no background of their own.
    ground = Rectangle((0, 0), 1, 1, transform=axes.transAxes, color=colours["ground"], zorder=-10)
    axes.add_patch(ground)
    _scale_bar(axes, colours, reach_m)


def _draw(axes: Axes, colours: Colours, shape: Shape) -> None:
    from matplotlib.collections import LineCollection, PolyCollection

    lines, width = list(shape.lines), _POINTS_PER_PIXEL * shape.width
    line = colours[shape.line] if shape.line else "none"
    artist: Any = LineCollection(lines, colors=line, linewidths=width, capstyle="round")
    if shape.fill:
        artist = PolyCollection(lines, facecolor=colours[shape.fill], edgecolor=line, linewidth=width)
    if shape.dash:
        artist.set_linestyle((0, tuple(length / shape.width for length in shape.dash)))
    artist.set_zorder(shape.level)
    axes.add_collection(artist, autolim=False)


def _scale_bar(axes: Axes, colours: Colours, reach_m: float) -> None:
    lengths = (1, 2, 5, 10, 20, 50, 100, 200, 500)
    length = next((metres for metres in lengths if metres >= reach_m / 5), lengths[-1])
    width = length / (2 * reach_m)
    axes.plot((0.03, 0.03 + width), (0.03, 0.03), color=colours["ink"], linewidth=2, transform=axes.transAxes)
    axes.text(0.03, 0.04, f"{length} m", color=colours["ink"], fontsize=9, transform=axes.transAxes)


def _draw_legend(figure: Figure, colours: Colours) -> None:
    """Draw the legend, without failures, which a still picture does not mark."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def handle(name: str) -> Any:
        if name in ("route", "log"):
            return Line2D([], [], color=colours[name], linestyle="--")
        if name in LIGHTS:
            return Line2D([], [], color=colours[name], linewidth=4)
        if name in ("stop", "goal"):
            fill = colours[name] if name == "stop" else "none"
            return Line2D([], [], color=colours[name], marker="o", linestyle="none", markerfacecolor=fill)
        return Patch(facecolor=colours[name], edgecolor=colours["outline"])

    labels = {name: label for name, label in LEGEND if name != "mark"}
    figure.legend([handle(name) for name in labels], list(labels.values()), loc="lower center", ncol=5, frameon=False,
                  fontsize=9, labelcolor=colours["ink"], columnspacing=1.2, handlelength=1.6)  # fmt: skip
