"""Comfort by nuPlan's limits and Savitzky-Golay windows, one step at a time.

Jerk is the derivative over 15 samples of accelerations that are smoothed over 8 samples. A simulation therefore
evaluates step t - 11 at step t, and the last twelve steps at the end of the episode, as in SciPy's ``interp`` mode. The
result equals ``scipy.signal.savgol_filter`` over the logged past and the episode, as tests verify. Windows and orders
are those of nuPlan's devkit (decision 0011).
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

#: Samples of the jerk window, and number of steps that are evaluated at once at the end of an episode.
WINDOW, TAIL = 15, 12
#: Window, order and derivative of smoothed acceleration, jerk, yaw rate and yaw acceleration.
SMOOTH, JERK, YAW_RATE, YAW_ACCELERATION = (8, 2, 0), (15, 2, 1), (5, 2, 1), (5, 3, 2)
#: Number of samples that the last twelve steps depend on, and index of the first with a whole window of 8 around it.
_SAMPLES, _FIRST_FINAL = 23, 4
#: nuPlan's closed-loop limits: m/s2, m/s2, m/s3, m/s3, rad/s, rad/s2.
LONGITUDINAL_MPS2 = (-4.05, 2.40)
LATERAL_MPS2, JERK_MPS3, JERK_MAGNITUDE_MPS3 = 4.89, 4.13, 8.37
YAW_RATE_RPS, YAW_ACCELERATION_RPS2 = 0.95, 1.93


@cache
def savgol_tail_matrix(window: int, order: int, derivative: int) -> np.ndarray[Any, Any]:
    """Return the Savitzky-Golay filter as a matrix ``[19, 22]`` from the last 22 samples to the values at the last 19.

    Row 0 is an interior point. The last ``window // 2`` rows evaluate the polynomial of the last window.
    """
    # The matrix for one more sample makes row 0 interior for even windows.
    return savgol_matrix(_SAMPLES, window, order, derivative)[_FIRST_FINAL:, 1:]


@cache
def savgol_matrix(samples: int, window: int, order: int, derivative: int) -> np.ndarray[Any, Any]:
    """Return the Savitzky-Golay filter as a matrix ``[samples, samples]``.

    The filter fits a polynomial of ``order`` to ``window`` samples by least squares, and differentiates it
    ``derivative`` times per sample (Savitzky and Golay 1964). Rows near an end evaluate the polynomial of the first or
    last window. As in SciPy, interior row i of an even window gives the value at i + 0.5.
    """
    half = window // 2
    matrix = np.zeros((samples, samples))
    for sample in range(samples):
        interior = half <= sample < samples - half
        if interior:
            first = sample - half + (window % 2 == 0)
            position = half - 0.5 if window % 2 == 0 else half
        else:
            first = 0 if sample < half else samples - window
            position = sample - first
        matrix[sample, first : first + window] = _weights(window, order, derivative, position)
    return matrix


def _weights(window: int, order: int, derivative: int, position: float) -> np.ndarray[Any, Any]:
    """Return the weights of the derivative of the fitted polynomial at sample ``position``."""
    powers = (np.arange(window) - position)[:, None] ** np.arange(order + 1)
    factorial = float(np.prod(np.arange(1, derivative + 1))) if derivative else 1.0
    return np.linalg.pinv(powers)[derivative] * factorial


@record
class ComfortSteps:
    """Comfort, and magnitudes of jerk and lateral acceleration, of consecutive steps, oldest first."""

    comfortable: Bool[Array, " steps"]
    jerk_mps3: Float[Array, " steps"]
    lateral_mps2: Float[Array, " steps"]


def check_trip_comfort(motion: Float[Array, "time 4"]) -> ComfortSteps:
    """Evaluate a trip (x, y, heading, speed; 23 rows or more) from row 11 on, the first with centred windows.

    For plots and tables: an episode evaluates the same steps one by one, from its first step on.
    """
    windows = jnp.arange(len(motion) - _SAMPLES + 1)[:, None] + jnp.arange(_SAMPLES)
    steps = jax.vmap(check_comfort)(motion[windows])
    return jax.tree.map(lambda leaf: jnp.concatenate([leaf[:-1, 0], leaf[-1]]), steps)


def check_comfort(history: Float[Array, "history 4"]) -> ComfortSteps:
    """Evaluate the last twelve steps of a motion history (23 rows of x, y, heading, speed) against the limits.

    Only the value of the first, eleven steps ago, is final. The others hold for an episode that ends at the last row,
    as in SciPy's ``interp`` mode.
    """
    speed = history[:, 3]
    heading_change = wrap(history[1:, 2] - history[:-1, 2])
    heading = jnp.cumsum(heading_change)
    longitudinal = (speed[1:] - speed[:-1]) / DT_S
    lateral = (speed[1:] + speed[:-1]) / 2 * heading_change / DT_S

    def apply_filter(signal: Array, window: tuple[int, int, int]) -> Array:
        matrix = jnp.asarray(savgol_tail_matrix(*window), jnp.float32)
        return matrix @ signal / DT_S ** window[2]

    def jerk(smooth: Array) -> Array:
        matrix = savgol_matrix(_SAMPLES, *JERK)[-TAIL:, _FIRST_FINAL:]
        return jnp.asarray(matrix, jnp.float32) @ smooth / DT_S

    smooth_longitudinal = apply_filter(longitudinal, SMOOTH)
    lateral_mps2 = jnp.abs(apply_filter(lateral, SMOOTH)[-TAIL:])
    jerk_magnitude = jnp.abs(jerk(apply_filter(jnp.sqrt(longitudinal**2 + lateral**2 + 1e-12), SMOOTH)))
    longitudinal_mps2 = smooth_longitudinal[-TAIL:]
    comfortable = (longitudinal_mps2 >= LONGITUDINAL_MPS2[0]) & (longitudinal_mps2 <= LONGITUDINAL_MPS2[1])
    comfortable &= (lateral_mps2 <= LATERAL_MPS2) & (jerk_magnitude <= JERK_MAGNITUDE_MPS3)
    comfortable &= jnp.abs(jerk(smooth_longitudinal)) <= JERK_MPS3
    comfortable &= jnp.abs(apply_filter(heading, YAW_RATE)[-TAIL:]) <= YAW_RATE_RPS
    comfortable &= jnp.abs(apply_filter(heading, YAW_ACCELERATION)[-TAIL:]) <= YAW_ACCELERATION_RPS2
    return ComfortSteps(comfortable, jerk_magnitude, lateral_mps2)
