"""Reader of ScenarioNet pickles: one recording per file, from WOMD, nuScenes, nuPlan, Argoverse, Lyft or MetaDrive.

The dictionaries are those of MetaDrive's ``ScenarioDescription``. The reader undoes what ScenarioNet's converters do to
each data set, as far as the file allows (docs/data/scenarionet.md).
"""

from __future__ import annotations

import contextlib
import pickletools
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivax.datasets import parsing
from drivax.datasets.nuscenes.reader import CENTRE_AHEAD_M
from drivax.datasets.parsing import flatten, lift
from drivax.datasets.reader import BadRecord, Description, attempt, read_head
from drivax.datasets.scenarionet import pickles
from drivax.datasets.scenarionet.map import RoadMap, road_map
from drivax.datasets.scenarionet.pickles import (
    SKIP,
    Names,
    as_float,
    as_int,
    as_list,
    as_text,
    count_rows,
    floats,
    mapping,
)
from drivax.errors import DataError
from drivax.geometry.vectors import wrap
from drivax.reading import read_bytes
from drivax.scenario.recording import Light, MapFeature, Recording, Tracks, differentiate, is_even
from drivax.scenario.schema import CURRENT_STEP, DT_S, LANE_KINDS, AgentKind, Flag, LightState

Array = np.ndarray[Any, Any]

_NAME = "scenarionet"
_DATASETS = {"waymo": "womd", "argoverse": "av2", "argoverse2": "av2", "pg": "metadrive"}
_TITLES = {
    "womd": "Waymo Open Motion Dataset",
    "nuscenes": "nuScenes",
    "nuplan": "nuPlan",
    "av2": "Argoverse 2",
    "lyft": "Lyft Level 5",
    "metadrive": "MetaDrive (generated)",
}
#: WOMD's polylines have points 0.5 m apart; twice that is a jump where the map was clipped.
_WOMD_GAP_M = 1.0
_STATES = {
    **{f"LANE_STATE_{state.name}": state for state in LightState if state >= 0},
    "TRAFFIC_LIGHT_RED": LightState.STOP,
    "TRAFFIC_LIGHT_YELLOW": LightState.CAUTION,
    "TRAFFIC_LIGHT_GREEN": LightState.GO,
    "TRAFFIC_LIGHT_UNKNOWN": LightState.UNKNOWN,
}
_MOST_LIGHT_STATES = 2_000_000
_MOST_TRACK_STATES = 1_000_000
_FARTHEST_M = 1e7
_AGENTS = {
    "VEHICLE": AgentKind.VEHICLE,
    "PEDESTRIAN": AgentKind.PEDESTRIAN,
    "CYCLIST": AgentKind.CYCLIST,
    **dict.fromkeys(("TRAFFIC_CONE", "TRAFFIC_BARRIER", "TRAFFIC_OBJECT"), AgentKind.STATIC),
}
#: Possible numbers of columns of each state, and its largest plausible value: metres, radians, m/s.
_COLUMNS = {
    "position": ((2, 3), _FARTHEST_M),
    "heading": ((1,), 1e4),
    "velocity": ((2, 3), 1e3),
    **dict.fromkeys(("length", "width", "height"), ((1,), 1e3)),
    "size": ((3,), 1e3),  # length, width, height in the earliest version of the format
    "radius": ((1,), 1e3),  # of round objects of MetaDrive, without length and width
    "valid": ((1,), np.inf),
}
#: Known states of tracks that are not read: MetaDrive's own vehicles have them.
_UNUSED_STATES = ("angular_velocity", "steering", "throttle_brake", "action")
#: A track moves at its end if its last step is longer than this, metres.
_MOVING_M = 0.05
#: A scenario file names its dictionaries within this many bytes.
_HEAD_BYTES = 4096
_SIGNS = (b"version", b"length")
_PARTS = (b"tracks", b"metadata", b"map_features", b"dynamic_map_states")


@dataclass(frozen=True)
class ScenarioNet:
    """Reader of ScenarioNet pickles, without running them; a pickle that names anything but data is refused."""

    name: str = _NAME
    patterns: tuple[str, ...] = ("sd_*.pkl", "[0-9]*.pkl")
    companions: tuple[str, ...] = ("dataset_summary.pkl", "dataset_mapping.pkl")

    def recognise(self, path: Path) -> bool:
        """Return whether the file is a pickle that begins with the keys of a scenario."""
        head = read_head(path, _HEAD_BYTES)
        has_keys = all(key in head for key in _SIGNS) and any(key in head for key in _PARTS)
        return head[:1] in (b"\x80", b"(", b"}") and has_keys

    def describe(self, path: Path) -> Description:
        """Describe data set and version of the scenario, and what it lacks."""
        tree = _load(path)
        recording = decode(tree)
        lanes = [f for f in recording.features if f.kind in LANE_KINDS]
        facts = (
            (not any(f.successors for f in lanes), "no lane graph: lanes are joined where they touch"),
            (not recording.lights, "no traffic lights"),
            (not is_even(recording.timestamps_s), parsing.UNEVEN),
            (Flag.DIFFERENTIATED_VELOCITY in recording.flags, "velocities are taken from the positions"),
        )
        return Description(
            dataset=f"{_TITLES.get(recording.dataset, recording.dataset)}, by ScenarioNet",
            flavour="ScenarioNet pickle",
            version=as_text(tree.get("version")),
            recordings=1,
            notes=tuple(note for holds, note in facts if holds),
        )

    def count(self, path: Path) -> int:
        """Return the number of windows, by the length that the file names at its beginning."""
        steps = _length_of(read_head(path, _HEAD_BYTES))
        return 0 if steps is None else parsing.windows_of(steps)

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """Yield the recording of a file, or the bad record in its place."""
        yield attempt(lambda: decode(_load(path)), file=path)


def _load(path: Path) -> Any:
    """Return the content of a pickle."""
    return pickles.load(read_bytes(path, "check the path, and that it is a scenario", pickles.MOST_BYTES))


def _length_of(head: bytes) -> int | None:
    """Return the value of the key ``length`` in the beginning of a pickle, None without a plausible one."""
    key = None
    with contextlib.suppress(ValueError):  # the beginning is cut anywhere
        for operation, argument, _ in pickletools.genops(head):
            if operation.name in ("MEMOIZE", "BINPUT", "LONG_BINPUT", "PUT"):
                continue
            if key == "length":
                return argument if type(argument) is int and 0 < argument < 1_000_000 else None
            key = argument
    return None


def decode(tree: Any) -> Recording:
    """Return the recording in a ScenarioNet dictionary, in the map frame of the original data, metres, float64.

    A shift of the origin is undone where the file states it (:func:`_offset`); else the frame is the file's.
    """
    metadata = mapping(tree, "metadata")
    table = {
        name: body for key, body in mapping(tree, "tracks").items() if (name := as_text(key)) is not None
    }
    rows = {name: row for row, name in enumerate(table)}
    dataset, identity, ego = _dataset(tree, metadata), _identity(tree, metadata), _ego(metadata, rows)
    tracks, lost = read_tracks(table, Names(list(table), bits=31), ego)
    tracks, flags = _motion(tracks, metadata, dataset, ego)
    ego_xy = tracks.xy[ego, int(np.argmax(tracks.valid[ego]))]
    roads = road_map(mapping(tree, "map_features"), dataset, ego_xy)
    steps = tracks.valid.shape[1]
    lost += Counter({**roads.lost, "one_point_features": parsing.one_point_features(roads.features)})
    lights = _lights(mapping(tree, "dynamic_map_states"), steps, dataset, roads, lost)
    tracks, features = _with_heights(tracks, roads)
    tags = {"source_format": _NAME} | parsing.place_tags(as_text(metadata.get("map")))
    scenario_type = as_text(metadata.get("scenario_type")) or None
    recording = Recording(
        scenario_id=identity,
        dataset=dataset,
        segment=as_text(metadata.get("log_name")) or parsing.segment_of(identity),
        timestamps_s=_timestamps(metadata, steps),
        current_step=_current_step(metadata, steps),
        ego=ego,
        tracks=tracks,
        features=features,
        lights=lights,
        to_predict=_track_rows(metadata.get("tracks_to_predict"), rows),
        of_interest=_track_rows(metadata.get("objects_of_interest"), rows),
        tags=tags | ({} if scenario_type is None else {"scenario_types": scenario_type[:64]}),
        lost=parsing.nonzero(**lost),
        flags=flags,
        split_gap_m=_WOMD_GAP_M if dataset == "womd" else None,
    )
    return parsing.shift(recording, _offset(metadata, table, dataset))


def _offset(metadata: Mapping[Any, Any], table: Mapping[str, Any], dataset: str) -> Array:
    """Return the position (x, y, 0) of the file's origin in the original map frame; zeros if it is unknown.

    ScenarioNet notes the centre that it subtracts from all positions, MetaDrive the old origin in its new frame. In
    older nuScenes files the steps without an observation show the centre: their zeros were moved as well.
    """
    centre = _position(metadata, "map_center") - _position(metadata, "old_origin_in_current_coordinate")
    if not centre.any() and dataset == "nuscenes":
        states = [body["state"] for body in table.values() if body["state"].get("valid") is not None]
        invalid = [floats(s["position"], "")[floats(s["valid"], "").reshape(-1) < 0.5, :2] for s in states]
        origins = np.unique(np.concatenate([np.zeros((0, 2)), *invalid]), axis=0)
        centre = -origins[0] if len(origins) == 1 else centre
    return np.append(centre, 0.0)


def _position(metadata: Mapping[Any, Any], name: str) -> Array:
    """Return a position (x, y) in the metadata; zeros for a missing one."""
    value = metadata.get(name)
    position = np.zeros(2) if value is None else floats(value, name)
    if position.shape not in ((2,), (3,)) or not (np.abs(position) < _FARTHEST_M).all():
        raise DataError(f"{name} is not a position", cure=SKIP)
    return position[:2]


def _identity(tree: Any, metadata: Mapping[Any, Any]) -> str:
    """Return the id of the scenario, from the first of the three places where versions of the format store it."""
    for value in (tree.get("id"), metadata.get("scenario_id"), metadata.get("id")):
        if identity := as_text(value):
            return identity
    raise DataError("the scenario has no id", cure=SKIP)


def _dataset(tree: Any, metadata: Mapping[Any, Any]) -> str:
    """Return drivax's name of the source data set; ``scenarionet`` if the file gives none that is usable."""
    source = as_text(metadata.get("dataset")) or as_text(metadata.get("coordinate")) or ""
    version = as_text(tree.get("version")) or ""
    # Early files name the data set in their version only.
    name = next((name for name in ("nuscenes", "nuplan") if version.startswith(name)), source.lower())
    name = _DATASETS.get(name, name)
    # Names longer than 16 bytes cannot be stored (``scenario.recording.DATASET_BYTES``).
    return name if name.isascii() and 0 < len(name) <= 16 and "\0" not in name else _NAME


def _ego(metadata: Mapping[Any, Any], rows: Mapping[str, int]) -> int:
    """Return the row of the track ``sdc_id``, or of the track ``ego`` if the file names none."""
    name = as_text(metadata.get("sdc_id"))
    name = "ego" if name is None else name
    if name not in rows:
        raise DataError(f"the ego {name[:40]!r} is not one of {len(rows)} tracks", cure=SKIP)
    return rows[name]


def read_tracks(table: Mapping[str, Any], names: Names, ego: int) -> tuple[Tracks, Counter[str]]:
    """Read ``tracks``, and count states of unknown names.

    Invalid states become zeros. Velocities, heights and sizes that the file lacks are zero; a track without ``valid``
    is valid at every step. Round objects get twice their radius as length and width; length and width of an ego that is
    wider than long are swapped.
    """
    titles = [f"track {name[:40]!r}" for name in table]
    bodies = [mapping({"": body}, "", f"tracks[{name[:40]!r}]") for name, body in table.items()]
    states = [mapping(body, "state", title) for title, body in zip(titles, bodies, strict=True)]
    steps = count_rows(states[ego].get("position"))
    if steps == 0 or steps * len(states) > _MOST_TRACK_STATES:
        raise DataError(f"{len(states)} tracks of {steps} steps", cure=SKIP)
    arrays = {name: np.zeros((len(states), steps, columns[-1])) for name, (columns, _) in _COLUMNS.items()}
    for row, (title, state) in enumerate(zip(titles, states, strict=True)):
        for name in _COLUMNS:
            values = _series(state, name, steps, title)
            if values is not None:
                arrays[name][row, :, : values.shape[1]] = values
            elif name in ("position", "heading"):
                raise DataError(f"{title} has no {name}", cure=SKIP)
            elif name == "valid":
                arrays[name][row] = 1.0
    valid = arrays["valid"][..., 0] > 0.5
    for name, (_, limit) in _COLUMNS.items():
        arrays[name][~valid] = 0.0
        parsing.check_within(limit, arrays[name])
    size = np.concatenate([arrays[name] for name in ("length", "width", "height")], axis=-1)
    size = np.where(size.any(axis=(1, 2), keepdims=True), size, arrays["size"])
    is_round = ~size[..., :2].any(axis=(1, 2), keepdims=True)
    size[..., :2] += np.where(is_round, 2.0 * arrays["radius"], 0.0)
    longest, widest, _ = size[ego].max(axis=0)
    if longest < widest:  # nuScenes files have a car 1.73 m long and 4.08 m wide
        size[ego] = size[ego][:, [1, 0, 2]]
    tracks = Tracks(
        xy=arrays["position"][..., :2].copy(),
        z=arrays["position"][..., 2].copy(),
        heading=np.where(valid, wrap(arrays["heading"][..., 0]), 0.0),
        velocity=arrays["velocity"][..., :2].copy(),
        size=size,
        valid=valid,
        kind=np.array(
            [_AGENTS.get(as_text(body.get("type")) or "", AgentKind.OTHER) for body in bodies], np.int8
        ),
        track_id=np.array([names.get(name) for name in table], np.int64),
    )
    unknown = {str(name) for state in states for name in state} - {*_COLUMNS, *_UNUSED_STATES}
    return tracks, Counter(unknown_fields=len(unknown))


def _series(state: Mapping[Any, Any], name: str, steps: int, what: str) -> Array | None:
    """Return one state of one track as ``[time, column]``; None for a missing one."""
    series = state.get(name)
    if series is None:
        return None
    if count_rows(series) != steps:
        raise DataError(f"{what} has {count_rows(series)} values of {name} for {steps} steps", cure=SKIP)
    values = floats(series, f"{what}: {name}")
    values = values[:, None] if values.ndim == 1 else values
    if values.ndim != 2 or values.shape[1] not in _COLUMNS[name][0]:
        raise DataError(f"{what} has a {name} of shape {values.shape}", cure=SKIP)
    return values


def lacks_velocity(tracks: Tracks) -> bool:
    """Return whether most tracks that move at their end have velocity 0 there.

    Then velocities are missing, or differences to the next position, of which the last step has none (nuScenes).
    """
    rows = np.arange(len(tracks.valid))
    end = tracks.valid.shape[1] - 1 - np.argmax(tracks.valid[:, ::-1], axis=1)
    previous = np.maximum(end - 1, 0)
    moves = np.hypot(*(tracks.xy[rows, end] - tracks.xy[rows, previous]).T) > _MOVING_M
    moves &= tracks.valid[rows, end] & tracks.valid[rows, previous] & (end > previous)
    has_zero = ~tracks.velocity[rows, end].any(axis=1)
    return bool((moves & has_zero).sum() * 2 > moves.sum())


def _motion(tracks: Tracks, metadata: Mapping[Any, Any], dataset: str, ego: int) -> tuple[Tracks, Flag]:
    """Return tracks with box centres and velocities, and flags for default sizes and differentiated velocities."""
    flags = Flag.DEFAULT_SIZES if dataset == "av2" else Flag.NONE
    if dataset == "nuscenes":  # poses of ego are of the rear axle
        xy = tracks.xy.copy()
        centres = parsing.box_centre(xy[ego], tracks.heading[ego], CENTRE_AHEAD_M)
        xy[ego] = np.where(tracks.valid[ego, :, None], centres, 0.0)
        tracks = replace(tracks, xy=xy)
    if lacks_velocity(tracks):
        times = _timestamps(metadata, tracks.valid.shape[1])
        tracks = replace(tracks, velocity=differentiate(tracks.xy, tracks.valid, times))
        flags |= Flag.DIFFERENTIATED_VELOCITY
    return tracks, flags


def _with_heights(tracks: Tracks, roads: RoadMap) -> tuple[Tracks, tuple[MapFeature, ...]]:
    """Place agents on the ground if the tracks or the map have no heights."""
    if roads.flat:
        return flatten(tracks, roads.features)
    return tracks if tracks.z.any() else lift(tracks, roads.features), roads.features


def _timestamps(metadata: Mapping[Any, Any], steps: int) -> Array:
    """Return the time of every step, seconds; 10 Hz if the file has no timestamps."""
    stamps = metadata.get("ts")
    if stamps is None:
        return np.arange(steps) * DT_S
    times = floats(stamps, "timestamps")
    if times.shape != (steps,):
        raise DataError(f"timestamps of shape {times.shape} for {steps} steps", cure=SKIP)
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise DataError("timestamps do not increase", cure=SKIP)
    return times


def _current_step(metadata: Mapping[Any, Any], steps: int) -> int:
    """Return the current step: that of the file, or step 10 (the last of fewer) if it names none."""
    step = as_int(metadata.get("current_time_index"))
    if step is None:
        return min(CURRENT_STEP, steps - 1)
    if step >= steps:
        raise DataError(f"current_time_index is {step} of {steps} steps", cure=SKIP)
    return step


def _track_rows(value: Any, rows: Mapping[str, int]) -> tuple[int, ...]:
    """Return rows of the tracks in a list of names or a dictionary by name, without unknown names."""
    names = list(value) if isinstance(value, dict) else as_list(value)
    numbers = (rows.get(name) for item in names if (name := as_text(item)) is not None)
    return tuple(row for row in numbers if row is not None)


def _lights(
    table: Mapping[Any, Any], steps: int, dataset: str, roads: RoadMap, lost: Counter[str]
) -> tuple[Light, ...]:
    """Return lights by lane; a state of None in the file is a step without an observation."""
    if len(table) * steps > _MOST_LIGHT_STATES:
        raise DataError(f"{len(table)} lights of {steps} steps", cure=SKIP)
    starts = {f.feature_id: f.points[0] for f in roads.features if f.kind in LANE_KINDS}
    lights = parsing.Lights(steps)
    for key, body in table.items():
        what = f"light {(as_text(key) or '')[:40]!r}"
        light = mapping({"": body}, "", what)
        lane = roads.names.get(light.get("lane", key))
        states = as_list(mapping(light, "state", what).get("object_state"))
        if len(states) != steps:
            raise DataError(f"{what} has {len(states)} states for {steps} steps", cure=SKIP)
        if lane is None or lane not in starts:
            lost["lights_without_lane"] += 1
            continue
        points = _stop_points(light, steps, what)
        # The stop points of nuPlan's lights are 8 m behind the line.
        stops = points[points.any(axis=1)] if dataset != "nuplan" else points[:0]
        stop_point = starts[lane].copy()
        if len(stops):
            stop_point[: stops.shape[1]] = stops[0]
        for step, name in enumerate(states):
            state = _state(name)
            # The earliest version of the format has zeros wherever nothing is observed.
            is_fill = state == LightState.UNKNOWN and len(points) == steps > 1 and not points[step].any()
            if name is None or is_fill:
                continue
            lost["unknown_light_states"] += state is None
            lights.observe(step, lane, LightState.UNKNOWN if state is None else state, stop_point.tolist())
    return lights.collect(roads.features)[0]


def _stop_points(light: Mapping[Any, Any], steps: int, what: str) -> Array:
    """Return stop points (x, y and maybe z): one, or in ``state`` of the earliest version one per step."""
    stops = light.get("stop_point", light["state"].get("stop_point"))
    points = np.zeros((0, 3)) if stops is None else np.atleast_2d(floats(stops, f"{what}: stop_point"))
    is_plausible = points.shape[1] in (2, 3) and (np.abs(points) < _FARTHEST_M).all()
    return points if is_plausible and len(points) in (1, steps) else np.zeros((0, 3))


def _state(state: Any) -> LightState | None:
    """Return the state by its name or WOMD's number; None for anything else."""
    if isinstance(state, str):
        return _STATES.get(state)
    number = as_float(state)
    return LightState(int(number)) if number is not None and number in range(9) else None
