"""Health of critics: whether Q values are returns, rank episodes by their return, and have converged.

With Q values that diverge or only fit the data, training still yields a policy, but in effect one that imitates. Each
validation of an offline run in :class:`~drivax.learning.driving.Driving` compares the critics with simulated returns of
the current policy, and with returns of held-out episodes; at its end, the run reports what is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from drivax.learning.driving import BATCH, Driving
from drivax.learning.experience import ExpertSteps
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.simulator import Simulator

#: Largest root mean square error of Q, in standard deviations of the simulated returns.
MOST_Q_ERROR = 0.5
#: Least rank correlation (Spearman) of Q with the returns of held-out episodes.
LEAST_Q_RANK = 0.5
#: Largest mean TD error of the last quarter of a run relative to the quarter before it.
MOST_TD_RISE = 1.05
#: Least share of episodes that end in a failure: with fewer, nothing tells critics what failures cost.
LEAST_FAILURES = 0.05
#: Largest distance of the entropy from its target over the last quarter of a run, nats.
MOST_ENTROPY_ERROR = 0.5

Observation = dict[str, Array]


def policy_returns(
    environment: Driving, bank: ScenarioBank, act: Callable[[Observation], Array], gamma: float
) -> tuple[Float[Array, " N"], Float[Array, " N"], Observation, Observation]:
    """Drive a policy in all scenarios from the current step to the end of the episode.

    Returns:
        Discounted return; ``gamma^n`` for an episode of n steps, 0 where it terminated; and the observations of the
        first and the final states. To bootstrap a truncated episode, add this discount times the value of the final
        state to the return.
    """
    simulator = Simulator(replace(environment.task, metrics="none"), environment.simulator.traffic)

    def step(carry: Any, is_first: Array) -> tuple[Any, None]:
        # One step more than the episode has, which observes the final state: a second trace would take long.
        state, over, value, discount, first, _ = carry
        observation = dict(simulator.observe(bank, state.context))
        action = act(jax.tree.map(lambda leaf: leaf[None], observation))[0]
        after, result = simulator.step(bank, state, action)
        value = value + jnp.where(over, 0.0, discount * result.reward)
        discount = jnp.where(over, discount, jnp.where(result.terminated, 0.0, gamma * discount))
        state = jax.tree.map(partial(jnp.where, over), state, after)
        over |= result.terminated | result.truncated
        first = jax.tree.map(partial(jnp.where, is_first), observation, first)
        return (state, over, value, discount, first, observation), None

    def episode(index: Int[Array, ""]) -> tuple[Array, Array, Observation, Observation]:
        initial = simulator.reset(bank, index)
        shapes = jax.eval_shape(lambda: dict(simulator.observe(bank, initial.context)))
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        carry = (initial, jnp.zeros((), bool), jnp.zeros(()), jnp.ones(()), zeros, zeros)
        steps = jnp.arange(bank.steps - CURRENT_STEP)
        (_, _, value, discount, first, final), _ = jax.lax.scan(step, carry, steps == 0)
        return value, discount, first, final

    return jax.lax.map(episode, jnp.arange(len(bank)), batch_size=min(len(bank), BATCH))


def returns_to_go(steps: ExpertSteps, final_value: Float[Array, " M"], gamma: float) -> Float[Array, "M T"]:
    """Return the discounted return of recorded episodes from each usable step on; elsewhere it is undefined.

    ``final_value`` is the value of the state in which an episode ends without termination.
    """

    def step(value: Array, step_t: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        reward, terminated, usable = step_t
        value = jnp.where(usable, reward + gamma * jnp.where(terminated, 0.0, value), value)
        return value, value

    columns = (steps.reward.T, steps.terminated.T, steps.usable.T)
    return jax.lax.scan(step, final_value, columns, reverse=True)[1].T


def critic_problems(
    rows: Sequence[Mapping[str, float]], entropy: float | None = None, needs_failures: bool = False
) -> list[str] | None:
    """Diagnose the critics of a run from its rows of ``metrics.jsonl`` up to the loaded policy; return the problems.

    None if Q was not compared with returns, as in runs without validation. ``entropy`` is the policy's target entropy,
    None for a policy without one; ``needs_failures`` is the setting of the algorithm.
    """
    problems, errors, ranks = [], _column(rows, "validation/q_error"), _column(rows, "validation/q_rank")
    if not len(errors) or not len(ranks):
        return None
    failures = _column(rows, "sampler/failures")
    if len(failures) and not failures[-1] >= LEAST_FAILURES:
        problem = f"{failures[-1]:.1%} of the episodes fail, too few to learn what failures cost"
        problems.append(f"{problem}; the policy only imitates" if needs_failures else problem)
    td_error = _column(rows, "loss/critic")
    before, last = (td_error[len(td_error) * k // 4 : len(td_error) * (k + 1) // 4] for k in (2, 3))
    if len(before) and not last.mean() <= MOST_TD_RISE * before.mean():
        values = f"from {before.mean():.3g} to {last.mean():.3g}"
        problems.append(f"the TD error rises over the second half, {values}")
    if not errors[-1] <= MOST_Q_ERROR:
        problems.append(f"Q is off by {errors[-1]:.2f} standard deviations of the policy's returns")
    if not ranks[-1] >= LEAST_Q_RANK:
        problems.append(f"Q has a rank correlation of {ranks[-1]:.2f} with the returns of held-out episodes")
    entropies = _column(rows, "loss/entropy")
    entropies = entropies[len(entropies) * 3 // 4 :]
    if entropy is not None and len(entropies) and not abs(entropies.mean() - entropy) <= MOST_ENTROPY_ERROR:
        problems.append(f"the entropy is {entropies.mean():.2f}, its target {entropy:.2f}")
    return problems


def _column(rows: Sequence[Mapping[str, float]], name: str) -> np.ndarray:
    return np.array([row[name] for row in rows if name in row], np.float64)
