"""Interactive moments of a simulation: the steps from index a driver that only follows its leader would collide.

Recorded data sets are mined for interactions, since most driving is on empty roads. Here a reference driver that
follows its leader and stops at red lights, but ignores all other agents, is rolled out from several steps of the same
traffic. Where it collides, good driving takes more than car following.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int8, Int64

from drivax.geometry.boxes import overlap
from drivax.scenario.schema import CURRENT_STEP, DT_S, STEPS
from drivax.simulator.idm import IdmParameters, idm_acceleration
from drivax.synthetic.roads.network import Control, RoadNetwork
from drivax.synthetic.roads.signals import Colour
from drivax.synthetic.traffic.obstacles import Boxes, extents
from drivax.synthetic.traffic.path_arrays import speed_profile
from drivax.synthetic.traffic.paths import Path
from drivax.synthetic.traffic.roles import Motion

#: The reference driver: IDM parameters, lateral acceleration in bends and braking before them, m/s2.
_DRIVER, _LATERAL_MPS2, _SLOWING_MPS2 = IdmParameters(), 2.5, 2.0
#: Its lateral margin on either side, m; its distance to a stop line, m.
_SIDE_M, _STOP_SHORT_M = 0.3, 1.0
#: Agents further from ego's path are ignored, m.
_NEAR_M = 12.0
#: Simulate every second step.
_STRIDE = 2


@dataclass(frozen=True)
class _Others:
    """Agents near ego's path at all steps: extents along and across it, m."""

    near_m: Float64[np.ndarray, "user time"]
    far_m: Float64[np.ndarray, "user time"]
    right_m: Float64[np.ndarray, "user time"]
    left_m: Float64[np.ndarray, "user time"]
    speed: Float64[np.ndarray, "user time"]
    box: Float64[np.ndarray, "user time 6"]


def critical_steps(
    network: RoadNetwork,
    motion: Motion,
    colour: Int8[np.ndarray, "time lane"],
    steps: Int64[np.ndarray, " start"],
) -> Bool[np.ndarray, " start"]:
    """Whether the reference driver collides in the recordings that begin at some steps.

    Args:
        network: The roads.
        motion: Motion of all agents; row 0 is ego.
        colour: Colours of the lights at each time.
        steps: First steps of recordings, even numbers; the driver takes over ``CURRENT_STEP`` later.
    """
    path, motion = motion.paths[0], motion.every(_STRIDE)
    others, colour = _project_others(path, motion), colour[::_STRIDE]
    length, width = motion.size_m[0, :2]
    now = (np.asarray(steps) + CURRENT_STEP) // _STRIDE
    at, speed = motion.distance_m[0, now], motion.speed[0, now]
    fastest = speed_profile(path, 1.0, _LATERAL_MPS2, _SLOWING_MPS2)
    hit, behind = np.zeros(len(now), bool), np.zeros((len(others.near_m), len(now)), bool)
    for _ in range((STEPS - CURRENT_STEP - 1) // _STRIDE):
        gap, leader = _leader(others, now, at, (float(length), float(width)))
        line = _stop_line_m(network, path, colour[now], at + length / 2) + 2.0 - _STOP_SHORT_M
        target_mps = fastest[np.minimum((at / path.step_m).astype(int), len(fastest) - 1)]
        a = idm_acceleration(
            np.stack([speed, speed]),
            np.stack([target_mps, target_mps]),
            np.stack([gap, line]),
            np.stack([leader, np.zeros_like(leader)]),
            _DRIVER,
        ).min(axis=0)
        after = np.maximum(speed + a * _STRIDE * DT_S, 0.0)
        at, speed, now = at + (speed + after) / 2 * _STRIDE * DT_S, after, now + 1
        hit |= _hits(others, now, path, at, (float(length), float(width)), behind)
    return hit


def _project_others(path: Path, motion: Motion) -> _Others:
    """Extents of all other agents in the coordinates of ego's path."""
    count, times = motion.valid.shape
    flat = (count - 1) * times
    boxes = Boxes(
        motion.xy[1:].reshape(flat, 2),
        motion.heading[1:].reshape(flat),
        motion.speed[1:].reshape(flat),
        np.repeat(motion.size_m[1:, :2], times, axis=0),
    )
    extent, index = extents(path, boxes, _NEAR_M)
    valid = motion.valid[1:].reshape(flat)[index]
    place = np.clip((extent.near_m + extent.far_m) / 2 / path.step_m, 0, len(path.curve.xy) - 1).astype(int)
    along = boxes.speed[index] * np.cos(boxes.heading[index] - path.curve.heading[place])

    def table(values: Float64[np.ndarray, " k"], empty: float) -> Float64[np.ndarray, "user time"]:
        result = np.full(flat, empty)
        result[index] = np.where(valid, values, empty)
        return result.reshape(count - 1, times)

    direction = np.stack([np.cos(boxes.heading), np.sin(boxes.heading)], axis=-1)
    box = np.concatenate([boxes.xy, direction, boxes.size_m], axis=-1).reshape(count - 1, times, 6)
    near = table(extent.near_m, np.inf)
    rows = np.isfinite(near).any(axis=1)
    return _Others(
        near_m=near[rows],
        far_m=table(extent.far_m, np.inf)[rows],
        right_m=table(extent.right_m, np.inf)[rows],
        left_m=table(extent.left_m, np.inf)[rows],
        speed=table(along, 0.0)[rows],
        box=box[rows],
    )


def _leader(
    others: _Others,
    now: Int64[np.ndarray, " start"],
    at: Float64[np.ndarray, " start"],
    size_m: tuple[float, float],
) -> tuple[Float64[np.ndarray, " start"], Float64[np.ndarray, " start"]]:
    """Gap to the next agent ahead on the path, and its speed."""
    if not len(others.near_m):
        return np.full(len(at), np.inf), np.zeros(len(at))
    near, far = others.near_m[:, now], others.far_m[:, now]
    side = size_m[1] / 2 + _SIDE_M
    ahead = (near + far) / 2 > at
    ahead &= (others.right_m[:, now] < side) & (others.left_m[:, now] > -side)
    gap = np.where(ahead, near, np.inf) - at - size_m[0] / 2
    first = gap.argmin(axis=0)
    columns = np.arange(len(at))
    return gap[first, columns], others.speed[:, now][first, columns]


def _stop_line_m(
    network: RoadNetwork,
    path: Path,
    colour: Int8[np.ndarray, "start lane"],
    front: Float64[np.ndarray, " start"],
) -> Float64[np.ndarray, " start"]:
    """Distance to the next stop line with a red or yellow light."""
    result = np.full(len(front), np.inf)
    for span in path.spans:
        if network.lanes[span.lane].control == Control.SIGNAL:
            away = span.begin_m - front
            shut = (colour[:, span.lane] == Colour.RED) | (colour[:, span.lane] == Colour.YELLOW)
            result = np.minimum(result, np.where(shut & (away > 0), away, np.inf))
    return result


def _hits(
    others: _Others,
    now: Int64[np.ndarray, " start"],
    path: Path,
    at: Float64[np.ndarray, " start"],
    size_m: tuple[float, float],
    behind: Bool[np.ndarray, "user start"],
) -> Bool[np.ndarray, " start"]:
    """Whether an agent overlaps ego and did not come from behind; adds agents that did to ``behind``."""
    result = np.zeros(len(at), bool)
    if not len(others.near_m):
        return result
    half = size_m[0] / 2
    near, far = others.near_m[:, now], others.far_m[:, now]
    maybe = (near < at + half) & (far > at - half)
    maybe &= (others.right_m[:, now] < size_m[1] / 2) & (others.left_m[:, now] > -size_m[1] / 2)
    behind |= maybe & ((near + far) / 2 <= at - half)
    user, start = np.nonzero(maybe & ~behind)
    if len(user):
        place = np.minimum((at[start] / path.step_m).astype(int), len(path.curve.xy) - 1)
        heading = path.curve.heading[place]
        ego = np.column_stack(
            [path.curve.xy[place], np.cos(heading), np.sin(heading), np.tile(size_m, (len(user), 1))]
        )
        result[start[overlap(ego, others.box[user, now[start]])]] = True
    return result
