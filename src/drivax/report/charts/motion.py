"""Signals of the plots: speed, accelerations, jerk, yaw rate and curvature of a path, and the commands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.geometry.vectors import wrap
from drivax.metrics.comfort import (
    JERK,
    JERK_MPS3,
    LATERAL_MPS2,
    LONGITUDINAL_MPS2,
    SMOOTH,
    WINDOW,
    YAW_RATE,
    YAW_RATE_RPS,
    savgol_matrix,
)
from drivax.scenario.schema import DT_S

Array = np.ndarray[Any, Any]
#: Below this speed a path has no curvature: headings jitter more than the car moves.
_CURVED_MPS = 0.5


@dataclass(frozen=True)
class Signal:
    """One plot.

    Attributes:
        name, title: Its name, and the words above the plot.
        unit: Unit of its values.
        step: Resolution of the packed values.
        limits: Comfort limits, low and high; empty without.
    """

    name: str
    title: str
    unit: str
    step: float
    limits: tuple[float, ...] = ()


SIGNALS = (
    Signal("speed", "speed", "m/s", 0.01),
    Signal("acceleration", "acceleration along the road", "m/s²", 0.01, LONGITUDINAL_MPS2),
    Signal("jerk", "jerk along the road", "m/s³", 0.01, (-JERK_MPS3, JERK_MPS3)),
    Signal("curvature", "curvature", "1/m", 0.0001),
    Signal("yaw_rate", "yaw rate", "rad/s", 0.001, (-YAW_RATE_RPS, YAW_RATE_RPS)),
    Signal("lateral", "lateral acceleration", "m/s²", 0.01, (-LATERAL_MPS2, LATERAL_MPS2)),
)
#: Commands: the first two numbers of an action.
COMMANDS = (
    Signal("lengthwise", "command lengthwise", "1 is the most", 0.001),
    Signal("sideways", "command sideways", "1 is the most", 0.001),
)
COMMANDED = len(COMMANDS)


def signals(ego: Float[Array, "step 4"]) -> dict[str, Float[Array, " step"]]:
    """Return the signals of a path by name, differentiated and filtered like the comfort metrics.

    Windows as in ``metrics.comfort``: accelerations 8/2, jerk 15/2 of them, yaw rate 5/2. Curvature is yaw rate over
    speed. The 7 steps at either end have values of the first or last window's polynomial. Values are NaN
    outside of the last unbroken stretch of the path, at its first step, and, except for speed, throughout if it has
    fewer than 16 steps.

    Args:
        ego: Position [m], heading [rad], speed [m/s] at every step; NaN where the agent is absent.
    """
    present = np.asarray(np.isfinite(ego).all(axis=1))
    values = {signal.name: np.full(len(ego), np.nan) for signal in SIGNALS}
    values["speed"][present] = ego[present, 3]
    if not present.any():
        return values
    end = int(np.flatnonzero(present)[-1]) + 1
    gaps = np.flatnonzero(~present[:end])
    first = int(gaps[-1]) + 1 if gaps.size else 0
    if end - first <= WINDOW:
        return values
    path, at = np.asarray(ego[first:end], np.float64), slice(first + 1, end)
    turned = np.asarray(wrap(np.diff(path[:, 2])))
    along, middle = np.diff(path[:, 3]) / DT_S, (path[1:, 3] + path[:-1, 3]) / 2
    samples = end - first - 1
    smooth = savgol_matrix(samples, *SMOOTH)
    rate = savgol_matrix(samples, *YAW_RATE) @ np.cumsum(turned) / DT_S
    values["acceleration"][at] = smooth @ along
    values["lateral"][at] = smooth @ (middle * turned / DT_S)
    values["jerk"][at] = savgol_matrix(samples, *JERK) @ smooth @ along / DT_S
    values["yaw_rate"][at] = rate
    values["curvature"][at] = np.where(middle >= _CURVED_MPS, rate / np.maximum(middle, _CURVED_MPS), np.nan)
    return values
