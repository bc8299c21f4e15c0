from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import savgol_filter

from drivax.synthetic.expert.violations import LIMITS, broken_limits, discomfort, quantities, smoother


@pytest.mark.parametrize(("window", "order", "derivative"), [(8, 2, 0), (15, 2, 1), (15, 3, 2), (7, 3, 1)])
def test_smoothing_equals_scipy(window, order, derivative):
    values = np.random.default_rng(0).normal(size=40)
    expected = savgol_filter(values, window, order, deriv=derivative)
    assert np.allclose(smoother(40, window, order, derivative) @ values, expected, atol=1e-10)


def test_comfort_quantities_equal_scipy():
    rng = np.random.default_rng(1)
    speed = 8.0 + np.cumsum(rng.normal(size=91)) * 0.1
    heading = np.cumsum(rng.normal(size=91)) * 0.02 + 3.1
    got = quantities((heading + np.pi) % (2 * np.pi) - np.pi, speed)
    along, turned = np.diff(speed) / 0.1, np.diff(heading)
    aside = (speed[1:] + speed[:-1]) / 2 * turned / 0.1

    def smooth(values, window, order, derivative=0):
        return savgol_filter(values, window, order, deriv=derivative, delta=0.1)

    expected = {
        "longitudinal_mps2": smooth(along, 8, 2),
        "lateral_mps2": smooth(aside, 8, 2),
        "jerk_mps3": smooth(along, 15, 2, 1),
        "jerk_magnitude_mps3": smooth(np.hypot(along, aside), 15, 2, 1),
        "yaw_rate_rps": smooth(heading[1:], 15, 2, 1),
        "yaw_acceleration_rps2": smooth(heading[1:], 15, 3, 2),
    }
    assert set(got) == set(expected) == set(LIMITS)
    for name, values in expected.items():
        assert np.allclose(got[name], values, atol=1e-8), name


def test_discomfort_names_exceeded_limits():
    step = np.arange(91) * 0.1
    assert discomfort(np.zeros(91), np.full(91, 10.0)) == ""
    assert discomfort(np.zeros(91), 50.0 - 4.0 * step) == ""
    assert discomfort(np.zeros(91), 50.0 - 4.1 * step) == "longitudinal_mps2"
    # 10 m/s at 0.48 rad/s are 4.8 m/s2.
    assert discomfort(0.48 * step, np.full(91, 10.0)) == ""
    assert discomfort(0.50 * step, np.full(91, 10.0)) == "lateral_mps2"
    assert discomfort(1.0 * step, np.full(91, 2.0)) == "yaw_rate_rps"
    assert discomfort(np.zeros(91), np.where(step < 4.0, 10.0, 12.5 - 3.0 * (step - 4.0))) != ""


def test_exceeded_limits_are_named_in_order():
    """Braking at 5 m/s2 from 50 m/s while turning at 1 rad/s: up to 50 m/s2 to the side, which fall by 5 m/s3."""
    step = np.arange(91) * 0.1
    assert broken_limits(np.zeros(91), np.full(91, 10.0)) == ()
    assert broken_limits(1.0 * step, 50.0 - 5.0 * step) == (
        "longitudinal_mps2",
        "lateral_mps2",
        "yaw_rate_rps",
    )
