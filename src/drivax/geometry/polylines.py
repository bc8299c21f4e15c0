"""Polylines: arc length, simplification, cutting, resampling and projection.

:class:`Polylines` holds many polylines in one array of points, so that a map needs no Python loop over its features.
Arc length is measured in the plane (x, y); a third coordinate is carried along. NumPy only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Polylines:
    """Concatenated polylines.

    Attributes:
        start: Index of the first point of each polyline, and finally the number of points.
        arc: Arc length of each point from the start of its polyline, m.
    """

    points: Float[Array, "point dim"]
    start: Int[Array, " polyline_plus_1"]
    arc: Float[Array, " point"]

    @classmethod
    def of(cls, lines: Sequence[Float[Array, "_ dim"]], dim: int = 3) -> Polylines:
        """Concatenate polylines; ``dim`` is the number of coordinates if there are no polylines."""
        counts = np.array([len(line) for line in lines], dtype=np.int64)
        points = np.concatenate(list(lines)) if len(lines) else np.zeros((0, dim))
        start = np.concatenate(([0], np.cumsum(counts)))
        return cls(points, start, arc_lengths(points, start))

    @property
    def count(self) -> int:
        """Number of polylines."""
        return len(self.start) - 1

    @cached_property
    def row(self) -> Int[Array, " point"]:
        """Index of the polyline of every point."""
        return np.repeat(np.arange(self.count), np.diff(self.start))

    @cached_property
    def length(self) -> Float[Array, " polyline"]:
        """Length of every polyline in the plane, metres; 0 without points."""
        if len(self.points) == 0:
            return np.zeros(self.count)
        return np.where(np.diff(self.start) > 0, self.arc[np.maximum(self.start[1:] - 1, 0)], 0.0)

    def line(self, row: Any) -> Float[Array, "_ dim"]:
        """Points of a polyline."""
        return self.points[self.start[row] : self.start[row + 1]]

    @cached_property
    def _base(self) -> Float[Array, " polyline_plus_1"]:
        """Offset of every polyline on one axis that holds all of them, one metre apart."""
        return np.concatenate(([0.0], np.cumsum(self.length + 1.0)))

    @cached_property
    def _key(self) -> Float[Array, " point"]:
        """Position of every point on the axis of :attr:`_base`."""
        return self.arc + self._base[self.row]

    def locate(self, row: Array, s: Array) -> tuple[Int[Array, "*query"], Float[Array, "*query"]]:
        """Find the segment at arc length ``s`` of polyline ``row``, which has two points or more.

        Returns:
            The index of its first point, and the fraction of the segment at ``s``. Before the beginning the
            segment is the first with a length, beyond the end the last: evaluation continues straight on, but stays at
            a last point that is repeated.
        """
        # Minimum and maximum are several times as fast as clip on few elements.
        key = np.minimum(np.maximum(s, 0.0), self.length[row]) + self._base[row]
        index = self._key.searchsorted(key, side="right") - 1
        index = np.minimum(np.maximum(index, self.start[row]), self.start[row + 1] - 2)
        span = self.arc[index + 1] - self.arc[index]
        return index, (s - self.arc[index]) / np.where(span > 0.0, span, 1.0)

    def at(self, row: Array, s: Array) -> Float[Array, "*query dim"]:
        """Points at arc lengths ``s`` of polylines ``row`` (straight on beyond the ends)."""
        index, fraction = self.locate(np.asarray(row), np.asarray(s, dtype=np.float64))
        begin = self.points.take(index, axis=0)
        return begin + fraction[..., None] * (self.points.take(index + 1, axis=0) - begin)

    def heading(self, row: Array, s: Array, span_m: float = 1.0) -> Float[Array, "*query"]:
        """Heading at arc lengths ``s``: of the chord from half a span behind to half a span ahead, radians.

        The chord stays inside the polyline; that of a polyline shorter than the span goes from end to end.
        """
        row, s = np.asarray(row), np.asarray(s, dtype=np.float64)
        length = self.length[row]
        begin = np.minimum(np.maximum(s - span_m / 2, 0.0), np.maximum(length - span_m, 0.0))
        chord = self.at(row, np.minimum(begin + span_m, length)) - self.at(row, begin)
        return np.arctan2(chord[..., 1], chord[..., 0])


def arc_lengths(
    points: Float[Array, "point dim"], start: Int[Array, " polyline_plus_1"] | None = None
) -> Float[Array, " point"]:
    """Arc length in the plane of every point from the first point of its polyline, metres.

    ``start`` holds the first point of each polyline and the number of points; None stands for a single polyline.
    """
    if len(points) == 0:
        return np.zeros(0)
    step, total = points[1:, :2] - points[:-1, :2], np.zeros(len(points))
    np.hypot(step[:, 0], step[:, 1]).cumsum(out=total[1:])
    if start is None:
        return total
    counts = np.diff(start)
    return total - np.repeat(total[start[:-1][counts > 0]], counts[counts > 0])


def point_to_segment(
    point: Float[Array, "*#batch dim"], a: Float[Array, "*#batch dim"], b: Float[Array, "*#batch dim"]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Distance from points to segments, and the fraction in [0, 1] of the nearest point; broadcasts leading axes."""
    axes = range(a.shape[-1])
    return _distance_to_chords(
        [point[..., i] - a[..., i] for i in axes], [b[..., i] - a[..., i] for i in axes]
    )


def _distance_to_chords(offset: Sequence[Array], chord: Sequence[Array]) -> tuple[Array, Array]:
    """Distance from points to chords, and the fraction in [0, 1] of the nearest point.

    ``offset`` points from the start of each chord to its point. Arguments are sequences of coordinates: one array per
    coordinate is faster than an axis of two.
    """
    square = _dot(chord, chord)
    fraction = _dot(offset, chord) / np.where(square > 0.0, square, 1.0)
    fraction = np.minimum(np.maximum(fraction, 0.0), 1.0)
    residual = [w - fraction * u for w, u in zip(offset, chord, strict=True)]
    return np.sqrt(_dot(residual, residual)), fraction


def _dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    return reduce(np.add, map(np.multiply, a, b))


def simplify(lines: Polylines, tolerance_m: float, z_weight: float = 0.0) -> Bool[Array, " point"]:
    """Mask of the points to keep: the other points lie within the tolerance of the simplified polylines.

    Douglas and Peucker, Cartographica 10(2), 1973, run on all polylines at once and level by level: every interval
    between kept points whose farthest point exceeds the tolerance is split there. Distance is to the chord as a
    segment, so closed rings (first point = last point) work.

    ``z_weight`` is the weight of the third coordinate in the distance; 0 ignores it.
    """
    axes = [np.ascontiguousarray(lines.points[:, i]) for i in (0, 1)]
    if z_weight > 0.0 and lines.points[:, 2:].any():
        axes.append(z_weight * lines.points[:, 2])
    keep = np.zeros(len(lines.points), dtype=bool)
    has_points = np.diff(lines.start) > 0
    keep[lines.start[:-1][has_points]] = True
    keep[lines.start[1:][has_points] - 1] = True
    interior = np.flatnonzero(~keep)  # points of intervals that may still have to be split
    while len(interior):
        vertices, interval = np.flatnonzero(keep), keep.cumsum()[interior]
        begin, end = vertices[interval - 1], vertices[interval]
        distance, _ = _distance_to_chords(
            [x.take(interior) - x.take(begin) for x in axes], [x.take(end) - x.take(begin) for x in axes]
        )
        first = _changes(interval)  # the first interior point of each interval
        farthest = np.repeat(np.maximum.reduceat(distance, first), np.diff(first, append=len(interior)))
        must_split = farthest > tolerance_m
        # Several points may be equally far: split at the earliest.
        peak = np.flatnonzero(must_split & (distance == farthest))
        keep[interior[peak[_changes(interval[peak])]]] = True
        interior = interior[must_split]
        interior = interior[~keep[interior]]
    return keep


def _changes(values: Int[Array, " n"]) -> Int[Array, " change"]:
    """Indices at which a sequence begins or changes."""
    return np.concatenate(([0], np.flatnonzero(values[1:] != values[:-1]) + 1))[: len(values)]


def cut_counts(length: Float[Array, " segment"], longest_m: float) -> Int[Array, " segment"]:
    """Number of equal pieces to cut each segment into, so that no piece is longer than ``longest_m``; at least 1."""
    # The tolerance keeps rounding from adding a piece.
    return np.maximum(np.ceil(length / longest_m - 1e-9), 1).astype(np.int64)


def resample(
    points: Float[Array, "point dim"], spacing_m: float, most: int | None = None
) -> tuple[Float[Array, "sample dim"], Int[Array, " sample"]]:
    """Resample a polyline of two points or more every ``spacing_m`` of arc length; the remainder at the end is dropped.

    Returns:
        The first ``most`` samples, and for each the index of the point where its segment begins.
    """
    arc = arc_lengths(points)
    # The tolerances keep rounding from dropping the last sample, or from choosing the segment before a point.
    count = int(np.floor(arc[-1] / spacing_m + 1e-6)) + 1
    s = np.arange(count if most is None else min(count, most)) * spacing_m
    index = arc.searchsorted(s + 1e-9, side="right") - 1
    index = np.minimum(np.maximum(index, 0), len(points) - 2)
    begin, start = points.take(index, axis=0), arc[index]
    span = arc[index + 1] - start
    fraction = np.minimum(np.maximum((s - start) / np.where(span > 0.0, span, 1.0), 0.0), 1.0)
    return begin + fraction[:, None] * (points.take(index + 1, axis=0) - begin), index


def left_normals(heading: Float[Array, "*n"]) -> Float[Array, "*n 2"]:
    """Unit vectors to the left of headings."""
    cos, sin = np.cos(heading), np.sin(heading)
    normal = np.empty((*cos.shape, 2), cos.dtype)
    normal[..., 0], normal[..., 1] = -sin, cos
    return normal


def headings(points: Float[Array, "point dim"]) -> Float[Array, " point"]:
    """Heading at every point of a polyline by central differences, one-sided at the ends, radians."""
    xy = points[:, :2]
    chord = np.concatenate((xy[1:], xy[-1:])) - np.concatenate((xy[:1], xy[:-1]))
    return np.arctan2(chord[:, 1], chord[:, 0])


def project(
    points: Float[Array, "point dim"], xy: Float[Array, "query 2"]
) -> tuple[Float[Array, " query"], Float[Array, " query"]]:
    """Arc length of the nearest point of a polyline of at least two points, and the distance from it, metres."""
    line = points[:, :2]
    arc = arc_lengths(points)
    distance, fraction = point_to_segment(xy[:, None], line[None, :-1], line[None, 1:])
    best = distance.argmin(axis=1)
    rows = np.arange(len(xy))
    s = arc[best] + fraction[rows, best] * (arc[best + 1] - arc[best])
    return s, distance[rows, best]


def project_monotone(
    points: Float[Array, "point dim"], xy: Float[Array, "query 2"], window_m: Float[Array, " query"]
) -> Float[Array, " query"]:
    """Non-decreasing arc lengths of successive positions along a polyline, without jumps to another branch.

    ``s[k]`` is the arc length in ``[s[k-1], s[k-1] + window[k]]`` whose point is nearest to ``xy[k]``; the first
    position is searched on the whole polyline, which needs two points, and ``window[0]`` is not used.
    """
    arc = arc_lengths(points)
    (step_x, step_y), span, starts = (points[1:, :2] - points[:-1, :2]).T, np.diff(arc), arc[:-1]
    square = np.maximum(step_x * step_x + step_y * step_y, 1e-12)
    divisor = np.maximum(span, 1e-12)
    offset_x, offset_y = (np.subtract.outer(xy[:, axis], points[:-1, axis]) for axis in (0, 1))
    feet = (offset_x * step_x + offset_y * step_y) / square * span
    result = np.zeros(len(xy))
    low, high = 0.0, arc[-1]
    for k in range(len(xy)):
        if k > 0:
            low, high = result[k - 1], min(result[k - 1] + window_m[k], arc[-1])
        i = max(int(arc.searchsorted(low, side="right")) - 1, 0)
        reach = slice(i, max(int(arc.searchsorted(high, side="left")), i + 1))
        length, begin = span[reach], starts[reach]
        if not len(length):  # ``low`` is the end of the line, which begins no segment
            result[k] = low
            continue
        foot = np.minimum(np.maximum(feet[k, reach], low - begin), high - begin)
        foot = np.minimum(np.maximum(foot, 0.0), length)
        fraction = foot / divisor[reach]
        residual_x = offset_x[k, reach] - fraction * step_x[reach]
        residual_y = offset_y[k, reach] - fraction * step_y[reach]
        nearest = (residual_x * residual_x + residual_y * residual_y).argmin()
        result[k] = arc[i + nearest] + foot[nearest]
    return result
