"""Episodes that a report shows: their selection (failures first), scenarios and rollouts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.errors import DataError
from drivax.evaluation.episode_table import EpisodeTable, ScenarioKey, Tags
from drivax.evaluation.pairing import comparable
from drivax.evaluation.rollout import unpack_poses
from drivax.report.charts import COMMANDS
from drivax.report.pictures.drawing import Rollout
from drivax.scenario.schema import Scenario
from drivax.scenario.store import ScenarioSet

#: Kinds of failure, most severe first: (name, metric, value that means failure).
FAILURES = (
    ("planner crashed", "crashed", 1.0),
    ("at-fault collision", "at_fault_collision", 1.0),
    ("collision", "collision", 1.0),
    ("off-road", "offroad", 1.0),
    ("red light", "red_light", 1.0),
    ("left the map", "left_map", 1.0),
    ("goal not reached", "reached_goal", 0.0),
)
#: Least share of successes among the shown episodes, rounded to whole episodes, if there are enough.
_MIN_SUCCESS_SHARE = 0.25


@dataclass(frozen=True)
class EpisodeGroup:
    """The episodes of all runs in one scenario.

    ``rows`` has a row of each run's table, or None if the run has no episode or is not comparable with the policy, the
    last run. ``outcome`` is that of the policy's episode (:func:`outcome`).
    """

    dataset: str
    scenario_id: str
    rows: tuple[int | None, ...]
    outcome: str

    @property
    def key(self) -> ScenarioKey:
        """Data set and id of the scenario."""
        return self.dataset, self.scenario_id


def outcome(run: EpisodeTable, row: int) -> str:
    """Return the most severe failure of an episode, ``success`` without one, or ``unjudged``.

    An episode is unjudged if no metric of :data:`FAILURES` is defined.
    """
    any_defined = False
    for name, metric, failure_value in FAILURES:
        value = _metric_value(run, metric, row)
        any_defined |= not np.isnan(value)
        if value == failure_value:
            return name
    return "success" if any_defined else "unjudged"


def sort_worst_first(run: EpisodeTable, others: Sequence[EpisodeTable] = ()) -> list[int]:
    """Return the rows of a run, worst episode first: by failure, unjudged, success; then by ``vmax_score``.

    An undefined score counts as 1. Ties are broken by the number of comparable ``others`` that succeed, the largest
    first, then by scenario id.
    """
    order = (*(name for name, _, _ in FAILURES), "unjudged", "success")
    rank = {name: index for index, name in enumerate(order)}
    success_count: Counter[ScenarioKey] = Counter()
    for other in others:
        if comparable(run, other):
            episodes = enumerate(other.scenarios)
            success_count.update({key for row, key in episodes if outcome(other, row) == "success"})
    scenarios = run.scenarios

    def sort_key(row: int) -> tuple[int, float, int, str, int]:
        score = _metric_value(run, "vmax_score", row)
        sort_score = 1.0 if np.isnan(score) else score
        return rank[outcome(run, row)], sort_score, -success_count[scenarios[row]], scenarios[row][1], row

    return sorted(range(len(run)), key=sort_key)


def choose(runs: Sequence[EpisodeTable], count: int) -> list[EpisodeGroup]:
    """Choose at most ``count`` episodes of the last run: failures, each kind in turn and worst first, then successes.

    Unjudged episodes count as a kind of failure. At least a quarter (rounded) are successes if there are enough. Among
    equal failures, those where other planners succeed come first; among successes, those where they fail.
    """
    kinds: dict[str, list[EpisodeGroup]] = {}
    for group in rank_scenarios(runs):
        kinds.setdefault(group.outcome, []).append(group)
    successes = kinds.pop("success", [])
    successes.sort(key=lambda group: (_count_successes(runs, group), group.scenario_id))
    rounds = zip_longest(*kinds.values())  # the first of each kind, then the second of each, and so on
    failures = [group for groups in rounds for group in groups if group is not None]
    failures = failures[: max(count - len(successes), count - round(_MIN_SUCCESS_SHARE * count))]
    return failures + successes[: count - len(failures)]


def _count_successes(runs: Sequence[EpisodeTable], group: EpisodeGroup) -> int:
    """Return the number of runs that succeed in a scenario."""
    episodes = zip(runs, group.rows, strict=True)
    return sum(outcome(run, row) == "success" for run, row in episodes if row is not None)


def rank_scenarios(runs: Sequence[EpisodeTable]) -> list[EpisodeGroup]:
    """Return the first episode of every run in each scenario of the last run, worst scenario first."""
    policy = runs[-1]
    others = [_first_rows(run) if comparable(policy, run) else {} for run in runs[:-1]]
    groups = {
        row: EpisodeGroup(*key, (*(rows.get(key) for rows in others), row), outcome(policy, row))
        for key, row in _first_rows(policy).items()
    }
    return [groups[row] for row in sort_worst_first(policy, runs[:-1]) if row in groups]


def _first_rows(run: EpisodeTable) -> dict[ScenarioKey, int]:
    """Return the row of the first episode of each scenario."""
    rows: dict[ScenarioKey, int] = {}
    for row, key in enumerate(run.scenarios):
        rows.setdefault(key, row)
    return rows


def _metric_value(run: EpisodeTable, metric: str, row: int) -> float:
    """Return a metric of an episode; NaN where it is undefined or missing."""
    return float(run.metrics[metric][row]) if metric in run.metrics else float("nan")


class EvaluatedSet:
    """The scenarios of an evaluation, opened by :meth:`EpisodeTable.open_set`."""

    def __init__(self, run: EpisodeTable, data: Path | None = None) -> None:
        self.scenarios: ScenarioSet = run.open_set(data)
        keys = [(entry["dataset"], entry["scenario_id"]) for entry in self.scenarios.entries]
        self._rows = {key: row for row, key in enumerate(keys)}

    def scenario(self, key: ScenarioKey) -> Scenario:
        """Return a scenario by data set and id.

        Raises:
            DataError: The scenario is not in the set.
        """
        if key not in self._rows:
            cure = "pass the set that was evaluated with --data SET"
            raise DataError("is not in the scenario set", file=self.scenarios.path, record=key[1], cure=cure)
        return self.scenarios[self._rows[key]]

    def tags(self) -> Tags:
        """Return the tags of every scenario."""
        return {key: self.scenarios.entries[row]["tags"] for key, row in self._rows.items()}


def rollouts_of(runs: Sequence[EpisodeTable], group: EpisodeGroup, scenario: Scenario) -> list[Rollout]:
    """Return the rollout of each run that has an episode in the group."""
    episodes = zip(runs, group.rows, strict=True)
    return [_rollout(run, row, scenario) for run, row in episodes if row is not None]


def _rollout(run: EpisodeTable, row: int, scenario: Scenario) -> Rollout:
    """Return an episode as steps of the scenario: as logged before its start, NaN after its end."""
    trajectories = run.trajectories
    steps, start = int(scenario.steps), trajectories.begin(row, scenario)
    ego = np.full((steps, 4), np.nan)
    ego[:start] = logged_motion(scenario)[:start]
    motion = trajectories.ego[row, : steps - start]
    ego[start : start + len(motion)] = motion
    events = {name: int(first_step[row]) for name, first_step in trajectories.events.items()}
    crash = run.crash_by_scenario.get(run.scenarios[row])
    events["crashed"] = -1 if crash is None else crash.step
    action = np.full((steps, len(COMMANDS)), np.nan)
    commands = trajectories.action[row, : steps - start, : len(COMMANDS)]
    action[start : start + len(commands), : commands.shape[1]] = commands
    others = None
    if trajectories.others is not None:
        others = np.full((steps, *trajectories.others.shape[2:]), np.nan, np.float32)
        others[start : start + len(motion)] = unpack_poses(trajectories.others[row, : steps - start])
    return Rollout(run.name, ego, start, events, outcome(run, row), action, others)


def logged_motion(scenario: Scenario) -> Float[np.ndarray[Any, Any], "step 4"]:
    """Return position [m], heading [rad] and speed [m/s] of the logged ego at every step; NaN where it is not valid."""
    steps = int(scenario.steps)
    speed = np.linalg.norm(scenario.agent_velocity[:steps, 0], axis=-1)
    pose = np.column_stack((scenario.agent_xy[:steps, 0], scenario.agent_heading[:steps, 0], speed))
    return np.where(scenario.agent_valid[:steps, 0, None], pose, np.nan).astype(np.float64)
