"""Statistics of a study: conditions, rates, differences between arms, and a verdict on each claim."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from drivax.curation.scores import ScoreTable
from drivax.curation.subset import top_rows
from drivax.evaluation.episode_table import SHARES
from drivax.metrics.catalogue import METRICS
from drivax.stats.ranking import correlation_interval, rank_correlation
from drivax.stats.seeds import CrossedEffect, crossed_difference, crossed_mean, log_ratio, seeds_interval
from drivax.stats.significance import holm_adjust
from drivax.studies.definition import Claim, Stratum

#: Rankings are unrelated if their correlation's interval is within ±UNRELATED, related if it is beyond ±RELATED.
UNRELATED, RELATED = 0.1, 0.3
#: Share of the scenarios that are compared as the most critical ones of two methods.
_TOP = 0.05
_LEVEL = 0.05
#: Metrics that lie between 0 and 1.
_SHARES = (*SHARES, "progress_ratio")

Values = Float[np.ndarray, "seed scenario"]
#: Values of an arm by metric.
Episodes = Mapping[str, Values]
Weights = Float[np.ndarray, " scenario"]
Verdict = Literal["supported", "contradicted", "undecided"]


@dataclass(frozen=True)
class Strata:
    """Recordings and rarity of the test scenarios.

    Attributes:
        recordings: Recording of every scenario: scenarios of one recording are dependent.
        rare: Whether a scenario is rare.
        share: Share of rare scenarios in ordinary traffic; None: as in the test set.
    """

    recordings: Sequence[str]
    rare: Bool[np.ndarray, " scenario"]
    share: float | None = None

    def weights(self, rows: Stratum) -> Weights:
        """Return the weight of every scenario.

        Args:
            rows: ``common`` or ``rare`` scenarios alone; or ``ordinary``: all, rare ones with their share of ordinary
                traffic, of which the test set may hold more.
        """
        if rows != "ordinary":
            return (self.rare if rows == "rare" else ~self.rare).astype(np.float64)
        if self.share is None or self.rare.all() or not self.rare.any():
            return np.ones(len(self.rare))
        return np.where(self.rare, self.share / self.rare.sum(), (1.0 - self.share) / (~self.rare).sum())

    def is_comparable(self, values: Values, weights: Weights) -> bool:
        """Return whether at least two recordings have weight and all values."""
        labels = np.asarray(self.recordings)
        return np.unique(labels[(weights > 0.0) & ~np.isnan(values).any(axis=0)]).size > 1


@dataclass(frozen=True)
class Condition:
    """Result of an arm on the validation set, before arms are compared.

    Attributes:
        arm: Its name.
        progress: Share of the expert's progress on the validation set at the best checkpoints, mean over seeds.
        least: Progress of the worst seed.
        change: Change of the validation score from the third to the last quarter of the validations, mean over seeds.
        moved: Absolute value of that change, mean over seeds.
        met: Whether every seed makes enough progress, and scores no longer move.
    """

    arm: str
    progress: float
    least: float
    change: float
    moved: float
    met: bool

    @classmethod
    def of(
        cls, arm: str, curves: Sequence[Mapping[str, Sequence[float]]], least: float, flat: float
    ) -> Condition:
        """Return the condition of an arm from ``score`` and ``progress`` at the validations of every seed."""
        progress, changes = [], []
        for curve in curves:
            scores = np.asarray(curve["score"])
            quarter = max(len(scores) // 4, 1)
            progress.append(curve["progress"][int(scores.argmax())])
            changes.append(scores[-quarter:].mean() - scores[-2 * quarter : -quarter].mean())
        moved = float(np.abs(changes).mean())
        met = bool(min(progress) >= least and moved <= flat)
        return cls(arm, float(np.mean(progress)), min(progress), float(np.mean(changes)), moved, met)

    def __str__(self) -> str:
        return (
            f"{self.arm}: {self.progress:.0%} of the expert's progress (worst seed {self.least:.0%}), score moves by "
            f"{self.change:+.3f} ({self.moved:.3f} either way): {'good enough' if self.met else 'NOT good enough'}"
        )


@dataclass(frozen=True)
class ClaimResult:
    """A claim and its verdict.

    Attributes:
        claim: The claim.
        tested: The effect that is tested against 0: the difference, arm minus reference; for a claimed size the log
            ratio minus the claimed one. None if the stratum is empty, or the ratio undefined.
        difference: The difference.
        change: Relative change and its interval; None if undefined.
        adjusted: P-value adjusted within the group (Holm).
        verdict: The verdict.
        needed: If undecided, the number of seeds or recordings that would decide, if the true effect were the estimate.
    """

    claim: Claim
    tested: CrossedEffect | None
    difference: CrossedEffect | None
    change: tuple[float, float, float] | None
    adjusted: float | None
    verdict: Verdict = "undecided"
    needed: str = ""

    def plain(self) -> dict[str, Any]:
        """Return plain values for ``results.json``."""
        difference = self.difference
        return {
            "claim": vars(self.claim),
            "verdict": self.verdict,
            "needed": self.needed,
            "difference": None if difference is None else difference.difference,
            "interval": None if difference is None else list(difference.interval()),
            "p": None if self.tested is None else self.tested.p,
            "adjusted": self.adjusted,
            "change": None if self.change is None else list(self.change),
        }


def decide_claims(
    claims: Sequence[Claim], episodes: Mapping[str, Episodes], strata: Strata
) -> list[ClaimResult]:
    """Test every claim, with p-values adjusted within its group (Holm).

    Args:
        claims: The claims.
        episodes: Values of every arm.
        strata: The test scenarios.
    """
    results = [_effects(claim, episodes, strata) for claim in claims]
    groups = [claim.group for claim in claims]
    for group in set(groups):
        members = [index for index, name in enumerate(groups) if name == group]
        tested = [results[index].tested for index in members]
        adjusted = holm_adjust([None if effect is None else effect.p for effect in tested])
        for index, p in zip(members, adjusted, strict=True):
            results[index] = _decide(replace(results[index], adjusted=p), len(members))
    return results


def _effects(claim: Claim, episodes: Mapping[str, Episodes], strata: Strata) -> ClaimResult:
    weights = strata.weights(claim.rows)
    arm, reference = (episodes[name][claim.metric] for name in (claim.arm, claim.reference))
    if not strata.is_comparable(np.concatenate([arm, reference]), weights):
        return ClaimResult(claim, None, None, None, None)
    difference = tested = crossed_difference(arm, reference, strata.recordings, weights)
    ratio = log_ratio(arm, reference, strata.recordings, weights)
    if claim.change is not None:
        tested = ratio and replace(ratio, difference=ratio.difference - math.log1p(claim.change))
    if ratio is None:
        return ClaimResult(claim, tested, difference, None, None)
    low, high = map(math.expm1, ratio.interval())
    return ClaimResult(claim, tested, difference, (math.expm1(ratio.difference), low, high), None)


def _decide(result: ClaimResult, claims: int) -> ClaimResult:
    if result.tested is None or result.adjusted is None:
        reason = "fewer than two recordings define it"
        if result.difference is not None:
            reason = "the mean of an arm is 0: no ratio"
        return replace(result, needed=reason)
    if result.adjusted >= _LEVEL:
        return replace(result, needed=needed(result.tested, claims))
    lower_is_better = METRICS[result.claim.metric].better == "low"
    better = (result.tested.difference < 0) == lower_is_better
    return replace(result, verdict="supported" if better else "contradicted")


def needed(effect: CrossedEffect, claims: int) -> str:
    """Describe the number of seeds or recordings that would decide.

    Args:
        effect: The effect that is tested.
        claims: Number of claims that are adjusted together; the strictest of their levels counts.
    """
    confidence = level(claims)
    seeds = effect.seeds_needed(confidence=confidence)
    recordings = effect.clusters_needed(confidence=confidence)
    numbers = [f"{seeds:,} seeds each"] if seeds is not None else []
    numbers += [f"{recordings:,} test recordings"] if recordings is not None else []
    if numbers:
        return " or ".join(numbers) + " would decide"
    return "neither seeds nor recordings alone would decide"


def level(claims: int) -> float:
    """Return the confidence at which the first of some claims is tested (Holm)."""
    return 1.0 - _LEVEL / claims


def detectable(
    first: Episodes, second: Episodes, strata: Strata, metrics: Sequence[str], claims: int
) -> dict[str, float]:
    """Return the smallest differences in ordinary traffic that the study detects with a probability of 80 %.

    An estimate before the other arms are trained: assumes that seeds of all arms vary like those of the first baseline,
    and that arms differ by scenario like the two baselines.

    Args:
        first: Values of the first baseline.
        second: Values of the second baseline.
        strata: The test scenarios.
        metrics: Names of metrics; those undefined in the test are left out.
        claims: Number of claims that are adjusted together.
    """
    weights, smallest = strata.weights("ordinary"), {}
    for name in metrics:
        if strata.is_comparable(np.concatenate([first[name], second[name]]), weights):
            effect = crossed_difference(first[name], second[name], strata.recordings, weights)
            (seeds, _), (interaction, _) = effect.seeds, effect.interaction
            equal_arms = replace(effect, seeds=(seeds, seeds), interaction=(interaction, interaction))
            smallest[name] = equal_arms.detectable(confidence=level(claims))
    return smallest


def rates(
    episodes: Episodes, strata: Strata, metrics: Sequence[str]
) -> dict[Stratum, dict[str, dict[str, float | int | None]]]:
    """Return the mean over seeds and scenarios of an arm with its interval, by stratum and metric.

    Metrics that fewer than two recordings define are left out.
    """
    means: dict[Stratum, dict[str, dict[str, float | int | None]]] = {}
    for stratum in ("ordinary", "common", "rare"):
        weights = strata.weights(stratum)
        known = {name: episodes[name] for name in metrics if strata.is_comparable(episodes[name], weights)}
        if known:
            means[stratum] = {
                name: _rate(values, strata, weights, name in _SHARES) for name, values in known.items()
            }
    return means


def _rate(values: Values, strata: Strata, weights: Weights, share: bool) -> dict[str, float | int | None]:
    interval = seeds_interval(values, strata.recordings, weights, share=share).as_dict()
    return {"scenarios" if name == "n" else name: value for name, value in interval.items()}


def rule_cost(
    rule: Episodes, best: Episodes, strata: Strata, metrics: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Return the cost of another checkpoint rule in ordinary traffic: paired differences, by metric.

    Args:
        rule: Values of every seed with the checkpoint of the rule.
        best: Values of the same seeds with the best checkpoint.
        strata: The test scenarios.
        metrics: Names of metrics.
    """
    weights, costs = strata.weights("ordinary"), {}
    for name in metrics:
        differences = rule[name] - best[name]
        if strata.is_comparable(differences, weights):
            effect = crossed_mean(differences, strata.recordings, weights)
            costs[name] = {"difference": effect.difference, "interval": list(effect.interval())}
    return costs


def rankings(tables: Mapping[str, ScoreTable], recordings: Sequence[str]) -> list[dict[str, Any]]:
    """Compare the rankings of scenarios by methods: rank correlation, overlap of the top 5 %, and a verdict.

    Args:
        tables: Score tables of one set by method.
        recordings: Recording of every scenario, which are resampled for the interval.
    """
    pairs = []
    for first, second in combinations([name for name in tables if name not in ("uniform", "oracle")], 2):
        scores, other_scores = (tables[name].scenarios for name in (first, second))
        count = max(round(_TOP * len(scores)), 1)
        top_sets = [set(top_rows(tables[name], count)) for name in (first, second)]
        low, high = correlation_interval(scores, other_scores, recordings)
        verdict: Verdict = "undecided"
        if max(-low, high) < UNRELATED:
            verdict = "supported"
        elif low > RELATED or high < -RELATED:
            verdict = "contradicted"
        pairs.append(
            {
                "methods": [first, second],
                "rho": rank_correlation(scores, other_scores),
                "interval": [low, high],
                "overlap": len(top_sets[0] & top_sets[1]) / count,
                "orthogonal": verdict,
            }
        )
    return pairs
