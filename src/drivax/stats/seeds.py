"""Differences between policies trained with several seeds: seeds and scenarios are crossed random effects.

The variances of seeds and scenarios are added, so that an interval covers other seeds and other scenarios. Values have
a row per seed and a column per scenario; scenarios that some seed leaves undefined, or of weight 0, are left out.
``clusters`` are labels of scenarios (None: every scenario is its own), ``weights`` say how much each counts.
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

Values = Float64[np.ndarray, "seed scenario"]
#: Values of another policy, with more or fewer seeds.
Others = Float64[np.ndarray, "other_seed other_scenario"]
Weights = Float64[np.ndarray, " scenario"]
#: Defaults of a planned comparison.
_CONFIDENCE, _POWER = 0.95, 0.80
#: Infinite degrees of freedom are replaced by these.
_MOST_FREEDOM = 1e9
#: The largest number of seeds or clusters that is considered, and how many numbers up to it.
_MOST, _TRIED = 10**6, 400


@dataclass(frozen=True)
class Crossed:
    """A mean difference of two policies with several seeds each, all evaluated on the same scenarios.

    The squared standard error is ``se^2 = s_a^2 / K_a + s_b^2 / K_b + v - e_a - e_b``, at least the larger of the
    variances of seeds and of scenarios: the variances of the means of seeds; the variance of the mean over scenarios by
    clusters, ``v = C / (C - 1) sum((S_c - m W_c)^2) / W^2`` (a ratio of totals; Cochran, Sampling Techniques, 1977,
    section 6.3); and of each policy the interaction of seeds and scenarios, which is in both,
    ``e = C / (C - 1) sum(R_kc^2) / (K (K - 1) W^2)`` with totals ``R_kc`` of the residuals of a two-way layout (Owen,
    Ann. Appl. Stat. 1, 2007). Degrees of freedom are those of Satterthwaite (Biometrics Bulletin 2, 1946).

    Attributes:
        difference: The mean difference.
        seeds: Variance from the choice of seeds, by policy.
        scenarios: Variance from the choice of scenarios.
        agents: Number of seeds, by policy.
        clusters: Number of clusters.
        both: Variance of the interaction, by policy.
    """

    difference: float
    seeds: tuple[float, float]
    scenarios: float
    agents: tuple[int, int]
    clusters: int
    both: tuple[float, float] = (0.0, 0.0)

    @property
    def error(self) -> float:
        """Standard error of the difference."""
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
        """Two-sided p-value of the null hypothesis of no difference."""
        if self.error == 0.0:
            return 1.0 if self.difference == 0.0 else 0.0
        return 2.0 * self._probability(-abs(self.difference) / self.error)

    def interval(self, confidence: float = _CONFIDENCE) -> tuple[float, float]:
        """Return the confidence interval of the difference."""
        half = self._quantile((1.0 + confidence) / 2.0) * self.error
        return self.difference - half, self.difference + half

    def detectable(self, power: float = _POWER, confidence: float = _CONFIDENCE) -> float:
        """Return the smallest difference that is detected with probability ``power``."""
        return self.error * (self._quantile((1.0 + confidence) / 2.0) + self._quantile(power))

    def power(self, difference: float, confidence: float = _CONFIDENCE) -> float:
        """Return the probability that a difference of this size is detected."""
        if self.error == 0.0:
            return float(difference != 0.0)
        return self._probability(abs(difference) / self.error - self._quantile((1.0 + confidence) / 2.0))

    def seeds_needed(self, power: float = _POWER, confidence: float = _CONFIDENCE) -> int | None:
        """Return the seeds per policy, more than now, that detect this difference; None if no number does."""
        return self._least(self._with_seeds, max(self.agents), power, confidence)

    def clusters_needed(self, power: float = _POWER, confidence: float = _CONFIDENCE) -> int | None:
        """Return the clusters, more than now, that detect this difference; None if no number does."""
        return self._least(self._with_clusters, self.clusters, power, confidence)

    def _probability(self, t: float) -> float:
        return float(special.stdtr(min(self.freedom, _MOST_FREEDOM), t))

    def _quantile(self, share: float) -> float:
        return float(special.stdtrit(min(self.freedom, _MOST_FREEDOM), share))

    def _with_seeds(self, number: int) -> Crossed:
        """Extrapolate to ``number`` seeds of each policy with the same variance."""
        (a, b), (both_a, both_b) = self.seeds, self.both
        share_a, share_b = (count / number for count in self.agents)
        both = both_a * share_a, both_b * share_b
        scenarios = max(self.scenarios - sum(self.both), 0.0) + sum(both)
        return Crossed(
            self.difference, (a * share_a, b * share_b), scenarios, (number, number), self.clusters, both
        )

    def _with_clusters(self, number: int) -> Crossed:
        """Extrapolate to ``number`` clusters with the same variance."""
        (a, b), (both_a, both_b), share = self.seeds, self.both, self.clusters / number
        seeds = max(a - both_a, 0.0) + both_a * share, max(b - both_b, 0.0) + both_b * share
        both = both_a * share, both_b * share
        return Crossed(self.difference, seeds, self.scenarios * share, self.agents, number, both)

    def _least(
        self, at: Callable[[int], Crossed], present: int, power: float, confidence: float
    ) -> int | None:
        def detected(number: int) -> bool:
            return abs(self.difference) >= at(number).detectable(power, confidence)

        # More is not always better: the fewer degrees of freedom are left, the more the part that stays alone weighs.
        numbers = np.unique(np.round(np.geomspace(present + 1, max(_MOST, present + 1), _TRIED)))
        numbers = numbers.astype(int).tolist()
        at_least = next((place for place, number in enumerate(numbers) if detected(number)), None)
        if self.difference == 0.0 or at_least is None:
            return None
        low, high = (numbers[at_least - 1] if at_least else present), numbers[at_least]
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if detected(middle) else (middle, high)
        return high


def crossed_mean(values: Values, clusters: Any = None, weights: Weights | None = None) -> Crossed:
    """Return the mean of one policy, with the error of :func:`crossed_difference`; one seed alone is certain.

    Of differences between the same seeds it is a paired comparison. Raises UsageError with fewer than two clusters.
    """
    return crossed_difference(certain(values), np.zeros((2, values.shape[1])), clusters, weights)


def certain(values: Values) -> Others:
    """Return the values with a single seed repeated: without variance, as of a planner that is not trained."""
    return values if len(values) > 1 else np.repeat(values, 2, axis=0)


def seeds_interval(
    values: Values,
    clusters: Any = None,
    weights: Weights | None = None,
    confidence: float = _CONFIDENCE,
    *,
    share: bool = False,
) -> Interval:
    """Return the mean of one policy with the interval of :func:`crossed_mean`; no bounds with fewer than two clusters.

    A ``share`` lies within 0 and 1; if all values are 0, or all are 1, the interval is Wilson's of as many clusters
    (with weights, of their effective number, Kish 1965).
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
    """Return the difference of the means of two policies; UsageError for fewer than two seeds of one, or clusters."""
    if a.shape[1] != b.shape[1]:
        raise UsageError("seeds have different scenarios", cure="give one value per seed and scenario")
    labels = dense(clusters, a.shape[1], "cluster")
    weight, keep = _counted(a, b, weights)
    labels = np.unique(labels[keep], return_inverse=True)[1]
    if min(len(a), len(b)) < 2 or not keep.any() or labels.max() < 1:
        cure = "train two seeds or more of each, and drive two recordings or more"
        raise UsageError("nothing to tell chance by", cure=cure)
    share, number = weight[keep] / weight[keep].sum(), int(labels.max()) + 1
    more, policies = number / (number - 1), (a[:, keep], b[:, keep])
    apart = policies[0].mean(axis=0) - policies[1].mean(axis=0)
    # Differences of sums of equal numbers are rounding.
    rounding = ROUNDING * max(float(np.abs(policy).max()) for policy in policies)
    apart = np.where(np.abs(apart) <= rounding, 0.0, apart)
    mean = float(apart @ share)
    scenarios = more * float(np.square(np.bincount(labels, share * (apart - mean), number)).sum())
    seeds, both = [], []
    for policy in policies:
        agents, count = policy @ share, len(policy)
        seeds.append(float(agents.var(ddof=1)) / count)
        rest = (policy - agents[:, None] - policy.mean(axis=0) + agents.mean()) * share
        totals = np.stack([np.bincount(labels, row, number) for row in rest])
        both.append(more * float(np.square(totals).sum()) / (count * (count - 1)))
    return Crossed(mean, (seeds[0], seeds[1]), scenarios, (len(a), len(b)), number, both=(both[0], both[1]))


def difference_interval(
    a: Values, b: Others, clusters: Any = None, confidence: float = _CONFIDENCE
) -> tuple[Interval, Crossed | None]:
    """Return the interval of a difference of policies, each of one seed or several, and its :class:`Crossed`.

    With fewer than two clusters there are neither bounds nor a :class:`Crossed`.
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
    """Return ``ln(mean(a) / mean(b))`` of values at least 0 with its error (delta method); None if a mean is 0."""
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
