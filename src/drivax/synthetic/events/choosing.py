"""Which event happens in a scenario: scripts propose, proposals are checked, and one of the feasible kinds is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drivax.synthetic.cast import Cast, Motion, Staging
from drivax.synthetic.events.crossing import CrossTraffic
from drivax.synthetic.events.kinds import SEVERITY_MPS2, EventKind, EventScript, Proposal, Staged
from drivax.synthetic.events.leading import LeadBrakes, StalledVehicle
from drivax.synthetic.events.merging import CutIn
from drivax.synthetic.events.roadside import Jaywalker, LaneBlocked, ReversingCar, WrongWayCyclist
from drivax.synthetic.events.scene import FULL_SWING, Scene
from drivax.synthetic.events.threat import comes_close, first_blocked, severity, with_room
from drivax.synthetic.roads import RoadNetwork

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
#: Draws per kind before it counts as impossible here, and draws of places per severity.
_DRAWS, _PER_SEVERITY = 30, 10
#: A proposal counts where what it requires is so near to what was drawn, m/s2.
_NEAR_MPS2 = 0.6


def possible(kind: EventKind, network: RoadNetwork) -> bool:
    """Whether roads have what an event needs: a light, a lane that ends, bays; quick to tell before any traffic."""
    return SCRIPTS[kind].possible(network)


def stage(
    kind: EventKind, cast: Cast, motion: Motion, first_step: int, rng: np.random.Generator
) -> Staged | None:
    """Stages an event of a kind, or returns None where the scenario offers no occasion.

    Args:
        kind: The kind.
        cast: Who is in the scenario.
        motion: How it goes without the event; row 0 is ego.
        first_step: Step of ``motion`` at which the recording begins.
        rng: Source of chance.
    """
    return _staged(SCRIPTS[kind], Scene(cast, motion, first_step), rng)


def stage_any(
    cast: Cast,
    motion: Motion,
    first_step: int,
    rng: np.random.Generator,
    kinds: Sequence[EventKind] = tuple(SCRIPTS),
) -> tuple[Staged | None, tuple[EventKind, ...]]:
    """Stages one of several kinds: they are tried in random order until one finds an occasion.

    Args:
        cast: Who is in the scenario.
        motion: How it goes without the event; row 0 is ego.
        first_step: Step of ``motion`` at which the recording begins.
        rng: Source of chance.
        kinds: The kinds to choose from.

    Returns:
        The event, or None where no kind is possible, and the kinds that were found impossible on the way.
    """
    scene = Scene(cast, motion, first_step)
    impossible: list[EventKind] = []
    for place in rng.permutation(len(kinds)).tolist():
        staged = _staged(SCRIPTS[kinds[place]], scene, rng)
        if staged is not None:
            return staged, tuple(impossible)
        impossible.append(kinds[place])
    return None, tuple(impossible)


def _staged(script: EventScript, scene: Scene, rng: np.random.Generator) -> Staged | None:
    wanted = 0.0
    for draw in range(_DRAWS):
        if draw % _PER_SEVERITY == 0:
            wanted = float(rng.uniform(*SEVERITY_MPS2))
        proposal = script.propose(scene, wanted, rng)
        checked = None if proposal is None else _checked(proposal.scene or scene, proposal)
        if proposal is not None and checked is not None:
            required, staging = checked
            actor = len(scene.motion.kind) if proposal.vehicle is None else proposal.vehicle
            actors = (actor, *proposal.others)
            return Staged(script.kind, staging, actors, proposal.first_step, proposal.last_step, required)
    return None


def _checked(scene: Scene, proposal: Proposal) -> tuple[float, Staging] | None:
    """The deceleration that a proposal really requires of ego, and its staging; None where it does not do."""
    begin, threat = proposal.first_step, proposal.threat
    required = severity(scene, threat, begin)
    low, high = SEVERITY_MPS2
    if not low <= required <= high or abs(required - proposal.severity_mps2) > _NEAR_MPS2:
        return None
    blocked = np.isfinite(first_blocked(scene, threat, begin))
    entered = begin + int(np.argmax(blocked))
    if not blocked.any() or entered >= scene.first_step + FULL_SWING:
        return None
    if not comes_close(scene, threat, begin):
        return None
    extras = tuple(
        with_room(scene, extra, entered, proposal.staging.removed) for extra in proposal.staging.extras
    )
    known = tuple(extra for extra in extras if extra is not None and extra.valid[begin])
    return (required, replace(proposal.staging, extras=known)) if len(known) == len(extras) else None
