"""What somebody in ego's way asks of ego: the deceleration that avoids it, and the time to collision without.

Ego stays on its way. At each later time T the threat leaves free only what is before some station; with d the room
until there and v ego's speed, the constant deceleration that keeps ego before it at T is

    a = 2 (v T - d) / T^2   where ego still rolls at T (d >= v T / 2),   a = v^2 / (2 d)   where it has come to rest,

and the largest over all T is the deceleration that the threat requires.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64

from drivax.geometry.boxes import overlap, time_to_overlap
from drivax.scenario.schema import CURRENT_STEP, DT_S, AgentKind
from drivax.synthetic.events.ego_view import Scene
from drivax.synthetic.events.kinds import Staged
from drivax.synthetic.roads.curves import STEP_M
from drivax.synthetic.traffic.roles import Motion, Scripted

#: Time to collision that makes a threat one, s; in what really happens a little less, and of a box of ego that is
#: smaller, m: events that perception noise, or a hand's breadth, would undo are none.
NEAR_S, SURELY_S, _SMALLER_M = 1.0, 0.8, 0.3
#: Ego keeps its speed where it changes by less than this share.
_STEADY = 0.12
#: Nobody appears nearer to ego than this, m.
_VIEW_M = 40.0
#: Others keep this from an actor that was not there before, m, along it and beside it: in vehicles, and else.
_APART_M, _APART_ON_FOOT_M = (1.5, 0.3), (0.2, 0.05)
#: Whose centres come so near to each other are in one lane, m.
_IN_LANE_M = 6.5
#: Who comes this near to somebody that crosses its way would hit it, along and across both together, m; and how far
#: apart centres are then at most.
_CROSSED_M, _NEAR_M = np.array([4.0, 1.2]), 15.0
#: Time gap to who drives behind an actor when it appears, s.
_BEHIND_S = 0.8


def required_deceleration(
    speed_mps: float, room_m: Float64[np.ndarray, " k"], time_s: Float64[np.ndarray, " k"]
) -> float:
    """The deceleration with which ego has gone at most ``room_m`` at each time; 0 where it may keep its speed."""
    if np.any(room_m <= 0.0):
        return math.inf
    some = (time_s > 0) & (speed_mps * time_s > room_m)
    room, time = room_m[some], time_s[some]
    rolling = 2 * (speed_mps * time - room) / time**2
    rest = speed_mps**2 / (2 * room)
    return float(np.max(np.where(room >= speed_mps * time / 2, rolling, rest), initial=0.0))


def waiting_room(speed_mps: float, deceleration_mps2: float, time_s: float) -> float:
    """The inverse: the room until a place that is taken up to a time, so that this deceleration is required."""
    if deceleration_mps2 * time_s <= speed_mps:
        return speed_mps * time_s - deceleration_mps2 * time_s**2 / 2
    return speed_mps**2 / (2 * deceleration_mps2)


def boxes(one: Scripted) -> Float64[np.ndarray, "time 6"]:
    """Its boxes in the order of :mod:`drivax.geometry.boxes`."""
    size = np.broadcast_to(np.array(one.size_m[:2]), one.xy.shape)
    return np.column_stack([one.xy, np.cos(one.heading), np.sin(one.heading), size])


def first_blocked(scene: Scene, threat: Scripted, step: int) -> Float64[np.ndarray, " time"]:
    """For each step from ``step`` to the recording's end the first station at which ego would touch the threat, m.

    Infinite where it is not in the way; stations behind ego at ``step`` do not count.
    """
    track, last = scene.track, scene.last_step
    box = boxes(threat)[step : last + 1]
    begin = int(track.at[step] / STEP_M)
    station = STEP_M * np.arange(begin, len(track.xy), 1)
    xy, heading = track.xy[begin:], track.heading[begin:]
    size = scene.ego_size_m
    ego = np.column_stack(
        [xy, np.cos(heading), np.sin(heading), np.broadcast_to(size[:2], xy.shape)],
    )
    reach = (math.hypot(size[0], size[1]) + math.hypot(*threat.size_m[:2])) / 2
    gap = (box[:, None, 0] - xy[:, 0]) ** 2 + (box[:, None, 1] - xy[:, 1]) ** 2
    time, place = np.nonzero((gap < reach**2) & threat.valid[step : last + 1, None])
    hit = overlap(ego[place], box[time])
    result = np.full(len(box), math.inf)
    np.minimum.at(result, time[hit], station[place[hit]])
    return result


def severity(scene: Scene, threat: Scripted, step: int) -> float:
    """The constant deceleration from a step on with which ego just avoids the threat, m/s2."""
    room = first_blocked(scene, threat, step) - scene.track.at[step]
    return required_by_samples(float(scene.motion.speed[0, step]), room)


def required_by_samples(speed_mps: float, room_m: Float64[np.ndarray, " step"]) -> float:
    """:func:`required_deceleration` of the room until the first blocked sample of the way, at each step from now on.

    The way's samples are half a metre apart: the first that touches lies a quarter too far on average. In the same
    way who has left ego's way at a step has been in it for half of the step on average.
    """
    time, taken = DT_S * np.arange(len(room_m)), np.isfinite(room_m)
    leaves = np.flatnonzero(taken[:-1] & ~taken[1:])
    time = np.concatenate([time, time[leaves] + DT_S / 2])
    room = np.concatenate([room_m, room_m[leaves]]) - STEP_M / 2
    return required_deceleration(speed_mps, np.maximum(room, 0.0), time)


def least_ttc(scene: Scene, threat: Scripted, hold_from: int, since: int) -> float:
    """The least time to collision with an ego that keeps its speed of a step, s (5: none, 0: they collide).

    Args:
        scene: The scene.
        threat: The actor.
        hold_from: From this step on ego keeps its speed.
        since: From this step on to the recording's end it counts.
    """
    track, steps = scene.track, np.arange(max(since, hold_from), scene.last_step + 1)
    speed = float(scene.motion.speed[0, hold_from])
    xy, heading = track.pose(track.at[hold_from] + speed * DT_S * (steps - hold_from))
    time = _times_to_collision(scene, (xy, heading, speed), boxes(threat)[steps], threat.speed[steps])
    return float(np.min(np.where(threat.valid[steps], time, 5.0), initial=5.0))


def threatens(scene: Scene, motion: Motion, staged: Staged) -> bool:
    """Whether ego comes within 1 s of collision with the actor if it keeps its speed when the event begins.

    Ego goes on along the way that it takes without the event, as far beside it as it is. That is the last word on an
    event: others may have disturbed it, and ego may have become slower before.

    Args:
        scene: The scenario without the event.
        motion: With it.
        staged: What was staged.
    """
    begin, actor = staged.first_step, staged.actors[0]
    (station,), (left,) = scene.track.projected(motion.xy[:1, begin])
    steps = np.arange(begin, scene.last_step + 1)
    speed = float(motion.speed[0, begin])
    xy, heading = scene.track.pose(station + speed * DT_S * (steps - begin), left)
    acts = slice(begin, scene.last_step + 1)
    turned, size = motion.heading[actor, acts], np.broadcast_to(motion.size_m[actor, :2], xy.shape)
    other = np.column_stack([motion.xy[actor, acts], np.cos(turned), np.sin(turned), size])
    time = _times_to_collision(scene, (xy, heading, speed), other, motion.speed[actor, acts])
    return bool(np.any(motion.valid[actor, acts] & (time < SURELY_S)))


def _times_to_collision(
    scene: Scene,
    ego: tuple[Float64[np.ndarray, "time 2"], Float64[np.ndarray, " time"], float],
    other: Float64[np.ndarray, "time 6"],
    speed: Float64[np.ndarray, " time"],
) -> Float64[np.ndarray, " time"]:
    """Time to collision of ego, given by positions, headings and its speed, with somebody ahead, s (at most 5)."""
    xy, heading, own = ego
    toward = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    box = np.column_stack([xy, toward, np.broadcast_to(scene.ego_size_m[:2] - _SMALLER_M, xy.shape)])
    time = time_to_overlap(box, own * toward, other, speed[:, None] * other[:, 2:4], 5.0)
    time = np.where(overlap(box, other), 0.0, time)
    # Who comes from behind is no threat that ego could brake for.
    ahead = np.sum((other[:, :2] - xy) * toward, axis=-1) > -scene.ego_size_m[0] / 2
    return np.where(ahead, time, 5.0)


def comes_close(scene: Scene, threat: Scripted, step: int) -> bool:
    """Whether an ego that keeps its speed is within 1 s of collision: that of the event's first step, and of now.

    Where ego changes its speed in between (a turn, a queue) it would be elsewhere anyway, and only the first counts.
    """
    current, speed = scene.first_step + CURRENT_STEP, scene.motion.speed[0]
    if least_ttc(scene, threat, step, step) >= NEAR_S:
        return False
    steady = abs(speed[step] - speed[current]) < _STEADY * speed[current]
    return not steady or least_ttc(scene, threat, current, step) < NEAR_S


def in_its_lane(scene: Scene, extra: Scripted, until: int) -> tuple[int, ...]:
    """Rows of vehicles that are in the way of somebody who was not there before, and drive or stand as it does."""
    motion, steps = scene.motion, np.arange(until + 1)
    rows = np.arange(1, motion.vehicles)
    gap = np.sum((motion.xy[rows, : until + 1] - extra.xy[steps]) ** 2, axis=-1)
    same = np.cos(motion.heading[rows, : until + 1] - extra.heading[steps]) > 0.7
    met = motion.valid[rows, : until + 1] & extra.valid[steps] & (gap < _IN_LANE_M**2) & same
    return tuple(rows[met.any(axis=1)].tolist())


def in_its_cross_way(scene: Scene, extra: Scripted) -> tuple[int, ...]:
    """Rows of vehicles that would run into somebody who crosses their way, or stand in it, as ego goes on without it.

    Ego's own lane is not alone: who is to be avoided by ego should not be hit by others for whom nobody planned.
    """
    motion, last = scene.motion, scene.last_step
    rows, moves = np.arange(1, motion.vehicles), np.flatnonzero(extra.valid & (np.abs(extra.speed) > 0.3))
    moves = moves[moves <= last]
    gap = np.sum((motion.xy[rows][:, moves] - extra.xy[moves]) ** 2, axis=-1)
    turned = motion.heading[rows][:, moves]
    crosses = np.abs(np.cos(turned - extra.heading[moves])) < 0.7
    row, step = np.nonzero(motion.valid[rows][:, moves] & crosses & (gap < _NEAR_M**2))
    size = motion.size_m[rows[row], :2] + _CROSSED_M
    other = np.column_stack(
        [motion.xy[rows[row], moves[step]], np.cos(turned[row, step]), np.sin(turned[row, step]), size]
    )
    hit = overlap(boxes(extra)[moves[step]], other)
    return tuple(np.unique(rows[row[hit]]).tolist())


def with_room(scene: Scene, extra: Scripted, until: int, removed: tuple[int, ...] = ()) -> Scripted | None:
    """Somebody who was not there before, from when on it drives into nobody; None where it would, or be seen to appear.

    Others see it and keep behind it: only who is ahead of it counts, until the step at which ego may meet it.

    Args:
        scene: The scene without it.
        extra: Who it is.
        until: The step at which ego may meet it.
        removed: Rows of vehicles that do not take part.
    """
    motion, last = scene.motion, until + 1
    along, beside = _APART_M if extra.kind == AgentKind.VEHICLE else _APART_ON_FOOT_M
    box = boxes(extra)[None, :last] + np.array([0, 0, 0, 0, 2 * along, 2 * beside])
    users = slice(1, None)
    size = np.broadcast_to(motion.size_m[users, None, :2], motion.xy[users].shape)[:, :last]
    turned = motion.heading[users, :last]
    other = np.concatenate(
        [motion.xy[users, :last], np.cos(turned)[..., None], np.sin(turned)[..., None], size], axis=-1
    )
    part = ~np.isin(np.arange(len(motion.kind)), removed)[users, None]
    valid = motion.valid[users, :last] & extra.valid[:last] & part
    near = np.sum((other[..., :2] - box[..., :2]) ** 2, axis=-1) < 15.0**2
    user, step = np.nonzero(valid & near)
    forward = box[0, step, 2:4] * np.where(extra.speed[step] < 0, -1.0, 1.0)[:, None]
    ahead = np.sum((other[user, step, :2] - box[0, step, :2]) * forward, axis=-1) > 0
    on_foot = motion.kind[users][user] == AgentKind.PEDESTRIAN
    meets = step[overlap(box[0, step], other[user, step]) & (ahead | on_foot)]
    appears = int(np.argmax(extra.valid))
    if len(meets):
        # Who comes on the scene later is spared what happened before.
        appears = max(appears, int(meets.max()) + 5)
    if appears >= last or not extra.valid[appears]:
        return None
    seen = appears > scene.first_step and np.hypot(*(extra.xy[appears] - motion.xy[0, appears])) < _VIEW_M
    now = box[0, appears], other[:, appears], valid[:, appears], motion.speed[users, appears]
    if seen or not _appears_apart(*now):
        return None
    return replace(extra, valid=extra.valid & (np.arange(len(extra.valid)) >= appears))


def _appears_apart(
    box: Float64[np.ndarray, " 6"],
    other: Float64[np.ndarray, "user 6"],
    valid: Bool[np.ndarray, " user"],
    speed: Float64[np.ndarray, " user"],
) -> bool:
    """Whether nobody has to brake hard for somebody who appears: everyone's box with its way of 0.8 s ahead is free."""
    longer = other.copy()
    longer[:, 4] += _BEHIND_S * speed
    longer[:, :2] += _BEHIND_S / 2 * speed[:, None] * other[:, 2:4]
    return not bool(np.any(valid & overlap(np.broadcast_to(box, other.shape), longer)))
