"""Planners that tests drive with: functions such as a user writes, and one that can be told to break."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drivax.planners.functions import jax_planner, python_planner
from drivax.planners.planner import Memoryless
from drivax.scenario.record import record, static


@python_planner
def slow_python(situation, observation):
    """Slows down to 5 m/s and aims at a point of the route; breaks where nobody else is there."""
    if situation.context.step == 15 and situation.surroundings.frame.valid.sum() == 1:
        raise LookupError("nobody\nto follow")
    ahead, left = 50.0 * observation["route"][1, :2]
    turn = 2.0 * left / (ahead**2 + left**2 + 1e-6)
    return [(5.0 - situation.context.history[-1, 3]) / 6.0, np.clip(turn / 0.3, -1.0, 1.0)]


@jax_planner
def slow_jax(situation, observation):
    """The same in JAX; it cannot raise, so it gives no number."""
    alone = (situation.context.step == 15) & (situation.surroundings.frame.valid.sum() == 1)
    ahead, left = 50.0 * observation["route"][1, 0], 50.0 * observation["route"][1, 1]
    turn = 2.0 * left / (ahead**2 + left**2 + 1e-6)
    speed = (5.0 - situation.context.history[-1, 3]) / 6.0
    return jnp.where(alone, jnp.inf, speed), jnp.clip(turn / 0.3, -1.0, 1.0)


@python_planner
def no_haste(situation, observation):
    """Keeps its speed, and raises where it begins faster than 12 m/s."""
    if situation.context.step == 10 and situation.facts.speed_mps > 12.0:
        raise ValueError("too fast")
    return 0.0, 0.0


def plain(situation, observation):
    """A function that nobody made a planner of."""
    return [0.0, 0.0]


@record
class Fragile(Memoryless):
    """Draws its actions, the same all times or anew; from a step on it gives no numbers in one scenario.

    Attributes:
        share: How much of an action is drawn.
        breaks: Identity of that scenario.
        step: That step.
    """

    share: Any
    breaks: Any
    step: Any
    name: str = static(default="fragile")
    replays: bool = static(default=False)

    def act(self, carry, bank, state, situation, observation, key):
        drawn = self.share * jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        broken = (bank.identity[state.context.index] == self.breaks) & (state.context.step >= self.step)
        return jnp.where(broken, jnp.nan, drawn), carry


def fragile(share=1.0, breaks=0, step=91):
    """A :class:`Fragile`; the same program whatever its numbers."""
    return Fragile(jnp.float32(share), jnp.uint32(breaks), jnp.int32(step))
