from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import scipy.stats

from drivax.errors import UsageError
from drivax.stats.intervals import (
    Interval,
    bootstrap_mean,
    effective_size,
    interquartile_bootstrap,
    interquartile_mean,
    paired_bootstrap,
    per_event,
    rate,
    split_bootstrap,
    wilson,
)


@pytest.mark.parametrize(("successes", "n"), [(0, 1), (1, 1), (0, 12), (5, 12), (12, 12), (173, 256)])
@pytest.mark.parametrize("confidence", [0.8, 0.95, 0.99])
def test_wilson_is_scipys(successes, n, confidence):
    expected = scipy.stats.binomtest(successes, n).proportion_ci(confidence, method="wilson")
    result = wilson(successes, n, confidence)
    assert result.mean == successes / n and result.n == n
    assert result.low == pytest.approx(expected.low, abs=1e-12)
    assert result.high == pytest.approx(expected.high, abs=1e-12)


def test_wilson_by_hand():
    # z = 1: p = 1/2, n = 3: centre 1/2, half = (1 / (1 + 1/3)) sqrt(1/12 + 1/36) = 3/4 * 1/3 = 1/4.
    one_sigma = math.erf(1 / math.sqrt(2))
    result = wilson(1.5, 3, one_sigma)
    assert (result.low, result.high) == pytest.approx((0.25, 0.75), abs=1e-12)


@pytest.mark.parametrize("events", [0, 1, 7, 250])
def test_bounds_per_event_are_where_poisson_tails_are_2_5_percent(events):
    result = per_event(events, 70.0)
    assert scipy.stats.poisson.cdf(events, 70.0 / result.low) == pytest.approx(0.025, rel=1e-6)
    if events == 0:
        assert result.mean is None and result.high is None
        # The rule of three, with its exact number: -ln 0.025.
        assert result.low == pytest.approx(70.0 / -math.log(0.025))
    else:
        assert result.mean == 70.0 / events and result.n == events
        assert scipy.stats.poisson.sf(events - 1, 70.0 / result.high) == pytest.approx(0.025, rel=1e-6)


def test_no_exposure_is_refused():
    with pytest.raises(UsageError, match="exposure"):
        per_event(0, 0.0)


def test_effective_size_equals_kish_by_hand():
    assert effective_size(np.ones((4, 5))) == pytest.approx(20.0)
    assert effective_size(np.array([[3.0, 1.0, 0.0]])) == pytest.approx(16 / 10)
    assert effective_size(np.zeros((2, 2))) == 0.0


def test_undefined_values_have_no_interval():
    nothing = Interval(None, None, None, 0)
    assert wilson(0, 0) == nothing
    assert rate([None, float("nan")]) == nothing
    assert bootstrap_mean([], seed=0) == nothing
    assert bootstrap_mean([None, None], ["a", "b"], seed=0) == nothing
    assert paired_bootstrap([1.0, None], [None, 2.0], seed=0) == nothing
    assert interquartile_bootstrap([[], []], seed=0) == nothing
    assert nothing.as_dict() == {"mean": None, "low": None, "high": None, "n": 0}


def test_rate_of_independent_episodes_is_wilson():
    values = [1, 0, None, 1, 1, float("nan"), 0]
    assert rate(values) == wilson(3, 5)
    assert rate(values, list("abcdefg")) == wilson(3, 5)
    assert rate([True, False, True]) == wilson(2, 3)


def test_rate_of_clusters_by_hand():
    # Two clusters of two, totals 2 and 0, p = 1/2: variance 2/1 * (1 + 1) / 16 = 1/4; binomial 1/16; deff 4.
    result = rate([1, 1, 0, 0], ["a", "a", "b", "b"])
    expected = wilson(0.5, 1)
    assert (result.mean, result.n) == (0.5, 4)
    assert (result.low, result.high) == pytest.approx((expected.low, expected.high))
    # Totals 1 and 1: no spread between clusters, so no better than independent.
    balanced = rate([1, 0, 1, 0], ["a", "a", "b", "b"])
    assert (balanced.low, balanced.high) == pytest.approx((wilson(2, 4).low, wilson(2, 4).high))


def test_rate_of_equal_values_counts_clusters():
    result = rate([0] * 12, ["a"] * 6 + ["b"] * 6)
    assert (result.mean, result.low, result.n) == (0.0, 0.0, 12)
    assert result.high == pytest.approx(wilson(0, 2).high)


def test_bootstrap_is_the_exact_distribution_of_a_small_sample():
    # All 27 equally likely resamples of three values; the percentile bounds of 40,000 draws must be theirs.
    values = np.array([0.0, 1.0, 5.0])
    means = sorted(float(np.mean(draw)) for draw in itertools.product(values, repeat=3))
    result = bootstrap_mean(values, confidence=0.8, resamples=40_000, seed=3)
    assert result.mean == 2.0 and result.n == 3
    assert result.low == pytest.approx(np.quantile(means, 0.1, method="inverted_cdf"))
    assert result.high == pytest.approx(np.quantile(means, 0.9, method="inverted_cdf"))


def test_cluster_bootstrap_is_the_exact_distribution_of_whole_clusters():
    values, labels = [0.0, 0.0, 0.0, 4.0, 10.0], ["a", "a", "a", "b", "c"]
    totals = {"a": (0.0, 3), "b": (4.0, 1), "c": (10.0, 1)}
    means = sorted(
        sum(totals[c][0] for c in draw) / sum(totals[c][1] for c in draw)
        for draw in itertools.product("abc", repeat=3)
    )
    result = bootstrap_mean(values, labels, confidence=0.9, resamples=40_000, seed=1)
    assert result.mean == pytest.approx(2.8)
    assert result.low == pytest.approx(np.quantile(means, 0.05, method="inverted_cdf"))
    assert result.high == pytest.approx(np.quantile(means, 0.95, method="inverted_cdf"))


def test_bootstrap_agrees_with_scipy():
    values = np.random.default_rng(5).gamma(2.0, 1.0, 80)
    expected = scipy.stats.bootstrap(
        (values,), np.mean, method="percentile", n_resamples=20_000, rng=np.random.default_rng(1)
    ).confidence_interval
    result = bootstrap_mean(values, resamples=20_000, seed=0)
    width = expected.high - expected.low
    assert result.low == pytest.approx(expected.low, abs=0.03 * width)
    assert result.high == pytest.approx(expected.high, abs=0.03 * width)


def test_pairs_agree_with_scipy_and_need_both():
    rng = np.random.default_rng(6)
    scene = rng.normal(0, 5, 60)
    a, b = scene + rng.normal(0.5, 1, 60), scene + rng.normal(0, 1, 60)
    expected = scipy.stats.bootstrap(
        (a, b),
        lambda x, y, axis: np.mean(x - y, axis=axis),
        paired=True,
        method="percentile",
        n_resamples=20_000,
        rng=np.random.default_rng(2),
    ).confidence_interval
    result = paired_bootstrap([*a, 3.0, None], [*b, None, 9.0], resamples=20_000, seed=0)
    assert result.n == 60 and result.mean == pytest.approx(float(np.mean(a - b)))
    width = expected.high - expected.low
    assert result.low == pytest.approx(expected.low, abs=0.03 * width)
    assert result.high == pytest.approx(expected.high, abs=0.03 * width)
    apart = bootstrap_mean(a, seed=0)
    assert result.high - result.low < (apart.high - apart.low) / 2, (
        "pairing removes the spread between scenarios"
    )


def test_a_single_cluster_has_no_interval():
    assert bootstrap_mean([1.0, 2.0], ["a", "a"], seed=0) == Interval(1.5, None, None, 2)
    assert bootstrap_mean([7.0], seed=0) == Interval(7.0, None, None, 1)
    by_seed = [[1.0, 2.0, None], [1.0, 3.0, None]]
    assert interquartile_bootstrap(by_seed, list("aab"), seed=0) == Interval(1.75, None, None, 4)


def test_clusters_without_defined_episodes_are_excluded():
    assert bootstrap_mean([1.0, None, 3.0], ["a", "b", "c"], seed=4) == bootstrap_mean([1.0, 3.0], seed=4)
    by_seed = np.random.default_rng(0).normal(size=(3, 8))
    padded = np.pad(by_seed, ((0, 1), (0, 40)), constant_values=np.nan)
    assert interquartile_bootstrap(padded, seed=4) == interquartile_bootstrap(by_seed, seed=4)


def test_seeds_repeat_and_chunks_do_not_matter(monkeypatch):
    values = np.random.default_rng(0).normal(size=40)
    first = bootstrap_mean(values, seed=1)
    assert first == bootstrap_mean(values, seed=1) != bootstrap_mean(values, seed=2)
    monkeypatch.setattr("drivax.stats.intervals._CHUNK", 400)
    chunked = bootstrap_mean(values, seed=1)
    assert (chunked.low, chunked.high) == pytest.approx((first.low, first.high), abs=0.02)


def test_coverage_of_clustered_data():
    """95 % intervals of clustered data cover the true value; intervals that ignore clusters do so too rarely."""
    rng = np.random.default_rng(11)
    clusters, size, trials, truth = 40, 5, 300, 0.7
    labels = np.repeat(np.arange(clusters), size)
    hits = {"rate": 0, "mean": 0, "naive": 0}
    for trial in range(trials):
        p = rng.beta(truth * 1.5, (1 - truth) * 1.5, clusters)
        values = (rng.random((clusters, size)) < p[:, None]).astype(float).ravel()
        for name, result in (
            ("rate", rate(values, labels)),
            ("mean", bootstrap_mean(values, labels, resamples=600, seed=trial)),
            ("naive", rate(values)),
        ):
            hits[name] += result.low <= truth <= result.high
    share = {name: count / trials for name, count in hits.items()}
    # Binomial standard error of a coverage of 0.95 in 300 trials: 0.0126.
    assert 0.91 <= share["rate"] <= 0.985 and 0.90 <= share["mean"] <= 0.985
    assert share["naive"] < 0.85


@pytest.mark.parametrize(
    "call",
    [
        lambda: wilson(3, 2),
        lambda: wilson(-1, 2),
        lambda: wilson(1, 2, 1.0),
        lambda: rate([0.5, 1]),
        lambda: bootstrap_mean([1.0, 2.0], ["a"], seed=0),
        lambda: bootstrap_mean([1.0, math.inf], seed=0),
        lambda: bootstrap_mean([1.0, 2.0], resamples=0, seed=0),
        lambda: bootstrap_mean([1.0, 2.0], confidence=0.0, seed=0),
        lambda: paired_bootstrap([1.0], [1.0, 2.0], seed=0),
        lambda: split_bootstrap([1.0, 2.0], np.array([True, False]), ["a", "a"], seed=0),
        lambda: per_event(3, 10.0, confidence=95),
        lambda: per_event(-1, 10.0),
        lambda: rate(["yes"]),
        lambda: rate([[1.0], [1.0, 0.0]]),
    ],
)
def test_impossible_arguments_are_refused_in_one_line(call):
    with pytest.raises(UsageError) as caught:
        call()
    assert "\n" not in str(caught.value) and caught.value.cure


def test_interquartile_bootstrap_of_equal_seeds_is_that_of_their_episodes():
    row = np.random.default_rng(0).normal(size=60)
    one, alone = interquartile_bootstrap([row, row, row], seed=0), bootstrap_mean(row, seed=0)
    assert one.mean == pytest.approx(alone.mean)
    assert (one.low, one.high) == pytest.approx((alone.low, alone.high), abs=0.02)
    # Seeds that differ widen it; without seeds or defined values it is undefined.
    assert interquartile_bootstrap([], seed=0).mean is None
    assert interquartile_bootstrap([row - 1, row, row + 1], seed=0).low < one.low - 0.2
    assert interquartile_bootstrap([[None, None]], seed=0) == Interval(None, None, None, 0)
    assert interquartile_bootstrap([[1.0, 2.0]], ["a", "a"], seed=0) == Interval(1.5, None, None, 2)
    with pytest.raises(UsageError, match="different episodes"):
        interquartile_bootstrap([[1.0, 2.0], [1.0]], seed=0)


def test_stratified_bootstrap_is_the_exact_distribution():
    """Two strata of three and two clusters: two draws of weight 3/2, and one draw of weight 2."""
    values, strata = [0.0, 1.0, 5.0, 10.0, 14.0], ["x", "x", "x", "y", "y"]
    means = [
        (1.5 * (a + b) + 2 * c) / 5
        for a in (0.0, 1.0, 5.0) for b in (0.0, 1.0, 5.0) for c in (10.0, 14.0)
    ]  # fmt: skip
    result = bootstrap_mean(values, strata=strata, confidence=0.8, resamples=40_000, seed=2)
    assert result.mean == pytest.approx(6.0) and result.n == 5
    assert result.low == pytest.approx(np.quantile(means, 0.1, method="inverted_cdf"))
    assert result.high == pytest.approx(np.quantile(means, 0.9, method="inverted_cdf"))


def test_stratified_bootstrap_has_the_variance_of_stratified_sampling():
    """``sum_h (C_h / C)^2 s_h^2 / C_h`` with unbiased ``s_h``, however small the strata (ten of three)."""
    rng = np.random.default_rng(0)
    strata = np.repeat(np.arange(10), 3)
    values = rng.normal(10.0 * strata, 1.0)
    spread = np.array([values[strata == h].var(ddof=1) for h in range(10)])
    expected = math.sqrt((0.1**2 * spread / 3).sum())
    one_sigma = math.erf(1 / math.sqrt(2))
    result = bootstrap_mean(values, strata=strata, confidence=one_sigma, resamples=20_000, seed=0)
    assert (result.high - result.low) / 2 == pytest.approx(expected, rel=0.03)
    without = bootstrap_mean(values, confidence=one_sigma, seed=0)
    assert without.high - without.low > 10 * (result.high - result.low), (
        "between strata nothing is left to chance"
    )


def test_strata_assign_clusters_and_exclude_undefined_values():
    values, clusters, strata = [1.0, 2.0, 3.0, None, 5.0], list("aabbc"), list("xxyyy")
    result = bootstrap_mean(values, clusters, strata=strata, seed=0)
    assert result.n == 4 and result.mean == pytest.approx(2.75)
    with pytest.raises(UsageError, match="lies in two strata"):
        bootstrap_mean([1.0, 2.0], ["a", "a"], strata=["x", "y"], seed=0)


def test_split_bootstrap_draws_each_arm_by_itself():
    values, first = np.array([0.0, 3.0, 1.0, 5.0, 6.0]), np.array([True, False, True, False, False])
    means = [
        (a + b) / 2 - sum(c) / 3
        for a in (0, 1) for b in (0, 1) for c in itertools.product((3, 5, 6), repeat=3)
    ]  # fmt: skip
    result = split_bootstrap(values, first, confidence=0.9, resamples=40_000, seed=0)
    assert result.mean == pytest.approx(0.5 - 14 / 3) and result.n == 5
    assert result.low == pytest.approx(np.quantile(means, 0.05, method="inverted_cdf"))
    assert result.high == pytest.approx(np.quantile(means, 0.95, method="inverted_cdf"))
    assert split_bootstrap(values, np.zeros(5, bool), seed=0) == Interval(None, None, None, 0)
    assert split_bootstrap(values, first, ["a", "b", "a", "c", "d"], seed=0).low is None, (
        "one cluster in an arm"
    )
    strata = np.array([0, 1, 0, 1, 1])
    assert split_bootstrap(values, first, strata=strata, seed=0).mean == result.mean


@pytest.mark.parametrize("n", [4, 8, 12, 40])
def test_interquartile_mean_is_scipys_where_quarters_are_whole(n):
    values = np.random.default_rng(n).normal(size=n)
    assert interquartile_mean(values) == pytest.approx(scipy.stats.trim_mean(values, 0.25))


def test_interquartile_mean_by_hand():
    # Of three the outer ones count (1/3 - 1/4) / (1/2) = 1/6 each, the middle one 2/3.
    assert interquartile_mean([9.0, 0.0, 3.0]) == pytest.approx(9 / 6 + 3 * 2 / 3)
    assert interquartile_mean([1.0, None, 2.0]) == pytest.approx(1.5)
    assert interquartile_mean([7.0]) == pytest.approx(7.0) and interquartile_mean([None]) is None


def test_interquartile_bootstrap_is_the_exact_distribution():
    values = np.array([[0.0, 2.0], [1.0, 5.0], [8.0, 9.0]])
    result = interquartile_bootstrap(values, confidence=0.8, resamples=20_000, seed=0)
    assert result.mean == pytest.approx(interquartile_mean(values.mean(axis=1))) and result.n == 6
    means = [
        interquartile_mean([values[seed, list(drawn)].mean() for seed in seeds])
        for seeds in itertools.product(range(3), repeat=3) for drawn in itertools.product(range(2), repeat=2)
    ]  # fmt: skip
    assert result.low == pytest.approx(np.quantile(means, 0.1), abs=0.06)
    assert result.high == pytest.approx(np.quantile(means, 0.9), abs=0.06)
