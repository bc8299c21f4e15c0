"""Compare two planners: intervals, tests, power, and the decision of a plan.

The primary metric decides. The p-values of secondary metrics are adjusted for multiple testing. Differences are
``A - B``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from drivax import settings
from drivax.errors import UsageError
from drivax.evaluation import pairing
from drivax.evaluation.episode_table import RATES, SHARES, EpisodeTable, interval_of
from drivax.evaluation.pairing import Pairs, Split
from drivax.evaluation.plan import ComparisonPlan, Decision, MetricComparison, Sensitivity, decide
from drivax.seal import MARK, mark_edited
from drivax.stats import effects, significance
from drivax.stats.clusters import design_effect, drop_undefined
from drivax.stats.intervals import Interval, interquartile_bootstrap, paired_bootstrap, split_bootstrap
from drivax.stats.seeds import CrossedEffect, difference_interval, seeds_interval
from drivax.stats.significance import SignificanceResult

#: Default of the smallest difference that matters, as a share of the standard deviation.
_SMALL_EFFECT = 0.1
Values = Float64[np.ndarray, " n"]


@dataclass(frozen=True)
class SeedSpread:
    """Spread of the primary metric over the seeds of a policy.

    Attributes:
        means: Mean of each seed; None if no value is defined.
        interquartile: Interquartile mean; its interval resamples seeds and recordings.
    """

    means: tuple[float | None, ...]
    interquartile: Interval


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison.

    Attributes:
        names, folders: Names and run folders of A and B.
        traffic: Traffic model of both.
        scenarios, recordings: Numbers of scenarios and recordings of A and of B, which are the same if paired.
        strata: Number of strata of the split; 1 without strata.
        sensitivity: Sensitivity of the primary metric; None if the metric does not vary.
        seeds: Spread over seeds of A and B; None for a single seed.
    """

    plan: ComparisonPlan
    names: tuple[str, str]
    folders: tuple[Path | None, Path | None]
    traffic: str
    scenarios: tuple[int, int]
    recordings: tuple[int, int]
    strata: int
    primary: MetricComparison
    secondary: tuple[MetricComparison, ...]
    sensitivity: Sensitivity | None
    seeds: tuple[SeedSpread | None, SeedSpread | None]
    decision: Decision

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; undefined values are null."""
        folders = [None if folder is None else str(folder) for folder in self.folders]
        values = asdict(self) | {"plan": settings.plain(self.plan), "folders": folders}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


@dataclass(frozen=True)
class _Side:
    """One planner: the evaluation of each seed, and the mask of its common scenarios."""

    tables: Sequence[EpisodeTable]
    pairs: Pairs
    arm: Bool[np.ndarray, " n"]

    def by_seed(self, metric: str) -> Float64[np.ndarray, "seed n"]:
        return np.stack([self.pairs.values(table, metric) for table in self.tables])

    def values(self, metric: str) -> Values:
        """Return the mean over the seeds; NaN outside the arm, and if it is undefined for a seed."""
        return np.where(self.arm, self.by_seed(metric).mean(axis=0), np.nan)

    @property
    def folder(self) -> Path | None:
        folder = self.tables[0].folder
        return folder if folder is None or len(self.tables) == 1 else folder.parent

    @property
    def name(self) -> str:
        folder, names = self.folder, [table.name for table in self.tables]
        if folder is None or len(names) == 1:
            return names[0]
        return mark_edited(folder.name, any(name.endswith(MARK) for name in names))

    @property
    def recordings(self) -> int:
        return len({cluster for cluster, in_arm in zip(self.pairs.clusters, self.arm, strict=True) if in_arm})

    def interval(self, plan: ComparisonPlan, metric: str, included: Bool[np.ndarray, " n"]) -> Interval:
        """Return the mean and its interval over the included scenarios."""
        clusters = self.pairs.clusters
        if len(self.tables) == 1:
            values = np.where(included, self.values(metric), np.nan)
            return interval_of(metric, values, clusters, plan.confidence, plan.seed)
        by_seed = np.where(included, self.by_seed(metric), np.nan)
        return seeds_interval(by_seed, clusters, confidence=plan.confidence, share=metric in SHARES)

    def spread(self, plan: ComparisonPlan) -> SeedSpread | None:
        if len(self.tables) == 1:
            return None
        values = np.where(self.arm, self.by_seed(plan.primary), np.nan)
        defined = [seed_values[~np.isnan(seed_values)] for seed_values in values]
        means = tuple(float(seed_values.mean()) if seed_values.size else None for seed_values in defined)
        interquartile = interquartile_bootstrap(
            values, self.pairs.clusters, plan.confidence, plan.resamples, seed=plan.seed
        )
        return SeedSpread(means, interquartile)


def compare(
    plan: ComparisonPlan, a: Sequence[EpisodeTable], b: Sequence[EpisodeTable],
    entries: Sequence[Mapping[str, Any]] = (),
) -> Comparison:  # fmt: skip
    """Compare two planners by a plan, given an evaluation per seed of each.

    ``entries`` are the manifest entries of the scenarios, which a stratified split needs.

    Raises:
        UsageError: The evaluations cannot be compared, or lack a metric of the plan.
    """
    pairing.check_pairs(a, b)
    for metric in (plan.primary, *plan.secondary):
        pairing.check_metric(metric, (*a, *b), primary=metric == plan.primary)
    pairs = Pairs.of(*a, *b)
    if not pairs.keys:
        raise UsageError("A and B have no scenario in common", cure="evaluate both on the same scenarios")
    if plan.split != "paired" and max(len(a), len(b)) > 1:
        raise UsageError("a split takes one evaluation of A and of B", cure="compare seeds in pairs")
    split = None if plan.split == "paired" else _split(plan, pairs, entries)
    all_scenarios = np.ones(len(pairs.keys), bool)
    arms = (all_scenarios, all_scenarios) if split is None else (split.first, ~split.first)
    sides = _Side(a, pairs, arms[0]), _Side(b, pairs, arms[1])
    primary = _compare_metric(plan, plan.primary, sides, split)
    if min(primary.a.n, primary.b.n) == 0:
        raise pairing.undefined_metric(plan.primary, (*a, *b))
    primary = primary.with_winner(plan, primary.evidence.p)
    others = [_compare_metric(plan, metric, sides, split) for metric in plan.secondary]
    adjusted_p = significance.holm_adjust([other.evidence.p for other in others])
    secondary = tuple(other.with_winner(plan, p) for other, p in zip(others, adjusted_p, strict=True))
    sensitivity = _sensitivity(plan, sides, split)
    return Comparison(
        plan=plan,
        names=_names(*sides),
        folders=(sides[0].folder, sides[1].folder),
        traffic=a[0].traffic,
        scenarios=(int(arms[0].sum()), int(arms[1].sum())),
        recordings=(sides[0].recordings, sides[1].recordings),
        strata=1 if split is None else split.strata_count,
        primary=primary,
        secondary=secondary,
        sensitivity=sensitivity,
        seeds=(sides[0].spread(plan), sides[1].spread(plan)),
        decision=decide(plan, primary, secondary, sensitivity),
    )


def _names(a: _Side, b: _Side) -> tuple[str, str]:
    if a.name != b.name:
        return a.name, b.name
    labels = [side.folder.name if side.folder else arm for side, arm in ((a, "A"), (b, "B"))]
    return f"{a.name} ({labels[0]})", f"{b.name} ({labels[1]})"


def _split(plan: ComparisonPlan, pairs: Pairs, entries: Sequence[Mapping[str, Any]]) -> Split:
    strata = None
    if plan.split == "stratified":
        entry_by_key = {(entry["dataset"], entry["scenario_id"]): entry for entry in entries}
        missing = next((key for key in pairs.keys if key not in entry_by_key), None)
        if missing is not None:
            cure = "pass the set that was evaluated with --data"
            raise UsageError(f"stratum of scenario {missing[1]} is unknown", cure=cure)
        strata = pairing.strata_of([entry_by_key[key] for key in pairs.keys], plan.strata)
    return pairing.assign(pairs.clusters, strata, plan.ratio, plan.seed)


def _compare_metric(
    plan: ComparisonPlan, metric: str, sides: tuple[_Side, _Side], split: Split | None
) -> MetricComparison:
    """Compare the planners in one metric; the winner is added later."""
    x, y = (side.values(metric) for side in sides)
    pairs = zip((x, y), sides, strict=True)
    undefined = [int((np.isnan(values) & side.arm).sum()) for values, side in pairs]
    included = ~np.isnan(x) & ~np.isnan(y) if split is None else np.ones(x.size, bool)
    x, y = np.where(included, x, np.nan), np.where(included, y, np.nan)
    a, b = (side.interval(plan, metric, included) for side in sides)
    difference, evidence = _test_difference(plan, metric, sides, split, x, y)
    column = sides[0].tables[0].metric(metric)
    return MetricComparison(
        metric=metric,
        unit="" if column is None else column.unit,
        better="-" if column is None else column.better,
        a=a,
        b=b,
        difference=difference,
        effects={"d": effects.cohens_d(x, y)} if split else asdict(effects.cohens_d_paired(x, y)),
        evidence=evidence,
        p_adjusted=None,
        winner=None,
        seeds=max(len(side.tables) for side in sides),
        undefined_a=undefined[0],
        undefined_b=undefined[1],
    )


def _test_difference(
    plan: ComparisonPlan, metric: str, sides: tuple[_Side, _Side], split: Split | None, x: Values, y: Values
) -> tuple[Interval, SignificanceResult]:
    """Return the difference of the means, and its significance test."""
    clusters = sides[0].pairs.clusters
    resampling = {"confidence": plan.confidence, "resamples": plan.resamples, "seed": plan.seed}
    if split is not None:
        values, first = np.where(split.first, x, y), split.first
        difference = split_bootstrap(values, first, clusters, strata=split.strata, **resampling)
        test = significance.split_permutation
        return difference, test(values, first, clusters, split.strata, plan.resamples, seed=plan.seed)
    if max(len(side.tables) for side in sides) == 1:
        difference = paired_bootstrap(x, y, clusters, **resampling)
        return difference, _paired_test(plan, metric, x, y, clusters)
    difference, effect = _seed_difference(plan, metric, sides)
    p, units = (None, 0) if effect is None else (effect.p, effect.clusters)
    return difference, SignificanceResult("t", p, units, exact=False)


def _seed_difference(
    plan: ComparisonPlan, metric: str, sides: tuple[_Side, _Side]
) -> tuple[Interval, CrossedEffect | None]:
    """Return the difference with an interval over seeds and recordings, and its crossed effect."""
    x, y = (side.by_seed(metric) for side in sides)
    return difference_interval(x, y, sides[0].pairs.clusters, plan.confidence)


def _paired_test(
    plan: ComparisonPlan, metric: str, x: Values, y: Values, clusters: Sequence[str]
) -> SignificanceResult:
    """Apply McNemar's test to rates in independent pairs, otherwise the plan's test of means by recording."""
    _, labels = drop_undefined(x, clusters)
    independent = labels.size == 0 or int(labels.max()) + 1 == labels.size
    values = np.concatenate((x, y))
    if metric in RATES and independent and np.isin(values[~np.isnan(values)], (0.0, 1.0)).all():
        return significance.mcnemar_test(x, y)
    permutation = plan.test == "permutation"
    test = significance.paired_permutation if permutation else significance.paired_bootstrap_test
    return test(x, y, clusters, plan.resamples, seed=plan.seed)


def _sensitivity(plan: ComparisonPlan, sides: tuple[_Side, _Side], split: Split | None) -> Sensitivity | None:
    """Return the sensitivity of the comparison in the primary metric; None if the metric does not vary."""
    x, y = (side.values(plan.primary) for side in sides)
    if split is None:
        deviations, labels = drop_undefined(x - y, sides[0].pairs.clusters)
        share, deviation = None, float(deviations.std(ddof=1)) if deviations.size > 1 else 0.0
    else:
        residuals = np.where(split.first, x - np.nanmean(x), y - np.nanmean(y))
        deviations, labels = drop_undefined(residuals, sides[0].pairs.clusters)
        defined_a, defined_b = x[~np.isnan(x)], y[~np.isnan(y)]
        share = defined_a.size / deviations.size
        deviation = effects.pooled_deviation(defined_a, defined_b) if deviations.size > 2 else 0.0
    if deviations.size < 2:
        return None
    inflation = design_effect(deviations, labels)
    smallest = plan.smallest_difference or _SMALL_EFFECT * deviation
    if max(len(side.tables) for side in sides) > 1:
        crossed_effect = _seed_difference(plan, plan.primary, sides)[1]
        return _seed_sensitivity(plan, crossed_effect, deviations.size, deviation, inflation, smallest)
    if deviation <= effects.ROUNDING * max(np.nanmax(np.abs(x)), np.nanmax(np.abs(y))):
        return None
    effect, effective_n = smallest / deviation, deviations.size / inflation
    detectable_d = effects.detectable_effect(effective_n, plan.power, plan.confidence, share)
    return Sensitivity(
        deviation=deviation,
        design_effect=inflation,
        smallest=smallest,
        power=effects.power(effect, effective_n, plan.confidence, share),
        detectable=None if detectable_d is None else detectable_d * deviation,
        needed=math.ceil(inflation * effects.scenarios_needed(effect, plan.power, plan.confidence, share)),
    )


def _seed_sensitivity(
    plan: ComparisonPlan, effect: CrossedEffect | None, n: int, deviation: float, inflation: float,
    smallest: float,
) -> Sensitivity | None:  # fmt: skip
    """Return the sensitivity of a comparison over seeds; more scenarios do not reduce the variance of seeds."""
    if effect is None or effect.error == 0.0:
        return None
    power, needed = effect.power(smallest, plan.confidence), n
    if power < plan.power:
        clusters = replace(effect, difference=smallest).clusters_needed(plan.power, plan.confidence)
        needed = None if clusters is None else math.ceil(clusters * n / effect.clusters)
    detectable = effect.detectable(plan.power, plan.confidence)
    return Sensitivity(deviation, inflation, smallest, power, detectable, needed)
