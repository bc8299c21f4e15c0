"""What the long-tail study finds: conditions, rates, differences, and a verdict on each claim."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from drivax.curation.arms import LONGTAIL, Claim
from drivax.curation.scores import ScoreTable
from drivax.curation.subset import top_rows
from drivax.stats.ranking import correlation_interval, rank_correlation
from drivax.stats.seeds import Crossed, crossed_difference, crossed_mean, log_ratio, seeds_interval
from drivax.stats.significance import holm

#: Two rankings below this correlation (and above its negative) are called unrelated, above the other one related.
UNRELATED, RELATED = 0.1, 0.3
#: Share of the scenarios that are compared as the most critical ones of two methods.
_TOP = 0.05


def rankings(tables: Mapping[str, ScoreTable], clusters: Sequence[str]) -> list[dict[str, Any]]:
    """How similar the rankings of scenarios are: rank correlation, and how many of the most critical are the same.

    They are unrelated or related only where all of the correlation's interval is.

    Args:
        tables: By method, of one set.
        clusters: Recording of every scenario, which are drawn again for the interval.
    """
    found = []
    for one, other in combinations([name for name in tables if name not in ("uniform", "oracle")], 2):
        first, second = tables[one].scenarios, tables[other].scenarios
        count = max(round(_TOP * len(first)), 1)
        tops = [set(top_rows(tables[name], count)) for name in (one, other)]
        low, high = correlation_interval(first, second, clusters)
        verdict = "undecided"
        if max(-low, high) < UNRELATED:
            verdict = "supported"
        elif low > RELATED or high < -RELATED:
            verdict = "contradicted"
        found.append(
            {
                "one": one,
                "other": other,
                "rho": rank_correlation(first, second),
                "interval": [low, high],
                "overlap": len(tops[0] & tops[1]) / count,
                "orthogonal": verdict,
            }
        )
    return found


Values = Float[np.ndarray, "seed scenario"]
#: By metric.
Episodes = Mapping[str, Values]
Rows = Bool[np.ndarray, " scenario"]
Counts = Float[np.ndarray, " scenario"]
Verdict = Literal["supported", "contradicted", "undecided"]

#: What is reported of every arm, and whether more of it is better.
METRICS = {
    "collision": -1, "at_fault_collision": -1, "offroad": -1, "accuracy": 1, "progress_ratio": 1, "vmax_score": 1,
}  # fmt: skip
_LEVEL = 0.05


@dataclass(frozen=True)
class Condition:
    """How well an arm drives before anything is compared.

    Attributes:
        arm: Its name.
        progress: Share of the expert's progress on the validation set at the chosen checkpoints, mean over seeds.
        least: The same of the worst seed.
        change: Of the validation score, from the third to the last quarter of the validations, mean over seeds.
        moved: How far it changes either way, mean over seeds.
        met: Whether every seed makes progress enough, and seeds move little.
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
        """From the validations of every seed: ``score`` and ``progress`` in their order."""
        progress, changes = [], []
        for curve in curves:
            scores = np.asarray(curve["score"])
            quarter = max(len(scores) // 4, 1)
            progress.append(curve["progress"][int(scores.argmax())])
            changes.append(scores[-quarter:].mean() - scores[-2 * quarter : -quarter].mean())
        moved = float(np.abs(changes).mean())
        return cls(
            arm,
            progress=float(np.mean(progress)),
            least=min(progress),
            change=float(np.mean(changes)),
            moved=moved,
            met=bool(min(progress) >= least and moved <= flat),
        )

    def words(self) -> str:
        """One line."""
        return (
            f"{self.arm}: {self.progress:.0%} of the expert's progress (worst seed {self.least:.0%}), score moves by "
            f"{self.change:+.3f} ({self.moved:.3f} either way): {'good enough' if self.met else 'NOT good enough'}"
        )


def claims(arms: Sequence[str]) -> list[Claim]:
    """Return the claims of the long-tail study about these arms."""
    return [claim for claim in LONGTAIL.claims if claim.arm in arms and claim.reference in arms]


@dataclass(frozen=True)
class JudgedClaim:
    """A claim and what became of it.

    Attributes:
        claim: The claim.
        found: What is tested against 0: the difference, one arm minus the other; of a claim about a size the
            logarithm of the ratio over the claimed one. None where a kind of scenario, or a ratio, does not exist.
        difference: The difference.
        change: The relative change with its interval, where there is one.
        adjusted: P-value, adjusted for the number of claims in its group (Holm).
        verdict: What it comes to.
        needed: Where undecided: how many seeds, or recordings, would find what was found.
    """

    claim: Claim
    found: Crossed | None
    difference: Crossed | None
    change: tuple[float, float, float] | None
    adjusted: float | None
    verdict: Verdict
    needed: str


def judge(
    episodes: Mapping[str, Episodes],
    clusters: Sequence[str],
    rare: Rows,
    arms: Sequence[str],
    share: float | None = None,
) -> list[JudgedClaim]:
    """Judges every claim.

    Args:
        episodes: What every arm did, by metric.
        clusters: Recording of every scenario.
        rare: Which scenarios are rare.
        arms: Whom claims are about.
        share: Of rare scenarios in ordinary traffic (:func:`counts`).
    """
    labels = np.asarray(clusters)
    tested = []
    for claim in claims(arms):
        weights = counts(claim.rows, rare, share)
        one, other = (episodes[name][claim.metric] for name in (claim.arm, claim.reference))
        difference = ratio = None
        if _several(np.concatenate([one, other]), labels, weights):
            difference = crossed_difference(one, other, labels, weights)
            ratio = log_ratio(one, other, labels, weights)
        found = difference
        if claim.change is not None:
            found = ratio and replace(ratio, difference=ratio.difference - math.log1p(claim.change))
        tested.append((claim, found, difference, ratio))
    groups = [claim.group for claim, *_ in tested]
    adjusted: dict[int, float | None] = {}
    for group in set(groups):
        places = [place for place, name in enumerate(groups) if name == group]
        ps = holm([None if tested[place][1] is None else tested[place][1].p for place in places])
        adjusted |= dict(zip(places, ps, strict=True))
    return [
        _judged(claim, found, difference, ratio, adjusted[place], groups.count(claim.group))
        for place, (claim, found, difference, ratio) in enumerate(tested)
    ]


def _judged(
    claim: Claim,
    found: Crossed | None,
    difference: Crossed | None,
    ratio: Crossed | None,
    p: float | None,
    together: int,
) -> JudgedClaim:
    change = None
    if ratio is not None:
        low, high = ratio.interval()
        change = (math.expm1(ratio.difference), math.expm1(low), math.expm1(high))
    if found is None or p is None:
        why = "there are no such scenarios" if difference is None else "one of them never collides: no ratio"
        return JudgedClaim(claim, found, difference, change, p, "undecided", why)
    verdict: Verdict = "undecided"
    if p < _LEVEL:
        verdict = "supported" if METRICS[claim.metric] * found.difference > 0 else "contradicted"
    words = "" if verdict != "undecided" else needed(found, together)
    return JudgedClaim(claim, found, difference, change, p, verdict, words)


def needed(found: Crossed, together: int) -> str:
    """How many seeds or recordings would decide, in words.

    Args:
        found: What is tested.
        together: How many claims are adjusted together; the strictest of their levels counts.
    """
    confidence = level(together)
    seeds = found.seeds_needed(confidence=confidence)
    recordings = found.clusters_needed(confidence=confidence)
    ways = [f"{seeds:,} seeds each"] if seeds is not None else []
    ways += [f"{recordings:,} test recordings"] if recordings is not None else []
    if ways:
        return " or ".join(ways) + " would decide"
    return "neither seeds nor recordings alone would decide"


def level(together: int) -> float:
    """Confidence at which the first of ``together`` claims is tested (Holm)."""
    return 1.0 - _LEVEL / together


def detectable(
    baseline: Episodes,
    other: Episodes,
    clusters: Sequence[str],
    rare: Rows,
    share: float | None,
    together: int,
) -> dict[str, float]:
    """The smallest differences that a study finds with a probability of 80 %, known before the others learn.

    As if two kinds of arms had seeds that vary as the baseline's, and differed by scenario as the baseline and ``bc``
    do; at the level of the first of the claims that are adjusted together.

    Args:
        baseline: What the baseline's seeds did.
        other: What those of ``bc`` did.
        clusters: Recording of every scenario.
        rare: Which scenarios are rare.
        share: Of rare scenarios in ordinary traffic.
        together: How many claims.
    """
    labels, weights, found = np.asarray(clusters), counts("ordinary", rare, share), {}
    for name in METRICS:
        if _several(np.concatenate([baseline[name], other[name]]), labels, weights):
            two = crossed_difference(baseline[name], other[name], labels, weights)
            (seeds, _), (both, _) = two.seeds, two.both
            equal = replace(two, seeds=(seeds, seeds), both=(both, both))
            found[name] = equal.detectable(confidence=level(together))
    return found


def counts(rows: str, rare: Rows, share: float | None) -> Counts:
    """How much each scenario of the test counts.

    Args:
        rows: ``common`` or ``rare`` ones alone; or ``ordinary``: rare ones as often as in ordinary traffic, of which
            the test may hold more.
        rare: Which scenarios are rare.
        share: Of rare scenarios in ordinary traffic; None: as in the test.
    """
    if rows != "ordinary":
        return (rare if rows == "rare" else ~rare).astype(np.float64)
    if share is None or rare.all() or not rare.any():
        return np.ones(len(rare))
    return np.where(rare, share / rare.sum(), (1.0 - share) / (~rare).sum())


def _several(values: Values, labels: np.ndarray[Any, Any], weights: Counts) -> bool:
    """Whether more than one recording counts in which all values are defined."""
    return np.unique(labels[(weights > 0.0) & ~np.isnan(values).any(axis=0)]).size > 1


def rates(
    episodes: Episodes, clusters: Sequence[str], rare: Rows, share: float | None = None
) -> dict[str, dict[str, dict[str, Any]]]:
    """Of one arm: by kind of scenario and metric the mean over seeds and scenarios, with its interval.

    Metrics that hardly any scenario defines are left out.
    """
    labels = np.asarray(clusters)
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for kind in ("ordinary", "common", "rare"):
        weights = counts(kind, rare, share)
        defined = {name: episodes[name] for name in METRICS if _several(episodes[name], labels, weights)}
        if defined:
            found[kind] = {name: _rate(one, labels, weights) for name, one in defined.items()}
    return found


def _rate(values: Values, labels: np.ndarray[Any, Any], weights: Counts) -> dict[str, float | int | None]:
    """Mean, interval within what all of these metrics lie in, and how many scenarios it is of."""
    found = seeds_interval(values, labels, weights, share=True).as_dict()
    return {"scenarios" if name == "n" else name: value for name, value in found.items()}


def summary(judged: JudgedClaim) -> dict[str, Any]:
    """As plain values."""
    difference = judged.difference
    return {
        "claim": asdict(judged.claim),
        "verdict": judged.verdict,
        "needed": judged.needed,
        "difference": None if difference is None else difference.difference,
        "interval": None if difference is None else list(difference.interval()),
        "p": None if judged.found is None else judged.found.p,
        "adjusted": judged.adjusted,
        "change": None if judged.change is None else list(judged.change),
    }


def cost_of_rule(
    chosen: Episodes, best: Episodes, clusters: Sequence[str], rare: Rows, share: float | None
) -> dict[str, Any]:
    """What other checkpoints of the very same runs cost, in pairs: by metric the difference and its interval.

    Args:
        chosen: What the seeds did with the checkpoints in question.
        best: What they did with those that were taken, in the same order.
        clusters: Recording of every scenario.
        rare: Which scenarios are rare.
        share: Of rare scenarios in ordinary traffic.
    """
    labels, weights, found = np.asarray(clusters), counts("ordinary", rare, share), {}
    for name in METRICS:
        apart = chosen[name] - best[name]
        if _several(apart, labels, weights):
            one = crossed_mean(apart, labels, weights)
            found[name] = {"difference": one.difference, "interval": list(one.interval())}
    return found
