from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivax.errors import DataError
from drivax.geometry.polylines import point_to_segment
from drivax.scenario.build.grid import Grid, arrange
from drivax.scenario.build.segments import cut, road_lines
from drivax.scenario.schema import CAPACITIES

from .recordings import edge, lane, line

CAPACITY = CAPACITIES["default"]
PATH = np.zeros((1, 2))


def random_map(seed: int, size: float = 120.0):
    rng = np.random.default_rng(seed)
    features = []
    for i in range(14):
        course = np.cumsum(rng.normal(0.0, 0.15, 70)) + rng.uniform(-3, 3)
        step = rng.uniform(0.2, 6.0)
        xy = rng.uniform(-size, size, 2) + np.cumsum(
            step * np.stack((np.cos(course), np.sin(course)), axis=-1), axis=0
        )
        points = np.concatenate((xy, np.zeros((70, 1))), axis=1)
        features.append(edge(i, points) if i % 2 else lane(i, points))
    return cut(road_lines(features, np.zeros(3), None))


def block_members(arranged, start, xy):
    """Segment indices in the 3 x 3 block around a query, read as three runs."""
    column, row = arranged.grid.column_row(xy[None])[0]
    side = arranged.grid.side
    members = []
    for y in range(max(row - 1, 0), min(row + 2, side)):
        first, last = y * side + max(column - 1, 0), y * side + min(column + 1, side - 1)
        members += range(start[first], start[last + 1])
    return set(members)


@given(st.integers(0, 10_000))
def test_every_segment_within_eight_metres_is_in_the_block_of_nine_cells(seed):
    segments = random_map(seed)
    capacity = replace(CAPACITY, edge_run=500, lane_run=500)
    arranged = arrange(segments, PATH, 100.0, capacity)
    assert arranged.overflow.get("edge_run", 0) == 0
    a, b = (x.astype(np.float32).astype(np.float64) for x in (arranged.segments.a, arranged.segments.b))
    rng = np.random.default_rng(seed)
    picks = a[rng.integers(0, len(a), 60), :2] + rng.uniform(-9, 9, (60, 2))
    for xy in picks[arranged.grid.contains(picks)]:
        distance, _ = point_to_segment(xy[None], a[:, :2], b[:, :2])
        for start, low, high in (
            (arranged.edge_start, 0, arranged.blocks[1]),
            (arranged.lane_start, arranged.blocks[1], arranged.blocks[2]),
        ):
            needed = {int(i) for i in np.flatnonzero(distance <= 8.0) if low <= i < high}
            assert needed <= block_members(arranged, start, xy)


@given(st.integers(0, 10_000))
def test_blocks_are_sorted_by_cell_and_nothing_is_lost(seed):
    segments = random_map(seed)
    arranged = arrange(segments, PATH, 1000.0, replace(CAPACITY, edge_run=500, lane_run=500))
    ends = arranged.blocks
    assert ends[0] == 0
    assert ends[3] == len(arranged.segments) == len(segments) - arranged.overflow.get("segments", 0)
    for number, (low, high) in enumerate(pairwise(ends[:3])):
        assert (arranged.segments.block[low:high] == number).all()
        cell = arranged.grid.cell(arranged.segments.middle[low:high])
        assert (np.diff(cell) >= 0).all()
        start = (arranged.edge_start, arranged.lane_start)[number]
        assert (start[0], start[-1]) == (low, high)
        assert np.diff(start).tolist() == np.bincount(cell, minlength=64 * 64).tolist()
    kept = {tuple(row) for row in arranged.segments.a}
    assert kept <= {tuple(row) for row in segments.a}


def test_the_grid_is_centred_on_the_map_or_on_the_log_where_the_map_is_too_large():
    small = Grid.around(np.array([[0.0, 0], [100, 40]]), PATH, CAPACITY)
    assert small.origin.tolist() == [50 - 320, 20 - 320]
    large = Grid.around(np.array([[0.0, 0], [900, 0]]), np.array([[10.0, 0], [30, 0]]), CAPACITY)
    assert large.origin.tolist() == [20 - 320, -320]


def test_farthest_segments_overflow_and_are_counted():
    segments = cut(road_lines([lane(1, line((-200, 0), (200, 0)))], np.zeros(3), None))
    arranged = arrange(segments, PATH, 100.0, replace(CAPACITY, segments=40))
    assert arranged.overflow == {"segments": len(segments) - 40}
    assert np.abs(arranged.segments.middle[:, 0]).max() < 40 * 4 / 2
    far = cut(road_lines([lane(1, line((-50, 0), (900, 0)))], np.zeros(3), None))
    cropped = arrange(far, PATH, 400.0, CAPACITY)
    x = far.middle[:, 0]
    assert cropped.overflow == {"segments": int(((x >= 320) & (x <= 400)).sum())}
    assert arrange(far, PATH, 320.0, CAPACITY).overflow == {}  # the rest is outside the crop


def test_crowded_runs_are_thinned_and_counted_and_refused_near_the_log():
    comb = [line((300 + 0.1 * i, -2), (300 + 0.1 * i, 1.9)) for i in range(30)]
    segments = cut(road_lines([edge(i, c) for i, c in enumerate(comb)], np.zeros(3), None))
    tight = replace(CAPACITY, edge_run=10)
    arranged = arrange(segments, PATH, 100.0, tight)
    assert arranged.overflow == {"edge_run": 20}
    assert arranged.segments.middle[:, 0].max() < 301.0  # the nearest ones stay
    with pytest.raises(DataError, match=r"20 road-edge segments .* larger capacity"):
        arrange(segments, np.array([[295.0, 0.0]]), 100.0, tight)
    # No capacity holds what lies outside the square.
    long = cut(road_lines([edge(1, line((0, 5), (900, 5)))], np.zeros(3), None))
    with pytest.raises(DataError, match=r"shorten --future-s: the log leaves the map's square of 640 m"):
        arrange(long, line((0, 0), (900, 0))[:, :2], 100.0, CAPACITY)
    runs = arranged.grid.runs(np.diff(arranged.edge_start))
    assert runs.max() == 10
