"""Encoder of a set: two dense layers with relu on each row, then the maximum over valid rows."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.kernels.library import call, in_use

#: Widths of both layers that are compiled.
_WIDTHS = (32, 64)

#: Kernel and bias of both layers.
Layers = Sequence[tuple[Float[Array, "_ _"], Float[Array, " _"]]]


def supports(layers: Layers, activation: str) -> bool:
    """Whether the native kernel is in use and has these layers: two of the same width, with relu."""
    widths = {bias.shape[0] for _, bias in layers}
    is_compiled = len(layers) == 2 and len(widths) == 1 and widths <= set(_WIDTHS)
    return is_compiled and activation == "relu" and in_use()


def encode(
    layers: Layers, rows: Float[Array, "*batch row inputs"], valid: Bool[Array, "*batch row"]
) -> tuple[Float[Array, "*batch width"], Int[Array, "*batch width"]]:
    """Return the maximum of zero and the valid rows after the layers, and the row of each maximum; -1 for zeros."""
    width = layers[1][1].shape
    results = [jax.ShapeDtypeStruct(width, dtype) for dtype in (jnp.float32, jnp.int32)]
    output, winner = call("encode_sets", results, _flat(layers), (rows, valid), valid.ndim - 1)
    return output, winner


def differentiate(
    layers: Layers, rows: Float[Array, "*batch row inputs"], winner: Int[Array, "*batch width"],
    gradient: Float[Array, "*batch width"],
) -> Layers:  # fmt: skip
    """Return the gradient of the layers, summed over the batch; the first of equal rows takes all of it."""
    weights = _flat(layers)
    results = [jax.ShapeDtypeStruct(weight.shape, jnp.float32) for weight in weights]
    batched, axes = (rows, winner, gradient), winner.ndim - 1
    kernel1, bias1, kernel2, bias2 = call("differentiate_sets", results, weights, batched, axes, sums=True)
    return (kernel1, bias1), (kernel2, bias2)


def _flat(layers: Layers) -> list[Array]:
    return [weight for layer in layers for weight in layer]
