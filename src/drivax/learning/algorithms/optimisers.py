"""Adam with gradient clipping and a linear learning-rate schedule, for all algorithms."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax

from drivax.errors import UsageError


def clipped_adam(
    rate: float, norm: float | None, *, updates: int = 0, last: float = 0.1, eps: float = 1e-8,
    per_network: bool = False,
) -> optax.GradientTransformation:  # fmt: skip
    """Return Adam (Kingma and Ba 2015) with gradient clipping.

    Args:
        rate: Initial learning rate.
        norm: Maximum global norm of gradients; None: no clipping.
        updates: Updates over which the rate decays linearly; it is constant afterwards. 0: always constant.
        last: Final rate relative to ``rate``.
        eps: Epsilon of Adam.
        per_network: Clip each network by its own norm, for networks that share nothing: the value's gradient is often a
            hundred times the policy's, and a joint norm would shrink the policy's steps.
    """
    schedule = optax.linear_schedule(rate, last * rate, updates) if updates else rate
    adam = optax.adam(schedule, eps=eps)
    if norm is None:
        return optax.chain(optax.identity(), adam)
    return optax.chain(clip_per_network(norm) if per_network else optax.clip_by_global_norm(norm), adam)


def clip_per_network(norm: float) -> optax.GradientTransformation:
    """Clip each network (the first level of the tree) by its own global norm."""

    def clip(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        paths, structure = jax.tree_util.tree_flatten_with_path(updates)
        squares: dict[Any, Any] = {}
        for path, leaf in paths:
            squares[path[0]] = squares.get(path[0], 0.0) + jnp.sum(leaf * leaf)
        # The factor is 1 within the norm, and for a zero gradient.
        scale = {name: norm / jnp.maximum(jnp.sqrt(square), norm) for name, square in squares.items()}
        return jax.tree.unflatten(structure, [leaf * scale[path[0]] for path, leaf in paths]), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), clip)


def check_decay_share(share: float) -> None:
    """Raise UsageError if the share of a run over which a rate decays is outside (0, 1]."""
    if not 0.0 < share <= 1.0:
        raise UsageError(f"falling is {share}", cure="use more than 0 and at most 1")
