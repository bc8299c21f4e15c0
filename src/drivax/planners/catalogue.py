"""Planners by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from drivax.errors import UsageError
from drivax.planners.pdm.planner import PdmPlanner
from drivax.planners.planner import Planner
from drivax.planners.simple import ConstantVelocity, Expert, IdmPlanner, RandomActions
from drivax.plugins import check_arguments, find_named, is_dotted
from drivax.tasks.actions import ActionSpace

PLANNERS: dict[str, Callable[[], Planner]] = {
    "expert": Expert,
    "expert_actions": lambda: Expert(replays=False),
    "constant_velocity": ConstantVelocity,
    "random": RandomActions,
    "idm": IdmPlanner,
    "pdm": PdmPlanner,
}


def make_planner(name: str, actions: ActionSpace | None = None) -> Planner:
    """Return the planner of a name in :data:`PLANNERS`, or of ``package.module:name`` (a planner or what makes one).

    ``actions`` replaces the planner's own action space, if it has one.

    Raises:
        KeyError: Unknown name.
        UsageError: A dotted name leads to no planner.
    """
    planner = as_planner(find_named(name), name) if is_dotted(name) else PLANNERS[name]()
    return replace(planner, actions=actions) if actions and hasattr(planner, "actions") else planner  # type: ignore


def as_planner(thing: Any, name: str) -> Planner:
    """Return a planner of the user's: ``thing`` itself, or what its class or function makes without arguments.

    Raises:
        UsageError: It is no planner and makes none; the message uses ``name``.
    """
    if isinstance(thing, Planner) and not isinstance(thing, type):
        return thing
    if callable(thing):
        try:
            check_arguments(thing, name, ())
        except ValueError as error:
            cure = "put @drivax.python_planner or @drivax.jax_planner above a function that drives"
            raise UsageError(str(error), cure=cure) from None
        thing = thing()
    if not isinstance(thing, Planner):
        raise UsageError(f"{name!r} makes no planner", cure="see drivax.planners.planner.Planner")
    return thing
