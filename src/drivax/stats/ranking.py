"""Ranking quality of scores: AUC, precision at the base rate, and rank correlation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import norm, rankdata

from drivax.errors import UsageError

Numbers = Float[np.ndarray[Any, Any], " n"]
Labels = Bool[np.ndarray[Any, Any], " n"]


def roc_auc(scores: Numbers, labels: Labels, weights: Numbers | None = None) -> float:
    """Probability that a positive scores above a negative; a tie counts half (Hanley and McNeil, 1982).

    Args:
        scores: Scores.
        labels: True for positives.
        weights: Weight of each; equally by default.

    Raises:
        UsageError: There are no positives, or no negatives.
    """
    _check(labels)
    return _auc(*_masses(_places(scores), labels, np.ones(len(scores)) if weights is None else weights))


def auc_interval(scores: Numbers, labels: Labels, confidence: float = 0.95) -> tuple[float, float]:
    """Interval of :func:`roc_auc`, by DeLong, DeLong and Clarke-Pearson (Biometrics 44, 1988), within [0, 1].

    The variance is that of each one's share of others that it is ranked rightly against, over their number, summed
    over both kinds.

    Raises:
        UsageError: There are fewer than two positives or negatives.
    """
    positive, negative = scores[labels], scores[~labels]
    if min(len(positive), len(negative)) < 2:
        raise UsageError("an interval needs two of either kind", cure="use a larger set")
    ranks = rankdata(scores)
    above = (ranks[labels] - rankdata(positive)) / len(negative)
    below = 1.0 - (ranks[~labels] - rankdata(negative)) / len(positive)
    spread = np.sqrt(above.var(ddof=1) / len(positive) + below.var(ddof=1) / len(negative))
    reach = float(norm.ppf(0.5 + confidence / 2) * spread)
    middle = float(above.mean())
    return max(middle - reach, 0.0), min(middle + reach, 1.0)


def precision_at_base_rate(scores: Numbers, labels: Labels, weights: Numbers | None = None) -> float:
    """Share of positives among the highest scores, of which as many are taken as there are positives.

    1 for a perfect ranking, the base rate itself for one by chance. Of equal scores at the edge a share is taken.

    Raises:
        UsageError: There are no positives, or no negatives.
    """
    _check(labels)
    return _precision(*_masses(_places(scores), labels, np.ones(len(scores)) if weights is None else weights))


def bootstrap_intervals(
    scores: Numbers,
    labels: Labels,
    weights: Numbers,
    clusters: Int[np.ndarray[Any, Any], " n"],
    resamples: int = 500,
    confidence: float = 0.95,
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Intervals of :func:`roc_auc` and :func:`precision_at_base_rate`, by percentiles of a cluster bootstrap.

    Whole clusters are drawn with replacement (Davison and Hinkley, Bootstrap Methods, 1997, 3.8): those with
    a positive and those without are drawn separately, so that the base rate stays.

    Args:
        scores: Scores.
        labels: True for positives.
        weights: Weight of each.
        clusters: What belongs together: the scenario of a step.
        resamples: How often.
        confidence: Of both intervals.

    Raises:
        UsageError: There are no positives, or no negatives.
    """
    _check(labels)
    place, rng = _places(scores), np.random.default_rng(0)
    number, cluster = np.unique(clusters, return_inverse=True)
    holds = np.bincount(cluster, labels, len(number)) > 0
    kinds = [np.flatnonzero(holds), np.flatnonzero(~holds)]
    samples = []
    for _ in range(resamples):
        drawn = np.concatenate([rng.choice(kind, len(kind)) for kind in kinds if len(kind)])
        times = np.bincount(drawn, minlength=len(number))[cluster]
        masses = _masses(place, labels, weights * times)
        samples.append((_auc(*masses), _precision(*masses)))
    tail = (1.0 - confidence) / 2
    low, high = np.quantile(samples, (tail, 1.0 - tail), axis=0)
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


def _places(scores: Numbers) -> Int[np.ndarray[Any, Any], " n"]:
    """Rank of every score among the different ones, the lowest first."""
    return np.unique(scores, return_inverse=True)[1]


def _masses(
    place: Int[np.ndarray[Any, Any], " n"], labels: Labels, weights: Numbers
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return the weight of positives and of negatives, by score."""
    count = int(place.max()) + 1
    return np.bincount(place, weights * labels, count), np.bincount(place, weights * ~labels, count)


def _auc(positive: np.ndarray[Any, Any], negative: np.ndarray[Any, Any]) -> float:
    below = np.cumsum(negative) - negative
    return float(np.sum(positive * (below + negative / 2)) / (positive.sum() * negative.sum()))


def _precision(positive: np.ndarray[Any, Any], negative: np.ndarray[Any, Any]) -> float:
    positive, total = positive[::-1], (positive + negative)[::-1]
    count = positive.sum()
    left = count - (np.cumsum(total) - total)
    taken = np.clip(np.divide(left, total, out=np.zeros_like(total), where=total > 0), 0.0, 1.0)
    return float(np.sum(positive * taken) / count)


def rank_correlation(first: Numbers, second: Numbers) -> float:
    """The correlation of mid-ranks (Spearman, Am. J. Psychol. 15, 1904); NaN where one is constant."""
    with np.errstate(invalid="ignore"):
        return float(np.corrcoef(rankdata(first), rankdata(second))[0, 1])


def correlation_interval(
    first: Numbers,
    second: Numbers,
    clusters: Sequence[Any] | np.ndarray[Any, Any],
    resamples: int = 200,
    confidence: float = 0.95,
) -> tuple[float, float]:
    """Interval of :func:`rank_correlation`, by percentiles of a bootstrap that draws whole clusters.

    Davison and Hinkley, Bootstrap Methods, 1997, 3.8. From -1 to 1 where nothing can be said: of a single cluster, or
    where nearly all scores are the same.

    Args:
        first: Some scores.
        second: Others of the same.
        clusters: What belongs together: the recording of a scenario, the scenario of a step.
        resamples: How often.
        confidence: Of the interval.
    """
    number = np.unique(np.asarray(clusters), return_inverse=True)[1]
    parts = np.split(np.argsort(number, kind="stable"), np.cumsum(np.bincount(number))[:-1])
    rng, samples = np.random.default_rng(0), []
    for _ in range(resamples):
        rows = np.concatenate([parts[place] for place in rng.integers(len(parts), size=len(parts))])
        samples.append(rank_correlation(first[rows], second[rows]))
    if len(parts) < 2 or np.isnan(samples).any():
        return -1.0, 1.0
    tail = (1.0 - confidence) / 2
    low, high = np.quantile(samples, (tail, 1.0 - tail))
    return float(low), float(high)


def _check(labels: Labels) -> None:
    if labels.all() or not labels.any():
        raise UsageError(
            "labels are all true or all false", cure="use a set that has positives and negatives"
        )
