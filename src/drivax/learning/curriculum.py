"""Curricula: stages of a training run that differ in scenarios and in the weights of the reward.

A stage changes data of the compiled iteration only, so nothing is compiled again: the chances of scenarios, and factors
of reward terms. The stage follows from the logged rows, so a resumed run continues in the same one.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.checks import check_at_least
from drivax.errors import DataError, UsageError, did_you_mean
from drivax.scenario.select.selection import Selection

#: Logged values of an iteration by name; None where they were not finite.
LoggedValues = Mapping[str, float | None]


@dataclass(frozen=True)
class Advance:
    """When a stage ends before its budget: if a rollout metric passes a value.

    Attributes:
        metric: Name of a metric of rollouts (``rollout/<metric>`` in the log).
        above: The mean over the newest episodes must be at least this.
        episodes: Least number of these episodes.
    """

    metric: str = "success"
    above: float = 0.9
    episodes: int = 200

    def __post_init__(self) -> None:
        check_at_least(self, 1, "episodes")


@dataclass(frozen=True)
class Stage:
    """A stage of a curriculum.

    Attributes:
        name: Name for the log.
        steps: Budget in environment steps; the last stage takes all that remain.
        filters: Conditions on scenarios (``agents<=8``, ``type=turn_left|turn_right``); new episodes begin in those
            that meet all of them.
        reward_scale: Factor of all reward terms.
        rewards: Further factors of single terms, at the beginning of the stage.
        rewards_at_end: Factors at the end of its budget, between which they change linearly; terms that are missing
            keep their factor.
        advance: When the stage ends early; None: never.
    """

    name: str
    steps: int
    filters: tuple[str, ...] = ()
    reward_scale: float = 1.0
    rewards: dict[str, float] = field(default_factory=dict)
    rewards_at_end: dict[str, float] = field(default_factory=dict)
    advance: Advance | None = None

    def __post_init__(self) -> None:
        check_at_least(self, 1, "steps")
        Selection.parse(self.filters)
        for value in (self.reward_scale, *self.rewards.values(), *self.rewards_at_end.values()):
            if not math.isfinite(value):
                problem = f"stage {self.name!r}: a factor of the reward is {value}"
                raise UsageError(problem, cure="use a finite number")

    def factors(self, share: float, terms: Iterable[str]) -> dict[str, float]:
        """Return the factor of each reward term when a share of the budget is done."""
        share = min(max(share, 0.0), 1.0)
        result = {}
        for term in terms:
            first = self.rewards.get(term, 1.0)
            last = self.rewards_at_end.get(term, first)
            result[term] = self.reward_scale * ((1.0 - share) * first + share * last)
        return result


def mean_rollout(rows: Sequence[LoggedValues]) -> dict[str, float]:
    """Return the metrics of rollouts of several seeds as those of all their episodes together."""
    sums, totals = defaultdict[str, float](float), defaultdict[str, float](float)
    for row in rows:
        # Values that are not finite are None in the log.
        finite = {name: value for name, value in row.items() if value is not None and math.isfinite(value)}
        count = finite.pop("rollout/episodes", 0.0)
        totals["rollout/episodes"] += count
        for name, value in finite.items():
            if name.startswith("rollout/"):
                sums[name] += value * count
                totals[name] += count
    means = {name: value / totals[name] for name, value in sums.items() if totals[name] > 0}
    return {"rollout/episodes": totals["rollout/episodes"], **means}


class Curriculum:
    """The stages of a run, and its position in them.

    Args:
        stages: The stages in order.
        entries: Manifest entries of the scenarios to train on.
        terms: Names of the reward terms.
        metrics: Names of the metrics of rollouts.
        steps_per_iteration: Environment steps of an iteration.

    Raises:
        UsageError: A stage names an unknown reward term or metric.
        DataError: No scenario meets the filters of a stage.
    """

    def __init__(
        self, stages: Sequence[Stage], entries: Sequence[Mapping[str, Any]], terms: Collection[str],
        metrics: Collection[str], steps_per_iteration: int,
    ) -> None:  # fmt: skip
        self.stages, self.terms, self._steps_per_iteration = stages, sorted(terms), steps_per_iteration
        self.number, self._done = 0, 0
        self._newest: deque[tuple[float, float]] = deque()
        self._shares = []
        for stage in stages:
            names = [("reward term", term, self.terms) for term in (*stage.rewards, *stage.rewards_at_end)]
            if stage.advance is not None:
                names.append(("metric of rollouts", stage.advance.metric, sorted(metrics)))
            for kind, name, known in names:
                if name not in known:
                    problem = f"stage {stage.name!r}: unknown {kind} {name!r}"
                    raise UsageError(problem, cure=did_you_mean(name, known))
            mask = np.zeros(len(entries))
            mask[Selection.parse(stage.filters).rows(entries)] = 1.0
            if not mask.any():
                problem = f"stage {stage.name!r}: no scenario to train on meets {' and '.join(stage.filters)}"
                raise DataError(problem, cure="use fewer or weaker filters, or other scenarios")
            self._shares.append(mask)

    @property
    def stage(self) -> Stage:
        """The present stage."""
        return self.stages[self.number]

    @property
    def scenarios(self) -> Float[np.ndarray, " N"]:
        """1 for scenarios of the present stage, 0 for others."""
        return self._shares[self.number]

    @property
    def factors(self) -> dict[str, float]:
        """Present factors of the reward terms."""
        return self.stage.factors(self._done / self.stage.steps, self.terms)

    def text(self) -> str:
        """Return a line for the log about the present stage."""
        count = int(self.scenarios.sum())
        return f"stage {self.number + 1} of {len(self.stages)}, {self.stage.name}: {count:,} scenarios"

    def log(self, row: LoggedValues) -> None:
        """Move on by an iteration, given its log."""
        self._done += self._steps_per_iteration
        if self.number + 1 < len(self.stages) and (self._done >= self.stage.steps or self._passes(row)):
            self.number, self._done = self.number + 1, 0
            self._newest.clear()

    def _passes(self, row: LoggedValues) -> bool:
        """Return whether the metric passes over the newest iterations with enough episodes."""
        advance = self.stage.advance
        if advance is None:
            return False
        value, episodes = row.get(f"rollout/{advance.metric}"), row.get("rollout/episodes") or 0.0
        if value is not None and episodes > 0:
            self._newest.append((value, episodes))
        total = sum(count for _, count in self._newest)
        while total - (self._newest[0][1] if self._newest else 0.0) >= advance.episodes:
            total -= self._newest.popleft()[1]
        if total < advance.episodes:
            return False
        return sum(value * count for value, count in self._newest) / total >= advance.above
