"""Recordings: logs in the frame of their source, as readers and the built-in world produce them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64, Int8, Int64

from drivax.errors import DataError, UsageError
from drivax.scenario.schema import CURRENT_STEP, DT_S, STEPS, AgentKind, Capacity, Flag, RoadKind

Array = np.ndarray[Any, Any]
STEP_TOLERANCE_S = 0.005
TEXT_BYTES = {"scenario_id": 64, "segment": 64, "dataset": 16}
#: Largest distance from the ego and largest speed; beyond them the file is damaged or its unit is not the metre.
EXTENT_M, SPEED_MPS = 100_000.0, 500.0
#: Steps between the starts of two windows.
STRIDE = 40
_UNITS = "repair it, or convert it to metres in the reader"
#: Fields of tracks with a value per step, and the shape of that value.
_WIDTHS = {"xy": (2,), "z": (), "heading": (), "velocity": (2,), "size": (3,), "valid": ()}
Finding = tuple[str, str] | None


@dataclass(frozen=True)
class Tracks:
    """Tracks of all road users in the map frame of the source; invalid entries hold zeros."""

    xy: Float64[np.ndarray, "track time 2"]
    z: Float64[np.ndarray, "track time"]
    heading: Float64[np.ndarray, "track time"]
    velocity: Float64[np.ndarray, "track time 2"]
    size: Float64[np.ndarray, "track time 3"]
    valid: Bool[np.ndarray, "track time"]
    kind: Int8[np.ndarray, " track"]
    track_id: Int64[np.ndarray, " track"]


@dataclass(frozen=True)
class MapFeature:
    """An element of the map: a lane centre, a marking, an edge, an implicitly closed polygon, or a stop sign (a point).

    Points are (x, y, z) in metres. Road edges have the drivable side on their left. Links are ids and may dangle.
    """

    feature_id: int
    kind: RoadKind
    points: Float64[np.ndarray, "point 3"]
    limit_mps: float | None = None
    width_m: float | None = None
    successors: tuple[int, ...] = ()
    predecessors: tuple[int, ...] = ()
    left_neighbours: tuple[int, ...] = ()
    right_neighbours: tuple[int, ...] = ()
    interpolating: bool = False
    #: For a stop sign: the lanes that it controls.
    lanes: tuple[int, ...] = ()


@dataclass(frozen=True)
class Light:
    """A traffic light for one lane."""

    lane_id: int
    stop_point: Float64[np.ndarray, " 3"]
    states: Int8[np.ndarray, " time"]


@dataclass(frozen=True)
class Event:
    """A labelled rare event of the built-in world; ``actors`` are track ids, steps are inclusive."""

    kind: int
    start: int
    end: int
    actors: tuple[int, ...]


@dataclass(frozen=True)
class Recording:
    """A log in the frame of its source: ragged arrays, float64.

    Attributes:
        ego: Row of ``tracks`` that is the ego vehicle.
        timestamps_s: Seconds, one per step.
        current_step: Last step of the past (10 in WOMD).
        to_predict, of_interest: Rows of ``tracks``.
        route_lanes: Feature ids of the lanes of the intended route in order, if known.
        route_corridor: Feature ids of all lanes that the intended route may use, if only these are known (nuPlan's
            roadblocks).
        seen: Mask of the valid steps that the sensors of the ego would see; None if all recorded steps were seen.
        tags: Words of the source: ``place`` (city), ``source_format``, ``family`` of the built-in world, ...
        lost: Numbers of items that the reader left out, by name.
        flags: Facts that only the reader knows (default sizes, truncated map, ...).
        split_gap_m: Polylines are split where neighbouring points are further apart (clipped maps).
    """

    scenario_id: str
    dataset: str
    segment: str
    timestamps_s: Float64[np.ndarray, " time"]
    current_step: int
    ego: int
    tracks: Tracks
    features: tuple[MapFeature, ...]
    lights: tuple[Light, ...] = ()
    to_predict: tuple[int, ...] = ()
    of_interest: tuple[int, ...] = ()
    route_lanes: tuple[int, ...] = ()
    route_corridor: tuple[int, ...] = ()
    seen: Bool[np.ndarray, "track time"] | None = None
    events: tuple[Event, ...] = ()
    tags: Mapping[str, str] = field(default_factory=dict)
    lost: Mapping[str, int] = field(default_factory=dict)
    flags: Flag = Flag.NONE
    split_gap_m: float | None = None


def windows(recording: Recording, stride: int = STRIDE, length: int = STEPS) -> Iterator[Recording]:
    """Cut a recording into windows of ``length`` steps that share its segment; step 10 of each is the current one.

    Window ``k`` starts at step ``k * stride``; a rest that fills no window is left out (110 steps make one window, 199
    make three). Windows without a valid ego at the current step are left out, and counted in ``lost`` of the others as
    ``windows_without_ego``. A recording of at most ``length`` steps is its own window.

    Raises:
        DataError: No window has a valid ego at its current step.
    """
    if stride < 1:
        raise UsageError(f"a stride of {stride} steps", cure="choose 1 or more")
    steps = len(recording.timestamps_s)
    if steps <= length:
        now = min(CURRENT_STEP, steps - 1)
        yield recording if recording.current_step == now else replace(recording, current_step=now)
        return
    starts = range(0, steps - length + 1, stride)
    usable = [start for start in starts if recording.tracks.valid[recording.ego, start + CURRENT_STEP]]
    if not usable:
        problem = f"the ego is not valid at the current step of any of {len(starts)} windows"
        raise DataError(problem, record=recording.scenario_id, cure="skip the recording")
    left_out = {"windows_without_ego": len(starts) - len(usable)} if len(usable) < len(starts) else {}
    for start in usable:
        yield _window(replace(recording, lost={**recording.lost, **left_out}), start, length)


def _window(recording: Recording, start: int, length: int) -> Recording:
    """The ``length`` steps from ``start`` on."""
    part = slice(start, start + length)
    timed = {name: getattr(recording.tracks, name)[:, part] for name in _WIDTHS}
    events = (
        replace(event, start=max(event.start - start, 0), end=min(event.end - start, length - 1))
        for event in recording.events
    )
    return replace(
        recording,
        scenario_id=f"{recording.scenario_id}@{start}",
        timestamps_s=recording.timestamps_s[part],
        current_step=CURRENT_STEP,
        tracks=replace(recording.tracks, **timed),
        seen=None if recording.seen is None else recording.seen[:, part],
        lights=tuple(replace(light, states=light.states[part]) for light in recording.lights),
        events=tuple(event for event in events if event.end >= event.start),
    )


def with_ego(recording: Recording, row: int) -> Recording:
    """Return the recording with another vehicle, valid at the current step, as the ego; its route and ``seen`` go."""
    tracks = recording.tracks
    is_vehicle = 0 <= row < len(tracks.kind) and tracks.kind[row] == AgentKind.VEHICLE
    if not is_vehicle or not tracks.valid[row, recording.current_step]:
        problem = f"track row {row} is no vehicle that is valid at step {recording.current_step}"
        cure = "choose a vehicle that is valid at the current step"
        raise UsageError(problem, record=recording.scenario_id, cure=cure)
    if row == recording.ego:
        return recording
    name = f"{recording.scenario_id}#{int(tracks.track_id[row])}"
    return replace(recording, scenario_id=name, ego=row, seen=None, route_lanes=(), route_corridor=())


def check(recording: Recording, capacity: Capacity) -> None:
    """Raise DataError if a recording is invalid."""
    problem = _check_names(recording) or _check_time(recording, capacity.steps) or _check_shapes(recording)
    problem = problem or _check_tracks(recording) or _check_extent(recording)
    problem = problem or _check_map(recording) or _check_lights(recording)
    if problem is not None:
        raise DataError(problem[0], record=recording.scenario_id, cure=problem[1])


def step_seconds(timestamps_s: Float[Array, " time"]) -> tuple[float, float]:
    """Median step and largest deviation from it, seconds; 0.1 and 0 for a single step."""
    if len(timestamps_s) < 2:
        return DT_S, 0.0
    steps = np.diff(timestamps_s)
    return float(np.median(steps)), float(np.abs(steps - np.median(steps)).max())


def _check_names(recording: Recording) -> Finding:
    for name, size in TEXT_BYTES.items():
        text = getattr(recording, name)
        if not text or len(text.encode()) > size or "\0" in text:
            return f"{name} {text[:80]!r} is empty or longer than {size} bytes", f"shorten the {name}"
    return None


def _check_time(recording: Recording, most_steps: int) -> Finding:
    times = np.asarray(recording.timestamps_s)
    steps = len(times)
    if steps == 0 or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        return "timestamps do not increase", "repair the time base in the reader"
    if steps > most_steps:
        return f"{steps} steps, more than {most_steps}", "cut it with windows()"
    if not 0 <= recording.current_step < steps:
        return f"current step {recording.current_step} of {steps} steps", "name a step that exists"
    median, _ = step_seconds(times)
    if abs(median - DT_S) > STEP_TOLERANCE_S:
        return f"steps of {median:.3f} s instead of {DT_S} s", "resample the recording to 10 Hz"
    return None


def _check_shapes(recording: Recording) -> Finding:
    tracks, steps = recording.tracks, len(recording.timestamps_s)
    count = len(tracks.track_id)
    shapes = {f"tracks.{name}": (count, steps, *width) for name, width in _WIDTHS.items()}
    shapes |= {"tracks.kind": (count,)} | ({} if recording.seen is None else {"seen": (count, steps)})
    for name, shape in shapes.items():
        given = np.shape(attrgetter(name)(recording))
        if given != shape:
            return f"{name} has shape {given}, not {shape}", "give every track every step"
    rows = (recording.ego, *recording.to_predict, *recording.of_interest)
    if any(not 0 <= row < count for row in rows):
        return f"a track row out of {count} is named in {rows}", "name rows of the track table"
    return None


def _check_tracks(recording: Recording) -> Finding:
    tracks = recording.tracks
    for name in ("xy", "z", "heading", "velocity"):
        values = getattr(tracks, name)
        bad = tracks.valid & ~np.isfinite(values.reshape(*tracks.valid.shape, -1)).all(axis=-1)
        if bad.any():
            track, step = (int(i) for i in np.argwhere(bad)[0])
            place = f"track {int(tracks.track_id[track])} at step {step}"
            return f"tracks.{name} of {place} is not finite", "mark the step as not valid or repair it"
    kinds = {int(kind) for kind in AgentKind}
    if not set(np.unique(tracks.kind).tolist()) <= kinds:
        return "an agent kind is unknown", f"use kinds {min(kinds)} to {max(kinds)}"
    ids = tracks.track_id
    if len(ids) and (ids.min() < 0 or ids.max() >= 2**31):
        return "track ids do not fit into 31 bits", "number the tracks in the reader"
    if not tracks.valid[recording.ego, recording.current_step]:
        return f"the ego is not valid at the current step {recording.current_step}", "skip the recording"
    return None


def _here(recording: Recording) -> Float[Array, "3"]:
    """Position of the ego at the current step."""
    now = recording.ego, recording.current_step
    return np.append(recording.tracks.xy[now], recording.tracks.z[now])


def _check_extent(recording: Recording) -> Finding:
    """Positions and speeds of any size would not fit into memory or float32."""
    tracks, here = recording.tracks, _here(recording)
    places = np.concatenate((tracks.xy[tracks.valid], tracks.z[tracks.valid][:, None]), axis=1)
    if np.abs(places - here).max() > EXTENT_M:
        return f"a track is more than {EXTENT_M / 1000:.0f} km away from the ego", _UNITS
    if np.abs(tracks.velocity[tracks.valid]).max() > SPEED_MPS:
        return f"a track is faster than {SPEED_MPS:.0f} m/s", _UNITS
    stops = [np.asarray(light.stop_point) for light in recording.lights if np.shape(light.stop_point) == (3,)]
    if stops and np.nanmax(np.abs(np.array(stops) - here), initial=0.0) > EXTENT_M:
        return f"a light is more than {EXTENT_M / 1000:.0f} km away from the ego", _UNITS
    return None


def _check_map(recording: Recording) -> Finding:
    for feature in recording.features:
        shape = np.shape(feature.points)
        if len(shape) != 2 or shape[1] != 3 or not shape[0]:
            return f"points of feature {feature.feature_id} have shape {shape}", "give (point, 3)"
        if not -(2**63) <= feature.feature_id < 2**63:
            return f"the feature id {feature.feature_id} does not fit into 64 bits", "number the features"
        if feature.kind not in RoadKind:
            return f"feature {feature.feature_id} is of unknown kind {feature.kind}", "use a RoadKind"
    if not recording.features:
        return None
    points = np.concatenate([feature.points for feature in recording.features])
    far = np.flatnonzero(~(np.abs(points - _here(recording)).max(axis=1) <= EXTENT_M))
    if not len(far):
        return None
    ends = np.cumsum([len(feature.points) for feature in recording.features])
    feature = recording.features[int(np.searchsorted(ends, far[0], side="right"))]
    if not np.isfinite(points[far[0]]).all():
        return f"feature {feature.feature_id} has a point that is not finite", "repair it or drop it"
    where = f"more than {EXTENT_M / 1000:.0f} km away from the ego"
    return f"feature {feature.feature_id} has a point {where}", _UNITS


def _check_lights(recording: Recording) -> Finding:
    steps = len(recording.timestamps_s)
    for light in recording.lights:
        states = np.asarray(light.states)
        if states.shape != (steps,) or states.min() < -1 or states.max() > 8:
            return f"the light of lane {light.lane_id} has no state from -1 to 8 per step", "use LightState"
        if np.shape(light.stop_point) != (3,) or not np.isfinite(light.stop_point).all():
            return f"the light of lane {light.lane_id} has no finite stop point", "repair it or drop it"
    return None
