"""Smooth a coarse speed plan: least squares of acceleration and jerk within bounds.

Newton's method with an exact line search solves a quadratic programme with quadratic penalties for its bounds: the
objective is convex and piecewise quadratic, so a few steps suffice (Mangasarian, "A finite Newton method for
classification", Optim. Methods Softw. 17, 2002).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float64

from drivax.scenario.schema import DT_S

#: Weights of squared acceleration, jerk, deviation from the coarse speed and position, and excess over a bound.
_ACCELERATION, _JERK, _SPEED, _POSITION, _PENALTY = 0.3, 0.6, 0.4, 0.03, 3e5
#: Steps from one knot of acceleration to the next.
_KNOT_STEPS = 3
#: Largest number of Newton steps and of bisections per step, and change of all bounded values below which to stop.
_NEWTON_STEPS, _BISECTIONS, _MIN_CHANGE = 40, 12, 1e-4

_Series = Float64[np.ndarray, " time"]
_Later = Float64[np.ndarray, " later"]
_Rows = Float64[np.ndarray, " m"]
_Knots = Float64[np.ndarray, " n"]
_Matrix = Float64[np.ndarray, "m n"]


@dataclass(frozen=True)
class Bounds:
    """Bounds of position and speed at each step but the first, and of acceleration and jerk at all steps."""

    low_m: _Later
    high_m: _Later
    top_mps: _Later
    acceleration_mps2: tuple[float, float]
    jerk_mps3: float


@dataclass(frozen=True)
class SpeedProfile:
    """Distance and speed from the present step on, and the largest excess over a bound: m, m/s, m/s2 or 10 m/s3."""

    at_m: _Series
    speed: _Series
    excess: float


@cache
def _matrices(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the map from accelerations at knots to stacked distances, speeds, accelerations and jerks.

    Acceleration is constant within a step and linear between knots. The second matrix is the objective's Hessian.
    """
    n, m = np.arange(steps)[:, None], np.arange(steps)
    knots = np.arange(0, steps + _KNOT_STEPS - 1, _KNOT_STEPS)
    interpolation = np.stack([np.interp(np.arange(steps), knots, row) for row in np.eye(len(knots))], axis=-1)
    past = (n >= m).astype(float)
    jerk = (np.eye(steps) - np.eye(steps, k=-1)) / DT_S
    blocks = np.concatenate([past * (n - m + 0.5) * DT_S**2, past * DT_S, np.eye(steps), jerk])
    rows = np.einsum("ij,jk->ik", blocks, interpolation)
    weight = np.repeat([_POSITION, _SPEED, _ACCELERATION, _JERK], steps)
    return rows, _gram_matrix(rows, weight)


def _gram_matrix(rows: _Matrix, weight: _Rows) -> Float64[np.ndarray, "n n"]:
    """Return ``R' diag(w) R``; unlike with BLAS its bits do not depend on the number of threads."""
    return np.einsum("ki,kj->ij", rows * weight[:, None], rows)


def _matmul(rows: _Matrix, values: _Knots) -> _Rows:
    return np.einsum("ij,j->i", rows, values)


def smooth_speeds(at_m: _Series, speed: _Series, acceleration_mps2: float, bounds: Bounds) -> SpeedProfile:
    """Return a smooth speed profile near a coarse plan: distances from 0, and speeds, the first of which is kept.

    ``acceleration_mps2`` is the acceleration just before the first step. Bounds that cannot be kept are exceeded.
    """
    steps = len(at_m) - 1
    rows, hessian = _matrices(steps)
    coast_m = speed[0] * DT_S * np.arange(1, steps + 1)
    offset = np.zeros(steps)
    offset[0] = acceleration_mps2 / DT_S
    linear_terms = np.concatenate(
        [_POSITION * (at_m[1:] - coast_m), _SPEED * (speed[1:] - speed[0]), np.zeros(steps), _JERK * offset]
    )
    target = _matmul(rows.T, linear_terms)
    low_a, high_a = (np.full(steps, a) for a in bounds.acceleration_mps2)
    # A tenth of the weight for jerk keeps the excesses over all bounds similar.
    scale = np.repeat([1.0, 0.1], [3 * steps, steps])
    limit = np.full(steps, bounds.jerk_mps3)
    high = np.concatenate([bounds.high_m - coast_m, bounds.top_mps - speed[0], high_a, offset + limit])
    low = np.concatenate([bounds.low_m - coast_m, np.full(steps, -speed[0]), low_a, offset - limit])
    bounded = rows * scale[:, None]
    knots = _minimise(hessian, target, bounded, low * scale, high * scale)
    value = _matmul(bounded, knots)
    excess = float(np.maximum(np.maximum(value - high * scale, low * scale - value), 0.0).max())
    return _integrate(float(speed[0]), _matmul(rows[2 * steps : 3 * steps], knots), excess)


def _minimise(
    hessian: Float64[np.ndarray, "n n"], target: _Knots, rows: _Matrix, low: _Rows, high: _Rows
) -> _Knots:
    """Minimise ``a H a / 2 - t a`` and the penalties of ``low <= R a <= high`` by Newton steps with a line search."""
    a = np.linalg.solve(hessian, target)
    value = _matmul(rows, a)
    for _ in range(_NEWTON_STEPS):
        bound = np.clip(value, low, high)
        violated = value != bound
        active = rows[violated]
        penalty = _gram_matrix(active, np.full(len(active), _PENALTY))
        step = np.linalg.solve(hessian + penalty, target + _PENALTY * _matmul(active.T, bound[violated]))
        step -= a
        change = _matmul(rows, step)
        if np.abs(change).max() < _MIN_CHANGE:
            break
        slope = float(np.sum(step * (_matmul(hessian, a) - target)))
        curvature = float(np.sum(step * _matmul(hessian, step)))
        step_length = _step_length(value, change, (low, high), (slope, curvature))
        a = a + step_length * step
        value = value + step_length * change
    return a


def _step_length(
    value: _Rows, change: _Rows, limits: tuple[_Rows, _Rows], derivatives: tuple[float, float]
) -> float:
    """Find the share of a Newton step that minimises the objective, by bisection of the derivative.

    ``derivatives`` are the first and second derivative of the objective without penalties.
    """
    low, high = limits

    def derivative(share: float) -> float:
        shifted = value + share * change
        excess = shifted - np.clip(shifted, low, high)
        return derivatives[0] + share * derivatives[1] + _PENALTY * float(np.sum(excess * change))

    if derivative(1.0) <= 1e-6 * abs(derivatives[0]):
        return 1.0
    below, above = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = (below + above) / 2
        below, above = (middle, above) if derivative(middle) < 0.0 else (below, middle)
    return (below + above) / 2


def _integrate(speed: float, a: Float64[np.ndarray, " step"], excess: float) -> SpeedProfile:
    """Integrate accelerations; speeds below 3 cm/s become 0."""
    after = speed + np.cumsum(a) * DT_S
    after = np.where(after < 0.03, 0.0, after)
    speeds = np.concatenate([[speed], after])
    travelled = np.concatenate([[0.0], np.cumsum((speeds[1:] + speeds[:-1]) * DT_S / 2)])
    return SpeedProfile(travelled, speeds, excess)
