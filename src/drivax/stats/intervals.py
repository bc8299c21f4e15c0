"""How sure are we: intervals for rates, means and paired differences.

Every function takes one value per episode. ``None`` or NaN means that the metric is undefined there: the
episode is left out and does not count in ``n``. Episodes that share a cluster (a ``segment``: windows of one
recording, seeds of one scenario) are not independent, so whole clusters are resampled, within strata where these are
given. Seeds are explicit; results are repeatable. Tests are in ``hypotheses``, effect sizes and power in ``effects``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64
from scipy import special

from drivax.errors import UsageError
from drivax.stats.clusters import (
    Labels,
    Strata,
    Totals,
    Values,
    defined,
    dense,
    design_effect,
    differences,
    numbers,
    stratum_of_clusters,
    totals,
)

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


def effective_size(weights: Any) -> float:
    """``(sum w)^2 / sum w^2``: how many of equal weight tell as much (Kish, Survey Sampling, 1965); 0 without any."""
    weights = np.asarray(weights, np.float64)
    squares = float(np.sum(weights**2))
    return float(np.sum(weights)) ** 2 / squares if squares > 0.0 else 0.0


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
    z = normal_quantile(confidence)
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
    Stat. Methodol. 3, 2015) with the design effect of :func:`~drivax.stats.clusters.design_effect`.

    Args:
        values: 0, 1, or undefined, one per episode.
        clusters: Labels of the clusters, one per episode; None: every episode is its own.
        confidence: Coverage, between 0 and 1.

    Raises:
        UsageError: If a value is neither 0 nor 1, or lengths disagree.
    """
    x, labels = defined(values, clusters)
    if x.size == 0:
        return NOTHING
    if not np.isin(x, (0.0, 1.0)).all():
        raise UsageError("a rate takes only 0 and 1", cure="use bootstrap_mean for other values")
    n, p = x.size, float(x.mean())
    effective = n / design_effect(x, labels)
    found = wilson(p * effective, effective, confidence)
    return Interval(p, found.low, found.high, n)


def bootstrap_mean(
    values: Any,
    clusters: Any = None,
    confidence: float = 0.95,
    resamples: int = RESAMPLES,
    *,
    strata: Any = None,
    seed: int,
) -> Interval:
    """Percentile bootstrap interval of a mean, resampling whole clusters, within strata where these are given.

    Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section 13.3; clusters: Davison and Hinkley,
    Bootstrap Methods, 1997, section 3.8: draw as many clusters as there are, with replacement; the mean of a
    resample is its sum over its number of episodes. Strata: of the ``C_h`` clusters of each draw ``C_h - 1`` and weigh
    them by ``C_h / (C_h - 1)``, so that the variance is right however small strata are (Rao, Wu and Yue, Surv.
    Methodol. 18, 1992).

    Args:
        values: Numbers or undefined, one per episode.
        clusters: Labels of the clusters, one per episode; None: every episode is its own.
        confidence: Coverage, between 0 and 1.
        resamples: Number of resamples.
        strata: Labels of the strata, one per episode, the same throughout a cluster; None: no strata. Those of a
            single cluster are taken together.
        seed: Seed of the random numbers.

    Raises:
        UsageError: If lengths disagree, a value is infinite, a cluster lies in two strata, or an option is impossible.
    """
    check_draws(confidence, resamples)
    x, labels = defined(values, clusters)
    if x.size == 0:
        return NOTHING
    of = None
    if strata is not None:
        keep = ~np.isnan(numbers(values))
        of = stratum_of_clusters(dense(strata, keep.size, "stratum")[keep], labels)
    mean = float(x.mean())
    if labels.max() == 0:
        return Interval(mean, None, None, x.size)
    means = _resampled_means(x, labels, of, resamples, np.random.default_rng(seed))
    return Interval(mean, *_percentiles(means, confidence), x.size)


def split_bootstrap(
    values: Any,
    first: Bool[np.ndarray, " n"],
    clusters: Any = None,
    confidence: float = 0.95,
    resamples: int = RESAMPLES,
    *,
    strata: Any = None,
    seed: int,
) -> Interval:
    """Percentile bootstrap interval of the difference of the means of two arms that share no cluster, first - second.

    Each arm is resampled by itself, as :func:`bootstrap_mean` does (Efron and Tibshirani 1993, section 8.3).

    Args:
        values: Numbers or undefined, one per episode.
        first: Which episodes belong to the first arm.
        clusters: As for :func:`bootstrap_mean`, as the rest.
        confidence: Coverage, between 0 and 1.
        resamples: Number of resamples.
        strata: Labels of the strata.
        seed: Seed of the random numbers.

    Raises:
        UsageError: As :func:`bootstrap_mean`.
    """
    check_draws(confidence, resamples)
    x = numbers(values)
    rng, parts = np.random.default_rng(seed), []
    of = None if strata is None else dense(strata, x.size, "stratum")
    for arm in (first, ~first):
        chosen = arm & ~np.isnan(x)
        part, labels = defined(x[chosen], dense(clusters, x.size, "cluster")[chosen])
        if part.size == 0:
            return NOTHING
        parts.append((part, labels, None if of is None else stratum_of_clusters(of[chosen], labels)))
    mean, n = float(parts[0][0].mean() - parts[1][0].mean()), sum(part.size for part, _, _ in parts)
    if min(labels.max() for _, labels, _ in parts) == 0:
        return Interval(mean, None, None, n)
    means = [_resampled_means(part, labels, own, resamples, rng) for part, labels, own in parts]
    return Interval(mean, *_percentiles(means[0] - means[1], confidence), n)


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
    return bootstrap_mean(differences(a, b), clusters, confidence, resamples, seed=seed)


def interquartile_bootstrap(
    values: Any,
    clusters: Any = None,
    confidence: float = 0.95,
    resamples: int = RESAMPLES,
    *,
    seed: int,
) -> Interval:
    """Percentile bootstrap interval of the interquartile mean over agents (training seeds) of their mean episode.

    Agents and clusters are crossed: every agent drove every scenario. Each resample draws as many of both as there are,
    independently and with replacement (Owen, Ann. Appl. Stat. 1, 2007, "The pigeonhole bootstrap"). Of a few agents it
    is too narrow, as bootstraps of few things are; means have :func:`~drivax.stats.seeds.agents_interval`.

    Args:
        values: ``[agents, episodes]``; numbers or undefined.
        clusters: Labels of the clusters, one per episode; None: every episode is its own.
        confidence: Coverage, between 0 and 1.
        resamples: Number of resamples.
        seed: Seed of the random numbers.

    Returns:
        ``n`` counts the values of the agents.

    Raises:
        UsageError: If lengths disagree, a value is infinite, or an option is impossible.
    """
    check_draws(confidence, resamples)
    rows = [numbers(row) for row in values]
    labels = dense(clusters, rows[0].size, "cluster")
    if any(row.size != labels.size for row in rows):
        raise UsageError("agents drove different episodes", cure="give one value per agent and episode")
    sums, counts = _agent_totals(np.stack(rows), labels)
    n, (agents, number) = int(counts.sum()), sums.shape
    if not n:
        return NOTHING
    mean = _interquartile(np.ones(agents, int), sums.sum(axis=1), counts.sum(axis=1))
    if number < 2:
        return Interval(mean, None, None, n)
    rng, means = np.random.default_rng(seed), np.empty(resamples)
    for at in range(resamples):
        drawn, of = _times_drawn(number, rng), _times_drawn(agents, rng)
        means[at] = _interquartile(of, sums @ drawn, counts @ drawn)
    return Interval(mean, *_percentiles(means, confidence), n)


def _agent_totals(
    x: Float64[np.ndarray, "agent n"], labels: Labels
) -> tuple[Float64[np.ndarray, "agent cluster"], Float64[np.ndarray, "agent cluster"]]:
    """Sum and number of the defined values of each cluster, agent by agent."""
    count, there = int(labels.max()) + 1, ~np.isnan(x)
    rows = list(zip(x, there, strict=True))
    sums = np.stack([np.bincount(labels, np.where(one, row, 0.0), count) for row, one in rows])
    return sums, np.stack([np.bincount(labels, one, count) for _, one in rows])


def _times_drawn(count: int, rng: np.random.Generator) -> Labels:
    """How often each of ``count`` things comes in as many draws with replacement."""
    return np.bincount(rng.integers(0, count, count), minlength=count)


def interquartile_mean(values: Any) -> float | None:
    """Mean of the middle half of the values, as of the agents of one training; None of nothing.

    Less moved by one failed agent than the mean, and it uses more than the median does (Agarwal et al., NeurIPS 2021,
    "Deep reinforcement learning at the edge of the statistical precipice"). The value of rank ``i`` of ``n`` stands for
    the quantiles from ``i / n`` to ``(i + 1) / n`` and counts by how much of them lies between 1/4 and 3/4, so that it
    is defined for any number; of three values the outer ones count a sixth each.
    """
    x = np.sort(numbers(values))
    x = x[~np.isnan(x)]
    if x.size == 0:
        return None
    edges = np.clip(np.arange(x.size + 1) / x.size, 0.25, 0.75)
    return float(2.0 * np.diff(edges) @ x)


def _interquartile(agents: Labels, sums: Totals, counts: Totals) -> float:
    """Interquartile mean of the means of the agents that were drawn."""
    means = np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)
    found = interquartile_mean(np.repeat(means, agents))
    return float("nan") if found is None else found


def check_draws(confidence: float, resamples: int) -> None:
    """Refuses an impossible confidence or number of resamples.

    Raises:
        UsageError: They are.
    """
    normal_quantile(confidence)
    if resamples < 1:
        raise UsageError(f"{resamples} resamples cannot be", cure="use 1000 or more")


def normal_quantile(confidence: float) -> float:
    """Two-sided quantile z of the standard normal distribution.

    Raises:
        UsageError: If the confidence is not between 0 and 1.
    """
    if not 0 < confidence < 1:
        raise UsageError(
            f"a confidence of {confidence} cannot be", cure="use a number between 0 and 1, as 0.95"
        )
    return float(special.ndtri((1 + confidence) / 2))


def _percentiles(found: Float64[np.ndarray, " resample"], confidence: float) -> tuple[float, float]:
    """The bounds that leave out as much on either side."""
    low, high = np.nanquantile(found, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


def _resampled_means(
    x: Values, labels: Labels, strata: Strata | None, resamples: int, rng: np.random.Generator
) -> Float64[np.ndarray, " resample"]:
    """Means of resamples of whole clusters, within the strata of the clusters."""
    sums, counts = totals(x, labels)
    if strata is None:
        drawn = _drawn_totals(sums, counts, sums.size, resamples, rng)
        return drawn[0] / drawn[1]
    total = np.zeros((2, resamples))
    for stratum in range(int(strata.max()) + 1):
        inside = strata == stratum
        size = int(inside.sum())
        total += size / (size - 1) * _drawn_totals(sums[inside], counts[inside], size - 1, resamples, rng)
    return total[0] / total[1]


def _drawn_totals(
    sums: Totals, counts: Totals, draws: int, resamples: int, rng: np.random.Generator
) -> Float64[np.ndarray, "2 resample"]:
    """Sum and number of the values of ``resamples`` times ``draws`` clusters, drawn with replacement."""
    found = np.empty((2, resamples))
    rows = max(1, _CHUNK // draws)
    same = bool((counts == counts[0]).all())
    for begin in range(0, resamples, rows):
        end = min(begin + rows, resamples)
        drawn = rng.integers(0, sums.size, size=(end - begin, draws), dtype=np.int32)
        found[0, begin:end] = sums[drawn].sum(axis=1)
        found[1, begin:end] = counts[0] * draws if same else counts[drawn].sum(axis=1)
    return found
