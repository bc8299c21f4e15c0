"""How sure are we: intervals for rates, means and paired differences.

Every function takes one value per episode. ``None`` or NaN means that the metric is undefined there: the
episode is left out and does not count in ``n``. Episodes that share a cluster (a ``segment``: windows of one
recording, seeds of one scenario) are not independent, so whole clusters are resampled. Seeds are explicit;
results are repeatable.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from scipy import special

from drivax.errors import UsageError

RESAMPLES = 10_000
#: Random indices drawn at once: bounds the memory of a bootstrap to about 16 MB.
_CHUNK = 2_000_000


@dataclass(frozen=True)
class Interval:
    """An estimate with its interval and the number of episodes (or pairs) where it was defined.

    ``mean`` is None where nothing is defined; ``low`` and ``high`` are None where the spread cannot be
    estimated (nothing defined, or a bootstrap of a single cluster).
    """

    mean: float | None
    low: float | None
    high: float | None
    n: int

    def as_dict(self) -> dict[str, float | int | None]:
        """The four numbers by name, as ``summary.json`` stores them."""
        return {"mean": self.mean, "low": self.low, "high": self.high, "n": self.n}


NOTHING = Interval(None, None, None, 0)


def wilson(successes: float | int, n: float | int, confidence: float = 0.95) -> Interval:
    """Score interval of a proportion (Wilson, J. Am. Stat. Assoc. 22, 1927).

    ``centre = (p + z^2 / 2n) / (1 + z^2 / n)``,
    ``half = z / (1 + z^2 / n) * sqrt(p (1 - p) / n + z^2 / 4n^2)``; never empty, never outside [0, 1].

    Args:
        successes: Number of successes, 0 to ``n``.
        n: Number of independent trials; may be fractional (an effective sample size).
        confidence: Coverage, between 0 and 1.

    Raises:
        UsageError: If the counts or the confidence are impossible.
    """
    z = _normal_quantile(confidence)
    if not 0 <= successes <= n:
        raise UsageError(
            f"{successes} successes of {n} trials cannot be", cure="count trials and successes again"
        )
    if n == 0:
        return NOTHING
    p = successes / n
    shrink = 1.0 + z * z / n
    centre = (p + z * z / (2 * n)) / shrink
    half = z / shrink * float(np.sqrt(p * (1 - p) / n + z * z / (4 * n * n)))
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == n else min(1.0, centre + half)
    return Interval(float(p), float(low), float(high), round(n))


def rate(values: Any, clusters: Any = None, confidence: float = 0.95) -> Interval:
    """Wilson interval of a share of 0/1 values whose episodes may come in clusters.

    The trials are replaced by the effective sample size ``n / deff`` (Kish 1965; Dean and Pagano, J. Surv.
    Stat. Methodol. 3, 2015). The design effect ``deff`` is the variance of the ratio of cluster totals, ``C /
    (C - 1) * sum((s_c - p m_c)^2) / n^2``, over the binomial ``p (1 - p) / n``, at least 1. Where all values
    agree nothing can be said about the variance, and clusters count as single trials.

    Args:
        values: 0, 1, or undefined, one per episode.
        clusters: Labels of the clusters, one per episode; None: every episode is its own.
        confidence: Coverage, between 0 and 1.

    Raises:
        UsageError: If a value is neither 0 nor 1, or lengths disagree.
    """
    x, labels = _defined(values, clusters)
    if x.size == 0:
        return NOTHING
    if not np.isin(x, (0.0, 1.0)).all():
        raise UsageError("a rate takes only 0 and 1", cure="use bootstrap_mean for other values")
    n, successes = x.size, float(x.sum())
    effective = n / _design_effect(*_totals(x, labels))
    p = successes / n
    found = wilson(p * effective, effective, confidence)
    return Interval(p, found.low, found.high, n)


def bootstrap_mean(
    values: Any,
    clusters: Any = None,
    confidence: float = 0.95,
    resamples: int = RESAMPLES,
    *,
    seed: int,
) -> Interval:
    """Percentile bootstrap interval of a mean, resampling whole clusters.

    Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section 13.3; clusters: Davison and Hinkley,
    Bootstrap Methods, 1997, section 3.8: draw as many clusters as there are, with replacement; the mean of a
    resample is its sum over its number of episodes.

    Args:
        values: Numbers or undefined, one per episode.
        clusters: Labels of the clusters, one per episode; None: every episode is its own.
        confidence: Coverage, between 0 and 1.
        resamples: Number of resamples.
        seed: Seed of the random numbers.

    Raises:
        UsageError: If lengths disagree, a value is infinite, or an option is impossible.
    """
    _normal_quantile(confidence)
    if resamples < 1:
        raise UsageError(f"{resamples} resamples cannot be", cure="use 1000 or more")
    x, labels = _defined(values, clusters)
    if x.size == 0:
        return NOTHING
    sums, counts = _totals(x, labels)
    mean = float(x.mean())
    if sums.size < 2:
        return Interval(mean, None, None, x.size)
    means = _resampled_means(sums, counts, resamples, np.random.default_rng(seed))
    low, high = np.quantile(means, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Interval(mean, float(low), float(high), x.size)


def paired_bootstrap(
    a: Any,
    b: Any,
    clusters: Any = None,
    confidence: float = 0.95,
    resamples: int = RESAMPLES,
    *,
    seed: int,
) -> Interval:
    """Percentile bootstrap interval of ``mean(a - b)`` over the pairs where both are defined.

    Pairing removes the spread between scenarios that both planners share (Efron and Tibshirani 1993, chapter
    8).

    Args:
        a: Numbers or undefined, one per scenario.
        b: The other planner's, in the same order.
        clusters: Labels of the clusters, one per scenario; None: every scenario is its own.
        confidence: Coverage, between 0 and 1.
        resamples: Number of resamples.
        seed: Seed of the random numbers.

    Raises:
        UsageError: If lengths disagree, a value is infinite, or an option is impossible.
    """
    first, second = _numbers(a), _numbers(b)
    if first.shape != second.shape:
        raise UsageError(
            f"pairs need equally many values, not {first.size} and {second.size}",
            cure="pair by scenario first",
        )
    return bootstrap_mean(first - second, clusters, confidence, resamples, seed=seed)


def crossed_bootstrap(
    values: Any,
    clusters: Any = None,
    confidence: float = 0.95,
    resamples: int = RESAMPLES,
    *,
    seed: int,
) -> Interval:
    """Percentile bootstrap interval of a mean over agents (training seeds) and episodes, both resampled.

    Agents and clusters are crossed: every agent drove every scenario. Each resample draws as many of both as there are,
    independently and with replacement, which for crossed factors is at worst too wide (Owen, Ann. Appl. Stat. 1, 2007,
    "The pigeonhole bootstrap").

    Args:
        values: ``[agents, episodes]``; numbers or undefined.
        clusters: Labels of the clusters, one per episode; None: every episode is its own.
        confidence: Coverage, between 0 and 1.
        resamples: Number of resamples.
        seed: Seed of the random numbers.

    Raises:
        UsageError: If lengths disagree, a value is infinite, or an option is impossible.
    """
    _normal_quantile(confidence)
    if resamples < 1:
        raise UsageError(f"{resamples} resamples cannot be", cure="use 1000 or more")
    rows = [_numbers(row) for row in values]
    labels = np.arange(rows[0].size) if clusters is None else np.unique(clusters, return_inverse=True)[1]
    if any(row.size != labels.size for row in rows):
        raise UsageError("agents drove different episodes", cure="give one value per agent and episode")
    x = np.stack(rows)
    there = ~np.isnan(x)
    count = int(labels.max()) + 1
    sums = np.stack(
        [np.bincount(labels, np.where(one, row, 0.0), count) for row, one in zip(x, there, strict=True)]
    )
    counts = np.stack([np.bincount(labels, one, count) for one in there])
    if not there.any():
        return NOTHING
    mean, n = float(sums.sum() / counts.sum()), int(there.sum())
    if count < 2:
        return Interval(mean, None, None, n)
    rng = np.random.default_rng(seed)
    means = np.empty(resamples)
    for number in range(resamples):
        agents = np.bincount(rng.integers(0, len(x), len(x)), minlength=len(x))
        drawn = np.bincount(rng.integers(0, count, count), minlength=count)
        means[number] = _ratio(float(agents @ sums @ drawn), float(agents @ counts @ drawn))
    low, high = np.nanquantile(means, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Interval(mean, float(low), float(high), n)


def _ratio(total: float, count: float) -> float:
    """A mean; NaN of nothing, which a resample of sparse values may be."""
    return total / count if count else float("nan")


def _normal_quantile(confidence: float) -> float:
    """Two-sided quantile z of the standard normal distribution."""
    if not 0 < confidence < 1:
        raise UsageError(
            f"a confidence of {confidence} cannot be", cure="use a number between 0 and 1, as 0.95"
        )
    return float(special.ndtri((1 + confidence) / 2))


def _numbers(values: Any) -> Float64[np.ndarray, " n"]:
    """Values as float64 with NaN where undefined."""
    x = np.asarray(values, dtype=np.float64)
    if x.ndim != 1 or np.isinf(x).any():
        raise UsageError(
            "values must be a list of finite numbers, NaN or None", cure="leave infinite ones undefined"
        )
    return x


def _defined(values: Any, clusters: Any) -> tuple[Float64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
    """The defined values and the dense number of the cluster of each."""
    x = _numbers(values)
    if clusters is not None and len(clusters) != x.size:
        raise UsageError(
            f"{len(clusters)} cluster labels for {x.size} values", cure="give one cluster label per value"
        )
    keep = ~np.isnan(x)
    labels = np.arange(x.size) if clusters is None else np.asarray(clusters)
    dense = np.unique(labels[keep], return_inverse=True)[1]
    return x[keep], dense.astype(np.int64)


def _totals(
    x: Float64[np.ndarray, " n"], labels: Int64[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, " cluster"], Float64[np.ndarray, " cluster"]]:
    """Sum and number of the values of each cluster."""
    return np.bincount(labels, weights=x), np.bincount(labels).astype(np.float64)


def _design_effect(sums: Float64[np.ndarray, " cluster"], counts: Float64[np.ndarray, " cluster"]) -> float:
    """How much larger the variance of a share is than for independent trials; between 1 and n / 1."""
    n, clusters = float(counts.sum()), counts.size
    p = float(sums.sum()) / n
    if clusters == n:
        return 1.0
    if clusters == 1 or p in (0.0, 1.0):
        return n / clusters
    variance = clusters / (clusters - 1) * float(np.square(sums - p * counts).sum()) / n**2
    return min(max(1.0, variance / (p * (1 - p) / n)), n)


def _resampled_means(
    sums: Float64[np.ndarray, " cluster"],
    counts: Float64[np.ndarray, " cluster"],
    resamples: int,
    rng: np.random.Generator,
) -> Float64[np.ndarray, " resample"]:
    """Means of ``resamples`` draws of as many clusters as there are, with replacement."""
    clusters = sums.size
    means = np.empty(resamples)
    rows = max(1, _CHUNK // clusters)
    same = bool((counts == counts[0]).all())
    for begin in range(0, resamples, rows):
        end = min(begin + rows, resamples)
        drawn = rng.integers(0, clusters, size=(end - begin, clusters), dtype=np.int32)
        total = counts[0] * clusters if same else counts[drawn].sum(axis=1)
        means[begin:end] = sums[drawn].sum(axis=1) / total
    return means
