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
    for row, mine in enumerate(actions):
        of = [statistics.pvariance([b - a for a, b in pairwise(one)]) for one in mine.T.tolist()]
        assert result[row] == pytest.approx(statistics.fmean(of) ** 0.5)
    large = action_jerk(np.random.default_rng(4).uniform(-1, 1, (1, 100_000, 2)))
    assert large[0] == pytest.approx((2 / 3) ** 0.5, abs=0.01), "what the docstring says of chance"


def test_action_jerk_of_ramp_is_zero_and_of_switching_is_not():
    ramp, switch = np.linspace(-1, 1, 81), np.tile([1.0, -1.0], 41)[:81]
    result = action_jerk(np.stack([np.stack([ramp, ramp], -1), np.stack([switch, 0 * switch], -1)]))
    assert result[0] == pytest.approx(0.0, abs=1e-12)
    # Eighty changes of 2 and -2 in one of two numbers: variance 4, halved.
    assert result[1] == pytest.approx(2**0.5)


def test_actions_after_a_crash_are_nan():
    actions = np.tile(np.array([0.0, 1.0, -1.0, 0.5])[None, :, None], (3, 1, 2))
    cut = until_crash(actions, np.array([-1, 12, 10]), 10)
    assert np.isfinite(cut[0]).all() and np.isnan(cut[1, 2:]).all() and np.isfinite(cut[1, :2]).all()
    result = action_jerk(cut)
    assert result[1] == 0.0, "one change has no spread"
    assert np.isnan(result[2]) and result[0] > 1
