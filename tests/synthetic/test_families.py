from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import shapely

from drivax.scenario.schema import CAR_LANE_KINDS, EDGE_KINDS, LANE_KINDS, RoadKind
from drivax.synthetic.roads.curves import Pose, straight
from drivax.synthetic.roads.families import FAMILIES
from drivax.synthetic.roads.families.street_layout import Street, Strip
from drivax.synthetic.roads.network import GRID, RING, Control, map_features
from drivax.synthetic.traffic.paths import random_lanes

from .oracles import box_corners, signed_area, winding_number
from .pursuit import covering_routes, driven

SEEDS = range(4)
CASES = [pytest.param(f, s, id=f"{f.name}-{s}") for f in FAMILIES for s in SEEDS]
NAMED = {family.name: family for family in FAMILIES}


@cache
def built(family, seed):
    """Even seeds draw roads of one domain, odd ones those of the other."""
    return family.build(np.random.default_rng(seed), (GRID, RING)[seed % 2])


@cache
def ground(family, seed):
    """Drivable area: inside the outer boundary, outside of the islands."""
    outer, *islands = built(family, seed).edges
    return shapely.Polygon(outer.xy, [island.xy for island in islands])


def drivable(point, network) -> bool:
    """Whether a point is inside the outer boundary (winding number 1) and outside of all islands."""
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
        assert all(index in network.lanes[before].successors for before in lane.predecessors)
        if lane.ends:
            assert not lane.successors and max(lane.left, lane.right) >= 0
    assert joints >= 5


@pytest.mark.parametrize(("family", "seed"), CASES)
def test_headings_are_tangents(family, seed):
    for lane in built(family, seed).lanes:
        step = np.diff(lane.curve.xy, axis=0)
        middle = (lane.curve.heading[1:] + lane.curve.heading[:-1]) / 2
        off = np.arctan2(step[:, 1], step[:, 0]) - middle
        assert np.abs((off + math.pi) % (2 * math.pi) - math.pi).max() < math.radians(2.0)


@pytest.mark.parametrize(("family", "seed"), CASES)
def test_neighbours_are_parallel(family, seed):
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
def test_lanes_keep_clear_of_edges(family, seed):
    network, inside = built(family, seed), ground(family, seed)
    for lane in network.lanes:
        assert drivable(lane.curve.xy[len(lane.curve.xy) // 2], network)
        assert inside.covers(shapely.LineString(lane.curve.xy[1:-1]))
        inner = lane.curve.xy[12:-12]
        if len(inner) > 1:
            gap = inside.boundary.distance(shapely.LineString(inner))
            # Half a lane; on the inner side of a corner a little less.
            assert gap > (min(1.55, lane.width_m / 2) if lane.connector else lane.width_m / 2) - 0.01


@pytest.mark.parametrize(("family", "seed"), CASES)
def test_edges_are_closed_simple_rings_with_the_road_on_their_left(family, seed):
    network = built(family, seed)
    assert ground(family, seed).is_valid
    outer, *islands = network.edges
    assert outer.kind == RoadKind.EDGE_BOUNDARY and signed_area(outer.xy) > 0
    for island in islands:
        assert island.kind == RoadKind.EDGE_MEDIAN and signed_area(island.xy) < 0
        assert all(winding_number(p, outer.xy) == 1 for p in island.xy[::20])
    for edge in network.edges:
        ring = np.concatenate([edge.xy, edge.xy[:1]])
        assert np.hypot(*np.diff(ring, axis=0).T).max() < 60.0
        assert shapely.LinearRing(ring).is_simple
        # A step to the left of any side is on the road, a step to the right is off it.
        middle, along = (ring[1:] + ring[:-1]) / 2, np.diff(ring, axis=0)
        left = np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.hypot(*along.T)[:, None]
        for k in range(0, len(middle), 25):
            assert drivable(middle[k] + 0.05 * left[k], network)
            assert not drivable(middle[k] - 0.05 * left[k], network)


@pytest.mark.parametrize(("family", "seed"), CASES)
def test_starts_have_road_ahead(family, seed):
    network = built(family, seed)
    assert network.starts
    for start in network.starts:
        lane = network.lanes[start.lane]
        assert 0 < start.low_m < start.high_m < lane.length_m
        room, at, seen = lane.length_m - start.high_m, lane, {start.lane}
        while ahead := [k for k in at.successors if k not in seen] or (at.ends and [max(at.left, at.right)]):
            seen.add(ahead[0])
            # A change to the neighbour of a lane that ends adds no distance.
            room += network.lanes[ahead[0]].length_m if at.successors else 0.0
            at = network.lanes[ahead[0]]
        # Nine seconds at the limit, and the 50 m of route beyond the destination.
        assert room > 9.0 * lane.limit_mps + 50.0
        if not lane.predecessors:
            assert start.low_m > 100.0


@pytest.mark.parametrize(("family", "seed"), CASES)
def test_map_features_describe_the_whole_network(family, seed):
    network = built(family, seed)
    features = {f.feature_id: f for f in map_features(network)}
    signs = [f for f in features.values() if f.kind == RoadKind.STOP_SIGN]
    rest = len(network.edges) + len(network.markings) + len(network.crosswalks)
    assert len(features) == len(network.lanes) + rest + len(signs)
    stops = {
        before
        for lane in network.lanes
        if lane.control in (Control.STOP, Control.ALL_WAY_STOP)
        for before in lane.predecessors
    }
    assert len(signs) == len(stops)
    lanes = [f for f in features.values() if f.kind in LANE_KINDS]
    assert len(lanes) == len(network.lanes)
    for feature in lanes:
        assert feature.limit_mps and feature.width_m
        gaps = np.hypot(*np.diff(feature.points[:, :2], axis=0).T)
        assert gaps.max() < 1.35 and gaps.min() > 0.1
        for link in (*feature.successors, *feature.predecessors, *feature.left_neighbours):
            assert features[link].kind in LANE_KINDS
    for feature in features.values():
        if feature.kind in EDGE_KINDS:
            assert np.array_equal(feature.points[0], feature.points[-1])


def place(lane, along_m):
    """Pose at a distance along a lane, by interpolation."""
    curve = lane.curve
    xy = [np.interp(along_m, curve.arc_m, curve.xy[:, k]) for k in (0, 1)]
    return np.array(xy), float(np.interp(along_m, curve.arc_m, curve.heading))


@pytest.mark.parametrize(("family", "seed"), CASES)
def test_crossings_span_the_road_over_their_lanes(family, seed):
    network, inside = built(family, seed), ground(family, seed)
    for crossing in network.crossings:
        axis = shapely.LineString(crossing.axis)
        for end in crossing.axis:
            assert inside.exterior.distance(shapely.Point(end)) < 0.15
        crossed = {
            i for i, lane in enumerate(network.lanes) if axis.crosses(shapely.LineString(lane.curve.xy))
        }
        assert crossed <= {lane for lane, _ in crossing.lanes}
        for lane, along_m in crossing.lanes:
            xy, _ = place(network.lanes[lane], along_m)
            assert axis.distance(shapely.Point(xy)) < 0.3
    marked = sum(crossing.marked for crossing in network.crossings)
    assert len(network.crosswalks) == marked


@pytest.mark.parametrize(("family", "seed"), CASES)
def test_sidewalks_are_outside_the_road(family, seed):
    inside = ground(family, seed)
    whole = shapely.Polygon(inside.exterior)
    for sidewalk in built(family, seed).sidewalks:
        assert 0.8 < whole.distance(shapely.LineString(sidewalk.xy)) < 3.0


@pytest.mark.parametrize(("family", "seed"), CASES)
def test_bays_are_inside_the_road_next_to_their_lane(family, seed):
    network, inside = built(family, seed), ground(family, seed)
    boxes = []
    for bay in network.bays:
        corners = box_corners((bay.pose.x, bay.pose.y), bay.pose.heading, bay.length_m - 0.6, 1.8)
        boxes.append(shapely.Polygon(corners))
        assert inside.covers(boxes[-1])
        lane = network.lanes[bay.lane]
        assert boxes[-1].distance(shapely.LineString(lane.curve.xy)) > lane.width_m / 2
        xy, heading = place(lane, bay.along_m)
        to = np.array([bay.pose.x, bay.pose.y]) - xy
        assert abs(to @ [math.cos(heading), math.sin(heading)]) < 0.1
        assert math.cos(heading - bay.pose.heading) > 0.999
    # Bays do not overlap: each box intersects only itself.
    assert all(sum(shapely.intersects(box, boxes)) == 1 for box in boxes)


@pytest.mark.parametrize(
    ("family", "seed"),
    [
        pytest.param(f, s, id=f"{f.name}-{s}", marks=[pytest.mark.slow] if s > 2 else [])
        for f in FAMILIES
        for s in range(1, 13)
    ],
)
def test_pure_pursuit_drives_all_routes(family, seed):
    network, inside = built(family, seed), ground(family, seed)
    routes = covering_routes(network)
    assert {lane for route in routes for lane in route} == set(range(len(network.lanes)))
    corners = driven(network, routes, speed_mps=8.0, lateral_mps2=3.0)
    shapely.prepare(inside)
    assert shapely.contains_xy(inside, corners[:, 0], corners[:, 1]).all()


@pytest.mark.parametrize(("family", "seed"), CASES)
def test_random_routes_end_at_lane_ends_and_repeat_no_lane(family, seed):
    network, rng = built(family, seed), np.random.default_rng(seed)
    used = set()
    for first, lane in enumerate(network.lanes):
        for _ in range(1 if lane.predecessors else 8):
            lanes = random_lanes(network, first, rng)
            assert len(set(lanes)) == len(lanes)
            assert not network.lanes[lanes[-1]].successors
            used |= set(pairwise(lanes))
    # At forks nearly every branch is taken sometimes.
    forks = {
        (i, k) for i, lane in enumerate(network.lanes) if len(lane.successors) > 1 for k in lane.successors
    }
    assert len(forks - used) <= 0.2 * len(forks)


@pytest.mark.slow
def test_families_draw_varied_roads():
    for family in FAMILIES:
        layouts = {len(built(family, seed).lanes) for seed in range(10)}
        assert len(layouts) >= (1 if family.name == "all_way_stop" else 2), family.name
    curved, straight = NAMED["curved_road"], NAMED["straight_road"]
    turned = {
        family.name: [np.ptp(built(family, seed).lanes[0].curve.heading) for seed in range(10)]
        for family in (curved, straight)
    }
    assert max(turned["curved_road"]) > 0.3 > max(turned["straight_road"])


def test_lane_drops_lose_lanes_on_both_sides_and_gain_lanes():
    changes = set()
    for seed in range(30):
        network = built(NAMED["lane_drop"], seed)
        ending = [lane for lane in network.lanes if lane.ends]
        forks = [lane for lane in network.lanes if len(lane.successors) == 2]
        changes.add("gain" if forks else "left" if ending[0].left < 0 else "right")
        assert len(ending) + len(forks) == 1
    assert changes == {"gain", "left", "right"}


def test_middle_line_of_a_one_way_street_is_marked_along_the_first_lane_to_its_left():
    strips = (Strip(-1, True, 0, 3), Strip(1, True, 0, 3), Strip(2, True, 1, 2))
    street = Street(straight(Pose(0.0, 0.0, 0.0), 60.0), (0, 40, 80, 120), strips, 3.5, 13.4, 0.5)
    street.add_markings()
    middle = [line for line in street.draft.markings if np.all(np.abs(line.xy[:, 1]) < 0.1)]
    assert [line.kind for line in middle] == [RoadKind.LINE_BROKEN_SINGLE_WHITE]
    assert np.allclose(middle[0].xy[[0, -1], 0], [0.0, 60.0])


def test_highways_have_an_on_ramp_an_off_ramp_or_both():
    layouts = set()
    for seed in range(20):
        network = built(NAMED["highway"], seed)
        assert all(lane.kind == RoadKind.LANE_FREEWAY for lane in network.lanes)
        sources = {i for i, lane in enumerate(network.lanes) if not lane.predecessors}
        ramps = [
            i for i, lane in enumerate(network.lanes) if lane.limit_mps < 0.8 * network.lanes[0].limit_mps
        ]
        ends = any(lane.ends for lane in network.lanes)
        leave = [i for i in ramps if network.lanes[i].exit_only]
        enter = [i for i in ramps if i in sources]
        assert sorted(leave + enter) == ramps
        assert all(network.lanes[k].exit_only for i in leave for k in network.lanes[i].predecessors)
        assert {s.lane for s in network.starts} & set(ramps) == set(enter)
        layouts.add((ends, len(enter), len(leave)))
    # A lane that ends behind an on-ramp, an off-ramp, or a lane from one to the other.
    assert layouts == {(True, 1, 0), (False, 0, 1), (False, 1, 1)}


def test_roundabout_entries_yield_to_circulating_traffic():
    layouts = set()
    for seed in range(12):
        network = built(NAMED["roundabout"], seed)
        outer = [lane for lane in network.lanes if not lane.predecessors]
        arms = sum(lane.left < 0 for lane in outer)
        layouts.add((arms, len(outer) // arms))
        entries = [i for lane in outer for i in lane.successors]
        assert all(network.lanes[i].control == Control.YIELD and network.lanes[i].yields_to for i in entries)
        # Of two connectors in conflict exactly one yields.
        for a, b in zip(*np.nonzero(np.triu(network.conflicts)), strict=True):
            assert (b in network.lanes[a].yields_to) != (a in network.lanes[b].yields_to)
        # Traffic circulates counter-clockwise.
        for lane in network.lanes:
            if len(lane.successors) == 2:
                x, y = lane.curve.xy[0]
                assert x * math.sin(lane.curve.heading[0]) - y * math.cos(lane.curve.heading[0]) > 0
    assert {arms for arms, _ in layouts} == {3, 4} and {count for _, count in layouts} == {1, 2}


@pytest.mark.parametrize("name", ["all_way_stop", "roundabout", "midblock_crosswalk"])
def test_families_with_a_highest_limit_use_the_lowest_one_of_faster_styles(name):
    style = replace(GRID, limits_mps=(25.0, 20.0))
    network = NAMED[name].build(np.random.default_rng(0), style)
    assert max(lane.limit_mps for lane in network.lanes) == 20.0


def test_streets_have_the_features_of_their_family():
    for seed in range(8):
        parked, midblock = built(NAMED["parked_street"], seed), built(NAMED["midblock_crosswalk"], seed)
        assert len(parked.bays) > 20 and len(parked.sidewalks) == 2
        assert midblock.crossings and len(midblock.sidewalks) == 2
    marks = [c.marked for seed in range(20) for c in built(NAMED["midblock_crosswalk"], seed).crossings]
    assert 0.5 < np.mean(marks) < 0.95
    assert all(lane.kind in CAR_LANE_KINDS for lane in parked.lanes)
