"""Planners by name."""

from __future__ import annotations

from collections.abc import Callable

from drivax.errors import UsageError
from drivax.named import find_named, is_dotted
from drivax.planners.idm import IdmPlanner
from drivax.planners.pdm import PdmPlanner
from drivax.planners.planner import Planner
from drivax.planners.search import SearchPlanner
from drivax.planners.simple import ConstantVelocity, Expert, RandomActions

PLANNERS: dict[str, Callable[[], Planner]] = {
    "expert": Expert,
    "expert_actions": lambda: Expert(replays=False),
    "constant_velocity": ConstantVelocity,
    "random": RandomActions,
    "idm": IdmPlanner,
    "pdm": PdmPlanner,
    "search": SearchPlanner,
}


def make_planner(name: str) -> Planner:
    """The planner of a name, for the default action space.

    Args:
        name: One of :data:`PLANNERS`, or ``package.module:name`` of a planner of your own, or of what makes one.

    Raises:
        KeyError: If there is none.
        UsageError: If a dotted name leads to no planner.
    """
    if not is_dotted(name):
        return PLANNERS[name]()
    found = find_named(name)
    made = found if isinstance(found, Planner) and not isinstance(found, type) else None
    if made is None and callable(found):
        made = found()
    if not isinstance(made, Planner):
        raise UsageError(f"{name!r} makes no planner", cure="see drivax.planners.planner.Planner")
    return made
