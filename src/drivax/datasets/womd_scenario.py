"""Reader of WOMD ``Scenario`` protos in TFRecord files (motion dataset v1.0 to v1.3.1, 9 s and 20 s files)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from drivax.datasets import readings, womd
from drivax.datasets.messages import parse, scenario_class
from drivax.datasets.reader import BadRecord
from drivax.errors import DataError
from drivax.geometry.angles import wrap
from drivax.scenario.recording import Light, MapFeature, Recording, Tracks
from drivax.scenario.schema import RoadKind

_MPS_PER_MPH = 0.44704
#: Points are 0.5 m apart; twice that is a jump where the map was clipped, not road.
_SPLIT_GAP_M = 1.0
_SKIP = "skip this record, or download the file again"
#: Columns of the table of states.
_STATE = attrgetter(
    "center_x", "center_y", "center_z", "length", "width", "height", "heading", "velocity_x", "velocity_y", "valid"
)  # fmt: skip
_POINT = attrgetter("x", "y", "z")
_POLYGONS = {
    "crosswalk": RoadKind.CROSSWALK,
    "speed_bump": RoadKind.SPEED_BUMP,
    "driveway": RoadKind.DRIVEWAY,
}


@dataclass(frozen=True)
class WomdScenario:
    """Reads Scenario protos: dense tracks, map with lane graph and speed limits, lights by lane."""

    name: str = womd.SCENARIO_FORMAT
    patterns: tuple[str, ...] = womd.PATTERNS

    def recognise(self, path: Path) -> bool:
        """Whether the first readable record is a Scenario proto."""
        return womd.recognise(path, self.name)

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """The recordings of one file, and in their place the records that cannot be read."""
        return womd.read(path, self.name, decode)


def decode(payload: bytes) -> Recording:
    """The recording in a serialised ``Scenario``.

    Positions stay in the proto's map frame, metres, float64. Headings are wrapped (the files hold up to 10 rad),
    invalid states are zeros (the files keep a z there), speed limits are m/s and None where the file says 0.
    Links to lanes that the file does not hold are kept.

    Raises:
        DataError: The payload is no Scenario, or contradicts itself.
    """
    message = parse(scenario_class(), payload)
    if message is None or not message.scenario_id:
        raise DataError("the payload is not a WOMD Scenario proto", cure=_SKIP)
    steps = len(message.timestamps_seconds)
    _check(message, steps)
    features = tuple(_features(message.map_features))
    lights = _lights(message.dynamic_map_states, steps)
    rows = {track.id: row for row, track in enumerate(message.tracks)}
    return Recording(
        scenario_id=message.scenario_id,
        dataset=womd.DATASET,
        segment=message.scenario_id,
        timestamps_s=np.array(message.timestamps_seconds, np.float64),
        current_step=message.current_time_index,
        ego=message.sdc_track_index,
        tracks=_tracks(message.tracks, steps),
        features=features,
        lights=lights,
        to_predict=readings.rows_within(
            [wanted.track_index for wanted in message.tracks_to_predict],
            len(message.tracks),
            "tracks_to_predict",
        ),
        # These are track ids, tracks_to_predict are rows.
        of_interest=tuple(rows[track] for track in message.objects_of_interest if track in rows),
        split_gap_m=_SPLIT_GAP_M,
    )


def _check(message: Any, steps: int) -> None:
    if steps == 0 or not message.tracks:
        raise DataError("the scenario has no steps or no tracks", cure=_SKIP)
    if not 0 <= message.current_time_index < steps:
        raise DataError(f"current_time_index is {message.current_time_index} of {steps} steps", cure=_SKIP)
    readings.rows_within([message.sdc_track_index], len(message.tracks), "sdc_track_index")
    if len(message.dynamic_map_states) > steps:
        raise DataError(f"{len(message.dynamic_map_states)} light steps, {steps} steps", cure=_SKIP)
    for track in message.tracks:
        if len(track.states) != steps:
            raise DataError(f"track {track.id} has {len(track.states)} states, {steps} steps", cure=_SKIP)


def _tracks(tracks: Any, steps: int) -> Tracks:
    rows = [_STATE(state) for track in tracks for state in track.states]
    table = np.array(rows, np.float64).reshape(len(tracks), steps, 10)
    valid = table[..., 9] > 0.5
    table = np.where(valid[..., None], table, 0.0)
    readings.check_finite(table)
    return Tracks(
        xy=table[..., 0:2].copy(),
        z=table[..., 2].copy(),
        size=table[..., 3:6].copy(),
        heading=np.where(valid, wrap(table[..., 6]), 0.0),
        velocity=table[..., 7:9].copy(),
        valid=valid,
        kind=np.array([womd.agent_kind(track.object_type) for track in tracks], np.int8),
        track_id=np.array([track.id for track in tracks], np.int64),
    )


def _lights(states: Any, steps: int) -> tuple[Light, ...]:
    lights = readings.Lights(steps)
    for step, state in enumerate(states):
        for lane in state.lane_states:
            point = lane.stop_point
            lights.observe(step, lane.lane, lane.state, (point.x, point.y, point.z))
    return lights.collected()


def _features(messages: Any) -> Iterator[MapFeature]:
    for message in messages:
        kind = message.WhichOneof("kind")
        if kind is None:  # a kind of feature that later versions may add
            continue
        body = getattr(message, kind)
        feature = _feature(message.id, kind, body)
        if len(feature.points):
            yield feature


def _feature(feature_id: int, kind: str, body: Any) -> MapFeature:
    if kind == "lane":
        return _lane(feature_id, body)
    if kind == "stop_sign":
        return MapFeature(feature_id, RoadKind.STOP_SIGN, _points([body.position]), lanes=tuple(body.lane))
    if kind in _POLYGONS:
        return MapFeature(feature_id, _POLYGONS[kind], _points(body.polygon))
    first, last = (5, 13) if kind == "road_line" else (14, 16)
    code = first + body.type
    return MapFeature(feature_id, RoadKind(code if first <= code <= last else first), _points(body.polyline))


def _lane(feature_id: int, lane: Any) -> MapFeature:
    return MapFeature(
        feature_id=feature_id,
        kind=RoadKind(lane.type) if 0 <= lane.type <= 3 else RoadKind.LANE_UNDEFINED,
        points=_points(lane.polyline),
        limit_mps=lane.speed_limit_mph * _MPS_PER_MPH if lane.speed_limit_mph > 0 else None,
        successors=tuple(lane.exit_lanes),
        predecessors=tuple(lane.entry_lanes),
        left_neighbours=tuple(neighbour.feature_id for neighbour in lane.left_neighbors),
        right_neighbours=tuple(neighbour.feature_id for neighbour in lane.right_neighbors),
        interpolating=lane.interpolating,
    )


def _points(points: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([_POINT(point) for point in points], np.float64).reshape(-1, 3)
