"""Plan of a comparison, written before the comparison is run, and its decision rule."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from drivax.errors import UsageError
from drivax.stats.intervals import Interval
from drivax.stats.significance import SignificanceResult

Arm = Literal["A", "B"]


@dataclass(frozen=True)
class ComparisonPlan:
    """Metrics, split, tests and decision rule of a comparison, read from a YAML file.

    Attributes:
        name: Heading of the page.
        a, b: Run folders of ``drivax evaluate``, unless the command line names them.
        primary: The metric that decides.
        secondary: Further metrics to report; the primary metric is removed from them.
        split: ``paired`` compares on every common scenario; ``random`` and ``stratified`` give each planner its own
            scenarios.
        ratio: Share of the recordings for A in a split.
        strata: Tags that a stratified split balances between the arms.
        minimum_scenarios: Number of scenarios that a decision requires.
        confidence: Confidence level of intervals; tests reject if p is below 1 - confidence.
        power: Probability of detecting the smallest difference that matters, required for "no difference".
        smallest_difference: The smallest difference that matters, in the unit of the primary metric; null: a tenth of
            ``Sensitivity.deviation``.
        test: Test of mean paired differences: ``permutation``, or ``bootstrap`` if they are far from symmetric.
        resamples: Number of permutations and bootstrap samples; the interval of a single run's mean always has 10,000.
        seed: Seed of the split and of all resampling.
    """

    name: str = ""
    a: Path | None = None
    b: Path | None = None
    primary: str = "vmax_score"
    secondary: tuple[str, ...] = ("collision", "progress_ratio", "comfortable")
    split: Literal["paired", "random", "stratified"] = "paired"
    ratio: float = 0.5
    strata: tuple[str, ...] = ("difficulty", "type", "density")
    minimum_scenarios: int = 1000
    confidence: float = 0.95
    power: float = 0.80
    smallest_difference: float | None = None
    test: Literal["permutation", "bootstrap"] = "permutation"
    resamples: int = 10_000
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("ratio", "confidence", "power"):
            value = getattr(self, name)
            if not 0 < value < 1:
                raise UsageError(f"{name} is {value}", cure="use a number between 0 and 1")
        for name, least in (("minimum_scenarios", 2), ("resamples", 100), ("seed", 0)):
            if getattr(self, name) < least:
                raise UsageError(f"{name} is {getattr(self, name)}", cure=f"use {least} or more")
        if self.smallest_difference is not None and not 0 < self.smallest_difference < math.inf:
            problem = f"smallest_difference is {self.smallest_difference}"
            raise UsageError(problem, cure="use a number above 0, or null")
        if len(set(self.secondary)) < len(self.secondary):
            raise UsageError("duplicate secondary metric", cure="name each metric once")
        # The primary metric may be one of the default secondary ones.
        secondary = tuple(name for name in self.secondary if name != self.primary)
        object.__setattr__(self, "secondary", secondary)
        if self.split != "paired" and self.test == "bootstrap":
            cure = "use test: permutation, or split: paired"
            raise UsageError("the bootstrap test is for pairs", cure=cure)


@dataclass(frozen=True)
class Sensitivity:
    """Sensitivity of a comparison; differences are in the unit of the metric.

    Attributes:
        deviation: Standard deviation of the paired differences, or within the arms of a split.
        design_effect: Factor by which clustering in recordings increases the required number of scenarios.
        smallest: The smallest difference that matters.
        power: Probability of detecting ``smallest`` with these scenarios.
        detectable: The smallest difference that is detected with the plan's power; None if there is none.
        needed: Number of scenarios that detect ``smallest`` with the plan's power; None if seeds vary too much for any
            number.
    """

    deviation: float
    design_effect: float
    smallest: float
    power: float
    detectable: float | None
    needed: int | None


@dataclass(frozen=True)
class MetricComparison:
    """Comparison of two planners in one metric.

    Attributes:
        unit: ``-`` without a unit, empty if unknown.
        better: ``high``, ``low``, or ``-`` for neither.
        a, b, difference: Means over the included scenarios, and ``A - B``.
        effects: Cohen's d: ``d_z`` and ``d_av`` of pairs, ``d`` of a split.
        evidence: Result of the test.
        p_adjusted: p-value, for secondary metrics adjusted by Holm's method.
        winner: The better planner by the (adjusted) test; None if neither.
        seeds: The larger number of seeds of A and B.
        undefined_a, undefined_b: Numbers of scenarios excluded because the value of A, or of B, is undefined.
    """

    metric: str
    unit: str
    better: str
    a: Interval
    b: Interval
    difference: Interval
    effects: Mapping[str, float | None]
    evidence: SignificanceResult
    p_adjusted: float | None
    winner: Arm | None
    seeds: int
    undefined_a: int
    undefined_b: int

    def with_winner(self, plan: ComparisonPlan, p: float | None) -> MetricComparison:
        """Return the comparison with its adjusted p-value ``p``, and with the winner if the test rejects."""
        mean, winner = self.difference.mean, None
        if self.better != "-" and mean and p is not None and p < 1 - plan.confidence:
            winner = "A" if (mean > 0) == (self.better == "high") else "B"
        return replace(self, p_adjusted=p, winner=winner)


@dataclass(frozen=True)
class Decision:
    """Decision of a comparison.

    Attributes:
        recommendation: The planner to choose, no difference, or not enough scenarios to decide.
        because: The part of the rule that decided.
        needed: Required number of scenarios, more than there are; None unless more scenarios would allow a decision.
        caveats: Secondary metrics in which the recommended planner is worse.
    """

    recommendation: Literal["A", "B", "no difference", "not enough scenarios"]
    because: Literal["test", "power", "minimum", "equal", "seeds"]
    needed: int | None
    caveats: tuple[str, ...]


def decide(
    plan: ComparisonPlan, primary: MetricComparison, secondary: Sequence[MetricComparison],
    sensitivity: Sensitivity | None,
) -> Decision:  # fmt: skip
    """Decide by the rule: enough scenarios, then the test, then the power to conclude "no difference".

    With fewer scenarios than the plan's minimum, there is no decision. A test that rejects recommends the better
    planner. Otherwise the result is "no difference" if both planners have the same values in all seeds, or if the
    comparison had the plan's power to detect the smallest difference that matters. If it had not, there are not enough
    scenarios, or not enough seeds if no number of scenarios suffices.
    """
    n = primary.difference.n
    needed = max(plan.minimum_scenarios, 0 if sensitivity is None else sensitivity.needed or 0)
    if n < plan.minimum_scenarios:
        return Decision("not enough scenarios", "minimum", needed, ())
    if primary.winner is not None:
        caveats = tuple(metric.metric for metric in secondary if metric.winner not in (None, primary.winner))
        return Decision(primary.winner, "test", None, caveats)
    if sensitivity is None and primary.difference.mean == 0:
        return Decision("no difference", "equal", None, ())
    if sensitivity is not None and sensitivity.power >= plan.power:
        return Decision("no difference", "power", None, ())
    if sensitivity is not None and sensitivity.needed is None:
        return Decision("not enough scenarios", "seeds", None, ())
    # Without a sensitivity, or close to the required power, ``needed`` may not exceed the present number.
    return Decision("not enough scenarios", "power", max(needed, n + 1), ())
