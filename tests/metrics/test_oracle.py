"""Metrics on random scenes against an oracle that uses other methods in float64."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import RoadKind
from judging import BATCH, judge
from metric_oracle import Judge
from metric_scenes import two_way_road
from scenes import car, line, straight_road

KINDS = ((1, 4.8, 2.0), (1, 12.0, 2.5), (2, 0.6, 0.6), (3, 1.8, 0.7))
QUARTER = np.pi / 2


def random_car(rng):
    """A car near ego's path at constant velocity; a quarter stand, and some are present only for a while."""
    kind, length, width = KINDS[rng.choice(4, p=[0.6, 0.1, 0.2, 0.1])]
    heading = rng.choice([0.0, np.pi, QUARTER, -QUARTER]) + rng.normal(0, 0.15)
    x, y, speed = rng.uniform([-20, -3, 0.0], [70, 8, 12.0])
    first, last = np.sort(rng.integers(0, 91, 2)) if rng.random() < 0.3 else (0, 91)
    speed *= rng.random() > 0.25
    # A car that never gets 0.3 m from its median position is stored as parked, at one pose: let it stand.
    speed *= speed * 0.1 * (last - first) / 2 > 0.35
    return car(x, y, heading, speed, length, width, kind, range(first, last))


def random_scene(rng):
    """A road with a light, up to six other agents, and ego's motion; the log drives straight on."""
    cars = [
        car(speed=rng.choice([0.0, 4.0, 10.0, 13.0])),
        *(random_car(rng) for _ in range(rng.integers(0, 7))),
    ]
    states = np.repeat(rng.choice([0, 4, 5, 6, 1], 4), 25)[:91]
    end = rng.choice([90.0, 350.0])
    road, two_way = straight_road(cars, light=states, light_x=30.0, end=end), bool(rng.random() < 0.5)
    if two_way:
        oncoming = next(f for f in two_way_road(cars, end=end).features if f.feature_id == 2)
        kept = [replace(f, left_neighbours=()) for f in road.features if f.feature_id != 2]
        road = replace(road, features=(*kept, oncoming))
    if rng.random() < 0.5:
        road = replace(road, features=(*road.features, random_lane(rng)))
    return road, random_drive(rng), two_way


def random_lane(rng):
    """A street that crosses the road, or a lane that leaves it."""
    angle, limit = rng.choice([-1, 1]) * rng.uniform(0.1, 3.0), rng.choice([4.0, 8.0, 20.0])
    x, along = rng.uniform(5, 60), 60 * np.array([np.cos(angle), np.sin(angle)])
    begin = np.array([x, rng.uniform(-1, 4)]) - rng.choice([0, 1]) * along
    return MapFeature(7, RoadKind.LANE_SURFACE, line(begin, begin + 2 * along), limit, 3.7)


def random_drive(rng):
    """Continue the log smoothly, with oscillating speed and heading and a drift to one side."""
    wave, pace = rng.uniform(0.3, 3), rng.uniform(0.3, 2)
    gain = rng.uniform(-4, 4) / wave
    steer, drift = rng.choice([0.0, 0.05, 0.3]) * rng.normal(), rng.choice([0.0, 0.0, 0.05]) * rng.normal()
    t = (np.arange(91) - 10) * 0.1
    later = np.maximum(t, 0.0)

    def drive(log):
        speed = np.maximum(log[10, 3] + gain * (np.cos(wave * later) - 1.0), 0.0)
        heading = steer * (1 - np.cos(pace * later)) + drift * np.minimum(later, 2.0)
        middle = (heading[1:] + heading[:-1]) / 2
        step = (speed[1:] + speed[:-1])[:, None] / 2 * 0.1 * np.stack([np.cos(middle), np.sin(middle)], -1)
        xy = np.concatenate([np.zeros((1, 2)), step.cumsum(axis=0)])
        driven = np.stack([*(xy - xy[10]).T, heading, speed], -1)
        return np.where((t > 0)[:, None], driven, log)

    return drive


def same(value, actual):
    if value is None or actual is None:
        return value is actual
    return actual == pytest.approx(float(value), rel=2e-3, abs=5e-3)


def compare(seed):
    """Compare ``BATCH`` random scenes with the oracle, except those near a threshold; return how many."""
    rng = np.random.default_rng(seed)
    cases = [random_scene(rng) for _ in range(BATCH)]
    result = judge([road for road, _, _ in cases], [drive for _, drive, _ in cases])
    compared = 0
    for number, ((road, drive, two_way), actual) in enumerate(zip(cases, result, strict=True)):
        ego = road.tracks
        log = np.column_stack([ego.xy[0], ego.heading[0], np.hypot(*ego.velocity[0].T)])
        # The oracle reads the same motion as the package, in float32.
        oracle = Judge(road, drive(log).astype(np.float32).astype(np.float64), two_way)
        expected, ttc = oracle.episode(actual["series"]["ttc"])
        if oracle.ambiguous:
            continue
        compared += 1
        for name, value in expected.items():
            assert same(value, actual[name]), (seed, number, name, value, actual[name])
        for t, (value, grazing) in ttc.items():
            fine = actual["series"]["ttc"][t - 11] == pytest.approx(value, abs=4e-3)
            assert fine or (value == 5.0 and grazing() == 5.0), (seed, number, t, value)
    return compared


@settings(max_examples=2)
@given(st.integers(0, 2**31))
def test_metrics_of_random_scenes_equal_the_oracle(seed):
    compare(seed)


@pytest.mark.slow
def test_many_random_scenes():
    assert sum(compare(seed) for seed in range(30)) >= 150
