"""Effect sizes by hand; power against textbook values, SciPy's noncentral t and simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.stats

from drivax.errors import UsageError
from drivax.stats.effects import (
    PairedEffect,
    cohens_d,
    cohens_d_paired,
    detectable_effect,
    power,
    scenarios_needed,
)


def test_effect_sizes_by_hand():
    # Differences 1, 1, 4: mean 2, deviation sqrt(3). Variances of (2, 3, 7) and (1, 2, 3): 7 and 1.
    result = cohens_d_paired([2.0, 3.0, 7.0, None], [1.0, 2.0, 3.0, 5.0])
    assert result.d_z == pytest.approx(2 / math.sqrt(3)) and result.d_av == pytest.approx(2 / math.sqrt(4))
    # Means 4 and 2, pooled variance (2 * 7 + 2 * 1) / 4 = 4.
    assert cohens_d([2.0, 3.0, 7.0], [1.0, 2.0, 3.0, None]) == pytest.approx(2 / 2)
    assert cohens_d([1.0, 1.0], [1.0, 1.0]) is None and cohens_d([1.0], [2.0, 3.0]) is None
    assert cohens_d_paired([1.0], [2.0]) == PairedEffect(None, None)
    assert cohens_d_paired([2.0, 3.0], [1.0, 2.0]).d_z is None, "no spread of the differences"


def test_sample_sizes_equal_those_of_cohen():
    """Cohen 1988, table 2.4.1: 64 in each of two groups for d = 0.5; 34 and 199 pairs for 0.5 and 0.2."""
    assert scenarios_needed(0.5) == 34 and scenarios_needed(0.2) == 199
    assert scenarios_needed(0.5, share=0.5) == 128 and scenarios_needed(0.8, share=0.5) in (51, 52)
    # Minus one: not enough.
    assert power(0.5, 33) < 0.8 <= power(0.5, 34)
    # 1,000 pairs, as the published experiment asks for, find an effect of nine hundredths.
    assert detectable_effect(1000) == pytest.approx(0.0887, abs=1e-4)


@pytest.mark.parametrize(("effect", "n"), [(0.3, 20), (0.05, 2500), (0.0887, 1000), (1.2, 8), (0.0, 50)])
def test_power_is_the_noncentral_t(effect, n):
    bound = scipy.stats.t.ppf(0.975, n - 1)
    shift = effect * math.sqrt(n)
    expected = scipy.stats.nct.sf(bound, n - 1, shift) + scipy.stats.nct.cdf(-bound, n - 1, shift)
    assert power(effect, n) == pytest.approx(expected, abs=1e-6)


def test_power_by_simulation():
    x = np.random.default_rng(0).normal(0.4, 1, (20_000, 40))
    rejected = scipy.stats.ttest_1samp(x, 0, axis=1).pvalue < 0.1
    assert power(0.4, 40, confidence=0.9) == pytest.approx(rejected.mean(), abs=0.01)


def test_power_of_two_pairs():
    """One degree of freedom: T is a normal variable over the absolute value of another."""
    rng, bound = np.random.default_rng(1), scipy.stats.t.ppf(0.975, 1)
    for effect in (10.0, 17.0):
        t = rng.normal(effect * math.sqrt(2), 1, 100_000) / rng.normal(0, 1, 100_000)
        assert power(effect, 2) == pytest.approx((np.abs(t) > bound).mean(), abs=0.005)


def test_power_at_its_ends():
    assert power(5.0, 1000) == 1.0 and power(1.0, 1) == 0.0 and power(1.0, 2, share=0.5) == 0.0
    assert power(-0.5, 34) == power(0.5, 34)
    assert scenarios_needed(1e-3) == pytest.approx(
        (scipy.stats.norm.ppf([0.975, 0.8]).sum() / 1e-3) ** 2, rel=1e-4
    )
    assert detectable_effect(1) is None
    for share in (None, 0.3):
        least = detectable_effect(200, 0.9, 0.99, share)
        assert power(least, 200, 0.99, share) == pytest.approx(0.9, abs=1e-9)
    # An uneven split needs more.
    assert scenarios_needed(0.3, share=0.2) > scenarios_needed(0.3, share=0.5)


@pytest.mark.parametrize(
    "call",
    [
        lambda: power(1.0, 10, confidence=1.0),
        lambda: scenarios_needed(0.0),
        lambda: scenarios_needed(math.nan),
        lambda: scenarios_needed(0.1, 1.0),
        lambda: power(math.nan, 10),
        lambda: detectable_effect(100, 1.5),
    ],
)
def test_impossible_arguments_are_refused_in_one_line(call):
    with pytest.raises(UsageError) as caught:
        call()
    assert "\n" not in str(caught.value) and caught.value.cure
