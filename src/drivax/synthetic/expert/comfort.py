"""How comfortable a drive is, by nuPlan's limits and Savitzky-Golay windows, without JAX.

The quantities are those of :mod:`drivax.metrics.comfort`, over a whole recording at once.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float64

from drivax.geometry.vectors import wrap
from drivax.scenario.schema import DT_S

#: Lowest and highest longitudinal acceleration, m/s2; then the largest lateral acceleration, jerk, jerk magnitude, yaw
#: rate and yaw acceleration.
LIMITS: dict[str, tuple[float, float]] = {
    "longitudinal_mps2": (-4.05, 2.40),
    "lateral_mps2": (-4.89, 4.89),
    "jerk_mps3": (-4.13, 4.13),
    "jerk_magnitude_mps3": (-8.37, 8.37),
    "yaw_rate_rps": (-0.95, 0.95),
    "yaw_acceleration_rps2": (-1.93, 1.93),
}


@cache
def smoother(count: int, window: int, order: int, derivative: int = 0) -> Float64[np.ndarray, "count count"]:
    """The Savitzky-Golay filter (Savitzky and Golay 1964) as a matrix; at the ends the first and last polynomial hold.

    Args:
        count: Number of samples.
        window: Samples in a window; an even one is centred half a sample before its upper middle, as in SciPy.
        order: Order of the polynomial.
        derivative: Which derivative, per sample.
    """
    half = window // 2
    first = np.clip(np.arange(count) - half + (window % 2 == 0), 0, count - window)
    at = np.arange(count) - first.astype(float)
    if window % 2 == 0:
        inner = (np.arange(count) >= half) & (np.arange(count) < count - half)
        at[inner] = half - 0.5
    factorial = float(np.prod(np.arange(1, derivative + 1))) if derivative else 1.0
    rows = np.zeros((count, count))
    for row in range(count):
        powers = (np.arange(window) - at[row])[:, None] ** np.arange(order + 1)
        rows[row, first[row] : first[row] + window] = np.linalg.pinv(powers)[derivative] * factorial
    return rows


def quantities(
    heading: Float64[np.ndarray, " time"], speed: Float64[np.ndarray, " time"]
) -> dict[str, Float64[np.ndarray, " step"]]:
    """The smoothed quantities of :data:`LIMITS` at each step but the first.

    Args:
        heading: Heading, rad.
        speed: Speed along it, m/s.
    """
    turned = wrap(np.diff(heading))
    along, lateral = np.diff(speed) / DT_S, (speed[1:] + speed[:-1]) / 2 * turned / DT_S
    course = np.cumsum(turned)
    jerk = {"window": 15, "order": 2, "derivative": 1}
    return {
        "longitudinal_mps2": _smoothed(along, 8, 2),
        "lateral_mps2": _smoothed(lateral, 8, 2),
        "jerk_mps3": _smoothed(along, **jerk),
        "jerk_magnitude_mps3": _smoothed(np.hypot(along, lateral), **jerk),
        "yaw_rate_rps": _smoothed(course, **jerk),
        "yaw_acceleration_rps2": _smoothed(course, 15, 3, 2),
    }


def _smoothed(
    values: Float64[np.ndarray, " n"], window: int, order: int, derivative: int = 0
) -> Float64[np.ndarray, " n"]:
    # Not by BLAS, whose last bits depend on the number of threads.
    weights = smoother(len(values), window, order, derivative)
    return np.einsum("ij,j->i", weights, values) / DT_S**derivative


def broken_limits(
    heading: Float64[np.ndarray, " time"], speed: Float64[np.ndarray, " time"]
) -> tuple[str, ...]:
    """The quantities that exceed their limits, in the order of :data:`LIMITS`.

    Args:
        heading: Heading, rad.
        speed: Speed, m/s.
    """
    return tuple(
        name
        for name, values in quantities(heading, speed).items()
        if values.min() < LIMITS[name][0] or values.max() > LIMITS[name][1]
    )


def discomfort(heading: Float64[np.ndarray, " time"], speed: Float64[np.ndarray, " time"]) -> str:
    """The first of :func:`broken_limits`, or an empty string."""
    return next(iter(broken_limits(heading, speed)), "")
