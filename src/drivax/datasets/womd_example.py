"""Reader of WOMD tf.Examples in TFRecord files (motion dataset v1.0 to v1.3.1).

They hold less than the protos: at most 128 tracks, no lane graph, no speed limits, no lanes of stop signs, the map
as one list of points that the writer cut off at 20,000 or 30,000, and at most 16 lights per step.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivax.datasets import readings, womd
from drivax.datasets.messages import example_class, parse
from drivax.datasets.reader import BadRecord
from drivax.errors import DataError
from drivax.geometry.angles import wrap
from drivax.scenario.recording import Light, MapFeature, Recording, Tracks
from drivax.scenario.schema import POLYGON_KINDS, Flag, RoadKind

_SKIP = "skip this record, or download the file again"
_SPANS = ("past", "current", "future")
_Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class WomdExample:
    """Reads tf.Examples: tracks, map points grouped into features, lights re-keyed by lane."""

    name: str = womd.EXAMPLE_FORMAT
    patterns: tuple[str, ...] = womd.PATTERNS

    def recognise(self, path: Path) -> bool:
        """Whether the first readable record is a tf.Example of the motion dataset."""
        return womd.recognise(path, self.name)

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """The recordings of one file, and in their place the records that cannot be read."""
        return womd.read(path, self.name, decode)


def decode(payload: bytes) -> Recording:
    """The recording in a serialised tf.Example.

    Padding rows are dropped; the ego row, rows to predict and of interest are numbered among the rest. Invalid
    entries (-1 in the file) are zeros, headings are wrapped. Lights are keyed by lane id because the 16 slots are
    used by different lanes over time. Routes (``path_samples``) are ignored.

    Raises:
        DataError: The payload is no such tf.Example, or a feature is missing or has the wrong length.
    """
    message = parse(example_class(), payload)
    if message is None or not message.features.feature:
        raise DataError("the payload is not a tf.Example", cure=_SKIP)
    table = _Features(message)
    ids = table.numbers("state/id")
    if not np.isfinite(ids).all():
        raise DataError("state/id holds numbers that are not finite", cure=_SKIP)
    used = np.flatnonzero(ids != -1)
    spans = table.spans()
    tracks, times = _tracks(table, spans, used)
    ego = np.flatnonzero(table.rows("state/is_sdc", used) == 1)
    if ego.size != 1:
        raise DataError(f"state/is_sdc marks {ego.size} rows, not 1", cure=_SKIP)
    features, truncated = _map(table)
    lights = _lights(table, spans)
    scenario_id = table.text("scenario/id") or hashlib.sha256(payload).hexdigest()[:16]
    return Recording(
        scenario_id=scenario_id,
        dataset=womd.DATASET,
        segment=scenario_id,
        timestamps_s=times,
        current_step=spans["past"],
        ego=int(ego[0]),
        tracks=tracks,
        features=features,
        lights=lights,
        to_predict=tuple(np.flatnonzero(table.rows("state/tracks_to_predict", used) == 1).tolist()),
        of_interest=tuple(np.flatnonzero(table.rows("state/objects_of_interest", used) == 1).tolist()),
        flags=Flag.TRUNCATED_MAP if truncated else Flag.NONE,
        split_gap_m=_split_gap_m(features),
    )


class _Features:
    """The features of one tf.Example by name; float lists become float32 (as stored), int64 lists int64."""

    def __init__(self, message: Any) -> None:
        self._values: Mapping[str, Any] = {entry.key: entry.value for entry in message.features.feature}

    def has(self, name: str) -> bool:
        """Whether the feature exists and is not empty."""
        value = self._values.get(name)
        kind = value.WhichOneof("kind") if value is not None else None
        return kind is not None and len(getattr(value, kind).value) > 0

    def numbers(self, name: str, shape: tuple[int, ...] | None = None) -> _Array:
        """A numeric feature, checked against and brought into a shape."""
        value = self._values.get(name)
        kind = value.WhichOneof("kind") if value is not None else None
        if kind not in ("float_list", "int64_list"):
            raise DataError(f"numeric feature {name} is missing", cure=_SKIP)
        dtype = np.float32 if kind == "float_list" else np.int64
        values = np.array(getattr(value, kind).value, dtype)
        if shape is None:
            return values
        wanted = int(np.prod(shape))
        if values.size != wanted:
            raise DataError(f"feature {name} has {values.size} values, not {wanted}", cure=_SKIP)
        return values.reshape(shape)

    def rows(self, name: str, used: _Array) -> _Array:
        """A feature with one value per track row, of the rows used; zeros where the file does not hold it."""
        if not self.has(name):
            return np.zeros(used.size, np.int64)
        return self.numbers(name, (self.numbers("state/id").size,))[used]

    def text(self, name: str) -> str:
        """A text feature; empty where the file does not hold it."""
        value = self._values.get(name)
        return "" if value is None else b"".join(value.bytes_list.value[:1]).decode("ascii", "replace")

    def spans(self) -> dict[str, int]:
        """Steps of past, current and future; the test split has no future, or one that is invalid throughout."""
        tracks = max(self.numbers("state/id").size, 1)
        steps = {}
        for span in _SPANS:
            name = f"state/{span}/valid"
            present = self.has(name) and (span != "future" or bool((self.numbers(name) == 1).any()))
            steps[span] = self.numbers(name).size // tracks if present else 0
        if steps["current"] != 1:
            raise DataError(f"state/current holds {steps['current']} steps, not 1", cure=_SKIP)
        return steps

    def over_time(self, name: str, spans: Mapping[str, int], tracks: int) -> _Array:
        """``state/{past,current,future}/<name>`` joined: ``[track, time]``."""
        parts = [
            self.numbers(f"state/{span}/{name}", (tracks, steps)) for span, steps in spans.items() if steps
        ]
        return np.concatenate(parts, axis=1)


def _tracks(table: _Features, spans: Mapping[str, int], used: _Array) -> tuple[Tracks, _Array]:
    count = table.numbers("state/id").size

    def read(name: str) -> _Array:
        return table.over_time(name, spans, count)[used]

    valid = read("valid") == 1

    def measured(*names: str) -> _Array:
        values = [np.where(valid, read(name).astype(np.float64), 0.0) for name in names]
        readings.check_finite(*values)
        return values[0] if len(values) == 1 else np.stack(values, axis=-1)

    kinds = table.numbers("state/type", (count,))[used]
    tracks = Tracks(
        xy=measured("x", "y"),
        z=measured("z"),
        size=measured("length", "width", "height"),
        heading=np.where(valid, wrap(measured("bbox_yaw")), 0.0),
        velocity=measured("velocity_x", "velocity_y"),
        valid=valid,
        kind=np.array([womd.agent_kind(int(kind)) for kind in np.nan_to_num(kinds)], np.int8),
        track_id=np.array([int(number) for number in table.numbers("state/id")[used]], np.int64),
    )
    micros = np.where(valid, read("timestamp_micros"), -1).max(axis=0, initial=-1)
    return tracks, readings.seconds(np.where(micros >= 0, micros * 1e-6, np.nan))


def _lights(table: _Features, spans: Mapping[str, int]) -> tuple[Light, ...]:
    lights = readings.Lights(sum(spans.values()))
    start = 0
    for span, steps in spans.items():
        base = f"traffic_light_state/{span}/"
        if steps and table.has(base + "id"):
            slots = table.numbers(base + "id").size // steps
            read = {
                name: table.numbers(base + name, (steps, slots))
                for name in ("id", "state", "valid", "x", "y", "z")
            }
            for step, slot in np.argwhere(read["valid"] == 1).tolist():
                point = [float(read[axis][step, slot]) for axis in "xyz"]
                lights.observe(
                    start + step, int(read["id"][step, slot]), int(read["state"][step, slot]), point
                )
        start += steps
    return lights.collected()


def _map(table: _Features) -> tuple[tuple[MapFeature, ...], bool]:
    """Features in order of first appearance, and whether the list of points is full, so probably cut off."""
    base = "roadgraph_samples/"
    if not table.has(base + "id"):
        return (), False
    ids = table.numbers(base + "id")
    kinds = table.numbers(base + "type", ids.shape)
    points = table.numbers(base + "xyz", (ids.size, 3)).astype(np.float64)
    valid = table.numbers(base + "valid", ids.shape) == 1
    keep = np.flatnonzero(valid & np.isin(kinds, [int(kind) for kind in RoadKind]))
    order = keep[np.argsort(ids[keep], kind="stable")]
    starts = np.flatnonzero(np.diff(ids[order], prepend=ids[order][:1] - 1)) if order.size else order
    groups = sorted(np.split(order, starts[1:]), key=lambda group: group[0]) if order.size else []
    features = [
        _feature(int(ids[group[0]]), RoadKind(int(kinds[group[0]])), points[group]) for group in groups
    ]
    return tuple(features), bool(valid.all())


def _split_gap_m(features: Sequence[MapFeature]) -> float:
    """Twice the nominal point spacing: 0.5 m up to v1.1, 1.0 m from v1.2 (told apart by the median)."""
    gaps = [
        np.hypot(*np.diff(feature.points[:, :2], axis=0).T)
        for feature in features
        if feature.kind not in POLYGON_KINDS and len(feature.points) > 1
    ]
    return 2.0 if gaps and float(np.median(np.concatenate(gaps))) > 0.75 else 1.0


def _feature(feature_id: int, kind: RoadKind, points: _Array) -> MapFeature:
    # The writer closes polygons; ours are closed implicitly.
    if kind in POLYGON_KINDS and len(points) > 1 and np.allclose(points[0], points[-1], rtol=0, atol=1e-3):
        points = points[:-1]
    return MapFeature(feature_id, kind, points)
