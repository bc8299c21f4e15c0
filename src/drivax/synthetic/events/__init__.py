"""Labelled events: something unusual that is staged in a scenario and written down with its actors and times.

A script looks at how the scenario goes without it (``scene``), and proposes what an actor does, and when, so that an
ego that keeps its speed would meet it; ``threat`` tells what that asks of ego, and ``choosing`` takes what is sound.
"""

from drivax.synthetic.events.choosing import SCRIPTS, possible, stage, stage_any
from drivax.synthetic.events.kinds import SEVERITY_MPS2, EventKind, EventScript, Proposal, Staged

__all__ = [
    "SCRIPTS",
    "SEVERITY_MPS2",
    "EventKind",
    "EventScript",
    "Proposal",
    "Staged",
    "possible",
    "stage",
    "stage_any",
]
