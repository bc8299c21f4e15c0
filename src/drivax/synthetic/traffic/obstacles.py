"""What is ahead of a vehicle: its leader on the lanes of its path, and obstacles in the corridor of its path.

Obstacles are parked cars, pedestrians, and vehicles off their lanes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64

from drivax.synthetic.traffic.path_arrays import (
    PathTables,
    PerVehicle,
    VehicleMask,
    VehicleRows,
    Worlds,
    group_indices,
    pad_last,
)
from drivax.synthetic.traffic.paths import SLOTS, Path
from drivax.synthetic.traffic.roles import Drivers

#: Right part of a lane that a cyclist takes, m: half a bicycle, its distance from the kerb, 1.5 m to a passing car.
_CYCLIST_PASSING_M = 0.35 + 0.55 + 1.5
#: Lateral margin of the corridor for vehicles, which keep to their lanes, and for other users, m.
_VEHICLE_MARGIN_M, _SIDE_MARGIN_M = 0.05, 0.2
#: Largest half extent of another vehicle across a path, m: of a turning one only the middle counts.
_MAX_HALF_WIDTH_M = 1.3
#: Search for moving obstacles: range ahead, spacing of the path's samples, and half width, m.
_RANGE_M, _SAMPLE_M, _MAX_LATERAL_M = 50.0, 2.0, 16.0
#: Range of the search for vehicles ahead, m.
_VEHICLE_RANGE_M = 25.0
#: Users that leave the corridor at least this long before the vehicle arrives are ignored, if it arrives in more than
#: twice this time, s.
_CLEARANCE_S = 0.8
#: Time over which lateral motion is extrapolated, s.
_DRIFT_S = 0.7
#: Boxes per batch, which keeps the table of distances in the processor's cache.
_BATCH_SIZE = 256
#: Distances ahead of a vehicle at which its path is sampled, m.
_SAMPLES_M = np.arange(0.0, _RANGE_M + 6.0, _SAMPLE_M)

#: A number and an index per pair.
_Values = Float64[np.ndarray, " k"]
_Indices = Int64[np.ndarray, " k"]


class LeaderSearch:
    """Search for the leader of every vehicle."""

    def __init__(self, worlds: Worlds, drivers: Drivers) -> None:
        self._worlds = worlds
        self._half_m, self._half_width_m = drivers.size_m[:, :2].T / 2
        self._cyclist, self._any_cyclist = drivers.cyclist, bool(drivers.cyclist.any())
        # Half the width of the widest car in the middle of each lane that may pass a cyclist (below 4.8 m: none may).
        widths = [lane.width_m for network in worlds.networks for lane in network.lanes]
        self._passing_half_m = np.array(widths) / 2 - _CYCLIST_PASSING_M
        self._nearest = np.full(len(worlds.world), np.inf), np.zeros(len(worlds.world), int)

    def find(
        self, tables: PathTables, at_m: PerVehicle, active: VehicleMask
    ) -> tuple[PerVehicle, VehicleRows]:
        """Return the gap to the nearest vehicle ahead on the lanes of the path (infinite: none), and its row.

        A world without a vehicle on a lane keeps its last result.
        """
        world = self._worlds.world
        lane, along = tables.lanes_at(at_m)
        lane[~active] = -1
        # Occupied (vehicle, lane) of each world, padded with -1, and their positions on the path of each vehicle.
        slots = (lane.ravel() >= 0).nonzero()[0]
        if not len(slots):
            return self._nearest
        vehicle, lane = slots // SLOTS, lane.ravel().take(slots)
        entry = group_indices(world[vehicle], len(self._worlds))
        lanes = np.where(entry < 0, self._worlds.first_lane[:-1, None], lane[entry])
        index = lanes.take(world, axis=0)
        index += tables.column[:, None]
        # nan where the lane is not on the path, or not relevant at this position.
        begin = tables.present_begin(at_m).take(index)
        pair = (begin == begin).ravel().nonzero()[0]
        row = pair // entry.shape[1]
        slot = entry.ravel().take(pair - (row - world[row]) * entry.shape[1])
        ahead, own_m = vehicle[slot], at_m[row]
        position = tables.scale.take(index.ravel()[pair]) * along.ravel().take(slots)[slot]
        position += begin.ravel()[pair]
        is_ahead = (position > own_m) & (ahead != row) & (slot >= 0)
        if self._any_cyclist:
            # Cyclists are overtaken within lanes that are wide enough.
            is_ahead &= ~self._cyclist[ahead] | (self._passing_half_m[lane[slot]] < self._half_width_m[row])
        k = is_ahead.nonzero()[0]
        row, ahead = row[k], ahead[k]
        gap_m = position[k] - self._half_m[ahead] - own_m[k] - self._half_m[row]
        gap, leader = np.full(len(world), np.inf), vehicle[entry[:, 0]][world]
        np.minimum.at(gap, row, gap_m)
        # Enter the first of several nearest vehicles last.
        nearest = (gap_m == gap[row]).nonzero()[0][::-1]
        leader[row[nearest]] = ahead[nearest]
        is_empty = (entry[:, 0] < 0)[world]
        if is_empty.any():
            gap[is_empty], leader[is_empty] = (last[is_empty] for last in self._nearest)
        self._nearest = gap, leader
        return self._nearest


@dataclass(frozen=True)
class Boxes:
    """Boxes at one moment: centres, headings, signed speeds along them, lengths and widths."""

    xy: Float64[np.ndarray, "box 2"]
    heading: Float64[np.ndarray, " box"]
    speed: Float64[np.ndarray, " box"]
    size_m: Float64[np.ndarray, "box 2"]

    def __len__(self) -> int:
        return len(self.speed)

    @cached_property
    def direction(self) -> tuple[Float64[np.ndarray, " box"], Float64[np.ndarray, " box"]]:
        """Cosine and sine of the headings."""
        return np.cos(self.heading), np.sin(self.heading)

    def select(self, rows: np.ndarray) -> Boxes:
        """Return the boxes of some rows (indices or a mask)."""
        return Boxes(self.xy[rows], self.heading[rows], self.speed[rows], self.size_m[rows])

    def concatenate(self, other: Boxes) -> Boxes:
        """Append other boxes."""
        if not len(other):
            return self
        names = ("xy", "heading", "speed", "size_m")
        return Boxes(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))


@dataclass(frozen=True)
class Extents:
    """Longitudinal and lateral extent of boxes in the coordinates of a path, m."""

    near_m: Float64[np.ndarray, " box"]
    far_m: Float64[np.ndarray, " box"]
    right_m: Float64[np.ndarray, " box"]
    left_m: Float64[np.ndarray, " box"]


def extents(path: Path, boxes: Boxes, within_m: float = 12.0) -> tuple[Extents, Int64[np.ndarray, " box"]]:
    """Return the extents of the boxes near a path, and their rows, as if the path were straight along each box."""
    coarse = path.curve.xy[::8]
    in_bounds = (boxes.xy > coarse.min(axis=0) - within_m) & (boxes.xy < coarse.max(axis=0) + within_m)
    candidates = np.flatnonzero(in_bounds[:, 0] & in_bounds[:, 1])
    rows, coarse_index = np.zeros(0, int), np.zeros(0, int)
    for first in range(0, len(candidates), _BATCH_SIZE):
        batch = candidates[first : first + _BATCH_SIZE]
        squared_gap = _squared_distance(boxes.xy[batch, None], coarse)
        best = squared_gap.argmin(axis=1)
        is_close = squared_gap[np.arange(len(batch)), best] < within_m**2
        rows, coarse_index = np.append(rows, batch[is_close]), np.append(coarse_index, 8 * best[is_close])
    window = coarse_index[:, None] + np.arange(-8, 9)
    window = np.minimum(np.maximum(window, 0), len(path.curve.xy) - 1)
    fine = _squared_distance(boxes.xy[rows, None], path.curve.xy.take(window, axis=0))
    index = window[np.arange(len(rows)), fine.argmin(axis=1)]
    position, lateral, angle = _relative_poses(boxes, rows, path.curve.xy[index], path.curve.heading[index])
    length, width = _half_extents(boxes.size_m[rows], angle)
    position = position + index * path.step_m
    return Extents(position - length, position + length, lateral - width, lateral + width), rows


def _squared_distance(
    a: Float64[np.ndarray, "*#batch 2"], b: Float64[np.ndarray, "*#batch 2"]
) -> Float64[np.ndarray, "..."]:
    """Squared distances between points."""
    dx, dy = a[..., 0] - b[..., 0], a[..., 1] - b[..., 1]
    dx *= dx
    dy *= dy
    dx += dy
    return dx


def _relative_poses(
    boxes: Boxes, rows: _Indices, xy: Float64[np.ndarray, "k 2"], heading: _Values
) -> tuple[_Values, _Values, _Values]:
    """Return the positions of boxes ahead and to the left of poses, and their relative headings."""
    dx, dy = (boxes.xy.take(rows, axis=0) - xy).T
    cos, sin = np.cos(heading), np.sin(heading)
    return dx * cos + dy * sin, dy * cos - dx * sin, boxes.heading[rows] - heading


def _half_extents(size_m: Float64[np.ndarray, "k 2"], relative_heading: _Values) -> tuple[_Values, _Values]:
    """Return the half extents of boxes along and across a direction."""
    cos, sin = np.abs(np.cos(relative_heading)) / 2, np.abs(np.sin(relative_heading)) / 2
    return cos * size_m[:, 0] + sin * size_m[:, 1], sin * size_m[:, 0] + cos * size_m[:, 1]


NO_EXTENTS = Extents(*np.zeros((4, 0)))


class StaticObstacles:
    """Static obstacles of each world, in the coordinates of every vehicle's path.

    Args:
        worlds: The worlds.
        boxes: Obstacles of each world.
        path_extents: Their extents on the path of each vehicle.
        width_m: Width of each vehicle.
    """

    def __init__(
        self, worlds: Worlds, boxes: Sequence[Boxes], path_extents: Sequence[Extents], width_m: PerVehicle
    ) -> None:
        self.boxes, self._worlds, self._half = tuple(boxes), worlds, width_m / 2
        self.near_m = np.full((len(width_m), 1), np.inf)
        self._extents = list(path_extents)
        for row in np.flatnonzero([len(extents.near_m) > 0 for extents in path_extents]).tolist():
            self._enter(row)

    def replace(self, row: int, path: Path) -> None:
        """Replace the path of one vehicle."""
        boxes = self.boxes[self._worlds.world[row]]
        if len(boxes):
            self._extents[row], _ = extents(path, boxes)
            self._enter(row)

    def _enter(self, row: int) -> None:
        """Enter the near ends of the obstacles in the corridor of a vehicle's path."""
        path_extents, half = self._extents[row], self._half[row] + _SIDE_MARGIN_M
        near_m = np.sort(path_extents.near_m[(path_extents.right_m < half) & (path_extents.left_m > -half)])
        extra = len(near_m) - self.near_m.shape[1]
        if extra > 0:
            self.near_m = np.pad(self.near_m, ((0, 0), (0, extra)), constant_values=np.inf)
        self.near_m[row] = np.inf
        self.near_m[row, : len(near_m)] = near_m

    def is_blocked(self, row: int, front_m: float, half_m: float, within_m: float) -> bool:
        """Return whether an obstacle lies within a distance ahead of a front bumper, in a band of this half width."""
        path_extents = self._extents[row]
        is_blocking = (path_extents.right_m < half_m) & (path_extents.left_m > -half_m)
        is_blocking &= (path_extents.near_m > front_m - 0.5) & (path_extents.near_m < front_m + within_m)
        return bool(is_blocking.any())

    def gap(self, front_m: PerVehicle) -> PerVehicle:
        """Distance from the front bumper to the next obstacle in the corridor, more than -1 m (infinite: none)."""
        gap = self.near_m - front_m[:, None]
        return np.where(gap > -1.0, gap, np.inf).min(axis=1)


def nearest_obstacles(
    tables: PathTables, vehicles: Boxes, at_m: PerVehicle, active: VehicleMask, others: Boxes,
    by_world: Int64[np.ndarray, "world most"],
) -> tuple[PerVehicle, PerVehicle]:  # fmt: skip
    """Return the gap from each front bumper to the nearest obstacle in the path's corridor, and the obstacle's speed.

    The speed is that along the path, 0 for oncoming obstacles. Without an obstacle it is 0 and the gap infinite.
    ``others`` are pedestrians and moving scripted users; ``by_world`` has their indices, padded with -1.
    """
    count, users = len(vehicles), vehicles.concatenate(others)
    gap, speed = np.full(count, np.inf), np.zeros(count)
    viewer, user = _nearby_pairs(tables.worlds, vehicles, users, by_world, active)
    if not len(viewer):
        return gap, speed
    pose, sample_m, squared_gap = _nearest_samples(tables, at_m, viewer, users.xy.take(user, axis=0))
    # Ignore users at least 8 m from all samples ahead.
    k = (squared_gap < 64.0).nonzero()[0]
    viewer, user, pose, sample_m = viewer[k], user[k], pose.take(k, axis=0), sample_m[k]
    position, left, relative_heading = _relative_poses(users, user, pose[:, :2], pose[:, 2])
    position = position + sample_m
    length, width = _half_extents(users.size_m[user], relative_heading)
    is_vehicle = user < count
    width = np.where(is_vehicle, np.minimum(width, _MAX_HALF_WIDTH_M), width)
    drift = users.speed[user] * np.sin(relative_heading)
    left_soon = left + drift * _DRIFT_S
    size = vehicles.size_m[viewer]
    half = size[:, 1] / 2 + np.where(is_vehicle, _VEHICLE_MARGIN_M, _SIDE_MARGIN_M)
    is_inside = (np.minimum(left, left_soon) - width < half) & (np.maximum(left, left_soon) + width > -half)
    is_inside &= position > at_m[viewer] + 0.3 * size[:, 0]
    k = is_inside.nonzero()[0]
    if not len(k):
        return gap, speed
    viewer, user, left, drift = viewer[k], user[k], left[k], drift[k]
    room = position[k] - length[k] - at_m[viewer] - size[k, 0] / 2
    stays = ~_leaves_corridor(left, drift, half[k] + width[k], room / np.maximum(vehicles.speed[viewer], 1.0))
    # Enter the nearest of several obstacles of a vehicle last.
    order = np.argsort(-room, kind="stable")
    order = order[stays[order]]
    gap[viewer[order]] = room[order]
    speed[viewer[order]] = np.maximum(users.speed[user] * np.cos(relative_heading[k]), 0.0)[order]
    return gap, speed


def _nearby_pairs(
    worlds: Worlds,
    vehicles: Boxes,
    users: Boxes,
    by_world: Int64[np.ndarray, "world most"],
    active: VehicleMask,
) -> tuple[_Indices, _Indices]:
    """Return pairs of a vehicle and a user of its world (vehicles first) in a wedge ahead of it."""
    count = worlds.rows.shape[1]
    columns = np.concatenate((worlds.rows, np.where(by_world < 0, -1, by_world + len(vehicles))), axis=1)
    xy = pad_last(users.xy.T, np.nan)
    xy[:, : len(vehicles)][:, ~active] = np.nan
    dx, dy = xy.take(columns, axis=1).take(worlds.world, axis=1)
    dx -= vehicles.xy[:, 0, None]
    dy -= vehicles.xy[:, 1, None]
    cos, sin = vehicles.direction
    ahead = dx * cos[:, None]
    ahead += dy * sin[:, None]
    # Below 13 m/s this exceeds the comfortable stopping distance; less for vehicles, which follow others and the rules.
    reach = np.where(active, np.minimum(_RANGE_M, 12.0 + 2.5 * vehicles.speed), 0.0)[:, None]
    is_near = ahead > 0.5
    is_near[:, :count] &= ahead[:, :count] < np.minimum(reach, _VEHICLE_RANGE_M)
    is_near[:, count:] &= ahead[:, count:] < reach
    pair = is_near.ravel().nonzero()[0]
    viewer = pair // is_near.shape[1]
    lateral = np.abs(dy.ravel()[pair] * cos[viewer] - dx.ravel()[pair] * sin[viewer])
    is_inside = lateral < np.minimum(0.5 * ahead.ravel()[pair] + 3.0, _MAX_LATERAL_M)
    pair, viewer = pair[is_inside], viewer[is_inside]
    return viewer, columns.ravel()[pair - (viewer - worlds.world[viewer]) * is_near.shape[1]]


def _nearest_samples(
    tables: PathTables, at_m: PerVehicle, viewer: _Indices, xy: Float64[np.ndarray, "k 2"]
) -> tuple[Float64[np.ndarray, "k 4"], _Values, _Values]:
    """Return the sample of the path ahead nearest to each point, its position, and the squared distance."""
    points, index = tables.samples_ahead(at_m, viewer, _SAMPLES_M)
    dx, dy = points[..., 0] - xy[:, 0, None], points[..., 1] - xy[:, 1, None]
    squared_gap = dx * dx + dy * dy
    nearest = np.arange(len(viewer)), squared_gap.argmin(axis=1)
    return points[nearest], index[nearest] * tables.step_m[viewer], squared_gap[nearest]


def _leaves_corridor(
    left: _Values, drift: _Values, reach: _Values, arrival_s: _Values
) -> Bool[np.ndarray, " k"]:
    """Mask of crossing users that leave the corridor well before the vehicle arrives, in ``arrival_s``."""
    left_at_arrival = left + drift * np.maximum(arrival_s - _CLEARANCE_S, 0.0)
    return (arrival_s > 2 * _CLEARANCE_S) & (np.abs(left_at_arrival) > reach) & (left_at_arrival * drift > 0)
