"""What a recording must satisfy before it can become a scenario; every refusal says what to do about it."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.errors import DataError
from drivax.scenario.recording import Recording
from drivax.scenario.schema import DT_S, AgentKind, Capacity, RoadKind

Array = np.ndarray[Any, Any]

#: The median step may differ from 0.1 s by this much.
STEP_TOLERANCE_S = 0.005
TEXT_BYTES = {"scenario_id": 64, "segment": 64, "dataset": 16}
#: Nothing lies further from the ego, and nobody drives faster: the file is damaged, or its unit is not the metre.
EXTENT_M, SPEED_MPS = 100_000.0, 500.0
_UNITS = "repair it, or convert it to metres in the reader"


def check(recording: Recording, capacity: Capacity) -> None:
    """Refuses recordings that make no sense.

    Raises:
        DataError: Names the recording, what is wrong with it and the cure.
    """
    for test in (
        _check_names,
        _check_time,
        _check_shapes,
        _check_tracks,
        _check_ego,
        _check_extent,
        _check_map,
        _check_lights,
    ):
        problem = test(recording, capacity)
        if problem is not None:
            raise DataError(problem[0], record=recording.scenario_id, cure=problem[1])


Finding = tuple[str, str] | None


def step_seconds(timestamps_s: Float[Array, " time"]) -> tuple[float, float]:
    """Median step, and the largest deviation of a step from it, seconds; 0.1 and 0 for a single step."""
    steps = np.diff(timestamps_s)
    if len(steps) == 0:
        return DT_S, 0.0
    median = float(np.median(steps))
    return median, float(np.abs(steps - median).max())


def _check_names(recording: Recording, capacity: Capacity) -> Finding:
    for name, size in TEXT_BYTES.items():
        text = getattr(recording, name)
        if not text or len(text.encode()) > size or "\0" in text:
            return f"{name} {text[:80]!r} is empty or longer than {size} bytes", f"shorten the {name}"
    return None


def _check_time(recording: Recording, capacity: Capacity) -> Finding:
    times = np.asarray(recording.timestamps_s)
    steps = len(times)
    if steps == 0 or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        return "timestamps do not increase", "repair the time base in the reader"
    if steps > capacity.steps:
        return f"{steps} steps, more than {capacity.steps}", "cut it with windows()"
    if not 0 <= recording.current_step < steps:
        return f"current step {recording.current_step} of {steps} steps", "name a step that exists"
    median, _ = step_seconds(times)
    if abs(median - DT_S) > STEP_TOLERANCE_S:
        return f"steps of {median:.3f} s instead of {DT_S} s", "resample the recording to 10 Hz"
    return None


def _check_shapes(recording: Recording, capacity: Capacity) -> Finding:
    tracks, steps = recording.tracks, len(recording.timestamps_s)
    count = len(tracks.track_id)
    wanted = {
        "xy": (count, steps, 2),
        "z": (count, steps),
        "heading": (count, steps),
        "velocity": (count, steps, 2),
        "size": (count, steps, 3),
        "valid": (count, steps),
        "kind": (count,),
    }
    for name, shape in wanted.items():
        found = np.shape(getattr(tracks, name))
        if found != shape:
            return f"tracks.{name} has shape {found}, not {shape}", "give every track every step"
    if recording.seen is not None and np.shape(recording.seen) != (count, steps):
        return (
            f"seen has shape {np.shape(recording.seen)}, not {(count, steps)}",
            "give every track every step",
        )
    rows = (recording.ego, *recording.to_predict, *recording.of_interest)
    if any(not 0 <= row < count for row in rows):
        return f"a track row out of {count} is named in {rows}", "name rows of the track table"
    return None


def _check_tracks(recording: Recording, capacity: Capacity) -> Finding:
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
    return None


def _check_ego(recording: Recording, capacity: Capacity) -> Finding:
    if not recording.tracks.valid[recording.ego, recording.current_step]:
        return f"the ego is not valid at the current step {recording.current_step}", "skip the recording"
    return None


def _here(recording: Recording) -> Float[Array, "3"]:
    """Where the ego is at the current step."""
    now = recording.ego, recording.current_step
    return np.append(recording.tracks.xy[now], recording.tracks.z[now])


def _check_extent(recording: Recording, capacity: Capacity) -> Finding:
    """Valid numbers of any size would need memory of any size, and would not fit into float32."""
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


def _check_map(recording: Recording, capacity: Capacity) -> Finding:
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
    counts = [len(feature.points) for feature in recording.features]
    points = np.concatenate([feature.points for feature in recording.features])
    far = ~(np.abs(points - _here(recording)).max(axis=1) <= EXTENT_M)
    if not far.any():
        return None
    row = int(np.searchsorted(np.cumsum(counts), np.argmax(far), side="right"))
    place = f"feature {recording.features[row].feature_id} has a point"
    if not np.isfinite(points[np.argmax(far)]).all():
        return f"{place} that is not finite", "repair it or drop it"
    return f"{place} more than {EXTENT_M / 1000:.0f} km away from the ego", _UNITS


def _check_lights(recording: Recording, capacity: Capacity) -> Finding:
    steps = len(recording.timestamps_s)
    for light in recording.lights:
        states = np.asarray(light.states)
        if states.shape != (steps,) or states.min() < -1 or states.max() > 8:
            return f"the light of lane {light.lane_id} has no state from -1 to 8 per step", "use LightState"
        if np.shape(light.stop_point) != (3,) or not np.isfinite(light.stop_point).all():
            return f"the light of lane {light.lane_id} has no finite stop point", "repair it or drop it"
    return None
