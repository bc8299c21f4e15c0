"""Routes along the lane graph from the pose of the ego, one point per metre.

Row 0 leads to the goal, or along the intended route if the source has one; row 1 is the log itself (privileged), the
others are alternatives. Without a route to the goal, row 0 is the log, too. All but the route of the log depend on the
poses up to the current step, the goal region and the intended route only; among routes that reach the goal equally
well the nearest to the log is taken. Candidates come from this project's search (``graph``) or the ``published`` one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from drivax.geometry.polylines import arc_lengths, headings, left_normals, project, project_monotone, resample
from drivax.scenario.build.lane_paths import (
    CHANGE_M,
    REACH_M,
    SAME_TURN_RAD,
    LanePath,
    LaneSearch,
    continue_straight,
    follow,
    is_change,
    precede,
    trace,
    walk,
)
from drivax.scenario.build.lanes import LaneGraph, LaneSegments
from drivax.scenario.build.segments import space_out, thin_path

Array = np.ndarray[Any, Any]
#: Source of candidates: the search of this project, or the published one.
RouteStyle = Literal["graph", "published"]
#: Largest offset of a route from the driven path, and least distance between driven poses that are compared with it.
OFFSET_M, _POSE_SPACING_M = 1.0, 1.0
#: Largest drift of the ego across a line, metres per metre (a change of 3.5 m within 12 m).
_MOST_SLOPE = 0.3
#: Lateral shifts of a route fade out over this distance behind the first driven pose and beyond the end of the log.
_FADE_M = 20.0
#: Published candidates begin on lanes within this distance of the ego at the start of the log, m.
PUBLISHED_REACH_M = 2.5
#: Least length and largest number of published candidates, and largest number of paths that their search extends.
LEAST_M, MOST_PATHS, MOST_EXPANSIONS = 250.0, 10, 5000
#: Least heading change along a lane that is a turn.
TURN_RAD = np.deg2rad(30.0)
#: Weights of the published :func:`score`.
CHANGE_WEIGHT, TURN_WEIGHT, LENGTH_WEIGHT, CURVATURE_WEIGHT = -0.3, -0.2, 0.1, -0.1
#: Distance between the points of a route.
SPACING_M = 1.0
#: Candidates reach this far ahead, or farther if the present speed carries farther in ``AHEAD_S``.
AHEAD_M, AHEAD_S = 200.0, 12.0
#: Routes begin this far behind the driven path and go on this far past the goal, straight on where the map ends.
BEHIND_M, PAST_GOAL_M = 20.0, 50.0
#: Time until a lane change begins, and its duration.
REACTION_S, CHANGE_S = 0.5, 3.0
#: Largest distance from the goal at which a route leads to it.
GOAL_M = 10.0
#: Where along the stretch of two parallel lanes a route may change from one to the other.
CHANGE_PLACES = (0.0, 0.25, 0.5, 0.75, 1.0)
#: Shorter steps of the log are jitter of a standing car; a log that stays within the second distance has no path.
STEP_M, STANDS_M = 0.5, 2.0
#: The log's route goes on this far beyond the log; its lanes are looked up at every n-th point (0.5 m apart or more).
LOG_AHEAD_M, LABEL_EVERY = 100.0, 4


@dataclass(frozen=True)
class Route:
    """Points 1 m apart along a lane path, with the dense index of the lane under each (-1 without one)."""

    xyz: Float[Array, "point 3"]
    heading: Float[Array, " point"]
    lane: Int[Array, " point"]

    @classmethod
    def along(cls, xyz: Float[Array, "_ 3"], lane: Int[Array, " _"], most: int) -> Route:
        """Resample a polyline at 1 m to at most ``most`` points."""
        points, index = resample(xyz, SPACING_M, most)
        return cls(points, headings(points), lane[index])


@dataclass(frozen=True)
class EgoLog:
    """The logged ego in the local frame, zeros where not valid; the current step is valid."""

    xyz: Float[Array, "time 3"]
    heading: Float[Array, " time"]
    speed: Float[Array, " time"]
    valid: Bool[Array, " time"]
    current: int

    @cached_property
    def last(self) -> int:
        """The last valid step."""
        return int(np.flatnonzero(self.valid)[-1])

    @cached_property
    def positions(self) -> Float[Array, "step 3"]:
        """Valid positions in order."""
        return self.xyz[self.valid]

    @cached_property
    def history(self) -> Float[Array, "step 3"]:
        """Valid positions up to the current step."""
        return self.xyz[: self.current + 1][self.valid[: self.current + 1]]


@dataclass(frozen=True)
class RouteSet:
    """Routes of a scenario: to the goal, the log's own, then alternatives.

    ``on_lanes`` says whether the first comes from the lane graph. ``goal`` is the last logged position projected on it,
    and ``progress`` the arc length of the logged ego on it at every step, metres.
    """

    routes: tuple[Route, ...]
    on_lanes: bool
    goal: Float[Array, "2"]
    progress: Float[Array, " time"]


@dataclass(frozen=True)
class Intent:
    """Intended route according to the source: its lanes in order, or all lanes that it may use; empty if unknown."""

    lanes: tuple[int, ...] = ()
    corridor: tuple[int, ...] = ()


def find_routes(
    lane_segments: LaneSegments,
    ego: EgoLog,
    intent: Intent,
    style: RouteStyle,
    most_routes: int,
    most_points: int,
) -> RouteSet:
    """Find all routes of a scenario; ``published`` candidates ignore the intended route."""
    log = log_route(lane_segments, ego, most_points)
    if style == "published":
        best, others = _published_routes(lane_segments, ego, most_points)
    else:
        best, others = _search_routes(lane_segments, ego, intent, most_routes - 1, most_points)
    first = log if best is None else best
    alternatives = [route for route in others if not _same(route, first)]
    progress = log_progress(first, ego)
    index = np.arange(len(first.xyz))
    goal = np.array([np.interp(progress[ego.last], index, first.xyz[:, axis]) for axis in (0, 1)])
    return RouteSet((first, log, *alternatives)[:most_routes], best is not None, goal, progress)


def _search_routes(
    lane_segments: LaneSegments, ego: EgoLog, intent: Intent, most_routes: int, most_points: int
) -> tuple[Route | None, list[Route]]:
    """Intended route, or else route to the goal, if any, and alternatives, by search from the current step."""
    pose = ego.xyz[ego.current], float(ego.heading[ego.current])
    need = max(AHEAD_M, float(ego.speed[ego.current]) * AHEAD_S)
    search = LaneSearch.start(lane_segments, *pose, need, intent.corridor)
    drawer = _Drawer(lane_segments.graph, ego, most_points)
    others = [drawer.draw(lane_path, 0.0) for lane_path in search.alternatives(most_routes)]
    end = ego.xyz[ego.last], float(ego.heading[ego.last])
    if intent.lanes:
        return _best(ego, drawer.variants([search.along(intent.lanes, *end)]), np.inf), others
    return _best(ego, [*drawer.variants(search.to_goal(*end)), *others], GOAL_M), others


def _published_routes(
    lane_segments: LaneSegments, ego: EgoLog, most_points: int
) -> tuple[Route | None, list[Route]]:
    """Published candidate that leads to the goal, if any, and all candidates, the best score first."""
    ego = replace(ego, current=int(np.argmax(ego.valid)))
    search = LaneSearch.start(lane_segments, ego.xyz[ego.current], float(ego.heading[ego.current]), LEAST_M)
    drawer = _Drawer(lane_segments.graph, ego, most_points, plain=True)
    others = [drawer.draw(lane_path, 0.0) for lane_path in published_paths(search)]
    return _best(ego, others, GOAL_M), others


def published_paths(search: LaneSearch) -> list[LanePath]:
    """First ten complete paths of a breadth-first search, the best score first.

    A path is complete with the first lane that ends 250 m or more ahead. From a lane the search goes to its successors,
    the straightest first, then to its left and right neighbour where there is room for a change; paths never use a lane
    twice and change lanes at most twice. Where the map ends too early for ten such paths, paths to its end are used.
    The search begins at the first logged pose, on lanes within 2.5 m.
    """
    queue = deque(lane_path for lane_path in search.starts if lane_path.lateral <= PUBLISHED_REACH_M)
    complete, dead_ends = list[LanePath](), list[LanePath]()
    for _ in range(MOST_EXPANSIONS):
        if not queue or len(complete) >= MOST_PATHS:
            break
        lane_path = queue.popleft()
        if search.reach(lane_path) >= search.need_m:
            complete.append(lane_path)
            continue
        children = search.expand(lane_path)
        if not search.goes_on(children):
            dead_ends.append(lane_path)
        queue.extend(children)
    return sorted([*complete, *dead_ends][:MOST_PATHS], key=lambda lane_path: -score(search, lane_path))


def score(search: LaneSearch, lane_path: LanePath) -> float:
    """Return the published score: -0.3 lane changes - 0.2 turns + 0.1 length - 0.1 curvature.

    Lane changes and turns (lanes whose heading changes by more than 30 degrees from end to end) are counted, the length
    ahead of the ego is in metres, and curvature is the heading change of all lanes from end to end per metre of that
    length, rad/m. With these units a metre of length outweighs most of the rest, as published.
    """
    length = max(search.reach(lane_path), 1.0)
    bend = search.bend[list(lane_path.lanes)]
    turning = CHANGE_WEIGHT * lane_path.changes + TURN_WEIGHT * int((bend > TURN_RAD).sum())
    return float(turning + LENGTH_WEIGHT * length + CURVATURE_WEIGHT * float(bend.sum()) / length)


def _same(route: Route, other: Route) -> bool:
    """Return whether the points of two routes differ by less than 10 cm."""
    return len(route.xyz) == len(other.xyz) and bool(np.abs(route.xyz - other.xyz).max() < 0.1)


def _best(ego: EgoLog, routes: Sequence[Route], reach_m: float) -> Route | None:
    """Route that passes nearest to the end of the log, in whole metres, then nearest to all of the log.

    None if no route passes within ``reach_m`` of its end.
    """
    if not routes:
        return None
    path = thin_path(ego.positions[:, :2])
    distances = [project(route.xyz, path)[1] for route in routes]
    # Rounded, so that routes which are equally good stay in order.
    keys = [(np.floor(away[-1]), round(float(away.mean()), 1), i) for i, away in enumerate(distances)]
    goal_distance, _, best = min(keys)
    return routes[best] if goal_distance < reach_m else None


@dataclass(frozen=True)
class _Drawer:
    """Draw routes of at most ``most`` points along lane paths.

    A plain route begins at the ego and keeps to the lanes; others begin 20 m behind the first logged position and bend
    to the driven path.
    """

    graph: LaneGraph
    ego: EgoLog
    most: int
    plain: bool = False
    drawn: dict[tuple[Any, ...], Route] = field(default_factory=dict)

    def variants(self, lane_paths: Sequence[LanePath]) -> list[Route]:
        """Routes along lane paths; those with lane changes are drawn with early to late changes."""
        routes = []
        for lane_path in lane_paths:
            changes = any(is_change(self.graph, a, b) for a, b in pairwise(lane_path.lanes))
            routes += [self.draw(lane_path, place) for place in (CHANGE_PLACES if changes else (0.0,))]
        return routes

    def draw(self, lane_path: LanePath, place: float) -> Route:
        """Route along a lane path and the straightest successors of its last lane; ``place`` as in :func:`trace`."""
        graph, ego = self.graph, self.ego
        history = ego.history[:, :2]
        behind_m = 0.0 if self.plain else BEHIND_M + float(arc_lengths(history)[-1])
        prefix, length = precede(graph, lane_path.lanes[0], behind_m - lane_path.s, history)
        begin = lane_path.s + length - behind_m  # negative: the lanes begin too late
        ahead_m = float(graph.lines.length[list(lane_path.lanes)].sum()) - lane_path.s
        lanes = (*prefix, *follow(graph, lane_path.lanes, ahead_m, self.most * SPACING_M))
        speed = float(ego.speed[ego.current])
        change_m, window_m = max(CHANGE_M, CHANGE_S * speed), (REACTION_S * speed, lane_path.goal_m)
        # Cached: alternatives often have the lanes of the intended route. Without lane changes the goal is irrelevant.
        changes = any(is_change(graph, a, b) for a, b in pairwise(lanes))
        key = lanes, begin, length, (lane_path.goal_m, place) if changes else None
        if key in self.drawn:
            return self.drawn[key]
        line = trace(graph, lanes, max(begin, 0.0), -lane_path.s - length, window_m, place, change_m)
        line = continue_straight(line, max(-begin, 0.0), PAST_GOAL_M)
        arc, _ = project(line[0], ego.positions[-1:, :2])
        missing_m = float(arc[0]) + PAST_GOAL_M - float(arc_lengths(line[0])[-1])
        xyz, label = continue_straight(line, 0.0, missing_m)
        points, index = resample(xyz, SPACING_M, self.most)
        route_xyz = points if self.plain else join(points, history, change_m)
        self.drawn[key] = Route.along(route_xyz, label[index], self.most)
        return self.drawn[key]


def join(
    xyz: Float[Array, "point 3"], history: Float[Array, "step 2"], ahead_m: float
) -> Float[Array, "point 3"]:
    """Bend a line so that it passes within a metre of the driven path.

    At each driven pose the line is shifted sideways by the excess of its distance over a metre. The shift is
    interpolated between the poses and fades out ahead of the last one by a cubic polynomial that continues in the ego's
    direction (Hermite: shift and slope at the ego, zero both ``ahead_m`` ahead). Points of ``xyz`` are about 1 m apart.
    """
    # The line may pass the poses again later on: project them onto its beginning only.
    count = int(arc_lengths(history)[-1] + 2 * BEHIND_M) + 2
    s, pose_shift = _shifts(xyz[:count], history)
    if not pose_shift.any():
        return xyz
    arc = arc_lengths(xyz)
    shift, is_behind, is_ahead = np.interp(arc, s, pose_shift), arc < s[0], arc > s[-1]
    slope = np.diff(pose_shift) / np.diff(s) if len(s) > 1 else np.zeros(1)
    slope = np.clip(slope, -_MOST_SLOPE, _MOST_SLOPE)
    shift[is_behind] = _fade(s[0] - arc[is_behind], pose_shift[0], -slope[0], _FADE_M)
    shift[is_ahead] = _fade(arc[is_ahead] - s[-1], pose_shift[-1], slope[-1], ahead_m)
    result = xyz.copy()
    result[:, :2] += shift[:, None] * left_normals(headings(xyz))
    return result


def _shifts(xyz: Float[Array, "point 3"], history: Float[Array, "step 2"]) -> tuple[Array, Array]:
    """Increasing arc lengths of driven poses along a line, and the shift of the line to its left there."""
    s, _ = project(xyz, history)
    # From the last pose back, keep those that lie at least a metre further back along the line.
    keep = [len(s) - 1]
    for i in range(len(s) - 2, -1, -1):
        if s[i] <= s[keep[-1]] - _POSE_SPACING_M:
            keep.append(i)
    rows = np.array(keep[::-1])
    arc, course = arc_lengths(xyz), np.unwrap(headings(xyz))
    foot = np.stack([np.interp(s[rows], arc, xyz[:, axis]) for axis in (0, 1)], axis=-1)
    offset = np.einsum("ij,ij->i", history[rows] - foot, left_normals(np.interp(s[rows], arc, course)))
    return s[rows], np.sign(offset) * np.maximum(np.abs(offset) - OFFSET_M, 0.0)


def _fade(distance: Array, shift: float, slope: float, length: float) -> Array:
    """Cubic from a shift and its slope to zero shift and slope at ``length``, then zero."""
    t = np.clip(distance / length, 0.0, 1.0)
    return shift * (1.0 + t**2 * (2.0 * t - 3.0)) + slope * length * t * (1.0 - t) ** 2


def log_route(lane_segments: LaneSegments, ego: EgoLog, most_points: int) -> Route:
    """Path of the logged ego (privileged), continued along its last lane, else straight on.

    Positions within half a metre of the previous one are left out as jitter; of a log that stays within 2 m of its
    first position, only the last remaining one is kept.
    """
    xyz, heading = ego.positions, ego.heading[ego.valid]
    keep = space_out(xyz[:, :2], STEP_M)
    if np.hypot(*(xyz - xyz[0])[:, :2].T).max() < STANDS_M:
        keep = keep[-1:]
    pose, course = xyz[keep[-1]], float(heading[keep[-1]])
    line = np.concatenate((xyz[keep], _continuation(lane_segments, pose, course)))
    probe = np.arange(0, len(line), LABEL_EVERY)
    lane, _, _ = lane_segments.nearest(line[probe], headings(line)[probe], REACH_M, SAME_TURN_RAD)
    return Route.along(line, np.repeat(lane, LABEL_EVERY)[: len(line)], most_points)


def _continuation(lane_segments: LaneSegments, pose: Float[Array, "3"], heading: float) -> Array:
    """Points 1 m apart ahead of a pose: along its lane, its lateral offset fading within 20 m; else straight."""
    lines = lane_segments.graph.lines
    count = int(LOG_AHEAD_M)
    distance = np.arange(1.0, count + 1.0)
    lane, s, _ = lane_segments.nearest(pose[None], np.array([heading]), REACH_M, SAME_TURN_RAD)
    if lane[0] < 0:
        xy = pose[:2] + distance[:, None] * np.array([np.cos(heading), np.sin(heading)])
    else:
        lateral = float((pose[:2] - lines.at(lane, s)[0, :2]) @ left_normals(lines.heading(lane, s))[0])
        points, courses = walk(lane_segments.graph, lane, s, 1.0, count)
        fade = lateral * np.maximum(1.0 - distance / _FADE_M, 0.0)
        xy = points[0] + fade[:, None] * left_normals(courses[0])
    return np.concatenate((xy, np.full((count, 1), pose[2])), axis=1)


def log_progress(route: Route, ego: EgoLog) -> Float[Array, " time"]:
    """Arc length of the logged ego along a route at every step, never decreasing, metres; gaps repeat the last value.

    The first position is searched on the whole route, and earlier steps get its value; each later position is searched
    no further ahead than 1.5 times the distance driven since the last valid step, plus 2 m.
    """
    rows = np.flatnonzero(ego.valid)
    xy = ego.positions[:, :2]
    step_m = np.hypot(*np.diff(xy, axis=0, prepend=xy[:1]).T)
    s = project_monotone(route.xyz, xy, 1.5 * step_m + 2.0)
    last_valid = np.searchsorted(rows, np.arange(len(ego.valid)), side="right") - 1
    return s[np.maximum(last_valid, 0)]
