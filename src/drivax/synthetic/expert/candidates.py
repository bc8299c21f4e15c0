"""Candidate paths of ego, their conflicts with other users, and their stop lines."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from drivax.geometry.boxes import corners, overlap
from drivax.geometry.polylines import left_normals
from drivax.geometry.vectors import wrap
from drivax.scenario.schema import DT_S, nonzero
from drivax.synthetic.roads.curves import Curve, Pose
from drivax.synthetic.roads.network import Control, RoadNetwork
from drivax.synthetic.roads.signals import Colour
from drivax.synthetic.traffic.lateral import project_on_path, quintic_step
from drivax.synthetic.traffic.path_arrays import speed_profile
from drivax.synthetic.traffic.paths import Path, interpolate_curve, mean_curvature
from drivax.synthetic.traffic.roles import Drivers

#: Distance between the samples of a candidate, m.
SPACING_M = 0.5
#: Largest lateral acceleration, m/s2, and yaw rate, rad/s, of a plan: nuPlan's comfort limits with a reserve.
_LATERAL_MPS2, _YAW_RATE_RPS = 4.2, 0.8
#: Distance over which ego returns to its path, m.
_RETURN_M = 30.0
#: Hard margin at ego's bumpers and sides, m; the final check uses 0.1 m.
HARD_M = (0.35, 0.2)
#: Preferred margin, m, for vehicles and for pedestrians and cyclists.
NEAR_M, NEAR_VULNERABLE_M = (1.2, 0.5), (2.0, 1.2)
#: Stride of the coarse pass over path samples.
_STRIDE = 4
#: Remaining yellow time below which ego avoids passing a light, s.
_LATE_YELLOW_S = 1.0
#: Smallest time gap to users with priority where ego gives way, s.
_YIELD_S = 2.0
#: Distance to a stop line at standstill, m.
_SHORT_M = 0.5

#: A number and a flag per time step, and a number per sample of a path.
_Series = Float64[np.ndarray, " time"]
_Steps = Bool[np.ndarray, " time"]
_Points = Float64[np.ndarray, " point"]
_Boxes = Float64[np.ndarray, "user time 6"]
_PathBoxes = Float64[np.ndarray, "point 6"]
_Exists = Bool[np.ndarray, "user time"]
_Size = Float64[np.ndarray, " 3"]


@dataclass(frozen=True)
class Shift:
    """Lateral offset to the left with quintic transitions out and back; positions are distances ahead of ego."""

    aside_m: float = 0.0
    begin_m: float = 0.0
    out_end_m: float = 1.0
    back_begin_m: float = 2.0
    end_m: float = 3.0


@dataclass(frozen=True)
class CandidatePath:
    """A curve that begins at ego's centre, sampled every ``SPACING_M``, with preferred and largest speeds.

    ``base_m`` is the position of each sample along the original path, m ahead of ego.
    """

    xy: Float64[np.ndarray, "point 2"]
    heading: _Points
    base_m: _Points
    preferred_mps: _Points
    limit_mps: _Points
    shift: Shift = Shift()

    def pose(
        self, at_m: Float64[np.ndarray, " n"]
    ) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
        """Position and heading at distances from ego."""
        arc = SPACING_M * np.arange(len(self.xy))
        curve = interpolate_curve(Curve(self.xy, self.heading), arc, at_m)
        return curve.xy, curve.heading


def shift_path(
    path: Path, drivers: Drivers, pose: Pose, near_m: float, reach_m: float, shift: Shift
) -> CandidatePath:
    """Return the rest of ego's path with a shift, at most ``reach_m`` long.

    ``near_m`` is the approximate position of ego on the path.
    """
    begin, left, direction = project_on_path(path, np.array([pose.x, pose.y]), near_m)
    ahead = np.arange(0.0, min(reach_m, path.length_m - begin - 1e-6), SPACING_M)
    grid = path.step_m * np.arange(len(path.curve.xy))
    base = interpolate_curve(path.curve, grid, begin + ahead)
    lateral = quintic_step(ahead, (0.0, left, math.tan(wrap(pose.heading - direction))), _RETURN_M)
    out_m, back_m = shift.out_end_m - shift.begin_m, shift.end_m - shift.back_begin_m
    lateral += shift.aside_m * quintic_step(ahead, (shift.back_begin_m, 1.0, 0.0), back_m)
    lateral -= shift.aside_m * quintic_step(ahead, (shift.begin_m, 1.0, 0.0), out_m)
    stretch = np.maximum(1.0 - lateral * np.interp(begin + ahead, grid, path.curvature), 0.2)
    relative_heading = np.arctan2(np.gradient(lateral, SPACING_M), stretch)
    xy = base.xy + lateral[:, None] * left_normals(base.heading)
    curve = Curve(xy, base.heading + relative_heading)
    arc = curve.arc_m
    position = np.arange(0.0, float(arc[-1]), SPACING_M)
    curve, base = interpolate_curve(curve, arc, position), np.interp(position, arc, ahead)
    limit = np.interp(begin + base, grid, path.limit_mps)
    preferred, bound = _speeds(curve, limit, drivers)
    return CandidatePath(curve.xy, curve.heading, base, preferred, bound, shift)


def _speeds(curve: Curve, limit_mps: _Points, drivers: Drivers) -> tuple[_Points, _Points]:
    """Return the preferred speeds of ego along a curve, and the largest ones in bends."""
    curvature, no_lanes = mean_curvature(curve, SPACING_M), np.full((len(limit_mps), 1), -1, np.int32)
    path = Path(curve, SPACING_M, curvature, limit_mps, (), no_lanes, np.zeros((len(limit_mps), 1)))
    driver = drivers.speed_factor[0], drivers.lateral_mps2[0], drivers.slowing_mps2[0]
    bend = np.maximum(np.abs(curvature), 1e-6)
    bound = np.minimum(np.sqrt(_LATERAL_MPS2 / bend), _YAW_RATE_RPS / bend)
    return speed_profile(path, *map(float, driver)), bound


def candidate_boxes(candidate: CandidatePath, size_m: _Size) -> _PathBoxes:
    """Return ego's box at the samples of a path."""
    heading = candidate.heading[:, None]
    size = np.broadcast_to(size_m[:2], (len(heading), 2))
    return np.concatenate([candidate.xy, np.cos(heading), np.sin(heading), size], axis=-1)


def candidate_corners(candidate: CandidatePath, size_m: _Size) -> Float64[np.ndarray, "corner 2"]:
    """Return corners of ego's box every metre of the stretch where a candidate leaves the original path."""
    base, shift = candidate.base_m, candidate.shift
    is_shifted = (base >= shift.begin_m - 2.0) & (base <= shift.end_m + 2.0)
    return corners(candidate_boxes(candidate, size_m)[is_shifted][::2]).reshape(-1, 2)


@dataclass(frozen=True)
class Conflicts:
    """Conflicts of ego's box along its path with other users: contacts (``hard``), or small gaps."""

    user: Int64[np.ndarray, " conflict"]
    step: Int64[np.ndarray, " conflict"]
    point: Int64[np.ndarray, " conflict"]
    hard: Bool[np.ndarray, " conflict"]

    def select(self, keep: Bool[np.ndarray, " conflict"]) -> Conflicts:
        """Return a subset of the conflicts."""
        return Conflicts(self.user[keep], self.step[keep], self.point[keep], self.hard[keep])


@dataclass(frozen=True)
class StopLine:
    """Stop line for ego's centre: passing is forbidden at the steps ``closed``, and discouraged at the steps ``late``.

    ``base_m`` is its distance ahead of ego along the path.
    """

    base_m: float
    closed: _Steps
    late: _Steps


def find_conflicts(
    candidate: CandidatePath, size_m: _Size, others: _Boxes, valid: _Exists,
    vulnerable: Bool[np.ndarray, " user"],
) -> Conflicts:  # fmt: skip
    """Find conflicts of ego's box along a path with others; ``vulnerable`` is a mask of pedestrians and cyclists."""
    margin = np.where(vulnerable[:, None], NEAR_VULNERABLE_M, NEAR_M)
    is_static = valid.all(axis=1) & (others == others[:, :1]).all(axis=(1, 2))
    ego = candidate_boxes(candidate, size_m)
    moving = _box_conflicts(ego, others, valid & ~is_static[:, None], margin)
    # Static users are tested at one step only.
    static = _box_conflicts(ego, others[:, :1], is_static[:, None], margin)
    steps = others.shape[1]
    user, point, hard = (np.repeat(values, steps) for values in (static.user, static.point, static.hard))
    return Conflicts(
        user=np.concatenate([moving.user, user]),
        step=np.concatenate([moving.step, np.tile(np.arange(steps), len(static.step))]),
        point=np.concatenate([moving.point, point]),
        hard=np.concatenate([moving.hard, hard]),
    )


def _box_conflicts(
    ego: _PathBoxes, others: _Boxes, valid: _Exists, margin_m: Float64[np.ndarray, "user 2"]
) -> Conflicts:
    """Find conflicts of boxes: circles at every fourth sample first, then exact overlap."""
    reach = np.hypot(*(others[:, 0, 4:].T / 2)) + np.hypot(*(ego[0, 4:] / 2 + margin_m).T)
    reach += _STRIDE * SPACING_M / 2
    user, step = nonzero(valid & _is_near_path(others, ego, reach))
    coarse = ego[::_STRIDE, :2]
    xy = others[user, step, :2]
    squared_gap = (xy[:, None, 0] - coarse[:, 0]) ** 2 + (xy[:, None, 1] - coarse[:, 1]) ** 2
    entry, block = nonzero(squared_gap < reach[user, None] ** 2)
    point = (block[:, None] * _STRIDE + np.arange(_STRIDE) - _STRIDE // 2).ravel()
    entry = np.repeat(entry, _STRIDE)
    is_inside = (point >= 0) & (point < len(ego))
    entry, point = entry[is_inside], point[is_inside]
    other, ego_box = others[user[entry], step[entry]], ego[point]
    is_close = overlap(_grow_boxes(ego_box, margin_m[user[entry]]), other)
    entry, point, other, ego_box = entry[is_close], point[is_close], other[is_close], ego_box[is_close]
    hard = overlap(_grow_boxes(ego_box, np.array(HARD_M)), other)
    return Conflicts(user[entry], step[entry], point, hard)


def _grow_boxes(
    box: Float64[np.ndarray, "n 6"], by_m: Float64[np.ndarray, "*n 2"]
) -> Float64[np.ndarray, "n 6"]:
    """Grow boxes at each end and each side."""
    size = box[:, 4:] + 2 * by_m
    return np.concatenate([box[:, :4], size], axis=1)


def _is_near_path(others: _Boxes, ego: _PathBoxes, reach: Float64[np.ndarray, " user"]) -> _Exists:
    """Mask of users near the bounding rectangle of the path."""
    low, high = ego[:, :2].min(axis=0), ego[:, :2].max(axis=0)
    outside = np.maximum(low - others[..., :2], others[..., :2] - high).max(axis=-1)
    return outside < reach[:, None]


def stop_lines(
    network: RoadNetwork, path: Path, ego_m: tuple[float, float], times_s: _Series, passed: _Series,
    coming: dict[int, _Steps],
) -> list[StopLine]:  # fmt: skip
    """Return the lines ahead of ego that it must not or should not pass at some time.

    ``ego_m`` is the path position of ego's centre and half its length, ``passed`` the position at each time in the last
    run (a stop sign's line is closed until ego passes it there), and ``coming`` the result of :func:`arrivals`. Times
    are on the clock of the lights.
    """
    from_m, half_m = ego_m
    result = []
    shape = (len(times_s), len(network.lanes))
    colour, to_red = np.zeros(shape, np.int8), np.zeros(shape)
    if network.signals is not None:
        colour, to_red = network.signals.colours(times_s, len(network.lanes))
    for span in path.spans:
        lane = network.lanes[span.lane]
        line = span.begin_m - half_m
        if not lane.connector or line <= from_m:
            continue
        closed = colour[:, span.lane] == Colour.RED
        late = (colour[:, span.lane] == Colour.YELLOW) & (to_red[:, span.lane] < _LATE_YELLOW_S)
        if lane.control in (Control.STOP, Control.ALL_WAY_STOP):
            closed |= passed <= line
        for rival in lane.yields_to:
            if rival in coming:
                late |= coming[rival]
        if closed.any() or late.any():
            result.append(StopLine(line - _SHORT_M - from_m, closed, late))
    return result


def arrivals(
    network: RoadNetwork, paths: list[Path], distance_m: Float64[np.ndarray, "vehicle time"],
    valid: Bool[np.ndarray, "vehicle time"], half_m: Float64[np.ndarray, " vehicle"],
) -> dict[int, _Steps]:  # fmt: skip
    """Return, for connectors with priority, a mask of the steps at which a vehicle is on them or will be within 2 s.

    Ego, row 0, does not count. Connectors on no vehicle's path are left out. The paths are those of the last step:
    before a lane change or detour a vehicle's positions on them are approximate.
    """
    priority_lanes = {rival for lane in network.lanes for rival in lane.yields_to}
    result: dict[int, _Steps] = {}
    for vehicle in range(1, len(paths)):
        for span in paths[vehicle].spans:
            if span.lane in priority_lanes:
                position, half = distance_m[vehicle], half_m[vehicle]
                end = span.begin_m + span.scale * network.lanes[span.lane].length_m
                is_on_lane = (position + half > span.begin_m) & (position - half < end) & valid[vehicle]
                window = np.ones(round(_YIELD_S / DT_S) + 1)
                is_coming = np.convolve(is_on_lane[::-1], window, mode="full")[: len(is_on_lane)][::-1] > 0
                result[span.lane] = result.get(span.lane, np.zeros(len(is_on_lane), bool)) | is_coming
    return result
