from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.optimize import LinearConstraint, minimize

from drivax.synthetic.expert import speed_plan
from drivax.synthetic.expert.speed_plan import COARSE, Bounds, Occupancy, search, smooth_speeds

STEPS = 40  # 4 s


def occupancy(steps=STEPS, length_m=100.0):
    places = int(length_m / 0.5) + 1
    return Occupancy(0.5, np.zeros((steps + 1, places), bool), np.zeros((steps + 1, places)))


def run(occupied, speed, preferred=12.0, bound=30.0):
    places = occupied.hard.shape[1]
    return search(occupied, np.full(places, preferred), np.full(places, bound), speed)


def test_speed_is_kept_on_a_long_free_road():
    """At 15 m/s a minute is 900 m, more than a plan of the built-in horizon."""
    count, spacing = 120, 1.0
    free = np.zeros((count * COARSE + 1, 1000), bool)
    plan = search(
        Occupancy(spacing, free, free.astype(float)), np.full(1000, 15.0), np.full(1000, 20.0), 15.0
    )
    np.testing.assert_allclose(plan.speed, 15.0)


def test_free_path_has_no_cost():
    plan = run(occupancy(), 12.0)
    assert np.allclose(plan.speed, 12.0)
    assert plan.cost == pytest.approx(0.0, abs=1e-3)
    at, speed = plan.resample(STEPS + 1)
    assert np.allclose(at, 1.2 * np.arange(STEPS + 1))
    assert np.allclose(speed, 12.0)


@pytest.mark.parametrize("speed", [3.0, 5.2])
def test_search_finds_the_best_speeds(speed):
    """Compare with all sequences of accelerations, whose costs are computed independently."""
    occupied = occupancy(steps=4 * COARSE, length_m=40.0)
    occupied.hard[:, 18:22] = True
    occupied.hard[14:, :] = False
    occupied.near[:, 15:18] = 1.0
    occupied.near[14:, :] = 0.0
    plan = run(occupied, speed, preferred=7.0)
    unit = speed / int(np.ceil(speed / 0.75 - 0.3)) / 0.5
    choices = np.arange(int(np.ceil(-6.05 / unit)), int(2.3 / unit) + 1) * unit
    top = max(7.0, speed)
    best = np.inf
    for sequence in itertools.product(choices, repeat=4):
        best = min(best, _cost(occupied, speed, sequence, 7.0, np.ceil(top / (unit * 0.5)) * unit * 0.5))
    assert plan.cost == pytest.approx(best, rel=2e-3, abs=1e-2)
    assert not plan.touches


def _cost(occupied, v, sequence, preferred, top):
    s, total = 0.0, 0.0
    for k, a in enumerate(sequence, start=1):
        after = v + a * 0.5
        if after < -1e-9 or after > top + 1e-9:
            return np.inf
        s, v = s + (v + after) * 0.25, max(after, 0.0)
        total += 0.5 * (a**2 + 3.0 * max(-3.0 - a, 0.0) ** 2)
        total += 0.5 * (speed_plan._FAST if v > preferred else speed_plan._SLOW) * (v - preferred) ** 2
        pace = min(v / 5.0, 2.0)
        for j in range(-2, 3):
            t = min(k * COARSE + j, len(occupied.hard) - 1)
            p = min(max(round((s + v * j * 0.1) / 0.5), 0), occupied.hard.shape[1] - 1)
            total += (pace + 0.02) * (1e5 * occupied.hard[t, p] + 0.8 * occupied.near[t, p])
        p = min(round(s / 0.5), occupied.hard.shape[1] - 1)
        ahead = np.flatnonzero(occupied.hard[k * COARSE, p:])
        free = ahead[0] * 0.5 if len(ahead) else 1000.0
        close = max(1.0 - (free - 1.0) / (1.1 * v + 0.5), 0.0) ** 2
        total += 6.0 * 0.5 * close * min(pace, 1.0)
    return total


def test_search_stops_before_a_wall_until_it_opens():
    occupied = occupancy(steps=80)
    occupied.hard[:50, 60:64] = True  # at 30 m until 5 s
    plan = run(occupied, 12.0)
    at, speed = plan.resample(81)
    assert not plan.touches
    assert at[49] < 30.0 < at[80]
    assert speed[45] < 6.0
    assert speed[-1] > speed[45] + 2.0


@pytest.mark.parametrize(("wall_m", "possible"), [(18.0, True), (10.0, False)])
def test_search_stops_before_a_wall_within_the_braking_limit(wall_m, possible):
    """From 12 m/s a stop takes 12 m with 6 m/s2, and 14.4 m with 5 m/s2."""
    occupied = occupancy()
    occupied.hard[:, int(wall_m / 0.5) :] = True
    plan = run(occupied, 12.0)
    assert plan.touches != possible
    if possible:
        assert plan.speed[-1] == 0.0
        assert np.diff(plan.speed).min() / 0.5 >= -6.1


def test_bends_bound_the_speed():
    occupied = occupancy(steps=80)
    places = occupied.hard.shape[1]
    bound = np.where(np.arange(places) * 0.5 > 40.0, 6.0, 30.0)
    plan = search(occupied, np.full(places, 12.0), bound, 12.0)
    at, speed = plan.resample(81)
    assert speed[at > 41.0].max() <= 6.2


def test_standing_ego_can_start():
    plan = run(occupancy(), 0.0)
    assert plan.speed[0] == 0.0
    assert np.diff(plan.speed)[:4].min() > 0.0


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
            speed_plan._ACCELERATION_WEIGHT * np.sum(a**2)
            + speed_plan._JERK_WEIGHT * np.sum(jerk(a) ** 2)
            + speed_plan._SPEED_WEIGHT * np.sum((v - speed[1:]) ** 2)
            + speed_plan._POSITION_WEIGHT * np.sum((s - at[1:]) ** 2)
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
