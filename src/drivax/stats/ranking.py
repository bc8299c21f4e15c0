"""Ranking quality of scores: AUC, precision at the base rate, and rank correlation.

Labels are true for positives. Functions of labels raise UsageError without positives or without negatives.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from drivax.errors import UsageError
from drivax.stats.intervals import check_draws, normal_quantile, percentiles

Numbers = Float[np.ndarray[Any, Any], " n"]
Labels = Bool[np.ndarray[Any, Any], " n"]


def roc_auc(scores: Numbers, labels: Labels, weights: Numbers | None = None) -> float:
    """Return the probability that a positive scores above a negative; ties count half (Hanley and McNeil, 1982)."""
    return _auc(*_weights_by_rank(_ranks(scores, labels), labels, weights))


def auc_interval(scores: Numbers, labels: Labels, confidence: float = 0.95) -> tuple[float, float]:
    """Return the interval of :func:`roc_auc` by DeLong, DeLong and Clarke-Pearson (Biometrics 44, 1988), within [0, 1].

    Raises:
        UsageError: There are fewer than two positives or negatives, or the confidence is outside (0, 1).
    """
    quantile = normal_quantile(confidence)
    positive, negative = scores[labels], scores[~labels]
    if min(len(positive), len(negative)) < 2:
        raise UsageError("an interval needs two positives and two negatives", cure="use a larger set")
    ranks = _mean_ranks(scores)
    positive_share = (ranks[labels] - _mean_ranks(positive)) / len(negative)
    negative_share = 1.0 - (ranks[~labels] - _mean_ranks(negative)) / len(positive)
    error = np.sqrt(positive_share.var(ddof=1) / len(positive) + negative_share.var(ddof=1) / len(negative))
    margin = float(quantile * error)
    auc = float(positive_share.mean())
    return max(auc - margin, 0.0), min(auc + margin, 1.0)


def precision_at_base_rate(scores: Numbers, labels: Labels, weights: Numbers | None = None) -> float:
    """Return the precision among the ``k`` highest scores, where ``k`` is the number (or weight) of positives.

    Ties at the threshold count in proportion. A perfect ranking has 1, a random one the base rate.
    """
    return _precision(*_weights_by_rank(_ranks(scores, labels), labels, weights))


def bootstrap_intervals(
    scores: Numbers, labels: Labels, weights: Numbers, clusters: Int[np.ndarray[Any, Any], " n"],
    resamples: int = 500, confidence: float = 0.95,
) -> tuple[tuple[float, float], tuple[float, float]]:  # fmt: skip
    """Return cluster-bootstrap percentile intervals of :func:`roc_auc` and :func:`precision_at_base_rate`.

    Clusters with and without positives are drawn separately, so each resample has as many of each as the data (Davison
    and Hinkley, Bootstrap Methods, 1997, section 3.8).
    """
    check_draws(resamples, confidence)
    rank, rng = _ranks(scores, labels), np.random.default_rng(0)
    names, cluster = np.unique(clusters, return_inverse=True)
    has_positive = np.bincount(cluster, labels, len(names)) > 0
    groups = [np.flatnonzero(has_positive), np.flatnonzero(~has_positive)]
    samples = []
    for _ in range(resamples):
        draws = np.concatenate([rng.choice(group, len(group)) for group in groups if len(group)])
        draw_counts = np.bincount(draws, minlength=len(names))[cluster]
        by_rank = _weights_by_rank(rank, labels, weights * draw_counts)
        samples.append((_auc(*by_rank), _precision(*by_rank)))
    auc, precision = np.array(samples).T
    return percentiles(auc, confidence), percentiles(precision, confidence)


def _ranks(scores: Numbers, labels: Labels) -> Int[np.ndarray[Any, Any], " n"]:
    """Return the index of each score among the sorted distinct scores."""
    if labels.all() or not labels.any():
        cure = "use a set that has positives and negatives"
        raise UsageError("labels are all true or all false", cure=cure)
    return np.unique(scores, return_inverse=True)[1]


def _weights_by_rank(
    rank: Int[np.ndarray[Any, Any], " n"], labels: Labels, weights: Numbers | None
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return the total weight of positives and of negatives at each rank."""
    count, weights = int(rank.max()) + 1, np.ones(len(rank)) if weights is None else weights
    return np.bincount(rank, weights * labels, count), np.bincount(rank, weights * ~labels, count)


def _auc(positive: np.ndarray[Any, Any], negative: np.ndarray[Any, Any]) -> float:
    """Return the AUC from the weights of positives and negatives by rank."""
    below = np.cumsum(negative) - negative
    with np.errstate(invalid="ignore"):  # NaN for a resample without negatives
        return float(np.sum(positive * (below + negative / 2)) / (positive.sum() * negative.sum()))


def _precision(positive: np.ndarray[Any, Any], negative: np.ndarray[Any, Any]) -> float:
    """Return the precision at the base rate from the weights of positives and negatives by rank."""
    positive, total = positive[::-1], (positive + negative)[::-1]
    count = positive.sum()
    remaining = count - (np.cumsum(total) - total)
    included_share = np.clip(np.divide(remaining, total, out=np.zeros_like(total), where=total > 0), 0.0, 1.0)
    return float(np.sum(positive * included_share) / count)


def rank_correlation(first: Numbers, second: Numbers) -> float:
    """Return Spearman's rank correlation (Am. J. Psychol. 15, 1904); NaN if a list is constant or empty."""
    if len(first) < 2:  # NumPy would warn
        return float("nan")
    with np.errstate(invalid="ignore"):
        return float(np.corrcoef(_mean_ranks(first), _mean_ranks(second))[0, 1])


def correlation_interval(
    first: Numbers, second: Numbers, clusters: Any, resamples: int = 200, confidence: float = 0.95
) -> tuple[float, float]:
    """Return the cluster-bootstrap percentile interval of :func:`rank_correlation`.

    Davison and Hinkley, Bootstrap Methods, 1997, section 3.8. The interval is (-1, 1) for a single cluster, or if a
    resample has constant scores.
    """
    check_draws(resamples, confidence)
    labels = np.unique(np.asarray(clusters), return_inverse=True)[1]
    members = np.split(np.argsort(labels, kind="stable"), np.cumsum(np.bincount(labels))[:-1])
    rng, samples = np.random.default_rng(0), []
    for _ in range(resamples):
        draws = rng.integers(len(members), size=len(members))
        indices = np.concatenate([members[cluster] for cluster in draws])
        samples.append(rank_correlation(first[indices], second[indices]))
    if len(members) < 2 or np.isnan(samples).any():
        return -1.0, 1.0
    return percentiles(np.array(samples), confidence)


def _mean_ranks(values: Numbers) -> Numbers:
    """Return the ranks of values, the mean of ranks for equal ones."""
    from scipy.stats import rankdata  # takes 0.3 s to import

    return rankdata(values)
