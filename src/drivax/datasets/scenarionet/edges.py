"""Turning road edges so that the drivable side is on their left, where a file orders their points otherwise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from drivax.datasets.scenarionet.values import SKIP
from drivax.errors import DataError
from drivax.geometry.polylines import point_to_segment

Array = np.ndarray[Any, Any]

#: Lane points within this distance say on which side of an edge one drives, metres.
BESIDE_M = 8.0
#: Places along a ring that are looked up in the other rings; rings may touch in some.
_PROBES = 5
_MOST_COMPARISONS = 100_000_000
#: Comparisons of points and segments at once.
_BLOCK = 500_000


def outlines_on_left(lines: Sequence[Array]) -> list[Array]:
    """Rings of the outline of drivable space, exteriors anticlockwise and holes clockwise.

    Rings do not cross, so one inside an even number of others is an exterior, else a hole. A line that is no ring
    (the outline was clipped) is turned round: GEOS, which makes these outlines, runs clockwise around areas.

    Args:
        lines: Points of the rings, metres; the first point is repeated at the end.

    Raises:
        DataError: There are too many.
    """
    ring = [len(points) >= 4 and bool((points[0, :2] == points[-1, :2]).all()) for points in lines]
    rings = [points[:, :2] for points, closed in zip(lines, ring, strict=True) if closed]
    if _PROBES * len(rings) * sum(map(len, rings)) > _MOST_COMPARISONS:
        raise DataError(f"an outline of {len(rings)} rings", cure=SKIP)
    depth = iter([_depth(points, [other for other in rings if other is not points]) for points in rings])
    turned = []
    for points, closed in zip(lines, ring, strict=True):
        anticlockwise = closed and _area(points) > 0
        wanted = closed and next(depth) % 2 == 0
        turned.append(points if closed and anticlockwise == wanted else points[::-1].copy())
    return turned


def _area(ring: Array) -> float:
    """Twice the signed area, anticlockwise positive (shoelace formula around the first point)."""
    x, y = (ring[:, :2] - ring[0, :2]).T
    return float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))


def _depth(ring: Array, others: Sequence[Array]) -> int:
    """In how many other rings a ring lies, as most of a few places along it tell."""
    at = np.linspace(0, len(ring) - 2, _PROBES).astype(np.int64)
    place = (ring[at] + ring[at + 1]) / 2
    return sum(int(2 * inside(place, other).sum() > _PROBES) for other in others)


def inside(points: Array, ring: Array) -> Array:
    """Which points lie inside a closed ring (even-odd rule)."""
    a, b = ring[:-1], ring[1:]
    above = points[:, None, 1] >= a[None, :, 1]
    crosses = above != (points[:, None, 1] >= b[None, :, 1])
    rise = np.where(a[:, 1] == b[:, 1], 1.0, b[:, 1] - a[:, 1])
    x = a[:, 0] + (points[:, None, 1] - a[:, 1]) / rise * (b - a)[:, 0]
    return ((crosses & (x > points[:, None, 0])).sum(axis=1) % 2).astype(bool)


def drivable_on_left(edges: Sequence[Array], lanes: Sequence[Array]) -> list[Array]:
    """Edges with most of the lanes beside them on their left; unchanged where no lane is near.

    Args:
        edges: Points of road edges, metres.
        lanes: Points of lane centres.

    Raises:
        DataError: There are too many points.
    """
    centres = np.concatenate([points[:, :2] for points in lanes]) if lanes else np.zeros((0, 2))
    if sum(map(len, edges)) * len(centres) > _MOST_COMPARISONS:
        raise DataError("road edges and lanes of too many points", cure=SKIP)
    return [points[::-1].copy() if _votes_left(points[:, :2], centres) < 0 else points for points in edges]


def _votes_left(edge: Array, centres: Array) -> int:
    """Lane points beside an edge that are on its left, less those on its right."""
    low, high = edge.min(axis=0) - BESIDE_M, edge.max(axis=0) + BESIDE_M
    near = centres[np.all((centres >= low) & (centres <= high), axis=1)]
    block = max(_BLOCK // len(edge), 1)
    return sum(_votes(edge, near[first : first + block]) for first in range(0, len(near), block))


def _votes(edge: Array, points: Array) -> int:
    a, b = edge[:-1], edge[1:]
    distance, along = point_to_segment(points[:, None], a[None], b[None])
    rows = np.arange(len(points))
    nearest = distance.argmin(axis=1)
    place = nearest + along[rows, nearest]
    # What is nearest to an end lies before or behind the edge, not beside it.
    beside = (distance[rows, nearest] <= BESIDE_M) & (place > 0) & (place < len(a))
    step, offset = (b - a)[nearest], points - a[nearest]
    side = np.sign(step[:, 0] * offset[:, 1] - step[:, 1] * offset[:, 0])
    return int(side[beside].sum())
