"""Steps are drawn in proportion to their weights."""

import time
from functools import partial

import jax
import numpy as np
import pytest
from scipy import stats

from drivax.errors import DataError
from drivax.learning.experience import Sampler, sample_steps, sampler

COUNT = 200_000
_draw = partial(jax.jit, static_argnums=2)(sample_steps)


def draw_counts(weights, seed=0, count=COUNT):
    """Return how often each step is drawn."""
    index, step = _draw(sampler(weights), jax.random.key(seed), (count,))
    counts = np.zeros(weights.shape, int)
    np.add.at(counts, (np.asarray(index), np.asarray(step)), 1)
    return counts


@pytest.fixture(scope="module")
def weights():
    weights = np.random.default_rng(0).gamma(0.5, size=(7, 9))
    # Zeros at both ends, next to each other, and of a whole scenario.
    weights[0, :2] = weights[3] = weights[6, -3:] = 0.0
    return weights


def test_frequencies_follow_the_weights(weights):
    counts = draw_counts(weights)
    positive = weights > 0.0
    assert counts[~positive].sum() == 0 and counts.sum() == COUNT
    expected = COUNT * weights[positive] / weights.sum()
    enough = expected > 5
    assert (
        stats.chisquare(
            [*counts[positive][enough], counts[positive][~enough].sum()],
            [*expected[enough], expected[~enough].sum()],
        ).pvalue
        > 0.01
    )
    # The oracle sees weights that are wrong by a tenth.
    wrong = expected[enough] * np.where(np.arange(enough.sum()) % 2, 1.1, 1.0)
    wrong *= counts[positive][enough].sum() / wrong.sum()
    assert stats.chisquare(counts[positive][enough], wrong).pvalue < 1e-6


def test_probabilities_are_exact_among_many_steps():
    """Of a million equal weights each is right within 0.03 %, where float32 is wrong by up to 6 %."""
    uniform = sampler(np.ones((12_000, 91)))
    steps = np.diff(np.asarray(uniform.cumulative).astype(np.int64), prepend=0)
    np.testing.assert_allclose(steps, (2**32 - 1) / steps.size, rtol=3e-4)
    skewed = np.ones((12_000, 91))
    skewed[-1, -1] = skewed.sum()
    counts = _draw(sampler(skewed), jax.random.key(1), (COUNT,))
    assert (np.asarray(counts[0]) == 11_999).mean() == pytest.approx(0.5, abs=0.01)


def test_draws_follow_from_the_key_alone(weights):
    distribution = sampler(weights)
    one, again, other = (_draw(distribution, jax.random.key(seed), (50,)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, again)
    assert (np.asarray(one) != np.asarray(other)).any()

    assert float(sampler(np.array([[3.0, 1.0, 0.0]])).effective) == pytest.approx(1.6)


def test_zero_weights_are_refused():
    with pytest.raises(DataError, match="all weights are 0"):
        sampler(np.zeros((2, 2)))


@pytest.mark.slow
def test_millions_of_draws_per_second():
    distribution: Sampler = sampler(np.random.default_rng(0).gamma(0.5, size=(10_000, 91)))
    count = 1_000_000
    jax.block_until_ready(_draw(distribution, jax.random.key(0), (count,)))
    start_s = time.perf_counter()
    jax.block_until_ready(_draw(distribution, jax.random.key(1), (count,)))
    assert count / (time.perf_counter() - start_s) > 1e6
