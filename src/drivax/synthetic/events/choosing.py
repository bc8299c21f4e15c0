"""Staging of an event: a script proposes, and the first proposal that passes the checks is taken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drivax.synthetic.events.adversary import (
    comes_close,
    enter_when_clear,
    first_blocked_station,
    severity,
    vehicles_that_cross,
)
from drivax.synthetic.events.crossing import CrossTraffic
from drivax.synthetic.events.destinations import Destination
from drivax.synthetic.events.ego_view import FULL_SWING, NOTICED, EgoView
from drivax.synthetic.events.kinds import SEVERITY_MPS2, EventKind, EventScript, Proposal, StagedEvent
from drivax.synthetic.events.leading import CutIn, LeadBrakes, StalledVehicle
from drivax.synthetic.events.roadside import Jaywalker, LaneBlocked, ReversingCar, WrongWayCyclist
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.roles import Staging

#: All scripts; a new event is a script here and a number in :class:`EventKind`.
SCRIPTS: dict[EventKind, EventScript] = {
    EventKind.LEAD_BRAKES: LeadBrakes(),
    EventKind.CUT_IN: CutIn(),
    EventKind.STALLED_VEHICLE: StalledVehicle(),
    EventKind.RED_LIGHT_RUNNER: CrossTraffic(),
    EventKind.JAYWALKER: Jaywalker(),
    EventKind.FROM_BEHIND_PARKED: Jaywalker(hidden=True),
    EventKind.LATE_MERGE: CutIn(late_merge=True),
    EventKind.WRONG_WAY_CYCLIST: WrongWayCyclist(),
    EventKind.TURN_CONFLICT: CrossTraffic(turning=True),
    EventKind.LANE_BLOCKED: LaneBlocked(),
    EventKind.REVERSING_CAR: ReversingCar(),
    EventKind.TAILGATER: LeadBrakes(tailgater=True),
}
#: Proposals per event, number of these with the requested severity, and proposals per further severity.
_DRAWS, _AS_REQUESTED, _PER_SEVERITY = 40, 20, 5
#: Exponent of the uniform variable in the draw of a severity: values below 1 favour hard events.
_HARD_EXPONENT = 0.7
#: Kinds that rarely succeed without a suitable destination of ego.
_NEEDS_DESTINATION = {
    EventKind.RED_LIGHT_RUNNER,
    EventKind.TURN_CONFLICT,
    EventKind.LATE_MERGE,
    EventKind.TAILGATER,
}
#: Largest difference between a proposal's severity and the deceleration that it requires, m/s2.
_TOLERANCE_MPS2 = 0.6


def possible(kind: EventKind, network: RoadNetwork) -> bool:
    """Return whether a network allows an event, which may need a light, a lane that ends, or bays."""
    return SCRIPTS[kind].possible(network)


def destinations_for(kind: EventKind, network: RoadNetwork, again: bool = False) -> tuple[Destination, ...]:
    """Return candidate places for ego to pass, so that an event can be staged; empty: anywhere.

    ``again`` gives destinations to kinds that can happen anywhere, too, after an attempt without one has failed.
    """
    return SCRIPTS[kind].destinations(network) if again or kind in _NEEDS_DESTINATION else ()


def draw_severity(rng: np.random.Generator) -> float:
    """Draw the deceleration that an event should require of ego, m/s2.

    Hard events are drawn more often, since they are harder to stage: staged events fill all thirds of the range.
    """
    low, high = SEVERITY_MPS2
    return low + (high - low) * float(rng.random() ** _HARD_EXPONENT)


def stage(
    kind: EventKind, view: EgoView, severity_mps2: float, rng: np.random.Generator
) -> StagedEvent | None:
    """Stage an event in the scenario of ``view``, or return None if no proposal passes the checks.

    Other severities are drawn if the requested one cannot be staged.
    """
    for draw in range(_DRAWS):
        if draw >= _AS_REQUESTED and draw % _PER_SEVERITY == 0:
            severity_mps2 = draw_severity(rng)
        proposal = SCRIPTS[kind].propose(view, severity_mps2, rng)
        if proposal is None:
            continue
        result = _accept_proposal(proposal.view or view, proposal)
        if result is not None:
            required_mps2, staging = result
            actor = len(view.motion.kind) if proposal.vehicle is None else proposal.vehicle
            actors = (actor, *proposal.others)
            return StagedEvent(kind, staging, actors, proposal.first_step, proposal.last_step, required_mps2)
    return None


def _accept_proposal(view: EgoView, proposal: Proposal) -> tuple[float, Staging] | None:
    """Return the deceleration that a proposal requires of ego, and its staging, or None if it fails a check."""
    begin, adversary = proposal.first_step, proposal.adversary
    required_mps2 = severity(view, adversary, begin + NOTICED)
    low, high = SEVERITY_MPS2
    if not low <= required_mps2 <= high or abs(required_mps2 - proposal.severity_mps2) > _TOLERANCE_MPS2:
        return None
    is_blocked = np.isfinite(first_blocked_station(view, adversary, begin))
    entry = begin + int(np.argmax(is_blocked))
    is_in_time = is_blocked.any() and entry < view.first_step + FULL_SWING
    if not is_in_time or not comes_close(view, adversary, begin):
        return None
    staging = proposal.staging
    crossing_rows = (row for extra in staging.extras for row in vehicles_that_cross(view, extra))
    removed = tuple(sorted({*staging.removed, *crossing_rows}))
    if not set(removed).isdisjoint(proposal.others):
        return None
    entering_extras = (enter_when_clear(view, extra, entry, removed) for extra in staging.extras)
    extras = tuple(extra for extra in entering_extras if extra is not None and extra.valid[begin])
    if len(extras) < len(staging.extras):
        return None
    return required_mps2, replace(staging, extras=extras, removed=removed)
