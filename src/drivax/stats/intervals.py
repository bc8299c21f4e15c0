"""Confidence intervals for rates, means and paired differences.

Functions take one value per episode. Undefined values (``None`` or NaN) are ignored and do not count in ``n``.
``clusters`` are labels of the episodes; whole clusters are resampled. Without labels, every episode is a cluster.
``confidence`` is the coverage, ``seed`` the seed of the random numbers.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from drivax.errors import UsageError
from drivax.stats.clusters import (
    Labels,
    Strata,
    Totals,
    Values,
    as_values,
    cluster_strata,
    cluster_totals,
    dense_labels,
    design_effect,
    drop_undefined,
    paired_differences,
)

RESAMPLES = 10_000
#: Random numbers per chunk, which limits each array of them to about 16 MB.
_CHUNK = 2_000_000


@dataclass(frozen=True)
class Interval:
    """An estimate and its interval; ``n`` counts the defined episodes, pairs, trials, values or events.

    ``mean`` is None if ``n`` is 0; a bound is None if it cannot be estimated.
    """

    mean: float | None
    low: float | None
    high: float | None
    n: int

    def as_dict(self) -> dict[str, float | int | None]:
        """Return the four numbers by name, in the format of ``summary.json``."""
        return asdict(self)


UNDEFINED = Interval(None, None, None, 0)


def effective_size(weights: Any) -> float:
    """Return the effective sample size of weights, ``(sum w)^2 / sum w^2`` (Kish, Survey Sampling, 1965), or 0."""
    weights = np.asarray(weights, np.float64)
    squares = float(np.sum(weights**2))
    return float(np.sum(weights)) ** 2 / squares if squares > 0.0 else 0.0


def wilson(successes: float | int, n: float | int, confidence: float = 0.95) -> Interval:
    """Return the score interval of a proportion (Wilson, J. Am. Stat. Assoc. 22, 1927).

    ``centre = (p + z^2 / 2n) / (1 + z^2 / n)``, ``margin = z / (1 + z^2 / n) * sqrt(p (1 - p) / n + z^2 / 4n^2)``;
    always within [0, 1]. The number of trials ``n`` may be fractional (an effective sample size); the result rounds it.
    """
    z = normal_quantile(confidence)
    if not 0 <= successes <= n:
        raise UsageError(f"{successes} successes of {n} trials are impossible", cure="use 0 to n successes")
    if n == 0:
        return UNDEFINED
    p = successes / n
    denominator = 1.0 + z * z / n
    centre = (p + z * z / (2 * n)) / denominator
    margin = z / denominator * float(np.sqrt(p * (1 - p) / n + z * z / (4 * n * n)))
    low = 0.0 if successes == 0 else max(0.0, centre - margin)
    high = 1.0 if successes == n else min(1.0, centre + margin)
    return Interval(float(p), float(low), float(high), round(n))


def rate(values: Any, clusters: Any = None, confidence: float = 0.95) -> Interval:
    """Return the Wilson interval of a share of 0/1 values, optionally in clusters.

    The trials are replaced by the effective sample size ``n / deff`` (Kish 1965; Dean and Pagano, J. Surv.
    Stat. Methodol. 3, 2015) with the design effect of :func:`~drivax.stats.clusters.design_effect`.
    """
    x, labels = drop_undefined(values, clusters)
    if x.size == 0:
        return UNDEFINED
    if not np.isin(x, (0.0, 1.0)).all():
        raise UsageError("a rate takes only 0 and 1", cure="use bootstrap_mean for other values")
    n, p = x.size, float(x.mean())
    effective = n / design_effect(x, labels)
    interval = wilson(p * effective, effective, confidence)
    return Interval(p, interval.low, interval.high, n)


def per_event(events: int, exposure: float, confidence: float = 0.95) -> Interval:
    """Return the exposure per event, such as kilometres per collision, with the exact interval of a Poisson process.

    The rate lies between the quantiles of gamma distributions of ``events`` and ``events + 1`` (Garwood, Biometrika
    28, 1936). ``n`` counts events; without events only the lower bound is known.
    """
    from scipy import special  # takes 0.1 s to import

    normal_quantile(confidence)  # refuses a confidence outside (0, 1)
    if events < 0 or not exposure > 0.0:
        cure = "use 0 or more events and positive exposure"
        raise UsageError(f"{events} events in {exposure} of exposure", cure=cure)
    tail = (1.0 - confidence) / 2.0
    low = exposure / float(special.gammaincinv(events + 1, 1.0 - tail))
    if events == 0:
        return Interval(None, low, None, 0)
    return Interval(exposure / events, low, exposure / float(special.gammaincinv(events, tail)), events)


def bootstrap_mean(
    values: Any, clusters: Any = None, confidence: float = 0.95, resamples: int = RESAMPLES,
    *, strata: Any = None, seed: int,
) -> Interval:  # fmt: skip
    """Return the percentile bootstrap interval of a mean, resampling whole clusters, within strata if given.

    Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section 13.3; clusters: Davison and Hinkley,
    Bootstrap Methods, 1997, section 3.8. A resample draws as many clusters as there are, with replacement; its mean is
    its sum over its number of episodes. Within strata, it draws ``C_h - 1`` of the ``C_h`` clusters of each stratum
    and weights them by ``C_h / (C_h - 1)``, which keeps the variance correct in small strata (Rao, Wu and Yue, Surv.
    Methodol. 18, 1992). Strata of a single cluster are pooled.
    """
    check_draws(resamples, confidence)
    x, labels = drop_undefined(values, clusters)
    if x.size == 0:
        return UNDEFINED
    if strata is not None:
        keep = ~np.isnan(as_values(values))
        strata = cluster_strata(dense_labels(strata, keep.size, "stratum")[keep], labels)
    mean = float(x.mean())
    if labels.max() == 0:
        return Interval(mean, None, None, x.size)
    means = _resample_means(x, labels, strata, resamples, np.random.default_rng(seed))
    return Interval(mean, *percentiles(means, confidence), x.size)


def split_bootstrap(
    values: Any, first: Bool[np.ndarray, " n"], clusters: Any = None, confidence: float = 0.95,
    resamples: int = RESAMPLES, *, strata: Any = None, seed: int,
) -> Interval:  # fmt: skip
    """Return the percentile bootstrap interval of ``mean(first arm) - mean(second arm)``.

    The arms, which must not share a cluster, are resampled separately, as in :func:`bootstrap_mean` (Efron and
    Tibshirani 1993, section 8.3). ``first`` masks the episodes of the first arm.

    Raises:
        UsageError: A cluster is in both arms or in two strata.
    """
    check_draws(resamples, confidence)
    x = as_values(values)
    cluster_labels, defined = dense_labels(clusters, x.size, "cluster"), ~np.isnan(x)
    if np.intersect1d(cluster_labels[first & defined], cluster_labels[~first & defined]).size:
        raise UsageError("a cluster is in both arms", cure="assign whole clusters")
    stratum_labels = None if strata is None else dense_labels(strata, x.size, "stratum")
    rng, arms = np.random.default_rng(seed), []
    for arm in (first, ~first):
        included = arm & defined
        arm_values, labels = drop_undefined(x[included], cluster_labels[included])
        if arm_values.size == 0:
            return UNDEFINED
        arm_strata = None if stratum_labels is None else cluster_strata(stratum_labels[included], labels)
        arms.append((arm_values, labels, arm_strata))
    (a, a_labels, a_strata), (b, b_labels, b_strata) = arms
    difference, n = float(a.mean() - b.mean()), a.size + b.size
    if a_labels.max() == 0 or b_labels.max() == 0:
        return Interval(difference, None, None, n)
    differences = _resample_means(a, a_labels, a_strata, resamples, rng)
    differences -= _resample_means(b, b_labels, b_strata, resamples, rng)
    return Interval(difference, *percentiles(differences, confidence), n)


def paired_bootstrap(
    a: Any, b: Any, clusters: Any = None, confidence: float = 0.95, resamples: int = RESAMPLES, *, seed: int
) -> Interval:
    """Return the percentile bootstrap interval of ``mean(a - b)`` over pairs with two defined values.

    Pairing removes the variation between scenarios that both planners share (Efron and Tibshirani 1993, chapter 8).
    """
    return bootstrap_mean(paired_differences(a, b), clusters, confidence, resamples, seed=seed)


def interquartile_bootstrap(
    values: Any, clusters: Any = None, confidence: float = 0.95, resamples: int = RESAMPLES, *, seed: int
) -> Interval:
    """Return the percentile bootstrap interval of the interquartile mean of the means of training seeds.

    ``values`` are ``[seed, episode]``; ``n`` counts the defined values. Seeds and clusters are crossed: every seed is
    evaluated on every scenario. Both are resampled independently with replacement (Owen, Ann. Appl. Stat. 1, 2007,
    "The pigeonhole bootstrap"). Bootstrap intervals are too narrow with few seeds; see
    :func:`~drivax.stats.seeds.seeds_interval` for means.
    """
    check_draws(resamples, confidence)
    by_seed = [as_values(seed_values) for seed_values in values]
    if not any(seed_values.size for seed_values in by_seed):
        return UNDEFINED
    labels = dense_labels(clusters, by_seed[0].size, "cluster")
    if any(seed_values.size != labels.size for seed_values in by_seed):
        raise UsageError("seeds have different episodes", cure="give one value per seed and episode")
    sums, counts = _seed_totals(np.stack(by_seed), labels)
    # Seeds and clusters without a value are not part of the sample.
    has_values = np.ix_(counts.any(axis=1), counts.any(axis=0))
    sums, counts = sums[has_values], counts[has_values]
    n, (seeds, cluster_count) = int(counts.sum()), sums.shape
    if not n:
        return UNDEFINED
    mean = _interquartile(np.ones(seeds, int), sums.sum(axis=1), counts.sum(axis=1))
    if cluster_count < 2:
        return Interval(mean, None, None, n)
    rng, means = np.random.default_rng(seed), np.empty(resamples)
    for resample in range(resamples):
        cluster_draws, seed_draws = _draw_counts(cluster_count, rng), _draw_counts(seeds, rng)
        means[resample] = _interquartile(seed_draws, sums @ cluster_draws, counts @ cluster_draws)
    return Interval(mean, *percentiles(means, confidence), n)


def _seed_totals(
    x: Float64[np.ndarray, "seed n"], labels: Labels
) -> tuple[Float64[np.ndarray, "seed cluster"], Float64[np.ndarray, "seed cluster"]]:
    """Return sum and number of the defined values of each cluster, by seed."""
    count, valid = int(labels.max()) + 1, ~np.isnan(x)
    sums = [np.bincount(labels, seed_values, count) for seed_values in np.where(valid, x, 0.0)]
    return np.stack(sums), np.stack([np.bincount(labels, mask, count) for mask in valid])


def _draw_counts(count: int, rng: np.random.Generator) -> Labels:
    """Return the number of draws of each of ``count`` units, in ``count`` draws with replacement."""
    return np.bincount(rng.integers(0, count, count), minlength=count)


def interquartile_mean(values: Any) -> float | None:
    """Return the mean of the middle half of the values, for example of training seeds; None without values.

    It is more robust to a failed seed than the mean, and more efficient than the median (Agarwal et al., NeurIPS 2021,
    "Deep reinforcement learning at the edge of the statistical precipice"). The value of rank ``i`` of ``n`` covers
    the quantiles from ``i / n`` to ``(i + 1) / n`` and is weighted by their overlap with [1/4, 3/4].
    """
    x = np.sort(as_values(values))
    x = x[~np.isnan(x)]
    if x.size == 0:
        return None
    edges = np.clip(np.arange(x.size + 1) / x.size, 0.25, 0.75)
    return float(2.0 * np.diff(edges) @ x)


def _interquartile(draws: Labels, sums: Totals, counts: Totals) -> float:
    """Return the interquartile mean of the means of the drawn seeds."""
    means = np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)
    mean = interquartile_mean(np.repeat(means, draws))
    return math.nan if mean is None else mean


def check_draws(resamples: int, confidence: float = 0.95) -> None:
    """Check the arguments of a bootstrap or a permutation test, which has no confidence.

    Raises:
        UsageError: The confidence is outside (0, 1), or there are no resamples.
    """
    normal_quantile(confidence)
    if resamples < 1:
        raise UsageError(f"number of resamples is {resamples}", cure="use 1000 or more")


def normal_quantile(confidence: float) -> float:
    """Return the two-sided quantile z of the standard normal distribution."""
    if not 0 < confidence < 1:
        raise UsageError(f"confidence is {confidence}", cure="use a number between 0 and 1, for example 0.95")
    return NormalDist().inv_cdf((1 + confidence) / 2)


def percentiles(values: Float64[np.ndarray, " resample"], confidence: float) -> tuple[float, float]:
    """Return the bounds of the central share ``confidence`` of resampled values; NaN values are ignored."""
    low, high = np.nanquantile(values, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


def _resample_means(
    x: Values, labels: Labels, strata: Strata | None, resamples: int, rng: np.random.Generator
) -> Float64[np.ndarray, " resample"]:
    """Return means of resamples of whole clusters, within strata if given."""
    sums, counts = cluster_totals(x, labels)
    if strata is None:
        draws = _draw_totals(sums, counts, sums.size, resamples, rng)
        return draws[0] / draws[1]
    total = np.zeros((2, resamples))
    for stratum in range(int(strata.max()) + 1):
        members = strata == stratum
        size = int(members.sum())
        total += size / (size - 1) * _draw_totals(sums[members], counts[members], size - 1, resamples, rng)
    return total[0] / total[1]


def _draw_totals(
    sums: Totals, counts: Totals, draws: int, resamples: int, rng: np.random.Generator
) -> Float64[np.ndarray, "2 resample"]:
    """Return sum and number of the values of ``draws`` clusters drawn with replacement, ``resamples`` times."""
    chunks, equal_counts = [], bool((counts == counts[0]).all())
    for size in chunk_sizes(resamples, draws):
        index = rng.integers(0, sums.size, size=(size, draws), dtype=np.int32)
        total_counts = np.full(size, counts[0] * draws) if equal_counts else counts[index].sum(axis=1)
        chunks.append((sums[index].sum(axis=1), total_counts))
    return np.concatenate(chunks, axis=1)


def chunk_sizes(resamples: int, width: int) -> list[int]:
    """Split resamples of ``width`` random numbers into chunks of bounded memory."""
    chunk = max(1, _CHUNK // max(1, width))
    return [min(chunk, resamples - first) for first in range(0, resamples, chunk)]
