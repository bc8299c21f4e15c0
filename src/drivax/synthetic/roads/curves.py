"""Smooth plane curves of roads: positions and tangent headings, sampled at about 0.5 m."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Float64

from drivax.geometry.polylines import left_normals
from drivax.geometry.vectors import wrap

#: Distance between the samples of a curve, m: chords stay within 3.2 mm of an arc of 10 m radius.
STEP_M = 0.5
#: Change of heading below which a quintic joins two poses, and above which a fillet does.
_FILLET_ANGLE = math.radians(25.0)
#: Length up to which straight remainders are dropped, m.
_SHORTEST_M = 1e-3


@dataclass(frozen=True)
class Pose:
    """Position and heading: metres and radians CCW from +x."""

    x: float
    y: float
    heading: float

    def ahead(self, metres: float) -> Pose:
        """Pose at a distance straight ahead."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return Pose(self.x + metres * cos, self.y + metres * sin, self.heading)

    def shift_left(self, left_m: float) -> Pose:
        """Pose at a distance to the left (negative: right)."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return Pose(self.x - left_m * sin, self.y + left_m * cos, self.heading)

    def reverse(self) -> Pose:
        """Pose at the same place with the opposite heading."""
        return Pose(self.x, self.y, self.heading + math.pi)


@dataclass(frozen=True)
class Curve:
    """Sampled curve: points in metres and unwrapped tangent headings in radians."""

    xy: Float64[np.ndarray, "point 2"]
    heading: Float64[np.ndarray, " point"]

    @cached_property
    def arc_m(self) -> Float64[np.ndarray, " point"]:
        """Distance along the chords from the first point to each point, m."""
        arc, steps = np.zeros(len(self.xy)), self.xy[1:] - self.xy[:-1]
        np.cumsum(np.hypot(steps[:, 0], steps[:, 1]), out=arc[1:])
        arc.flags.writeable = False
        return arc

    @cached_property
    def normal(self) -> Float64[np.ndarray, "point 2"]:
        """Unit vectors to the left."""
        return left_normals(self.heading)

    @cached_property
    def bend(self) -> Float64[np.ndarray, " point"]:
        """Curvature: change of the heading per metre of arc."""
        # The bound moves the first sample by a nanometre and has no use, but the bits of stored sets depend on it.
        return gradient(self.heading, np.maximum(self.arc_m, 1e-9))

    @property
    def start(self) -> Pose:
        """First pose."""
        return self.pose(0)

    @property
    def end(self) -> Pose:
        """Last pose."""
        return self.pose(-1)

    def pose(self, sample: int) -> Pose:
        """Pose at a sample."""
        return Pose(float(self.xy[sample, 0]), float(self.xy[sample, 1]), float(self.heading[sample]))

    def at(
        self, along_m: Float64[np.ndarray, " n"]
    ) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
        """Positions and headings at distances along the curve, interpolated linearly; beyond an end, that end."""
        return interpolate(along_m, self.arc_m, self.xy), np.interp(along_m, self.arc_m, self.heading)

    def parallel(self, left_m: float) -> Curve:
        """Parallel curve at a distance to the left (negative: right)."""
        return Curve(self.xy + left_m * self.normal, self.heading)

    def offset_by(self, left_m: Float64[np.ndarray, " point"]) -> Curve:
        """Curve at a distance to the left that varies along it, with its own tangent headings.

        With arc length s, curvature k and displacement d the tangent turns by ``atan2(dd/ds, 1 - d k)``.
        """
        stretch = 1.0 - left_m * gradient(self.heading, self.arc_m)
        slope = gradient(left_m, self.arc_m)
        xy = self.xy + left_m[:, None] * self.normal
        return Curve(xy, self.heading + np.arctan2(slope, stretch))

    def reverse(self) -> Curve:
        """Curve in the other direction."""
        return Curve(self.xy[::-1].copy(), self.heading[::-1] + math.pi)

    def piece(self, first: int, last: int) -> Curve:
        """Samples ``first`` to ``last``, both included."""
        return Curve(self.xy[first : last + 1], self.heading[first : last + 1])


def interpolate(
    along_m: Float64[np.ndarray, " n"],
    arc_m: Float64[np.ndarray, " point"],
    xy: Float64[np.ndarray, "point 2"],
) -> Float64[np.ndarray, "n 2"]:
    """Positions at distances along a polyline whose points lie at ``arc_m``."""
    result = np.empty((len(along_m), 2))
    for k in (0, 1):
        result[:, k] = np.interp(along_m, arc_m, xy[:, k])
    return result


def gradient(
    values: Float64[np.ndarray, " point"], at_m: Float64[np.ndarray, " point"]
) -> Float64[np.ndarray, " point"]:
    """Derivative of values at positions by central differences: ``np.gradient`` without its checks."""
    steps, result = at_m[1:] - at_m[:-1], np.empty_like(values)
    before, after, change = steps[:-1], steps[1:], values[1:] - values[:-1]
    if (steps == steps[0]).all():
        result[1:-1] = (values[2:] - values[:-2]) / (2.0 * steps[0])
    else:
        width = before + after
        result[1:-1] = -after / (before * width) * values[:-2]
        result[1:-1] += (after - before) / (before * after) * values[1:-1]
        result[1:-1] += before / (after * width) * values[2:]
    result[0], result[-1] = change[0] / steps[0], change[-1] / steps[-1]
    return result


def smooth_step(share: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    """Quintic step from 0 to 1, ``10 t^3 - 15 t^4 + 6 t^5`` of the clipped share: no slope or curvature at its ends."""
    t = np.clip(share, 0.0, 1.0)
    return t**3 * (10 - 15 * t + 6 * t**2)


def from_curvature(curvature: Float64[np.ndarray, " point"], step_m: float, start: Pose) -> Curve:
    """Integrate curvature (1/m, one value per sample) to a curve by the midpoint rule."""
    heading, xy = np.zeros(len(curvature)), np.zeros((len(curvature), 2))
    np.cumsum((curvature[1:] + curvature[:-1]) * (step_m / 2), out=heading[1:])
    heading += start.heading
    middle = (heading[1:] + heading[:-1]) / 2
    np.cumsum(step_m * np.cos(middle), out=xy[1:, 0])
    np.cumsum(step_m * np.sin(middle), out=xy[1:, 1])
    xy += (start.x, start.y)
    return Curve(xy, heading)


def straight(start: Pose, length_m: float) -> Curve:
    """Straight line."""
    count = max(2, math.ceil(length_m / STEP_M) + 1)
    position = np.linspace(0.0, length_m, count)
    xy = np.column_stack(
        [start.x + position * math.cos(start.heading), start.y + position * math.sin(start.heading)]
    )
    return Curve(xy, np.full(count, start.heading))


def join_curves(*curves: Curve) -> Curve:
    """Concatenate curves, each of which begins where the previous one ends."""
    xy, heading = [curves[0].xy], [curves[0].heading]
    for curve in curves[1:]:
        # Unwrap the headings.
        jump = heading[-1][-1] - curve.heading[0]
        xy.append(curve.xy[1:])
        heading.append(curve.heading[1:] + 2 * math.pi * round(jump / (2 * math.pi)))
    return Curve(np.concatenate(xy), np.concatenate(heading))


def resample(curve: Curve, step_m: float) -> Curve:
    """Resample a curve at equal distances of about ``step_m`` along its chords; both ends are kept."""
    length = float(curve.arc_m[-1])
    last = max(1, round(length / step_m))
    position = np.arange(last + 1) * (length / last)
    position[-1] = length
    return Curve(*curve.at(position))


def turn(start: Pose, angle: float, tangent_m: float, easing: float = 0.3) -> Curve:
    """Bend of clothoid, arc and clothoid by an angle (rad, positive to the left).

    The tangents of both ends meet at the corner, ``tangent_m`` after the start and before the end; ``easing`` is the
    share of the length in each of the two clothoids.
    """
    length = tangent_m / _unit_tangent(angle, easing)
    # Integrate at an eighth of the step: the end meets the tangent point within 2 mm.
    count = 8 * max(4, math.ceil(length / STEP_M))
    fine = _eased_bend(start, angle, length, easing, count + 1)
    return Curve(fine.xy[::8], fine.heading[::8])


def _eased_bend(start: Pose, angle: float, length_m: float, easing: float, count: int) -> Curve:
    """Return the bend of :func:`turn` with a given length and number of samples."""
    share = np.linspace(0.0, 1.0, count)
    ramp = np.minimum(1.0, np.minimum(share, 1.0 - share) / easing)
    curvature = ramp * (angle / float(np.trapezoid(ramp, share)) / length_m)
    return from_curvature(curvature, length_m / (count - 1), start)


@lru_cache(maxsize=256)
def _unit_tangent(angle: float, easing: float) -> float:
    """Length of the tangents of a bend of unit length; the bends of a junction often have equal angles."""
    unit = _eased_bend(Pose(0.0, 0.0, 0.0), angle, 1.0, easing, 513)
    return math.hypot(*unit.xy[-1]) / 2 / math.cos(angle / 2)


def quintic(start: Pose, end: Pose) -> Curve:
    """Fifth-order Hermite curve between nearly parallel poses, with zero curvature at both."""
    chord = math.hypot(end.x - start.x, end.y - start.y)
    t = np.linspace(0.0, 1.0, max(8, math.ceil(chord / STEP_M) * 4))[:, None]
    p0, p1 = np.array([start.x, start.y]), np.array([end.x, end.y])
    d0 = chord * np.array([math.cos(start.heading), math.sin(start.heading)])
    d1 = chord * np.array([math.cos(end.heading), math.sin(end.heading)])
    step = smooth_step(t)
    step_rate = 30 * t**2 - 60 * t**3 + 30 * t**4
    first, first_rate = t - 6 * t**3 + 8 * t**4 - 3 * t**5, 1 - 18 * t**2 + 32 * t**3 - 15 * t**4
    last, last_rate = -4 * t**3 + 7 * t**4 - 3 * t**5, -12 * t**2 + 28 * t**3 - 15 * t**4
    xy = p0 + (p1 - p0) * step + d0 * first + d1 * last
    rate = (p1 - p0) * step_rate + d0 * first_rate + d1 * last_rate
    heading = start.heading + wrap(np.arctan2(rate[:, 1], rate[:, 0]) - start.heading)
    return resample(Curve(xy, heading), STEP_M)


def tangent_lengths(start: Pose, end: Pose, sin: float) -> tuple[float, float]:
    """Return the distances ahead of ``start`` and behind ``end`` of the tangents' intersection.

    ``sin`` is the sine of the turn between the headings. A distance on the other side of its pose is negative.
    """
    dx, dy = end.x - start.x, end.y - start.y
    before = (dx * math.sin(end.heading) - dy * math.cos(end.heading)) / sin
    return before, (dy * math.cos(start.heading) - dx * math.sin(start.heading)) / sin


def connect_poses(start: Pose, end: Pose) -> Curve:
    """Connect poses by a smooth curve: a fillet of the two tangents, or a quintic for small changes of heading.

    Raises:
        ValueError: The tangents of a fillet do not meet at least 1 m ahead of the start and behind the end.
    """
    angle = float(wrap(end.heading - start.heading))
    if abs(angle) < _FILLET_ANGLE:
        return quintic(start, end)
    before, after = tangent_lengths(start, end, math.sin(angle))
    tangent = min(before, after)
    if tangent < 1.0:
        raise ValueError("no single bend connects the poses: their tangents do not meet between them")
    pieces = [turn(start.ahead(before - tangent), angle, tangent)]
    if before - tangent > _SHORTEST_M:
        pieces.insert(0, straight(start, before - tangent))
    if after - tangent > _SHORTEST_M:
        pieces.append(straight(pieces[-1].end, after - tangent))
    return resample(join_curves(*pieces), STEP_M)


def draw_winding_curve(
    rng: np.random.Generator, length_m: float, *, max_curvature: float, max_turn: float, start: Pose
) -> Curve:
    """Draw a winding road: curvature is linear between random knots 35 to 90 m apart, and 0 at the start.

    Curvature is at most ``max_curvature`` (1/m). Headings differ by at most ``max_turn`` (rad): below pi the curve
    cannot intersect itself.
    """
    knots, values = [0.0], [0.0]
    while knots[-1] < length_m:
        knots.append(knots[-1] + rng.uniform(35.0, 90.0))
        # Five of six knots reverse the curvature: S-curves are common.
        sign = -np.sign(values[-1]) if rng.random() < 2 / 3 and values[-1] else rng.choice([-1.0, 1.0])
        values.append(float(sign) * max_curvature * float(rng.uniform(0.15, 1.0)))
    count = math.ceil(length_m / STEP_M) + 1
    position = np.arange(count) * STEP_M
    curvature = np.interp(position, knots, values)
    headings = np.concatenate([[0.0], np.cumsum((curvature[1:] + curvature[:-1]) * STEP_M / 2)])
    excess = float(np.ptp(headings)) / max_turn
    return from_curvature(curvature / max(1.0, excess), STEP_M, start)
