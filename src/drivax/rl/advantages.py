"""Advantages and returns. Time is the leading axis; ``_t`` and ``_tp1`` mark steps t and t + 1."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def generalised_advantages(
    reward_t: Float[Array, "time *batch"],
    value_t: Float[Array, "time *batch"],
    value_tp1: Float[Array, "time *batch"],
    terminated_t: Bool[Array, "time *batch"],
    truncated_t: Bool[Array, "time *batch"],
    gamma: float,
    lambda_: float,
) -> tuple[Float[Array, "time *batch"], Float[Array, "time *batch"]]:
    """Generalised advantage estimation (Schulman et al. 2016, arXiv 1506.02438).

    ``delta_t = r_t + gamma (1 - terminated_t) V(s_{t+1}) - V(s_t)`` and
    ``A_t = delta_t + gamma lambda (1 - terminated_t) (1 - truncated_t) A_{t+1}``, zero beyond the end. A truncated
    step bootstraps the value of the state it led to, and nothing of the next episode reaches it.

    Args:
        reward_t: Rewards.
        value_t: Values of the states before each step.
        value_tp1: Values of the states after each step (of the final state where an episode ended).
        terminated_t: Episode ended for good.
        truncated_t: Episode was cut off.
        gamma: Discount.
        lambda_: 0 gives one-step TD errors, 1 Monte Carlo returns.

    Returns:
        Advantages, and value targets ``A_t + V(s_t)``.
    """
    alive = 1.0 - terminated_t.astype(jnp.float32)
    delta_t = reward_t + gamma * alive * value_tp1 - value_t
    carry_on = gamma * lambda_ * alive * (1.0 - truncated_t.astype(jnp.float32))

    def back(advantage_tp1: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        delta, keep = now
        advantage = delta + keep * advantage_tp1
        return advantage, advantage

    _, advantages = jax.lax.scan(back, jnp.zeros_like(delta_t[0]), (delta_t, carry_on), reverse=True)
    return advantages, advantages + value_t
