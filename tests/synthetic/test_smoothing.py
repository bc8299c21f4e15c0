from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import LinearConstraint, minimize

from drivax.synthetic.expert import smoothing
from drivax.synthetic.expert.smoothing import Bounds, smooth_speeds


def bounds(steps, low=-np.inf, high=np.inf, top=40.0, acceleration=(-6.0, 2.3), jerk=25.0):
    return Bounds(np.full(steps, low), np.full(steps, high), np.full(steps, top), acceleration, jerk)


def braking(steps=40):
    speed = np.maximum(12.0 - 0.35 * np.arange(steps + 1), 0.0)
    return np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) * 0.05)]), speed


def test_constant_speed_is_unchanged():
    at, speed = np.arange(51) * 1.0, np.full(51, 10.0)
    profile = smooth_speeds(at, speed, 0.0, bounds(50))
    assert profile.excess <= 0.0
    assert np.allclose(profile.speed, 10.0)
    assert np.allclose(profile.at_m, at)


@pytest.mark.filterwarnings("ignore:delta_grad")
@pytest.mark.parametrize("high", [np.inf, 20.5])
def test_smoothing_solves_the_quadratic_programme(high):
    """The same problem by a general solver (trust-region interior point); acceleration is linear between knots."""
    steps = 21
    at, speed = braking(steps)
    limits = bounds(steps, high=high, acceleration=(-4.5, 2.0), jerk=8.0)
    profile = smooth_speeds(at, speed, -0.5, limits)
    tril = np.tril(np.ones((steps, steps)))
    rate = tril * 0.1
    position = np.array(
        [[(n - m + 0.5) * 0.01 if m <= n else 0.0 for m in range(steps)] for n in range(steps)]
    )

    spline = np.zeros((steps, 8))
    for t in range(steps):
        spline[t, t // 3], spline[t, t // 3 + 1] = 1 - (t % 3) / 3, (t % 3) / 3

    def jerk(a):
        return np.diff(np.concatenate([[-0.5], a])) / 0.1

    def cost(knots):
        a = spline @ knots
        v, s = 12.0 + rate @ a, 12.0 * 0.1 * np.arange(1, steps + 1) + position @ a
        return (
            smoothing._ACCELERATION * np.sum(a**2)
            + smoothing._JERK * np.sum(jerk(a) ** 2)
            + smoothing._SPEED * np.sum((v - speed[1:]) ** 2)
            + smoothing._POSITION * np.sum((s - at[1:]) ** 2)
        )

    difference = (np.eye(steps) - np.eye(steps, k=-1)) / 0.1
    first = np.zeros(steps)
    first[0] = -5.0
    constraints = [
        LinearConstraint(position @ spline, -np.inf, np.minimum(high, 1e6) - 1.2 * np.arange(1, steps + 1)),
        LinearConstraint(rate @ spline, -12.0, 28.0),
        LinearConstraint(spline, -4.5, 2.0),
        LinearConstraint(difference @ spline, first - 8.0, first + 8.0),
    ]
    solution = minimize(
        cost, np.zeros(8),
        method="trust-constr", constraints=constraints,
        options={"gtol": 1e-9, "xtol": 1e-12, "maxiter": 3000},
    )  # fmt: skip
    got = np.diff(profile.speed) / 0.1
    assert profile.excess < 0.01
    assert np.abs(got - spline @ solution.x).max() < 0.1


def test_bounds_are_kept():
    at, speed = braking()
    profile = smooth_speeds(at, speed, 0.0, bounds(40, high=19.0))
    a = np.diff(profile.speed) / 0.1
    assert profile.excess < 0.02
    assert profile.at_m.max() < 19.02
    assert a.min() > -6.02
    assert np.abs(np.diff(np.concatenate([[0.0], a]))).max() / 0.1 < 25.3
    assert np.all(profile.speed >= 0.0)


def test_excess_of_infeasible_bounds_is_reported():
    # From 12 m/s a car needs 12 m with 6 m/s2.
    at, speed = braking()
    assert smooth_speeds(at, speed, 0.0, bounds(40, high=11.0)).excess > 0.1


def test_stopped_drives_stand():
    at, speed = braking(80)
    profile = smooth_speeds(at, speed, 0.0, bounds(80))
    assert profile.speed[-1] == 0.0
    assert np.ptp(profile.at_m[-3:]) < 0.01
