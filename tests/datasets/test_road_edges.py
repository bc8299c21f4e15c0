"""Road edges from drivable areas, against point-in-polygon by brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivax.datasets.road_edges import GAP_M, road_edges
from drivax.errors import DataError, UsageError
from drivax.scenario.schema import RoadKind

FIRST = 900


def box(x0, y0, x1, y1, clockwise=False):
    ring = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], np.float64)
    return ring[::-1].copy() if clockwise else ring


def inside(ring, xy) -> np.ndarray:
    """Even-odd rule by crossings of a ray: the oracle, for simple rings."""
    result = np.zeros(len(xy), bool)
    for (x0, y0), (x1, y1) in zip(ring[:, :2], np.roll(ring[:, :2], -1, axis=0), strict=True):
        crosses = (y0 > xy[:, 1]) != (y1 > xy[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            result ^= crosses & (xy[:, 0] < (x1 - x0) * (xy[:, 1] - y0) / (y1 - y0) + x0)
    return result


def drivable(areas, xy) -> np.ndarray:
    """Whether points lie in any area and none of its own holes."""
    found = np.zeros(len(xy), bool)
    for exterior, holes in areas:
        in_hole = [inside(hole, xy) for hole in holes]
        found |= inside(exterior, xy) & ~np.logical_or.reduce(in_hole, axis=0, initial=False)
    return found


def assert_sides(areas, edges, off_m=0.5, rng=None):
    """Left of every edge is drivable, right of it is not: random points next to every edge."""
    rng = rng or np.random.default_rng(1)
    for edge in edges:
        a, b = edge.points[:-1, :2], edge.points[1:, :2]
        length = np.hypot(*(b - a).T)
        long = length > 2 * off_m
        a, step, length = a[long], (b - a)[long], length[long]
        for _ in range(5):
            along = rng.uniform(0.05, 0.95, len(a))[:, None]
            left = np.column_stack((-step[:, 1], step[:, 0])) / length[:, None] * off_m
            assert drivable(areas, a + along * step + left).all()
            assert not drivable(areas, a + along * step - left).any()


def assert_rings(edges):
    for number, edge in enumerate(edges):
        assert edge.feature_id == FIRST + number and edge.kind == RoadKind.EDGE_BOUNDARY
        assert len(edge.points) >= 4
        np.testing.assert_array_equal(edge.points[0], edge.points[-1])


def turning(edge) -> float:
    """Signed area: positive for anticlockwise rings."""
    x, y = edge.points[:, 0], edge.points[:, 1]
    return 0.5 * float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))


@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize("hole_clockwise", [False, True])
@pytest.mark.parametrize("repeated", [False, True])
def test_check_list_7_edges_have_the_drivable_side_on_the_left(clockwise, hole_clockwise, repeated):
    """Orient edges (drivable left), closed-ring flag: whichever way round the source draws its rings."""
    exterior, hole = box(0, 0, 40, 20, clockwise), box(10, 5, 20, 15, hole_clockwise)
    if repeated:
        exterior, hole = np.concatenate((exterior, exterior[:1])), np.concatenate((hole, hole[:1]))
    areas = [(exterior, [hole])]
    edges = road_edges(areas, FIRST)
    assert_rings(edges)
    assert [round(turning(edge), 3) for edge in edges] == [800.0, -100.0]
    assert_sides(areas, edges)


def test_areas_that_touch_become_one():
    """Argoverse 2 cuts drivable areas at map tiles: no edge may run across the road there."""
    areas = [(box(0, 0, 30, 10), []), (box(30, 2, 60, 10, clockwise=True), [])]
    (edge,) = road_edges(areas, FIRST)
    assert turning(edge) == pytest.approx(300 + 240)
    on_cut = np.isclose(edge.points[:, 0], 30.0)
    assert edge.points[on_cut, 1].max(initial=0.0) <= 10.0 and on_cut.sum() <= 3
    middle = (edge.points[:-1] + edge.points[1:]) / 2
    assert not ((np.abs(middle[:, 0] - 30.0) < 0.01) & (middle[:, 1] > 2.01) & (middle[:, 1] < 9.99)).any()
    assert_sides(areas, [edge])


@pytest.mark.parametrize("gap", [0.002, 0.02, 0.09])
def test_small_gaps_are_closed(gap):
    areas = [(box(0, 0, 30, 10), []), (box(30 + gap, 0, 60, 10), [])]
    (edge,) = road_edges(areas, FIRST)
    assert turning(edge) == pytest.approx(600.0, abs=0.01)


def test_wide_gaps_stay():
    edges = road_edges([(box(0, 0, 30, 10), []), (box(30 + 2 * GAP_M, 0, 60, 10), [])], FIRST)
    assert sorted(round(turning(edge), 2) for edge in edges) == [298.0, 300.0]


def test_overlaps_slivers_and_points_of_contact():
    crossing = [(box(0, 8, 40, 12), []), (box(18, -10, 22, 30, clockwise=True), [])]
    (edge,) = road_edges(crossing, FIRST)
    assert turning(edge) == pytest.approx(160 + 160 - 16)
    assert_sides(crossing, [edge])
    sliver = [(box(0, 0, 10, 10), []), (box(20, 0, 20.05, 10), [])]  # 0.5 square metres of nothing
    assert [round(turning(edge), 3) for edge in road_edges(sliver, FIRST)] == [100.0]
    corner = [(box(0, 0, 10, 10), []), (box(10, 10, 20, 20), [])]
    edges = road_edges(corner, FIRST)
    assert_rings(edges)
    assert sum(map(turning, edges)) == pytest.approx(200.0, abs=0.05)
    assert_sides(corner, edges)


def test_a_ring_that_crosses_itself_is_repaired():
    bow = np.array([[0, 0], [20, 20], [20, 0], [0, 20]], np.float64)
    edges = road_edges([(bow, [])], FIRST)
    assert_rings(edges)
    assert sum(map(turning, edges)) == pytest.approx(200.0, abs=0.1)
    assert_sides([(bow, [])], edges)


def test_a_hole_that_another_area_fills_is_no_edge():
    areas = [(box(0, 0, 30, 30), [box(10, 10, 20, 20)]), (box(10, 10, 20, 20), [])]
    assert [round(turning(edge), 3) for edge in road_edges(areas, FIRST)] == [900.0]


def test_degenerate_rings_are_left_out():
    point, line = np.zeros((4, 2)), np.array([[0, 0], [5, 5], [0, 0]], np.float64)
    flat = np.array([[0, 0], [5, 0], [10, 0], [2, 0]], np.float64)
    empty = np.zeros((0, 2))
    assert road_edges([(point, []), (line, []), (flat, []), (empty, [])], FIRST) == []
    assert road_edges([], FIRST) == []
    (edge,) = road_edges([(box(0, 0, 10, 10), [point, line, empty])], FIRST)
    assert turning(edge) == pytest.approx(100.0)


def test_heights_follow_the_nearest_edge_of_the_input():
    """A plane z = x / 10: heights of corners are kept, those of new corners interpolated along what crosses there."""

    def tilted(ring):
        return np.column_stack((ring, ring[:, 0] / 10 + 3))

    areas = [(tilted(box(0, 8, 40, 12)), []), (tilted(box(18, -10, 22, 30)), [])]
    (edge,) = road_edges(areas, FIRST)
    np.testing.assert_allclose(edge.points[:, 2], edge.points[:, 0] / 10 + 3, atol=1e-3)
    assert len(edge.points) == 13  # twelve corners of a plus sign, four of them new
    (flat,) = road_edges([(box(0, 0, 4, 4), [])], FIRST)
    assert not flat.points[:, 2].any()


@given(st.integers(0, 10_000))
def test_random_stars_have_their_edges_on_the_right_side(seed):
    """Up to five star-shaped areas far from the origin, in random orientation, some with a hole."""
    rng = np.random.default_rng(seed)
    areas = []
    for _ in range(rng.integers(1, 6)):
        angle = np.sort(rng.uniform(0, 2 * math.pi, rng.integers(8, 30)))
        if np.diff(angle, append=angle[0] + 2 * math.pi).max() > 2.5:
            continue
        radius = rng.uniform(15, 30, len(angle))
        circle = np.column_stack((np.cos(angle), np.sin(angle)))
        centre = np.array([664_000.0, 4_000_000.0]) + rng.uniform(-25, 25, 2)
        ring = centre + radius[:, None] * circle
        holes = [centre + 2 * circle] if rng.random() < 0.5 else []
        areas.append((ring if rng.random() < 0.5 else ring[::-1].copy(), holes))
    edges = road_edges(areas, FIRST)
    assert_rings(edges)
    xy = np.array([664_000.0, 4_000_000.0]) + rng.uniform(-60, 60, (400, 2))
    wanted = drivable(areas, xy)
    found = np.zeros(len(xy), int)
    for edge in edges:
        found += np.where(inside(edge.points, xy), 1 if turning(edge) > 0 else -1, 0)
    # Notches narrower than a gap are filled: next to the edges of the input the answer is free.
    rings = [ring for exterior, holes in areas for ring in (exterior, *holes)]
    closed = [np.concatenate((ring, ring[:1])) for ring in rings]
    near = (
        np.array([_distance(ring, xy) for ring in closed]).reshape(-1, len(xy)).min(axis=0, initial=1.0)
        < GAP_M
    )
    np.testing.assert_array_equal(found[~near], wanted[~near])


def _distance(ring, xy):
    a, b = ring[:-1, :2], ring[1:, :2]
    step = b - a
    square = np.maximum((step**2).sum(1), 1e-12)
    along = np.clip(((xy[:, None] - a) * step).sum(-1) / square, 0, 1)
    return np.hypot(*np.moveaxis(xy[:, None] - a - along[..., None] * step, -1, 0)).min(axis=1)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e300, -1e9])
def test_points_that_are_not_finite_or_too_far_are_refused(bad):
    ring = box(0, 0, 10, 10)
    ring[2, 1] = bad
    with pytest.raises(DataError, match="not finite"):
        road_edges([(ring, [])], FIRST)


def test_missing_shapely_names_the_extra(hide_packages):
    hide_packages("shapely")
    with pytest.raises(UsageError, match=r"pip install 'drivax\[maps\]'"):
        road_edges([(box(0, 0, 10, 10), [])], FIRST)
