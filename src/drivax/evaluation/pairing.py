"""Pair the episodes of two planners by scenario, or split the scenarios between them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from drivax.errors import UsageError, did_you_mean
from drivax.evaluation.episode_table import NOT_SUMMARISED, EpisodeTable, ScenarioKey
from drivax.metrics.catalogue import METRICS
from drivax.seal import MARK
from drivax.stats.clusters import cluster_strata, dense_labels

#: Settings of an evaluation that must agree between paired episodes.
_START_SETTINGS = ("noisy_start", "start_step")
#: Minimum number of clusters of a stratum; smaller strata are merged.
_MIN_CLUSTERS = 10


@dataclass(frozen=True)
class Pairs:
    """The scenarios that several evaluations have in common, in the order of the first, and their clusters."""

    keys: tuple[ScenarioKey, ...]
    clusters: tuple[str, ...]

    @classmethod
    def of(cls, first: EpisodeTable, *others: EpisodeTable) -> Pairs:
        """Return the scenarios that all these evaluations contain."""
        cluster = dict(zip(first.scenarios, first.clusters, strict=True))
        other_scenarios = [set(other.scenarios) for other in others]
        keys = tuple(key for key in cluster if all(key in scenarios for scenarios in other_scenarios))
        return cls(keys, tuple(cluster[key] for key in keys))

    def values(self, table: EpisodeTable, metric: str) -> Float64[np.ndarray[Any, Any], " scenario"]:
        """Return a metric of one evaluation by scenario, averaged over repeated episodes; NaN if undefined."""
        means = table.by_scenario(metric)
        return np.array([means[key] for key in self.keys], np.float64)


def mismatch(a: EpisodeTable, b: EpisodeTable) -> tuple[str, str] | None:
    """Return problem and cure if the episodes of two runs cannot be paired, else None.

    Paired episodes need the same scenario set, traffic and start, as far as both runs record them. The seed of noisy
    starts may differ.
    """
    hashes = [str(run.data.get("hash") or "") for run in (a, b)]
    if all(hashes) and hashes[0] != hashes[1]:
        sets = f"{hashes[0][:12]} and {hashes[1][:12]}"
        return f"differ in scenario set ({sets})", "evaluate both with the same --data"
    if a.traffic != b.traffic:
        traffic = f"{a.traffic} and {b.traffic}"
        return f"differ in traffic ({traffic})", "evaluate both with the same --traffic"
    for name in _START_SETTINGS:
        values = [run.settings.get(name) for run in (a, b)]
        if None not in values and values[0] != values[1]:
            flag = f"--{name.replace('_', '-')}"
            return f"differ in {name} ({values[0]} and {values[1]})", f"evaluate both with the same {flag}"
    return None


def comparable(a: EpisodeTable, b: EpisodeTable) -> bool:
    """Return whether the episodes of two runs can be paired."""
    return mismatch(a, b) is None


def check_pairs(a: Sequence[EpisodeTable], b: Sequence[EpisodeTable]) -> None:
    """Check that the evaluations of A and B, one per training seed, can be paired.

    Raises:
        UsageError: A run occurs twice, a side contains several planners, or set, traffic or start differ.
    """
    tables = (*a, *b)
    runs = [id(table) if table.folder is None else table.folder.resolve() for table in tables]
    if duplicates := [table for index, table in enumerate(tables) if runs[index] in runs[:index]]:
        problem = "A and B are the same run" if len(tables) == 2 else "duplicate run"
        raise UsageError(problem, file=duplicates[0].folder, cure="name different runs")
    for side in (a, b):
        # A name ends with the seed's number and the checkpoint. Another checkpoint is another planner.
        names = [table.name.removesuffix(MARK) for table in side]
        planners = {re.sub(r"^(.*?)[0-9]*(@[0-9]+)?$", r"\1\2", name): name for name in names}
        if len(planners) > 1:
            problem = f"contains evaluations of several planners ({', '.join(sorted(planners.values()))})"
            folder = side[0].folder
            cure = "pass those of one planner" if folder is None else f"name one of them, as {folder}"
            raise UsageError(problem, file=folder and folder.parent, cure=cure)
    for table in tables[1:]:
        if problem := mismatch(tables[0], table):
            names = [run.folder or run.name for run in (tables[0], table)]
            raise UsageError(f"{names[0]} and {names[1]} {problem[0]}", cure=problem[1])


def check_metric(metric: str, tables: Sequence[EpisodeTable], *, primary: bool) -> None:
    """Check that a comparison can use a metric.

    Raises:
        UsageError: The metric is missing or has no meaningful mean, or is ``primary`` without a better direction.
    """
    for table in tables:
        if metric not in table.metrics:
            available = [name for name in table.metrics if all(name in other.metrics for other in tables)]
            problem = f"{table.folder or table.name} has no metric {metric!r}"
            raise UsageError(problem, cure=did_you_mean(metric, available))
    if metric in NOT_SUMMARISED:
        raise UsageError(f"{metric} is a code or count without a mean", cure="choose another metric")
    if metric in METRICS and metric.endswith("_partial"):
        problem = f"{metric} combines different inputs in different scenarios, so its mean has no meaning"
        raise UsageError(problem, cure=f"choose {metric.removesuffix('_partial')}, or one of its inputs")
    info = tables[0].metric(metric)
    if primary and (info is None or info.better == "-"):
        raise UsageError(f"{metric} has no better direction", cure="choose another primary metric")


def undefined_metric(metric: str, tables: Sequence[EpisodeTable], *, paired: bool) -> UsageError:
    """Return the error for a primary metric that is undefined in every pair, or throughout an arm of a split."""
    for table in tables:
        full, partial = (
            table.metrics.get(name, np.full(1, np.nan)) for name in (metric, f"{metric}_partial")
        )
        if np.isnan(full).all() and not np.isnan(partial).all():
            problem = f"every {metric} of {table.name} is partial: one of its inputs is undefined in these scenarios"
            return UsageError(problem, cure="choose another primary metric, for example success or accuracy")
    problem = f"{metric} is defined for A and B in no common scenario"
    if not paired:
        problem = f"{metric} is undefined in every scenario of A, or of B"
    return UsageError(problem, cure="choose another primary metric")


@dataclass(frozen=True)
class Split:
    """Assignment of scenarios to two arms; all scenarios of a recording are in the same arm.

    Attributes:
        first: Mask of the scenarios of the first arm.
        strata: Stratum of each scenario; 0 for all in a random split.
    """

    first: Bool[np.ndarray, " n"]
    strata: Int64[np.ndarray, " n"]

    @property
    def strata_count(self) -> int:
        """Number of strata."""
        return int(self.strata.max()) + 1


def strata_of(entries: Sequence[Mapping[str, Any]], tags: Sequence[str]) -> list[str]:
    """Return the stratum of each scenario (manifest entry): its values of ``tags``, joined by spaces.

    Raises:
        UsageError: A tag does not occur in any scenario.
    """
    known_tags = dict.fromkeys(name for entry in entries for name in entry["tags"])
    for tag in tags:
        if tag not in known_tags:
            raise UsageError(f"no scenario has a tag {tag!r}", cure=did_you_mean(tag, known_tags))
    return [" ".join(str(entry["tags"].get(tag, "unknown")) for tag in tags) for entry in entries]


def assign(clusters: Sequence[str], strata: Sequence[str] | None, ratio: float, seed: int) -> Split:
    """Randomly assign whole clusters to two arms; the first gets a share ``ratio`` of the clusters of each stratum.

    A cluster belongs to the most frequent stratum of its scenarios (of equally frequent ones, the first by name).
    Strata of fewer than ten clusters are merged. Rounding errors carry over to the next stratum.

    Raises:
        UsageError: An arm is empty.
    """
    labels = dense_labels(clusters, len(clusters), "cluster")
    count = int(labels.max()) + 1
    stratum_of = np.zeros(count, np.int64)
    if strata is not None:
        stratum_of = cluster_strata(_majority_strata(labels, strata), labels, _MIN_CLUSTERS)
    rng, in_first = np.random.default_rng(seed), np.zeros(count, bool)
    available = assigned = 0
    for stratum in range(int(stratum_of.max()) + 1):
        members = rng.permutation(np.flatnonzero(stratum_of == stratum))
        available += members.size
        quota = round(ratio * available) - assigned
        in_first[members[:quota]] = True
        assigned += quota
    if not in_first.any() or in_first.all():
        problem = f"{count} recordings at a ratio of {ratio} leave an arm empty"
        raise UsageError(problem, cure="use split: paired, or evaluate more scenarios")
    return Split(in_first[labels], stratum_of[labels])


def _majority_strata(labels: Int64[np.ndarray, " n"], strata: Sequence[str]) -> list[str]:
    """Return, for each scenario, the most frequent stratum of its cluster."""
    votes: dict[int, Counter[str]] = {}
    for label, stratum in zip(labels, strata, strict=True):
        votes.setdefault(int(label), Counter())[stratum] += 1
    majority = {label: min(counts, key=lambda name: (-counts[name], name)) for label, counts in votes.items()}
    return [majority[int(label)] for label in labels]
