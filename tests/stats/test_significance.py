"""Significance tests against enumeration, SciPy and hand-made tables."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import scipy.stats

from drivax.errors import UsageError
from drivax.stats.significance import (
    holm_adjust,
    mcnemar_test,
    paired_bootstrap_test,
    paired_permutation,
    split_permutation,
)


def pairs_of(more, fewer, same=3):
    """Return 0/1 values with given numbers of discordant pairs of either kind."""
    a = [1] * more + [0] * fewer + [1] * same + [0] * same
    b = [0] * more + [1] * fewer + [1] * same + [0] * same
    return np.array(a, float), np.array(b, float)


@pytest.mark.parametrize(("more", "fewer"), [(0, 0), (1, 0), (5, 5), (1, 9), (12, 4), (0, 7), (130, 90)])
def test_mcnemar_is_scipys_sign_test(more, fewer):
    a, b = pairs_of(more, fewer)
    n, k = more + fewer, min(more, fewer)
    exact = scipy.stats.binomtest(more, n, 0.5).pvalue if n else 1.0
    assert mcnemar_test(a, b, mid=False).p == pytest.approx(exact)
    expected = min(1.0, 2 * scipy.stats.binom.cdf(k, n, 0.5) - scipy.stats.binom.pmf(k, n, 0.5)) if n else 1.0
    result = mcnemar_test(a, b)
    assert result.p == pytest.approx(expected) and result.units == n and result.exact


def test_mcnemar_by_hand():
    # One against nine: 2 (1 + 10) / 1024 exactly, and 10 / 1024 less for the mid-p value.
    a, b = pairs_of(1, 9)
    assert mcnemar_test(a, b, mid=False).p == pytest.approx(22 / 1024)
    assert mcnemar_test(a, b).p == pytest.approx(12 / 1024)
    # Undefined on either side leaves the pair out; nothing defined has no p.
    assert mcnemar_test([*a, 1, None], [*b, None, 0]) == mcnemar_test(a, b)
    assert mcnemar_test([None], [1]).p is None


def test_permutation_of_pairs_is_scipys():
    rng = np.random.default_rng(0)
    a, b = rng.normal(0.4, 1, 9), rng.normal(0, 1, 9)
    expected = scipy.stats.permutation_test(
        (a, b), lambda x, y, axis: np.mean(x - y, axis=axis), permutation_type="samples", vectorized=True
    )  # fmt: skip
    result = paired_permutation(a, b, seed=0)
    assert result.exact and result.p == pytest.approx(expected.pvalue)
    # Drawn instead of counted: the same up to chance.
    drawn = paired_permutation(a, b, resamples=400, seed=0)
    assert not drawn.exact and drawn.p == pytest.approx(expected.pvalue, abs=0.08)


def test_permutation_of_clusters_flips_whole_clusters():
    d, clusters = np.array([1.0, 2.0, -1.0, 4.0, 0.5, 0.5]), list("aabcdd")
    sums = np.array([3.0, -1.0, 4.0, 1.0])
    patterns = [abs(np.dot(signs, sums)) >= 7.0 for signs in itertools.product((1, -1), repeat=4)]
    result = paired_permutation(d, np.zeros(6), clusters, seed=0)
    assert result.p == pytest.approx(np.mean(patterns)) and result.units == 4
    assert result.p > paired_permutation(d, np.zeros(6), seed=0).p, "as if pairs were independent: too sure"


def test_permutation_of_rates_is_mcnemars_exact_test():
    a, b = pairs_of(8, 2, same=40)
    result = paired_permutation(a, b, seed=0)
    assert result.p == pytest.approx(mcnemar_test(a, b, mid=False).p) and result.units == 10


def test_permutation_with_no_or_only_differences():
    same = paired_permutation([1.0, 2.0], [1.0, 2.0], seed=0)
    assert (same.p, same.units) == (1.0, 0)
    assert paired_permutation(np.ones(5), np.zeros(5), seed=0).p == pytest.approx(2 / 2**5)
    assert paired_permutation(np.ones(500), np.zeros(500), seed=0).p == pytest.approx(1 / 10_001)
    assert paired_permutation([None], [None], seed=0).p is None


def test_bootstrap_test_is_a_t_test_of_many_symmetric_values():
    rng = np.random.default_rng(3)
    d = rng.normal(0.15, 1, 200)
    expected = scipy.stats.ttest_1samp(d, 0).pvalue
    result = paired_bootstrap_test(d, np.zeros(200), resamples=20_000, seed=0)
    assert result.p == pytest.approx(expected, abs=0.01)


def test_bootstrap_test_is_the_exact_distribution_of_a_small_sample():
    """All ``4^4`` resamples of four cluster totals, with the standard error of their ratio."""
    d, clusters = np.array([1.0, 2.0, 0.5, 3.0, 2.0, 2.5]), np.array([0, 0, 1, 2, 2, 3])
    sums, counts = np.bincount(clusters, d), np.bincount(clusters)

    def summary(rows):
        s, n = sums[rows], counts[rows]
        mean = s.sum() / n.sum()
        return mean, math.sqrt(4 / 3 * ((s - mean * n) ** 2).sum()) / n.sum()

    mean, error = summary(np.arange(4))
    beyond = []
    for rows in itertools.product(range(4), repeat=4):
        m, e = summary(np.array(rows))
        beyond.append(abs(m - mean) >= mean / error * e - 1e-9)
    result = paired_bootstrap_test(d, np.zeros(6), clusters, resamples=40_000, seed=1)
    assert result.p == pytest.approx(np.mean(beyond), abs=0.005)


def test_bootstrap_test_of_constant_differences():
    assert paired_bootstrap_test([1.0, 1.0], [1.0, 1.0], seed=0).p == 1.0
    assert paired_bootstrap_test([2.0, 2.0], [1.0, 1.0], seed=0).p < 0.001
    assert paired_bootstrap_test([2.0, 2.0], [1.0, 0.0], ["a", "a"], seed=0).p is None
    assert paired_bootstrap_test(np.full(10, 0.1), np.zeros(10), seed=0).p < 0.001, "moments are rounded"


def test_permutation_of_arms_is_every_assignment():
    values = np.array([3.0, 5.0, 4.0, 1.0, 0.0, 2.0, 2.5])
    clusters = np.array([0, 0, 1, 2, 3, 4, 4])
    first = np.isin(clusters, (0, 1))
    means = {}
    for chosen in itertools.combinations(range(5), 2):
        arm = np.isin(clusters, chosen)
        means[chosen] = values[arm].mean() - values[~arm].mean()
    expected = np.mean([abs(m) >= abs(means[0, 1]) - 1e-12 for m in means.values()])
    result = split_permutation(values, first, clusters, resamples=20_000, seed=0)
    assert result.p == pytest.approx(expected, abs=0.01)


def test_permutation_of_arms_keeps_to_strata():
    # Stratum x is high, stratum y low; within each one of two is in the first arm: four assignments.
    values, strata = np.array([10.0, 9.0, 2.0, 1.0]), ["x", "x", "y", "y"]
    first = np.array([True, False, True, False])
    expected = np.mean([abs(a + b) >= 2 for a in (1, -1) for b in (1, -1)])
    result = split_permutation(values, first, strata=strata, resamples=20_000, seed=0)
    assert result.p == pytest.approx(expected, abs=0.01)
    assert split_permutation(values, np.ones(4, bool), seed=0).p is None


def test_permutation_of_more_than_a_thousand_pairs():
    x = np.random.default_rng(0).normal(size=1100)
    result = paired_permutation(x, np.zeros(1100), resamples=50, seed=0)
    assert result.units == 1100 and not result.exact and 0.0 < result.p < 1.0


def test_holm_by_hand():
    # Sorted 0.01, 0.02, 0.03, 0.5 of four: 0.04, 0.06, 0.06, 0.5; None counts for nothing.
    assert holm_adjust([0.03, 0.01, None, 0.5, 0.02]) == pytest.approx(
        [0.06, 0.04, None, 0.5, 0.06], abs=1e-12
    )
    assert holm_adjust([0.7, 0.6]) == [1.0, 1.0] and holm_adjust([]) == [] and holm_adjust([0.2]) == [0.2]


@pytest.mark.parametrize(
    "call",
    [
        lambda: mcnemar_test([0.5], [1.0]),
        lambda: mcnemar_test([1.0], [1.0, 0.0]),
        lambda: paired_permutation([1.0], [1.0, 2.0], seed=0),
        lambda: paired_permutation([1.0], [0.0], resamples=0, seed=0),
        lambda: split_permutation([1.0, 2.0], np.array([True, False]), ["a", "a"], seed=0),
    ],
)
def test_impossible_arguments_are_refused_in_one_line(call):
    with pytest.raises(UsageError) as caught:
        call()
    assert "\n" not in str(caught.value) and caught.value.cure
