"""Lane paths: search of the lane graph ahead of the ego and to the goal, and the line along a path."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from drivax.geometry.polylines import arc_lengths, project
from drivax.geometry.vectors import wrap
from drivax.scenario.build.lanes import END_SPAN_M, LaneGraph, LaneSegments, end_headings
from drivax.scenario.schema import CAR_LANE_KINDS

Array = np.ndarray[Any, Any]

#: A line and the dense lane index of each of its points (-1 off the map).
Line = tuple[Float[Array, "_ 3"], Int[Array, " _"]]
#: Least length of a lane change.
CHANGE_M = 20.0
#: Gaps of this size between lanes fade out over ``FADE_M``; wider ones are crossed in a straight line.
GAP_M, FADE_M = (0.05, 2.0), 10.0
#: Lateral distance and heading difference within which a lane is under the ego or the goal, and the heading difference
#: for lanes under the log.
REACH_M, TURN_RAD, SAME_TURN_RAD = 4.0, np.deg2rad(60.0), np.deg2rad(45.0)
#: Costs in metres: of a lane change, of a metre between ego and its first lane, of a radian of turning.
CHANGE_COST_M, LATERAL_COST, TURN_COST_M = 60.0, 30.0, 10.0
#: Costs of a radian between the headings of ego and of its first lane, and of a lane outside the intended corridor.
ASKEW_COST_M, OUTSIDE_COST_M = 30.0, 200.0
MOST_CHANGES, MOST_EXPANSIONS, MOST_GOAL_LANES = 2, 400, 3
#: Cost of each missing metre of an unfinished path, which makes the search go forward.
EAGERNESS = 0.1


@dataclass(frozen=True)
class LanePath:
    """A sequence of lanes, each a successor or neighbour of the previous one; metres.

    Attributes:
        lanes: Dense indices, from the lane of the ego on.
        s, lateral: Arc length of the ego on the first lane, and its distance from it.
        ahead: Distance from the ego to the beginning of the last lane; negative if the ego has passed it.
        entry_m: Arc length on the last lane at which it is entered.
        penalty: Cost of lane changes, turns, lateral distance, heading and lanes outside the corridor.
        changes: Number of lane changes.
        goal_m: Distance from the ego to the goal; infinite without one.
    """

    lanes: tuple[int, ...]
    s: float
    ahead: float
    entry_m: float
    penalty: float
    changes: int
    goal_m: float = np.inf
    lateral: float = 0.0

    def then(self, lane: int, ahead: float, entry_m: float, penalty: float, changes: int = 0) -> LanePath:
        """Return the path with one more lane; ``changes`` is the number of further lane changes."""
        lanes, changes = (*self.lanes, lane), self.changes + changes
        return replace(self, lanes=lanes, ahead=ahead, entry_m=entry_m, penalty=penalty, changes=changes)


@dataclass(frozen=True)
class LaneSearch:
    """Best-first search from ``starts``, paths of one lane under the ego, the best fitting first.

    A complete path is ``need_m`` long ahead of the ego. Of each lane, ``bend`` is the heading change from end to end
    (radians), ``drivable`` whether cars may drive on it, and ``outside`` the cost of entering it (metres), zero in the
    intended corridor.
    """

    lane_segments: LaneSegments
    starts: tuple[LanePath, ...]
    need_m: float
    bend: Float[Array, " lane"]
    drivable: tuple[bool, ...]
    outside: tuple[float, ...]

    @property
    def graph(self) -> LaneGraph:
        """The lane graph."""
        return self.lane_segments.graph

    @classmethod
    def start(
        cls, lane_segments: LaneSegments, xyz: Float[Array, "3"], heading: float, need_m: float,
        corridor: Collection[int] = (),
    ) -> LaneSearch:  # fmt: skip
        """Start at the lanes within 4 m and 60 degrees of a pose; ``corridor`` holds the intended lanes, if known."""
        graph, outside = lane_segments.graph, np.zeros(lane_segments.graph.count)
        if corridor:
            outside[~np.isin(np.arange(graph.count), list(corridor))] = OUTSIDE_COST_M
        starts = []
        for lane, s, distance in lane_segments.around(xyz, heading, REACH_M, TURN_RAD):
            turn = float(np.abs(wrap(graph.lines.heading(np.array([lane]), np.array([s])) - heading))[0])
            penalty = LATERAL_COST * distance + ASKEW_COST_M * turn + float(outside[lane])
            starts.append(LanePath((lane,), s, -s, s, penalty, changes=0, lateral=distance))
        starts.sort(key=lambda lane_path: lane_path.penalty)
        begin, end = end_headings(graph.lines)
        drivable = tuple(np.isin(graph.kind, CAR_LANE_KINDS).tolist())
        return cls(
            lane_segments, tuple(starts), need_m, np.abs(wrap(end - begin)), drivable, tuple(outside.tolist())
        )

    def alternatives(self, most: int) -> list[LanePath]:
        """At most ``most`` paths, complete or to the end of the map, the cheapest first.

        They differ in their lanes at a third, two thirds or all of the required length.
        """
        complete: dict[tuple[int, ...], LanePath] = {}
        serial = count()  # orders paths of equal cost: the earlier first
        heap = [(self._priority(lane_path), next(serial), lane_path) for lane_path in self.starts]
        heapq.heapify(heap)
        for _ in range(MOST_EXPANSIONS):
            if not heap or len(complete) >= most:
                break
            lane_path = heapq.heappop(heap)[2]
            children = [] if self.reach(lane_path) >= self.need_m else self.expand(lane_path)
            if not self.goes_on(children):
                complete.setdefault(self._signature(lane_path), lane_path)
            for child in children:
                heapq.heappush(heap, (self._priority(child), next(serial), child))
        return list(complete.values())

    def to_goal(self, xyz: Float[Array, "3"], heading: float) -> list[LanePath]:
        """Cheapest paths to the lanes under the goal (Dijkstra's search)."""
        goals = self._goals(xyz, heading)
        complete, visited, serial = list[LanePath](), set[int](), count()
        # Starts are sorted by penalty, so the list is a heap.
        heap = [(lane_path.penalty, next(serial), lane_path) for lane_path in self.starts]
        while heap and len(complete) < len(goals):
            lane_path = heapq.heappop(heap)[2]
            lane = lane_path.lanes[-1]
            if lane in visited:
                continue
            visited.add(lane)
            if lane in goals:
                complete.append(replace(lane_path, goal_m=lane_path.ahead + goals[lane]))
            for child in self.expand(lane_path):
                if child.lanes[-1] not in visited:
                    heapq.heappush(heap, (child.penalty + child.ahead + child.entry_m, next(serial), child))
        return complete

    def along(self, lanes: Sequence[int], xyz: Float[Array, "3"], heading: float) -> LanePath:
        """Path along lanes to a goal, from the lane that fits the ego best (the first if none is under the ego)."""
        first = next((start for start in self.starts if start.lanes[0] in lanes), None)
        lane_path = LanePath(tuple(lanes), 0.0, 0.0, 0.0, 0.0, 0)
        if first is not None:
            lane_path = replace(first, lanes=tuple(lanes[list(lanes).index(first.lanes[0]) :]))
        goals, ahead, goal_m = self._goals(xyz, heading), lane_path.ahead, np.inf
        for lane, next_lane in zip(lane_path.lanes, (*lane_path.lanes[1:], -1), strict=True):
            goal_m = ahead + goals[lane] if lane in goals else goal_m
            if next_lane >= 0 and is_change(self.graph, lane, next_lane):
                ahead -= change_room(self.graph, lane, next_lane, 0.0)[2]
            else:
                ahead += float(self.graph.lines.length[lane])
        return replace(lane_path, goal_m=goal_m)

    def _goals(self, xyz: Float[Array, "3"], heading: float) -> dict[int, float]:
        """Lanes under the goal, at most the three nearest, with its arc length on each."""
        return {
            lane: s
            for lane, s, _ in self.lane_segments.around(xyz, heading, REACH_M, TURN_RAD)[:MOST_GOAL_LANES]
        }

    def reach(self, lane_path: LanePath) -> float:
        """Distance from the ego to the end of a path, metres."""
        return lane_path.ahead + float(self.graph.lines.length[lane_path.lanes[-1]])

    def _priority(self, lane_path: LanePath) -> float:
        """Sort key of a path in the search: its cost and a tenth of its missing length, the smallest first."""
        return lane_path.penalty + EAGERNESS * max(self.need_m - self.reach(lane_path), 0.0)

    def expand(self, lane_path: LanePath) -> list[LanePath]:
        """Paths with one more lane: successors, and neighbours where there is room for a lane change."""
        graph, lane, lanes = self.graph, lane_path.lanes[-1], lane_path.lanes
        result = []
        for other in (int(x) for x in graph.successor[lane] if x >= 0):
            if self.drivable[other] and other not in lanes:
                penalty = lane_path.penalty + TURN_COST_M * float(self.bend[other]) + self.outside[other]
                result.append(lane_path.then(other, self.reach(lane_path), 0.0, penalty))
        if lane_path.changes >= MOST_CHANGES:
            return result
        for other, shift in graph.neighbours(lane):
            low, high, _ = change_room(graph, lane, other, lane_path.entry_m)
            if self.drivable[other] and other not in lanes and high - low >= CHANGE_M:
                penalty = lane_path.penalty + CHANGE_COST_M + self.outside[other]
                entry_m = low + shift + CHANGE_M
                result.append(lane_path.then(other, lane_path.ahead - shift, entry_m, penalty, changes=1))
        return result

    def goes_on(self, children: Sequence[LanePath]) -> bool:
        """Return whether the last lane of any path is a successor, not entered by a lane change."""
        return any(not is_change(self.graph, *lane_path.lanes[-2:]) for lane_path in children)

    def _signature(self, lane_path: LanePath) -> tuple[int, ...]:
        """Lanes at a third, two thirds and all of the required length; lanes left by a change do not count."""
        graph = self.graph
        ends, reach = [], -lane_path.s
        for lane, next_lane in zip(lane_path.lanes, (*lane_path.lanes[1:], -1), strict=True):
            if next_lane < 0 or not is_change(graph, lane, next_lane):
                reach += float(graph.lines.length[lane])
            ends.append(reach)
        marks = np.searchsorted(ends, self.need_m * np.array([1 / 3, 2 / 3, 1.0]))
        return tuple(lane_path.lanes[min(int(i), len(lane_path.lanes) - 1)] for i in marks)


def is_change(graph: LaneGraph, lane: int, next_lane: int) -> bool:
    """Return whether the step from one lane to the next is a lane change."""
    adjacent = next_lane in (graph.left[lane], graph.right[lane])
    return adjacent and next_lane not in graph.successor[lane]


def change_room(graph: LaneGraph, lane: int, next_lane: int, entry_m: float) -> tuple[float, float, float]:
    """Arc lengths of a lane, from ``entry_m`` on, between which its neighbour runs, and their shift to the neighbour's.

    The first is the larger one if there is no room.
    """
    on_left = graph.left[lane] == next_lane
    shift = float(graph.left_shift[lane] if on_left else graph.right_shift[lane])
    low = max(entry_m, -shift)
    return low, min(float(graph.lines.length[lane]), float(graph.lines.length[next_lane]) - shift), shift


def trace(
    graph: LaneGraph, lanes: Sequence[int], begin_m: float, ahead_m: float, window_m: tuple[float, float],
    place: float, change_m: float = CHANGE_M,
) -> Line:  # fmt: skip
    """Draw the line along lanes, each a successor or neighbour of the previous one, from ``begin_m`` on the first.

    Where there is room, a lane change is ``change_m`` long and lies between the two distances ahead of the ego in
    ``window_m``; ``place`` is its place in between: 0 as early, 1 as late as possible. ``ahead_m`` is the distance from
    the ego to the start of the first lane (negative: behind), metres.
    """
    parts: list[Line] = []
    s = begin_m
    for i, lane in enumerate(lanes):
        next_lane = lanes[i + 1] if i + 1 < len(lanes) else None
        if next_lane is None or not is_change(graph, lane, next_lane):
            parts.append(_close_gap(parts, _stretch(graph, lane, s, float(graph.lines.length[lane]))))
            s, ahead_m = 0.0, ahead_m + float(graph.lines.length[lane])
            continue
        low, high, shift = change_room(graph, lane, next_lane, max(s, window_m[0] - ahead_m))
        length = min(change_m, max(high - low, 1.0))
        high = min(high, max(window_m[1] - ahead_m, low + length))
        leave = min(low + place * max(high - low - length, 0.0), float(graph.lines.length[lane]))
        parts.append(_close_gap(parts, _stretch(graph, lane, s, leave)))
        blend, s = _blend(graph, lane, next_lane, leave, length)
        parts.append(blend)
        ahead_m -= shift
    xyz = np.concatenate([part[0] for part in parts])
    label = np.concatenate([part[1] for part in parts])
    step = np.hypot(*np.diff(xyz[:, :2], axis=0).T)
    # Of two equal points keep the later one, which has the lane ahead.
    keep = np.concatenate((step > 0.01, [True]))
    return xyz[keep], label[keep]


def _stretch(graph: LaneGraph, lane: int, begin: float, end: float) -> Line:
    """Points of a lane between two arc lengths, ends included."""
    if (lane, begin, end) not in graph.stretches:
        graph.stretches[lane, begin, end] = _cut_out(graph, lane, begin, end)
    return graph.stretches[lane, begin, end]


def _cut_out(graph: LaneGraph, lane: int, begin: float, end: float) -> Line:
    arc = graph.lines.arc[graph.lines.start[lane] : graph.lines.start[lane + 1]]
    ends = graph.lines.at(np.array([lane, lane]), np.array([begin, end]))
    inner = graph.lines.line(lane)[(arc > begin + 0.01) & (arc < end - 0.01)]
    xyz = np.concatenate((ends[:1], inner, ends[1:]))
    return xyz, np.full(len(xyz), lane)


def _close_gap(parts: Sequence[Line], line: Line) -> Line:
    """Shift the beginning of a line onto the end of the previous one; the shift fades out."""
    if not parts:
        return line
    xyz, label = line
    gap = parts[-1][0][-1] - xyz[0]
    if not GAP_M[0] < float(np.hypot(gap[0], gap[1])) < GAP_M[1]:
        return line
    return xyz + np.maximum(1.0 - arc_lengths(xyz) / FADE_M, 0.0)[:, None] * gap, label


def _blend(graph: LaneGraph, lane: int, next_lane: int, leave: float, length: float) -> tuple[Line, float]:
    """Line from a lane to its neighbour, and the arc length on the neighbour where it ends.

    Lateral motion by the quintic 10 t^3 - 15 t^4 + 6 t^5: no jump in heading or curvature at the ends.
    """
    t = np.linspace(0.0, 1.0, int(np.ceil(length)) + 1)
    origin = graph.lines.at(np.full(len(t), lane), leave + t * length)
    s, _ = project(graph.lines.line(next_lane), origin[[0, -1], :2])
    target = graph.lines.at(np.full(len(t), next_lane), s[0] + t * (s[1] - s[0]))
    weight = (t**3 * (10.0 - 15.0 * t + 6.0 * t**2))[:, None]
    return ((1.0 - weight) * origin + weight * target, np.where(t < 0.5, lane, next_lane)), float(s[1])


def follow(graph: LaneGraph, lanes: Sequence[int], ahead_m: float, need_m: float) -> tuple[int, ...]:
    """Continue lanes along the straightest successors from ``ahead_m`` to ``need_m``, or until they end or repeat."""
    result = list(lanes)
    while ahead_m < need_m:
        next_lane = int(graph.successor[result[-1], 0])
        if next_lane < 0 or next_lane in result:
            break
        result.append(next_lane)
        ahead_m += float(graph.lines.length[next_lane])
    return tuple(result)


def walk(
    graph: LaneGraph, lane: Int[Array, " start"], s: Float[Array, " start"], step_m: float, points: int
) -> tuple[Float[Array, "start points 2"], Float[Array, "start points"]]:
    """Return points (m) and headings (rad) every ``step_m`` along lanes and their straightest successors.

    The first point lies ``step_m`` ahead of arc length ``s`` on each start lane; beyond the last lane, points continue
    straight on.
    """
    distance = step_m * np.arange(1, points + 1)
    chain, begin = [lane], [-s]
    for _ in range(4 * points):  # ends rings of very short lanes
        next_lane = graph.successor[chain[-1], 0]
        next_begin = np.where(next_lane >= 0, begin[-1] + graph.lines.length[chain[-1]], np.inf)
        if not (next_begin <= distance[-1]).any():
            break
        chain.append(np.maximum(next_lane, 0))
        begin.append(next_begin)
    hop = (distance[None, :, None] > np.stack(begin, axis=-1)[:, None, :]).sum(axis=-1) - 1
    hop = np.maximum(hop, 0)
    lane_of_point = np.take_along_axis(np.stack(chain, axis=-1), hop, axis=1)
    arc = distance - np.take_along_axis(np.stack(begin, axis=-1), hop, axis=1)
    lane_arc = np.minimum(arc, graph.lines.length[lane_of_point])
    heading = graph.lines.heading(lane_of_point, lane_arc, END_SPAN_M)
    overrun = (arc - lane_arc)[..., None] * np.stack((np.cos(heading), np.sin(heading)), axis=-1)
    return graph.lines.at(lane_of_point, lane_arc)[..., :2] + overrun, heading


def precede(
    graph: LaneGraph, lane: int, need_m: float, history: Float[Array, "step 2"]
) -> tuple[tuple[int, ...], float]:
    """Predecessors of a lane along the ego's ``history``, first to last, at least ``need_m`` long, and their length.

    They are shorter where the map begins.
    """
    result, total = list[int](), 0.0
    while total < need_m:
        first = result[0] if result else lane
        options = [int(p) for p in graph.predecessor[first] if p >= 0 and p != lane and p not in result]
        if not options:
            break
        distances = [project(graph.lines.line(option), history)[1].mean() for option in options]
        # Rounded to metres: of options that are about equally near the first is taken, also on other processors.
        best = options[int(np.argmin([round(float(metres)) for metres in distances]))]
        result.insert(0, best)
        total += float(graph.lines.length[best])
    return tuple(result), total


def continue_straight(line: Line, behind_m: float, ahead_m: float) -> Line:
    """Extend a line straight on at both ends; the new points have no lane."""
    xyz, label = line
    if ahead_m > 0.0:
        tip = xyz[-1] + _end_direction(xyz) * ahead_m
        xyz, label = np.concatenate((xyz, tip[None])), np.append(label, -1)
        label[-2] = -1  # the stretch from the old end on
    if behind_m > 0.0:
        tail = xyz[0] + _end_direction(xyz[::-1]) * behind_m
        xyz, label = np.concatenate((tail[None], xyz)), np.concatenate(([-1], label))
    return xyz, label


def _end_direction(xyz: Float[Array, "point 3"]) -> Float[Array, "3"]:
    """Direction in the plane of the last two metres of a line; +x for a line without length."""
    distance = np.hypot(*(xyz[:, :2] - xyz[-1, :2]).T)
    rows = np.flatnonzero(distance >= min(END_SPAN_M, distance.max()))
    step = xyz[-1] - xyz[rows[-1]]
    size = float(np.hypot(step[0], step[1]))
    return np.array([step[0] / size, step[1] / size, 0.0]) if size > 0.0 else np.array([1.0, 0.0, 0.0])
