"""Paths that leave their lanes' centres: changes to another way from wherever a vehicle is, and ways around things."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from drivax.geometry.vectors import wrap
from drivax.synthetic.roads.curves import STEP_M, Curve
from drivax.synthetic.traffic.paths import SLOTS, LaneSpan, Path, smoothed_curvature

#: Share of a lane change after which a vehicle has left the old lane.
_LEFT_SHARE = 0.75
#: From this lateral offset on a vehicle takes up room in the lane beside, m.
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
    """Enters a lane into the first free slot of the samples on which it is taken up."""
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
    """Where a point is beside a path: position along it, offset to the left (m), and the path's heading there.

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


def change_onto(
    target: Path,
    present: Path,
    at_m: float,
    length_m: float,
) -> tuple[Path, float]:
    """A path that leaves another where a vehicle is and swings onto a third, as a lane change does.

    Args:
        target: The path to get onto; it runs beside the present one here.
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
    path: Path, at_m: tuple[float, float, float, float], aside_m: float, beside: tuple[Occupied, ...] = ()
) -> Path:
    """A path with a bulge to one side: out from the first to the second position, back from the third to the last.

    Args:
        path: The path.
        at_m: The four positions, rising.
        aside_m: Offset in between, positive to the left.
        beside: Lanes into which the bulge reaches.
    """
    old = path.step_m * np.arange(len(path.curve.xy))
    out = 1.0 - quintic_step(old, (at_m[0], 1.0, 0.0), at_m[1] - at_m[0])
    back = quintic_step(old, (at_m[2], 1.0, 0.0), at_m[3] - at_m[2])
    return displaced(path, aside_m * out * back, beside if abs(aside_m) > _INTRUDES_M else ())[0]
