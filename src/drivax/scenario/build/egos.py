"""Further egos: vehicles next to the recorded ego that may be the ego of an episode, with routes of their own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int

from drivax.scenario.build.routes import STANDS_M, EgoLog, RouteSet
from drivax.scenario.build.tracks import LocalTracks
from drivax.scenario.schema import CURRENT_STEP, LEAST_STEPS, AgentKind

Array = np.ndarray[Any, Any]

#: Logs of further egos end where they leave the box of the recorded ego's log, widened by this; the stored map reaches
#: 20 m further.
KNOWN_M = 80.0


@dataclass(frozen=True)
class FurtherEgo:
    """A further ego: its slot, the last step of its unbroken log, and its routes, of which the first is stored."""

    slot: int
    last: int
    routes: RouteSet


def further_egos(
    tracks: LocalTracks, moving: Int[Array, " slot"], log: EgoLog, most: int
) -> list[tuple[int, int]]:
    """Return slot and last step of up to ``most`` vehicles, the nearest to the recorded ego first.

    From the current step on, their log lasts 2 s or more and leads more than 2 m away. It ends at the first gap, or
    where it leaves the box of :data:`KNOWN_M`. ``moving`` holds the track of every slot, ``log`` is the recorded ego's.
    """
    if most < 1:
        return []
    now, path = log.current, log.positions[:, :2]
    xy, valid = tracks.xyz[moving, now:, :2], tracks.valid[moving, now:]
    low, high = path.min(axis=0) - KNOWN_M, path.max(axis=0) + KNOWN_M
    unbroken = np.logical_and.accumulate(valid & ((xy >= low) & (xy <= high)).all(axis=2), axis=1)
    steps = unbroken.sum(axis=1)
    travel = np.where(unbroken, np.hypot(*np.moveaxis(xy - xy[:, :1], -1, 0)), 0.0).max(axis=1)
    eligible = (steps >= LEAST_STEPS - CURRENT_STEP) & (travel > STANDS_M)
    eligible &= (tracks.kind[moving] == AgentKind.VEHICLE) & (moving != tracks.ego)
    slots = np.flatnonzero(eligible)
    distance = np.hypot(*(xy[slots, 0] - log.xyz[now, :2]).T)
    chosen = slots[np.argsort(distance, kind="stable")[:most]]
    return [(int(slot), now + int(steps[slot]) - 1) for slot in chosen]
