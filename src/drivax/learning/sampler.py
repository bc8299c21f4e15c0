"""Drawing places (scenario, step) by weight, on the device.

By the inverse of the cumulative distribution, in whole numbers: float32 would round a weight among a million others by
a twentieth, 32 bits by a five-thousandth, and what has no weight has no number that leads to it.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt

from drivax.errors import DataError, UsageError
from drivax.scenario.record import record, static
from drivax.stats.intervals import effective_size

_LAST = 2**32 - 1

#: Scenarios and steps that were drawn.
Places = tuple[Int[Array, "..."], Int[Array, "..."]]


@record
class Sampler:
    """A distribution over the steps of scenarios; :func:`sampler` makes one.

    Attributes:
        cumulative: Share of all weight up to each step, scenario by scenario, in units of ``1 / (2^32 - 1)``.
        effective: Effective sample size, see :func:`~drivax.stats.intervals.effective_size`.
        steps: Steps of a scenario.
    """

    cumulative: UInt[Array, " places"]
    effective: Float[Array, ""]
    steps: int = static()


def sampler(weights: np.ndarray) -> Sampler:
    """A sampler that draws each step in proportion to its weight.

    Args:
        weights: ``[N, T]``, at least 0; a step whose share of all weight is below ``2^-32`` may never be drawn.

    Raises:
        DataError: No step has any weight.
    """
    total = np.cumsum(weights.reshape(-1), dtype=np.float64)
    if not total[-1] > 0.0:
        raise DataError("no step has any weight", cure="give some step that can be learned from a weight")
    cumulative = np.floor(total / total[-1] * _LAST).astype(np.uint32)
    effective = jnp.asarray(effective_size(weights), jnp.float32)
    return Sampler(jnp.asarray(cumulative), effective, weights.shape[1])


def draw(sampler: Sampler, key: Array, shape: tuple[int, ...]) -> Places:
    """Places with replacement, each with a chance in proportion to its weight."""
    number = jnp.minimum(jax.random.bits(key, shape, jnp.uint32), jnp.uint32(_LAST - 1))
    # The first step whose share reaches beyond the number: a step without weight never does.
    place = jnp.searchsorted(sampler.cumulative, number, side="right").astype(jnp.int32)
    return place // sampler.steps, place % sampler.steps


def checked_weights(weights: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Weights of the steps of a set, if they can be such.

    Args:
        weights: Of each scenario and step.
        shape: Scenarios and steps of the set.

    Raises:
        UsageError: They have another shape, are negative, or not finite.
    """
    weights = np.asarray(weights)
    if weights.shape != shape:
        raise UsageError(
            f"weights of shape {weights.shape} for {shape[0]} scenarios of {shape[1]} steps",
            cure="weigh every step of this very set",
        )
    bad = np.argwhere(~(np.isfinite(weights) & (weights >= 0.0)))
    if len(bad):
        scenario, step = bad[0]
        raise UsageError(
            f"the weight of step {step} of scenario {scenario} is {weights[scenario, step]}",
            cure="use finite numbers of at least 0",
        )
    return weights.astype(np.float64)
