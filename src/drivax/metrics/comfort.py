"""Comfort by nuPlan's limits and Savitzky-Golay windows, one step at a time.

Jerk is the derivative over 15 samples of accelerations that are smoothed over 8, so a simulation evaluates step t - 11
at step t and the last twelve steps when the episode ends; the edge is SciPy's ``interp`` mode. The result equals
``scipy.signal.savgol_filter`` over the whole episode (tests). Windows and orders are those that nuPlan's devkit uses
(decision 0011).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from drivax.geometry.vectors import wrap
from drivax.scenario.record import record
from drivax.scenario.schema import DT_S

#: Samples of the window of jerk, and how many trailing steps are evaluated at once when an episode ends.
WINDOW, TAIL = 15, 12
#: Windows, orders and derivatives: smoothed acceleration, jerk of it, yaw rate, yaw acceleration.
SMOOTH, JERK, YAW_RATE, YAW_ACCELERATION = (8, 2, 0), (15, 2, 1), (5, 2, 1), (5, 3, 2)
#: Motions that the last steps depend on, and the first acceleration whose smoothed value does not change any more.
_SAMPLES, _SETTLED = 23, 4
#: nuPlan's closed-loop limits: m/s2, m/s2, m/s3, m/s3, rad/s, rad/s2.
LONGITUDINAL_MPS2 = (-4.05, 2.40)
LATERAL_MPS2, JERK_MPS3, JERK_MAGNITUDE_MPS3 = 4.89, 4.13, 8.37
YAW_RATE_RPS, YAW_ACCELERATION_RPS2 = 0.95, 1.93


@cache
def savgol_tail_matrix(window: int, order: int, derivative: int) -> np.ndarray[Any, Any]:
    """Return the Savitzky-Golay filter as a matrix ``[19, 22]`` from the last 22 samples to the values at the last 19.

    Row 0 is an interior point; the last ``window // 2`` rows are read off the last window's polynomial.
    """
    # A sample before the first keeps its even window an interior one.
    return savgol_matrix(_SAMPLES, window, order, derivative)[_SETTLED:, 1:]


@cache
def savgol_matrix(samples: int, window: int, order: int, derivative: int) -> np.ndarray[Any, Any]:
    """Return the Savitzky-Golay filter of a number of samples as a matrix ``[samples, samples]``.

    Least-squares polynomial of ``order`` over ``window`` samples, differentiated ``derivative`` times per sample
    (Savitzky and Golay 1964). Rows near an end are read off the polynomial of the first or last window. As in SciPy,
    an even window's interior value belongs to half a sample later.
    """
    half = window // 2
    rows = np.zeros((samples, samples))
    for at in range(samples):
        interior = half <= at < samples - half
        first = at - half + (window % 2 == 0) if interior else (0 if at < half else samples - window)
        where = (half - 0.5 if window % 2 == 0 else half) if interior else at - first
        rows[at, first : first + window] = _weights(window, order, derivative, where)
    return rows


def _weights(window: int, order: int, derivative: int, where: float) -> np.ndarray[Any, Any]:
    """Return the weights of the derivative of the fitted polynomial at sample position ``where``."""
    powers = (np.arange(window) - where)[:, None] ** np.arange(order + 1)
    factorial = float(np.prod(np.arange(1, derivative + 1))) if derivative else 1.0
    return np.linalg.pinv(powers)[derivative] * factorial


@record
class ComfortSteps:
    """Comfort and measurements of consecutive steps, oldest first."""

    comfortable: Bool[Array, " steps"]
    jerk_mps3: Float[Array, " steps"]
    lateral_mps2: Float[Array, " steps"]


def check_trip_comfort(motion: Float[Array, "time 4"]) -> ComfortSteps:
    """Evaluate a trip (x, y, heading, speed; at least 23 rows) from row 11 on, the first with centred windows.

    For plots and tables; an episode evaluates the same steps one by one.
    """
    windows = jnp.arange(len(motion) - _SAMPLES + 1)[:, None] + jnp.arange(_SAMPLES)
    steps = jax.vmap(check_comfort)(motion[windows])
    return jax.tree.map(lambda part: jnp.concatenate([part[:-1, 0], part[-1]]), steps)


def check_comfort(history: Float[Array, "history 4"]) -> ComfortSteps:
    """Evaluate the last twelve steps of a motion history (23 rows of x, y, heading, speed) against the limits.

    Row 0, eleven steps back, is final; the later rows are those of SciPy's edge mode if the history ended now.
    """
    speed = history[:, 3]
    turned = wrap(history[1:, 2] - history[:-1, 2])
    heading = jnp.cumsum(turned)
    along = (speed[1:] - speed[:-1]) / DT_S
    lateral = (speed[1:] + speed[:-1]) / 2 * turned / DT_S

    def filtered(signal: Array, window: tuple[int, int, int]) -> Array:
        matrix = jnp.asarray(savgol_tail_matrix(*window), jnp.float32)
        return matrix @ signal / DT_S ** window[2]

    def jerk(smoothed: Array) -> Array:
        matrix = savgol_matrix(_SAMPLES, *JERK)[-TAIL:, _SETTLED:]
        return jnp.asarray(matrix, jnp.float32) @ smoothed / DT_S

    smooth = filtered(along, SMOOTH)
    lateral_mps2 = jnp.abs(filtered(lateral, SMOOTH)[-TAIL:])
    magnitude = jnp.abs(jerk(filtered(jnp.sqrt(along**2 + lateral**2 + 1e-12), SMOOTH)))
    fine = (smooth[-TAIL:] >= LONGITUDINAL_MPS2[0]) & (smooth[-TAIL:] <= LONGITUDINAL_MPS2[1])
    fine &= (lateral_mps2 <= LATERAL_MPS2) & (magnitude <= JERK_MAGNITUDE_MPS3)
    fine &= jnp.abs(jerk(smooth)) <= JERK_MPS3
    fine &= jnp.abs(filtered(heading, YAW_RATE)[-TAIL:]) <= YAW_RATE_RPS
    fine &= jnp.abs(filtered(heading, YAW_ACCELERATION)[-TAIL:]) <= YAW_ACCELERATION_RPS2
    return ComfortSteps(fine, magnitude, lateral_mps2)
