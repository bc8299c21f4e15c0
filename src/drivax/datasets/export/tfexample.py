"""Scenarios as tf.Examples of the Waymo Open Motion Dataset, which Waymax and V-Max read.

Names, types, shapes and -1 for missing values are those of the motion dataset (waymo.com/open/data/motion/tfexample);
``path_samples`` and ``roadgraph_samples/speed_limit`` are those of ScenarioMax, which V-Max trains on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Int

from drivax.datasets.export.recording import restore
from drivax.datasets.parsing import MPS_PER_MPH, subdivide
from drivax.datasets.womd.messages import ORIGIN
from drivax.geometry.polylines import project, resample
from drivax.scenario.recording import MapFeature, Recording, Tracks
from drivax.scenario.schema import (
    CURRENT_STEP,
    EDGE_KINDS,
    LANE_KINDS,
    LINE_KINDS,
    POLYGON_KINDS,
    STEPS,
    AgentKind,
    RoadKind,
    Scenario,
)

_Array = np.ndarray[Any, Any]

AGENTS, LIGHTS, POINTS = 128, 16, 30_000
_SPANS = {"past": slice(0, 10), "current": slice(10, 11), "future": slice(11, STEPS)}
#: Maximum number of tracks to predict that precede all others; sort key of tracks that are not valid at the current
#: step, from which their number of valid steps is subtracted.
_FIRST, _ABSENT_RANK = 8, 1e9
#: Spacing of map points, just under 1 m so that rounding makes no longer gap, at which readers cut polylines; and the
#: factor by which it grows until the points fit.
_SPACING_M, _WIDEN = 0.998, 1.1
#: Largest absolute coordinate that is written; up to it float32 is exact to half a millimetre.
_ABSOLUTE_M = 16_384.0
#: Upper bounds of the integers that float32 and int32 hold.
_FLOAT_ID_END, _INT_ID_END = 2**24, 2**31
#: Order of features in Waymo's files; readers that take fewer points cut off the end.
_ORDER = (
    *LANE_KINDS, *LINE_KINDS, RoadKind.STOP_SIGN, RoadKind.CROSSWALK, RoadKind.SPEED_BUMP, *EDGE_KINDS,
    RoadKind.DRIVEWAY,
)  # fmt: skip
#: A path is on the route if the log is this close to it for this share of its steps.
_ON_ROUTE_M, _ON_ROUTE_SHARE = 1.5, 0.95


@dataclass(frozen=True)
class Paths:
    """Number of ``path_samples``, and number and spacing of their points."""

    count: int
    points: int
    spacing_m: float


PATHS = {"vmax": Paths(10, 300, 1.0), "published": Paths(10, 500, 0.5)}


def tf_example(
    scenario: Scenario, paths: Paths = PATHS["vmax"]
) -> tuple[dict[str, bytes | _Array], Counter[str]]:
    """Return the features of a scenario, and the counts of elements that did not fit, both by name.

    Coordinates are the source's (float32, as in the data set) where all are below 16,384 m, else relative to ego at the
    current step: UTM coordinates would be rounded to half a metre. ``scenario/origin`` then holds that position as
    text, which Waymax and V-Max skip. Where an id does not fit its type exactly (agents: float32, map: int32),
    consecutive numbers replace all ids of that kind.
    """
    recording = restore(scenario)
    tracks, lost = _align_tracks(recording)
    origin = _origin(recording, scenario.origin)
    order = _order(tracks, recording)
    lost["agents"] += max(len(order) - AGENTS, 0)
    micros = np.round(np.arange(STEPS) * float(scenario.dt_s) * 1e6).astype(np.int64)
    file_ids = _file_ids(recording)
    features: dict[str, bytes | _Array] = {"scenario/id": recording.scenario_id.encode()}
    features |= {ORIGIN: " ".join(map(repr, origin.tolist())).encode()} if origin.any() else {}
    features |= _states(tracks, order[:AGENTS], micros, origin) | _marks(tracks, recording, order[:AGENTS])
    features |= _lights(recording, file_ids, micros, origin, lost)
    features |= _map(recording.features, file_ids, origin)
    features |= _paths(scenario, file_ids, scenario.origin - origin, paths)
    return features, +lost


def _origin(recording: Recording, scenario_origin: _Array) -> _Array:
    """Return the point to subtract from all coordinates: zeros, or the scenario's origin if coordinates are large."""
    points = [recording.tracks.xy[recording.tracks.valid], *(f.points[:, :2] for f in recording.features)]
    largest = max(float(np.abs(xy).max(initial=0.0)) for xy in points)
    return np.zeros(3) if largest < _ABSOLUTE_M else np.asarray(scenario_origin, np.float64)


def _align_tracks(recording: Recording) -> tuple[Tracks, Counter[str]]:
    """Return tracks at 91 steps around the current one, missing steps as invalid, and the number of steps left out."""
    tracks = recording.tracks
    steps, exists = _steps(recording)
    index = np.clip(steps, 0, tracks.valid.shape[1] - 1)
    series = {name: getattr(tracks, name)[:, index] for name in ("xy", "z", "heading", "velocity", "size")}
    valid = tracks.valid[:, index] & exists
    return replace(tracks, **series, valid=valid), Counter(steps=int(tracks.valid.shape[1] - exists.sum()))


def _steps(recording: Recording) -> tuple[_Array, _Array]:
    """Return 91 steps around the recording's current one, and whether the recording has each."""
    steps = recording.current_step - CURRENT_STEP + np.arange(STEPS)
    return steps, (steps >= 0) & (steps < len(recording.timestamps_s))


def _order(tracks: Tracks, recording: Recording) -> Int[_Array, " track"]:
    """Return the rows in the order of the file: ego, which V-Max reads from row 0, then the data set's order.

    That is: first the tracks that are valid now (up to 8 to predict by id, then the others by distance from ego), then
    those not valid now, most valid steps first. Tracks that are not valid at any of the 91 steps are left out.
    """
    now = tracks.valid[:, CURRENT_STEP]
    to_predict = [row for row in recording.to_predict if now[row] and row != recording.ego]
    to_predict = sorted(to_predict, key=lambda row: int(tracks.track_id[row]))[:_FIRST]
    xy = tracks.xy[:, CURRENT_STEP]
    distance = np.hypot(*(xy - xy[recording.ego]).T)
    # One sort key: distances, with the tracks to predict below all of them and absent tracks above.
    rank = np.where(now, distance, _ABSENT_RANK - tracks.valid.sum(axis=1))
    rank[to_predict] = -2.0 + np.arange(len(to_predict)) / _FIRST
    rank[recording.ego] = -np.inf
    order = np.argsort(rank, kind="stable")
    return order[tracks.valid[order].any(axis=1)]


def _pad(values: _Array, rows: int, fill: int = -1) -> _Array:
    """Pad an array to a number of rows, with ``fill``."""
    out = np.full((rows, *values.shape[1:]), fill, values.dtype)
    out[: len(values)] = values
    return out


def _by_span(prefix: str, table: Mapping[str, _Array], axis: int) -> dict[str, _Array]:
    """Cut columns into past, current step and future along their time axis."""
    return {
        f"{prefix}/{span}/{name}": column[(slice(None),) * axis + (steps,)]
        for span, steps in _SPANS.items()
        for name, column in table.items()
    }


def _states(tracks: Tracks, order: _Array, micros: _Array, origin: _Array) -> dict[str, _Array]:
    """Return features of agents over time; -1 where not valid."""
    valid = tracks.valid[order]
    vx, vy = np.moveaxis(tracks.velocity[order], -1, 0)
    columns = {
        "x": tracks.xy[order, :, 0] - origin[0],
        "y": tracks.xy[order, :, 1] - origin[1],
        "z": tracks.z[order] - origin[2],
        "bbox_yaw": tracks.heading[order],
        "length": tracks.size[order, :, 0],
        "width": tracks.size[order, :, 1],
        "height": tracks.size[order, :, 2],
        "velocity_x": vx,
        "velocity_y": vy,
        "speed": np.hypot(vx, vy),
        "vel_yaw": np.arctan2(vy, vx),
        "timestamp_micros": np.broadcast_to(micros, valid.shape),
    }
    table = {name: _pad(np.where(valid, column, -1), AGENTS) for name, column in columns.items()}
    table["valid"] = _pad(valid.astype(np.int64), AGENTS, 0)
    return _by_span("state", table, axis=1)


def _marks(tracks: Tracks, recording: Recording, order: _Array) -> dict[str, _Array]:
    """Return the time-invariant features of agents; -1 in rows without an agent."""
    ids = tracks.track_id[order]
    if ids.max(initial=0) >= _FLOAT_ID_END:
        ids = np.arange(len(order))
    # The data set has no class for cones and barriers.
    kinds = np.where(tracks.kind[order] == AgentKind.STATIC, AgentKind.OTHER, tracks.kind[order])

    marks = {
        "is_sdc": (recording.ego,),
        "tracks_to_predict": recording.to_predict,
        "objects_of_interest": recording.of_interest,
        "difficulty_level": (),
    }
    columns = {
        "id": ids.astype(np.float32),
        "type": kinds.astype(np.float32),
        **{name: np.isin(order, rows).astype(np.int64) for name, rows in marks.items()},
    }
    return {f"state/{name}": _pad(column, AGENTS) for name, column in columns.items()}


def _file_ids(recording: Recording) -> dict[int, int]:
    """Map ids of map features and lights' lanes to ids for the file: the same if all fit, else consecutive numbers."""
    ids = [feature.feature_id for feature in recording.features]
    file_ids = dict.fromkeys((*ids, *(light.lane_id for light in recording.lights)))
    fit = all(0 <= number < _INT_ID_END for number in file_ids)
    return {number: number if fit else row for row, number in enumerate(file_ids)}


def _lights(
    recording: Recording, file_ids: Mapping[int, int], micros: _Array, origin: _Array, lost: Counter[str]
) -> dict[str, _Array]:
    """Return lights in 16 slots, time-major; count what does not fit under ``lost["light_states"]``.

    Up to 16 lights keep their slots; of more, each step holds the first 16 that are observed at it.
    """
    lights = recording.lights
    steps, exists = _steps(recording)
    states = np.full((STEPS, max(len(lights), LIGHTS)), -1, np.int64)
    for column, light in enumerate(lights):
        states[exists, column] = light.states[steps[exists]]
    slot = np.broadcast_to(np.arange(LIGHTS), (STEPS, LIGHTS))
    if len(lights) > LIGHTS:  # Observed lights first, by step: a slot may change its lane.
        slot = np.argsort(states < 0, axis=1, kind="stable")[:, :LIGHTS]
    state = np.take_along_axis(states, slot, 1)
    is_observed = state >= 0
    lost["light_states"] += int((states >= 0).sum() - is_observed.sum())
    lane = np.full(states.shape[1], -1, np.int64)
    point = np.full((states.shape[1], 3), -1.0)
    lane[: len(lights)] = [file_ids[light.lane_id] for light in lights]
    point[: len(lights)] = np.array([light.stop_point for light in lights]).reshape(-1, 3) - origin
    table = {
        "state": state,
        "id": np.where(is_observed, lane[slot], -1),
        "valid": is_observed.astype(np.int64),
        **{axis: np.where(is_observed, point[slot, i], -1.0) for i, axis in enumerate("xyz")},
        "timestamp_micros": micros,
    }
    return _by_span("traffic_light_state", table, axis=0)


def _map(features: tuple[MapFeature, ...], file_ids: Mapping[int, int], origin: _Array) -> dict[str, _Array]:
    """Return points along every feature, at most 1 m apart; further apart if there would be more than 30,000."""
    features = tuple(sorted(features, key=lambda feature: _ORDER.index(feature.kind)))
    spacing = _SPACING_M
    lines = [_sample(feature, spacing) for feature in features]
    # The loop ends, because the features' own points are fewer (two for each of at most 8192 stored segments).
    while sum(map(len, lines)) > POINTS:
        spacing *= _WIDEN
        lines = [_sample(feature, spacing) for feature in features]
    counts = [len(line) for line in lines]
    limits = [-1.0 if f.limit_mps is None else f.limit_mps / MPS_PER_MPH for f in features]
    columns = {
        "xyz": np.concatenate([*lines, np.zeros((0, 3))]) - origin,
        "dir": np.concatenate([*map(_directions, lines), np.zeros((0, 3))]),
        "id": np.repeat([file_ids[f.feature_id] for f in features], counts).astype(np.int64)[:, None],
        "type": np.repeat([int(f.kind) for f in features], counts).astype(np.int64)[:, None],
        "speed_limit": np.repeat(limits, counts).astype(np.float64),
    }
    table = {f"roadgraph_samples/{name}": _pad(column, POINTS) for name, column in columns.items()}
    valid = np.ones((sum(counts), 1), np.int64)
    return {**table, "roadgraph_samples/valid": _pad(valid, POINTS, 0)}


def _sample(feature: MapFeature, spacing_m: float) -> _Array:
    """Return a feature's own points and others between them, at most ``spacing_m`` apart; polygons are closed."""
    points = feature.points
    if feature.kind in POLYGON_KINDS:
        points = np.concatenate((points, points[:1]))
    step = np.diff(points, axis=0)
    pieces = np.maximum(np.ceil(np.linalg.norm(step, axis=1) / spacing_m), 1).astype(np.int64)
    return np.concatenate((subdivide(points[:-1], step, pieces), points[-1:]))


def _directions(line: _Array) -> _Array:
    """Return unit vectors to the next point; zero at the last one, as in the data set."""
    step = np.diff(line, axis=0, append=line[-1:])
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return step / np.where(length > 0, length, 1.0)


def _paths(scenario: Scenario, file_ids: Mapping[int, int], shift: _Array, paths: Paths) -> dict[str, _Array]:
    """Return routes from ego's first logged position; the first is the route to the goal and always ``on_route``.

    The log route (stored row 1) is privileged and not exported, unless no lane leads to the goal: then it is row 0.
    """
    shape = (paths.count, paths.points)
    xyz, lane = np.full((*shape, 3), -1.0), np.full(shape, -1, np.int64)
    arc, valid, on_route = np.zeros(shape), np.zeros(shape, np.int64), np.zeros((paths.count, 1), np.int64)
    log = scenario.agent_xy[scenario.agent_valid[:, 0], 0].astype(np.float64)
    rows = [row for row in np.flatnonzero(scenario.route_points > 1) if row != 1][: paths.count]
    for number, row in enumerate(rows):
        count = int(scenario.route_points[row])
        line = np.column_stack((scenario.route_xy[row], scenario.route_z[row]))[:count].astype(np.float64)
        begin = min(int(np.hypot(*(line[:, :2] - log[0]).T).argmin()), count - 2)
        points, index = resample(line[begin:], paths.spacing_m, paths.points)
        lanes = scenario.route_lane[row, begin:count][index]
        ids = np.where(lanes >= 0, scenario.lane_id[lanes], -1).tolist()
        size = len(points)
        xyz[number, :size] = points + shift
        lane[number, :size] = [file_ids.get(lane_id, -1) for lane_id in ids]
        arc[number, :size] = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        valid[number, :size] = 1
        _, distance = project(points[:, :2], log)
        on_route[number] = number == 0 or (distance <= _ON_ROUTE_M).mean() >= _ON_ROUTE_SHARE
    columns = {"xyz": xyz, "id": lane, "arc_length": arc, "valid": valid, "on_route": on_route}
    return {f"path_samples/{name}": column for name, column in columns.items()}
