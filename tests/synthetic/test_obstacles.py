from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from drivax.scenario.schema import AgentKind
from drivax.synthetic.roads.curves import Pose, straight
from drivax.synthetic.roads.network import Line, RoadKind, RoadNetwork
from drivax.synthetic.traffic.lateral import (
    DetourPositions,
    detour_path,
    displace_path,
    lane_change_path,
    quintic_step,
)
from drivax.synthetic.traffic.obstacles import Boxes, LeaderSearch, StaticObstacles, extents
from drivax.synthetic.traffic.path_arrays import PathTables, Worlds
from drivax.synthetic.traffic.paths import Sway, lane_path
from drivax.synthetic.traffic.roles import ScriptedUser, Staging
from drivax.synthetic.traffic.simulation import boxes_at

from .oracles import box_corners, distance_to_polyline, shared_area
from .traffic_scenes import drivers, road, run


def street(high=6.0):
    """One lane east (y = 0), one west (y = 3.5), and edges: one 2.5 m to the right, one to the left."""
    network, _ = road(300.0)
    lanes = list(network.lanes)
    lanes.append(dataclasses.replace(lanes[0], curve=straight(Pose(300.0, 3.5, math.pi), 300.0)))
    ring = np.array([[-5.0, -2.5], [305.0, -2.5], [305.0, high], [-5.0, high]])
    return RoadNetwork("test", tuple(lanes), (Line(RoadKind.EDGE_BOUNDARY, ring),))


def parked(x, y, steps, speed=None):
    one = ScriptedUser.from_pose(AgentKind.VEHICLE, (4.6, 1.9, 1.5), Pose(x, y, 0.0), steps)
    return one if speed is None else dataclasses.replace(one, speed=np.full(steps, speed))


def touches(motion, a, b):
    """Steps at which two users' boxes share an area, by clipping polygons."""
    steps = []
    for t in range(motion.xy.shape[1]):
        if (
            motion.valid[a, t]
            and motion.valid[b, t]
            and np.hypot(*(motion.xy[a, t] - motion.xy[b, t])) < 15.0
        ):
            boxes = [
                box_corners(motion.xy[k, t], motion.heading[k, t], *motion.size_m[k, :2]) for k in (a, b)
            ]
            if shared_area(*boxes) > 1e-6:
                steps.append(t)
    return steps


@pytest.mark.parametrize("turned", [0.0, 0.4, math.pi / 2, 2.5])
def test_extents_are_those_of_the_corners(turned):
    network, _ = road(100.0)
    path = lane_path(network, (0,), Sway())
    boxes = Boxes(np.array([[40.0, 2.0]]), np.array([turned]), np.zeros(1), np.array([[4.0, 1.8]]))
    extent, rows = extents(path, boxes)
    corners = np.array(box_corners((40.0, 2.0), turned, 4.0, 1.8))
    assert rows.tolist() == [0]
    assert extent.near_m[0] == pytest.approx(corners[:, 0].min()) and extent.far_m[0] == pytest.approx(
        corners[:, 0].max()
    )
    assert extent.right_m[0] == pytest.approx(corners[:, 1].min()) and extent.left_m[0] == pytest.approx(
        corners[:, 1].max()
    )


def test_distant_agents_have_no_extent():
    path = lane_path(road(100.0)[0], (0,), Sway())
    boxes = Boxes(np.array([[40.0, 30.0]]), np.zeros(1), np.zeros(1), np.array([[4.0, 1.8]]))
    assert not len(extents(path, boxes)[1])


@pytest.mark.parametrize(("high", "passes"), [(6.0, True), (2.2, False)])
def test_double_parked_car_is_passed_only_where_room_permits(high, passes):
    table = drivers(1, speed_factor=0.8)
    motion = run(street(high), [(0,)], table, [20.0], [10.0], 30.0, parked=(parked(150.0, -0.4, 300),))
    assert not touches(motion, 0, 1)
    x, y = motion.xy[0, motion.valid[0]].T
    assert (x.max() > 180.0) == passes
    if passes:
        assert y.max() > 1.5 and abs(y[x > 200.0]).max() < 0.1
        assert y.max() + 0.95 < high
    else:
        assert motion.speed[0, -1] < 0.01
        assert 150.0 - 2.3 - motion.size_m[0, 0] / 2 - x.max() == pytest.approx(5.0, abs=1.5)


def test_detours_yield_to_oncoming_traffic():
    table = drivers(2, speed_factor=0.8)
    network = street()
    motion = run(
        network, [(0,), (1,)], table, [90.0, 60.0], [8.0, 10.0], 40.0, parked=(parked(150.0, -0.4, 400),)
    )
    assert not touches(motion, 0, 1) and not touches(motion, 0, 2)
    assert motion.acceleration[1].min() > -1.5
    assert motion.xy[0, :, 0].max() > 180.0
    # Row 1 has passed before row 0 swings out.
    meeting = int(np.flatnonzero(motion.xy[0, :, 0] > motion.xy[1, :, 0])[0])
    assert motion.xy[0, meeting, 1] < 0.5


@pytest.mark.parametrize(("x", "y", "is_blocked"), [
    (40.0, 0.0, True),
    (40.0, 2.1, True),  # 2.1 - 0.95 m is nearer than 1.2 m
    (40.0, 2.2, False),
    (40.0, -2.2, False),
    (70.0, 0.0, False),  # its rear is 67.7 - 22.0 m ahead of the front
    (69.0, 0.0, True),
    (20.0, 0.0, False),  # passed: its rear is more than half a metre behind the front
])  # fmt: skip
def test_obstacles_in_the_band_ahead_are_detected(x, y, is_blocked):
    path = lane_path(street(), (0,), Sway())
    boxes = boxes_at((parked(x, y, 1),), 0)
    standing = StaticObstacles(Worlds([street()], [1]), [boxes], [extents(path, boxes)[0]], np.array([1.9]))
    assert standing.is_blocked(0, 22.0, 1.2, 45.0) == is_blocked


def test_cars_next_to_the_lane_change_nothing():
    table = drivers(1)
    free = run(street(), [(0,)], table, [20.0], [10.0], 15.0)
    with_parked = run(street(), [(0,)], table, [20.0], [10.0], 15.0, parked=(parked(150.0, -2.6, 150),))
    assert np.array_equal(free.xy[0], with_parked.xy[0])


def test_vehicles_brake_for_a_pedestrian_in_the_lane():
    steps = 150
    times = np.arange(steps) / 10
    # From 4 s on it walks from the right at 1.5 m/s to the middle of the lane at x = 120 m and stops there.
    y = np.clip(-5.0 + 1.5 * np.maximum(times - 4.0, 0.0), -5.0, 0.0)
    pedestrian = ScriptedUser(
        kind=AgentKind.PEDESTRIAN,
        size_m=(0.6, 0.6, 1.75),
        xy=np.stack([np.full(steps, 120.0), y], axis=-1),
        heading=np.full(steps, math.pi / 2),
        speed=np.gradient(y, times),
        valid=np.ones(steps, bool),
    )
    table = drivers(1, speed_factor=0.8)
    motion = run(street(), [(0,)], table, [20.0], [11.0], 15.0, Staging(extras=(pedestrian,)))
    assert not touches(motion, 0, 1)
    assert motion.speed[0, -1] < 0.1 and motion.xy[0, -1, 0] < 120.0
    assert motion.kind.tolist() == [AgentKind.VEHICLE, AgentKind.PEDESTRIAN]


def test_quintic_starts_with_value_and_slope_and_ends_level():
    at = np.linspace(0.0, 60.0, 6001)
    d = quintic_step(at, (10.0, 1.5, 0.1), 40.0)
    step = at[1]
    slope = np.gradient(d, step)
    assert np.interp(10.0, at, d) == pytest.approx(1.5, abs=1e-6)
    assert np.interp(10.0, at, slope) == pytest.approx(0.1, abs=1e-3)
    assert np.abs(d[at >= 50.0]).max() < 1e-9
    assert np.abs(np.gradient(slope, step)[(at > 10.1) & (at < 60)]).max() < 0.02


def test_displaced_path_keeps_its_offset():
    network, _ = road(200.0)
    path = lane_path(network, (0,), Sway())
    shifted = detour_path(path, DetourPositions(40.0, 60.0, 90.0, 115.0), 2.0)
    y = np.interp([20.0, 75.0, 150.0], shifted.curve.xy[:, 0], shifted.curve.xy[:, 1])
    assert y == pytest.approx([0.0, 2.0, 0.0], abs=1e-6)
    # The new path is as long as its curve, and its lane still ends at the path's end.
    longer = np.hypot(*np.diff(shifted.curve.xy, axis=0).T).sum() - 200.0
    assert shifted.length_m == pytest.approx(200.0 + longer, abs=0.01) and longer > 0.2
    last = shifted.spans[0]
    assert last.begin_m + last.scale * 200.0 == pytest.approx(shifted.length_m, abs=0.01)
    chord = np.arctan2(*np.diff(shifted.curve.xy, axis=0).T[::-1])
    assert np.abs(chord - (shifted.curve.heading[1:] + shifted.curve.heading[:-1]) / 2).max() < 0.01
    same, moved = displace_path(path, np.zeros(len(path.curve.xy)))
    assert np.allclose(same.curve.xy, path.curve.xy) and np.allclose(
        moved, path.step_m * np.arange(len(moved))
    )


def test_lane_change_starts_at_the_vehicle():
    network, columns = road(300.0, lanes=2)
    present, target = (lane_path(network, (column[0],), Sway((0.2,), (0.05,), (0.3,))) for column in columns)
    path, at = lane_change_path(target, present, 80.3, 50.0)
    xy = [np.interp(at, path.step_m * np.arange(len(path.curve.xy)), path.curve.xy[:, k]) for k in (0, 1)]
    old = [np.interp(80.3, present.curve.arc_m, present.curve.xy[:, k]) for k in (0, 1)]
    assert np.hypot(*(np.array(xy) - old)) < 0.02
    end = path.curve.xy[path.step_m * np.arange(len(path.curve.xy)) > at + 51.0]
    assert distance_to_polyline(end, target.curve.xy).max() < 0.02
    during = set(path.lane[round((at + 10.0) / path.step_m)]) - {-1}
    after = set(path.lane[round((at + 45.0) / path.step_m)]) - {-1}
    assert during == {columns[0][0], columns[1][0]} and after == {columns[1][0]}


def leaders(routes, at, table, active=None, **roads):
    network, _ = road(300.0, **roads)
    worlds = Worlds([network], [len(routes)])
    tables = PathTables(worlds, [lane_path(network, route, Sway()) for route in routes], table)
    is_active = np.ones(len(at), bool) if active is None else np.array(active)
    return LeaderSearch(worlds, table).find(tables, np.array(at, float), is_active)


@pytest.mark.parametrize("seed", range(5))
def test_leader_is_the_nearest_vehicle_ahead_on_the_path(seed):
    # Three lanes in three sections of 100 m: lane 3k + j is the j-th section of the k-th column.
    rng = np.random.default_rng(seed)
    column, at, is_active = rng.integers(0, 3, 14), rng.uniform(5.0, 290.0, 14), rng.random(14) < 0.8
    table = drivers(14, seed)
    gap, leader = leaders(
        [(3 * k, 3 * k + 1, 3 * k + 2) for k in column.tolist()], at, table, is_active, lanes=3, sections=3
    )
    for i in range(14):
        ahead = [j for j in range(14) if is_active[j] and column[j] == column[i] and at[j] > at[i]]
        if not ahead:
            assert gap[i] == np.inf
            continue
        # The nearest by its rear: lengths differ.
        room = {j: at[j] - at[i] - (table.size_m[j, 0] + table.size_m[i, 0]) / 2 for j in ahead}
        nearest = min(room, key=lambda j: room[j])
        assert gap[i] == pytest.approx(room[nearest], abs=1e-6)
        assert leader[i] == nearest


@pytest.mark.parametrize(("width", "follows"), [(3.5, True), (7.0, False)])
def test_cyclists_are_leaders_only_on_narrow_lanes(width, follows):
    # A car of 2 m needs 1 m of half the lane; 2.4 m are the cyclist's.
    table = drivers(2)
    size = np.array([[4.6, 2.0, 1.5], [1.8, 0.7, 1.7]])
    table = dataclasses.replace(
        table, size_m=size, kind=np.array([AgentKind.VEHICLE, AgentKind.CYCLIST], np.int8)
    )
    gap, _ = leaders([(0,), (0,)], [20.0, 40.0], table, width_m=width)
    assert gap[0] == (pytest.approx(20.0 - 3.2, abs=1e-6) if follows else np.inf)


def test_empty_road_has_no_leaders():
    gap, _ = leaders([(0,), (0,)], [20.0, 40.0], drivers(2), [False, False])
    assert np.all(gap == np.inf)
