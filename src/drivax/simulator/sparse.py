"""Evaluate a function for the few elements of a batch that need it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

#: Elements computed together: more than start in most steps, and enough to fill vectors.
AT_ONCE = 8


def map_where(requested: Bool[Array, " B"], function: Callable[..., Any], *arguments: Any) -> Any:
    """``jax.vmap(function)`` where ``requested``, zeros elsewhere; cost grows with the number requested.

    ``function`` maps one element of each argument (pytrees of arrays ``[B, ...]``) to a pytree of arrays. A loop
    computes 8 elements at a time; it has no reverse-mode derivative.
    """
    count, batched = requested.shape[0], jax.vmap(function)
    chunk = min(AT_ONCE, count)
    element = jax.eval_shape(function, *jax.tree.map(lambda leaf: leaf[0], arguments))
    zeros = jax.tree.map(lambda leaf: jnp.zeros((count, *leaf.shape), leaf.dtype), element)
    # The first requested element ranks highest; top_k of floats is the cheapest way to find a few of them.
    rank = jnp.arange(count, 0, -1).astype(jnp.float32)

    def compute(carry: tuple[Array, Any]) -> tuple[Array, Any]:
        left, results = carry
        top_rank, index = jax.lax.top_k(jnp.where(left, rank, 0.0), chunk)
        index = jnp.where(top_rank > 0.0, index, count)
        values = batched(*jax.tree.map(lambda leaf: leaf.at[index].get(mode="clip"), arguments))
        results = jax.tree.map(lambda total, value: total.at[index].set(value, mode="drop"), results, values)
        return left.at[index].set(False, mode="drop"), results

    return jax.lax.while_loop(lambda carry: carry[0].any(), compute, (requested, zeros))[1]
