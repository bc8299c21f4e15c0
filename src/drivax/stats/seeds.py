"""Differences between policies trained with several seeds: seeds and scenarios are crossed random effects.

The variances of seeds and scenarios are added, so that an interval covers other seeds and other scenarios.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64
from scipy import special

from drivax.errors import UsageError
from drivax.stats.clusters import dense
from drivax.stats.effects import ROUNDING
from drivax.stats.intervals import Interval, effective_size, wilson

#: Values of one policy, a row per training seed, a column per scenario.
Values = Float64[np.ndarray, "agent scenario"]
#: Values of another policy, with more or fewer seeds.
Others = Float64[np.ndarray, "other_agent other_scenario"]
Weights = Float64[np.ndarray, " scenario"]
#: Defaults of a planned comparison.
_CONFIDENCE, _POWER = 0.95, 0.80
#: The largest number that is considered, and how many up to there.
_MOST, _TRIED = 10**6, 400


@dataclass(frozen=True)
class Crossed:
    """A mean difference of two policies with several seeds each, all evaluated on the same scenarios.

    The squared standard error adds what the choice of seeds and the choice of scenarios contribute, and takes away once
    what is in both: ``se^2 = s_a^2 / K_a + s_b^2 / K_b + v - e_a - e_b``. These are the variances of the means of
    agents; the variance of the mean over scenarios by clusters, ``v = C / (C - 1) sum((S_c - m W_c)^2) / W^2`` (a ratio
    of totals; Cochran, Sampling Techniques, 1977, section 6.3); and of each kind what seeds and scenarios do together,
    ``e = C / (C - 1) sum(R_kc^2) / (K (K - 1) W^2)`` with totals ``R_kc`` of the residuals of a two-way layout (Owen,
    Ann. Appl. Stat. 1, 2007). It is never taken below the larger of the two. Degrees of freedom are those of
    Satterthwaite (Biometrics Bulletin 2, 1946).

    Attributes:
        difference: The mean difference.
        seeds: What the choice of seeds adds to the squared error, by kind of agent.
        scenarios: What the choice of scenarios adds.
        agents: Agents of each kind.
        clusters: Clusters of scenarios.
        both: What is in both, by kind of agent.
    """

    difference: float
    seeds: tuple[float, float]
    scenarios: float
    agents: tuple[int, int]
    clusters: int
    both: tuple[float, float] = (0.0, 0.0)

    @property
    def error(self) -> float:
        """Standard error."""
        seeds = sum(self.seeds)
        return math.sqrt(max(seeds + self.scenarios - sum(self.both), seeds, self.scenarios))

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
        """Return the smallest difference that is detected with probability ``power``."""
        return self.error * (
            _quantile(self.freedom, (1.0 + confidence) / 2.0) + _quantile(self.freedom, power)
        )

    def power(self, difference: float, confidence: float = _CONFIDENCE) -> float:
        """Probability to detect a difference of this size."""
        if self.error == 0.0:
            return float(difference != 0.0)
        reach = abs(difference) / self.error - _quantile(self.freedom, (1.0 + confidence) / 2.0)
        return float(special.stdtr(_finite(self.freedom), reach))

    def seeds_needed(self, power: float = _POWER, confidence: float = _CONFIDENCE) -> int | None:
        """Seeds of each kind, more than now, with which this difference would be found; None: no number of them."""
        return self._least(self._with_seeds, max(self.agents), power, confidence)

    def clusters_needed(self, power: float = _POWER, confidence: float = _CONFIDENCE) -> int | None:
        """Clusters, more than now, with which as many seeds would find this difference; None: no number of them."""
        return self._least(self._with_clusters, self.clusters, power, confidence)

    def _with_seeds(self, number: int) -> Crossed:
        """Extrapolate to ``number`` seeds of each policy with the same variance."""
        shares = [count / number for count in self.agents]
        seeds, both = (
            [x * share for x, share in zip(xs, shares, strict=True)] for xs in (self.seeds, self.both)
        )
        alone = max(self.scenarios - sum(self.both), 0.0)
        return replace(
            self, seeds=(seeds[0], seeds[1]), both=(both[0], both[1]), scenarios=alone + sum(both),
            agents=(number, number),
        )  # fmt: skip

    def _with_clusters(self, number: int) -> Crossed:
        """Extrapolate to ``number`` clusters with the same variance."""
        share = self.clusters / number
        both = [x * share for x in self.both]
        seeds = [max(x - own, 0.0) + own * share for x, own in zip(self.seeds, self.both, strict=True)]
        return replace(
            self, seeds=(seeds[0], seeds[1]), both=(both[0], both[1]), scenarios=self.scenarios * share,
            clusters=number,
        )  # fmt: skip

    def _least(
        self, at: Callable[[int], Crossed], present: int, power: float, confidence: float
    ) -> int | None:
        def detected(number: int) -> bool:
            return abs(self.difference) >= at(number).detectable(power, confidence)

        # More is not always better: the fewer degrees of freedom are left, the more the part that stays alone weighs.
        numbers = (
            np.unique(np.round(np.geomspace(present + 1, max(_MOST, present + 1), _TRIED)))
            .astype(int)
            .tolist()
        )
        at_least = next((place for place, number in enumerate(numbers) if detected(number)), None)
        if self.difference == 0.0 or at_least is None:
            return None
        low, high = (numbers[at_least - 1] if at_least else present), numbers[at_least]
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if detected(middle) else (middle, high)
        return high


def crossed_mean(values: Values, clusters: Any = None, weights: Weights | None = None) -> Crossed:
    """The mean of one kind of agents, with an error as that of :func:`crossed_difference`; one agent alone is certain.

    Of differences between the same agents, one row per agent, it is a comparison in pairs.

    Args:
        values: One row per agent, one column per scenario; scenarios that some agent leaves undefined are left out.
        clusters: Labels of the clusters of scenarios; None: every scenario is its own.
        weights: How much each scenario counts; None: equally.

    Raises:
        UsageError: There are fewer than two clusters of scenarios that all define.
    """
    return crossed_difference(certain(values), np.zeros((2, values.shape[1])), clusters, weights)


def certain(values: Values) -> Others:
    """Agents whose number says how they vary; one alone stands for itself, as a planner does that learned nothing."""
    return values if len(values) > 1 else np.repeat(values, 2, axis=0)


def seeds_interval(
    values: Values,
    clusters: Any = None,
    weights: Weights | None = None,
    confidence: float = _CONFIDENCE,
    *,
    share: bool = False,
) -> Interval:
    """The mean of one kind of agents with the interval of :func:`crossed_mean`.

    Args:
        values: As there, like the next two.
        clusters: The same.
        weights: The same.
        confidence: Coverage.
        share: The interval lies within 0 and 1; where all is 0, or all is 1, it is Wilson's of as many clusters (with
            weights of their effective number, Kish 1965).

    Returns:
        ``n`` counts scenarios that all agents define; no bounds with fewer than two clusters of them.
    """
    weight, keep = _counted(values, values, weights)
    number = int(keep.sum())
    labels = dense(clusters, values.shape[1], "cluster")
    if np.unique(labels[keep]).size < 2:
        return Interval(float(values[:, keep].mean()) if number else None, None, None, number)
    effect = crossed_mean(values, labels, weights)
    low, high = effect.interval(confidence)
    only = np.unique(values[:, keep])
    if share and only.size == 1 and only[0] in (0.0, 1.0):
        mass = np.bincount(labels[keep], weight[keep])
        trials = effect.clusters if weights is None else effective_size(mass)
        return replace(wilson(float(only[0]) * trials, trials, confidence), n=number)
    if share:
        low, high = max(low, 0.0), min(high, 1.0)
    return Interval(effect.difference, low, high, number)


def crossed_difference(a: Values, b: Others, clusters: Any = None, weights: Weights | None = None) -> Crossed:
    """The difference of the means of two kinds of agents.

    Args:
        a: A row per seed, a column per scenario; scenarios that some seed leaves undefined are left out.
        b: The other kind's, in the same scenarios.
        clusters: Labels of the clusters of scenarios; None: every scenario is its own.
        weights: How much each scenario counts, as where some kinds were drawn more often than they occur; those of 0
            are left out. None: equally.

    Raises:
        UsageError: There are fewer than two agents of a kind, or clusters of scenarios that all define.
    """
    if a.shape[1] != b.shape[1]:
        raise UsageError("seeds have different scenarios", cure="give one value per seed and scenario")
    labels = dense(clusters, a.shape[1], "cluster")
    weight, keep = _counted(a, b, weights)
    labels = np.unique(labels[keep], return_inverse=True)[1]
    if min(len(a), len(b)) < 2 or not keep.any() or labels.max() < 1:
        raise UsageError(
            "nothing to tell chance by",
            cure="train two seeds or more of each, and drive two recordings or more",
        )
    share, number = weight[keep] / weight[keep].sum(), int(labels.max()) + 1
    more = number / (number - 1)
    kinds = [policy[:, keep] for policy in (a, b)]
    apart = kinds[0].mean(axis=0) - kinds[1].mean(axis=0)
    # What sums of equal numbers differ by is no difference.
    apart = np.where(
        np.abs(apart) <= ROUNDING * max(float(np.abs(policy).max()) for policy in kinds), 0.0, apart
    )
    mean = float(apart @ share)
    scenarios = more * float(np.square(np.bincount(labels, share * (apart - mean), number)).sum())
    seeds, both = [], []
    for policy in kinds:
        agents, count = policy @ share, len(policy)
        seeds.append(float(agents.var(ddof=1)) / count)
        rest = (policy - agents[:, None] - policy.mean(axis=0) + agents.mean()) * share
        totals = np.stack([np.bincount(labels, row, number) for row in rest])
        both.append(more * float(np.square(totals).sum()) / (count * (count - 1)))
    return Crossed(mean, (seeds[0], seeds[1]), scenarios, (len(a), len(b)), number, both=(both[0], both[1]))


def difference_interval(
    a: Values, b: Others, clusters: Any = None, confidence: float = _CONFIDENCE
) -> tuple[Interval, Crossed | None]:
    """The difference of two kinds of agents, either of which may be one agent alone (:func:`certain`).

    Returns:
        The interval, ``n`` counting scenarios that all define, and what it is from; fewer than two clusters of them
        have no bounds and nothing behind them.
    """
    _, keep = _counted(a, b, None)
    number = int(keep.sum())
    labels = dense(clusters, a.shape[1], "cluster")
    if np.unique(labels[keep]).size < 2:
        mean = float(a[:, keep].mean() - b[:, keep].mean()) if number else None
        return Interval(mean, None, None, number), None
    effect = crossed_difference(certain(a), certain(b), labels)
    return Interval(effect.difference, *effect.interval(confidence), number), effect


def log_ratio(a: Values, b: Others, clusters: Any = None, weights: Weights | None = None) -> Crossed | None:
    """``ln(mean(a) / mean(b))`` with its error (delta method).

    Args:
        a: As for :func:`crossed_difference`, of values that are at least 0.
        b: The same.
        clusters: The same.
        weights: The same.

    Returns:
        The logarithm as ``difference``; None where a mean is not above 0.
    """
    weight, keep = _counted(a, b, weights)
    if not keep.any():
        return None
    means = [float(np.average(policy[:, keep].mean(axis=0), weights=weight[keep])) for policy in (a, b)]
    if min(means) <= 0.0:
        return None
    scaled = crossed_difference(a / means[0], b / means[1], clusters, weights)
    return replace(scaled, difference=math.log(means[0] / means[1]))


def _counted(
    a: Values, b: Others, weights: Weights | None
) -> tuple[Float64[np.ndarray, " scenario"], Bool[np.ndarray, " scenario"]]:
    weight = np.ones(a.shape[1]) if weights is None else np.asarray(weights, np.float64)
    return weight, np.asarray(~np.isnan(np.concatenate([a, b])).any(axis=0) & (weight > 0.0))


def _finite(freedom: float) -> float:
    return min(freedom, 1e9)


def _quantile(freedom: float, share: float) -> float:
    return float(special.stdtrit(_finite(freedom), share))
