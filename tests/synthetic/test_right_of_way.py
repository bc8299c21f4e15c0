from __future__ import annotations

import math

import numpy as np
import pytest

from drivax.synthetic.roads.network import CLEARANCE_M, Control
from drivax.synthetic.traffic.right_of_way import conflict_zones, time_to_cover
from drivax.synthetic.traffic.roles import EgoPlan

from .traffic_scenes import crossroads, drivers, entered, run, twins

ROUTES = ((0, 1, 2), (3, 4, 5), (6, 7, 8), (9, 10, 11))


def test_conflict_zones_are_where_connectors_are_near():
    network = crossroads(2)
    begin, end = conflict_zones(network)
    # Two lines at right angles: each is near the other within the clearance of the crossing point (112, -2).
    assert begin[1, 4] == pytest.approx(12.0 - CLEARANCE_M, abs=1.0)
    assert end[1, 4] == pytest.approx(12.0 + CLEARANCE_M, abs=1.0)
    assert np.argwhere(~np.isnan(begin)).tolist() == [[1, 4], [4, 1]]
    assert np.isnan(begin).tolist() == np.isnan(end).tolist()


@pytest.mark.parametrize(
    ("distance", "speed"), [(0.0, 3.0), (5.0, 0.0), (12.0, 2.0), (80.0, 4.0), (-3.0, 4.0)]
)
def test_travel_time_agrees_with_simulation(distance, speed):
    at, v, t = 0.0, speed, 0.0
    while at < distance:
        at, v, t = at + v * 1e-4, min(v + 1.5e-4, 9.0), t + 1e-4
    assert time_to_cover(np.array([distance]), speed, 1.5, 9.0)[0] == pytest.approx(t, abs=0.01)


def yielding(seconds_away, control=Control.YIELD, speed=10.0):
    """Row 1 must yield to row 0, which reaches the conflict ``seconds_away`` after the start.

    Returns the first steps of row 1 beyond its line and of row 0 at the conflict, and the motion.
    """
    network = crossroads(2, control=[Control.NONE, control], yields_to=[(), (1,)])
    table = drivers(2, speed_factor=0.7, critical_gap_s=4.5, acceleration_mps2=1.5)
    # Row 1 stands 2 m before its line.
    at = [112.0 - 2.0 - speed * seconds_away, 98.0 - table.size_m[1, 0] / 2]
    motion = run(network, ROUTES[:2], table, at, [speed, 0.0], 12.0)
    return (
        entered(motion, 1, 100.0, table.size_m[1, 0]),
        entered(motion, 0, 112.0, table.size_m[0, 0]),
        motion,
    )


def test_yielding_vehicle_accepts_an_eight_second_gap_and_rejects_three():
    yielding_step, priority_step, _ = yielding(3.0)
    assert priority_step < 40 and yielding_step > priority_step
    yielding_step, priority_step, motion = yielding(8.0)
    assert yielding_step < 30 and yielding_step < priority_step
    # The vehicle with priority is not hindered.
    assert motion.acceleration[0].min() > -1.0


def test_vehicles_pass_a_yield_sign_without_stopping_when_the_road_is_free():
    network = crossroads(2, control=[Control.NONE, Control.YIELD], yields_to=[(), (1,)])
    table = drivers(2, speed_factor=0.7)
    motion = run(network, ROUTES[:2], table, [200.0, 20.0], [10.0, 10.0], 12.0)
    assert motion.speed[1].min() > 8.0


def test_all_vehicles_stand_at_a_stop_sign():
    network = crossroads(2, control=[Control.NONE, Control.STOP], yields_to=[(), (1,)])
    table = drivers(2, speed_factor=0.7)
    motion = run(network, ROUTES[:2], table, [200.0, 20.0], [10.0, 10.0], 25.0)
    size = table.size_m[1, 0]
    line = entered(motion, 1, 100.0, size)
    stops = np.flatnonzero(motion.speed[1, :line] < 0.21)
    assert len(stops) and line < 200
    assert 100.0 - 4.5 < motion.distance_m[1, stops[0]] + size / 2 <= 100.0


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (2, 0, 3, 1)])
def test_all_way_stop_serves_in_order_of_arrival(order):
    network = crossroads(4, control=[Control.ALL_WAY_STOP] * 4)
    table = twins(4, speed_factor=0.6)
    # Each vehicle is 12 m (more than a second) behind the previous one.
    at = [80.0 - 12.0 * order[row] for row in range(4)]
    motion = run(network, ROUTES, table, at, [6.0] * 4, 40.0)
    lines = [entered(motion, row, 100.0, table.size_m[row, 0]) for row in range(4)]
    # Rows 0 and 2 come from opposite sides and do not meet, nor do 1 and 3.
    for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)):
        assert (lines[a] < lines[b]) == (order[a] < order[b])
    assert max(lines) < 400


def test_right_hand_vehicle_goes_first_on_simultaneous_arrival():
    network = crossroads(2, control=[Control.ALL_WAY_STOP] * 2)
    table = twins(2, speed_factor=0.6)
    half = table.size_m[:, 0] / 2
    motion = run(network, ROUTES[:2], table, 60.0 - half, [6.0] * 2, 25.0)
    lines = [entered(motion, row, 100.0, table.size_m[row, 0]) for row in range(2)]
    # Row 1 goes north and so comes from the right of row 0, which goes east.
    assert lines[1] < lines[0] < 250


def test_no_vehicle_enters_a_junction_that_cannot_be_cleared():
    network = crossroads(2, control=[Control.YIELD, Control.NONE], yields_to=[(4,), ()])
    table = drivers(3, speed_factor=0.7)
    # Row 0 stands right behind the junction on row 1's path (both go east); row 2 goes north later.
    standing = EgoPlan(0, np.tile([124.0, -2.0], (200, 1)), np.zeros(200), np.zeros(200))
    routes, at, speed = (ROUTES[0], ROUTES[0], ROUTES[1]), [124.0, 60.0, 20.0], [0.0, 8.0, 8.0]
    motion = run(network, routes, table, at, speed, 20.0, ego=standing)
    assert (motion.distance_m[1] + table.size_m[1, 0] / 2).max() < 100.0
    assert motion.distance_m[2, -1] > 120.0


def test_connectors_of_one_lane_and_oncoming_traffic_do_not_conflict():
    network = crossroads(4)
    begin, _ = conflict_zones(network)
    assert math.isnan(begin[1, 7]) and not math.isnan(begin[1, 10])
