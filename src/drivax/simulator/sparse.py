"""Computing something for the few of a batch that need it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

#: How many are computed together: more than begin in most steps, and enough to fill vectors.
AT_ONCE = 8


def map_where(requested: Bool[Array, " B"], function: Callable[..., Any], *arguments: Any) -> Any:
    """``jax.vmap(function)`` where ``requested``, zeros elsewhere; the cost follows how many are requested.

    They are computed 8 at a time, as often as it takes, in a loop that cannot be differentiated in reverse.

    Args:
        requested: Which rows of the batch are needed.
        function: Of one row each of the arguments; gives a pytree of arrays.
        arguments: Pytrees of arrays ``[B, ...]``.
    """
    count, every = requested.shape[0], jax.vmap(function)
    few = min(AT_ONCE, count)
    one = jax.eval_shape(function, *jax.tree.map(lambda leaf: leaf[0], arguments))
    nothing = jax.tree.map(lambda leaf: jnp.zeros((count, *leaf.shape), leaf.dtype), one)
    # The first requested row ranks highest; top_k of floats is the cheapest way to find a few of them.
    rank = jnp.arange(count, 0, -1).astype(jnp.float32)

    def more(carry: tuple[Array, Any]) -> Array:
        return carry[0].any()

    def some(carry: tuple[Array, Any]) -> tuple[Array, Any]:
        left, found = carry
        found_rank, place = jax.lax.top_k(jnp.where(left, rank, 0.0), few)
        place = jnp.where(found_rank > 0.0, place, count)
        rows = every(*jax.tree.map(lambda leaf: leaf.at[place].get(mode="clip"), arguments))
        found = jax.tree.map(lambda all_, row: all_.at[place].set(row, mode="drop"), found, rows)
        return left.at[place].set(False, mode="drop"), found

    return jax.lax.while_loop(more, some, (requested, nothing))[1]
