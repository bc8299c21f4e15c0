from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from drivax.synthetic.curves import Pose, straight
from drivax.synthetic.drafting import Draft
from drivax.synthetic.families import CurvedRoad
from drivax.synthetic.paths import Sway, lane_path, random_lanes
from drivax.synthetic.population import Density, drawn_drivers, joined_drivers, placed
from drivax.synthetic.roads import RoadNetwork
from drivax.synthetic.signals import LightGroup, SignalPlan
from drivax.synthetic.traffic import Override, Traffic, speed_profile


def line_with_light(signals=None):
    """200 m of road, a stop line, 20 m of junction, 300 m of road; limit 15 m/s."""
    draft = Draft()
    a = draft.lane(straight(Pose(0.0, 0.0, 0.0), 200.0), 3.5, 15.0)
    b = draft.lane(straight(Pose(200.0, 0.0, 0.0), 20.0), 3.5, 15.0, connector=True)
    c = draft.lane(straight(Pose(220.0, 0.0, 0.0), 300.0), 3.5, 15.0)
    draft.link(a, b)
    draft.link(b, c)
    return RoadNetwork("test", tuple(draft.lanes), (), signals=signals)


def light(green_s, offset_s=0.0):
    """Green for ``green_s`` from ``offset_s`` on, then yellow, then a long red."""
    groups = (LightGroup((1,), False), LightGroup((), False))
    return SignalPlan(groups, ((0,), (1,)), (green_s, 500.0), offset_s=offset_s)


def drivers(count, seed=0, **values):
    table = drawn_drivers(count, 0.0, np.random.default_rng(seed))
    return dataclasses.replace(table, **{k: np.full(count, v) for k, v in values.items()})


def run(network, table, at, speed, seconds, overrides=()):
    paths = [lane_path(network, (0, 1, 2), Sway()) for _ in at]
    times = np.arange(round(seconds * 10)) / 10
    return Traffic(network, paths, table, np.array(at, float), np.array(speed, float), times).run(overrides)


def test_the_speed_profile_is_the_slowest_that_is_needed():
    network = CurvedRoad().build(np.random.default_rng(3))
    path = lane_path(network, random_lanes(network, 0, np.random.default_rng(0)), Sway())
    got = speed_profile(path, 0.9, 2.0, 1.4)
    top = np.minimum(0.9 * path.limit_mps, np.sqrt(2.0 / np.maximum(np.abs(path.curvature), 1e-6)))
    for i in range(0, len(top), 61):
        brute = min(math.sqrt(top[j] ** 2 + 2 * 1.4 * path.step_m * (j - i)) for j in range(i, len(top)))
        assert got[i] == pytest.approx(brute)
    assert got.min() < top.max()


def test_a_free_driver_reaches_and_holds_the_wanted_speed():
    motion = run(line_with_light(), drivers(1, speed_factor=0.9), [10.0], [5.0], 20.0)
    assert motion.speed[0, -1] == pytest.approx(0.9 * 15.0, rel=0.02)
    assert motion.speed[0].max() <= 0.9 * 15.0 + 0.05


@pytest.mark.parametrize("speed", [6.0, 10.0, 14.0])
@pytest.mark.parametrize("seed", range(3))
def test_at_red_everybody_stops_behind_the_line(speed, seed):
    table = drivers(3, seed)
    motion = run(line_with_light(light(1.0, -10.0)), table, [140.0, 110.0, 70.0], [speed] * 3, 30.0)
    front = motion.distance_m[0] + table.size_m[0, 0] / 2
    assert front.max() < 200.0
    assert front[-1] > 197.0
    assert motion.speed[:, -1] == pytest.approx(0.0, abs=0.05)
    gaps = motion.distance_m[:-1, -1] - motion.distance_m[1:, -1]
    lengths = (table.size_m[:-1, 0] + table.size_m[1:, 0]) / 2
    assert np.all(gaps - lengths > 1.0) and np.all(gaps - lengths < 4.0)
    assert motion.acceleration.min() > -4.5


def test_green_is_driven_through_and_red_is_left_when_it_turns_green():
    through = run(line_with_light(light(30.0)), drivers(1), [150.0], [12.0], 10.0)
    assert through.distance_m[0, -1] > 230.0
    table = drivers(1)
    waits = run(line_with_light(light(20.0, offset_s=10.0)), table, [185.0], [8.0], 25.0)
    front = waits.distance_m[0] + table.size_m[0, 0] / 2
    assert front[99] < 200.0 and waits.speed[0, 99] < 0.3
    assert waits.distance_m[0, -1] > 230.0


@pytest.mark.parametrize("at", range(120, 196, 5))
def test_yellow_is_stopped_for_or_passed_but_red_never_run(at):
    table = drivers(1, seed=at)
    motion = run(line_with_light(light(1.0)), table, [float(at)], [13.0], 15.0)
    front = motion.distance_m[0] + table.size_m[0, 0] / 2
    # Green until 1.0 s, yellow until 4.0 s.
    passed = np.flatnonzero(front > 200.0)
    assert not len(passed) or passed[0] <= 41
    assert motion.acceleration.min() > -5.5


def test_nobody_touches_a_leader_who_brakes_to_a_halt():
    table = drivers(4, seed=2)
    stop = Override(vehicle=0, first_step=20, last_step=120, acceleration_mps2=-4.0)
    motion = run(line_with_light(), table, [150.0, 120.0, 92.0, 60.0], [12.0] * 4, 16.0, (stop,))
    assert motion.speed[0, 70] == 0.0
    assert motion.acceleration[0, 25:40] == pytest.approx(-4.0)
    gaps = motion.distance_m[:-1] - motion.distance_m[1:]
    assert (gaps - (table.size_m[:-1, 0] + table.size_m[1:, 0])[:, None] / 2).min() > 0.3


def test_positions_are_the_integral_of_speeds_and_stops_are_exact():
    stop = Override(0, 5, 60, -6.0)
    motion = run(line_with_light(), drivers(1, speed_factor=1.0), [20.0], [10.0], 8.0, (stop,))
    v, s = motion.speed[0], motion.distance_m[0]
    # Trapezoids are exact at constant acceleration; in the step of the halt the distance is v^2 / (2 a).
    halt = int(np.flatnonzero((v[1:] == 0) & (v[:-1] > 0))[0])
    moved = np.diff(s)
    trapezoid = (v[1:] + v[:-1]) / 2 * 0.1
    others = np.arange(len(moved)) != halt
    assert np.allclose(moved[others], trapezoid[others])
    assert moved[halt] == pytest.approx(v[halt] ** 2 / (2 * -motion.acceleration[0, halt]))
    assert np.all(v[halt + 1 : 60] == 0) and np.ptp(s[halt + 1 : 60]) == 0


def crossroads():
    """Two roads that cross at right angles, without lights: lanes 0-1-2 eastwards, 3-4-5 northwards."""
    draft = Draft()
    for x, y, heading in ((0.0, 0.0, 0.0), (110.0, -110.0, math.pi / 2)):
        begin = Pose(x, y, heading)
        parts = [
            draft.lane(straight(begin.ahead(at), length), 3.5, 15.0, connector=at == 100.0)
            for at, length in ((0.0, 100.0), (100.0, 20.0), (120.0, 200.0))
        ]
        draft.link(parts[0], parts[1])
        draft.link(parts[1], parts[2])
    return RoadNetwork("test", tuple(draft.lanes), ())


@pytest.mark.parametrize("crossing", [True, False])
def test_nobody_enters_while_somebody_still_crosses(crossing):
    network = crossroads()
    assert np.argwhere(network.conflicts).tolist() == [[1, 4], [4, 1]]
    table = drivers(2, speed_factor=0.9)
    paths = [lane_path(network, lanes, Sway()) for lanes in ((0, 1, 2), (3, 4, 5))]
    # The first one creeps across the junction, or has crossed it already.
    at = np.array([104.0 if crossing else 140.0, 50.0])
    creep = Override(vehicle=0, first_step=0, last_step=75, acceleration_mps2=0.0)
    motion = Traffic(network, paths, table, at, np.array([2.0, 10.0]), np.arange(150) / 10).run((creep,))
    front = motion.distance_m[1] + table.size_m[1, 0] / 2
    rear = motion.distance_m[0] - table.size_m[0, 0] / 2
    entered = int(np.flatnonzero(front > 100.0)[0])
    if crossing:
        assert rear[entered] >= 120.0 - 0.5 and entered > 70
        assert motion.speed[1, :entered].min() < 0.6
    else:
        assert entered < 60 and motion.speed[1].min() > 5.0


def test_vehicles_leave_at_the_end_of_the_map():
    motion = run(line_with_light(), drivers(1), [480.0], [13.0], 6.0)
    assert motion.valid[0, 0] and not motion.valid[0, -1]
    assert np.all(np.diff(motion.valid[0].astype(int)) <= 0)


@pytest.mark.parametrize("seed", range(6))
def test_placed_vehicles_keep_their_distance(seed):
    rng = np.random.default_rng(seed)
    network = CurvedRoad().build(rng)
    where = placed(network, 0, 50.0, Density(spacing_m=(5.0, 10.0), vehicles=200), rng)
    points = [(0, 50.0), *zip(where.lane, where.along_m, strict=True)]
    assert len(points) > 20
    for i, (lane, along) in enumerate(points):
        assert 0 < along < network.lanes[lane].length_m
        for other, there in points[i + 1 :]:
            if other == lane:
                assert abs(along - there) > 15.0
            elif other in network.lanes[lane].successors:
                assert network.lanes[lane].length_m - along + there > 15.0


def test_tables_of_drivers_are_joined_in_order():
    both = joined_drivers(drivers(2, 1), drivers(3, 2))
    assert both.size_m.shape == (5, 3)
    assert np.array_equal(both.headway_s[2:], drivers(3, 2).headway_s)
