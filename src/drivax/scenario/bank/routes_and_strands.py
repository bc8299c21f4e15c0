"""Arrays of a bank along routes and lanes: routes of all egos, their goals, logs and stop lines, and strands of lanes.

A strand is a sequence of lanes that continue each other. Where several lanes begin or end, the lane with the smallest
change of course continues the strand; the others belong to other strands. Passing to an adjacent strand is a lane
change (``scenario.bank.queries.lane_passage``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Integer, Shaped

from drivax.geometry.vectors import wrap
from drivax.scenario.bank.columns import NEVER_M, StrandColumn
from drivax.scenario.schema import Flag, stack_field

_Record = Shaped[np.ndarray, ""]
_Arrays = dict[str, np.ndarray[Any, Any]]
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


def interleave(*columns: np.ndarray[Any, Any]) -> Float[np.ndarray, "*n column"]:
    """Interleave columns in float32; arrays with one dimension more than the last hold several columns."""
    rank = columns[-1].ndim
    flat: list[np.ndarray[Any, Any]] = []
    for values in columns:
        flat += [values] if values.ndim == rank else [values[..., i] for i in range(values.shape[-1])]
    result = np.empty((*columns[-1].shape, len(flat)), np.float32)
    for i, values in enumerate(flat):
        result[..., i] = values
    return result


def stack_routes(records: Sequence[_Record]) -> _Arrays:
    """Return routes, goals and logs of all egos ``[n, K, ...]``, and the logged paths of the recorded ones."""
    names = ("xy", "z", "heading", "limit", "lane", "points")
    *route, points = (_per_ego(records, f"route_{name}", 0) for name in names)
    *log, log_points = (stack_field(records, f"route_{name}", 1) for name in names)
    return {
        "routes": _route_columns(*route),
        "route_points": points.astype(np.int32),
        "log_routes": _route_columns(*log),
        "log_route_points": log_points.astype(np.int32),
        "goal": _per_ego(records, "goal_xy"),
        "log_progress": _per_ego(records, "log_progress"),
        **_stack_egos(records),
    }


def _route_columns(xy: Any, z: Any, heading: Any, limit: Any, lane: Any) -> Float[np.ndarray, "*n column"]:
    return interleave(xy, z, np.cos(heading), np.sin(heading), limit, lane)


def _stack_egos(records: Sequence[_Record]) -> _Arrays:
    steps, flags = (stack_field(records, name)[:, None].astype(np.int32) for name in ("steps", "flags"))
    slot, last, on_lanes = np.zeros_like(steps), steps - 1, (flags & int(Flag.ROUTE)) > 0
    if most_egos(records) > 1:
        further = [stack_field(records, f"ego_{name}") for name in ("slot", "last_step", "on_lanes")]
        pairs = zip((slot, last, on_lanes), further, strict=True)
        slot, last, on_lanes = (np.concatenate(pair, axis=1) for pair in pairs)
    xy, valid = (
        np.stack([log[f"agent_{name}"][:, egos] for log, egos in zip(records, slot, strict=True)])
        for name in ("xy", "valid")
    )
    valid &= (slot[:, None] >= 0) & (np.arange(valid.shape[1])[:, None] <= last[:, None])
    ahead = np.moveaxis(_log_ahead(xy, valid), 2, 1)
    return {"egos": slot, "last_step": last, "on_lanes": on_lanes, "log_ahead": ahead}


def _log_ahead(
    xy: Float[np.ndarray, "n time ego 2"], valid: Bool[np.ndarray, "n time ego"]
) -> Float[np.ndarray, "n time ego"]:
    """Return the distance that each logged ego drives from every step on, m; gaps of the log add nothing."""
    step_m = np.hypot(*np.moveaxis(np.diff(xy, axis=1), -1, 0)) * (valid[:, 1:] & valid[:, :-1])
    ahead = np.cumsum(step_m[:, ::-1], axis=1)[:, ::-1]
    return np.concatenate([ahead, np.zeros_like(ahead[:, :1])], axis=1)


def stack_lights(records: Sequence[_Record], count: int) -> _Arrays:
    """Return the first ``count`` stop lines and their states."""
    lights = slice(0, count)
    line = stack_field(records, "light_line", lights).astype(np.float64)
    z, heading, exit_rad, lane = (
        stack_field(records, f"light_{name}", lights) for name in ("z", "heading", "exit_heading", "lane")
    )
    middle, along = (line[..., :2] + line[..., 2:]) / 2, line[..., 2:] - line[..., :2]
    half = np.hypot(*np.moveaxis(along, -1, 0)) / 2
    right = wrap(exit_rad.astype(np.float64) - heading) < -np.pi / 4
    x, y = np.moveaxis(middle, -1, 0)
    arcs = [_stop_arcs(records, ego, lane, middle) for ego in range(most_egos(records))]
    rows = [x, y, np.cos(heading), np.sin(heading), half, z, np.cos(exit_rad), np.sin(exit_rad), right, *arcs]
    return {
        "light_line": np.stack(rows, axis=1, dtype=np.float32),
        "light_state": stack_field(records, "light_state", slice(None), lights),
    }


def _stop_arcs(
    records: Sequence[_Record], ego: int, lane: Int[np.ndarray, "n light"],
    middle: Float[np.ndarray, "n light 2"],
) -> Float[np.ndarray, "n light"]:  # fmt: skip
    """Return arc lengths (m) along an ego's route of the stop lines on its lanes; ``NEVER_M`` for all others."""
    arcs = np.full(lane.shape, NEVER_M)
    count, route_lane = (of_ego(records, f"route_{name}", ego, 0) for name in ("points", "lane"))
    on_route = np.zeros((len(records), 2 + max(int(lane.max()), int(route_lane.max()))), bool)
    on_route[np.arange(len(records))[:, None], route_lane] = True
    on_route[:, -1] = False  # the entry of -1, no lane
    on_route &= count[:, None] > 0
    scenario, light = stops = np.nonzero(on_route[np.arange(len(records))[:, None], lane])
    if len(light):
        xy, heading = (
            of_ego(records, f"route_{name}", ego, 0).astype(np.float64) for name in ("xy", "heading")
        )
        dx, dy = np.moveaxis(middle[stops][:, None] - xy[scenario], -1, 0)
        squared_m = np.where(np.arange(xy.shape[1]) < count[scenario, None], dx * dx + dy * dy, np.inf)
        point = np.argmin(squared_m, axis=1)
        nearest, course = (np.arange(len(point)), point), heading[scenario, point]
        # Route points are 1 m apart: the index of the nearest is its arc length.
        arcs[stops] = point + dx[nearest] * np.cos(course) + dy[nearest] * np.sin(course)
    return arcs


def most_egos(records: Sequence[_Record]) -> int:
    """Return the number of egos K that each record has room for."""
    return 1 + len(records[0]["ego_slot"]) if "ego_slot" in (records[0].dtype.names or ()) else 1


def of_ego(records: Sequence[_Record], name: str, ego: int, *part: int) -> np.ndarray[Any, Any]:
    """Stack a field of the k-th ego of all records.

    The field is ``name`` (or ``part`` of it) for the recorded ego, k = 0, and ``ego_name`` for further egos.
    """
    return stack_field(records, f"ego_{name}", ego - 1) if ego else stack_field(records, name, *part)


def _per_ego(records: Sequence[_Record], name: str, *part: int) -> np.ndarray[Any, Any]:
    """Stack :func:`of_ego` over all egos: ``[n, K, ...]``."""
    return np.stack([of_ego(records, name, ego, *part) for ego in range(most_egos(records))], axis=1)


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
