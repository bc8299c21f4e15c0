"""Slow, plain geometry in float64 that shares no code with the package."""

from __future__ import annotations

import math

import numpy as np


def winding_number(point, ring):
    """Turns of the ring around the point, by summing the angles under which its sides are seen."""
    x, y = ring[:, 0] - point[0], ring[:, 1] - point[1]
    nx, ny = np.roll(x, -1), np.roll(y, -1)
    return round(float(np.sum(np.arctan2(x * ny - y * nx, x * nx + y * ny))) / (2 * math.pi))


def signed_area(ring):
    x, y = ring[:, 0], ring[:, 1]
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2


def box_corners(xy, heading, length, width):
    """Corners, counter-clockwise."""
    c, s = math.cos(heading), math.sin(heading)
    offsets = [
        (length / 2, width / 2),
        (-length / 2, width / 2),
        (-length / 2, -width / 2),
        (length / 2, -width / 2),
    ]
    return [(xy[0] + dx * c - dy * s, xy[1] + dx * s + dy * c) for dx, dy in offsets]


def shared_area(a, b):
    """Area common to two convex counter-clockwise polygons (Sutherland and Hodgman 1974)."""
    result = list(a)
    for k in range(len(b)):
        (ax, ay), (bx, by) = b[k], b[(k + 1) % len(b)]

        def depth(p, ax=ax, ay=ay, bx=bx, by=by):
            return (bx - ax) * (p[1] - ay) - (by - ay) * (p[0] - ax)

        clipped = []
        for i, p in enumerate(result):
            q = result[(i + 1) % len(result)]
            dp, dq = depth(p), depth(q)
            if dp >= 0:
                clipped.append(p)
            if dp * dq < 0:
                t = dp / (dp - dq)
                clipped.append((p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])))
        result = clipped
        if not result:
            return 0.0
    return abs(signed_area(np.array(result)))


def distance_to_polyline(points, line):
    """Distance of every point to the nearest place on an open polyline."""
    a, d = line[:-1], np.diff(line, axis=0)
    from_a = points[:, None] - a
    t = np.clip(np.sum(from_a * d, axis=-1) / np.sum(d * d, axis=-1), 0.0, 1.0)
    return np.sqrt(np.min(np.sum((from_a - t[..., None] * d) ** 2, axis=-1), axis=1))
