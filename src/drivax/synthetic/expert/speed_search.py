"""Speed search along a path by dynamic programming over position, speed and time.

Steps take 0.5 s and end on grid points of speed and position: between speeds ``i dv`` and ``j dv`` a step covers
``(i + j) dv dt / 2``. One step is one gather over (acceleration, speed, position).
"""

from __future__ import annotations

from dataclasses import dataclass

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
