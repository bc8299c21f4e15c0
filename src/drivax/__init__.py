"""Train, curate and judge driving planners on recorded traffic, in one JAX program.

Everything that the command line does can be done from here; names are imported when they are first used, so that
``import drivax`` stays fast and worker processes that convert data never load JAX.
"""

from __future__ import annotations

import importlib
import os
from importlib import metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drivax.api import evaluate, load, make_simulator
    from drivax.learning.loop import train
    from drivax.planners.functions import jax_planner, python_planner
    from drivax.scenario.bank.scenario_bank import ScenarioBank
    from drivax.scenario.store import ScenarioSet
    from drivax.tasks.task import Task

_HOMES = {
    "load": "drivax.api",
    "make_simulator": "drivax.api",
    "evaluate": "drivax.api",
    "train": "drivax.learning.loop",
    "jax_planner": "drivax.planners.functions",
    "python_planner": "drivax.planners.functions",
    "ScenarioBank": "drivax.scenario.bank.scenario_bank",
    "ScenarioSet": "drivax.scenario.store",
    "Task": "drivax.tasks.task",
}

#: jaxlib 0.10's CPU client runs the parts of a program on a pool of threads, and in programs that train several agents
#: side by side one now and then is never woken up again (see also ``learning.devices``). Without its scheduler for
#: concurrency the parts run one after the other. XLA ends a process that gives a flag it does not know; so the version
#: counts.
_XLA_FLAG, _XLA_SERIES = "--xla_cpu_enable_concurrency_optimized_scheduler", "0.10."


def _avoid_the_hang() -> None:
    """Sets the flag, unless the user has; before JAX reads it, which is when its backend starts."""
    given = os.environ.get("XLA_FLAGS", "")
    try:
        known = metadata.version("jaxlib").startswith(_XLA_SERIES)
    except metadata.PackageNotFoundError:
        return
    if known and _XLA_FLAG not in given:
        os.environ["XLA_FLAGS"] = f"{given} {_XLA_FLAG}=false".strip()


_avoid_the_hang()

__all__ = [
    "ScenarioBank", "ScenarioSet", "Task", "evaluate", "jax_planner", "load", "make_simulator", "python_planner",
    "train",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'drivax' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
