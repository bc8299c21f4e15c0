from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivax.geometry.polylines import arc_lengths
from drivax.scenario.build.segments import cut, inside_box, path_distance, road_lines, thin_path
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import RoadKind

from .recordings import FAR, arc, edge, lane, line


def pieces_of(*features, gap=None):
    roads = road_lines(features, np.zeros(3), gap)
    return roads, cut(roads)


def test_a_straight_road_is_cut_into_equal_pieces_of_at_most_four_metres():
    _, segments = pieces_of(lane(7, line((0, 0), (10, 0), step=0.5)))
    assert len(segments) == 3
    assert segments.a[:, 0] == pytest.approx([0, 10 / 3, 20 / 3])
    assert segments.b[:, 0] == pytest.approx([10 / 3, 20 / 3, 10])
    assert segments.start_m == pytest.approx([0, 10 / 3, 20 / 3])
    assert segments.span_m == pytest.approx([10 / 3] * 3)
    assert segments.block.tolist() == [1, 1, 1]


@given(st.integers(0, 10_000))
def test_segments_stay_within_five_centimetres_of_the_source(seed):
    """Check-list 8: simplified to 5 cm, at most 4 m long."""
    rng = np.random.default_rng(seed)
    course = np.cumsum(rng.normal(0.0, 0.1, 150))
    xy = np.cumsum(0.5 * np.stack((np.cos(course), np.sin(course)), axis=-1), axis=0)
    points = np.concatenate((xy, np.zeros((150, 1))), axis=1)
    _, segments = pieces_of(lane(1, points))
    assert np.linalg.norm((segments.b - segments.a)[:, :2], axis=1).max() <= 4.0
    assert segments.a[1:] == pytest.approx(segments.b[:-1])  # a chain without gaps
    t = np.linspace(0.0, 1.0, 41)[:, None, None]
    drawn = (segments.a + t * (segments.b - segments.a)).reshape(-1, 3)[:, :2]
    far = np.hypot(*(points[:, None, :2] - drawn).transpose(2, 0, 1)).min(axis=1)
    assert far.max() <= 0.05 + 0.05  # 5 cm to the chord, and the sampling of the chord (10 cm apart)
    assert segments.start_m[-1] + segments.span_m[-1] == pytest.approx(arc_lengths(points)[-1])


def test_clipping_jumps_split_lines_but_not_polygons():
    """Check-list 5: edges are split at gaps of more than 1 m in WOMD."""
    jump = np.concatenate((line((0, 0), (5, 0), step=0.5), line((30, 0), (35, 0), step=0.5)))
    crossing = MapFeature(9, RoadKind.CROSSWALK, np.array([[0.0, 0, 0], [20, 0, 0], [20, 4, 0], [0, 4, 0]]))
    roads, segments = pieces_of(edge(4, jump), crossing, gap=1.0)
    assert roads.feature.tolist() == [0, 0, 1]
    assert roads.closed.tolist() == [False, False, True]
    on_edge = segments.kind == RoadKind.EDGE_BOUNDARY
    assert not ((segments.a[on_edge, 0] < 6) & (segments.b[on_edge, 0] > 6)).any()
    assert segments.start_m[on_edge].max() + 2.5 == pytest.approx(35.0)  # arc length counts the gap
    whole, _ = pieces_of(edge(4, jump), gap=None)
    assert whole.feature.tolist() == [0]


def test_polygons_are_closed_and_features_without_length_are_left_out():
    """Check-list 6: lines of fewer than two points are dropped."""
    square = np.array([[0.0, 0, 0], [3, 0, 0], [3, 3, 0], [0, 3, 0]])
    roads, segments = pieces_of(
        MapFeature(1, RoadKind.SPEED_BUMP, square),
        lane(2, np.zeros((1, 3))),
        lane(3, np.ones((4, 3))),
        MapFeature(4, RoadKind.STOP_SIGN, np.zeros((1, 3))),
    )
    assert roads.feature.tolist() == [0]
    assert roads.closed.tolist() == [True]
    assert segments.span_m.sum() == pytest.approx(12.0)
    assert segments.b[-1].tolist() == [0, 0, 0]


def test_a_ring_is_closed_exactly():
    """Check-list 7: the closed-ring flag."""
    ring = np.concatenate((line((0, 0), (9, 0), (9, 9), (0, 9)), [[0.02, 0.01, 0.0]]))
    roads, segments = pieces_of(edge(1, ring))
    assert roads.closed.tolist() == [True]
    assert segments.b[-1].tolist() == segments.a[0].tolist()
    assert ring[-1].tolist() == [0.02, 0.01, 0.0]  # the source is left alone
    open_line, _ = pieces_of(edge(1, ring[:-1]))
    assert open_line.closed.tolist() == [False]


def test_origin_is_subtracted_in_double_precision():
    points = FAR + arc((0.0, 0.0), 30.0, 0.0, 1.0)
    roads = road_lines([lane(1, points)], FAR, None)
    assert roads.lines.points == pytest.approx(arc((0.0, 0.0), 30.0, 0.0, 1.0), abs=1e-8)


def test_no_features_give_no_segments():
    roads, segments = pieces_of()
    assert (roads.lines.count, len(segments)) == (0, 0)


def test_thin_path_keeps_both_ends_and_distances_are_of_its_points():
    path = thin_path(np.stack((np.linspace(0, 20, 81), np.zeros(81)), axis=-1))
    assert path[:, 0].tolist() == [0, 5, 10, 15, 20]
    assert thin_path(np.zeros((4, 2))).tolist() == [[0, 0], [0, 0]]
    assert path_distance(np.array([[5.0, 3.0], [24.0, 3.0]]), path).tolist() == [3.0, 5.0]
    box = inside_box(np.array([[-9.0, 0], [29.9, -10], [30.1, 0], [5, 10.1]]), path, 10.0)
    assert box.tolist() == [True, True, False, False]
