"""Scripted actors: speed profiles, and motion along ego's path or along lanes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64

from drivax.scenario.schema import DT_S, AgentKind
from drivax.synthetic.events.ego_view import Track
from drivax.synthetic.roads import curves
from drivax.synthetic.roads.curves import Curve
from drivax.synthetic.traffic.roles import Motion, ScriptedUser

#: A number for each time; length, width and height, m.
Times = Float64[np.ndarray, " time"]
Size = tuple[float, float, float]
CAR_M = (4.6, 1.85, 1.55)
#: Speed below which an actor keeps its heading, m/s.
_MOVING_MPS = 0.3


def speed_change(first_mps: float, last_mps: float, rate_mps2: float, times_s: Times) -> tuple[Times, Times]:
    """Return distance (m) and speed (m/s) of a change of speed that begins at time 0; distances before are negative."""
    duration_s = abs(last_mps - first_mps) / rate_mps2
    acceleration = math.copysign(rate_mps2, last_mps - first_mps)
    elapsed_s = np.clip(times_s, 0.0, duration_s)
    distance = first_mps * np.minimum(times_s, 0.0) + first_mps * elapsed_s + acceleration * elapsed_s**2 / 2
    distance = distance + last_mps * np.maximum(times_s - duration_s, 0.0)
    return distance, first_mps + acceleration * elapsed_s


def travel_s(distance_m: float, speed_mps: float, gain_mps2: float) -> float:
    """Return the time to cover a distance from rest, s: constant acceleration, then constant speed."""
    ramp_m = speed_mps**2 / (2 * gain_mps2)
    if distance_m <= ramp_m:
        return math.sqrt(2 * max(distance_m, 0.0) / gain_mps2)
    return speed_mps / gain_mps2 + (distance_m - ramp_m) / speed_mps


def gait(
    distance_m: float, speed_mps: float, rates_mps2: tuple[float, float], times_s: Times
) -> tuple[Times, Times] | None:
    """Return distance and speed of a walk from rest at time 0 to rest, or None if it is too short to reach its speed.

    ``rates_mps2`` are acceleration and deceleration.
    """
    gain_mps2, loss_mps2 = rates_mps2
    stopping_m = speed_mps**2 / (2 * loss_mps2)
    if distance_m < stopping_m + speed_mps**2 / (2 * gain_mps2):
        return None
    brake_s = travel_s(distance_m - stopping_m, speed_mps, gain_mps2)
    travelled_m, rising_mps = speed_change(0.0, speed_mps, gain_mps2, np.minimum(times_s, brake_s))
    braked_m, falling_mps = speed_change(speed_mps, 0.0, loss_mps2, np.maximum(times_s - brake_s, 0.0))
    return travelled_m + braked_m, np.where(times_s < brake_s, rising_mps, falling_mps)


def along_track(
    track: Track, station: Times, left_m: Times, kind: AgentKind, size_m: Size,
    valid: Bool[np.ndarray, " time"],
) -> ScriptedUser:  # fmt: skip
    """Build an actor at stations and lateral offsets of ego's path, headed along its motion and valid on the path."""
    valid = valid & (station >= 0.0) & (station <= track.length_m - 1.0)
    xy, heading = track.pose(station, left_m)
    return scripted_motion(xy, heading, kind, size_m, valid)


def scripted_motion(
    xy: Float64[np.ndarray, "time 2"], heading: Times, kind: AgentKind, size_m: Size,
    valid: Bool[np.ndarray, " time"],
) -> ScriptedUser:  # fmt: skip
    """Build an actor headed along its motion.

    Below 0.3 m/s the actor keeps its last heading, and before it first moves it has its first one. ``heading`` is used
    for an actor that never moves.
    """
    velocity = np.gradient(xy, DT_S, axis=0)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    is_moving = speed > _MOVING_MPS
    if is_moving.any():
        angle = np.arctan2(velocity[:, 1], velocity[:, 0])
        index = np.maximum.accumulate(np.where(is_moving, np.arange(len(xy)), -1))
        index = np.where(index < 0, int(np.argmax(is_moving)), index)
        heading = angle[index]
    return ScriptedUser(kind, size_m, xy, heading, speed, valid)


def along_curve(curve: Curve, distance_m: Times, kind: AgentKind, size_m: Size) -> ScriptedUser:
    """Build an actor that drives along a curve and is valid while both bumpers are on it."""
    xy, heading = curve.at(distance_m)
    speed = np.maximum(np.gradient(distance_m, DT_S), 0.0)
    valid = (distance_m >= size_m[0] / 2) & (distance_m <= curve.arc_m[-1] - size_m[0] / 2)
    return ScriptedUser(kind, size_m, xy, heading, speed, valid)


def user_trajectory(motion: Motion, row: int) -> ScriptedUser:
    """Return the trajectory of one user of a motion."""
    length, width, height = map(float, motion.size_m[row])
    trajectory = motion.xy[row], motion.heading[row], motion.speed[row], motion.valid[row].copy()
    return ScriptedUser(AgentKind(int(motion.kind[row])), (length, width, height), *trajectory)


def brake_to_halt(motion: Motion, row: int, step: int, braking_mps2: float) -> ScriptedUser:
    """Return the trajectory of a vehicle in traffic that starts braking at ``step`` and comes to a halt on its path."""
    user = user_trajectory(motion, row)
    arc = Curve(user.xy, user.heading).arc_m
    times = DT_S * (np.arange(len(arc)) - step)
    travelled_m, braked_mps = speed_change(float(user.speed[step]), 0.0, braking_mps2, times)
    position = np.where(times < 0, arc, np.minimum(arc[step] + travelled_m, arc))
    is_new = np.concatenate([[True], np.diff(arc) > 1e-6])
    heading = np.interp(position, arc[is_new], np.unwrap(user.heading)[is_new])
    speed = np.where(times < 0, user.speed, np.minimum(braked_mps, user.speed))
    xy = curves.interpolate(position, arc[is_new], user.xy[is_new])
    return replace(user, xy=xy, heading=heading, speed=speed)
