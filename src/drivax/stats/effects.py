"""Effect sizes, power, and the number of scenarios needed to detect a difference."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivax.errors import UsageError
from drivax.stats.clusters import as_values, paired_differences

#: Relative deviations below this are rounding errors.
ROUNDING = 1e-9
#: Upper bound of :func:`scenarios_needed`.
_MAX_SCENARIOS = 10**12


@dataclass(frozen=True)
class PairedEffect:
    """Standardised mean differences of pairs; None if their divisor is 0 or fewer than two pairs are defined.

    Power depends on ``d_z``; ``d_av`` is comparable with an unpaired d.
    """

    d_z: float | None
    d_av: float | None


def cohens_d_paired(a: Any, b: Any) -> PairedEffect:
    """Return Cohen's d of pairs, ``d_z = m / s(a - b)`` and ``d_av = m / sqrt((s(a)^2 + s(b)^2) / 2)``.

    Cohen, Statistical Power Analysis, 1988, section 2.3.5 (``d_z``); Cumming, Understanding the New Statistics, 2012,
    chapter 11 (``d_av``). Standard deviations divide by ``n - 1``. Pairs with an undefined value are ignored.
    """
    difference = paired_differences(a, b)
    keep = ~np.isnan(difference)
    if keep.sum() < 2:
        return PairedEffect(None, None)
    difference, first, second = difference[keep], as_values(a)[keep], as_values(b)[keep]
    mean, average_deviation = difference.mean(), math.sqrt((first.var(ddof=1) + second.var(ddof=1)) / 2)
    return PairedEffect(_ratio(mean, difference.std(ddof=1)), _ratio(mean, average_deviation))


def cohens_d(a: Any, b: Any) -> float | None:
    """Return Cohen's d of two independent samples, ``(m_a - m_b) / s`` with the pooled deviation (Cohen 1988, 2.5).

    The result is None if neither sample varies, or if one has fewer than two defined values.
    """
    first, second = (values[~np.isnan(values)] for values in (as_values(a), as_values(b)))
    if min(first.size, second.size) < 2:
        return None
    return _ratio(first.mean() - second.mean(), pooled_deviation(first, second))


def pooled_deviation(a: Any, b: Any) -> float:
    """Return the pooled standard deviation, ``sqrt(((n_a - 1) s_a^2 + (n_b - 1) s_b^2) / (n_a + n_b - 2))``."""
    first, second = as_values(a), as_values(b)
    squares = sum(float(np.square(sample - sample.mean()).sum()) for sample in (first, second))
    return math.sqrt(squares / (first.size + second.size - 2))


def _ratio(difference: Any, deviation: Any) -> float | None:
    return float(difference / deviation) if deviation > ROUNDING * abs(difference) else None


def power(effect: float, n: float, confidence: float = 0.95, share: float | None = None) -> float:
    """Return the probability that a two-sided t-test detects an effect.

    It is ``P(|T| > t)`` with noncentral t. Pairs have ``n - 1`` degrees of freedom and noncentrality ``d sqrt(n)``, two
    arms ``n - 2`` and ``d sqrt(n w (1 - w))`` (Cohen 1988, section 2.3; Johnson, Kotz and Balakrishnan, Continuous
    Univariate Distributions 2, 1995, chapter 31).

    Args:
        effect: ``d_z`` of pairs, or Cohen's d of two arms.
        n: Number of pairs, or of scenarios of both arms; may be fractional (an effective sample size).
        confidence: 1 - significance level.
        share: ``w``, the share of the first arm; None for pairs.
    """
    from scipy import special  # takes 0.1 s to import

    if not (0 < confidence < 1 and (share is None or 0 < share < 1) and n > 0) or math.isnan(effect):
        cure = "confidence and share lie between 0 and 1, n above 0, and the effect is a number"
        raise UsageError("effect, confidence, share or n out of range", cure=cure)
    dof = n - (1 if share is None else 2)
    if dof <= 0:
        return 0.0
    noncentrality = abs(effect) * math.sqrt(n if share is None else n * share * (1 - share))
    critical = float(special.stdtrit(dof, (1 + confidence) / 2))
    lower_cdf, upper_cdf = (float(special.nctdtr(dof, noncentrality, t)) for t in (-critical, critical))
    if noncentrality - critical > 10 or math.isnan(upper_cdf):
        # The numerator of T is almost constant, so use the distribution of its denominator; SciPy may return NaN.
        return float(special.chdtr(dof, dof * (noncentrality / critical) ** 2))
    # SciPy returns NaN for some lower tails that are negligible.
    return min(1.0, 1.0 - upper_cdf + (lower_cdf if math.isfinite(lower_cdf) else 0.0))


def scenarios_needed(
    effect: float, target: float = 0.8, confidence: float = 0.95, share: float | None = None
) -> int:
    """Return the smallest number of independent scenarios that detects an effect with power ``target``.

    The number counts pairs, or the scenarios of both arms; about 1e12 means that many or more. Clustered scenarios need
    :func:`~drivax.stats.clusters.design_effect` times as many. Other arguments are those of :func:`power`.
    """
    _check_target(target)
    if not abs(effect) > 0:
        raise UsageError(f"no number of scenarios detects an effect of {effect}", cure="give an effect")
    low, high = 1, 2
    while power(effect, high, confidence, share) < target and high < _MAX_SCENARIOS:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if power(effect, middle, confidence, share) >= target else (middle, high)
    return high


def detectable_effect(
    n: float, target: float = 0.8, confidence: float = 0.95, share: float | None = None
) -> float | None:
    """Return the smallest effect that is detected with power ``target``; None if ``n`` is too small for any effect."""
    _check_target(target)
    low, high = 0.0, 1.0
    while power(high, n, confidence, share) < target:
        if high > 1e6:
            return None
        high *= 2
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if power(middle, n, confidence, share) >= target else (middle, high)
    return high


def _check_target(target: float) -> None:
    if not 0 < target < 1:
        raise UsageError(f"power {target} is impossible", cure="give a power between 0 and 1")
