"""Ranking quality of scores: AUC, precision at the base rate, and rank correlation.

Functions of labels (true for positives) raise UsageError without positives or negatives.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import norm, rankdata

from drivax.errors import UsageError

Numbers = Float[np.ndarray[Any, Any], " n"]
Labels = Bool[np.ndarray[Any, Any], " n"]


def roc_auc(scores: Numbers, labels: Labels, weights: Numbers | None = None) -> float:
    """Return the probability that a positive scores above a negative; a tie counts half (Hanley and McNeil, 1982)."""
    return _auc(*_masses(_ranks(scores, labels), labels, weights))


def auc_interval(scores: Numbers, labels: Labels, confidence: float = 0.95) -> tuple[float, float]:
    """Return the interval of :func:`roc_auc` by DeLong, DeLong and Clarke-Pearson (Biometrics 44, 1988), within [0, 1].

    Raises UsageError for fewer than two positives or negatives.
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
    """Return the share of positives among as many of the highest scores; of equal ones at the edge a share is taken.

    1 for a perfect ranking, the base rate for a random one.
    """
    return _precision(*_masses(_ranks(scores, labels), labels, weights))


def bootstrap_intervals(
    scores: Numbers, labels: Labels, weights: Numbers, clusters: Int[np.ndarray[Any, Any], " n"],
    resamples: int = 500, confidence: float = 0.95,
) -> tuple[tuple[float, float], tuple[float, float]]:  # fmt: skip
    """Return intervals of :func:`roc_auc` and :func:`precision_at_base_rate`, by percentiles of a cluster bootstrap.

    Whole clusters are drawn with replacement (Davison and Hinkley, Bootstrap Methods, 1997, 3.8): those with
    a positive and those without are drawn separately, so that the base rate stays.
    """
    rank, rng = _ranks(scores, labels), np.random.default_rng(0)
    number, cluster = np.unique(clusters, return_inverse=True)
    holds = np.bincount(cluster, labels, len(number)) > 0
    kinds = [np.flatnonzero(holds), np.flatnonzero(~holds)]
    samples = []
    for _ in range(resamples):
        drawn = np.concatenate([rng.choice(kind, len(kind)) for kind in kinds if len(kind)])
        times = np.bincount(drawn, minlength=len(number))[cluster]
        masses = _masses(rank, labels, weights * times)
        samples.append((_auc(*masses), _precision(*masses)))
    low, high = _bounds(samples, confidence)
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


def _bounds(samples: Any, confidence: float) -> np.ndarray[Any, Any]:
    tail = (1.0 - confidence) / 2
    return np.quantile(samples, (tail, 1.0 - tail), axis=0)


def _ranks(scores: Numbers, labels: Labels) -> Int[np.ndarray[Any, Any], " n"]:
    """Return the rank of every score among the distinct ones, the lowest first."""
    if labels.all() or not labels.any():
        cure = "use a set that has positives and negatives"
        raise UsageError("labels are all true or all false", cure=cure)
    return np.unique(scores, return_inverse=True)[1]


def _masses(
    rank: Int[np.ndarray[Any, Any], " n"], labels: Labels, weights: Numbers | None
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return the weight of positives and of negatives, by score."""
    count, weights = int(rank.max()) + 1, np.ones(len(rank)) if weights is None else weights
    return np.bincount(rank, weights * labels, count), np.bincount(rank, weights * ~labels, count)


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
    """Return the correlation of mid-ranks (Spearman, Am. J. Psychol. 15, 1904); NaN if a list is constant."""
    with np.errstate(invalid="ignore"):
        return float(np.corrcoef(rankdata(first), rankdata(second))[0, 1])


def correlation_interval(
    first: Numbers, second: Numbers, clusters: Any, resamples: int = 200, confidence: float = 0.95
) -> tuple[float, float]:
    """Return the interval of :func:`rank_correlation`, by percentiles of a bootstrap of whole clusters.

    Davison and Hinkley, Bootstrap Methods, 1997, 3.8. (-1, 1) if there is a single cluster, or nearly all scores are
    equal.
    """
    number = np.unique(np.asarray(clusters), return_inverse=True)[1]
    members = np.split(np.argsort(number, kind="stable"), np.cumsum(np.bincount(number))[:-1])
    rng, samples = np.random.default_rng(0), []
    for _ in range(resamples):
        drawn = np.concatenate([members[n] for n in rng.integers(len(members), size=len(members))])
        samples.append(rank_correlation(first[drawn], second[drawn]))
    if len(members) < 2 or np.isnan(samples).any():
        return -1.0, 1.0
    low, high = _bounds(samples, confidence)
    return float(low), float(high)
