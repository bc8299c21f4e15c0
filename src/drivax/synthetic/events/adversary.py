"""Severity of an adversary: the deceleration that avoids it, and the time to collision without braking.

Ego stays on its path. At each time T the adversary blocks the path from some station on; with d the distance to that
station and v ego's speed, the constant deceleration that keeps ego before it at T is

    a = 2 (v T - d) / T^2   where ego still moves at T (d >= v T / 2),   a = v^2 / (2 d)   where it is at rest,

and the required deceleration is the largest over all T.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from drivax.geometry.boxes import overlap, time_to_overlap
from drivax.scenario.schema import CURRENT_STEP, DT_S, AgentKind
from drivax.synthetic.events.actors import user_of
from drivax.synthetic.events.ego_view import EgoView
from drivax.synthetic.events.kinds import StagedEvent
from drivax.synthetic.roads.curves import STEP_M
from drivax.synthetic.traffic.roles import Motion, ScriptedUser

#: Largest time to collision of an event, s: as proposed, and as simulated; and by how much ego's box is smaller in
#: both, m. The margins exclude events that perception noise could undo.
NEAR_S, SURELY_S, _SMALLER_M = 1.0, 0.8, 0.3
#: Ego's speed counts as constant where it changes by less than this share.
_STEADY = 0.12
#: Actors appear no nearer to ego than this, m.
_VIEW_M = 40.0
#: Longitudinal and lateral distance between a new actor and other agents, m: of vehicles, and of other actors.
_APART_M, _APART_ON_FOOT_M = (1.5, 0.3), (0.2, 0.05)
#: Largest distance between the centres of vehicles that share a lane, m.
_IN_LANE_M = 6.5
#: Margins by which the box of a crossing vehicle is longer and wider, m; and the largest distance of centres, m.
_CROSSED_M, _NEAR_M = np.array([4.0, 1.2]), 15.0
#: Time gap of the vehicle behind an actor that appears, s.
_BEHIND_S = 0.8


def required_deceleration(
    speed_mps: float, room_m: Float64[np.ndarray, " k"], time_s: Float64[np.ndarray, " k"]
) -> float:
    """Constant deceleration with which ego has moved at most ``room_m`` at each time; 0 where it may keep its speed."""
    if np.any(room_m <= 0.0):
        return math.inf
    some = (time_s > 0) & (speed_mps * time_s > room_m)
    room, time = room_m[some], time_s[some]
    rolling = 2 * (speed_mps * time - room) / time**2
    stopping = speed_mps**2 / (2 * room)
    return float(np.max(np.where(room >= speed_mps * time / 2, rolling, stopping), initial=0.0))


def waiting_room(speed_mps: float, deceleration_mps2: float, time_s: float) -> float:
    """Distance to a place that is blocked until a time, so that it requires this deceleration."""
    if deceleration_mps2 * time_s <= speed_mps:
        return speed_mps * time_s - deceleration_mps2 * time_s**2 / 2
    return speed_mps**2 / (2 * deceleration_mps2)


def boxes(
    xy: Float64[np.ndarray, "*n 2"], heading: Float64[np.ndarray, "*n"], size_m: Any
) -> Float64[np.ndarray, "*n 6"]:
    """Boxes in the layout of :mod:`drivax.geometry.boxes`; sizes are broadcast."""
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return np.concatenate([xy, direction, np.broadcast_to(size_m, xy.shape)], axis=-1)


def actor_boxes(actor: ScriptedUser) -> Float64[np.ndarray, "time 6"]:
    """Boxes of an actor at all steps."""
    return boxes(actor.xy, actor.heading, actor.size_m[:2])


def first_blocked_station(view: EgoView, adversary: ScriptedUser, step: int) -> Float64[np.ndarray, " time"]:
    """First station ahead at which ego would touch the actor, for each step from ``step`` on, m (infinite: none)."""
    track, last = view.track, view.last_step
    box = actor_boxes(adversary)[step : last + 1]
    begin = int(track.at[step] / STEP_M)
    station, xy = STEP_M * np.arange(begin, len(track.xy)), track.xy[begin:]
    size = view.ego_size_m[:2]
    ego = boxes(xy, track.heading[begin:], size)
    reach = (math.hypot(*size) + math.hypot(*adversary.size_m[:2])) / 2
    gap = (box[:, None, 0] - xy[:, 0]) ** 2 + (box[:, None, 1] - xy[:, 1]) ** 2
    time, index = np.nonzero((gap < reach**2) & adversary.valid[step : last + 1, None])
    hit = overlap(ego[index], box[time])
    result = np.full(len(box), math.inf)
    np.minimum.at(result, time[hit], station[index[hit]])
    return result


def severity(view: EgoView, adversary: ScriptedUser, step: int) -> float:
    """Constant deceleration from a given step on with which ego just avoids the actor, m/s2."""
    room = first_blocked_station(view, adversary, step) - view.track.at[step]
    return required_by_samples(float(view.motion.speed[0, step]), room)


def required_by_samples(speed_mps: float, room_m: Float64[np.ndarray, " step"]) -> float:
    """:func:`required_deceleration` of the room until the first blocked sample of the path, at each step from now on.

    Corrects for sampling: the first blocked sample lies half a step of the path too far on average, and an actor
    that has left the path at a step has blocked it for half of that step.
    """
    time, taken = DT_S * np.arange(len(room_m)), np.isfinite(room_m)
    leaves = np.flatnonzero(taken[:-1] & ~taken[1:])
    time = np.concatenate([time, time[leaves] + DT_S / 2])
    room = np.concatenate([room_m, room_m[leaves]]) - STEP_M / 2
    return required_deceleration(speed_mps, np.maximum(room, 0.0), time)


def least_ttc(
    view: EgoView, actor: ScriptedUser, ego: tuple[float, float, float], hold_from: int, since: int
) -> float:
    """Least time to collision with an actor ahead from ``since`` on, s (at most 5).

    ``ego`` is its station, lateral offset and speed at ``hold_from``; it keeps the latter two from then on.
    """
    station, left, speed = ego
    steps = np.arange(max(since, hold_from), view.last_step + 1)
    xy, heading = view.track.pose(station + speed * DT_S * (steps - hold_from), left)
    own, other = boxes(xy, heading, view.ego_size_m[:2] - _SMALLER_M), actor_boxes(actor)[steps]
    toward = own[:, 2:4]
    time = time_to_overlap(own, speed * toward, other, actor.speed[steps, None] * other[:, 2:4], 5.0)
    time = np.where(overlap(own, other), 0.0, time)
    # Braking does not avoid actors from behind.
    ahead = np.sum((other[:, :2] - xy) * toward, axis=-1) > -view.ego_size_m[0] / 2
    return float(np.min(np.where(ahead & actor.valid[steps], time, 5.0), initial=5.0))


def endangers_ego(view: EgoView, motion: Motion, staged: StagedEvent) -> bool:
    """Whether the simulated actor comes close to collision with an ego that keeps its speed from the event's start.

    Rejects events that other agents disturbed, or for which ego became slower before. ``view`` is the scenario without
    the event, ``motion`` the simulated motion with it.
    """
    begin = staged.first_step
    (station,), (left,) = view.track.project(motion.xy[:1, begin])
    ego = station, left, float(motion.speed[0, begin])
    return least_ttc(view, user_of(motion, staged.actors[0]), ego, begin, begin) < SURELY_S


def comes_close(view: EgoView, adversary: ScriptedUser, step: int) -> bool:
    """Whether an ego at constant speed comes close to collision: from the event's first step, and from the current one.

    Where ego's speed changes in between (a turn, a queue) only the first counts.
    """
    current, speed = view.first_step + CURRENT_STEP, view.motion.speed[0]

    def close(hold_from: int) -> bool:
        ego = view.track.at[hold_from], 0.0, float(speed[hold_from])
        return least_ttc(view, adversary, ego, hold_from, step) < NEAR_S

    steady = abs(speed[step] - speed[current]) < _STEADY * speed[current]
    return close(step) and (not steady or close(current))


def vehicles_in_lane(view: EgoView, extra: ScriptedUser, until: int) -> tuple[int, ...]:
    """Rows of vehicles in the lane of a new actor, near it and with its heading, up to a step."""
    motion, steps = view.motion, np.arange(until + 1)
    rows = np.arange(1, motion.vehicles)
    gap = np.sum((motion.xy[rows, : until + 1] - extra.xy[steps]) ** 2, axis=-1)
    same = np.cos(motion.heading[rows, : until + 1] - extra.heading[steps]) > 0.7
    met = motion.valid[rows, : until + 1] & extra.valid[steps] & (gap < _IN_LANE_M**2) & same
    return tuple(rows[met.any(axis=1)].tolist())


def vehicles_that_cross(view: EgoView, extra: ScriptedUser) -> tuple[int, ...]:
    """Rows of vehicles that would collide with an actor that crosses their path."""
    motion, last = view.motion, view.last_step
    rows, moves = np.arange(1, motion.vehicles), np.flatnonzero(extra.valid & (np.abs(extra.speed) > 0.3))
    moves = moves[moves <= last]
    gap = np.sum((motion.xy[rows][:, moves] - extra.xy[moves]) ** 2, axis=-1)
    headings = motion.heading[rows][:, moves]
    crosses = np.abs(np.cos(headings - extra.heading[moves])) < 0.7
    row, step = np.nonzero(motion.valid[rows][:, moves] & crosses & (gap < _NEAR_M**2))
    size = motion.size_m[rows[row], :2] + _CROSSED_M
    other = boxes(motion.xy[rows[row], moves[step]], headings[row, step], size)
    hit = overlap(actor_boxes(extra)[moves[step]], other)
    return tuple(np.unique(rows[row[hit]]).tolist())


def enter_when_clear(
    view: EgoView, extra: ScriptedUser, until: int, removed: tuple[int, ...]
) -> ScriptedUser | None:
    """Let a new actor appear when it has no collision ahead; None where it has, or where ego would see it appear.

    Other agents see it and keep behind it: only agents ahead of it and pedestrians count, until ego may meet it at step
    ``until``; vehicles of the rows ``removed`` are left out.
    """
    motion, last = view.motion, until + 1
    along, across = _APART_M if extra.kind == AgentKind.VEHICLE else _APART_ON_FOOT_M
    box = actor_boxes(extra)[None, :last] + np.array([0, 0, 0, 0, 2 * along, 2 * across])
    users = slice(1, None)
    other = boxes(motion.xy[users, :last], motion.heading[users, :last], motion.size_m[users, None, :2])
    stays = ~np.isin(np.arange(len(motion.kind)), removed)[users, None]
    valid = motion.valid[users, :last] & extra.valid[:last] & stays
    near = np.sum((other[..., :2] - box[..., :2]) ** 2, axis=-1) < _NEAR_M**2
    user, step = np.nonzero(valid & near)
    forward = box[0, step, 2:4] * np.where(extra.speed[step] < 0, -1.0, 1.0)[:, None]
    ahead = np.sum((other[user, step, :2] - box[0, step, :2]) * forward, axis=-1) > 0
    on_foot = motion.kind[users][user] == AgentKind.PEDESTRIAN
    meets = step[overlap(box[0, step], other[user, step]) & (ahead | on_foot)]
    appears = int(np.argmax(extra.valid))
    if len(meets):
        # It appears after its last collision.
        appears = max(appears, int(meets.max()) + 5)
    if appears >= last or not extra.valid[appears]:
        return None
    seen = appears > view.first_step and np.hypot(*(extra.xy[appears] - motion.xy[0, appears])) < _VIEW_M
    scene = box[0, appears], other[:, appears], valid[:, appears], motion.speed[users, appears]
    if seen or not _is_clear(*scene):
        return None
    return replace(extra, valid=extra.valid & (np.arange(len(extra.valid)) >= appears))


def _is_clear(
    box: Float64[np.ndarray, " 6"], other: Float64[np.ndarray, "user 6"], valid: Bool[np.ndarray, " user"],
    speed: Float64[np.ndarray, " user"],
) -> bool:  # fmt: skip
    """Whether a new box is clear of all others, each extended by its travel of the next 0.8 s."""
    longer = other.copy()
    longer[:, 4] += _BEHIND_S * speed
    longer[:, :2] += _BEHIND_S / 2 * speed[:, None] * other[:, 2:4]
    return not bool(np.any(valid & overlap(np.broadcast_to(box, other.shape), longer)))
