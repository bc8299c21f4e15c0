"""Closed-loop validation on held-out scenarios, and how checkpoints are compared by it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from drivax.errors import DrivaxError
from drivax.evaluation.audit import scenario_names
from drivax.evaluation.runner import evaluate
from drivax.planners.planner import Planner
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.simulator.types import Traffic
from drivax.tasks.task import Task

#: ``score``: the V-Max score. ``lexicographic``: fewest failures, then progress, then comfort. ``fitted_q``: what
#: fitted-Q evaluation expects of the policy, without driving.
Rule = Literal["score", "lexicographic", "fitted_q"]

_SCORES = ("vmax_score", "vmax_score_partial")
_METRICS = (
    "success", "accuracy", "accuracy_at_fault", "collision", "offroad", "red_light", "progress_ratio", "comfortable",
)  # fmt: skip
_ORDER = ("accuracy", "progress_ratio", "comfortable")


@dataclass(frozen=True)
class Validation:
    """Held-out scenarios that checkpoints are chosen by."""

    bank: ScenarioBank
    names: Sequence[Mapping[str, str]]

    @classmethod
    def of(cls, data: ScenarioSet) -> Validation:
        """From a scenario set."""
        scenarios = list(data)
        return cls(ScenarioBank.from_scenarios(scenarios), scenario_names(scenarios))


def validate(planner: Planner, validation: Validation, task: Task, traffic: Traffic) -> dict[str, float]:
    """What to log of a planner on held-out scenarios: ``validation/<metric>``, means over those that define it.

    Raises:
        DrivaxError: If its actions are not finite: learning has diverged.
    """
    results = evaluate(planner, validation.bank, validation.names, task=task, traffic=traffic)
    if results.crashes:
        raise DrivaxError(
            f"actions of the policy are not finite in {len(results.crashes)} of {len(results)} episodes",
            cure="lower the learning rate, or resume from an earlier checkpoint",
        )
    # Full scores where there are any; partial ones are never mixed with them.
    score = next(name for name in _SCORES if np.isfinite(results.metrics[name]).any())
    row = {}
    for name in (score, *_METRICS):
        values = results.metrics[name]
        if np.isfinite(values).any():
            row[f"validation/{name}"] = float(np.nanmean(values))
    return row


def rank(rule: Rule, row: Mapping[str, Any]) -> tuple[float, ...] | None:
    """What two checkpoints are compared by, higher is better: from a row of ``metrics.jsonl``.

    The lexicographic rule compares ``accuracy`` (the share of episodes without a failure) first; progress decides only
    between equal shares, comfort only between equal progress. What is undefined comes last.

    Returns:
        None where the row holds no validation.
    """
    seen = {
        name.removeprefix("validation/"): value
        for name, value in row.items()
        if name.startswith("validation/")
    }
    if not seen:
        return None
    if rule == "fitted_q":
        return (_or_last(seen["fitted_q"], -math.inf),)
    if rule == "score":
        return (float(next(seen[name] for name in _SCORES if name in seen)),)
    return tuple(_or_last(seen.get(name)) for name in _ORDER)


def _or_last(value: float | None, last: float = -1.0) -> float:
    return last if value is None or math.isnan(value) else float(value)
