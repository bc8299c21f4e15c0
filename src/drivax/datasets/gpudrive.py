"""Reader and writer of GPUDrive's JSON files: scenarios of the Waymo Open Motion Dataset, one file each.

They hold tracks and map elements, but no lane graph, no speed limits and no lanes of stop signs; none of the published
files has a traffic light.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivax.datasets import parsing
from drivax.datasets.export.recording import restore
from drivax.datasets.reader import BadRecord, Description, attempt, read_head
from drivax.errors import DataError
from drivax.geometry.vectors import wrap
from drivax.scenario.recording import Light, MapFeature, Recording, Tracks
from drivax.scenario.schema import (
    CURRENT_STEP,
    DT_S,
    EDGE_KINDS,
    LANE_KINDS,
    LINE_KINDS,
    AgentKind,
    LightState,
    RoadKind,
    Scenario,
)

_Array = np.ndarray[Any, Any]

_SKIP = "skip this file, or make it again from the Waymo protos"
_HEAD_BYTES = 4096
_MOST_STEPS = 1000
#: Value of invalid states.
_INVALID = -10_000.0
#: Largest plausible number (metres, m/s, radians).
_LARGEST = 1e7
#: Range of plausible lengths, widths and heights; others are replaced by the default of the class.
_SMALLEST_SIZE_M, _LARGEST_SIZE_M = 0.01, 1000.0
#: Upper bound of ids, which public tools store in 31 bits.
_ID_END = 2**31
_AGENTS = {"vehicle": AgentKind.VEHICLE, "pedestrian": AgentKind.PEDESTRIAN, "cyclist": AgentKind.CYCLIST}
#: Kind by ``type`` of a road without a known ``map_element_id``.
_ROADS = {
    "lane": RoadKind.LANE_UNDEFINED,
    "road_line": RoadKind.LINE_UNKNOWN,
    "road_edge": RoadKind.EDGE_UNKNOWN,
    "crosswalk": RoadKind.CROSSWALK,
    "speed_bump": RoadKind.SPEED_BUMP,
    "stop_sign": RoadKind.STOP_SIGN,
    "driveway": RoadKind.DRIVEWAY,
}
#: Known fields of objects and roads; some are not read.
_FIELDS = {
    "position", "heading", "velocity", "valid", "length", "width", "height", "type", "id", "geometry", "map_element_id",
    "goalPosition", "mark_as_expert", "is_sdc",
}  # fmt: skip
_AGENT_TYPES = {kind: name for name, kind in _AGENTS.items()}
_ROAD_TYPES = {
    **dict.fromkeys(LANE_KINDS, "lane"),
    **dict.fromkeys(LINE_KINDS, "road_line"),
    **dict.fromkeys(EDGE_KINDS, "road_edge"),
    **{kind: name for name, kind in _ROADS.items()},
}
_KINDS = {int(kind): kind for kind in RoadKind}
#: Gap at which polylines are split, and largest median spacing of files in which they are. Points of published files
#: are 0.5 m apart: twice that is a jump where the map was clipped. In files with a larger spacing points were thinned.
_SPLIT_GAP_M, _DENSE_M = 1.0, 0.75
#: Fields that other converters to this format omit: heights of the map, of agents and of boxes.
_OPTIONAL = ("z", "height")
#: Decimals of metres (a tenth of a millimetre) and of headings.
_DIGITS, _HEADING_DIGITS = 4, 6


@dataclass(frozen=True)
class GpuDrive:
    """Reader of GPUDrive JSON: tracks with one size each, map elements without links, lights where a file has any."""

    name: str = "gpudrive"
    patterns: tuple[str, ...] = ("tfrecord-*_*.json",)
    companions: tuple[str, ...] = ("export.json",)

    def recognise(self, path: Path) -> bool:
        """Return whether the file begins like a GPUDrive scenario."""
        head = read_head(path, _HEAD_BYTES)
        keys = ((b'"objects"', b'"position"'), (b'"roads"', b'"geometry"'))
        return head.lstrip().startswith(b"{") and any(a in head and b in head for a, b in keys)

    def describe(self, path: Path) -> Description:
        """Describe the content of the file."""
        recording = decode(parsing.load_json(path))
        notes = [
            f"{len(recording.tracks.kind)} objects, {len(recording.features)} road elements",
            "no lane graph (lanes are chained by geometry) and no speed limits",
        ]
        if not recording.lights:
            notes.append("no traffic lights; the published files leave out every scenario that has one")
        if (parsing.spacing_m(recording.features) or 0.0) > _DENSE_M:
            notes.append("its points were thinned, so it is not one of the published files")
        return Description("Waymo Open Motion Dataset", "GPUDrive JSON", recordings=1, notes=tuple(notes))

    def count(self, path: Path) -> int:
        """Return 1 for a GPUDrive scenario, else 0."""
        return int(self.recognise(path))

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """Yield the recording of a file, or the bad record in its place."""
        yield attempt(lambda: decode(parsing.load_json(path)), file=path)


def decode(content: Any) -> Recording:
    """Return the recording in a parsed GPUDrive file.

    Positions stay in WOMD's map frame, metres, float64; invalid steps (-10000 in the file) are zeros; steps are 0.1 s
    apart, because the file has no timestamps. ``goalPosition`` (an agent's last valid position) and ``mark_as_expert``
    (agents that GPUDrive replays) are dropped.
    """
    if not isinstance(content, Mapping):
        raise DataError("is not a GPUDrive scenario", cure=_SKIP)
    metadata, scenario_id = content.get("metadata"), content.get("scenario_id")
    if not isinstance(metadata, Mapping) or "sdc_track_index" not in metadata:
        raise DataError(
            "has no metadata with sdc_track_index, so the ego is unknown",
            cure="use files of GPUDrive's present converter; its small hand-made test files are not recordings",
        )
    if not isinstance(scenario_id, str) or not scenario_id.isprintable():
        raise DataError("has no scenario_id", cure=_SKIP)
    objects, roads = _rows(content, "objects"), _rows(content, "roads")
    tracks, unusable_sizes = _tracks(objects)
    count, steps = tracks.valid.shape
    ego = _row_numbers([metadata["sdc_track_index"]], count, "sdc_track_index")[0]
    if tracks.kind[ego] != AgentKind.VEHICLE:
        raise DataError(f"sdc_track_index names object {ego}, which is not a vehicle", cure=_SKIP)
    features, unknown = _features(roads)
    lights, lost_lights = _lights(content.get("tl_states"), steps, features)
    spacing = parsing.spacing_m(features)
    rows = {int(track): row for row, track in enumerate(tracks.track_id)}
    ids = [_integer(track, "objects_of_interest") for track in _read_list(metadata, "objects_of_interest")]
    to_predict = [
        entry.get("track_index") if isinstance(entry, Mapping) else entry
        for entry in _read_list(metadata, "tracks_to_predict")
    ]
    return Recording(
        scenario_id=scenario_id,
        dataset="womd",
        segment=parsing.segment_of(scenario_id),
        timestamps_s=np.arange(steps) * DT_S,
        current_step=CURRENT_STEP,
        ego=ego,
        tracks=tracks,
        features=features,
        lights=lights,
        to_predict=_row_numbers(to_predict, count, "tracks_to_predict"),
        # Objects of interest are given by id, tracks to predict by row.
        of_interest=tuple(rows[track] for track in ids if track in rows),
        tags={"source_format": "gpudrive"},
        lost=parsing.nonzero(
            unknown_roads=unknown,
            one_point_features=parsing.one_point_features(features),
            lights_without_place=lost_lights,
            implausible_sizes=unusable_sizes,
            unknown_fields=len({str(key) for row in (*objects, *roads) for key in row} - _FIELDS),
        ),
        # In files whose points were thinned a jump looks like any other gap.
        split_gap_m=_SPLIT_GAP_M if spacing is not None and spacing <= _DENSE_M else None,
    )


def _rows(content: Mapping[str, Any], name: str) -> Sequence[Mapping[str, Any]]:
    rows = content.get(name)
    if not isinstance(rows, list) or not all(isinstance(row, Mapping) for row in rows):
        raise DataError(f"has no list of {name}", cure=_SKIP)
    return rows


def _read_list(metadata: Mapping[str, Any], name: str) -> list[Any]:
    values = metadata.get(name)
    if values is not None and not isinstance(values, list):
        raise DataError(f"metadata.{name} is not a list", cure=_SKIP)
    return values or []


def _integer(value: Any, what: str) -> int:
    """Return a value that must be an integer; ``what`` names it in the error."""
    if type(value) is not int:
        raise DataError(f"{what} contains {str(value)[:40]!r}, which is not an integer", cure=_SKIP)
    return value


def _row_numbers(values: Sequence[Any], count: int, what: str) -> tuple[int, ...]:
    return parsing.rows_within([_integer(value, what) for value in values], count, what)


def _table(rows: Any, keys: Sequence[str], what: str) -> _Array:
    """Return numbers of a list of dictionaries, ``[row, key]``; zeros for an optional key that the first row lacks."""
    try:
        columns = [i for i, key in enumerate(keys) if key not in _OPTIONAL or not rows or key in rows[0]]
        values = np.array([[row[keys[i]] for i in columns] for row in rows], np.float64)
        if len(rows) and values.shape != (len(rows), len(columns)):
            raise ValueError("values are lists")
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise DataError(f"{what} is not a list of numbers {', '.join(keys)}", cure=_SKIP) from error
    table = np.zeros((len(rows), len(keys)))
    table[:, columns] = values.reshape(-1, len(columns))
    return table


def _columns(row: Any, names: Sequence[str], what: str) -> list[list[Any]]:
    """Return the lists of these names in a dictionary; refuse missing ones, and lists of different lengths."""
    lists = [row.get(name) for name in names] if isinstance(row, Mapping) else []
    columns = [values for values in lists if isinstance(values, list)]
    if len(columns) < len(names) or len({len(values) for values in columns}) != 1:
        raise DataError(f"{what} has no lists {', '.join(names)} of one length", cure=_SKIP)
    return columns


def _ids(rows: Sequence[Mapping[str, Any]], what: str) -> list[int]:
    """Return the ids of objects or roads, or their indices if none has an id."""
    numbers = [row.get("id") for row in rows]
    if all(number is None for number in numbers):
        return list(range(len(numbers)))
    ids = [_integer(number, f"the id of {what}") for number in numbers]
    if len(set(ids)) < len(ids) or not all(0 <= number < _ID_END for number in ids):
        raise DataError(f"the ids of {what} are not unique, or not from 0 to {_ID_END - 1}", cure=_SKIP)
    return ids


def _tracks(objects: Sequence[Mapping[str, Any]]) -> tuple[Tracks, int]:
    """Return the tracks, and the number of those with an implausible length, width or height.

    Implausible values become 0, which stands for the default of the class. Missing heights are not counted.
    """
    table, valid = _states(objects)
    valid &= ~(table[..., :2] == _INVALID).all(axis=-1)
    table = np.where(valid[..., None], table, 0.0)
    if not (np.abs(table) <= _LARGEST).all():
        raise DataError("valid states contain numbers that are not finite or implausibly large", cure=_SKIP)
    size = _table(objects, ("length", "width", "height"), "the size of objects")
    plausible = (size >= _SMALLEST_SIZE_M) & (size <= _LARGEST_SIZE_M)
    size = np.where(plausible, size, 0.0)
    columns = slice(None if "height" in objects[0] else -1)
    lost = int((~plausible[:, columns].all(axis=1) & valid.any(axis=1)).sum())
    kinds = [str(row.get("type")) for row in objects]
    tracks = Tracks(
        xy=table[..., 0:2].copy(),
        z=table[..., 2].copy(),
        size=np.where(valid[..., None], size[:, None], 0.0),
        heading=np.where(valid, wrap(table[..., 3]), 0.0),
        velocity=table[..., 4:6].copy(),
        valid=valid,
        kind=np.array([_AGENTS.get(kind, AgentKind.OTHER) for kind in kinds], np.int8),
        track_id=np.array(_ids(objects, "objects"), np.int64),
    )
    return tracks, lost


def _states(objects: Sequence[Mapping[str, Any]]) -> tuple[_Array, _Array]:
    """Return x, y, z, heading, vx, vy of every object and step, and their mask."""
    if not objects:
        raise DataError("has no objects", cure=_SKIP)
    first = objects[0].get("valid")
    steps = len(first) if isinstance(first, list) else 0
    if not CURRENT_STEP < steps <= _MOST_STEPS:
        raise DataError(f"has {steps} steps, not {CURRENT_STEP + 1} to {_MOST_STEPS}", cure=_SKIP)
    tables, masks = [], []
    for row, track in enumerate(objects):
        names = ("position", "heading", "velocity", "valid")
        position, heading, velocity, valid = _columns(track, names, f"object {row}")
        if len(position) != steps:
            raise DataError(f"object {row} has {len(position)} states for {steps} steps", cure=_SKIP)
        headings = [{"heading": value} for value in heading]
        columns = (
            _table(position, "xyz", f"the position of object {row}"),
            _table(headings, ("heading",), f"the heading of object {row}"),
            _table(velocity, "xy", f"the velocity of object {row}"),
        )
        tables.append(np.concatenate(columns, axis=1))
        masks.append([mark == 1 for mark in valid])
    return np.stack(tables), np.array(masks, bool)


def _features(roads: Sequence[Mapping[str, Any]]) -> tuple[tuple[MapFeature, ...], int]:
    """Return map features in order of the file, and the number of roads of unknown kind or without points."""
    ids = _ids(roads, "roads")
    features, unknown = [], 0
    for number, road in zip(ids, roads, strict=True):
        code, type_name = road.get("map_element_id"), str(road.get("type"))
        kind = _KINDS.get(code) if type(code) is int else None
        kind = _ROADS.get(type_name) if kind is None else kind
        points = _table(road.get("geometry"), "xyz", f"the geometry of road {number}")
        if kind is None or not len(points):
            unknown += 1
            continue
        if not (np.abs(points) <= _LARGEST).all():
            raise DataError(f"the geometry of road {number} is not finite or implausibly large", cure=_SKIP)
        features.append(MapFeature(number, kind, points))
    return tuple(features), unknown


def _lights(states: Any, steps: int, features: Sequence[MapFeature]) -> tuple[tuple[Light, ...], int]:
    """Return lights by lane from lists with an entry per observation, and the number of those without a position."""
    if not states:
        return (), 0
    if not isinstance(states, Mapping):
        raise DataError("tl_states is not a dictionary of lanes", cure=_SKIP)
    lights = parsing.Lights(steps)
    for lane, observations in states.items():
        if not (lane.isascii() and lane.isdigit() and len(lane) < 11):
            raise DataError(f"tl_states names lane {lane[:40]!r}, which is not an id", cure=_SKIP)
        what = f"tl_states of lane {lane[:40]}"
        indices, lane_states, *axes = _columns(observations, ("time_index", "state", "x", "y", "z"), what)
        indices = parsing.rows_within([_integer(step, what) for step in indices], steps, what, "step")
        rows = [dict(zip("xyz", point, strict=True)) for point in zip(*axes, strict=True)]
        points = _table(rows, "xyz", what)
        if not (np.abs(points) <= _LARGEST).all():
            raise DataError(f"{what} has a position that is not finite or implausibly large", cure=_SKIP)
        for step, state, point in zip(indices, lane_states, points.tolist(), strict=True):
            lights.observe(step, int(lane), _light_state(state), point)
    return lights.collect(features)


def _light_state(state: Any) -> int:
    """Return a state by its name, as GPUDrive's converter writes it, or by WOMD's number; UNKNOWN otherwise."""
    name = str(state).upper()
    if name in LightState.__members__ and name != LightState.UNOBSERVED.name:
        return int(LightState[name])
    is_number = type(state) is int and LightState.UNKNOWN <= state <= LightState.FLASHING_CAUTION
    return state if is_number else int(LightState.UNKNOWN)


def file_name(number: int) -> str:
    """Return the file name of an exported scenario by its number, with the prefix that GPUDrive's loader expects."""
    return f"tfrecord-00000-of-00001_{number}.json"


def gpudrive_content(scenario: Scenario, name: str) -> dict[str, Any]:
    """Return the content of a scenario's GPUDrive file as plain JSON values.

    Positions are in the source's frame, to a tenth of a millimetre; invalid steps are -10000. Ego is the last object,
    as in the published files; ``mark_as_expert`` is false for all.
    """
    recording = restore(scenario)
    count = len(recording.tracks.kind)
    rows = [*(row for row in range(count) if row != recording.ego), recording.ego]
    index = {row: number for number, row in enumerate(rows)}
    ids = recording.tracks.track_id
    lights: dict[str, dict[str, list[Any]]] = {}
    for light in recording.lights:  # of several lights of a lane keep the first, which is nearest to the log
        lights.setdefault(str(light.lane_id), _light(light))
    return {
        "name": name,
        "scenario_id": recording.scenario_id,
        "objects": [_object(recording, row) for row in rows],
        "roads": [
            {
                "geometry": _points(feature.points),
                "type": _ROAD_TYPES[feature.kind],
                "map_element_id": int(feature.kind),
                "id": feature.feature_id,
            }
            for feature in recording.features
        ],
        "tl_states": lights,
        "metadata": {
            "sdc_track_index": index[recording.ego],
            "objects_of_interest": [int(ids[row]) for row in recording.of_interest],
            "tracks_to_predict": [
                {"track_index": index[row], "difficulty": 0} for row in recording.to_predict
            ],
        },
    }


def _points(points: _Array) -> list[dict[str, float]]:
    return [dict(zip("xyz", point, strict=False)) for point in np.round(points, _DIGITS).tolist()]


def _object(recording: Recording, row: int) -> dict[str, Any]:
    """Return a track as an object of the file, with the size of its last valid step."""
    tracks = recording.tracks
    valid = tracks.valid[row]
    last = np.flatnonzero(valid)[-1]
    position = np.column_stack((tracks.xy[row], tracks.z[row]))
    length, width, height = tracks.size[row, last].tolist()
    return {
        "position": _points(np.where(valid[:, None], position, _INVALID)),
        "width": width,
        "length": length,
        "height": height,
        "heading": np.round(np.where(valid, tracks.heading[row], _INVALID), _HEADING_DIGITS).tolist(),
        "velocity": _points(np.where(valid[:, None], tracks.velocity[row], _INVALID)),
        "valid": valid.tolist(),
        "goalPosition": _points(position[last : last + 1])[0],
        "type": _AGENT_TYPES.get(AgentKind(int(tracks.kind[row])), "other"),
        "id": int(tracks.track_id[row]),
        "mark_as_expert": False,
    }


def _light(light: Light) -> dict[str, list[Any]]:
    """Return a light as lists with an entry per observation, as GPUDrive's converter writes it."""
    steps = np.flatnonzero(light.states >= 0)
    (point,) = _points(light.stop_point[None])
    return {
        "state": [LightState(int(light.states[step])).name.lower() for step in steps],
        **{axis: [value] * len(steps) for axis, value in point.items()},
        "time_index": steps.tolist(),
    }
