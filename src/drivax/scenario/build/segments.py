"""Map features as polylines, as segments of at most 4 m for queries, and as ranked pieces to observe."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from drivax.geometry.polylines import Polylines, arc_lengths, cut_counts, simplify
from drivax.geometry.vectors import wrap
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import (
    CAR_LANE_KINDS,
    EDGE_KINDS,
    LANE_KINDS,
    POLYGON_KINDS,
    RoadKind,
    among,
    nonzero,
)

Array = np.ndarray[Any, Any]

#: Longest segment: 4 m, as the grid requires, less a margin for rounding to float32.
LONGEST_M = 3.99
#: Tolerance of simplification, and the weight of heights in it: 20 cm count as 5 cm in the plane.
TOLERANCE_M, Z_WEIGHT = 0.05, 0.25
#: Largest gap between the ends of a closed ring, and its least number of points, the first counted twice.
CLOSED_M, _RING_POINTS = 0.05, 4
#: Shorter polylines are dropped.
_LEAST_LENGTH_M = 1e-3
#: Larger speed limits of a source are ignored.
MOST_LIMIT_MPS = 100.0
#: Longest piece of road, and fewest pieces of a closed ring: a single piece would end where it begins.
PIECE_M, RING_PIECES = 10.0, 4
#: Points whose distance from a path is computed at once.
_BLOCK = 512
#: Pieces rank by rings of this width around the log of the ego.
RING_M = 50.0


@dataclass(frozen=True)
class RoadLines:
    """All drawn map features as polylines in the local frame: split at clipping gaps, polygons closed.

    ``feature`` is the row of the source feature, ``closed`` the mask of closed rings. ``arc`` is the arc length of each
    point along its source feature, gaps included (``lines.arc`` that along its polyline), metres.
    """

    lines: Polylines
    feature: Int[Array, " polyline"]
    kind: Int[Array, " polyline"]
    closed: Bool[Array, " polyline"]
    arc: Float[Array, " point"]


@dataclass(frozen=True)
class Segments:
    """Straight pieces of at most 4 m from ``a`` to ``b``, in the local frame, float64.

    ``start_m`` is the arc length at ``a``, and ``span_m`` that from ``a`` to ``b``, both along the source feature.
    """

    a: Float[Array, "segment 3"]
    b: Float[Array, "segment 3"]
    kind: Int[Array, " segment"]
    polyline: Int[Array, " segment"]
    feature: Int[Array, " segment"]
    start_m: Float[Array, " segment"]
    span_m: Float[Array, " segment"]

    def __len__(self) -> int:
        return len(self.a)

    def take(self, rows: Array) -> Segments:
        """Select segments by indices or a mask."""
        rows = rows.nonzero()[0] if rows.dtype == bool else rows
        return Segments(
            **{name: getattr(self, name).take(rows, axis=0) for name in self.__dataclass_fields__}
        )

    @cached_property
    def middle(self) -> Float[Array, "segment 2"]:
        """Midpoints in the plane of the end points rounded to float32."""
        ends = self.a[:, :2].astype(np.float32), self.b[:, :2].astype(np.float32)
        return ((ends[0] + ends[1]) * np.float32(0.5)).astype(np.float64)

    @cached_property
    def block(self) -> Int[Array, " segment"]:
        """Storage block: 0 road edge, 1 car lane, 2 the rest."""
        is_edge = among(self.kind, EDGE_KINDS)
        return np.where(is_edge, 0, np.where(among(self.kind, CAR_LANE_KINDS), 1, 2))


def road_lines(
    features: Sequence[MapFeature], origin: Float[Array, " 3"], split_gap_m: float | None
) -> RoadLines:
    """Draw features of two or more points, other than stop signs, as polylines in the local frame.

    Polylines other than polygons are split where neighbouring points are more than ``split_gap_m`` apart.
    """
    rows = [i for i, f in enumerate(features) if f.kind != RoadKind.STOP_SIGN and len(f.points) >= 2]
    whole = Polylines.of([_outline(features[i]) for i in rows])
    kind = np.array([features[i].kind for i in rows], dtype=np.int64)
    points = whole.points - origin if len(whole.points) else whole.points
    breaks = np.zeros(len(points), dtype=bool)
    breaks[whole.start[:-1]] = True
    if split_gap_m is not None and len(points):
        step = np.hypot(*np.diff(points[:, :2], axis=0, prepend=points[:1, :2]).T)
        breaks |= (step > split_gap_m) & ~among(kind, POLYGON_KINDS)[whole.row]
    lines, keep = _drop_short(points, np.flatnonzero(breaks))
    row = whole.row[keep][lines.start[:-1]]
    first, last = lines.points[lines.start[:-1]], lines.points[lines.start[1:] - 1]
    closed = (np.hypot(*(last - first)[:, :2].T) <= CLOSED_M) & (np.diff(lines.start) >= _RING_POINTS)
    lines.points[lines.start[1:][closed] - 1] = first[closed]
    return RoadLines(lines, np.array(rows, dtype=np.int64)[row], kind[row], closed, whole.arc[keep])


def _outline(feature: MapFeature) -> Array:
    """Points of a feature; polygons are closed."""
    points = np.asarray(feature.points, dtype=np.float64)
    if feature.kind in POLYGON_KINDS and np.any(points[0] != points[-1]):
        return np.concatenate((points, points[:1]))
    return points


def _drop_short(points: Array, begin: Array) -> tuple[Polylines, Bool[Array, " point"]]:
    """Polylines that begin at the indices ``begin``, without those of no length, and the mask of their points."""
    start = np.append(begin, len(points))
    counts = np.diff(start)
    arc = arc_lengths(points, start)
    is_long = (counts >= 2) & (arc[start[1:] - 1] > _LEAST_LENGTH_M) if len(points) else counts >= 2
    keep = np.repeat(is_long, counts)
    return Polylines(points[keep], np.concatenate(([0], np.cumsum(counts[is_long]))), arc[keep]), keep


def cut(roads: RoadLines) -> Segments:
    """Simplify polylines to 5 cm and cut them into segments of at most 4 m, in order."""
    keep = simplify(roads.lines, TOLERANCE_M, Z_WEIGHT)
    rows = keep.nonzero()[0]
    points, arc, line = roads.lines.points.take(rows, axis=0), roads.arc[rows], roads.lines.row[rows]
    inner = (line[1:] == line[:-1]).nonzero()[0]
    a, b = points.take(inner, axis=0), points.take(inner + 1, axis=0)
    s, span, line = arc[:-1][inner], np.diff(arc)[inner], line[:-1][inner]
    pieces = cut_counts(np.hypot(*(b - a)[:, :2].T), LONGEST_M)
    owner = np.repeat(np.arange(len(a)), pieces)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    low, high = number / pieces[owner], (number + 1) / pieces[owner]
    begin, step = a.take(owner, axis=0), (b - a).take(owner, axis=0)
    is_last = (number + 1 == pieces[owner])[:, None]
    return Segments(
        a=begin + low[:, None] * step,
        b=np.where(is_last, b.take(owner, axis=0), begin + high[:, None] * step),
        kind=roads.kind[line[owner]],
        polyline=line[owner],
        feature=roads.feature[line[owner]],
        start_m=s[owner] + low * span[owner],
        span_m=span[owner] / pieces[owner],
    )


def path_distance(xy: Float[Array, "point 2"], path: Float[Array, "step 2"]) -> Float[Array, " point"]:
    """Distance of points from the nearest point of ``path``, metres; infinite for an empty path."""
    best = np.full(len(xy), np.inf)
    # Blocks keep the tables in the processor's cache.
    for first in range(0, len(xy), _BLOCK):
        x, y = (np.subtract.outer(path[:, axis], xy[first : first + _BLOCK, axis]) for axis in (0, 1))
        squared = x * x + y * y
        # np.hypot is slow: call it only for the nearest points up to rounding.
        near = nonzero(~(squared > squared.min(axis=0, initial=np.inf) * (1 + 1e-12)))
        np.minimum.at(best, near[1] + first, np.hypot(x[near], y[near]))
    return best


def thin_path(xy: Float[Array, "step 2"], spacing_m: float = 5.0) -> Float[Array, "point 2"]:
    """Thin a trajectory to points about ``spacing_m`` apart, with its first and last point."""
    bin_number = np.floor(arc_lengths(xy) / spacing_m)
    keep = np.diff(bin_number, prepend=-1.0) > 0
    keep[-1] = True
    return xy[keep]


def space_out(xy: Float[Array, "step 2"], least_m: float) -> list[int]:
    """Return the indices of the first position and of those at least ``least_m`` from the previous one."""
    keep, step_m = [0], np.hypot(*(xy[1:] - xy[:-1]).T).tolist()
    for i in range(1, len(xy)):
        distance = step_m[i - 1] if keep[-1] == i - 1 else np.hypot(*(xy[i] - xy[keep[-1]]))
        if distance >= least_m:
            keep.append(i)
    return keep


def inside_box(
    xy: Float[Array, "point 2"], path: Float[Array, "step 2"], margin_m: float
) -> Bool[Array, " point"]:
    """Return whether points lie in the axis-aligned box of a trajectory, widened by a margin."""
    low, high = path.min(axis=0) - margin_m, path.max(axis=0) + margin_m
    # Reducing so short an axis would take several times as long.
    x_inside, y_inside = ((low[k] <= xy[:, k]) & (xy[:, k] <= high[k]) for k in (0, 1))
    return x_inside & y_inside


def plausible_limit(feature: MapFeature) -> float:
    """Plausible speed limit of a lane in m/s, else -1."""
    limit = feature.limit_mps if feature.kind in LANE_KINDS else None
    return limit if limit is not None and 0.0 < limit <= MOST_LIMIT_MPS else -1.0


@dataclass(frozen=True)
class RoadRows:
    """Pieces of road in the local frame, in order of rank.

    Each has its midpoint by arc length, unit vector from its first to its last point, arc length (m), speed limit (m/s,
    -1 unknown or no lane), and curvature (1/m, left positive).
    """

    xy: Float[Array, "row 2"]
    direction: Float[Array, "row 2"]
    length: Float[Array, " row"]
    kind: Int[Array, " row"]
    limit: Float[Array, " row"]
    curvature: Float[Array, " row"]
    overflow: dict[str, int]


def road_rows(
    roads: RoadLines, features: Sequence[MapFeature], path: Float[Array, "step 2"], margin_m: float, most: int
) -> RoadRows:
    """Cut lanes, road edges and crosswalks into pieces and keep the ``most`` highest ranks.

    Pieces whose midpoint lies more than ``margin_m`` outside the box of ``path``, the log of the ego, are dropped.
    """
    line = np.flatnonzero(np.isin(roads.kind, (*LANE_KINDS, *EDGE_KINDS, RoadKind.CROSSWALK)))
    length = roads.lines.length[line]
    pieces = np.maximum(cut_counts(length, PIECE_M), np.where(roads.closed[line], RING_PIECES, 1))
    owner = np.repeat(line, pieces)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    span = np.repeat(length / pieces, pieces)
    begin = number * span
    middle = roads.lines.at(owner, begin + span / 2)[..., :2]
    rows = np.flatnonzero(inside_box(middle, path, margin_m))
    owner, begin, span, middle = owner[rows], begin[rows], span[rows], middle[rows]
    kind = roads.kind[owner]
    group = np.where(among(kind, LANE_KINDS), 0, np.where(among(kind, EDGE_KINDS), 1, 2))
    order = rank(group, path_distance(middle, path))[:most]
    overflow = +Counter(road_rows=len(owner) - len(order))
    owner, begin, span, middle, kind = owner[order], begin[order], span[order], middle[order], kind[order]
    start, end = roads.lines.at(owner, begin), roads.lines.at(owner, begin + span)
    angle = _angle(start, end)
    # Curvature is the turn from the first third to the last, over the distance of their middles.
    first = _angle(start, roads.lines.at(owner, begin + span / 3))
    last = _angle(roads.lines.at(owner, begin + span * 2 / 3), end)
    turn = wrap(last - first)
    limits = np.array([plausible_limit(feature) for feature in features], dtype=np.float64)
    return RoadRows(
        xy=middle,
        direction=np.stack((np.cos(angle), np.sin(angle)), axis=-1),
        length=span,
        kind=kind,
        limit=limits[roads.feature[owner]] if len(owner) else np.zeros(0),
        # Rounded: the last bits of angles depend on the processor. Adding 0 makes -0 positive.
        curvature=np.round(turn / (span * 2 / 3), 6) + 0.0,
        overflow=overflow,
    )


def _angle(begin: Float[Array, "row 3"], end: Float[Array, "row 3"]) -> Float[Array, " row"]:
    """Angle of each chord."""
    chord = end - begin
    return np.arctan2(chord[:, 1], chord[:, 0])


def rank(group: Int[Array, " row"], distance: Float[Array, " row"]) -> Int[Array, " row"]:
    """Order pieces so that every prefix spreads evenly over each group, nearer rings first.

    Within a ring of 50 m around the log, the rows of a group (in order along the map) are taken in bit-reversed
    order (van der Corput's sequence), and the groups are interleaved in proportion to their sizes.
    """
    ring = np.floor(distance / RING_M).astype(np.int64)
    label, position = ring * 3 + group, np.zeros(len(group))
    for number in np.unique(label):
        members = np.flatnonzero(label == number)
        position[members] = (_bit_reversed_rank(len(members)) + 0.5) / len(members)
    return np.lexsort((np.arange(len(group)), position, ring))


@lru_cache(maxsize=256)
def _bit_reversed_rank(count: int) -> Int[Array, " count"]:
    """Rank of each of ``count`` items in the order of their bit-reversed indices."""
    bits = max(int(count - 1).bit_length(), 1)
    index = np.arange(count)
    reverse = sum(((index >> bit) & 1) << (bits - 1 - bit) for bit in range(bits))
    return np.argsort(np.argsort(reverse))
