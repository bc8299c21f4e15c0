"""Collecting experience: a batch of environments that begin anew by themselves, unrolled on the device."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.learning.environment import Environment, Environments
from drivax.scenario.record import record


@record
class Rollout:
    """Experience ``[time, batch]``. ``alive`` is false for the steps that only begin an episode; mask them out.

    The row after row t holds what row t led to, final states included; after the last row that is in the environments.
    ``choice`` is what the policy chose, ``extra`` what the actor wants to remember. Of ``observation`` and ``state``
    (what replay stores) the one is there that was asked for; the other is None.
    """

    observation: dict[str, Array] | None
    state: Any
    choice: Float[Array, "*time batch D"]
    extra: dict[str, Array]
    reward: Float[Array, "*time batch"]
    terminated: Bool[Array, "*time batch"]
    truncated: Bool[Array, "*time batch"]
    alive: Bool[Array, "*time batch"]


#: From observations and a key to (choice, action in [-1, 1], what to remember).
Actor = Callable[[Mapping[str, Array], Array], tuple[Array, Array, dict[str, Array]]]


def collect(
    environment: Environment,
    data: Any,
    environments: Environments,
    actor: Actor,
    key: Array,
    steps: int,
    keep: Literal["observation", "state"] = "observation",
) -> tuple[Environments, Rollout, dict[str, Array]]:
    """Unrolls ``steps`` steps in every environment.

    Args:
        environment: What is acted in.
        data: Its data.
        environments: Where to go on.
        actor: What acts.
        key: Of actions and of whatever the environment draws.
        steps: How many.
        keep: Whether rows hold observations, or states that they can be made of again.

    Returns:
        The environments afterwards, the experience, and sums to log: the environment's (``Outcome.totals``), with
        ``episodes`` that ended and ``steps`` that counted.
    """

    def one(carry: tuple[Environments, Any, Array], _: None) -> tuple[Any, Any]:
        now, looked, key = carry
        key, act_key, step_key = jax.random.split(key, 3)
        choice, action, extra = actor(now.observation, act_key)
        following, outcome = environment.step(data, now, looked, action, step_key)
        row = Rollout(
            observation=now.observation if keep == "observation" else None,
            state=environment.stored(now.state) if keep == "state" else None,
            choice=choice,
            extra=extra,
            reward=jnp.where(now.over, 0.0, outcome.reward),
            terminated=outcome.terminated,
            truncated=outcome.truncated,
            alive=~now.over,
        )
        counts = {"episodes": following.over.sum(), "steps": row.alive.sum()}
        totals = outcome.totals | {name: count.astype(jnp.float32) for name, count in counts.items()}
        return (following, outcome.looked, key), (row, totals)

    first = (environments, environment.look(data, environments.state), key)
    (environments, _, _), (rollout, totals) = jax.lax.scan(one, first, None, steps)
    return environments, rollout, jax.tree.map(lambda leaf: leaf.sum(axis=0), totals)
