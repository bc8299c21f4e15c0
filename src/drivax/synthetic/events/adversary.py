"""Severity of an adversary: the deceleration that avoids it, and the time to collision without braking.

Ego stays on its path. At each time T the adversary blocks the path from some station on; with d the distance to that
station and v ego's speed, the constant deceleration that keeps ego short of the station at T is

    a = 2 (v T - d) / T^2   where ego still moves at T (d >= v T / 2),   a = v^2 / (2 d)   where ego is at rest,

and the required deceleration is the largest over all T.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from drivax.geometry.boxes import overlap, time_to_overlap
from drivax.scenario.schema import CURRENT_STEP, DT_S, AgentKind, nonzero
from drivax.synthetic.events.actors import user_trajectory
from drivax.synthetic.events.ego_view import EgoView
from drivax.synthetic.events.kinds import StagedEvent
from drivax.synthetic.roads.curves import STEP_M
from drivax.synthetic.traffic.roles import Motion, ScriptedUser

#: Largest time to collision of a proposed and of a simulated event, s, and reduction of ego's box for both, m: events
#: that perception noise could undo are excluded.
_PROPOSED_TTC_S, _SIMULATED_TTC_S, _BOX_MARGIN_M = 1.0, 0.8, 0.3
#: Relative change of ego's speed below which it counts as constant.
_STEADY_SHARE = 0.12
#: Horizon of the time to collision, s.
_TTC_HORIZON_S = 5.0
#: Least distance from ego at which an actor may appear during the recording, m.
_APPEARANCE_M = 40.0
#: Longitudinal and lateral distance of a new actor from other agents, m: for a vehicle, and for other kinds of actors.
_VEHICLE_MARGIN_M, _OTHER_MARGIN_M = (1.5, 0.3), (0.2, 0.05)
#: Distance of centres below which parallel vehicles block a new actor, m.
_SAME_LANE_M = 6.5
#: Margins added to the length and width of a crossing vehicle, and largest distance of centres in overlap tests, m.
_CROSSING_MARGIN_M, _NEAR_M = np.array([4.0, 1.2]), 15.0
#: Vehicles must need at least this time to reach an actor that appears, s.
_BEHIND_S = 0.8


def required_deceleration(
    speed_mps: float, room_m: Float64[np.ndarray, " k"], time_s: Float64[np.ndarray, " k"]
) -> float:
    """Return the constant deceleration with which ego moves at most ``room_m`` by each time, m/s2.

    It is 0 if ego need not brake, and infinite if a distance is not positive.
    """
    if np.any(room_m <= 0.0):
        return math.inf
    is_relevant = (time_s > 0) & (speed_mps * time_s > room_m)
    room, time = room_m[is_relevant], time_s[is_relevant]
    moving_mps2 = 2 * (speed_mps * time - room) / time**2
    stopping_mps2 = speed_mps**2 / (2 * room)
    return float(np.max(np.where(room >= speed_mps * time / 2, moving_mps2, stopping_mps2), initial=0.0))


def waiting_room(speed_mps: float, deceleration_mps2: float, time_s: float) -> float:
    """Return the distance, m, at which a place that is blocked until a time requires this deceleration."""
    if deceleration_mps2 * time_s <= speed_mps:
        return speed_mps * time_s - deceleration_mps2 * time_s**2 / 2
    return speed_mps**2 / (2 * deceleration_mps2)


def boxes(
    xy: Float64[np.ndarray, "*n 2"], heading: Float64[np.ndarray, "*n"], size_m: Any
) -> Float64[np.ndarray, "*n 6"]:
    """Return boxes in the layout of :mod:`drivax.geometry.boxes`; sizes are broadcast."""
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return np.concatenate([xy, direction, np.broadcast_to(size_m, xy.shape)], axis=-1)


def actor_boxes(actor: ScriptedUser) -> Float64[np.ndarray, "time 6"]:
    """Return the boxes of an actor at all steps."""
    return boxes(actor.xy, actor.heading, actor.size_m[:2])


def first_blocked_station(view: EgoView, adversary: ScriptedUser, step: int) -> Float64[np.ndarray, " time"]:
    """Return the first station at which ego would overlap the actor, at each step from ``step`` on, m (inf: none)."""
    track, last = view.track, view.last_step
    box = actor_boxes(adversary)[step : last + 1]
    begin = int(track.at[step] / STEP_M)
    station, xy = STEP_M * np.arange(begin, len(track.xy)), track.xy[begin:]
    size = view.ego_size_m[:2]
    ego = boxes(xy, track.heading[begin:], size)
    reach = (math.hypot(*size) + math.hypot(*adversary.size_m[:2])) / 2
    squared_m2 = (box[:, None, 0] - xy[:, 0]) ** 2 + (box[:, None, 1] - xy[:, 1]) ** 2
    time, index = nonzero((squared_m2 < reach**2) & adversary.valid[step : last + 1, None])
    hit = overlap(ego[index], box[time])
    result = np.full(len(box), math.inf)
    np.minimum.at(result, time[hit], station[index[hit]])
    return result


def severity(view: EgoView, adversary: ScriptedUser, step: int) -> float:
    """Return the constant deceleration from a step on with which ego just avoids the actor, m/s2."""
    room = first_blocked_station(view, adversary, step) - view.track.at[step]
    return required_on_samples(float(view.motion.speed[0, step]), room)


def required_on_samples(speed_mps: float, room_m: Float64[np.ndarray, " step"]) -> float:
    """Return :func:`required_deceleration` for the distance to the first blocked sample of the path at each step.

    Corrects for sampling: the first blocked sample is on average half a sample too far, and an actor that leaves the
    path during a step blocks it for half of that step.
    """
    time, blocked = DT_S * np.arange(len(room_m)), np.isfinite(room_m)
    leaves = np.flatnonzero(blocked[:-1] & ~blocked[1:])
    time = np.concatenate([time, time[leaves] + DT_S / 2])
    room = np.concatenate([room_m, room_m[leaves]]) - STEP_M / 2
    return required_deceleration(speed_mps, np.maximum(room, 0.0), time)


def least_ttc(
    view: EgoView, actor: ScriptedUser, ego: tuple[float, float, float], first_step: int, from_step: int
) -> float:
    """Return the minimum time to collision (TTC) with an actor ahead of ego from ``from_step`` on, s (at most 5).

    ``ego`` holds ego's station, lateral offset and speed at ``first_step``; offset and speed stay constant.
    """
    station, left, speed = ego
    steps = np.arange(max(from_step, first_step), view.last_step + 1)
    xy, heading = view.track.pose(station + speed * DT_S * (steps - first_step), left)
    ego_box, other = boxes(xy, heading, view.ego_size_m[:2] - _BOX_MARGIN_M), actor_boxes(actor)[steps]
    direction = ego_box[:, 2:4]
    ttc_s = time_to_overlap(
        ego_box, speed * direction, other, actor.speed[steps, None] * other[:, 2:4], _TTC_HORIZON_S
    )
    ttc_s = np.where(overlap(ego_box, other), 0.0, ttc_s)
    # Braking does not avoid actors from behind.
    is_ahead = np.sum((other[:, :2] - xy) * direction, axis=-1) > -view.ego_size_m[0] / 2
    is_relevant = is_ahead & actor.valid[steps]
    return float(np.min(np.where(is_relevant, ttc_s, _TTC_HORIZON_S), initial=_TTC_HORIZON_S))


def endangers_ego(view: EgoView, motion: Motion, staged: StagedEvent) -> bool:
    """Return whether the simulated actor comes close to collision with an ego that keeps its speed during the event.

    Rejects events that other agents disturbed, or before which ego slowed down. ``view`` is the scenario without
    the event, ``motion`` the simulated motion with it.
    """
    begin = staged.first_step
    (station,), (left,) = view.track.project(motion.xy[:1, begin])
    ego = station, left, float(motion.speed[0, begin])
    return least_ttc(view, user_trajectory(motion, staged.actors[0]), ego, begin, begin) < _SIMULATED_TTC_S


def comes_close(view: EgoView, adversary: ScriptedUser, step: int) -> bool:
    """Return whether an ego at constant speed comes close to collision: from the event's first and the current step.

    Where ego's speed changes in between (a turn, a queue) only the first counts.
    """
    current, speed = view.first_step + CURRENT_STEP, view.motion.speed[0]

    def close(first_step: int) -> bool:
        ego = view.track.at[first_step], 0.0, float(speed[first_step])
        return least_ttc(view, adversary, ego, first_step, step) < _PROPOSED_TTC_S

    is_steady = abs(speed[step] - speed[current]) < _STEADY_SHARE * speed[current]
    return close(step) and (not is_steady or close(current))


def vehicles_in_lane(view: EgoView, extra: ScriptedUser, until: int) -> tuple[int, ...]:
    """Return the rows of vehicles that block a new actor at any step up to ``until``.

    Lanes play no role: a vehicle counts if it is near the actor and has about the same heading.
    """
    motion, steps = view.motion, np.arange(until + 1)
    rows = np.arange(1, motion.vehicles)
    is_near = np.sum((motion.xy[rows, : until + 1] - extra.xy[steps]) ** 2, axis=-1) < _SAME_LANE_M**2
    is_parallel = np.cos(motion.heading[rows, : until + 1] - extra.heading[steps]) > 0.7
    is_in_lane = motion.valid[rows, : until + 1] & extra.valid[steps] & is_near & is_parallel
    return tuple(rows[is_in_lane.any(axis=1)].tolist())


def vehicles_that_cross(view: EgoView, extra: ScriptedUser) -> tuple[int, ...]:
    """Return the rows of vehicles that would collide with an actor that crosses their path."""
    motion, last = view.motion, view.last_step
    rows, steps = np.arange(1, motion.vehicles), np.flatnonzero(extra.valid & (np.abs(extra.speed) > 0.3))
    steps = steps[steps <= last]
    squared_gap = np.sum((motion.xy[rows][:, steps] - extra.xy[steps]) ** 2, axis=-1)
    headings = motion.heading[rows][:, steps]
    is_crossing = np.abs(np.cos(headings - extra.heading[steps])) < 0.7
    row, step = nonzero(motion.valid[rows][:, steps] & is_crossing & (squared_gap < _NEAR_M**2))
    size = motion.size_m[rows[row], :2] + _CROSSING_MARGIN_M
    other = boxes(motion.xy[rows[row], steps[step]], headings[row, step], size)
    hit = overlap(actor_boxes(extra)[steps[step]], other)
    return tuple(np.unique(rows[row[hit]]).tolist())


def enter_when_clear(
    view: EgoView, extra: ScriptedUser, until: int, removed: tuple[int, ...]
) -> ScriptedUser | None:
    """Delay the appearance of a new actor until it collides with no agent ahead of it up to step ``until``.

    Agents behind it react to it, so only agents ahead of it and pedestrians count. The rows ``removed`` do not take
    part.

    Returns:
        The actor, or None if it would appear close to ego during the recording, too close to another agent, or after
        step ``until``.
    """
    motion, end = view.motion, until + 1
    along, across = _VEHICLE_MARGIN_M if extra.kind == AgentKind.VEHICLE else _OTHER_MARGIN_M
    box = actor_boxes(extra)[None, :end] + np.array([0, 0, 0, 0, 2 * along, 2 * across])
    users = slice(1, None)
    other = boxes(motion.xy[users, :end], motion.heading[users, :end], motion.size_m[users, None, :2])
    is_kept = ~np.isin(np.arange(len(motion.kind)), removed)[users, None]
    valid = motion.valid[users, :end] & extra.valid[:end] & is_kept
    is_near = np.sum((other[..., :2] - box[..., :2]) ** 2, axis=-1) < _NEAR_M**2
    user, step = nonzero(valid & is_near)
    forward = box[0, step, 2:4] * np.where(extra.speed[step] < 0, -1.0, 1.0)[:, None]
    is_ahead = np.sum((other[user, step, :2] - box[0, step, :2]) * forward, axis=-1) > 0
    is_pedestrian = motion.kind[users][user] == AgentKind.PEDESTRIAN
    collisions = step[overlap(box[0, step], other[user, step]) & (is_ahead | is_pedestrian)]
    entry = int(np.argmax(extra.valid))
    if len(collisions):
        # It appears half a second after its last collision.
        entry = max(entry, int(collisions.max()) + 5)
    if entry >= end or not extra.valid[entry]:
        return None
    distance = np.hypot(*(extra.xy[entry] - motion.xy[0, entry]))
    is_visible = entry > view.first_step and distance < _APPEARANCE_M
    is_clear = _is_clear(box[0, entry], other[:, entry], valid[:, entry], motion.speed[users, entry])
    if is_visible or not is_clear:
        return None
    return replace(extra, valid=extra.valid & (np.arange(len(extra.valid)) >= entry))


def _is_clear(
    box: Float64[np.ndarray, " 6"], others: Float64[np.ndarray, "user 6"], valid: Bool[np.ndarray, " user"],
    speed: Float64[np.ndarray, " user"],
) -> bool:  # fmt: skip
    """Return whether a new box is clear of all others, each extended by its travel in the next 0.8 s."""
    extended_box = others.copy()
    extended_box[:, 4] += _BEHIND_S * speed
    extended_box[:, :2] += _BEHIND_S / 2 * speed[:, None] * others[:, 2:4]
    return not bool(np.any(valid & overlap(np.broadcast_to(box, others.shape), extended_box)))
