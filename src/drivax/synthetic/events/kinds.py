"""Data types of events: kinds, staged events, proposals and the base class of scripts."""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from drivax.synthetic.events.destinations import Destination, open_road
from drivax.synthetic.events.ego_view import EgoView
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.roles import ScriptedUser, Staging

#: Range of required decelerations of staged events, m/s2.
SEVERITY_MPS2 = (1.5, 6.0)


class EventKind(enum.IntEnum):
    """Kinds of events; scenario sets store these numbers."""

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
class StagedEvent:
    """An event to simulate.

    Attributes:
        staging: Changes to the traffic.
        actors: Rows of the actors in the simulated motion, whose last rows are the staging's extras.
        first_step, last_step: Steps of the misbehaviour, both included. That of cross traffic usually ends 1 s after it
            enters the junction, even before the conflict.
        severity_mps2: Constant deceleration with which ego just avoids the actor if ego starts braking 0.4 s after the
            first step, when the actor's behaviour is visible, and until then drives as without the event (except that
            it reacts to an added leader before the leader brakes).
    """

    kind: EventKind
    staging: Staging
    actors: tuple[int, ...]
    first_step: int
    last_step: int
    severity_mps2: float


@dataclass(frozen=True)
class Proposal:
    """An event as a script proposes it, before the checks.

    Attributes:
        severity_mps2: Intended severity, which the checks compare with the required deceleration.
        adversary: Undisturbed motion of the actor at all steps.
        vehicle: Row of the actor if it is a vehicle of the traffic; None if it is the first of the extras.
        others: Rows of further actors.
        view: The scenario in which ego reacts to the actor before the event; None where it does not.
    """

    staging: Staging
    severity_mps2: float
    adversary: ScriptedUser
    first_step: int
    last_step: int
    vehicle: int | None = None
    others: tuple[int, ...] = ()
    view: EgoView | None = None


class EventScript(ABC):
    """Proposes events of one kind."""

    def destinations(self, network: RoadNetwork) -> tuple[Destination, ...]:
        """Return candidate places for ego to pass; by default any open road."""
        return open_road(network)

    def possible(self, network: RoadNetwork) -> bool:
        """Return whether the event is possible in a network."""
        return bool(self.destinations(network))

    @abstractmethod
    def propose(self, view: EgoView, severity_mps2: float, rng: np.random.Generator) -> Proposal | None:
        """Propose an event of about this severity, or return None if this draw fails."""
