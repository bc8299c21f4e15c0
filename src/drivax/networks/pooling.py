"""Maximum over a set of embedded rows, with a cheap backward pass.

The gradient of a maximum concerns one row per output. Plain differentiation takes the gradients of all rows, mostly
zeros, through all layers; here only the maximal rows are embedded again, where that is less work. Ties: the first row.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Activation = Literal["relu", "tanh", "gelu", "silu"]
ACTIVATIONS = {"relu": jax.nn.relu, "tanh": jnp.tanh, "gelu": jax.nn.gelu, "silu": jax.nn.silu}
#: Kernel and bias of each layer.
Layers = Sequence[tuple[Float[Array, "_ _"], Float[Array, " _"]]]


def dense(
    activation: Activation, layers: Layers, x: Float[Array, "*batch inputs"]
) -> Float[Array, "*batch outputs"]:
    """Apply dense layers with an activation after each."""
    for kernel, bias in layers:
        x = ACTIVATIONS[activation](x @ kernel + bias)
    return x


def largest(
    activation: Activation,
    layers: Layers,
    rows: Float[Array, "*batch row inputs"],
    there: Bool[Array, "*batch row"],
) -> Float[Array, "*batch outputs"]:
    """Return the maximum of zero and the valid rows after the layers."""
    if only_winners(rows.shape[-2], [rows.shape[-1], *(bias.shape[0] for _, bias in layers)]):
        return _of_layers(activation, tuple(layers), rows, there)
    return _of_rows(dense(activation, layers, rows), there)


def only_winners(rows: int, sizes: Sequence[int]) -> bool:
    """Whether it is less work to differentiate the maximal rows only, one per output.

    A backward pass takes two products per layer and row. A maximal row is embedded again, which makes three, with one
    output of the last layer.

    Args:
        rows: Number of rows.
        sizes: Width of a row and of each layer.
    """
    products = [inputs * outputs for inputs, outputs in pairwise(sizes)]
    return 3 * sizes[-1] * (sum(products[:-1]) + sizes[-2]) < 2 * rows * sum(products)


@jax.custom_vjp
def _of_rows(
    embedded: Float[Array, "*batch row outputs"], there: Bool[Array, "*batch row"]
) -> Float[Array, "*batch outputs"]:
    return jnp.max(embedded, axis=-2, initial=0.0, where=there[..., None])


def _of_rows_forward(embedded: Array, there: Array) -> tuple[Array, tuple[Array, Array, int]]:
    largest, winner, counts = _winners(embedded, there)
    return largest, (winner, counts, embedded.shape[-2])


def _of_rows_backward(kept: tuple[Array, Array, int], gradient: Array) -> tuple[Array, None]:
    winner, counts, rows = kept
    won = jnp.arange(rows)[:, None] == winner[..., None, :]
    return jnp.where(won, jnp.where(counts, gradient, 0.0)[..., None, :], 0.0), None


_of_rows.defvjp(_of_rows_forward, _of_rows_backward)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _of_layers(
    activation: Activation,
    layers: Layers,
    rows: Float[Array, "*batch row inputs"],
    there: Bool[Array, "*batch row"],
) -> Float[Array, "*batch outputs"]:
    return jnp.max(dense(activation, layers, rows), axis=-2, initial=0.0, where=there[..., None])


def _of_layers_forward(
    activation: Activation, layers: Layers, rows: Array, there: Array
) -> tuple[Array, Any]:
    largest, winner, counts = _winners(dense(activation, layers, rows), there)
    return largest, (layers, rows, winner, counts)


def _of_layers_backward(activation: Activation, kept: Any, gradient: Array) -> tuple[Any, Array, None]:
    layers, rows, winner, counts = kept

    def again(layers: Layers, rows: Array) -> Array:
        """Return each output from the row that attains it."""
        won = dense(activation, layers[:-1], jnp.take_along_axis(rows, winner[..., None], axis=-2))
        kernel, bias = layers[-1]
        return ACTIVATIONS[activation](jnp.sum(won * kernel.T, axis=-1) + bias)

    _, pull = jax.vjp(again, layers, rows)
    return *pull(jnp.where(counts, gradient, 0.0)), None


_of_layers.defvjp(_of_layers_forward, _of_layers_backward)


def _winners(embedded: Array, there: Array) -> tuple[Array, Array, Array]:
    """Return the maximum, its row, and whether it is above zero, so that it has a gradient."""
    # Invalid rows are never above zero.
    candidates = jnp.where(there[..., None], embedded, 0.0)
    maximum = jnp.max(candidates, axis=-2)
    return jnp.maximum(maximum, 0.0), jnp.argmax(candidates, axis=-2), maximum > 0.0
