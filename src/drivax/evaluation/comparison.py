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
from drivax.files import path_end
from drivax.seal import MARK, mark_edited
from drivax.stats import effects, significance
from drivax.stats.clusters import design_effect, drop_undefined
from drivax.stats.intervals import Interval, interquartile_bootstrap, paired_bootstrap, split_bootstrap
from drivax.stats.seeds import CrossedEffect, difference_interval, seeds_interval
from drivax.stats.significance import SignificanceResult

#: Smallest difference that matters by default, in standard deviations.
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
        names, folders: Distinct names, and run folders, of A and B; with several seeds the parent of the first run.
        traffic: Traffic model of both.
        scenarios, recordings: Numbers of scenarios and recordings of A and of B, which are equal if paired.
        strata: Number of strata of the split; 1 without strata.
        sensitivity: Sensitivity of the primary metric; None if its differences (in a split: its values) do not vary, or
            if too few scenarios or recordings define it.
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
    """One planner: the evaluation of each seed, the common scenarios, and the mask of those in its arm."""

    tables: Sequence[EpisodeTable]
    pairs: Pairs
    arm: Bool[np.ndarray, " n"]

    def by_seed(self, metric: str) -> Float64[np.ndarray, "seed n"]:
        return np.stack([self.pairs.values(table, metric) for table in self.tables])

    def values(self, metric: str) -> Values:
        """Return the mean over seeds by scenario; NaN outside the arm, and if a seed has no defined value."""
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
        resampling = {"resamples": plan.resamples, "seed": plan.seed}
        interquartile = interquartile_bootstrap(values, self.pairs.clusters, plan.confidence, **resampling)
        return SeedSpread(means, interquartile)


@dataclass(frozen=True)
class _Contrast:
    """Two planners, and the split of the scenarios between them; None for pairs."""

    plan: ComparisonPlan
    a: _Side
    b: _Side
    split: Split | None

    @property
    def seeds(self) -> int:
        return max(len(self.a.tables), len(self.b.tables))

    @property
    def clusters(self) -> tuple[str, ...]:
        return self.a.pairs.clusters

    def compare(self, metric: str) -> MetricComparison:
        """Compare the planners in one metric; the winner is added later."""
        a, b = self.a.values(metric), self.b.values(metric)
        included = ~np.isnan(a) & ~np.isnan(b) if self.split is None else np.ones(a.size, bool)
        x, y = np.where(included, a, np.nan), np.where(included, b, np.nan)
        difference, evidence = self._test(metric, x, y)
        column = self.a.tables[0].metric(metric)
        return MetricComparison(
            metric=metric,
            unit="" if column is None else column.unit,
            better="-" if column is None else column.better,
            a=self.a.interval(self.plan, metric, included),
            b=self.b.interval(self.plan, metric, included),
            difference=difference,
            effects={"d": effects.cohens_d(x, y)} if self.split else asdict(effects.cohens_d_paired(x, y)),
            evidence=evidence,
            p_adjusted=None,
            winner=None,
            seeds=self.seeds,
            undefined_a=int((np.isnan(a) & self.a.arm).sum()),
            undefined_b=int((np.isnan(b) & self.b.arm).sum()),
        )

    def _test(self, metric: str, x: Values, y: Values) -> tuple[Interval, SignificanceResult]:
        """Return the difference of the means, and the result of its test, which is a t test with several seeds."""
        plan, split, clusters = self.plan, self.split, self.clusters
        resampling = {"confidence": plan.confidence, "resamples": plan.resamples, "seed": plan.seed}
        if split is not None:
            values, first = np.where(split.first, x, y), split.first
            difference = split_bootstrap(values, first, clusters, strata=split.strata, **resampling)
            test = significance.split_permutation
            return difference, test(values, first, clusters, split.strata, plan.resamples, seed=plan.seed)
        if self.seeds == 1:
            return paired_bootstrap(x, y, clusters, **resampling), self._paired_test(metric, x, y)
        difference, effect = self._seed_difference(metric)
        p, units = (None, 0) if effect is None else (effect.p, effect.clusters)
        return difference, SignificanceResult("t", p, units, exact=False)

    def _seed_difference(self, metric: str) -> tuple[Interval, CrossedEffect | None]:
        """Return the difference with an interval over seeds and recordings, and its crossed effect."""
        x, y = self.a.by_seed(metric), self.b.by_seed(metric)
        return difference_interval(x, y, self.clusters, self.plan.confidence)

    def _paired_test(self, metric: str, x: Values, y: Values) -> SignificanceResult:
        """Apply McNemar's test to rates of independent pairs, else the plan's test of means by recording."""
        _, labels = drop_undefined(x, self.clusters)
        independent = labels.size == 0 or int(labels.max()) + 1 == labels.size
        values = np.concatenate((x, y))
        if metric in RATES and independent and np.isin(values[~np.isnan(values)], (0.0, 1.0)).all():
            return significance.mcnemar_test(x, y)
        permutation = self.plan.test == "permutation"
        test = significance.paired_permutation if permutation else significance.paired_bootstrap_test
        return test(x, y, self.clusters, self.plan.resamples, seed=self.plan.seed)

    def sensitivity(self) -> Sensitivity | None:
        """Return the sensitivity in the primary metric (:class:`Comparison`)."""
        plan, split = self.plan, self.split
        x, y = self.a.values(plan.primary), self.b.values(plan.primary)
        if split is None:
            deviations, labels = drop_undefined(x - y, self.clusters)
            share, deviation = None, float(deviations.std(ddof=1)) if deviations.size > 1 else 0.0
        else:
            residuals = np.where(split.first, x - np.nanmean(x), y - np.nanmean(y))
            deviations, labels = drop_undefined(residuals, self.clusters)
            defined_a, defined_b = x[~np.isnan(x)], y[~np.isnan(y)]
            share = defined_a.size / deviations.size
            deviation = effects.pooled_deviation(defined_a, defined_b) if deviations.size > 2 else 0.0
        if deviations.size < 2:
            return None
        inflation = design_effect(deviations, labels)
        smallest = plan.smallest_difference or _SMALL_EFFECT * deviation
        if self.seeds > 1:
            return self._seed_sensitivity(deviations.size, deviation, inflation, smallest)
        if deviation <= effects.ROUNDING * max(np.nanmax(np.abs(x)), np.nanmax(np.abs(y))):
            return None
        effect, effective_n = smallest / deviation, deviations.size / inflation
        detectable_d = effects.detectable_effect(effective_n, plan.power, plan.confidence, share)
        needed = inflation * effects.scenarios_needed(effect, plan.power, plan.confidence, share)
        return Sensitivity(
            deviation=deviation,
            design_effect=inflation,
            smallest=smallest,
            power=effects.power(effect, effective_n, plan.confidence, share),
            detectable=None if detectable_d is None else detectable_d * deviation,
            needed=math.ceil(needed),
        )

    def _seed_sensitivity(
        self, n: int, deviation: float, inflation: float, smallest: float
    ) -> Sensitivity | None:
        """Return the sensitivity over seeds; more scenarios do not reduce the variance of seeds."""
        plan, effect = self.plan, self._seed_difference(self.plan.primary)[1]
        if effect is None or effect.standard_error == 0.0:
            return None
        power, needed = effect.power(smallest, plan.confidence), n
        if power < plan.power:
            clusters = replace(effect, difference=smallest).clusters_needed(plan.power, plan.confidence)
            needed = None if clusters is None else math.ceil(clusters * n / effect.clusters)
        detectable = effect.detectable(plan.power, plan.confidence)
        return Sensitivity(deviation, inflation, smallest, power, detectable, needed)


def compare(
    plan: ComparisonPlan, a: Sequence[EpisodeTable], b: Sequence[EpisodeTable],
    entries: Sequence[Mapping[str, Any]] = (),
) -> Comparison:  # fmt: skip
    """Compare two planners by a plan, given one evaluation for each of their seeds.

    ``entries`` are the manifest entries of the scenarios, which a stratified split needs.

    Raises:
        UsageError: The evaluations cannot be compared, or lack a metric of the plan.
    """
    pairing.check_pairs(a, b)
    for metric in (plan.primary, *plan.secondary):
        pairing.check_metric(metric, (*a, *b), primary=metric == plan.primary)
    pairs = Pairs.of(*a, *b)
    if not pairs.keys:
        raise UsageError("the runs have no scenario in common", cure="evaluate all on the same scenarios")
    if plan.split != "paired" and max(len(a), len(b)) > 1:
        raise UsageError("a split takes one evaluation of A and of B", cure="compare seeds in pairs")
    split = None if plan.split == "paired" else _split(plan, pairs, entries)
    all_scenarios = np.ones(len(pairs.keys), bool)
    arms = (all_scenarios, all_scenarios) if split is None else (split.first, ~split.first)
    sides = _Side(a, pairs, arms[0]), _Side(b, pairs, arms[1])
    contrast = _Contrast(plan, *sides, split)
    primary = contrast.compare(plan.primary)
    if min(primary.a.n, primary.b.n) == 0:
        raise pairing.undefined_metric(plan.primary, (*a, *b), paired=split is None)
    primary = primary.with_winner(plan, primary.evidence.p)
    results = [contrast.compare(metric) for metric in plan.secondary]
    adjusted_p = significance.holm_adjust([result.evidence.p for result in results])
    secondary = tuple(result.with_winner(plan, p) for result, p in zip(results, adjusted_p, strict=True))
    sensitivity = contrast.sensitivity()
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
    """Return distinct names of A and B: equal names are followed by the ends of their folders, or by A and B."""
    if a.name != b.name:
        return a.name, b.name
    if a.folder is None or b.folder is None or a.folder.resolve() == b.folder.resolve():
        return f"{a.name} (A)", f"{b.name} (B)"
    first, second = a.folder.resolve(), b.folder.resolve()
    return f"{a.name} ({path_end(first, [second])})", f"{b.name} ({path_end(second, [first])})"


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
