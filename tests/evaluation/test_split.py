from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.evaluation.pairing import assign, strata_of

CLUSTERS = [f"r{number // 2}" for number in range(120)]
#: A third of the recordings is hard; some of the others have one hard scenario of two.
HARD = ["hard" if (n // 2) % 3 == 0 or n % 8 == 3 else "easy" for n in range(120)]


def test_split_assigns_whole_recordings_in_the_ratio():
    result = assign(CLUSTERS, None, 0.25, seed=1)
    arms = {cluster: set() for cluster in CLUSTERS}
    for cluster, in_first in zip(CLUSTERS, result.first, strict=True):
        arms[cluster].add(bool(in_first))
    assert all(len(arm) == 1 for arm in arms.values()) and result.first.sum() == 30
    assert result.strata_count == 1
    np.testing.assert_array_equal(result.first, assign(CLUSTERS, None, 0.25, seed=1).first)
    assert (result.first != assign(CLUSTERS, None, 0.25, seed=2).first).any()


def test_strata_are_split_in_halves():
    result = assign(CLUSTERS, HARD, 0.5, seed=0)
    assert result.strata_count == 2
    for stratum in range(2):
        in_first = result.first[result.strata == stratum]
        assert abs(int(in_first.sum()) - int((~in_first).sum())) <= 2, "two scenarios of a recording"
    # A recording with one scenario of each belongs to the stratum that is first by name: easy.
    sizes = Counter(result.strata.tolist())
    assert sizes == {0: 80, 1: 40}


def test_rounding_errors_carry_over_to_the_next_stratum():
    """Ten strata of eleven recordings are split into halves, although no stratum can be halved."""
    clusters = [str(number) for number in range(110)]
    result = assign(clusters, [f"{number % 10}" for number in range(110)], 0.5, seed=0)
    assert result.first.sum() == 55 and result.strata_count == 10


def test_small_strata_are_merged():
    clusters = [str(number) for number in range(40)]
    strata = ["common"] * 28 + ["rare"] * 7 + ["rarer"] * 5
    result = assign(clusters, strata, 0.5, seed=0)
    assert result.strata_count == 2 and Counter(result.strata.tolist()) == {0: 28, 1: 12}


def test_empty_arm_is_refused():
    with pytest.raises(UsageError, match="leave an arm empty"):
        assign(["a", "a"], None, 0.5, seed=0)


def test_strata_are_the_values_of_tags():
    entries = [{"tags": {"difficulty": "hard", "type": "straight"}}, {"tags": {"type": "merge"}}]
    assert strata_of(entries, ["difficulty", "type"]) == ["hard straight", "unknown merge"]
    with pytest.raises(UsageError, match=r"no scenario has a tag 'dificulty'.*difficulty"):
        strata_of(entries, ["dificulty"])
