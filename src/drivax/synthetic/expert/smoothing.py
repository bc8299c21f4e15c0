"""From a coarse drive to a smooth one: the least squares of acceleration and jerk within bounds.

A quadratic programme whose bounds are quadratic penalties on what exceeds them, solved by Newton's method: the
function is convex and piecewise quadratic, so it ends after a few steps when each goes to the least value on its line
(Mangasarian, "A finite Newton method for classification", Optim. Methods Softw. 17, 2002).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float64

from drivax.scenario.schema import DT_S

#: Weights of squared acceleration, jerk, and difference to the coarse drive's speed and place.
_ACCELERATION, _JERK, _SPEED, _PLACE = 0.3, 0.6, 0.4, 0.03
_PENALTY = 3e5
#: Steps from one knot of acceleration to the next.
_KNOT_STEPS = 3
_NEWTON_STEPS, _BISECTIONS, _SMALLEST = 40, 12, 1e-4


@dataclass(frozen=True)
class Bounds:
    """What a drive must keep to.

    Attributes:
        low_m, high_m: Where ego's centre may be at each step but the first.
        top_mps: Highest speed at each step but the first.
        acceleration_mps2: Lowest and highest acceleration.
        jerk_mps3: Largest jerk.
    """

    low_m: Float64[np.ndarray, " later"]
    high_m: Float64[np.ndarray, " later"]
    top_mps: Float64[np.ndarray, " later"]
    acceleration_mps2: tuple[float, float]
    jerk_mps3: float


@dataclass(frozen=True)
class SpeedProfile:
    """A drive from the present step on: distance and speed, and by how much it exceeds its bounds (in their units)."""

    at_m: Float64[np.ndarray, " time"]
    speed: Float64[np.ndarray, " time"]
    excess: float


@cache
def _matrices(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """From accelerations at knots to distances, speeds, accelerations and jerks, one below the other.

    Acceleration is constant within a step and linear between knots from step to step.

    Returns:
        The rows, and the matrix of the squares in the sum that is minimised.
    """
    n, m = np.arange(steps)[:, None], np.arange(steps)
    knots = np.arange(0, steps + _KNOT_STEPS - 1, _KNOT_STEPS)
    own = np.stack([np.interp(np.arange(steps), knots, row) for row in np.eye(len(knots))], axis=-1)
    past = (n >= m).astype(float)
    jerk = (np.eye(steps) - np.eye(steps, k=-1)) / DT_S
    whole = np.concatenate([past * (n - m + 0.5) * DT_S**2, past * DT_S, np.eye(steps), jerk])
    rows = np.einsum("ij,jk->ik", whole, own)
    weight = np.repeat([_PLACE, _SPEED, _ACCELERATION, _JERK], steps)
    return rows, _squares(rows, weight)


def _squares(
    rows: Float64[np.ndarray, "m n"], weight: Float64[np.ndarray, " m"]
) -> Float64[np.ndarray, "n n"]:
    """``R' diag(w) R``. Unlike a product by BLAS its bits do not depend on the number of threads."""
    return np.einsum("ki,kj->ij", rows * weight[:, None], rows)


def _times(rows: Float64[np.ndarray, "m n"], values: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " m"]:
    return np.einsum("ij,j->i", rows, values)


def smoothed(
    at_m: Float64[np.ndarray, " time"],
    speed: Float64[np.ndarray, " time"],
    acceleration_mps2: float,
    bounds: Bounds,
) -> SpeedProfile:
    """The smoothest drive near a coarse one.

    Args:
        at_m: Distances of the coarse drive; the first is 0.
        speed: Its speeds; the first is kept.
        acceleration_mps2: Acceleration just before the first step.
        bounds: What to keep to.
    """
    steps = len(at_m) - 1
    rows, base = _matrices(steps)
    free = speed[0] * DT_S * np.arange(1, steps + 1)
    before = np.zeros(steps)
    before[0] = acceleration_mps2 / DT_S
    linear_terms = np.concatenate(
        [_PLACE * (at_m[1:] - free), _SPEED * (speed[1:] - speed[0]), np.zeros(steps), _JERK * before]
    )
    target = _times(rows.T, linear_terms)
    low_a, high_a = (np.full(steps, a) for a in bounds.acceleration_mps2)
    # Jerk counts a tenth, so that a bound is exceeded by about as much as one of the others.
    scale = np.repeat([1.0, 0.1], [3 * steps, steps])
    limit = np.full(steps, bounds.jerk_mps3)
    high = np.concatenate([bounds.high_m - free, bounds.top_mps - speed[0], high_a, before + limit])
    low = np.concatenate([bounds.low_m - free, np.full(steps, -speed[0]), low_a, before - limit])
    bounded = rows * scale[:, None]
    knots = _least(base, target, bounded, low * scale, high * scale)
    value = _times(bounded, knots)
    excess = float(np.maximum(np.maximum(value - high * scale, low * scale - value), 0.0).max())
    return _profile(float(speed[0]), _times(rows[2 * steps : 3 * steps], knots), excess)


def _least(
    base: Float64[np.ndarray, "n n"],
    target: Float64[np.ndarray, " n"],
    rows: Float64[np.ndarray, "m n"],
    low: Float64[np.ndarray, " m"],
    high: Float64[np.ndarray, " m"],
) -> Float64[np.ndarray, " n"]:
    """Minimise ``a B a / 2 - t a`` and the penalties of ``low <= R a <= high`` by Newton steps with a line search."""
    a = np.linalg.solve(base, target)
    value = _times(rows, a)
    for _ in range(_NEWTON_STEPS):
        bound = np.clip(value, low, high)
        hit = value != bound
        active = rows[hit]
        penalty = _squares(active, np.full(len(active), _PENALTY))
        step = np.linalg.solve(base + penalty, target + _PENALTY * _times(active.T, bound[hit]))
        step -= a
        change = _times(rows, step)
        if np.abs(change).max() < _SMALLEST:
            break
        slope = float(np.sum(step * (_times(base, a) - target)))
        curvature = float(np.sum(step * _times(base, step)))
        share = _share(value, change, (low, high), (slope, curvature))
        a = a + share * step
        value = value + share * change
    return a


def _share(
    value: Float64[np.ndarray, " m"],
    change: Float64[np.ndarray, " m"],
    limits: tuple[Float64[np.ndarray, " m"], Float64[np.ndarray, " m"]],
    rise: tuple[float, float],
) -> float:
    """How much of a Newton step leads to the least value on its line: where the derivative is zero, by bisection.

    Args:
        value: What is bounded, before the step.
        change: By how much the whole step changes it.
        limits: Its bounds.
        rise: First and second derivative of the function without penalties.
    """
    low, high = limits

    def derivative(share: float) -> float:
        there = value + share * change
        beyond = there - np.clip(there, low, high)
        return rise[0] + share * rise[1] + _PENALTY * float(np.sum(beyond * change))

    if derivative(1.0) <= 1e-6 * abs(rise[0]):
        return 1.0
    below, above = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = (below + above) / 2
        below, above = (middle, above) if derivative(middle) < 0.0 else (below, middle)
    return (below + above) / 2


def _profile(speed: float, a: Float64[np.ndarray, " step"], excess: float) -> SpeedProfile:
    """Speeds below zero, and creeping where the car has as good as stopped, become standing."""
    after = speed + np.cumsum(a) * DT_S
    after = np.where(after < 0.03, 0.0, after)
    whole = np.concatenate([[speed], after])
    travelled = np.concatenate([[0.0], np.cumsum((whole[1:] + whole[:-1]) * DT_S / 2)])
    return SpeedProfile(travelled, whole, excess)
