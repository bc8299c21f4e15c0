"""Routes on which ego arrives at a destination at a given time."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from drivax.synthetic.events.destinations import (
    Destination,
    DestinationRoute,
    draw_route,
    green_on_arrival,
    open_road,
    rearrange,
    route_past,
)
from drivax.synthetic.roads.curves import Pose, straight
from drivax.synthetic.roads.network import Control, Draft, RoadNetwork, Start
from drivax.synthetic.roads.signals import Colour, LightGroup, SignalPlan
from drivax.synthetic.traffic.placement import Placement

LIMIT = 10.0


def chain(lengths, control=Control.NONE):
    """Consecutive lanes along +x; the second to last is a connector with a rule."""
    draft, at = Draft(), 0.0
    for k, length in enumerate(lengths):
        cross = k == len(lengths) - 2
        rule = control if cross else Control.NONE
        draft.lane(straight(Pose(at, 0.0, 0.0), length), 3.5, LIMIT, connector=cross, control=rule)
        at += length
        if k:
            draft.link(k - 1, k)
    return RoadNetwork("test", tuple(draft.lanes), ())


def test_start_distance_matches_the_arrival_time():
    network = chain([100.0, 80.0, 20.0, 120.0], Control.SIGNAL)
    way = route_past(network, Destination(2, (0.0, 0.0), (5.0, 5.0)), np.random.default_rng(0))
    assert way is not None and way.lanes == (0, 1, 2, 3) and way.lanes[way.place] == 2
    # 5 s at 88 % of 10 m/s before the end of lane 1.
    assert way.start.lane == 1 and way.start.low_m == pytest.approx(80.0 - 44.0)
    further = route_past(network, Destination(2, (10.0, 10.0), (12.5, 12.5)), np.random.default_rng(0))
    assert further is not None and further.start.lane == 0
    assert further.start.low_m == pytest.approx(100.0 + 80.0 + 10.0 - 110.0)


def test_no_route_beyond_the_map_or_through_controlled_junctions():
    network = chain([100.0, 80.0, 20.0, 120.0], Control.STOP)
    rng = np.random.default_rng(0)
    assert route_past(network, Destination(1, (10.0, 10.0), (20.0, 20.0)), rng) is None
    assert route_past(network, Destination(3, (5.0, 5.0), (6.0, 6.0)), rng) is None
    # Nor does ego begin on a connector.
    assert route_past(network, Destination(3, (5.0, 5.0), (1.0, 1.0)), rng) is None
    hopeless, good = Destination(1, (10.0, 10.0), (20.0, 20.0)), Destination(3, (60.0, 60.0), (3.0, 3.0))
    for seed in range(4):
        way = draw_route(network, (hopeless, good), np.random.default_rng(seed))
        assert way is not None and way.start.lane == 3
    assert draw_route(network, (hopeless,), rng) is None and draw_route(network, (), rng) is None


@pytest.mark.parametrize("green_s", [7.0, 20.0])
def test_light_is_green_on_arrival(green_s):
    plan = SignalPlan(
        (LightGroup((0,), False), LightGroup((1,), False)), ((0,), (1,)), (30.0, green_s), offset_s=3.0
    )
    colour, _ = green_on_arrival(plan, 1).colours(np.arange(0.0, 5.9, 0.1), 2)
    assert np.all(colour[:, 1] == Colour.GREEN)


def test_rearranged_traffic_is_clear_ahead_with_a_follower():
    way = DestinationRoute(Start(1, 40.0, 40.0), (0, 1, 2, 3, 4), 2, alone=True, followed=True)
    others = Placement((1, 1, 2, 3, 4, 7), (60.0, 5.0, 3.0, 30.0, 10.0, 50.0))
    rng = np.random.default_rng(0)
    found = rearrange(others, way, (1, 40.0), rng)
    # The vehicle at 5 m leaves no room for a follower at 12 to 24 m.
    assert (found.lane, found.along_m) == ((1, 4, 7), (5.0, 10.0, 50.0))
    found = rearrange(Placement((7,), (50.0,)), way, (1, 40.0), rng)
    assert found.lane == (7, 1) and 12.0 <= found.along_m[1] <= 24.0
    plain = dataclasses.replace(way, alone=False, followed=False)
    assert rearrange(others, plain, (1, 40.0), rng) == others


def test_open_road_excludes_lane_ends_and_slow_lanes():
    network = chain([100.0, 80.0, 20.0, 50.0])
    assert [place.lane for place in open_road(network)] == [0, 1]
    assert open_road(network, lowest_limit_mps=12.0) == () and open_road(network, has_neighbour=True) == ()
    assert all(30.0 <= place.along_m[0] < place.along_m[1] for place in open_road(network))
