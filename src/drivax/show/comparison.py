"""The numbers of a report: intervals per planner and metric, and paired differences between planners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivax.evaluation.results import interval_of
from drivax.evaluation.statistics import NOTHING, Interval, paired_bootstrap
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
    return interval_of(metric, run.metrics[metric], np.array(_clusters(run)))


def comparable(one: Evaluation, other: Evaluation) -> bool:
    """Whether two runs drove the same scenarios in the same traffic, so that their episodes can be paired."""
    hashes = {run.data.get("hash") for run in (one, other)} - {None}
    return len(hashes) <= 1 and one.traffic == other.traffic


def difference(run: Evaluation, other: Evaluation, metric: str) -> Difference:
    """Paired difference ``run - other`` of a metric; repeated episodes of a scenario are averaged first."""
    mine, theirs = _by_scenario(run, metric), _by_scenario(other, metric)
    shared = [key for key in mine if key in theirs]
    segments = dict(zip(_scenarios(run), _clusters(run), strict=True))
    interval = paired_bootstrap(
        [mine[key] for key in shared],
        [theirs[key] for key in shared],
        [segments[key] for key in shared],
        CONFIDENCE,
        seed=SEED,
    )
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


def _scenarios(run: Evaluation) -> list[tuple[str, str]]:
    return list(zip(run.keys["dataset"], run.keys["scenario_id"], strict=True))


def _clusters(run: Evaluation) -> list[str]:
    """Cluster of every episode: its segment, or its scenario where no segment is known."""
    keys = run.keys
    rows = zip(keys["dataset"], keys["segment"], keys["scenario_id"], strict=True)
    return [f"{dataset}/{segment or scenario}" for dataset, segment, scenario in rows]


def _by_scenario(run: Evaluation, metric: str) -> dict[tuple[str, str], float]:
    """Mean of a metric per scenario over its defined episodes; NaN where there is none."""
    values: Any = run.metrics.get(metric)
    gathered: dict[tuple[str, str], list[float]] = {}
    for row, key in enumerate(_scenarios(run)):
        cell = np.nan if values is None else float(values[row])
        gathered.setdefault(key, []).append(cell)
    means = {}
    for key, cells in gathered.items():
        defined = [cell for cell in cells if not np.isnan(cell)]
        means[key] = float(np.mean(defined)) if defined else np.nan
    return means
