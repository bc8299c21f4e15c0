"""Paths that leave lane centres: lane changes, and detours around obstacles."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from drivax.geometry.vectors import wrap
from drivax.synthetic.roads.curves import STEP_M, Curve
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.obstacles import Boxes, Extents, extents
from drivax.synthetic.traffic.path_arrays import PathTables
from drivax.synthetic.traffic.paths import SLOTS, LaneSpan, Path, smoothed_curvature

#: Drivers begin to look for a way around this far before a thing, m; they pass it with this room, m.
LOOK_M, _ROOM_M = 45.0, 0.55
#: What comes so near to the side of a vehicle on its path is in its way, m.
DETOUR_MARGIN_M = 0.3
#: Largest offset of a detour, m, and its steepest slope, m forward per m aside.
_FURTHEST_M, _STEEPEST = 4.3, 2.2
#: Distance ahead over which a detour occupies adjacent lanes, m.
_ADJACENT_M = 60.0
#: Room kept to the road's edge, m, and speed at which things are passed, m/s.
_EDGE_M, _PASS_MPS = 0.2, 6.0


@dataclass(frozen=True)
class DetourRequest:
    """A vehicle that looks for a detour: path position, speed, size, and adjacent lanes of its direction."""

    path: Path
    at_m: float
    speed: float
    size_m: tuple[float, float]
    adjacent: tuple[Occupied, ...] = ()


def detour_request(
    network: RoadNetwork, tables: PathTables, row: int, now: tuple[float, float], size_m: tuple[float, float]
) -> DetourRequest:
    """Build the request of a vehicle at a path position and speed."""
    at = float(now[0])
    lane, along = tables.on(np.array([at]), np.array([row]))
    adjacent = []
    if lane[0, 0] >= 0:
        here = network.lanes[lane[0, 0]]
        for other in (here.left, here.right):
            if other >= 0:
                scale = here.length_m / network.lanes[other].length_m
                adjacent.append(Occupied(other, at - float(along[0, 0]), scale, at, at + _ADJACENT_M))
    return DetourRequest(tables.paths[row], at, float(now[1]), size_m, tuple(adjacent))


class Detours:
    """Finds detours around standing obstacles.

    Args:
        network: The roads.
    """

    def __init__(self, network: RoadNetwork) -> None:
        points = [_dense(edge.xy) for edge in network.edges]
        xy = np.concatenate(points) if points else np.zeros((0, 2))
        self._edge = Boxes(xy, np.zeros(len(xy)), np.zeros(len(xy)), np.zeros((len(xy), 2)))

    def find(self, request: DetourRequest, standing: Boxes, moving: Boxes) -> tuple[Path, float] | None:
        """A path around what stands ahead, and where it is back on the old one (m); None where there is none."""
        path, half_width, half_length = request.path, request.size_m[1] / 2, request.size_m[0] / 2
        near = standing.chosen(_close(standing, path, request.at_m, LOOK_M + 40.0))
        seen, _ = extents(path, near)
        front = request.at_m + half_length
        blocks = (
            (seen.right_m < half_width + DETOUR_MARGIN_M)
            & (seen.left_m > -half_width - DETOUR_MARGIN_M)
            & (seen.near_m > front - 0.5)
        )
        if not blocks.any():
            return None
        first = float(seen.near_m[blocks].min())
        if not 2.0 < first - front < LOOK_M:
            return None
        last = first
        for k in np.argsort(seen.near_m, kind="stable"):
            if blocks[k] and seen.near_m[k] < last + 2 * half_length + 14.0:
                last = max(last, float(seen.far_m[k]))
        group = blocks & (seen.near_m <= last)
        sides = [
            float(seen.left_m[group].max()) + half_width + _ROOM_M,
            float(seen.right_m[group].min()) - half_width - _ROOM_M,
        ]
        for aside in sorted(sides, key=abs):
            plan = self._plan(request, first, last, aside)
            if plan is not None and self._is_free(request, plan, aside, seen, moving):
                return around(path, plan, aside, request.adjacent), plan[3]
        return None

    @staticmethod
    def _plan(
        request: DetourRequest, first: float, last: float, aside: float
    ) -> tuple[float, float, float, float] | None:
        half = request.size_m[0] / 2
        out = first - half - 0.3
        begin = max(request.at_m, out - max(_STEEPEST * 2 * abs(aside), 2.4 * request.speed))
        back = last + half + 0.5
        end = back + max(_STEEPEST * 1.6 * abs(aside), 2.0 * min(request.speed, _PASS_MPS))
        if (
            abs(aside) > _FURTHEST_M
            or out - begin < _STEEPEST * abs(aside)
            or end > request.path.length_m - 5.0
        ):
            return None
        return begin, out, back, end

    def _is_free(
        self,
        request: DetourRequest,
        plan: tuple[float, float, float, float],
        aside: float,
        seen: Extents,
        moving: Boxes,
    ) -> bool:
        """Whether the detour is free of road edges, standing obstacles and oncoming or overtaking users."""
        begin, out, back, end = plan
        half = request.size_m[1] / 2
        low, high = aside - half - _EDGE_M, aside + half + _EDGE_M
        adjacent = (seen.near_m < back) & (seen.far_m > out) & (seen.right_m < high) & (seen.left_m > low)
        if adjacent.any():
            return False
        edge = self._edge.chosen(_close(self._edge, request.path, (out + back) / 2, (end - begin) / 2 + 15.0))
        edges, _ = extents(request.path, edge)
        sweep = (edges.near_m > out) & (edges.near_m < back)
        sweep &= (edges.left_m > min(low, -half)) & (edges.right_m < max(high, half))
        if sweep.any():
            return False
        lasts = (end - request.at_m) / max(request.speed, _PASS_MPS) + 1.0
        near = moving.chosen(
            _close(moving, request.path, (request.at_m + end) / 2, end - request.at_m + 90.0)
        )
        others, which = extents(request.path, near, within_m=6.0)
        place = np.rint(
            np.clip((others.near_m + others.far_m) / 2, 0, request.path.length_m) / request.path.step_m
        )
        turned = wrap(near.heading[which] - request.path.curve.heading[place.astype(int)])
        speed = near.speed[which] * np.cos(turned)
        meets = (others.right_m < high + 0.3) & (others.left_m > low - 0.3)
        ahead = (others.far_m > request.at_m) & (others.near_m + np.minimum(speed, 0.0) * lasts < end + 5.0)
        behind = (others.far_m <= request.at_m) & (others.far_m + speed * 3.0 > request.at_m - 6.0)
        # A moving vehicle beyond the detour in the own lane is a leader, no conflict.
        ahead &= ~((speed > 1.0) & (others.near_m > back))
        return not bool(np.any(meets & (ahead | behind)))


def _dense(ring: Float64[np.ndarray, "point 2"]) -> Float64[np.ndarray, "dense 2"]:
    """A closed ring with points at most a metre apart."""
    closed = np.concatenate([ring, ring[:1]])
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    at = np.linspace(0.0, arc[-1], int(arc[-1]) + 2)
    return np.stack([np.interp(at, arc, closed[:, k]) for k in (0, 1)], axis=-1)


def _close(boxes: Boxes, path: Path, at_m: float, within_m: float) -> np.ndarray:
    centre = path.curve.xy[min(int(max(at_m, 0.0) / path.step_m), len(path.curve.xy) - 1)]
    return np.sum((boxes.xy - centre) ** 2, axis=1) < within_m**2


#: Share of a lane change after which a vehicle has left the old lane.
_LEFT_SHARE = 0.75
#: From this lateral offset on a vehicle occupies the adjacent lane, m.
_INTRUDES_M = 0.7


@dataclass(frozen=True)
class Occupied:
    """A lane that a vehicle takes up besides its path's own, between two path positions (before the displacement).

    Attributes:
        lane: Its index.
        begin_m: Path position at which the lane begins.
        scale: Path metres per lane metre.
        from_m, until_m: Where on the path it is taken up.
    """

    lane: int
    begin_m: float
    scale: float
    from_m: float
    until_m: float


def displaced(
    path: Path, aside_m: Float64[np.ndarray, " point"], occupied: tuple[Occupied, ...] = ()
) -> tuple[Path, Float64[np.ndarray, " point"]]:
    """A path driven aside of itself.

    Args:
        path: The path.
        aside_m: Offset to the left at each of its samples; smooth.
        occupied: Lanes taken up on the way.

    Returns:
        The new path, and where on it each sample of the old one has gone, m.
    """
    curve, step = path.curve, path.step_m
    normal = np.stack([-np.sin(curve.heading), np.cos(curve.heading)], axis=-1)
    slope = np.gradient(aside_m, step)
    stretch = np.maximum(1.0 - aside_m * np.gradient(curve.heading, step), 0.1)
    xy = curve.xy + aside_m[:, None] * normal
    heading = curve.heading + np.arctan2(slope, stretch)
    old = step * np.arange(len(xy))
    new = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    count = max(2, round(float(new[-1]) / STEP_M) + 1)
    at = np.linspace(0.0, new[-1], count)
    moved = Curve(
        np.stack([np.interp(at, new, xy[:, k]) for k in (0, 1)], axis=-1), np.interp(at, new, heading)
    )
    source = np.interp(at, new, old)
    index = np.rint(source / step).astype(int)
    lane = path.lane[index]
    lane_m = path.lane_m[index] + np.where(lane >= 0, (source - index * step)[:, None], 0.0)
    for other in occupied:
        _take_up(other, source, lane, lane_m)

    step = float(new[-1]) / (count - 1)
    result = Path(
        curve=moved,
        step_m=step,
        curvature=smoothed_curvature(moved, step),
        limit_mps=path.limit_mps[index],
        spans=_moved_spans(path, occupied, old, new),
        lane=lane,
        lane_m=lane_m,
    )
    return result, new


def _moved_spans(
    path: Path,
    occupied: tuple[Occupied, ...],
    old: Float64[np.ndarray, " point"],
    new: Float64[np.ndarray, " point"],
) -> tuple[LaneSpan, ...]:
    """Where the lanes of a path lie on its displaced copy, whose samples went from the old to the new positions."""

    def gone(metres: float) -> float:
        if not math.isfinite(metres) or metres < 0.0:
            return metres
        beyond = max(metres - float(old[-1]), 0.0)
        return float(np.interp(metres, old, new)) + beyond

    # A span is anchored where it ends: what lies ahead of the displacement stays in place.
    shifts = [gone(span.end_m) - span.end_m for span in path.spans]
    spans = [
        replace(s, begin_m=s.begin_m + by, end_m=s.end_m + by, from_m=gone(s.from_m), until_m=gone(s.until_m))
        for s, by in zip(path.spans, shifts, strict=True)
    ]
    for o in occupied:
        end = gone(o.until_m)
        spans.append(LaneSpan(o.lane, o.begin_m + end - o.until_m, o.scale, gone(o.from_m), end, end))
    return tuple(spans)


def _take_up(
    other: Occupied,
    at: Float64[np.ndarray, " point"],
    lane: np.ndarray,
    lane_m: Float64[np.ndarray, "point slot"],
) -> None:
    """Enter a lane into the first free slot of the samples on which it is taken up."""
    here = (at >= other.from_m) & (at <= other.until_m) & ~(lane == other.lane).any(axis=1)
    for slot in range(SLOTS):
        free = here & (lane[:, slot] < 0)
        lane[free, slot] = other.lane
        lane_m[free, slot] = (at[free] - other.begin_m) / other.scale
        here &= ~free


def quintic_step(
    at: Float64[np.ndarray, " point"], begin: tuple[float, float, float], length_m: float
) -> Float64[np.ndarray, " point"]:
    """The offset that leaves a value and slope at a place and is zero, level and straight a length later.

    Args:
        at: Path positions, m.
        begin: The place, the offset there (m) and its slope (m/m); the second derivative there is zero.
        length_m: Length, m.
    """
    place, offset, slope = begin
    u = np.clip((at - place) / length_m, 0.0, 1.0)
    rate = slope * length_m
    # Hermite basis of degree five: value and slope at 0; everything else is zero.
    value = 1 - 10 * u**3 + 15 * u**4 - 6 * u**5
    tangent = u - 6 * u**3 + 8 * u**4 - 3 * u**5
    before = np.clip(at - place, -10.0, 0.0)
    return np.where(at < place, offset + slope * before, offset * value + rate * tangent)


def located(
    path: Path, xy: Float64[np.ndarray, " 2"], near_m: float | None = None
) -> tuple[float, float, float]:
    """Locate a point relative to a path: position along it, offset to the left (m), and the path's heading there.

    Args:
        path: The path.
        xy: The point.
        near_m: Look only within 30 m of this position.
    """
    first, last = 0, len(path.curve.xy)
    if near_m is not None:
        first = max(0, int((near_m - 30.0) / path.step_m))
        last = max(first + 2, int((near_m + 30.0) / path.step_m))
    gap = xy - path.curve.xy[first:last]
    place = first + int(np.argmin(np.sum(gap**2, axis=1)))
    heading = float(path.curve.heading[place])
    dx, dy = xy - path.curve.xy[place]
    along = dx * math.cos(heading) + dy * math.sin(heading)
    return place * path.step_m + float(along), float(dy * math.cos(heading) - dx * math.sin(heading)), heading


def followed(path: Path, xy: Float64[np.ndarray, "time 2"]) -> Float64[np.ndarray, " time"]:
    """Where along a path points in motion are, m; each within 30 m of the one before."""
    result, near = np.zeros(len(xy)), None
    for k, point in enumerate(xy):
        near = located(path, point, near)[0]
        result[k] = near
    return result


def change_onto(target: Path, present: Path, at_m: float, length_m: float) -> tuple[Path, float]:
    """A path that leaves another where a vehicle is and swings onto a third, as a lane change does.

    Args:
        target: The path to get onto; it runs parallel to the present one here.
        present: The path that the vehicle is on.
        at_m: Where on it, m.
        length_m: Distance along the target over which to change, m.

    Returns:
        The path, and the vehicle's position on it. Until most of the change is done the old lanes are occupied too.
    """
    place = min(max(at_m / present.step_m, 0.0), len(present.curve.xy) - 1.001)
    index, share = int(place), place - int(place)
    xy = present.curve.xy[index] * (1 - share) + present.curve.xy[index + 1] * share
    heading = float(present.curve.heading[index] * (1 - share) + present.curve.heading[index + 1] * share)
    along, aside, direction = located(target, xy)
    turned = float(np.clip(wrap(heading - direction), -0.6, 0.6))
    old = target.step_m * np.arange(len(target.curve.xy))
    offset = quintic_step(old, (along, aside, math.tan(turned)), length_m)
    own = {span.lane for span in target.spans}
    left = along + _LEFT_SHARE * length_m
    occupied = tuple(
        Occupied(
            s.lane, along + s.begin_m - at_m, s.scale, along - 6.0, min(left, along + s.end_m - at_m + 2.0)
        )
        for s in present.spans
        if s.lane not in own and s.end_m > at_m - 3.0 and s.begin_m < at_m + length_m and s.until_m > at_m
    )
    path, new = displaced(target, offset, occupied)
    return path, float(np.interp(along, old, new))


def around(
    path: Path, at_m: tuple[float, float, float, float], aside_m: float, adjacent: tuple[Occupied, ...] = ()
) -> Path:
    """A path with a bulge to one side: out from the first to the second position, back from the third to the last.

    Args:
        path: The path.
        at_m: The four positions, rising.
        aside_m: Offset in between, positive to the left.
        adjacent: Lanes into which the bulge reaches.
    """
    old = path.step_m * np.arange(len(path.curve.xy))
    out = 1.0 - quintic_step(old, (at_m[0], 1.0, 0.0), at_m[1] - at_m[0])
    back = quintic_step(old, (at_m[2], 1.0, 0.0), at_m[3] - at_m[2])
    return displaced(path, aside_m * out * back, adjacent if abs(aside_m) > _INTRUDES_M else ())[0]
