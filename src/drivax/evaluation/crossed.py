"""Differences between agents that were trained several times: seeds and scenarios are both drawn by chance.

A difference that other seeds, or other scenarios, would not show again is none; the variances of both are added.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64
from scipy import special

from drivax.errors import UsageError
from drivax.evaluation.clusters import dense, totals

#: Values of the agents of one kind, one column per scenario.
Values = Float64[np.ndarray, "agent scenario"]
#: Those of another kind, of whom there may be more or fewer.
Others = Float64[np.ndarray, "other_agent other_scenario"]
#: What is wanted of a comparison that has not been made yet.
_CONFIDENCE, _POWER = 0.95, 0.80
_MOST = 10**6


@dataclass(frozen=True)
class Crossed:
    """A mean difference of two kinds of agents, several agents of each, all of which drove the same scenarios.

    The standard error adds what the choice of seeds and the choice of scenarios contribute,
    ``se^2 = s_a^2 / K_a + s_b^2 / K_b + v``: variances of the means of agents, and of the mean over scenarios by
    clusters, ``v = C / (C - 1) sum((S_c - m n_c)^2) / n^2`` (a ratio of totals; Cochran, Sampling Techniques, 1977,
    section 6.3). What seeds and scenarios do together is in both, so that the error is rather too large (Owen, Ann.
    Appl. Stat. 1, 2007). Degrees of freedom are those of Satterthwaite (Biometrics Bulletin 2, 1946).

    Attributes:
        difference: The mean difference.
        seeds: What the choice of seeds adds to the squared error, by kind of agent.
        scenarios: What the choice of scenarios adds.
        agents: Agents of each kind.
        clusters: Clusters of scenarios.
    """

    difference: float
    seeds: tuple[float, float]
    scenarios: float
    agents: tuple[int, int]
    clusters: int

    @property
    def error(self) -> float:
        """Standard error."""
        return math.sqrt(sum(self.seeds) + self.scenarios)

    @property
    def freedom(self) -> float:
        """Degrees of freedom; infinite where nothing varies."""
        parts = (*self.seeds, self.scenarios)
        numbers = (*(count - 1 for count in self.agents), self.clusters - 1)
        below = sum(part**2 / number for part, number in zip(parts, numbers, strict=True) if part > 0.0)
        return self.error**4 / below if below > 0.0 else math.inf

    @property
    def p(self) -> float:
        """Two-sided probability of so large a difference if there were none."""
        if self.error == 0.0:
            return 1.0 if self.difference == 0.0 else 0.0
        return float(2.0 * special.stdtr(_finite(self.freedom), -abs(self.difference) / self.error))

    def interval(self, confidence: float = _CONFIDENCE) -> tuple[float, float]:
        """Confidence interval of the difference."""
        half = _quantile(self.freedom, (1.0 + confidence) / 2.0) * self.error
        return self.difference - half, self.difference + half

    def detectable(self, power: float = _POWER, confidence: float = _CONFIDENCE) -> float:
        """The smallest difference that so many seeds and scenarios find with a probability of ``power``."""
        return self.error * (
            _quantile(self.freedom, (1.0 + confidence) / 2.0) + _quantile(self.freedom, power)
        )

    def seeds_needed(self, power: float = _POWER) -> int | None:
        """Seeds of each kind with which this difference would be found on as many scenarios; None: no number of them.

        As if both variances stayed what they are here.
        """
        each = sum(part * count for part, count in zip(self.seeds, self.agents, strict=True))
        return self._least(lambda number: (each / number, self.scenarios), min(self.agents), power)

    def clusters_needed(self, power: float = _POWER) -> int | None:
        """Clusters of scenarios with which as many seeds would find this difference; None: no number of them."""
        whole = self.scenarios * self.clusters
        return self._least(lambda number: (sum(self.seeds), whole / number), self.clusters, power)

    def _least(self, parts: Any, begin: int, power: float) -> int | None:
        """By the normal distribution: with so many more seeds the t distribution is one."""
        wanted = float(special.ndtri((1.0 + _CONFIDENCE) / 2.0) + special.ndtri(power))

        def found(number: int) -> bool:
            return abs(self.difference) >= wanted * math.sqrt(sum(parts(number)))

        if self.difference == 0.0 or not found(_MOST):
            return None
        low, high = 1, begin
        while not found(high):
            low, high = high, 2 * high
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if found(middle) else (middle, high)
        return high


def crossed_mean(values: Values, clusters: Any = None) -> Crossed:
    """The mean of one kind of agents, with an error as that of :func:`crossed_difference`; one agent alone is certain.

    Args:
        values: One row per agent, one column per scenario; scenarios that some agent leaves undefined are left out.
        clusters: Labels of the clusters of scenarios; None: every scenario is its own.

    Raises:
        UsageError: There are fewer than two clusters of scenarios that all define.
    """
    twice = values if len(values) > 1 else np.repeat(values, 2, axis=0)
    return crossed_difference(twice, np.zeros((2, values.shape[1])), clusters)


def crossed_difference(a: Values, b: Others, clusters: Any = None) -> Crossed:
    """The difference of the means of two kinds of agents.

    Args:
        a: One row per agent, one column per scenario; scenarios that some agent leaves undefined are left out.
        b: The other kind's, in the same scenarios.
        clusters: Labels of the clusters of scenarios; None: every scenario is its own.

    Raises:
        UsageError: There are fewer than two agents of a kind, or clusters of scenarios that all define.
    """
    if a.shape[1] != b.shape[1]:
        raise UsageError("agents drove different scenarios", cure="give one value per agent and scenario")
    labels = dense(clusters, a.shape[1], "cluster")
    keep = _defined(a, b)
    labels = np.unique(labels[keep], return_inverse=True)[1]
    if min(len(a), len(b)) < 2 or not keep.any() or labels.max() < 1:
        raise UsageError(
            "nothing to tell chance by",
            cure="train two seeds or more of each, and drive two recordings or more",
        )
    first, second = a[:, keep], b[:, keep]
    apart = first.mean(axis=0) - second.mean(axis=0)
    sums, counts = totals(apart, labels)
    mean, number = float(apart.mean()), len(counts)
    apart_by = float(np.square(sums - mean * counts).sum() / counts.sum() ** 2)
    scenarios = number / (number - 1) * apart_by
    seeds = tuple(float(one.mean(axis=1).var(ddof=1)) / len(one) for one in (first, second))
    return Crossed(mean, (seeds[0], seeds[1]), scenarios, (len(a), len(b)), number)


def relative_change(a: Values, b: Others, clusters: Any = None) -> tuple[float, float, float] | None:
    """``mean(a) / mean(b) - 1`` and its interval, by the error of the logarithm of the ratio (delta method).

    Args:
        a: As for :func:`crossed_difference`, of values that are at least 0.
        b: The same.
        clusters: The same.

    Returns:
        Change, low, high; None where a mean is not above 0.
    """
    keep = _defined(a, b)
    means = [float(one[:, keep].mean()) for one in (a, b)] if keep.any() else [0.0, 0.0]
    if min(means) <= 0.0:
        return None
    scaled = crossed_difference(a / means[0], b / means[1], clusters)
    half = _quantile(scaled.freedom, (1.0 + _CONFIDENCE) / 2.0) * scaled.error
    ratio = means[0] / means[1]
    return ratio - 1.0, ratio * math.exp(-half) - 1.0, ratio * math.exp(half) - 1.0


def _defined(a: Values, b: Others) -> Bool[np.ndarray, " scenario"]:
    return np.asarray(~np.isnan(np.concatenate([a, b])).any(axis=0))


def _finite(freedom: float) -> float:
    return min(freedom, 1e9)


def _quantile(freedom: float, share: float) -> float:
    return float(special.stdtrit(_finite(freedom), share))
