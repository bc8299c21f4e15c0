"""Obstacles in the corridor of a vehicle's path: parked cars, pedestrians, vehicles off their lanes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64

from drivax.synthetic.traffic.path_arrays import PathTables, PerVehicle, VehicleMask, Worlds, pad_last
from drivax.synthetic.traffic.paths import Path

#: Lateral margin of the corridor, m; less for vehicles, which keep to their lanes.
_MARGIN_M, _VEHICLES_M = 0.2, 0.05
#: Largest half width of other vehicles, m: of a turning one only the middle part counts.
_MIDDLE_M = 1.3
#: Range of the search for moving obstacles ahead, m, its step along the path, and its half width.
_AHEAD_M, _EVERY_M, _ASIDE_M = 50.0, 2.0, 16.0
#: Range of the search for vehicles, m.
_NEAR_M = 25.0
#: Crossing users are ignored when they leave the corridor this long before arrival, s.
_WELL_S = 0.8
#: Time over which lateral motion is extrapolated, s.
_FORESEEN_S = 0.7
#: Boxes per batch: the table of distances stays in the processor's cache.
_BATCH = 256
#: Distances ahead of a vehicle at which its path is sampled, m.
_LOOKS_M = np.arange(0.0, _AHEAD_M + 6.0, _EVERY_M)

#: A number and an index per pair.
_Values = Float64[np.ndarray, " k"]
_Indices = Int64[np.ndarray, " k"]


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

    def select(self, which: np.ndarray) -> Boxes:
        """Return the boxes of some rows."""
        return Boxes(self.xy[which], self.heading[which], self.speed[which], self.size_m[which])

    def concatenate(self, other: Boxes) -> Boxes:
        """Return these boxes and others."""
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
    """Extents of the boxes near a path, which counts as straight over the length of a box, and their rows."""
    coarse = path.curve.xy[::8]
    in_box = (boxes.xy > coarse.min(axis=0) - within_m) & (boxes.xy < coarse.max(axis=0) + within_m)
    inside = np.flatnonzero(in_box[:, 0] & in_box[:, 1])
    near, rough = np.zeros(0, int), np.zeros(0, int)
    for first in range(0, len(inside), _BATCH):
        batch = inside[first : first + _BATCH]
        gap = _squared_distance(boxes.xy[batch, None], coarse)
        best = gap.argmin(axis=1)
        close = gap[np.arange(len(batch)), best] < within_m**2
        near, rough = np.append(near, batch[close]), np.append(rough, 8 * best[close])
    window = np.clip(rough[:, None] + np.arange(-8, 9), 0, len(path.curve.xy) - 1)
    fine = _squared_distance(boxes.xy[near, None], path.curve.xy[window])
    index = window[np.arange(len(near)), fine.argmin(axis=1)]
    position, lateral, angle = _relative(boxes, near, path.curve.xy[index], path.curve.heading[index])
    length, width = _reach(boxes.size_m[near], angle)
    position = position + index * path.step_m
    return Extents(position - length, position + length, lateral - width, lateral + width), near


def _squared_distance(
    a: Float64[np.ndarray, "*#batch 2"], b: Float64[np.ndarray, "*#batch 2"]
) -> Float64[np.ndarray, "..."]:
    """Squared distances."""
    dx, dy = a[..., 0] - b[..., 0], a[..., 1] - b[..., 1]
    dx *= dx
    dy *= dy
    dx += dy
    return dx


def _relative(
    boxes: Boxes, which: _Indices, xy: Float64[np.ndarray, "k 2"], heading: _Values
) -> tuple[_Values, _Values, _Values]:
    """Positions of boxes ahead and to the left of poses, and their relative headings."""
    dx, dy = (boxes.xy[which] - xy).T
    cos, sin = np.cos(heading), np.sin(heading)
    return dx * cos + dy * sin, dy * cos - dx * sin, boxes.heading[which] - heading


def _reach(size_m: Float64[np.ndarray, "k 2"], relative_heading: _Values) -> tuple[_Values, _Values]:
    """Half extents along and across a direction."""
    cos, sin = np.abs(np.cos(relative_heading)) / 2, np.abs(np.sin(relative_heading)) / 2
    return cos * size_m[:, 0] + sin * size_m[:, 1], sin * size_m[:, 0] + cos * size_m[:, 1]


NO_EXTENTS = Extents(*np.zeros((4, 0)))


class StaticObstacles:
    """Static obstacles of each world, in the coordinates of every vehicle's path.

    Args:
        worlds: The worlds.
        boxes: Obstacles of each world.
        seen: Their extents on the path of each vehicle.
        width_m: Width of each vehicle.
    """

    def __init__(
        self, worlds: Worlds, boxes: Sequence[Boxes], seen: Sequence[Extents], width_m: PerVehicle
    ) -> None:
        self.boxes, self._worlds, self._half = tuple(boxes), worlds, width_m / 2
        self.near_m = np.full((len(width_m), 1), np.inf)
        self._seen = list(seen)
        for row in np.flatnonzero([len(extents.near_m) > 0 for extents in seen]).tolist():
            self._enter(row)

    def replace(self, row: int, path: Path) -> None:
        """Enter the path of one vehicle."""
        boxes = self.boxes[self._worlds.world[row]]
        if len(boxes):
            self._seen[row], _ = extents(path, boxes)
            self._enter(row)

    def _enter(self, row: int) -> None:
        seen, half = self._seen[row], self._half[row] + _MARGIN_M
        block = np.sort(seen.near_m[(seen.right_m < half) & (seen.left_m > -half)])
        if len(block) > self.near_m.shape[1]:
            extra = len(block) - self.near_m.shape[1]
            self.near_m = np.pad(self.near_m, ((0, 0), (0, extra)), constant_values=np.inf)
        self.near_m[row] = np.inf
        self.near_m[row, : len(block)] = block

    def meets(self, row: int, front_m: float, half_m: float, within_m: float) -> bool:
        """Whether an obstacle lies within a distance ahead of a vehicle's front, in a band of some half width."""
        seen = self._seen[row]
        block = (seen.right_m < half_m) & (seen.left_m > -half_m)
        block &= (seen.near_m > front_m - 0.5) & (seen.near_m < front_m + within_m)
        return bool(block.any())

    def gap(self, front_m: PerVehicle) -> PerVehicle:
        """Distance from the front bumper to the next obstacle in the corridor (infinite: none)."""
        gap = self.near_m - front_m[:, None]
        return np.where(gap > -1.0, gap, np.inf).min(axis=1)


def nearest_obstacles(
    tables: PathTables, vehicles: Boxes, at_m: PerVehicle, active: VehicleMask, others: Boxes,
    by_world: Int64[np.ndarray, "world most"],
) -> tuple[PerVehicle, PerVehicle]:  # fmt: skip
    """Gap from each front bumper to the nearest obstacle in the corridor of the own path, and its speed along it.

    ``others`` are the moving users that are no vehicles; ``by_world`` has their indices, filled up with -1.
    """
    count, users = len(vehicles), vehicles.concatenate(others)
    gap, speed = np.full(count, np.inf), np.zeros(count)
    viewer, user = _nearby_pairs(tables.worlds, vehicles, users, by_world, active)
    if not len(viewer):
        return gap, speed
    pose, place_m, apart2 = _nearest(tables, at_m, viewer, users.xy[user])
    # Obstacles beyond the last sample of the path, or next to the vehicle, do not count.
    k = (apart2 < 64.0).nonzero()[0]
    viewer, user, pose, place_m = viewer[k], user[k], pose[k], place_m[k]
    position, left, relative_heading = _relative(users, user, pose[:, :2], pose[:, 2])
    position = position + place_m
    length, width = _reach(users.size_m[user], relative_heading)
    vehicle = user < count
    width = np.where(vehicle, np.minimum(width, _MIDDLE_M), width)
    drift = users.speed[user] * np.sin(relative_heading)
    left_soon = left + drift * _FORESEEN_S
    size = vehicles.size_m[viewer]
    half = size[:, 1] / 2 + np.where(vehicle, _VEHICLES_M, _MARGIN_M)
    inside = (np.minimum(left, left_soon) - width < half) & (np.maximum(left, left_soon) + width > -half)
    inside &= position > at_m[viewer] + 0.3 * size[:, 0]
    k = inside.nonzero()[0]
    if not len(k):
        return gap, speed
    viewer, user, left, drift = viewer[k], user[k], left[k], drift[k]
    room = position[k] - length[k] - at_m[viewer] - size[k, 0] / 2
    stays = ~_leaves_corridor(left, drift, half[k] + width[k], room / np.maximum(vehicles.speed[viewer], 1.0))
    # Of several obstacles of a vehicle the nearest is entered last.
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
    """Pairs of a vehicle and a user of its world (vehicles first) in a wedge ahead of it."""
    count = worlds.rows.shape[1]
    columns = np.concatenate((worlds.rows, np.where(by_world < 0, -1, by_world + len(vehicles))), axis=1)
    xy = pad_last(users.xy.T, np.nan)
    xy[:, : len(vehicles)][:, ~active] = np.nan
    dx, dy = xy.take(columns, axis=1).take(worlds.world, axis=1)
    dx -= vehicles.xy[:, 0, None]
    dy -= vehicles.xy[:, 1, None]
    cos, sin = (component[:, None] for component in vehicles.direction)
    ahead = dx * cos
    ahead += dy * sin
    dy *= cos
    dx *= sin
    dy -= dx
    # Somewhat beyond the comfortable stopping distance; less for vehicles, which follow each other and the rules.
    reach = np.where(active, np.minimum(_AHEAD_M, 12.0 + 2.5 * vehicles.speed), 0.0)[:, None]
    near = ahead > 0.5
    near[:, :count] &= ahead[:, :count] < np.minimum(reach, _NEAR_M)
    near[:, count:] &= ahead[:, count:] < reach
    ahead *= 0.5
    ahead += 3.0
    near &= np.abs(dy, out=dy) < np.minimum(ahead, _ASIDE_M, out=ahead)
    viewer, column = np.divmod(near.ravel().nonzero()[0], near.shape[1])
    return viewer, columns[worlds.world[viewer], column]


def _nearest(
    tables: PathTables, at_m: PerVehicle, viewer: _Indices, xy: Float64[np.ndarray, "k 2"]
) -> tuple[Float64[np.ndarray, "k 4"], _Values, _Values]:
    """The sample of a vehicle's path ahead that is nearest to a point, its position, and the squared distance."""
    points, index = tables.samples_ahead(at_m, viewer, _LOOKS_M)
    dx, dy = points[..., 0] - xy[:, 0, None], points[..., 1] - xy[:, 1, None]
    separation = dx * dx + dy * dy
    pair = np.arange(len(viewer)), separation.argmin(axis=1)
    return points[pair], index[pair] * tables.step_m[viewer], separation[pair]


def _leaves_corridor(
    left: _Values, drift: _Values, reach: _Values, seconds: _Values
) -> Bool[np.ndarray, " k"]:
    """Mask of crossing users that leave the corridor well before the vehicle arrives."""
    left_at_arrival = left + drift * np.maximum(seconds - _WELL_S, 0.0)
    return (seconds > 2 * _WELL_S) & (np.abs(left_at_arrival) > reach) & (left_at_arrival * drift > 0)
