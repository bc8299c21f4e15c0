"""Combine components to step scores (weighted mean) and aggregate steps to scenario scores."""

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
        weights: Non-negative weight of each component; only their ratios matter.
        scenario: Aggregator of steps: ``max``, ``mean``, ``std``, ``p0`` to ``p100`` (percentile) or ``topN`` (mean of
            the N largest). A string aggregates the combined score; a mapping names an aggregator for each component,
            and the results are weighted.
    """

    weights: Mapping[str, float]
    scenario: str | Mapping[str, str] = "max"

    def __post_init__(self) -> None:
        for name, weight in self.weights.items():
            if not 0.0 <= weight < float("inf"):
                raise UsageError(f"the weight of {name!r} is {weight}", cure="use 0 or more")
        if not any(self.weights.values()):
            raise UsageError("no component has a weight", cure="give one a weight above 0")
        aggregators = {"": self.scenario} if isinstance(self.scenario, str) else self.scenario
        for name in aggregators.values():
            check_aggregator(name)
        if not isinstance(self.scenario, str):
            missing = sorted(set(self.weights) - set(self.scenario))
            if missing:
                raise UsageError(
                    f"there is no aggregator for {missing[0]!r}", cure="name one for each component"
                )

    def check_components(self, available: Collection[str]) -> None:
        """Refuse weights and aggregators of components that are not available."""
        for name in (*self.weights, *(() if isinstance(self.scenario, str) else self.scenario)):
            if name not in available:
                raise UsageError(
                    f"there is no component {name!r}", cure=did_you_mean(name, sorted(available))
                )

    def combine(self, components: Mapping[str, Steps], valid: Valid) -> tuple[Steps, Scenarios]:
        """Return the scores of steps and of scenarios, in [0, 1].

        Invalid steps score 0 and do not count for their scenario.

        Raises:
            UsageError: A component that has a weight is missing.
        """
        self.check_components(components)
        shares = {name: weight / sum(self.weights.values()) for name, weight in self.weights.items()}
        steps = sum(share * components[name] for name, share in shares.items())
        # A mean of ones may exceed 1 by rounding.
        steps = np.where(valid, np.minimum(steps, 1.0), 0.0)
        if isinstance(self.scenario, str):
            return steps, aggregate(steps, valid, self.scenario)
        each = {name: aggregate(components[name], valid, self.scenario[name]) for name in shares}
        scenarios = sum((share * each[name] for name, share in shares.items()), np.zeros(len(steps)))
        return steps, np.minimum(scenarios, 1.0)


def check_aggregator(name: str) -> None:
    """Refuse an unknown aggregator."""
    match = _NUMBERED.fullmatch(name)
    if match is None:
        known = name in ("max", "mean", "std")
    else:
        known = int(match[2]) <= 100 if match[1] == "p" else int(match[2]) >= 1
    if not known:
        raise UsageError(
            f"unknown aggregator {name!r}", cure="use max, mean, std, p0 to p100, or top1, top2, ..."
        )


def aggregate(steps: Steps, valid: Valid, name: str) -> Scenarios:
    """Aggregate the valid steps of every scenario; 0 where there are none.

    Percentiles interpolate linearly (NumPy's default); ``std`` is the population's.
    """
    check_aggregator(name)
    count = valid.sum(axis=1)
    divisor = np.maximum(count, 1)
    masked = np.where(valid, steps, 0.0)
    mean = masked.sum(axis=1) / divisor
    if name == "mean":
        return mean
    if name == "std":
        return np.sqrt(np.where(valid, (steps - mean[:, None]) ** 2, 0.0).sum(axis=1) / divisor)
    ordered = np.sort(np.where(valid, steps, np.inf), axis=1)
    ordered = np.where(np.isinf(ordered), 0.0, ordered)
    match = _NUMBERED.fullmatch(name)
    if match is not None and match[1] == "top":
        rank = np.arange(steps.shape[1])
        largest = (rank < count[:, None]) & (rank >= count[:, None] - int(match[2]))
        return np.where(largest, ordered, 0.0).sum(axis=1) / np.maximum(largest.sum(axis=1), 1)
    position = (divisor - 1) * (1.0 if match is None else int(match[2]) / 100.0)
    low = np.floor(position).astype(int)
    high, scenario = np.minimum(low + 1, divisor - 1), np.arange(len(steps))
    fraction = position - low
    return ordered[scenario, low] * (1.0 - fraction) + ordered[scenario, high] * fraction
