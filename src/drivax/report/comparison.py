"""What paired differences between planners say, and which metrics runs have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from drivax.evaluation.tables import paired_difference
from drivax.report.glossary import note
from drivax.report.loaded_runs import Evaluation
from drivax.stats.intervals import Interval


@dataclass(frozen=True)
class Difference:
    """A metric of one planner minus another's, over the scenarios that both drove.

    Attributes:
        metric: Name of the metric.
        against: Name of the other planner.
        interval: Mean difference with its interval and the number of pairs.
        verdict: ``better``, ``worse``, ``unclear`` (the interval holds 0), ``same`` (no pair differs in the end) or
            ``none`` (no direction, no interval).
    """

    metric: str
    against: str
    interval: Interval
    verdict: str


def difference(run: Evaluation, other: Evaluation, metric: str) -> Difference:
    """Paired difference ``run - other`` of a metric, and what it says."""
    interval = paired_difference(run, other, metric)
    return Difference(metric, other.name, interval, _verdict(interval, note(metric, [run]).better))


def metric_names(runs: Sequence[Evaluation]) -> list[str]:
    """Metrics of all runs, each once, in the order of first appearance."""
    return list(dict.fromkeys(name for run in runs for name in run.metrics))


def _verdict(interval: Interval, better: str) -> str:
    low, high = interval.low, interval.high
    if better == "none" or low is None or high is None:
        return "none"
    if low == high == 0:
        return "same"
    if low <= 0 <= high:
        return "unclear"
    return "better" if (low > 0) == (better == "up") else "worse"
