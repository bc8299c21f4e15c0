"""Under the null a test at 5 % rejects 5 % +- 1 %, clusters and all.

The standard error of a share of 0.05 in 4,000 simulations is 0.0034, so that +-0.01 is three of them.
"""

from __future__ import annotations

import numpy as np
import pytest

from drivax.evaluation.pairing import assign
from drivax.stats.seeds import crossed_difference, repeat_single_seed
from drivax.stats.significance import (
    holm_adjust,
    mcnemar_test,
    paired_bootstrap_test,
    paired_permutation,
    split_permutation,
)

TRIALS, RESAMPLES = 4000, 400
CLUSTERS = np.repeat(np.arange(40), [1, 2, 3, 4] * 10)


def scenes(rng):
    """Difficulty of scenarios, correlated within recordings and skewed."""
    return rng.gamma(1.0, 1.0, 40)[CLUSTERS] + rng.gamma(1.0, 1.0, CLUSTERS.size)


def noise(rng):
    """Results of a planner relative to the difficulty, correlated within recordings."""
    return rng.normal(size=40)[CLUSTERS] + rng.normal(size=CLUSTERS.size)


def rejected(p_of):
    """Return the share of simulations with a p-value below 0.05."""
    rng = np.random.default_rng(0)
    return np.mean([p_of(rng, trial) < 0.05 for trial in range(TRIALS)])


@pytest.mark.slow
@pytest.mark.parametrize("test", [paired_permutation, paired_bootstrap_test])
def test_tests_of_paired_means(test):
    def p(rng, trial):
        scene = scenes(rng)
        return test(scene + noise(rng), scene + noise(rng), CLUSTERS, RESAMPLES, seed=trial).p

    assert rejected(p) == pytest.approx(0.05, abs=0.01)


@pytest.mark.slow
def test_ignoring_clusters_rejects_too_often():
    def p(rng, trial):
        return paired_permutation(noise(rng), noise(rng), resamples=RESAMPLES, seed=trial).p

    assert rejected(p) > 0.1


@pytest.mark.slow
def test_mcnemars_mid_p():
    """Exact p-values are discrete and reject less; mid-p values reject about 5 %, never much more."""

    def p(rng, mid):
        hard = rng.random(400)
        return mcnemar_test(rng.random(400) < hard, rng.random(400) < hard, mid=mid).p

    assert rejected(lambda rng, _: p(rng, True)) == pytest.approx(0.05, abs=0.01)
    assert rejected(lambda rng, _: p(rng, False)) <= 0.06


@pytest.mark.slow
@pytest.mark.parametrize("stratified", [False, True])
def test_tests_of_arms(stratified):
    kinds = [f"{kind}" for kind in (np.arange(40) % 3)[CLUSTERS]]
    clusters = [str(cluster) for cluster in CLUSTERS]

    def p(rng, trial):
        split = assign(clusters, kinds if stratified else None, 0.4, seed=trial)
        values = scenes(rng) + 3.0 * (np.arange(40) % 3)[CLUSTERS] + noise(rng)
        return split_permutation(values, split.first, CLUSTERS, split.strata, RESAMPLES, seed=trial).p

    assert rejected(p) == pytest.approx(0.05, abs=0.01)


@pytest.mark.slow
def test_holm_keeps_the_whole_family_at_its_level():
    """Three metrics of one episode are correlated; any of them is significant in at most 5 % of cases."""

    def p(rng, trial):
        common = noise(rng)
        ps = [
            paired_permutation(
                common + noise(rng), np.zeros(CLUSTERS.size), CLUSTERS, RESAMPLES, seed=trial
            ).p
            for _ in range(3)
        ]
        return min(holm_adjust(ps))

    assert 0.02 <= rejected(p) <= 0.06


@pytest.mark.slow
@pytest.mark.parametrize(("seeds", "others"), [(3, 1), (3, 3), (2, 2)])
@pytest.mark.parametrize("spread", [0.0, 0.3, 1.0])
def test_seeds_that_differ_are_no_difference(seeds, others, spread):
    """Both kinds of policies are drawn from one distribution; one with a single seed is exactly its mean.

    Where seeds hardly differ it rejects less. With two degrees of freedom Satterthwaite's are an approximation.
    """

    def p(rng, trial):
        scene = scenes(rng)

        def kind(number):
            means = spread * rng.normal(size=(number, 1)) * (number > 1)
            return repeat_single_seed(scene + means + np.stack([noise(rng) for _ in range(number)]))

        return crossed_difference(kind(seeds), kind(others), CLUSTERS).p

    assert 0.005 <= rejected(p) <= (0.08 if others == 1 else 0.06)
