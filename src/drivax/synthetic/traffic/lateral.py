"""Paths that leave lane centres: lane changes, and detours around obstacles."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from drivax.geometry.polylines import left_normals
from drivax.geometry.vectors import wrap
from drivax.synthetic.roads.curves import STEP_M, Curve
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.obstacles import Boxes, Extents, extents
from drivax.synthetic.traffic.path_arrays import PathTables
from drivax.synthetic.traffic.paths import SLOTS, LaneSpan, Path, interpolate_curve, mean_curvature

#: Distance from an obstacle at which drivers start to look for a detour, m.
LOOK_M = 45.0
#: Lateral distance from a vehicle's side within which an obstacle blocks it, and lateral gap to it in passing, m.
DETOUR_MARGIN_M, _PASSING_GAP_M = 0.3, 0.55
#: Largest offset of a detour, m, and least distance along the road per metre of offset.
_MAX_OFFSET_M, _MIN_RATIO = 4.3, 2.2
#: Distance ahead over which a detour occupies adjacent lanes, m.
_ADJACENT_M = 60.0
#: Distance kept to the road's edge, m, and speed at which obstacles are passed, m/s.
_EDGE_M, _PASS_MPS = 0.2, 6.0
#: Gap to the first obstacle at the end of the way out, and to the last one at the beginning of the way back, m.
_GAP_BEFORE_M, _GAP_BEHIND_M = 0.3, 0.5
#: Length of the way out (less where there is no room) and back: the larger of a multiple of the shortest possible one
#: and a travel time, s.
_OUT_FACTOR, _BACK_FACTOR, _OUT_S, _BACK_S = 2.0, 1.6, 2.4, 2.0
#: Least length of the path after a detour, m.
_END_MARGIN_M = 5.0
#: Share of a lane change after which a vehicle has left the old lane.
_EXIT_SHARE = 0.75
#: Lateral offset from which on a vehicle occupies the adjacent lane, m.
_INTRUSION_M = 0.7

_Samples = Float64[np.ndarray, " point"]
_Point = Float64[np.ndarray, " 2"]


def displace_path(
    path: Path, aside_m: _Samples, occupied: tuple[LaneSpan, ...] = ()
) -> tuple[Path, _Samples]:
    """Displace a path to the left by a smooth offset at each sample.

    ``occupied`` are further lanes that the vehicle occupies, in positions of the old path.

    Returns:
        The new path, and the position on it of each sample of the old one, m.
    """
    curve, step = path.curve, path.step_m
    slope = np.gradient(aside_m, step)
    stretch = np.maximum(1.0 - aside_m * np.gradient(curve.heading, step), 0.1)
    xy = curve.xy + aside_m[:, None] * left_normals(curve.heading)
    new_curve = Curve(xy, curve.heading + np.arctan2(slope, stretch))
    old_m = step * np.arange(len(xy))
    new_m = new_curve.arc_m
    count = max(2, round(float(new_m[-1]) / STEP_M) + 1)
    position = np.linspace(0.0, new_m[-1], count)
    source = np.interp(position, new_m, old_m)
    index = np.rint(source / step).astype(int)
    lane = path.lane.take(index, axis=0)
    lane_m = path.lane_m.take(index, axis=0) + np.where(lane >= 0, (source - index * step)[:, None], 0.0)
    for span in occupied:
        _enter_span(span, source, lane, lane_m)
    new_curve, step = interpolate_curve(new_curve, new_m, position), float(new_m[-1]) / (count - 1)
    spans = _displaced_spans(path, occupied, old_m, new_m)
    curvature = mean_curvature(new_curve, step)
    return Path(new_curve, step, curvature, path.limit_mps[index], spans, lane, lane_m), new_m


def _displaced_spans(
    path: Path, occupied: tuple[LaneSpan, ...], old_m: _Samples, new_m: _Samples
) -> tuple[LaneSpan, ...]:
    """Lane spans of a displaced path, whose samples moved from the old to the new positions."""

    def to_new(metres: float) -> float:
        if not math.isfinite(metres) or metres < 0.0:
            return metres
        return float(np.interp(metres, old_m, new_m)) + max(metres - float(old_m[-1]), 0.0)

    # A span is anchored at its end: what lies ahead of the displacement stays in place.
    shifts = [to_new(span.end_m) - span.end_m for span in path.spans]
    spans = [
        replace(
            s, begin_m=s.begin_m + by, end_m=s.end_m + by, from_m=to_new(s.from_m), until_m=to_new(s.until_m)
        )
        for s, by in zip(path.spans, shifts, strict=True)
    ]
    for s in occupied:
        end = to_new(s.until_m)
        spans.append(LaneSpan(s.lane, s.begin_m + end - s.until_m, s.scale, to_new(s.from_m), end, end))
    return tuple(spans)


def _enter_span(
    span: LaneSpan, source: _Samples, lane: np.ndarray, lane_m: Float64[np.ndarray, "point slot"]
) -> None:
    """Enter a lane into the first free slot of the samples on which it is occupied, if there is a free one."""
    is_occupied = (source >= span.from_m) & (source <= span.until_m) & ~(lane == span.lane).any(axis=1)
    for slot in range(SLOTS):
        is_free = is_occupied & (lane[:, slot] < 0)
        lane[is_free, slot] = span.lane
        lane_m[is_free, slot] = (source[is_free] - span.begin_m) / span.scale
        is_occupied &= ~is_free


def quintic_step(at: _Samples, begin: tuple[float, float, float], length_m: float) -> _Samples:
    """Offset that fades to zero, with zero slope and curvature at the end, over a length.

    ``begin`` is the first position, with the offset (m) and slope (m/m) there; the second derivative is zero. Before it
    the offset is linear with this slope, at most 10 m back.
    """
    start_m, offset, slope = begin
    u = np.clip((at - start_m) / length_m, 0.0, 1.0)
    rate = slope * length_m
    # Hermite basis of degree five: value and slope at 0; everything else is zero.
    value = 1 - 10 * u**3 + 15 * u**4 - 6 * u**5
    tangent = u - 6 * u**3 + 8 * u**4 - 3 * u**5
    before = np.clip(at - start_m, -10.0, 0.0)
    return np.where(at < start_m, offset + slope * before, offset * value + rate * tangent)


def project_on_path(path: Path, xy: _Point, near_m: float | None = None) -> tuple[float, float, float]:
    """Project a point onto a path, within 30 m of the position ``near_m`` if there is one.

    Returns:
        Position along the path and offset to its left, m, and the path's heading there.
    """
    first, last = 0, len(path.curve.xy)
    if near_m is not None:
        first = max(0, int((near_m - 30.0) / path.step_m))
        last = max(first + 2, int((near_m + 30.0) / path.step_m))
    gap_x, gap_y = (xy - path.curve.xy[first:last]).T
    index = first + int(np.argmin(gap_x**2 + gap_y**2))
    heading = float(path.curve.heading[index])
    dx, dy = xy - path.curve.xy[index]
    along = dx * math.cos(heading) + dy * math.sin(heading)
    return index * path.step_m + float(along), float(dy * math.cos(heading) - dx * math.sin(heading)), heading


def positions_along(path: Path, xy: Float64[np.ndarray, "time 2"]) -> Float64[np.ndarray, " time"]:
    """Return the positions along a path of a moving point, m."""
    result, near = np.zeros(len(xy)), None
    for k, point in enumerate(xy):
        near = project_on_path(path, point, near)[0]
        result[k] = near
    return result


def lane_change_path(target: Path, present: Path, at_m: float, length_m: float) -> tuple[Path, float]:
    """Build the path of a lane change from a position on the present path to a parallel one.

    The old lanes stay occupied for most of the change.

    Returns:
        The path, and the vehicle's position on it.
    """
    sample = min(max(at_m / present.step_m, 0.0), len(present.curve.xy) - 1.001)
    index, share = int(sample), sample - int(sample)
    xy = present.curve.xy[index] * (1 - share) + present.curve.xy[index + 1] * share
    heading = float(present.curve.heading[index] * (1 - share) + present.curve.heading[index + 1] * share)
    along, lateral, direction = project_on_path(target, xy)
    relative_heading = float(np.clip(wrap(heading - direction), -0.6, 0.6))
    old_m = target.step_m * np.arange(len(target.curve.xy))
    offset = quintic_step(old_m, (along, lateral, math.tan(relative_heading)), length_m)
    lanes = {span.lane for span in target.spans}
    exit_m = along + _EXIT_SHARE * length_m
    occupied = tuple(
        LaneSpan(
            s.lane, along + s.begin_m - at_m, s.scale, along - 6.0, min(exit_m, along + s.end_m - at_m + 2.0)
        )
        for s in present.spans
        if s.lane not in lanes and s.end_m > at_m - 3.0 and s.begin_m < at_m + length_m and s.until_m > at_m
    )
    path, new_m = displace_path(target, offset, occupied)
    return path, float(np.interp(along, old_m, new_m))


class DetourPositions(NamedTuple):
    """Path positions of a detour: beginning and end of the way out, beginning and end of the way back, m."""

    begin: float
    out_end: float
    back_begin: float
    end: float


def detour_path(
    path: Path, positions: DetourPositions, aside_m: float, adjacent: tuple[LaneSpan, ...] = ()
) -> Path:
    """Build a detour to the left by ``aside_m``; beyond 0.7 m to either side it occupies all ``adjacent`` lanes."""
    begin, out_end, back_begin, end = positions
    position = path.step_m * np.arange(len(path.curve.xy))
    out = 1.0 - quintic_step(position, (begin, 1.0, 0.0), out_end - begin)
    back = quintic_step(position, (back_begin, 1.0, 0.0), end - back_begin)
    return displace_path(path, aside_m * out * back, adjacent if abs(aside_m) > _INTRUSION_M else ())[0]


@dataclass(frozen=True)
class DetourRequest:
    """A vehicle that looks for a detour: path position, speed, size, and adjacent lanes of its direction."""

    path: Path
    at_m: float
    speed: float
    size_m: tuple[float, float]
    adjacent: tuple[LaneSpan, ...] = ()


def detour_request(
    tables: PathTables, row: int, position: float, speed: float, size_m: tuple[float, float]
) -> DetourRequest:
    """Build the request of a vehicle at a path position and speed."""
    adjacent, world = [], tables.worlds.world[row]
    network = tables.worlds.networks[world]
    lane, along = tables.lanes_at(np.array([position]), slice(row, row + 1))
    if lane[0, 0] >= 0:
        current = network.lanes[lane[0, 0] - tables.worlds.first_lane[world]]
        for other in (current.left, current.right):
            if other >= 0:
                scale = current.length_m / network.lanes[other].length_m
                adjacent.append(
                    LaneSpan(other, position - float(along[0, 0]), scale, position, position + _ADJACENT_M)
                )
    return DetourRequest(tables.paths[row], position, speed, size_m, tuple(adjacent))


class Detours:
    """Search for detours around standing obstacles."""

    def __init__(self, network: RoadNetwork) -> None:
        xy = np.concatenate([np.zeros((0, 2)), *(_densify(edge.xy) for edge in network.edges)])
        self._edge = Boxes(xy, np.zeros(len(xy)), np.zeros(len(xy)), np.zeros((len(xy), 2)))

    def find(self, request: DetourRequest, standing: Boxes, moving: Boxes) -> tuple[Path, float] | None:
        """Return a path around the next obstacles, and the old position (m) where it rejoins, or None without one."""
        half_width, half_length = request.size_m[1] / 2, request.size_m[0] / 2
        obstacles, _ = _extents(request, standing, request.at_m, LOOK_M + 40.0)
        front, side = request.at_m + half_length, half_width + DETOUR_MARGIN_M
        is_blocking = (obstacles.right_m < side) & (obstacles.left_m > -side)
        is_blocking &= obstacles.near_m > front - 0.5
        if not is_blocking.any():
            return None
        first_m = float(obstacles.near_m[is_blocking].min())
        if not 2.0 < first_m - front < LOOK_M:
            return None
        last_m = first_m
        for k in np.argsort(obstacles.near_m, kind="stable"):
            if is_blocking[k] and obstacles.near_m[k] < last_m + 2 * half_length + 14.0:
                last_m = max(last_m, float(obstacles.far_m[k]))
        is_passed = is_blocking & (obstacles.near_m <= last_m)
        left = float(obstacles.left_m[is_passed].max()) + half_width + _PASSING_GAP_M
        right = float(obstacles.right_m[is_passed].min()) - half_width - _PASSING_GAP_M
        for lateral in sorted([left, right], key=abs):
            positions = _detour_positions(request, first_m, last_m, lateral)
            if positions is not None and self._is_free(request, positions, lateral, obstacles, moving):
                return detour_path(request.path, positions, lateral, request.adjacent), positions.end
        return None

    def _is_free(
        self, request: DetourRequest, positions: DetourPositions, lateral: float, obstacles: Extents,
        moving: Boxes,
    ) -> bool:  # fmt: skip
        """Return whether the detour avoids edges, standing obstacles, and oncoming, crossing or overtaking users."""
        begin, out_end, back_begin, end = positions
        half = request.size_m[1] / 2
        low, high = lateral - half - _EDGE_M, lateral + half + _EDGE_M
        is_blocking = (obstacles.near_m < back_begin) & (obstacles.far_m > out_end)
        is_blocking &= (obstacles.right_m < high) & (obstacles.left_m > low)
        edges, _ = _extents(request, self._edge, (out_end + back_begin) / 2, (end - begin) / 2 + 15.0)
        is_edge_near = (edges.near_m > out_end) & (edges.near_m < back_begin)
        is_edge_near &= (edges.left_m > min(low, -half)) & (edges.right_m < max(high, half))
        if is_blocking.any() or is_edge_near.any():
            return False
        path, position = request.path, request.at_m
        duration_s = (end - position) / max(request.speed, _PASS_MPS) + 1.0
        others, users = _extents(request, moving, (position + end) / 2, end - position + 90.0, within_m=6.0)
        middle = np.clip((others.near_m + others.far_m) / 2, 0, path.length_m)
        relative_heading = wrap(users.heading - path.curve.heading[np.rint(middle / path.step_m).astype(int)])
        speed = users.speed * np.cos(relative_heading)
        is_in_corridor = (others.right_m < high + 0.3) & (others.left_m > low - 0.3)
        nearest_m = others.near_m + np.minimum(speed, 0.0) * duration_s
        is_ahead = (others.far_m > position) & (nearest_m < end + 5.0)
        is_behind = (others.far_m <= position) & (others.far_m + speed * 3.0 > position - 6.0)
        # A user beyond the detour that drives on is a leader, not a conflict.
        is_ahead &= ~((speed > 1.0) & (others.near_m > back_begin))
        return not bool(np.any(is_in_corridor & (is_ahead | is_behind)))


def _detour_positions(
    request: DetourRequest, first_m: float, last_m: float, lateral_m: float
) -> DetourPositions | None:
    """Return the positions of a detour around obstacles from ``first_m`` to ``last_m`` of the path.

    None if the offset ``lateral_m`` is too large, the rest of the way out is too steep, or the path ends too soon.
    """
    half_length, offset_m = request.size_m[0] / 2, abs(lateral_m)
    out_end = first_m - half_length - _GAP_BEFORE_M
    begin = max(request.at_m, out_end - max(_MIN_RATIO * _OUT_FACTOR * offset_m, _OUT_S * request.speed))
    back_begin = last_m + half_length + _GAP_BEHIND_M
    end = back_begin + max(_MIN_RATIO * _BACK_FACTOR * offset_m, _BACK_S * min(request.speed, _PASS_MPS))
    is_steep, is_short = out_end - begin < _MIN_RATIO * offset_m, end > request.path.length_m - _END_MARGIN_M
    if offset_m > _MAX_OFFSET_M or is_steep or is_short:
        return None
    return DetourPositions(begin, out_end, back_begin, end)


def _densify(ring: Float64[np.ndarray, "point 2"]) -> Float64[np.ndarray, "dense 2"]:
    """Return a closed ring with points at most a metre apart."""
    closed = np.concatenate([ring, ring[:1]])
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    position = np.linspace(0.0, arc[-1], int(arc[-1]) + 2)
    return np.stack([np.interp(position, arc, closed[:, k]) for k in (0, 1)], axis=-1)


def _extents(
    request: DetourRequest, boxes: Boxes, at_m: float, radius_m: float, within_m: float = 12.0
) -> tuple[Extents, Boxes]:
    """Return the extents along the path of the boxes within a radius of a position on it, and these boxes."""
    path = request.path
    centre = path.curve.xy[min(int(max(at_m, 0.0) / path.step_m), len(path.curve.xy) - 1)]
    near_boxes = boxes.select(np.sum((boxes.xy - centre) ** 2, axis=1) < radius_m**2)
    obstacles, rows = extents(path, near_boxes, within_m)
    return obstacles, near_boxes.select(rows)
