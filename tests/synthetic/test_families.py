from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from drivax.scenario.schema import CAR_LANE_KINDS, EDGE_KINDS, RoadKind
from drivax.synthetic.families import FAMILIES
from drivax.synthetic.roads import map_features

from .oracles import crossings, signed_area, winding_number

SEEDS = range(6)
CASES = [pytest.param(f, s, id=f"{f.name}-{s}") for f in FAMILIES for s in SEEDS]


@cache
def built(family, seed):
    return family.build(np.random.default_rng(seed))


def drivable(point, network) -> bool:
    """Inside the outer boundary (once around, counter-clockwise) and outside of all islands."""
    return sum(winding_number(point, edge.xy) for edge in network.edges) == 1


@pytest.mark.parametrize(("family", "seed"), CASES)
def test_lanes_connect_without_gap_or_kink(family, seed):
    network = built(family, seed)
    joints = 0
    for index, lane in enumerate(network.lanes):
        for after in lane.successors:
            a, b = lane.curve.end, network.lanes[after].curve.start
            assert math.hypot(a.x - b.x, a.y - b.y) < 0.05
            assert abs((a.heading - b.heading + math.pi) % (2 * math.pi) - math.pi) < math.radians(5)
            assert index in network.lanes[after].predecessors
            joints += 1
    assert joints >= 12


@pytest.mark.parametrize(("family", "seed"), CASES)
def test_neighbours_run_beside_each_other(family, seed):
    network = built(family, seed)
    for index, lane in enumerate(network.lanes):
        if lane.left >= 0:
            other = network.lanes[lane.left]
            assert other.right == index
            for mine, theirs in ((lane.curve.start, other.curve.start), (lane.curve.end, other.curve.end)):
                dx, dy = theirs.x - mine.x, theirs.y - mine.y
                aside = -dx * math.sin(mine.heading) + dy * math.cos(mine.heading)
                assert aside == pytest.approx((lane.width_m + other.width_m) / 2, abs=0.02)
                assert dx * math.cos(mine.heading) + dy * math.sin(mine.heading) == pytest.approx(0, abs=0.02)


@pytest.mark.parametrize(("family", "seed"), CASES)
def test_lanes_lie_inside_the_edges_and_clear_of_them(family, seed):
    network = built(family, seed)
    rings = [np.concatenate([edge.xy, edge.xy[:1]]) for edge in network.edges]
    kerbs = np.concatenate([edge.xy for edge in network.edges])
    for lane in network.lanes:
        for point in lane.curve.xy[3:-3:20]:
            assert drivable(point, network)
        for ring in rings:
            assert crossings(lane.curve.xy[1:-1:4], ring) == 0
        inner = lane.curve.xy[12:-12:3]
        gap = np.sqrt(np.min(np.sum((inner[:, None] - kerbs[None]) ** 2, axis=-1), axis=1))
        # Half a lane, and a little less on the inner side of a corner.
        assert gap.min() > (1.55 if lane.connector else lane.width_m / 2)


@pytest.mark.parametrize(("family", "seed"), CASES)
def test_edges_are_closed_simple_rings_with_the_road_on_their_left(family, seed):
    network = built(family, seed)
    outer, *islands = network.edges
    assert outer.kind == RoadKind.EDGE_BOUNDARY and signed_area(outer.xy) > 0
    for island in islands:
        assert island.kind == RoadKind.EDGE_MEDIAN and signed_area(island.xy) < 0
        assert all(winding_number(p, outer.xy) == 1 for p in island.xy[::20])
    for edge in network.edges:
        ring = np.concatenate([edge.xy, edge.xy[:1]])
        assert np.hypot(*np.diff(ring, axis=0).T).max() < 60.0
        assert crossings(ring, ring) == 0
        # A step to the left of any side is on the road, a step to the right is off it.
        middle, along = (ring[1:] + ring[:-1]) / 2, np.diff(ring, axis=0)
        left = np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.hypot(*along.T)[:, None]
        for k in range(0, len(middle), 25):
            assert drivable(middle[k] + 0.05 * left[k], network)
            assert not drivable(middle[k] - 0.05 * left[k], network)


@pytest.mark.parametrize(("family", "seed"), CASES)
def test_there_is_road_ahead_of_every_start(family, seed):
    network = built(family, seed)
    assert network.starts
    for start in network.starts:
        lane = network.lanes[start.lane]
        assert 0 < start.low_m < start.high_m < lane.length_m
        room, at = lane.length_m - start.high_m, start.lane
        while network.lanes[at].successors:
            at = network.lanes[at].successors[0]
            room += network.lanes[at].length_m
        # Nine seconds at the limit, and the 50 m of route beyond the goal.
        assert room > 9.0 * lane.limit_mps + 50.0
        if not lane.predecessors:
            assert start.low_m > 100.0


@pytest.mark.parametrize(("family", "seed"), CASES)
def test_map_features_tell_the_whole_network(family, seed):
    network = built(family, seed)
    features = {f.feature_id: f for f in map_features(network)}
    assert len(features) == len(network.lanes) + len(network.edges) + len(network.markings) + len(
        network.crosswalks
    )
    lanes = [f for f in features.values() if f.kind in CAR_LANE_KINDS]
    assert len(lanes) == len(network.lanes)
    for feature in lanes:
        assert feature.limit_mps and feature.width_m
        gaps = np.hypot(*np.diff(feature.points[:, :2], axis=0).T)
        assert gaps.max() < 1.35 and gaps.min() > 0.1
        for link in (*feature.successors, *feature.predecessors, *feature.left_neighbours):
            assert features[link].kind in CAR_LANE_KINDS
    for feature in features.values():
        if feature.kind in EDGE_KINDS:
            assert np.array_equal(feature.points[0], feature.points[-1])


def test_chance_draws_many_roads():
    curved, junction = FAMILIES
    layouts = {len(built(curved, seed).lanes) for seed in range(12)}
    assert len(layouts) >= 3
    turning = [abs(np.ptp(built(curved, seed).lanes[0].curve.heading)) for seed in range(12)]
    assert max(turning) > 0.3
    plans = {len(built(junction, seed).signals.phases[0]) for seed in range(12)}
    assert plans == {1, 2}  # split phases and protected lefts
    assert all(len(built(junction, seed).crosswalks) == 4 for seed in SEEDS)
