"""Encoder of a set: two dense layers with relu on each row, then the maximum over valid rows."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.kernels.library import call, in_use

#: Widths of both layers that are compiled.
_WIDTHS = (32, 64)

#: Kernel and bias of the first and of the second layer.
Weights = tuple[Array, Array, Array, Array]


def supports(layers: Sequence[tuple[Array, Array]], activation: str) -> bool:
    """Whether the native kernel is in use and has these layers: two of the same width, with relu."""
    widths = {bias.shape[0] for _, bias in layers}
    return activation == "relu" and len(layers) == 2 and len(widths) == 1 and widths <= set(_WIDTHS) and in_use()


def encode(
    weights: Weights, rows: Float[Array, "*batch row inputs"], valid: Bool[Array, "*batch row"]
) -> tuple[Float[Array, "*batch width"], Int[Array, "*batch width"]]:
    """Return the maximum of zero and the valid rows after the layers, and the row of each maximum; -1 for zeros."""
    width = weights[1].shape[0]
    results = [jax.ShapeDtypeStruct((width,), dtype) for dtype in (jnp.float32, jnp.int32)]
    output, winner = call("encode_sets", results, weights, (rows, valid), valid.ndim - 1)
    return output, winner


def differentiate(
    weights: Weights, rows: Float[Array, "*batch row inputs"], winner: Int[Array, "*batch width"],
    gradient: Float[Array, "*batch width"],
) -> Weights:  # fmt: skip
    """Return the gradient of the weights, summed over the batch; the first of equal rows takes all of it."""
    results = [jax.ShapeDtypeStruct(weight.shape, jnp.float32) for weight in weights]
    return tuple(call("differentiate_sets", results, (*weights, rows, winner, gradient)))
