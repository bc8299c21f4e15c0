"""The lane graph: lanes, their links and widths, the lanes under a pose, and their traffic lights and stop signs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from drivax.errors import DataError
from drivax.geometry.polylines import Polylines, left_normals, point_to_segment
from drivax.geometry.vectors import wrap
from drivax.scenario.build.segments import LONGEST_M, Segments, inside_box, path_distance, plausible_limit
from drivax.scenario.recording import Light, MapFeature
from drivax.scenario.schema import CAR_LANE_KINDS, LANE_KINDS, Flag, RoadKind, among, nonzero

Array = np.ndarray[Any, Any]

#: Links that a record stores per lane and direction.
LINKS = 4
#: Largest gap and turn between lanes that are chained because their source has no graph.
CHAIN_GAP_M, CHAIN_HEADING_RAD = 0.5, np.deg2rad(20.0)
#: Neighbours have the same direction if their headings differ by less.
SAME_WAY_RAD = np.deg2rad(45.0)
#: Plausible widths measured from the spacing of neighbours, and the largest plausible width of a source, metres.
WIDTHS_M, MOST_WIDTH_M = (2.2, 5.5), 50.0
#: Larger height differences are between levels, metres.
LEVEL_M = 3.0
#: Headings at lane ends are measured over this chord: the last source points lie close together.
END_SPAN_M = 2.0
#: Kinds of links whose loss is counted.
_DANGLING = {
    "dangling_links": ("successors", "predecessors"),
    "dangling_neighbours": ("left_neighbours", "right_neighbours"),
}
#: Half the width of a stop line on a lane of unknown width, metres.
HALF_WIDTH_M = 1.85
#: A light without a lane takes the heading of a lane segment of its level within this distance.
LANE_REACH_M = 2.0
#: Lanes that a record stores per stop sign.
LANES_PER_STOP = 4
#: Points of a lane to measure neighbours, places on a lane where it is measured (fractions), and lanes per chunk.
_SAMPLES, _PROBES, _CHUNK = 33, (0.1, 0.3, 0.5, 0.7, 0.9), 512


@dataclass(frozen=True)
class LaneGraph:
    """Lanes with dense indices and their links; everything in the local frame, float64.

    Attributes:
        lines: Centre lines.
        feature, lane_id: Row and id of the source feature.
        width, limit: Metres and m/s, -1 unknown.
        interpolating: Lanes inside junctions, as marked by the source.
        successor, predecessor: Dense indices, -1 padded, the straightest first.
        left, right: Neighbours in the same direction, -1 none.
        left_shift, right_shift: Arc length on the neighbour at arc length s, minus s, metres.
        chained: Whether the links were made from geometry.
        dropped_links: Links between these lanes that ``select`` dropped: more than four per lane and direction.
        lost: Numbers of ``dangling_links`` (successors and predecessors) and ``dangling_neighbours`` of the source.
    """

    lines: Polylines
    feature: Int[Array, " lane"]
    lane_id: Int[Array, " lane"]
    kind: Int[Array, " lane"]
    width: Float[Array, " lane"]
    limit: Float[Array, " lane"]
    interpolating: Bool[Array, " lane"]
    successor: Int[Array, "lane link"]
    predecessor: Int[Array, "lane back_link"]
    left: Int[Array, " lane"]
    right: Int[Array, " lane"]
    left_shift: Float[Array, " lane"]
    right_shift: Float[Array, " lane"]
    chained: bool
    lost: Mapping[str, int]
    dropped_links: int = 0

    @cached_property
    def stretches(self) -> dict[tuple[int, float, float], Any]:
        """Cache of :func:`drivax.scenario.build.lane_paths.trace`, by lane, begin and end."""
        return {}

    @property
    def count(self) -> int:
        """Number of lanes."""
        return len(self.lane_id)

    @property
    def flags(self) -> Flag:
        """Flags that the graph justifies."""
        flags = Flag.SPEED_LIMITS if (self.limit > 0).any() else Flag.NONE
        if not (self.successor >= 0).any():
            return flags
        return flags | Flag.LANE_GRAPH | (Flag.CHAINED_GRAPH if self.chained else Flag.NONE)

    def index(self) -> dict[int, int]:
        """Return the dense index of every source id."""
        return {int(lane): i for i, lane in enumerate(self.lane_id)}

    def neighbours(self, lane: int) -> list[tuple[int, float]]:
        """Adjacent lanes in the same direction, each with its arc-length shift."""
        sides = ((self.left[lane], self.left_shift[lane]), (self.right[lane], self.right_shift[lane]))
        return [(int(other), float(shift)) for other, shift in sides if other >= 0]


def lane_graph(features: Sequence[MapFeature], origin: Float[Array, " 3"]) -> LaneGraph:
    """Build the graph of all lanes with a length; dangling links are dropped and counted.

    If the source links no lanes, they are chained where their ends meet.

    Raises:
        DataError: Two lanes have one id.
    """
    rows = [
        i for i, feature in enumerate(features)
        if feature.kind in LANE_KINDS and (np.abs(feature.points - feature.points[0])[:, :2] > 1e-3).any()
    ]  # fmt: skip
    lanes = [features[i] for i in rows]
    ids = [lane.feature_id for lane in lanes]
    index = {lane_id: i for i, lane_id in enumerate(ids)}
    if len(index) < len(ids):
        duplicate = next(i for i in ids if ids.count(i) > 1)
        raise DataError(f"two lanes have the id {duplicate}", cure="give every map feature its own id")
    lines = Polylines.of([np.asarray(lane.points, dtype=np.float64) - origin for lane in lanes])
    begin, end = end_headings(lines)
    kind = np.array([lane.kind for lane in lanes], dtype=np.int64)
    pairs = _source_pairs(lanes, index)
    has_links = any(f.successors or f.predecessors for f in lanes)
    if not has_links:
        pairs = _geometric_pairs(lines, begin, end, kind)
    samples = _samples(lines)
    left, left_shift, left_gap = _adjacent(lanes, index, samples, lines.length, "left_neighbours")
    right, right_shift, right_gap = _adjacent(lanes, index, samples, lines.length, "right_neighbours")
    dangling = {name: _count_dangling(lanes, index, *links) for name, links in _DANGLING.items()}
    return LaneGraph(
        lines=lines,
        feature=np.array(rows, dtype=np.int64),
        lane_id=np.array(ids, dtype=np.int64),
        kind=kind,
        width=_widths(lanes, np.fmin(left_gap, right_gap)),
        limit=np.array([plausible_limit(lane) for lane in lanes], dtype=np.float64),
        interpolating=np.array([lane.interpolating for lane in lanes], dtype=bool),
        successor=_link_table(pairs, end, begin),
        predecessor=_link_table([(b, a) for a, b in pairs], begin, end),
        left=left, right=right, left_shift=left_shift, right_shift=right_shift,
        chained=not has_links, lost=dangling,
    )  # fmt: skip


def _widths(lanes: Sequence[MapFeature], gap: Float[Array, " lane"]) -> Float[Array, " lane"]:
    """Width of every lane: that of the source, else the smaller gap to a neighbour, -1 if neither is plausible."""
    width = np.array([lane.width_m for lane in lanes], dtype=np.float64)
    spacing = np.where((gap >= WIDTHS_M[0]) & (gap <= WIDTHS_M[1]), gap, -1.0)
    return np.where((width > 0.0) & (width <= MOST_WIDTH_M), width, spacing)


def _count_dangling(lanes: Sequence[MapFeature], index: Mapping[int, int], *names: str) -> int:
    """Number of links of these kinds to missing lanes."""
    return sum(other not in index for lane in lanes for name in names for other in getattr(lane, name))


def end_headings(lines: Polylines) -> tuple[Float[Array, " lane"], Float[Array, " lane"]]:
    """Return the headings at the first and at the last point of every lane."""
    lane, begin = np.arange(lines.count), np.zeros(lines.count)
    return lines.heading(lane, begin, END_SPAN_M), lines.heading(lane, lines.length, END_SPAN_M)


def _source_pairs(lanes: Sequence[MapFeature], index: Mapping[int, int]) -> list[tuple[int, int]]:
    """(lane, successor) pairs named by either side; dangling and self links dropped, order kept."""
    pairs: dict[tuple[int, int], None] = {}
    for i, lane in enumerate(lanes):
        pairs |= dict.fromkeys((i, index[j]) for j in lane.successors if index.get(j, i) != i)
        pairs |= dict.fromkeys((index[j], i) for j in lane.predecessors if index.get(j, i) != i)
    return list(pairs)


def _geometric_pairs(lines: Polylines, begin: Array, end: Array, kind: Array) -> list[tuple[int, int]]:
    """Pairs of lanes where the end of the first meets the beginning of the second, in place and heading."""
    first, last = lines.points[lines.start[:-1]], lines.points[lines.start[1:] - 1]
    bike = kind == RoadKind.LANE_BIKE
    pairs: list[tuple[int, int]] = []
    for offset in range(0, lines.count, _CHUNK):  # maps of thousands of lanes would need gigabytes at once
        part = slice(offset, offset + _CHUNK)
        gap = np.hypot(*np.moveaxis((last[part, None] - first[None])[..., :2], -1, 0))
        level = np.abs(last[part, None, 2] - first[None, :, 2]) < LEVEL_M
        bend = np.abs(wrap(end[part, None] - begin[None]))
        fits = (gap <= CHAIN_GAP_M) & level & (bend <= CHAIN_HEADING_RAD) & (bike[part, None] == bike[None])
        pairs += [(int(i) + offset, int(j)) for i, j in np.argwhere(fits) if i + offset != j]
    return pairs


def _link_table(
    pairs: Sequence[tuple[int, int]], out_heading: Array, in_heading: Array
) -> Int[Array, "lane link"]:
    """Links of every lane, the straightest first, -1 padded to at least four."""
    a, b = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    most = np.bincount(a).max(initial=LINKS)
    table = np.full((len(out_heading), most), -1, dtype=np.int64)
    bend = np.abs(wrap(in_heading[b] - out_heading[a]))
    # Rounded: links that are equally straight stay in order.
    order = np.lexsort((np.arange(len(a)), np.round(bend, 3), a))
    column = np.arange(len(a)) - np.searchsorted(a[order], a[order])
    table[a[order], column] = b[order]
    return table


def _samples(lines: Polylines) -> Float[Array, "lane sample 2"]:
    """Evenly spaced points of every lane, to measure neighbours."""
    fraction = np.linspace(0.0, 1.0, _SAMPLES)
    return lines.at(np.arange(lines.count)[:, None], lines.length[:, None] * fraction)[..., :2]


def _adjacent(
    lanes: Sequence[MapFeature], index: Mapping[int, int], samples: Array, length: Array, side: str
) -> tuple[Int[Array, " lane"], Float[Array, " lane"], Float[Array, " lane"]]:
    """Adjacent lane in the same direction (-1 none), its arc-length shift (0), and the gap between them (NaN), metres.

    Of several, the lane that runs along most of this one, then the nearest. Oncoming lanes (neighbours in Argoverse 2)
    do not count.
    """
    best, shift, gap = np.full(len(lanes), -1), np.zeros(len(lanes)), np.full(len(lanes), np.nan)
    links = ((i, j) for i, lane in enumerate(lanes) for j in getattr(lane, side))
    pairs = list(dict.fromkeys((i, index[j]) for i, j in links if index.get(j, i) != i))
    if not pairs:
        return best, shift, gap
    a, b = np.array(pairs).T
    interior, distance, offset = _measure_adjacent(samples, length, a, b)
    adjacent = interior.any(axis=1)
    a, b, interior, probes = a[adjacent], b[adjacent], interior[adjacent], interior.sum(axis=1)[adjacent]
    pick = (np.arange(len(a)), (probes - 1) // 2)  # the (lower) median of the interior probes
    median_gap = np.sort(np.where(interior, distance[adjacent], np.inf), axis=1)[pick]
    median_shift = np.sort(np.where(interior, offset[adjacent], np.inf), axis=1)[pick]
    for i in np.lexsort((-median_gap, probes)):  # the best comes last
        best[a[i]], shift[a[i]], gap[a[i]] = b[i], median_shift[i], median_gap[i]
    return best, shift, gap


def _measure_adjacent(samples: Array, length: Array, a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Return the mask of lanes ``b`` that run along ``a``, their distance and arc-length shift: ``[pair, probe]``."""
    fraction = np.array(_PROBES)
    index = np.round(fraction * (_SAMPLES - 1)).astype(np.int64)
    probe = samples[a][:, index]
    direction = samples[a][:, index + 1] - samples[a][:, index - 1]
    begin, end = samples[b][:, None, :-1], samples[b][:, None, 1:]
    distance, along = point_to_segment(probe[:, :, None], begin, end)
    nearest = distance.argmin(axis=2)
    pick = np.ix_(np.arange(len(a)), np.arange(len(index)))
    along, distance = along[(*pick, nearest)], distance[(*pick, nearest)]
    chord = samples[b[:, None], nearest + 1] - samples[b[:, None], nearest]
    turn = np.arctan2(chord[..., 1], chord[..., 0]) - np.arctan2(direction[..., 1], direction[..., 0])
    position = (nearest + along) / (_SAMPLES - 1)
    interior = (np.abs(wrap(turn)) < SAME_WAY_RAD) & (position > 1e-6) & (position < 1.0 - 1e-6)
    arc = index / (_SAMPLES - 1) * length[a][:, None]
    return interior, distance, position * length[b][:, None] - arc


def select(graph: LaneGraph, lanes: Int[Array, " selection"]) -> LaneGraph:
    """Return the graph of these lanes with new dense indices and at most four links per lane and direction.

    Links to other lanes are not counted: they lead out of the crop, or to lanes that are counted as not fitting.
    """
    new_index = np.full(graph.count + 1, -1)  # the last entry is that of -1
    new_index[lanes] = np.arange(len(lanes))
    lines = [graph.lines.line(i) for i in lanes]
    successor, predecessor = (
        _compact(new_index[links[lanes]]) for links in (graph.successor, graph.predecessor)
    )
    per_lane = ("feature", "lane_id", "kind", "width", "limit", "interpolating", "left_shift", "right_shift")
    return replace(
        graph,
        lines=Polylines.of(lines),
        successor=successor[:, :LINKS],
        predecessor=predecessor[:, :LINKS],
        dropped_links=int((successor[:, LINKS:] >= 0).sum() + (predecessor[:, LINKS:] >= 0).sum()),
        left=new_index[graph.left[lanes]],
        right=new_index[graph.right[lanes]],
        **{name: getattr(graph, name)[lanes] for name in per_lane},
    )


def _compact(links: Int[Array, "lane link"]) -> Int[Array, "lane link"]:
    """Move missing links to the end of each row."""
    return np.take_along_axis(links, np.argsort(links < 0, axis=1, kind="stable"), axis=1)


@dataclass(frozen=True)
class LaneSegments:
    """Car-lane segments of a lane graph, to look up the lanes under a pose.

    Attributes:
        lane: Dense lane index of each segment.
        heading: Direction of each segment, radians.
    """

    graph: LaneGraph
    segments: Segments
    lane: Int[Array, " segment"]
    heading: Float[Array, " segment"]

    @classmethod
    def of(cls, segments: Segments, graph: LaneGraph) -> LaneSegments:
        """Select the segments of the car lanes of a graph."""
        rows = np.flatnonzero(among(segments.kind, CAR_LANE_KINDS))
        lane = lane_of_feature(graph, segments.feature[rows])
        of_lanes = segments.take(rows[lane >= 0])
        step = of_lanes.b - of_lanes.a
        return cls(graph, of_lanes, lane[lane >= 0], np.arctan2(step[:, 1], step[:, 0]))

    def nearest(
        self, xyz: Float[Array, "pose 3"], heading: Float[Array, " pose"], reach_m: float, turn_rad: float
    ) -> tuple[Int[Array, " pose"], Float[Array, " pose"], Float[Array, " pose"]]:
        """Nearest lane of each pose within reach, turn and level, arc length on it, and distance from it, metres.

        The lane is -1 without one in reach; then the other values mean nothing.
        """
        crop = self._crop(xyz[:, :2], reach_m)
        if not len(crop.lane):
            return np.full(len(xyz), -1), np.zeros(len(xyz)), np.full(len(xyz), np.inf)
        distance, s = crop._measure(xyz, heading, reach_m, turn_rad)
        best = distance.argmin(axis=1)
        pick = np.arange(len(xyz)), best
        return np.where(distance[pick] <= reach_m, crop.lane[best], -1), s[pick], distance[pick]

    def around(
        self, xyz: Float[Array, " 3"], heading: float, reach_m: float, turn_rad: float
    ) -> list[tuple[int, float, float]]:
        """Lanes within reach of a pose as (lane, arc length on it, distance), the nearest first."""
        crop = self._crop(xyz[None, :2], reach_m)
        (distance,), (s,) = crop._measure(xyz[None], np.array([heading]), reach_m, turn_rad)
        lanes: dict[int, tuple[int, float, float]] = {}
        for i in np.argsort(distance, kind="stable"):
            lane = int(crop.lane[i])
            if distance[i] <= reach_m:
                lanes.setdefault(lane, (lane, float(s[i]), float(distance[i])))
        return list(lanes.values())

    def _crop(self, xy: Float[Array, "pose 2"], reach_m: float) -> LaneSegments:
        """Segments in the box of the poses, widened by the reach."""
        rows = np.zeros(0, int)
        if len(xy) and len(self.segments):
            rows = np.flatnonzero(inside_box(self.segments.a[:, :2], xy, reach_m + LONGEST_M))
        return LaneSegments(self.graph, self.segments.take(rows), self.lane[rows], self.heading[rows])

    def _measure(self, xyz: Array, heading: Array, reach_m: float, turn_rad: float) -> tuple[Array, Array]:
        """Distance and arc length of every pose on every segment.

        The distance is infinite if turn or level exclude the segment or it begins outside the box of the pose, whose
        half side is ``reach_m + LONGEST_M``: callers compare it with ``reach_m``.
        """
        segments, most = self.segments, reach_m + LONGEST_M
        shape = (len(xyz), len(segments))
        distance, s = np.full(shape, np.inf), np.zeros(shape)
        in_reach = np.abs(xyz[:, :1] - segments.a[:, 0]) <= most
        in_reach &= np.abs(xyz[:, 1:2] - segments.a[:, 1]) <= most
        pose, row = nonzero(in_reach)
        a, b = segments.a.take(row, axis=0), segments.b.take(row, axis=0)
        separation, along = point_to_segment(xyz[pose, :2], a[:, :2], b[:, :2])
        z = a[:, 2] + along * (b[:, 2] - a[:, 2])
        is_excluded = np.abs(wrap(self.heading[row] - heading[pose])) > turn_rad
        is_excluded |= np.abs(z - xyz[pose, 2]) > LEVEL_M
        distance[pose, row] = np.where(is_excluded, np.inf, separation)
        s[pose, row] = segments.start_m[row] + along * segments.span_m[row]
        return distance, s


def lane_of_feature(graph: LaneGraph, feature: Int[Array, " row"]) -> Int[Array, " row"]:
    """Return the dense lane index of source features, -1 for those that are not in the lane graph."""
    size = max(int(graph.feature.max(initial=-1)), int(feature.max(initial=-1))) + 2
    table = np.full(size, -1)
    table[graph.feature] = np.arange(graph.count)
    return table[feature]


@dataclass(frozen=True)
class Lights:
    """Traffic lights in the local frame.

    Each has a stop line from left to right of its lane (x, y, x, y), the dense index of the lane (-1 if the map lacks
    it) with its headings at the stop point and at its end, and states over time (-1 unobserved).
    """

    line: Float[Array, "light 4"]
    z: Float[Array, " light"]
    lane: Int[Array, " light"]
    heading: Float[Array, " light"]
    exit_heading: Float[Array, " light"]
    state: Int8[Array, "light time"]
    overflow: dict[str, int]


def place_lights(
    lights: Sequence[Light],
    lane_segments: LaneSegments,
    origin: Float[Array, "3"],
    path: Float[Array, "step 2"],
    margin_m: float,
    most: int,
) -> Lights:
    """Place stop lines across the lanes at the stop points; keep the ``most`` lights nearest to ``path``.

    Lights whose lane is missing and that are near no other lane of their level have no direction and are dropped. They
    are counted only in the box of ``path`` widened by ``margin_m``: elsewhere the lanes are cropped too.
    """
    graph, steps = lane_segments.graph, len(lights[0].states) if lights else 0
    stop = np.array([light.stop_point for light in lights], dtype=np.float64).reshape(-1, 3) - origin
    index = graph.index()
    lane = np.array([index.get(light.lane_id, -1) for light in lights], dtype=np.int64)
    heading, exit_heading = _light_headings(lane_segments, lane, stop)
    width = np.append(graph.width, -1.0)[lane]
    half = np.where(width > 0, width / 2, HALF_WIDTH_M)
    has_heading = np.flatnonzero(~np.isnan(heading))
    rows = has_heading[np.argsort(path_distance(stop[has_heading, :2], path), kind="stable")]
    without_heading = int((np.isnan(heading) & inside_box(stop[:, :2], path, margin_m)).sum())
    overflow, rows = +Counter(lights=len(rows) - most, lights_without_lane=without_heading), rows[:most]
    left = half[rows, None] * left_normals(heading[rows])
    states = [np.asarray(lights[i].states, dtype=np.int8) for i in rows]
    return Lights(
        line=np.concatenate((stop[rows, :2] + left, stop[rows, :2] - left), axis=1),
        z=stop[rows, 2],
        lane=lane[rows],
        heading=heading[rows],
        exit_heading=exit_heading[rows],
        state=np.stack(states) if states else np.zeros((0, steps), dtype=np.int8),
        overflow=overflow,
    )


def _light_headings(
    lane_segments: LaneSegments, lane: Int[Array, " light"], stop: Float[Array, "light 3"]
) -> tuple[Float[Array, " light"], Float[Array, " light"]]:
    """Headings of each light's lane at the stop point and at its end.

    A light without a lane (-1) has the heading of the nearest lane segment of its level for both, NaN without one in
    reach.
    """
    graph, heading, exit_heading = lane_segments.graph, np.full(len(lane), np.nan), np.full(len(lane), np.nan)
    known = np.flatnonzero(lane >= 0)
    s = _arc_at(graph, lane[known], stop[known, :2])
    heading[known] = graph.lines.heading(lane[known], s, END_SPAN_M)
    exit_heading[known] = graph.lines.heading(lane[known], graph.lines.length[lane[known]], END_SPAN_M)
    for i in np.flatnonzero(lane < 0):
        heading[i] = exit_heading[i] = _heading_near(lane_segments, stop[i])
    return heading, exit_heading


def _arc_at(
    graph: LaneGraph, lane: Int[Array, " light"], xy: Float[Array, "light 2"]
) -> Float[Array, " light"]:
    """Arc length on each lane of the point nearest to its stop point."""
    result = np.zeros(len(lane))
    for i, (lane_index, point) in enumerate(zip(lane, xy, strict=True)):
        line, arc = graph.lines.line(lane_index)[:, :2], graph.lines.arc[graph.lines.start[lane_index] :]
        distance, along = point_to_segment(point, line[:-1], line[1:])
        best = distance.argmin()
        result[i] = arc[best] + along[best] * (arc[best + 1] - arc[best])
    return result


def _heading_near(lane_segments: LaneSegments, stop: Float[Array, "3"]) -> float:
    """Heading of the nearest lane segment on the level of a stop point, NaN without one in reach.

    If the lanes differ by at most :data:`LEVEL_M` in height, all are on its level: the stop point may be at the
    height of the lamp.
    """
    a, b = lane_segments.segments.a, lane_segments.segments.b
    if len(a) == 0:
        return float("nan")
    distance, along = point_to_segment(stop[:2], a[:, :2], b[:, :2])
    z = a[:, 2] + along * (b[:, 2] - a[:, 2])
    if np.ptp(z) > LEVEL_M:
        distance = np.where(np.abs(z - stop[2]) <= LEVEL_M, distance, np.inf)
    best = distance.argmin()
    return float(lane_segments.heading[best]) if distance[best] <= LANE_REACH_M else float("nan")


@dataclass(frozen=True)
class Stops:
    """Stop signs in the local frame, each with up to four dense lane indices (-1 padded)."""

    xy: Float[Array, "stop 2"]
    lane: Int[Array, "stop 4"]
    overflow: dict[str, int]


def place_stops(
    features: Sequence[MapFeature], graph: LaneGraph, origin: Float[Array, "3"], path: Float[Array, "step 2"],
    margin_m: float, most: int,
) -> Stops:  # fmt: skip
    """Place stop signs with the lanes that they control; keep the ``most`` signs nearest to ``path``.

    Signs that control a lane of ``graph``, and those in the box of ``path`` widened by ``margin_m``, come first; only
    they are counted.
    """
    signs = [f for f in features if f.kind == RoadKind.STOP_SIGN and len(f.points)]
    xy = np.array([f.points[0] for f in signs], dtype=np.float64).reshape(-1, 3)[:, :2] - origin[:2]
    index = graph.index()
    lane = np.full((len(signs), LANES_PER_STOP), -1)
    excess = np.zeros(len(signs), dtype=np.int64)
    for i, sign in enumerate(signs):
        known = [index[number] for number in sign.lanes if number in index]
        lane[i, : min(len(known), LANES_PER_STOP)] = known[:LANES_PER_STOP]
        excess[i] = max(len(known) - LANES_PER_STOP, 0)
    in_scope, distance = inside_box(xy, path, margin_m) | (lane[:, 0] >= 0), path_distance(xy, path)
    rows = np.lexsort((distance, ~in_scope))[:most]
    rows = rows[np.argsort(distance[rows], kind="stable")]
    overflow = +Counter(stops=int(in_scope.sum()) - most, stop_lanes=int(excess[rows].sum()))
    return Stops(xy[rows], lane[rows], overflow)
