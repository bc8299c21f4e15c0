"""Parsing that readers share: imports of extras, checks, time bases, lights by lane, city names, JSON files."""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from drivax.errors import DataError, missing_package
from drivax.scenario.arrays import differentiate as differentiate
from drivax.scenario.recording import STRIDE, Light, MapFeature
from drivax.scenario.schema import POLYGON_KINDS, STEPS, LightState, RoadKind

#: Cities (the tag ``place``) and how data sets call them or their parts: nuScenes and nuPlan by the names of their
#: maps, Argoverse 2 by name or by the code in the names of its sensor maps.
PLACES: Mapping[str, tuple[str, ...]] = {
    "austin": ("atx",),
    "boston": ("boston-seaport", "us-ma-boston"),
    "dearborn": ("dtw",),
    "las-vegas": ("us-nv-las-vegas-strip",),
    "miami": ("mia",),
    "palo-alto": ("pao",),
    "pittsburgh": ("pit", "us-pa-pittsburgh-hazelwood"),
    "singapore": ("sg-one-north", "singapore-hollandvillage", "singapore-onenorth", "singapore-queenstown"),
    "washington-dc": ("wdc",),
}
_CITY_OF = {name: city for city, names in PLACES.items() for name in (city, *names)}
_LONGEST = 64


def place_tags(location: str | None) -> dict[str, str]:
    """The tags ``place`` (the city) and ``location`` (the source's own word, which may name a part of the city).

    Args:
        location: What the source calls the place; None or empty where it does not tell, which gives no tag.

    Returns:
        ``location`` alone where the city is not known: ``place`` never holds the private word of one data set.
    """
    if not location:
        return {}
    city = _CITY_OF.get(location.lower().replace("_", "-"))
    return ({} if city is None else {"place": city}) | {"location": location[:_LONGEST]}


#: Metres per second in a mile per hour.
MPS_PER_MPH = 0.44704
_UNOBSERVED, _UNKNOWN = int(LightState.UNOBSERVED), int(LightState.UNKNOWN)
_LAST_STATE = int(max(LightState))


def import_extra(package: str) -> Any:
    """Return a package that an extra installs."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise missing_package(error) or error from error


class Lights:
    """Collects light states by lane: slots and list positions move between steps, lanes do not.

    Args:
        steps: Number of steps; a lane that is not observed at a step has state -1 there.
    """

    def __init__(self, steps: int) -> None:
        self._steps = steps
        # Lists of plain numbers: a scenario has a thousand observations, and arrays are slow one by one.
        self._lights: dict[int, tuple[tuple[float, ...], list[int]]] = {}

    def observe(self, step: int, lane: int, state: int, stop_point: Sequence[float]) -> None:
        """Note one observation. Of several for one lane and step the first that is not UNKNOWN counts."""
        light = self._lights.get(lane)
        if light is None:
            light = self._lights[lane] = tuple(stop_point), [_UNOBSERVED] * self._steps
        states = light[1]
        if states[step] <= _UNKNOWN:
            states[step] = state if _UNKNOWN <= state <= _LAST_STATE else _UNKNOWN

    def collected(self) -> tuple[Light, ...]:
        """The lights in order of first observation."""
        return tuple(
            Light(lane, np.array(point, np.float64), np.array(states, np.int8))
            for lane, (point, states) in self._lights.items()
        )


def rows_within(rows: Sequence[int], count: int, what: str) -> tuple[int, ...]:
    """Row numbers as ints."""
    for row in rows:
        if not 0 <= row < count:
            raise DataError(f"{what} names track {row}, there are {count}", cure="skip this record")
    return tuple(int(row) for row in rows)


def check_finite(*measured: np.ndarray[Any, Any]) -> None:
    """Refuse NaN and infinities among what is marked valid."""
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


def box_centre(
    rear_axle: Float[np.ndarray, "step 2"], heading: Float[np.ndarray, " step"], ahead_m: float
) -> Float[np.ndarray, "step 2"]:
    """Positions of the middle of a car ``ahead_m`` ahead of its rear axle, where poses of recording cars are."""
    return rear_axle + ahead_m * np.stack((np.cos(heading), np.sin(heading)), axis=-1)


def spacing_m(features: Sequence[MapFeature]) -> float | None:
    """Median distance of neighbouring points of lines (polygons are left out), metres; None without any."""
    gaps = [
        np.hypot(*np.diff(feature.points[:, :2], axis=0).T)
        for feature in features
        if feature.kind not in POLYGON_KINDS and len(feature.points) > 1
    ]
    return float(np.median(np.concatenate(gaps))) if gaps else None


def load_json(path: Path) -> Any:
    """The content of a JSON file."""
    try:
        return json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise DataError("is missing", file=path, cure="download it again") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"is no valid JSON ({error})", file=path, cure="download it again") from error


def windows_of(steps: int) -> int:
    """Number of scenarios that a recording of ``steps`` steps becomes (``scenario.recording.windows``)."""
    return 1 if steps <= STEPS else (steps - STEPS) // STRIDE + 1


def nonzero(**counts: int) -> dict[str, int]:
    """Counts by name for ``Recording.lost``; only what is not zero."""
    return {name: int(count) for name, count in counts.items() if count}


def one_point_features(features: Sequence[MapFeature]) -> int:
    """How many lines and polygons have one point only: without direction or extent they are nowhere on the map."""
    return sum(len(f.points) < 2 and f.kind != RoadKind.STOP_SIGN for f in features)


def check_within(most: float, *measured: np.ndarray[Any, Any]) -> None:
    """Refuse numbers that nothing on a road has: NaN, infinities, and what is further from 0 than ``most``."""
    if not all((np.abs(values) <= most).all() for values in measured):  # NaN compares false
        raise DataError(f"holds numbers that are not finite or beyond {most:g}", cure="skip this record")
