"""Planners for tests: functions as a user writes them, and a class that fails on request."""

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
    """Slow down to 5 m/s and aim at a point of the route; raise an error where no other agent is there."""
    if situation.context.step == 15 and situation.surroundings.frame.valid.sum() == 1:
        raise LookupError("nobody\nto follow")
    ahead, left = 50.0 * observation["route"][1, :2]
    turn = 2.0 * left / (ahead**2 + left**2 + 1e-6)
    return [(5.0 - situation.context.history[-1, 3]) / 6.0, np.clip(turn / 0.3, -1.0, 1.0)]


@jax_planner
def slow_jax(situation, observation):
    """The same in JAX, which cannot raise: the action is infinite instead."""
    alone = (situation.context.step == 15) & (situation.surroundings.frame.valid.sum() == 1)
    ahead, left = 50.0 * observation["route"][1, 0], 50.0 * observation["route"][1, 1]
    turn = 2.0 * left / (ahead**2 + left**2 + 1e-6)
    speed = (5.0 - situation.context.history[-1, 3]) / 6.0
    return jnp.where(alone, jnp.inf, speed), jnp.clip(turn / 0.3, -1.0, 1.0)


@python_planner
def no_haste(situation, observation):
    """Keep the speed; raise an error where the episode starts faster than 12 m/s."""
    if situation.context.step == 10 and situation.facts.speed_mps > 12.0:
        raise ValueError("too fast")
    return 0.0, 0.0


def plain(situation, observation):
    """A plain function without a planner decorator."""
    return [0.0, 0.0]


@record
class Fragile(Memoryless):
    """Random actions that are NaN in one scenario from a step on.

    Attributes:
        share: Factor of the random numbers.
        breaks: Identity of the scenario.
        step: The step.
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
    """A :class:`Fragile` whose numbers are leaves: they share one program."""
    return Fragile(jnp.float32(share), jnp.uint32(breaks), jnp.int32(step))
