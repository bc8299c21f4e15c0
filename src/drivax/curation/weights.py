"""From scores to weights of a sampler, and what the weights do to the data that is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from drivax.curation.scores import ScoreTable
from drivax.errors import UsageError
from drivax.stats.intervals import effective_size

Scale = Literal["step", "scenario"]
Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class WeightConfig:
    """How a score becomes a weight. All of it is global: over every step of a set that can be drawn.

    For score s of a step, or of its scenario, in this order:

    1. ``quantile``: u is the mid-rank of s among all n steps, over n, in (0, 1): what a score means no longer depends
       on how it is spread, and equal scores have equal weights; ``none``: u = s. Then u + ``floor``.
    2. w = u ** (1 / ``temperature``): 1 leaves it, a higher temperature evens it out, a lower one sharpens it.
    3. w clipped so that none is more than ``most`` times the mean of what is then left (where fewer than n / ``most``
       are above 0, those weigh alike), over that mean.
    4. ``(1 - uniform) w + uniform``: a mixture with uniform sampling, whose mean is 1.

    Attributes:
        normalise: See 1.
        floor: See 1.
        temperature: See 2.
        most: See 3.
        uniform: See 4.
    """

    normalise: Literal["quantile", "none"] = "quantile"
    floor: float = 0.0
    temperature: float = 0.5
    most: float = 10.0
    uniform: float = 0.2

    def __post_init__(self) -> None:
        if not 0.0 <= self.floor < float("inf"):
            raise UsageError(f"floor is {self.floor}", cure="use 0 or more")
        if not 0.0 < self.temperature < float("inf"):
            raise UsageError(f"temperature is {self.temperature}", cure="use a positive number")
        if not self.most > 1.0:
            raise UsageError(f"most is {self.most}", cure="use more than 1, inf for no limit")
        if not 0.0 <= self.uniform <= 1.0:
            raise UsageError(f"uniform is {self.uniform}", cure="use 0 to 1")


#: As the study draws: in proportion to the score, plus a hundredth.
PUBLISHED = WeightConfig(normalise="none", floor=0.01, temperature=1.0, most=float("inf"), uniform=0.0)


def weights_of(
    table: ScoreTable, config: WeightConfig, scale: Scale, usable: Bool[Array, "N T"] | None = None
) -> Float[Array, "N T"]:
    """Weights of every step of a set, of mean 1 over the steps that can be drawn.

    Other steps weigh 0. At the scale of scenarios every step of a scenario has the scenario's weight.

    Args:
        table: The scores.
        config: How scores become weights.
        scale: Whether steps are weighted one by one, or as their scenarios are.
        usable: Which steps can be drawn, where a training leaves some out (:func:`drivax.learning.loop.usable_steps`);
            by default all of which the log knows what ego did (``ScoreTable.drawn``).

    Raises:
        UsageError: No step can be drawn, or none would have a weight.
    """
    drawn = table.drawn if usable is None else usable
    if not drawn.any():
        raise UsageError("there is no step that can be drawn", cure="check the set")
    weights = np.zeros(drawn.shape)
    if scale == "step":
        weights[drawn] = _weighted(table.steps[drawn], np.ones(int(drawn.sum())), config)
    else:
        some = drawn.any(axis=1)
        each = _weighted(table.scenarios[some], drawn[some].sum(axis=1).astype(np.float64), config)
        weights[some] = np.where(drawn[some], each[:, None], 0.0)
    if not weights.any():
        raise UsageError(
            "every score is 0, so that nothing has a weight", cure="give floor, or normalise: quantile"
        )
    return weights / weights[drawn].mean()


def _weighted(
    scores: Float[Array, " n"], mass: Float[Array, " n"], config: WeightConfig
) -> Float[Array, " n"]:
    """Weights of scores that so many steps have each."""
    score = np.asarray(scores, np.float64)
    if config.normalise == "quantile":
        _, place = np.unique(score, return_inverse=True)
        alike = np.bincount(place, mass)
        score = ((np.cumsum(alike) - alike / 2.0) / mass.sum())[place]
    # In logarithms, so that a low temperature neither overflows nor makes everything 0.
    with np.errstate(divide="ignore"):
        power = np.log(score + config.floor) / config.temperature
    if not np.isfinite(power.max()):
        return np.zeros(len(score))
    weight = _capped(np.exp(power - power.max()), mass, config.most)
    return (1.0 - config.uniform) * weight / np.average(weight, weights=mass) + config.uniform


def _capped(weight: Float[Array, " n"], mass: Float[Array, " n"], most: float) -> Float[Array, " n"]:
    """The weights, the largest of them lowered to one value that is ``most`` times the mean of the result."""
    order = np.argsort(-weight, kind="stable")
    ordered, own = weight[order], mass[order]
    if ordered[0] <= most * np.average(weight, weights=mass):
        return weight
    # If the first k, of mass m, are lowered to c, then c = most (m c + rest) / n, with rest the sum of all others.
    lowered = np.cumsum(own) - own
    rest = np.cumsum((ordered * own)[::-1])[::-1]
    left = mass.sum() - most * lowered
    cap = most * rest / np.where(left > 0.0, left, np.inf)
    enough = np.flatnonzero((left > 0.0) & (cap >= ordered) & (cap > 0.0))
    return np.minimum(weight, cap[enough[0]] if len(enough) else ordered[ordered > 0].min())


@dataclass(frozen=True)
class Draws:
    """What weights do to the data that is drawn.

    Attributes:
        effective: Effective sample size over the number of steps that can be drawn, ``(sum w)^2 / (n sum w^2)`` (Kish,
            1965): 1 for uniform weights, 1 / n where one step has all.
        effective_scenarios: The same of the scenarios' sums of weights.
        tilt: 99th percentile of the weights over their mean.
        largest: Largest weight over the mean.
        concentration: Share of the draws that goes to the 5 % of the steps that weigh most; 0.05 for uniform weights.
    """

    effective: float
    effective_scenarios: float
    tilt: float
    largest: float
    concentration: float


def draws_of(weights: Float[Array, "N T"], drawn: Bool[Array, "N T"]) -> Draws:
    """Measures weights.

    Args:
        weights: Of every step.
        drawn: Which steps can be drawn, as :func:`weights_of` was told.
    """
    one = weights[drawn]
    some = drawn.any(axis=1)
    ordered = np.sort(one)[::-1]
    return Draws(
        effective=effective_size(one) / one.size,
        effective_scenarios=effective_size(weights.sum(axis=1)[some]) / int(some.sum()),
        tilt=float(np.quantile(one, 0.99) / one.mean()),
        largest=float(ordered[0] / one.mean()),
        concentration=float(ordered[: max(round(len(one) * 0.05), 1)].sum() / one.sum()),
    )
