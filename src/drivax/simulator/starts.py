"""Starts of episodes: as logged, or after a second of perturbed driving.

Any step of the log can be the first one (``Simulator.reset(..., step=...)``); a start provides the motion before it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.errors import UsageError
from drivax.geometry.boxes import corners
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.queries import around_lanes, project_on_route
from drivax.scenario.bank.scenario_bank import Integer, Scalar, ScenarioBank
from drivax.simulator.contact import overlaps
from drivax.simulator.dynamics import bicycle
from drivax.simulator.situation import measure_offroad
from drivax.simulator.traffic.log import alone, frame_of, logged_history
from drivax.simulator.types import HISTORY, MOTION_SPEED, AgentContext, History

#: Rows of all moving agents at one step, as in ``bank.agents``.
Rows = Float[Array, "A 8"]

#: Largest number of draws per start.
MOST_TRIES = 1000
#: Acceleration (m/s2) and curvature (1/m) of an action of 1 in the published description.
_ACCELERATION, _CURVATURE = 6.0, 0.3
#: Range of a strong acceleration, relative to an action of 1; a mild one is between 0 and the upper end.
_STRONG_ACCELERATION = (0.54, 0.6)
#: Range of a strong curvature, relative to its bound; a mild one is between 0 and 1.
_STRONG_CURVATURE = (0.9, 1.0)
#: The curvature's bound falls linearly from the first value at standstill to the second at this speed.
_BOUND, _BOUND_MPS = (0.4, 0.03), 40.0 / 3.6


@runtime_checkable
class Start(Protocol):
    """Motion of the driven agent before the first step of an episode."""

    def begin(
        self, bank: ScenarioBank, index: Integer, step: Integer, slot: Integer, agents: Rows, key: Any
    ) -> tuple[History, Scalar]:
        """Return the motions of the steps up to ``step``, and the arc length along the route at ``step``.

        ``agents`` are the rows of all moving agents at ``step``, from the traffic model.
        """
        ...


@dataclass(frozen=True)
class LogStart:
    """Start as logged."""

    def begin(
        self, bank: ScenarioBank, index: Integer, step: Integer, slot: Integer, agents: Any = None, key: Any = None
    ) -> tuple[History, Scalar]:  # fmt: skip
        """Return the logged motion."""
        return logged_history(bank, index, step, slot), bank.log_progress[bank.row_of(index, slot), step]


@dataclass(frozen=True)
class NoisyStart:
    """Start after one second of driving with one perturbed action (V-Max, ``noisy_init``).

    Three quarters of the draws are strong (acceleration 3.24 to 3.6 m/s2, nearly the largest curvature), the others
    mild (uniform from 0 to the strong maximum), left or right with equal odds. The largest curvature is 0.12 1/m at
    standstill and 0.009 1/m from 40 km/h on. A draw that ends in a collision, off the road or off the map is rejected;
    if all draws are, the episode starts as logged. Unlike in the publication, no metric counts the steps before the
    start.

    Attributes:
        steps: Perturbed steps; fewer where the log has the agent for fewer steps before the start.
        strong: Share of strong draws.
        scale: Factor on accelerations and curvatures.
        tries: Draws per start.
    """

    steps: int = 10
    strong: float = 0.75
    scale: float = 1.0
    tries: int = 8

    def __post_init__(self) -> None:
        if not 1 <= self.steps < HISTORY:
            raise UsageError(f"a noisy start of {self.steps} steps", cure=f"use 1 to {HISTORY - 1}")
        if not (0.0 <= self.strong <= 1.0 and 0.0 <= self.scale < math.inf and 1 <= self.tries <= MOST_TRIES):
            cure = f"strong in [0, 1], scale >= 0, tries 1 to {MOST_TRIES}"
            raise UsageError(f"{self} cannot be drawn", cure=cure)

    def begin(
        self, bank: ScenarioBank, index: Integer, step: Integer, slot: Integer, agents: Rows, key: Any
    ) -> tuple[History, Scalar]:
        """Return the first acceptable of ``tries`` draws, or the logged motion if there is none."""
        if key is None:
            raise UsageError("a noisy start needs a random key", cure="reset(bank, index, step, slot, key)")
        # Only steps at which the log has the agent are replaced.
        back = jnp.arange(1, self.steps + 1)
        is_logged = bank.agents[index, jnp.maximum(step - back, 0), slot, AgentColumn.VALID] > 0
        is_logged &= back <= step
        count = jnp.cumprod(is_logged.astype(jnp.int32)).sum()
        base_history = logged_history(bank, index, step - count, slot)

        def draw_history(key: Array) -> tuple[History, Bool[Array, ""]]:
            """Draw a history, and return whether it is acceptable."""
            history = self._unroll(base_history, count, *self.draw(key, base_history[-1, MOTION_SPEED]))
            return history, _is_acceptable(bank, index, step, slot, agents, history)

        histories, is_acceptable = jax.vmap(draw_history)(jax.random.split(key, self.tries))
        log_history, log_route_m = LogStart().begin(bank, index, step, slot)
        history = jnp.where(is_acceptable.any(), histories[jnp.argmax(is_acceptable)], log_history)
        row = bank.row_of(index, slot)
        base_m = bank.log_progress[row, step - count]
        along_m = project_on_route(bank, row, history[-1, :2], base_m).along_m
        return history, jnp.where(is_acceptable.any(), jnp.maximum(along_m, base_m), log_route_m)

    def draw(self, key: Array, speed: Scalar) -> tuple[Scalar, Scalar]:
        """Draw an acceleration (m/s2) and a curvature (1/m) for a speed."""
        keys = jax.random.split(key, 4)
        is_strong = jax.random.bernoulli(keys[0], self.strong)
        side = jnp.where(jax.random.bernoulli(keys[1]), 1.0, -1.0)
        low = jnp.where(is_strong, _STRONG_ACCELERATION[0], 0.0)
        acceleration = jax.random.uniform(keys[2], minval=low, maxval=_STRONG_ACCELERATION[1])
        low = jnp.where(is_strong, _STRONG_CURVATURE[0], 0.0)
        curvature = side * jax.random.uniform(keys[3], minval=low, maxval=_STRONG_CURVATURE[1])
        bound = _BOUND[0] + (_BOUND[1] - _BOUND[0]) * jnp.minimum(speed / _BOUND_MPS, 1.0)
        return self.scale * _ACCELERATION * acceleration, self.scale * _CURVATURE * bound * curvature

    def _unroll(self, history: History, count: Integer, acceleration: Scalar, curvature: Scalar) -> History:
        """Return the history after ``count`` steps of one action."""

        def advance(history: Array, step: Array) -> tuple[Array, None]:
            """Append a motion, unless ``count`` steps are done."""
            next_history = jnp.concatenate([history[1:], bicycle(history[-1], acceleration, curvature)[None]])
            return jnp.where(step < count, next_history, history), None

        return jax.lax.scan(advance, history, jnp.arange(self.steps))[0]


def _is_acceptable(
    bank: ScenarioBank, index: Integer, step: Integer, slot: Integer, agents: Rows, history: History
) -> Bool[Array, ""]:
    """Return whether an agent with this history overlaps no other agent and is on the road at ``step``."""
    zero, z = jnp.zeros(()), bank.agents[index, step, slot, AgentColumn.Z]
    context = AgentContext(index, step, slot, history, jnp.zeros(2), zero, z, ())
    frame = frame_of(bank, index, step, agents, alone(context), 0)
    box, ground = frame.box[slot], z - bank.height_m(index, slot) / 2
    lanes = around_lanes(bank, index, box[:2], box[2:4], corners(box), ground)
    _, left_map, offroad = measure_offroad(bank, index, box, ground, lanes)
    return ~(overlaps(frame, slot).any() | offroad | left_map)
