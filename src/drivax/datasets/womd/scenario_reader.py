"""Reader of WOMD ``Scenario`` protos in TFRecord files (motion dataset v1.0 to v1.3.1, 9 s and 20 s files)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from drivax.datasets import parsing
from drivax.datasets.reader import Description
from drivax.datasets.womd.messages import POINTS, SKIP, STATES, parse, read_table, unknown_fields
from drivax.datasets.womd.tfrecord import (
    DATASET,
    FULL_NAME,
    SCENARIO_FORMAT,
    TfRecordReader,
    agent_kind,
    count_records,
    notes_of,
)
from drivax.errors import DataError
from drivax.geometry.vectors import wrap
from drivax.scenario.recording import Light, MapFeature, Recording, Tracks
from drivax.scenario.schema import EDGE_KINDS, LANE_KINDS, LINE_KINDS, RoadKind

#: Points are 0.5 m apart; twice that is a jump where the map was clipped, not road.
_SPLIT_GAP_M = 1.0
_POLYGONS = {kind: RoadKind[kind.upper()] for kind in ("crosswalk", "speed_bump", "driveway")}
_Points = Float64[np.ndarray, "point 3"]


@dataclass(frozen=True)
class WomdScenario(TfRecordReader):
    """Reader of Scenario protos: dense tracks, map with lane graph and speed limits, lights by lane."""

    name: str = SCENARIO_FORMAT

    def decode(self, payload: bytes) -> Recording:
        """Return the recording in a serialised ``Scenario``.

        Positions stay in the proto's map frame, metres, float64. Headings are wrapped (files hold up to 10 rad),
        invalid states are zeros (files keep a z there), speed limits are m/s (0 in the file means unknown). Dangling
        links are kept.
        """
        message = parse("Scenario", payload)
        if message is None or not message.scenario_id:
            raise DataError("the payload is not a WOMD Scenario proto", cure=SKIP)
        steps = len(message.timestamps_seconds)
        _check(message, steps)
        features, lost = _features(message.map_features)
        lights, lost_lights = _lights(message.dynamic_map_states, steps, features)
        rows = {track.id: row for row, track in enumerate(message.tracks)}
        return Recording(
            scenario_id=message.scenario_id,
            dataset=DATASET,
            segment=message.scenario_id,
            timestamps_s=np.array(message.timestamps_seconds, np.float64),
            current_step=message.current_time_index,
            ego=message.sdc_track_index,
            tracks=_tracks(message.tracks, steps),
            features=features,
            lights=lights,
            to_predict=parsing.rows_within(
                [track.track_index for track in message.tracks_to_predict], len(rows), "tracks_to_predict"
            ),
            # These are track ids, tracks_to_predict are rows.
            of_interest=tuple(rows[track] for track in message.objects_of_interest if track in rows),
            tags={"source_format": self.name},
            lost=parsing.nonzero(
                lost, lights_without_place=lost_lights, unknown_fields=_unknown_fields(message, payload)
            ),
            split_gap_m=_SPLIT_GAP_M,
        )

    def describe(self, path: Path) -> Description:
        """Describe the first record: version by kinds of features, lane graph, lights."""
        recording = self.first(path)
        lanes = [feature for feature in recording.features if feature.kind in LANE_KINDS]
        has_links = any(lane.successors or lane.predecessors for lane in lanes)
        notes = list(notes_of(recording))
        if not has_links:
            notes.append("no lane graph in the first record: lanes are chained by geometry")
        has_driveways = any(feature.kind == RoadKind.DRIVEWAY for feature in recording.features)
        version = "1.2 or later" if has_driveways else "1.1 or later" if has_links else None
        flavour = "Scenario protos in TFRecord"
        return Description(FULL_NAME, flavour, version, count_records(path), tuple(notes))


def _unknown_fields(message: Any, payload: bytes) -> int:
    """Count fields of unknown numbers; of the states, which are kept as bytes, one of each length is examined."""
    states = {len(state): state for track in message.tracks for state in track.states}
    pairs = ((parse(STATES.name, blob), blob) for blob in states.values())
    in_states = (unknown_fields(state, blob) for state, blob in pairs if state is not None)
    return len(unknown_fields(message, payload).union(*in_states))


def _check(message: Any, steps: int) -> None:
    """Refuse a scenario whose counts, indices or ids contradict each other."""
    if not isinstance(message.scenario_id, str):  # protobuf gives bytes where a string is not UTF-8
        raise DataError("scenario_id is not text", cure=SKIP)
    if steps == 0 or not message.tracks:
        raise DataError("the scenario has no steps or no tracks", cure=SKIP)
    if not 0 <= message.current_time_index < steps:
        raise DataError(f"current_time_index is {message.current_time_index} of {steps} steps", cure=SKIP)
    parsing.rows_within([message.sdc_track_index], len(message.tracks), "sdc_track_index")
    if len(message.dynamic_map_states) > steps:
        raise DataError(f"{len(message.dynamic_map_states)} light steps for {steps} steps", cure=SKIP)
    ids = set()
    for track in message.tracks:
        if len(track.states) != steps:
            raise DataError(f"track {track.id} has {len(track.states)} states for {steps} steps", cure=SKIP)
        if track.id in ids:
            raise DataError(f"two tracks have the id {track.id}", cure=SKIP)
        ids.add(track.id)


def _tracks(tracks: Any, steps: int) -> Tracks:
    blobs = [state for track in tracks for state in track.states]
    # Columns in the order of the message ObjectState.
    table = read_table(blobs, STATES).reshape(len(tracks), steps, -1)
    valid = table[..., 9] > 0.5
    table[~valid] = 0.0
    parsing.check_finite(table)
    return Tracks(
        xy=table[..., 0:2].copy(),
        z=table[..., 2].copy(),
        size=table[..., 3:6].copy(),
        heading=np.where(valid, wrap(table[..., 6]), 0.0),
        velocity=table[..., 7:9].copy(),
        valid=valid,
        kind=np.array([agent_kind(track.object_type) for track in tracks], np.int8),
        track_id=np.array([track.id for track in tracks], np.int64),
    )


def _lights(states: Any, steps: int, features: Sequence[MapFeature]) -> tuple[tuple[Light, ...], int]:
    lights = parsing.Lights(steps)
    for step, state in enumerate(states):
        for lane in state.lane_states:
            point = lane.stop_point
            lights.observe(step, lane.lane, lane.state, (point.x, point.y, point.z))
    return lights.collect(features)


def _features(messages: Any) -> tuple[tuple[MapFeature, ...], dict[str, int]]:
    """Return the map features, and the numbers of skipped ones and of those with one point by name."""
    bodies: dict[int, tuple[str, Any, Sequence[bytes]]] = {}
    unknown = duplicate = empty = 0
    for message in messages:
        kind = message.WhichOneof("kind")
        if kind is None:  # a kind of feature that later versions may add
            unknown += 1
            continue
        body = getattr(message, kind)
        blobs = _blobs(kind, body)
        if not blobs:
            empty += 1
        elif message.id in bodies:
            duplicate += 1
        else:
            bodies[message.id] = kind, body, blobs
    points = read_table([blob for *_, blobs in bodies.values() for blob in blobs], POINTS)
    ends = np.cumsum([len(blobs) for *_, blobs in bodies.values()], dtype=np.int64)[:-1]
    # Without features ``np.split`` still returns one, empty part.
    features = tuple(
        _feature(feature_id, kind, body, line.copy())
        for (feature_id, (kind, body, _)), line in zip(bodies.items(), np.split(points, ends), strict=False)
    )
    lost = parsing.nonzero(
        unknown_features=unknown,
        empty_features=empty,
        duplicate_features=duplicate,
        one_point_features=parsing.one_point_features(features),
    )
    return features, lost


def _blobs(kind: str, body: Any) -> Sequence[bytes]:
    """Return the serialised points of a feature."""
    if kind == "stop_sign":
        return [body.position] if body.HasField("position") else []
    return body.polygon if kind in _POLYGONS else body.polyline


def _feature(feature_id: int, kind: str, body: Any, points: _Points) -> MapFeature:
    if kind == "lane":
        return _lane(feature_id, body, points)
    if kind == "stop_sign":
        return MapFeature(feature_id, RoadKind.STOP_SIGN, points, lanes=tuple(body.lane))
    if kind in _POLYGONS:
        return MapFeature(feature_id, _POLYGONS[kind], points)
    # Types of lines and edges count from 0 in the order of RoadKind, which begins with the unknown kind.
    kinds = LINE_KINDS if kind == "road_line" else EDGE_KINDS
    return MapFeature(feature_id, kinds[body.type if 0 <= body.type < len(kinds) else 0], points)


def _lane(feature_id: int, lane: Any, points: _Points) -> MapFeature:
    return MapFeature(
        feature_id=feature_id,
        kind=RoadKind(lane.type) if 0 <= lane.type <= 3 else RoadKind.LANE_UNDEFINED,
        points=points,
        limit_mps=lane.speed_limit_mph * parsing.MPS_PER_MPH if lane.speed_limit_mph > 0 else None,
        successors=tuple(lane.exit_lanes),
        predecessors=tuple(lane.entry_lanes),
        left_neighbours=tuple(neighbour.feature_id for neighbour in lane.left_neighbors),
        right_neighbours=tuple(neighbour.feature_id for neighbour in lane.right_neighbors),
        interpolating=lane.interpolating,
    )
