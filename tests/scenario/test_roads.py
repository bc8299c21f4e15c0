from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivax.scenario.build.segments import rank, road_lines, road_rows
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import RoadKind

from .recordings import arc, edge, lane, line

PATH = np.array([[0.0, 0.0]])


def rows_of(*features, most=500, margin=100.0):
    return road_rows(road_lines(features, np.zeros(3), None), features, PATH, margin, most)


def test_a_straight_lane_gives_equal_pieces_by_hand():
    rows = rows_of(lane(1, line((0, 2), (25, 2)), limit_mps=13.4))
    assert sorted(rows.xy[:, 0]) == pytest.approx([25 / 6, 12.5, 125 / 6])
    assert rows.length == pytest.approx([25 / 3] * 3)
    assert rows.direction == pytest.approx(np.array([[1.0, 0.0]] * 3))
    assert rows.curvature == pytest.approx([0.0] * 3)
    assert rows.limit.tolist() == [13.4] * 3
    assert rows.kind.tolist() == [RoadKind.LANE_SURFACE] * 3


def test_curvature_of_circles_has_size_and_sign():
    left = rows_of(lane(1, arc((0, 0), 25.0, 0.0, 2.0, step=0.25)))
    right = rows_of(lane(1, arc((0, 0), 25.0, 2.0, 0.0, step=0.25)))
    assert left.curvature == pytest.approx(np.full(len(left.curvature), 1 / 25), rel=0.03)
    assert right.curvature == pytest.approx(np.full(len(right.curvature), -1 / 25), rel=0.03)
    assert np.hypot(*left.xy.T) == pytest.approx(np.full(len(left.xy), 25.0), abs=0.01)


def test_only_lanes_edges_and_crosswalks_become_pieces():
    square = np.array([[5.0, 5, 0], [7, 5, 0], [7, 7, 0], [5, 7, 0]])
    rows = rows_of(
        lane(1, line((0, 0), (9, 0)), kind=RoadKind.LANE_BIKE),
        edge(2, line((0, 9), (9, 9))),
        MapFeature(3, RoadKind.CROSSWALK, square),
        MapFeature(4, RoadKind.SPEED_BUMP, square),
        MapFeature(5, RoadKind.LINE_BROKEN_SINGLE_WHITE, line((0, 3), (9, 3))),
        MapFeature(6, RoadKind.STOP_SIGN, np.zeros((1, 3))),
        lane(7, line((300, 0), (320, 0))),
    )
    assert sorted(rows.kind) == [RoadKind.LANE_BIKE, RoadKind.EDGE_BOUNDARY] + [RoadKind.CROSSWALK] * 4
    assert rows.limit.tolist() == [-1.0] * 6
    ring = rows.kind == RoadKind.CROSSWALK
    assert np.abs(rows.direction[ring]).max(axis=1) == pytest.approx(np.ones(4))  # a ring has four sides


@given(st.integers(0, 10_000))
def test_pieces_are_at_most_ten_metres_and_add_up(seed):
    rng = np.random.default_rng(seed)
    length = rng.uniform(0.5, 90.0, 5)
    lanes = [lane(i, line((0, 3 * i), (x, 3 * i))) for i, x in enumerate(length)]
    rows = rows_of(*lanes)
    assert rows.length.max() <= 10.0 + 1e-9
    assert rows.length.sum() == pytest.approx(length.sum())
    assert np.linalg.norm(rows.direction, axis=1) == pytest.approx(np.ones(len(rows.length)))


@given(st.integers(0, 10_000))
def test_every_prefix_of_the_rank_spreads_evenly_within_a_ring(seed):
    rng = np.random.default_rng(seed)
    group = np.sort(rng.integers(0, 3, 200))
    order = rank(group, np.full(200, 10.0))
    assert sorted(order) == list(range(200))
    total = np.bincount(group, minlength=3)
    for count in (20, 50, 111):
        prefix = order[:count]
        share = np.bincount(group[prefix], minlength=3)
        assert np.abs(share - count * total / 200).max() <= 1.5  # classes in proportion
        for number in range(3):
            members = np.flatnonzero(group == number)
            place = np.sort(np.searchsorted(members, prefix[group[prefix] == number]))
            gaps = np.diff(np.concatenate(([-1], place, [len(members)])))
            assert gaps.max() <= 4 * len(members) / max(len(place), 1) + 1  # no stretch is left out


def test_nearer_rings_come_first_and_overflow_is_counted():
    far = np.array([120.0, 10.0, 60.0, 20.0])
    assert sorted(rank(np.zeros(4, int), far)[:2]) == [1, 3]
    assert rank(np.zeros(4, int), far)[2:].tolist() == [2, 0]
    rows = rows_of(lane(1, line((0, 0), (90, 0))), most=4)
    assert len(rows.kind) == 4
    assert rows.overflow == {"road_rows": 5}
    assert rows.xy[:, 0].max() < 50
    assert len(rows_of().kind) == 0
