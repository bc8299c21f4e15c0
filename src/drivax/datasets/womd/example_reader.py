"""Readers of tf.Examples in TFRecord files: of WOMD (motion dataset v1.0 to v1.3.1) and of ScenarioMax.

They hold less than the protos: at most 128 tracks in flat lists, split into past, current and future; no lane graph,
no speed limits, no lanes of stop signs; the map as one list of points that the writer cut off at 20,000 or 30,000; at
most 16 lights per step.

ScenarioMax, which V-Max reads, has the same layout with differences: ego is row 0, ids are renumbered from 0, padding
looks like tracks, times, ``speed`` and ``vel_yaw`` are missing, map points have limits in mph, lights keep their slot
and are UNKNOWN where nothing was known, ten paths of ego are included, and the original data set is not named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivax.datasets import parsing
from drivax.datasets.reader import Description
from drivax.datasets.womd.messages import SKIP, ExampleFeatures, features_of
from drivax.datasets.womd.tfrecord import (
    DATASET,
    EXAMPLE_FORMAT,
    FULL_NAME,
    SCENARIOMAX_FORMAT,
    TfRecordReader,
    agent_kind,
    count_records,
    notes_of,
)
from drivax.errors import DataError
from drivax.geometry.vectors import wrap
from drivax.scenario.recording import Light, MapFeature, Recording, Tracks, differentiate
from drivax.scenario.schema import DT_S, LANE_KINDS, POLYGON_KINDS, Flag, LightState, RoadKind

#: float32 holds every integer below this; larger ids may have been rounded.
_EXACT = 2**24
#: Median spacing of map points above which a file is of v1.2 or later (1 m instead of 0.5 m), m.
_COARSE_M = 0.75
_FLAVOUR = "tf.Examples in TFRecord"
Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class WomdExample(TfRecordReader):
    """Reader of WOMD's tf.Examples: tracks, map points grouped into features, lights by lane."""

    name: str = EXAMPLE_FORMAT
    companions: tuple[str, ...] = ("export.json",)

    def decode(self, payload: bytes) -> Recording:
        """Return the recording in a serialised tf.Example; rows without an id are padding."""
        table = features_of(payload)
        rows = np.flatnonzero(table.numbers("state/id") != -1)
        return _recording(table, payload, rows, DATASET, self.name)

    def describe(self, path: Path) -> Description:
        """Describe the first record: version by the spacing of map points, truncated map, paths."""
        recording = self.first(path)
        has_limits = any(feature.limit_mps is not None for feature in recording.features)
        limits = "" if has_limits else " and no speed limits"
        notes = [*notes_of(recording), f"no lane graph{limits}: lanes are chained by geometry"]
        if Flag.TRUNCATED_MAP in recording.flags:
            notes.append(
                "the list of map points is full, so the map is cut off; the Scenario protos hold all of it"
            )
        if "paths" in recording.lost:
            notes.append("path_samples are not used: routes are computed again")
        has_spacing = parsing.spacing_m(recording.features) is not None
        version = "1.2 or later" if _is_coarse(recording.features) else "1.0 or 1.1" if has_spacing else None
        return Description(FULL_NAME, _FLAVOUR, version, count_records(path), tuple(notes))


@dataclass(frozen=True)
class ScenarioMax(TfRecordReader):
    """Reader of ScenarioMax's tf.Examples: tracks, map with limits, lights by lane."""

    name: str = SCENARIOMAX_FORMAT

    def decode(self, payload: bytes) -> Recording:
        """Return the recording in a serialised tf.Example of ScenarioMax.

        Rows that are never valid are padding. Without times, steps are 0.1 s apart; missing velocities (-1 throughout)
        are computed from positions. Lights that are UNKNOWN throughout are dropped: the writer stores what it does not
        know as UNKNOWN, for some sources also yellow.
        """
        table = features_of(payload)
        all_rows = np.arange(table.numbers("state/id").size)
        rows = np.flatnonzero((table.over_time("valid", all_rows) == 1).any(axis=1))
        recording = _recording(table, payload, rows, self.name, self.name)
        tracks, flags = recording.tracks, recording.flags
        if tracks.valid.any() and (tracks.velocity[tracks.valid] == -1.0).all():
            velocity = differentiate(tracks.xy, tracks.valid, recording.timestamps_s)
            tracks, flags = replace(tracks, velocity=velocity), flags | Flag.DIFFERENTIATED_VELOCITY
        lights = tuple(light for light in recording.lights if (light.states > LightState.UNKNOWN).any())
        lost = {**recording.lost, **parsing.nonzero(lights_without_state=len(recording.lights) - len(lights))}
        return replace(recording, tracks=tracks, lights=lights, lost=lost, flags=flags)

    def describe(self, path: Path) -> Description:
        """Describe the first record: speed limits, truncated map, paths."""
        recording = self.first(path)
        limits = sum(feature.limit_mps is not None for feature in recording.features)
        notes = [
            *notes_of(recording),
            "the file does not say which data set its scenarios come from",
            f"{limits} lanes have a speed limit; no lane graph: lanes are chained by geometry",
        ]
        if Flag.TRUNCATED_MAP in recording.flags:
            notes.append("the list of map points is full, so the map is cut off")
        if "paths" in recording.lost:
            notes.append(
                "path_samples are not used (they were ranked by the log's future): routes are computed again"
            )
        return Description("ScenarioMax", _FLAVOUR, None, count_records(path), tuple(notes))


def _recording(
    table: ExampleFeatures, payload: bytes, rows: Array, dataset: str, source_format: str
) -> Recording:
    """Return the recording of the tracks in some rows.

    Invalid entries (-1 in the file) become zeros, headings are wrapped. Lights are keyed by lane because the 16 slots
    hold different lanes over time. ``path_samples`` count as lost: the route among them was marked with the log's
    future.
    """
    tracks = _tracks(table, rows)
    features, is_full = _map_features(table)
    lights, lost_lights = _lights(table, features)
    scenario_id = table.scenario_id(payload)
    recording = Recording(
        scenario_id=scenario_id,
        dataset=dataset,
        segment=parsing.segment_of(scenario_id),
        timestamps_s=_timestamps(table, rows, tracks.valid),
        current_step=table.spans["past"],
        ego=_ego_row(table, rows),
        tracks=tracks,
        features=features,
        lights=lights,
        to_predict=table.find_flagged("state/tracks_to_predict", rows),
        of_interest=table.find_flagged("state/objects_of_interest", rows),
        tags={"source_format": source_format},
        lost=parsing.nonzero(
            paths=_paths(table),
            one_point_features=parsing.one_point_features(features),
            lights_without_place=lost_lights,
            unknown_fields=table.count_unknown(),
        ),
        flags=Flag.TRUNCATED_MAP if is_full else Flag.NONE,
        split_gap_m=2.0 if _is_coarse(features) else 1.0,  # twice the nominal spacing of points
    )
    return parsing.shift(recording, table.origin())


def _track_ids(features: ExampleFeatures, rows: Array) -> Array:
    """Return ids of the rows, which are stored as floats; refuse those that may have been rounded."""
    ids = features.numbers("state/id")[rows]
    if not np.isfinite(ids).all() or (ids != np.round(ids)).any() or (np.abs(ids) >= _EXACT).any():
        raise DataError("state/id contains numbers that are not exact integers", cure=SKIP)
    if (ids < 0).any() or len(np.unique(ids)) < len(ids):
        raise DataError("state/id names a track twice, or negatively", cure=SKIP)
    return ids.astype(np.int64)


def _tracks(features: ExampleFeatures, rows: Array) -> Tracks:
    """Return the tracks in the rows."""
    track_id = _track_ids(features, rows)
    valid = features.over_time("valid", rows) == 1

    def read(*names: str) -> Array:
        """Return fields of the states on a last axis, or one field without it; 0 in invalid states."""
        values = [np.where(valid, features.over_time(name, rows).astype(np.float64), 0.0) for name in names]
        parsing.check_finite(*values)
        return values[0] if len(values) == 1 else np.stack(values, axis=-1)

    kinds = np.nan_to_num(features.numbers("state/type", (features.numbers("state/id").size,))[rows])
    return Tracks(
        xy=read("x", "y"),
        z=read("z"),
        size=read("length", "width", "height"),
        heading=np.where(valid, wrap(read("bbox_yaw")), 0.0),
        velocity=read("velocity_x", "velocity_y"),
        valid=valid,
        kind=np.array([agent_kind(int(kind)) for kind in kinds], np.int8),
        track_id=track_id,
    )


def _timestamps(features: ExampleFeatures, rows: Array, valid: Array) -> Array:
    """Return the time of every step, seconds.

    A step at which no valid state has a time is extrapolated at 10 Hz from the last earlier step that has one, else
    from the first later step; without any time the steps begin at 0.
    """
    micros = np.where(valid, features.over_time("timestamp_micros", rows), -1).max(axis=0, initial=-1)
    steps, known = np.arange(len(micros)), np.flatnonzero((micros >= 0) & np.isfinite(micros))
    if known.size == 0:
        return steps * DT_S
    nearest = known[np.maximum(np.searchsorted(known, steps, side="right") - 1, 0)]
    return micros[nearest] * 1e-6 + (steps - nearest) * DT_S


def _ego_row(features: ExampleFeatures, rows: Array) -> int:
    """Return the index of the ego among the rows."""
    ego = features.find_flagged("state/is_sdc", rows)
    if len(ego) != 1:
        raise DataError(f"state/is_sdc marks {len(ego)} rows, not 1", cure=SKIP)
    return ego[0]


def _lights(features: ExampleFeatures, road_map: Sequence[MapFeature]) -> tuple[tuple[Light, ...], int]:
    """Return the lights by lane, and the number of lights without a position."""
    collector = parsing.Lights(sum(features.spans.values()))
    start = 0
    for span, steps in features.spans.items():
        base = f"traffic_light_state/{span}/"
        if steps and features.has(base + "id"):
            slots = features.numbers(base + "id").size // steps
            lanes = features.integers(base + "id", (steps, slots))
            states, valid = (features.numbers(base + name, (steps, slots)) for name in ("state", "valid"))
            points = np.stack([features.numbers(base + axis, (steps, slots)) for axis in "xyz"], axis=-1)
            is_observed = (valid == 1) & (lanes >= 0) & np.isfinite(states) & np.isfinite(points).all(axis=-1)
            for step, slot in np.argwhere(is_observed).tolist():
                collector.observe(
                    start + step, int(lanes[step, slot]), int(states[step, slot]), points[step, slot].tolist()
                )
        start += steps
    return collector.collect(road_map)


def _map_features(features: ExampleFeatures) -> tuple[tuple[MapFeature, ...], bool]:
    """Return map features in order of first appearance, and whether the list of points is full, so probably cut off."""
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
    road_map = []
    for group in _groups(ids, keep):
        kind = RoadKind(int(kinds[group[0]]))
        limit = float(limits[group].max()) * parsing.MPS_PER_MPH if kind in LANE_KINDS else 0.0
        line = _open_ring(points[group]) if kind in POLYGON_KINDS else points[group]
        road_map.append(MapFeature(int(ids[group[0]]), kind, line, limit_mps=limit if limit > 0 else None))
    return tuple(road_map), bool(valid.all())


def _groups(ids: Array, keep: Array) -> list[Array]:
    """Return the point numbers of each feature, features in order of first appearance."""
    order = keep[np.argsort(ids[keep], kind="stable")]
    groups = np.split(order, np.flatnonzero(np.diff(ids[order])) + 1)
    return sorted(groups, key=lambda group: group[0]) if keep.size else []


def _limits(features: ExampleFeatures, count: int) -> Array:
    """Return speed limits of map points in mph, 0 if unknown: Waymo's files have none."""
    name = "roadgraph_samples/speed_limit"
    if not features.has(name):
        return np.zeros(count)
    limits = features.numbers(name, (count,))
    return np.where(np.isfinite(limits) & (limits > 0), limits, 0.0)


def _open_ring(points: Array) -> Array:
    """Drop the repeated last point of a ring: map features are closed implicitly."""
    is_closed = len(points) > 1 and np.allclose(points[0], points[-1], rtol=0, atol=1e-3)
    return points[:-1] if is_closed else points


def _is_coarse(road_map: Sequence[MapFeature]) -> bool:
    """Return whether the map is sampled at 1 m (from v1.2 on) rather than at 0.5 m; False without lines."""
    return (parsing.spacing_m(road_map) or 0.0) > _COARSE_M


def _paths(features: ExampleFeatures) -> int:
    """Count paths of the ego in the file."""
    if not (features.has("path_samples/valid") and features.has("path_samples/on_route")):
        return 0
    valid = features.numbers("path_samples/valid") == 1
    rows = features.numbers("path_samples/on_route").size
    return int(valid.reshape(rows, -1).any(axis=1).sum()) if valid.size % rows == 0 else rows
