"""Observations: named groups of features with masks, in the ego frame, scaled to about [-1, 1].

Layout (semantics, Observation): each group is an array whose last axis are features and a boolean mask over its rows.
Masked rows are zero. Positions are divided by 50 m, speeds by 15 m/s, lengths by 5 m (pieces of road by 10 m).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.angles import rotate
from drivax.scenario.bank import (
    LIGHT_ARC,
    LIGHT_COS,
    LIGHT_SIN,
    LIGHT_X,
    LIGHT_Y,
    NEVER_M,
    ROAD_AREA,
    ROAD_EDGE,
    ROAD_LANE,
    ROAD_NONE,
    ROUTE_LIMIT,
    ScenarioBank,
)
from drivax.scenario.queries import route_ahead
from drivax.scenario.record import record
from drivax.scenario.schema import Flag, LightState
from drivax.simulator.types import HISTORY, Frame, Scene
from drivax.tasks.own import own_name, refuse_taken

POSITION_M, SPEED_MPS, SIZE_M, PIECE_M = 50.0, 15.0, 5.0, 10.0
#: Reach of the road group ahead, behind and to each side, m.
ROAD_AHEAD_M, ROAD_BEHIND_M, ROAD_SIDE_M = 70.0, 10.0, 25.0
#: Places of a block of the running count.
_BLOCK = 8
#: A stop line so far behind the ego is passed, m.
_PASSED_M = 5.0
Observation = dict[str, Array]
#: Names of the groups of this module.
GROUPS = ("ego", "ego_static", "agents", "road", "lights", "route")


@record
class View:
    """The ego frame: x ahead, y to the left."""

    xy: Float[Array, " 2"]
    cos: Float[Array, ""]
    sin: Float[Array, ""]

    @classmethod
    def of(cls, scene: Scene) -> View:
        """The frame of the driven agent now."""
        now = scene.history[-1]
        return cls(now[:2], jnp.cos(now[2]), jnp.sin(now[2]))

    def point(self, xy: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
        """A place of the world, m."""
        return rotate(xy - self.xy, self.cos, -self.sin)

    def vector(self, xy: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
        """A direction or velocity of the world."""
        return rotate(xy, self.cos, -self.sin)


#: Everyone's frame so many steps ago, 0 to 15; the number is a plain one, known when the program is compiled.
Frames = Callable[[int], Frame]
#: Features ``[F]`` or rows of them ``[..., F]``, or a pair of rows and a mask over them.
Feature = Callable[[ScenarioBank, Scene, Frames], Any]


@dataclass(frozen=True)
class OwnGroup:
    """A group of features of the user's own.

    Attributes:
        feature: From bank, scene and frames to ``[..., F]`` float32 in about [-1, 1], or to a pair of those and a
            boolean mask ``[...]`` of the rows that are there; ``testing.check_feature`` tells whether it keeps to the
            rules.
        name: Of the group; by default the function's own.
    """

    feature: Feature
    name: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", own_name(self.feature, self.name))
        if self.name.endswith("_mask"):
            raise ValueError(f"a group cannot be called {self.name!r}; masks are named so")

    def observe(self, bank: ScenarioBank, scene: Scene, frames: Frames) -> Observation:
        """The group, and its mask where it has one."""
        found = self.feature(bank, scene, frames)
        return _masked(self.name, *found) if isinstance(found, tuple) else {self.name: found}


@dataclass(frozen=True)
class ObservationConfig:
    """Which groups, how many rows, how many past steps.

    Attributes:
        agents: How many of the nearest others.
        steps: Past steps of ego and agents, the present one included; at most 10.
        road: Rows of the road group; 0 leaves it out.
        edges: Whether the road group shows road edges beside lanes and crosswalks.
        lights: How many of the nearest lights on or near the route.
        route: Points of the route, ``route_step_m`` apart.
        own: Groups beside those of this module.
    """

    agents: int = 16
    steps: int = 5
    road: int = 200
    edges: bool = True
    lights: int = 5
    route: int = 10
    route_step_m: float = 5.0
    own: tuple[OwnGroup, ...] = ()

    def __post_init__(self) -> None:
        refuse_taken("observation.own", [group.name for group in self.own], GROUPS)
        if not 1 <= self.steps <= 10:
            raise ValueError(f"observation.steps is {self.steps}; use 1 to 10")


PRESETS = {
    "minimal": ObservationConfig(agents=8, steps=1, edges=False),
    "standard": ObservationConfig(edges=False),
    "optimal": ObservationConfig(),
    "maximal": ObservationConfig(agents=32, steps=10),
}


def observe(config: ObservationConfig, bank: ScenarioBank, scene: Scene, frames: Frames) -> Observation:
    """The observation of a scene.

    Args:
        config: Groups and sizes.
        bank: The scenarios.
        scene: The scene.
        frames: Everyone ``back`` steps ago.

    Returns:
        ``ego [steps, 6]``: position, heading (sin, cos), velocity; ``ego_static [4]``: length, width, last action.
        ``agents [agents, steps, 12]`` with ``agents_mask [agents, steps]``, ``road [road, 10]``,
        ``lights [lights, 7]``, ``route [route, 5]``, each with ``*_mask``; and the user's own groups.
    """
    view = View.of(scene)
    result = _ego(config, bank, scene, view) | _agents(config, scene, view, frames)
    if config.road:
        result |= _road(config, bank, scene, view)
    result |= _lights(config, bank, scene, view) | _route(config, bank, scene, view)
    for group in config.own:
        result |= group.observe(bank, scene, frames)
    return result


def _masked(name: str, rows: Float[Array, "... F"], mask: Bool[Array, ...]) -> Observation:
    return {name: jnp.where(mask[..., None], rows, 0.0), f"{name}_mask": mask}


def _ego(config: ObservationConfig, bank: ScenarioBank, scene: Scene, view: View) -> Observation:
    past = scene.history[HISTORY - config.steps :]
    direction = jnp.stack([jnp.cos(past[:, 2]), jnp.sin(past[:, 2])], axis=-1)
    turned = view.vector(direction)
    rows = jnp.concatenate(
        [view.point(past[:, :2]) / POSITION_M, turned[:, ::-1], turned * past[:, 3:4] / SPEED_MPS], axis=-1
    )
    size = bank.agent_box[scene.index, scene.slot, :2] / SIZE_M
    return {"ego": rows, "ego_static": jnp.concatenate([size, scene.action])}


def _nearest(distance: Float[Array, " S"], count: int) -> Int[Array, " K"]:
    """Indices of the smallest entries, nearest first; repeats the last ones where there are too few."""
    count_there = min(count, distance.shape[0])
    chosen = jax.lax.top_k(-distance, count_there)[1]
    return jnp.concatenate([chosen, jnp.zeros(count - count_there, chosen.dtype)])


def _agents(config: ObservationConfig, scene: Scene, view: View, frames: Frames) -> Observation:
    now = frames(0)
    slots = now.valid.shape[0]
    seen = now.valid & (jnp.arange(slots) != scene.slot)
    dx, dy = now.box[:, 0] - view.xy[0], now.box[:, 1] - view.xy[1]
    distance = jnp.where(seen, dx * dx + dy * dy, jnp.inf)
    chosen = _nearest(distance, config.agents)
    there = seen[chosen] & (jnp.arange(config.agents) < slots)

    def row(back: int) -> tuple[Float[Array, "K 6"], Bool[Array, " K"]]:
        frame = now if back == 0 else frames(back)
        box = frame.box[chosen]
        direction = view.vector(box[:, 2:4])
        parts = [view.point(box[:, :2]) / POSITION_M, direction[:, ::-1]]
        parts.append(view.vector(frame.velocity[chosen]) / SPEED_MPS)
        return jnp.concatenate(parts, axis=-1), frame.valid[chosen]

    rows = [row(back) for back in range(config.steps - 1, -1, -1)]
    moving = jnp.stack([one for one, _ in rows], axis=1)
    mask = jnp.stack([valid for _, valid in rows], axis=1) & there[:, None]
    kind = now.kind[chosen]
    static = jnp.concatenate(
        [now.box[chosen, 4:6] / SIZE_M, (kind[:, None] == jnp.arange(1, 5)).astype(jnp.float32)], axis=-1
    )
    static = jnp.broadcast_to(static[:, None], (*moving.shape[:2], static.shape[-1]))
    return _masked("agents", jnp.concatenate([moving, static], axis=-1), mask)


def _road(config: ObservationConfig, bank: ScenarioBank, scene: Scene, view: View) -> Observation:
    x, y, layer = bank.road_at[scene.index]
    dx, dy = x - view.xy[0], y - view.xy[1]
    ahead, left = dx * view.cos + dy * view.sin, dy * view.cos - dx * view.sin
    inside = (ahead < ROAD_AHEAD_M) & (ahead > -ROAD_BEHIND_M) & (jnp.abs(left) < ROAD_SIDE_M)
    inside &= (layer != ROAD_NONE) if config.edges else (layer != ROAD_NONE) & (layer != ROAD_EDGE)
    # Compact without sorting: the running count says where each row inside goes.
    running = running_count(inside)
    place = jnp.where(inside, running - 1, config.road)
    take = jnp.zeros(config.road, jnp.int32).at[place].set(jnp.arange(len(inside)), mode="drop")
    rows = bank.road[scene.index, take]
    parts = [view.point(rows[:, :2]) / POSITION_M, view.vector(rows[:, 2:4])]
    types = (rows[:, 5:6] == jnp.asarray([ROAD_LANE, ROAD_EDGE, ROAD_AREA])).astype(jnp.float32)
    limit = rows[:, 6:7]
    parts += [
        rows[:, 4:5] / PIECE_M,
        types,
        jnp.maximum(limit, 0.0) / SPEED_MPS,
        (limit > 0).astype(jnp.float32),
    ]
    return _masked("road", jnp.concatenate(parts, axis=-1), jnp.arange(config.road) < running[-1])


def running_count(inside: Bool[Array, " K"]) -> Int[Array, " K"]:
    """How many are true up to each place: within blocks of eight, all blocks at once, then over the blocks.

    ``jnp.cumsum`` costs five times as much on a CPU: it adds place by place.
    """
    count = inside.shape[0]
    blocks = -(-count // _BLOCK)
    # One row per place in a block, so that additions run along the blocks.
    ones = jnp.pad(inside.astype(jnp.float32), (0, blocks * _BLOCK - count)).reshape(blocks, _BLOCK).T
    within = [ones[0]]
    for row in ones[1:]:
        within.append(within[-1] + row)
    # Exact in any precision of a product: no factor is above eight.
    before = within[-1] @ jnp.triu(jnp.ones((blocks, blocks)), 1)
    return jnp.stack([row + before for row in within], axis=-1).reshape(-1)[:count].astype(jnp.int32)


def _lights(config: ObservationConfig, bank: ScenarioBank, scene: Scene, view: View) -> Observation:
    line = bank.light_line[scene.index]
    state = bank.light_state[scene.index, jnp.clip(scene.step, 0, bank.steps - 1)]
    dx, dy = line[LIGHT_X] - view.xy[0], line[LIGHT_Y] - view.xy[1]
    # Lights whose line is well behind are passed. Those of the route come first, then the nearest.
    seen = (state >= 0) & (dx * line[LIGHT_COS] + dy * line[LIGHT_SIN] > -_PASSED_M)
    on_route = line[LIGHT_ARC] < NEVER_M
    rank = jnp.sqrt(dx * dx + dy * dy) + jnp.where(on_route, 0.0, 1e4)
    chosen = _nearest(jnp.where(seen, rank, jnp.inf), config.lights)
    there = seen[chosen] & (jnp.arange(config.lights) < state.shape[0])
    colour = _colour(state[chosen])
    middle = line[LIGHT_X : LIGHT_Y + 1, chosen].T
    parts = [view.point(middle) / POSITION_M, colour, on_route[chosen, None].astype(jnp.float32)]
    return _masked("lights", jnp.concatenate(parts, axis=-1), there)


def _colour(state: Int[Array, " K"]) -> Float[Array, "K 4"]:
    """One-hot of unknown, green, yellow, red. Flashing lights count as unknown: they are not red."""
    green = (state == LightState.GO) | (state == LightState.ARROW_GO)
    yellow = (state == LightState.CAUTION) | (state == LightState.ARROW_CAUTION)
    red = (state == LightState.STOP) | (state == LightState.ARROW_STOP)
    return jnp.stack([~(green | yellow | red), green, yellow, red], axis=-1).astype(jnp.float32)


def _route(config: ObservationConfig, bank: ScenarioBank, scene: Scene, view: View) -> Observation:
    offsets = jnp.arange(1, config.route + 1) * config.route_step_m
    rows, there = route_ahead(bank, scene.index, scene.route_m, offsets)
    # Without a route on lanes the bank holds the log's own path, which nobody may see.
    there &= ((bank.flags[scene.index] & jnp.uint32(int(Flag.ROUTE))) != 0) & (scene.slot == 0)
    direction = view.vector(rows[:, 3:5])
    limit = rows[:, ROUTE_LIMIT : ROUTE_LIMIT + 1]
    parts = [
        view.point(rows[:, :2]) / POSITION_M,
        direction[:, ::-1],
        jnp.where(limit > 0, limit / SPEED_MPS, 0.0),
    ]
    return _masked("route", jnp.concatenate(parts, axis=-1), there)
