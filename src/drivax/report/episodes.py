"""Drives of evaluations in the scenarios that they drove, for player and video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.errors import DataError
from drivax.evaluation.episode_table import ScenarioKey
from drivax.evaluation.traffic_trajectories import unpacked
from drivax.report.charts.motion import COMMANDED
from drivax.report.episode_selection import Choice, outcome
from drivax.report.loaded_runs import Evaluation
from drivax.report.pictures.episode import Drive
from drivax.scenario.schema import Scenario
from drivax.scenario.store import ScenarioSet


class DrivenSet:
    """The scenarios that an evaluation drove.

    Args:
        run: The evaluation.
        data: Where its scenario set is, if it has moved.

    Raises:
        DataError: It is not there, or another one is.
    """

    def __init__(self, run: Evaluation, data: Path | None = None) -> None:
        self.scenarios: ScenarioSet = run.open_set(data)
        self._rows = {
            (entry["dataset"], entry["scenario_id"]): row for row, entry in enumerate(self.scenarios.entries)
        }

    def scenario(self, key: ScenarioKey) -> Scenario:
        """A scenario by data set and id.

        Raises:
            DataError: It is not in the set.
        """
        row = self._rows.get(key)
        if row is None:
            raise DataError(
                "is not in the scenario set",
                file=self.scenarios.path,
                record=key[1],
                cure="pass the set that was evaluated with --data SET",
            )
        return self.scenarios[row]

    def tags(self) -> dict[ScenarioKey, Mapping[str, str]]:
        """The tags of every scenario."""
        return {key: self.scenarios.entries[row]["tags"] for key, row in self._rows.items()}


def drives_of(runs: Sequence[Evaluation], choice: Choice, scenario: Scenario) -> list[Drive]:
    """What each run that drove the chosen scenario did there."""
    rows = zip(runs, choice.rows, strict=True)
    return [_drive(run, place, scenario) for run, place in rows if place is not None]


def _drive(run: Evaluation, row: int, scenario: Scenario) -> Drive:
    stored = run.trajectories
    steps, start = int(scenario.steps), int(stored.start[row])
    ego = np.full((steps, 4), np.nan)
    ego[:start] = logged_drive(scenario)[:start]
    driven = stored.ego[row, : steps - start]
    ego[start : start + len(driven)] = driven
    events = {name: int(at[row]) for name, at in stored.events.items()}
    crashed = {(crash.dataset, crash.scenario_id): crash.step for crash in run.crashes}
    events["crashed"] = crashed.get(run.scenarios[row], -1)
    action, asked = np.full((steps, COMMANDED), np.nan), stored.action[row, : steps - start, :COMMANDED]
    action[start : start + len(asked), : asked.shape[1]] = asked
    others = None
    if stored.others is not None:
        others = np.full((steps, *stored.others.shape[2:]), np.nan, np.float32)
        others[start : start + len(driven)] = unpacked(stored.others[row, : steps - start])
    return Drive(run.name, ego, start, events, outcome(run, row), action, others)


def logged_drive(scenario: Scenario) -> Float[np.ndarray[Any, Any], "step 4"]:
    """The logged ego: position, heading, speed; NaN where it was not valid."""
    steps = int(scenario.steps)
    speed = np.linalg.norm(scenario.agent_velocity[:steps, 0], axis=-1)
    pose = np.column_stack((scenario.agent_xy[:steps, 0], scenario.agent_heading[:steps, 0], speed))
    return np.where(scenario.agent_valid[:steps, 0, None], pose, np.nan).astype(np.float64)
