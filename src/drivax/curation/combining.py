"""From components to scores: their weighted mean at every step, and one score of every scenario."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from drivax.errors import UsageError, did_you_mean

Steps = Float[np.ndarray[Any, Any], "N T"]
Valid = Bool[np.ndarray[Any, Any], "N T"]
Scenarios = Float[np.ndarray[Any, Any], " N"]

_NUMBERED = re.compile(r"(p|top)(\d+)")


@dataclass(frozen=True)
class Combination:
    """How components become scores.

    Attributes:
        weights: Of each component that counts; not negative. What they are among each other counts, not their sum.
        scenario: How steps become the score of their scenario: ``max``, ``mean``, ``std``, ``p99`` (a percentile,
            any from p0 to p100) or ``top10`` (the mean of the ten largest, or of so many others). One for the combined
            score, or one for each component, whose results are then weighted.
    """

    weights: Mapping[str, float]
    scenario: str | Mapping[str, str] = "max"

    def __post_init__(self) -> None:
        for name, weight in self.weights.items():
            if not 0.0 <= weight < float("inf"):
                raise UsageError(f"the weight of {name!r} is {weight}", cure="use 0 or more")
        if not any(self.weights.values()):
            raise UsageError("no component has a weight", cure="give one a weight above 0")
        each = {"": self.scenario} if isinstance(self.scenario, str) else self.scenario
        for name in each.values():
            check_aggregator(name)
        if not isinstance(self.scenario, str):
            lacking = sorted(set(self.weights) - set(self.scenario))
            if lacking:
                raise UsageError(
                    f"there is no aggregator for {lacking[0]!r}", cure="name one for each component"
                )

    def check_components(self, there: Collection[str]) -> None:
        """Refuses to weigh or to aggregate what is not there.

        Raises:
            UsageError: A component that has a weight, or an aggregator of its own, is not there.
        """
        for name in (*self.weights, *(() if isinstance(self.scenario, str) else self.scenario)):
            if name not in there:
                raise UsageError(f"there is no component {name!r}", cure=did_you_mean(name, sorted(there)))

    def combine(self, components: Mapping[str, Steps], valid: Valid) -> tuple[Steps, Scenarios]:
        """Scores in [0, 1]: of every step the weighted mean of its components, and of every scenario.

        Steps that are not valid score 0, and count for no scenario.

        Raises:
            UsageError: A component that has a weight is not there.
        """
        self.check_components(components)
        shares = {name: weight / sum(self.weights.values()) for name, weight in self.weights.items()}
        steps = sum(share * components[name] for name, share in shares.items())
        # A mean of ones may be a rounding above 1.
        steps = np.where(valid, np.minimum(steps, 1.0), 0.0)
        if isinstance(self.scenario, str):
            return steps, aggregate(steps, valid, self.scenario)
        each = {name: aggregate(components[name], valid, self.scenario[name]) for name in shares}
        scenarios = sum((share * each[name] for name, share in shares.items()), np.zeros(len(steps)))
        return steps, np.minimum(scenarios, 1.0)


def check_aggregator(name: str) -> None:
    """Refuses what is no aggregator.

    Raises:
        UsageError: It is none.
    """
    found = _NUMBERED.fullmatch(name)
    known = name in ("max", "mean", "std") if found is None else _allowed(found[1], int(found[2]))
    if not known:
        raise UsageError(
            f"{name!r} aggregates no steps", cure="use max, mean, std, p0 to p100, or top1, top2, ..."
        )


def _allowed(kind: str, number: int) -> bool:
    return number <= 100 if kind == "p" else number >= 1


def aggregate(steps: Steps, valid: Valid, name: str) -> Scenarios:
    """One number of the valid steps of every scenario; 0 where it has none.

    ``pQ`` is the Q-th percentile, linear between the two nearest (NumPy's default); ``std`` that of the population.
    """
    check_aggregator(name)
    count = valid.sum(axis=1)
    some = np.maximum(count, 1)
    masked = np.where(valid, steps, 0.0)
    mean = masked.sum(axis=1) / some
    if name == "mean":
        return mean
    if name == "std":
        return np.sqrt(np.where(valid, (steps - mean[:, None]) ** 2, 0.0).sum(axis=1) / some)
    ordered = np.sort(np.where(valid, steps, np.inf), axis=1)
    ordered = np.where(np.isinf(ordered), 0.0, ordered)
    found = _NUMBERED.fullmatch(name)
    if found is not None and found[1] == "top":
        place = np.arange(steps.shape[1])
        largest = (place < count[:, None]) & (place >= count[:, None] - int(found[2]))
        return np.where(largest, ordered, 0.0).sum(axis=1) / np.maximum(largest.sum(axis=1), 1)
    at = (some - 1) * (1.0 if found is None else int(found[2]) / 100.0)
    low = np.floor(at).astype(int)
    high, row = np.minimum(low + 1, some - 1), np.arange(len(steps))
    part = at - low
    return ordered[row, low] * (1.0 - part) + ordered[row, high] * part
