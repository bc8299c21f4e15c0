"""Speed plan along a path: a search by dynamic programming over position, speed and time, and its smoothing.

Steps of the search take 0.5 s and end on grid points of speed and position: between speeds ``i dv`` and ``j dv`` a step
covers ``(i + j) dv dt / 2``. One step is one gather over (acceleration, speed, position).

Smoothing is a least-squares problem of acceleration and jerk within bounds. Newton's method with an exact line search
solves it as a quadratic programme with quadratic penalties for its bounds: the objective is convex and piecewise
quadratic, so a few steps suffice (Mangasarian, "A finite Newton method for classification", Optim. Methods Softw. 17,
2002).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float32, Float64, Int64

from drivax.scenario.schema import DT_S

#: Steps of the recording in one step of the search.
COARSE = 5
_STEP_S = COARSE * DT_S
#: Spacing of speeds, m/s, which is fitted to the present speed by a factor of 0.65 to 1.3 (from 0.3 on below 0.5 m/s).
#: Accelerations are 1.5 m/s2 times this factor apart.
_SPEED_STEP_MPS = 0.75
#: Lowest and highest acceleration, and the one below which braking costs more, m/s2.
_MIN_ACCELERATION_MPS2, _MAX_ACCELERATION_MPS2, _COMFORT_MPS2 = -6.05, 2.3, -3.0
#: Costs per second of (m/s2)^2, and of (m/s)^2 below and above the preferred speed and above the limit of bends.
_ACCELERATION, _SLOW, _FAST, _BEND = 1.0, 0.1, 0.6, 50.0
#: Costs per second of (m/s2)^2 of hard braking, and, at 5 m/s, of a short gap ahead and of ``Occupancy.near``.
_HARD_BRAKING, _CLOSE_BEHIND, _CLOSE = 3.0, 6.0, 8.0
#: Preferred time gap to places that ego must avoid ahead, added to 1.5 m, s.
_HEADWAY_S = 1.1
#: Cost of contact; even 0.02 of it exceeds usual sums of other costs.
TOUCH = 1e5
#: Weights of squared acceleration, jerk, deviation from the coarse speed and position, and excess over a bound.
_ACCELERATION_WEIGHT, _JERK_WEIGHT, _SPEED_WEIGHT, _POSITION_WEIGHT, _PENALTY_WEIGHT = (
    0.3,
    0.6,
    0.4,
    0.03,
    3e5,
)
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
class Occupancy:
    """Occupancy of a path by step (axis 0) and evenly spaced distance from ego (axis 1).

    ``hard`` is a mask of places that ego's centre must avoid, ``near`` the weight of those that it should avoid.
    """

    spacing_m: float
    hard: np.ndarray
    near: np.ndarray


@dataclass(frozen=True)
class SpeedPlan:
    """Speeds at the coarse steps, their cost, and whether ego touches an obstacle."""

    speed: Float64[np.ndarray, " coarse"]
    cost: float
    touches: bool

    def resample(self, steps: int) -> tuple[Float64[np.ndarray, " time"], Float64[np.ndarray, " time"]]:
        """Return distance and speed at every step of the recording."""
        position = np.arange(steps) / COARSE
        speed = np.interp(position, np.arange(len(self.speed)), self.speed)
        travelled = np.cumsum((speed[1:] + speed[:-1]) * DT_S / 2)
        return np.concatenate([[0.0], travelled]), speed


@dataclass(frozen=True)
class _Grid:
    """Speeds, places, the state from which each (acceleration, speed, place) is reached, and costs of acceleration."""

    speed: Float32[np.ndarray, " speed"]
    place: Float64[np.ndarray, " place"]
    source: Int64[np.ndarray, "change speed place"]
    effort: Float32[np.ndarray, " change"]


def _grid(speed_mps: float, top_mps: float, reach_m: float) -> tuple[_Grid, int]:
    """Return the grid and the index of the present speed on it."""
    index = int(np.ceil(speed_mps / _SPEED_STEP_MPS - 0.3)) if speed_mps > 0.2 else 0
    step = speed_mps / index if index else _SPEED_STEP_MPS
    speeds = max(index, int(np.ceil(top_mps / step))) + 1
    spacing = step * _STEP_S / 2
    places = max(2, int(reach_m / spacing))
    unit = step / _STEP_S
    change = np.arange(int(np.ceil(_MIN_ACCELERATION_MPS2 / unit)), int(_MAX_ACCELERATION_MPS2 / unit) + 1)
    v, s = np.arange(speeds), np.arange(places)
    before = v - change[:, None]
    source = s - (before + v)[..., None]
    is_possible = (before >= 0)[..., None] & (before < speeds)[..., None] & (source >= 0)
    # Impossible transitions come from an extra state with infinite cost.
    source = np.where(is_possible, before[..., None] * places + source, speeds * places)
    a = change * unit
    effort = _ACCELERATION * a**2 + _HARD_BRAKING * np.maximum(_COMFORT_MPS2 - a, 0.0) ** 2
    effort = (effort * _STEP_S).astype(np.float32)
    return _Grid((v * step).astype(np.float32), s * spacing, source, effort), index


def search(
    occupancy: Occupancy, preferred_mps: Float64[np.ndarray, " place"],
    limit_mps: Float64[np.ndarray, " place"], speed_mps: float,
) -> SpeedPlan:  # fmt: skip
    """Return the cheapest speeds from the present one on, for preferred and largest speeds along a path."""
    steps = -(-(len(occupancy.hard) - 1) // COARSE)
    reach = occupancy.spacing_m * (occupancy.hard.shape[1] - 1)
    top = max(float(preferred_mps.max()), speed_mps)
    reach = min(reach, (top + 1.0) * (steps + 1) * _STEP_S)
    grid, start = _grid(speed_mps, top, reach)
    speeds, places = len(grid.speed), len(grid.place)
    preferred = np.interp(grid.place, occupancy.spacing_m * np.arange(len(preferred_mps)), preferred_mps)
    bound = np.interp(grid.place, occupancy.spacing_m * np.arange(len(limit_mps)), limit_mps)
    difference = grid.speed[:, None] - preferred
    overspeed = np.maximum(grid.speed[:, None] - bound, 0.0)
    state_cost = np.where(difference > 0, _FAST, _SLOW) * difference**2 + _BEND * overspeed**2
    state_cost = (state_cost * _STEP_S).astype(np.float32)
    states = _OccupiedStates(occupancy, grid)
    layers = np.full((steps + 1, speeds * places + 1), np.inf, np.float32)
    layers[0, start * places] = 0.0
    for k in range(1, steps + 1):
        reached = layers[k - 1].take(grid.source)
        reached += grid.effort[:, None, None]
        layers[k, :-1] = (reached.min(axis=0) + state_cost + states.cost(k * COARSE)).ravel()
    return _trace_back(grid, layers, states)


def _trace_back(
    grid: _Grid, layers: Float32[np.ndarray, "coarse state"], states: _OccupiedStates
) -> SpeedPlan:
    """Trace back from the cheapest final state."""
    places = len(grid.place)
    state = int(np.argmin(layers[-1]))
    cost = float(layers[-1, state])
    speed, touches = [], False
    for k in range(len(layers) - 1, 0, -1):
        v, s = divmod(state, places)
        speed.append(float(grid.speed[v]))
        touches |= states.touches(k * COARSE, v, s)
        source = grid.source[:, v, s]
        state = int(source[np.argmin(layers[k - 1][source] + grid.effort)])
    speed.append(float(grid.speed[state // places]))
    return SpeedPlan(np.array(speed[::-1]), cost, touches)


class _OccupiedStates:
    """Costs of states (speed, place) by occupancy; speed counts as constant for half a coarse step before and after."""

    def __init__(self, occupancy: Occupancy, grid: _Grid) -> None:
        self._occupancy = occupancy
        half = COARSE // 2
        places = occupancy.hard.shape[1]
        position_m = grid.place + (DT_S * np.arange(-half, half + 1))[:, None, None] * grid.speed[:, None]
        self._index = np.clip(np.rint(position_m / occupancy.spacing_m).astype(int), 0, places - 1)
        # The occupancy of the last step persists.
        price = TOUCH * occupancy.hard + (_CLOSE * DT_S) * occupancy.near
        price = np.concatenate([price, np.repeat(price[-1:], COARSE + half, axis=0)]).astype(np.float32)
        self._price, self._places = price.ravel(), places
        self._flat = self._index + (places * np.arange(COARSE))[:, None, None]
        self._ahead = _free_ahead(occupancy)
        self._column = np.clip(np.rint(grid.place / occupancy.spacing_m).astype(int), 0, places - 1)
        factor = np.minimum(grid.speed[:, None] / 5.0, 2.0)
        # Contact is not free at standstill.
        self._factor, self._following = factor + 0.02, (_CLOSE_BEHIND * _STEP_S) * np.minimum(factor, 1.0)
        self._preferred_gap = _HEADWAY_S * grid.speed[:, None] + 0.5

    def cost(self, step: int) -> Float32[np.ndarray, "speed place"]:
        """Cost of all states from half a coarse step before a step to half a coarse step after it."""
        first = (step - COARSE // 2) * self._places
        contact = self._price[first : first + COARSE * self._places].take(self._flat).sum(axis=0)
        free = self._ahead[min(step, len(self._ahead) - 1)][self._column]
        close = np.maximum(1.0 - (free - 1.0) / self._preferred_gap, 0.0) ** 2
        return contact * self._factor + close * self._following

    def touches(self, step: int, v: int, s: int) -> bool:
        """Return whether ego touches an obstacle around a step."""
        half = COARSE // 2
        rows = np.minimum(step + np.arange(-half, half + 1), len(self._occupancy.hard) - 1)
        return bool(self._occupancy.hard[rows, self._index[:, v, s]].any())


def _free_ahead(occupancy: Occupancy) -> Float32[np.ndarray, "time place"]:
    """Return the distance from each place to the next hard place, m (0: this place; 1 km or more: none)."""
    places = occupancy.hard.shape[1]
    index = np.where(occupancy.hard, np.arange(places), places + round(1000.0 / occupancy.spacing_m))
    nearest = np.minimum.accumulate(index[:, ::-1], axis=1)[:, ::-1]
    return ((nearest - np.arange(places)) * occupancy.spacing_m).astype(np.float32)


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
    weight = np.repeat([_POSITION_WEIGHT, _SPEED_WEIGHT, _ACCELERATION_WEIGHT, _JERK_WEIGHT], steps)
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
        [
            _POSITION_WEIGHT * (at_m[1:] - coast_m),
            _SPEED_WEIGHT * (speed[1:] - speed[0]),
            np.zeros(steps),
            _JERK_WEIGHT * offset,
        ]
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
        penalty = _gram_matrix(active, np.full(len(active), _PENALTY_WEIGHT))
        step = np.linalg.solve(
            hessian + penalty, target + _PENALTY_WEIGHT * _matmul(active.T, bound[violated])
        )
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
        return derivatives[0] + share * derivatives[1] + _PENALTY_WEIGHT * float(np.sum(excess * change))

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
