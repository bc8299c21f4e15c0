"""Which event happens in a scenario: scripts propose, proposals are checked, and one of the feasible kinds is drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drivax.synthetic.events.adversary import (
    comes_close,
    first_blocked,
    in_its_cross_way,
    severity,
    with_room,
)
from drivax.synthetic.events.crossing import CrossTraffic
from drivax.synthetic.events.destinations import Aim, open_road
from drivax.synthetic.events.ego_view import FULL_SWING, NOTICED, Scene
from drivax.synthetic.events.kinds import SEVERITY_MPS2, AimedScript, EventKind, EventScript, Proposal, Staged
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
#: Draws of an event before it counts as impossible here, how many of them with the wanted severity, and how many
#: with each other one.
_DRAWS, _AS_WANTED, _PER_SEVERITY = 40, 20, 5
#: Severities are powers of uniform numbers: below 1 the hard ones come up more often.
_HARD = 0.7
#: Kinds that hardly ever find an occasion where ego goes where it likes.
_PLACED = (
    EventKind.RED_LIGHT_RUNNER,
    EventKind.TURN_CONFLICT,
    EventKind.LATE_MERGE,
    EventKind.TAILGATER,
)
#: A proposal counts where what it requires is so near to what was drawn, m/s2.
_NEAR_MPS2 = 0.6


def possible(kind: EventKind, network: RoadNetwork) -> bool:
    """Whether roads have what an event needs: a light, a lane that ends, bays; quick to tell before any traffic."""
    return SCRIPTS[kind].possible(network)


def aims(kind: EventKind, network: RoadNetwork, again: bool = False) -> tuple[Aim, ...]:
    """Places of which ego should pass one at a certain time, so that an event finds an occasion; empty: anywhere.

    Args:
        kind: The kind of event.
        network: The roads.
        again: Whether scenarios in which ego went where it liked offered no occasion: then also for kinds that can
            happen on any open road.
    """
    script = SCRIPTS[kind]
    if not again and kind not in _PLACED:
        return ()
    return script.aims(network) if isinstance(script, AimedScript) else open_road(network)


def drawn_severity(rng: np.random.Generator) -> float:
    """The deceleration that an event should require of ego, m/s2, more often hard than mild.

    Hard events find an occasion less often, and who brakes ahead of ego in its lane stays below 3 or so: with this
    slope all thirds of the range are filled.
    """
    low, high = SEVERITY_MPS2
    return low + (high - low) * float(rng.random() ** _HARD)


def stage(kind: EventKind, scene: Scene, severity_mps2: float, rng: np.random.Generator) -> Staged | None:
    """Stages an event of a kind, or returns None where the scenario offers no occasion.

    Args:
        kind: The kind.
        scene: How the scenario goes without the event.
        severity_mps2: What it should require of ego; where that finds no occasion something else is drawn.
        rng: Source of chance.
    """
    script = SCRIPTS[kind]
    for draw in range(_DRAWS):
        if draw >= _AS_WANTED and draw % _PER_SEVERITY == 0:
            severity_mps2 = drawn_severity(rng)
        proposal = script.propose(scene, severity_mps2, rng)
        checked = None if proposal is None else _checked(proposal.scene or scene, proposal)
        if proposal is not None and checked is not None:
            required, staging = checked
            actor = len(scene.motion.kind) if proposal.vehicle is None else proposal.vehicle
            actors = (actor, *proposal.others)
            return Staged(kind, staging, actors, proposal.first_step, proposal.last_step, required)
    return None


def _checked(scene: Scene, proposal: Proposal) -> tuple[float, Staging] | None:
    """The deceleration that a proposal really requires of ego, and its staging; None where it does not do."""
    begin, threat = proposal.first_step, proposal.threat
    required = severity(scene, threat, begin + NOTICED)
    low, high = SEVERITY_MPS2
    if not low <= required <= high or abs(required - proposal.severity_mps2) > _NEAR_MPS2:
        return None
    blocked = np.isfinite(first_blocked(scene, threat, begin))
    entered = begin + int(np.argmax(blocked))
    if not blocked.any() or entered >= scene.first_step + FULL_SWING:
        return None
    if not comes_close(scene, threat, begin):
        return None
    staging = proposal.staging
    removed = sorted(
        {*staging.removed, *(row for one in staging.extras for row in in_its_cross_way(scene, one))}
    )
    if set(removed) & set(proposal.others):
        return None
    extras = tuple(with_room(scene, extra, entered, tuple(removed)) for extra in staging.extras)
    known = tuple(extra for extra in extras if extra is not None and extra.valid[begin])
    if len(known) < len(extras):
        return None
    return required, replace(staging, extras=known, removed=tuple(removed))
