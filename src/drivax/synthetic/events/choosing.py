"""Staging of an event: a script proposes, and the first proposal that passes the checks is taken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drivax.synthetic.events.adversary import (
    comes_close,
    enter_when_clear,
    first_blocked,
    severity,
    vehicles_that_cross,
)
from drivax.synthetic.events.crossing import CrossTraffic
from drivax.synthetic.events.destinations import Destination, open_road
from drivax.synthetic.events.ego_view import FULL_SWING, NOTICED, EgoView
from drivax.synthetic.events.kinds import (
    SEVERITY_MPS2,
    DestinationScript,
    EventKind,
    EventScript,
    Proposal,
    StagedEvent,
)
from drivax.synthetic.events.leading import LeadBrakes, StalledVehicle
from drivax.synthetic.events.merging import CutIn
from drivax.synthetic.events.roadside import Jaywalker, LaneBlocked, ReversingCar, WrongWayCyclist
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.roles import Staging

#: All scripts; a new event is a script here and a number in :class:`EventKind`.
SCRIPTS: dict[EventKind, EventScript] = {
    script.kind: script
    for script in (
        LeadBrakes(),
        CutIn(),
        StalledVehicle(),
        CrossTraffic(),
        Jaywalker(),
        Jaywalker(hidden=True),
        CutIn(late_merge=True),
        WrongWayCyclist(),
        CrossTraffic(turning=True),
        LaneBlocked(),
        ReversingCar(),
        LeadBrakes(tailgater=True),
    )
}
#: Proposals per event, how many of them with the requested severity, and how many with each other one.
_DRAWS, _AS_REQUESTED, _PER_SEVERITY = 40, 20, 5
#: Exponent of the uniform number behind a severity; below 1 hard events are more frequent.
_HARD = 0.7
#: Kinds that rarely succeed unless ego is sent to a suitable place.
_PLACED = (
    EventKind.RED_LIGHT_RUNNER,
    EventKind.TURN_CONFLICT,
    EventKind.LATE_MERGE,
    EventKind.TAILGATER,
)
#: Largest difference between a proposal's severity and the one that it really requires, m/s2.
_NEAR_MPS2 = 0.6


def possible(kind: EventKind, network: RoadNetwork) -> bool:
    """Whether a network has what an event needs, such as a light, a lane that ends or bays."""
    return SCRIPTS[kind].possible(network)


def destinations_for(kind: EventKind, network: RoadNetwork, again: bool = False) -> tuple[Destination, ...]:
    """Places of which ego should pass one, so that an event can be staged; empty: anywhere.

    Args:
        kind: The kind of event.
        network: The roads.
        again: Whether staging has failed before: then kinds that can happen anywhere get places too.
    """
    script = SCRIPTS[kind]
    if not again and kind not in _PLACED:
        return ()
    return script.destinations(network) if isinstance(script, DestinationScript) else open_road(network)


def draw_severity(rng: np.random.Generator) -> float:
    """Draw the deceleration that an event should require of ego, m/s2.

    Hard events are drawn more often, since they are harder to stage: staged events fill all thirds of the range.
    """
    low, high = SEVERITY_MPS2
    return low + (high - low) * float(rng.random() ** _HARD)


def stage(
    kind: EventKind, view: EgoView, severity_mps2: float, rng: np.random.Generator
) -> StagedEvent | None:
    """Stage an event of a kind, or return None where no proposal passes.

    Args:
        kind: The kind.
        view: The scenario without the event.
        severity_mps2: Requested severity; other ones are drawn where it cannot be staged.
        rng: Source of randomness.
    """
    script = SCRIPTS[kind]
    for draw in range(_DRAWS):
        if draw >= _AS_REQUESTED and draw % _PER_SEVERITY == 0:
            severity_mps2 = draw_severity(rng)
        proposal = script.propose(view, severity_mps2, rng)
        checked = None if proposal is None else _check(proposal.view or view, proposal)
        if proposal is not None and checked is not None:
            required, staging = checked
            actor = len(view.motion.kind) if proposal.vehicle is None else proposal.vehicle
            actors = (actor, *proposal.others)
            return StagedEvent(kind, staging, actors, proposal.first_step, proposal.last_step, required)
    return None


def _check(view: EgoView, proposal: Proposal) -> tuple[float, Staging] | None:
    """The deceleration that a proposal requires of ego, and its staging; None where the proposal fails a check."""
    begin, adversary = proposal.first_step, proposal.adversary
    required = severity(view, adversary, begin + NOTICED)
    low, high = SEVERITY_MPS2
    if not low <= required <= high or abs(required - proposal.severity_mps2) > _NEAR_MPS2:
        return None
    blocked = np.isfinite(first_blocked(view, adversary, begin))
    entered = begin + int(np.argmax(blocked))
    if not blocked.any() or entered >= view.first_step + FULL_SWING:
        return None
    if not comes_close(view, adversary, begin):
        return None
    staging = proposal.staging
    removed = sorted(
        {*staging.removed, *(row for extra in staging.extras for row in vehicles_that_cross(view, extra))}
    )
    if set(removed) & set(proposal.others):
        return None
    extras = tuple(enter_when_clear(view, extra, entered, tuple(removed)) for extra in staging.extras)
    known = tuple(extra for extra in extras if extra is not None and extra.valid[begin])
    if len(known) < len(extras):
        return None
    return required, replace(staging, extras=known, removed=tuple(removed))
