"""What the two forms of the Waymo Open Motion Dataset share: telling them apart, units, lights, flags."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from drivax.datasets.messages import example_class, parse, scenario_class
from drivax.datasets.reader import BadRecord
from drivax.datasets.tfrecord import read_records
from drivax.errors import DataError, DrivaxError
from drivax.scenario.schema import (
    LANE_KINDS,
    AgentKind,
    Flag,
    Light,
    LightState,
    MapFeature,
    Recording,
)

DATASET = "womd"
SCENARIO_FORMAT, EXAMPLE_FORMAT = "womd-scenario", "womd-example"
#: Shards are called ``...tfrecord-00000-of-01000``, samples ``....tfrecord``.
PATTERNS = ("*.tfrecord", "*.tfrecord-*", "*.tfrecords")
_CONTENTS = {SCENARIO_FORMAT: "WOMD Scenario protos", EXAMPLE_FORMAT: "WOMD tf.Examples"}


def flavour(payload: bytes) -> str | None:
    """The format of a record's payload by its content, None where it is neither form of WOMD motion data."""
    example = parse(example_class(), payload)
    if example is not None and any(entry.key == "state/current/x" for entry in example.features.feature):
        return EXAMPLE_FORMAT
    scenario = parse(scenario_class(), payload)
    if scenario is not None and scenario.scenario_id and scenario.tracks:
        return SCENARIO_FORMAT
    return None


def recognise(path: Path, name: str) -> bool:
    """Whether the first readable record of a TFRecord file is of the format ``name``."""
    try:
        for _, record in read_records(path):
            if isinstance(record, bytes):
                return flavour(record) == name
    except DataError:
        return False
    return False


def read(path: Path, name: str, decode: Callable[[bytes], Recording]) -> Iterator[Recording | BadRecord]:
    """The recordings of a TFRecord file whose payloads ``decode`` reads, and bad records in their places."""
    for number, record in read_records(path):
        if isinstance(record, DataError):
            yield BadRecord.of(record, path, number)
            continue
        try:
            yield decode(record)
        except DataError as error:
            yield BadRecord.of(explain(error, record, name), path, number)


def explain(error: DataError, payload: bytes, name: str) -> DrivaxError:
    """The error, or a better one where the payload is of the other form of WOMD."""
    other = flavour(payload)
    if other is None or other == name:
        return error
    return DataError(f"holds {_CONTENTS[other]}, not {_CONTENTS[name]}", cure=f"use --format {other}")


def agent_kind(code: int) -> AgentKind:
    """The class of a WOMD object type; 0 (unset) and codes of later versions count as other."""
    return AgentKind(code) if 1 <= code <= 4 else AgentKind.OTHER


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


def flags_of(features: Sequence[MapFeature], lights: Sequence[Light], steps: int, current_step: int) -> Flag:
    """The flags that follow from what a recording holds."""
    flags = Flag.NONE
    lanes = [feature for feature in features if feature.kind in LANE_KINDS]
    if lights:
        flags |= Flag.LIGHTS
    if any(lane.successors or lane.predecessors for lane in lanes):
        flags |= Flag.LANE_GRAPH
    if any(lane.limit_mps is not None for lane in lanes):
        flags |= Flag.SPEED_LIMITS
    if any(feature.points[:, 2].any() for feature in features):
        flags |= Flag.ELEVATION
    if current_step == steps - 1:
        flags |= Flag.NO_FUTURE
    return flags


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
