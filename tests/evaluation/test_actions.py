"""Action jerk against the standard library and hand-computed values."""

from __future__ import annotations

import statistics
from itertools import pairwise

import numpy as np
import pytest

from drivax.evaluation.runner import action_jerk, until_crash


def test_action_jerk_is_the_deviation_of_differences():
    actions = np.random.default_rng(3).uniform(-1, 1, (4, 80, 2))
    result = action_jerk(actions)
    for row, episode in enumerate(actions):
        variances = [
            statistics.pvariance([b - a for a, b in pairwise(values)]) for values in episode.T.tolist()
        ]
        assert result[row] == pytest.approx(statistics.fmean(variances) ** 0.5)
    large = action_jerk(np.random.default_rng(4).uniform(-1, 1, (1, 100_000, 2)))
    assert large[0] == pytest.approx((2 / 3) ** 0.5, abs=0.01), "the docstring's value for random actions"


def test_action_jerk_of_ramp_is_zero_and_of_switching_is_not():
    ramp, switch = np.linspace(-1, 1, 81), np.tile([1.0, -1.0], 41)[:81]
    result = action_jerk(np.stack([np.stack([ramp, ramp], -1), np.stack([switch, 0 * switch], -1)]))
    assert result[0] == pytest.approx(0.0, abs=1e-12)
    # Eighty changes of 2 and -2 in one of two dimensions: variance 4, halved.
    assert result[1] == pytest.approx(2**0.5)


def test_actions_after_a_crash_are_nan():
    actions = np.tile(np.array([0.0, 1.0, -1.0, 0.5])[None, :, None], (3, 1, 2))
    before_crash = until_crash(actions, np.array([-1, 12, 10]), 10)
    assert np.isfinite(before_crash[0]).all() and np.isfinite(before_crash[1, :2]).all()
    assert np.isnan(before_crash[1, 2:]).all()
    result = action_jerk(before_crash)
    assert result[1] == 0.0, "one change has no spread"
    assert np.isnan(result[2]) and result[0] > 1
