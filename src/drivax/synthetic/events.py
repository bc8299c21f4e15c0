"""Labelled events: something unusual that is staged in a scenario and written down with its actors and times.

A script looks at how the scenario goes without it and may stage itself: it returns what the actor is made to do
(:class:`~drivax.synthetic.traffic.Override`) and the label. A new event is a script in :data:`SCRIPTS`.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from drivax.scenario.schema import CURRENT_STEP, DT_S
from drivax.synthetic.paths import Path
from drivax.synthetic.traffic import Motion, Override


class EventKind(enum.IntEnum):
    """Kinds of events; the numbers are stored in scenario sets and never change their meaning."""

    NONE = 0
    LEAD_BRAKES = 1


@dataclass(frozen=True)
class Staged:
    """An event that will happen: what it is, what its actor (a row of the traffic) does, and when."""

    kind: EventKind
    override: Override


@runtime_checkable
class EventScript(Protocol):
    """Decides whether and how an event happens."""

    def stage(
        self, motion: Motion, paths: list[Path], first_step: int, rng: np.random.Generator
    ) -> Staged | None:
        """Stages the event, or returns None where the scenario offers no occasion.

        Args:
            motion: How the scenario goes without the event; row 0 is ego.
            paths: Everyone's path.
            first_step: Step of ``motion`` at which the recording begins.
            rng: Source of chance.
        """
        ...


@dataclass(frozen=True)
class LeadBrakes:
    """The vehicle ahead of ego brakes hard for no visible reason.

    Attributes:
        braking_mps2: Its deceleration, low and high.
        lasts_s: How long it brakes, low and high.
        within_m: It is at most this far ahead of ego, centre to centre.
    """

    braking_mps2: tuple[float, float] = (2.5, 4.0)
    lasts_s: tuple[float, float] = (1.0, 1.8)
    within_m: float = 45.0

    def stage(
        self, motion: Motion, paths: list[Path], first_step: int, rng: np.random.Generator
    ) -> Staged | None:
        """See :class:`EventScript`."""
        start = first_step + CURRENT_STEP + int(rng.integers(5, 35))
        leader = _ahead_of_ego(motion, paths, start, self.within_m)
        if leader is None or motion.speed[leader, start] < 5.0:
            return None
        end = start + round(float(rng.uniform(*self.lasts_s)) / DT_S)
        braking = -float(rng.uniform(*self.braking_mps2))
        return Staged(EventKind.LEAD_BRAKES, Override(leader, start, end, braking))


SCRIPTS: tuple[EventScript, ...] = (LeadBrakes(),)


def _ahead_of_ego(motion: Motion, paths: list[Path], step: int, within_m: float) -> int | None:
    """The nearest vehicle whose centre is on ego's path ahead (within 1 m of it), or None."""
    begin = int(motion.distance_m[0, step] / paths[0].step_m)
    ahead = paths[0].curve.xy[begin : begin + round(within_m / paths[0].step_m)]
    if not len(ahead):
        return None
    gap = np.hypot(*np.moveaxis(motion.xy[1:, step, None] - ahead, -1, 0))
    place = np.where((gap < 1.0) & motion.valid[1:, step, None], np.arange(len(ahead)), len(ahead)).min(
        axis=1
    )
    if not len(place) or place.min() == len(ahead):
        return None
    return 1 + int(np.argmin(place))
