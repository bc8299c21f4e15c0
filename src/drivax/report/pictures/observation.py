"""A picture of what a policy sees: its observation from above, in the ego frame, and nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from drivax.errors import UsageError
from drivax.geometry.boxes import corners
from drivax.report.pictures.palette import LIGHT
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.simulator import Simulator
from drivax.tasks.features import COLUMNS, feature_names
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from drivax.tasks.view import PIECE_M, POSITION_M, SIZE_M, SPEED_MPS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Values = np.ndarray[Any, Any]
_KINDS = ("vehicle", "pedestrian", "cyclist", "other")
_STATES = {"unknown": "unknown", "green": "green", "yellow": "amber", "red": "red"}
_ROADS = {"lane": ("lane", 1.6), "edge": ("edge", 2.2), "crosswalk": ("line", 5.0)}
#: Nothing further than this is drawn, m; space around what is drawn, m.
_FARTHEST_M, _MARGIN_M = 130.0, 4.0
#: The picture is at least so wide for its height, and so high for its width.
_SLIMMEST = 0.66
#: An agent of unknown size is a dot of this radius, m.
_DOT_M = 0.9
_SCALE = {
    "position": POSITION_M,
    "goal": POSITION_M,
    "velocity": SPEED_MPS,
    **dict.fromkeys(("length", "width"), SIZE_M),
}


@dataclass(frozen=True)
class Seen:
    """An observation taken apart: columns by group and feature, lengths in m, velocities in m/s, others as they are.

    Attributes:
        values: Group -> feature -> ``[..., columns]``, only what is configured.
        masks: Group -> which rows are there.
    """

    values: Mapping[str, Mapping[str, Values]]
    masks: Mapping[str, Values]

    @classmethod
    def of(cls, config: ObservationConfig, observation: Mapping[str, Any]) -> Seen:
        """Takes apart one observation (unbatched) of a configuration."""
        arrays = {name: np.asarray(value) for name, value in observation.items()}
        names = feature_names(config.features, {name: value.shape for name, value in arrays.items()})
        values, masks = {}, {}
        for group in (name for name in COLUMNS if name in arrays):
            values[group], place = {}, 0
            for feature in getattr(config.features, group):
                width = sum(name.split()[0] == feature for name in names[group])
                scale = PIECE_M if (group, feature) == ("road", "length") else _SCALE.get(feature, 1.0)
                values[group][feature] = arrays[group][..., place : place + width] * scale
                place += width
            shape = arrays[group].shape[:-1]
            masks[group] = arrays.get(f"{group}_mask", np.ones(shape, bool))
        return cls(values, masks)

    def has(self, group: str, *features: str) -> bool:
        """Whether a group has all of these features."""
        return group in self.values and all(name in self.values[group] for name in features)

    def __getitem__(self, at: tuple[str, str]) -> Values:
        return self.values[at[0]][at[1]]


def draw_observation(config: ObservationConfig, observation: Mapping[str, Any], title: str = "") -> Figure:
    """Draws one observation from above, ego's heading up: what is masked or not configured is not there.

    Args:
        config: What it was made by.
        observation: The groups of one observation, unbatched.
        title: Written above.

    Returns:
        A figure; save it with ``figure.savefig(path)``.

    Raises:
        UsageError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise UsageError("matplotlib is not installed", cure="pip install 'drivax[show]'") from error
    seen = Seen.of(config, observation)
    low, high = _extent(config, seen)
    width, height = high - low
    tall = 7.6
    wide = min(max(tall * width / height, 3.2), 10.0)
    figure = Figure(figsize=(wide + 2.9, tall + 0.5), dpi=100, facecolor="white")
    across, up = figure.get_size_inches()
    axes = figure.add_axes((0.15 / across, 0.15 / up, wide / across, tall / up), facecolor=LIGHT["ground"])
    _draw(axes, config, seen)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xticks=[], yticks=[])
    axes.set_aspect("equal", adjustable="box", anchor="NW")
    for side in axes.spines.values():
        side.set_color(LIGHT["lane"])
    _scale_bar(axes, low, high)
    _legend(figure, (wide + 0.4) / across, config, seen)
    figure.text(
        0.15 / across, 1 - 0.2 / up, title, fontsize=11, color=LIGHT["ink"], va="center", weight="bold"
    )
    return figure


def draw_moment(
    task: Task, bank: ScenarioBank, title: str = "", row: int = 0, step: int = CURRENT_STEP
) -> Figure:
    """Draws what the ego of a scenario sees at a step of its log."""
    simulator = Simulator(task)
    observe = jax.jit(lambda bank: simulator.observe(bank, simulator.context(bank, row, step)))
    return draw_observation(task.observation, observe(bank), title)


def _up(points: Values) -> Values:
    """Points of the ego frame (ahead, left) on paper: ahead is up, left is left."""
    return np.stack([-points[..., 1], points[..., 0]], axis=-1)


def _extent(config: ObservationConfig, seen: Seen) -> tuple[Values, Values]:
    """The rectangle of paper that holds everything that is seen, no further than ``_FARTHEST_M``."""
    points = [np.zeros((1, 2)), np.array([[20.0, 12.0], [-8.0, -12.0]])]
    for group in ("agents", "road", "lights", "route", "ego"):
        if seen.has(group, "position"):
            points.append(_up(seen[group, "position"][seen.masks[group]]))
    everything = np.clip(np.concatenate(points), -_FARTHEST_M, _FARTHEST_M)
    low, high = everything.min(axis=0) - _MARGIN_M, everything.max(axis=0) + _MARGIN_M
    # Neither a tower nor a ribbon: as much more on both sides as is needed.
    width, height = high - low
    more = np.array([max(_SLIMMEST * height - width, 0.0), max(_SLIMMEST * width - height, 0.0)]) / 2
    return low - more, high + more


def _draw(axes: Axes, config: ObservationConfig, seen: Seen) -> None:
    if config.road:
        _draw_reach(axes, config)
    if seen.has("road", "position"):
        _draw_road(axes, seen)
    if seen.has("route", "position"):
        _draw_route(axes, seen)
    if seen.has("lights", "position"):
        _draw_lights(axes, seen)
    if seen.has("agents", "position"):
        _draw_agents(axes, seen)
    _draw_ego(axes, seen)


def _draw_reach(axes: Axes, config: ObservationConfig) -> None:
    """The box inside which pieces of road are seen."""
    from matplotlib.patches import Rectangle

    side, behind, ahead = config.road_side_m, config.road_behind_m, config.road_ahead_m
    axes.add_patch(
        Rectangle(
            (-side, -behind), 2 * side, ahead + behind, facecolor="white", edgecolor=LIGHT["lane"],
            linestyle=(0, (6, 4)), linewidth=0.9, zorder=0,
        )
    )  # fmt: skip


def _draw_road(axes: Axes, seen: Seen) -> None:
    from matplotlib.collections import LineCollection

    mask = seen.masks["road"]
    middle = seen["road", "position"][mask]
    if not seen.has("road", "direction"):
        axes.scatter(*_up(middle).T, s=5, color=LIGHT["edge"], zorder=1)
        return
    direction = seen["road", "direction"][mask]
    length = seen["road", "length"][mask] if seen.has("road", "length") else np.full((len(middle), 1), 1.0)
    half = direction * length / 2
    pieces = _up(np.stack([middle - half, middle + half], axis=1))
    kinds = seen["road", "type"][mask] if seen.has("road", "type") else np.eye(3)[np.zeros(len(middle), int)]
    for number, (colour, width) in enumerate(_ROADS.values()):
        chosen = kinds[:, number] > 0
        collection = LineCollection(
            list(pieces[chosen]),
            colors=LIGHT[colour],
            linewidths=width,
            capstyle="butt",
            zorder=1.5 - number / 4,
        )
        if number == 2:
            collection.set(linestyles=[(0, (0.5, 0.5))], alpha=0.55)
        axes.add_collection(collection)
    lanes = kinds[:, 0] > 0
    turned = _up(direction[lanes])
    axes.quiver(
        *_up(middle[lanes]).T, *turned.T, color=LIGHT["line"], angles="xy", pivot="mid", scale_units="xy", scale=0.6,
        units="xy", width=0.22, headwidth=4.5, headlength=4.5, headaxislength=4, zorder=1.6,
    )  # fmt: skip


def _draw_route(axes: Axes, seen: Seen) -> None:
    points = _up(seen["route", "position"][seen.masks["route"]])
    line = np.concatenate([np.zeros((1, 2)), points])
    axes.plot(*line.T, color=LIGHT["route"], linewidth=1.4, alpha=0.5, zorder=2)
    axes.scatter(*points.T, s=22, color=LIGHT["route"], edgecolor="white", linewidth=0.6, zorder=2.1)
    if seen.has("route", "goal") and len(points):
        goal = _up(seen["route", "goal"][seen.masks["route"]][:1])
        axes.scatter(*goal.T, s=170, marker="*", color=LIGHT["route"], edgecolor="white", zorder=2.2)


def _draw_lights(axes: Axes, seen: Seen) -> None:
    for row in np.flatnonzero(seen.masks["lights"]):
        x, y = _up(seen["lights", "position"][row])
        state = seen["lights", "state"][row] if seen.has("lights", "state") else np.eye(4)[0]
        colour = LIGHT[list(_STATES.values())[int(np.argmax(state))]]
        mine = seen.has("lights", "on_route") and seen["lights", "on_route"][row, 0] > 0
        axes.scatter(x, y, s=110 if mine else 45, color=colour, edgecolor=LIGHT["ink"] if mine else "white",
                     linewidth=1.4 if mine else 0.8, marker="s", zorder=3)  # fmt: skip


def _draw_agents(axes: Axes, seen: Seen) -> None:
    mask = seen.masks["agents"]
    steps = mask.shape[1]
    for row in np.flatnonzero(mask[:, -1]):
        kind = seen["agents", "type"][row, -1] if seen.has("agents", "type") else np.eye(4)[0]
        colour = LIGHT[_KINDS[int(np.argmax(kind))]]
        for step in np.flatnonzero(mask[row]):
            now = step == steps - 1
            faded = 1.0 if now else 0.12 + 0.3 * step / steps
            _outline(axes, seen, "agents", (row, step), colour, faded, 4.0 + step / steps)
        if kind[1] + kind[2] > 0:  # who is slim gets a halo
            place = _up(seen["agents", "position"][row, -1])
            axes.scatter(*place, s=70, color=colour, alpha=0.45, linewidth=0, zorder=3.9)
        if seen.has("agents", "velocity"):
            _arrow(axes, seen["agents", "position"][row, -1], seen["agents", "velocity"][row, -1])


def _outline(
    axes: Axes, seen: Seen, group: str, at: tuple[Any, ...], colour: str, alpha: float, zorder: float
) -> None:
    """A box where heading and size are known, else a dot."""
    from matplotlib.patches import Circle, Polygon

    place, style = seen[group, "position"][at], {"alpha": alpha, "zorder": zorder, "linewidth": 0.7}
    sizes = "ego_static" if group == "ego" else group
    edge = LIGHT["outline"] if alpha == 1.0 else "none"
    if seen.has(group, "heading") and seen.has(sizes, "length", "width"):
        sin, cos = seen[group, "heading"][at]
        size = [seen[sizes, name][() if group == "ego" else at][0] for name in ("length", "width")]
        outline = _up(corners(np.array([*place, cos, sin, *size])))
        axes.add_patch(Polygon(outline, closed=True, facecolor=colour, edgecolor=edge, **style))
        if alpha == 1.0:  # the windscreen says where the front is
            front = _up(corners(np.array([*(place + 0.22 * size[0] * np.array([cos, sin])), cos, sin,
                                          0.16 * size[0], 0.72 * size[1]])))  # fmt: skip
            axes.add_patch(
                Polygon(front, closed=True, facecolor=LIGHT["ink"], alpha=0.65, zorder=zorder + 0.01)
            )
    else:
        axes.add_patch(Circle(tuple(_up(place)), _DOT_M, facecolor=colour, edgecolor=edge, **style))


def _arrow(axes: Axes, place: Values, velocity: Values) -> None:
    """Where somebody will be in a second at this velocity."""
    if np.hypot(*velocity) < 0.5:
        return
    start, end = _up(place), _up(place + velocity)
    axes.annotate(
        "", xy=tuple(end), xytext=tuple(start), zorder=5.5, annotation_clip=True,
        arrowprops={"arrowstyle": "-|>", "color": LIGHT["ink"], "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0,
                    "mutation_scale": 8},
    )  # fmt: skip


def _draw_ego(axes: Axes, seen: Seen) -> None:
    if not seen.has("ego", "position"):
        axes.scatter(0, 0, s=60, color=LIGHT["ego"], zorder=6)
        return
    steps = len(seen["ego", "position"])
    for step in range(steps):
        faded = 1.0 if step == steps - 1 else 0.12 + 0.3 * step / steps
        _outline(axes, seen, "ego", (step,), LIGHT["ego"], faded, 6.0 + step / steps)
    if seen.has("ego", "velocity"):
        _arrow(axes, seen["ego", "position"][-1], seen["ego", "velocity"][-1])


def _scale_bar(axes: Axes, low: Values, high: Values) -> None:
    x, y = low[0] + 0.04 * (high[0] - low[0]), low[1] + 0.025 * (high[1] - low[1])
    axes.plot((x, x + 10.0), (y, y), color=LIGHT["ink"], linewidth=2.5, solid_capstyle="butt", zorder=9)
    axes.text(
        x + 5.0, y + 0.008 * (high[1] - low[1]), "10 m", color=LIGHT["ink"], fontsize=9, ha="center", zorder=9
    )


def _legend(figure: Figure, left: float, config: ObservationConfig, seen: Seen) -> None:
    """What the signs mean, and how much of each group is there."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def line(colour: str, label: str, **more: Any) -> Any:
        return Line2D([], [], color=LIGHT[colour], label=label, **more)

    def sign(colour: str, label: str, marker: str = "s", **more: Any) -> Any:
        return line(colour, label, linestyle="", marker=marker, markersize=8, **more)

    handles: list[Any] = [Patch(facecolor=LIGHT["ego"], edgecolor=LIGHT["outline"], label="ego")]
    if seen.has("agents", "position"):
        kinds = _KINDS if seen.has("agents", "type") else _KINDS[:1]
        named = kinds if len(kinds) > 1 else ("agent",)
        handles += [
            Patch(facecolor=LIGHT[kind], edgecolor=LIGHT["outline"], label=name)
            for kind, name in zip(kinds, named, strict=True)
        ]
        if config.steps > 1:
            handles.append(Patch(facecolor=LIGHT["vehicle"], alpha=0.3, label="past steps, faded"))
    if seen.has("agents", "velocity") or seen.has("ego", "velocity"):
        handles.append(line("ink", "way in 1 s", marker=">", markersize=5, linewidth=0.9))
    if seen.has("road", "position"):
        handles += [line(colour, name, linewidth=width) for name, (colour, width) in _ROADS.items()]
        handles.append(line("lane", "reach of the road", linestyle="--", linewidth=0.9))
    if seen.has("lights", "position"):
        handles += [sign(colour, f"{name} light") for name, colour in _STATES.items()]
        handles.append(
            sign("ground", "light on the route", markeredgecolor=LIGHT["ink"], markeredgewidth=1.4)
        )
    if seen.has("route", "position"):
        handles.append(line("route", "route", marker="o", markersize=5, linewidth=1.4))
    if seen.has("route", "goal"):
        handles.append(sign("route", "goal", marker="*"))
    up = figure.get_size_inches()[1]
    legend = figure.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(left, 1 - 0.4 / up), frameon=False, fontsize=9,
        labelcolor=LIGHT["ink"], borderaxespad=0, handlelength=1.8,
    )  # fmt: skip
    legend.set_in_layout(False)
    figure.text(
        left, 0.2 / up, "\n".join(_counts(config, seen)), fontsize=9, color=LIGHT["ink"], linespacing=1.5
    )


def _counts(config: ObservationConfig, seen: Seen) -> list[str]:
    """How many rows of each group are there, and ego's own numbers."""
    lines = []
    if seen.has("ego", "velocity"):
        lines.append(f"ego drives {np.hypot(*seen['ego', 'velocity'][-1]):.1f} m/s")
    if seen.has("ego_static", "last_action"):
        action = ", ".join(f"{number:.2f}" for number in seen["ego_static", "last_action"])
        lines.append(f"last action {action}")
    for group, what in (
        ("agents", "agents"),
        ("road", "pieces of road"),
        ("lights", "lights"),
        ("route", "route points"),
    ):
        if group in seen.masks:
            mask = seen.masks[group]
            there = mask[:, -1] if mask.ndim > 1 else mask
            lines.append(f"{what}: {int(there.sum())} of {there.size}")
    lines += [f"{group.name}: not drawn" for group in config.own]
    return lines
