"""Significance tests of two planners on the same scenarios, or of the two arms of a split.

Tests are two-sided and take one value per scenario. Scenarios (or pairs) with undefined values (``None`` or NaN) are
ignored. Scenarios of a cluster (recording) stay together; by default every scenario is a cluster.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

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

#: Relative difference below which a resampled statistic and the observed one are tied.
_TIE = 1e-9
#: Standard error relative to the mean below which all differences count as equal: rounding errors are about 1e-8.
_ROUNDING_ERROR = 1e-7


@dataclass(frozen=True)
class SignificanceResult:
    """Result of a significance test.

    Attributes:
        name: Name of the test.
        p: Two-sided p-value; None if no value is defined, an arm is empty, or a bootstrap or t test has one cluster.
        units: Number of units: discordant pairs (McNemar), clusters with a difference (permutation of pairs), or
            clusters (other tests; 0 if all differences are 0); 0 without a p-value.
        exact: Whether the p-value is exact (binomial, or all permutations), not sampled or by a t distribution.
    """

    name: str
    p: float | None
    units: int
    exact: bool


def mcnemar_test(a: Any, b: Any, *, mid: bool = True) -> SignificanceResult:
    """Apply McNemar's test to two rates in independent pairs, exact or mid-p.

    Under the null hypothesis, either planner is equally likely to fail alone in each of the ``n`` discordant pairs:
    ``p = 2 P(X <= k)``, at most 1, where ``X ~ Binomial(n, 1/2)`` and ``k`` is the smaller of the two counts (McNemar,
    Psychometrika 12, 1947). The mid-p value, ``2 P(X <= k) - P(X = k)``, is less conservative and nearly always keeps
    its level (Fagerland, Lydersen and Laake, BMC Med. Res. Methodol. 13:91, 2013). Both are 1 for equal counts.
    """
    from scipy import special  # takes 0.1 s to import

    for values in (as_values(a), as_values(b)):
        if not np.isin(values[~np.isnan(values)], (0.0, 1.0)).all():
            raise UsageError("McNemar's test takes only 0 and 1", cure="use paired_permutation")
    difference = paired_differences(a, b)
    name = "McNemar mid-p" if mid else "McNemar exact"
    if np.isnan(difference).all():
        return SignificanceResult(name, None, 0, exact=True)
    positive, negative = int((difference > 0).sum()), int((difference < 0).sum())
    n, k = positive + negative, min(positive, negative)
    cdf = float(special.bdtr(k, n, 0.5)) if n else 1.0
    pmf = cdf - float(special.bdtr(k - 1, n, 0.5)) if k else cdf
    p = min(1.0, 2.0 * cdf - pmf) if mid and n else min(1.0, 2.0 * cdf)
    return SignificanceResult(name, p, n, exact=True)


def paired_permutation(
    a: Any, b: Any, clusters: Any = None, resamples: int = RESAMPLES, *, seed: int
) -> SignificanceResult:
    """Apply a sign-flipping permutation test to a mean paired difference, by cluster.

    If the planners are interchangeable, the difference of each cluster has either sign with equal probability (Fisher,
    The Design of Experiments, 1935, section 21; Good, Permutation, Parametric and Bootstrap Tests, 2005, section 3.2).
    All ``2^C`` sign patterns of ``C`` clusters with a difference are enumerated if there are at most ``resamples``; for
    0/1 values in clusters of size one, this is McNemar's exact test. Otherwise ``resamples`` random patterns are drawn,
    and ``p = (1 + #{|T*| >= |T|}) / (1 + resamples)`` (Phipson and Smyth, Stat. Appl. Genet. Mol. Biol. 9, 2010).
    """
    check_draws(resamples)
    x, labels = drop_undefined(paired_differences(a, b), clusters)
    if x.size == 0:
        return SignificanceResult("permutation", None, 0, exact=True)
    sums = cluster_totals(x, labels)[0]
    magnitude = np.abs(sums)
    # Remove clusters without a difference, which do not change the statistic.
    sums = sums[magnitude > _TIE * magnitude.max()]
    threshold = abs(float(sums.sum())) - _TIE * float(magnitude.sum())
    if 2**sums.size <= resamples:
        signs = 1.0 - 2.0 * (np.arange(2**sums.size)[:, None] >> np.arange(sums.size) & 1)
        p = float((np.abs(signs @ sums) >= threshold).mean())
        return SignificanceResult("permutation", p, sums.size, exact=True)
    rng, extreme_count = np.random.default_rng(seed), 0
    for count in chunk_sizes(resamples, sums.size):
        positive = rng.integers(0, 2, size=(count, sums.size), dtype=np.int8).astype(np.float64)
        extreme_count += int((np.abs(2.0 * (positive @ sums) - sums.sum()) >= threshold).sum())
    return SignificanceResult("permutation", (1 + extreme_count) / (1 + resamples), sums.size, exact=False)


def paired_bootstrap_test(
    a: Any, b: Any, clusters: Any = None, resamples: int = RESAMPLES, *, seed: int
) -> SignificanceResult:
    """Apply a bootstrap test to a mean paired difference, resampling whole clusters; it assumes no symmetry.

    ``t = m / se`` is compared with ``t* = (m* - m) / se*`` of resamples,
    ``p = (1 + #{|t*| >= |t|}) / (1 + resamples)`` (Efron and Tibshirani 1993, section 16.4; symmetric bootstrap-t:
    Hall, The Bootstrap and Edgeworth Expansion, 1992, section 3.6). The standard error is that of a ratio of totals,
    ``se^2 = C / (C - 1) sum((S_c - m n_c)^2) / n^2``.
    """
    check_draws(resamples)
    x, labels = drop_undefined(paired_differences(a, b), clusters)
    if x.size == 0 or labels.max() == 0:
        return SignificanceResult("bootstrap", None, 0, exact=False)
    sums, counts = cluster_totals(x, labels)
    if not sums.any():
        return SignificanceResult("bootstrap", 1.0, 0, exact=False)
    moments = np.stack((sums, counts, sums * sums, sums * counts, counts * counts), axis=1)
    mean, error = (float(value[0]) for value in _mean_and_error(moments.sum(axis=0)[None], sums.size))
    if error <= _ROUNDING_ERROR * abs(mean):
        return SignificanceResult("bootstrap", 1.0 / (1 + resamples), sums.size, exact=False)
    rng, extreme_count = np.random.default_rng(seed), 0
    for count in chunk_sizes(resamples, sums.size):
        draws = rng.multinomial(sums.size, np.full(sums.size, 1.0 / sums.size), size=count)
        means, errors = _mean_and_error(draws @ moments, sums.size)
        # |t*| >= |t|, multiplied by se*: a resample without variance counts as extreme.
        deviations = np.abs(means - mean)
        extreme_count += int((deviations >= (abs(mean) / error) * errors - _TIE * abs(mean)).sum())
    return SignificanceResult("bootstrap", (1 + extreme_count) / (1 + resamples), sums.size, exact=False)


def _mean_and_error(
    moments: Float64[np.ndarray, "resample 5"], clusters: int
) -> tuple[Float64[np.ndarray, " resample"], Float64[np.ndarray, " resample"]]:
    """Return the mean and its standard error from the sums over clusters of S, n, S^2, S n and n^2."""
    s, n, ss, sn, nn = moments.T
    mean = s / n
    variance = clusters / (clusters - 1) * np.maximum(ss - 2 * mean * sn + mean**2 * nn, 0.0) / n**2
    return mean, np.sqrt(variance)


def split_permutation(
    values: Any, first: Bool[np.ndarray, " n"], clusters: Any = None, strata: Any = None,
    resamples: int = RESAMPLES, *, seed: int,
) -> SignificanceResult:  # fmt: skip
    """Apply a permutation test to the means of two arms, permuting the arms of whole clusters within strata.

    Under the null hypothesis all assignments are equally likely, and the test keeps its level (Fisher 1935; Good 2005,
    section 3.3). Random assignments are drawn. ``first`` masks the scenarios of the first arm.

    Raises:
        UsageError: A cluster is in both arms or in two strata.
    """
    check_draws(resamples)
    keep = ~np.isnan(as_values(values))
    x, labels = drop_undefined(values, clusters)
    arm = first[keep]
    if x.size == 0 or arm.all() or not arm.any():
        return SignificanceResult("permutation", None, 0, exact=False)
    sums, counts = cluster_totals(x, labels)
    in_first = cluster_totals(arm.astype(np.float64), labels)[0] > 0
    if (in_first[labels] != arm).any():
        raise UsageError("a cluster is in both arms", cure="assign whole clusters")
    cluster_stratum = np.zeros(sums.size, np.int64)
    if strata is not None:
        cluster_stratum = cluster_strata(dense_labels(strata, keep.size, "stratum")[keep], labels, minimum=1)
    tie = _TIE * float(np.abs(x).max())
    threshold = abs(float(_arm_difference(in_first[None], sums, counts)[0])) - tie
    rng, extreme_count = np.random.default_rng(seed), 0
    for count in chunk_sizes(resamples, sums.size):
        draws = np.empty((count, sums.size), bool)
        for stratum in range(int(cluster_stratum.max()) + 1):
            members = cluster_stratum == stratum
            draws[:, members] = rng.permuted(np.tile(in_first[members], (count, 1)), axis=1)
        extreme_count += int((np.abs(_arm_difference(draws, sums, counts)) >= threshold).sum())
    return SignificanceResult("permutation", (1 + extreme_count) / (1 + resamples), sums.size, exact=False)


def _arm_difference(
    in_first: Bool[np.ndarray, "draw cluster"], sums: Totals, counts: Totals
) -> Float64[np.ndarray, " draw"]:
    """Return the difference of the means of two arms for each assignment."""
    total, count = (in_first.astype(np.float64) @ values for values in (sums, counts))
    return total / count - (sums.sum() - total) / (counts.sum() - count)


def holm_adjust(ps: Sequence[float | None]) -> list[float | None]:
    """Adjust p-values for multiple tests, under any dependence (Holm, Scand. J. Stat. 6, 1979).

    In ascending order, ``p_(i)`` becomes the largest of ``(m - j) p_(j)`` for ``j`` from 0 to ``i``, at most 1. None
    means that there is no test; it does not count in ``m``.
    """
    order = sorted((p, index) for index, p in enumerate(ps) if p is not None)
    adjusted_ps: list[float | None] = [None] * len(ps)
    largest = 0.0
    for rank, (p, index) in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * p))
        adjusted_ps[index] = largest
    return adjusted_ps
