"""Policy-gradient losses per sample; callers average."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def clipped_surrogate_loss(
    log_prob: Float[Array, "*batch"],
    old_log_prob: Float[Array, "*batch"],
    advantage: Float[Array, "*batch"],
    clip: float,
) -> Float[Array, "*batch"]:
    """PPO's clipped objective as a loss (Schulman et al. 2017, arXiv 1707.06347, eq. 7).

    ``-min(rho A, clip(rho, 1 - eps, 1 + eps) A)`` with ``rho = exp(log_prob - old_log_prob)``.
    """
    ratio = jnp.exp(log_prob - old_log_prob)
    return -jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - clip, 1.0 + clip) * advantage)
