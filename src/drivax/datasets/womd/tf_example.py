"""tf.Examples of motion data: tracks, map points grouped into features, lights re-keyed by lane.

WOMD's converter defined the layout and others write it too: flat lists, one row per track, times split into past,
current and future, the map as one list of points, at most 16 lights per step.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from drivax.datasets import parsing
from drivax.datasets.womd.messages import example_class, parse
from drivax.errors import DataError
from drivax.geometry.vectors import wrap
from drivax.scenario.recording import Light, MapFeature, Recording, Tracks
from drivax.scenario.schema import LANE_KINDS, POLYGON_KINDS, AgentKind, Flag, RoadKind

SKIP = "skip this record, or download the file again"
_SPANS = ("past", "current", "future")
#: Floats hold every whole number up to here; beyond, ids stored as floats may have been rounded.
_EXACT = 2**24
Array = np.ndarray[Any, Any]


def is_motion(message: Any) -> bool:
    """Whether a parsed tf.Example holds motion data."""
    return any(entry.key == "state/current/x" for entry in message.features.feature)


def agent_kind(code: int) -> AgentKind:
    """The class of a WOMD object type; 0 (unset) and codes of later versions count as other."""
    return AgentKind(code) if 1 <= code <= 4 else AgentKind.OTHER


def features_of(payload: bytes) -> Features:
    """The features in a serialised tf.Example."""
    message = parse(example_class(), payload)
    if message is None or not message.features.feature:
        raise DataError("the payload is not a tf.Example", cure=SKIP)
    return Features(message)


class Features:
    """The features of one tf.Example by name; float lists (float32 in the file) become float64, int64 lists int64."""

    def __init__(self, message: Any) -> None:
        self._values: Mapping[str, Any] = {entry.key: entry.value for entry in message.features.feature}

    def has(self, name: str) -> bool:
        """Whether the feature exists and is not empty."""
        value = self._values.get(name)
        kind = value.WhichOneof("kind") if value is not None else None
        return kind is not None and len(getattr(value, kind).value) > 0

    def numbers(self, name: str, shape: tuple[int, ...] | None = None) -> Array:
        """A numeric feature, checked against and brought into a shape."""
        value = self._values.get(name)
        kind = value.WhichOneof("kind") if value is not None else None
        if kind not in ("float_list", "int64_list"):
            raise DataError(f"numeric feature {name} is missing", cure=SKIP)
        dtype = np.float64 if kind == "float_list" else np.int64
        with np.errstate(invalid="ignore"):  # a signalling NaN of a damaged file
            values = np.array(getattr(value, kind).value, dtype)
        if shape is None:
            return values
        count = int(np.prod(shape))
        if values.size != count:
            raise DataError(f"feature {name} has {values.size} values, not {count}", cure=SKIP)
        return values.reshape(shape)

    def integers(self, name: str, shape: tuple[int, ...] | None = None) -> Array:
        """A feature that must be stored as whole numbers: ids of lanes would be rounded by floats."""
        values = self.numbers(name, shape)
        if values.dtype != np.int64:
            raise DataError(f"feature {name} holds floats, not integers", cure=SKIP)
        return values

    def rows(self, name: str, used: Array) -> Array:
        """A feature with one value per track row, of the rows used; zeros where the file does not hold it."""
        if not self.has(name):
            return np.zeros(used.size, np.int64)
        return self.numbers(name, (self.numbers("state/id").size,))[used]

    def marked(self, name: str, used: Array) -> tuple[int, ...]:
        """Rows among those used whose value is 1."""
        return tuple(np.flatnonzero(self.rows(name, used) == 1).tolist())

    def scenario_id(self, payload: bytes) -> str:
        """The scenario's id, or the beginning of the payload's SHA-256 where the file does not tell."""
        value = self._values.get("scenario/id")
        text = "" if value is None else b"".join(value.bytes_list.value[:1]).decode("ascii", "replace")
        return text or hashlib.sha256(payload).hexdigest()[:16]

    @cached_property
    def spans(self) -> dict[str, int]:
        """Steps of past, current and future; the test split has no future, or one that is invalid throughout."""
        tracks = max(self.numbers("state/id").size, 1)
        steps = {}
        for span in _SPANS:
            name = f"state/{span}/valid"
            present = self.has(name) and (span != "future" or bool((self.numbers(name) == 1).any()))
            steps[span] = self.numbers(name).size // tracks if present else 0
        if steps["current"] != 1:
            raise DataError(f"state/current holds {steps['current']} steps, not 1", cure=SKIP)
        return steps

    def over_time(self, name: str, used: Array) -> Array:
        """``state/{past,current,future}/<name>`` joined, of the rows used: ``[track, time]``."""
        count = self.numbers("state/id").size
        parts = [
            self.numbers(f"state/{span}/{name}", (count, steps))[used]
            for span, steps in self.spans.items()
            if steps
        ]
        return np.concatenate(parts, axis=1)


def recording(table: Features, payload: bytes, used: Array, dataset: str, source_format: str) -> Recording:
    """Return the recording in the rows used.

    Invalid entries (-1 in the file) are zeros, headings are wrapped. Lights are keyed by lane because the 16 slots
    hold different lanes over time. ``path_samples`` count as lost: the route among them was marked with the log's
    future.
    """
    track_id = track_ids(table, used)
    made = tracks(table, used, track_id)
    mapped, truncated = map_features(table)
    scenario_id = table.scenario_id(payload)
    return Recording(
        scenario_id=scenario_id,
        dataset=dataset,
        segment=scenario_id,
        timestamps_s=timestamps(table, used, made.valid),
        current_step=table.spans["past"],
        ego=ego_row(table, used),
        tracks=made,
        features=mapped,
        lights=lights(table),
        to_predict=table.marked("state/tracks_to_predict", used),
        of_interest=table.marked("state/objects_of_interest", used),
        tags={"source_format": source_format},
        lost=lost(table, mapped),
        flags=Flag.TRUNCATED_MAP if truncated else Flag.NONE,
        split_gap_m=split_gap_m(mapped),
    )


def track_ids(features: Features, used: Array) -> Array:
    """Ids of the rows used, as int64.

    The file stores them as floats. WOMD's are far below 2**24, up to where that is exact.
    """
    ids = features.numbers("state/id")[used]
    if not np.isfinite(ids).all() or (ids != np.round(ids)).any() or (np.abs(ids) > _EXACT).any():
        raise DataError("state/id holds numbers that are no exact whole numbers", cure=SKIP)
    if (ids < 0).any() or len(np.unique(ids)) < len(ids):
        raise DataError("state/id names a track twice, or negatively", cure=SKIP)
    return ids.astype(np.int64)


def tracks(features: Features, used: Array, track_id: Array) -> Tracks:
    """The tracks in the rows used; what is not valid (-1 in the file) is zero, headings are wrapped."""
    valid = features.over_time("valid", used) == 1

    def measured(*names: str) -> Array:
        values = [np.where(valid, features.over_time(name, used).astype(np.float64), 0.0) for name in names]
        parsing.check_finite(*values)
        return values[0] if len(values) == 1 else np.stack(values, axis=-1)

    kinds = np.nan_to_num(features.numbers("state/type", (features.numbers("state/id").size,))[used])
    return Tracks(
        xy=measured("x", "y"),
        z=measured("z"),
        size=measured("length", "width", "height"),
        heading=np.where(valid, wrap(measured("bbox_yaw")), 0.0),
        velocity=measured("velocity_x", "velocity_y"),
        valid=valid,
        kind=np.array([agent_kind(int(kind)) for kind in kinds], np.int8),
        track_id=track_id,
    )


def timestamps(features: Features, used: Array, valid: Array) -> Array:
    """Seconds of every step; where no valid state has a time, 10 Hz from the nearest that has."""
    micros = np.where(valid, features.over_time("timestamp_micros", used), -1).max(axis=0, initial=-1)
    return parsing.seconds(np.where(micros >= 0, micros * 1e-6, np.nan))


def ego_row(features: Features, used: Array) -> int:
    """The ego's row among the rows used."""
    ego = features.marked("state/is_sdc", used)
    if len(ego) != 1:
        raise DataError(f"state/is_sdc marks {len(ego)} rows, not 1", cure=SKIP)
    return ego[0]


def lights(features: Features) -> tuple[Light, ...]:
    """Lights by lane: the slots are used by different lanes over time."""
    collector = parsing.Lights(sum(features.spans.values()))
    start = 0
    for span, steps in features.spans.items():
        base = f"traffic_light_state/{span}/"
        if steps and features.has(base + "id"):
            slots = features.numbers(base + "id").size // steps
            lanes = features.integers(base + "id", (steps, slots))
            states, valid = (features.numbers(base + name, (steps, slots)) for name in ("state", "valid"))
            points = np.stack([features.numbers(base + axis, (steps, slots)) for axis in "xyz"], axis=-1)
            seen = (valid == 1) & (lanes >= 0) & np.isfinite(states) & np.isfinite(points).all(axis=-1)
            for step, slot in np.argwhere(seen).tolist():
                collector.observe(
                    start + step, int(lanes[step, slot]), int(states[step, slot]), points[step, slot].tolist()
                )
        start += steps
    return collector.collected()


def map_features(features: Features) -> tuple[tuple[MapFeature, ...], bool]:
    """Map features in order of first appearance, and whether the list of points is full, so probably cut off."""
    base = "roadgraph_samples/"
    if not features.has(base + "id"):
        return (), False
    ids = features.integers(base + "id")
    kinds = features.numbers(base + "type", ids.shape)
    points = features.numbers(base + "xyz", (ids.size, 3)).astype(np.float64)
    valid = features.numbers(base + "valid", ids.shape) == 1
    keep = np.flatnonzero(valid & np.isin(kinds, [int(kind) for kind in RoadKind]))
    parsing.check_finite(points[keep])
    limits = _limits(features, ids.size)
    made = []
    for group in _groups(ids, keep):
        kind = RoadKind(int(kinds[group[0]]))
        limit = float(limits[group].max()) * parsing.MPS_PER_MPH if kind in LANE_KINDS else 0.0
        ring = _unclosed(points[group]) if kind in POLYGON_KINDS else points[group]
        made.append(MapFeature(int(ids[group[0]]), kind, ring, limit_mps=limit if limit > 0 else None))
    return tuple(made), bool(valid.all())


def _groups(ids: Array, keep: Array) -> list[Array]:
    """Point numbers of each feature, features in order of first appearance."""
    if not keep.size:
        return []
    order = keep[np.argsort(ids[keep], kind="stable")]
    starts = np.flatnonzero(np.diff(ids[order])) + 1
    return sorted(np.split(order, starts), key=lambda group: group[0])


def _limits(features: Features, count: int) -> Array:
    """Speed limits of the map's points in mph, 0 where not known: only ScenarioMax writes them."""
    name = "roadgraph_samples/speed_limit"
    if not features.has(name):
        return np.zeros(count)
    limits = features.numbers(name, (count,))
    return np.where(np.isfinite(limits) & (limits > 0), limits, 0.0)


def _unclosed(points: Array) -> Array:
    """A ring without its repeated last point: the writers close polygons, ours are closed implicitly."""
    closed = len(points) > 1 and np.allclose(points[0], points[-1], rtol=0, atol=1e-3)
    return points[:-1] if closed else points


def is_coarse(mapped: Sequence[MapFeature]) -> bool:
    """Whether the map is sampled at 1 m (from v1.2 on) rather than at 0.5 m."""
    return (parsing.spacing_m(mapped) or 0.5) > 0.75


def split_gap_m(mapped: Sequence[MapFeature]) -> float:
    """Where polylines are cut: at twice the nominal spacing of their points."""
    return 2.0 if is_coarse(mapped) else 1.0


def lost(features: Features, mapped: Sequence[MapFeature]) -> dict[str, int]:
    """What is left out: the ego's published paths, and features of one point."""
    return parsing.nonzero(paths=_paths(features), one_point_features=parsing.one_point_features(mapped))


def _paths(features: Features) -> int:
    """How many paths of the ego the file holds."""
    if not (features.has("path_samples/valid") and features.has("path_samples/on_route")):
        return 0
    valid = features.numbers("path_samples/valid") == 1
    rows = features.numbers("path_samples/on_route").size
    return int(valid.reshape(rows, -1).any(axis=1).sum()) if valid.size % rows == 0 else rows
