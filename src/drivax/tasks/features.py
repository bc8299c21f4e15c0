"""Features of observation groups: names, columns, order, frame and units; functions of the optional features.

The columns of a group follow the order of :data:`COLUMNS`, not that of a configuration.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from types import MappingProxyType

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from drivax.errors import UsageError, did_you_mean
from drivax.geometry.boxes import COS, LENGTH, X, time_to_overlap
from drivax.geometry.vectors import norm, rotate
from drivax.scenario.bank.columns import RouteColumn
from drivax.scenario.bank.queries import project_on_route, route_ahead
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.simulator.ahead import has_route, project
from drivax.simulator.types import AgentContext, Frame

#: Units of positions, speeds, sizes and lengths of road pieces.
POSITION_M, SPEED_MPS, SIZE_M, PIECE_M = 50.0, 15.0, 5.0, 10.0
#: Unit of curvature, 1/m: a turn of 10 m radius is 1.
CURVATURE_PM = 0.1
#: Maximum of curvatures, in these units.
MAX_CURVATURE = 3.0
#: Points of the route on which agents are projected: position of the first relative to ego, m; spacing, m; number.
_ROUTE_START_M, _ROUTE_STEP_M, _ROUTE_POINTS = -30.0, 2.0, 61
#: Largest distance of the goal in each direction, in units of positions.
MAX_GOAL = 5.0
#: Maximum distance of an agent to either side of the route, m.
ROUTE_SIDE_M = 20.0
#: Horizon of times to overlap, s.
OVERLAP_S = 8.0
#: Half the distance over which the curvature of the route is measured, m.
HALF_WINDOW_M = 2.0

_MOTION = {"position": ("x", "y"), "heading": ("sin", "cos"), "velocity": ("ahead", "left")}
#: Columns of each feature of each group; "" for a feature with one column.
COLUMNS: Mapping[str, Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "ego": {**_MOTION, "time": ("",)},
        # The last action has as many columns as the action space has dimensions.
        "ego_static": {
            "length": ("",),
            "width": ("",),
            "height": ("",),
            "last_action": (),
            "route": ("left", "sin"),
        },
        "agents": {
            **_MOTION,
            "relative_velocity": ("ahead", "left"),
            **dict.fromkeys(("time", "length", "width", "height"), ("",)),
            "type": ("vehicle", "pedestrian", "cyclist", "other"),
            # The last three have their present values at all steps.
            "route": ("along", "left", "sin", "cos"),
            **dict.fromkeys(("closing_speed", "time_to_overlap"), ("",)),
        },
        "road": {
            "position": ("x", "y"),
            "direction": ("cos", "sin"),
            "length": ("",),
            "type": ("lane", "edge", "crosswalk"),
            "limit": ("", "known"),
            "curvature": ("",),
        },
        "lights": {"position": ("x", "y"), "state": ("unknown", "green", "yellow", "red"), "on_route": ("",)},
        "route": {
            "position": ("x", "y"),
            "heading": ("sin", "cos"),
            **dict.fromkeys(("limit", "curvature", "recommended_speed"), ("",)),
            "goal": ("x", "y"),
        },
    }
)

#: Function that returns the frame of all agents 0 to 15 steps ago (for reactive vehicles, more than 9 count as 9). The
#: number of steps is static; a second argument selects slots.
Frames = Callable[..., Frame]


@record
class View:
    """The ego frame: x ahead, y left."""

    xy: Float[Array, " 2"]
    cos: Float[Array, ""]
    sin: Float[Array, ""]

    @classmethod
    def of(cls, context: AgentContext) -> View:
        """Return the ego frame of the driven agent at the present step."""
        motion = context.history[-1]
        return cls(motion[:2], jnp.cos(motion[2]), jnp.sin(motion[2]))

    def point(self, xy: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
        """Transform positions (m) to the ego frame."""
        return rotate(xy - self.xy, self.cos, -self.sin)

    def rotate(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Transform the components of directions, velocities or offsets to ahead and left.

        The terms are ordered to round like :meth:`point` and :meth:`vector`, where products are fused.
        """
        return x * self.cos + y * self.sin, -(x * self.sin - y * self.cos)

    def vector(self, xy: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
        """Transform directions or velocities to the ego frame."""
        return rotate(xy, self.cos, -self.sin)


@dataclass(frozen=True)
class Features:
    """Features of each group, whose columns :data:`COLUMNS` lists; a group without features is omitted.

    Attributes:
        ego: Driven agent at each past step.
        ego_static: Driven agent now.
        agents: Each other agent at each past step.
        road: Each road piece.
        lights: Each light.
        route: Each point of the route.
    """

    ego: tuple[str, ...] = ("position", "heading", "velocity")
    ego_static: tuple[str, ...] = ("length", "width", "last_action")
    agents: tuple[str, ...] = ("position", "heading", "velocity", "length", "width", "type")
    road: tuple[str, ...] = ("position", "direction", "length", "type", "limit")
    lights: tuple[str, ...] = ("position", "state", "on_route")
    route: tuple[str, ...] = ("position", "heading", "limit")

    def __post_init__(self) -> None:
        for field in fields(self):
            selected, available = getattr(self, field.name), tuple(COLUMNS[field.name])
            key = f"observation.features.{field.name}"
            for number, name in enumerate(selected):
                if name not in available:
                    raise UsageError(f"{key} has no {name!r}", cure=did_you_mean(name, available))
                if name in selected[:number]:
                    raise UsageError(f"{key} names {name!r} twice", cure="name it once")
            # In the order of COLUMNS, on which encoders and checkpoints rely.
            object.__setattr__(self, field.name, tuple(name for name in available if name in selected))


def feature_names(features: Features, shapes: Mapping[str, Sequence[int]]) -> dict[str, tuple[str, ...]]:
    """Return a name per column of each group, such as ``velocity ahead``, without masks.

    ``shapes`` are those of one observation, by group. Columns of ``conditions`` and the user's groups are numbered.
    """
    names = {}
    for group, shape in shapes.items():
        if group.endswith("_mask") and group.removesuffix("_mask") in shapes:
            continue
        if group not in COLUMNS:
            names[group] = tuple(str(column) for column in range(shape[-1]))
            continue
        columns = [(name, COLUMNS[group][name]) for name in getattr(features, group)]
        # ``last_action`` has no fixed columns: it has the remaining ones, numbered.
        remaining = shape[-1] - sum(len(suffixes) for _, suffixes in columns)
        columns = [(name, suffixes or tuple(map(str, range(remaining)))) for name, suffixes in columns]
        names[group] = tuple(f"{name} {suffix}".strip() for name, suffixes in columns for suffix in suffixes)
    return names


def concatenate_features(
    selected: Sequence[str], columns: Mapping[str, Callable[[], Array]]
) -> Float[Array, "... F"]:
    """Compute and concatenate the columns of the selected features; others are not computed."""
    return jnp.concatenate([columns[name]() for name in selected], axis=-1)


def columns_of(group: str, selected: Collection[str], available: Sequence[str] | None = None) -> list[int]:
    """Return the indices of the selected features' columns among those of ``available`` (None: default features)."""
    start, columns = 0, []
    for name in getattr(Features(), group) if available is None else available:
        width = len(COLUMNS[group][name])
        columns += range(start, start + width) if name in selected else ()
        start += width
    return columns


def scale_curvature(curvature: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return a curvature (1/m) in units of 0.1 1/m, clipped to [-3, 3]."""
    return jnp.clip(curvature / CURVATURE_PM, -MAX_CURVATURE, MAX_CURVATURE)


def route_coordinates(
    bank: ScenarioBank, context: AgentContext, box: Float[Array, "K 6"]
) -> list[Float[Array, " K"]]:
    """Return positions of agents along the route (from ego) and left of it, and sine and cosine of the angle to it.

    Positions are in units of 50 m and 5 m; left is clipped to +-20 m, and 20 m for an agent that is not alongside the
    route. All values are 0 without a route.
    """
    offsets = projection_offsets()
    path, on_route = route_ahead(bank, context.row, context.route_m, offsets)
    on_route &= context.route_m + offsets >= 0.0
    along, left, cos, sin = project(path, on_route, offsets, box[:, X:COS], box[:, COS:LENGTH])
    columns = [along / POSITION_M, jnp.clip(left, -ROUTE_SIDE_M, ROUTE_SIDE_M) / SIZE_M, sin, cos]
    return [jnp.where(has_route(bank, context), column, 0.0) for column in columns]


def projection_offsets() -> Float[Array, " P"]:
    """Return the arc lengths, relative to ego, of the route points on which agents are projected, m."""
    return _ROUTE_START_M + _ROUTE_STEP_M * jnp.arange(_ROUTE_POINTS)


def ego_on_route(bank: ScenarioBank, context: AgentContext, view: View) -> Float[Array, " 2"]:
    """Return ego's offset left of its route (m, clipped to +-5) and the sine of its angle to it; 0 without a route."""
    projection = project_on_route(bank, context.row, view.xy, context.route_m)
    sine = view.sin * projection.heading[0] - view.cos * projection.heading[1]
    offset = jnp.clip(projection.lateral_m, -SIZE_M, SIZE_M)
    return jnp.where(has_route(bank, context), jnp.stack([offset, sine]), 0.0)


def closing_speed(ego: Float[Array, " 6"], ego_velocity: Float[Array, " 2"], agents: Frame) -> Array:
    """Return the speed at which the centres of agents and ego approach, in units of 15 m/s."""
    offset, velocity = agents.box[:, :2] - ego[:2], agents.velocity - ego_velocity
    return -jnp.sum(offset * velocity, axis=-1) / jnp.maximum(norm(offset), 1.0) / SPEED_MPS


def overlap_imminence(ego: Float[Array, " 6"], ego_velocity: Float[Array, " 2"], agents: Frame) -> Array:
    """Return 1 - t / 8 s for the time t until agents overlap ego at constant velocity and heading; 0 from 8 s on."""
    return 1.0 - time_to_overlap(ego, ego_velocity, agents.box, agents.velocity, OVERLAP_S) / OVERLAP_S


def route_curvature(
    bank: ScenarioBank, row: Int[Array, ""], along_m: Float[Array, " K"]
) -> Float[Array, " K"]:
    """Return the curvature of route ``row``, 1/m, left positive, averaged over 4 m around each position.

    The window is shorter at the ends of the route.
    """
    length_m = (bank.route_points[row] - 1).astype(jnp.float32)
    start_m = jnp.clip(along_m - HALF_WINDOW_M, 0.0, length_m)
    end_m, zero = jnp.clip(along_m + HALF_WINDOW_M, 0.0, length_m), jnp.zeros(())
    start, _ = route_ahead(bank, row, zero, start_m)
    end, _ = route_ahead(bank, row, zero, end_m)
    (c0, s0), (c1, s1) = ((rows[:, RouteColumn.COS], rows[:, RouteColumn.SIN]) for rows in (start, end))
    distance = end_m - start_m
    # Without a route the rows are zero, and the angle is undefined.
    angle = jnp.arctan2(c0 * s1 - s0 * c1, jnp.where(distance > 0, c0 * c1 + s0 * s1, 1.0))
    turn = jnp.where(distance > 0, angle, 0.0)
    return turn / jnp.maximum(distance, 1.0)


def recommended_speed(curvature: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the published speed at a curvature k in 1/m, ``clip(30 - 25 |k|, 5, 30)`` m/s."""
    return jnp.clip(30.0 - 25.0 * jnp.abs(curvature), 5.0, 30.0)


def goal_ahead(goal_m: Float[Array, " 2"]) -> Float[Array, " 2"]:
    """Return the goal (ego frame, m) in units of 50 m, both coordinates clipped to [-5, 5]."""
    return jnp.clip(goal_m / POSITION_M, -MAX_GOAL, MAX_GOAL)


def cut_rows(rows: Float[Array, "P F"], count: int) -> Float[Array, "R F"]:
    """Cut each road piece (position, direction, length, ...) into ``count`` equal pieces along its chord."""
    offsets = ((jnp.arange(count) + 0.5) / count - 0.5)[:, None]
    position, direction, length = rows[:, None, :2], rows[:, None, 2:4], rows[:, None, 4:5]
    middle = position + direction * length * (PIECE_M / POSITION_M) * offsets
    columns = [
        jnp.broadcast_to(column, (*middle.shape[:2], column.shape[-1]))
        for column in (middle, direction, length / count, rows[:, None, 5:])
    ]
    return jnp.concatenate(columns, axis=-1).reshape(-1, rows.shape[1])
