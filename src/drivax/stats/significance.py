"""Could this difference be chance? Tests of two planners on the same scenarios, or on two arms of a split.

Every test is two-sided and takes one value per scenario; ``None`` or NaN means undefined and leaves the scenario (or
pair) out. Scenarios of one cluster (recording) are kept together. Seeds are explicit; results are repeatable.
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
from drivax.stats.intervals import RESAMPLES, check_draws

#: Random numbers drawn at once: bounds the memory to about 16 MB.
_CHUNK = 2_000_000
#: Results of resamples this near to the found one, relative to its size, are ties.
_TIE = 1e-9


@dataclass(frozen=True)
class Evidence:
    """The result of a test.

    Attributes:
        name: Of the test.
        p: Probability of a difference at least as large as the one found, if there were none; None where nothing is
            defined.
        units: How many things were exchanged: discordant pairs, or clusters whose values differ.
        exact: Whether every possibility was counted, rather than a sample of them.
    """

    name: str
    p: float | None
    units: int
    exact: bool


def mcnemar(a: Any, b: Any, *, mid: bool = True) -> Evidence:
    """McNemar's test of two rates in independent pairs, exact or mid-p.

    If neither planner fails more often, the ``n`` pairs in which one fails and the other does not (discordant ones) are
    tosses of a fair coin: ``p = 2 P(X <= k)``, at most 1, with ``X ~ Binomial(n, 1/2)`` and ``k`` the rarer of both
    (McNemar, Psychometrika 12, 1947). The mid-p value, ``p - P(X = k)``, is less conservative and keeps its level
    nearly always (Fagerland, Lydersen and Laake, BMC Med. Res. Methodol. 13:91, 2013).

    Args:
        a: 0, 1 or undefined, one per scenario; scenarios are independent.
        b: The other planner's, in the same order.
        mid: Mid-p rather than exact.

    Raises:
        UsageError: If a value is neither 0 nor 1, or lengths disagree.
    """
    for values in (numbers(a), numbers(b)):
        if not np.isin(values[~np.isnan(values)], (0.0, 1.0)).all():
            raise UsageError("McNemar's test takes only 0 and 1", cure="use paired_permutation")
    found = differences(a, b)
    name = "McNemar mid-p" if mid else "McNemar exact"
    if np.isnan(found).all():
        return Evidence(name, None, 0, exact=True)
    more, fewer = int((found > 0).sum()), int((found < 0).sum())
    n, k = more + fewer, min(more, fewer)
    at_most = float(special.bdtr(k, n, 0.5)) if n else 1.0
    here = at_most - float(special.bdtr(k - 1, n, 0.5)) if k else at_most
    p = min(1.0, 2.0 * at_most - here) if mid and n else min(1.0, 2.0 * at_most)
    return Evidence(name, p, n, exact=True)


def paired_permutation(
    a: Any, b: Any, clusters: Any = None, resamples: int = RESAMPLES, *, seed: int
) -> Evidence:
    """Permutation test of a mean paired difference: whole clusters change the names of the planners.

    If the planners are interchangeable, the difference of each cluster has either sign with equal probability
    (Fisher, The Design of Experiments, 1935, section 21; Good, Permutation, Parametric and Bootstrap Tests, 2005,
    section 3.2). All ``2^C`` sign patterns are counted where they are no more than ``resamples``, else random ones:
    ``p = (1 + #{|T*| >= |T|}) / (1 + resamples)`` (Phipson and Smyth, Stat. Appl. Genet. Mol. Biol. 9, 2010). Of 0/1
    values in clusters of one this is McNemar's exact test.

    Args:
        a: Numbers or undefined, one per scenario.
        b: The other planner's, in the same order.
        clusters: Labels of the clusters, one per scenario; None: every scenario is its own.
        resamples: Number of sign patterns.
        seed: Seed of the random numbers.

    Raises:
        UsageError: If lengths disagree, a value is infinite, or there are no resamples.
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
    for count in _chunks(resamples, sums.size):
        kept = rng.integers(0, 2, size=(count, sums.size), dtype=np.int8).astype(np.float64)
        beyond += int((np.abs(2.0 * (kept @ sums) - sums.sum()) >= least).sum())
    return Evidence("permutation", (1 + beyond) / (1 + resamples), sums.size, exact=False)


def paired_bootstrap_test(
    a: Any, b: Any, clusters: Any = None, resamples: int = RESAMPLES, *, seed: int
) -> Evidence:
    """Bootstrap test of a mean paired difference that does not ask for symmetry, resampling whole clusters.

    ``t = m / se`` is held against ``t* = (m* - m) / se*`` of resamples, ``p = (1 + #{|t*| >= |t|}) / (1 + resamples)``
    (Efron and Tibshirani 1993, section 16.4; symmetric bootstrap-t: Hall, The Bootstrap and Edgeworth Expansion, 1992,
    section 3.6), with the standard error of a ratio of totals, ``se^2 = C / (C - 1) sum((S_c - m n_c)^2) / n^2``.

    Args:
        a: As for :func:`paired_permutation`, as the rest.
        b: The other planner's, in the same order.
        clusters: Labels of the clusters.
        resamples: Number of resamples.
        seed: Seed of the random numbers.

    Raises:
        UsageError: As :func:`paired_permutation`.
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
    for count in _chunks(resamples, sums.size):
        times = rng.multinomial(sums.size, np.full(sums.size, 1.0 / sums.size), size=count)
        means, errors = _mean_and_error(times @ moments, sums.size)
        # A resample that does not vary speaks for chance, unless it repeats the mean.
        away = np.abs(means - mean)
        beyond += int((away >= (abs(mean) / error) * errors - _TIE * abs(mean)).sum())
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
    values: Any,
    first: Bool[np.ndarray, " n"],
    clusters: Any = None,
    strata: Any = None,
    resamples: int = RESAMPLES,
    *,
    seed: int,
) -> Evidence:
    """Permutation test of the means of two arms: whole clusters are assigned anew, as many to each arm as there were.

    If it made no difference who drove a scenario, every assignment would have been as good as the one that was drawn,
    and the test is exact (Fisher 1935; Good 2005, section 3.3); strata keep their numbers in each arm.

    Args:
        values: Numbers or undefined, one per scenario.
        first: Which scenarios are in the first arm; all of a cluster, or none.
        clusters: Labels of the clusters, one per scenario; None: every scenario is its own.
        strata: Labels of the strata, one per scenario, the same throughout a cluster; None: no strata.
        resamples: Number of assignments.
        seed: Seed of the random numbers.

    Raises:
        UsageError: If lengths disagree, a cluster is in both arms or in two strata, or a value is infinite.
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
    for count in _chunks(resamples, sums.size):
        drawn = np.empty((count, sums.size), bool)
        for stratum in range(int(of.max()) + 1):
            inside = of == stratum
            drawn[:, inside] = rng.permuted(np.tile(mine[inside], (count, 1)), axis=1)
        beyond += int((np.abs(_between(drawn, sums, counts)) >= least).sum())
    return Evidence("permutation", (1 + beyond) / (1 + resamples), sums.size, exact=False)


def _between(
    mine: Bool[np.ndarray, "draw cluster"], sums: Totals, counts: Totals
) -> Float64[np.ndarray, " draw"]:
    """Difference of the means of two arms."""
    weight = mine.astype(np.float64)
    total, number = weight @ sums, weight @ counts
    return total / number - (sums.sum() - total) / (counts.sum() - number)


def holm(ps: Sequence[float | None]) -> list[float | None]:
    """P-values that are adjusted for their number, so that a true zero among them is rarely called a difference.

    Sorted upwards, ``p_(i)`` becomes the largest of ``(m - j) p_(j)``, ``j`` from 0 to ``i``, at most 1 (Holm, Scand.
    J. Stat. 6, 1979). Valid whatever the dependence between the tests; None (nothing to test) counts in no ``m``.
    """
    order = sorted((p, place) for place, p in enumerate(ps) if p is not None)
    adjusted: list[float | None] = [None] * len(ps)
    largest = 0.0
    for rank, (p, place) in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * p))
        adjusted[place] = largest
    return adjusted


def _chunks(resamples: int, width: int) -> list[int]:
    """Numbers of resamples that are made at once."""
    rows = max(1, _CHUNK // max(1, width))
    return [min(rows, resamples - begin) for begin in range(0, resamples, rows)]
