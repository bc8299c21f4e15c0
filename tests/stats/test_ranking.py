"""Ranking measures against their definitions by pairs."""

import numpy as np
import pytest
from scipy import stats

from drivax.errors import UsageError
from drivax.stats.ranking import (
    auc_interval,
    bootstrap_intervals,
    correlation_interval,
    precision_at_base_rate,
    rank_correlation,
    roc_auc,
)

RNG = np.random.default_rng(5)
SCORES = RNG.integers(0, 12, 150) / 12  # with ties
LABELS = RNG.random(150) < 0.1 + 0.5 * SCORES
WEIGHTS = RNG.random(150)


def by_pairs(scores, labels, weights):
    a, b = scores[labels][:, None], scores[~labels]
    pairs = weights[labels][:, None] * weights[~labels]
    return (pairs * ((a > b) + (a == b) / 2)).sum() / pairs.sum()


def test_auc_equals_the_share_of_ordered_pairs():
    assert roc_auc(SCORES, LABELS) == pytest.approx(by_pairs(SCORES, LABELS, np.ones(150)), rel=1e-12)
    assert roc_auc(SCORES, LABELS, WEIGHTS) == pytest.approx(by_pairs(SCORES, LABELS, WEIGHTS), rel=1e-12)
    assert roc_auc(np.ones(150), LABELS) == 0.5
    assert roc_auc(LABELS.astype(float), LABELS) == 1.0


def test_interval_equals_that_of_placement_values():
    a, b = SCORES[LABELS][:, None], SCORES[~LABELS]
    right = (a > b) + (a == b) / 2
    spread = np.sqrt(right.mean(1).var(ddof=1) / len(a) + right.mean(0).var(ddof=1) / len(b))
    expected = right.mean() + 1.959964 * spread * np.array([-1, 1])
    np.testing.assert_allclose(auc_interval(SCORES, LABELS), expected, rtol=1e-6)


def test_interval_covers_the_true_value():
    """Normal scores a standard deviation apart: the truth is Phi(1 / sqrt 2) = 0.7592."""
    covered = 0
    for _ in range(400):
        labels = np.arange(120) < 40
        low, high = auc_interval(RNG.normal(size=120) + labels, labels)
        covered += low <= 0.7592 <= high
    assert 0.91 <= covered / 400 <= 0.98


def test_precision_at_the_base_rate():
    scores = np.array([0.9, 0.8, 0.7, 0.6, 0.5, 0.4])
    labels = np.array([True, False, True, False, False, True])
    assert precision_at_base_rate(scores, labels) == pytest.approx(2 / 3)
    # Two of three equal scores at the edge are taken: two thirds of the one that is to be found.
    tied = np.array([0.9, 0.5, 0.5, 0.5, 0.1, 0.1])
    assert precision_at_base_rate(tied, labels) == pytest.approx((1 + 2 / 3) / 3)
    assert precision_at_base_rate(np.ones(6), labels) == pytest.approx(0.5)
    assert precision_at_base_rate(labels.astype(float), labels) == 1.0


def test_weights_are_repetitions():
    times = RNG.integers(1, 4, 150)
    scores, labels = (np.repeat(part, times) for part in (SCORES, LABELS))
    for measure in (roc_auc, precision_at_base_rate):
        expected = measure(scores, labels)
        assert measure(SCORES, LABELS, times.astype(float)) == pytest.approx(expected, rel=1e-12)


def test_invalid_arguments_are_refused():
    for measure in (roc_auc, precision_at_base_rate):
        with pytest.raises(UsageError, match="all true or all false"):
            measure(SCORES, np.zeros(150, bool))
    with pytest.raises(UsageError, match="two positives and two negatives"):
        auc_interval(SCORES, np.arange(150) == 0)
    with pytest.raises(UsageError, match="confidence is 95"):
        auc_interval(SCORES, LABELS, 95)
    with pytest.raises(UsageError, match="resamples is 0"):
        bootstrap_intervals(SCORES, LABELS, WEIGHTS, np.arange(150), resamples=0)
    with pytest.raises(UsageError, match="resamples is 0"):
        correlation_interval(SCORES, SCORES, np.arange(150), resamples=0)


def test_rank_correlation_equals_scipy():
    rng = np.random.default_rng(0)
    one, other = rng.integers(0, 20, 200).astype(float), rng.normal(size=200)
    other += 0.1 * one
    assert rank_correlation(one, other) == pytest.approx(stats.spearmanr(one, other).statistic)


@pytest.mark.parametrize("values", [[], [1.0], [2.0, 2.0]])
def test_constant_lists_have_no_rank_correlation(values):
    assert np.isnan(rank_correlation(np.array(values), np.array(values)))


def test_cluster_bootstrap_covers_the_true_value():
    """Forty scenarios of twenty steps with similar scores; intervals that ignore clusters are too short."""
    rng, truth, covered, apart = np.random.default_rng(3), 0.7592, [], []
    labels = np.repeat(np.arange(40) < 20, 20)
    cluster = np.repeat(np.arange(40), 20)
    for _ in range(60):
        scores = np.repeat(rng.normal(size=40), 20) + 0.1 * rng.normal(size=800) + labels
        for clusters, hits in ((cluster, covered), (np.arange(800), apart)):
            (low, high), _ = bootstrap_intervals(scores, labels, np.ones(800), clusters, resamples=200)
            hits.append(low <= truth <= high)
    assert np.mean(covered) >= 0.85 and np.mean(apart) < 0.5


def test_bootstrap_intervals_hold_the_measures_and_agree_with_delong():
    weights = np.where(LABELS, 0.5, 2.0)
    auc, precision = bootstrap_intervals(SCORES, LABELS, weights, np.arange(len(SCORES)), resamples=2000)
    assert auc[0] < roc_auc(SCORES, LABELS, weights) < auc[1]
    assert precision[0] <= precision_at_base_rate(SCORES, LABELS, weights) <= precision[1]
    np.testing.assert_allclose(auc, auc_interval(SCORES, LABELS), atol=0.02)


def test_resamples_without_negatives_are_left_out():
    scores, labels = np.array([0.1, 0.4, 0.2, 0.9]), np.array([True, True, False, True])
    auc, _ = bootstrap_intervals(scores, labels, np.ones(4), np.array([0, 0, 1, 1]), resamples=50)
    assert 0.0 <= auc[0] <= auc[1] <= 1.0


def test_interval_of_rank_correlation():
    """Approximately Fisher's interval for normal variables; repeated values add no information."""
    rng = np.random.default_rng(3)
    one, noise = rng.normal(size=(2, 400))
    other = 0.5 * one + noise
    rho = rank_correlation(one, other)
    expected = np.tanh(np.arctanh(rho) + np.array([-1.96, 1.96]) / np.sqrt(397))
    for times in (1, 3):
        result = correlation_interval(
            np.repeat(one, times), np.repeat(other, times), np.repeat(np.arange(400), times)
        )
        np.testing.assert_allclose(result, expected, atol=0.025)
    assert correlation_interval(one, other, np.zeros(400)) == (-1.0, 1.0)
    assert correlation_interval(one, (np.arange(400) == 7).astype(float), np.arange(400)) == (-1.0, 1.0)
    assert np.diff(correlation_interval(one, other, np.arange(400), confidence=0.5)) < np.diff(expected) / 2
