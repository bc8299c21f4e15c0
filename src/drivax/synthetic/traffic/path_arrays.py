"""All paths as arrays of one shape, so that a traffic step is a few operations over all vehicles."""

from __future__ import annotations

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


def speed_profile(
    path: Path, factor: float, lateral_mps2: float, slowing_mps2: float, top_mps: float = np.inf
) -> Float64[np.ndarray, " p"]:
    """Fastest speed at each sample within limits, in bends, and braking towards both.

    ``v(s)^2 = min over s' >= s of (vmax(s')^2 + 2 b (s' - s))`` with ``vmax = min(factor x limit, sqrt(a_lat / |k|))``.
    """
    cap = np.minimum((factor * path.limit_mps) ** 2, lateral_mps2 / np.maximum(np.abs(path.curvature), 1e-6))
    cap = np.minimum(cap, top_mps**2)
    ramp = 2 * slowing_mps2 * path.step_m * np.arange(len(cap))
    return np.sqrt(np.minimum.accumulate((cap + ramp)[::-1])[::-1] - ramp)


def driver_profile(path: Path, drivers: Drivers, row: int) -> Float64[np.ndarray, " p"]:
    """Speed profile of one of the drivers."""
    names = ("speed_factor", "lateral_mps2", "slowing_mps2", "top_speed_mps")
    return speed_profile(path, *(float(getattr(drivers, name)[row]) for name in names))


class PathTables:
    """Lookup tables of all paths, one row per vehicle; a row is replaced when its vehicle changes to another path.

    Attributes:
        table: x, y, heading and fastest speed at each sample.
        step_m, last, length_m: Distance between samples, index of the last one, and its position.
        lane, lane_m: Lanes occupied at each sample (-1: none), and positions on them.
        begin, scale, since, until: Per lane of the network the fields of its span (``begin`` is nan without a span).
        connector, connector_begin, connector_end: Connectors in order of travel (-1: none), and path positions.
        crossing, crossing_m: Marked crossings in order of travel (-1: none), and positions of their near side.
        stop_m: End of the last lane if the road continues without it, m (else infinite).
    """

    def __init__(self, network: RoadNetwork, paths: list[Path], drivers: Drivers) -> None:
        self._network, self._drivers = network, drivers
        self.paths = list(paths)
        count, lanes = len(paths), len(network.lanes)
        self._crossings: dict[int, list[tuple[int, float]]] = {}
        for number, crossing in enumerate(network.crossings):
            for lane, along in crossing.lanes if crossing.marked else ():
                self._crossings.setdefault(lane, []).append((number, along - crossing.width_m / 2))
        # Later paths may be longer.
        points = int(1.5 * max(len(path.curve.xy) for path in paths))
        connectors = 4 + max(sum(network.lanes[s.lane].connector for s in path.spans) for path in paths)
        self.table = np.zeros((count, points, 4))
        self.lane = np.full((count, points, SLOTS), -1)
        self.lane_m = np.zeros((count, points, SLOTS))
        self.step_m, self.last, self.length_m = np.ones(count), np.ones(count, int), np.ones(count)
        self._rows = np.arange(count)
        self.begin, self.scale = np.full((count, lanes), np.nan), np.ones((count, lanes))
        self.since, self.until = np.full((count, lanes), -np.inf), np.full((count, lanes), np.inf)
        self.connector = np.full((count, connectors), -1)
        self.connector_begin, self.connector_end = np.full((2, count, connectors), np.inf)
        self.crossing = np.full((count, 4), -1)
        self.crossing_m = np.full((count, 4), np.inf)
        self.stop_m = np.full(count, np.inf)
        for row, path in enumerate(paths):
            self.replace(row, path)

    def replace(self, row: int, path: Path) -> None:
        """Enter the path of one vehicle."""
        self.paths[row] = path
        n = len(path.curve.xy)
        self._grow(n)
        self.table[row, :n, :2], self.table[row, :n, 2] = path.curve.xy, path.curve.heading
        self.table[row, :n, 3] = driver_profile(path, self._drivers, row)
        self.table[row, n:] = self.table[row, n - 1]
        self.lane[row, :n], self.lane_m[row, :n] = path.lane, path.lane_m
        self.lane[row, n:] = -1
        self.step_m[row], self.last[row], self.length_m[row] = path.step_m, n - 1, path.length_m
        self.begin[row], self.scale[row] = np.nan, 1.0
        self.since[row], self.until[row] = -np.inf, np.inf
        self.connector[row], self.connector_begin[row], self.connector_end[row] = -1, np.inf, np.inf
        self._enter_lanes(row, path)
        final = max(path.spans, key=lambda span: span.end_m if span.until_m == np.inf else -1.0)
        lane = self._network.lanes[final.lane]
        self.stop_m[row] = path.length_m if lane.ends and not lane.successors else np.inf

    def _enter_lanes(self, row: int, path: Path) -> None:
        connectors, crossings = [], []
        for span in path.spans:
            lane = span.lane
            self.begin[row, lane], self.scale[row, lane] = span.begin_m, span.scale
            self.since[row, lane], self.until[row, lane] = span.from_m, span.until_m
            if self._network.lanes[lane].connector and span.until_m == np.inf:
                connectors.append((span.begin_m, span.end_m, lane))
            for number, along in self._crossings.get(lane, ()):
                crossings.append((span.begin_m + span.scale * along, number))
        for k, (begin, end, lane) in enumerate(sorted(connectors)[: self.connector.shape[1]]):
            self.connector[row, k], self.connector_begin[row, k] = lane, begin
            self.connector_end[row, k] = end
        self.widen(len(crossings))
        self.crossing[row], self.crossing_m[row] = -1, np.inf
        for k, (position, number) in enumerate(sorted(crossings)):
            self.crossing_m[row, k], self.crossing[row, k] = position, number

    def widen(self, crossings: int) -> None:
        """Make room for a number of crossings per path."""
        extra = crossings - self.crossing.shape[1]
        if extra > 0:
            self.crossing = np.pad(self.crossing, ((0, 0), (0, extra)), constant_values=-1)
            self.crossing_m = np.pad(self.crossing_m, ((0, 0), (0, extra)), constant_values=np.inf)

    def _grow(self, points: int) -> None:
        extra = points - self.table.shape[1]
        if extra > 0:
            pad = ((0, 0), (0, extra), (0, 0))
            self.table = np.pad(self.table, pad, mode="edge")
            self.lane = np.pad(self.lane, pad, constant_values=-1)
            self.lane_m = np.pad(self.lane_m, pad)

    def at(
        self, position_m: Float64[np.ndarray, "*look v"], rows: Rows = ALL_ROWS
    ) -> Float64[np.ndarray, "*look v 4"]:
        """x, y, heading and fastest speed at positions on the paths of all or some vehicles."""
        sample = position_m / self.step_m[rows]
        index = np.minimum(np.maximum(sample.astype(int), 0), self.last[rows] - 1)
        share = np.minimum(np.maximum(sample - index, 0.0), 1.0)[..., None]
        index += self._rows[rows] * self.table.shape[1]
        flat = self.table.reshape(-1, 4)
        low, result = flat.take(index, axis=0), flat.take(index + 1, axis=0)
        result -= low
        result *= share
        result += low
        return result

    def on(
        self, position_m: PerVehicle, rows: Rows = ALL_ROWS
    ) -> tuple[Int64[np.ndarray, "v slot"], Float64[np.ndarray, "v slot"]]:
        """Lanes occupied at positions on the paths of all or some vehicles (-1: none), and positions on them, m."""
        step = self.step_m[rows]
        index = np.minimum(np.maximum(np.rint(position_m / step).astype(int), 0), self.last[rows])
        excess, index = position_m - index * step, index + self._rows[rows] * self.lane.shape[1]
        along = self.lane_m.reshape(-1, SLOTS).take(index, axis=0)
        along += excess[:, None]
        return self.lane.reshape(-1, SLOTS).take(index, axis=0), along
