"""Rollouts of evaluations in their scenarios, for player and video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.errors import DataError
from drivax.evaluation.stored import ScenarioKey, open_driven_set
from drivax.evaluation.traffic_trajectories import unpacked
from drivax.report.charts.motion import COMMANDED
from drivax.report.episode_selection import EpisodeGroup, outcome
from drivax.report.pictures.drawing import Rollout
from drivax.report.runs import Evaluation
from drivax.scenario.schema import Scenario
from drivax.scenario.store import ScenarioSet


class EvaluatedSet:
    """The scenarios of an evaluation.

    Args:
        run: The evaluation.
        data: Path of its scenario set, if it has moved.

    Raises:
        DataError: The set is missing, or has another hash.
    """

    def __init__(self, run: Evaluation, data: Path | None = None) -> None:
        self.scenarios: ScenarioSet = open_driven_set(run, data)
        self._rows = {
            (entry["dataset"], entry["scenario_id"]): row for row, entry in enumerate(self.scenarios.entries)
        }

    def scenario(self, key: ScenarioKey) -> Scenario:
        """Return a scenario by data set and id.

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
        """Return the tags of every scenario."""
        return {key: self.scenarios.entries[row]["tags"] for key, row in self._rows.items()}


def rollouts_of(runs: Sequence[Evaluation], group: EpisodeGroup, scenario: Scenario) -> list[Rollout]:
    """Return the rollout of each run that has an episode in the group."""
    rows = zip(runs, group.rows, strict=True)
    return [_rollout(run, row, scenario) for run, row in rows if row is not None]


def _rollout(run: Evaluation, row: int, scenario: Scenario) -> Rollout:
    stored = run.trajectories
    place = stored.rows[run.occurrences[row]]
    steps, start = int(scenario.steps), int(stored.start[place])
    ego = np.full((steps, 4), np.nan)
    ego[:start] = logged_motion(scenario)[:start]
    motion = stored.ego[place, : steps - start]
    ego[start : start + len(motion)] = motion
    events = {name: int(at[place]) for name, at in stored.events.items()}
    events["crashed"] = run.crashes.get(run.scenarios[row], (-1, ""))[0]
    action = np.full((steps, COMMANDED), np.nan)
    commands = stored.action[place, : steps - start, :COMMANDED]
    action[start : start + len(commands), : commands.shape[1]] = commands
    others = None
    if stored.others is not None:
        others = np.full((steps, *stored.others.shape[2:]), np.nan, np.float32)
        others[start : start + len(motion)] = unpacked(stored.others[place, : steps - start])
    return Rollout(run.name, ego, start, events, outcome(run, row), action, others)


def logged_motion(scenario: Scenario) -> Float[np.ndarray[Any, Any], "step 4"]:
    """Return position, heading and speed of the logged ego; NaN where it is not valid."""
    steps = int(scenario.steps)
    speed = np.linalg.norm(scenario.agent_velocity[:steps, 0], axis=-1)
    pose = np.column_stack((scenario.agent_xy[:steps, 0], scenario.agent_heading[:steps, 0], speed))
    return np.where(scenario.agent_valid[:steps, 0, None], pose, np.nan).astype(np.float64)
