"""Obstacles in a vehicle's corridor that are on no lane: parked cars, pedestrians, swerving vehicles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64

from drivax.synthetic.traffic.path_arrays import PathTables, PerVehicle, VehicleMask
from drivax.synthetic.traffic.paths import Path

#: Room that a driver keeps on both sides, m.
_MARGIN_M = 0.2
#: Less is kept to vehicles, which keep to their lanes, m.
_VEHICLES_M = 0.05
#: Half width of a vehicle that stands or drives askew, as others see it, m.
_MIDDLE_M = 1.3
#: How far ahead of the centre things in motion are looked at, m, how finely, and how far aside.
_AHEAD_M, _EVERY_M, _ASIDE_M = 50.0, 2.0, 16.0
#: How far ahead other vehicles are looked at, m.
_NEAR_M = 25.0
#: Crossing users are ignored when they leave the corridor this long before arrival, s.
_WELL_S = 0.8
#: Sideways motion is foreseen for this long, s.
_FORESEEN_S = 0.7
#: Boxes that are looked for together along a path.
_TOGETHER = 256


@dataclass(frozen=True)
class Boxes:
    """Things at one moment: centres, headings, signed speeds along them, lengths and widths."""

    xy: Float64[np.ndarray, "thing 2"]
    heading: Float64[np.ndarray, " thing"]
    speed: Float64[np.ndarray, " thing"]
    size_m: Float64[np.ndarray, "thing 2"]

    def __len__(self) -> int:
        """How many."""
        return len(self.speed)

    @cached_property
    def direction(self) -> tuple[Float64[np.ndarray, " thing"], Float64[np.ndarray, " thing"]]:
        """Cosine and sine of the headings."""
        return np.cos(self.heading), np.sin(self.heading)

    def chosen(self, which: np.ndarray) -> Boxes:
        """Some of them."""
        return Boxes(self.xy[which], self.heading[which], self.speed[which], self.size_m[which])

    def joined(self, other: Boxes) -> Boxes:
        """These and others."""
        if not len(other):
            return self
        return Boxes(
            np.concatenate([self.xy, other.xy]),
            np.concatenate([self.heading, other.heading]),
            np.concatenate([self.speed, other.speed]),
            np.concatenate([self.size_m, other.size_m]),
        )


@dataclass(frozen=True)
class Extents:
    """Boxes as seen along a path: from where to where along it, and from right to left of it, m."""

    near_m: Float64[np.ndarray, " thing"]
    far_m: Float64[np.ndarray, " thing"]
    right_m: Float64[np.ndarray, " thing"]
    left_m: Float64[np.ndarray, " thing"]


def extents(path: Path, boxes: Boxes, within_m: float = 12.0) -> tuple[Extents, Int64[np.ndarray, " thing"]]:
    """Boxes near a path in its coordinates (straight over the length of a box), and which ones they are."""
    coarse = path.curve.xy[::8]
    around = (boxes.xy > coarse.min(axis=0) - within_m) & (boxes.xy < coarse.max(axis=0) + within_m)
    inside = np.flatnonzero(around[:, 0] & around[:, 1])
    near, rough = np.zeros(0, int), np.zeros(0, int)
    # So few at a time that the table of distances stays in the processor's cache.
    for first in range(0, len(inside), _TOGETHER):
        some = inside[first : first + _TOGETHER]
        gap = _squared(boxes.xy[some, None], coarse)
        best = gap.argmin(axis=1)
        close = gap[np.arange(len(some)), best] < within_m**2
        near, rough = np.append(near, some[close]), np.append(rough, 8 * best[close])
    window = np.clip(rough[:, None] + np.arange(-8, 9), 0, len(path.curve.xy) - 1)
    fine = _squared(boxes.xy[near, None], path.curve.xy[window])
    place = window[np.arange(len(near)), fine.argmin(axis=1)]
    at, aside, turned = _relative(boxes, near, path.curve.xy[place], path.curve.heading[place])
    length, width = _reach(boxes.size_m[near], turned)
    at = at + place * path.step_m
    return Extents(at - length, at + length, aside - width, aside + width), near


def _squared(
    a: Float64[np.ndarray, "*#batch 2"], b: Float64[np.ndarray, "*#batch 2"]
) -> Float64[np.ndarray, "..."]:
    """Squared distances."""
    dx, dy = a[..., 0] - b[..., 0], a[..., 1] - b[..., 1]
    dx *= dx
    dy *= dy
    dx += dy
    return dx


def _relative(
    boxes: Boxes,
    which: Int64[np.ndarray, " k"],
    xy: Float64[np.ndarray, "k 2"],
    heading: Float64[np.ndarray, " k"],
) -> tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
    """Boxes in frames at the given poses: ahead, to the left, and turned."""
    dx, dy = (boxes.xy[which] - xy).T
    cos, sin = np.cos(heading), np.sin(heading)
    return dx * cos + dy * sin, dy * cos - dx * sin, boxes.heading[which] - heading


def _reach(
    size_m: Float64[np.ndarray, "k 2"], turned: Float64[np.ndarray, " k"]
) -> tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
    """Half extents along and across a direction."""
    cos, sin = np.abs(np.cos(turned)) / 2, np.abs(np.sin(turned)) / 2
    return cos * size_m[:, 0] + sin * size_m[:, 1], sin * size_m[:, 0] + cos * size_m[:, 1]


class Standing:
    """Things that never move, as seen along every vehicle's path.

    Args:
        boxes: The things.
        tables: All paths.
        width_m: Widths of the vehicles.
    """

    def __init__(self, boxes: Boxes, tables: PathTables, width_m: PerVehicle) -> None:
        self.boxes, self._half = boxes, width_m / 2
        self.near_m = np.full((len(width_m), 1), np.inf)
        self._seen: list[tuple[Extents, Int64[np.ndarray, " k"]]] = []
        for row, path in enumerate(tables.paths):
            self._seen.append((Extents(*np.zeros((4, 0))), np.zeros(0, int)))
            self.replace(row, path)

    def replace(self, row: int, path: Path) -> None:
        """A vehicle has another path."""
        if not len(self.boxes):
            return
        seen, which = extents(path, self.boxes)
        self._seen[row] = (seen, which)
        half = self._half[row] + _MARGIN_M
        block = np.sort(seen.near_m[(seen.right_m < half) & (seen.left_m > -half)])
        if len(block) > self.near_m.shape[1]:
            more = len(block) - self.near_m.shape[1]
            self.near_m = np.pad(self.near_m, ((0, 0), (0, more)), constant_values=np.inf)
        self.near_m[row] = np.inf
        self.near_m[row, : len(block)] = block

    def copy(self) -> Standing:
        """A copy whose rows can be replaced without changing this one."""
        result = object.__new__(Standing)
        for name, value in vars(self).items():
            setattr(result, name, value.copy() if isinstance(value, np.ndarray | list) else value)
        return result

    def meets(self, row: int, front_m: float, half_m: float, within_m: float) -> bool:
        """Whether something stands so near ahead of a vehicle's front in a band of this half width."""
        seen = self._seen[row][0]
        block = (seen.right_m < half_m) & (seen.left_m > -half_m)
        block &= (seen.near_m > front_m - 0.5) & (seen.near_m < front_m + within_m)
        return bool(block.any())

    def gap(self, front_m: PerVehicle) -> PerVehicle:
        """Distance from the front bumper to the next thing in the way (infinite: none)."""
        gap = self.near_m - front_m[:, None]
        return np.where(gap > -1.0, gap, np.inf).min(axis=1)


def nearest_obstacles(
    tables: PathTables, vehicles: Boxes, at_m: PerVehicle, active: VehicleMask, others: Boxes
) -> tuple[PerVehicle, PerVehicle]:
    """Gap from each front bumper to the nearest thing in the corridor of the own path, and its speed along it.

    Args:
        tables: All paths.
        vehicles: The vehicles.
        at_m: Where they are on their paths.
        active: Which of them are there.
        others: Other possible obstacles: moving users, including those that stand for now.
    """
    count, things = len(vehicles), vehicles.joined(others)
    gap, speed = np.full(count, np.inf), np.zeros(count)
    viewer, thing = _close(vehicles, things, active)
    if not len(viewer):
        return gap, speed
    pose, place_m, apart2 = _nearest(tables, at_m, viewer, things.xy[thing])
    at, left, turned = _relative(things, thing, pose[:, :2], pose[:, 2])
    at = at + place_m
    length, width = _reach(things.size_m[thing], turned)
    # Vehicles keep out of each other's way by the rules: of one that turns, only the middle part counts.
    vehicle = thing < count
    width = np.where(vehicle, np.minimum(width, _MIDDLE_M), width)
    drift = things.speed[thing] * np.sin(turned)
    soon = left + drift * _FORESEEN_S
    size = vehicles.size_m[viewer]
    half = size[:, 1] / 2 + np.where(vehicle, _VEHICLES_M, _MARGIN_M)
    inside = (np.minimum(left, soon) - width < half) & (np.maximum(left, soon) + width > -half)
    # Beyond the last sample of the path, or next to the vehicle: no obstacle.
    inside &= (at > at_m[viewer] + 0.3 * size[:, 0]) & (apart2 < 64.0)
    k = inside.nonzero()[0]
    if not len(k):
        return gap, speed
    viewer, thing, left, drift = viewer[k], thing[k], left[k], drift[k]
    room = at[k] - length[k] - at_m[viewer] - size[k, 0] / 2
    stays = ~_gone(left, drift, half[k] + width[k], room / np.maximum(vehicles.speed[viewer], 1.0))
    # The nearest is entered last.
    order = np.argsort(-room, kind="stable")
    order = order[stays[order]]
    gap[viewer[order]] = room[order]
    speed[viewer[order]] = np.maximum(things.speed[thing] * np.cos(turned[k]), 0.0)[order]
    return gap, speed


def _close(
    vehicles: Boxes, things: Boxes, active: VehicleMask
) -> tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " k"]]:
    """Pairs of a vehicle and what is ahead of it and near enough to matter, roughly; vehicles come first in things."""
    count = len(vehicles)
    dx, dy = things.xy[:, 0] - vehicles.xy[:, 0, None], things.xy[:, 1] - vehicles.xy[:, 1, None]
    cos, sin = (part[:, None] for part in vehicles.direction)
    ahead = dx * cos + dy * sin
    dy *= cos
    dx *= sin
    dy -= dx
    # Within reach: what the vehicle could not stop for comfortably in time, and a little more; of vehicles, which
    # follow each other and the rules, those that are near. Who is not there sees nothing, and is not seen.
    reach = np.where(active, np.minimum(_AHEAD_M, 12.0 + 2.5 * vehicles.speed), 0.0)[:, None]
    near = ahead > 0.5
    near[:, :count] &= ahead[:, :count] < np.minimum(reach, _NEAR_M)
    near[:, :count] &= active
    near[:, count:] &= ahead[:, count:] < reach
    ahead *= 0.5
    ahead += 3.0
    near &= np.abs(dy, out=dy) < np.minimum(ahead, _ASIDE_M, out=ahead)
    pairs = near.ravel().nonzero()[0]
    return pairs // len(things), pairs % len(things)


#: Where ahead of a vehicle its path is looked at, m.
_LOOKS_M = np.arange(0.0, _AHEAD_M + 6.0, _EVERY_M)


def _nearest(
    tables: PathTables, at_m: PerVehicle, viewer: Int64[np.ndarray, " k"], xy: Float64[np.ndarray, "k 2"]
) -> tuple[Float64[np.ndarray, "k 4"], Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
    """The sample ahead on the path of a vehicle that is nearest to a point, where it is, and the squared distance."""
    step = tables.step_m[viewer]
    place = np.rint((at_m[viewer, None] + _LOOKS_M) / step[:, None]).astype(int)
    place = np.minimum(place, tables.last[viewer, None])
    flat = tables.table.reshape(-1, 4)
    points = flat.take(place + (viewer * tables.table.shape[1])[:, None], axis=0)
    dx, dy = points[..., 0] - xy[:, 0, None], points[..., 1] - xy[:, 1, None]
    apart = dx * dx + dy * dy
    pair = np.arange(len(viewer)), apart.argmin(axis=1)
    return points[pair], place[pair] * step, apart[pair]


def _gone(
    left: Float64[np.ndarray, " k"],
    drift: Float64[np.ndarray, " k"],
    reach: Float64[np.ndarray, " k"],
    seconds: Float64[np.ndarray, " k"],
) -> Bool[np.ndarray, " k"]:
    """Mask of crossing users that leave the corridor well before the vehicle arrives."""
    then = left + drift * np.maximum(seconds - _WELL_S, 0.0)
    return (seconds > 2 * _WELL_S) & (np.abs(then) > reach) & (then * drift > 0)
