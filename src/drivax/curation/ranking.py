"""How well scores rank what is to be found above everything else."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import norm, rankdata

from drivax.errors import UsageError

Numbers = Float[np.ndarray[Any, Any], " n"]
Labels = Bool[np.ndarray[Any, Any], " n"]


def roc_auc(scores: Numbers, labels: Labels, weights: Numbers | None = None) -> float:
    """Chance that what is to be found scores above what is not; a tie counts half (Hanley and McNeil, 1982).

    Args:
        scores: Of everything.
        labels: What is to be found.
        weights: How much each counts; all alike by default.

    Raises:
        UsageError: There is nothing to be found, or nothing else.
    """
    _check(labels)
    weights = np.ones(len(scores)) if weights is None else weights
    values, place = np.unique(scores, return_inverse=True)
    found = np.bincount(place, weights * labels, len(values))
    other = np.bincount(place, weights * ~labels, len(values))
    below = np.cumsum(other) - other
    return float(np.sum(found * (below + other / 2)) / (found.sum() * other.sum()))


def auc_interval(scores: Numbers, labels: Labels, confidence: float = 0.95) -> tuple[float, float]:
    """Interval of :func:`roc_auc`, by DeLong, DeLong and Clarke-Pearson (Biometrics 44, 1988), within [0, 1].

    The variance is that of each one's share of others that it is ranked rightly against, over their number, summed
    over both kinds.

    Raises:
        UsageError: There are fewer than two of a kind.
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
    """Share of what is to be found among the highest scores, if as many are taken as there are to be found.

    1 for a perfect ranking, the base rate itself for one by chance. Of equal scores at the edge a share is taken.

    Raises:
        UsageError: There is nothing to be found, or nothing else.
    """
    _check(labels)
    weights = np.ones(len(scores)) if weights is None else weights
    values, place = np.unique(-scores, return_inverse=True)
    every = np.bincount(place, weights, len(values))
    found = np.bincount(place, weights * labels, len(values))
    wanted = found.sum()
    taken = np.clip((wanted - (np.cumsum(every) - every)) / every, 0.0, 1.0)
    return float(np.sum(found * taken) / wanted)


def rank_correlation(one: Numbers, other: Numbers) -> float:
    """The correlation of mid-ranks (Spearman, Am. J. Psychol. 15, 1904); NaN where one of them is constant."""
    with np.errstate(invalid="ignore"):
        return float(np.corrcoef(rankdata(one), rankdata(other))[0, 1])


def _check(labels: Labels) -> None:
    if labels.all() or not labels.any():
        raise UsageError("there is nothing to find, or nothing else", cure="use a set that has both")
