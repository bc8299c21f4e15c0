"""Users who move as told, as boxes that others meet, and everybody together as one motion."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from drivax.scenario.schema import AgentKind
from drivax.synthetic.traffic.obstacles import Boxes
from drivax.synthetic.traffic.paths import Path
from drivax.synthetic.traffic.roles import Cast, Motion, Scripted, Staging


def boxes_at(scripted: tuple[Scripted, ...], step: int) -> Boxes:
    """Where scripted users are at a step."""
    if not scripted:
        return Boxes(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 2)))
    return Boxes(
        np.array([s.xy[step] for s in scripted]),
        np.array([s.heading[step] for s in scripted]),
        np.array([s.speed[step] for s in scripted]),
        np.array([s.size_m[:2] for s in scripted]),
    )


def standing_and_moving(extras: tuple[Scripted, ...]) -> tuple[tuple[Scripted, ...], tuple[Scripted, ...]]:
    """Those who stand in one place all the time, and the others."""
    fixed = [bool(e.valid.all() and not e.speed.any() and not np.ptp(e.xy, axis=0).any()) for e in extras]
    return (
        tuple(e for e, still in zip(extras, fixed, strict=True) if still),
        tuple(e for e, still in zip(extras, fixed, strict=True) if not still),
    )


def everybody(
    cast: Cast,
    staging: Staging,
    vehicles: tuple[
        Float64[np.ndarray, "v time 3"],
        Float64[np.ndarray, "v time"],
        Bool[np.ndarray, "v time"],
        Float64[np.ndarray, "v time"],
        Float64[np.ndarray, "v time"],
    ],
    walked: Float64[np.ndarray, "walker time 4"],
    paths: list[Path],
) -> Motion:
    """The motion of all users of a scenario, in their order.

    Args:
        cast: Who there is.
        staging: Whose extras are there too.
        vehicles: Their poses (x, y, heading), speeds, presence, path positions and accelerations.
        walked: x, y, heading and speed of the walkers.
        paths: The vehicles' paths.
    """
    pose, speed, valid, at, acceleration = vehicles
    steps = pose.shape[1]
    scripted = (*cast.parked, *staging.extras)
    kinds = [AgentKind.PEDESTRIAN] * len(cast.walkers) + [s.kind for s in scripted]
    sizes = [w.size_m for w in cast.walkers] + [s.size_m for s in scripted]
    there = np.ones(walked.shape[:2], bool)
    return Motion(
        kind=np.concatenate([cast.drivers.kind, np.array(kinds, np.int8)]),
        size_m=np.concatenate([cast.drivers.size_m, np.array(sizes, float).reshape(-1, 3)]),
        xy=np.concatenate([pose[..., :2], walked[..., :2], *(s.xy[None, :steps] for s in scripted)]),
        heading=np.concatenate([pose[..., 2], walked[..., 2], *(s.heading[None, :steps] for s in scripted)]),
        speed=np.concatenate([speed, walked[..., 3], *(s.speed[None, :steps] for s in scripted)]),
        valid=np.concatenate([valid, there, *(s.valid[None, :steps] for s in scripted)]),
        distance_m=at,
        acceleration=acceleration,
        paths=paths,
    )
