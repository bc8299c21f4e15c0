"""Logged episodes of control tasks: a table of observations, actions and rewards, as an environment's data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from drivax.learning.experience import ExpertSteps
from drivax.scenario.record import record
from pendulum import MAX_TORQUE, STEPS, Pendulum, Swing, swing


@record
class Table:
    """Stacked episodes: observations ``[N, T, 3]``, actions ``[N, T, 1]``, and their outcomes ``[N, T]``."""

    seen: jax.Array
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    usable: jax.Array


@dataclass(frozen=True)
class Logged(Pendulum):
    """An environment that is known from logged steps only; its observations are three numbers."""

    def expert_steps(self, data: Table) -> ExpertSteps:
        fields = {
            name: getattr(data, name) for name in ("action", "reward", "terminated", "truncated", "usable")
        }
        return ExpertSteps(**fields, clipped=jnp.zeros_like(data.usable))

    def observe_recorded(self, data: Table, places: Any) -> dict[str, jax.Array]:
        return {"pendulum": data.seen[places]}


def arms(action, reward) -> Table:
    """A bandit: each episode is one step from the same state, and ends there."""
    action, reward = (jnp.asarray(array, jnp.float32)[:, None] for array in (action, reward))
    first = jnp.broadcast_to(jnp.arange(2) == 0, (len(action), 2))
    return Table(
        seen=jnp.ones((len(action), 2, 3)),
        action=jnp.concatenate([action, action], axis=1)[..., None],
        reward=jnp.concatenate([reward, reward], axis=1),
        terminated=first,
        truncated=jnp.zeros_like(first),
        usable=first,
    )


def episodes(policy, key, count) -> tuple[Table, jax.Array]:
    """Episodes of the pendulum driven by ``policy(observation, key) -> action``, and their returns."""
    environment = Pendulum()
    state = environment._begin(key, count)

    def one(state: Swing, key: jax.Array) -> Any:
        seen = environment.observe_all((), environment.stored(state))["pendulum"]
        action = policy(seen, key)
        angle, rate, reward = swing(state.angle, state.rate, MAX_TORQUE * action[:, 0])
        return Swing(angle, rate, state.step + 1, state.earned + reward), (seen, action, reward)

    state, rows = jax.lax.scan(one, state, jax.random.split(key, STEPS))
    seen, action, reward = (jnp.moveaxis(row, 0, 1) for row in rows)
    # The last step's successor is not in the table.
    usable = jnp.broadcast_to(jnp.arange(STEPS) < STEPS - 1, reward.shape)
    nothing = jnp.zeros(reward.shape, bool)
    return Table(seen, action, reward, nothing, nothing, usable), state.earned
