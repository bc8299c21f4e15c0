"""Observations: named groups of features with masks, in the ego frame, scaled to about [-1, 1].

Each group is an array with features on its last axis; groups with missing rows have a boolean mask over their rows
(docs/guide/observations.md). Masked rows are zero. Positions are divided by 50 m, speeds by 15 m/s, lengths by 5 m
(road pieces by 10 m); ``tasks.features`` has the units of the optional features.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax import kernels
from drivax.errors import UsageError, did_you_mean
from drivax.kernels.bindings import Ego, observe_agents, observe_road, observe_route
from drivax.plugins import check_unique, name_of
from drivax.scenario.bank.columns import NEVER_M, LightRow, RoadColumn, RoadLayer, RouteColumn, SizeColumn
from drivax.scenario.bank.queries import route_ahead
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import DT_S, AgentKind, LightState
from drivax.simulator.ahead import ALONGSIDE_M, has_route
from drivax.simulator.lights import is_red, is_yellow
from drivax.simulator.types import HISTORY, MOTION_HEADING, MOTION_SPEED, AgentContext, Frame
from drivax.tasks import features
from drivax.tasks.features import COLUMNS, PIECE_M, POSITION_M, SIZE_M, SPEED_MPS, Features, Frames, View
from drivax.tasks.perception import (
    LIGHT_NOISE_STREAM,
    ROAD_NOISE_STREAM,
    Perception,
    perceive,
    position_errors,
)

#: Largest number of rows of the group road, and of another group; scenarios have at most 8,192 pieces and 512 agents.
MOST_ROAD_ROWS, MOST_ROWS = 8192, 512
#: Block size of :func:`running_count`.
_BLOCK = 8
#: Distance behind ego, along their lane, beyond which stop lines are omitted, m; addition to the distance of lights off
#: the route, which sorts them last, m.
_BEHIND_M, _OFF_ROUTE_M = 5.0, 1e4
#: Agent kinds in the order of the columns of ``type``, which are all 0 for ``AgentKind.STATIC``.
_TYPES = (AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.CYCLIST, AgentKind.OTHER)
Observation = dict[str, Array]
#: Names of the groups of this module.
GROUPS = tuple(COLUMNS)
#: Function that returns features ``[F]`` or rows ``[..., F]``, or a pair of rows and a mask over them.
Feature = Callable[[ScenarioBank, AgentContext, Frames], Any]


@dataclass(frozen=True)
class OwnGroup:
    """A user's observation group.

    Attributes:
        feature: Function of bank, context and frames that returns ``[..., F]`` float32 in about [-1, 1], or these rows
            and a boolean mask ``[...]`` of the valid ones; ``testing.check_feature`` checks it.
        name: Name of the group; by default that of the function.
    """

    feature: Feature
    name: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", name_of(self.feature, self.name))
        if self.name.endswith("_mask"):
            raise ValueError(f"a group cannot be named {self.name!r}: the suffix is reserved for masks")

    def observe(self, bank: ScenarioBank, context: AgentContext, frames: Frames) -> Observation:
        """Return the group, and its mask if it has one."""
        rows = self.feature(bank, context, frames)
        return _masked_group(self.name, *rows) if isinstance(rows, tuple) else {self.name: rows}


@dataclass(frozen=True)
class ObservationConfig:
    """Groups of an observation, their numbers of rows and past steps, and their features.

    In YAML the key ``preset`` names one of ``PRESETS`` to start from.

    Attributes:
        agents: Number of the nearest other agents.
        steps: Past steps of ego and agents, the present one included; at most 10.
        road: Rows of the road group; 0 omits it.
        lanes, edges, crosswalks: Layers of the road group.
        road_ahead_m, road_behind_m, road_side_m: Range of the road group ahead, behind and to each side.
        road_cut: Number of rows per road piece (of at most 10 m), which is cut along its chord into equal parts.
        lights: Number of lights: those on the route first, then the others, each by distance.
        route: Points of the route, ``route_step_m`` apart.
        features: Columns of each group.
        perception: Errors of perception; none by default.
        own: The user's groups.
    """

    agents: int = 16
    steps: int = 5
    road: int = 200
    lanes: bool = True
    edges: bool = True
    crosswalks: bool = True
    road_ahead_m: float = 70.0
    road_behind_m: float = 10.0
    road_side_m: float = 25.0
    road_cut: int = 1
    lights: int = 5
    route: int = 10
    route_step_m: float = 5.0
    features: Features = field(default_factory=Features)
    perception: Perception = field(default_factory=Perception)
    own: tuple[OwnGroup, ...] = ()

    def __post_init__(self) -> None:
        check_unique("observation.own", [group.name for group in self.own], GROUPS)
        counts = {name: getattr(self, name) for name in ("agents", "road", "lights", "route")}
        for name, count in counts.items():
            if count < 0:
                raise ValueError(f"observation.{name} is {count}; use 0 or more")
            most = MOST_ROAD_ROWS if name == "road" else MOST_ROWS
            if count > most:
                raise ValueError(f"observation.{name} is {count}; use {most:,} or less")
        if not 1 <= self.steps <= 10:
            raise ValueError(f"observation.steps is {self.steps}; use 1 to 10")
        for name in ("road_ahead_m", "road_behind_m", "road_side_m"):
            if not 0.0 <= (distance_m := getattr(self, name)) < math.inf:
                raise ValueError(f"observation.{name} is {distance_m:g}; use 0 or a positive number")
        if not 0.0 < self.route_step_m < math.inf:
            raise ValueError(f"observation.route_step_m is {self.route_step_m:g}; use a positive number")
        if self.road_cut < 1 or self.road % self.road_cut:
            cure = f"use a number that divides road ({self.road})"
            raise ValueError(f"observation.road_cut is {self.road_cut}; {cure}")

    @classmethod
    def preset(cls, name: str) -> ObservationConfig:
        """Return one of ``PRESETS``."""
        if name not in PRESETS:
            raise UsageError(f"unknown observation preset {name!r}", cure=did_you_mean(name, list(PRESETS)))
        return PRESETS[name]


_PUBLISHED = Features(
    ego_static=("length", "width", "height"),
    agents=("position", "heading", "velocity", "length", "width", "height", "type"),
    route=("position", "heading", "recommended_speed"),
)
#: ``published`` is the observation of the published description with road pieces of at most 10 m: 2,000 rows are 400
#: pieces cut into five each, in a box of 100 m instead of a circle.
PRESETS = MappingProxyType(
    {
        "minimal": ObservationConfig(agents=8, steps=1, edges=False),
        "standard": ObservationConfig(edges=False),
        "optimal": ObservationConfig(),
        "maximal": ObservationConfig(agents=32, steps=10),
        "published": ObservationConfig(
            road=2000,
            road_ahead_m=100.0,
            road_behind_m=100.0,
            road_side_m=100.0,
            road_cut=5,
            features=_PUBLISHED,
        ),
    }
)


def observe(
    config: ObservationConfig, bank: ScenarioBank, context: AgentContext, frames: Frames
) -> Observation:
    """Return the observation of a context; ``frames(k)`` is the frame of all agents k steps ago.

    By default ``ego [steps, 6]``: position, heading (sin, cos), velocity; ``ego_static [4]``: length, width, last
    action; ``agents [agents, steps, 12]`` with ``agents_mask [agents, steps]``, ``road [road, 10]``,
    ``lights [lights, 7]``, ``route [route, 5]``, each with ``*_mask``; and the user's groups.
    """
    view, selected = View.of(context), config.features
    if config.perception.of_agents:
        frames = perceive(config.perception, bank, context, frames)
    result = _ego(config, bank, context, view)
    if selected.agents:
        result |= _agents(config, bank, context, view, frames)
    if config.road and selected.road:
        result |= _road_group(config, bank, context, view)
    if selected.lights:
        result |= _lights(config, bank, context, view, frames(0).lights)
    if selected.route:
        result |= _route(config, bank, context, view)
    for group in config.own:
        result |= group.observe(bank, context, frames)
    return result


def _masked_group(name: str, rows: Float[Array, "... F"], mask: Bool[Array, ...]) -> Observation:
    """Return a group and its mask; masked rows are zero."""
    return {name: jnp.where(mask[..., None], rows, 0.0), f"{name}_mask": mask}


def _masked_columns(name: str, columns: Sequence[Array], mask: Bool[Array, "*rows"]) -> Observation:
    """Return a group and its mask from arrays that broadcast to ``mask``, one for each feature.

    Whole columns are computed and moved several times faster than rows of few numbers.
    """
    columns = [jnp.where(mask, column, 0.0) for column in columns]
    return {name: jnp.moveaxis(jnp.stack(columns), 0, -1), f"{name}_mask": mask}


def _ego(config: ObservationConfig, bank: ScenarioBank, context: AgentContext, view: View) -> Observation:
    """Return the groups ``ego`` [steps, F] and ``ego_static`` [F]."""
    past = context.history[HISTORY - config.steps :]
    direction = view.vector(jnp.stack([jnp.cos(past[:, 2]), jnp.sin(past[:, 2])], axis=-1))
    size = bank.agent_box[context.index, context.slot, : SizeColumn.KIND] / SIZE_M
    motion = {
        "position": lambda: view.point(past[:, :2]) / POSITION_M,
        "heading": lambda: direction[:, ::-1],
        "velocity": lambda: direction * past[:, 3:4] / SPEED_MPS,
        "time": lambda: -DT_S * jnp.arange(config.steps - 1, -1, -1, dtype=jnp.float32)[:, None],
    }
    static = {
        "length": lambda: size[:1],
        "width": lambda: size[1:2],
        "height": lambda: size[2:],
        "last_action": lambda: context.action,
        "route": lambda: features.ego_on_route(bank, context, view),
    }
    groups = {"ego": (config.features.ego, motion), "ego_static": (config.features.ego_static, static)}
    return {
        group: features.concatenate_features(selected, columns)
        for group, (selected, columns) in groups.items()
        if selected
    }


def _nearest(distance: Float[Array, " S"], count: int) -> Int[Array, " K"]:
    """Return the indices of the smallest distances in ascending order, padded with 0."""
    indices = jax.lax.top_k(-distance, min(count, distance.shape[0]))[1]
    return jnp.pad(indices, (0, count - indices.shape[0]))


def _agents(
    config: ObservationConfig, bank: ScenarioBank, context: AgentContext, view: View, frames: Frames
) -> Observation:
    """Return the group ``agents`` [agents, steps, F]: the nearest agents at the present step, nearest first."""
    now = frames(0)
    if config.steps == 1 and config.agents and kernels.in_use():

        def reference(bank: ScenarioBank, context: AgentContext, view: View, now: Frame) -> Observation:
            return _agents(
                config, bank, context, view, lambda _, slots=None: now if slots is None else now.at(slots)
            )

        native = kernels.with_reference(partial(_agents_natively, config), reference)
        return native(bank, context, view, now)
    slots = now.valid.shape[0]
    others = now.valid & (jnp.arange(slots) != context.slot)
    dx, dy = now.box[:, 0] - view.xy[0], now.box[:, 1] - view.xy[1]
    nearest = _nearest(jnp.where(others, dx * dx + dy * dy, jnp.inf), config.agents)
    exists = others[nearest] & (jnp.arange(config.agents) < slots)
    steps = range(config.steps - 1, -1, -1)
    # Past frames have only the rows of these agents.
    past = [frames(back, nearest) for back in steps]
    mask = jnp.stack([frame.valid for frame in past]) & exists
    # One array [steps, K] per column.
    x, y, cos, sin, length, width = jnp.moveaxis(jnp.stack([frame.box for frame in past]), -1, 0)
    vx, vy = jnp.moveaxis(jnp.stack([frame.velocity for frame in past]), -1, 0)
    ego = context.history[HISTORY - config.steps :]
    speed, heading = ego[:, MOTION_SPEED, None], ego[:, MOTION_HEADING, None]
    ego_vx, ego_vy = speed * jnp.cos(heading), speed * jnp.sin(heading)

    def scale(unit: float, *columns: Array) -> list[Array]:
        return [column / unit for column in columns]

    ego_box, ego_velocity = now.box[context.slot], now.velocity[context.slot]
    agents = now.at(nearest)
    columns = {
        "route": lambda: features.route_coordinates(bank, context, agents.box),
        "closing_speed": lambda: [features.closing_speed(ego_box, ego_velocity, agents)],
        "time_to_overlap": lambda: [features.overlap_imminence(ego_box, ego_velocity, agents)],
        "position": lambda: scale(POSITION_M, *view.rotate(x - view.xy[0], y - view.xy[1])),
        "heading": lambda: view.rotate(cos, sin)[::-1],
        "velocity": lambda: scale(SPEED_MPS, *view.rotate(vx, vy)),
        "relative_velocity": lambda: scale(SPEED_MPS, *view.rotate(vx - ego_vx, vy - ego_vy)),
        "time": lambda: [-DT_S * jnp.asarray(steps, jnp.float32)[:, None]],
        "length": lambda: scale(SIZE_M, length),
        "width": lambda: scale(SIZE_M, width),
        "height": lambda: scale(SIZE_M, bank.agent_box[context.index, nearest, SizeColumn.HEIGHT]),
        "type": lambda: [(past[-1].kind == kind).astype(jnp.float32) for kind in _TYPES],
    }
    selected = [column for name in config.features.agents for column in columns[name]()]
    group = _masked_columns("agents", selected, mask)
    return {name: jnp.moveaxis(values, 0, 1) for name, values in group.items()}


def _agents_natively(
    config: ObservationConfig, bank: ScenarioBank, context: AgentContext, view: View, now: Frame
) -> Observation:
    """Return the group ``agents`` of :func:`_agents` for one step."""
    rules = {
        "position_m": POSITION_M, "speed_mps": SPEED_MPS, "size_m": SIZE_M, "side_m": features.ROUTE_SIDE_M,
        "alongside_m": ALONGSIDE_M, "horizon_s": features.OVERLAP_S,
    }  # fmt: skip
    routes = bank.routes, bank.route_points, features.projection_offsets()
    rows, mask = observe_agents(
        bank.agent_box, routes, (now.box, now.velocity, now.valid, now.kind),
        _native_ego(bank, context, view), config.agents, _columns("agents", config.features.agents),
        _TYPES, rules,
    )  # fmt: skip
    return {"agents": rows[:, None], "agents_mask": mask[:, None]}


def _native_ego(bank: ScenarioBank, context: AgentContext, view: View) -> Ego:
    """Return the state of the driven agent that native kernels read."""
    direction = jnp.stack([view.cos, view.sin])
    place = context.index, context.row, context.slot, context.route_m, has_route(bank, context)
    return Ego(*place, context.history[-1], direction)


def _columns(group: str, selected: Collection[str]) -> list[int]:
    """Return the indices of the selected features' columns among those of all features of a group."""
    return features.columns_of(group, selected, tuple(COLUMNS[group]))


def _road_group(
    config: ObservationConfig, bank: ScenarioBank, context: AgentContext, view: View
) -> Observation:
    """Return the road group: pieces cut into rows, with noise, in the selected columns."""
    selected, has_noise = config.features.road, config.perception.noise_m > 0
    is_whole = config.road_cut == 1 and not has_noise
    if is_whole and kernels.in_use():
        native = partial(_road_natively, config, selected)
        return kernels.with_reference(native, partial(_road_group, config))(bank, context, view)
    pieces = replace(config, road=config.road // config.road_cut, road_cut=1)
    group = _road(pieces, bank, context, view)
    if is_whole and selected == Features().road:
        return group
    rows, mask = group["road"], group["road_mask"]
    if config.road_cut > 1:
        rows, mask = features.cut_rows(rows, config.road_cut), jnp.repeat(mask, config.road_cut)
    if has_noise:
        errors = position_errors(config.perception, bank, context, ROAD_NOISE_STREAM, config.road)
        rows = rows.at[:, :2].add(errors / POSITION_M)
    columns = features.columns_of("road", selected)
    # Curvature is not a default feature; :func:`_road` appends it.
    columns += [rows.shape[-1] - 1] if "curvature" in selected else []
    return _masked_group("road", jnp.stack([rows[:, column] for column in columns], axis=-1), mask)


def _road(config: ObservationConfig, bank: ScenarioBank, context: AgentContext, view: View) -> Observation:
    """Return the road group with all default features, and the curvature if it is selected."""
    if kernels.in_use():
        native = partial(_road_natively, config, {*Features().road, *config.features.road})
        return kernels.with_reference(native, partial(_road, config))(bank, context, view)

    def rotate(x: Array, y: Array) -> tuple[Array, Array]:
        """Return the components ahead and left, rounded differently from :meth:`View.rotate`."""
        return x * view.cos + y * view.sin, y * view.cos - x * view.sin

    x, y, layer = bank.road_at[context.index]
    dx, dy = x - view.xy[0], y - view.xy[1]
    ahead, left = rotate(dx, dy)
    inside = (ahead < config.road_ahead_m) & (ahead > -config.road_behind_m)
    inside &= (jnp.abs(left) < config.road_side_m) & (layer != RoadLayer.NONE)
    kinds = (RoadLayer.LANE, RoadLayer.EDGE, RoadLayer.AREA)
    for is_included, kind in zip((config.lanes, config.edges, config.crosswalks), kinds, strict=True):
        inside &= is_included or layer != kind
    # Compact without sorting: the running count is the target index of each row inside. Rows outside, and those that do
    # not fit, get indices beyond the end, which are dropped.
    running = running_count(inside)
    target = jnp.where(inside, running - 1, config.road)
    source = jnp.zeros(config.road, jnp.int32).at[target].set(jnp.arange(len(inside)), mode="drop")
    rows = bank.road[context.index, source].T
    x, y = rotate(rows[RoadColumn.X] - view.xy[0], rows[RoadColumn.Y] - view.xy[1])
    limit = rows[RoadColumn.LIMIT]
    columns = [x / POSITION_M, y / POSITION_M, *rotate(*rows[RoadColumn.DIRECTION])]
    columns += [rows[RoadColumn.LENGTH] / PIECE_M]
    columns += [(rows[RoadColumn.LAYER] == kind).astype(jnp.float32) for kind in kinds]
    columns += [jnp.maximum(limit, 0.0) / SPEED_MPS, (limit > 0).astype(jnp.float32)]
    if "curvature" in config.features.road:
        columns.append(features.scale_curvature(bank.road_curvature[context.index, source]))
    return _masked_columns("road", columns, jnp.arange(config.road) < running[-1])


def _road_natively(
    config: ObservationConfig,
    selected: Collection[str],
    bank: ScenarioBank,
    context: AgentContext,
    view: View,
) -> Observation:
    """Return the road group of :func:`_road` with the selected features."""
    layers = {RoadLayer.LANE: config.lanes, RoadLayer.EDGE: config.edges, RoadLayer.AREA: config.crosswalks}
    rows, mask = observe_road(
        bank.road_at, bank.road, bank.road_curvature, _native_ego(bank, context, view), config.road,
        _columns("road", selected), [layer for layer, is_included in layers.items() if is_included],
        {
            "ahead_m": float(config.road_ahead_m), "behind_m": float(config.road_behind_m),
            "side_m": float(config.road_side_m), "position_m": POSITION_M, "piece_m": PIECE_M, "speed_mps": SPEED_MPS,
            "curvature_pm": features.CURVATURE_PM, "max_curvature": features.MAX_CURVATURE,
        },
    )  # fmt: skip
    return {"road": rows, "road_mask": mask}


def running_count(inside: Bool[Array, " K"]) -> Int[Array, " K"]:
    """Return the cumulative count of true entries: within blocks of eight, then over blocks.

    ``jnp.cumsum`` is several times slower on CPUs, because it adds entry by entry.
    """
    count = inside.shape[0]
    blocks = -(-count // _BLOCK)
    # One row per position in a block: additions run along the blocks.
    positions = jnp.pad(inside.astype(jnp.float32), (0, blocks * _BLOCK - count)).reshape(blocks, _BLOCK).T
    in_block = [positions[0]]
    for row in positions[1:]:
        in_block.append(in_block[-1] + row)
    # The product is exact at any precision of matrix products, because factors are at most eight.
    block_start = in_block[-1] @ jnp.triu(jnp.ones((blocks, blocks)), 1)
    return jnp.stack([row + block_start for row in in_block], axis=-1).reshape(-1)[:count].astype(jnp.int32)


def _lights(
    config: ObservationConfig, bank: ScenarioBank, context: AgentContext, view: View, state: Int[Array, " L"]
) -> Observation:
    """Return the group ``lights``: those on the route first, then the others, each by distance.

    Without a route on lanes, all lights are off the route.
    """
    line = bank.light_line[context.index]
    dx, dy = line[LightRow.X] - view.xy[0], line[LightRow.Y] - view.xy[1]
    relevant = (state >= 0) & (dx * line[LightRow.COS] + dy * line[LightRow.SIN] > -_BEHIND_M)
    perception = config.perception
    on_route = (line[LightRow.ARC + bank.ego_number(context.row)] < NEVER_M) & has_route(bank, context)
    sort_key = jnp.sqrt(dx * dx + dy * dy) + jnp.where(on_route, 0.0, _OFF_ROUTE_M)
    indices = _nearest(jnp.where(relevant, sort_key, jnp.inf), config.lights)
    exists = relevant[indices] & (jnp.arange(config.lights) < state.shape[0])

    def position() -> Float[Array, "K 2"]:
        xy = view.point(line[LightRow.XY, indices].T)
        if perception.noise_m > 0:
            errors = position_errors(perception, bank, context, LIGHT_NOISE_STREAM, state.shape[0])
            xy = xy + errors[indices]
        return xy / POSITION_M

    columns = {
        "position": position,
        "state": lambda: _colour(state[indices]),
        "on_route": lambda: on_route[indices, None].astype(jnp.float32),
    }
    return _masked_group("lights", features.concatenate_features(config.features.lights, columns), exists)


def _colour(state: Int[Array, " K"]) -> Float[Array, "K 4"]:
    """Return one-hot columns: unknown, green, yellow, red. Flashing lights count as unknown, not red."""
    green = (state == LightState.GO) | (state == LightState.ARROW_GO)
    yellow, red = is_yellow(state), is_red(state)
    return jnp.stack([~(green | yellow | red), green, yellow, red], axis=-1).astype(jnp.float32)


def _route(config: ObservationConfig, bank: ScenarioBank, context: AgentContext, view: View) -> Observation:
    """Return the group ``route``: points ahead on the route; all masked without a route on lanes."""
    if config.route and kernels.in_use():
        native = partial(_route_natively, config)
        return kernels.with_reference(native, partial(_route, config))(bank, context, view)
    offsets = jnp.arange(1, config.route + 1) * config.route_step_m
    rows, exists = route_ahead(bank, context.row, context.route_m, offsets)
    exists &= has_route(bank, context)
    limit = rows[:, RouteColumn.LIMIT, None]

    def curvature() -> Float[Array, "K 1"]:
        return features.route_curvature(bank, context.row, context.route_m + offsets)[:, None]

    goal = bank.goal[context.row]
    columns = {
        "position": lambda: view.point(rows[:, RouteColumn.XY]) / POSITION_M,
        "heading": lambda: view.vector(rows[:, RouteColumn.HEADING])[:, ::-1],
        "limit": lambda: jnp.where(limit > 0, limit / SPEED_MPS, 0.0),
        "curvature": lambda: features.scale_curvature(curvature()),
        "recommended_speed": lambda: features.recommended_speed(curvature()) / SPEED_MPS,
        "goal": lambda: jnp.broadcast_to(features.goal_ahead(view.point(goal)), (config.route, 2)),
    }
    return _masked_group("route", features.concatenate_features(config.features.route, columns), exists)


def _route_natively(
    config: ObservationConfig, bank: ScenarioBank, context: AgentContext, view: View
) -> Observation:
    """Return the group ``route`` of :func:`_route`."""
    offsets = jnp.arange(1, config.route + 1) * config.route_step_m
    rows, mask = observe_route(
        (bank.routes, bank.route_points), bank.goal, _native_ego(bank, context, view),
        _columns("route", config.features.route), offsets,
        {
            "half_window_m": features.HALF_WINDOW_M, "position_m": POSITION_M, "speed_mps": SPEED_MPS,
            "curvature_pm": features.CURVATURE_PM, "max_curvature": features.MAX_CURVATURE,
            "max_goal": features.MAX_GOAL,
        },
    )  # fmt: skip
    return {"route": rows, "route_mask": mask}
