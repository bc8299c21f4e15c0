"""Arrays of the paths of several worlds, with which a traffic step is a few operations over all vehicles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int64

from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.paths import SLOTS, Path
from drivax.synthetic.traffic.roles import Drivers

#: A number, a flag and an index per vehicle.
PerVehicle = Float64[np.ndarray, " v"]
VehicleMask = Bool[np.ndarray, " v"]
VehicleRows = Int64[np.ndarray, " v"]
#: Vehicles of a look-up.
Rows = slice | VehicleRows
ALL_ROWS = slice(None)
#: Initial columns for crossings, spare columns for connectors, and initial capacity over the number of samples.
_CROSSING_COLUMNS, _SPARE_COLUMNS, _CAPACITY = 4, 4, 1.3


def speed_profile(
    path: Path, factor: float, lateral_mps2: float, slowing_mps2: float, top_mps: float = np.inf
) -> Float64[np.ndarray, " p"]:
    """Highest speed at each sample that respects limits and bends, and brakes in time for those ahead.

    ``v(s)^2 = min over s' >= s of (vmax(s')^2 + 2 b (s' - s))`` with
    ``vmax = min(factor x limit, sqrt(a_lat / |k|), top)``.
    """
    cap = np.minimum((factor * path.limit_mps) ** 2, lateral_mps2 / np.maximum(np.abs(path.curvature), 1e-6))
    cap = np.minimum(cap, top_mps**2)
    ramp = 2 * slowing_mps2 * path.step_m * np.arange(len(cap))
    return np.sqrt(np.minimum.accumulate((cap + ramp)[::-1])[::-1] - ramp)


def driver_profile(path: Path, drivers: Drivers, row: int) -> Float64[np.ndarray, " p"]:
    """Speed profile of one of the drivers."""
    names = ("speed_factor", "lateral_mps2", "slowing_mps2", "top_speed_mps")
    limits = tuple(float(getattr(drivers, name)[row]) for name in names)
    if limits not in path.profiles:
        path.profiles[limits] = speed_profile(path, *limits)
    return path.profiles[limits]


def group_indices(group: Int64[np.ndarray, " item"], groups: int) -> Int64[np.ndarray, "group most"]:
    """Indices of the items of each group in order, padded with -1."""
    size = np.bincount(group, minlength=groups)
    table = np.full((groups, size.max(initial=0)), -1)
    table[np.arange(table.shape[1]) < size[:, None]] = np.argsort(group, kind="stable")
    return table


def pad_last(values: np.ndarray, missing: float) -> np.ndarray:
    """Append a value to the last axis, which index -1 (missing) then selects."""
    return np.concatenate((values, np.full((*values.shape[:-1], 1), missing, values.dtype)), axis=-1)


def pad_steps(series: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Pad series to the length of the longest one by repeating their last step."""
    steps = max(map(len, series))
    return [values.take(np.minimum(np.arange(steps), len(values) - 1), axis=0) for values in series]


class Worlds:
    """Worlds that are simulated together: the vehicles of each are successive rows, its lanes successive indices.

    Attributes:
        networks: The roads of each world.
        first_row, first_lane, first_crossing: First row, lane and crossing of each world, with the total appended.
        world: World of each row.
        rows: Rows of each world, padded with -1.
    """

    def __init__(self, networks: Sequence[RoadNetwork], vehicles: Sequence[int]) -> None:
        self.networks = tuple(networks)
        lanes, crossings = [len(n.lanes) for n in networks], [len(n.crossings) for n in networks]
        self.first_row, self.first_lane, self.first_crossing = (
            np.concatenate(([0], np.cumsum(count))) for count in (vehicles, lanes, crossings)
        )
        self.world = np.repeat(np.arange(len(vehicles)), vehicles)
        self.rows = group_indices(self.world, len(vehicles))

    def __len__(self) -> int:
        return len(self.networks)

    def vehicles(self, world: int) -> slice:
        """Rows of the vehicles of a world."""
        return slice(int(self.first_row[world]), int(self.first_row[world + 1]))

    def mask(self, worlds: Int64[np.ndarray, " item"]) -> Bool[np.ndarray, " world"]:
        """Mask of the worlds that occur in an array of indices."""
        return np.bincount(worlds, minlength=len(self)) > 0


class PathTables:
    """Lookup tables of all paths, one row per vehicle; a row is replaced when its vehicle takes another path.

    Indices of lanes and crossings run through all worlds. Samples of new paths are appended to the others.

    Attributes:
        worlds: The worlds of the vehicles.
        table: x, y, heading and highest speed at each sample.
        step_m, last, length_m: Distance between samples, index of the last one, and its position.
        lane, lane_m: Lanes occupied at each sample (-1: none), and positions on them.
        begin, scale, from_m, until_m: Fields of the span of each lane of the vehicle's world (``begin`` is nan without
            one).
        column: Offset from a lane to its index in these arrays, flattened.
        connector, connector_begin, connector_end: Connectors in order of travel (-1: none), and path positions.
        crossing, crossing_m: Marked crossings in order of travel (-1: none), and positions of their near side.
        crossings: Largest number of marked crossings on a path of each world, at least 4.
        stop_m: End of the last lane if the road continues without it, m (else infinite).
    """

    def __init__(self, worlds: Worlds, paths: Sequence[Path], drivers: Drivers) -> None:
        self.worlds, self.paths, self._drivers = worlds, list(paths), drivers
        count, lanes = len(paths), int(np.diff(worlds.first_lane).max())
        self.crossings = np.full(len(worlds), _CROSSING_COLUMNS)
        self._first, self._sample_count = np.zeros(count, int), 0
        samples = int(_CAPACITY * sum(len(path.curve.xy) for path in paths))
        self.table, self.lane_m = np.empty((samples, 4)), np.empty((samples, SLOTS))
        self.lane = np.empty((samples, SLOTS), np.int32)
        self.step_m, self.last, self.length_m = np.ones(count), np.ones(count, int), np.ones(count)
        self.begin, self.scale = np.full((count, lanes), np.nan), np.ones((count, lanes))
        self.from_m, self.until_m = np.full((count, lanes), -np.inf), np.full((count, lanes), np.inf)
        self._present, self._is_limited = self.begin.copy(), np.zeros(count, bool)
        self.column = lanes * np.arange(count) - worlds.first_lane[worlds.world]
        self.connector, self.crossing = np.full((count, 0), -1), np.full((count, _CROSSING_COLUMNS), -1)
        self.connector_begin, self.connector_end = np.zeros((2, count, 0))
        self.crossing_m = np.full((count, _CROSSING_COLUMNS), np.inf)
        self.stop_m = np.full(count, np.inf)
        for row, path in enumerate(paths):
            self.replace(row, path)

    def replace(self, row: int, path: Path) -> None:
        """Replace the path of one vehicle."""
        self.paths[row] = path
        n, world = len(path.curve.xy), self.worlds.world[row]
        self._grow(self._sample_count + n)
        samples = slice(self._sample_count, self._sample_count + n)
        self._first[row], self._sample_count = self._sample_count, self._sample_count + n
        self.table[samples, :2], self.table[samples, 2] = path.curve.xy, path.curve.heading
        self.table[samples, 3] = driver_profile(path, self._drivers, row)
        self.lane[samples] = np.where(path.lane >= 0, path.lane + int(self.worlds.first_lane[world]), -1)
        self.lane_m[samples] = path.lane_m
        self.step_m[row], self.last[row], self.length_m[row] = path.step_m, n - 1, path.length_m
        self.begin[row], self.scale[row] = np.nan, 1.0
        self.from_m[row], self.until_m[row] = -np.inf, np.inf
        self._enter_lanes(row, path)
        final = max(path.spans, key=lambda span: span.end_m if span.until_m == np.inf else -1.0)
        lane = self.worlds.networks[world].lanes[final.lane]
        self.stop_m[row] = path.length_m if lane.ends else np.inf

    def _enter_lanes(self, row: int, path: Path) -> None:
        """Enter the spans of a path, its connectors and its marked crossings."""
        connectors, crossings, world = [], [], self.worlds.world[row]
        network = self.worlds.networks[world]
        for span in path.spans:
            lane = span.lane
            self.begin[row, lane], self.scale[row, lane] = span.begin_m, span.scale
            self.from_m[row, lane], self.until_m[row, lane] = span.from_m, span.until_m
            if network.lanes[lane].connector and span.until_m == np.inf:
                connectors.append((span.begin_m, span.end_m, lane + self.worlds.first_lane[world]))
            for number, along in network.marked_crossings.get(lane, ()):
                crossings.append(
                    (span.begin_m + span.scale * along, number + self.worlds.first_crossing[world])
                )
        self._present[row] = self.begin[row]
        self._is_limited[row] = any(span.from_m > -np.inf or span.until_m < np.inf for span in path.spans)
        self.crossings[world] = max(self.crossings[world], len(crossings))
        if len(connectors) >= self.connector.shape[1]:
            self._widen("connector", len(connectors) + _SPARE_COLUMNS, "_begin", "_end")
        self._widen("crossing", len(crossings), "_m")
        self.connector[row], self.connector_begin[row], self.connector_end[row] = -1, np.inf, np.inf
        for k, (begin, end, lane) in enumerate(sorted(connectors)):
            self.connector[row, k] = lane
            self.connector_begin[row, k], self.connector_end[row, k] = begin, end
        self.crossing[row], self.crossing_m[row] = -1, np.inf
        for k, (position, number) in enumerate(sorted(crossings)):
            self.crossing_m[row, k], self.crossing[row, k] = position, number

    def _widen(self, name: str, columns: int, *suffixes: str) -> None:
        """Widen the array ``name`` of indices, and its arrays of positions, to a number of columns."""
        extra = columns - getattr(self, name).shape[1]
        if extra > 0:
            for suffix in ("", *suffixes):
                fill = np.inf if suffix else -1
                array = np.pad(getattr(self, name + suffix), ((0, 0), (0, extra)), constant_values=fill)
                setattr(self, name + suffix, array)

    def _grow(self, samples: int) -> None:
        """Grow the tables of samples to a length, with a reserve."""
        extra = samples - len(self.table)
        if extra > 0:
            pad = ((0, extra + samples // 4), (0, 0))
            self.table, self.lane, self.lane_m = (
                np.pad(values, pad) for values in (self.table, self.lane, self.lane_m)
            )

    def present_begin(self, at_m: PerVehicle) -> Float64[np.ndarray, "v lane"]:
        """``begin`` of the spans that vehicles occupy at their positions, nan elsewhere."""
        rows = self._is_limited.nonzero()[0]
        position = at_m[rows, None]
        is_occupied = (self.from_m[rows] <= position) & (position <= self.until_m[rows])
        self._present[rows] = np.where(is_occupied, self.begin[rows], np.nan)
        return self._present

    def interpolate(
        self, position_m: Float64[np.ndarray, "*look v"], rows: Rows = ALL_ROWS
    ) -> Float64[np.ndarray, "*look v 4"]:
        """Interpolate x, y, heading and highest speed at positions on the paths of all or some vehicles."""
        sample = position_m / self.step_m[rows]
        index = np.minimum(np.maximum(sample.astype(int), 0), self.last[rows] - 1)
        share = np.minimum(np.maximum(sample - index, 0.0), 1.0)[..., None]
        index += self._first[rows]
        low, result = self.table.take(index, axis=0), self.table.take(index + 1, axis=0)
        result -= low
        result *= share
        result += low
        return result

    def lanes_at(
        self, position_m: PerVehicle, rows: Rows = ALL_ROWS
    ) -> tuple[Int64[np.ndarray, "v slot"], Float64[np.ndarray, "v slot"]]:
        """Lanes occupied at positions on the paths of all or some vehicles (-1: none), and positions on them, m."""
        step = self.step_m[rows]
        index = np.minimum(np.maximum(np.rint(position_m / step).astype(int), 0), self.last[rows])
        excess, index = position_m - index * step, index + self._first[rows]
        along = self.lane_m.take(index, axis=0)
        along += excess[:, None]
        return self.lane.take(index, axis=0).astype(int), along

    def samples_ahead(
        self, at_m: PerVehicle, rows: Int64[np.ndarray, " k"], distance_m: Float64[np.ndarray, " look"]
    ) -> tuple[Float64[np.ndarray, "k look 4"], Int64[np.ndarray, "k look"]]:
        """Samples of the paths nearest to distances ahead of some vehicles, at most the last one, and their indices."""
        index = np.rint((at_m[rows, None] + distance_m) / self.step_m[rows, None]).astype(int)
        index = np.minimum(index, self.last[rows, None])
        return self.table.take(index + self._first[rows, None], axis=0), index
