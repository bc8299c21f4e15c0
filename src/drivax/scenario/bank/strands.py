"""Strands of lanes: their neighbours, and the strands that they merge onto.

A strand is a sequence of lanes that continue each other. Where several lanes begin or end, the lane with the smallest
change of course continues the strand; the others belong to other strands. Passing to an adjacent strand is a lane
change (``scenario.bank.queries.lane_passage``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from drivax.geometry.vectors import wrap
from drivax.scenario.bank.columns import StrandColumn
from drivax.scenario.build.segments import inside_box
from drivax.scenario.schema import Scenario

Array = np.ndarray[Any, Any]

#: Coordinates of missing ends, m.
NOWHERE_M = 1e6
#: Stretch of a lane at its ends that decides its course, and distance from the ends for headings, m.
_BEND_M, _END_M = 20.0, 1.0
#: Turn onto a lane of which that stretch is not stored, rad.
_UNKNOWN = 100.0
#: Lanes that meet merge if their headings differ by less 20 m before; others cross or turn in.
_MERGING_RAD = np.deg2rad(30.0)
#: An adjacent lane continues beyond the end of a lane if it reaches further than the first distance. Lanes may end at
#: the crop of the map beyond the second distance from the box of the ego's log, m.
_ON_M, _KNOWN_M = 10.0, 95.0
#: Largest excess of the length of a lane over its drawing (height, rounding), and upper bound of lengths, m.
_SLACK_M, _KEY_M = 1.0, 1e6


def lane_strands(scenario: Scenario) -> Float32[np.ndarray, "lane 6"]:
    """Return the table :class:`StrandColumn` of a scenario, a row per stored lane.

    A strand is named by its last lane, or by the highest lane of a ring. It merges if its last lane leads onto another
    strand at a small angle (a ramp, two lanes that join), or ends next to a lane that continues (a lane drop). Turns
    that join a lane at a junction do not merge.
    """
    table = np.full((len(scenario.lane_id), 6), -1.0, np.float32)
    table[:, StrandColumn.END] = NOWHERE_M
    count = int((scenario.lane_length > 0).sum())
    if not count:
        return table
    row = np.arange(count)
    successor = scenario.lane_successor[:count].astype(np.int64)
    predecessor = scenario.lane_predecessor[:count].astype(np.int64)
    courses, each = _Courses.of(scenario, count), np.repeat(row[:, None], 4, axis=1)
    ahead = _straightest(successor, courses.turn(each, successor))
    behind = _straightest(predecessor, courses.turn(predecessor, each))
    follows = np.where((ahead >= 0) & (behind[ahead] == row), ahead, -1)
    strand, last = _strands(follows)
    other = np.where((ahead >= 0) & (follows < 0), behind[ahead], -1)
    comes_in = (other >= 0) & (np.abs(wrap(courses.before - courses.before[other])) <= _MERGING_RAD)
    onto = np.where(comes_in, strand[ahead], -1)
    stop, course = courses.stop, np.stack([np.cos(courses.end), np.sin(courses.end)], axis=1)
    stops = (successor < 0).all(axis=1) & _is_map_known(scenario, stop)
    sides = (StrandColumn.RIGHT, scenario.lane_right), (StrandColumn.LEFT, scenario.lane_left)
    for column, neighbour in sides:
        adjacent = neighbour[:count].astype(np.int64)
        further = ((stop[last[adjacent]] - stop) * course).sum(axis=1)
        # Lanes that are not stored lie beyond the crop.
        goes_on = (adjacent >= 0) & ((successor[last[adjacent]] >= 0).any(axis=1) | ~(further <= _ON_M))
        onto = np.where(stops & goes_on, strand[adjacent], onto)
        table[:count, column] = np.where(adjacent >= 0, strand[adjacent], -1)
    onto = np.where(follows[last] < 0, onto[last], -1)
    table[:count, StrandColumn.STRAND], table[:count, StrandColumn.ONTO] = strand, onto
    table[:count, StrandColumn.END] = np.where(onto[:, None] >= 0, stop[last], NOWHERE_M)
    return table


@dataclass(frozen=True)
class _Courses:
    """Courses of lanes at their ends; NaN where that stretch is not stored.

    Headings (rad) at the beginning, at the end and 20 m ``before`` the end; mean curvature (1/m) over the first and the
    last 20 m; and the last point (m).
    """

    begin: Float[Array, " lane"]
    end: Float[Array, " lane"]
    early: Float[Array, " lane"]
    late: Float[Array, " lane"]
    before: Float[Array, " lane"]
    stop: Float[Array, "lane 2"]

    @classmethod
    def of(cls, scenario: Scenario, count: int) -> _Courses:
        """Return the courses of the first ``count`` lanes."""
        part = slice(int(scenario.segment_blocks[1]), int(scenario.segment_blocks[2]))
        lane = scenario.segment_lane[part].astype(np.int64)
        start = scenario.segment_start_m[part].astype(float)
        order = np.lexsort((start, lane))
        lane, start = lane[order], start[order]
        a, b = (x[part, :2].astype(float)[order] for x in (scenario.segment_a, scenario.segment_b))
        span, heading = np.hypot(*(b - a).T), np.arctan2(*(b - a).T[::-1])
        row, length = np.arange(count), scenario.lane_length[:count].astype(float)

        def values(of: Array, arc: Array) -> Array:
            """Values of the segments at an arc length of each lane."""
            at = np.searchsorted(lane * _KEY_M + start, row * _KEY_M + arc, side="right") - 1
            stored = at >= 0
            stored[stored] = (lane[at] == row)[stored] & (arc - start[at] <= span[at] + _SLACK_M)[stored]
            result = np.full((count, *of.shape[1:]), np.nan)
            result[stored] = of[at[stored]]
            return result

        if not len(lane):
            return cls(*[np.full(count, np.nan)] * 5, stop=np.full((count, 2), np.nan))
        look = np.minimum(_BEND_M, length)
        begin, end = (values(heading, np.clip(m, 0.0, length)) for m in (_END_M, length - _END_M))
        before = values(heading, length - look)
        early, late = wrap(values(heading, look) - begin) / look, wrap(end - before) / look
        return cls(begin, end, early, late, before, values(b, length))

    def turn(self, lane: Int[Array, "*n"], onto: Int[Array, "*n"]) -> Float[Array, "*n"]:
        """Turn and change of curvature from a lane onto another, rad over 20 m."""
        kink = np.abs(wrap(self.begin[onto] - self.end[lane]))
        return kink + _BEND_M * np.abs(self.early[onto] - self.late[lane])


def _straightest(links: Int[Array, "lane 4"], turn: Float[Array, "lane 4"]) -> Int[Array, " lane"]:
    """Link of each lane with the smallest turn, the first if equal or unknown; -1 for none."""
    turn = np.where(links >= 0, np.where(np.isnan(turn), _UNKNOWN, np.round(turn, 2)), np.inf)
    return links[np.arange(len(links)), np.argmin(turn, axis=1)]


def _strands(follows: Int[Array, " lane"]) -> tuple[Int[Array, " lane"], Int[Array, " lane"]]:
    """Strand of each lane and its last lane (any lane of a ring), by pointer doubling."""
    row = np.arange(len(follows))
    last = np.where(follows >= 0, follows, row)
    highest = np.maximum(row, last)
    for _ in range(len(follows).bit_length()):
        highest, last = np.maximum(highest, highest[last]), last[last]
    return np.where(follows[last] >= 0, highest, last), last


def _is_map_known(scenario: Scenario, xy: Float[Array, "lane 2"]) -> Array:
    """Mask of points so near to the log of the ego that the map around them is stored."""
    log = scenario.agent_xy[scenario.agent_valid[:, 0], 0]
    return inside_box(xy, log, _KNOWN_M) if len(log) else np.zeros(len(xy), bool)


def corridor_lanes(scenario: Scenario) -> Bool[np.ndarray, " lane"]:
    """Mask of lanes of the route and of their same-direction neighbours (at any distance sideways)."""
    member = np.zeros(len(scenario.lane_id), bool)
    todo = list(np.unique(scenario.route_lane[0][: int(scenario.route_points[0])]))
    while todo:
        lane = int(todo.pop())
        if lane < 0 or member[lane]:
            continue
        member[lane] = True
        todo += [int(scenario.lane_left[lane]), int(scenario.lane_right[lane])]
    return member
