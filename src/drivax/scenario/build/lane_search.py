"""Search of the lane graph for ways ahead of the ego and ways to the goal."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.geometry.angles import wrap
from drivax.scenario.build.lane_paths import CHANGE_M, change_room, is_change
from drivax.scenario.build.lanes import END_SPAN_M, LaneGraph, LaneSegments
from drivax.scenario.schema import CAR_LANE_KINDS

Array = np.ndarray[Any, Any]

#: Lanes that count as under the ego or the goal: lateral distance and heading gate.
REACH_M = 4.0
TURN_RAD = np.deg2rad(60.0)
SAME_TURN_RAD = np.deg2rad(45.0)
#: Costs in metres: of a lane change, of a metre between ego and its first lane, of a radian of turning.
CHANGE_COST_M, LATERAL_COST, TURN_COST_M = 60.0, 30.0, 10.0
#: Of a radian between the headings of ego and of its first lane, and of a lane outside the intended corridor.
ASKEW_COST_M, OUTSIDE_COST_M = 30.0, 200.0
MOST_CHANGES = 2
MOST_EXPANSIONS = 400
MOST_GOAL_LANES = 3
#: Unfinished ways are taken up as if each missing metre cost this much, so that the search goes forward.
EAGERNESS = 0.1


@dataclass(frozen=True)
class Way:
    """A sequence of lanes from the ego on.

    Attributes:
        lanes: Dense indices, from the ego's lane on; each is a successor or a neighbour of the one before.
        s: Arc length of the ego on the first lane.
        ahead: Distance ahead of the ego at which the last lane begins (negative where it began before), metres.
        entry: Arc length on the last lane at which it is entered.
        penalty: Cost of lane changes, turns and lateral distance, metres.
        changes: Number of lane changes.
        until: Where the goal lies, metres ahead of the ego; infinite where the way has none.
        lateral: Distance of the ego from the first lane, metres.
    """

    lanes: tuple[int, ...]
    s: float
    ahead: float
    entry: float
    penalty: float
    changes: int
    until: float = np.inf
    lateral: float = 0.0


@dataclass(frozen=True)
class LaneSearch:
    """Best-first search from the lanes under the ego.

    Attributes:
        graph: The lane graph.
        on: Lane segments of the same graph.
        ways: One-lane ways to start from, the best fitting first.
        need_m: Length of a complete way ahead of the ego.
        bend: Heading change along every lane, radians.
        drivable: Whether cars use the lane.
        outside: Cost of entering each lane because it lies outside the intended corridor, metres.
    """

    graph: LaneGraph
    on: LaneSegments
    ways: tuple[Way, ...]
    need_m: float
    bend: Float[Array, " lane"]
    drivable: tuple[bool, ...]
    outside: tuple[float, ...]

    @classmethod
    def start(
        cls,
        graph: LaneGraph,
        on: LaneSegments,
        xyz: Float[Array, "3"],
        heading: float,
        need_m: float,
        corridor: Collection[int] = (),
    ) -> LaneSearch:
        """A search from a pose: from lanes within 4 m and 60 degrees of it.

        Args:
            graph: The lane graph.
            on: Lane segments of the same graph.
            xyz: Position of the ego.
            heading: Heading of the ego, radians.
            need_m: Length of a complete way ahead of the ego.
            corridor: Dense indices of the lanes that the intended route may use; empty: any.
        """
        row = np.arange(graph.count)
        lines = graph.lines
        begin, end = lines.heading(row, 0.0 * row, END_SPAN_M), lines.heading(row, lines.length, END_SPAN_M)
        near = on.around(xyz, heading, REACH_M, TURN_RAD)
        outside = np.zeros(graph.count)
        if corridor:
            outside[~np.isin(row, list(corridor))] = OUTSIDE_COST_M
        lane, arc = (np.array(values) for values in ([x[0] for x in near], [x[1] for x in near]))
        askew = np.abs(wrap(lines.heading(lane, arc) - heading)) if near else np.zeros(0)
        ways = [
            Way(
                lanes=(lane,),
                s=s,
                ahead=-s,
                entry=s,
                penalty=LATERAL_COST * far + ASKEW_COST_M * float(turn) + float(outside[lane]),
                changes=0,
                lateral=far,
            )
            for (lane, s, far), turn in zip(near, askew, strict=True)
        ]
        drivable = tuple(bool(kind) for kind in np.isin(graph.kind, CAR_LANE_KINDS))
        ways.sort(key=lambda way: way.penalty)
        return cls(
            graph, on, tuple(ways), need_m, np.abs(wrap(end - begin)), drivable, tuple(outside.tolist())
        )

    def alternatives(self, most: int) -> list[Way]:
        """Complete ways that differ in the lane a third, two thirds and the whole way ahead; the cheapest first."""
        found: dict[tuple[int, ...], Way] = {}
        serial = count()
        heap = [(self._urgency(way), next(serial), way) for way in self.ways]
        heapq.heapify(heap)
        for _ in range(MOST_EXPANSIONS):
            if not heap or len(found) >= most:
                break
            way = heapq.heappop(heap)[2]
            following = [] if self.reach(way) >= self.need_m else self.following(way)
            if not any(not is_change(self.graph, way.lanes[-1], child.lanes[-1]) for child in following):
                found.setdefault(self._signature(way), way)
            for child in following:
                heapq.heappush(heap, (self._urgency(child), next(serial), child))
        return list(found.values())

    def to_goal(self, xyz: Float[Array, "3"], heading: float) -> list[Way]:
        """The cheapest ways to the lanes under the goal (Dijkstra's search)."""
        goals = self._goals(xyz, heading)
        found: list[Way] = []
        done: set[int] = set()
        serial = count()
        heap = [(way.penalty, next(serial), way) for way in self.ways]
        heapq.heapify(heap)
        while heap and len(found) < len(goals):
            way = heapq.heappop(heap)[2]
            lane = way.lanes[-1]
            if lane in done:
                continue
            done.add(lane)
            if lane in goals:
                found.append(replace(way, until=way.ahead + goals[lane]))
            for child in self.following(way):
                if child.lanes[-1] not in done:
                    heapq.heappush(heap, (child.penalty + child.ahead + child.entry, next(serial), child))
        return found

    def along(self, lanes: Sequence[int], xyz: Float[Array, "3"], heading: float) -> Way:
        """The way along given lanes to a goal, from the lane that fits the ego best (the first where none does)."""
        way = Way(tuple(lanes), 0.0, 0.0, 0.0, 0.0, 0)
        for start in self.ways:
            if start.lanes[0] in lanes:
                rest = tuple(lanes[list(lanes).index(start.lanes[0]) :])
                way = replace(start, lanes=rest)
                break
        goals, ahead, until = self._goals(xyz, heading), way.ahead, np.inf
        for lane, following in zip(way.lanes, (*way.lanes[1:], -1), strict=True):
            until = ahead + goals[lane] if lane in goals else until
            if following >= 0 and is_change(self.graph, lane, following):
                ahead -= change_room(self.graph, lane, following, 0.0)[2]
            else:
                ahead += float(self.graph.lines.length[lane])
        return replace(way, until=until)

    def _goals(self, xyz: Float[Array, "3"], heading: float) -> dict[int, float]:
        """The lanes under the goal and its arc length on each."""
        near = self.on.around(xyz, heading, REACH_M, TURN_RAD)[:MOST_GOAL_LANES]
        return {lane: s for lane, s, _ in near}

    def reach(self, way: Way) -> float:
        """How far ahead of the ego a way ends."""
        return way.ahead + float(self.graph.lines.length[way.lanes[-1]])

    def _urgency(self, way: Way) -> float:
        return way.penalty + EAGERNESS * max(self.need_m - self.reach(way), 0.0)

    def following(self, way: Way) -> list[Way]:
        """Ways with one more lane: successors, and neighbours where there is room for a change."""
        graph, lane = self.graph, way.lanes[-1]
        result = []
        for other in (int(x) for x in graph.successor[lane] if x >= 0):
            if self.drivable[other] and other not in way.lanes:
                penalty = way.penalty + TURN_COST_M * float(self.bend[other]) + self.outside[other]
                lanes = (*way.lanes, other)
                result.append(replace(way, lanes=lanes, ahead=self.reach(way), entry=0.0, penalty=penalty))
        if way.changes >= MOST_CHANGES:
            return result
        for other, shift in graph.neighbours(lane):
            low, high, _ = change_room(graph, lane, other, way.entry)
            if self.drivable[other] and other not in way.lanes and high - low >= CHANGE_M:
                changed = replace(
                    way,
                    lanes=(*way.lanes, other),
                    ahead=way.ahead - shift,
                    entry=low + shift + CHANGE_M,
                    penalty=way.penalty + CHANGE_COST_M + self.outside[other],
                    changes=way.changes + 1,
                )
                result.append(changed)
        return result

    def _signature(self, way: Way) -> tuple[int, ...]:
        """The lanes at a third, two thirds and all of the wanted length; a lane left by a change is its neighbour."""
        graph = self.graph
        ends, reach = [], -way.s
        for lane, following in zip(way.lanes, (*way.lanes[1:], -1), strict=True):
            if following < 0 or not is_change(graph, lane, following):
                reach += float(graph.lines.length[lane])
            ends.append(reach)
        marks = np.searchsorted(ends, self.need_m * np.array([1 / 3, 2 / 3, 1.0]))
        return tuple(way.lanes[min(int(i), len(way.lanes) - 1)] for i in marks)
