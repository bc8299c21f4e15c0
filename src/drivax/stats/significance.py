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
from drivax.stats.clusters import (
    Totals,
    as_values,
    cluster_strata,
    cluster_totals,
    dense_labels,
    drop_undefined,
    paired_differences,
)
from drivax.stats.intervals import RESAMPLES, check_draws, chunk_sizes

#: Resampled statistics this close to the observed one, relative to its size, are ties.
_TIE = 1e-9


@dataclass(frozen=True)
class SignificanceResult:
    """Result of a significance test.

    Attributes:
        name: Name of the test.
        p: Two-sided p-value; None if no value is defined.
        units: Number of exchangeable units: discordant pairs, or clusters whose values differ.
        exact: Whether the p-value is exact (closed form, or all permutations) rather than sampled.
    """

    name: str
    p: float | None
    units: int
    exact: bool


def mcnemar_test(a: Any, b: Any, *, mid: bool = True) -> SignificanceResult:
    """McNemar's test of two rates in independent pairs, exact or mid-p.

    Under the null hypothesis, either planner is equally likely to be the only one that fails in each of the ``n``
    discordant pairs: ``p = 2 P(X <= k)``, at most 1, with ``X ~ Binomial(n, 1/2)`` and ``k`` the smaller of the two
    counts (McNemar, Psychometrika 12, 1947). The mid-p value, ``p - P(X = k)``, is less conservative and nearly always
    keeps its level (Fagerland, Lydersen and Laake, BMC Med. Res. Methodol. 13:91, 2013).
    """
    for values in (as_values(a), as_values(b)):
        if not np.isin(values[~np.isnan(values)], (0.0, 1.0)).all():
            raise UsageError("McNemar's test takes only 0 and 1", cure="use paired_permutation")
    pairs = paired_differences(a, b)
    name = "McNemar mid-p" if mid else "McNemar exact"
    if np.isnan(pairs).all():
        return SignificanceResult(name, None, 0, exact=True)
    more, fewer = int((pairs > 0).sum()), int((pairs < 0).sum())
    n, k = more + fewer, min(more, fewer)
    cdf = float(special.bdtr(k, n, 0.5)) if n else 1.0
    pmf = cdf - float(special.bdtr(k - 1, n, 0.5)) if k else cdf
    p = min(1.0, 2.0 * cdf - pmf) if mid and n else min(1.0, 2.0 * cdf)
    return SignificanceResult(name, p, n, exact=True)


def paired_permutation(
    a: Any, b: Any, clusters: Any = None, resamples: int = RESAMPLES, *, seed: int
) -> SignificanceResult:
    """Sign-flipping permutation test of a mean paired difference, by cluster.

    If the planners are interchangeable, the difference of each cluster has either sign with equal probability
    (Fisher, The Design of Experiments, 1935, section 21; Good, Permutation, Parametric and Bootstrap Tests, 2005,
    section 3.2). All ``2^C`` sign patterns are enumerated if there are at most ``resamples``; otherwise ``resamples``
    random ones are drawn and ``p = (1 + #{|T*| >= |T|}) / (1 + resamples)`` (Phipson and Smyth, Stat. Appl. Genet. Mol.
    Biol. 9, 2010). For 0/1 values in clusters of one this is McNemar's exact test.
    """
    check_draws(0.95, resamples)
    x, labels = drop_undefined(paired_differences(a, b), clusters)
    if x.size == 0:
        return SignificanceResult("permutation", None, 0, exact=True)
    sums = cluster_totals(x, labels)[0]
    size = np.abs(sums)
    # Clusters without a difference do not change the statistic.
    sums = sums[size > _TIE * size.max()]
    threshold = abs(float(sums.sum())) - _TIE * float(size.sum())
    if 2.0**sums.size <= resamples:
        signs = 1.0 - 2.0 * (np.arange(2**sums.size)[:, None] >> np.arange(sums.size) & 1)
        p = float((np.abs(signs @ sums) >= threshold).mean())
        return SignificanceResult("permutation", p, sums.size, exact=True)
    rng, extreme = np.random.default_rng(seed), 0
    for count in chunk_sizes(resamples, sums.size):
        positive = rng.integers(0, 2, size=(count, sums.size), dtype=np.int8).astype(np.float64)
        extreme += int((np.abs(2.0 * (positive @ sums) - sums.sum()) >= threshold).sum())
    return SignificanceResult("permutation", (1 + extreme) / (1 + resamples), sums.size, exact=False)


def paired_bootstrap_test(
    a: Any, b: Any, clusters: Any = None, resamples: int = RESAMPLES, *, seed: int
) -> SignificanceResult:
    """Bootstrap test of a mean paired difference, resampling whole clusters; assumes no symmetry.

    ``t = m / se`` is compared with ``t* = (m* - m) / se*`` of resamples, ``p = (1 + #{|t*| >= |t|}) / (1 + resamples)``
    (Efron and Tibshirani 1993, section 16.4; symmetric bootstrap-t: Hall, The Bootstrap and Edgeworth Expansion, 1992,
    section 3.6), with the standard error of a ratio of totals, ``se^2 = C / (C - 1) sum((S_c - m n_c)^2) / n^2``.
    """
    check_draws(0.95, resamples)
    x, labels = drop_undefined(paired_differences(a, b), clusters)
    if x.size == 0 or labels.max() == 0:
        return SignificanceResult("bootstrap", None, 0, exact=False)
    sums, counts = cluster_totals(x, labels)
    if not sums.any():
        return SignificanceResult("bootstrap", 1.0, 0, exact=False)
    moments = np.stack((sums, counts, sums * sums, sums * counts, counts * counts), axis=1)
    mean, error = (float(value[0]) for value in _mean_and_error(moments.sum(axis=0)[None], sums.size))
    if error == 0.0:
        return SignificanceResult("bootstrap", 1.0 / (1 + resamples), sums.size, exact=False)
    rng, extreme = np.random.default_rng(seed), 0
    for count in chunk_sizes(resamples, sums.size):
        draws = rng.multinomial(sums.size, np.full(sums.size, 1.0 / sums.size), size=count)
        means, errors = _mean_and_error(draws @ moments, sums.size)
        # A resample without variance supports the null hypothesis, unless it repeats the mean.
        deviations = np.abs(means - mean)
        extreme += int((deviations >= (abs(mean) / error) * errors - _TIE * abs(mean)).sum())
    return SignificanceResult("bootstrap", (1 + extreme) / (1 + resamples), sums.size, exact=False)


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
) -> SignificanceResult:  # fmt: skip
    """Permutation test of the means of two arms, reassigning whole clusters; the sizes of the arms stay, by stratum.

    Under the null hypothesis every assignment is as likely as the observed one, and the test is exact (Fisher 1935;
    Good 2005, section 3.3). ``first`` marks the scenarios of the first arm.
    Raises UsageError if a cluster is in both arms or in two strata.
    """
    check_draws(0.95, resamples)
    keep = ~np.isnan(as_values(values))
    x, labels = drop_undefined(values, clusters)
    arm = first[keep]
    if x.size == 0 or arm.all() or not arm.any():
        return SignificanceResult("permutation", None, 0, exact=False)
    sums, counts = cluster_totals(x, labels)
    in_first = cluster_totals(arm.astype(np.float64), labels)[0] > 0
    if (in_first[labels] != arm).any():
        raise UsageError("a cluster is in both arms", cure="assign whole clusters")
    stratum = np.zeros(sums.size, np.int64)
    if strata is not None:
        stratum = cluster_strata(dense_labels(strata, keep.size, "stratum")[keep], labels, minimum=1)
    tie = _TIE * float(np.abs(x).max())
    threshold = abs(float(_arm_difference(in_first[None], sums, counts)[0])) - tie
    rng, extreme = np.random.default_rng(seed), 0
    for count in chunk_sizes(resamples, sums.size):
        draws = np.empty((count, sums.size), bool)
        for number in range(int(stratum.max()) + 1):
            members = stratum == number
            draws[:, members] = rng.permuted(np.tile(in_first[members], (count, 1)), axis=1)
        extreme += int((np.abs(_arm_difference(draws, sums, counts)) >= threshold).sum())
    return SignificanceResult("permutation", (1 + extreme) / (1 + resamples), sums.size, exact=False)


def _arm_difference(
    in_first: Bool[np.ndarray, "draw cluster"], sums: Totals, counts: Totals
) -> Float64[np.ndarray, " draw"]:
    """Return the difference of the means of two arms."""
    total, number = (in_first.astype(np.float64) @ values for values in (sums, counts))
    return total / number - (sums.sum() - total) / (counts.sum() - number)


def holm_adjust(ps: Sequence[float | None]) -> list[float | None]:
    """Adjust p-values for multiple tests, under any dependence (Holm, Scand. J. Stat. 6, 1979).

    In ascending order ``p_(i)`` becomes the largest of ``(m - j) p_(j)``, ``j`` from 0 to ``i``, at most 1. None stands
    for no test and does not count in ``m``.
    """
    order = sorted((p, index) for index, p in enumerate(ps) if p is not None)
    adjusted: list[float | None] = [None] * len(ps)
    largest = 0.0
    for rank, (p, index) in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * p))
        adjusted[index] = largest
    return adjusted
