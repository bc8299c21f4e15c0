"""Normalisation of features to zero mean and unit deviation before any encoder."""

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

#: Lower bound of deviations: a nearly constant feature is not amplified.
_LEAST = 1e-3
#: Normalised features are clipped at this many deviations.
_FAR = 10.0


def feature_statistics(groups: Groups) -> dict[str, tuple[Float[Array, " F"], Float[Array, " F"]]]:
    """Return mean and standard deviation of each feature of each group, over all valid rows.

    Rows share their statistics, so that neither order nor padding matters. Without valid rows, 0 and 1.

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
    # Of the residuals, not of squares: differences of large squares cancel.
    variance = jnp.sum(jnp.where(share > 0, rows - mean, 0.0) ** 2 * share, axis=0)
    return mean, jnp.where(counts.sum() > 0, jnp.sqrt(variance), 1.0)


@dataclass(frozen=True)
class NormalisedConfig:
    """An encoder of normalised features.

    Attributes:
        encoder: The encoder.
    """

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

    def set_statistics(self, statistics: Statistics) -> None:
        """Set the statistics."""
        for name, (mean, deviation) in statistics.items():
            self.mean[name][...] = mean
            self.deviation[name][...] = deviation

    def __call__(self, groups: Groups) -> Float[Array, "*batch width"]:
        """Return the embedding of an observation or a batch."""
        return self.encoder(dict(groups) | {name: self._scaled(name, groups[name]) for name in self.mean})

    def _scaled(self, name: str, value: Array) -> Array:
        mean, deviation = (jax.lax.stop_gradient(part[name][...]) for part in (self.mean, self.deviation))
        return jnp.clip((value - mean) / jnp.maximum(deviation, _LEAST), -_FAR, _FAR)


def set_statistics(network: nnx.Module, statistics: Statistics) -> None:
    """Set the statistics of all normalised encoders of a network."""
    for _, part in nnx.iter_graph(network):
        if isinstance(part, NormalisedEncoder):
            part.set_statistics(statistics)
