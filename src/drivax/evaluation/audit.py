"""The audit: a log replayed through the metrics. Whatever the expert does wrong is a defect of map or converter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from drivax.evaluation.results import Results
from drivax.evaluation.runner import BATCH, evaluate
from drivax.planners.simple import Expert
from drivax.scenario.bank import ScenarioBank
from drivax.scenario.schema import Flag, Scenario

Finding = dict[str, float | int | bool | None]


def scenario_names(scenarios: Sequence[Scenario]) -> list[dict[str, str]]:
    """``dataset``, ``scenario_id`` and ``segment`` of scenarios, as tables carry them."""
    return [
        {"dataset": _text(s, "dataset"), "scenario_id": s.id, "segment": _text(s, "segment")}
        for s in scenarios
    ]


def _text(scenario: Scenario, name: str) -> str:
    return bytes(scenario.record[name][()]).rstrip(b"\0").decode()


def audit(scenarios: Sequence[Scenario]) -> list[Finding]:
    """Replays the logs of scenarios exactly; test splits without a future get an empty finding."""
    usable = [scenario for scenario in scenarios if Flag.NO_FUTURE not in scenario.has]
    if not usable:
        return [{} for _ in scenarios]
    findings = iter(
        [row for first in range(0, len(usable), BATCH) for row in _replay(usable[first : first + BATCH])]
    )
    return [{} if Flag.NO_FUTURE in scenario.has else next(findings) for scenario in scenarios]


def _replay(scenarios: Sequence[Scenario]) -> list[Finding]:
    """Findings of one batch. It is filled up and not trimmed, so that one compiled program serves every batch."""
    filled = [*scenarios, *[scenarios[-1]] * (BATCH - len(scenarios))]
    bank = ScenarioBank.from_scenarios(filled, trim=False)
    return _findings(evaluate(Expert(), bank, scenario_names(filled)))[: len(scenarios)]


def _findings(results: Results) -> list[Finding]:
    steps = results.motion.shape[1] - 1
    rows: list[Finding] = []
    for number in range(len(results)):
        metric = {name: _number(values[number]) for name, values in results.metrics.items()}
        rows.append(
            {
                "log_collides": bool(metric["collision"]),
                "log_offroad_fraction": round(float(results.offroad_steps[number]) / steps, 4),
                "first_offroad_step": _step(results.events["offroad"][number]),
                "log_runs_red": None if metric["red_light"] is None else bool(metric["red_light"]),
                "distance_m": metric["distance"],
                "route_deviation_max_m": metric["route_deviation_max"],
                "reached_goal": None if metric["reached_goal"] is None else bool(metric["reached_goal"]),
                "ignored_overlaps": int(metric["ignored_overlaps"] or 0),
                "clean": None if metric["accuracy"] is None else bool(metric["accuracy"]),
            }
        )
    return rows


def _number(value: Any) -> float | None:
    return round(float(value), 3) if np.isfinite(value) else None


def _step(value: Any) -> int | None:
    return int(value) if value >= 0 else None
