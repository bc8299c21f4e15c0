"""Planners by name."""

from __future__ import annotations

from collections.abc import Callable

from drivax.planners.idm import IdmPlanner
from drivax.planners.planner import Planner
from drivax.planners.search import SearchPlanner
from drivax.planners.simple import ConstantVelocity, Expert, RandomActions

PLANNERS: dict[str, Callable[[], Planner]] = {
    "expert": Expert,
    "expert_actions": lambda: Expert(replays=False),
    "constant_velocity": ConstantVelocity,
    "random": RandomActions,
    "idm": IdmPlanner,
    "search": SearchPlanner,
}


def make_planner(name: str) -> Planner:
    """The planner of a name, for the default action space.

    Raises:
        KeyError: If there is none.
    """
    return PLANNERS[name]()
