"""What stands or moves in the way of a vehicle without being on a lane: parked cars, people, whoever swerves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from drivax.synthetic.paths import Path
from drivax.synthetic.tables import PathTables

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
#: Who crosses ahead is not braked for when it will have left so long before, s.
_WELL_S = 0.8
#: Sideways motion is foreseen for this long, s.
_FORESEEN_S = 0.7


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

    def chosen(self, which: np.ndarray) -> Boxes:
        """Some of them."""
        return Boxes(self.xy[which], self.heading[which], self.speed[which], self.size_m[which])

    def joined(self, other: Boxes) -> Boxes:
        """These and others."""
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
    gap = np.sum((boxes.xy[:, None] - coarse) ** 2, axis=-1)
    near = np.flatnonzero(gap.min(axis=1) < within_m**2) if len(boxes) else np.zeros(0, int)
    rough = 8 * np.argmin(gap[near], axis=1) if len(near) else near
    window = np.clip(rough[:, None] + np.arange(-8, 9), 0, len(path.curve.xy) - 1)
    fine = np.sum((boxes.xy[near, None] - path.curve.xy[window]) ** 2, axis=-1)
    place = window[np.arange(len(near)), np.argmin(fine, axis=1)] if len(near) else near
    at, aside, turned = _relative(boxes, near, path.curve.xy[place], path.curve.heading[place])
    length, width = _reach(boxes.size_m[near], turned)
    at = at + place * path.step_m
    return Extents(at - length, at + length, aside - width, aside + width), near


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
        tables: Everyone's paths.
        width_m: Widths of the vehicles.
    """

    def __init__(self, boxes: Boxes, tables: PathTables, width_m: Float64[np.ndarray, " v"]) -> None:
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

    def beside(self, row: int) -> Extents:
        """Everything near a vehicle's path."""
        return self._seen[row][0]

    def gap(self, front_m: Float64[np.ndarray, " v"]) -> Float64[np.ndarray, " v"]:
        """Distance from the front bumper to the next thing in the way (infinite: none)."""
        gap = self.near_m - front_m[:, None]
        return np.where(gap > -1.0, gap, np.inf).min(axis=1)


def in_the_way(
    tables: PathTables,
    vehicles: Boxes,
    at_m: Float64[np.ndarray, " v"],
    active: Bool[np.ndarray, " v"],
    others: Boxes,
) -> tuple[Float64[np.ndarray, " v"], Float64[np.ndarray, " v"]]:
    """Gap from each front bumper to the nearest thing in the corridor of the own path, and its speed along it.

    Args:
        tables: Everyone's paths.
        vehicles: The vehicles.
        at_m: Where they are on their paths.
        active: Which of them are there.
        others: What may be in the way beside vehicles: things in motion, those that stand for once too.
    """
    count, things = len(vehicles), vehicles.joined(others)
    there = np.concatenate([active, np.ones(len(others), bool)])
    margin = np.where(np.arange(len(things)) < count, _VEHICLES_M, _MARGIN_M)
    gap, speed = np.full(count, np.inf), np.zeros(count)
    who, what = np.nonzero(_close(vehicles, things) & active[:, None] & there)
    if not len(who):
        return gap, speed
    pose, place_m, apart2 = _nearest(tables, at_m, who, things.xy[what])
    at, left, turned = _relative(things, what, pose[:, :2], pose[:, 2])
    at = at + place_m
    length, width = _reach(things.size_m[what], turned)
    # Vehicles keep out of each other's way by the rules: of one that turns, only the middle part counts.
    width = np.where(what < count, np.minimum(width, _MIDDLE_M), width)
    drift = things.speed[what] * np.sin(turned)
    soon = left + drift * _FORESEEN_S
    half = vehicles.size_m[who, 1] / 2 + margin[what]
    inside = (np.minimum(left, soon) - width < half) & (np.maximum(left, soon) + width > -half)
    # Beyond the last sample of the path, or beside the vehicle rather than ahead of it: not in the way.
    inside &= (at > at_m[who] + 0.3 * vehicles.size_m[who, 0]) & (apart2 < 64.0)
    room = at - length - at_m[who] - vehicles.size_m[who, 0] / 2
    inside &= ~_gone(left, drift, half + width, room / np.maximum(vehicles.speed[who], 1.0))
    room = np.where(inside, room, np.inf)
    order = np.argsort(-room, kind="stable")
    gap[who[order]] = room[order]
    speed[who[order]] = np.maximum(things.speed[what] * np.cos(turned), 0.0)[order]
    return gap, np.where(np.isfinite(gap), speed, 0.0)


def _close(vehicles: Boxes, things: Boxes) -> Bool[np.ndarray, "v thing"]:
    """What is ahead of a vehicle and near enough to matter, roughly."""
    delta = things.xy[None] - vehicles.xy[:, None]
    cos, sin = np.cos(vehicles.heading)[:, None], np.sin(vehicles.heading)[:, None]
    ahead, aside = delta[..., 0] * cos + delta[..., 1] * sin, delta[..., 1] * cos - delta[..., 0] * sin
    # Within reach: what the vehicle could not stop for comfortably in time, and a little more; of vehicles, which
    # follow each other and the rules, those that are near.
    reach = np.minimum(_AHEAD_M, 12.0 + 2.5 * vehicles.speed)[:, None]
    reach = np.where(np.arange(len(things)) < len(vehicles), np.minimum(reach, _NEAR_M), reach)
    return (ahead > 0.5) & (ahead < reach) & (np.abs(aside) < np.minimum(_ASIDE_M, 3.0 + 0.5 * ahead))


def _nearest(
    tables: PathTables,
    at_m: Float64[np.ndarray, " v"],
    who: Int64[np.ndarray, " k"],
    xy: Float64[np.ndarray, "k 2"],
) -> tuple[Float64[np.ndarray, "k 4"], Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
    """The sample ahead on the path of a vehicle that is nearest to a point, where it is, and the squared distance."""
    steps = np.arange(0.0, _AHEAD_M + 6.0, _EVERY_M)
    users, inverse = np.unique(who, return_inverse=True)
    place = np.rint((at_m[users, None] + steps) / tables.step_m[users, None]).astype(int)
    place = np.minimum(place, tables.last[users, None])
    points = tables.table[users[:, None], place][inverse]
    apart = (points[..., 0] - xy[:, 0, None]) ** 2 + (points[..., 1] - xy[:, 1, None]) ** 2
    nearest = np.argmin(apart, axis=1)
    pair = np.arange(len(who))
    return points[pair, nearest], place[inverse, nearest] * tables.step_m[who], apart[pair, nearest]


def _gone(
    left: Float64[np.ndarray, " k"],
    drift: Float64[np.ndarray, " k"],
    reach: Float64[np.ndarray, " k"],
    seconds: Float64[np.ndarray, " k"],
) -> Bool[np.ndarray, " k"]:
    """Who crosses the corridor will have left it well before the vehicle comes."""
    then = left + drift * np.maximum(seconds - _WELL_S, 0.0)
    return (seconds > 2 * _WELL_S) & (np.abs(then) > reach) & (then * drift > 0)
