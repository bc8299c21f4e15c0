"""Oriented rectangles: corners, overlap, and the time until two of them meet.

A box is an array ``[..., 6]`` of (x, y, cos heading, sin heading, length, width) in metres. Functions take numpy or
JAX arrays, broadcast over leading axes and return the same kind.
"""

from __future__ import annotations

from typing import Any

from drivax.geometry.vectors import root

#: Corners in units of half length and half width: front left, front right, rear right, rear left.
_CORNERS = ((1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0))
X, Y, COS, SIN, LENGTH, WIDTH = range(6)


def corners(box: Any) -> Any:
    """Corner points ``[..., 4, 2]``: front left, front right, rear right, rear left."""
    xp = box.__array_namespace__()
    cos, sin = box[..., COS], box[..., SIN]
    half_length, half_width = box[..., LENGTH] / 2, box[..., WIDTH] / 2
    points = []
    for ahead, left in _CORNERS:
        dx, dy = ahead * half_length, left * half_width
        points.append(
            xp.stack([box[..., X] + dx * cos - dy * sin, box[..., Y] + dx * sin + dy * cos], axis=-1)
        )
    return xp.stack(points, axis=-2)


def _axis_terms(a: Any, b: Any) -> tuple[tuple[Any, Any, Any], ...]:
    """The four separating axes of two boxes: (axis x, axis y, sum of the half extents along it)."""
    ca, sa, cb, sb = a[..., COS], a[..., SIN], b[..., COS], b[..., SIN]
    la, wa, lb, wb = a[..., LENGTH] / 2, a[..., WIDTH] / 2, b[..., LENGTH] / 2, b[..., WIDTH] / 2
    cos = abs(ca * cb + sa * sb)
    sin = abs(ca * sb - sa * cb)
    return (
        (ca, sa, la + lb * cos + wb * sin),
        (-sa, ca, wa + lb * sin + wb * cos),
        (cb, sb, lb + la * cos + wa * sin),
        (-sb, cb, wb + la * sin + wa * cos),
    )


def overlap(a: Any, b: Any) -> Any:
    """Whether two boxes share interior points (separating axis theorem; touching is not overlap)."""
    dx, dy = b[..., X] - a[..., X], b[..., Y] - a[..., Y]
    result = None
    for axis_x, axis_y, reach in _axis_terms(a, b):
        meets = abs(dx * axis_x + dy * axis_y) < reach
        result = meets if result is None else result & meets
    return result


def passage(start: Any, end: Any, box: Any) -> tuple[Any, Any]:
    """Where segments pass through boxes (slab test), as shares of the way from ``start`` to ``end``.

    Args:
        start: Points ``[..., 2]``.
        end: Points ``[..., 2]``.
        box: Boxes ``[..., 6]``.

    Returns:
        Shares in [0, 1] at which each segment enters and leaves; it passes through where the first is smaller.
    """
    xp = box.__array_namespace__()
    cos, sin = box[..., COS], box[..., SIN]

    def turned(point: Any) -> tuple[Any, Any]:
        x, y = point[..., 0] - box[..., X], point[..., 1] - box[..., Y]
        return x * cos + y * sin, y * cos - x * sin

    enters, leaves = None, None
    halves = (box[..., LENGTH] / 2, box[..., WIDTH] / 2)
    for begin, stop, half in zip(turned(start), turned(end), halves, strict=True):
        way = stop - begin
        way = xp.where(abs(way) < 1e-9, xp.full_like(way, 1e-9), way)
        first, second = (-half - begin) / way, (half - begin) / way
        low, high = xp.minimum(first, second), xp.maximum(first, second)
        enters = xp.maximum(low, xp.zeros_like(low)) if enters is None else xp.maximum(enters, low)
        leaves = xp.minimum(high, xp.ones_like(high)) if leaves is None else xp.minimum(leaves, high)
    return enters, leaves


def gap(a: Any, b: Any) -> Any:
    """Smallest distance between two boxes, m; 0 where they overlap.

    Of two convex polygons that are apart, a corner of one of them is nearest to the other.
    """
    xp = a.__array_namespace__()
    nearest = xp.minimum(_nearest_corner(a, b), _nearest_corner(b, a))
    return root(xp.where(overlap(a, b), xp.zeros_like(nearest), nearest))


def _nearest_corner(box: Any, other: Any) -> Any:
    """Squared distance of the corner of ``other`` that is nearest to ``box``, which is filled."""
    xp = box.__array_namespace__()
    points, box = corners(other), box[..., None, :]
    dx, dy = points[..., 0] - box[..., X], points[..., 1] - box[..., Y]
    ahead, left = dx * box[..., COS] + dy * box[..., SIN], dy * box[..., COS] - dx * box[..., SIN]
    beyond = xp.maximum(abs(ahead) - box[..., LENGTH] / 2, xp.zeros_like(ahead))
    beside = xp.maximum(abs(left) - box[..., WIDTH] / 2, xp.zeros_like(left))
    return xp.min(beyond * beyond + beside * beside, axis=-1)


def time_to_overlap(a: Any, velocity_a: Any, b: Any, velocity_b: Any, horizon_s: float) -> Any:
    """First time at which two boxes overlap at constant velocities and fixed headings, in closed form.

    On each separating axis the centre distance is linear in time, so the boxes overlap on that axis during one
    interval; they overlap in the plane during the intersection of the four (swept separating axis theorem).

    Args:
        a: Box ``[..., 6]``.
        velocity_a: Velocity of its centre ``[..., 2]``, m/s.
        b: Box ``[..., 6]``.
        velocity_b: Velocity ``[..., 2]``, m/s.
        horizon_s: Longest time of interest, seconds.

    Returns:
        Seconds ``[...]``: 0 where they overlap now, ``horizon_s`` where they do not within the horizon.
    """
    xp = a.__array_namespace__()
    dx, dy = b[..., X] - a[..., X], b[..., Y] - a[..., Y]
    vx = velocity_b[..., 0] - velocity_a[..., 0]
    vy = velocity_b[..., 1] - velocity_a[..., 1]
    begin, end = xp.zeros_like(dx), xp.full_like(dx, horizon_s)
    for axis_x, axis_y, reach in _axis_terms(a, b):
        distance = dx * axis_x + dy * axis_y
        speed = vx * axis_x + vy * axis_y
        moving = abs(speed) > 1e-9
        inverse = 1.0 / xp.where(moving, speed, xp.ones_like(speed))
        one, other = (-reach - distance) * inverse, (reach - distance) * inverse
        inside = abs(distance) < reach
        never = xp.full_like(dx, horizon_s)
        enter = xp.where(moving, xp.minimum(one, other), xp.where(inside, xp.zeros_like(dx), never))
        leave = xp.where(moving, xp.maximum(one, other), never)
        begin, end = xp.maximum(begin, enter), xp.minimum(end, leave)
    return xp.where(begin < end, begin, xp.full_like(dx, horizon_s))
