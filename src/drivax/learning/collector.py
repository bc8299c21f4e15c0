"""Collecting experience: a batch of environments that reset themselves, unrolled on the device."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.metrics.catalogue import CODES
from drivax.metrics.episode import episode_metrics
from drivax.scenario.bank import AGENT_VALID, ScenarioBank
from drivax.scenario.record import record
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.simulator import Simulator
from drivax.simulator.sparse import map_where
from drivax.simulator.types import Beginning, Frame, SimState


@record
class Environments:
    """A batch of environments between two collections.

    Attributes:
        state: Their states.
        over: Whether each one's episode has ended; the next step begins a new one.
        observation: What each one's policy sees now.
    """

    state: SimState
    over: Bool[Array, " B"]
    observation: dict[str, Array]


@record
class Rollout:
    """Experience ``[time, batch]``. ``alive`` is false for the steps that only reset; mask them out.

    ``choice`` is what the policy chose, before squashing; ``extra`` is what the actor wants to remember.
    """

    observation: dict[str, Array]
    choice: Float[Array, "*time batch D"]
    extra: dict[str, Array]
    reward: Float[Array, "*time batch"]
    terminated: Bool[Array, "*time batch"]
    truncated: Bool[Array, "*time batch"]
    alive: Bool[Array, "*time batch"]


#: From observations and a key to (choice before squashing, action in [-1, 1], what to remember).
Actor = Callable[[Mapping[str, Array], Array], tuple[Array, Array, dict[str, Array]]]


def start_environments(simulator: Simulator, bank: ScenarioBank, key: Array, count: int) -> Environments:
    """Environments at scenarios drawn with replacement, at random steps so that their ends are staggered."""
    index_key, step_key = jax.random.split(key)
    index = jax.random.randint(index_key, (count,), 0, len(bank))
    step = _start(bank, index, jax.random.randint(step_key, (count,), CURRENT_STEP, bank.steps - 2))
    keys = jax.random.split(jax.random.fold_in(key, 1), count)
    state = jax.vmap(simulator.reset, in_axes=(None, 0, 0, None, 0))(bank, index, step, 0, keys)
    observation = jax.vmap(simulator.observe, in_axes=(None, 0))(bank, state.scene)
    return Environments(state, jnp.zeros(count, bool), dict(observation))


def collect(
    simulator: Simulator,
    bank: ScenarioBank,
    environments: Environments,
    actor: Actor,
    key: Array,
    steps: int,
    latest_start: int = CURRENT_STEP,
) -> tuple[Environments, Rollout, dict[str, Array]]:
    """Unrolls ``steps`` steps in every environment; episodes begin between step 10 and ``latest_start``.

    Returns:
        The environments afterwards, the experience, and sums of metrics over the episodes that ended, with
        ``"<name>"`` the sum and ``"<name>/n"`` the number of episodes that define it.
    """
    count = environments.over.shape[0]
    step_all = jax.vmap(simulator.step_or_begin, in_axes=(None, 0, 0, 0, 0, 0))
    observe_all = jax.vmap(simulator.observe, in_axes=(None, 0))
    everyone = jax.vmap(simulator.now, in_axes=(None, 0))

    def begin(index: Array, step: Array, key: Array) -> Beginning:
        return simulator.beginning(bank, index, step, 0, key)

    def one(carry: tuple[Environments, Frame, Array], _: None) -> tuple[Any, Any]:
        now, seen, key = carry
        key, act_key, index_key, start_key = jax.random.split(key, 4)
        choice, action, extra = actor(now.observation, act_key)
        index = jax.random.randint(index_key, (count,), 0, len(bank))
        start = _start(bank, index, jax.random.randint(start_key, (count,), CURRENT_STEP, latest_start + 1))
        keys = jax.random.split(
            jax.random.fold_in(start_key, 1), count
        )  # not computed where starts are logged
        fresh = map_where(now.over, begin, index, start, keys)
        state, transition = step_all(bank, now.state, action, now.over, fresh, seen)
        row = Rollout(
            observation=now.observation,
            choice=choice,
            extra=extra,
            reward=jnp.where(now.over, 0.0, transition.reward),
            terminated=transition.terminated,
            truncated=transition.truncated,
            alive=~now.over,
        )
        done = transition.terminated | transition.truncated
        tally = _tally(bank, state, transition.reward_terms, done, now.over)
        following = Environments(state, done, dict(observe_all(bank, state.scene)))
        return (following, everyone(bank, state.scene), key), (row, tally)

    first = (environments, everyone(bank, environments.state.scene), key)
    (environments, _, _), (rollout, tally) = jax.lax.scan(one, first, None, steps)
    return environments, rollout, jax.tree.map(lambda leaf: leaf.sum(axis=0), tally)


def _start(bank: ScenarioBank, index: Array, step: Array) -> Array:
    """Steps at which the ego is in the log: those asked for, or the current one, at which it always is."""
    return jnp.where(bank.agents[index, step, 0, AGENT_VALID] > 0, step, CURRENT_STEP)


def _tally(
    bank: ScenarioBank, state: SimState, terms: dict[str, Array], done: Array, over: Array
) -> dict[str, Array]:
    """Sums over the batch: the task's metrics of episodes that end now, reward terms of steps that count."""
    logged = [name for name in state.episode.selection.names if name not in CODES]

    def of_episodes() -> dict[str, Array]:
        values = jax.vmap(episode_metrics, in_axes=(None, 0))(bank, state)
        sums = {}
        for name in logged:
            counts = done & values[name].defined
            sums[name] = jnp.sum(jnp.where(counts, values[name].value, 0.0))
            sums[f"{name}/n"] = counts.sum().astype(jnp.float32)
        return sums

    # Most steps end no episode; the branch is on the whole batch, so it really is skipped.
    nothing = {name: jnp.zeros(()) for metric in logged for name in (metric, f"{metric}/n")}
    totals = jax.lax.cond(done.any(), of_episodes, lambda: nothing)
    totals |= {"episodes": done.sum().astype(jnp.float32), "steps": (~over).sum().astype(jnp.float32)}
    for name, term in terms.items():
        totals[f"reward/{name}"] = jnp.sum(jnp.where(over, 0.0, term))
    return totals
