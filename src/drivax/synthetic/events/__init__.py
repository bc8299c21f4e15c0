"""Labelled events: unusual situations that are staged in a scenario and stored with their actors and times.

A script reads the scenario without the event (``ego_view``) and proposes when an actor does what, so that an ego at
constant speed would collide; ``adversary`` computes what this requires of ego, ``choosing`` checks the proposals.
"""

from drivax.synthetic.events.adversary import threatens
from drivax.synthetic.events.choosing import SCRIPTS, aims, drawn_severity, possible, stage
from drivax.synthetic.events.ego_view import Scene
from drivax.synthetic.events.kinds import SEVERITY_MPS2, EventKind, EventScript, Proposal, Staged

__all__ = [
    "SCRIPTS",
    "SEVERITY_MPS2",
    "EventKind",
    "EventScript",
    "Proposal",
    "Scene",
    "Staged",
    "aims",
    "drawn_severity",
    "possible",
    "stage",
    "threatens",
]
