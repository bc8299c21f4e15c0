"""Labelled events: something unusual that is staged in a scenario and written down with its actors and times.

A script looks at how the scenario goes without it (``scene``), and proposes what an actor does, and when, so that an
ego that keeps its speed would meet it; ``threat`` tells what that asks of ego, and ``choosing`` takes what is sound.
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
