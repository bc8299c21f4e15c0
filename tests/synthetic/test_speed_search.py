from __future__ import annotations

import itertools

import numpy as np
import pytest

from drivax.synthetic.expert import speed_search
from drivax.synthetic.expert.speed_search import COARSE, Occupancy, search

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
        total += 0.5 * (speed_search._FAST if v > preferred else speed_search._SLOW) * (v - preferred) ** 2
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
