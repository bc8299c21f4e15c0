from __future__ import annotations

import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.stats.clusters import cluster_strata, dense_labels, design_effect, drop_undefined


def test_undefined_values_are_dropped_and_clusters_renumbered():
    x, labels = drop_undefined([1.0, None, 3.0, float("nan"), 5.0], ["b", "a", "b", "c", "d"])
    np.testing.assert_array_equal(x, [1, 3, 5])
    np.testing.assert_array_equal(labels, [0, 0, 1])
    assert list(drop_undefined([1.0, None, 2.0])[1]) == [0, 1]


def test_design_effect_by_hand():
    # Totals 3 and 7 of two values each, mean 2.5: V = 2 (4 + 4) / 16 = 1; spread 1.25, over n 0.3125.
    assert design_effect(
        np.array([1.0, 2, 3, 4]), dense_labels(["a", "a", "b", "b"], 4, "cluster")
    ) == pytest.approx(3.2)
    # Opposite values in a cluster cancel: no better than independent.
    assert design_effect(np.array([1.0, 4, 2, 3]), dense_labels(["a", "a", "b", "b"], 4, "cluster")) == 1.0
    # Where nothing varies, or all is one cluster, clusters count.
    assert design_effect(np.ones(6), dense_labels([0, 0, 0, 1, 1, 1], 6, "cluster")) == 3.0
    assert design_effect(np.array([1.0, 2, 3]), np.zeros(3, np.int64)) == 3.0
    assert design_effect(np.full(6, 0.1), np.arange(6) // 2) == 2.0, "the mean of 0.1 is rounded"


def test_design_effect_of_equal_clusters_follows_kish():
    """Kish: ``1 + (m - 1) rho`` for clusters of ``m`` (here m = 5, rho = 0.6)."""
    rng = np.random.default_rng(0)
    x = np.sqrt(0.6) * rng.normal(size=(20_000, 1)) + np.sqrt(0.4) * rng.normal(size=(20_000, 5))
    assert design_effect(x.ravel(), np.repeat(np.arange(20_000), 5)) == pytest.approx(1 + 4 * 0.6, rel=0.03)


def test_strata_of_clusters_and_their_pooling():
    labels = np.array([0, 0, 1, 2, 3, 4])
    strata = ["x", "x", "x", "y", "z", "z"]
    assert list(cluster_strata(strata, labels, minimum=1)) == [0, 0, 1, 2, 2]
    # y alone is too small, and there is nothing to take it together with but the smallest other (x before z).
    assert list(cluster_strata(strata, labels, minimum=2)) == [0, 0, 0, 1, 1]
    # y and w are small and make a stratum of two.
    assert list(cluster_strata(["x", "x", "y", "w"], np.arange(4), minimum=2)) == [0, 0, 1, 1]
    # All small: one stratum.
    assert list(cluster_strata(["x", "y"], np.arange(2), minimum=5)) == [0, 0]
    with pytest.raises(UsageError, match="lies in two strata"):
        cluster_strata(["x", "y"], np.array([0, 0]))
