"""The numbers of a report: intervals per planner and metric, and paired differences between planners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivax.evaluation.results import interval_of
from drivax.evaluation.statistics import NOTHING, Interval, paired_bootstrap
from drivax.evaluation.stored import Pairs
from drivax.show.glossary import note
from drivax.show.runs import Evaluation

CONFIDENCE = 0.95
SEED = 0


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


def summarise(run: Evaluation, metric: str) -> Interval:
    """Mean of a metric over the episodes of a run, with the interval that ``summary.json`` gives.

    Episodes of one segment form a cluster. A run without the metric gives an empty interval.
    """
    if metric not in run.metrics:
        return NOTHING
    return interval_of(metric, run.metrics[metric], np.array(run.clusters))


def difference(run: Evaluation, other: Evaluation, metric: str) -> Difference:
    """Paired difference ``run - other`` of a metric; repeated episodes of a scenario are averaged first."""
    pairs = Pairs.of(run, other)
    mine, theirs = pairs.values(run, metric), pairs.values(other, metric)
    interval = paired_bootstrap(mine, theirs, pairs.clusters, CONFIDENCE, seed=SEED)
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
