"""A picture of an observation: the input of a policy from above, in the ego frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from drivax.errors import explain_missing_package
from drivax.geometry.boxes import corners
from drivax.report.pictures.palette import LIGHT
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.simulator import Simulator
from drivax.tasks.features import COLUMNS, PIECE_M, POSITION_M, SIZE_M, SPEED_MPS, feature_names
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Values = np.ndarray[Any, Any]
#: Colours in the order of one-hot features: kinds of agents, states of lights (by name), kinds of road (with widths).
_KINDS = ("vehicle", "pedestrian", "cyclist", "other")
_STATES = {"unknown": "unknown", "green": "green", "yellow": "amber", "red": "red"}
_ROADS = {"lane": ("lane", 1.6), "edge": ("edge", 2.2), "crosswalk": ("line", 5.0)}
#: Maximum distance of drawn points, and margin around them, m.
_MAX_DISTANCE_M, _MARGIN_M = 130.0, 4.0
#: Corners (ahead, left) of a rectangle that every picture contains, m.
_MIN_EXTENT_M = ((20.0, 12.0), (-8.0, -12.0))
#: Minimum ratio of the shorter to the longer side of the picture.
_MIN_ASPECT = 0.66
#: Radius of the dot for an agent of unknown size, m.
_DOT_M = 0.9
#: Factors that turn scaled features into m and m/s; the length of road pieces has another.
_SCALE = {
    "position": POSITION_M, "goal": POSITION_M, "velocity": SPEED_MPS, "length": SIZE_M, "width": SIZE_M
}  # fmt: skip


@dataclass(frozen=True)
class ObservationGroups:
    """An observation by group and feature ``[..., columns]``, and a mask of each group's valid rows.

    Positions, goals, lengths, widths and velocities are in m and m/s, other features as observed.
    """

    values: Mapping[str, Mapping[str, Values]]
    masks: Mapping[str, Values]

    @classmethod
    def of(cls, config: ObservationConfig, observation: Mapping[str, Any]) -> ObservationGroups:
        """Split one observation (unbatched) of a configuration."""
        arrays = {name: np.asarray(value) for name, value in observation.items()}
        names = feature_names(config.features, {name: value.shape for name, value in arrays.items()})
        values, masks = {}, {}
        for group in (name for name in COLUMNS if name in arrays):
            values[group], start = {}, 0
            for feature in getattr(config.features, group):
                width = sum(name.split()[0] == feature for name in names[group])
                scale = PIECE_M if (group, feature) == ("road", "length") else _SCALE.get(feature, 1.0)
                values[group][feature] = arrays[group][..., start : start + width] * scale
                start += width
            shape = arrays[group].shape[:-1]
            masks[group] = arrays.get(f"{group}_mask", np.ones(shape, bool))
        return cls(values, masks)

    def has(self, group: str, *features: str) -> bool:
        """Return whether a group has all of these features."""
        return group in self.values and all(name in self.values[group] for name in features)

    def __getitem__(self, key: tuple[str, str]) -> Values:
        group, feature = key
        return self.values[group][feature]


def draw_observation(config: ObservationConfig, observation: Mapping[str, Any], title: str = "") -> Figure:
    """Return a figure of one observation (unbatched) from above, ego's heading up, without masked rows.

    Raises:
        UsageError: matplotlib is not installed.
    """
    with explain_missing_package():
        from matplotlib.figure import Figure
    groups = ObservationGroups.of(config, observation)
    low, high = _extent(groups)
    width, height = high - low
    height_in = 7.6
    width_in = min(max(height_in * width / height, 3.2), 10.0)
    figure = Figure(figsize=(width_in + 2.9, height_in + 0.5), dpi=100, facecolor="white")
    figure_width, figure_height = figure.get_size_inches()
    axes = figure.add_axes(
        (0.15 / figure_width, 0.15 / figure_height, width_in / figure_width, height_in / figure_height),
        facecolor=LIGHT["ground"],
    )
    _draw(axes, config, groups)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xticks=[], yticks=[])
    axes.set_aspect("equal", adjustable="box", anchor="NW")
    for side in axes.spines.values():
        side.set_color(LIGHT["lane"])
    _scale_bar(axes, low, high)
    _legend(figure, (width_in + 0.4) / figure_width, config, groups)
    style: dict[str, Any] = {"fontsize": 11, "color": LIGHT["ink"], "va": "center", "weight": "bold"}
    figure.text(0.15 / figure_width, 1 - 0.2 / figure_height, title, **style)
    return figure


def draw_log_observation(
    task: Task, bank: ScenarioBank, title: str = "", row: int = 0, step: int = CURRENT_STEP
) -> Figure:
    """Return a figure of the observation of a scenario at a step of its log."""
    simulator = Simulator(task)
    observe = jax.jit(lambda bank: simulator.observe(bank, simulator.context(bank, row, step)))
    return draw_observation(task.observation, observe(bank), title)


def _to_paper(points: Values) -> Values:
    """Rotate points of the ego frame (ahead, left) so that ahead is up on paper."""
    return np.stack([-points[..., 1], points[..., 0]], axis=-1)


def _extent(groups: ObservationGroups) -> tuple[Values, Values]:
    """Return the low and high corner on paper of a rectangle around all points, clipped to ``_MAX_DISTANCE_M``."""
    points = [_to_paper(np.array(_MIN_EXTENT_M))]
    for group in ("agents", "road", "lights", "route", "ego"):
        if groups.has(group, "position"):
            points.append(_to_paper(groups[group, "position"][groups.masks[group]]))
    xy = np.clip(np.concatenate(points), -_MAX_DISTANCE_M, _MAX_DISTANCE_M)
    low, high = xy.min(axis=0) - _MARGIN_M, xy.max(axis=0) + _MARGIN_M
    width, height = high - low
    padding = np.array([max(_MIN_ASPECT * height - width, 0.0), max(_MIN_ASPECT * width - height, 0.0)]) / 2
    return low - padding, high + padding


def _draw(axes: Axes, config: ObservationConfig, groups: ObservationGroups) -> None:
    if config.road:
        _draw_reach(axes, config)
    layers = {"road": _draw_road, "route": _draw_route, "lights": _draw_lights, "agents": _draw_agents}
    for group, draw in layers.items():
        if groups.has(group, "position"):
            draw(axes, groups)
    _draw_ego(axes, groups)


def _draw_reach(axes: Axes, config: ObservationConfig) -> None:
    """Draw the box around the observed road."""
    from matplotlib.patches import Rectangle

    side, behind, ahead = config.road_side_m, config.road_behind_m, config.road_ahead_m
    box = Rectangle((-side, -behind), 2 * side, ahead + behind, facecolor="white", edgecolor=LIGHT["lane"])
    box.set(linestyle=(0, (6, 4)), linewidth=0.9, zorder=0)
    axes.add_patch(box)


def _draw_road(axes: Axes, groups: ObservationGroups) -> None:
    from matplotlib.collections import LineCollection

    mask = groups.masks["road"]
    middle = groups["road", "position"][mask]
    if not groups.has("road", "direction"):
        axes.scatter(*_to_paper(middle).T, s=5, color=LIGHT["edge"], zorder=1)
        return
    direction = groups["road", "direction"][mask]
    length, kinds = np.ones((len(middle), 1)), np.eye(3)[np.zeros(len(middle), int)]
    if groups.has("road", "length"):
        length = groups["road", "length"][mask]
    if groups.has("road", "type"):
        kinds = groups["road", "type"][mask]
    half_piece = direction * length / 2
    pieces = _to_paper(np.stack([middle - half_piece, middle + half_piece], axis=1))
    for number, (kind, (colour, width)) in enumerate(_ROADS.items()):
        is_kind = kinds[:, number] > 0
        style: dict[str, Any] = {"linewidths": width, "capstyle": "butt", "zorder": 1.5 - number / 4}
        collection = LineCollection(list(pieces[is_kind]), colors=LIGHT[colour], **style)
        if kind == "crosswalk":
            collection.set(linestyles=[(0, (0.5, 0.5))], alpha=0.55)
        axes.add_collection(collection)
    lanes = kinds[:, 0] > 0
    arrows = _to_paper(direction[lanes])
    axes.quiver(
        *_to_paper(middle[lanes]).T, *arrows.T, color=LIGHT["line"], angles="xy", pivot="mid", scale_units="xy",
        scale=0.6, units="xy", width=0.22, headwidth=4.5, headlength=4.5, headaxislength=4, zorder=1.6,
    )  # fmt: skip


def _draw_route(axes: Axes, groups: ObservationGroups) -> None:
    points = _to_paper(groups["route", "position"][groups.masks["route"]])
    line = np.concatenate([np.zeros((1, 2)), points])
    axes.plot(*line.T, color=LIGHT["route"], linewidth=1.4, alpha=0.5, zorder=2)
    axes.scatter(*points.T, s=22, color=LIGHT["route"], edgecolor="white", linewidth=0.6, zorder=2.1)
    if groups.has("route", "goal") and len(points):
        goal = _to_paper(groups["route", "goal"][groups.masks["route"]][:1])
        axes.scatter(*goal.T, s=170, marker="*", color=LIGHT["route"], edgecolor="white", zorder=2.2)


def _draw_lights(axes: Axes, groups: ObservationGroups) -> None:
    for row in np.flatnonzero(groups.masks["lights"]):
        x, y = _to_paper(groups["lights", "position"][row])
        state = groups["lights", "state"][row] if groups.has("lights", "state") else np.eye(4)[0]
        colour = LIGHT[list(_STATES.values())[int(np.argmax(state))]]
        on_route = groups.has("lights", "on_route") and groups["lights", "on_route"][row, 0] > 0
        size, edge, width = (110, LIGHT["ink"], 1.4) if on_route else (45, "white", 0.8)
        axes.scatter(x, y, s=size, color=colour, edgecolor=edge, linewidth=width, marker="s", zorder=3)


def _opacity(step: int, steps: int) -> float:
    """Return the opacity of a pose: 1 at the last step, lower at earlier ones."""
    return 1.0 if step == steps - 1 else 0.12 + 0.3 * step / steps


def _draw_agents(axes: Axes, groups: ObservationGroups) -> None:
    mask = groups.masks["agents"]
    steps = mask.shape[1]
    for row in np.flatnonzero(mask[:, -1]):
        kind = groups["agents", "type"][row, -1] if groups.has("agents", "type") else np.eye(4)[0]
        colour = LIGHT[_KINDS[int(np.argmax(kind))]]
        for step in np.flatnonzero(mask[row]).tolist():
            _outline(axes, groups, "agents", (row, step), colour, _opacity(step, steps), 4.0 + step / steps)
        if kind[1] + kind[2] > 0:  # pedestrians and cyclists get a halo
            centre = _to_paper(groups["agents", "position"][row, -1])
            axes.scatter(*centre, s=70, color=colour, alpha=0.45, linewidth=0, zorder=3.9)
        if groups.has("agents", "velocity"):
            _arrow(axes, groups["agents", "position"][row, -1], groups["agents", "velocity"][row, -1])


def _outline(
    axes: Axes, groups: ObservationGroups, group: str, index: tuple[Any, ...], colour: str, alpha: float, zorder: float
) -> None:  # fmt: skip
    """Draw a box if heading and size are known, else a dot."""
    from matplotlib.patches import Circle, Polygon

    xy, style = groups[group, "position"][index], {"alpha": alpha, "zorder": zorder, "linewidth": 0.7}
    sizes = "ego_static" if group == "ego" else group
    edge = LIGHT["outline"] if alpha == 1.0 else "none"
    if groups.has(group, "heading") and groups.has(sizes, "length", "width"):
        sin, cos = groups[group, "heading"][index]
        size = [groups[sizes, name][() if group == "ego" else index][0] for name in ("length", "width")]
        outline = _to_paper(corners(np.array([*xy, cos, sin, *size])))
        axes.add_patch(Polygon(outline, closed=True, facecolor=colour, edgecolor=edge, **style))
        if alpha == 1.0:  # the windscreen shows the front
            front_xy = xy + 0.22 * size[0] * np.array([cos, sin])
            front = _to_paper(corners(np.array([*front_xy, cos, sin, 0.16 * size[0], 0.72 * size[1]])))
            front_style: dict[str, Any] = {"facecolor": LIGHT["ink"], "alpha": 0.65, "zorder": zorder + 0.01}
            axes.add_patch(Polygon(front, closed=True, **front_style))
    else:
        axes.add_patch(Circle(tuple(_to_paper(xy)), _DOT_M, facecolor=colour, edgecolor=edge, **style))


def _arrow(axes: Axes, position: Values, velocity: Values) -> None:
    """Draw an arrow to the position in one second at this velocity, none below 0.5 m/s."""
    if np.hypot(*velocity) < 0.5:
        return
    start, end = _to_paper(position), _to_paper(position + velocity)
    axes.annotate(
        "", xy=tuple(end), xytext=tuple(start), zorder=5.5, annotation_clip=True,
        arrowprops={"arrowstyle": "-|>", "color": LIGHT["ink"], "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0,
                    "mutation_scale": 8},
    )  # fmt: skip


def _draw_ego(axes: Axes, groups: ObservationGroups) -> None:
    if not groups.has("ego", "position"):
        axes.scatter(0, 0, s=60, color=LIGHT["ego"], zorder=6)
        return
    steps = len(groups["ego", "position"])
    for step in range(steps):
        _outline(axes, groups, "ego", (step,), LIGHT["ego"], _opacity(step, steps), 6.0 + step / steps)
    if groups.has("ego", "velocity"):
        _arrow(axes, groups["ego", "position"][-1], groups["ego", "velocity"][-1])


def _scale_bar(axes: Axes, low: Values, high: Values) -> None:
    width, height = high - low
    x, y = low[0] + 0.04 * width, low[1] + 0.025 * height
    axes.plot((x, x + 10.0), (y, y), color=LIGHT["ink"], linewidth=2.5, solid_capstyle="butt", zorder=9)
    axes.text(x + 5.0, y + 0.008 * height, "10 m", color=LIGHT["ink"], fontsize=9, ha="center", zorder=9)


def _legend(figure: Figure, left: float, config: ObservationConfig, groups: ObservationGroups) -> None:
    """Draw the legend, and the number of valid rows of each group."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def line(colour: str, label: str, **options: Any) -> Any:
        return Line2D([], [], color=LIGHT[colour], label=label, **options)

    def symbol(colour: str, label: str, marker: str = "s", **options: Any) -> Any:
        return line(colour, label, linestyle="", marker=marker, markersize=8, **options)

    handles: list[Any] = [Patch(facecolor=LIGHT["ego"], edgecolor=LIGHT["outline"], label="ego")]
    if groups.has("agents", "position"):
        kinds = (
            dict(zip(_KINDS, _KINDS, strict=True)) if groups.has("agents", "type") else {_KINDS[0]: "agent"}
        )
        edge = LIGHT["outline"]
        handles += [Patch(facecolor=LIGHT[kind], edgecolor=edge, label=name) for kind, name in kinds.items()]
        if config.steps > 1:
            handles.append(Patch(facecolor=LIGHT["vehicle"], alpha=0.3, label="past steps, faded"))
    if groups.has("agents", "velocity") or groups.has("ego", "velocity"):
        handles.append(line("ink", "motion in 1 s", marker=">", markersize=5, linewidth=0.9))
    if groups.has("road", "position"):
        roads = _ROADS if groups.has("road", "type", "direction") else {"road": ("edge", 1.6)}
        handles += [line(colour, name, linewidth=width) for name, (colour, width) in roads.items()]
        handles.append(line("lane", "reach of the road", linestyle="--", linewidth=0.9))
    if groups.has("lights", "position"):
        states = _STATES if groups.has("lights", "state") else {"unknown": "unknown"}
        handles += [symbol(colour, f"{name} light") for name, colour in states.items()]
    if groups.has("lights", "position", "on_route"):
        marker: dict[str, Any] = {"markeredgecolor": LIGHT["ink"], "markeredgewidth": 1.4}
        handles.append(symbol("ground", "light on the route", **marker))
    if groups.has("route", "position"):
        handles.append(line("route", "route", marker="o", markersize=5, linewidth=1.4))
    if groups.has("route", "goal"):
        handles.append(symbol("route", "goal", marker="*"))
    height_in = figure.get_size_inches()[1]
    legend = figure.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(left, 1 - 0.4 / height_in), frameon=False, fontsize=9,
        labelcolor=LIGHT["ink"], borderaxespad=0, handlelength=1.8,
    )  # fmt: skip
    legend.set_in_layout(False)
    counts = "\n".join(_counts(config, groups))
    figure.text(left, 0.2 / height_in, counts, fontsize=9, color=LIGHT["ink"], linespacing=1.5)


def _counts(config: ObservationConfig, groups: ObservationGroups) -> list[str]:
    """Return lines with ego's speed and last action, and the number of valid rows of each group."""
    lines = []
    if groups.has("ego", "velocity"):
        lines.append(f"ego speed {np.hypot(*groups['ego', 'velocity'][-1]):.1f} m/s")
    if groups.has("ego_static", "last_action"):
        action = ", ".join(f"{number:.2f}" for number in groups["ego_static", "last_action"])
        lines.append(f"last action {action}")
    labels = {"agents": "agents", "road": "pieces of road", "lights": "lights", "route": "route points"}
    for group, label in labels.items():
        if group in groups.masks:
            mask = groups.masks[group]
            valid = mask[:, -1] if mask.ndim > 1 else mask
            lines.append(f"{label}: {int(valid.sum())} of {valid.size}")
    lines += [f"{group.name}: not drawn" for group in config.own]
    return lines
