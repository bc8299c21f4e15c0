from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from drivax.synthetic.roads.curves import Pose, straight
from drivax.synthetic.roads.network import Bay, Draft, RoadNetwork
from drivax.synthetic.traffic.placement import parked_cars


def street(width=3.5, oncoming=True):
    """A lane along +x at y = 0, and one the other way if ``oncoming``, and 20 bays of 6.5 m on the right."""
    draft = Draft()
    draft.lane(straight(Pose(0.0, 0.0, 0.0), 200.0), width, 12.0)
    if oncoming:
        draft.lane(straight(Pose(200.0, width, math.pi), 200.0), width, 12.0)
    aside = -(width / 2 + 1.1)
    bays = tuple(Bay(Pose(20.0 + 7.0 * k, aside, 0.0), 6.5, 0, 20.0 + 7.0 * k) for k in range(20))
    return RoadNetwork("test", tuple(draft.lanes), (), bays=bays)


def test_bays_are_occupied_at_their_share_and_contain_their_cars():
    count = 0
    for seed in range(30):
        cars = parked_cars(street(), 0.6, 0.0, np.random.default_rng(seed), 20)
        count += len(cars)
        for car in cars:
            bay = min(street().bays, key=lambda b: abs(b.pose.x - car.xy[0, 0]))
            assert abs(car.xy[0, 0] - bay.pose.x) + car.size_m[0] / 2 < 6.5 / 2
            assert car.xy[0, 1] == pytest.approx(bay.pose.y, abs=0.16)
            # Some are parked the other way round.
            assert abs(math.sin(car.heading[0])) < math.sin(math.radians(5.0))
            assert np.ptp(car.xy, axis=0).max() == 0 and np.all(car.valid) and not car.speed.any()
            assert car.xy[0, 1] + car.size_m[1] / 2 < -3.5 / 2 + 0.15
    # 600 draws of 0.6: 3 sigma are 0.06.
    assert count / 600 == pytest.approx(0.6, abs=0.06)


def test_double_parked_cars_leave_room_to_pass():
    count = 0
    for seed in range(40):
        cars = parked_cars(street(), 0.0, 0.3, np.random.default_rng(seed), 5)
        count += len(cars)
        assert len(cars) <= 1
        for car in cars:
            # In the lane, on the side of the bay.
            assert car.xy[0, 1] - car.size_m[1] / 2 > -3.5 / 2 and car.xy[0, 1] < 0
    assert 5 <= count <= 20
    # A lane of 3.5 m without a neighbour leaves no room to pass.
    for seed in range(20):
        assert parked_cars(street(oncoming=False), 0.0, 1.0, np.random.default_rng(seed), 5) == ()
    # A lane of 5 m leaves room to pass.
    assert parked_cars(street(5.0, oncoming=False), 0.0, 1.0, np.random.default_rng(0), 5)


def test_double_parking_uses_neighbour_lanes_away_from_lane_ends():
    network = street(oncoming=False)
    lane = dataclasses.replace(network.lanes[0], left=0)
    with_neighbour = dataclasses.replace(network, lanes=(lane,))
    cars = parked_cars(with_neighbour, 0.0, 1.0, np.random.default_rng(0), 5)
    assert cars
    assert all(15.0 < car.xy[0, 0] < 185.0 for car in cars)
    junction = dataclasses.replace(network, lanes=(dataclasses.replace(lane, connector=True),))
    assert parked_cars(junction, 0.0, 1.0, np.random.default_rng(0), 5) == ()


def test_equal_seeds_park_equal_cars():
    cars, same = (parked_cars(street(), 0.5, 0.1, np.random.default_rng(4), 5) for _ in range(2))
    assert all(np.array_equal(a.xy, b.xy) for a, b in zip(cars, same, strict=True))
