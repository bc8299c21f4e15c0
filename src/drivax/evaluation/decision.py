"""What a comparison found in a metric, and the rule by which a plan decides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from drivax.evaluation.plan import ComparisonPlan
from drivax.stats.intervals import Interval
from drivax.stats.significance import Evidence

Arm = Literal["A", "B"]


@dataclass(frozen=True)
class Sensitivity:
    """What the data could have shown, whatever they did show; differences in the unit of the metric.

    Attributes:
        deviation: Standard deviation of the paired differences, or within the arms of a split.
        design_effect: How many times more scenarios are needed because recordings give several.
        smallest: The smallest difference that matters.
        power: Probability to find it with these scenarios.
        detectable: The difference that is found with the plan's power.
        needed: Scenarios that it takes to find the smallest difference with the plan's power; None where seeds differ
            so much that no number of them would do.
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
        metric: Its name.
        unit: ``-`` for shares, empty where unknown.
        better: ``high`` or ``low``; ``-`` where neither is.
        a, b: Means over the scenarios that count.
        difference: ``A - B``.
        effects: Cohen's d: ``d_z`` and ``d_av`` of pairs, ``d`` of a split.
        evidence: The test.
        p_adjusted: By Holm's method over the secondary metrics; the primary metric's own.
        winner: Which is better by the (adjusted) test; None if neither.
        seeds: The larger number of seeds of A and B.
        undefined_a, undefined_b: Scenarios of A, and of B, that are left out because its value is undefined.
    """

    metric: str
    unit: str
    better: str
    a: Interval
    b: Interval
    difference: Interval
    effects: Mapping[str, float | None]
    evidence: Evidence
    p_adjusted: float | None
    winner: Arm | None
    seeds: int
    undefined_a: int
    undefined_b: int


@dataclass(frozen=True)
class Decision:
    """What the plan's rule says.

    Attributes:
        recommendation: Which planner to take, that there is no difference, or that nothing can be said yet.
        because: Which part of the rule spoke.
        needed: Scenarios that are needed, where there are not enough.
        caveats: Secondary metrics in which the recommended planner is worse.
    """

    recommendation: Literal["A", "B", "no difference", "not enough scenarios"]
    because: Literal["test", "power", "minimum", "equal", "seeds"]
    needed: int | None
    caveats: tuple[str, ...]


def with_winner(plan: ComparisonPlan, comparison: MetricComparison, p: float | None) -> MetricComparison:
    """With its adjusted p-value, and the winner where that is small enough."""
    result = replace(comparison, p_adjusted=p)
    mean = comparison.difference.mean
    if comparison.better == "-" or not mean or p is None or p >= 1 - plan.confidence:
        return result
    return replace(result, winner="A" if (mean > 0) == (comparison.better == "high") else "B")


def decide(
    plan: ComparisonPlan,
    primary: MetricComparison,
    secondary: Sequence[MetricComparison],
    sensitivity: Sensitivity | None,
) -> Decision:
    """The rule: enough scenarios, then the test, then the power to say "no difference".

    With fewer scenarios than the plan's minimum nothing is decided. A test that rejects gives the better planner. One
    that does not means "no difference" only if the smallest difference that matters would have been found with the
    plan's power; otherwise there are not enough scenarios, or seeds, where these differ so much that no number of
    scenarios would do.
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
