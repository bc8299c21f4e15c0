"""Planners by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from drivax.errors import UsageError, did_you_mean
from drivax.planners.nuplan.planner import Host, NuplanPlanner, is_nuplan
from drivax.planners.pdm.planner import PdmPlanner
from drivax.planners.planner import Planner
from drivax.planners.simple import ConstantSpeed, ConstantVelocity, Expert, IdmPlanner, RandomActions
from drivax.plugins import check_arguments, find_named, is_dotted, makes, result_class
from drivax.tasks.actions import ActionSpace
from drivax.tasks.task import Task

PLANNERS: dict[str, Callable[[], Planner]] = {
    "expert": Expert,
    "expert_actions": lambda: Expert(replays=False),
    "constant_velocity": ConstantVelocity,
    "constant_speed": ConstantSpeed,
    "random": RandomActions,
    "idm": IdmPlanner,
    "pdm": PdmPlanner,
}


def make_planner(name: str, actions: ActionSpace | None = None) -> Planner:
    """Make a planner by its name in :data:`PLANNERS` or its dotted name ``package.module:name``.

    A dotted name leads to a planner, or to a class or function that returns one without arguments. ``actions`` replaces
    the field ``actions`` of the planner, and of a planner that it wraps, if they have one.

    Raises:
        UsageError: Unknown name, or the dotted name leads to no planner.
    """
    if not is_dotted(name) and name not in PLANNERS:
        raise UsageError(f"unknown planner {name!r}", cure=did_you_mean(name, PLANNERS))
    planner = as_planner(find_named(name), name) if is_dotted(name) else PLANNERS[name]()
    return planner if actions is None else _with_actions(planner, actions)


def _with_actions(planner: Any, actions: ActionSpace) -> Any:
    """Return a planner, and the planner in its field ``planner``, with another action space."""
    names = getattr(planner, "__dataclass_fields__", {})
    changes: dict[str, Any] = {"actions": actions} if "actions" in names else {}
    if "planner" in names:
        changes["planner"] = _with_actions(planner.planner, actions)
    return replace(planner, **changes) if changes else planner


def default_task(planner: Planner) -> Task:
    """Return the default task, with the action space of the planner, or of a planner that it wraps."""
    inner: Any = planner
    while not hasattr(inner, "actions") and isinstance(getattr(inner, "planner", None), Planner):
        inner = inner.planner
    return Task(actions=getattr(inner, "actions", Task().actions))


def as_planner(candidate: Any, name: str) -> Planner:
    """Return a user's planner: ``candidate`` itself, or the result of calling it without arguments.

    Adapts objects and classes with nuPlan's interface (:mod:`drivax.planners.nuplan`).

    Raises:
        UsageError: ``candidate`` is not a planner and does not make one; the message uses ``name``.
    """
    is_planner = not isinstance(candidate, type) and (is_nuplan(candidate) or isinstance(candidate, Planner))
    if callable(candidate) and not is_planner:
        try:
            check_arguments(candidate, name, ())
        except ValueError as error:
            cure = "put @drivax.python_planner or @drivax.jax_planner above a function that drives"
            if isinstance(candidate, type):
                cure = f"name a function that makes {name} without arguments"
            raise UsageError(str(error), cure=cure) from None
        if not is_nuplan(candidate) and (is_nuplan(result_class(candidate)) or makes(candidate, Planner)):
            candidate = candidate()
    return _adapt(candidate, name)


def _adapt(candidate: Any, name: str) -> Planner:
    """Wrap a planner with nuPlan's interface, and check any other."""
    if is_nuplan(candidate):
        return NuplanPlanner(Host(candidate, name))
    if not isinstance(candidate, Planner):
        raise UsageError(f"{name!r} makes no planner", cure="see drivax.planners.Planner")
    return candidate
