"""Oriented rectangles: corners, overlap, gap, and time to overlap.

A box is an array ``[..., 6]`` of (x, y, cos heading, sin heading, length, width) in metres. Functions broadcast over
leading axes and take NumPy or JAX arrays.
"""

from __future__ import annotations

from functools import reduce
from operator import and_
from typing import Any

from drivax.geometry.vectors import root

#: Corners in units of half length and half width: front left, front right, rear right, rear left.
_CORNERS = ((1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0))
X, Y, COS, SIN, LENGTH, WIDTH = range(6)


def corners(box: Any) -> Any:
    """Return corner points ``[..., 4, 2]``: front left, front right, rear right, rear left."""
    xp = box.__array_namespace__()
    return xp.stack([xp.stack(_corner(box, *corner), axis=-1) for corner in _CORNERS], axis=-2)


def _corner(box: Any, ahead: float, left: float) -> tuple[Any, Any]:
    """Return x and y of the corner that is ``ahead`` half lengths ahead and ``left`` half widths to the left."""
    cos, sin = box[..., COS], box[..., SIN]
    dx, dy = ahead * (box[..., LENGTH] / 2), left * (box[..., WIDTH] / 2)
    return box[..., X] + dx * cos - dy * sin, box[..., Y] + dx * sin + dy * cos


def _axis_terms(a: Any, b: Any) -> tuple[tuple[Any, Any, Any], ...]:
    """Return the four separating axes of two boxes: (axis x, axis y, sum of the half extents along it)."""
    ca, sa, cb, sb = a[..., COS], a[..., SIN], b[..., COS], b[..., SIN]
    la, wa, lb, wb = a[..., LENGTH] / 2, a[..., WIDTH] / 2, b[..., LENGTH] / 2, b[..., WIDTH] / 2
    cos, sin = abs(ca * cb + sa * sb), abs(ca * sb - sa * cb)
    return (
        (ca, sa, la + lb * cos + wb * sin),
        (-sa, ca, wa + lb * sin + wb * cos),
        (cb, sb, lb + la * cos + wa * sin),
        (-sb, cb, wb + la * sin + wa * cos),
    )


def overlap(a: Any, b: Any) -> Any:
    """Return whether boxes share interior points (separating axis theorem; touching is no overlap)."""
    dx, dy = b[..., X] - a[..., X], b[..., Y] - a[..., Y]
    return reduce(
        and_, (abs(dx * axis_x + dy * axis_y) < reach for axis_x, axis_y, reach in _axis_terms(a, b))
    )


def passage(start: Any, end: Any, box: Any) -> tuple[Any, Any]:
    """Return the fractions of segments ``start`` to ``end`` (``[..., 2]``) at which they enter and leave boxes.

    A segment passes through the box if the first fraction is smaller than the second. If it does, both are in [0, 1]
    (slab test). A segment along a side may count as passing or not.
    """
    xp = box.__array_namespace__()
    cos, sin = box[..., COS], box[..., SIN]

    def to_local(point: Any) -> tuple[Any, Any]:
        x, y = point[..., 0] - box[..., X], point[..., 1] - box[..., Y]
        return x * cos + y * sin, y * cos - x * sin

    t_enter, t_leave = 0.0, 1.0
    halves = (box[..., LENGTH] / 2, box[..., WIDTH] / 2)
    for begin, stop, half in zip(to_local(start), to_local(end), halves, strict=True):
        step = stop - begin
        # A segment parallel to these two sides gets a tiny step: it lies between them throughout, or never.
        step = xp.where(abs(step) < 1e-9, xp.full_like(step, 1e-9), step)
        first, second = (-half - begin) / step, (half - begin) / step
        low, high = xp.minimum(first, second), xp.maximum(first, second)
        t_enter, t_leave = xp.maximum(low, t_enter), xp.minimum(high, t_leave)
    return t_enter, t_leave


def gap(a: Any, b: Any) -> Any:
    """Return the smallest distance between boxes, m: from one box to a corner of the other, or 0 if they overlap."""
    xp = a.__array_namespace__()
    squared = xp.minimum(_squared_corner_distance(a, b), _squared_corner_distance(b, a))
    return root(xp.where(overlap(a, b), xp.zeros_like(squared), squared))


def _squared_corner_distance(box: Any, other: Any) -> Any:
    """Return the squared distance from ``box`` to the nearest corner of ``other``, m2; 0 for a corner inside."""
    xp = box.__array_namespace__()
    nearest = None
    # Corner by corner: XLA vectorises this, but not an array of corners.
    for corner in _CORNERS:
        x, y = _corner(other, *corner)
        dx, dy = x - box[..., X], y - box[..., Y]
        ahead, left = dx * box[..., COS] + dy * box[..., SIN], dy * box[..., COS] - dx * box[..., SIN]
        lengthwise = xp.maximum(abs(ahead) - box[..., LENGTH] / 2, xp.zeros_like(ahead))
        sideways = xp.maximum(abs(left) - box[..., WIDTH] / 2, xp.zeros_like(left))
        squared = lengthwise * lengthwise + sideways * sideways
        nearest = squared if nearest is None else xp.minimum(nearest, squared)
    return nearest


def overlap_within(a: Any, velocity_a: Any, b: Any, velocity_b: Any, horizon_s: float) -> Any:
    """Return whether boxes overlap within a horizon at constant velocities and fixed headings.

    Separating axis theorem for ``a`` and the area that ``b`` sweeps relative to it: the axes of both boxes and the
    normal of the relative velocity. Equal to ``time_to_overlap(...) < horizon_s`` for positive horizons, without
    divisions, but a corner that only touches the other box in passing counts as overlap.
    """
    half_s = horizon_s / 2
    sweep_x, sweep_y = ((velocity_b[..., axis] - velocity_a[..., axis]) * half_s for axis in (0, 1))
    dx, dy = b[..., X] - a[..., X] + sweep_x, b[..., Y] - a[..., Y] + sweep_y
    extent = sum(
        abs(box[..., COS] * sweep_y - box[..., SIN] * sweep_x) * (box[..., LENGTH] / 2)
        + abs(box[..., SIN] * sweep_y + box[..., COS] * sweep_x) * (box[..., WIDTH] / 2)
        for box in (a, b)
    )
    # Without relative motion the normal is zero: both sides are 0, so it excludes nothing.
    result = abs(dy * sweep_x - dx * sweep_y) <= extent
    for axis_x, axis_y, reach in _axis_terms(a, b):
        result &= abs(dx * axis_x + dy * axis_y) < reach + abs(sweep_x * axis_x + sweep_y * axis_y)
    return result


def time_to_overlap(a: Any, velocity_a: Any, b: Any, velocity_b: Any, horizon_s: float) -> Any:
    """Return the first time (s) at which two boxes overlap at constant velocities and fixed headings, in closed form.

    On each separating axis the centre distance is linear in time, so the boxes overlap on that axis during one
    interval; they overlap in the plane during the intersection of the four (swept separating axis theorem). Velocities
    ``[..., 2]`` are those of the centres, m/s. The time is 0 for boxes that overlap now, and ``horizon_s`` for boxes
    that do not overlap within the horizon.
    """
    xp = a.__array_namespace__()
    dx, dy = b[..., X] - a[..., X], b[..., Y] - a[..., Y]
    vx, vy = velocity_b[..., 0] - velocity_a[..., 0], velocity_b[..., 1] - velocity_a[..., 1]
    never = xp.full_like(dx, horizon_s)
    begin, end = xp.zeros_like(dx), never
    for axis_x, axis_y, reach in _axis_terms(a, b):
        distance, speed = dx * axis_x + dy * axis_y, vx * axis_x + vy * axis_y
        is_moving = abs(speed) > 1e-9
        # At rest on this axis, any divisor serves: the result is not selected.
        inverse = 1.0 / xp.where(is_moving, speed, xp.ones_like(speed))
        first, second = (-reach - distance) * inverse, (reach - distance) * inverse
        overlaps = abs(distance) < reach
        enter = xp.where(is_moving, xp.minimum(first, second), xp.where(overlaps, xp.zeros_like(dx), never))
        leave = xp.where(is_moving, xp.maximum(first, second), never)
        begin, end = xp.maximum(begin, enter), xp.minimum(end, leave)
    return xp.where(begin < end, begin, never)
