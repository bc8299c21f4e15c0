"""Train, curate and judge driving planners on recorded traffic, in one JAX program.

Everything that the command line does can be done from here; names are imported when they are first used, so that
``import drivax`` stays fast and worker processes that convert data never load JAX.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drivax.api import evaluate, load, make_simulator
    from drivax.learning.loop import train
    from drivax.scenario.bank import ScenarioBank
    from drivax.scenario.store import ScenarioSet
    from drivax.tasks.task import Task

_HOMES = {
    "load": "drivax.api",
    "make_simulator": "drivax.api",
    "evaluate": "drivax.api",
    "train": "drivax.learning.loop",
    "ScenarioBank": "drivax.scenario.bank",
    "ScenarioSet": "drivax.scenario.store",
    "Task": "drivax.tasks.task",
}

__all__ = ["ScenarioBank", "ScenarioSet", "Task", "evaluate", "load", "make_simulator", "train"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'drivax' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
