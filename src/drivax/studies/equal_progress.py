"""Two drivers at the same progress: the faster one drives slower until it gets no further than the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Values = Float[np.ndarray, "_ scenario"]
#: Values of a driver by speed limiter (share of the speed limit; 1: none) and metric, a row per seed.
BySpeed = Mapping[float, Mapping[str, Values]]


class ProgressError(Exception):
    """A driver gets further than the other even at its lowest speed; ``faster``: the first (0) or the second (1)."""

    def __init__(self, faster: int) -> None:
        super().__init__(f"driver {faster} makes more progress even at its lowest speed")
        self.faster = faster


@dataclass(frozen=True)
class EqualProgress:
    """A metric of two drivers at the same progress.

    Attributes:
        values: Values of the first and the second driver, NaN where a metric is undefined at any speed.
        slower: Which driver is slowed down: 0 or 1.
        share: Its speed limiter, interpolated, as a share of the speed limit.
    """

    values: tuple[Values, Values]
    slower: int
    share: float


def match_progress(
    first: BySpeed, second: BySpeed, metric: str, weights: Float[np.ndarray, " scenario"]
) -> EqualProgress:
    """Return a metric of two drivers at the lower ``progress_ratio`` of both.

    The faster driver's metric m is interpolated linearly between the two speeds whose progress p encloses the other
    driver's progress P. With the slope b of m over p, the result has the values of m - b (p - P): mixed over both
    speeds for the faster driver, at full speed for the other. Their means are the interpolated ones, and their variance
    is that of the interpolated difference (delta method): the errors of m and p at both speeds, and of P.

    Raises:
        ProgressError: The faster driver gets further even at its lowest speed.
    """
    drivers = first, second
    names = ("progress_ratio", metric)
    every_value = [episodes[name] for driver in drivers for episodes in driver.values() for name in names]
    is_defined = (weights > 0.0) & ~np.isnan(np.concatenate(every_value)).any(axis=0)
    if not is_defined.any():
        undefined = [np.full_like(driver[1.0][metric], np.nan) for driver in drivers]
        return EqualProgress((undefined[0], undefined[1]), 0, 1.0)

    def mean(values: Values) -> float:
        return float(np.average(values[:, is_defined].mean(axis=0), weights=weights[is_defined]))

    progress = [{speed: mean(e["progress_ratio"]) for speed, e in driver.items()} for driver in drivers]
    faster = int(progress[1][1.0] >= progress[0][1.0])
    target, speeds = progress[1 - faster][1.0], sorted(drivers[faster], reverse=True)
    below = next((k for k, speed in enumerate(speeds) if k and progress[faster][speed] <= target), None)
    if below is None:
        raise ProgressError(faster)
    upper, lower = speeds[below - 1 : below + 1]
    high, low = progress[faster][upper], progress[faster][lower]
    range_of_progress = (high - low) or 1.0
    mix = (high - target) / range_of_progress
    of_upper, of_lower = (drivers[faster][speed] for speed in (upper, lower))
    slope = (mean(of_upper[metric]) - mean(of_lower[metric])) / range_of_progress

    def adjusted(episodes: Mapping[str, Values]) -> Values:
        values = episodes[metric] - slope * (episodes["progress_ratio"] - target)
        return np.where(is_defined, values, np.nan)

    mixed = (1.0 - mix) * adjusted(of_upper) + mix * adjusted(of_lower)
    other = adjusted(drivers[1 - faster][1.0])
    share = upper + mix * (lower - upper)
    return EqualProgress((other, mixed) if faster else (mixed, other), faster, share)
