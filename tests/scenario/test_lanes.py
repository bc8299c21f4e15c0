from __future__ import annotations

import numpy as np
import pytest

from drivax.errors import DataError
from drivax.scenario.build.lane_paths import walk
from drivax.scenario.build.lanes import LaneSegments, lane_graph, lane_of_feature, select
from drivax.scenario.build.segments import cut, road_lines
from drivax.scenario.schema import Flag, RoadKind

from .recordings import FAR, arc, edge, lane, line

ZERO = np.zeros(3)


def graph_of(*features, origin=ZERO):
    return lane_graph(features, origin)


def on(graph, features):
    return LaneSegments.of(cut(road_lines(features, ZERO, None)), graph)


def test_links_named_by_either_side_are_kept_and_dangling_ones_dropped():
    graph = graph_of(
        lane(10, line((0, 0), (20, 0)), successors=(11, 99)),
        edge(5, line((0, 5), (20, 5))),
        lane(11, line((20, 0), (40, 0)), predecessors=(98,)),
        lane(12, line((20, 0), (40, 4)), predecessors=(10, 5)),
    )
    assert graph.lane_id.tolist() == [10, 11, 12]
    assert graph.successor[0].tolist() == [1, 2, -1, -1]  # the straightest first
    assert graph.predecessor[:, 0].tolist() == [-1, 0, 0]
    assert graph.flags == Flag.LANE_GRAPH
    assert graph.lost == {"dangling_links": 3, "dangling_neighbours": 0}  # 99, 98, and 5, which is an edge
    assert graph.feature.tolist() == [0, 2, 3]
    assert lane_of_feature(graph, np.array([3, 1, 0])).tolist() == [2, -1, 0]


def test_links_beyond_four_are_counted():
    fan = [lane(i, line((20, 0), (40, 2.0 * i))) for i in range(6)]
    graph = graph_of(*fan, lane(9, line((0, 0), (20, 0)), successors=tuple(range(6))))
    assert graph.successor[6].tolist() == [0, 1, 2, 3, 4, 5]  # routes may use all of them
    stored = select(graph, np.arange(7))
    assert stored.successor[6].tolist() == [0, 1, 2, 3]
    assert (graph.dropped_links, stored.dropped_links) == (0, 2)
    # Of the lanes that are kept, the fifth link is the second: none is lost.
    part = select(graph, np.array([0, 4, 6]))
    assert (part.successor[2].tolist(), part.dropped_links) == ([0, 1, -1, -1], 0)


def test_oncoming_lanes_are_not_neighbours_and_spacing_gives_the_width():
    """Check-list 13: neighbours are tested for direction."""
    graph = graph_of(
        lane(1, line((0, 0), (100, 0)), left_neighbours=(2, 3), right_neighbours=(4,)),
        lane(2, line((100, 3.2), (0, 3.2)), left_neighbours=(1,)),
        lane(3, line((60, 3.4), (100, 3.4)), right_neighbours=(1,), width_m=3.0),
        lane(4, line((0, -9), (100, -9)), left_neighbours=(1,)),
    )
    assert graph.left.tolist() == [2, -1, -1, 0]
    assert graph.right.tolist() == [3, -1, 0, -1]
    assert graph.left_shift[0] == pytest.approx(-60.0)
    assert graph.right_shift[2] == pytest.approx(60.0)
    assert graph.width == pytest.approx([3.4, -1.0, 3.0, -1.0])  # given, else measured where it can be a lane
    assert graph.neighbours(0) == [(2, pytest.approx(-60.0)), (3, pytest.approx(0.0))]


def test_neighbour_is_the_lane_alongside_for_longest():
    graph = graph_of(
        lane(1, line((0, 0), (100, 0)), left_neighbours=(2, 3)),
        lane(2, line((0, 3), (25, 3))),
        lane(3, line((20, 4), (100, 4))),
    )
    assert graph.left[0] == 2


def test_lanes_without_any_links_are_chained_by_geometry():
    graph = graph_of(
        lane(1, line((0, 0), (20, 0))),
        lane(2, line((20.3, 0.2), (40, 0.2))),
        lane(3, line((20.2, 0), (20.2, 30))),  # a right angle
        lane(4, line((20.1, 0, 6.0), (40, 0, 6.0), z=6.0)),  # a bridge
        lane(5, line((20, 0), (40, 0)), kind=RoadKind.LANE_BIKE),
        lane(6, line((40.7, 0.2), (60, 0.2))),  # too far on
    )
    assert graph.successor[:, 0].tolist() == [1, -1, -1, -1, -1, -1]
    assert graph.flags == Flag.LANE_GRAPH | Flag.CHAINED_GRAPH
    linked = graph_of(lane(1, line((0, 0), (20, 0)), successors=(77,)), lane(2, line((20, 0), (40, 0))))
    assert linked.flags == Flag.NONE  # a source with links is taken at its word


def test_chaining_is_independent_of_the_number_of_lanes():
    """Check-list 24: lanes of a source without a graph, more than one chunk."""
    rows = 30
    features = [
        lane(100 * row + i, line((20.0 * i, 9.0 * row), (20.0 * i + 20, 9.0 * row), step=20.0))
        for row in range(rows)
        for i in range(20)
    ]
    graph = graph_of(*features)
    expected = [lane_id + 1 if lane_id % 100 < 19 else -1 for lane_id in graph.lane_id.tolist()]
    found = [int(graph.lane_id[i]) if i >= 0 else -1 for i in graph.successor[:, 0]]
    assert found == expected
    assert graph.flags == Flag.LANE_GRAPH | Flag.CHAINED_GRAPH


def test_implausible_limits_and_widths_are_unknown():
    graph = graph_of(
        lane(1, line((0, 0), (9, 0)), limit_mps=0.0, width_m=0.0),
        lane(2, line((0, 9), (9, 9)), limit_mps=13.4, width_m=float("nan")),
    )
    assert graph.limit.tolist() == [-1.0, 13.4]
    assert graph.width.tolist() == [-1.0, -1.0]
    assert graph.flags == Flag.SPEED_LIMITS


def test_lanes_without_direction_are_left_out_and_equal_ids_refused():
    graph = graph_of(lane(1, np.zeros((1, 3))), lane(2, np.ones((3, 3))), lane(3, line((0, 0), (5, 0))))
    assert graph.lane_id.tolist() == [3]
    with pytest.raises(DataError, match="two lanes have the id 3"):
        graph_of(lane(3, line((0, 0), (5, 0))), lane(3, line((5, 0), (9, 0))))
    assert graph_of().count == 0


def test_selected_lanes_are_renumbered():
    chain = [lane(i, line((10 * i, 0), (10 * i + 10, 0)), successors=(i + 1,)) for i in range(4)]
    graph = select(
        graph_of(*chain, lane(7, line((5, 3), (15, 3)), predecessors=(0,))), np.array([0, 1, 3, 4])
    )
    assert graph.lane_id.tolist() == [0, 1, 3, 7]
    assert graph.successor[:, :2].tolist() == [[1, 3], [-1, -1], [-1, -1], [-1, -1]]
    assert graph.predecessor[:, 0].tolist() == [-1, 0, -1, 0]
    assert graph.lines.length.tolist() == [10.0] * 4


def test_lane_under_a_pose_respects_reach_heading_and_level():
    features = (
        lane(1, line((0, 0), (100, 0))),
        lane(2, line((100, 1), (0, 1))),
        lane(3, line((0, 2), (100, 2), z=8.0)),
        lane(4, line((0, 0.5), (100, 0.5)), kind=RoadKind.LANE_BIKE),
    )
    graph = graph_of(*features)
    xyz = np.array([[30.0, 0.9, 0.0], [30, 0.9, 0], [30, 1.9, 8.5], [30, 40, 0], [30, 0.9, 0]])
    heading = np.array([0.1, 3.0, 0.0, 0.0, 1.5])
    found, s, distance = on(graph, features).nearest(xyz, heading, 4.0, np.deg2rad(60))
    assert found.tolist() == [0, 1, 2, -1, -1]
    assert s[:3] == pytest.approx([30.0, 70.0, 30.0])
    assert distance[:3] == pytest.approx([0.9, 0.1, 0.1])
    around = on(graph, features).around(np.array([30.0, 0.9, 0.0]), 0.0, 4.0, np.deg2rad(60))
    assert around == [(0, pytest.approx(30.0), pytest.approx(0.9))]
    assert on(graph_of(), ()).around(np.zeros(3), 0.0, 4.0, 1.0) == []


def test_walk_follows_successors_then_goes_straight():
    features = (
        lane(1, line((0, 0), (10, 0)), successors=(2,)),
        lane(2, arc((10, 20), 20.0, -np.pi / 2, 0.0, step=0.05), successors=(3,)),
        lane(3, line((30, 20), (30, 21)), successors=(4,)),
        lane(4, line((30, 21), (30, 23))),
    )
    points, heading = walk(graph_of(*features), np.array([0, 3]), np.array([4.0, 0.0]), 4.0, 14)
    s = 4.0 + 4.0 * np.arange(1, 15)
    angle = np.clip((s - 10) / 20, 0.0, np.pi / 2)
    turn = 10 * np.pi
    expected = np.stack(
        (
            np.where(s < 10, s, 10 + 20 * np.sin(angle)),
            np.where(s < 10, 0, 20 - 20 * np.cos(angle)) + np.maximum(s - 10 - turn, 0),
        ),
        axis=-1,
    )
    assert points[0] == pytest.approx(expected, abs=0.01)
    assert heading[0] == pytest.approx(np.where(s < 10, 0, angle), abs=0.06)
    assert points[1] == pytest.approx(np.stack((np.full(14, 30.0), 21 + 4.0 * np.arange(1, 15)), axis=-1))


def test_the_origin_is_subtracted():
    features = [lane(1, FAR + line((0, 0), (7, 0)))]
    assert graph_of(*features, origin=FAR).lines.points == pytest.approx(line((0, 0), (7, 0)), abs=1e-8)
