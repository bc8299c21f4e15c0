"""The uniform grid over a scenario's map: which segments lie near a place, without a search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from drivax.errors import DataError
from drivax.scenario.build.segments import Segments, path_distance
from drivax.scenario.schema import Capacity

Array = np.ndarray[Any, Any]

EDGE_BLOCK, LANE_BLOCK, REST_BLOCK = 0, 1, 2
#: Missing an edge this near to the logged ego would make off-road tests wrong: the scenario is refused.
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
        """The grid centred on these points, or on the ego's log where they do not fit into the square."""
        size = capacity.grid * capacity.cell_m
        points = xy if len(xy) and np.all(np.ptp(xy, axis=0) < size) else path
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        origin = (centre - size / 2).astype(np.float32).astype(np.float64)
        return cls(origin, capacity.cell_m, capacity.grid)

    def column_row(self, xy: Float[Array, "point 2"]) -> Int[Array, "point 2"]:
        """Column and row of the cell of each point; may lie outside the square."""
        return np.floor((xy - self.origin) / self.cell_m).astype(np.int64)

    def contains(self, xy: Float[Array, "point 2"]) -> Bool[Array, " point"]:
        """Whether points lie in the square."""
        cell = self.column_row(xy)
        return np.all((cell >= 0) & (cell < self.side), axis=1)

    def cell(self, xy: Float[Array, "point 2"]) -> Int[Array, " point"]:
        """Row-major cell index of points inside the square."""
        cell = self.column_row(xy)
        return cell[:, 1] * self.side + cell[:, 0]

    def runs(self, counts: Int[Array, " cell"]) -> Int[Array, "row column"]:
        """Number of entries in the run of three neighbouring cells of a row, centred on each cell."""
        table = np.pad(counts.reshape(self.side, self.side), ((0, 0), (1, 1)))
        return table[:, :-2] + table[:, 1:-1] + table[:, 2:]

    def crowded(self, cell: Int[Array, " entry"], far: Float[Array, " entry"], cap: int) -> Array:
        """Entries to drop so that no run of three cells is longer than ``cap``: the farthest of crowded runs.

        Args:
            cell: Cell index of every entry.
            far: Distance of every entry from the ego's log, metres.
            cap: Longest run.
        """
        dropped = np.zeros(len(cell), dtype=bool)
        while True:
            counts = np.bincount(cell[~dropped], minlength=self.side**2)
            runs = self.runs(counts)
            row, column = np.unravel_index(runs.argmax(), runs.shape)
            excess = runs[row, column] - cap
            if excess <= 0:
                return np.flatnonzero(dropped)
            near = np.abs(cell % self.side - column) <= 1
            members = np.flatnonzero(~dropped & (cell // self.side == row) & near)
            dropped[members[np.argsort(far[members], kind="stable")[-excess:]]] = True

    def starts(self, cell: Int[Array, " entry"], offset: int) -> Int[Array, " cell_plus_1"]:
        """CSR row starts of entries sorted by cell, ``offset`` added."""
        counts = np.bincount(cell, minlength=self.side**2)
        return np.concatenate(([0], np.cumsum(counts))) + offset


@dataclass(frozen=True)
class GridSegments:
    """Segments in storage order with their grid.

    Attributes:
        segments: Sorted: edges by cell, car lanes by cell, the rest in order of the source.
        blocks: 0, end of the edges, end of the lanes, end of the rest.
        edge_start: CSR starts of the edges, absolute segment indices.
        lane_start: CSR starts of the car lanes, absolute segment indices.
        overflow: What did not fit, by name.
    """

    grid: Grid
    segments: Segments
    blocks: Int[Array, " 4"]
    edge_start: Int[Array, " cell_plus_1"]
    lane_start: Int[Array, " cell_plus_1"]
    overflow: dict[str, int]


def arrange(segments: Segments, path: Float[Array, "step 2"], capacity: Capacity) -> GridSegments:
    """Sorts segments into the grid and drops what fits neither the square, the table nor a query's runs.

    Args:
        segments: The segments of the cropped map.
        path: A few points along the ego's log; what is farthest from it is dropped first.
        capacity: Padded sizes.

    Raises:
        DataError: Road edges near the ego's log would have to be dropped.
    """
    middle = segments.middle
    grid = Grid.around(middle, path, capacity)
    far = path_distance(middle, path)
    keep = grid.contains(middle)
    if keep.sum() > capacity.segments:
        inside = np.flatnonzero(keep)
        keep[inside[np.argsort(far[inside], kind="stable")[capacity.segments :]]] = False
    overflow = {"segments": int((~keep).sum())}
    block = segments.block
    for name, number, cap in (
        ("edge_run", EDGE_BLOCK, capacity.edge_run),
        ("lane_run", LANE_BLOCK, capacity.lane_run),
    ):
        rows = np.flatnonzero(keep & (block == number))
        drop = rows[grid.crowded(grid.cell(middle[rows]), far[rows], cap)]
        keep[drop] = False
        overflow[name] = len(drop)
    _refuse_unsafe(~keep & (block == EDGE_BLOCK), far, capacity)
    rows = np.flatnonzero(keep)
    cell = grid.cell(middle[rows])
    sort_key = block[rows] * grid.side**2 + np.where(block[rows] == REST_BLOCK, 0, cell)
    order = np.argsort(sort_key, kind="stable")
    rows, cell = rows[order], cell[order]
    ends = np.searchsorted(block[rows], [0, 1, 2, 3])
    return GridSegments(
        grid=grid,
        segments=segments.take(rows),
        blocks=ends,
        edge_start=grid.starts(cell[: ends[1]], 0),
        lane_start=grid.starts(cell[ends[1] : ends[2]], int(ends[1])),
        overflow={name: count for name, count in overflow.items() if count},
    )


def _refuse_unsafe(
    dropped: Bool[Array, " segment"], far: Float[Array, " segment"], capacity: Capacity
) -> None:
    """Raises where an edge next to the ego's log did not fit."""
    lost = int((dropped & (far < UNSAFE_M)).sum())
    if lost:
        raise DataError(
            f"{lost} road-edge segments within {UNSAFE_M:.0f} m of the ego's log do not fit capacity"
            f" {capacity.name!r}",
            cure="convert with a larger capacity",
        )
