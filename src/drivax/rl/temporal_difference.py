"""Temporal-difference targets, and the losses of soft actor-critic. ``_t`` and ``_tp1`` mark steps t and t + 1."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def td_target(
    reward_t: Float[Array, "*batch"],
    value_tp1: Float[Array, "*batch"],
    terminated_t: Bool[Array, "*batch"],
    gamma: float,
) -> Float[Array, "*batch"]:
    """One-step target ``r_t + gamma (1 - terminated_t) V(s_{t+1})`` (Sutton 1988).

    A terminated step is worth its reward alone. A truncated one is no special case: it bootstraps the value of the
    final state that it led to.

    Args:
        reward_t: Rewards.
        value_tp1: Values of the states after each step.
        terminated_t: Episode ended for good.
        gamma: Discount.

    Returns:
        Targets; no gradient flows into them.
    """
    # Chosen, not multiplied by zero: a value that overflowed must not reach a step that does not look at it.
    return jax.lax.stop_gradient(reward_t + gamma * jnp.where(terminated_t, 0.0, value_tp1))


def soft_value(
    q: Float[Array, "critic *batch"], log_prob: Float[Array, "*batch"], temperature: Float[Array, ""]
) -> Float[Array, "*batch"]:
    """``min_i Q_i(s, a) - alpha log pi(a|s)`` of an action that the policy sampled.

    The soft state value (Haarnoja et al. 2018, arXiv 1812.05905, eq. 3) with the minimum over critics against
    overestimation (clipped double Q, Fujimoto et al. 2018, arXiv 1802.09477, eq. 10).
    """
    return jnp.min(q, axis=0) - temperature * log_prob


def soft_policy_loss(
    q: Float[Array, "critic *batch"], log_prob: Float[Array, "*batch"], temperature: Float[Array, ""]
) -> Float[Array, "*batch"]:
    """``alpha log pi(a|s) - min_i Q_i(s, a)`` per sample, reparameterised (arXiv 1812.05905, eq. 7 and 9).

    The temperature is a number here: no gradient reaches it.
    """
    return -soft_value(q, log_prob, jax.lax.stop_gradient(temperature))


def temperature_loss(
    log_temperature: Float[Array, ""], log_prob: Float[Array, "*batch"], target_entropy: float
) -> Float[Array, "*batch"]:
    """``-alpha (log pi(a|s) + H)`` per sample, with ``alpha = exp(log_temperature)`` (arXiv 1812.05905, eq. 18).

    Its gradient lowers the temperature where the policy's entropy ``-E log pi`` is above the target ``H``, and raises
    it where it is below; nothing reaches the policy.
    """
    return -jnp.exp(log_temperature) * jax.lax.stop_gradient(log_prob + target_entropy)


def polyak(target: Any, online: Any, tau: float) -> Any:
    """``(1 - tau) target + tau online``, leaf by leaf; tau 1 copies, tau 0 keeps (Polyak and Juditsky 1992)."""
    return jax.tree.map(lambda old, new: (1.0 - tau) * old + tau * new, target, online)
