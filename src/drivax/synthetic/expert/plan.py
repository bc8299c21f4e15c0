"""Plan ego's motion with knowledge of all future motion: the cheapest of a few paths at their best speeds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from drivax.geometry.boxes import corners
from drivax.geometry.vectors import wrap
from drivax.scenario.schema import DT_S, AgentKind
from drivax.synthetic.expert.candidates import (
    SPACING_M,
    CandidatePath,
    Conflicts,
    Shift,
    StopLine,
    arrivals,
    candidate_corners,
    find_conflicts,
    shift_path,
    stop_lines,
)
from drivax.synthetic.expert.speed_plan import (
    TOUCH,
    Bounds,
    Occupancy,
    SpeedPlan,
    SpeedProfile,
    search,
    smooth_speeds,
)
from drivax.synthetic.expert.violations import against_traffic, inside, user_boxes
from drivax.synthetic.roads.curves import Pose
from drivax.synthetic.traffic.lateral import project_on_path
from drivax.synthetic.traffic.paths import Path
from drivax.synthetic.traffic.roles import EgoPlan, Motion, Roles

#: Bounds of acceleration (m/s2) and jerk (m/s3), the most comfortable first.
_BOUNDS_BY_COMFORT = (((-3.4, 2.0), 2.6), ((-4.0, 2.3), 4.1), ((-5.9, 2.3), 25.0))
#: Cost of the original path below which no alternatives are computed if its smooth speeds are within their bounds.
_GOOD_COST = 12.0
#: Costs of a shift: constant, per m of offset, per second against traffic.
_SHIFT_COST, _OFFSET_COST, _WRONG_WAY_COST = 8.0, 2.0, 6.0
#: Weight, in ``Occupancy.near``, of a line at which the light is about to turn red or ego must give way.
_LATE_COST = 30.0
#: Weight, in ``Occupancy.near``, of places close to pedestrians and cyclists.
_VULNERABLE_FACTOR = 12.0
#: Steps by which motion is extrapolated beyond the recording.
_EXTRA_STEPS = 20
#: Lateral gap to a user that ego passes, m, and lateral acceleration of the shift, m/s2: preferred and tightest.
_PASSING_GAPS_M, _SHIFT_MPS2 = (0.8, 0.4), (1.6, 3.8)
#: Distance over which the remaining offset between ego and its path fades, m.
_FADE_M = 10.0
#: Largest shift, m, and largest second derivative of the quintic step from 0 to 1, 10 / sqrt(3).
_MAX_SHIFT_M, _STEP_CURVATURE = 4.5, 5.77
#: Excess over a bound that counts as rounding, in the units of ``SpeedProfile.excess``.
_TOLERANCE = 0.03

_Series = Float64[np.ndarray, " time"]


class _Hit(NamedTuple):
    """Conflict with another user: its index in ``_State.others``, the step, and the sample of ego's path."""

    user: int
    step: int
    point: int


class _Extent(NamedTuple):
    """Range of a user along ego's path, and its lateral extent on the side on which ego passes it, m."""

    begin: float
    end: float
    lateral: float


@dataclass(frozen=True)
class _State:
    """Planning input that all candidates share, from the first step of the plan on.

    Attributes:
        pose, from_m: Ego's pose and path position.
        acceleration: Ego's acceleration in the step before.
        others, valid: Boxes of the other users, and when they exist.
        passed_m: Ego's distance ahead of ``from_m`` at each step of the last run.
        vulnerable: Mask of pedestrians and cyclists among the others.
        unreactive: Mask of others that are not expected to react to ego.
    """

    roles: Roles
    path: Path
    pose: Pose
    from_m: float
    speed: float
    acceleration: float
    size_m: Float64[np.ndarray, " 3"]
    others: Float64[np.ndarray, "user time 6"]
    valid: Bool[np.ndarray, "user time"]
    passed_m: _Series
    lines: list[StopLine]
    vulnerable: Bool[np.ndarray, " user"]
    unreactive: Bool[np.ndarray, " user"]

    def candidate(self, shift: Shift) -> CandidatePath:
        """Return ego's path with a lateral shift, as far as ego can travel."""
        top = max(self.speed, 1.05 * float(np.max(self.path.limit_mps)))
        reach_m = top * DT_S * self.others.shape[1] + 15.0
        return shift_path(self.path, self.roles.drivers, self.pose, self.from_m, reach_m, shift)


@dataclass(frozen=True)
class _Option:
    """A candidate path with its occupancy, best speeds and cost."""

    candidate: CandidatePath
    occupancy: Occupancy
    speeds: SpeedPlan
    cost: float


def plan_ego(
    roles: Roles, motion: Motion, times_s: _Series, first_step: int, unreactive: frozenset[int] = frozenset()
) -> EgoPlan:
    """Plan ego's motion from a given step on, given all users' motion in the last run.

    ``unreactive`` are users that hit ego in an earlier run and so are not expected to react; ``times_s`` are on the
    clock of the lights.
    """
    state = _state(roles, motion, times_s, first_step, unreactive)
    candidate, profile = _best_candidate(state)
    steps = motion.xy.shape[1] - first_step
    xy, heading = candidate.pose(profile.at_m[:steps])
    # The path starts within millimetres of ego; the difference fades over the first metres.
    fade = np.clip(1.0 - profile.at_m[:steps] / _FADE_M, 0.0, 1.0)
    xy += fade[:, None] * (motion.xy[0, first_step] - xy[0])
    heading += fade * wrap(state.pose.heading - heading[0])
    heading = heading[0] + np.concatenate([[0.0], np.cumsum(wrap(np.diff(heading)))])
    return EgoPlan(first_step, xy, heading, profile.speed[:steps])


def _state(
    roles: Roles, motion: Motion, times_s: _Series, first_step: int, unreactive: frozenset[int]
) -> _State:
    """Derive the planning input from the last run."""
    x, y = motion.xy[0, first_step]
    pose = Pose(float(x), float(y), float(motion.heading[0, first_step]))
    paths = motion.paths or roles.paths
    from_m = project_on_path(paths[0], motion.xy[0, first_step], float(motion.distance_m[0, first_step]))[0]
    boxes, valid = _extrapolate(motion, first_step)
    rows = np.arange(1, len(motion.kind))
    state = _State(
        roles=roles,
        path=paths[0],
        pose=pose,
        from_m=from_m,
        speed=max(0.0, float(motion.speed[0, first_step])),
        acceleration=float(motion.acceleration[0, max(0, first_step - 1)]),
        size_m=motion.size_m[0],
        others=boxes,
        valid=valid,
        passed_m=np.zeros(boxes.shape[1]),
        lines=[],
        vulnerable=np.isin(motion.kind[1:], (AgentKind.PEDESTRIAN, AgentKind.CYCLIST)),
        unreactive=(rows >= motion.vehicles) | np.isin(rows, sorted(unreactive)),
    )
    candidate = state.candidate(Shift())
    gap = candidate.xy[:, None] - motion.xy[0, first_step:]
    passed_m = candidate.base_m[np.argmin(np.sum(gap**2, axis=-1), axis=0)]
    state = replace(state, passed_m=_repeat_last_step(passed_m))
    return replace(state, lines=_lines(motion, times_s[first_step:], state))


def _repeat_last_step(values: np.ndarray) -> np.ndarray:
    """Extend a series by copies of its last value."""
    return np.append(values, np.repeat(values[-1:], _EXTRA_STEPS))


def _extrapolate(
    motion: Motion, first_step: int
) -> tuple[Float64[np.ndarray, "user time 6"], Bool[np.ndarray, "user time"]]:
    """Return the boxes of other users from ``first_step`` on, extrapolated at constant velocity beyond the end."""
    box, valid = user_boxes(motion)[1:, first_step:], motion.valid[1:, first_step:]
    extension = np.repeat(box[:, -1:], _EXTRA_STEPS, axis=1)
    travelled = motion.speed[1:, -1:] * DT_S * np.arange(1, _EXTRA_STEPS + 1)
    extension[..., :2] += travelled[..., None] * extension[..., 2:4]
    extra = np.repeat(valid[:, -1:], _EXTRA_STEPS, axis=1)
    return np.concatenate([box, extension], axis=1), np.concatenate([valid, extra], axis=1)


def _lines(motion: Motion, times_s: _Series, state: _State) -> list[StopLine]:
    """Return the stop lines ahead, at the steps of the plan and of its extrapolation."""
    steps, half = len(times_s), motion.size_m[: motion.vehicles, 0] / 2
    roles = state.roles
    distance, valid = motion.distance_m[:, -steps:], motion.valid[: motion.vehicles, -steps:]
    coming = arrivals(roles.network, motion.paths or roles.paths, distance, valid, half)
    coming = {lane: _repeat_last_step(is_coming) for lane, is_coming in coming.items()}
    clock = np.append(times_s, times_s[-1] + DT_S * np.arange(1, _EXTRA_STEPS + 1))
    ego, passed = (state.from_m, float(half[0])), state.from_m + state.passed_m
    return stop_lines(roles.network, state.path, ego, clock, passed, coming)


def _best_candidate(state: _State) -> tuple[CandidatePath, SpeedProfile]:
    """Return the cheapest feasible candidate, else the one that violates its bounds least."""
    candidate = state.candidate(Shift())
    conflicts = _conflicts(state, candidate)
    options = [_option(state, candidate, conflicts)]
    infeasible: list[tuple[float, CandidatePath, SpeedProfile]] = []
    if options[0].cost < _GOOD_COST:
        profile = _smooth(state, options[0])
        if profile.excess <= _TOLERANCE:
            return candidate, profile
    options += _passing_options(state, candidate, conflicts)
    for option in sorted(options, key=lambda option: option.cost):
        profile = _smooth(state, option)
        if profile.excess <= _TOLERANCE and not option.speeds.touches:
            return option.candidate, profile
        infeasible.append((profile.excess + 100.0 * option.speeds.touches, option.candidate, profile))
    _, candidate, profile = min(infeasible, key=lambda entry: entry[0])
    return candidate, profile


def _conflicts(state: _State, candidate: CandidatePath) -> Conflicts:
    """Return conflicts along a candidate, without those of vehicles that follow ego and will react."""
    conflicts = find_conflicts(candidate, state.size_m, state.others, state.valid, state.vulnerable)
    is_follower = np.zeros(len(state.others), bool)
    order = np.lexsort((-conflicts.point, conflicts.step, conflicts.user))
    users, first = np.unique(conflicts.user[order], return_index=True)
    step, point = conflicts.step[order][first], conflicts.point[order][first]
    box = state.others[users, step]
    along = box[:, 2] * np.cos(candidate.heading[point]) + box[:, 3] * np.sin(candidate.heading[point])
    is_behind = candidate.base_m[point] < state.passed_m[step]
    is_follower[users] = is_behind & (along > 0.7) & ~state.unreactive[users]
    return conflicts.select(~is_follower[conflicts.user])


def _option(state: _State, candidate: CandidatePath, conflicts: Conflicts) -> _Option:
    """Search the best speeds along a candidate and add the costs of its shift."""
    occupancy = _occupancy(state, candidate, conflicts)
    speeds = search(occupancy, candidate.preferred_mps, candidate.limit_mps, state.speed)
    cost = speeds.cost
    if candidate.shift.aside_m:
        wrong = against_traffic(state.roles.network, candidate.xy[::4], candidate.heading[::4])
        wrong_m, lateral = float(wrong.sum() * 4 * SPACING_M), abs(candidate.shift.aside_m)
        cost += _SHIFT_COST + _OFFSET_COST * lateral + _WRONG_WAY_COST * wrong_m / max(state.speed, 4.0)
    return _Option(candidate, occupancy, speeds, cost)


def _occupancy(state: _State, candidate: CandidatePath, conflicts: Conflicts) -> Occupancy:
    """Return the occupancy of a candidate by others, stop lines, and the end of the map."""
    shape = (state.others.shape[1], len(candidate.xy))
    hard, near = np.zeros(shape, bool), np.zeros(shape)
    weight = np.where(state.vulnerable[conflicts.user], _VULNERABLE_FACTOR, 1.0)
    np.maximum.at(near, (conflicts.step, conflicts.point), weight)
    hard[conflicts.step[conflicts.hard], conflicts.point[conflicts.hard]] = True
    # Lines are so thick that ego does not pass over them within 0.1 s.
    thickness = int(np.ceil((0.1 * (float(candidate.preferred_mps.max()) + state.speed) + 0.5) / SPACING_M))
    for line in state.lines:
        if line.base_m < candidate.base_m[-1]:
            index = int(np.searchsorted(candidate.base_m, line.base_m))
            hard[line.closed, index : index + thickness] = True
            near[line.late, index : index + thickness] = _LATE_COST
    room = state.path.length_m - state.from_m - state.size_m[0] / 2 - 0.5
    hard[:, candidate.base_m > room] = True
    return Occupancy(SPACING_M, hard, near)


def _smooth(state: _State, option: _Option) -> SpeedProfile:
    """Smooth an option's speeds within the most comfortable feasible bounds, else within the widest ones."""
    position, speed = option.speeds.resample(state.others.shape[1])
    speed[0] = state.speed
    hard = option.occupancy.hard[1:]
    index = np.arange(hard.shape[1])
    ego_index = np.clip(np.rint(position[1:] / SPACING_M).astype(int), 0, len(index) - 1)
    below = np.where(hard & (index < ego_index[:, None]), index, -1).max(axis=1)
    above = np.where(hard & (index > ego_index[:, None]), index, len(index)).min(axis=1)
    # Steps at which even the best speeds touch something are unbounded.
    has_contact = hard[np.arange(len(hard)), ego_index]
    low = np.where((below >= 0) & ~has_contact, (below + 1) * SPACING_M, -np.inf)
    high = np.where(has_contact, np.inf, (above - 1) * SPACING_M)
    window = np.clip(ego_index[:, None] + np.arange(-4, 5), 0, len(index) - 1)
    top = np.maximum(option.candidate.limit_mps[window].min(axis=1), speed[1:])
    profile = None
    for acceleration, jerk in _BOUNDS_BY_COMFORT:
        bounds = Bounds(low, np.maximum(high, low), top, acceleration, jerk)
        profile = smooth_speeds(position, speed, state.acceleration, bounds)
        if profile.excess <= _TOLERANCE:
            break
    assert profile is not None
    return profile


def _passing_options(state: _State, candidate: CandidatePath, conflicts: Conflicts) -> list[_Option]:
    """Return options that pass the first obstacle, if there is one; tight gaps only where wider ones fail."""
    hit = _first_hit(state, candidate, conflicts)
    if hit is None:
        return []
    rings = tuple(edge.xy for edge in state.roles.network.edges)
    result = []
    for side in (1.0, -1.0):
        for margins in zip(_PASSING_GAPS_M, _SHIFT_MPS2, strict=True):
            shift = _shift(state, candidate, conflicts, hit, side, margins)
            if shift is None:
                continue
            shifted = state.candidate(shift)
            if not bool(inside(candidate_corners(shifted, state.size_m + 0.2), rings).all()):
                continue
            option = _option(state, shifted, _conflicts(state, shifted))
            result.append(option)
            if option.cost < TOUCH:
                break
    return result


def _first_hit(state: _State, candidate: CandidatePath, conflicts: Conflicts) -> _Hit | None:
    """Return the first collision at the preferred speeds, if there is one."""
    position, speed, positions = 0.0, state.speed, []
    for _ in range(state.others.shape[1]):
        positions.append(position)
        index = min(int(position / SPACING_M), len(candidate.xy) - 1)
        speed = min(speed + 1.5 * DT_S, max(float(candidate.preferred_mps[index]), speed - 2.0 * DT_S))
        position += speed * DT_S
    separation = np.abs(conflicts.point * SPACING_M - np.array(positions)[conflicts.step])
    is_contact = conflicts.hard & (separation < 0.3 + 0.05 * state.speed)
    if not is_contact.any():
        return None
    first = int(np.flatnonzero(is_contact)[np.argmin(conflicts.step[is_contact])])
    return _Hit(int(conflicts.user[first]), int(conflicts.step[first]), int(conflicts.point[first]))


def _shift(
    state: _State, candidate: CandidatePath, conflicts: Conflicts, hit: _Hit, side: float,
    margins: tuple[float, float],
) -> Shift | None:  # fmt: skip
    """Return the shift that passes a user, and standing users close behind it, on one side (1: left, -1: right).

    ``margins`` are lateral gap (m) and acceleration (m/s2). Return None if the shift would be too small or too large.
    """
    gap_m, shift_mps2 = margins
    begin, end, lateral = _extent(state, candidate, hit, side)
    half_length_m, half_width_m = state.size_m[0] / 2 + 1.0, state.size_m[1] / 2
    passed_users = {hit.user}
    standing_users = [
        user
        for user in np.unique(conflicts.user[conflicts.hard]).tolist()
        if np.ptp(state.others[user, state.valid[user], :2], axis=0).max() < 0.5
    ]
    for user in sorted(standing_users, key=lambda u: int(conflicts.point[conflicts.user == u].min())):
        user_conflicts = conflicts.hard & (conflicts.user == user)
        index = int(conflicts.point[user_conflicts].min())
        if user not in passed_users and begin < index * SPACING_M < end + 20.0:
            user_hit = _Hit(user, int(conflicts.step[user_conflicts].min()), index)
            extent = _extent(state, candidate, user_hit, side)
            end, lateral = max(end, extent.end), max(lateral, extent.lateral)
            passed_users.add(user)
    lateral = lateral + half_width_m + gap_m
    if not 0.15 < lateral < _MAX_SHIFT_M:
        return None
    speed = max(state.speed, float(candidate.preferred_mps[hit.point]) * 0.7)
    out_m = max(speed * float(np.sqrt(_STEP_CURVATURE * lateral / shift_mps2)), 3.0 * lateral, 8.0)
    back_m = max(out_m, speed * float(np.sqrt(_STEP_CURVATURE * lateral / _SHIFT_MPS2[0])))
    out_begin = max(0.0, begin - half_length_m - out_m)
    out_end = out_begin + out_m
    back_begin = max(end + half_length_m, out_end)
    return Shift(side * lateral, out_begin, out_end, back_begin, back_begin + back_m)


def _extent(state: _State, candidate: CandidatePath, hit: _Hit, side: float) -> _Extent:
    """Return the extent of a user in conflict, for passing it on the left (1) or right (-1) side."""
    user, step, point = hit
    box = state.others[user, step]
    c, s = float(np.cos(candidate.heading[point])), float(np.sin(candidate.heading[point]))
    offset = corners(box) - candidate.xy[point]
    along, left = offset @ np.array([c, s]), offset @ np.array([-s, c])
    # Ego passes moving users over a longer stretch, which grows with their speed along the path.
    later_step = min(step + 10, len(state.others[user]) - 1)
    duration_s = max((later_step - step) * DT_S, DT_S)
    speed_along_mps = (state.others[user, later_step, :2] - box[:2]) @ np.array([c, s]) / duration_s
    position = point * SPACING_M
    ahead_m, behind_m = max(3.0 * speed_along_mps, 0.7 * -speed_along_mps, 0.0), 0.7 * abs(speed_along_mps)
    return _Extent(
        begin=position + float(along.min()) - behind_m,
        end=position + float(along.max()) + ahead_m,
        lateral=float((side * left).max()),
    )
