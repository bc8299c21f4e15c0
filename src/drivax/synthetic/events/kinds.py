"""What a labelled event is: its kind, who acts in it, when, and how hard it is to cope with."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from drivax.synthetic.events.destinations import Aim
from drivax.synthetic.events.ego_view import Scene
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.roles import Scripted, Staging

#: Required decelerations of staged events, m/s2: from mild to the limit of what braking can avoid.
SEVERITY_MPS2 = (1.5, 6.0)


class EventKind(enum.IntEnum):
    """Kinds of events; the numbers are stored in scenario sets and never change their meaning."""

    NONE = 0
    LEAD_BRAKES = 1
    CUT_IN = 2
    STALLED_VEHICLE = 3
    RED_LIGHT_RUNNER = 4
    JAYWALKER = 5
    FROM_BEHIND_PARKED = 6
    LATE_MERGE = 7
    WRONG_WAY_CYCLIST = 8
    TURN_CONFLICT = 9
    LANE_BLOCKED = 10
    REVERSING_CAR = 11
    TAILGATER = 12


@dataclass(frozen=True)
class Staged:
    """An event that will happen.

    Attributes:
        kind: What it is.
        staging: What has to change in how traffic goes.
        actors: Rows of the motion that comes of it: of vehicles, or of the extras, which come last.
        first_step, last_step: From when to when the actor does what it should not, both included.
        severity_mps2: The constant deceleration with which ego just avoids the actor if it begins when it can see
            what the actor is about to do, 0.4 s after the first step, and keeps its speed until then.
    """

    kind: EventKind
    staging: Staging
    actors: tuple[int, ...]
    first_step: int
    last_step: int
    severity_mps2: float


@dataclass(frozen=True)
class Proposal:
    """An event as a script would like it, before it is checked.

    Attributes:
        severity_mps2: What it is meant to require of ego.
        threat: How the actor will go if nobody disturbs it, at all steps.
        vehicle: Its row if it is a vehicle of the roles; else it is the first of the extras.
        others: Rows of further actors.
        scene: The scene with the actor in it, where ego drives otherwise because of it long before the event.
    """

    staging: Staging
    severity_mps2: float
    threat: Scripted
    first_step: int
    last_step: int
    vehicle: int | None = None
    others: tuple[int, ...] = ()
    scene: Scene | None = None


@runtime_checkable
class EventScript(Protocol):
    """Thinks of an event of one kind."""

    @property
    def kind(self) -> EventKind:
        """What it stages."""
        ...

    def possible(self, network: RoadNetwork) -> bool:
        """Whether roads have what the event needs; where they do, the traffic may still leave no occasion."""
        ...

    def propose(self, scene: Scene, severity_mps2: float, rng: np.random.Generator) -> Proposal | None:
        """Proposes an event of about this severity, or None where this draw finds no occasion."""
        ...


@runtime_checkable
class AimedScript(EventScript, Protocol):
    """One that needs ego at certain places; all others may happen on any open road."""

    def aims(self, network: RoadNetwork) -> tuple[Aim, ...]:
        """Places of which ego should pass one."""
        ...
