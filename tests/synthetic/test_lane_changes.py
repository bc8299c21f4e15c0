from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from drivax.simulator.idm import IdmParameters, idm_acceleration
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.lane_changes import LaneChains, LaneChanges, VehicleState
from drivax.synthetic.traffic.obstacles import Boxes
from drivax.synthetic.traffic.path_arrays import PathTables, Worlds
from drivax.synthetic.traffic.paths import Sway, lane_path
from drivax.synthetic.traffic.roles import Override, Staging

from .traffic_scenes import drivers, road, run

NOTHING = Boxes(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 2)))


def decisions(routes, at, speed, politeness=0.0, network=None, movers=(1,), standing=NOTHING):
    """Lane changes of the rows ``movers`` on two lanes 600 m long, and the pairs that open gaps."""
    network = network or road(lanes=2)[0]
    table = drivers(len(at), speed_factor=1.0, politeness=politeness, headway_s=1.5)
    table = dataclasses.replace(
        table,
        acceleration_mps2=np.full(len(at), 1.5),
        braking_mps2=np.full(len(at), 2.0),
        size_m=np.tile([5.0, 2.0, 1.5], (len(at), 1)),
    )
    paths = [lane_path(network, route, Sway()) for route in routes]
    worlds = Worlds([network], [len(at)])
    tables = PathTables(worlds, paths, table)
    at, speed = np.array(at, float), np.array(speed, float)
    fastest = tables.interpolate(at, np.arange(len(at)))[:, 3]
    preferred = np.full(len(at), np.nan)
    for i, route in enumerate(routes):
        ahead = [j for j in range(len(at)) if j != i and routes[j] == route and at[j] > at[i]]
        j = min(ahead, key=lambda j: at[j], default=None)
        gap = np.inf if j is None else at[j] - at[i] - 5.0
        preferred[i] = law(speed[i], gap, 0.0 if j is None else speed[j])
    free = np.isin(np.arange(len(at)), movers)
    changes = LaneChanges(worlds, table, [standing])
    now = VehicleState(at, speed, np.ones(len(at), bool), free, fastest, preferred)
    return changes.decide(now, tables)


def law(speed, gap, leader_speed):
    parameters = IdmParameters(headway_s=1.5, acceleration_mps2=1.5, comfortable_braking_mps2=2.0)
    values = (np.array([x], float) for x in (speed, 15.0, gap, leader_speed))
    return float(idm_acceleration(*values, parameters)[0])


def by_hand(gap_ahead_new, gap_behind_new, politeness, gap_ahead_old=20.0):
    """MOBIL by hand for row 1 at 12 m/s behind a leader at 8 m/s; the new follower drives 14 m/s, alone."""
    own, new = law(12.0, gap_ahead_old, 8.0), law(12.0, gap_ahead_new, 15.0)
    follower, follower_then = (
        law(14.0, gap_ahead_new + gap_behind_new + 5.0, 15.0),
        law(14.0, gap_behind_new, 12.0),
    )
    gain = new - own + politeness * (follower_then - follower)
    return gain > 0.25 and follower_then > -2.5


@pytest.mark.parametrize("behind", [6.0, 12.0, 20.0, 30.0, 60.0])
@pytest.mark.parametrize("ahead", [8.0, 15.0, 60.0])
@pytest.mark.parametrize("politeness", [0.0, 1.0])
def test_lane_changes_follow_mobil(behind, ahead, politeness):
    # Rows: ego far away, the candidate, its leader; on the left lane the new leader and the new follower.
    at = [20.0, 300.0, 325.0, 305.0 + ahead, 295.0 - behind]
    routes = [(1,), (1,), (1,), (0,), (0,)]
    changes, _ = decisions(routes, at, [10.0, 12.0, 8.0, 15.0, 14.0], politeness)
    mine = [change for change in changes if change.vehicle == 1]
    roomy = ahead > 2.0 and behind > 2.0 + 0.25 * 14.0
    assert bool(mine) == (by_hand(ahead, behind, politeness) and roomy)
    for change in mine:
        assert change.lane == 0 and change.length_m == pytest.approx(4.2 * 12.0)


@pytest.mark.parametrize("politeness", [0.0, 0.5, 1.0])
def test_only_polite_drivers_make_way_for_followers(politeness):
    # Row 1 at 9 m/s has the same gap to a leader at 8.5 m/s on both lanes; row 3 at 13 m/s is held up behind it.
    at, routes = [20.0, 300.0, 330.0, 275.0, 330.0], [(1,), (1,), (1,), (1,), (0,)]
    speed = [9.0, 9.0, 8.5, 13.0, 8.5]
    own, new = law(9.0, 25.0, 8.5), law(9.0, 25.0, 8.5)
    held, then = law(13.0, 20.0, 9.0), law(13.0, 50.0, 8.5)
    gain = new - own + politeness * (then - held)
    changes, _ = decisions(routes, at, speed, politeness)
    assert (1 in [change.vehicle for change in changes]) == (gain > 0.25)
    assert (gain > 0.25) == (politeness > 0)


def test_no_lane_change_without_incentive_or_next_to_a_vehicle():
    routes = [(1,), (1,), (0,)]
    assert decisions(routes, [20.0, 300.0, 500.0], [10.0, 14.0, 14.0])[0] == []
    assert decisions([(1,), (1,), (1,), (0,)], [20.0, 300.0, 315.0, 302.0], [10.0, 12.0, 5.0, 12.0])[0] == []


@pytest.mark.parametrize(("obstacle_m", "changes"), [(340.0, False), (298.0, False), (290.0, True)])
def test_obstacles_block_a_change_only_ahead_and_next_to_the_vehicle(obstacle_m, changes):
    obstacle = Boxes(np.array([[obstacle_m, 0.0]]), np.zeros(1), np.zeros(1), np.array([[4.8, 2.0]]))
    routes, at, speed = [(1,), (1,), (1,)], [20.0, 300.0, 330.0], [10.0, 12.0, 6.0]
    assert bool(decisions(routes, at, speed, standing=obstacle)[0]) == changes


def test_only_one_vehicle_takes_a_contested_gap():
    routes = [(1,), (1,), (1,), (1,), (0,)]
    changes, _ = decisions(
        routes, [20.0, 300.0, 318.0, 340.0, 500.0], [10.0, 12.0, 9.0, 5.0, 14.0], movers=(1, 2, 3)
    )
    assert len(changes) == 1


def test_chains_span_sections_and_end_at_forks():
    network, columns = road(lanes=2, sections=3)
    chains = LaneChains.from_network(network)
    assert [chains.offset_m[k] for k in columns[0]] == pytest.approx([0.0, 200.0, 400.0])
    assert len({int(chains.chain[k]) for k in columns[0]}) == 1
    assert chains.chain[columns[1][0]] != chains.chain[columns[0][0]]
    assert chains.left[columns[1][1]] == columns[0][1] and chains.right[columns[1][1]] == -1


def drop():
    """Two lanes of 300 m in three sections; the right one ends after that, the left one goes on for 300 m."""
    network, columns = road(length_m=600.0, lanes=2, sections=6)
    lanes = list(network.lanes)
    keep = [*columns[0], *columns[1][:3]]
    number = {old: new for new, old in enumerate(keep)}
    result = []
    for old in keep:
        lane = lanes[old]
        last = old == columns[1][2]
        result.append(
            dataclasses.replace(
                lane,
                successors=() if last else tuple(number[k] for k in lane.successors),
                predecessors=tuple(number[k] for k in lane.predecessors),
                left=number.get(lane.left, -1),
                right=number.get(lane.right, -1),
                ends=last,
            )
        )
    return RoadNetwork("test", tuple(result), ())


@pytest.mark.parametrize("seed", range(4))
def test_all_vehicles_merge_before_the_lane_ends(seed):
    network = drop()
    table = drivers(7, seed, speed_factor=0.9)
    left, right = (0, 1, 2, 3, 4, 5), (6, 7, 8)
    routes = [left, right, right, right, left, left, left]
    at = [10.0, 150.0, 110.0, 70.0, 140.0, 100.0, 60.0]
    motion = run(network, routes, table, at, [12.0] * 7, 40.0)
    # Rows 1 to 3 start on the right lane and end on the left one, y = 0, beyond the drop.
    for row in (1, 2, 3):
        beyond = motion.xy[row, motion.valid[row], 0] > 305.0
        assert beyond.any()
        assert np.abs(motion.xy[row, motion.valid[row]][beyond, 1]).max() < 0.3
    assert motion.acceleration.min() > -5.0


def test_vehicles_without_room_wait_before_the_end_of_the_lane():
    network = drop()
    count = 24
    table = drivers(count, 1, speed_factor=0.9, politeness=0.0)
    routes = [(0, 1, 2, 3, 4, 5)] * (count - 1) + [(6, 7, 8)]
    # A standing column of cars next to the whole lane.
    at = [270.0 - 9.0 * k + 20.0 for k in range(count - 1)] + [180.0]
    hold = Staging(overrides=tuple(Override(k, 0, 400, -3.0) for k in range(count - 1)))
    motion = run(network, routes, table, at, [0.0] * (count - 1) + [10.0], 25.0, hold)
    assert motion.speed[-1, -1] < 0.1
    assert 265.0 < motion.xy[-1, -1, 0] < 297.0


def test_lane_change_is_smooth_and_occupies_both_lanes():
    network, columns = road(lanes=2)
    table = drivers(4, 0, speed_factor=0.95, politeness=0.0)
    # Row 1 comes up behind a slow one and passes; row 3 follows far behind on the left.
    routes = [(columns[1][0],), (columns[1][0],), (columns[1][0],), (columns[0][0],)]
    table = dataclasses.replace(table, top_speed_mps=np.array([3.0, np.inf, 6.0, np.inf]))
    motion = run(network, routes, table, [20.0, 60.0, 110.0, 30.0], [3.0, 13.0, 6.0, 10.0], 20.0)
    y = motion.xy[1, :, 1]
    assert y[0] == pytest.approx(-3.5) and abs(y[-1]) < 0.2
    moving = np.hypot(*np.diff(motion.xy[1], axis=0).T)
    assert moving == pytest.approx((motion.speed[1, 1:] + motion.speed[1, :-1]) * 0.05, abs=0.02)
    chord = np.arctan2(*np.diff(motion.xy[1], axis=0).T[::-1])
    assert np.abs(chord - (motion.heading[1, 1:] + motion.heading[1, :-1]) / 2).max() < 0.02
    assert motion.distance_m[1, -1] > motion.distance_m[2, -1]
    spans = {span.lane: span for span in motion.paths[1].spans}
    assert set(spans) == {0, 1} and np.isfinite(spans[1].until_m)
