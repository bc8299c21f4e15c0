"""Encoders: from named groups with masks to one vector; dense layers, maximum over rows, and normalisation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from flax import nnx
from jax.custom_derivatives import CustomVJPPrimal
from jaxtyping import Array, Bool, Float, Int

from drivax.errors import UsageError
from drivax.kernels import bindings

Groups = Mapping[str, Array]
#: Shapes of one observation, by group.
GroupSpec = Mapping[str, tuple[int, ...]]
#: Mean and standard deviation of each feature, by group.
Statistics = Mapping[str, tuple[Float[Array, " F"], Float[Array, " F"]]]
#: Kernel and bias of each layer.
Layers = Sequence[tuple[Float[Array, "_ _"], Float[Array, " _"]]]

Activation = Literal["relu", "tanh", "gelu", "silu"]
ACTIVATIONS = {"relu": jax.nn.relu, "tanh": jnp.tanh, "gelu": jax.nn.gelu, "silu": jax.nn.silu}
#: Non-decreasing activations: they commute with a maximum.
_MONOTONE = ("relu", "tanh")

#: Largest width of a layer, and largest number of layers.
MOST_WIDTH, MOST_LAYERS = 4096, 32

#: Lower bound of deviations: a nearly constant feature is not amplified.
_MIN_DEVIATION = 1e-3
#: Normalised features are clipped at this many deviations.
_MAX_DEVIATIONS = 10.0


@runtime_checkable
class Encoder(Protocol):
    """An ``nnx.Module`` whose state consists of ``nnx.Param`` only."""

    @property
    def width(self) -> int:
        """Size of the embedding."""
        ...

    def __call__(self, groups: Groups) -> Float[Array, "*batch width"]:
        """Return the embedding of an observation or a batch; masked rows have no effect."""
        ...


@runtime_checkable
class EncoderConfig(Protocol):
    """Settings of an encoder; your own are frozen dataclasses, named in YAML as ``package.module:Name``."""

    def build(self, spec: GroupSpec, rngs: nnx.Rngs) -> Encoder:
        """Return an encoder of observations with these groups."""
        ...


@dataclass(frozen=True)
class MlpConfig:
    """Dense layers over all groups, concatenated.

    Attributes:
        rows: Layers shared by the rows of each masked group, before a maximum over rows; empty: rows are flattened.
        flat: Masked groups whose rows are always flattened, because their order matters, such as route points; missing
            names are ignored.
        hidden: Width of each following layer; the last is the size of the embedding. Empty: no layers.
        activation: Activation after each layer.
    """

    kind: Literal["mlp"] = "mlp"
    rows: tuple[int, ...] = ()
    flat: tuple[str, ...] = ()
    hidden: tuple[int, ...] = (256, 256)
    activation: Activation = "relu"

    def __post_init__(self) -> None:
        check_widths("rows", self.rows)
        check_widths("hidden", self.hidden)

    def build(self, spec: GroupSpec, rngs: nnx.Rngs) -> MlpEncoder:
        """Return the encoder with fresh parameters."""
        return MlpEncoder(self, spec, rngs)


class MlpEncoder(nnx.Module):
    """Flatten or pool each group, then apply dense layers."""

    def __init__(self, config: MlpConfig, spec: GroupSpec, rngs: nnx.Rngs) -> None:
        self.names = group_names(spec)
        self.pooled = tuple(
            name for name in self.names if config.rows and f"{name}_mask" in spec and name not in config.flat
        )
        self.shapes = {name: tuple(spec[name]) for name in self.names}
        self.activation: Activation = config.activation
        width, shared = 0, {}
        for name in self.names:
            mask_shape = spec.get(f"{name}_mask")
            if name in self.pooled and mask_shape is not None:
                # A row is what the mask's first axis counts; its times are concatenated with their masks.
                row_width = math.prod(spec[name][1:]) + math.prod(mask_shape[1:])
                shared[name] = dense_layers(row_width, config.rows, rngs)
                width += config.rows[-1]
            else:
                width += math.prod(spec[name]) + (0 if mask_shape is None else math.prod(mask_shape))
        self.shared = nnx.Dict(shared)
        self.layers = dense_layers(width, config.hidden, rngs)
        self.width = config.hidden[-1] if config.hidden else width

    def __call__(self, groups: Groups) -> Float[Array, "*batch width"]:
        """Return the embedding of an observation or a batch."""
        x = jnp.concatenate([self._group(name, groups) for name in self.names], axis=-1)
        return dense(self.activation, _weights(self.layers), x)

    def _group(self, name: str, groups: Groups) -> Float[Array, "*batch features"]:
        """Return a group as one vector: its rows pooled, or its features and masks flattened."""
        value, mask = groups[name].astype(jnp.float32), groups.get(f"{name}_mask")
        lead = value.shape[: value.ndim - len(self.shapes[name])]
        if mask is None:
            return value.reshape(*lead, -1)
        value = jnp.where(mask[..., None], value, 0.0)
        is_pooled = name in self.pooled
        axes = (*lead, self.shapes[name][0], -1) if is_pooled else (*lead, -1)
        mask = mask.reshape(axes)
        features = jnp.concatenate([value.reshape(axes), mask.astype(jnp.float32)], axis=-1)
        if not is_pooled:
            return features
        # A row is valid if any of its times is; without valid rows the embedding is zero.
        return max_pool(self.activation, _weights(self.shared[name]), features, mask.any(axis=-1))


def check_widths(name: str, widths: tuple[int, ...]) -> None:
    """Raise UsageError if a layer of the setting ``name`` has no outputs or too many, or if it has too many layers."""
    if min(widths, default=1) < 1:
        raise UsageError(f"{name} has a layer of width {min(widths)}", cure="use 1 or more")
    if max(widths, default=1) > MOST_WIDTH:
        raise UsageError(f"{name} has a layer of width {max(widths)}", cure=f"use {MOST_WIDTH:,} or less")
    if len(widths) > MOST_LAYERS:
        raise UsageError(f"{name} has {len(widths)} layers", cure=f"use {MOST_LAYERS} or less")


def dense_layers(width: int, sizes: tuple[int, ...], rngs: nnx.Rngs) -> Any:
    """Return dense layers of these sizes on ``width`` inputs, with orthogonal weights of gain sqrt(2), as for relu."""
    initializer = nnx.initializers.orthogonal(2**0.5)
    pairs = pairwise((width, *sizes))
    return nnx.List([nnx.Linear(*pair, kernel_init=initializer, rngs=rngs) for pair in pairs])


def _weights(layers: Any) -> Layers:
    return tuple((layer.kernel[...], layer.bias[...]) for layer in layers)


def group_names(spec: GroupSpec) -> tuple[str, ...]:
    """Return the non-empty groups that are not masks, in alphabetical order.

    Raises:
        UsageError: All groups are empty.
    """
    groups = (n for n in spec if not (n.endswith("_mask") and n.removesuffix("_mask") in spec))
    names = tuple(sorted(name for name in groups if math.prod(spec[name])))
    if not names:
        raise UsageError("nothing to encode: all groups are empty", cure="observe at least one row")
    return names


def dense(
    activation: Activation, layers: Layers, x: Float[Array, "*batch inputs"]
) -> Float[Array, "*batch outputs"]:
    """Apply dense layers with an activation after each."""
    for kernel, bias in layers:
        x = ACTIVATIONS[activation](x @ kernel + bias)
    return x


def max_pool(
    activation: Activation, layers: Layers, rows: Float[Array, "*batch row inputs"],
    valid: Bool[Array, "*batch row"],
) -> Float[Array, "*batch outputs"]:  # fmt: skip
    """Return the maximum of zero and the valid rows after the layers.

    Equal rows share the gradient; in the native kernel the first of them takes all of it.
    """
    if activation not in _MONOTONE:
        return jnp.max(dense(activation, layers, rows), axis=-2, initial=0.0, where=valid[..., None])
    lead, (count, width) = rows.shape[:-2], rows.shape[-2:]
    maximum: Array = _dense_and_max(
        activation, tuple(layers), rows.reshape(-1, count, width), valid.reshape(-1, count)
    )
    return maximum.reshape(*lead, -1)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _dense_and_max(
    activation: Activation, layers: Layers, rows: Float[Array, "B row inputs"], valid: Bool[Array, "B row"]
) -> Float[Array, "B outputs"]:
    if bindings.supports_layers(layers, activation):
        return bindings.encode_sets(layers, rows, valid)[0]
    return _dense_and_max_forward(activation, layers, rows, valid)[0]


def _save_dense_and_max(
    activation: Activation, layers: Any, rows: CustomVJPPrimal, valid: CustomVJPPrimal
) -> tuple[Array, Any]:
    """Return the output and the residuals of either implementation; the native one has no gradient of rows."""
    layers = tuple((kernel.value, bias.value) for kernel, bias in layers)
    if bindings.supports_layers(layers, activation) and not rows.perturbed:
        output, winner = bindings.encode_sets(layers, rows.value, valid.value)
        return output, _NativeResiduals(layers, rows.value, winner)
    return _dense_and_max_forward(activation, layers, rows.value, valid.value)


class _NativeResiduals(NamedTuple):
    layers: Layers
    rows: Float[Array, "B row inputs"]
    winner: Int[Array, "B outputs"]


def _dense_and_max_forward(
    activation: Activation, layers: Layers, rows: Array, valid: Array
) -> tuple[Array, Any]:
    """Return the output and the residuals of the backward pass.

    The last bias is added and the last activation applied after the maximum, with the same result since it is monotone.
    """
    inputs: list[Array] = [rows.reshape(-1, rows.shape[-1])]
    activate, hidden_vjps = partial(jax.vjp, ACTIVATIONS[activation]), []
    for kernel, bias in layers[:-1]:
        output, vjp = activate(inputs[-1] @ kernel + bias)
        inputs.append(output)
        hidden_vjps.append(vjp)
    kernel, bias = layers[-1]
    products: Array = (inputs[-1] @ kernel).reshape(*valid.shape, -1)
    largest = jnp.max(jnp.where(valid[..., None], products, -jnp.inf), axis=1)
    output, vjp = activate(largest + bias)
    residuals = layers, valid, inputs, hidden_vjps, products, largest, output > 0.0, vjp
    return jnp.maximum(output, 0.0), residuals


def _dense_and_max_backward(
    activation: Activation, residuals: Any, gradient: Array
) -> tuple[Any, Array | None, None]:
    """Differentiate all rows as one matrix: on CPUs, XLA multiplies zeros faster than it gathers and scatters."""
    if isinstance(residuals, _NativeResiduals):
        return bindings.differentiate_sets(*residuals, gradient), None, None
    layers, valid, inputs, hidden_vjps, products, largest, is_positive, vjp = residuals
    (gradient,) = vjp(jnp.where(is_positive, gradient, 0.0))
    is_largest = (products == largest[:, None]) & valid[..., None]
    share = gradient / jnp.maximum(jnp.sum(is_largest, axis=1, dtype=jnp.float32), 1.0)
    by_row = jnp.where(is_largest, share[:, None], 0.0).reshape(-1, share.shape[-1])
    gradients = [(inputs[-1].T @ by_row, gradient.sum(axis=0))]
    for number in reversed(range(len(hidden_vjps))):
        (by_row,) = hidden_vjps[number](by_row @ layers[number + 1][0].T)
        gradients.append((inputs[number].T @ by_row, by_row.sum(axis=0)))
    return tuple(reversed(gradients)), (by_row @ layers[0][0].T).reshape(*valid.shape, -1), None


_dense_and_max.defvjp(_save_dense_and_max, _dense_and_max_backward, symbolic_zeros=True)


def feature_statistics(groups: Groups) -> dict[str, tuple[Float[Array, " F"], Float[Array, " F"]]]:
    """Return mean and standard deviation of each feature over all valid rows; 0 and 1 if there are none.

    Groups may have any leading axes. Rows share their statistics, so that neither order nor padding matters.
    """
    names = group_names({name: value.shape for name, value in groups.items()})
    return {name: _group_statistics(groups[name], groups.get(f"{name}_mask")) for name in names}


def _group_statistics(value: Array, mask: Array | None) -> tuple[Array, Array]:
    rows = value.reshape(-1, value.shape[-1]).astype(jnp.float32)
    valid = jnp.ones(len(rows)) if mask is None else mask.reshape(-1).astype(jnp.float32)
    share = (valid / jnp.maximum(valid.sum(), 1.0))[:, None]
    mean = jnp.sum(jnp.where(share > 0, rows, 0.0) * share, axis=0)
    # From residuals, because differences of large squares cancel.
    variance = jnp.sum(jnp.where(share > 0, rows - mean, 0.0) ** 2 * share, axis=0)
    return mean, jnp.where(valid.sum() > 0, jnp.sqrt(variance), 1.0)


@dataclass(frozen=True)
class NormalisedConfig:
    """An encoder of normalised features."""

    encoder: EncoderConfig

    def build(self, spec: GroupSpec, rngs: nnx.Rngs) -> NormalisedEncoder:
        """Return the encoder with fresh parameters; it normalises nothing until statistics are set."""
        return NormalisedEncoder(self.encoder.build(spec, rngs), spec)


class NormalisedEncoder(nnx.Module):
    """Shift and scale features, then encode. Statistics are parameters without gradients."""

    def __init__(self, encoder: Encoder, spec: GroupSpec) -> None:
        self.encoder = encoder
        self.width = encoder.width
        sizes = {name: spec[name][-1] for name in group_names(spec)}
        self.mean = nnx.Dict({name: nnx.Param(jnp.zeros(size)) for name, size in sizes.items()})
        self.deviation = nnx.Dict({name: nnx.Param(jnp.ones(size)) for name, size in sizes.items()})

    def __call__(self, groups: Groups) -> Float[Array, "*batch width"]:
        """Return the embedding of an observation or a batch."""
        return self.encoder(dict(groups) | {name: self._normalise(name, groups[name]) for name in self.mean})

    def _normalise(self, name: str, value: Array) -> Array:
        mean, deviation = (jax.lax.stop_gradient(values[name][...]) for values in (self.mean, self.deviation))
        return jnp.clip(
            (value - mean) / jnp.maximum(deviation, _MIN_DEVIATION), -_MAX_DEVIATIONS, _MAX_DEVIATIONS
        )


def set_statistics(network: nnx.Module, statistics: Statistics) -> None:
    """Set the statistics of all normalised encoders of a network, in place."""
    for _, node in nnx.iter_graph(network):
        if isinstance(node, NormalisedEncoder):
            for name, (mean, deviation) in statistics.items():
                node.mean[name][...] = mean
                node.deviation[name][...] = deviation
