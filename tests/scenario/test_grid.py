from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivax.errors import DataError
from drivax.geometry.polylines import point_to_segment
from drivax.scenario.grid import Grid, arrange, cell_sides
from drivax.scenario.schema import CAPACITIES
from drivax.scenario.segments import cut, road_lines

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
    arranged = arrange(segments, PATH, capacity)
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
    arranged = arrange(segments, PATH, replace(CAPACITY, edge_run=500, lane_run=500))
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


def test_what_does_not_fit_is_the_farthest_and_counted():
    segments = cut(road_lines([lane(1, line((-200, 0), (200, 0)))], np.zeros(3), None))
    arranged = arrange(segments, PATH, replace(CAPACITY, segments=40))
    assert arranged.overflow == {"segments": len(segments) - 40}
    assert np.abs(arranged.segments.middle[:, 0]).max() < 40 * 4 / 2
    far = cut(road_lines([lane(1, line((-50, 0), (900, 0)))], np.zeros(3), None))
    cropped = arrange(far, PATH, CAPACITY)
    assert cropped.overflow["segments"] == int((far.middle[:, 0] >= 320).sum())


def test_crowded_runs_are_thinned_and_counted_and_refused_near_the_log():
    comb = [line((300 + 0.1 * i, -2), (300 + 0.1 * i, 1.9)) for i in range(30)]
    segments = cut(road_lines([edge(i, c) for i, c in enumerate(comb)], np.zeros(3), None))
    tight = replace(CAPACITY, edge_run=10)
    arranged = arrange(segments, PATH, tight)
    assert arranged.overflow == {"edge_run": 20}
    assert arranged.segments.middle[:, 0].max() < 301.0  # the nearest ones stay
    with pytest.raises(DataError, match=r"20 road-edge segments .* larger capacity"):
        arrange(segments, np.array([[295.0, 0.0]]), tight)
    runs = arranged.grid.runs(np.diff(arranged.edge_start))
    assert runs.max() == 10


def ring(*corners, number=1):
    return edge(number, line(*corners, corners[0], step=1.0))


def sides_of(*features, closed=True):
    segments = cut(road_lines(features, np.zeros(3), None))
    grid = Grid.around(segments.middle, PATH, CAPACITY)
    return grid, segments, cell_sides(grid, segments, closed)


OUTER = ring((-150, -100), (150, -100), (150, 100), (-150, 100))
ISLAND = ring((-60, -50), (-60, 50), (60, 50), (60, -50), number=2)  # clockwise: a block of houses


def test_sides_of_a_ring_road_by_hand():
    grid, _, side = sides_of(OUTER, ISLAND)

    def at(x, y):
        return side[grid.cell(np.array([[float(x), float(y)]]))[0]]

    assert (at(-105, 0), at(105, 75), at(0, 0), at(35, -5)) == (1, 1, -1, -1)
    assert (at(-150, 0), at(60, 0)) == (0, 0)  # an edge in the block
    assert (at(250, 0), at(0, 250)) == (0, 0)  # beyond every edge


@settings(max_examples=6)
@given(st.integers(0, 10_000))
def test_sides_agree_with_the_sign_of_the_nearest_edge_everywhere_in_the_cell(seed):
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, 25)[:-1]
    outer = (140 + rng.uniform(-25, 25, 24))[:, None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    inner = (60 + rng.uniform(-20, 20, 24))[:, None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    grid, segments, side = sides_of(ring(*outer), ring(*inner[::-1], number=2))
    known = np.flatnonzero(side)
    assert len(known) > 20
    for cell in known:
        corner = grid.origin + grid.cell_m * np.array([cell % 64, cell // 64])
        for dx, dy in ((0.5, 0.5), (0, 0), (0, 1), (1, 0), (1, 1)):
            assert nearest_side(segments, corner + grid.cell_m * np.array([dx, dy])) == side[cell]


def nearest_side(segments, xy) -> int:
    """Sign by the nearest edge; of two equally near segments the one whose line is further away."""
    a, b = segments.a[:, :2], segments.b[:, :2]
    distance, _ = point_to_segment(xy[None], a, b)
    tied = np.flatnonzero(distance < distance.min() + 1e-6)
    step = (b - a)[tied]
    cross = (step[:, 0] * (xy - a[tied])[:, 1] - step[:, 1] * (xy - a[tied])[:, 0]) / np.linalg.norm(
        step, axis=1
    )
    return int(np.sign(cross[np.abs(cross).argmax()]))


def test_sides_are_unknown_for_open_or_contradicting_edges():
    assert not sides_of(OUTER, ISLAND, closed=False)[2].any()
    same_place = ring((-60, -50), (-60, 50), (60, 50), (60, -50), number=3)
    apart = ring((-120, -90), (-70, -90), (-70, -60), (-120, -60), number=4)
    assert not sides_of(same_place, apart)[2].any()  # one says outside is road, the other that it is not
