"""Compare two planners: a plan, written before the comparison is run, intervals, tests, power, and the decision.

The primary metric decides (:func:`decide`). The p-values of secondary metrics are adjusted for multiple testing.
Differences are ``A - B``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float64

from drivax import settings
from drivax.errors import UsageError
from drivax.evaluation import pairing
from drivax.evaluation.episode_table import RATES, SHARES, EpisodeTable, interval_of
from drivax.evaluation.pairing import Pairs, Split
from drivax.files import path_end
from drivax.seal import MARK, mark_edited
from drivax.stats import effects, significance
from drivax.stats.clusters import design_effect, drop_undefined
from drivax.stats.intervals import Interval, interquartile_bootstrap, paired_bootstrap, split_bootstrap
from drivax.stats.seeds import CrossedEffect, difference_interval, seeds_interval
from drivax.stats.significance import SignificanceResult

Arm = Literal["A", "B"]
#: Smallest difference that matters by default, in standard deviations.
_SMALL_EFFECT = 0.1
Values = Float64[np.ndarray, " n"]


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
