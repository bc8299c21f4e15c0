"""Differences between policies trained with several seeds: seeds and scenarios are crossed random effects.

The variances of seeds and scenarios are added, so that intervals cover other seeds and other scenarios. Values have a
row per seed and a column per scenario. Scenarios with weight 0 or an undefined value are ignored. ``clusters`` are
labels of scenarios; by default every scenario is a cluster.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from drivax.errors import UsageError
from drivax.stats.clusters import Labels, dense_labels
from drivax.stats.effects import ROUNDING
from drivax.stats.intervals import Interval, effective_size, normal_quantile, wilson

Values = Float64[np.ndarray, "seed scenario"]
#: Values of another policy, with its own number of seeds.
OtherValues = Float64[np.ndarray, "other_seed other_scenario"]
Weights = Float64[np.ndarray, " scenario"]
#: Defaults of a planned comparison.
_CONFIDENCE, _POWER = 0.95, 0.80
#: Upper bound of degrees of freedom, which may be infinite.
_MAX_FREEDOM = 1e9
#: Largest number of seeds or clusters to consider, and number of candidates up to it.
_MAX_NUMBER, _CANDIDATES = 10**6, 400


@dataclass(frozen=True)
class CrossedEffect:
    """Mean difference of two policies with several seeds each, all evaluated on the same scenarios.

    The squared standard error is ``se^2 = s_a^2 / K_a + s_b^2 / K_b + v - e_a - e_b``, at least the larger of the
    variances of seeds and of scenarios. Its terms are

    - the variances of the seed means;
    - the variance of the mean over scenarios by clusters, ``v = C / (C - 1) sum((S_c - m W_c)^2) / W^2`` (a ratio of
      totals; Cochran, Sampling Techniques, 1977, section 6.3);
    - for each policy, the interaction of seeds and scenarios, which both variances contain,
      ``e = C / (C - 1) sum(R_kc^2) / (K (K - 1) W^2)`` with totals ``R_kc`` of the residuals of a two-way layout
      (Owen, Ann. Appl. Stat. 1, 2007).

    Degrees of freedom are those of Satterthwaite (Biometrics Bulletin 2, 1946).

    Attributes:
        difference: Mean difference.
        seeds: Variance from the choice of seeds, by policy.
        scenarios: Variance from the choice of scenarios.
        seed_counts: Number of seeds, by policy.
        clusters: Number of clusters.
        interaction: Variance of the interaction, by policy.
    """

    difference: float
    seeds: tuple[float, float]
    scenarios: float
    seed_counts: tuple[int, int]
    clusters: int
    interaction: tuple[float, float] = (0.0, 0.0)

    @property
    def standard_error(self) -> float:
        """Standard error of the difference."""
        seed_variance = sum(self.seeds)
        variance = seed_variance + self.scenarios - sum(self.interaction)
        return math.sqrt(max(variance, seed_variance, self.scenarios))

    @property
    def degrees_of_freedom(self) -> float:
        """Degrees of freedom; infinite if nothing varies."""
        variances = (*self.seeds, self.scenarios)
        dofs = (*(count - 1 for count in self.seed_counts), self.clusters - 1)
        denominator = sum(v**2 / dof for v, dof in zip(variances, dofs, strict=True) if v > 0.0)
        return self.standard_error**4 / denominator if denominator > 0.0 else math.inf

    @property
    def p(self) -> float:
        """Two-sided p-value of the null hypothesis of no difference."""
        if self.standard_error == 0.0:
            return 1.0 if self.difference == 0.0 else 0.0
        return 2.0 * self._probability(-abs(self.difference) / self.standard_error)

    def interval(self, confidence: float = _CONFIDENCE) -> tuple[float, float]:
        """Return the confidence interval of the difference."""
        margin = self._critical(confidence) * self.standard_error
        return self.difference - margin, self.difference + margin

    def detectable(self, power: float = _POWER, confidence: float = _CONFIDENCE) -> float:
        """Return the smallest difference that is detected with probability ``power``."""
        if not 0.0 < power < 1.0:
            raise UsageError(f"power {power} is impossible", cure="give a power between 0 and 1")
        return self.standard_error * (self._critical(confidence) + self._quantile(power))

    def power(self, difference: float, confidence: float = _CONFIDENCE) -> float:
        """Return the probability of detecting a difference of this size."""
        if self.standard_error == 0.0:
            return float(difference != 0.0)
        return self._probability(abs(difference) / self.standard_error - self._critical(confidence))

    def seeds_needed(self, power: float = _POWER, confidence: float = _CONFIDENCE) -> int | None:
        """Return the smallest number of seeds per policy above the current one that detects the difference, or None."""
        return self._smallest_number(self.with_seeds, max(self.seed_counts), power, confidence)

    def clusters_needed(self, power: float = _POWER, confidence: float = _CONFIDENCE) -> int | None:
        """Return the smallest number of clusters above the current one that detects the difference, or None."""
        return self._smallest_number(self.with_clusters, self.clusters, power, confidence)

    def _probability(self, t: float) -> float:
        from scipy import special  # takes 0.1 s to import

        return float(special.stdtr(min(self.degrees_of_freedom, _MAX_FREEDOM), t))

    def _quantile(self, share: float) -> float:
        from scipy import special  # takes 0.1 s to import

        return float(special.stdtrit(min(self.degrees_of_freedom, _MAX_FREEDOM), share))

    def _critical(self, confidence: float) -> float:
        """Return the two-sided critical value of t."""
        normal_quantile(confidence)  # refuses a confidence outside (0, 1)
        return self._quantile((1.0 + confidence) / 2.0)

    def with_seeds(self, number: int) -> CrossedEffect:
        """Extrapolate to ``number`` seeds of each policy with the same variance."""
        (a, b), (e_a, e_b) = self.seeds, self.interaction
        share_a, share_b = (count / number for count in self.seed_counts)
        interaction = e_a * share_a, e_b * share_b
        scenarios = max(self.scenarios - sum(self.interaction), 0.0) + sum(interaction)
        seeds, counts = (a * share_a, b * share_b), (number, number)
        return replace(self, seeds=seeds, scenarios=scenarios, seed_counts=counts, interaction=interaction)

    def with_clusters(self, number: int) -> CrossedEffect:
        """Extrapolate to ``number`` clusters with the same variance."""
        (a, b), (e_a, e_b), share = self.seeds, self.interaction, self.clusters / number
        seeds = max(a - e_a, 0.0) + e_a * share, max(b - e_b, 0.0) + e_b * share
        scenarios, interaction = self.scenarios * share, (e_a * share, e_b * share)
        return replace(self, seeds=seeds, scenarios=scenarios, clusters=number, interaction=interaction)

    def _smallest_number(
        self, extrapolate: Callable[[int], CrossedEffect], current: int, power: float, confidence: float
    ) -> int | None:
        """Return the smallest number above ``current`` that detects this difference; None if there is none."""

        def detects(number: int) -> bool:
            return abs(self.difference) >= extrapolate(number).detectable(power, confidence)

        # Detection is not monotonic: as one number grows, the degrees of freedom approach those of the other.
        candidates = np.geomspace(current + 1, max(_MAX_NUMBER, current + 1), _CANDIDATES)
        numbers = np.unique(np.round(candidates)).astype(int).tolist()
        first = next((index for index, number in enumerate(numbers) if detects(number)), None)
        if self.difference == 0.0 or first is None:  # without an error, 0 >= 0 holds
            return None
        low, high = (numbers[first - 1] if first else current), numbers[first]
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if detects(middle) else (middle, high)
        return high


def crossed_mean(values: Values, clusters: Any = None, weights: Weights | None = None) -> CrossedEffect:
    """Return the mean of one policy with the error of :func:`crossed_difference`; a single seed has no variance.

    For a paired comparison of two policies, pass the differences of their values by seed.

    Raises:
        UsageError: There are fewer than two clusters.
    """
    return crossed_difference(repeat_single_seed(values), np.zeros((2, values.shape[1])), clusters, weights)


def repeat_single_seed(values: Values) -> OtherValues:
    """Repeat the values of a single seed, so that it has no variance, as for a planner without training."""
    return values if len(values) > 1 else np.repeat(values, 2, axis=0)


def seeds_interval(
    values: Values, clusters: Any = None, weights: Weights | None = None, confidence: float = _CONFIDENCE, *,
    share: bool = False,
) -> Interval:  # fmt: skip
    """Return the mean of one policy with the interval of :func:`crossed_mean`.

    The interval has no bounds with fewer than two clusters. That of a ``share`` lies within 0 and 1; if all its values
    are 0, or all are 1, it is Wilson's interval with one trial per cluster (with weights, their effective sample size,
    Kish 1965).
    """
    weight, keep = _weights_and_mask(values, values, weights)
    n = int(keep.sum())
    labels = dense_labels(clusters, values.shape[1], "cluster")
    if np.unique(labels[keep]).size < 2:
        mean = float(np.average(values[:, keep].mean(axis=0), weights=weight[keep])) if n else None
        return Interval(mean, None, None, n)
    effect = crossed_mean(values, labels, weights)
    low, high = effect.interval(confidence)
    distinct = np.unique(values[:, keep])
    if share and distinct.size == 1 and distinct[0] in (0.0, 1.0):
        mass = np.bincount(labels[keep], weight[keep])
        trials = effect.clusters if weights is None else effective_size(mass)
        return replace(wilson(float(distinct[0]) * trials, trials, confidence), n=n)
    if share:
        low, high = max(low, 0.0), min(high, 1.0)
    return Interval(effect.difference, low, high, n)


def crossed_difference(
    a: Values, b: OtherValues, clusters: Any = None, weights: Weights | None = None
) -> CrossedEffect:
    """Return the difference of the means of two policies.

    Raises:
        UsageError: A policy has fewer than two seeds, or there are fewer than two clusters.
    """
    if a.shape[1] != b.shape[1]:
        raise UsageError("seeds have different scenarios", cure="give one value per seed and scenario")
    labels = dense_labels(clusters, a.shape[1], "cluster")
    weight, keep = _weights_and_mask(a, b, weights)
    labels = np.unique(labels[keep], return_inverse=True)[1]
    if min(len(a), len(b)) < 2 or not keep.any() or labels.max() < 1:
        cure = "train two seeds or more of each, and evaluate on two recordings or more"
        raise UsageError("too few seeds or recordings to estimate a variance", cure=cure)
    share, cluster_count = weight[keep] / weight[keep].sum(), int(labels.max()) + 1
    correction, a, b = cluster_count / (cluster_count - 1), a[:, keep], b[:, keep]
    difference = a.mean(axis=0) - b.mean(axis=0)
    # Remove the rounding errors of sums.
    rounding = ROUNDING * max(float(np.abs(a).max()), float(np.abs(b).max()))
    difference = np.where(np.abs(difference) <= rounding, 0.0, difference)
    mean = float(difference @ share)
    totals = np.bincount(labels, share * (difference - mean), cluster_count)
    scenarios = correction * float(np.square(totals).sum())
    seeds_a, interaction_a = _seed_variances(a, share, labels, correction)
    seeds_b, interaction_b = _seed_variances(b, share, labels, correction)
    seeds, interaction = (seeds_a, seeds_b), (interaction_a, interaction_b)
    return CrossedEffect(mean, seeds, scenarios, (len(a), len(b)), cluster_count, interaction)


def _seed_variances(values: Values, share: Weights, labels: Labels, correction: float) -> tuple[float, float]:
    """Return the variances from the choice of seeds and of the interaction of one policy."""
    seed_means, seed_count = values @ share, len(values)
    residuals = (values - seed_means[:, None] - values.mean(axis=0) + seed_means.mean()) * share
    totals = np.stack([np.bincount(labels, residual) for residual in residuals])
    interaction = correction * float(np.square(totals).sum()) / (seed_count * (seed_count - 1))
    return float(seed_means.var(ddof=1)) / seed_count, interaction


def difference_interval(
    a: Values, b: OtherValues, clusters: Any = None, confidence: float = _CONFIDENCE
) -> tuple[Interval, CrossedEffect | None]:
    """Return the interval of the difference of two policies, of one or several seeds, and its :class:`CrossedEffect`.

    With fewer than two clusters, the interval has no bounds and the effect is None.
    """
    _, keep = _weights_and_mask(a, b, None)
    n = int(keep.sum())
    labels = dense_labels(clusters, a.shape[1], "cluster")
    if np.unique(labels[keep]).size < 2:
        mean = float(a[:, keep].mean() - b[:, keep].mean()) if n else None
        return Interval(mean, None, None, n), None
    effect = crossed_difference(repeat_single_seed(a), repeat_single_seed(b), labels)
    return Interval(effect.difference, *effect.interval(confidence), n), effect


def log_ratio(
    a: Values, b: OtherValues, clusters: Any = None, weights: Weights | None = None
) -> CrossedEffect | None:
    """Return ``ln(mean(a) / mean(b))`` with its error (delta method); None unless both means exist and are positive.

    Raises:
        UsageError: As in :func:`crossed_difference`.
    """
    weight, keep = _weights_and_mask(a, b, weights)
    if not keep.any():
        return None
    means = [float(np.average(values[:, keep].mean(axis=0), weights=weight[keep])) for values in (a, b)]
    if min(means) <= 0.0:
        return None
    relative_effect = crossed_difference(a / means[0], b / means[1], clusters, weights)
    return replace(relative_effect, difference=math.log(means[0] / means[1]))


def _weights_and_mask(
    a: Values, b: OtherValues, weights: Weights | None
) -> tuple[Float64[np.ndarray, " scenario"], Bool[np.ndarray, " scenario"]]:
    """Return the weight of each scenario, and the mask of those with a positive weight and only defined values."""
    weight = np.ones(a.shape[1]) if weights is None else np.asarray(weights, np.float64)
    return weight, np.asarray(~np.isnan(np.concatenate([a, b])).any(axis=0) & (weight > 0.0))
