"""Tracks in the local frame, sorted into moving and parked agents with one box size each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from drivax.geometry.polylines import left_normals
from drivax.geometry.vectors import wrap
from drivax.scenario.build.lane_paths import walk
from drivax.scenario.build.lanes import LaneSegments
from drivax.scenario.recording import Tracks
from drivax.scenario.schema import AgentKind, among

Array = np.ndarray[Any, Any]

#: A parked agent stays within these distances of its median pose.
PARKED_M, PARKED_RAD = 0.3, 0.1
#: Distance between the points of an extension.
EXTENSION_STEP_M = 4.0
#: Over this distance an extension fades from the agent's lateral offset to the centre of its lane.
FADE_M = 20.0
#: Agents that move by more than the second distance rank as if they were nearer to the ego by the first.
MOVER_BONUS_M, MOVER_M = 50.0, 2.0
#: Bits of ``agent_flags``.
EGO_BIT, PREDICT_BIT, INTEREST_BIT = 1, 2, 4
#: Length, width and height where a source has none, metres (medians of Argoverse 2 sensor logs by class).
DEFAULT_SIZES = {
    AgentKind.NONE: (1.0, 1.0, 1.0), AgentKind.VEHICLE: (4.1, 1.9, 1.6), AgentKind.PEDESTRIAN: (0.7, 0.7, 1.8),
    AgentKind.CYCLIST: (1.8, 0.6, 1.7), AgentKind.OTHER: (1.0, 1.0, 1.0), AgentKind.STATIC: (0.5, 0.5, 1.0),
}  # fmt: skip
DEFAULT_EGO_SIZE = (4.9, 2.0, 1.5)
#: Smaller and larger measurements of a size are ignored.
LEAST_SIZE_M, MOST_SIZE_M = 1e-3, 100.0
#: Sort key of tracks never valid together with the ego, and bonus of preferred tracks; larger than all distances.
_UNRELATED_M, _PREFERENCE_M = 1e6, 1e7


@dataclass(frozen=True)
class LocalTracks:
    """Tracks in the local frame, float64: box centres, headings in [-pi, pi), m/s; zeros where not valid.

    ``size`` is the median length, width and height over the valid steps, metres; ``has_default_size`` masks tracks with
    a default length, width or height.
    """

    xyz: Float[Array, "track time 3"]
    heading: Float[Array, "track time"]
    velocity: Float[Array, "track time 2"]
    size: Float[Array, "track 3"]
    valid: Bool[Array, "track time"]
    kind: Int[Array, " track"]
    track_id: Int[Array, " track"]
    ego: int
    has_default_size: Bool[Array, " track"]


def local_tracks(tracks: Tracks, ego: int, origin: Float[Array, "3"]) -> LocalTracks:
    """Move tracks into the local frame and give every track one box size.

    Length, width and height are each the median of the valid measurements from 1 mm to 100 m, since sizes of one
    object vary by metres in public data; without any, that of :data:`DEFAULT_EGO_SIZE` (ego) or :data:`DEFAULT_SIZES`.
    """
    valid, mask = tracks.valid, tracks.valid[..., None]
    xyz = np.where(mask, np.concatenate((tracks.xy, tracks.z[..., None]), axis=-1) - origin, 0.0)
    heading, velocity = np.where(valid, wrap(tracks.heading), 0.0), np.where(mask, tracks.velocity, 0.0)
    size, has_default_size = _sizes(tracks, ego)
    kind, track_id = tracks.kind.astype(np.int64), tracks.track_id.astype(np.int64)
    return LocalTracks(xyz, heading, velocity, size, valid, kind, track_id, ego, has_default_size)


def _sizes(tracks: Tracks, ego: int) -> tuple[Float[Array, "track 3"], Bool[Array, " track"]]:
    """Median box size of every track, and the mask of those with a default length, width or height."""
    sizes = np.nan_to_num(tracks.size)
    is_plausible = tracks.valid[..., None] & (sizes >= LEAST_SIZE_M) & (sizes <= MOST_SIZE_M)
    size = masked_median(np.swapaxes(tracks.size, 1, 2), np.swapaxes(is_plausible, 1, 2))
    default = np.array([DEFAULT_SIZES[AgentKind(kind)] for kind in tracks.kind]).reshape(-1, 3)
    default[ego] = DEFAULT_EGO_SIZE
    is_unknown = ~np.any(is_plausible, axis=1)
    return np.where(is_unknown, default, size), is_unknown.any(axis=1)


def masked_median(values: Float[Array, "*row time"], valid: Bool[Array, "*row time"]) -> Float[Array, "*row"]:
    """Median over the valid entries of the last axis; 0 without any."""
    sorted_values = np.sort(np.where(valid, values, np.inf), axis=-1)
    count = valid.sum(axis=-1)
    lower, upper = np.maximum((count - 1) // 2, 0), np.minimum(count // 2, values.shape[-1] - 1)
    middle = np.take_along_axis(sorted_values, np.stack((lower, upper), axis=-1), axis=-1)
    low, high = np.moveaxis(middle, -1, 0)
    with np.errstate(invalid="ignore"):
        return np.where(count > 0, (low + high) / 2, 0.0)


@dataclass(frozen=True)
class Placement:
    """Tracks of the moving block (the ego first) and of the parked block, in slot order.

    ``pose`` is the median x, y, z and heading of every track.
    """

    moving: Int[Array, " slot"]
    parked: Int[Array, " parked_slot"]
    pose: Float[Array, "track 4"]
    overflow: dict[str, int]


def place(tracks: LocalTracks, preferred: Sequence[int], agents: int, parked: int) -> Placement:
    """Sort tracks into the moving and the parked block, the most relevant first.

    A track is parked if every valid pose is within 0.3 m and 0.1 rad of its median pose. The ego comes first, then
    ``preferred`` tracks (to predict, of interest), then tracks by their smallest distance to the ego during the log,
    where those that move rank 50 m nearer. Tracks without a valid step are dropped.
    """
    pose = median_pose(tracks)
    offset_m = np.hypot(*np.moveaxis(tracks.xyz[..., :2] - pose[:, None, :2], -1, 0))
    turn = np.abs(wrap(tracks.heading - pose[:, None, 3]))
    is_still = ((offset_m <= PARKED_M) & (turn <= PARKED_RAD)) | ~tracks.valid
    has_pose = tracks.valid.any(axis=1)
    is_parked = is_still.all(axis=1) & has_pose
    is_parked[tracks.ego] = False
    rank = _rank(tracks, np.where(tracks.valid, offset_m, 0.0).max(axis=1), preferred)
    order = np.argsort(rank, kind="stable")
    moving_rows, parked_rows = order[(has_pose & ~is_parked)[order]], order[is_parked[order]]
    overflow = +Counter(agents=len(moving_rows) - agents, parked=len(parked_rows) - parked)
    return Placement(moving_rows[:agents], parked_rows[:parked], pose, overflow)


def median_pose(tracks: LocalTracks) -> Float[Array, "track 4"]:
    """Median x, y, z and heading over the valid steps; the heading relative to its circular mean."""
    by_axis = np.swapaxes(tracks.xyz, 1, 2)
    xyz = masked_median(by_axis, np.broadcast_to(tracks.valid[:, None], by_axis.shape))
    weight = tracks.valid.astype(np.float64)
    mean = np.arctan2((np.sin(tracks.heading) * weight).sum(1), (np.cos(tracks.heading) * weight).sum(1))
    turn = masked_median(wrap(tracks.heading - mean[:, None]), tracks.valid)
    return np.concatenate((xyz, wrap(mean + turn)[:, None]), axis=1)


def _rank(tracks: LocalTracks, reach_m: Array, preferred: Sequence[int]) -> Float[Array, " track"]:
    """Sort key of every track, smaller is more relevant; ``reach_m`` is its largest distance from its median pose."""
    with_ego = tracks.valid & tracks.valid[tracks.ego]
    distance = np.hypot(*np.moveaxis((tracks.xyz - tracks.xyz[tracks.ego])[..., :2], -1, 0))
    rank = np.where(with_ego, distance, _UNRELATED_M).min(axis=1) - MOVER_BONUS_M * (reach_m > MOVER_M)
    rank[list(preferred)] -= _PREFERENCE_M
    rank[tracks.ego] = -np.inf
    return rank


def extend(
    tracks: LocalTracks, rows: Int[Array, " slot"], lane_segments: LaneSegments, count: int
) -> Float[Array, "slot count 2"]:
    """Extend tracks by ``count`` points 4 m apart beyond their last valid pose: along their lane, else straight on.

    Vehicles and cyclists within 3 m and 45 degrees of a lane follow it and its straightest successors; their lateral
    offset fades within 20 m.
    """
    last = tracks.valid.shape[1] - 1 - np.argmax(tracks.valid[rows][:, ::-1], axis=1)
    xyz, heading = tracks.xyz[rows, last], tracks.heading[rows, last]
    distance = EXTENSION_STEP_M * np.arange(1, count + 1)
    direction = np.stack((np.cos(heading), np.sin(heading)), axis=-1)
    points = xyz[:, None, :2] + distance[:, None] * direction[:, None]
    lane, s, _ = lane_segments.nearest(xyz, heading, reach_m=3.0, turn_rad=np.deg2rad(45.0))
    can_follow = among(tracks.kind[rows], (AgentKind.VEHICLE, AgentKind.CYCLIST))
    followers = np.flatnonzero((lane >= 0) & can_follow)
    if len(followers) == 0:
        return points
    lines, lane, s = lane_segments.graph.lines, lane[followers], s[followers]
    offset = xyz[followers, :2] - lines.at(lane, s)[..., :2]
    lateral = np.einsum("ai,ai->a", offset, left_normals(lines.heading(lane, s)))
    lane_points, lane_heading = walk(lane_segments.graph, lane, s, EXTENSION_STEP_M, count)
    fade = np.maximum(1.0 - distance / FADE_M, 0.0)
    points[followers] = lane_points + (lateral[:, None] * fade)[..., None] * left_normals(lane_heading)
    return points
