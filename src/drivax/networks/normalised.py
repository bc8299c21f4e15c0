"""Features of zero mean and unit deviation in front of any encoder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from drivax.networks.encoders import Encoder, EncoderConfig, Groups, GroupSpec, group_names

#: Mean and standard deviation of each feature, by group.
Statistics = Mapping[str, tuple[Float[Array, " F"], Float[Array, " F"]]]

#: A feature that hardly varies is not blown up.
_LEAST = 1e-3
#: Normalised features are clipped there, in deviations.
_FAR = 10.0


def feature_statistics(groups: Groups) -> dict[str, tuple[Float[Array, " F"], Float[Array, " F"]]]:
    """Mean and standard deviation of every feature of every group, over all rows that are there.

    A feature is the same number in whatever row it stands, so that neither the order of rows nor padding matters:
    masked rows have no part. Without any row, 0 and 1.

    Args:
        groups: Observations, with any leading axes; features are the last axis, masks are ``<name>_mask``.
    """
    names = group_names({name: value.shape for name, value in groups.items()})
    return {name: _of_group(groups[name], groups.get(f"{name}_mask")) for name in names}


def _of_group(value: Array, mask: Array | None) -> tuple[Array, Array]:
    rows = value.reshape(-1, value.shape[-1]).astype(jnp.float32)
    counts = jnp.ones(len(rows)) if mask is None else mask.reshape(-1).astype(jnp.float32)
    share = (counts / jnp.maximum(counts.sum(), 1.0))[:, None]
    mean = jnp.sum(jnp.where(share > 0, rows, 0.0) * share, axis=0)
    # Of what is left, not of squares: differences of large squares lose all digits.
    variance = jnp.sum(jnp.where(share > 0, rows - mean, 0.0) ** 2 * share, axis=0)
    return mean, jnp.where(counts.sum() > 0, jnp.sqrt(variance), 1.0)


@dataclass(frozen=True)
class NormalisedConfig:
    """An encoder behind normalisation.

    Attributes:
        encoder: The encoder.
    """

    encoder: EncoderConfig

    def build(self, spec: GroupSpec, rngs: nnx.Rngs) -> NormalisedEncoder:
        """The encoder with fresh parameters, which normalises nothing until it is told statistics."""
        return NormalisedEncoder(self.encoder.build(spec, rngs), spec)


class NormalisedEncoder(nnx.Module):
    """Shifts and scales features, then encodes. Statistics are parameters that no gradient reaches."""

    def __init__(self, encoder: Encoder, spec: GroupSpec) -> None:
        self.encoder = encoder
        self.width = encoder.width
        sizes = {name: spec[name][-1] for name in group_names(spec)}
        self.mean = nnx.Dict({name: nnx.Param(jnp.zeros(size)) for name, size in sizes.items()})
        self.deviation = nnx.Dict({name: nnx.Param(jnp.ones(size)) for name, size in sizes.items()})

    def tell(self, statistics: Statistics) -> None:
        """Takes statistics over."""
        for name, (mean, deviation) in statistics.items():
            self.mean[name][...] = mean
            self.deviation[name][...] = deviation

    def __call__(self, groups: Groups) -> Float[Array, "*batch width"]:
        """Encodes one observation or a batch of them."""
        return self.encoder(dict(groups) | {name: self._scaled(name, groups[name]) for name in self.mean})

    def _scaled(self, name: str, value: Array) -> Array:
        mean, deviation = (jax.lax.stop_gradient(part[name][...]) for part in (self.mean, self.deviation))
        return jnp.clip((value - mean) / jnp.maximum(deviation, _LEAST), -_FAR, _FAR)


def tell_statistics(network: nnx.Module, statistics: Statistics) -> None:
    """Tells them to every normalised encoder of a network."""
    for _, part in nnx.iter_graph(network):
        if isinstance(part, NormalisedEncoder):
            part.tell(statistics)
