"""Drawing of an episode, shared by player, videos and Gymnasium rendering, and still pictures of one step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from drivax.errors import UsageError, explain_missing_package
from drivax.geometry.boxes import corners
from drivax.report.pictures.palette import (
    LEGEND,
    LIGHT,
    agent_colour,
    light_colour,
    road_layer,
    theme_colours,
)
from drivax.scenario.schema import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = np.ndarray[Any, Any]
Box = tuple[float, float, float, float]
Lines = list[Float[Array, "_ 2"]]
#: Layers of the map in drawing order.
LAYERS = ("crosswalk", "lane", "bike", "line", "edge")
#: Colours of lights, in the order of their codes.
LIGHTS = ("unknown", "red", "amber", "green")
#: Widths of lines by colour, pixels.
WIDTHS: Mapping[str, float] = {
    "lane": 1.0, "bike": 1.0, "line": 1.0, "edge": 1.8, "route": 2.0, "goal": 2.0, "ego": 2.0, "log": 1.4, "ink": 1.4,
    "outline": 0.8, "red": 5.0, "amber": 4.0, "green": 2.5, "unknown": 2.0,
}  # fmt: skip
#: Marked events, and their text.
EVENT_WORDS: Mapping[str, str] = {
    "collision": "collision", "offroad": "off-road", "red_light": "red light", "crashed": "planner crashed",
}  # fmt: skip
#: Margin around all ego paths within which map and agents are drawn, metres.
MARGIN_M = 90.0
#: Radii of a stop sign and of the ring around the goal, metres.
STOP_M, GOAL_M = 0.9, 2.0
#: Maximum gap between consecutive segments of one line, metres.
_JOINT_M = 0.02
Colours = Mapping[str, str]
#: Height of the legend, inches.
_LEGEND_IN = 0.85
#: Points per pixel of a line's width.
_POINTS_PER_PIXEL = 0.9


@dataclass(frozen=True)
class Rollout:
    """One planner's episode in a scenario.

    Attributes:
        planner, outcome: Names of the planner and of the outcome.
        ego: Position [m], heading [rad], speed [m/s] at every step, local frame; NaN where the agent is absent.
        start: Step at which the planner took over.
        events: Step of the first event by name, -1 for none.
        action: The first two numbers of each action, NaN for steps without one; None for the log.
        others: Position [m] and heading [rad] of every agent in reactive traffic, NaN where absent; None in log replay.
    """

    planner: str
    ego: Float[Array, "step 4"]
    start: int
    events: dict[str, int]
    outcome: str
    action: Float[Array, "step 2"] | None = None
    others: Float[Array, "step agent 3"] | None = None


def replace_traffic(scenario: Scenario, rollout: Rollout) -> Scenario:
    """Return the scenario with the trajectories of all agents but ego in a rollout, from its start on."""
    if rollout.others is None:
        return scenario
    others = rollout.others[rollout.start :, 1:]
    steps, slots = slice(rollout.start, rollout.start + len(others)), slice(1, 1 + others.shape[1])
    present = np.asarray(np.isfinite(others).all(axis=-1))
    poses = np.where(present[..., None], others, 0.0)
    record = scenario.record.copy()
    record["agent_valid"][steps, 1:] = False
    record["agent_valid"][steps, slots] = present
    record["agent_xy"][steps, slots] = poses[..., :2]
    record["agent_heading"][steps, slots] = poses[..., 2]
    return replace(scenario, record=record)


def surroundings(scenario: Scenario, rollouts: Sequence[Rollout]) -> Box:
    """Return the bounding box of all ego paths with a margin, metres."""
    paths = [scenario.agent_xy[:, 0][scenario.agent_valid[:, 0]]]
    paths += [rollout.ego[np.isfinite(rollout.ego).all(axis=1), :2] for rollout in rollouts]
    points = np.concatenate(paths).astype(np.float64)
    low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


@dataclass(frozen=True)
class Shape:
    """Lines or polygons ``[n, 2]`` of one style, metres.

    ``line`` and ``fill`` are the colours of outline and inside; None draws no outline, or no inside. ``dash`` has the
    lengths of dashes and gaps in pixels, empty for a solid line. Shapes of a higher ``level`` are drawn on top.
    """

    lines: Sequence[Array]
    line: str | None = None
    fill: str | None = None
    dash: tuple[float, ...] = ()
    level: float = 0.0

    @property
    def width(self) -> float:
        """Width of the outline, pixels."""
        return WIDTHS[self.line] if self.line else 0.0


@dataclass(frozen=True)
class AgentBoxes:
    """Agents as boxes: pose and presence at every step, length and width in metres, and the name of a colour."""

    xy: Float[Array, "step agent 2"]
    heading: Float[Array, "step agent"]
    size: Float[Array, "agent 2"]
    colour: Sequence[str]
    valid: Bool[Array, "step agent"]

    def shapes(self, step: int) -> Iterator[Shape]:
        """Yield the agents at a step, one shape per colour."""
        rows: list[int] = np.flatnonzero(self.valid[step]).tolist()
        for colour in dict.fromkeys(self.colour[row] for row in rows):
            group = [row for row in rows if self.colour[row] == colour]
            outlines = [
                _outline(self.xy[step, row], self.heading[step, row], self.size[row]) for row in group
            ]
            yield Shape(outlines, "outline", colour, level=4)


@dataclass(frozen=True)
class Drawing:
    """Drawing of a scenario, in its local frame, metres.

    Attributes:
        layers, stops: Polylines of the map by layer, and positions of stop signs.
        route, goal: Points of the route, and the goal, if it is near.
        light_line, light_state: Stop line of each light, and its code (:data:`LIGHTS`) at every step, -1 unobserved.
        agents, parked, log: Moving agents but ego, parked agents, and the logged ego.
    """

    layers: Mapping[str, Lines]
    stops: Float[Array, "sign 2"]
    route: Float[Array, "point 2"]
    goal: Float[Array, "_ 2"]
    light_line: Float[Array, "light 2 2"]
    light_state: Int[Array, "step light"]
    agents: AgentBoxes
    parked: AgentBoxes
    log: AgentBoxes

    @classmethod
    def of(cls, scenario: Scenario, box: Box) -> Drawing:
        """Return the drawing of a scenario within a box (low x, low y, high x, high y)."""
        signs = scenario.stop_xy[scenario.has_stop]
        line, state = _lights(scenario)
        is_near = _within(line[:, 0], box)
        route = scenario.route_xy[0, : int(scenario.route_points[0])]
        goal = np.asarray(scenario.goal_xy)[None]
        return cls(
            road_lines(scenario, box), signs[_within(signs, box)], route[_within(route, box)],
            goal[_within(goal, box)], line[is_near], state[:, is_near],
            _agent_boxes(scenario, box), _parked_boxes(scenario, box), _boxes(scenario, slice(0, 1)),
        )  # fmt: skip

    def ground(self) -> Iterator[Shape]:
        """Yield the static shapes: map, stop signs, route and goal."""
        yield Shape(self.layers["crosswalk"], fill="crosswalk")
        for name in LAYERS[1:]:
            yield Shape(self.layers[name], name, level=1)
        yield Shape([ring(sign, STOP_M) for sign in self.stops], fill="stop", level=2)
        yield Shape([self.route] if len(self.route) else [], "route", dash=(7.0, 5.0), level=2)
        yield Shape([ring(point, GOAL_M) for point in self.goal], "goal", level=2)

    def traffic(self, step: int) -> Iterator[Shape]:
        """Yield lights and all agents but ego at a step."""
        for code, name in enumerate(LIGHTS):
            yield Shape(list(self.light_line[self.light_state[step] == code]), name, level=3)
        yield from self.parked.shapes(step)
        yield from self.agents.shapes(step)

    def ego(self, path: Float[Array, "step _"], step: int, with_log: bool = True) -> Iterator[Shape]:
        """Yield ego at a step: its path so far, the dashed box of the log (``with_log``), its box and its arrow.

        ``path`` has position and heading at every step, NaN where ego is absent.
        """
        path, size = path[: step + 1], self.log.size[0]
        yield Shape([path[np.isfinite(path).all(axis=1), :2]], "ego", level=4.5)
        if with_log and self.log.valid[step, 0]:
            box = _outline(self.log.xy[step, 0], self.log.heading[step, 0], size)
            yield Shape([box], "log", dash=(4.0, 3.0), level=5)
        if np.isfinite(path[-1]).all():
            x, y, heading = path[-1, :3]
            yield Shape([_outline((x, y), heading, size)], "ink", "ego", level=6)
            ahead = np.array((np.cos(heading), np.sin(heading)))
            left = np.array((-ahead[1], ahead[0]))
            # An arrow on the roof: its tip and base ahead of the centre, and half its width, as shares of the size.
            tip, base, side = 0.38 * size[0] * ahead, 0.05 * size[0] * ahead, 0.32 * size[1] * left
            arrow = np.array((x, y)) + np.array((tip, base + side, base - side))
            yield Shape([arrow], fill="outline", level=7)


def _outline(xy: Any, heading: Any, size: Any) -> Float[Array, "5 2"]:
    """Return the closed outline of a box."""
    shape = corners(np.array((xy[0], xy[1], np.cos(heading), np.sin(heading), size[0], size[1])))
    return np.concatenate((shape, shape[:1]))


def ring(xy: Array, radius: float) -> Float[Array, "25 2"]:
    """Return the points of a circle; the last is the first."""
    angle = np.linspace(0.0, 2 * np.pi, 25)
    return xy + radius * np.column_stack((np.cos(angle), np.sin(angle)))


def _within(xy: Array, box: Box) -> Bool[Array, "..."]:
    """Return a mask of the points inside a box."""
    return np.all((xy >= box[:2]) & (xy <= box[2:]), axis=-1)


def road_lines(scenario: Scenario, box: Box | None = None) -> dict[str, Lines]:
    """Return the polylines of every layer, without segments whose midpoint is outside the box.

    Segments are stored by grid cell. Those of a feature are sorted by arc length and chained where their ends meet. The
    box is (low x, low y, high x, high y).
    """
    count = int(scenario.segment_blocks[3])  # the end of the last block
    rows = np.lexsort((scenario.segment_start_m[:count], scenario.segment_feature[:count]))
    a, b = scenario.segment_a[rows, :2], scenario.segment_b[rows, :2]
    if box is not None:
        is_inside = _within((a + b) / 2, box)
        rows, a, b = rows[is_inside], a[is_inside], b[is_inside]
    layers: dict[str, Lines] = {name: [] for name in LAYERS}
    if not len(rows):
        return layers
    feature = scenario.segment_feature[rows]
    continues = (feature[1:] == feature[:-1]) & (np.abs(a[1:] - b[:-1]).max(axis=1) < _JOINT_M)
    starts = np.flatnonzero(np.concatenate(([True], ~continues)))
    for begin, end in zip(starts, [*starts[1:], len(rows)], strict=True):
        line = np.concatenate((a[begin:end], b[end - 1 : end]))
        layers[road_layer(int(scenario.segment_kind[rows[begin]]))].append(line)
    return layers


def _lights(scenario: Scenario) -> tuple[Float[Array, "light 2 2"], Int[Array, "step light"]]:
    """Return stop lines and codes of the lights that have a stop line and at least one observed state."""
    line, steps = scenario.light_line, int(scenario.steps)
    has_stop_line = np.abs(line[:, :2] - line[:, 2:]).max(axis=1, initial=0.0) > 0
    rows = np.flatnonzero(has_stop_line & (scenario.light_state >= 0).any(axis=0))
    states = scenario.light_state[:steps, rows]
    codes = np.full(states.shape, -1, np.int8)
    for state in np.unique(states[states >= 0]):
        codes[states == state] = LIGHTS.index(light_colour(int(state)))
    return line[rows].reshape(-1, 2, 2), codes


def _boxes(scenario: Scenario, rows: Any, valid: Any = None) -> AgentBoxes:
    """Return the boxes of some agents, present where ``valid`` or, by default, as in the scenario."""
    steps = int(scenario.steps)
    colours = [agent_colour(int(kind)) for kind in scenario.agent_kind[rows]]
    return AgentBoxes(
        scenario.agent_xy[:steps, rows], scenario.agent_heading[:steps, rows], scenario.agent_size[rows, :2], colours,
        scenario.agent_valid[:steps, rows] if valid is None else valid,
    )  # fmt: skip


def _agent_boxes(scenario: Scenario, box: Box) -> AgentBoxes:
    """Return all moving agents but ego, present while they are inside the box."""
    steps = int(scenario.steps)
    is_near = scenario.agent_valid[:steps] & _within(scenario.agent_xy[:steps], box)
    is_near[:, 0] = False
    rows = np.flatnonzero(is_near.any(axis=0))
    return _boxes(scenario, rows, is_near[:, rows])


def _parked_boxes(scenario: Scenario, box: Box) -> AgentBoxes:
    steps = int(scenario.steps)
    rows = np.flatnonzero(scenario.parked_valid[:steps].any(axis=0) & _within(scenario.parked_xy, box))
    colours = [agent_colour(int(kind)) for kind in scenario.parked_kind[rows]]
    shape = (steps, len(rows))
    return AgentBoxes(
        np.broadcast_to(scenario.parked_xy[rows], (*shape, 2)), np.broadcast_to(scenario.parked_heading[rows], shape),
        scenario.parked_size[rows, :2], ["parked" if name == "vehicle" else name for name in colours],
        scenario.parked_valid[:steps, rows],
    )  # fmt: skip


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
