from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from drivax.scenario.schema import AgentKind, RoadKind
from drivax.synthetic.roads.curves import Pose
from drivax.synthetic.roads.families import CurvedRoad
from drivax.synthetic.traffic.placement import Density, draw_drivers, draw_path, join_drivers, place_vehicles
from drivax.synthetic.traffic.roles import ScriptedUser

from .traffic_scenes import drivers, road


@pytest.mark.parametrize("seed", range(6))
def test_placed_vehicles_keep_their_distance(seed):
    rng = np.random.default_rng(seed)
    network = CurvedRoad().build(rng)
    where = place_vehicles(network, 0, 50.0, Density(spacing_m=(5.0, 10.0), vehicles=200), rng)
    points = [(0, 50.0), *zip(where.lane, where.along_m, strict=True)]
    assert len(points) > 20
    for i, (lane, along) in enumerate(points):
        assert 0 < along < network.lanes[lane].length_m
        for other, other_along in points[i + 1 :]:
            if other == lane:
                assert abs(along - other_along) > 15.0
            elif other in network.lanes[lane].successors:
                assert network.lanes[lane].length_m - along + other_along > 15.0


def test_no_vehicle_begins_in_or_behind_an_obstacle_or_at_a_lane_end():
    network, _ = road(600.0, lanes=2)
    lanes = (network.lanes[0], dataclasses.replace(network.lanes[1], ends=True))
    network = dataclasses.replace(network, lanes=lanes)
    obstacle = ScriptedUser.from_pose(AgentKind.VEHICLE, (4.6, 1.9, 1.5), Pose(300.0, 0.0, 0.0), 10)
    density = Density(spacing_m=(4.0, 6.0), vehicles=200, leader_share=0.0)
    places = [
        place
        for seed in range(20)
        for place in zip(
            *dataclasses.astuple(
                place_vehicles(network, 0, 20.0, density, np.random.default_rng(seed), (obstacle,))
            ),
            strict=True,
        )
    ]
    along_m = np.array([along for lane, along in places if lane == 0])
    assert not np.any((along_m > 275.0) & (along_m < 310.0)) and np.any((along_m > 240.0) & (along_m < 275.0))
    assert max(along for lane, along in places if lane == 1) <= 525.0


def test_vehicle_types_match_their_shares():
    density = Density(van_share=0.2, truck_share=0.1, bus_share=0.05, cyclist_share=0.15)
    table = draw_drivers(20000, density, np.random.default_rng(0))
    length, cyclist = table.size_m[:, 0], table.cyclist
    counts = [np.mean(cyclist), np.mean(length > 10.0), np.mean((length > 6.9) & (length < 10.0)), np.mean(
        (table.size_m[:, 2] > 1.99) & (length < 6.5))]  # fmt: skip
    assert counts == pytest.approx([0.15, 0.05, 0.1, 0.2], abs=4 * 0.5 / np.sqrt(20000))
    assert np.all(table.kind[~cyclist] == AgentKind.VEHICLE)
    assert np.all((table.top_speed_mps[cyclist] >= 4.0) & (table.top_speed_mps[cyclist] <= 7.0))
    assert np.all(table.size_m[cyclist, 1] < 0.71) and np.all(table.size_m[~cyclist, 1] > 1.69)
    assert table.reaction_s.min() >= 0.1 and table.reaction_s.max() <= 0.6
    assert table.critical_gap_s.min() >= 3.5 and table.critical_gap_s.max() <= 6.0


def test_no_cyclists_on_fast_roads_and_only_cyclists_on_bicycle_lanes():
    lane = road()[0].lanes[0]
    fast, bike = dataclasses.replace(lane, limit_mps=25.0), dataclasses.replace(lane, kind=RoadKind.LANE_BIKE)
    lanes = [fast] * 300 + [bike] * 10 + [lane] * 300
    table = draw_drivers(610, Density(cyclist_share=0.3), np.random.default_rng(1), lanes)
    assert not table.cyclist[:300].any() and table.cyclist[300:310].all() and table.cyclist[310:].any()


def test_cyclists_ride_at_the_right_side_of_the_lane():
    network, _ = road(300.0, width_m=3.5)
    rider = draw_path(network, (0,), True, np.random.default_rng(0)).curve.xy[:, 1]
    car = draw_path(network, (0,), False, np.random.default_rng(0)).curve.xy[:, 1]
    assert rider.mean() == pytest.approx(-1.2, abs=0.08) and np.ptp(rider) < 0.21
    assert abs(car).max() < 0.21


def test_tables_of_drivers_are_joined_and_chosen_in_order():
    joined = join_drivers(drivers(2, 1), drivers(3, 2))
    assert joined.size_m.shape == (5, 3)
    assert np.array_equal(joined.headway_s[2:], drivers(3, 2).headway_s)
    assert np.array_equal(joined.select(np.array([4, 0])).headway_s, joined.headway_s[[4, 0]])
