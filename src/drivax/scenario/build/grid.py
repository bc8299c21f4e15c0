"""The uniform grid over the map of a scenario: segments near a pose, and the drivable side of every cell."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Int8, Int32

from drivax.errors import DataError
from drivax.scenario.build.segments import Segments, inside_box, path_distance
from drivax.scenario.schema import Capacity

#: Within this distance an edge itself decides the side of a point (``scenario.bank.queries.EDGE_CUTOFF_M``), m.
CUTOFF_M = 3.0
#: Side cells along a grid cell. Half the diagonal of a side cell is below the cut-off, so no edge lies between its
#: centre and those of its points that are beyond the cut-off.
SPLIT = 3
#: Edges whose surroundings are searched at once.
_BLOCK = 64
#: Codes of a packed side cell; 0 is unknown.
DRIVABLE, NOT_DRIVABLE = 1, 2
#: Edges decide the side of cells up to the first distance; end points within the second are one vertex, m.
_REACH_M, _VERTEX_M = 20.0, 0.01
Array = np.ndarray[Any, Any]
EDGE_BLOCK, LANE_BLOCK, REST_BLOCK = 0, 1, 2
#: A scenario is refused if an edge this near to the logged ego does not fit: off-road tests would be wrong.
UNSAFE_M = 20.0


@dataclass(frozen=True)
class Grid:
    """A square of ``side`` x ``side`` cells, row-major: cell index = iy * side + ix.

    Guarantee: every segment of at most 4 m within ``cell_m`` - 2 m of a query lies in the 3 x 3 block of cells
    around the query, because its midpoint is at most 2 m from its nearest point.
    """

    origin: Float[Array, " 2"]
    cell_m: float
    side: int

    @classmethod
    def around(cls, xy: Float[Array, "point 2"], path: Float[Array, "step 2"], capacity: Capacity) -> Grid:
        """Return the grid centred on points; without any, or if they do not fit, on ``path``, the log of the ego."""
        size = capacity.grid * capacity.cell_m
        points = xy if len(xy) and np.all(np.ptp(xy, axis=0) < size) else path
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        origin = (centre - size / 2).astype(np.float32).astype(np.float64)
        return cls(origin, capacity.cell_m, capacity.grid)

    @property
    def centres(self) -> Float[Array, "cell 2"]:
        """Centre of every cell, row-major."""
        along = (np.arange(self.side) + 0.5) * self.cell_m
        return self.origin + np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)

    def column_row(self, xy: Float[Array, "point 2"]) -> Int[Array, "point 2"]:
        """Column and row of the cell of each point; may lie outside the square."""
        return np.floor((xy - self.origin) / self.cell_m).astype(np.int64)

    def contains(self, xy: Float[Array, "point 2"]) -> Bool[Array, " point"]:
        """Return whether points lie in the square."""
        cell = self.column_row(xy)
        return np.all((cell >= 0) & (cell < self.side), axis=1)

    def cell(self, xy: Float[Array, "point 2"]) -> Int[Array, " point"]:
        """Row-major cell index of points inside the square."""
        return self.column_row(xy) @ np.array([1, self.side])

    def runs(self, counts: Int[Array, " cell"]) -> Int[Array, "row column"]:
        """Number of entries in the run of three neighbouring cells of a row, centred on each cell."""
        table = np.pad(counts.reshape(self.side, self.side), ((0, 0), (1, 1)))
        return table[:, :-2] + table[:, 1:-1] + table[:, 2:]

    def excess_entries(self, cell: Int[Array, " entry"], distance: Float[Array, " entry"], cap: int) -> Array:
        """Return the farthest entries to drop so that no run of three cells is longer than ``cap``."""
        drop = np.zeros(len(cell), dtype=bool)
        while True:
            counts = np.bincount(cell[~drop], minlength=self.side**2)
            runs = self.runs(counts)
            row, column = np.unravel_index(runs.argmax(), runs.shape)
            excess = runs[row, column] - cap
            if excess <= 0:
                return np.flatnonzero(drop)
            in_run = (cell // self.side == row) & (np.abs(cell % self.side - column) <= 1)
            members = np.flatnonzero(~drop & in_run)
            drop[members[np.argsort(distance[members], kind="stable")[-excess:]]] = True

    def starts(self, cell: Int[Array, " entry"], offset: int) -> Int[Array, " cell_plus_1"]:
        """Index of the first entry of each cell, and of the end; entries are sorted by cell and begin at ``offset``."""
        counts = np.bincount(cell, minlength=self.side**2)
        return np.concatenate(([0], np.cumsum(counts))) + offset


@dataclass(frozen=True)
class GridSegments:
    """Segments in storage order (edges by cell, car lanes by cell, the rest in order of the source) with their grid.

    ``blocks`` holds 0 and the ends of the edges, the lanes and the rest. ``edge_start`` and ``lane_start`` hold the
    index of the first segment of each cell, and of the end.
    """

    grid: Grid
    segments: Segments
    blocks: Int[Array, " 4"]
    edge_start: Int[Array, " cell_plus_1"]
    lane_start: Int[Array, " cell_plus_1"]
    overflow: dict[str, int]


def arrange(
    segments: Segments, path: Float[Array, "step 2"], margin_m: float, capacity: Capacity
) -> GridSegments:
    """Sort segments into the grid; drop those that do not fit the square, the table or the runs of a query.

    Those farthest from ``path``, the log of the ego, are dropped first. Segments outside both the square and the box of
    ``path`` widened by ``margin_m``, where lanes of routes may lead, are not counted.

    Raises:
        DataError: A road edge near ``path`` does not fit.
    """
    middle = segments.middle
    grid = Grid.around(middle, path, capacity)
    distance = path_distance(middle, path)
    keep = grid.contains(middle)
    in_scope = keep | inside_box(middle, path, margin_m)
    if keep.sum() > capacity.segments:
        inside = np.flatnonzero(keep)
        keep[inside[np.argsort(distance[inside], kind="stable")[capacity.segments :]]] = False
    overflow = Counter(segments=int((in_scope & ~keep).sum()))
    block = segments.block
    for name, number in (("edge_run", EDGE_BLOCK), ("lane_run", LANE_BLOCK)):
        rows = np.flatnonzero(keep & (block == number))
        drop = rows[grid.excess_entries(grid.cell(middle[rows]), distance[rows], getattr(capacity, name))]
        keep[drop] = False
        overflow[name] = len(drop)
    lost = ~keep & (block == EDGE_BLOCK) & (distance < UNSAFE_M)
    if count := int(lost.sum()):
        problem = (
            f"{count} road-edge segments within {UNSAFE_M:.0f} m of the ego's log "
            f"do not fit capacity {capacity.name!r}"
        )
        cure = "convert with a larger capacity"
        if not grid.contains(middle[lost]).all():
            cure = f"shorten --future-s: the log leaves the map's square of {grid.side * grid.cell_m:.0f} m"
        raise DataError(problem, cure=cure)
    rows = np.flatnonzero(keep)
    cell = grid.cell(middle[rows])
    order = np.lexsort((np.where(block[rows] == REST_BLOCK, 0, cell), block[rows]))
    rows, cell = rows[order], cell[order]
    ends = np.searchsorted(block[rows], [0, 1, 2, 3])
    return GridSegments(
        grid=grid,
        segments=segments.take(rows),
        blocks=ends,
        edge_start=grid.starts(cell[: ends[1]], 0),
        lane_start=grid.starts(cell[ends[1] : ends[2]], int(ends[1])),
        overflow=+overflow,
    )


def ringed_cells(
    grid: Grid, edges: Segments, closed: Bool[Array, " edge"], path: Float[Array, "step 2"], margin_m: float
) -> Bool[Array, " cell"]:
    """Mask of the cells where closed rings of edges separate road from the rest, however far the next edge is.

    These are all cells if each edge of the source is part of a closed ring (``closed``). If this holds only for the
    edges in the box of ``path`` widened by the margin, they are the cells in this box. Otherwise there are none.
    """
    in_box = inside_box(edges.middle, path, margin_m)
    if not len(in_box) or closed.all():
        return np.full(grid.side**2, len(in_box) > 0)
    return inside_box(grid.centres, path, margin_m) & (in_box.any() and closed[in_box].all())


def cell_sides(
    grid: Grid, edges: Segments, lanes: Float[Array, "point 2"], closed: Bool[Array, " edge"],
    ringed: Bool[Array, " cell"],
) -> Int32[Array, " cell"]:  # fmt: skip
    """Sides of the 3 x 3 side cells of every grid cell, packed by :func:`pack_sides`.

    The nearest of ``edges`` (all of the source, also those outside the crop) within 20 m decides: its left is drivable;
    beyond the end of an open edge the side is unknown. It is also unknown if a lane centre (``lanes``) lies in a side
    cell off the road, more than 3 m from the edge. In ``ringed`` cells (:func:`ringed_cells`) far from all edges the
    rings decide instead.
    """
    side_grid = Grid(grid.origin, grid.cell_m / SPLIT, grid.side * SPLIT)
    if not len(edges):
        return np.zeros(grid.side**2, dtype=np.int32)
    reach = _REACH_M + grid.cell_m
    middle = (edges.a[:, :2] + edges.b[:, :2]) / 2 - grid.origin
    in_reach = np.all((middle >= -reach) & (middle <= grid.side * grid.cell_m + reach), axis=1)
    side, distance = np.zeros(side_grid.side**2, int), np.full(side_grid.side**2, np.inf)
    if in_reach.any():
        side, distance = _nearest_sides(side_grid, edges.take(in_reach))
    lane_cells = side_grid.cell(lanes[side_grid.contains(lanes)])
    contradicted = lane_cells[(side[lane_cells] < 0) & (distance[lane_cells] > CUTOFF_M)]
    side[contradicted] = 0
    if ringed.any():
        square = _sides_within_rings(grid, edges, closed, ringed).reshape(grid.side, grid.side)
        ring_side = square.repeat(SPLIT, axis=0).repeat(SPLIT, axis=1).ravel()
        side = np.where(ring_side != 0, ring_side, side)
    return pack_sides(side.reshape(side_grid.side, side_grid.side))


def pack_sides(side: Int[Array, "row column"]) -> Int32[Array, " cell"]:
    """Pack the sides (1 drivable, -1 not, 0 unknown) of each grid cell's 3 x 3 side cells into one integer.

    Each side takes two bits, row by row from the lowest bits: 0 unknown, 1 drivable, 2 not drivable.
    """
    count = len(side) // SPLIT
    blocks = side.reshape(count, SPLIT, count, SPLIT).swapaxes(1, 2).reshape(count * count, SPLIT * SPLIT)
    codes = np.where(blocks < 0, NOT_DRIVABLE, blocks).astype(np.int32)
    return np.bitwise_or.reduce(codes << np.arange(0, 2 * SPLIT * SPLIT, 2, dtype=np.int32), axis=1)


def _nearest_sides(side_grid: Grid, edges: Segments) -> tuple[Int[Array, " cell"], Float[Array, " cell"]]:
    """Side of the nearest edge at every cell centre (0: out of reach, or beyond its open end), and its distance."""
    width, reach = side_grid.cell_m, int(np.ceil(_REACH_M / side_grid.cell_m))
    a, b = edges.a[:, :2] - side_grid.origin, edges.b[:, :2] - side_grid.origin
    base = np.floor((a + b) / (2 * width)).astype(np.int64)
    low, (columns, rows) = base.min(axis=0) - reach, (np.ptp(base, axis=0) + 2 * reach + 1).tolist()
    segment, near_cell, nearest = _nearest_pairs(a, b, base, low, (rows, columns), width)
    (begin_x, begin_y), (u_x, u_y) = a.take(segment, axis=0).T, (b - a).take(segment, axis=0).T
    w_x = (near_cell % columns + low[0] + 0.5) * width - begin_x
    w_y = (near_cell // columns + low[1] + 0.5) * width - begin_y
    length = np.maximum(np.hypot(u_x, u_y), 1e-6)
    along = (u_x * w_x + u_y * w_y) / length**2
    left = (u_x * w_y - u_y * w_x) / length
    begins, ends = _open_ends(a, b)
    past_end = (begins[segment] & (along <= 0.0)) | (ends[segment] & (along >= 1.0))
    # At a vertex the segment whose line is further away decides.
    (most_left, least_left), unknown = np.zeros((2, len(nearest))), np.zeros(len(nearest), dtype=bool)
    np.maximum.at(most_left, near_cell, left)
    np.minimum.at(least_left, near_cell, left)
    unknown[near_cell[past_end]] = True
    sign, distance = np.where(most_left >= -least_left, 1, -1), np.sqrt(nearest)
    sides = np.where(unknown | (distance > _REACH_M), 0, sign)
    shape, square = (rows, columns), (side_grid.side, side_grid.side)
    sides = _crop(sides, shape, low, np.zeros(square, int))
    return sides, _crop(distance, shape, low, np.full(square, np.inf))


def _nearest_pairs(
    a: Float[Array, "segment 2"], b: Float[Array, "segment 2"], base: Int[Array, "segment 2"],
    low: Int[Array, "2"], shape: tuple[int, int], width: float,
) -> tuple[Int[Array, " pair"], Int[Array, " pair"], Float[Array, " cell"]]:  # fmt: skip
    """Pairs of a segment and a cell to whose centre no other segment is nearer, and the squared distance of each cell.

    ``base`` is the column and row of each segment's midpoint, ``low`` the first column and row.
    """
    steps = np.arange(-int(np.ceil(_REACH_M / width)), int(np.ceil(_REACH_M / width)) + 1)
    index, window = (base - low) @ np.array([1, shape[1]]), (shape[1] * steps[:, None] + steps).ravel()
    nearest, pairs = np.full(shape[0] * shape[1], np.inf), []
    # Blocks keep the tables in the processor's cache.
    for first in range(0, len(a), _BLOCK):
        block = slice(first, first + _BLOCK)
        cell = index[block, None] + window
        x, y = (((base[block, axis, None] + steps) + 0.5) * width for axis in (0, 1))
        squared = _squared_distances(x, y, a[block], b[block]).reshape(cell.shape)
        nearer = (squared < nearest.take(cell)).ravel().nonzero()[0]
        np.minimum.at(nearest, cell.take(nearer), squared.take(nearer))
        near = (squared <= _tie_limit(nearest.take(cell))).ravel().nonzero()[0]
        pairs.append((near // len(window) + first, cell.take(near), squared.take(near)))
    segment, cell, squared = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    # All segments that are nearest up to rounding: at a vertex there are two.
    keep = squared <= _tie_limit(nearest[cell])
    return segment[keep], cell[keep], nearest


def _tie_limit(squared: Array) -> Array:
    """Squared distances up to which segments are equally near."""
    return squared * (1 + 1e-6) + 1e-6


def _crop(values: Array, shape: tuple[int, int], low: Int[Array, "2"], square: Array) -> Array:
    """Copy the cells of a rectangle, whose first column and row are ``low``, into a square; return it flat."""
    (x, y), (first_x, first_y) = np.maximum(low, 0), np.maximum(-low, 0)
    target = square[y:, x:]
    source = values.reshape(shape)[first_y : first_y + len(target), first_x : first_x + target.shape[1]]
    target[: len(source), : source.shape[1]] = source
    return square.ravel()


def _squared_distances(
    x: Float[Array, "segment column"], y: Float[Array, "segment row"], a: Float[Array, "segment 2"],
    b: Float[Array, "segment 2"],
) -> Float[Array, "segment row column"]:  # fmt: skip
    """Squared distances from each segment to a grid of points."""
    u = b - a
    share = u / np.maximum((u * u).sum(axis=1), 1e-12)[:, None]
    x, y = (x - a[:, :1])[:, None], (y - a[:, 1:])[..., None]
    along = x * share[:, 0, None, None] + y * share[:, 1, None, None]
    np.minimum(np.maximum(along, 0.0, out=along), 1.0, out=along)
    squared = x - along * u[:, 0, None, None]
    squared *= squared
    along *= u[:, 1, None, None]
    np.subtract(y, along, out=along)
    along *= along
    squared += along
    return squared


def _open_ends(a: Float[Array, "segment 2"], b: Float[Array, "segment 2"]) -> tuple[Array, Array]:
    """Masks of segments that begin at an open end, and that end at one."""
    ends = (np.round(end / _VERTEX_M).astype(np.int64) for end in (a, b))
    # One integer per vertex.
    first, last = ((end[:, 0] * 2**32 + end[:, 1]).tolist() for end in ends)
    # Sets are several times as fast as np.isin.
    firsts, lasts = set(first), set(last)
    return np.array([vertex not in lasts for vertex in first]), np.array([v not in firsts for v in last])


def _sides_within_rings(
    grid: Grid, edges: Segments, closed: Bool[Array, " edge"], ringed: Bool[Array, " cell"]
) -> Int8[Array, " cell"]:
    """Sides of ringed cells far from every edge: 1 drivable, -1 not, 0 unknown.

    No edge crosses a cell whose 3 x 3 block holds none, so the whole cell lies on one side. Rings have the drivable
    side on their left (outer rings counter-clockwise, islands clockwise), so winding numbers are one lower off the road
    than on it. Crossings of the line through the cell centres of a row are counted from the right (Sunday, 2001).
    """
    side = np.zeros(grid.side**2, dtype=np.int8)
    rings = edges.take(closed)
    winding = _winding_at_centres(grid, rings).ravel()
    low, high = winding[ringed].min(), winding[ringed].max()
    if low < 0 < high:
        return side  # Rings contradict each other.
    drivable = winding > 0 if high > 0 else winding == 0
    vertices = np.concatenate((rings.a[:, :2], rings.b[:, :2]))
    in_box = (grid.centres >= vertices.min(axis=0)) & (grid.centres <= vertices.max(axis=0))
    has_side = ringed & in_box.all(axis=1) & ~_near_edge(grid, edges).ravel()
    side[has_side] = np.where(drivable[has_side], 1, -1)
    return side


def _winding_at_centres(grid: Grid, edges: Segments) -> Int[Array, "row column"]:
    """Winding number of the edges around the centre of every cell."""
    scaled_a = (edges.a[:, :2] - grid.origin) / grid.cell_m - 0.5
    scaled_b = (edges.b[:, :2] - grid.origin) / grid.cell_m - 0.5
    row_a, row_b = np.floor(scaled_a[:, 1]), np.floor(scaled_b[:, 1])
    crossing = np.flatnonzero(row_a != row_b)  # A segment crosses at most one row line.
    line = np.maximum(row_a, row_b)[crossing]
    a, b = scaled_a[crossing], scaled_b[crossing]
    x = a[:, 0] + (line - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    up = np.where(row_b[crossing] > row_a[crossing], 1, -1)
    last = np.clip(np.ceil(x) - 1, -1, grid.side - 1).astype(np.int64)  # last column left of the crossing
    inside = (line >= 0) & (line < grid.side) & (last >= 0)
    table = np.zeros((grid.side, grid.side), dtype=np.int64)
    np.add.at(table, (line[inside].astype(np.int64), last[inside]), up[inside])
    return np.cumsum(table[:, ::-1], axis=1)[:, ::-1]


def _near_edge(grid: Grid, edges: Segments) -> Bool[Array, "row column"]:
    """Mask of cells whose 3 x 3 block holds the midpoint of an edge segment."""
    size = grid.side
    cell = grid.column_row(edges.middle) + 1
    padded = np.zeros((size + 2, size + 2), dtype=bool)
    column, row = cell[np.all((cell >= 0) & (cell < size + 2), axis=1)].T
    padded[row, column] = True
    shifts = [padded[dy : dy + size, dx : dx + size] for dy in range(3) for dx in range(3)]
    return np.logical_or.reduce(shifts)
