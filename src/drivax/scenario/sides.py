"""On which side of the road edges a grid cell lies, for places with no edge within the cut-off of the off-road test."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from drivax.scenario.grid import Grid
from drivax.scenario.segments import Segments

Array = np.ndarray[Any, Any]

#: Nearer than this to an edge the edge itself decides (``scenario.queries.EDGE_CUTOFF_M``), m.
CUTOFF_M = 3.0
#: Samples of a cell are this far apart; edges are heard up to this distance, m.
_SPACING_M, _REACH_M = 2.5, 20.0
#: End points within this distance are one vertex, m.
_JOINED_M = 0.01


def cell_sides(
    grid: Grid, edges: Segments, lanes: Float[Array, "point 2"], rings_closed: bool
) -> Int8[Array, " cell"]:
    """Which cells are drivable where no edge is within the cut-off: 1 drivable, -1 not, 0 unknown.

    Samples of a cell, 2.5 m apart, that are beyond the cut-off of every edge look at their nearest edge (drivable on
    its left); points of lane centres there count as drivable. The cell has a side when all of them agree. An open
    edge says nothing about what lies beyond its end. Cells that no edge reaches get a side from closed rings only.

    Args:
        grid: The grid.
        edges: All road-edge segments, also those that were cropped away.
        lanes: Points of lane centres.
        rings_closed: Whether every road edge is a closed ring.
    """
    side = np.zeros(grid.side**2, dtype=np.int8)
    if not len(edges):
        return side
    count = round(grid.cell_m / _SPACING_M)
    size = grid.side * count + 1
    sign, distance = _nearest_sides(grid, edges, size)
    sign = np.where(distance > CUTOFF_M, sign, 0)
    blind = ((distance <= _REACH_M) & (distance > CUTOFF_M) & (sign == 0)).reshape(size, size)
    drivable, not_drivable = (sign > 0).reshape(size, size), (sign < 0).reshape(size, size)
    on_lane = _lanes_beyond(grid, lanes, distance, size)
    yes = _any_in_cell(drivable, grid.side, count).ravel() | on_lane
    no = _any_in_cell(not_drivable, grid.side, count).ravel()
    undecided = _any_in_cell(blind, grid.side, count).ravel()
    side[yes & ~no & ~undecided] = 1
    side[no & ~yes & ~undecided] = -1
    if rings_closed:
        within = _sides_within_rings(grid, edges)
        side = np.where(within != 0, within, side)
    return side


def _nearest_sides(
    grid: Grid, edges: Segments, size: int
) -> tuple[Int[Array, " sample"], Float[Array, " sample"]]:
    """Side of the nearest edge (0: none in reach, or beyond its open end) and distance to it, of every sample."""
    reach = int(_REACH_M / _SPACING_M)
    steps = np.arange(-reach, reach + 1)
    dx, dy = (part.ravel() for part in np.meshgrid(steps, steps))
    a, b = edges.a[:, :2] - grid.origin, edges.b[:, :2] - grid.origin
    base = np.round((a + b) / (2 * _SPACING_M)).astype(np.int64)
    column, row = base[:, :1] + dx, base[:, 1:] + dy
    inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    # Samples outside the grid share one place behind the others.
    sample = np.where(inside, row * size + column, size * size)
    squared = _squared_distances(column * _SPACING_M, row * _SPACING_M, a, b)
    nearest = np.full(size * size + 1, np.inf)
    np.minimum.at(nearest, sample.ravel(), squared.ravel())
    segment, place = np.nonzero(inside & (squared <= nearest[sample] * (1 + 1e-6) + 1e-6))
    at = sample[segment, place]
    u = b[segment] - a[segment]
    w = np.stack([column[segment, place], row[segment, place]], axis=-1) * _SPACING_M - a[segment]
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
    along = np.clip((x * u[:, :1] + y * u[:, 1:]) / squared, 0.0, 1.0)
    return (x - along * u[:, :1]) ** 2 + (y - along * u[:, 1:]) ** 2


def _open_ends(a: Float[Array, "segment 2"], b: Float[Array, "segment 2"]) -> tuple[Array, Array]:
    """Whether nothing ends where a segment begins, and whether nothing begins where it ends."""
    both = np.round(np.concatenate((a, b)) / _JOINED_M).astype(np.int64)
    name = np.unique(both, axis=0, return_inverse=True)[1].ravel()
    first, last = name[: len(a)], name[len(a) :]
    return ~np.isin(first, last), ~np.isin(last, first)


def _lanes_beyond(
    grid: Grid, lanes: Float[Array, "point 2"], distance: Float[Array, " sample"], size: int
) -> Bool[Array, " cell"]:
    """Cells with a lane centre that is beyond the cut-off of every edge (as its nearest sample tells)."""
    here = lanes[grid.contains(lanes)]
    at = np.round((here - grid.origin) / _SPACING_M).astype(np.int64)
    # A sample is at most 1.8 m away from the point that it stands for.
    far = distance[at[:, 1] * size + at[:, 0]] > CUTOFF_M + _SPACING_M
    cells = np.zeros(grid.side**2, dtype=bool)
    cells[grid.cell(here[far])] = True
    return cells


def _any_in_cell(samples: Bool[Array, "row column"], side: int, count: int) -> Bool[Array, "side side"]:
    """Whether any sample of a cell holds, its border included."""
    result = np.zeros((side, side), dtype=bool)
    for dy in range(count + 1):
        for dx in range(count + 1):
            result |= samples[dy : dy + side * count : count, dx : dx + side * count : count]
    return result


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
