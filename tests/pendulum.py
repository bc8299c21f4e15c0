"""Pendulum swing-up as an environment: a control task whose known results judge the algorithms.

Dynamics, observation and reward are those of Gymnasium's ``Pendulum-v1`` (tested against it step by step), from its
documented equations: ``theta'' = 3 g / (2 l) sin(theta) + 3 / (m l^2) u``, semi-implicit Euler of 0.05 s, costs
``theta^2 + 0.1 theta'^2 + 0.001 u^2``, 200 steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from drivax.learning.environment import Environments, Outcome
from drivax.scenario.record import record

G, MASS, LENGTH, DT, MAX_SPEED, MAX_TORQUE, STEPS = 10.0, 1.0, 1.0, 0.05, 8.0, 2.0, 200


@record
class Swing:
    """A pendulum: angle from upright and its rate, steps since the beginning, and the return so far."""

    angle: jax.Array
    rate: jax.Array
    step: jax.Array
    earned: jax.Array


@record
class Demonstrations:
    """What an expert did: the pendulum's data, where it is to be imitated."""

    stored: Any
    action: jax.Array


def swing(angle, rate, torque):
    """Angle and rate a step later, and the reward of the step."""
    wrapped = (angle + math.pi) % (2 * math.pi) - math.pi
    reward = -(wrapped**2 + 0.1 * rate**2 + 0.001 * torque**2)
    push = 3 * G / (2 * LENGTH) * jnp.sin(angle) + 3.0 / (MASS * LENGTH**2) * torque
    rate = jnp.clip(rate + push * DT, -MAX_SPEED, MAX_SPEED)
    return angle + rate * DT, rate, reward


@dataclass(frozen=True)
class Pendulum:
    """A batch of pendulums. An action of 1 is a torque of 2 N m; ``data`` holds demonstrations, or nothing."""

    action_size: int = 1
    levels: Any = None

    def shapes(self, data):
        return {"pendulum": (3,)}

    def start(self, data, key, count):
        begin_key, step_key = jax.random.split(key)
        state = self._begin(begin_key, count)
        step = jax.random.randint(step_key, (count,), 0, STEPS)
        state = Swing(state.angle, state.rate, step, jnp.full(count, jnp.nan))
        return Environments(state, jnp.zeros(count, bool), self.observe_all(data, self.stored(state)))

    def stored(self, state):
        return {"angle": state.angle, "rate": state.rate}

    def observe_all(self, data, stored):
        angle = stored["angle"]
        return {"pendulum": jnp.stack([jnp.cos(angle), jnp.sin(angle), stored["rate"]], axis=-1)}

    def cache(self, data, state):
        return ()

    def draw(self, data, key, count):
        return key

    def step(self, data, now, cache, action, drawn):
        angle, rate, reward = swing(now.state.angle, now.state.rate, MAX_TORQUE * action[:, 0])
        moved = Swing(angle, rate, now.state.step + 1, now.state.earned + reward)
        fresh = self._begin(drawn, len(now.over))
        state = jax.tree.map(lambda new, old: jnp.where(now.over, new, old), fresh, moved)
        over = (state.step >= STEPS) & ~now.over
        # Only whole episodes have a return: those at the start began in the middle.
        counts = over & ~jnp.isnan(state.earned)
        totals = {
            "return": jnp.sum(jnp.where(counts, state.earned, 0.0)),
            "return/n": counts.sum().astype(jnp.float32),
            "reward/swing": jnp.sum(jnp.where(now.over, 0.0, reward)),
        }
        outcome = Outcome(reward, jnp.zeros_like(over), over, (), totals)
        return Environments(state, over, self.observe_all(data, self.stored(state))), outcome

    def demonstrations(self, data, key, count):
        rows = jax.random.randint(key, (count,), 0, len(data.action))
        stored = jax.tree.map(lambda leaf: leaf[rows], data.stored)
        return self.observe_all(data, stored), data.action[rows], jnp.zeros(count, bool)

    def _begin(self, key, count):
        draws = jax.random.uniform(key, (2, count), minval=-1.0)
        return Swing(draws[0] * math.pi, draws[1], jnp.zeros(count, jnp.int32), jnp.zeros(count))


def returns(distribution, parameters, key, count=100):
    """Returns of whole episodes in which a policy acts by its mode, and what it saw and did ``[step, episode]``."""
    environment = Pendulum()
    state = environment._begin(key, count)

    def one(state, _):
        stored = environment.stored(state)
        action = distribution(parameters, environment.observe_all((), stored)).mode()
        angle, rate, reward = swing(state.angle, state.rate, MAX_TORQUE * action[:, 0])
        return Swing(angle, rate, state.step + 1, state.earned + reward), (stored, action)

    state, (stored, action) = jax.lax.scan(one, state, None, STEPS)
    return state.earned, Demonstrations(stored, action)
