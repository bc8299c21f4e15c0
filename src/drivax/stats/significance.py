"""Significance tests of two planners on the same scenarios, or on two arms of a split.

Every test is two-sided and takes one value per scenario; ``None`` or NaN means undefined and leaves the scenario (or
pair) out. Scenarios of one cluster (recording; None: every scenario is its own) stay together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64
from scipy import special

from drivax.errors import UsageError
from drivax.stats.clusters import Totals, defined, dense, differences, numbers, stratum_of_clusters, totals
from drivax.stats.intervals import RESAMPLES, check_draws, chunk_sizes

#: Resampled statistics this close to the observed one, relative to its size, are ties.
_TIE = 1e-9


@dataclass(frozen=True)
class Evidence:
    """The result of a test.

    Attributes:
        name: Name of the test.
        p: Probability of a difference at least as large under the null hypothesis; None if nothing is defined.
        units: Number of exchanged units: discordant pairs, or clusters whose values differ.
        exact: Whether every permutation was counted, rather than a sample.
    """

    name: str
    p: float | None
    units: int
    exact: bool


def mcnemar(a: Any, b: Any, *, mid: bool = True) -> Evidence:
    """McNemar's test of two rates in independent pairs, exact or mid-p.

    Under the null hypothesis the ``n`` pairs in which only one planner fails (discordant pairs) are tosses of a fair
    coin: ``p = 2 P(X <= k)``, at most 1, with ``X ~ Binomial(n, 1/2)`` and ``k`` the rarer of both (McNemar,
    Psychometrika 12, 1947). The mid-p value, ``p - P(X = k)``, is less conservative and keeps its level nearly always
    (Fagerland, Lydersen and Laake, BMC Med. Res. Methodol. 13:91, 2013). Scenarios are independent.
    """
    for values in (numbers(a), numbers(b)):
        if not np.isin(values[~np.isnan(values)], (0.0, 1.0)).all():
            raise UsageError("McNemar's test takes only 0 and 1", cure="use paired_permutation")
    pairs = differences(a, b)
    name = "McNemar mid-p" if mid else "McNemar exact"
    if np.isnan(pairs).all():
        return Evidence(name, None, 0, exact=True)
    more, fewer = int((pairs > 0).sum()), int((pairs < 0).sum())
    n, k = more + fewer, min(more, fewer)
    at_most = float(special.bdtr(k, n, 0.5)) if n else 1.0
    here = at_most - float(special.bdtr(k - 1, n, 0.5)) if k else at_most
    p = min(1.0, 2.0 * at_most - here) if mid and n else min(1.0, 2.0 * at_most)
    return Evidence(name, p, n, exact=True)


def paired_permutation(
    a: Any, b: Any, clusters: Any = None, resamples: int = RESAMPLES, *, seed: int
) -> Evidence:
    """Permutation test of a mean paired difference: the signs of whole clusters are flipped.

    If the planners are interchangeable, the difference of each cluster has either sign with equal probability
    (Fisher, The Design of Experiments, 1935, section 21; Good, Permutation, Parametric and Bootstrap Tests, 2005,
    section 3.2). All ``2^C`` sign patterns are counted where they are no more than ``resamples``, else random ones:
    ``p = (1 + #{|T*| >= |T|}) / (1 + resamples)`` (Phipson and Smyth, Stat. Appl. Genet. Mol. Biol. 9, 2010). For 0/1
    values in clusters of one this is McNemar's exact test.
    """
    check_draws(0.95, resamples)
    x, labels = defined(differences(a, b), clusters)
    if x.size == 0:
        return Evidence("permutation", None, 0, exact=True)
    sums = totals(x, labels)[0]
    size = np.abs(sums)
    # Clusters without a difference change nothing whatever their sign.
    sums = sums[size > _TIE * size.max()]
    least = abs(float(sums.sum())) - _TIE * float(size.sum())
    if 2.0**sums.size <= resamples:
        signs = 1.0 - 2.0 * (np.arange(2**sums.size)[:, None] >> np.arange(sums.size) & 1)
        return Evidence("permutation", float((np.abs(signs @ sums) >= least).mean()), sums.size, exact=True)
    rng, beyond = np.random.default_rng(seed), 0
    for count in chunk_sizes(resamples, sums.size):
        kept = rng.integers(0, 2, size=(count, sums.size), dtype=np.int8).astype(np.float64)
        beyond += int((np.abs(2.0 * (kept @ sums) - sums.sum()) >= least).sum())
    return Evidence("permutation", (1 + beyond) / (1 + resamples), sums.size, exact=False)


def paired_bootstrap_test(
    a: Any, b: Any, clusters: Any = None, resamples: int = RESAMPLES, *, seed: int
) -> Evidence:
    """Bootstrap test of a mean paired difference without the assumption of symmetry, resampling whole clusters.

    ``t = m / se`` is compared with ``t* = (m* - m) / se*`` of resamples, ``p = (1 + #{|t*| >= |t|}) / (1 + resamples)``
    (Efron and Tibshirani 1993, section 16.4; symmetric bootstrap-t: Hall, The Bootstrap and Edgeworth Expansion, 1992,
    section 3.6), with the standard error of a ratio of totals, ``se^2 = C / (C - 1) sum((S_c - m n_c)^2) / n^2``.
    """
    check_draws(0.95, resamples)
    x, labels = defined(differences(a, b), clusters)
    if x.size == 0 or labels.max() == 0:
        return Evidence("bootstrap", None, 0, exact=False)
    sums, counts = totals(x, labels)
    if not sums.any():
        return Evidence("bootstrap", 1.0, 0, exact=False)
    moments = np.stack((sums, counts, sums * sums, sums * counts, counts * counts), axis=1)
    mean, error = (float(value[0]) for value in _mean_and_error(moments.sum(axis=0)[None], sums.size))
    if error == 0.0:
        return Evidence("bootstrap", 1.0 / (1 + resamples), sums.size, exact=False)
    rng, beyond = np.random.default_rng(seed), 0
    for count in chunk_sizes(resamples, sums.size):
        times = rng.multinomial(sums.size, np.full(sums.size, 1.0 / sums.size), size=count)
        means, errors = _mean_and_error(times @ moments, sums.size)
        # A resample without variance supports the null hypothesis, unless it repeats the mean.
        deviations = np.abs(means - mean)
        beyond += int((deviations >= (abs(mean) / error) * errors - _TIE * abs(mean)).sum())
    return Evidence("bootstrap", (1 + beyond) / (1 + resamples), sums.size, exact=False)


def _mean_and_error(
    moments: Float64[np.ndarray, "resample 5"], clusters: int
) -> tuple[Float64[np.ndarray, " resample"], Float64[np.ndarray, " resample"]]:
    """Mean and its standard error from sums over clusters of S, n, S^2, S n and n^2."""
    s, n, ss, sn, nn = moments.T
    mean = s / n
    variance = clusters / (clusters - 1) * np.maximum(ss - 2 * mean * sn + mean**2 * nn, 0.0) / n**2
    return mean, np.sqrt(variance)


def split_permutation(
    values: Any, first: Bool[np.ndarray, " n"], clusters: Any = None, strata: Any = None,
    resamples: int = RESAMPLES, *, seed: int,
) -> Evidence:  # fmt: skip
    """Permutation test of the means of two arms: whole clusters are reassigned, keeping their number in each arm.

    Under the null hypothesis every assignment is as likely as the observed one, and the test is exact (Fisher 1935;
    Good 2005, section 3.3); strata keep their numbers in each arm. ``first`` marks the scenarios of the first arm.
    Raises UsageError if a cluster is in both arms or in two strata.
    """
    check_draws(0.95, resamples)
    keep = ~np.isnan(numbers(values))
    x, labels = defined(values, clusters)
    arm = first[keep]
    if x.size == 0 or arm.all() or not arm.any():
        return Evidence("permutation", None, 0, exact=False)
    sums, counts = totals(x, labels)
    mine = totals(arm.astype(np.float64), labels)[0] > 0
    if (mine[labels] != arm).any():
        raise UsageError("a cluster is in both arms", cure="assign whole clusters")
    of = np.zeros(sums.size, np.int64)
    if strata is not None:
        of = stratum_of_clusters(dense(strata, keep.size, "stratum")[keep], labels, least=1)
    tie = _TIE * float(np.abs(x).max())
    least = abs(float(_between(mine[None], sums, counts)[0])) - tie
    rng, beyond = np.random.default_rng(seed), 0
    for count in chunk_sizes(resamples, sums.size):
        drawn = np.empty((count, sums.size), bool)
        for stratum in range(int(of.max()) + 1):
            inside = of == stratum
            drawn[:, inside] = rng.permuted(np.tile(mine[inside], (count, 1)), axis=1)
        beyond += int((np.abs(_between(drawn, sums, counts)) >= least).sum())
    return Evidence("permutation", (1 + beyond) / (1 + resamples), sums.size, exact=False)


def _between(
    mine: Bool[np.ndarray, "draw cluster"], sums: Totals, counts: Totals
) -> Float64[np.ndarray, " draw"]:
    """Return the difference of the means of two arms."""
    total, number = (mine.astype(np.float64) @ values for values in (sums, counts))
    return total / number - (sums.sum() - total) / (counts.sum() - number)


def holm(ps: Sequence[float | None]) -> list[float | None]:
    """Holm's adjustment of p-values for multiple tests, valid under any dependence (Holm, Scand. J. Stat. 6, 1979).

    In ascending order ``p_(i)`` becomes the largest of ``(m - j) p_(j)``, ``j`` from 0 to ``i``, at most 1. None
    (nothing to test) does not count in ``m``.
    """
    order = sorted((p, place) for place, p in enumerate(ps) if p is not None)
    adjusted: list[float | None] = [None] * len(ps)
    largest = 0.0
    for rank, (p, place) in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * p))
        adjusted[place] = largest
    return adjusted
