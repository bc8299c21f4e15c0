"""Equations of reinforcement learning: advantages, temporal-difference targets, terms of losses, returns off policy.

Arrays in, arrays out. Time is the leading axis; ``_t`` and ``_tp1`` mark steps t and t + 1. Losses are per sample;
callers add and average them (``drivax.learning.algorithms``).

Estimators of a policy's return read episodes of other policies, of T steps; steps that are not ``usable`` (after the
end) have no reward, and their ratio counts as 1. ``ratio`` is the probability of the action under the evaluated policy
over that under the behaviour policy.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from drivax.scenario.record import record


def generalised_advantages(
    reward_t: Float[Array, "time *batch"], value_t: Float[Array, "time *batch"],
    value_tp1: Float[Array, "time *batch"], terminated_t: Bool[Array, "time *batch"],
    truncated_t: Bool[Array, "time *batch"], gamma: float, lambda_: float,
) -> tuple[Float[Array, "time *batch"], Float[Array, "time *batch"]]:  # fmt: skip
    """Generalised advantage estimation (Schulman et al. 2016, arXiv 1506.02438).

    ``delta_t = r_t + gamma (1 - terminated_t) V(s_{t+1}) - V(s_t)`` and
    ``A_t = delta_t + gamma lambda (1 - terminated_t) (1 - truncated_t) A_{t+1}``, zero after the last step. A truncated
    step bootstraps ``value_tp1``, the value of its final state, and no reward of the next episode reaches it.

    Returns:
        Advantages, and value targets ``A_t + V(s_t)``.
    """
    # Select, do not multiply by zero: a value that overflowed must not reach the episode before it.
    delta_t = reward_t + gamma * jnp.where(terminated_t, 0.0, value_tp1) - value_t

    def step(advantage_tp1: Array, step_t: tuple[Array, Array]) -> tuple[Array, Array]:
        delta, ends = step_t
        advantage = delta + jnp.where(ends, 0.0, gamma * lambda_ * advantage_tp1)
        return advantage, advantage

    steps_t = delta_t, terminated_t | truncated_t
    _, advantages = jax.lax.scan(step, jnp.zeros_like(delta_t[0]), steps_t, reverse=True)
    return advantages, advantages + value_t


def clipped_surrogate_loss(
    log_prob: Float[Array, "*batch"], old_log_prob: Float[Array, "*batch"], advantage: Float[Array, "*batch"],
    clip: float,
) -> Float[Array, "*batch"]:  # fmt: skip
    """Clipped surrogate objective of PPO as a loss (Schulman et al. 2017, arXiv 1707.06347, eq. 7).

    ``-min(rho A, clip(rho, 1 - eps, 1 + eps) A)`` with ``rho = exp(log_prob - old_log_prob)``.
    """
    ratio = jnp.exp(log_prob - old_log_prob)
    return -jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - clip, 1.0 + clip) * advantage)


class NStepReturns(NamedTuple):
    """Discounted sums of rewards, whether the episode terminated, numbers of steps, and ``gamma^(decisions)``."""

    reward: Float[Array, "*batch"]
    terminated: Bool[Array, "*batch"]
    steps: Int[Array, "*batch"]
    discount: Float[Array, "*batch"]


def n_step_returns(
    reward_t: Float[Array, "time *batch"], terminated_t: Bool[Array, "time *batch"],
    follows_t: Bool[Array, "time *batch"], gamma: float, hold: int = 1,
) -> NStepReturns:  # fmt: skip
    """Return ``sum_k gamma^k r_{t+k}`` over the steps before the first false ``follows_t`` (Sutton 1988).

    ``follows_t`` holds where step t belongs to the episode and its next state is stored. ``hold`` steps of time make
    one decision; their rewards share a discount. Later actions, which another policy may have chosen, get no off-policy
    correction.
    """
    taken_t = jnp.cumprod(follows_t, axis=0, dtype=jnp.int32)
    decision = np.arange(len(reward_t)) // hold
    # Discounts from the first decision to the state after the last one.
    power = jnp.asarray(gamma ** np.arange(decision[-1] + 2), jnp.float32)
    weight = power[decision].reshape(-1, *[1] * (reward_t.ndim - 1))
    steps = taken_t.sum(axis=0)
    return NStepReturns(
        jnp.sum(jnp.where(taken_t > 0, weight * reward_t, 0.0), axis=0),
        (terminated_t & (taken_t > 0)).any(axis=0),
        steps,
        power[(steps + hold - 1) // hold],
    )


def td_target(
    reward_t: Float[Array, "*batch"], value_tp1: Float[Array, "*batch"], terminated_t: Bool[Array, "*batch"],
    gamma: float | Float[Array, "*batch"],
) -> Float[Array, "*batch"]:  # fmt: skip
    """Return the target ``r_t + gamma (1 - terminated_t) V(s_{t+1})`` (Sutton 1988).

    A truncated step bootstraps the value of its final state. No gradient flows into the targets. With n-step returns,
    ``gamma`` is the discount of n steps.
    """
    # Select, for the reason in :func:`generalised_advantages`.
    return jax.lax.stop_gradient(reward_t + gamma * jnp.where(terminated_t, 0.0, value_tp1))


def soft_value(
    q: Float[Array, "critic *batch"], log_prob: Float[Array, "*batch"], temperature: Float[Array, ""]
) -> Float[Array, "*batch"]:
    """Soft state value ``min_i Q_i(s, a) - alpha log pi(a|s)`` of a sampled action (arXiv 1812.05905, eq. 3).

    The minimum over critics counters overestimation (clipped double Q, arXiv 1802.09477, eq. 10).
    """
    return jnp.min(q, axis=0) - temperature * log_prob


def soft_policy_loss(
    q: Float[Array, "critic *batch"], log_prob: Float[Array, "*batch"], temperature: Float[Array, ""]
) -> Float[Array, "*batch"]:
    """``alpha log pi(a|s) - min_i Q_i(s, a)`` per sample, reparameterised (arXiv 1812.05905, eq. 7 and 9).

    No gradient reaches the temperature.
    """
    return -soft_value(q, log_prob, jax.lax.stop_gradient(temperature))


def temperature_loss(
    log_temperature: Float[Array, ""], log_prob: Float[Array, "*batch"], target_entropy: float
) -> Float[Array, "*batch"]:
    """``-alpha (log pi(a|s) + H)`` per sample, with ``alpha = exp(log_temperature)`` (arXiv 1812.05905, eq. 18).

    The temperature falls while the policy's entropy ``-E log pi`` is above the target ``H``. No gradient reaches the
    policy.
    """
    return -jnp.exp(log_temperature) * jax.lax.stop_gradient(log_prob + target_entropy)


def polyak(target: Any, online: Any, tau: float) -> Any:
    """``(1 - tau) target + tau online``, leaf by leaf; tau 1 copies, tau 0 keeps (Polyak and Juditsky 1992)."""
    return jax.tree.map(lambda old, new: (1.0 - tau) * old + tau * new, target, online)


def log_mass(
    q: Float[Array, "action *batch"], log_density: Float[Array, "action *batch"], temperature: float = 1.0
) -> Float[Array, "*batch"]:
    """``tau log int exp(Q(s, a) / tau) da``, a soft maximum over all actions, from K sampled ones.

    By importance sampling: ``tau log 1/K sum_k exp(Q(s, a_k) / tau) / p(a_k)`` (Kumar et al. 2020, arXiv 2006.04779,
    appendix F). ``log_density`` is that of the distribution that each action was drawn from; zeros weigh all
    actions equally. A ``temperature`` near 0 gives the maximum.
    """
    return temperature * (jax.nn.logsumexp(q / temperature - log_density, axis=0) - jnp.log(len(q)))


def conservative_penalty(
    q: Float[Array, "action *batch"], log_density: Float[Array, "action *batch"],
    q_data: Float[Array, "*batch"], temperature: float = 1.0,
) -> Float[Array, "*batch"]:  # fmt: skip
    """``log_mass(Q(s, .)) - Q(s, a)`` with the logged action ``a``: the regulariser CQL(H) (arXiv 2006.04779, eq. 4).

    A tabular critic that minimises half its squared error from ``r + gamma V`` plus ``alpha`` times this penalty ends
    at ``r + gamma V - alpha (softmax(Q / tau) / pi_beta - 1)``, with ``pi_beta`` the policy of the data.
    """
    return log_mass(q, log_density, temperature) - q_data


def penalty_weight_loss(
    log_weight: Float[Array, ""], penalty: Float[Array, "*batch"], gap: float
) -> Float[Array, "*batch"]:
    """``-alpha (penalty - gap)`` with ``alpha = exp(log_weight)``: CQL's Lagrange multiplier.

    The weight rises while the penalty is above the gap (arXiv 2006.04779, eq. 30). No gradient reaches the critics.
    """
    return -jnp.exp(log_weight) * jax.lax.stop_gradient(penalty - gap)


def expectile_loss(error: Float[Array, "*batch"], expectile: float) -> Float[Array, "*batch"]:
    """``|tau - 1(u < 0)| u^2`` of ``u = target - value`` (Kostrikov et al. 2021, arXiv 2110.06169, eq. 5)."""
    return jnp.where(error < 0.0, 1.0 - expectile, expectile) * error**2


def advantage_weights(
    advantage: Float[Array, "*batch"], inverse_temperature: float, largest: float
) -> Float[Array, "*batch"]:
    """``min(exp(beta A), largest)`` without gradient: advantage-weighted regression (arXiv 2110.06169, eq. 7)."""
    # Clipping the exponent avoids overflow.
    exponent = jnp.minimum(inverse_temperature * advantage, jnp.log(largest))
    return jax.lax.stop_gradient(jnp.exp(exponent))


def scaled_policy_loss(loss: Float[Array, "*batch"], mean_q: Float[Array, ""]) -> Float[Array, "*batch"]:
    """``loss / mean |Q|``, given the mean over the batch (Fujimoto and Gu 2021, arXiv 2106.06860).

    A loss ``-Q`` becomes independent of the scale of rewards. No gradient reaches the divisor, which is at least 1e-6.
    """
    return loss / jnp.maximum(jax.lax.stop_gradient(mean_q), 1e-6)


def smoothed_action(
    action: Float[Array, "*batch D"], noise: Float[Array, "*batch D"], bound: float
) -> Float[Array, "*batch D"]:
    """``clip(a + clip(noise, -c, c), -1, 1)``: target policy smoothing (arXiv 1802.09477, eq. 14)."""
    return jnp.clip(action + jnp.clip(noise, -bound, bound), -1.0, 1.0)


@record
class Estimate:
    """An estimated return, and the least effective number of episodes (Kish) behind any of its steps."""

    value: Float[Array, ""]
    effective: Float[Array, ""]


def weighted_importance_sampling(
    reward: Float[Array, "N T"], ratio: Float[Array, "N T"], usable: Bool[Array, "N T"], gamma: float
) -> Estimate:
    """Return the mean discounted return by per-decision weighted importance sampling.

    Rewards of step t are averaged over episodes with weights proportional to the product of ratios up to t (Precup et
    al. 2000; Thomas and Brunskill 2016, arXiv 1604.00923, section 2).
    """
    weights, effective = _weights(ratio, usable)
    discount = gamma ** jnp.arange(reward.shape[1])
    return Estimate(jnp.sum(discount * weights * jnp.where(usable, reward, 0.0)), effective)


def doubly_robust(
    reward: Float[Array, "N T"], ratio: Float[Array, "N T"], usable: Bool[Array, "N T"],
    q: Float[Array, "N T"], value: Float[Array, "N T"], gamma: float,
) -> Estimate:  # fmt: skip
    """Return the mean discounted return by the weighted doubly robust estimator (arXiv 1604.00923, eq. 7).

    Args:
        reward: Rewards.
        ratio: Ratios of probabilities.
        usable: Mask of the steps.
        q: Estimated Q of the evaluated policy for the actions of the episodes.
        value: Estimated value of the states under the evaluated policy.
        gamma: Discount.
    """
    weights, effective = _weights(ratio, usable)
    previous = jnp.concatenate([jnp.full((len(reward), 1), 1.0 / len(reward)), weights[:, :-1]], axis=1)
    discount = gamma ** jnp.arange(reward.shape[1])
    terms = weights * (reward - q) + previous * value
    return Estimate(jnp.sum(discount * jnp.where(usable, terms, 0.0)), effective)


def _weights(
    ratio: Float[Array, "N T"], usable: Bool[Array, "N T"]
) -> tuple[Float[Array, "N T"], Float[Array, ""]]:
    """Return weights of episodes for each step, which sum to 1, and the least effective number of episodes."""
    logs = jnp.cumsum(jnp.where(usable, jnp.log(ratio), 0.0), axis=1)
    weights = jnp.exp(logs - logs.max(axis=0))
    weights = weights / weights.sum(axis=0)
    return weights, jnp.min(1.0 / jnp.sum(weights**2, axis=0))
