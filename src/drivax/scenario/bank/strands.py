"""Strands of lanes: their neighbours, and the strands that they merge onto.

A strand is a sequence of lanes that continue each other. Where several lanes begin or end, the lane with the smallest
change of course continues the strand; the others belong to other strands. Passing to an adjacent strand is a lane
change (``scenario.bank.queries.lane_passage``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Integer

from drivax.geometry.vectors import wrap
from drivax.scenario.bank.columns import StrandColumn
from drivax.scenario.schema import stack_field

Array = np.ndarray[Any, Any]

#: Coordinates of missing ends, m.
NOWHERE_M = 1e6
#: Stretch of a lane at its ends that decides its course, and distance from the ends for headings, m.
_BEND_M, _END_M = 20.0, 1.0
#: Turn to or from a lane whose stretch is not stored, larger than any known turn, rad.
_UNKNOWN_TURN = 100.0
#: Lanes that meet merge if their headings 20 m before differ by less; other lanes cross or turn in.
_MERGING_RAD = np.deg2rad(30.0)
#: An adjacent lane continues beyond the end of a lane if it reaches further than the first distance. Lanes may end at
#: the crop of the map beyond the second distance from the box of the ego's log, m.
_CONTINUES_M, _KNOWN_M = 10.0, 95.0
#: Largest excess of the length of a lane over that of its segments (height, rounding), m.
_SLACK_M = 1.0


def lane_strands(records: Sequence[Array]) -> Float32[np.ndarray, "n lane 6"]:
    """Return the strand tables of scenarios (:class:`StrandColumn`), a row per stored lane.

    The index of a strand is that of its last lane, or the highest of a ring. A strand merges if its last lane leads
    onto another strand at a small angle (a ramp, two lanes that join), or ends next to a lane that continues (a lane
    drop). Turns that join a lane at a junction do not merge.
    """
    lanes = _Lanes.of(records)
    tables = np.full((*lanes.mask.shape, 6), -1.0, np.float32)
    tables[..., StrandColumn.END] = NOWHERE_M
    if len(lanes.scenario):
        tables[lanes.mask] = _strand_rows(records, lanes)
    return tables


def _strand_rows(records: Sequence[Array], lanes: _Lanes) -> Float[Array, "lane 6"]:
    """Return a row of :class:`StrandColumn` for each stored lane (at least one) of all scenarios."""
    lane = np.arange(len(lanes.scenario))
    successor, predecessor = lanes.links(records, "successor"), lanes.links(records, "predecessor")
    courses, lane_of_link = _Courses.of(records, lanes), np.repeat(lane[:, None], 4, axis=1)
    next_lane = _straightest_link(successor, courses.turn(lane_of_link, successor))
    previous_lane = _straightest_link(predecessor, courses.turn(predecessor, lane_of_link))
    # Two lanes belong to one strand if each is the straightest link of the other. Index -1 reads the last lane; its
    # values are masked.
    continuation = np.where((next_lane >= 0) & (previous_lane[next_lane] == lane), next_lane, -1)
    strand, last = _strands(continuation)
    # A lane whose successor continues another lane (its rival) merges onto that strand if their earlier headings agree.
    rival = np.where((next_lane >= 0) & (continuation < 0), previous_lane[next_lane], -1)
    merges = (rival >= 0) & (np.abs(wrap(courses.before - courses.before[rival])) <= _MERGING_RAD)
    onto = np.where(merges, strand[next_lane], -1)
    stop, course = courses.stop, np.stack([np.cos(courses.end), np.sin(courses.end)], axis=1)
    is_dead_end = (successor < 0).all(axis=1) & _is_map_known(records, lanes.scenario, stop)
    rows = np.empty((len(lane), 6))
    for column, name in ((StrandColumn.RIGHT, "right"), (StrandColumn.LEFT, "left")):
        adjacent = lanes.links(records, name)
        further = ((stop[last[adjacent]] - stop) * course).sum(axis=1)
        # NaN counts as further: the end of the adjacent strand is not stored, so it lies beyond the crop.
        is_further = ~(further <= _CONTINUES_M)
        continues = (adjacent >= 0) & ((successor[last[adjacent]] >= 0).any(axis=1) | is_further)
        onto = np.where(is_dead_end & continues, strand[adjacent], onto)
        rows[:, column] = lanes.index(np.where(adjacent >= 0, strand[adjacent], -1))
    # A strand merges where its last lane does; a ring has no last lane.
    onto = np.where(continuation[last] < 0, onto[last], -1)
    rows[:, StrandColumn.STRAND], rows[:, StrandColumn.ONTO] = lanes.index(strand), lanes.index(onto)
    rows[:, StrandColumn.END] = np.where(onto[:, None] >= 0, stop[last], NOWHERE_M)
    return rows


@dataclass(frozen=True)
class _Lanes:
    """Stored lanes of some scenarios, in one sequence.

    Attributes:
        mask: Mask of the lanes of each record.
        first: First lane of each scenario in the sequence.
        scenario: Scenario of each lane.
        length: Length of each lane, m.
    """

    mask: Bool[Array, "n capacity"]
    first: Int[Array, " n"]
    scenario: Int[Array, " lane"]
    length: Float[Array, " lane"]

    @classmethod
    def of(cls, records: Sequence[Array]) -> _Lanes:
        """Return the lanes of records."""
        length = stack_field(records, "lane_length")
        count = (length > 0).sum(axis=1)
        mask = np.arange(length.shape[1]) < count[:, None]
        scenario = np.repeat(np.arange(len(records)), count)
        return cls(mask, np.cumsum(count) - count, scenario, length[mask].astype(float))

    def links(self, records: Sequence[Array], name: str) -> Int[Array, "lane *link"]:
        """Return links of lanes as indices in the sequence, -1 for none."""
        link = stack_field(records, f"lane_{name}")[self.mask].astype(np.int64)
        first = self.first[self.scenario].reshape(-1, *[1] * (link.ndim - 1))
        return np.where(link >= 0, link + first, -1)

    def index(self, lane: Int[Array, " lane"]) -> Int[Array, " lane"]:
        """Convert sequence indices to indices in a scenario, for entry i that of lane i; -1 for none."""
        return np.where(lane >= 0, lane - self.first[self.scenario], -1)


@dataclass(frozen=True)
class _Courses:
    """Courses of lanes at their ends; NaN if the stretch is not stored.

    Attributes:
        begin, end, before: Headings 1 m from the beginning, 1 m from the end, and 20 m from the end, rad.
        early, late: Mean curvatures over the first and the last 20 m, 1/m.
        stop: Last point, m.
    """

    begin: Float[Array, " lane"]
    end: Float[Array, " lane"]
    early: Float[Array, " lane"]
    late: Float[Array, " lane"]
    before: Float[Array, " lane"]
    stop: Float[Array, "lane 2"]

    @classmethod
    def of(cls, records: Sequence[Array], lanes: _Lanes) -> _Courses:
        """Return the courses of stored lanes."""
        segments, length = _Segments.of(records, lanes), lanes.length
        stretch = np.minimum(_BEND_M, length)
        begin, _ = segments.at(np.minimum(_END_M, length))
        end, _ = segments.at(np.maximum(length - _END_M, 0.0))
        after, _ = segments.at(stretch)
        before, _ = segments.at(length - stretch)
        _, stop = segments.at(length)
        return cls(begin, end, wrap(after - begin) / stretch, wrap(end - before) / stretch, before, stop)

    def turn(self, lane: Int[Array, "*n"], onto: Int[Array, "*n"]) -> Float[Array, "*n"]:
        """Turn from a lane onto another plus the change of curvature over 20 m, rad."""
        turn = np.abs(wrap(self.begin[onto] - self.end[lane]))
        return turn + _BEND_M * np.abs(self.early[onto] - self.late[lane])


@dataclass(frozen=True)
class _Segments:
    """Segments in order of lane and arc length; those of lane i are ``first[i]`` to ``first[i + 1]``, exclusive."""

    lane: Integer[Array, " segment"]
    start: Float[Array, " segment"]
    a: Float[Array, "segment 2"]
    b: Float[Array, "segment 2"]
    first: Int[Array, " lane1"]

    @classmethod
    def of(cls, records: Sequence[Array], lanes: _Lanes) -> _Segments:
        """Return the segments of stored lanes."""
        blocks = [slice(*record["segment_blocks"][1:3].tolist()) for record in records]
        index, start, a, b = (
            np.concatenate(
                [record[f"segment_{name}"][block] for record, block in zip(records, blocks, strict=True)]
            )
            for name in ("lane", "start_m", "a", "b")
        )
        first = np.repeat(lanes.first, [block.stop - block.start for block in blocks])
        has_lane = np.flatnonzero(index >= 0)
        lane = (first[has_lane] + index[has_lane]).astype(np.min_scalar_type(len(lanes.scenario)))
        # Keys: the bits of the start, which order floats of one sign, then the index. Integers sort several times
        # faster than np.lexsort.
        start_bits = np.abs(start[has_lane]).view(np.uint32).astype(np.uint64)
        keys = (start_bits << 32) | np.arange(len(has_lane), dtype=np.uint64)
        order = (np.sort(keys) & 0xFFFFFFFF).astype(np.int64)
        order = order[np.argsort(lane[order], kind="stable")]
        lane, order = lane[order], has_lane[order]
        bounds = np.searchsorted(lane, np.arange(len(lanes.scenario) + 1))
        return cls(lane, start[order].astype(float), a[order, :2], b[order, :2], bounds)

    def at(self, arc: Float[Array, " lane"]) -> tuple[Float[Array, " lane"], Float[Array, "lane 2"]]:
        """Heading and end of the segment at an arc length of each lane, NaN without one."""
        # Segments of a lane are sorted by start: the number of those that start at or before ``arc`` gives the last.
        before = np.append(0, np.cumsum(self.start <= arc[self.lane]))[self.first]
        last = self.first[:-1] + np.diff(before) - 1
        lane = np.flatnonzero(np.diff(before))
        start, a, b = (values[last[lane]].astype(float) for values in (self.start, self.a, self.b))
        span = np.hypot(*(b - a).T)
        reaches = arc[lane] - start <= span + _SLACK_M
        heading, end = np.full(len(arc), np.nan), np.full((len(arc), 2), np.nan)
        heading[lane[reaches]] = np.arctan2(*(b - a)[reaches].T[::-1])
        end[lane[reaches]] = b[reaches]
        return heading, end


def _straightest_link(links: Int[Array, "lane 4"], turn: Float[Array, "lane 4"]) -> Int[Array, " lane"]:
    """Link of each lane with the smallest turn (to 0.01 rad), the first of equal or unknown ones; -1 for none."""
    turn = np.where(links >= 0, np.where(np.isnan(turn), _UNKNOWN_TURN, np.round(turn, 2)), np.inf)
    return links[np.arange(len(links)), np.argmin(turn, axis=1)]


def _strands(continuation: Int[Array, " lane"]) -> tuple[Int[Array, " lane"], Int[Array, " lane"]]:
    """Strand of each lane, and the last lane of that strand (any lane of a ring), by pointer doubling."""
    lane = np.arange(len(continuation))
    last = np.where(continuation >= 0, continuation, lane)
    highest = np.maximum(lane, last)
    for _ in range(len(continuation).bit_length()):
        highest, last = np.maximum(highest, highest[last]), last[last]
    return np.where(continuation[last] >= 0, highest, last), last


def _is_map_known(
    records: Sequence[Array], scenario: Int[Array, " lane"], xy: Float[Array, "lane 2"]
) -> Bool[Array, " lane"]:
    """Mask of points within 95 m of the box of the ego's log: the map around them is stored."""
    valid = stack_field(records, "agent_valid", slice(None), 0)[..., None]
    log = stack_field(records, "agent_xy", slice(None), 0)
    low = np.where(valid, log, np.inf).min(axis=1) - _KNOWN_M
    high = np.where(valid, log, -np.inf).max(axis=1) + _KNOWN_M
    return np.all((xy >= low[scenario]) & (xy <= high[scenario]), axis=1)


def corridor_lanes(
    records: Sequence[Array], route: Int[np.ndarray, "n point"], count: Int[np.ndarray, " n"]
) -> Bool[np.ndarray, "n lane"]:
    """Mask of lanes of a route and of their same-direction neighbours, however many lanes away.

    ``route`` holds the lane of each of ``count`` points of the route, -1 for none.
    """
    neighbours = [stack_field(records, f"lane_{side}") for side in ("left", "right")]
    scenario, point = np.nonzero((route >= 0) & (np.arange(route.shape[1]) < count[:, None]))
    lane = route[scenario, point]
    member = np.zeros(neighbours[0].shape, bool)
    while len(lane):
        member[scenario, lane] = True
        adjacent_lanes = np.zeros_like(member)
        for neighbour in neighbours:
            adjacent = neighbour[scenario, lane]
            adjacent_lanes[scenario[adjacent >= 0], adjacent[adjacent >= 0]] = True
        scenario, lane = np.nonzero(adjacent_lanes & ~member)
    return member
