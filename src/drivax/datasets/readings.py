"""What readers share: lights collected by lane, checks, time bases, velocities from positions, JSON files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from drivax.errors import DataError
from drivax.scenario.recording import Light
from drivax.scenario.schema import LightState


class Lights:
    """Collects light states by lane: slots and list positions move between steps, lanes do not.

    Args:
        steps: Number of steps; a lane that is not observed at a step has state -1 there.
    """

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._lights: dict[int, Light] = {}

    def observe(self, step: int, lane: int, state: int, stop_point: Sequence[float]) -> None:
        """Note one observation. Of several for one lane and step the first that is not UNKNOWN counts."""
        light = self._lights.get(lane)
        if light is None:
            states = np.full(self._steps, LightState.UNOBSERVED, np.int8)
            light = self._lights[lane] = Light(lane, np.array(stop_point, np.float64), states)
        if light.states[step] <= LightState.UNKNOWN:
            known = LightState.UNKNOWN <= state <= LightState.FLASHING_CAUTION
            light.states[step] = state if known else LightState.UNKNOWN

    def collected(self) -> tuple[Light, ...]:
        """The lights in order of first observation."""
        return tuple(self._lights.values())


def rows_within(rows: Sequence[int], count: int, what: str) -> tuple[int, ...]:
    """Row numbers as ints.

    Raises:
        DataError: One is not a row of ``count`` tracks.
    """
    for row in rows:
        if not 0 <= row < count:
            raise DataError(f"{what} names track {row}, there are {count}", cure="skip this record")
    return tuple(int(row) for row in rows)


def check_finite(*measured: np.ndarray[Any, Any]) -> None:
    """Refuse NaN and infinities among what is marked valid.

    Raises:
        DataError: There are some.
    """
    if not all(np.isfinite(values).all() for values in measured):
        raise DataError("valid states hold numbers that are not finite", cure="skip this record")


def seconds(timestamps: Float64[np.ndarray, " time"]) -> Float64[np.ndarray, " time"]:
    """Timestamps with unknown ones (NaN) filled at 10 Hz from the nearest known one before, or after."""
    known = np.flatnonzero(np.isfinite(timestamps))
    steps = np.arange(len(timestamps))
    if known.size == 0:
        return steps * 0.1
    nearest = known[np.maximum(np.searchsorted(known, steps, side="right") - 1, 0)]
    return timestamps[nearest] + (steps - nearest) * 0.1


def differentiate(
    xy: Float64[np.ndarray, "track time 2"],
    valid: Bool[np.ndarray, "track time"],
    timestamps_s: Float64[np.ndarray, " time"],
) -> Float64[np.ndarray, "track time 2"]:
    """Velocities from positions, m/s: central differences inside, one-sided at the ends of what was observed.

    No difference is taken over a gap; a position without a valid neighbour, and what is not valid, gets zero.
    """
    step = np.arange(len(timestamps_s))
    behind = np.zeros_like(valid)
    ahead = np.zeros_like(valid)
    behind[:, 1:] = valid[:, 1:] & valid[:, :-1]
    ahead[:, :-1] = behind[:, 1:]
    first = np.maximum(step - behind, 0)
    last = np.minimum(step + ahead, len(step) - 1)
    rows = np.arange(len(xy))[:, None]
    seconds_apart = (timestamps_s[last] - timestamps_s[first])[..., None]
    moved = xy[rows, last] - xy[rows, first]
    return np.divide(moved, seconds_apart, out=np.zeros_like(moved), where=(behind | ahead)[..., None])


def load_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        DataError: It is missing or no JSON.
    """
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise DataError("is missing", file=path, cure="download it again") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"is no valid JSON ({error})", file=path, cure="download it again") from error
