"""The plan of a comparison, written before it is run, and the rule by which it decides."""

from __future__ import annotations

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
    """Metrics, split, tests and decision rule of a comparison, written as YAML before it is run.

    Attributes:
        name: Heading of the page.
        a, b: Run folders of ``drivax evaluate``; the command line may name them instead.
        primary: The metric that decides.
        secondary: Further metrics to report; the primary one is left out of them.
        split: ``paired`` compares on every common scenario; ``random`` and ``stratified`` give each planner its own
            scenarios.
        ratio: Share of the recordings that A gets in a split.
        strata: Tags by which a stratified split balances the arms.
        minimum_scenarios: With fewer, nothing is decided.
        confidence: Level of intervals; tests reject at 1 - confidence.
        power: Probability to detect the smallest difference that "no difference" requires.
        smallest_difference: The smallest difference that matters, in the unit of the primary metric; null: a tenth of
            the standard deviation.
        test: Test of means in pairs: ``permutation``, or ``bootstrap`` where differences are far from symmetric.
        resamples: Number of bootstraps and permutations.
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
        if self.minimum_scenarios < 2 or self.resamples < 100:
            raise UsageError(
                "too few scenarios or resamples", cure="use 2 scenarios and 100 resamples or more"
            )
        if self.smallest_difference is not None and not self.smallest_difference > 0:
            raise UsageError("the smallest difference that matters is above 0", cure="give its size, or null")
        if len(set(self.secondary)) < len(self.secondary):
            raise UsageError("a metric is named twice", cure="name each metric once")
        # So that the primary metric can be changed without changing the secondary ones.
        others = tuple(name for name in self.secondary if name != self.primary)
        object.__setattr__(self, "secondary", others)
        if self.split != "paired" and self.test == "bootstrap":
            cure = "use test: permutation, or split: paired"
            raise UsageError("the bootstrap test is for pairs", cure=cure)


@dataclass(frozen=True)
class Sensitivity:
    """Sensitivity of a comparison; differences are in the unit of the metric.

    Attributes:
        deviation: Standard deviation of the paired differences, or within the arms of a split.
        design_effect: Factor by which clustering in recordings increases the number of scenarios needed.
        smallest: The smallest difference that matters.
        power: Probability to detect it with these scenarios.
        detectable: The difference that is detected with the plan's power.
        needed: Scenarios needed to detect the smallest difference with the plan's power; None where seeds differ so
            much that no number suffices.
    """

    deviation: float
    design_effect: float
    smallest: float
    power: float
    detectable: float | None
    needed: int | None


@dataclass(frozen=True)
class MetricComparison:
    """One metric of both planners.

    Attributes:
        unit: ``-`` for shares, empty where unknown.
        better: ``high`` or ``low``; ``-`` where neither is.
        a, b, difference: Means over the scenarios that count, and ``A - B``.
        effects: Cohen's d: ``d_z`` and ``d_av`` of pairs, ``d`` of a split.
        evidence: The test.
        p_adjusted: By Holm's method over the secondary metrics; the primary metric's own.
        winner: Which is better by the (adjusted) test; None if neither.
        seeds: The larger number of seeds of A and B.
        undefined_a, undefined_b: Scenarios left out because the value of A, or of B, is undefined.
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
        """Return the comparison with its adjusted p-value, and the winner where that is small enough."""
        mean, winner = self.difference.mean, None
        if self.better != "-" and mean and p is not None and p < 1 - plan.confidence:
            winner = "A" if (mean > 0) == (self.better == "high") else "B"
        return replace(self, p_adjusted=p, winner=winner)


@dataclass(frozen=True)
class Decision:
    """Decision by the rule of a plan.

    Attributes:
        recommendation: The planner to take, no difference, or not enough scenarios to decide.
        because: The part of the rule that decided.
        needed: Number of scenarios needed, if there are too few.
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

    With fewer scenarios than the plan's minimum nothing is decided. A test that rejects gives the better planner. One
    that does not means "no difference" only if the smallest difference that matters would have been detected with the
    plan's power; otherwise there are not enough scenarios, or seeds, where no number of scenarios suffices.
    """
    n = primary.difference.n
    needed = max(plan.minimum_scenarios, 0 if sensitivity is None else sensitivity.needed or 0)
    if n < plan.minimum_scenarios:
        return Decision("not enough scenarios", "minimum", needed, ())
    if primary.winner is not None:
        worse = tuple(metric.metric for metric in secondary if metric.winner not in (None, primary.winner))
        return Decision(primary.winner, "test", None, worse)
    if sensitivity is None and primary.difference.mean == 0:
        return Decision("no difference", "equal", None, ())
    if sensitivity is not None and sensitivity.power >= plan.power:
        return Decision("no difference", "power", None, ())
    if sensitivity is not None and sensitivity.needed is None:
        return Decision("not enough scenarios", "seeds", None, ())
    return Decision("not enough scenarios", "power", max(needed, n + 1), ())
