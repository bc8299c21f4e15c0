"""Perception of ego: range, occlusion, drop-out and noise. It affects observations only; metrics use the truth.

At every step a sensor on ego detects the agents in range, in view and not dropped, each with that step's position
error; a tracker keeps the detections. A past step of an agent is therefore the same in every observation that holds it;
steps without a detection are masked, and an agent that is not detected now is absent with its history.

Random numbers follow from the state: the key is the seed with the scenario's identity, step, driven slot and the
agent's slot folded in. A replayed observation equals the live one, and nothing is carried.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.geometry.boxes import corners, passage
from drivax.geometry.vectors import norm, rotate
from drivax.scenario.bank.columns import LightRow
from drivax.scenario.bank.queries import LEVEL_M
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import AgentKind
from drivax.simulator.types import HISTORY, AgentContext, Frame

#: Numbers folded into the key of a step, by what is drawn.
#: Added to step numbers, since keys are folded with numbers from 0 on.
_BEFORE = 16
_DROPPED, _MOVED, _DROPPED_LIGHTS, MOVED_LIGHTS, MOVED_ROAD = range(5)


@dataclass(frozen=True)
class Perception:
    """Errors of perception; all are off by default and then cost nothing.

    Attributes:
        range_m: Range beyond which agents and stop lines are not seen, m.
        occlusion: Whether vehicles hide agents behind them (:func:`in_view`).
        dropout_m: Agents and lights are seen with probability exp(-distance / dropout_m), drawn at each step;
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
                place = f"observation.perception.{name}"
                raise ValueError(f"{place} is {value}; use a positive number, or null for none")
        if not 0.0 <= self.noise_m < math.inf:
            raise ValueError(f"observation.perception.noise_m is {self.noise_m}; use 0 or a positive number")

    @property
    def of_agents(self) -> bool:
        """Whether agents are perceived with errors."""
        return self.occlusion or self.of_lights or self.noise_m > 0

    @property
    def of_lights(self) -> bool:
        """Whether lights may be missed."""
        return self.range_m is not None or self.dropout_m is not None


def perceived(
    config: Perception, bank: ScenarioBank, context: AgentContext, frames: Callable[[int], Frame]
) -> Callable[[int], Frame]:
    """Return the frames as ego perceives them: unseen agents not valid, unseen lights -1, and positions with errors.

    Ego itself is exact. ``frames`` returns the true frame of all agents some steps ago.
    """
    return cache(lambda back: _sensed(config, bank, context, frames(back), back))


def _sensed(config: Perception, bank: ScenarioBank, context: AgentContext, frame: Frame, back: int) -> Frame:
    eye, slots = context.history[HISTORY - 1 - back], jnp.arange(frame.valid.shape[0])
    others, seen, place = slots != context.slot, frame.valid, frame.box[:, :2]
    distance = norm(place - eye[:2])
    key = _key(config, bank, context, back)
    seen &= _reported(config, jax.random.fold_in(key, _DROPPED), distance)
    if config.occlusion:
        level = jnp.abs(frame.z - frame.z[context.slot]) <= LEVEL_M
        slim = (frame.kind == AgentKind.PEDESTRIAN) | (frame.kind == AgentKind.CYCLIST)
        seen &= in_view(eye[:2], frame.box, frame.valid & others & level & ~slim)
    if config.noise_m > 0:
        # Drawn in ego's frame: invariant to rotations of the map.
        error = config.noise_m * _each(jax.random.fold_in(key, _MOVED), len(slots))
        place = place + rotate(error, jnp.cos(eye[2]), jnp.sin(eye[2]))
    place = jnp.where(others[:, None], place, frame.box[:, :2])
    box = jnp.concatenate([place, frame.box[:, 2:]], axis=-1)
    lights = frame.lights
    if config.of_lights:
        line = bank.light_line[context.index, LightRow.XY]
        lights = jnp.where(lights_seen(config, bank, context, norm(line.T - eye[:2]), back), lights, -1)
    return replace(frame, box=box, valid=jnp.where(others, seen, frame.valid), lights=lights)


def in_view(
    eye: Float[Array, " 2"], box: Float[Array, "S 6"], blocks: Bool[Array, " S"]
) -> Bool[Array, " S"]:
    """Return which agents are visible from a point: those with a visible centre or corner.

    A box of ``blocks`` blocks lines of sight through its inside; touching does not block. No box blocks itself, and a
    box around the eye blocks nothing. All S x S x 5 pairs are tested, about 40 operations each.
    """
    dx, dy = eye[0] - box[:, 0], eye[1] - box[:, 1]
    along, across = dx * box[:, 2] + dy * box[:, 3], dy * box[:, 2] - dx * box[:, 3]
    inside = (jnp.abs(along) < box[:, 4] / 2) & (jnp.abs(across) < box[:, 5] / 2)
    points = jnp.concatenate([corners(box), box[:, None, :2]], axis=1)
    enters, leaves = passage(eye, points[:, :, None], box)
    others = ~jnp.eye(len(box), dtype=bool)
    cut = (enters < leaves) & (blocks & ~inside) & others[:, None]
    return ~cut.any(axis=2).all(axis=1)


def lights_seen(
    config: Perception, bank: ScenarioBank, context: AgentContext, distance_m: Float[Array, " L"],
    back: int = 0,
) -> Bool[Array, " L"]:  # fmt: skip
    """Return which stop lines were seen ``back`` steps ago, at these distances."""
    key = jax.random.fold_in(_key(config, bank, context, back), _DROPPED_LIGHTS)
    return _reported(config, key, distance_m)


def position_errors(
    config: Perception, bank: ScenarioBank, context: AgentContext, drawn: int, count: int
) -> Float[Array, "count 2"]:
    """Return position errors of ``MOVED_LIGHTS`` or ``MOVED_ROAD`` in the ego frame, m."""
    return config.noise_m * _each(jax.random.fold_in(_key(config, bank, context), drawn), count)


def _key(config: Perception, bank: ScenarioBank, context: AgentContext, back: int = 0) -> Array:
    key = jax.random.key(config.seed)
    for number in (bank.identity[context.index], context.step - back + _BEFORE, context.slot):
        key = jax.random.fold_in(key, number)
    return key


def _reported(config: Perception, key: Array, distance_m: Float[Array, " S"]) -> Bool[Array, " S"]:
    """Return which agents are in range and not dropped at random."""
    seen = jnp.ones(distance_m.shape, bool)
    if config.range_m is not None:
        seen &= distance_m <= config.range_m
    if config.dropout_m is not None:
        draw = jax.vmap(lambda slot: jax.random.uniform(jax.random.fold_in(key, slot)))
        seen &= draw(jnp.arange(len(distance_m))) < jnp.exp(-distance_m / config.dropout_m)
    return seen


def _each(key: Array, count: int) -> Float[Array, "count 2"]:
    """Return two standard normal numbers per slot, independent of the number of slots."""
    draw = jax.vmap(lambda slot: jax.random.normal(jax.random.fold_in(key, slot), (2,)))
    return draw(jnp.arange(count))
