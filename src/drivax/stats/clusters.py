"""Clustered values: windows of one recording (``segment``) are not independent.

Whole clusters are resampled, flipped or assigned, optionally within strata (types of scenarios).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from drivax.errors import UsageError

Values = Float64[np.ndarray, " n"]
Labels = Int64[np.ndarray, " n"]
#: Sums by cluster.
Totals = Float64[np.ndarray, " cluster"]
#: Stratum of each cluster.
Strata = Int64[np.ndarray, " cluster"]


def recordings(datasets: Iterable[str], segments: Iterable[str], scenarios: Iterable[str]) -> list[str]:
    """Return the cluster of each scenario: its recording (``segment``), or the scenario itself if that is unknown."""
    names = zip(datasets, segments, scenarios, strict=True)
    return [f"{dataset}/{segment or scenario}" for dataset, segment, scenario in names]


def recordings_of(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the recording of each scenario of a set, given the entries of its manifest."""
    names = ("dataset", "segment", "scenario_id")
    return recordings(*([str(entry[name]) for entry in entries] for name in names))


def as_values(values: Any) -> Values:
    """Convert to float64, with NaN for undefined values.

    Raises:
        UsageError: A value is infinite or not numeric, or the values are not a flat list.
    """
    problem = "values must be a list of finite numbers, NaN or None"
    try:
        x = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UsageError(problem, cure="give one number per episode") from error
    if x.ndim != 1:
        raise UsageError(problem, cure="give one number per episode")
    if np.isinf(x).any():
        raise UsageError(problem, cure="replace infinite values by None")
    return x


def paired_differences(a: Any, b: Any) -> Values:
    """Return ``a - b`` by pair; NaN if either value is undefined."""
    first, second = as_values(a), as_values(b)
    if first.shape != second.shape:
        problem = f"pairs need lists of equal length, not {first.size} and {second.size}"
        raise UsageError(problem, cure="pair by scenario first")
    return first - second


def drop_undefined(values: Any, clusters: Any = None) -> tuple[Values, Labels]:
    """Return the defined values and their dense cluster labels; by default each value is a cluster."""
    x = as_values(values)
    labels, keep = dense_labels(clusters, x.size, "cluster"), ~np.isnan(x)
    return x[keep], dense_labels(labels[keep], int(keep.sum()), "cluster")


def dense_labels(labels: Any, count: int, kind: str) -> Labels:
    """Return labels as integers from 0 on without gaps; None gives each of ``count`` values its own label.

    Raises:
        UsageError: The number of labels is not ``count``; the message calls them ``kind``.
    """
    if labels is None:
        return np.arange(count, dtype=np.int64)
    if len(labels) != count:
        problem = f"{len(labels)} {kind} labels for {count} values"
        raise UsageError(problem, cure=f"give one {kind} label per value")
    return np.unique(np.asarray(labels), return_inverse=True)[1].astype(np.int64)


def cluster_totals(x: Values, labels: Labels) -> tuple[Totals, Totals]:
    """Return the sum and the number of values of each cluster."""
    return np.bincount(labels, weights=x), np.bincount(labels).astype(np.float64)


def design_effect(x: Values, labels: Labels) -> float:
    """Return the variance of a mean relative to that of independent values, between 1 and ``n``.

    ``deff = V / (s^2 / n)``. ``V = C / (C - 1) * sum((S_c - m n_c)^2) / n^2`` is the variance of the ratio of cluster
    totals (Kish, Survey Sampling, 1965, section 8.2; Cochran, Sampling Techniques, 1977, section 6.3), and ``s^2`` the
    mean squared deviation, ``p (1 - p)`` for shares. If all values are equal, or there is only one cluster, ``V``
    cannot be estimated; each cluster then counts as one value: ``n / C``.
    """
    sums, counts = cluster_totals(x, labels)
    n, clusters, mean = x.size, sums.size, float(x.mean())
    if clusters == n:
        return 1.0
    if clusters == 1 or (x == x[0]).all():
        return n / clusters
    value_variance = float(np.square(x - mean).mean())
    mean_variance = clusters / (clusters - 1) * float(np.square(sums - mean * counts).sum()) / n**2
    return min(max(1.0, mean_variance / (value_variance / n)), float(n))


def cluster_strata(strata: Any, labels: Labels, minimum: int = 2) -> Strata:
    """Return the stratum of each cluster, given the stratum and the dense cluster label of each value.

    Strata with fewer than ``minimum`` clusters are pooled; a pool that is still too small joins the smallest other
    stratum (Cochran 1977, section 5A.12, "collapsed strata").

    Raises:
        UsageError: A cluster lies in two strata.
    """
    value_strata = dense_labels(strata, labels.size, "stratum")
    _, first_index = np.unique(labels, return_index=True)
    stratum = value_strata[first_index]
    if (stratum[labels] != value_strata).any():
        raise UsageError("a cluster lies in two strata", cure="give all values of a cluster one stratum")
    sizes = np.bincount(stratum)
    stratum = np.where(sizes[stratum] < minimum, sizes.size, stratum)
    sizes = np.bincount(stratum, minlength=sizes.size + 1)
    candidates = np.flatnonzero(sizes[:-1])
    if 0 < sizes[-1] < minimum and candidates.size:
        stratum = np.where(stratum == sizes.size - 1, candidates[sizes[candidates].argmin()], stratum)
    return dense_labels(stratum, stratum.size, "stratum")
