"""What the long-tail study finds: conditions, rates, differences, and a verdict on each claim."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from drivax.curation.arms import CURATED, control_of
from drivax.stats.seeds import Crossed, crossed_difference, crossed_mean, log_ratio, seeds_interval
from drivax.stats.significance import holm

Values = Float[np.ndarray, "seed scenario"]
#: By metric.
Driven = Mapping[str, Values]
Rows = Bool[np.ndarray, " scenario"]
Counts = Float[np.ndarray, " scenario"]
Verdict = Literal["supported", "contradicted", "undecided"]
#: Against the baseline, against a lot, in common and in rare scenarios, in other failures, between methods.
ClaimGroup = Literal["baseline", "lot", "where", "failures", "methods"]

#: What is reported of every agent, and whether more of it is better.
METRICS = {
    "collision": -1, "at_fault_collision": -1, "offroad": -1, "accuracy": 1, "progress_ratio": 1, "vmax_score": 1,
}  # fmt: skip
_LEVEL = 0.05
#: What the published study reports of its best agent: 16.0 % of collisions to 5.5 %.
PUBLISHED_CHANGE = 5.5 / 16.0 - 1.0


@dataclass(frozen=True)
class Condition:
    """How well an agent drives before anything is compared.

    Attributes:
        agent: Its name.
        progress: Share of the expert's progress on the validation set at the chosen checkpoints, mean over seeds.
        least: The same of the worst seed.
        change: Of the validation score, from the third to the last quarter of the validations, mean over seeds.
        moved: How far it changes either way, mean over seeds.
        met: Whether every seed makes progress enough, and seeds move little.
    """

    agent: str
    progress: float
    least: float
    change: float
    moved: float
    met: bool

    @classmethod
    def of(
        cls, agent: str, curves: Sequence[Mapping[str, Sequence[float]]], least: float, flat: float
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
            agent,
            progress=float(np.mean(progress)),
            least=min(progress),
            change=float(np.mean(changes)),
            moved=moved,
            met=bool(min(progress) >= least and moved <= flat),
        )

    def words(self) -> str:
        """One line."""
        return (
            f"{self.agent}: {self.progress:.0%} of the expert's progress (worst seed {self.least:.0%}), score moves by "
            f"{self.change:+.3f} ({self.moved:.3f} either way): {'good enough' if self.met else 'NOT good enough'}"
        )


@dataclass(frozen=True)
class Claim:
    """A claim about two agents.

    Attributes:
        words: The claim.
        one: The agent that is said to be better.
        other: The one that it is compared with.
        group: Claims whose p-values are adjusted together.
        metric: In what.
        rows: ``ordinary``, ``common`` or ``rare`` scenarios.
        change: Relative change that is claimed, at least; None: only the direction is.
    """

    words: str
    one: str
    other: str
    group: ClaimGroup
    metric: str = "collision"
    rows: str = "ordinary"
    change: float | None = None


def claims(agents: Sequence[str]) -> list[Claim]:
    """All claims about these agents: those of the published study, and those that its controls would have asked."""
    found = []
    curated = [name for name in CURATED if name in agents]
    for name in (*curated, "cql_bc", "oracle", "oracle_strong"):
        found.append(Claim(f"{name} collides less than the baseline", name, "baseline", "baseline"))
    # A third of the collisions, or fewer: the ratio of the published rates.
    found.append(
        Claim(
            f"ensemble has {1 + PUBLISHED_CHANGE:.0%} of the baseline's collisions or fewer",
            "ensemble",
            "baseline",
            "baseline",
            change=PUBLISHED_CHANGE,
        )
    )
    for name in (*curated, "oracle"):
        lot = control_of(name)
        found.append(
            Claim(f"{name} collides less than weights as strong, dealt out by lot", name, lot, "lot")
        )
    for name in (*curated, "oracle"):
        for rows in ("common", "rare"):
            words = f"{name} collides less than the baseline in {rows} scenarios"
            found.append(Claim(words, name, "baseline", "where", rows=rows))
        words = f"{name} collides less than weights as strong, dealt out by lot, in rare scenarios"
        found.append(Claim(words, name, control_of(name), "where", rows="rare"))
    for name in curated:
        words = f"{name} fails less than the baseline"
        found.append(Claim(words, name, "baseline", "failures", "accuracy"))
    for one, other in (
        ("ensemble", "heuristic"),
        ("ensemble", "action_rarity"),
        ("ensemble", "cql_bc"),
        ("action_rarity", "heuristic"),
    ):
        found.append(Claim(f"{one} collides less than {other}", one, other, "methods"))
    for name in ("heuristic", "ensemble", "action_rarity"):
        whole = f"{name}_scenario"
        words = f"{name} by step collides less at fault than by scenario"
        found.append(Claim(words, name, whole, "methods", "at_fault_collision"))
        words = f"{name} by scenario gets further than by step"
        found.append(Claim(words, whole, name, "methods", "progress_ratio"))
    return [claim for claim in found if claim.one in agents and claim.other in agents]


@dataclass(frozen=True)
class Judged:
    """A claim and what became of it.

    Attributes:
        claim: The claim.
        found: What is tested against 0: the difference, one agent minus the other; of a claim about a size the
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
    driven: Mapping[str, Driven],
    clusters: Sequence[str],
    rare: Rows,
    agents: Sequence[str],
    share: float | None = None,
) -> list[Judged]:
    """Judges every claim.

    Args:
        driven: What every agent did, by metric.
        clusters: Recording of every scenario.
        rare: Which scenarios are rare.
        agents: Whom claims are about.
        share: Of rare scenarios in ordinary traffic (:func:`counts`).
    """
    labels = np.asarray(clusters)
    made = []
    for claim in claims(agents):
        weights = counts(claim.rows, rare, share)
        one, other = (driven[name][claim.metric] for name in (claim.one, claim.other))
        difference = ratio = None
        if _several(np.concatenate([one, other]), labels, weights):
            difference = crossed_difference(one, other, labels, weights)
            ratio = log_ratio(one, other, labels, weights)
        found = difference
        if claim.change is not None:
            found = ratio and replace(ratio, difference=ratio.difference - math.log1p(claim.change))
        made.append((claim, found, difference, ratio))
    groups = [claim.group for claim, *_ in made]
    adjusted: dict[int, float | None] = {}
    for group in set(groups):
        places = [place for place, name in enumerate(groups) if name == group]
        ps = holm([None if made[place][1] is None else made[place][1].p for place in places])
        adjusted |= dict(zip(places, ps, strict=True))
    return [
        _judged(claim, found, difference, ratio, adjusted[place], groups.count(claim.group))
        for place, (claim, found, difference, ratio) in enumerate(made)
    ]


def _judged(
    claim: Claim,
    found: Crossed | None,
    difference: Crossed | None,
    ratio: Crossed | None,
    p: float | None,
    together: int,
) -> Judged:
    change = None
    if ratio is not None:
        low, high = ratio.interval()
        change = (math.expm1(ratio.difference), math.expm1(low), math.expm1(high))
    if found is None or p is None:
        why = "there are no such scenarios" if difference is None else "one of them never collides: no ratio"
        return Judged(claim, found, difference, change, p, "undecided", why)
    verdict: Verdict = "undecided"
    if p < _LEVEL:
        verdict = "supported" if METRICS[claim.metric] * found.difference > 0 else "contradicted"
    words = "" if verdict != "undecided" else needed(found, together)
    return Judged(claim, found, difference, change, p, verdict, words)


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
    """Confidence at which the first of so many claims is tested (Holm)."""
    return 1.0 - _LEVEL / together


def detectable(
    baseline: Driven, other: Driven, clusters: Sequence[str], rare: Rows, share: float | None, together: int
) -> dict[str, float]:
    """The smallest differences that a study finds with a probability of 80 %, known before the others learn.

    As if two kinds of agents had seeds that vary as the baseline's, and differed by scenario as the baseline and ``bc``
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
            alike = replace(two, seeds=(seeds, seeds), both=(both, both))
            found[name] = alike.detectable(confidence=level(together))
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
    """Whether more than one recording counts in which everybody's value is defined."""
    return np.unique(labels[(weights > 0.0) & ~np.isnan(values).any(axis=0)]).size > 1


def rates(
    driven: Driven, clusters: Sequence[str], rare: Rows, share: float | None = None
) -> dict[str, dict[str, dict[str, Any]]]:
    """Of one agent: by kind of scenario and metric the mean over seeds and scenarios, with its interval.

    Metrics that hardly any scenario defines are left out.
    """
    labels = np.asarray(clusters)
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for kind in ("ordinary", "common", "rare"):
        weights = counts(kind, rare, share)
        defined = {name: driven[name] for name in METRICS if _several(driven[name], labels, weights)}
        if defined:
            found[kind] = {name: _rate(one, labels, weights) for name, one in defined.items()}
    return found


def _rate(values: Values, labels: np.ndarray[Any, Any], weights: Counts) -> dict[str, float | int | None]:
    """Mean, interval within what all of these metrics lie in, and how many scenarios it is of."""
    found = seeds_interval(values, labels, weights, share=True).as_dict()
    return {"scenarios" if name == "n" else name: value for name, value in found.items()}


def summary(judged: Judged) -> dict[str, Any]:
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
    chosen: Driven, best: Driven, clusters: Sequence[str], rare: Rows, share: float | None
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
