"""Checks of a generated motion: violations that reject it, and nuPlan's comfort limits.

The limits of comfort are those of :mod:`drivax.metrics.comfort`; the filters are the world's own (decision 0011).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Bool, Float64, Int64

from drivax.geometry.boxes import corners, overlap
from drivax.geometry.vectors import wrap
from drivax.scenario.schema import DT_S, AgentKind, nonzero
from drivax.synthetic.roads.network import Control, Lane, RoadNetwork
from drivax.synthetic.roads.signals import Colour
from drivax.synthetic.traffic.paths import Path
from drivax.synthetic.traffic.roles import Motion, Roles, Staging

#: Margin around ego in overlap tests, m: covers replay in float32 and the noise of recorded tracks.
EGO_SKIN_M = 0.1
#: Least distance that ego must travel, m.
_LEAST_M = 10.0
#: Largest speed and distance of a stop at a line, m/s and m, and largest time between the stop and passing, s.
_STANDING_MPS, _BEFORE_LINE_M, _STOP_WINDOW_S = 0.5, 3.0, 3.0
#: Distance against traffic within 1 s from which the metric ``direction`` falls below 1, m.
_WRONG_WAY_M = 2.0
#: Distance from the route's lanes beyond which ego is off its route, m; the metric uses 2.
_OFF_ROUTE_M = 1.9
#: A lane against the heading counts only if it is nearer than all others by more than this, m.
_AMBIGUITY_M = 0.5
#: Lowest and highest value of each quantity of comfort (nuPlan).
LIMITS: dict[str, tuple[float, float]] = {
    "longitudinal_mps2": (-4.05, 2.40),
    "lateral_mps2": (-4.89, 4.89),
    "jerk_mps3": (-4.13, 4.13),
    "jerk_magnitude_mps3": (-8.37, 8.37),
    "yaw_rate_rps": (-0.95, 0.95),
    "yaw_acceleration_rps2": (-1.93, 1.93),
}

#: A number and a flag per time step.
_Series = Float64[np.ndarray, " time"]
_Steps = Bool[np.ndarray, " step"]
_UserPairs = Bool[np.ndarray, "user user"]
_LaneSteps = Bool[np.ndarray, "step lane"]
_Points = Float64[np.ndarray, "time 2"]


@dataclass(frozen=True)
class Violation:
    """Reason to reject a scenario.

    Attributes:
        cause: Name of the violation (empty: none).
        users, step: Users that ego collides with, and the first step of a collision (other causes: none, 0).
    """

    cause: str = ""
    users: tuple[int, ...] = ()
    step: int = 0


def user_boxes(motion: Motion) -> Float64[np.ndarray, "user time 6"]:
    """Return all users' boxes in the layout of :mod:`drivax.geometry.boxes`."""
    result = np.empty((*motion.heading.shape, 6))
    result[..., :2], result[..., 4:] = motion.xy, motion.size_m[:, None, :2]
    np.cos(motion.heading, out=result[..., 2])
    np.sin(motion.heading, out=result[..., 3])
    return result


def find_violation(
    roles: Roles, motion: Motion, times_s: _Series, first_step: int, staging: Staging, hardest_mps2: float
) -> Violation:
    """Return the first violation of a motion from a given step on, in the order of the checks.

    Ego may drive against traffic in scenarios with a staged event or with parked cars, which it may have to pass.
    ``times_s`` are on the clock of the lights; ``hardest_mps2`` is the hardest accepted braking of ego.
    """
    window = slice(first_step, None)
    speed = motion.speed[0, window]
    if np.sum(np.abs(speed)) * DT_S < _LEAST_M:
        return Violation("ego_hardly_moves")
    if not motion.valid[0, window].all():
        return Violation("ego_leaves_map")
    box = user_boxes(motion.from_step(first_step))
    overlap_step = first_overlap_step(box, motion.valid[:, window], _tested_pairs(motion))
    users = np.flatnonzero(overlap_step[0] < box.shape[1])
    if len(users):
        return Violation("ego_collides", tuple(users.tolist()), first_step + int(overlap_step[0].min()))
    if np.diff(speed).min() < -(hardest_mps2 + 0.02) * DT_S:
        return Violation("ego_brakes_hard")
    if leaves_road(roles.network, box[0]):
        return Violation("ego_leaves_road")
    cause = _find_rule_violation(roles, motion, times_s, first_step)
    if cause:
        return Violation(cause)
    may_pass = roles.parked or is_staged(staging)
    if not may_pass and goes_against_traffic(roles.network, box[0, :, :2], motion.heading[0, window]):
        return Violation("ego_wrong_way")
    return Violation("others_collide" if (overlap_step < box.shape[1]).any() else "")


def is_staged(staging: Staging) -> bool:
    """Return whether a staging changes anything."""
    return any(vars(staging).values())


def _tested_pairs(motion: Motion) -> _UserPairs:
    """Mask of pairs that must not overlap: not two pedestrians, not two static users."""
    is_pedestrian = motion.kind == AgentKind.PEDESTRIAN
    is_moving = np.abs(np.where(motion.valid, motion.speed, 0.0)).max(axis=1) > 0.0
    return (is_moving[:, None] | is_moving) & ~(is_pedestrian[:, None] & is_pedestrian)


def first_overlap_step(
    box: Float64[np.ndarray, "user time 6"], valid: Bool[np.ndarray, "user time"], tested: _UserPairs
) -> Int64[np.ndarray, "user user"]:
    """Return the step at which tested pairs first overlap (the number of steps: never), with a margin around ego."""
    box = box.copy()
    box[0, :, 4:] += 2 * EGO_SKIN_M
    reach = np.hypot(box[:, 0, 4], box[:, 0, 5]) / 2
    # Broad phase: bounding rectangles of the trajectories.
    may_meet = np.triu(tested, 1)
    for values in (box[..., 0], box[..., 1]):
        low = np.where(valid, values, np.inf).min(axis=1) - reach
        high = np.where(valid, values, -np.inf).max(axis=1) + reach
        may_meet &= (low[:, None] <= high) & (high[:, None] >= low)
    first, second = np.nonzero(may_meet)
    dx, dy = (box[first, :, axis] - box[second, :, axis] for axis in (0, 1))
    squared_gap = dx * dx + dy * dy
    is_near = (squared_gap < ((reach[first] + reach[second]) ** 2)[:, None]) & valid[first] & valid[second]
    index, time = nonzero(is_near)
    hit = overlap(box[first[index], time], box[second[index], time])
    result = np.full((len(box), len(box)), box.shape[1])
    np.minimum.at(result, (first[index[hit]], second[index[hit]]), time[hit])
    return np.minimum(result, result.T)


def inside(
    points: Float64[np.ndarray, "point 2"], rings: tuple[Float64[np.ndarray, "_ 2"], ...]
) -> Bool[np.ndarray, " point"]:
    """Mask of points inside the area bounded by closed rings (even-odd rule, exact)."""
    crossings = np.zeros(len(points), int)
    x, y = points.T.copy()
    for ring in rings:
        a, b = ring, np.roll(ring, -1, axis=0)
        is_near = (np.minimum(a, b) <= points.max(axis=0)) & (np.maximum(a, b) >= points.min(axis=0))
        # Rays to the right meet only sides at the points' heights that reach beyond the leftmost point.
        keep = is_near[:, 1] & (np.maximum(a, b)[:, 0] >= points[:, 0].min())
        (ax, ay), (bx, by) = a[keep].T, b[keep].T
        point, k = nonzero((ay > y[:, None]) != (by > y[:, None]))
        (ax, ay), (bx, by), x_of, y_of = (ax[k], ay[k]), (bx[k], by[k]), x[point], y[point]
        side = (bx - ax) * (y_of - ay) - (x_of - ax) * (by - ay)
        crossings += np.bincount(point[(side > 0) == (by > ay)], minlength=len(points))
    return crossings % 2 == 1


def leaves_road(network: RoadNetwork, box: Float64[np.ndarray, "time 6"]) -> bool:
    """Return whether a corner of the box leaves the road at any step."""
    is_new = np.append(True, np.abs(np.diff(box[:, :4], axis=0)).max(axis=1) > 0.0)
    points = corners(box[is_new]).reshape(-1, 2)
    return not bool(inside(points, tuple(edge.xy for edge in network.edges)).all())


def passes(lane: Lane, front: _Points, heading: _Series) -> _Steps:
    """Mask of steps in which the middle of a front bumper passes the line at the start of a lane, in its direction."""
    begin = lane.curve.start
    c, s = math.cos(begin.heading), math.sin(begin.heading)
    dx, dy = front[:, 0] - begin.x, front[:, 1] - begin.y
    ahead, left = dx * c + dy * s, dy * c - dx * s
    within = (np.abs(left) < lane.width_m / 2 + 0.3) & (np.cos(heading - begin.heading) > 0.5)
    return (ahead[:-1] <= 0.0) & (ahead[1:] > 0.0) & within[1:]


def _find_rule_violation(roles: Roles, motion: Motion, times_s: _Series, first_step: int) -> str:
    """Return ``ego_runs_red``, ``other_runs_red``, ``ego_runs_stop_sign``, or an empty string."""
    network, window = roles.network, slice(first_step, None)
    red = np.zeros((len(times_s) - first_step, len(network.lanes)), bool)
    if network.signals is not None:
        red = network.signals.colours(times_s[window], len(network.lanes))[0] == Colour.RED
    red_steps = red[:-1] & red[1:]
    for i, path in enumerate(motion.paths or roles.paths):
        heading, valid = motion.heading[i, window], motion.valid[i, window]
        front = _front(motion, i)[window]
        for span in path.spans:
            lane = network.lanes[span.lane]
            has_stop_sign = i == 0 and lane.control in (Control.STOP, Control.ALL_WAY_STOP)
            if not lane.connector or not (has_stop_sign or red_steps[:, span.lane].any()):
                continue
            passed = passes(lane, front, heading) & valid[:-1] & valid[1:]
            if np.any(passed & red_steps[:, span.lane]):
                return "ego_runs_red" if i == 0 else "other_runs_red"
            if has_stop_sign and not _stopped_before_line(lane, motion, first_step, front, passed):
                return "ego_runs_stop_sign"
        if i == 0 and _passes_red_off_route(network, path, motion.xy[0, window], front, heading, red_steps):
            return "ego_runs_red"
    return ""


def _passes_red_off_route(
    network: RoadNetwork, path: Path, xy: _Points, front: _Points, heading: _Series, red_steps: _LaneSteps
) -> bool:
    """Return whether ego, off its route, passes the line of another lane at red; the metric counts this, too."""
    route = {span.lane for span in path.spans}
    red_lanes = np.flatnonzero(red_steps.any(axis=0))
    others = [k for k in red_lanes if network.lanes[k].connector and k not in route]
    passed = [passes(network.lanes[k], front, heading) & red_steps[:, k] for k in others]
    if not np.any(passed):
        return False
    route_xy = np.concatenate([network.lanes[k].curve.xy for k in route])
    off_route = np.hypot(*(xy[:, None] - route_xy).transpose(2, 0, 1)).min(axis=1) > _OFF_ROUTE_M
    return bool((np.any(passed, axis=0) & off_route[1:]).any())


def _front(motion: Motion, user: int) -> _Points:
    """Return the middle of a user's front bumper."""
    heading = motion.heading[user]
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1) * motion.size_m[user, 0] / 2
    return motion.xy[user] + ahead


def last_stop(roles: Roles, motion: Motion, first_step: int) -> int:
    """Return the last step at which ego stands before it passes a stop sign, else the first step."""
    front, result = _front(motion, 0), first_step
    for span in (motion.paths or roles.paths)[0].spans:
        lane = roles.network.lanes[span.lane]
        if lane.connector and lane.control in (Control.STOP, Control.ALL_WAY_STOP):
            for step in np.flatnonzero(passes(lane, front, motion.heading[0])):
                stops = np.flatnonzero(motion.speed[0, first_step : step + 1] < _STANDING_MPS)
                result = max(result, first_step + int(stops[-1])) if len(stops) else result
    return result


def _stopped_before_line(lane: Lane, motion: Motion, first_step: int, front: _Points, passed: _Steps) -> bool:
    """Return whether ego stopped at most 3 m before the line and 3 s before each passing of it."""
    for step in np.flatnonzero(passed):
        # The stop may lie before the recording.
        begin = max(0, first_step + int(step) - round(_STOP_WINDOW_S / DT_S))
        gap = np.hypot(*(motion.xy[0, begin : first_step + step + 1] - lane.curve.xy[0]).T)
        close = gap < motion.size_m[0, 0] / 2 + _BEFORE_LINE_M
        slow = motion.speed[0, begin : first_step + step + 1] < _STANDING_MPS
        if not np.any(close & slow):
            return False
    return True


def against_traffic(
    network: RoadNetwork, xy: Float64[np.ndarray, "place 2"], heading: Float64[np.ndarray, " place"]
) -> Bool[np.ndarray, " place"]:
    """Mask of poses whose nearest lane leads the other way (headings differ by more than 135 degrees).

    That lane must be more than 0.5 m nearer than all lanes that do not: where lanes cross, the latter decide.
    """
    points = np.concatenate([lane.curve.xy[::2] for lane in network.lanes])
    course = np.concatenate([lane.curve.heading[::2] for lane in network.lanes])
    is_near = ((points >= xy.min(axis=0) - 6.0) & (points <= xy.max(axis=0) + 6.0)).all(axis=1)
    points, course = points[is_near], course[is_near]
    if not len(points):
        return np.zeros(len(xy), bool)
    dx, dy = (np.subtract.outer(xy[:, axis], points[:, axis]) for axis in (0, 1))
    squared = dx * dx + dy * dy
    # Points further away cannot decide.
    limit_m = np.sqrt(squared.min(axis=1)) + _AMBIGUITY_M + 1e-3
    place, point = nonzero(squared <= (limit_m * limit_m)[:, None])
    gap = np.hypot(dx[place, point], dy[place, point])
    against = np.cos(heading[place] - course[point]) < math.cos(math.radians(135.0))
    opposed, other = np.full((2, len(xy)), np.inf)
    np.minimum.at(opposed, place[against], gap[against])
    np.minimum.at(other, place[~against], gap[~against])
    return opposed < other - _AMBIGUITY_M


def goes_against_traffic(network: RoadNetwork, xy: _Points, heading: _Series) -> bool:
    """Return whether ego travels more than 2 m against traffic within a second."""
    stride = 2
    wrong = against_traffic(network, xy[::stride], heading[::stride])
    travelled = np.hypot(*np.diff(xy[::stride], axis=0).T) * wrong[1:]
    window = round(1.0 / (stride * DT_S))
    return bool(np.convolve(travelled, np.ones(window)).max() > _WRONG_WAY_M)


@cache
def smoother(count: int, window: int, order: int, derivative: int = 0) -> Float64[np.ndarray, "count count"]:
    """Return the Savitzky-Golay filter (Savitzky and Golay 1964) of ``count`` samples as a matrix.

    ``count`` is at least ``window``; derivatives are per sample. The first and last polynomials extend to the ends. As
    in SciPy, an even window is evaluated half a sample before the upper one of its two middle samples.
    """
    half = window // 2
    first = np.clip(np.arange(count) - half + (window % 2 == 0), 0, count - window)
    position = np.arange(count) - first.astype(float)
    if window % 2 == 0:
        inner = (np.arange(count) >= half) & (np.arange(count) < count - half)
        position[inner] = half - 0.5
    factorial = float(np.prod(np.arange(1, derivative + 1))) if derivative else 1.0
    rows = np.zeros((count, count))
    for row in range(count):
        powers = (np.arange(window) - position[row])[:, None] ** np.arange(order + 1)
        rows[row, first[row] : first[row] + window] = np.linalg.pinv(powers)[derivative] * factorial
    return rows


def quantities(heading: _Series, speed: _Series) -> dict[str, Float64[np.ndarray, " step"]]:
    """Return the smoothed quantities of :data:`LIMITS` at each step but the first."""
    relative_heading = wrap(np.diff(heading))
    longitudinal, lateral = np.diff(speed) / DT_S, (speed[1:] + speed[:-1]) / 2 * relative_heading / DT_S
    course = np.cumsum(relative_heading)
    slope = {"window": 15, "order": 2, "derivative": 1}
    return {
        "longitudinal_mps2": _savgol_filter(longitudinal, 8, 2),
        "lateral_mps2": _savgol_filter(lateral, 8, 2),
        "jerk_mps3": _savgol_filter(longitudinal, **slope),
        "jerk_magnitude_mps3": _savgol_filter(np.hypot(longitudinal, lateral), **slope),
        "yaw_rate_rps": _savgol_filter(course, **slope),
        "yaw_acceleration_rps2": _savgol_filter(course, 15, 3, 2),
    }


def _savgol_filter(
    values: Float64[np.ndarray, " n"], window: int, order: int, derivative: int = 0
) -> Float64[np.ndarray, " n"]:
    # The last bits of BLAS would depend on the number of threads.
    weights = smoother(len(values), window, order, derivative)
    return np.einsum("ij,j->i", weights, values) / DT_S**derivative


def broken_limits(heading: _Series, speed: _Series) -> tuple[str, ...]:
    """Return the quantities that exceed their limits, in the order of :data:`LIMITS`."""
    return tuple(
        name
        for name, values in quantities(heading, speed).items()
        if values.min() < LIMITS[name][0] or values.max() > LIMITS[name][1]
    )


def discomfort(heading: _Series, speed: _Series) -> str:
    """Return the first of :func:`broken_limits`, or an empty string."""
    return next(iter(broken_limits(heading, speed)), "")
