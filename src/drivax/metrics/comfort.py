"""Comfort by nuPlan's limits and Savitzky-Golay windows, one step at a time.

A window of 15 samples is centred 7 steps back, so a simulation evaluates step t - 7 at step t and the last eight
steps when the episode ends; the edge is SciPy's ``interp`` mode. The result equals ``scipy.signal.savgol_filter`` over
the whole episode (tests).
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

#: Samples of a comfort window, and how many trailing steps are evaluated at once when an episode ends.
WINDOW, TAIL = 15, 8
#: nuPlan's closed-loop limits: m/s2, m/s2, m/s3, m/s3, rad/s, rad/s2.
LONGITUDINAL_MPS2 = (-4.05, 2.40)
LATERAL_MPS2, JERK_MPS3, JERK_MAGNITUDE_MPS3 = 4.89, 4.13, 8.37
YAW_RATE_RPS, YAW_ACCELERATION_RPS2 = 0.95, 1.93


@cache
def savgol_tail_matrix(window: int, order: int, derivative: int) -> np.ndarray[Any, Any]:
    """Return the Savitzky-Golay filter as a matrix ``[8, 15]`` from the last 15 samples to the values at the last 8.

    Row 0 is an interior point; the last ``window // 2`` rows are read off the last window's polynomial.
    """
    return savgol_matrix(WINDOW, window, order, derivative)[-TAIL:]


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
    """Evaluate a trip (x, y, heading, speed; at least 16 rows) from row 8 on, the first with a centred window.

    For plots and tables; an episode evaluates the same steps one by one.
    """
    windows = jnp.arange(len(motion) - WINDOW)[:, None] + jnp.arange(WINDOW + 1)
    steps = jax.vmap(check_comfort)(motion[windows])
    return jax.tree.map(lambda part: jnp.concatenate([part[:-1, 0], part[-1]]), steps)


def check_comfort(history: Float[Array, "16 4"]) -> ComfortSteps:
    """Evaluate the last eight steps of a motion history (x, y, heading, speed) against the limits.

    Row 0, seven steps back, is final; the later rows are those of SciPy's edge mode if the history ended now.
    """
    speed = history[:, 3]
    turned = wrap(history[1:, 2] - history[:-1, 2])
    heading = jnp.cumsum(turned)
    along = (speed[1:] - speed[:-1]) / DT_S
    lateral = (speed[1:] + speed[:-1]) / 2 * turned / DT_S

    def filtered(signal: Array, window: int, order: int, derivative: int) -> Array:
        matrix = jnp.asarray(savgol_tail_matrix(window, order, derivative), jnp.float32)
        return matrix @ signal / DT_S**derivative

    smooth_along, smooth_lateral = filtered(along, 8, 2, 0), filtered(lateral, 8, 2, 0)
    jerk = filtered(along, 15, 2, 1)
    magnitude = filtered(jnp.sqrt(along**2 + lateral**2 + 1e-12), 15, 2, 1)
    yaw_rate, yaw_acceleration = filtered(heading, 15, 2, 1), filtered(heading, 15, 3, 2)
    fine = (smooth_along >= LONGITUDINAL_MPS2[0]) & (smooth_along <= LONGITUDINAL_MPS2[1])
    fine &= (jnp.abs(smooth_lateral) <= LATERAL_MPS2) & (jnp.abs(jerk) <= JERK_MPS3)
    fine &= (jnp.abs(magnitude) <= JERK_MAGNITUDE_MPS3) & (jnp.abs(yaw_rate) <= YAW_RATE_RPS)
    fine &= jnp.abs(yaw_acceleration) <= YAW_ACCELERATION_RPS2
    return ComfortSteps(fine, jnp.abs(magnitude), jnp.abs(smooth_lateral))
