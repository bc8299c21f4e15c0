"""Strands of lanes on hand-made maps: continuations, neighbours, merges and where they end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivax.scenario.bank.routes_and_strands import NOWHERE_M, corridor_lanes, lane_strands
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import CAPACITIES, stack_field
from drivax.synthetic.world import generate_recording

from .recordings import arc, driving, edge, lane, line, make_recording, make_tracks

SMALL = replace(CAPACITIES["default"], agents=4, parked=4, segments=2048, lanes=16, road_rows=256)


def codes(*features, path=None):
    """Rows of the table by the id of the lane: strand, left, right, onto (as ids), and the end in the map's frame."""
    tracks = make_tracks([driving() if path is None else path])
    scenario = assemble(make_recording(features, tracks), SMALL)
    assert not scenario.overflow
    table, ids = lane_strands([scenario.record])[0], scenario.lane_id
    used = scenario.lane_length > 0
    assert (table[~used] == [-1, -1, -1, -1, NOWHERE_M, NOWHERE_M]).all()
    named = {}
    for number, row in zip(ids[used].tolist(), table[used], strict=True):
        linked = [int(ids[int(x)]) if x >= 0 else None for x in row[:4]]
        end = None if row[4] == NOWHERE_M else tuple(np.round(row[4:] + scenario.origin[:2], 2).tolist())
        named[number] = (*linked, end)
    return named


BOX = edge(99, line((-150, -60), (250, -60), (250, 60), (-150, 60), (-150, -60)))


def test_consecutive_lanes_are_one_strand():
    found = codes(
        lane(1, line((-60, 0), (40, 0)), successors=(3,), left_neighbours=(2,)),
        lane(2, line((-60, 3.5), (150, 3.5)), right_neighbours=(1, 3)),
        lane(3, line((40, 0), (150, 0)), left_neighbours=(2,)),
        BOX,
    )
    # No lane ends: the map is cropped where all three stop.
    assert found == {1: (3, 2, None, None, None), 2: (2, None, 3, None, None), 3: (3, 2, None, None, None)}


def test_ending_lane_merges_onto_its_continuing_neighbour():
    drop = codes(
        lane(1, line((-60, 0), (60, 0)), left_neighbours=(2,)),
        lane(2, line((-60, 3.5), (60, 3.5)), successors=(3,), right_neighbours=(1,)),
        lane(3, line((60, 3.5), (150, 3.5))),
        BOX,
    )
    assert drop[1] == (1, 3, None, 3, (60.0, 0.0))
    assert drop[2] == (3, None, 1, None, None) and drop[3] == (3, None, None, None, None)
    # The same where the neighbour is not cut there, and on the other side.
    longer = codes(
        lane(1, line((-60, 7), (60, 7)), right_neighbours=(2,)),
        lane(2, line((-60, 3.5), (150, 3.5)), left_neighbours=(1,)),
        BOX,
    )
    assert longer == {1: (1, None, 2, 2, (60.0, 7.0)), 2: (2, 1, None, None, None)}
    # Alone, it leads nowhere: a dead end, or the end of the map.
    assert codes(lane(1, line((-60, 0), (60, 0))), BOX)[1] == (1, None, None, None, None)


def test_joining_lane_merges_onto_the_through_lane():
    for first in ("taper", "through"):
        lanes = {
            "taper": lane(1, line((-60, 0), (30, 0), (90, 3.5)), successors=(3,)),
            "through": lane(2, line((-60, 3.5), (90, 3.5)), successors=(3,)),
        }
        order = [lanes.pop(first), *lanes.values()]
        found = codes(*order, lane(3, line((90, 3.5), (150, 3.5))), BOX)
        assert found[1] == (1, None, None, 3, (90.0, 3.5)), first
        assert found[2][0] == 3 and found[2][3] is None
    ramp = codes(
        lane(1, line((-60, -20), (40, 0)), successors=(3,)),
        lane(2, line((-60, 0), (40, 0)), successors=(3,)),
        lane(3, line((40, 0), (150, 0))),
        BOX,
    )
    assert ramp[1] == (1, None, None, 3, (40.0, 0.0)) and ramp[3] == (3, None, None, None, None)


def junction(number=0):
    """From the west straight on or right, from the south right: into the road to the east."""
    return (
        lane(1, line((-60, 0), (-10, 0)), successors=(2, 5)),
        lane(2, line((-10, 0), (10, 0)), successors=(3,)),
        lane(3, line((10, 0), (120, 0))),
        lane(4, line((0, -60), (0, -10)), successors=(6,)),
        lane(5, arc((-10, -10), 10.0, np.pi / 2, 0.0)),
        lane(6, arc((10, -10), 10.0, np.pi, np.pi / 2), successors=(3,)),
        BOX,
    )


def test_turns_at_a_junction_are_strands_of_their_own_and_do_not_merge():
    found = codes(*junction())
    assert [found[i][0] for i in (1, 2, 3)] == [3, 3, 3]
    assert found[5][0] == 5 and found[4][0] == found[6][0] == 6
    assert all(row[3] is None and row[4] is None for row in found.values())


def test_a_ring_is_one_strand():
    quarters = [
        lane(i, arc((0, 20), 20.0, a, a + np.pi / 2), successors=((i - 10 + 1) % 4 + 10,))
        for i, a in zip(range(10, 14), np.arange(4) * np.pi / 2, strict=True)
    ]
    entry = lane(1, line((-40, 5), (-20, 20)), successors=(12,))
    found = codes(*quarters, entry, BOX)
    assert {found[i][0] for i in range(10, 14)} == {13}
    assert found[1][0] == 1
    assert all(found[i][3] is None for i in range(10, 14))


def test_lanes_cut_by_the_crop_do_not_end():
    # Ego's log covers x from -10 to 80; lanes are stored up to 100 m beyond it. The right lane ends within that, but
    # where the map may be cropped already.
    features = (
        lane(1, line((-60, 0), (178, 0)), left_neighbours=(2,)),
        lane(2, line((-60, 3.5), (250, 3.5)), right_neighbours=(1,)),
        edge(99, line((-150, -60), (260, -60), (260, 60), (-150, 60), (-150, -60))),
    )
    assert codes(*features)[1][3] is None
    nearer = (lane(1, line((-60, 0), (170, 0)), left_neighbours=(2,)), *features[1:])
    assert codes(*nearer)[1][3:] == (2, (170.0, 0.0))


def test_a_scenario_without_lanes_has_an_empty_table():
    assert codes(BOX) == {}


def test_corridor_reaches_all_neighbours_of_the_route():
    scenarios = [assemble(generate_recording(8, i)) for i in range(6)]
    records = [scenario.record for scenario in scenarios]
    route = (stack_field(records, f"route_{name}", 0) for name in ("lane", "points"))
    corridors = corridor_lanes(records, *route)
    for scenario, corridor in zip(scenarios, corridors, strict=True):
        member, queue = set(), set(scenario.route_lane[0, : scenario.route_points[0]].tolist())
        while queue := {lane for lane in queue if lane >= 0} - member:
            member |= queue
            queue = {int(side[lane]) for lane in queue for side in (scenario.lane_left, scenario.lane_right)}
        assert set(np.flatnonzero(corridor).tolist()) == member
    assert len({corridor.sum() for corridor in corridors}) > 1


@pytest.mark.parametrize("turn", [0.0, 2.0])
def test_strand_table_is_independent_of_the_frame(turn):
    cos, sin = np.cos(turn), np.sin(turn)
    spin = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    features = [replace(f, points=f.points @ spin) for f in junction()]
    found = codes(*features, path=driving(3.0, -20.0 * cos, -20.0 * sin, heading=turn))
    assert {i: row[:4] for i, row in found.items()} == {i: row[:4] for i, row in codes(*junction()).items()}
