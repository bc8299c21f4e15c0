"""Estimators of a policy's return from episodes of other policies.

Episodes have T steps; steps that are not ``usable`` (after the end) have no reward, and their ratio counts as 1.
``ratio`` is the probability of the action under the evaluated policy over that under the behaviour policy.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.scenario.record import record


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
