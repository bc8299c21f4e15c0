"""Episodes that a report shows: the policy's failures first, each kind in turn, then some successes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivax.evaluation.stored import EpisodeTable, ScenarioKey, comparable
from drivax.report.runs import Evaluation

#: Kinds of failure, gravest first: (words, metric, value that means failure).
FAILURES = (
    ("planner crashed", "crashed", 1.0),
    ("at-fault collision", "at_fault_collision", 1.0),
    ("collision", "collision", 1.0),
    ("off-road", "offroad", 1.0),
    ("red light", "red_light", 1.0),
    ("left the map", "left_map", 1.0),
    ("goal not reached", "reached_goal", 0.0),
)
#: Share of successes among the shown episodes where there are enough failures.
_SUCCESS_SHARE = 0.25


@dataclass(frozen=True)
class EpisodeGroup:
    """The episodes of all runs in one scenario.

    Attributes:
        dataset, scenario_id: The scenario.
        rows: Episode of that scenario in each run, None where the run lacks it.
        outcome: Outcome of the policy: a kind of failure, or ``success``.
    """

    dataset: str
    scenario_id: str
    rows: tuple[int | None, ...]
    outcome: str

    @property
    def key(self) -> ScenarioKey:
        """The scenario."""
        return self.dataset, self.scenario_id


def outcome(run: EpisodeTable, row: int) -> str:
    """Return the gravest failure of an episode, ``success``, or ``unjudged`` where nothing is defined."""
    defined = False
    for words, metric, bad in FAILURES:
        value = _value(run, metric, row)
        defined |= not np.isnan(value)
        if value == bad:
            return words
    return "success" if defined else "unjudged"


def worst_first(run: Evaluation, others: Sequence[Evaluation] = ()) -> list[int]:
    """Return the rows of a run, worst episode first: by failure, then by score.

    Among equals those come first that more of the other runs completed without failure, then by scenario id.
    """
    order = [words for words, _, _ in FAILURES]
    rank = {words: place for place, words in enumerate([*order, "unjudged", "success"])}
    completed: Counter[ScenarioKey] = Counter()
    for other in others:
        if comparable(run, other):
            keys = enumerate(other.scenarios)
            completed.update({key for row, key in keys if outcome(other, row) == "success"})
    scenarios = run.scenarios

    def key(row: int) -> tuple[int, float, int, str, int]:
        score = _value(run, "vmax_score", row)
        known = 1.0 if np.isnan(score) else score
        return rank[outcome(run, row)], known, -completed[scenarios[row]], scenarios[row][1], row

    return sorted(range(run.episodes), key=key)


def choose(runs: Sequence[Evaluation], count: int) -> list[EpisodeGroup]:
    """Return episodes of the last run: failures of every kind in turn, worst score first, and some successes.

    Among equal failures those come first that another planner completed; among successes those where others failed.
    """
    kinds: dict[str, list[EpisodeGroup]] = {}
    for group in ranked(runs):
        kinds.setdefault(group.outcome, []).append(group)
    successes = sorted(
        kinds.pop("success", []), key=lambda group: (_completed(runs, group), group.scenario_id)
    )
    failures = _in_turn(list(kinds.values()))
    most = max(count - len(successes), count - round(_SUCCESS_SHARE * count))
    return (failures[:most] + successes[: count - min(most, len(failures))])[:count]


def _in_turn(kinds: list[list[EpisodeGroup]]) -> list[EpisodeGroup]:
    """Return the first of each kind, then the second of each, and so on."""
    longest = max(map(len, kinds), default=0)
    return [groups[place] for place in range(longest) for groups in kinds if place < len(groups)]


def _completed(runs: Sequence[Evaluation], group: EpisodeGroup) -> int:
    """Return the number of runs without a failure."""
    rows = zip(runs, group.rows, strict=True)
    return sum(outcome(run, row) == "success" for run, row in rows if row is not None)


def ranked(runs: Sequence[Evaluation]) -> list[EpisodeGroup]:
    """Return all scenarios of the last run with a stored trajectory, worst first."""
    policy = runs[-1]
    others = [_first_rows(run) if comparable(policy, run) else {} for run in runs[:-1]]
    groups = {
        row: EpisodeGroup(*key, (*(rows.get(key) for rows in others), row), outcome(policy, row))
        for key, row in _first_rows(policy).items()
    }
    return [groups[row] for row in worst_first(policy, runs[:-1]) if row in groups]


def _first_rows(run: Evaluation) -> dict[ScenarioKey, int]:
    """Return the first episode of each scenario with a stored trajectory."""
    rows: dict[ScenarioKey, int] = {}
    for row, (key, dataset) in enumerate(zip(run.occurrences, run.keys["dataset"], strict=True)):
        if key in run.trajectories.rows:
            rows.setdefault((dataset, key[0]), row)
    return rows


def _value(run: EpisodeTable, metric: str, row: int) -> float:
    """Return a metric of an episode; NaN where it is undefined or missing."""
    return float(run.metrics[metric][row]) if metric in run.metrics else float("nan")
