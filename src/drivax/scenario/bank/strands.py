"""What a step needs to know of the lane graph: strands of road, which lie side by side, and which end or join another.

A strand is a sequence of lanes that lead straight on into each other. Where several lanes begin or end, the one
whose course changes least goes on; the others are strands of their own. Passing along a strand is nothing,
passing to a strand beside it is a lane change (``scenario.bank.passages``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from drivax.geometry.vectors import wrap
from drivax.scenario.bank.columns import StrandColumn
from drivax.scenario.schema import Scenario

Array = np.ndarray[Any, Any]

#: Coordinates of an end that does not exist, m.
NOWHERE_M = 1e6
#: Lanes are looked at so far before their ends and behind their beginnings, m; headings right at the ends this far.
_BEND_M, _END_M = 20.0, 1.0
#: What counts as the turn onto a lane of which the part that would tell is not stored, rad.
_UNKNOWN = 100.0
#: Lanes that meet in one merge where they run within this angle of each other so far before; others cross or turn in.
_MERGING_RAD = np.deg2rad(30.0)
#: A lane beside one that ends goes on if it reaches further than this, m.
_ON_M = 10.0
#: Further from the box around ego's log than this lanes may end because the map was cropped there, m.
_KNOWN_M = 95.0
#: Lanes are longer than they are drawn by at most this (height, rounding), m, and all are shorter than a key.
_SLACK_M, _KEY_M = 1.0, 1e6


def lane_codes(scenario: Scenario) -> Float32[np.ndarray, "lane 6"]:
    """The table of a scenario, a row per stored lane; see the columns of this module.

    A strand is named by its last lane, or by the highest one of a ring. It merges where its last lane leads onto
    another strand beside which it comes in (a ramp, two lanes that become one), or ends while its neighbour goes on (a
    lane drop). Turns that join a lane at a junction do not merge.
    """
    table = np.full((len(scenario.lane_id), 6), -1.0, np.float32)
    table[:, StrandColumn.END] = NOWHERE_M
    count = int((scenario.lane_length > 0).sum())
    if not count:
        return table
    row = np.arange(count)
    successor, predecessor = (
        getattr(scenario, name)[:count].astype(np.int64) for name in ("lane_successor", "lane_predecessor")
    )
    courses, each = _Courses.of(scenario, count), np.repeat(row[:, None], 4, axis=1)
    ahead = _straightest(successor, courses.turn(each, successor))
    behind = _straightest(predecessor, courses.turn(predecessor, each))
    follows = np.where((ahead >= 0) & (behind[ahead] == row), ahead, -1)
    strand, last = _strands(follows)
    other = np.where((ahead >= 0) & (follows < 0), behind[ahead], -1)
    comes_in = (other >= 0) & (np.abs(wrap(courses.before - courses.before[other])) <= _MERGING_RAD)
    onto = np.where(comes_in, strand[ahead], -1)
    stop, course = courses.stop, np.stack([np.cos(courses.end), np.sin(courses.end)], axis=1)
    stops = (successor < 0).all(axis=1) & _known(scenario, stop)
    for side in ("lane_right", "lane_left"):
        beside = getattr(scenario, side)[:count].astype(np.int64)
        further = ((stop[last[beside]] - stop) * course).sum(axis=1)
        # What is not stored lies beyond the crop.
        goes_on = (beside >= 0) & ((successor[last[beside]] >= 0).any(axis=1) | ~(further <= _ON_M))
        onto = np.where(stops & goes_on, strand[beside], onto)
        column = StrandColumn.LEFT if side == "lane_left" else StrandColumn.RIGHT
        table[:count, column] = np.where(beside >= 0, strand[beside], -1)
    onto = np.where(follows[last] < 0, onto[last], -1)
    table[:count, StrandColumn.STRAND], table[:count, StrandColumn.ONTO] = strand, onto
    table[:count, StrandColumn.END] = np.where(onto[:, None] >= 0, stop[last], NOWHERE_M)
    return table


@dataclass(frozen=True)
class _Courses:
    """How lanes run at their ends; NaN where that part is not stored. Lanes shorter than 20 m are looked at whole.

    Attributes:
        begin, end: Headings, rad.
        early, late: Mean curvature over the first and over the last 20 m, 1/m.
        before: Heading 20 m before the end, rad.
        stop: The last point, m.
    """

    begin: Float[Array, " lane"]
    end: Float[Array, " lane"]
    early: Float[Array, " lane"]
    late: Float[Array, " lane"]
    before: Float[Array, " lane"]
    stop: Float[Array, "lane 2"]

    @classmethod
    def of(cls, scenario: Scenario, count: int) -> _Courses:
        """The courses of the first ``count`` lanes."""
        part = slice(int(scenario.segment_blocks[1]), int(scenario.segment_blocks[2]))
        lane = scenario.segment_lane[part].astype(np.int64)
        start = scenario.segment_start_m[part].astype(float)
        order = np.lexsort((start, lane))
        lane, start = lane[order], start[order]
        a, b = (x[part, :2].astype(float)[order] for x in (scenario.segment_a, scenario.segment_b))
        span, heading = np.hypot(*(b - a).T), np.arctan2(*(b - a).T[::-1])
        row, length = np.arange(count), scenario.lane_length[:count].astype(float)

        def values(of: Array, arc: Array) -> Array:
            """What the segment holds that is at an arc length of each lane."""
            at = np.searchsorted(lane * _KEY_M + start, row * _KEY_M + arc, side="right") - 1
            stored = at >= 0
            stored[stored] = (lane[at] == row)[stored] & (arc - start[at] <= span[at] + _SLACK_M)[stored]
            found = np.full((count, *of.shape[1:]), np.nan)
            found[stored] = of[at[stored]]
            return found

        if not len(lane):
            nothing = np.full(count, np.nan)
            return cls(*[nothing] * 5, stop=np.full((count, 2), np.nan))
        look = np.minimum(_BEND_M, length)
        begin, end = (values(heading, np.clip(m, 0.0, length)) for m in (_END_M, length - _END_M))
        before = values(heading, length - look)
        early, late = wrap(values(heading, look) - begin) / look, wrap(end - before) / look
        return cls(begin, end, early, late, before, values(b, length))

    def turn(self, lane: Int[Array, "*n"], onto: Int[Array, "*n"]) -> Float[Array, "*n"]:
        """How much the course turns and changes its curvature where one lane leads onto another, rad over 20 m."""
        kink = np.abs(wrap(self.begin[onto] - self.end[lane]))
        return kink + _BEND_M * np.abs(self.early[onto] - self.late[lane])


def _straightest(links: Int[Array, "lane 4"], turn: Float[Array, "lane 4"]) -> Int[Array, " lane"]:
    """Of each lane's links the one that turns least, the first of equals and where nothing is known; -1 for none."""
    turn = np.where(links >= 0, np.where(np.isnan(turn), _UNKNOWN, np.round(turn, 2)), np.inf)
    return links[np.arange(len(links)), np.argmin(turn, axis=1)]


def _strands(follows: Int[Array, " lane"]) -> tuple[Int[Array, " lane"], Int[Array, " lane"]]:
    """Name of each lane's strand, and the last lane of it (any one in a ring); the ways ahead double every time."""
    row = np.arange(len(follows))
    last = np.where(follows >= 0, follows, row)
    highest = np.maximum(row, last)
    for _ in range(len(follows).bit_length()):
        highest, last = np.maximum(highest, highest[last]), last[last]
    return np.where(follows[last] >= 0, highest, last), last


def _known(scenario: Scenario, xy: Float[Array, "lane 2"]) -> Array:
    """Which places are so near to ego's log that the map around them is stored."""
    log = scenario.agent_xy[scenario.agent_valid[:, 0], 0]
    if not len(log):
        return np.zeros(len(xy), bool)
    low, high = log.min(axis=0) - _KNOWN_M, log.max(axis=0) + _KNOWN_M
    return ((xy >= low) & (xy <= high)).all(axis=1)


def corridor_lanes(scenario: Scenario) -> Bool[np.ndarray, " lane"]:
    """Which lanes are the route's own or their same-direction neighbours (at any distance sideways)."""
    member = np.zeros(len(scenario.lane_id), bool)
    todo = list(np.unique(scenario.route_lane[0][: int(scenario.route_points[0])]))
    while todo:
        lane = int(todo.pop())
        if lane < 0 or member[lane]:
            continue
        member[lane] = True
        todo += [int(scenario.lane_left[lane]), int(scenario.lane_right[lane])]
    return member
