"""Losses of offline reinforcement learning: conservative penalties, expectiles, and weighted imitation."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def log_mass(
    q: Float[Array, "action *batch"], log_density: Float[Array, "action *batch"], temperature: float = 1.0
) -> Float[Array, "*batch"]:
    """``tau log int exp(Q(s, a) / tau) da``, a soft maximum over all actions, from K sampled ones.

    By importance sampling: ``tau log 1/K sum_k exp(Q(s, a_k) / tau) / p(a_k)`` (Kumar et al. 2020, arXiv 2006.04779,
    appendix F). ``log_density`` is that of the distribution that each action was drawn from, so actions of several
    distributions can be mixed; zeros give the mean of ``exp(Q / tau)``. A ``temperature`` near 0 gives the maximum.
    """
    scaled = jax.nn.logsumexp(q / temperature - log_density, axis=0) - jnp.log(len(q))
    return temperature * scaled


def conservative_penalty(
    q: Float[Array, "action *batch"],
    log_density: Float[Array, "action *batch"],
    q_data: Float[Array, "*batch"],
    temperature: float = 1.0,
) -> Float[Array, "*batch"]:
    """``log_mass(Q(s, .)) - Q(s, a)`` with the action ``a`` of the data: the regulariser CQL(H).

    Kumar et al. 2020, arXiv 2006.04779, eq. 4. Its gradient lowers high Q values and raises those of logged actions. A
    tabular critic that also minimises half the squared error of ``r + gamma V`` ends at
    ``r + gamma V - alpha (softmax(Q) / pi_beta - 1)``, with ``pi_beta`` the policy of the data.
    """
    return log_mass(q, log_density, temperature) - q_data


def penalty_weight_loss(
    log_weight: Float[Array, ""], penalty: Float[Array, "*batch"], gap: float
) -> Float[Array, "*batch"]:
    """``-alpha (penalty - gap)`` with ``alpha = exp(log_weight)``: CQL's Lagrange multiplier (eq. 30).

    Its gradient raises the weight where the penalty is above the gap and lowers it where it is below. No gradient
    reaches the critics.
    """
    return -jnp.exp(log_weight) * jax.lax.stop_gradient(penalty - gap)


def expectile_loss(error: Float[Array, "*batch"], expectile: float) -> Float[Array, "*batch"]:
    """``|tau - 1(u < 0)| u^2`` of ``u = target - value`` (Kostrikov et al. 2021, arXiv 2110.06169, eq. 5).

    The minimising value is the mean of the targets at ``tau`` 0.5 and approaches their maximum as ``tau`` goes to 1.
    """
    return jnp.where(error < 0.0, 1.0 - expectile, expectile) * error**2


def advantage_weights(
    advantage: Float[Array, "*batch"], inverse_temperature: float, largest: float
) -> Float[Array, "*batch"]:
    """``min(exp(beta A), largest)``, weights of advantage-weighted regression; no gradient flows into them.

    Peng et al. 2019, arXiv 1910.00177, eq. 7, as IQL uses it (arXiv 2110.06169, eq. 7).
    """
    # Clipping the exponent avoids overflow.
    exponent = jnp.minimum(inverse_temperature * advantage, jnp.log(largest))
    return jax.lax.stop_gradient(jnp.exp(exponent))


def scaled_policy_loss(loss: Float[Array, "*batch"], q: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """``loss / mean |Q|`` over the batch: a policy loss that does not depend on the scale of rewards.

    TD3+BC (Fujimoto and Gu 2021, arXiv 2106.06860, eq. 5) uses it with ``-Q`` next to a squared error. No gradient
    reaches the divisor.
    """
    return loss / jnp.maximum(jax.lax.stop_gradient(jnp.mean(jnp.abs(q))), 1e-6)


def smoothed_action(
    action: Float[Array, "*batch D"], noise: Float[Array, "*batch D"], bound: float
) -> Float[Array, "*batch D"]:
    """``clip(a + clip(noise, -c, c), -1, 1)``: target policy smoothing.

    Fujimoto et al. 2018, arXiv 1802.09477, eq. 14.
    """
    return jnp.clip(action + jnp.clip(noise, -bound, bound), -1.0, 1.0)
