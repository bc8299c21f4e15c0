"""Encoders: from named groups with masks to one vector."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from drivax.errors import UsageError
from drivax.networks.pooling import Activation, Layers, dense, largest

Groups = Mapping[str, Array]
#: Shapes of one observation, by group.
GroupSpec = Mapping[str, tuple[int, ...]]


@runtime_checkable
class Encoder(Protocol):
    """An ``nnx.Module`` whose state consists of ``nnx.Param`` only: a pure function of parameters and input."""

    @property
    def width(self) -> int:
        """Size of the embedding."""
        ...

    def __call__(self, groups: Groups) -> Float[Array, "*batch width"]:
        """Return the embedding of an observation or a batch; masked rows have no effect."""
        ...


@runtime_checkable
class EncoderConfig(Protocol):
    """Settings of an encoder; yours is a frozen dataclass, in YAML ``kind: package.module:Name``."""

    def build(self, spec: GroupSpec, rngs: nnx.Rngs) -> Encoder:
        """Return an encoder of observations with these groups."""
        ...


@dataclass(frozen=True)
class MlpConfig:
    """Dense layers over all groups, concatenated.

    Attributes:
        rows: Layers shared by the rows of each masked group, before a maximum over rows (order-invariant); empty: rows
            are flattened in order.
        hidden: Width of each following layer; the last is the size of the embedding.
        activation: After each layer.
    """

    kind: Literal["mlp"] = "mlp"
    rows: tuple[int, ...] = ()
    hidden: tuple[int, ...] = (256, 256)
    activation: Activation = "relu"

    def build(self, spec: GroupSpec, rngs: nnx.Rngs) -> MlpEncoder:
        """Return the encoder with fresh parameters."""
        return MlpEncoder(self, spec, rngs)


class MlpEncoder(nnx.Module):
    """Flatten or pool each group (masked rows have no effect), then apply dense layers."""

    def __init__(self, config: MlpConfig, spec: GroupSpec, rngs: nnx.Rngs) -> None:
        self.pools = bool(config.rows)
        self.names = group_names(spec)
        self.shapes = {name: tuple(spec[name]) for name in self.names}
        self.activation: Activation = config.activation
        width, shared = 0, {}
        for name in self.names:
            masked = f"{name}_mask" in spec
            if masked and self.pools:
                # A row is what the mask's first axis counts; its times are concatenated with their masks.
                row_width = math.prod(spec[name][1:]) + math.prod(spec[f"{name}_mask"][1:])
                shared[name] = dense_layers(row_width, config.rows, rngs)
                width += config.rows[-1]
            else:
                width += math.prod(spec[name]) + (math.prod(spec[f"{name}_mask"]) if masked else 0)
        self.shared = nnx.Dict(shared)
        self.layers = dense_layers(width, config.hidden, rngs)
        self.width = config.hidden[-1]

    def __call__(self, groups: Groups) -> Float[Array, "*batch width"]:
        """Encodes one observation or a batch of them."""
        x = jnp.concatenate([self._part(name, groups) for name in self.names], axis=-1)
        return dense(self.activation, _weights(self.layers), x)

    def _part(self, name: str, groups: Groups) -> Float[Array, "*batch part"]:
        value, mask = groups[name].astype(jnp.float32), groups.get(f"{name}_mask")
        lead = value.shape[: value.ndim - len(self.shapes[name])]
        if mask is None:
            return value.reshape(*lead, -1)
        value = jnp.where(mask[..., None], value, 0.0)
        if not self.pools:
            return jnp.concatenate(
                [value.reshape(*lead, -1), mask.reshape(*lead, -1).astype(jnp.float32)], axis=-1
            )
        rows = self.shapes[name][0]
        there = mask.reshape(*lead, rows, -1)
        row = jnp.concatenate([value.reshape(*lead, rows, -1), there.astype(jnp.float32)], axis=-1)
        # A row counts when any of its times does; without rows the embedding is zero.
        return largest(self.activation, _weights(self.shared[name]), row, there.any(axis=-1))


def dense_layers(width: int, sizes: tuple[int, ...], rngs: nnx.Rngs) -> Any:
    """Return dense layers of these sizes, with orthogonal weights scaled for relu or tanh."""
    layers = []
    for size in sizes:
        layers.append(nnx.Linear(width, size, kernel_init=nnx.initializers.orthogonal(2**0.5), rngs=rngs))
        width = size
    return nnx.List(layers)


def _weights(layers: Any) -> Layers:
    return tuple((layer.kernel[...], layer.bias[...]) for layer in layers)


def group_spec(observation: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the groups of one (unbatched) observation."""
    return {name: tuple(value.shape) for name, value in observation.items()}


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
