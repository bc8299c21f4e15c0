"""Sides of grid cells against the nearest edge, by brute force."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drivax.geometry.polylines import point_to_segment
from drivax.scenario.build.grid import CUTOFF_M, DRIVABLE, SPLIT, Grid, cell_sides, pack_sides, ringed_cells
from drivax.scenario.build.segments import cut, road_lines
from drivax.scenario.schema import CAPACITIES

from .recordings import edge, line

NO_LANES = np.zeros((0, 2))
CAPACITY = CAPACITIES["default"]
PATH = np.array([[0.0, 0.0], [10.0, 0.0]])


def ring(*corners, number=1):
    return edge(number, line(*corners, corners[0], step=1.0))


def sides_of(*features, closed=True):
    roads = road_lines(features, np.zeros(3), None)
    segments = cut(roads)
    grid = Grid.around(segments.middle, PATH, CAPACITY)
    return (
        finer(grid),
        segments,
        unpacked(grid, sides(grid, segments, roads.closed[segments.polyline] & closed)),
    )


def sides(grid, segments, closed, lanes=NO_LANES) -> np.ndarray:
    """Packed sides; the crop is 100 m around ``PATH``."""
    return cell_sides(grid, segments, lanes, closed, ringed_cells(grid, segments, closed, PATH, 100.0))


def finer(grid) -> Grid:
    """The side cells."""
    return Grid(grid.origin, grid.cell_m / SPLIT, grid.side * SPLIT)


def unpacked(grid, words) -> np.ndarray:
    """1 drivable, -1 not, 0 unknown, of every side cell; independent of the code under test."""
    side = np.zeros((grid.side * SPLIT, grid.side * SPLIT), dtype=int)
    for cell, word in enumerate(words.tolist()):
        row, column = divmod(cell, grid.side)
        for part in range(9):
            code = word // 4**part % 4
            side[3 * row + part // 3, 3 * column + part % 3] = {0: 0, DRIVABLE: 1}.get(code, -1)
    return side.ravel()


OUTER = ring((-150, -100), (150, -100), (150, 100), (-150, 100))
ISLAND = ring((-60, -50), (-60, 50), (60, 50), (60, -50), number=2)  # clockwise: a block of houses


def test_sides_of_a_ring_road_by_hand():
    grid, _, side = sides_of(OUTER, ISLAND)

    def at(x, y):
        return side[grid.cell(np.array([[float(x), float(y)]]))[0]]

    assert (at(-105, 0), at(105, 75), at(0, 0), at(35, -5)) == (1, 1, -1, -1)
    # Both sides of a border, a little beyond the cut-off: a grid cell of 10 m holds both.
    assert (at(-146.5, 0), at(-153.5, 0), at(56.5, 0), at(63.5, 0)) == (1, -1, -1, 1)
    assert (at(250, 0), at(0, 250)) == (0, 0)  # beyond every edge


@settings(max_examples=8)
@given(st.integers(0, 10_000), st.booleans())
def test_sides_are_those_of_the_nearest_edge_beyond_the_cutoff(seed, closed):
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, 25)[:-1]
    outer = (140 + rng.uniform(-25, 25, 24))[:, None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    inner = (60 + rng.uniform(-20, 20, 24))[:, None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    grid, segments, side = sides_of(ring(*outer), ring(*inner[::-1], number=2), closed=closed)
    points = rng.uniform(-190, 190, (400, 2))
    a, b = segments.a[:, :2], segments.b[:, :2]
    tested = wrong = 0
    for xy in points:
        known = side[grid.cell(xy[None])[0]]
        if known == 0 or point_to_segment(xy[None], a, b)[0].min() <= CUTOFF_M:
            continue
        tested += 1
        wrong += nearest_side(segments, xy) != known
    assert tested > 100 and wrong == 0


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


def test_sides_beyond_open_edge_ends_are_unknown():
    # One edge along +x from 0 to 100: left of it is road, right of it is not, beyond its ends the side is unknown.
    grid, _, side = sides_of(edge(1, line((0, 0), (100, 0), step=1.0)))

    def at(x, y):
        return side[grid.cell(np.array([[float(x), float(y)]]))[0]]

    assert (at(50, 8), at(50, -8)) == (1, -1)
    assert (at(-12, 8), at(113, -8)) == (0, 0)
    assert at(50, 60) == 0


def test_a_lane_against_the_edges_leaves_the_side_unknown():
    edges = cut(road_lines([edge(1, line((0, 0), (100, 0), step=1.0))], np.zeros(3), None))
    grid = Grid.around(edges.middle, np.array([[0.0, 0.0]]), CAPACITY)
    lane = np.stack([np.arange(0.0, 100.0), np.full(100, -8.0)], axis=-1)
    cell = finer(grid).cell(np.array([[50.0, -8.0]]))[0]
    closed = np.zeros(len(edges), dtype=bool)
    assert unpacked(grid, sides(grid, edges, closed))[cell] == -1
    assert unpacked(grid, sides(grid, edges, closed, lane))[cell] == 0


def test_an_open_edge_outside_the_crop_changes_no_side_inside():
    grid, _, side = sides_of(OUTER, ISLAND)
    open_edges = [edge(8 + i, line((-10, y), (10, y), step=1.0)) for i, y in enumerate((180, -180))]
    same_grid, _, other = sides_of(OUTER, ISLAND, *open_edges)
    assert (same_grid.origin == grid.origin).all()
    crop = (np.abs(grid.centres - [5.0, 0.0]) < [100.0, 95.0]).all(axis=1)
    assert (side[crop] == other[crop]).all() and {1, -1} <= set(other[crop])
    # Beyond the crop the open edge may part road from field: at 50 m from every edge nothing is known.
    cell = grid.cell(np.array([[-205.0, -5.0], [205.0, 5.0]]))
    assert (other[cell] == 0).all()


def test_an_open_edge_in_the_crop_leaves_places_far_from_edges_unknown():
    grid, _, side = sides_of(OUTER, ISLAND, edge(9, line((70, 60), (90, 60), step=1.0)))
    middle = grid.cell(np.array([[0.0, 0.0]]))[0]  # 50 m from the next edge
    assert sides_of(OUTER, ISLAND)[2][middle] == -1 and side[middle] == 0


def test_sides_far_from_edges_are_unknown_where_rings_contradict():
    same_place = ring((-60, -50), (-60, 50), (60, 50), (60, -50), number=3)
    apart = ring((-120, -90), (-70, -90), (-70, -60), (-120, -60), number=4)
    grid, _, side = sides_of(same_place, apart)  # one says outside is road, the other that it is not
    assert side[grid.cell(np.array([[0.0, 0.0], [0.0, 200.0]]))].tolist() == [0, 0]


def test_packing_keeps_every_side():
    side = np.random.default_rng(0).integers(-1, 2, (12, 12))
    grid = Grid(np.zeros(2), 10.0, 4)
    assert (unpacked(grid, pack_sides(side)) == side.ravel()).all()
