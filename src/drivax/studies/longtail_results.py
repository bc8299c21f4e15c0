"""What the long-tail study finds: conditions, rates, differences, and a verdict on each claim."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from drivax.curation.agents import CURATED, control_of
from drivax.curation.ranking import rank_correlation
from drivax.curation.scores import ScoreTable
from drivax.curation.subset import top_rows
from drivax.evaluation.crossed import Crossed, crossed_difference, crossed_mean, relative_change
from drivax.evaluation.hypotheses import holm

Values = Float[np.ndarray, "seed scenario"]
#: By metric.
Driven = Mapping[str, Values]
Rows = Bool[np.ndarray, " scenario"]
Verdict = Literal["supported", "contradicted", "undecided"]

#: What is reported of every agent, and whether more of it is better.
METRICS = {
    "collision": -1, "at_fault_collision": -1, "offroad": -1, "accuracy": 1, "progress_ratio": 1, "vmax_score": 1,
}  # fmt: skip
#: Two rankings below this correlation (and above its negative) are called unrelated, above the other one related.
UNRELATED, RELATED = 0.1, 0.3
#: Share of the scenarios that are compared as the most critical ones of two methods.
_TOP = 0.05
_LEVEL = 0.05
#: What the published study reports of its best agent: 16.0 % of collisions to 5.5 %.
PUBLISHED_CHANGE = 5.5 / 16.0 - 1.0


@dataclass(frozen=True)
class Condition:
    """How well an agent drives before anything is compared.

    Attributes:
        agent: Its name.
        progress: Share of the expert's progress on the validation set at the chosen checkpoints, mean over seeds.
        change: Of the validation score, from the third to the last quarter of the validations, mean over seeds.
        met: Whether both are as they should be.
    """

    agent: str
    progress: float
    change: float
    met: bool

    @classmethod
    def of(
        cls, agent: str, curves: Sequence[Mapping[str, Sequence[float]]], least: float, flat: float
    ) -> Condition:
        """From the validations of every seed: ``score`` and ``progress`` in their order."""
        progress, change = [], []
        for curve in curves:
            scores = np.asarray(curve["score"])
            quarter = max(len(scores) // 4, 1)
            progress.append(curve["progress"][int(scores.argmax())])
            change.append(scores[-quarter:].mean() - scores[-2 * quarter : -quarter].mean())
        made, moved = float(np.mean(progress)), float(np.mean(change))
        return cls(agent, made, moved, bool(made >= least and abs(moved) <= flat))

    def words(self) -> str:
        """One line."""
        return (
            f"{self.agent}: {self.progress:.0%} of the expert's progress, score moves by {self.change:+.3f}: "
            f"{'good enough' if self.met else 'NOT good enough'}"
        )


@dataclass(frozen=True)
class Claim:
    """A claim about two agents.

    Attributes:
        words: The claim.
        one: The agent that is said to be better.
        other: The one that it is compared with.
        metric: In what.
        rows: ``all``, ``common`` or ``rare`` scenarios.
        change: Relative change that is claimed; None: only the direction is.
    """

    words: str
    one: str
    other: str
    metric: str = "collision"
    rows: str = "all"
    change: float | None = None


def claims(agents: Sequence[str]) -> list[Claim]:
    """All claims about these agents: those of the published study, and those that its controls would have asked."""
    found = []
    curated = [name for name in CURATED if name in agents]
    for name in curated:
        found.append(Claim(f"{name} collides less than the baseline", name, "baseline"))
        found.append(Claim(f"{name} fails less than the baseline", name, "baseline", "accuracy"))
    for name in curated:
        lot = control_of(name)
        if lot in agents:
            found.append(Claim(f"{name} collides less than the same weights dealt out by lot", name, lot))
            found.append(
                Claim(f"{name} collides less than weights by lot where it is rare", name, lot, rows="rare")
            )
    for one, other, words in (
        ("ensemble", "heuristic", "uncertainty collides less than the heuristic"),
        ("action_rarity", "heuristic", "action rarity collides less than the heuristic"),
        ("ensemble", "cql_bc", "uncertainty collides less than CQL with imitation"),
        ("cql_bc", "baseline", "CQL with imitation collides less than the baseline"),
        ("oracle", "baseline", "true labels collide less than the baseline"),
        ("oracle", control_of("oracle"), "true labels collide less than weights dealt out by lot"),
    ):
        if one in agents and other in agents:
            found.append(Claim(words, one, other))
    if "ensemble" in agents:
        found.append(
            Claim("uncertainty cuts collisions 2.9 times", "ensemble", "baseline", change=PUBLISHED_CHANGE)
        )
    return found


@dataclass(frozen=True)
class Judged:
    """A claim and what became of it.

    Attributes:
        claim: The claim.
        found: The difference, one agent minus the other; None where a kind of scenario does not occur.
        change: The relative change with its interval, where there is one.
        adjusted: P-value, adjusted for the number of all claims (Holm).
        verdict: What it comes to.
        needed: Where undecided: how many seeds, or recordings, would find a difference of this size.
    """

    claim: Claim
    found: Crossed | None
    change: tuple[float, float, float] | None
    adjusted: float | None
    verdict: Verdict
    needed: str


def judge(
    driven: Mapping[str, Driven], clusters: Sequence[str], rare: Rows, agents: Sequence[str]
) -> list[Judged]:
    """Judges every claim.

    Args:
        driven: What every agent did, by metric.
        clusters: Recording of every scenario.
        rare: Which scenarios are rare.
        agents: Whom claims are about.
    """
    labels = np.asarray(clusters)
    made = []
    for claim in claims(agents):
        rows = which(claim.rows, rare)
        one, other = (driven[name][claim.metric][:, rows] for name in (claim.one, claim.other))
        found = crossed_difference(one, other, labels[rows]) if np.unique(labels[rows]).size > 1 else None
        change = relative_change(one, other, labels[rows]) if found is not None else None
        made.append((claim, found, change))
    adjusted = holm([None if found is None else found.p for _, found, _ in made])
    return [
        _judged(claim, found, change, p) for (claim, found, change), p in zip(made, adjusted, strict=True)
    ]


def _judged(
    claim: Claim, found: Crossed | None, change: tuple[float, float, float] | None, p: float | None
) -> Judged:
    if found is None or p is None:
        return Judged(claim, found, change, p, "undecided", "there are no such scenarios")
    sign = METRICS[claim.metric] * found.difference
    verdict: Verdict = "undecided"
    if p < _LEVEL:
        verdict = "supported" if sign > 0 else "contradicted"
    if claim.change is not None and change is not None and claim.change < change[1]:
        # So large an effect as was claimed is beyond the interval.
        verdict = "contradicted"
    return Judged(claim, found, change, p, verdict, "" if verdict != "undecided" else needed(found))


def needed(found: Crossed) -> str:
    """How many seeds or recordings would decide, in words."""
    seeds, recordings = found.seeds_needed(), found.clusters_needed()
    ways = [f"{seeds:,} seeds each"] if seeds is not None else []
    ways += [f"{recordings:,} test recordings"] if recordings is not None else []
    if ways:
        return " or ".join(ways) + " would find a difference of this size"
    return "neither seeds nor recordings alone would find a difference of this size"


def which(rows: str, rare: Rows) -> Rows:
    """The scenarios of a name."""
    return {"all": np.ones_like(rare), "common": ~rare, "rare": rare}[rows]


def rates(driven: Driven, clusters: Sequence[str], rare: Rows) -> dict[str, dict[str, dict[str, Any]]]:
    """Of one agent: by kind of scenario and metric the mean over seeds and scenarios, with its interval."""
    labels = np.asarray(clusters)
    return {
        kind: {metric: _rate(crossed_mean(driven[metric][:, rows], labels[rows])) for metric in METRICS}
        for kind in ("all", "common", "rare")
        if np.unique(labels[rows := which(kind, rare)]).size > 1
    }


def _rate(found: Crossed) -> dict[str, float]:
    """Mean and interval, within what all of these metrics lie in."""
    low, high = np.clip(found.interval(), 0.0, 1.0)
    return {"mean": found.difference, "low": float(low), "high": float(high)}


def rankings(tables: Mapping[str, ScoreTable]) -> list[dict[str, Any]]:
    """How alike the rankings of scenarios are: rank correlation, and how many of the most critical are the same."""
    found = []
    for one, other in combinations([name for name in tables if name not in ("uniform", "oracle")], 2):
        first, second = tables[one], tables[other]
        count = max(round(_TOP * len(first.scenarios)), 1)
        tops = [set(top_rows(table, count)) for table in (first, second)]
        rho = rank_correlation(first.scenarios, second.scenarios)
        shared = len(tops[0] & tops[1]) / count
        verdict = "undecided"
        if abs(rho) < UNRELATED:
            verdict = "supported"
        elif abs(rho) > RELATED:
            verdict = "contradicted"
        found.append({"one": one, "other": other, "rho": rho, "overlap": shared, "orthogonal": verdict})
    return found


def summary(judged: Judged) -> dict[str, Any]:
    """As plain values."""
    found = judged.found
    return {
        "claim": asdict(judged.claim),
        "verdict": judged.verdict,
        "needed": judged.needed,
        "difference": None if found is None else found.difference,
        "interval": None if found is None else list(found.interval()),
        "p": None if found is None else found.p,
        "adjusted": judged.adjusted,
        "change": None if judged.change is None else list(judged.change),
    }
