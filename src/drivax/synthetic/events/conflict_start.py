"""Interactive moments of a simulation: the steps from which a driver that only follows its leader would collide.

Recorded data sets are mined for interactions, since most driving is uneventful. This module rolls out a reference
driver from several steps of the same traffic: it follows its leader and stops at red and yellow lights, but ignores all
other agents. A collision shows that good driving takes more than car following.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int8, Int64

from drivax.geometry.boxes import overlap
from drivax.scenario.schema import CURRENT_STEP, DT_S, STEPS, nonzero
from drivax.simulator.idm import IdmParameters, idm_acceleration
from drivax.synthetic.events.adversary import boxes
from drivax.synthetic.roads.network import Control, RoadNetwork
from drivax.synthetic.roads.signals import Colour
from drivax.synthetic.traffic.obstacles import Boxes, extents
from drivax.synthetic.traffic.path_arrays import speed_profile
from drivax.synthetic.traffic.paths import Path
from drivax.synthetic.traffic.roles import Motion

#: The reference driver: IDM parameters, lateral acceleration in bends and braking before them, m/s2.
_DRIVER, _LATERAL_MPS2, _SLOWING_MPS2 = IdmParameters(), 2.5, 2.0
#: Lateral margin of the reference driver on either side, and its distance to a stop line, m.
_SIDE_M, _STOP_SHORT_M = 0.3, 1.0
#: Agents further from ego's path are ignored, m.
_NEAR_M = 12.0
#: Simulate every second step.
_STRIDE = 2
#: Steps and numbers, one for each start of the driver.
_Steps = Int64[np.ndarray, " start"]
_Floats = Float64[np.ndarray, " start"]
#: :attr:`_Others.extent` at a step for each start.
_Extent = Float64[np.ndarray, "4 user start"]


@dataclass(frozen=True)
class _Others:
    """Agents near ego's path at all steps.

    Attributes:
        extent: Nearest and farthest position along the path, outermost offsets to its right and left, m.
        speed: Speed along the path, m/s.
    """

    extent: Float64[np.ndarray, "4 user time"]
    speed: Float64[np.ndarray, "user time"]
    box: Float64[np.ndarray, "user time 6"]


def critical_steps(
    network: RoadNetwork, motion: Motion, colour: Int8[np.ndarray, "time lane"], steps: _Steps
) -> Bool[np.ndarray, " start"]:
    """Mask of the first steps (``steps``, even numbers) of recordings in which the reference driver collides.

    The driver takes over from row 0 of the motion ``CURRENT_STEP`` steps after the first step.
    """
    path, motion = motion.paths[0], motion.every_nth(_STRIDE)
    others, colour, size_m = _project_others(path, motion), colour[::_STRIDE], motion.size_m[0, :2]
    step = (np.asarray(steps) + CURRENT_STEP) // _STRIDE
    position, speed = motion.distance_m[0, step], motion.speed[0, step]
    fastest = speed_profile(path, 1.0, _LATERAL_MPS2, _SLOWING_MPS2)
    hit, from_behind = np.zeros(len(step), bool), np.zeros((len(others.box), len(step)), bool)
    extent = others.extent.take(step, axis=2)
    for _ in range((STEPS - CURRENT_STEP - 1) // _STRIDE):
        gap, leader_speed = _leader(others, extent, step, position, size_m)
        # IDM stops ``min_gap_m`` before the shifted line, that is, ``_STOP_SHORT_M`` before the real one.
        line = _stop_line_m(network, path, colour[step], position + size_m[0] / 2)
        line = line + _DRIVER.min_gap_m - _STOP_SHORT_M
        target_mps = fastest[np.minimum((position / path.step_m).astype(int), len(fastest) - 1)]
        gaps, leader_speeds = np.array((gap, line)), np.array((leader_speed, np.zeros_like(leader_speed)))
        a = idm_acceleration(speed, target_mps, gaps, leader_speeds, _DRIVER).min(axis=0)
        after = np.maximum(speed + a * _STRIDE * DT_S, 0.0)
        position, speed, step = position + (speed + after) / 2 * _STRIDE * DT_S, after, step + 1
        extent = others.extent.take(step, axis=2)
        hit |= _hits(others, extent, step, path, position, size_m, from_behind)
    return hit


def _project_others(path: Path, motion: Motion) -> _Others:
    """Return the extents of all other agents in the coordinates of ego's path."""
    shape = motion.valid[1:].shape
    users = Boxes(
        motion.xy[1:].reshape(-1, 2),
        motion.heading[1:].ravel(),
        motion.speed[1:].ravel(),
        np.repeat(motion.size_m[1:, :2], shape[1], axis=0),
    )
    extent, index = extents(path, users, _NEAR_M)
    valid = motion.valid[1:].ravel()[index]
    sample = np.clip((extent.near_m + extent.far_m) / 2 / path.step_m, 0, len(path.curve.xy) - 1).astype(int)
    along = users.speed[index] * np.cos(users.heading[index] - path.curve.heading[sample])

    def table(values: Float64[np.ndarray, " k"], empty: float) -> Float64[np.ndarray, "user time"]:
        result = np.full(len(users.xy), empty)
        result[index] = np.where(valid, values, empty)
        return result.reshape(shape)

    sides = (extent.near_m, extent.far_m, extent.right_m, extent.left_m)
    extent_m = np.stack([table(side, np.inf) for side in sides])
    is_near = np.isfinite(extent_m[0]).any(axis=1)
    box = boxes(users.xy, users.heading, users.size_m).reshape(*shape, 6)
    return _Others(extent_m[:, is_near], table(along, 0.0)[is_near], box[is_near])


def _leader(
    others: _Others, extent: _Extent, step: _Steps, position: _Floats, size_m: Float64[np.ndarray, " 2"]
) -> tuple[_Floats, _Floats]:
    """Return gap (inf: none) and speed of the next agent ahead on the path, from the others' extents at these steps."""
    if not len(others.box):
        return np.full(len(position), np.inf), np.zeros(len(position))
    near_m, far_m, right_m, left_m = extent
    side = size_m[1] / 2 + _SIDE_M
    is_ahead = ((near_m + far_m) / 2 > position) & (right_m < side) & (left_m > -side)
    gap = np.where(is_ahead, near_m, np.inf) - position - size_m[0] / 2
    first = gap.argmin(axis=0), np.arange(len(position))
    return gap[first], others.speed[:, step][first]


def _stop_line_m(
    network: RoadNetwork, path: Path, colour: Int8[np.ndarray, "start lane"], front: _Floats
) -> _Floats:
    """Return the distance to the next stop line with a red or yellow light, inf without one."""
    result = np.full(len(front), np.inf)
    for span in path.spans:
        if network.lanes[span.lane].control == Control.SIGNAL:
            distance = span.begin_m - front
            is_closed = (colour[:, span.lane] == Colour.RED) | (colour[:, span.lane] == Colour.YELLOW)
            result = np.minimum(result, np.where(is_closed & (distance > 0), distance, np.inf))
    return result


def _hits(
    others: _Others, extent: _Extent, step: _Steps, path: Path, position: _Floats,
    size_m: Float64[np.ndarray, " 2"], from_behind: Bool[np.ndarray, "user start"],
) -> Bool[np.ndarray, " start"]:  # fmt: skip
    """Return whether an agent overlaps ego and did not come from behind; mark those that did in ``from_behind``."""
    half, side = size_m / 2
    near_m, far_m, right_m, left_m = extent
    is_close = (near_m < position + half) & (far_m > position - half) & (right_m < side) & (left_m > -side)
    from_behind |= is_close & ((near_m + far_m) / 2 <= position - half)
    user, start = nonzero(is_close & ~from_behind)
    result = np.zeros(len(position), bool)
    if not len(user):
        return result
    index = np.minimum((position[start] / path.step_m).astype(int), len(path.curve.xy) - 1)
    ego = boxes(path.curve.xy[index], path.curve.heading[index], size_m)
    result[start[overlap(ego, others.box[user, step[start]])]] = True
    return result
