"""The optimisers of all algorithms: Adam after clipping, with a learning rate that may fall."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax

from drivax.errors import UsageError


def clipped_adam(
    rate: float,
    norm: float | None,
    *,
    updates: int = 0,
    last: float = 0.1,
    eps: float = 1e-8,
    apart: bool = False,
) -> optax.GradientTransformation:
    """Adam (Kingma and Ba 2015) of clipped gradients.

    Args:
        rate: The learning rate, of the first update.
        norm: Gradients are scaled down to this global norm; None: they are taken as they are.
        updates: Updates over which the rate falls linearly to ``last`` times the first, and then stays; 0: it stays.
        last: See ``updates``.
        eps: Of Adam.
        apart: Whether each part of the parameters (the first level of their tree) is clipped by its own norm. Networks
            that share nothing should be: the value's error is often a hundred times the policy's, and one norm for
            both would shrink the policy's steps with it.
    """
    schedule = optax.linear_schedule(rate, last * rate, updates) if updates else rate
    adam = optax.adam(schedule, eps=eps)
    if norm is None:
        return optax.chain(optax.identity(), adam)
    return optax.chain(clip_apart(norm) if apart else optax.clip_by_global_norm(norm), adam)


def check_falling(share: float) -> None:
    """Refuses what is no share of a run.

    Raises:
        UsageError: It is none.
    """
    if not 0.0 < share <= 1.0:
        raise UsageError(f"falling is {share}", cure="use more than 0, and 1 at most")


def clip_apart(norm: float) -> optax.GradientTransformation:
    """Scales each part of a tree (its first level) down to a global norm of its own."""

    def clip(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        paths, structure = jax.tree_util.tree_flatten_with_path(updates)
        squares: dict[Any, Any] = {}
        for path, leaf in paths:
            squares[path[0]] = squares.get(path[0], 0.0) + jnp.sum(leaf * leaf)
        # Within the norm the factor is 1; a part without gradient divides by nothing.
        scale = {part: norm / jnp.maximum(jnp.sqrt(square), norm) for part, square in squares.items()}
        return jax.tree.unflatten(structure, [leaf * scale[path[0]] for path, leaf in paths]), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), clip)
