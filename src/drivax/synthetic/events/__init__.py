"""Labelled events: unusual situations that are staged in a scenario and stored with their actors and times.

A script reads the scenario without the event (``ego_view``) and proposes when an actor does what, so that an ego at
constant speed would collide; ``adversary`` computes what this requires of ego, ``choosing`` checks the proposals.
"""

from drivax.synthetic.events.adversary import endangers_ego
from drivax.synthetic.events.choosing import SCRIPTS, destinations_for, draw_severity, possible, stage
from drivax.synthetic.events.ego_view import EgoView
from drivax.synthetic.events.kinds import SEVERITY_MPS2, EventKind, EventScript, Proposal, StagedEvent

__all__ = [
    "SCRIPTS",
    "SEVERITY_MPS2",
    "EgoView",
    "EventKind",
    "EventScript",
    "Proposal",
    "StagedEvent",
    "destinations_for",
    "draw_severity",
    "endangers_ego",
    "possible",
    "stage",
]
