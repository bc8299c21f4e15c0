"""Recordings: logs in the frame of their source, as readers and the built-in world produce them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from operator import attrgetter
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int8, Int64

from drivax.errors import DataError, UsageError
from drivax.geometry.vectors import wrap
from drivax.scenario.schema import CURRENT_STEP, DT_S, NAMES, STEPS, AgentKind, Capacity, Flag, RoadKind

Array = np.ndarray[Any, Any]
STEP_TOLERANCE_S = 0.005
#: A recording is resampled if a step deviates from the median by more than the first, s, and split at steps longer than
#: the second, in median steps.
LATE_S, GAP_STEPS = 0.02, 2.5
DATASET_BYTES = 16
#: Largest distance from the ego and largest speed, both along an axis; beyond them a track or file is damaged, or its
#: unit is not the metre.
EXTENT_M, SPEED_MPS = 100_000.0, 100.0
#: Default number of steps between the starts of two windows.
STRIDE = 40
_UNIT_CURE = "repair it, or convert it to metres in the reader"
_ROAD_KINDS = frozenset(RoadKind)
#: Fields of tracks with a value per step, and the shape of that value.
_VALUE_SHAPES = {"xy": (2,), "z": (), "heading": (), "velocity": (2,), "size": (3,), "valid": ()}
#: Problem and cure, None if a check passes.
Finding = tuple[str, str] | None


@dataclass(frozen=True)
class Tracks:
    """Tracks of all road users (box centres) in the map frame of the source: m, rad, m/s; 0 where not valid."""

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
    """A traffic light for one lane: stop point (x, y, z) in metres, and a ``LightState`` for each step."""

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
        current_step: Step after which the future begins (10 in WOMD).
        to_predict, of_interest: Rows of ``tracks``.
        route_lanes: Feature ids of the lanes of the intended route in order, if known.
        route_corridor: Feature ids of all lanes that the intended route may use, if only these are known (nuPlan's
            roadblocks).
        seen: Mask of the valid steps that the sensors of the ego would see; None for all of them.
        tags: Words of the source: ``place`` (city), ``source_format``, ``family`` of the built-in world, ...
        lost: Numbers of items that were dropped or interpolated, by name.
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
    """Cut a recording into windows of ``length`` steps that share its segment; step 10 (or the last) becomes current.

    Window ``k`` starts at step ``k * stride``; a remainder that fills no window is dropped (110 steps make one window,
    199 make three). Windows without a valid ego at the current step are dropped; ``lost`` of all other windows counts
    them as ``windows_without_ego``. A recording of at most ``length`` steps is its own window.

    No window spans a gap of two or more missing frames: the pieces between gaps are cut on their own, and ``lost``
    counts the ``time_gaps``. If no piece fills a window, the longest one with a valid ego is the window. A piece with a
    step that differs by more than 20 ms from the median, such as one across a missing frame, is interpolated at even
    times; ``interpolated_steps`` counts steps without a frame.

    Raises:
        DataError: A recording that is cut has no window with a valid ego at its current step.
        UsageError: ``stride`` or ``length`` is below 1.
    """
    for name, number in (("stride", stride), ("length", length)):
        if number < 1:
            raise UsageError(f"a {name} of {number} steps", cure="choose 1 or more")
    pieces = [_resample(piece) for piece in _split_at_gaps(recording)]
    if len(pieces) == 1 and len(pieces[0][1]) <= length:
        piece, is_interpolated = pieces[0]
        current_step = min(CURRENT_STEP, len(is_interpolated) - 1)
        piece = piece if piece.current_step == current_step else replace(piece, current_step=current_step)
        yield _add_counts(piece, interpolated_steps=int(is_interpolated.sum()))
        return
    candidates = [
        _window(piece, is_interpolated, start, length, recording)
        for piece, is_interpolated in pieces
        for start in range(0, len(is_interpolated) - length + 1, stride)
    ] or [_window(*max(pieces, key=_window_rank), 0, length, recording)]
    usable_windows = [window for window in candidates if window.tracks.valid[window.ego, window.current_step]]
    if not usable_windows:
        problem = f"the ego is not valid at the current step of any of {len(candidates)} windows"
        raise DataError(problem, record=recording.scenario_id, cure="skip the recording")
    lost = {"windows_without_ego": len(candidates) - len(usable_windows), "time_gaps": len(pieces) - 1}
    yield from (_add_counts(window, **lost) for window in usable_windows)


def _window_rank(piece: tuple[Recording, Array]) -> tuple[bool, int]:
    """Sort key of pieces that fill no window: first a valid ego at the current step, then length."""
    recording, is_interpolated = piece
    current_step = min(CURRENT_STEP, len(is_interpolated) - 1)
    return bool(recording.tracks.valid[recording.ego, current_step]), len(is_interpolated)


def _add_counts(recording: Recording, **lost: int) -> Recording:
    """Return the recording with nonzero counts added to ``lost``, or itself if all are 0."""
    lost = {name: count for name, count in lost.items() if count}
    return replace(recording, lost={**recording.lost, **lost}) if lost else recording


def _split_at_gaps(recording: Recording) -> Iterator[Recording]:
    """Yield the pieces of a recording between gaps; :func:`check` refuses timestamps that do not increase."""
    times = recording.timestamps_s
    ends = np.flatnonzero(np.diff(times) > GAP_STEPS * step_seconds(times)[0]) + 1
    if not len(ends) or not (np.diff(times) > 0).all():
        yield recording
        return
    for first, last in pairwise([0, *ends.tolist(), len(times)]):
        yield _cut(recording, slice(first, last))


def _resample(recording: Recording) -> tuple[Recording, Bool[np.ndarray, " time"]]:
    """Interpolate a recording at even times if its steps are uneven; also return the mask of steps without a frame."""
    times = recording.timestamps_s
    if is_even(times) or not (np.diff(times) > 0).all():
        return recording, np.zeros(len(times), dtype=bool)
    step_s, _ = step_seconds(times)
    count = int((times[-1] - times[0] + STEP_TOLERANCE_S) / step_s) + 1
    even_times = times[0] + step_s * np.arange(count)
    at = np.interp(even_times, times, np.arange(len(times)))
    # A step near enough to a frame takes the frame unchanged.
    frame = np.rint(at).astype(np.int64)
    is_exact = np.abs(times[frame] - even_times) <= STEP_TOLERANCE_S
    return _interpolate_at(recording, np.where(is_exact, frame, at), even_times), ~is_exact


def _interpolate_at(
    recording: Recording, at: Float64[np.ndarray, " step"], times: Float64[Array, " step"]
) -> Recording:
    """Interpolate a recording at fractional steps and new times; lights keep their state until the next frame."""
    before, after = np.floor(at).astype(np.int64), np.ceil(at).astype(np.int64)
    tracks, seen = recording.tracks, recording.seen
    series = {"valid": tracks.valid[:, before] & tracks.valid[:, after]}
    for name in _VALUE_SHAPES.keys() - series.keys():
        series[name] = interpolate(getattr(tracks, name), tracks.valid, at, angle=name == "heading")

    def step_of(old: int) -> int:
        """Return the first new step at or after an old one, at most the last."""
        return min(int(np.searchsorted(at, old)), len(at) - 1)

    return replace(
        recording,
        timestamps_s=times,
        current_step=step_of(recording.current_step),
        tracks=replace(tracks, **series),
        seen=None if seen is None else seen[:, before] & seen[:, after],
        lights=tuple(replace(light, states=light.states[before]) for light in recording.lights),
        events=tuple(
            replace(event, start=step_of(event.start), end=step_of(event.end)) for event in recording.events
        ),
    )


def interpolate(
    values: Float[Array, "track time *value"], valid: Bool[Array, "track time"], at: Float[Array, " step"],
    angle: bool = False,
) -> Float[Array, "track step *value"]:  # fmt: skip
    """Interpolate values of tracks at fractional steps, angles along the shorter arc; 0 unless both sides are valid."""
    before, after = np.floor(at).astype(np.int64), np.ceil(at).astype(np.int64)
    expand = (..., *[None] * (values.ndim - 2))
    difference = values[:, after] - values[:, before]
    result = values[:, before] + (at - before)[expand] * (wrap(difference) if angle else difference)
    return np.where((valid[:, before] & valid[:, after])[expand], result, 0.0)


def differentiate(
    xy: Float64[np.ndarray, "track time 2"],
    valid: Bool[np.ndarray, "track time"],
    timestamps_s: Float64[np.ndarray, " time"],
) -> Float64[np.ndarray, "track time 2"]:
    """Velocities from positions, m/s: central differences, one-sided at the ends of observed intervals.

    No difference spans a gap; invalid steps and those without a valid neighbour get zero.
    """
    step = np.arange(len(timestamps_s))
    has_previous = np.pad(valid[:, 1:] & valid[:, :-1], ((0, 0), (1, 0)))
    has_next = np.pad(has_previous[:, 1:], ((0, 0), (0, 1)))
    first, last = np.maximum(step - has_previous, 0), np.minimum(step + has_next, len(step) - 1)
    rows = np.arange(len(xy))[:, None]
    seconds_apart = (timestamps_s[last] - timestamps_s[first])[..., None]
    displacement = xy[rows, last] - xy[rows, first]
    is_known = (has_previous | has_next)[..., None]
    return np.divide(displacement, seconds_apart, out=np.zeros_like(displacement), where=is_known)


def _window(
    piece: Recording, is_interpolated: Bool[Array, " time"], start: int, length: int, whole: Recording
) -> Recording:
    """Return the window of a piece from step ``start`` on; ``@STEP`` in its id is its start in the whole recording."""
    steps = slice(start, min(start + length, len(is_interpolated)))
    piece_start = (piece.timestamps_s[0] - whole.timestamps_s[0]) / step_seconds(whole.timestamps_s)[0]
    window = replace(
        _cut(piece, steps),
        scenario_id=f"{whole.scenario_id}@{round(piece_start) + start}",
        current_step=min(CURRENT_STEP, steps.stop - steps.start - 1),
    )
    return _add_counts(window, interpolated_steps=int(is_interpolated[steps].sum()))


def _cut(recording: Recording, steps: slice) -> Recording:
    """Return some steps of a recording, and the events in them; the caller sets the current step."""
    last = steps.stop - steps.start - 1
    series = {name: getattr(recording.tracks, name)[:, steps] for name in _VALUE_SHAPES}
    events = (
        replace(event, start=max(event.start - steps.start, 0), end=min(event.end - steps.start, last))
        for event in recording.events
    )
    return replace(
        recording,
        timestamps_s=recording.timestamps_s[steps],
        tracks=replace(recording.tracks, **series),
        seen=None if recording.seen is None else recording.seen[:, steps],
        lights=tuple(replace(light, states=light.states[steps]) for light in recording.lights),
        events=tuple(event for event in events if event.end >= event.start),
    )


def with_ego(recording: Recording, row: int) -> Recording:
    """Return the recording with another vehicle as the ego, without route and ``seen``; its id ends in ``#TRACK_ID``.

    For the row of the present ego, return the recording unchanged.

    Raises:
        UsageError: The track is not a vehicle that is valid at the current step.
    """
    tracks = recording.tracks
    is_vehicle = 0 <= row < len(tracks.kind) and tracks.kind[row] == AgentKind.VEHICLE
    if not is_vehicle or not tracks.valid[row, recording.current_step]:
        problem = f"track row {row} is not a vehicle that is valid at step {recording.current_step}"
        cure = "choose a vehicle that is valid at the current step"
        raise UsageError(problem, record=recording.scenario_id, cure=cure)
    if row == recording.ego:
        return recording
    name = f"{recording.scenario_id}#{int(tracks.track_id[row])}"
    return replace(recording, scenario_id=name, ego=row, seen=None, route_lanes=(), route_corridor=())


def check(recording: Recording, capacity: Capacity) -> None:
    """Raise a DataError if a recording is invalid."""
    finding = _check_names(recording) or _check_time(recording, capacity.steps) or _check_shapes(recording)
    finding = finding or _check_tracks(recording) or _check_extent(recording)
    finding = finding or _check_map(recording) or _check_lights(recording)
    if finding is not None:
        problem, cure = finding
        raise DataError(problem, record=recording.scenario_id, cure=cure)


def step_seconds(timestamps_s: Float[Array, " time"]) -> tuple[float, float]:
    """Median step and largest deviation from it, seconds; 0.1 and 0 for a single step."""
    if len(timestamps_s) < 2:
        return DT_S, 0.0
    steps = np.diff(timestamps_s)
    median = np.median(steps)
    return float(median), float(np.abs(steps - median).max())


def is_even(timestamps_s: Float[Array, " time"]) -> bool:
    """Return whether no step differs from the median by more than 20 ms."""
    return step_seconds(timestamps_s)[1] <= LATE_S


def _check_names(recording: Recording) -> Finding:
    for name in NAMES:
        text = getattr(recording, name)
        if not text or any(character < " " for character in text):
            problem = f"{name} {text[:80]!r} is empty or contains control characters"
            return problem, f"set {name} in the reader"
    if len(recording.dataset.encode()) > DATASET_BYTES:
        problem = f"dataset {recording.dataset[:80]!r} is longer than {DATASET_BYTES} bytes"
        return problem, "shorten it in the reader"
    return None


def _check_time(recording: Recording, most_steps: int) -> Finding:
    times = np.asarray(recording.timestamps_s)
    steps = len(times)
    if steps == 0:
        return "there are no steps", "skip the recording"
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        return "timestamps do not increase or are not finite", "repair the time base in the reader"
    if steps > most_steps:
        return f"{steps} steps, more than {most_steps}", "cut it with windows()"
    if not 0 <= recording.current_step < steps:
        return f"current step {recording.current_step} of {steps} steps", "name a step that exists"
    median, deviation = step_seconds(times)
    if abs(median - DT_S) > STEP_TOLERANCE_S:
        return f"steps of {median:.3f} s instead of {DT_S} s", "resample the recording to 10 Hz"
    if deviation > LATE_S:
        step = int(np.abs(np.diff(times) - median).argmax()) + 1
        problem = f"step {step} comes {times[step] - times[step - 1]:.3f} s after the one before"
        return problem, "cut and resample it with windows()"
    return None


def _check_shapes(recording: Recording) -> Finding:
    tracks, steps = recording.tracks, len(recording.timestamps_s)
    count = len(tracks.track_id)
    shapes = {f"tracks.{name}": (count, steps, *value_shape) for name, value_shape in _VALUE_SHAPES.items()}
    shapes |= {"tracks.kind": (count,)} | ({} if recording.seen is None else {"seen": (count, steps)})
    for name, shape in shapes.items():
        actual = np.shape(attrgetter(name)(recording))
        if actual != shape:
            return f"{name} has shape {actual}, not {shape}", "give every track a value per step"
    rows = (recording.ego, *recording.to_predict, *recording.of_interest)
    if wrong := [row for row in rows if not 0 <= row < count]:
        return f"track row {wrong[0]} of {count} tracks", "name rows of the track table"
    return None


def _check_tracks(recording: Recording) -> Finding:
    tracks = recording.tracks
    for name in ("xy", "z", "heading", "velocity"):
        values = getattr(tracks, name)
        if np.isfinite(values).all():
            continue
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


def _ego_position(recording: Recording) -> Float[Array, "3"]:
    """Position of the ego at the current step."""
    index = recording.ego, recording.current_step
    return np.append(recording.tracks.xy[index], recording.tracks.z[index])


def _check_extent(recording: Recording) -> Finding:
    """Refuse implausible ego and lights, which exhaust memory or float32 precision; other tracks lose such steps."""
    ego, row = _ego_position(recording), recording.ego
    steps = np.flatnonzero(recording.tracks.valid[row] & ~plausible_steps(recording, slice(row, row + 1))[0])
    if len(steps):
        when = f"between steps {steps[0]} and {steps[-1]}" if len(steps) > 1 else f"at step {steps[0]}"
        return f"the ego jumps or is faster than {SPEED_MPS:.0f} m/s {when}", _UNIT_CURE
    stops = [np.asarray(light.stop_point) for light in recording.lights if np.shape(light.stop_point) == (3,)]
    if stops and np.nanmax(np.abs(np.array(stops) - ego), initial=0.0) > EXTENT_M:
        return f"a light is more than {EXTENT_M / 1000:.0f} km away from the ego", _UNIT_CURE
    return None


def plausible_steps(recording: Recording, rows: slice = slice(None)) -> Bool[np.ndarray, "track time"]:
    """Mask of the valid steps of tracks within ``EXTENT_M`` and ``SPEED_MPS`` and without jumps.

    A track jumps between two observations that it could not connect at ``SPEED_MPS``. Of the pieces between jumps, the
    longest and those before and after that connect to it are kept.
    """
    tracks, ego = recording.tracks, _ego_position(recording)
    xy, z, velocity = tracks.xy[rows], tracks.z[rows], tracks.velocity[rows]
    result = tracks.valid[rows] & (np.abs(z - ego[2]) <= EXTENT_M)
    for axis in (0, 1):
        result &= np.abs(xy[..., axis] - ego[axis]) <= EXTENT_M
        result &= np.abs(velocity[..., axis]) <= SPEED_MPS
    track, step = np.nonzero(result)
    jumps = ~_connects(xy[track, step], step) & (track[1:] == track[:-1])
    for row in np.unique(track[1:][jumps]).tolist():
        chain = _longest_chain(xy[row], step[track == row])
        result[row] = False
        result[row, chain] = True
    return result


def _longest_chain(xy: Float[Array, "time 2"], steps: Int[Array, " step"]) -> Int[Array, " kept"]:
    """Return the steps of a track that form its longest piece without jumps, and those that connect to it."""
    pieces = np.split(steps, np.flatnonzero(~_connects(xy[steps], steps)) + 1)
    longest = int(np.argmax([len(piece) for piece in pieces]))
    chain = pieces[longest]
    for piece in pieces[longest + 1 :]:
        ends = np.array([chain[-1], piece[0]])
        chain = np.append(chain, piece) if _connects(xy[ends], ends)[0] else chain
    for piece in reversed(pieces[:longest]):
        ends = np.array([piece[-1], chain[0]])
        chain = np.append(piece, chain) if _connects(xy[ends], ends)[0] else chain
    return chain


def _connects(xy: Float[Array, "k 2"], step: Int[Array, " k"]) -> Bool[np.ndarray, " pair"]:
    """Return whether a track could connect successive observations at ``SPEED_MPS``."""
    displacement = xy[1:] - xy[:-1]
    return np.hypot(displacement[:, 0], displacement[:, 1]) <= SPEED_MPS * DT_S * (step[1:] - step[:-1])


def _check_map(recording: Recording) -> Finding:
    for feature in recording.features:
        shape = np.shape(feature.points)
        if len(shape) != 2 or shape[1] != 3 or not shape[0]:
            return f"points of feature {feature.feature_id} have shape {shape}", "give (point, 3)"
        if not -(2**63) <= feature.feature_id < 2**63:
            return f"the feature id {feature.feature_id} does not fit into 64 bits", "number the features"
        if feature.kind not in _ROAD_KINDS:
            return f"feature {feature.feature_id} is of unknown kind {feature.kind}", "use a RoadKind"
    if not recording.features:
        return None
    points = np.concatenate([feature.points for feature in recording.features])
    is_near = np.abs(points - _ego_position(recording)) <= EXTENT_M
    if is_near.all():
        return None
    far = np.flatnonzero(~is_near.all(axis=1))
    ends = np.cumsum([len(feature.points) for feature in recording.features])
    feature = recording.features[int(np.searchsorted(ends, far[0], side="right"))]
    if not np.isfinite(points[far[0]]).all():
        return f"feature {feature.feature_id} has a point that is not finite", "repair it or drop it"
    where = f"more than {EXTENT_M / 1000:.0f} km away from the ego"
    return f"feature {feature.feature_id} has a point {where}", _UNIT_CURE


def _check_lights(recording: Recording) -> Finding:
    steps = len(recording.timestamps_s)
    for light in recording.lights:
        states = np.asarray(light.states)
        if states.shape != (steps,) or states.min() < -1 or states.max() > 8:
            return f"the light of lane {light.lane_id} has no state from -1 to 8 per step", "use LightState"
        if np.shape(light.stop_point) != (3,) or not np.isfinite(light.stop_point).all():
            return f"the light of lane {light.lane_id} has no finite stop point", "repair it or drop it"
    return None
