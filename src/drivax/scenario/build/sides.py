"""On which side of the road edges a place lies, for places with no edge within the cut-off of the off-road test."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Int8, Int32

from drivax.scenario.build.grid import Grid
from drivax.scenario.build.segments import Segments

Array = np.ndarray[Any, Any]

#: Nearer than this to an edge the edge itself decides (``scenario.bank.queries.EDGE_CUTOFF_M``), m.
CUTOFF_M = 3.0
#: Side cells along one grid cell. Half the diagonal of a side cell must be below the cut-off: then no edge lies between
#: the centre of a side cell and those of its points that are beyond the cut-off, and the centre speaks for all of them.
SPLIT = 3
#: Codes of a packed side cell; 0 is unknown.
DRIVABLE, NOT_DRIVABLE = 1, 2
#: Edges are heard up to this distance, m.
_REACH_M = 20.0
#: End points within this distance are one vertex, m.
_JOINED_M = 0.01


def cell_sides(
    grid: Grid, edges: Segments, lanes: Float[Array, "point 2"], rings_closed: bool
) -> Int32[Array, " cell"]:
    """Which side cells are drivable where no edge is within the cut-off, packed per grid cell (see :func:`packed`).

    The nearest edge of a cell's centre says so (drivable on its left). An open edge says nothing about what lies
    beyond its end. Lane centres contradict cells that are not drivable. Grid cells that no edge reaches get a side
    from closed rings only.

    Args:
        grid: The grid; each of its cells has 3 x 3 side cells.
        edges: All road-edge segments, also those that were cropped away.
        lanes: Points of lane centres.
        rings_closed: Whether every road edge is a closed ring.
    """
    fine = Grid(grid.origin, grid.cell_m / SPLIT, grid.side * SPLIT)
    if not len(edges):
        return np.zeros(grid.side**2, dtype=np.int32)
    side, distance = _nearest_sides(fine, edges.take(_in_reach(grid, edges)))
    lane_cells = fine.cell(lanes[fine.contains(lanes)])
    contradicted = lane_cells[(side[lane_cells] < 0) & (distance[lane_cells] > CUTOFF_M)]
    side[contradicted] = 0
    if rings_closed:
        square = _sides_within_rings(grid, edges).reshape(grid.side, grid.side)
        within = square.repeat(SPLIT, axis=0).repeat(SPLIT, axis=1).ravel()
        side = np.where(within != 0, within, side)
    return packed(side.reshape(fine.side, fine.side))


def packed(side: Int[Array, "row column"]) -> Int32[Array, " cell"]:
    """Sides (1 drivable, -1 not, 0 unknown) of the 3 x 3 side cells of every grid cell in one number.

    Two bits for each, row by row from the lowest: 0 unknown, 1 drivable, 2 not drivable.
    """
    count = len(side) // SPLIT
    blocks = side.reshape(count, SPLIT, count, SPLIT).swapaxes(1, 2).reshape(count * count, SPLIT * SPLIT)
    codes = np.where(blocks < 0, NOT_DRIVABLE, blocks).astype(np.int32)
    return np.bitwise_or.reduce(codes << np.arange(0, 2 * SPLIT * SPLIT, 2, dtype=np.int32), axis=1)


def _in_reach(grid: Grid, edges: Segments) -> Bool[Array, " segment"]:
    """Edges that a cell of the grid may hear; a source may hold a whole city's."""
    reach = _REACH_M + grid.cell_m
    middle = (edges.a[:, :2] + edges.b[:, :2]) / 2 - grid.origin
    return np.all((middle >= -reach) & (middle <= grid.side * grid.cell_m + reach), axis=1)


def _nearest_sides(fine: Grid, edges: Segments) -> tuple[Int[Array, " cell"], Float[Array, " cell"]]:
    """Side of the nearest edge (0: none in reach, or beyond its open end) and distance to it, of every cell centre."""
    size, width = fine.side, fine.cell_m
    reach = int(np.ceil(_REACH_M / width))
    steps = np.arange(-reach, reach + 1)
    dx, dy = (part.ravel() for part in np.meshgrid(steps, steps))
    a, b = edges.a[:, :2] - fine.origin, edges.b[:, :2] - fine.origin
    base = np.floor((a + b) / (2 * width)).astype(np.int64)
    column, row = base[:, :1] + dx, base[:, 1:] + dy
    inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    # Cells outside the grid share one place behind the others.
    cell = np.where(inside, row * size + column, size * size)
    x, y = (column + 0.5) * width, (row + 0.5) * width
    squared = _squared_distances(x, y, a, b)
    nearest = np.full(size * size + 1, np.inf)
    np.minimum.at(nearest, cell.ravel(), squared.ravel())
    segment, place = np.nonzero(inside & (squared <= nearest[cell] * (1 + 1e-6) + 1e-6))
    at = cell[segment, place]
    u = b[segment] - a[segment]
    w = np.stack([x[segment, place], y[segment, place]], axis=-1) - a[segment]
    length = np.maximum(np.hypot(u[:, 0], u[:, 1]), 1e-6)
    along = (u * w).sum(axis=1) / length**2
    left = (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / length
    begins, ends = _open_ends(a, b)
    beyond = (begins[segment] & (along <= 0.0)) | (ends[segment] & (along >= 1.0))
    # At a vertex the segment whose line is further away has the right side.
    most, least, cut = np.zeros(size * size), np.zeros(size * size), np.zeros(size * size, dtype=bool)
    np.maximum.at(most, at, left)
    np.minimum.at(least, at, left)
    cut[at[beyond]] = True
    sign, distance = np.where(most >= -least, 1, -1), np.sqrt(nearest[:-1])
    return np.where(cut | (distance > _REACH_M), 0, sign), distance


def _squared_distances(
    x: Float[Array, "segment near"], y: Float[Array, "segment near"], a: Float[Array, "segment 2"],
    b: Float[Array, "segment 2"],
) -> Float[Array, "segment near"]:  # fmt: skip
    """Squared distance of points near each segment to it."""
    u = b - a
    squared = np.maximum((u * u).sum(axis=1), 1e-12)[:, None]
    x, y = x - a[:, :1], y - a[:, 1:]
    along = x * (u[:, :1] / squared)
    along += y * (u[:, 1:] / squared)
    np.minimum(np.maximum(along, 0.0, out=along), 1.0, out=along)
    x -= along * u[:, :1]
    y -= along * u[:, 1:]
    x *= x
    y *= y
    x += y
    return x


def _open_ends(a: Float[Array, "segment 2"], b: Float[Array, "segment 2"]) -> tuple[Array, Array]:
    """Whether nothing ends where a segment begins, and whether nothing begins where it ends."""
    both = np.round(np.concatenate((a, b)) / _JOINED_M).astype(np.int64)
    name = both[:, 0] * 2**32 + both[:, 1]  # edges in reach of a grid are few kilometres from its corner
    first, last = name[: len(a)], name[len(a) :]
    return ~np.isin(first, last), ~np.isin(last, first)


def _sides_within_rings(grid: Grid, edges: Segments) -> Int8[Array, " cell"]:
    """Which cells far from every edge are drivable, where all edges are closed rings: 1 drivable, -1 not, 0 unknown.

    No edge crosses a cell whose 3 x 3 block holds none, so for closed rings the whole cell lies on one side, and
    the winding number of its centre says on which: rings run with the drivable side on their left (outer rings
    counter-clockwise, islands clockwise), so it takes one value on the road and one lower off it. Crossings of the
    line through the cell centres of a row are counted from the right (Sunday's winding number, 2001).

    """
    side = np.zeros(grid.side**2, dtype=np.int8)
    winding = _winding_at_centres(grid, edges)
    low, high = min(winding.min(), 0), max(winding.max(), 0)
    if low < 0 < high:
        return side  # rings contradict each other
    drivable = winding > 0 if high > 0 else winding == 0
    corner = np.concatenate((edges.a[:, :2], edges.b[:, :2]))
    centre = grid.origin + (np.arange(grid.side)[:, None] + 0.5) * grid.cell_m
    within = (centre >= corner.min(axis=0)) & (centre <= corner.max(axis=0))
    known = (within[None, :, 0] & within[:, None, 1]) & ~_near_edge(grid, edges)
    side.reshape(grid.side, grid.side)[known] = np.where(drivable[known], 1, -1)
    return side


def _winding_at_centres(grid: Grid, edges: Segments) -> Int[Array, "row column"]:
    """Winding number of the edges around the centre of every cell."""
    scaled_a = (edges.a[:, :2] - grid.origin) / grid.cell_m - 0.5
    scaled_b = (edges.b[:, :2] - grid.origin) / grid.cell_m - 0.5
    row_a, row_b = np.floor(scaled_a[:, 1]), np.floor(scaled_b[:, 1])
    crossing = np.flatnonzero(row_a != row_b)  # a segment is shorter than a cell: one row line at most
    line = np.maximum(row_a, row_b)[crossing]
    a, b = scaled_a[crossing], scaled_b[crossing]
    x = a[:, 0] + (line - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    up = np.where(row_b[crossing] > row_a[crossing], 1, -1)
    last = np.clip(np.ceil(x) - 1, -1, grid.side - 1).astype(np.int64)  # last column left of the crossing
    seen = (line >= 0) & (line < grid.side) & (last >= 0)
    table = np.zeros((grid.side, grid.side), dtype=np.int64)
    np.add.at(table, (line[seen].astype(np.int64), last[seen]), up[seen])
    return np.cumsum(table[:, ::-1], axis=1)[:, ::-1]


def _near_edge(grid: Grid, edges: Segments) -> Bool[Array, "row column"]:
    """Cells whose 3 x 3 block holds the midpoint of an edge segment."""
    cell = grid.column_row(edges.middle) + 1
    padded = np.zeros((grid.side + 2, grid.side + 2), dtype=bool)
    near_square = np.all((cell >= 0) & (cell < grid.side + 2), axis=1)
    padded[cell[near_square, 1], cell[near_square, 0]] = True
    size = grid.side
    shifts = [padded[dy : dy + size, dx : dx + size] for dy in range(3) for dx in range(3)]
    return np.logical_or.reduce(shifts)
