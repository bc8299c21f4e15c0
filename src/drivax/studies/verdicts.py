"""Statistics of a study: conditions, rates, differences between arms, and a verdict on each claim."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from drivax.curation.methods import ORACLES
from drivax.curation.scores import ScoreTable, top_rows
from drivax.evaluation.episode_table import SHARES
from drivax.metrics.catalogue import METRICS
from drivax.stats.ranking import correlation_interval, rank_correlation
from drivax.stats.seeds import CrossedEffect, crossed_difference, crossed_mean, log_ratio, seeds_interval
from drivax.stats.significance import holm_adjust
from drivax.studies.definition import Claim, Stratum

#: Rankings are unrelated if their correlation's interval is within ±UNRELATED, related if it is beyond ±RELATED.
UNRELATED, RELATED = 0.1, 0.3
#: Share of the scenarios that count as a method's most critical.
_TOP = 0.05
#: Significance level.
_LEVEL = 0.05
#: Metrics whose intervals are kept within 0 and 1.
_SHARES = (*SHARES, "progress_ratio")

Values = Float[np.ndarray, "seed scenario"]
#: Values of an arm by metric; arms may have different numbers of seeds.
Episodes = Mapping[str, Float[np.ndarray, "_ scenario"]]
Weights = Float[np.ndarray, " scenario"]
Verdict = Literal["supported", "contradicted", "undecided"]
#: Values of a driver by speed limiter (share of the speed limit; 1: none) and metric, a row per seed.
BySpeed = Mapping[float, Episodes]


@dataclass(frozen=True)
class Strata:
    """Recordings and rarity of the test scenarios.

    Attributes:
        recordings: Recording of every scenario; scenarios of one recording are dependent.
        rare: Mask of the rare scenarios.
        share: Share of rare scenarios in ordinary traffic; None if it equals that of the test set.
    """

    recordings: Sequence[str]
    rare: Bool[np.ndarray, " scenario"]
    share: float | None = None

    def weights(self, stratum: Stratum) -> Weights:
        """Return the weight of every scenario.

        Args:
            stratum: ``common`` or ``rare``: these scenarios have weight 1. ``ordinary``: rare and common scenarios have
                the total weights of their shares of ordinary traffic, which may differ from those of the test set.
        """
        if stratum != "ordinary":
            return (self.rare if stratum == "rare" else ~self.rare).astype(np.float64)
        if self.share is None or self.rare.all() or not self.rare.any():
            return np.ones(len(self.rare))
        return np.where(self.rare, self.share / self.rare.sum(), (1.0 - self.share) / (~self.rare).sum())

    def is_comparable(self, values: Values, weights: Weights) -> bool:
        """Return whether two recordings or more have scenarios with positive weight and defined values."""
        labels = np.asarray(self.recordings)
        return np.unique(labels[(weights > 0.0) & ~np.isnan(values).any(axis=0)]).size > 1


@dataclass(frozen=True)
class ValidationCheck:
    """Check of an arm on the validation set; those of the baselines decide whether arms are compared.

    ``results.json`` stores the fields by name.

    Attributes:
        arm: Name of the arm.
        progress: Share of the expert's progress on the validation set at the best checkpoints, mean over seeds.
        least: Progress of the worst seed.
        change: Change of the validation score from the third to the last quarter of the validations, mean over seeds.
        moved: Mean over seeds of the absolute value of that change.
        met: Whether every seed makes enough progress, and scores have converged.
    """

    arm: str
    progress: float
    least: float
    change: float
    moved: float
    met: bool

    @classmethod
    def of(
        cls, arm: str, curves: Sequence[Mapping[str, Sequence[float]]], min_progress: float, max_change: float
    ) -> ValidationCheck:
        """Return the check of an arm from ``score`` and ``progress`` at the validations of every seed."""
        progress, changes = [], []
        for curve in curves:
            scores = np.asarray(curve["score"])
            quarter = max(len(scores) // 4, 1)
            progress.append(curve["progress"][best_validation(scores)])
            changes.append(scores[-quarter:].mean() - scores[-2 * quarter : -quarter].mean())
        mean_change, absolute_change = float(np.mean(changes)), float(np.abs(changes).mean())
        met = bool(min(progress) >= min_progress and absolute_change <= max_change)
        return cls(arm, float(np.mean(progress)), min(progress), mean_change, absolute_change, met)

    def __str__(self) -> str:
        return (
            f"{self.arm}: {self.progress:.0%} of the expert's progress (worst seed {self.least:.0%}), score changes by "
            f"{self.change:+.3f} (absolute {self.moved:.3f}): {'good enough' if self.met else 'NOT good enough'}"
        )


def best_validation(scores: Sequence[float] | Float[np.ndarray, " validation"]) -> int:
    """Return the index of the highest score, the latest if several are equal: that of the best checkpoint."""
    return len(scores) - 1 - int(np.argmax(scores[::-1]))


@dataclass(frozen=True)
class ClaimResult:
    """A claim and its verdict.

    Attributes:
        claim: The claim.
        effect: The effect to test against 0: the difference; for a claim with a margin, the difference shifted by it;
            for a claimed size, the log ratio minus its claimed value. None if fewer than two recordings define the
            metric, progress cannot be made equal, nothing varies (with a margin), or a claimed size has no ratio (a
            mean is not positive).
        difference: Arm minus reference; None if fewer than two recordings define the metric.
        change: Relative change and its interval; None if undefined.
        adjusted_p: P-value adjusted within the group (Holm).
        verdict: The verdict.
        needed: What would decide an undecided claim if the estimated effect is true, or why it cannot be tested.
        slower_arm: For a claim at equal progress, the arm that drives slower, and its speed limiter.
    """

    claim: Claim
    effect: CrossedEffect | None
    difference: CrossedEffect | None
    change: tuple[float, float, float] | None
    adjusted_p: float | None
    verdict: Verdict = "undecided"
    needed: str = ""
    slower_arm: tuple[str, float] | None = None

    def plain(self) -> dict[str, Any]:
        """Return plain values for ``results.json``."""
        difference = self.difference
        return {
            "claim": vars(self.claim),
            "verdict": self.verdict,
            "needed": self.needed,
            "difference": None if difference is None else difference.difference,
            "interval": None if difference is None else list(difference.interval()),
            "p": None if self.effect is None else self.effect.p,
            "adjusted": self.adjusted_p,
            "change": None if self.change is None else list(self.change),
            "slower_arm": None if self.slower_arm is None else list(self.slower_arm),
        }


def decide_claims(
    claims: Sequence[Claim], episodes: Mapping[str, Episodes], strata: Strata,
    slower: Mapping[str, Mapping[float, Episodes]] | None = None,
) -> list[ClaimResult]:  # fmt: skip
    """Test every claim on the values of all arms, with p-values adjusted within its group (Holm).

    ``slower`` has the values of arms with a speed limiter, by its share, for claims at equal progress.
    """
    results = [_effects(claim, episodes, strata, slower or {}) for claim in claims]
    groups = [claim.group for claim in claims]
    for group in set(groups):
        members = [index for index, name in enumerate(groups) if name == group]
        effects = [results[index].effect for index in members]
        adjusted_ps = holm_adjust([None if effect is None else effect.p for effect in effects])
        tests = sum(effect is not None for effect in effects)
        for index, p in zip(members, adjusted_ps, strict=True):
            results[index] = _decide(replace(results[index], adjusted_p=p), tests)
    return results


def _effects(
    claim: Claim, episodes: Mapping[str, Episodes], strata: Strata,
    slower: Mapping[str, Mapping[float, Episodes]],
) -> ClaimResult:  # fmt: skip
    """Return the effects of a claim, without a verdict."""
    weights, names = strata.weights(claim.rows), (claim.arm, claim.reference)
    arm, reference = (episodes[name][claim.metric] for name in names)
    result = ClaimResult(claim, None, None, None, None)
    if claim.at_equal_progress:
        first, second = ({1.0: episodes[name], **slower[name]} for name in names)
        try:
            matched = match_progress(first, second, claim.metric, weights)
        except ProgressError as error:
            return replace(
                result, needed=f"{names[error.faster]} makes more progress even at its lowest speed"
            )
        arm, reference = matched.values
        result = replace(result, slower_arm=(names[matched.slower], matched.share))
    if not strata.is_comparable(np.concatenate([arm, reference]), weights):
        return result
    difference = crossed_difference(arm, reference, strata.recordings, weights)
    ratio = log_ratio(arm, reference, strata.recordings, weights)
    result = replace(result, difference=difference, effect=difference)
    if claim.margin is not None:
        if difference.standard_error == 0.0:
            return replace(result, effect=None, needed="nothing varies: no error to compare the margin with")
        sign = -1.0 if METRICS[claim.metric].better == "low" else 1.0
        shifted = replace(difference, difference=difference.difference + sign * claim.margin)
        result = replace(result, effect=shifted)
    if ratio is None:
        return result if claim.change is None else replace(result, effect=None)
    if claim.change is not None:
        relative = replace(ratio, difference=ratio.difference - math.log1p(claim.change))
        result = replace(result, effect=relative)
    low, high = map(math.expm1, ratio.interval())
    return replace(result, change=(math.expm1(ratio.difference), low, high))


def _decide(result: ClaimResult, tests: int) -> ClaimResult:
    """Return the result with its verdict; its group has ``tests`` claims that can be tested."""
    if result.effect is None or result.adjusted_p is None:
        needed = result.needed or "fewer than two recordings define it"
        if result.difference is not None and not result.needed:
            needed = "the mean of an arm is not positive: no ratio"
        return replace(result, needed=needed)
    if result.adjusted_p >= _LEVEL:
        return replace(result, needed=describe_sample_size(result.effect, tests))
    lower_is_better = METRICS[result.claim.metric].better == "low"
    is_better = (result.effect.difference < 0) == lower_is_better
    return replace(result, verdict="supported" if is_better else "contradicted")


def describe_sample_size(effect: CrossedEffect, claims: int) -> str:
    """Describe the seeds or recordings that would decide a claim, at the strictest level among ``claims`` claims."""
    confidence = confidence_level(claims)
    seeds = effect.seeds_needed(confidence=confidence)
    recordings = effect.clusters_needed(confidence=confidence)
    numbers = [f"{seeds:,} seeds each"] if seeds is not None else []
    numbers += [f"{recordings:,} test recordings"] if recordings is not None else []
    if numbers:
        return " or ".join(numbers) + " would decide"
    return "neither seeds nor recordings alone would decide"


def confidence_level(claims: int) -> float:
    """Return the confidence level of Holm's first and strictest test among a number of claims."""
    return 1.0 - _LEVEL / claims


def detectable_differences(
    first: Episodes, second: Episodes, strata: Strata, metrics: Sequence[str], claims: int
) -> dict[str, float]:
    """Estimate the smallest differences in ordinary traffic that the study detects with a power of 80 %.

    Assumes that the seeds of every arm vary like those of the ``first`` baseline, and that arms differ by scenario like
    the two baselines. ``claims`` claims are adjusted together. Metrics that are undefined in the test are skipped.
    """
    weights, differences = strata.weights("ordinary"), {}
    for name in metrics:
        if strata.is_comparable(np.concatenate([first[name], second[name]]), weights):
            effect = crossed_difference(first[name], second[name], strata.recordings, weights)
            (seeds, _), (interaction, _) = effect.seeds, effect.interaction
            equal_arms = replace(effect, seeds=(seeds, seeds), interaction=(interaction, interaction))
            differences[name] = equal_arms.detectable(confidence=confidence_level(claims))
    return differences


def rates(
    episodes: Episodes, strata: Strata, metrics: Sequence[str]
) -> dict[Stratum, dict[str, dict[str, float | int | None]]]:
    """Return an arm's mean over seeds and scenarios with its interval, by stratum and metric.

    Skips metrics that are defined in fewer than two recordings.
    """
    means: dict[Stratum, dict[str, dict[str, float | int | None]]] = {}
    for stratum in ("ordinary", "common", "rare"):
        weights = strata.weights(stratum)
        names = [name for name in metrics if strata.is_comparable(episodes[name], weights)]
        if names:
            means[stratum] = {name: _rate(episodes[name], strata, weights, name in _SHARES) for name in names}
    return means


def rates_of_groups(
    episodes: Episodes, strata: Strata, groups: Mapping[str, Bool[np.ndarray, " scenario"]], metric: str
) -> dict[str, dict[str, float | int | None]]:
    """Return an arm's mean of a metric with its interval, by group of scenarios.

    ``groups`` has a mask per group. Skips groups in which the metric is defined in fewer than two recordings.
    """
    weights = {name: mask.astype(np.float64) for name, mask in groups.items()}
    return {
        name: _rate(episodes[metric], strata, weight, metric in _SHARES)
        for name, weight in weights.items()
        if strata.is_comparable(episodes[metric], weight)
    }


def _rate(values: Values, strata: Strata, weights: Weights, is_share: bool) -> dict[str, float | int | None]:
    """Return mean and interval; ``is_share`` keeps the interval in [0, 1]."""
    interval = seeds_interval(values, strata.recordings, weights, share=is_share).as_dict()
    return {"scenarios" if name == "n" else name: value for name, value in interval.items()}


def rule_cost(
    rule: Episodes, best: Episodes, strata: Strata, metrics: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Return the cost of another checkpoint rule in ordinary traffic: paired differences by metric.

    ``rule`` has the values of every seed at the rule's checkpoint, ``best`` those at the best checkpoint.
    """
    weights, costs = strata.weights("ordinary"), {}
    for name in metrics:
        differences = rule[name] - best[name]
        if strata.is_comparable(differences, weights):
            effect = crossed_mean(differences, strata.recordings, weights)
            costs[name] = {"difference": effect.difference, "interval": list(effect.interval())}
    return costs


def compare_rankings(tables: Mapping[str, ScoreTable], recordings: Sequence[str]) -> list[dict[str, Any]]:
    """Compare rankings of scenarios by two methods: rank correlation, overlap of the top 5 %, and a verdict.

    Leaves out ``uniform`` and labels. ``recordings`` has the recording of every scenario; the interval resamples
    recordings. The correlation is None if a method gives all scenarios the same score.
    """
    pairs = []
    for first, second in combinations([name for name in tables if name not in ("uniform", *ORACLES)], 2):
        scores, other_scores = (tables[name].scenarios for name in (first, second))
        count = max(round(_TOP * len(scores)), 1)
        top_sets = [set(top_rows(tables[name], count)) for name in (first, second)]
        rho = rank_correlation(scores, other_scores)
        low, high = correlation_interval(scores, other_scores, recordings)
        verdict: Verdict = "undecided"
        if max(-low, high) < UNRELATED:
            verdict = "supported"
        elif low > RELATED or high < -RELATED:
            verdict = "contradicted"
        pairs.append(
            {
                "methods": [first, second],
                "rho": None if math.isnan(rho) else rho,
                "interval": [low, high],
                "overlap": len(top_sets[0] & top_sets[1]) / count,
                "orthogonal": verdict,
            }
        )
    return pairs


class ProgressError(Exception):
    """The faster driver makes more progress even at its lowest speed; ``faster``: the first (0) or the second (1)."""

    def __init__(self, faster: int) -> None:
        super().__init__(f"driver {faster} makes more progress even at its lowest speed")
        self.faster = faster


@dataclass(frozen=True)
class EqualProgress:
    """A metric of two drivers at the same progress.

    Attributes:
        values: Values of the first and the second driver, NaN where a metric is undefined at any speed.
        slower: The driver whose speed is limited: the first (0) or the second (1).
        share: Its speed limiter, interpolated, as a share of the speed limit.
    """

    values: tuple[Float[np.ndarray, "_ scenario"], Float[np.ndarray, "_ scenario"]]
    slower: int
    share: float


def match_progress(
    first: BySpeed, second: BySpeed, metric: str, weights: Float[np.ndarray, " scenario"]
) -> EqualProgress:
    """Compare two drivers at equal progress by limiting the speed of the faster one.

    Returns ``metric`` of both at the lower ``progress_ratio``. The faster driver's metric m is interpolated linearly
    between the two speeds whose progress p encloses the other driver's progress P. With the slope b of m over p, the
    result has the values of m - b (p - P): mixed over both speeds for the faster driver, at full speed for the other.
    Their means are the interpolated ones, and their variance is that of the interpolated difference (delta method): the
    errors of m and p at both speeds, and of P.

    Raises:
        ProgressError: The faster driver makes more progress even at its lowest speed.
    """
    drivers = first, second
    names = ("progress_ratio", metric)
    every_value = [episodes[name] for driver in drivers for episodes in driver.values() for name in names]
    is_defined = (weights > 0.0) & ~np.isnan(np.concatenate(every_value)).any(axis=0)
    if not is_defined.any():
        undefined = [np.full_like(driver[1.0][metric], np.nan) for driver in drivers]
        return EqualProgress((undefined[0], undefined[1]), 0, 1.0)

    def mean(values: Values) -> float:
        return float(np.average(values[:, is_defined].mean(axis=0), weights=weights[is_defined]))

    progress = [{speed: mean(e["progress_ratio"]) for speed, e in driver.items()} for driver in drivers]
    faster = int(progress[1][1.0] >= progress[0][1.0])
    target, speeds = progress[1 - faster][1.0], sorted(drivers[faster], reverse=True)
    below = next((k for k, speed in enumerate(speeds) if k and progress[faster][speed] <= target), None)
    if below is None:
        raise ProgressError(faster)
    upper, lower = speeds[below - 1 : below + 1]
    high, low = progress[faster][upper], progress[faster][lower]
    range_of_progress = (high - low) or 1.0
    mix = (high - target) / range_of_progress
    of_upper, of_lower = (drivers[faster][speed] for speed in (upper, lower))
    slope = (mean(of_upper[metric]) - mean(of_lower[metric])) / range_of_progress

    def adjust(episodes: Mapping[str, Values]) -> Values:
        values = episodes[metric] - slope * (episodes["progress_ratio"] - target)
        return np.where(is_defined, values, np.nan)

    mixed = (1.0 - mix) * adjust(of_upper) + mix * adjust(of_lower)
    other = adjust(drivers[1 - faster][1.0])
    share = upper + mix * (lower - upper)
    return EqualProgress((other, mixed) if faster else (mixed, other), faster, share)
