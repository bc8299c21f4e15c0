"""A still picture of a scenario at one step, in the colours of the player."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from drivax.errors import UsageError
from drivax.geometry.boxes import corners
from drivax.report.pictures.palette import LEGEND, LIGHT, THEMES, agent_colour, light_colour
from drivax.report.pictures.roads import Box, light_rows, road_lines, route, stop_signs
from drivax.scenario.schema import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Colours = Mapping[str, str]
#: Height of the legend.
_LEGEND_INCHES = 0.85
_WIDTHS = {"lane": 0.8, "bike": 0.8, "line": 0.8, "edge": 1.6}


def draw_scenario(
    scenario: Scenario,
    step: int,
    ego: Any = None,
    reach_m: float = 60.0,
    theme: str = "light",
    legend: bool = True,
) -> Figure:
    """Draw map, agents, lights and route around the ego at one step.

    Args:
        scenario: The scenario.
        step: Step to draw, 0 to ``scenario.steps - 1``.
        ego: Driven path ``[step, 4]`` (x, y, heading, speed; local frame) to draw instead of the log's ego, whose box
            is then dashed; None draws the log.
        reach_m: Half the side of the square that is drawn, metres.
        theme: ``light`` or ``dark``.
        legend: Say below the picture what the colours mean.

    Returns:
        A figure; save it with ``figure.savefig(path)``.

    Raises:
        UsageError: The step is outside the scenario, or matplotlib is not installed.
    """
    if not 0 <= step < int(scenario.steps):
        raise UsageError(f"step {step} is not in the scenario", cure=f"use 0 to {int(scenario.steps) - 1}")
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise UsageError("matplotlib is not installed", cure="pip install 'drivax[show]'") from error
    path = None if ego is None else np.asarray(ego, dtype=np.float64)
    logged = scenario.agent_xy[step, 0]
    centre = logged if path is None or not np.isfinite(path[step]).all() else path[step, :2]
    colours, below = THEMES[theme], _LEGEND_INCHES if legend else 0.0
    figure = Figure(figsize=(7, 7 + below), dpi=110, facecolor=colours["ground"])
    axes = figure.add_axes((0, below / (7 + below), 1, 7 / (7 + below)))
    draw_on(axes, scenario, step, (float(centre[0]), float(centre[1])), reach_m, path, colours)
    if legend:
        _draw_legend(figure, colours)
    return figure


def draw_on(
    axes: Axes,
    scenario: Scenario,
    step: int,
    centre: tuple[float, float],
    reach_m: float,
    path: Any = None,
    colours: Colours = LIGHT,
) -> None:
    """Draw a square of a scenario at one step on given axes.

    Args:
        axes: Where to draw.
        scenario: The scenario.
        step: Step to draw.
        centre: Middle of the square, metres, local frame.
        reach_m: Half its side, metres.
        path: Driven path ``[step, 4]`` to draw instead of the log's ego, or None.
        colours: A theme of the palette.
    """
    (x, y), around = centre, reach_m + 5.0
    _draw_map(axes, colours, scenario, (x - around, y - around, x + around, y + around))
    _draw_lights(axes, colours, scenario, step)
    _draw_agents(axes, colours, scenario, step)
    _draw_ego(axes, colours, scenario, step, path)
    axes.set(xlim=(x - reach_m, x + reach_m), ylim=(y - reach_m, y + reach_m))
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.add_patch(_rectangle(axes, colours))
    _scale_bar(axes, colours, reach_m)


def _rectangle(axes: Axes, colours: Colours) -> Any:
    """The ground: an axis that is switched off paints no background of its own."""
    from matplotlib.patches import Rectangle

    return Rectangle((0, 0), 1, 1, transform=axes.transAxes, color=colours["ground"], zorder=-10)


def _draw_map(axes: Axes, colours: Colours, scenario: Scenario, box: Box) -> None:
    from matplotlib.collections import LineCollection, PolyCollection

    layers = road_lines(scenario, box)
    axes.add_collection(PolyCollection(layers["crosswalk"], facecolor=colours["crosswalk"], zorder=0))
    for rank, (name, width) in enumerate(_WIDTHS.items()):
        axes.add_collection(
            LineCollection(layers[name], colors=colours[name], linewidths=width, zorder=1 + 0.1 * rank)
        )
    path = route(scenario)
    axes.plot(path[:, 0], path[:, 1], color=colours["route"], linestyle=(0, (4, 3)), linewidth=1.6, zorder=2)
    signs = stop_signs(scenario)
    axes.scatter(signs[:, 0], signs[:, 1], marker="8", s=40, color=colours["stop"], zorder=2)


def _draw_lights(axes: Axes, colours: Colours, scenario: Scenario, step: int) -> None:
    for row in light_rows(scenario):
        state = int(scenario.light_state[step, row])
        if state >= 0:
            x0, y0, x1, y1 = scenario.light_line[row]
            colour = light_colour(state)
            width = {"red": 4.5, "amber": 3.5, "green": 2.2}.get(colour, 1.8)
            axes.plot((x0, x1), (y0, y1), color=colours[colour], linewidth=width, zorder=3)


def _draw_agents(axes: Axes, colours: Colours, scenario: Scenario, step: int) -> None:
    parked, moving = scenario.parked_valid[step], scenario.agent_valid[step].copy()
    moving[0] = False
    groups = (
        (scenario.parked_xy, scenario.parked_heading, scenario.parked_size, scenario.parked_kind, parked),
        (
            scenario.agent_xy[step],
            scenario.agent_heading[step],
            scenario.agent_size,
            scenario.agent_kind,
            moving,
        ),
    )
    for still, (xy, heading, size, kinds, valid) in zip((True, False), groups, strict=True):
        for row in np.flatnonzero(valid):
            colour = agent_colour(int(kinds[row]))
            colour = "parked" if still and colour == "vehicle" else colour
            style = {"facecolor": colours[colour], "edgecolor": colours["outline"]}
            _box(axes, xy[row], heading[row], size[row], **style, zorder=4)


def _draw_ego(axes: Axes, colours: Colours, scenario: Scenario, step: int, path: Any) -> None:
    size, logged = scenario.agent_size[0], scenario.agent_xy[step, 0]
    heading, seen = float(scenario.agent_heading[step, 0]), bool(scenario.agent_valid[step, 0])
    trail = (
        scenario.agent_xy[: step + 1, 0][scenario.agent_valid[: step + 1, 0]]
        if path is None
        else path[: step + 1]
    )
    axes.plot(trail[:, 0], trail[:, 1], color=colours["ego"], linewidth=1.8, zorder=4.5)
    if path is not None and seen:
        _box(
            axes, logged, heading, size, facecolor="none", edgecolor=colours["log"], linestyle="--", zorder=5
        )
    if path is not None:
        logged, heading, seen = path[step, :2], float(path[step, 2]), bool(np.isfinite(path[step]).all())
    if seen:
        _box(axes, logged, heading, size, facecolor=colours["ego"], edgecolor=colours["ink"], zorder=6)
        _box(axes, logged + 0.2 * size[0] * np.array((np.cos(heading), np.sin(heading))), heading,
             np.array((0.25 * size[0], 0.5 * size[1])), facecolor=colours["outline"], edgecolor=colours["outline"],
             zorder=7)  # fmt: skip


def _box(axes: Axes, xy: Any, heading: Any, size: Any, **style: Any) -> None:
    from matplotlib.patches import Polygon

    box = np.array((xy[0], xy[1], np.cos(heading), np.sin(heading), size[0], size[1]))
    axes.add_patch(Polygon(corners(box), closed=True, linewidth=0.7, **style))


def _scale_bar(axes: Axes, colours: Colours, reach_m: float) -> None:
    length = next(nice for nice in (1, 2, 5, 10, 20, 50, 100, 200, 500) if nice >= reach_m / 5 or nice == 500)
    width = length / (2 * reach_m)
    axes.plot((0.03, 0.03 + width), (0.03, 0.03), color=colours["ink"], linewidth=2, transform=axes.transAxes)
    axes.text(0.03, 0.04, f"{length} m", color=colours["ink"], fontsize=9, transform=axes.transAxes)


def _draw_legend(figure: Figure, colours: Colours) -> None:
    """What the colours mean, in the shapes that are drawn; failures are not, in a still picture."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def sign(name: str) -> Any:
        if name in ("route", "log"):
            return Line2D([], [], color=colours[name], linestyle="--")
        if name in ("red", "amber", "green", "unknown"):
            return Line2D([], [], color=colours[name], linewidth=4)
        if name == "stop":
            return Line2D([], [], color=colours[name], marker="8", linestyle="none")
        return Patch(facecolor=colours[name], edgecolor=colours["outline"])

    shown = [(name, words) for name, words in LEGEND if name not in ("mark", "goal")]
    signs, words = [sign(name) for name, _ in shown], [words for _, words in shown]
    figure.legend(signs, words, loc="lower center", ncol=5, frameon=False, fontsize=9, labelcolor=colours["ink"],
                  columnspacing=1.2, handlelength=1.6)  # fmt: skip
