"""Perception of ego: range, occlusion, drop-out and noise. It affects observations only; metrics use the true state.

At every step a sensor on ego detects the agents in range, in view and not dropped, each with that step's position
error; a tracker stores the detections. A past step of an agent is therefore the same in every observation. Steps
without a detection are masked; an agent without a detection at the present step is masked with its history.

Random numbers are functions of the state: seed, scenario, step, driven slot and the agent's slot are folded into the
key. Nothing is carried, and a replayed observation equals the live one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.geometry.boxes import COS, LENGTH, SIN, WIDTH, X, Y, corners, passage
from drivax.geometry.vectors import norm, rotate
from drivax.scenario.bank.columns import LightRow
from drivax.scenario.bank.queries import LEVEL_M
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import AgentKind
from drivax.simulator.types import HISTORY, AgentContext, Frame

#: Added to step numbers, which are negative in a history from before step 0; keys fold in numbers from 0 on.
_STEP_OFFSET = 16
#: Numbers folded into the key of a step for each kind of draw.
_DROPOUT_STREAM, _NOISE_STREAM, _LIGHT_DROPOUT_STREAM, LIGHT_NOISE_STREAM, ROAD_NOISE_STREAM = range(5)


@dataclass(frozen=True)
class Perception:
    """Errors of perception; all are off by default and then cost nothing.

    Attributes:
        range_m: Range of the detection of agents and stop lines, m.
        occlusion: Whether agents other than pedestrians and cyclists hide those behind them (:func:`in_view`).
        dropout_m: Agents and lights are detected with probability exp(-distance / dropout_m), drawn at each step;
            published: 200 m.
        noise_m: Standard deviation of the position error of agents, stop lines and road pieces in each direction,
            drawn at each step, m; published: 0.1 m.
        seed: Random seed.
    """

    range_m: float | None = None
    occlusion: bool = False
    dropout_m: float | None = None
    noise_m: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("range_m", "dropout_m"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                key = f"observation.perception.{name}"
                raise ValueError(f"{key} is {value}; use a positive number, or null for none")
        if not 0.0 <= self.noise_m < math.inf:
            raise ValueError(f"observation.perception.noise_m is {self.noise_m}; use 0 or a positive number")

    @property
    def of_agents(self) -> bool:
        """Whether the perception of agents has errors."""
        return self.occlusion or self.of_lights or self.noise_m > 0

    @property
    def of_lights(self) -> bool:
        """Whether lights and agents may be missed, because they are out of range or dropped."""
        return self.range_m is not None or self.dropout_m is not None


def perceive(
    config: Perception, bank: ScenarioBank, context: AgentContext, frames: Callable[..., Frame]
) -> Callable[..., Frame]:
    """Return ``frames`` as ego perceives them: undetected agents are not valid, undetected lights -1, positions noisy.

    Ego itself is exact. ``frames(back)`` returns the true frame of all agents ``back`` steps ago.
    """
    all_agents = cache(lambda back: _add_errors(config, bank, context, frames(back), back))
    return lambda back, slots=None: all_agents(back) if slots is None else all_agents(back).at(slots)


def _add_errors(
    config: Perception, bank: ScenarioBank, context: AgentContext, frame: Frame, back: int
) -> Frame:
    """Return the frame of ``back`` steps ago as ego perceived it then."""
    ego_motion, slots = context.history[HISTORY - 1 - back], jnp.arange(frame.valid.shape[0])
    others, detected, xy = slots != context.slot, frame.valid, frame.box[:, :2]
    distance = norm(xy - ego_motion[:2])
    key = _key(config, bank, context, back)
    detected &= _detect(config, jax.random.fold_in(key, _DROPOUT_STREAM), distance)
    if config.occlusion:
        same_level = jnp.abs(frame.z - frame.z[context.slot]) <= LEVEL_M
        is_thin = (frame.kind == AgentKind.PEDESTRIAN) | (frame.kind == AgentKind.CYCLIST)
        detected &= in_view(ego_motion[:2], frame.box, frame.valid & others & same_level & ~is_thin)
    if config.noise_m > 0:
        # Drawn in ego's frame, so that it is invariant to rotations of the map.
        error = config.noise_m * _normal_per_slot(jax.random.fold_in(key, _NOISE_STREAM), len(slots))
        xy = xy + rotate(error, jnp.cos(ego_motion[2]), jnp.sin(ego_motion[2]))
    xy = jnp.where(others[:, None], xy, frame.box[:, :2])
    box = jnp.concatenate([xy, frame.box[:, 2:]], axis=-1)
    lights = frame.lights
    if config.of_lights:
        distance = norm(bank.light_line[context.index, LightRow.XY].T - ego_motion[:2])
        lights = jnp.where(detect_lights(config, bank, context, distance, back), lights, -1)
    return replace(frame, box=box, valid=jnp.where(others, detected, frame.valid), lights=lights)


def in_view(
    eye: Float[Array, " 2"], box: Float[Array, "S 6"], blocks: Bool[Array, " S"]
) -> Bool[Array, " S"]:
    """Return a mask of the agents whose centre or a corner is visible from a point.

    Boxes in the mask ``blocks`` occlude lines of sight through their interior. No box occludes itself, and a box around
    the eye occludes nothing. All S x S x 5 combinations are tested, with about 40 operations each.
    """
    dx, dy = eye[0] - box[:, X], eye[1] - box[:, Y]
    along, across = dx * box[:, COS] + dy * box[:, SIN], dy * box[:, COS] - dx * box[:, SIN]
    inside = (jnp.abs(along) < box[:, LENGTH] / 2) & (jnp.abs(across) < box[:, WIDTH] / 2)
    points = jnp.concatenate([corners(box), box[:, None, :2]], axis=1)
    enters, leaves = passage(eye, points[:, :, None], box)
    others = ~jnp.eye(len(box), dtype=bool)
    occludes = (enters < leaves) & (blocks & ~inside) & others[:, None]
    return ~occludes.any(axis=2).all(axis=1)


def detect_lights(
    config: Perception, bank: ScenarioBank, context: AgentContext, distance_m: Float[Array, " L"],
    back: int = 0,
) -> Bool[Array, " L"]:  # fmt: skip
    """Return a mask of the stop lines detected ``back`` steps ago, from their distances."""
    key = jax.random.fold_in(_key(config, bank, context, back), _LIGHT_DROPOUT_STREAM)
    return _detect(config, key, distance_m)


def position_errors(
    config: Perception, bank: ScenarioBank, context: AgentContext, stream: int, count: int
) -> Float[Array, "count 2"]:
    """Return position errors of lights or road pieces, as ``stream`` selects, in the ego frame, m."""
    return config.noise_m * _normal_per_slot(jax.random.fold_in(_key(config, bank, context), stream), count)


def _key(config: Perception, bank: ScenarioBank, context: AgentContext, back: int = 0) -> Array:
    """Return the random key of the driven agent's perception ``back`` steps ago."""
    key = jax.random.key(config.seed)
    for number in (bank.identity[context.index], context.step - back + _STEP_OFFSET, context.slot):
        key = jax.random.fold_in(key, number)
    return key


def _detect(config: Perception, key: Array, distance_m: Float[Array, " S"]) -> Bool[Array, " S"]:
    """Return a mask of the slots in range that are not dropped at random."""
    detected = jnp.ones(distance_m.shape, bool)
    if config.range_m is not None:
        detected &= distance_m <= config.range_m
    if config.dropout_m is not None:
        draw = jax.vmap(lambda slot: jax.random.uniform(jax.random.fold_in(key, slot)))
        detected &= draw(jnp.arange(len(distance_m))) < jnp.exp(-distance_m / config.dropout_m)
    return detected


def _normal_per_slot(key: Array, count: int) -> Float[Array, "count 2"]:
    """Return two standard normal numbers per slot, independent of the number of slots."""
    draw = jax.vmap(lambda slot: jax.random.normal(jax.random.fold_in(key, slot), (2,)))
    return draw(jnp.arange(count))
