from __future__ import annotations

import itertools
import math
from functools import cache

import numpy as np
import pytest

from drivax.scenario.schema import Capacity, RoadKind
from drivax.synthetic.roads.families.junction_layout import CrossSection, Geometry
from drivax.synthetic.roads.families.junctions import (
    AllWayStop,
    Corridor,
    SignalisedJunction,
    TJunction,
    UnprotectedLeft,
)
from drivax.synthetic.roads.network import CLEARANCE_M, GRID, RING, Control, map_features
from drivax.synthetic.roads.signals import Colour
from drivax.synthetic.traffic.placement import Density, place_vehicles

from .oracles import distance_to_polyline, winding_number

JUNCTIONS = (SignalisedJunction(), TJunction(), AllWayStop(), UnprotectedLeft(), Corridor())
STYLES = {"grid": GRID, "ring": RING}
SEEDS = range(4)
CASES = [
    pytest.param(family, style, seed, id=f"{family.name}-{style}-{seed}")
    for family in JUNCTIONS
    for style in STYLES
    for seed in SEEDS
]


@cache
def built(family, style, seed):
    return family.build(np.random.default_rng(seed), STYLES[style])


def connectors(network):
    return [i for i, lane in enumerate(network.lanes) if lane.connector]


def turned(lane) -> float:
    """Change of heading, rad, positive to the left."""
    return float(lane.curve.heading[-1] - lane.curve.heading[0])


def closest(a, b) -> float:
    return float(np.sqrt(np.min(np.sum((a[:, None] - b[None]) ** 2, axis=-1))))


def open_lights(network):
    """Whether each lane has green or yellow at each time of a few cycles; False without lights."""
    if network.signals is None:
        return np.zeros((1, len(network.lanes)), bool)
    times = np.arange(0.0, 3 * network.signals.cycle_s, 0.25)
    colour, _ = network.signals.colours(times, len(network.lanes))
    return (colour == Colour.GREEN) | (colour == Colour.YELLOW)


@pytest.mark.parametrize(("family", "style", "seed"), CASES)
def test_each_conflict_has_exactly_one_right_of_way(family, style, seed):
    network = built(family, style, seed)
    lanes = network.lanes
    moving = open_lights(network)
    conflicts = 0
    for a, b in itertools.combinations(connectors(network), 2):
        if lanes[a].predecessors == lanes[b].predecessors:
            continue
        if closest(lanes[a].curve.xy[::2], lanes[b].curve.xy[::2]) >= CLEARANCE_M:
            assert b not in lanes[a].yields_to and a not in lanes[b].yields_to
            continue
        conflicts += 1
        both = {lanes[a].control, lanes[b].control}
        apart = both == {Control.SIGNAL} and not (moving[:, a] & moving[:, b]).any()
        settled = [
            apart,
            (b in lanes[a].yields_to) != (a in lanes[b].yields_to),
            both == {Control.ALL_WAY_STOP},
        ]
        assert sum(settled) == 1
    assert conflicts >= 3


@pytest.mark.parametrize(("family", "style", "seed"), CASES)
def test_approaches_connect_to_all_other_arms(family, style, seed):
    network = built(family, style, seed)
    lanes = network.lanes
    for lane in lanes:
        if lane.connector:
            assert len(lane.predecessors) == 1 and len(lane.successors) == 1
        else:
            # An arriving vehicle can drive on, unless the map ends there.
            assert lane.successors or lane.predecessors
            assert all(lanes[i].connector for i in (*lane.successors, *lane.predecessors))

    def road(lane):
        """A lane and all its neighbours."""
        parallel = {lane}
        for side in ("left", "right"):
            at = getattr(lanes[lane], side)
            while at >= 0:
                parallel.add(at)
                at = getattr(lanes[at], side)
        return frozenset(parallel)

    roads = {road(i) for i, lane in enumerate(lanes) if not lane.connector and lane.successors}
    for approach in roads:
        leaving = [i for lane in approach for i in lanes[lane].successors]
        # Three turns at a crossing, two at a T-junction: each leads to a road of its own.
        arms = {road(lanes[i].successors[0]) for i in leaving}
        assert len(arms) in (2, 3)
        turns = {
            0 if abs(turned(lanes[i])) < math.pi / 4 else int(np.sign(turned(lanes[i]))) for i in leaving
        }
        assert len(turns) == len(arms)


@pytest.mark.parametrize(("family", "style", "seed"), CASES)
def test_crossings_span_the_road_and_list_crossed_lanes(family, style, seed):
    network = built(family, style, seed)
    ring = np.concatenate([network.edges[0].xy, network.edges[0].xy[:1]])
    arms = 3 if family.name == "t_junction" else 4
    assert len(network.crossings) == arms or family.name == "corridor"
    assert sum(c.marked for c in network.crossings) == len(network.crosswalks)
    for crossing in network.crossings:
        assert distance_to_polyline(crossing.axis, ring).max() < 0.05
        listed = dict(crossing.lanes)
        assert len(listed) == len(crossing.lanes)
        for index, lane in enumerate(network.lanes):
            along_m = _intersection(crossing.axis, lane.curve)
            if index in listed:
                assert along_m == pytest.approx(listed[index], abs=0.05)
            else:
                assert along_m is None


def _intersection(axis, curve):
    """Distance along a curve at which it crosses the axis, where the side of its points changes; None: nowhere."""
    along = axis[1] - axis[0]
    along, length = along / np.hypot(*along), np.hypot(*along)
    offset = curve.xy - axis[0]
    side = offset @ np.array([-along[1], along[0]])
    within = offset @ along
    hits = np.flatnonzero((side[:-1] < 0) != (side[1:] < 0))
    hits = [k for k in hits if 0 < within[k] < length]
    assert len(hits) <= 1
    if not hits:
        return None
    k = hits[0]
    share = side[k] / (side[k] - side[k + 1])
    return float(curve.arc_m[k] + share * (curve.arc_m[k + 1] - curve.arc_m[k]))


@pytest.mark.parametrize(("family", "style", "seed"), CASES)
def test_sidewalks_follow_the_edge_outside_the_road(family, style, seed):
    network = built(family, style, seed)
    ring = np.concatenate([network.edges[0].xy, network.edges[0].xy[:1]])
    for sidewalk in network.sidewalks:
        points = sidewalk.xy[::10]
        gap = distance_to_polyline(points, ring)
        assert gap.min() > 0.95 and gap.max() < 2.6
        assert np.hypot(*np.diff(sidewalk.xy, axis=0).T).max() < 0.7
        assert all(winding_number(p, ring[:-1]) == 0 for p in points[::3])


@pytest.mark.parametrize("style", STYLES)
def test_streets_have_sidewalks_at_about_the_rate_of_their_style(style):
    sidewalks = [bool(built(f, style, seed).sidewalks) for f in JUNCTIONS[:3] for seed in range(10)]
    assert np.mean(sidewalks) == pytest.approx(STYLES[style].sidewalk_share, abs=0.25)


@pytest.mark.parametrize(("family", "style", "seed"), CASES)
def test_rules_fit_the_limits_of_a_scenario(family, style, seed):
    network = built(family, style, seed)
    controlled = [i for i in connectors(network) if network.lanes[i].control == Control.SIGNAL]
    assert len(controlled) <= Capacity().lights
    lit = [] if network.signals is None else [i for g in network.signals.groups for i in g.lanes]
    assert sorted(lit) == controlled
    signs = [f for f in map_features(network) if f.kind == RoadKind.STOP_SIGN]
    stopped = {
        before
        for i in connectors(network)
        if network.lanes[i].control in (Control.STOP, Control.ALL_WAY_STOP)
        for before in network.lanes[i].predecessors
    }
    assert len(signs) == len(stopped) <= Capacity().stops


@pytest.mark.parametrize("style", STYLES)
def test_left_turns_at_lights_are_protected_permissive_or_split(style):
    kinds = set()
    for seed in range(20):
        network = built(JUNCTIONS[0], style, seed)
        lanes, moving = network.lanes, open_lights(network)
        for i in connectors(network):
            if turned(lanes[i]) < math.pi / 4:
                assert not lanes[i].yields_to
                continue
            oncoming = [
                j
                for j in connectors(network)
                if abs(math.cos(lanes[i].curve.heading[0] - lanes[j].curve.heading[0]) + 1) < 0.1
                and turned(lanes[j]) < math.pi / 4
            ]
            together = [j for j in oncoming if (moving[:, i] & moving[:, j]).any()]
            arrow = next(g.arrow for g in network.signals.groups if i in g.lanes)
            kinds.add((arrow, bool(together)))
            # A permissive left turn gives way to oncoming traffic; an arrow means that there is none.
            assert set(lanes[i].yields_to) >= {
                j for j in together if closest(lanes[i].curve.xy[::2], lanes[j].curve.xy[::2]) < CLEARANCE_M
            }
            assert not (arrow and lanes[i].yields_to)
    assert kinds == {(True, False), (False, True), (False, False)}


@pytest.mark.parametrize("seed", range(8))
def test_t_junction_stem_and_left_turns_yield(seed):
    network = built(JUNCTIONS[1], "grid", seed)
    lanes = network.lanes
    signs = {Control.STOP, Control.YIELD}
    entries = {lanes[i].predecessors[0] for i in connectors(network)}
    signed = {lane for lane in entries if all(lanes[i].control in signs for i in lanes[lane].successors)}
    stem = {
        lane
        for lane in entries
        if not any(abs(turned(lanes[i])) < math.pi / 4 for i in lanes[lane].successors)
        and not any(abs(turned(lanes[i])) < math.pi / 4 for i in _neighbours(lanes, lane))
    }
    left_only = {lane for lane in signed - stem if all(turned(lanes[i]) > 1 for i in lanes[lane].successors)}
    assert stem and signed == stem | left_only
    for lane in entries - stem:
        for i in lanes[lane].successors:
            if turned(lanes[i]) > math.pi / 4:
                assert lanes[i].control == Control.YIELD and lanes[i].yields_to
            else:
                assert lanes[i].control == Control.NONE and not lanes[i].yields_to
    for lane in stem:
        for i in lanes[lane].successors:
            assert any(turned(lanes[j]) == pytest.approx(0, abs=0.5) for j in lanes[i].yields_to)
            assert all(lanes[j].predecessors[0] not in stem for j in lanes[i].yields_to)


def _neighbours(lanes, lane):
    """Connectors that begin at the neighbours of a lane."""
    return [i for side in (lanes[lane].left, lanes[lane].right) if side >= 0 for i in lanes[side].successors]


@pytest.mark.parametrize("style", STYLES)
def test_unprotected_left_starts_mostly_in_left_turn_lanes(style):
    for seed in range(8):
        network = built(JUNCTIONS[3], style, seed)
        lanes = network.lanes
        yields = [
            all(turned(lanes[i]) > 1.0 and lanes[i].yields_to for i in lanes[start.lane].successors)
            for start in network.starts
        ]
        assert np.mean(yields) >= 0.6
        # Traffic is dense on the lanes to which it gives way.
        first = {
            j for start in network.starts for i in lanes[start.lane].successors for j in lanes[i].yields_to
        }
        assert {lanes[j].predecessors[0] for j in first} & set(network.busy)
        assert not any(turned(lanes[i]) > 1.0 for lane in network.busy for i in lanes[lane].successors)


def test_busy_lanes_have_more_vehicles():
    network = built(JUNCTIONS[3], "grid", 0)
    quiet = [i for i, lane in enumerate(network.lanes) if not lane.connector and i not in network.busy]
    counts = np.zeros(len(network.lanes))
    for seed in range(30):
        density = Density(spacing_m=(60.0, 60.0), vehicles=1000, leader_share=0.0)
        drawn = place_vehicles(network, quiet[0], 100.0, density, np.random.default_rng(seed))
        np.add.at(counts, list(drawn.lane), 1)
    per_m = counts / np.array([lane.length_m for lane in network.lanes])
    assert per_m[list(network.busy)].mean() > 1.3 * per_m[quiet].mean()


@pytest.mark.parametrize("style", STYLES)
def test_corridors_pass_two_junctions(style):
    kinds = set()
    for seed in range(12):
        network = built(JUNCTIONS[4], style, seed)
        lanes = network.lanes
        shared = [lane for lane in lanes if not lane.connector and lane.predecessors and lane.successors]
        assert len(shared) in (2, 4)
        assert all(68.0 <= lane.length_m < 120.0 for lane in shared)
        programs = 0 if network.signals is None else max(1, len(network.signals.programs))
        kinds.add((programs, len(network.crossings)))
        # From most starts ego can drive through both.
        through = [
            any(
                lanes[after].successors for i in lanes[start.lane].successors for after in lanes[i].successors
            )
            for start in network.starts
        ]
        assert np.mean(through) > 0.6
    assert {programs for programs, _ in kinds} == {0, 1, 2}
    assert {crossings for _, crossings in kinds} >= {7, 8}


def test_mouths_follow_from_corner_radius_and_angle():
    geometry = Geometry(skew=0.0, offset_m=0.0, corner_m=(8.0, 8.0))
    rng = np.random.default_rng(0)
    wide, narrow = CrossSection(2, 1, 3.5, 1.0, 13.4), CrossSection(1, 1, 3.0, 0.5, 13.4)
    assert (wide.left_m, wide.right_m) == (8.0, 4.5)
    # Narrow lanes keep 3.2 m between opposing centres.
    assert narrow.left_m == narrow.right_m == pytest.approx(3.6)
    arms = geometry.arms(rng, [k * math.pi / 2 for k in range(4)], [wide, narrow] * 2)
    # The wide street is centred: its middle line is half a lane to the right of the axis, looking outwards.
    assert arms[0].base.y == pytest.approx(-1.75) and arms[2].base.y == pytest.approx(1.75)
    assert arms[1].base.x == arms[3].base.x == 0.0
    # At right angles a corner of 8 m begins 8 m from where the edges meet.
    mouths = geometry.mouths(rng, arms)
    assert mouths == pytest.approx([3.6 + 8.0, 6.25 + 8.0] * 2)
    # At 60 degrees edges that are 3.6 m from their middle lines meet 3.6 / tan 30 from the centre, and the kerb turns
    # by 120 degrees; the obtuse corners begin later and do not count.
    arms = geometry.arms(rng, [0.0, math.pi / 3, math.pi, 4 * math.pi / 3], [narrow] * 4)
    expected = 3.6 / math.tan(math.pi / 6) + 8.0 * math.tan(math.pi / 3)
    assert geometry.mouths(rng, arms) == pytest.approx([expected] * 4)


def test_coordinated_lights_turn_green_when_the_platoon_arrives():
    waves = 0
    for seed in range(16):
        network = built(JUNCTIONS[4], "grid", seed)
        plan = network.signals
        if plan is None or len(plan.programs) < 2:
            continue
        cycles = [
            sum(plan.green_s[phase] + plan.yellow_s + plan.all_red_s for phase in program)
            for program in plan.programs
        ]
        shared = next(
            lane for lane in network.lanes if not lane.connector and lane.predecessors and lane.successors
        )
        connectors_m = [network.lanes[i].length_m for i in (*shared.predecessors, *shared.successors)]
        far = shared.length_m + max(connectors_m)
        travel = plan.lags_s[1] * 0.85 * shared.limit_mps
        if cycles[0] == pytest.approx(cycles[1]):
            assert shared.length_m < travel < far + 15.0
            waves += 1
    assert waves >= 1


@pytest.mark.parametrize("family", JUNCTIONS[1:], ids=lambda f: f.name)
def test_priority_roads_keep_their_speed_through_the_junction(family):
    for seed in range(10):
        for lane in built(family, "grid", seed).lanes:
            if lane.connector and lane.control == Control.NONE and abs(turned(lane)) < math.pi / 4:
                window = 6  # 3 m, over which drivers average
                bend = np.abs(lane.curve.heading[window:] - lane.curve.heading[:-window]) / 3.0
                assert bend.max() * lane.limit_mps**2 < 4.0
