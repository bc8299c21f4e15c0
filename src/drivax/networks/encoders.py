"""Encoders: from named groups with masks to one vector. They know arrays, not driving."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

Groups = Mapping[str, Array]
#: Shapes of one observation, by group.
GroupSpec = Mapping[str, tuple[int, ...]]

_ACTIVATIONS = {"relu": jax.nn.relu, "tanh": jnp.tanh, "gelu": jax.nn.gelu, "silu": jax.nn.silu}


@dataclass(frozen=True)
class MlpConfig:
    """All groups flattened, side by side, through dense layers.

    Attributes:
        hidden: Width of each layer; the last is the size of the embedding.
        activation: After every layer.
    """

    kind: Literal["mlp"] = "mlp"
    hidden: tuple[int, ...] = (256, 256)
    activation: Literal["relu", "tanh", "gelu", "silu"] = "relu"


class MlpEncoder(nnx.Module):
    """Flattens every group (masked rows are zero), appends the masks, and applies dense layers."""

    def __init__(self, config: MlpConfig, spec: GroupSpec, rngs: nnx.Rngs) -> None:
        self.names = tuple(sorted(spec))
        self.activation = config.activation
        self.rank = len(spec[self.names[0]])
        width = sum(_size(spec[name]) for name in self.names)
        layers = []
        for size in config.hidden:
            layers.append(nnx.Linear(width, size, kernel_init=nnx.initializers.orthogonal(2**0.5), rngs=rngs))
            width = size
        self.layers = nnx.List(layers)
        self.width = width

    def __call__(self, groups: Groups) -> Float[Array, "*batch width"]:
        """Encodes one observation or a batch of them."""
        lead = groups[self.names[0]].ndim - self.rank
        parts = []
        for name in self.names:
            value = groups[name].astype(jnp.float32)
            mask = groups.get(f"{name}_mask")
            if mask is not None:
                value = jnp.where(mask[..., None], value, 0.0)
            parts.append(value.reshape(*value.shape[:lead], -1))
        x = jnp.concatenate(parts, axis=-1)
        for layer in self.layers:
            x = _ACTIVATIONS[self.activation](layer(x))
        return x


def group_spec(observation: Groups) -> dict[str, tuple[int, ...]]:
    """Shapes of the groups of one (unbatched) observation."""
    return {name: tuple(value.shape) for name, value in observation.items()}


def _size(shape: tuple[int, ...]) -> int:
    size = 1
    for dimension in shape:
        size *= dimension
    return size
