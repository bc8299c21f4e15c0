"""Restore the recording of a stored scenario, for exporters and for tests.

Some information is lost. Stored polylines are simplified to 5 cm and, except for lanes of routes, cropped to 100 m
around ego's log; boxes have one size; parked agents have one pose and no marks; stop signs have no ids and no heights;
lights whose lane is not on the map have no lane id. ``scenario.build.assemble`` says what is kept.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from drivax.scenario.build.assemble import MEASURED
from drivax.scenario.build.tracks import INTEREST_BIT, PREDICT_BIT
from drivax.scenario.recording import Light, MapFeature, Recording, Tracks
from drivax.scenario.schema import LANE_KINDS, POLYGON_KINDS, Flag, RoadKind, Scenario

_Array = np.ndarray[Any, Any]
#: Flags that readers set; assembly determines all others again.
_READER_FLAGS = ~MEASURED & ~(Flag.NO_FUTURE | Flag.JITTERED_TIME)


def restore(scenario: Scenario) -> Recording:
    """Return the recording that a stored scenario describes, in the source's map frame (float64).

    Agents are in stored order: ego, then moving, then parked agents. Every piece of a cropped polyline is a feature:
    the first keeps the id, and with it the links of the lane graph. Other pieces, stop signs, features without an id,
    and the lanes of lights that are not on the map get ids above all others.
    """
    largest = max(int(scenario.feature_id.max(initial=0)), int(scenario.lane_id.max(initial=0)))
    new_ids = itertools.count(largest + 1)
    features = (*_features(scenario, new_ids), *_stop_signs(scenario, new_ids))
    masks = scenario.agent_valid, scenario.parked_valid
    moving, parked = (np.flatnonzero(mask.any(axis=0)) for mask in masks)
    marks = scenario.agent_flags[moving]
    return Recording(
        scenario_id=scenario.id,
        dataset=scenario.text("dataset"),
        segment=scenario.text("segment"),
        timestamps_s=np.arange(int(scenario.steps)) * round(float(scenario.dt_s), 6),
        current_step=int(scenario.current_step),
        ego=0,
        tracks=_tracks(scenario, moving, parked),
        features=features,
        seen=_seen_mask(scenario, moving, parked),
        lights=_lights(scenario, new_ids),
        to_predict=tuple(np.flatnonzero(marks & PREDICT_BIT).tolist()),
        of_interest=tuple(np.flatnonzero(marks & INTEREST_BIT).tolist()),
        tags=scenario.tags,
        flags=Flag(scenario.has & _READER_FLAGS),
    )


def _mask(scenario: Scenario, moving: _Array, parked: _Array, name: str) -> Bool[_Array, "track time"]:
    """Return the mask ``name`` of moving and parked agents, in the order of tracks."""
    steps = int(scenario.steps)
    agents, parked_agents = scenario.record["agent_" + name], scenario.record["parked_" + name]
    return np.concatenate((agents[:steps, moving], parked_agents[:steps, parked]), axis=1).T


def _tracks(scenario: Scenario, moving: _Array, parked: _Array) -> Tracks:
    """Return tracks of the moving and parked agents in these slots, in the source's frame."""
    steps = int(scenario.steps)
    zeros = np.zeros((steps, len(parked), 1))
    valid = _mask(scenario, moving, parked, "valid")
    mask = valid.T[..., None]

    def join_steps(agents: _Array, poses: _Array) -> _Array:
        """Join time series of moving agents and poses of parked ones: [track, time, column], zero where not valid."""
        series = agents[:steps, moving].reshape(steps, len(moving), -1)
        series = np.concatenate((series, poses + zeros), axis=1)
        return np.swapaxes(np.where(mask, series, 0.0), 0, 1).astype(np.float64)

    def join(agents: _Array, parked_agents: _Array) -> _Array:
        """Join constants of moving and parked agents."""
        return np.concatenate((agents[moving], parked_agents[parked]))

    size = join(scenario.agent_size, scenario.parked_size).astype(np.float64)
    origin = np.where(mask, scenario.origin, 0.0).swapaxes(0, 1)
    return Tracks(
        xy=join_steps(scenario.agent_xy, scenario.parked_xy[parked]) + origin[..., :2],
        z=join_steps(scenario.agent_z, scenario.parked_z[parked, None])[..., 0] + origin[..., 2],
        heading=join_steps(scenario.agent_heading, scenario.parked_heading[parked, None])[..., 0],
        velocity=join_steps(scenario.agent_velocity, np.zeros((len(parked), 2))),
        size=np.where(valid[..., None], size[:, None], 0.0),
        valid=valid.copy(),
        kind=join(scenario.agent_kind, scenario.parked_kind).astype(np.int8),
        track_id=join(scenario.agent_id, scenario.parked_id).astype(np.int64),
    )


def _seen_mask(scenario: Scenario, moving: _Array, parked: _Array) -> Bool[_Array, "track time"] | None:
    """Return the mask of states that ego's sensors saw; None if they saw all valid ones."""
    seen, valid = (_mask(scenario, moving, parked, name) for name in ("seen", "valid"))
    return None if np.array_equal(seen, valid) else seen.copy()


def _polylines(scenario: Scenario) -> list[tuple[Float[_Array, "point 3"], int]]:
    """Join segments to polylines: points (local frame, metres) and first row, ordered by feature and arc length."""
    count = int(scenario.segment_blocks[3])
    begin, end = scenario.segment_a[:count], scenario.segment_b[:count]
    feature, lane, kind = (
        getattr(scenario, f"segment_{name}")[:count].astype(np.int64) for name in ("feature", "lane", "kind")
    )
    # Segments without a feature row are grouped by kind and lane, packed into a number above all rows.
    group = np.where(feature >= 0, feature, np.iinfo(np.int16).max + (kind + 1) * 2**16 + lane + 1)
    chains: list[list[int]] = []
    open_ends: dict[tuple[int, bytes], list[int]] = {}
    for row in np.lexsort((scenario.segment_start_m[:count], group)).tolist():
        chain = open_ends.pop((int(group[row]), begin[row].tobytes()), None)
        if chain is None:
            chain = []
            chains.append(chain)
        chain.append(row)
        open_ends[int(group[row]), end[row].tobytes()] = chain
    return [(np.concatenate((begin[chain[:1]], end[chain])).astype(np.float64), chain[0]) for chain in chains]


def _features(scenario: Scenario, new_ids: Iterator[int]) -> list[MapFeature]:
    """Return a feature per polyline; only the first polyline of a source's feature keeps its id and links."""
    features, source_ids = [], set()
    for local, segment in _polylines(scenario):
        kind = RoadKind(int(scenario.segment_kind[segment]))
        row, lane = int(scenario.segment_feature[segment]), int(scenario.segment_lane[segment])
        source_id = int(scenario.lane_id[lane] if lane >= 0 else scenario.feature_id[row] if row >= 0 else -1)
        is_first = source_id >= 0 and source_id not in source_ids
        source_ids.add(source_id)
        points = local + scenario.origin
        if kind in POLYGON_KINDS and np.array_equal(points[0], points[-1]):
            points = points[:-1]
        links = _links(scenario, lane) if is_first and kind in LANE_KINDS and lane >= 0 else {}
        features.append(MapFeature(source_id if is_first else next(new_ids), kind, points, **links))
    return features


def _links(scenario: Scenario, lane: int) -> dict[str, Any]:
    """Return fields of a lane from the lane graph, in ids of the source."""

    def ids(rows: _Array) -> tuple[int, ...]:
        """Return the source's ids of lanes by index, without missing ones (-1)."""
        return tuple(int(scenario.lane_id[row]) for row in rows if row >= 0)

    # Links that the assembly chained by geometry are not the source's; a new assembly chains them again.
    has_graph = Flag.CHAINED_GRAPH not in scenario.has
    limit, width = float(scenario.lane_limit[lane]), float(scenario.lane_width[lane])
    return {
        "limit_mps": limit if limit > 0 else None,
        "width_m": width if width > 0 else None,
        "successors": ids(scenario.lane_successor[lane]) if has_graph else (),
        "predecessors": ids(scenario.lane_predecessor[lane]) if has_graph else (),
        "left_neighbours": ids(scenario.lane_left[lane : lane + 1]),
        "right_neighbours": ids(scenario.lane_right[lane : lane + 1]),
        "interpolating": bool(scenario.lane_interpolating[lane]),
    }


def _stop_signs(scenario: Scenario, new_ids: Iterator[int]) -> list[MapFeature]:
    """Return stop signs, at the height of the nearest segment."""
    rows = np.flatnonzero(scenario.has_stop)
    points = scenario.segment_a[: int(scenario.segment_blocks[3])].astype(np.float64)
    signs = []
    for row in rows:
        xy = scenario.stop_xy[row].astype(np.float64)
        z = points[np.hypot(*(points[:, :2] - xy).T).argmin(), 2] if len(points) else 0.0
        lanes = tuple(int(scenario.lane_id[lane]) for lane in scenario.stop_lane[row] if lane >= 0)
        point = np.append(xy, z) + scenario.origin
        signs.append(MapFeature(next(new_ids), RoadKind.STOP_SIGN, point[None], lanes=lanes))
    return signs


def _lights(scenario: Scenario, new_ids: Iterator[int]) -> tuple[Light, ...]:
    """Return lights that were observed, at the middle of their stop lines."""
    lights = []
    for row in np.flatnonzero((scenario.light_state >= 0).any(axis=0)):
        line, lane = scenario.light_line[row].astype(np.float64), int(scenario.light_lane[row])
        middle = np.array([*(line[:2] + line[2:]) / 2, scenario.light_z[row]]) + scenario.origin
        states = scenario.light_state[: int(scenario.steps), row].copy()
        lights.append(Light(int(scenario.lane_id[lane]) if lane >= 0 else next(new_ids), middle, states))
    return tuple(lights)
