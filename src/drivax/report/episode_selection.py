"""Which episodes a report shows: the policy's failures first, each kind in turn, then some successes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivax.evaluation.episode_table import EpisodeTable, ScenarioKey
from drivax.evaluation.pairing import comparable
from drivax.report.loaded_runs import Evaluation

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
#: Share of the shown episodes that successes get where there are failures enough.
_SUCCESS_SHARE = 0.25


@dataclass(frozen=True)
class Choice:
    """One episode to show.

    Attributes:
        dataset, scenario_id: The scenario.
        rows: Episode of that scenario in each run, None where the run lacks it.
        outcome: What happened to the policy: a kind of failure, or ``success``.
    """

    dataset: str
    scenario_id: str
    rows: tuple[int | None, ...]
    outcome: str


def outcome(run: EpisodeTable, row: int) -> str:
    """The gravest kind of failure of an episode, ``success``, or ``unjudged`` where nothing is defined."""
    judged = False
    for words, metric, bad in FAILURES:
        value = _value(run, metric, row)
        judged |= not np.isnan(value)
        if value == bad:
            return words
    return "success" if judged else "unjudged"


def worst_first(run: Evaluation, others: Sequence[Evaluation] = ()) -> list[int]:
    """Rows of a run, worst episode first: by how grave the failure is, then by score.

    Among equals those come first that more of the others drove without failure, then by scenario id.
    """
    order = [words for words, _, _ in FAILURES]
    rank = {words: place for place, words in enumerate([*order, "unjudged", "success"])}
    done: Counter[ScenarioKey] = Counter()
    for other in others:
        if comparable(run, other):
            done.update({key for row, key in enumerate(other.scenarios) if outcome(other, row) == "success"})
    scenarios = run.scenarios

    def key(row: int) -> tuple[int, float, int, str, int]:
        score = _value(run, "vmax_score", row)
        known = 1.0 if np.isnan(score) else score
        return rank[outcome(run, row)], known, -done[scenarios[row]], scenarios[row][1], row

    return sorted(range(len(run)), key=key)


def choose(runs: Sequence[Evaluation], count: int) -> list[Choice]:
    """Pick episodes of the last run: failures of every kind in turn, worst score first, and some successes.

    Among equally bad failures those come first that another planner drove well; among successes those where
    others failed, so that the picture tells planners apart.
    """
    groups: dict[str, list[Choice]] = {}
    for choice in ranked(runs):
        groups.setdefault(choice.outcome, []).append(choice)
    successes = sorted(groups.pop("success", []), key=lambda one: (_driven_well(runs, one), one.scenario_id))
    failures = _in_turn(list(groups.values()))
    wanted = max(count - len(successes), count - round(_SUCCESS_SHARE * count))
    picked = failures[:wanted] + successes[: count - min(wanted, len(failures))]
    return picked[:count]


def _in_turn(groups: list[list[Choice]]) -> list[Choice]:
    """One of each group, then the second of each, and so on."""
    longest = max(map(len, groups), default=0)
    return [group[place] for place in range(longest) for group in groups if place < len(group)]


def _driven_well(runs: Sequence[Evaluation], choice: Choice) -> int:
    """How many of the runs drove it without failure."""
    rows = zip(runs, choice.rows, strict=True)
    return sum(outcome(run, row) == "success" for run, row in rows if row is not None)


def ranked(runs: Sequence[Evaluation]) -> list[Choice]:
    """All scenarios of the last run whose drive is stored, worst first."""
    choices = {places[-1]: _choice(runs, places) for places in _places(runs)}
    return [choices[row] for row in worst_first(runs[-1], runs[:-1]) if row in choices]


def _choice(runs: Sequence[Evaluation], rows: tuple[int | None, ...]) -> Choice:
    policy, row = runs[-1], rows[-1] or 0
    keys = policy.keys
    return Choice(keys["dataset"][row], keys["scenario_id"][row], rows, outcome(policy, row))


def _places(runs: Sequence[Evaluation]) -> list[tuple[int | None, ...]]:
    """Row of every scenario of the last run in each run; None where a run lacks it or is not comparable."""
    policy = runs[-1]
    others = [_first_rows(run) if comparable(policy, run) else {} for run in runs[:-1]]
    return [(*(rows.get(key) for rows in others), row) for key, row in _first_rows(policy).items()]


def _first_rows(run: Evaluation) -> dict[tuple[str, str], int]:
    """(data set, scenario id) -> first episode of that scenario."""
    rows: dict[tuple[str, str], int] = {}
    for row, key in enumerate(run.scenarios):
        rows.setdefault(key, row)
    return rows


def _value(run: EpisodeTable, metric: str, row: int) -> float:
    """A metric of an episode; NaN where it is undefined or missing."""
    return float(run.metrics[metric][row]) if metric in run.metrics else float("nan")
