"""The stored record of a scenario, filled from its parts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from drivax.scenario.build.grid import GridSegments
from drivax.scenario.build.lanes import LaneGraph, lane_of_feature
from drivax.scenario.build.lights import Lights, Stops
from drivax.scenario.build.roads import RoadRows
from drivax.scenario.build.routes import RouteSet
from drivax.scenario.build.segments import RoadLines
from drivax.scenario.build.tracks import EGO_BIT, INTEREST_BIT, PREDICT_BIT, LocalTracks, Placement
from drivax.scenario.recording import Event, Recording, step_seconds
from drivax.scenario.schema import Capacity, Flag, record_dtype

Array = np.ndarray[Any, Any]
Record = np.ndarray[Any, Any]

EVENT_ACTORS = 4
#: Fields in which unused slots and unknown values are -1; they are 0 in all others.
MISSING = (
    "agent_id", "parked_id", "light_lane", "light_state", "stop_lane", "segment_kind", "segment_feature",
    "segment_lane", "feature_id", "feature_kind", "lane_id", "lane_kind", "lane_width", "lane_limit",
    "lane_successor", "lane_predecessor", "lane_left", "lane_right", "lane_light", "route_lane", "route_limit",
    "road_kind", "road_limit", "event_kind", "event_start", "event_end", "event_actor",
)  # fmt: skip


@dataclass(frozen=True)
class Parts:
    """Parts of a scenario in the local frame; ``polylines`` are the rows of ``roads`` that are stored as features."""

    tracks: LocalTracks
    placement: Placement
    extension: Float[Array, "slot point 2"]
    graph: LaneGraph
    routes: RouteSet
    grid: GridSegments
    sides: Int[Array, " cell"]
    roads: RoadLines
    polylines: Int[Array, " polyline"]
    rows: RoadRows
    lights: Lights
    stops: Stops


def fill(
    parts: Parts, recording: Recording, capacity: Capacity, origin: Float[Array, "3"], flags: Flag
) -> Record:
    """Return the record of a scenario: a zero-dimensional structured array of ``record_dtype(capacity)``."""
    record = blank(capacity)
    _fill_head(record, recording, origin, flags)
    _fill_agents(record, parts, recording)
    _fill_lights(record, parts)
    _fill_segments(record, parts, recording)
    _fill_lanes(record, parts)
    _fill_routes(record, parts)
    _fill_rows(record, parts.rows)
    for i, event in enumerate(recording.events[: capacity.events]):
        _fill_event(record, i, event)
    return record


def blank(capacity: Capacity) -> Record:
    """Return a record without valid entries: zeros, and -1 for missing indices and values."""
    record = np.zeros((), record_dtype(capacity))
    for name in MISSING:
        record[name] = -1
    return record


def _put(record: Record, **values: Array) -> None:
    """Write arrays into the beginning of the leading axis of fields."""
    for name, value in values.items():
        record[name][: len(value)] = value


def _fill_head(record: Record, recording: Recording, origin: Float[Array, "3"], flags: Flag) -> None:
    record["scenario_id"] = recording.scenario_id.encode()
    record["dataset"] = recording.dataset.encode()
    record["segment"] = recording.segment.encode()
    # Rounded to a micrometre: the last bits of generated recordings depend on the processor.
    record["origin"] = np.round(origin, 6) + 0.0
    record["dt_s"] = step_seconds(recording.timestamps_s)[0]
    record["current_step"] = recording.current_step
    record["steps"] = len(recording.timestamps_s)
    record["flags"] = int(flags)


def _fill_agents(record: Record, parts: Parts, recording: Recording) -> None:
    tracks, moving, parked = parts.tracks, parts.placement.moving, parts.placement.parked
    steps, count = tracks.valid.shape[1], len(moving)
    seen = tracks.valid if recording.seen is None else tracks.valid & recording.seen
    timed = {
        "agent_xy": tracks.xyz[moving, :, :2],
        "agent_z": tracks.xyz[moving, :, 2],
        "agent_heading": tracks.heading[moving],
        "agent_velocity": tracks.velocity[moving],
        "agent_valid": tracks.valid[moving],
        "agent_seen": seen[moving],
    }
    for name, value in timed.items():
        record[name][:steps, :count] = np.swapaxes(value, 0, 1)
    record["parked_valid"][:steps, : len(parked)] = tracks.valid[parked].T
    record["parked_seen"][:steps, : len(parked)] = seen[parked].T
    flags = np.zeros(len(tracks.kind), dtype=np.uint8)
    flags[tracks.ego] |= EGO_BIT
    flags[list(recording.to_predict)] |= PREDICT_BIT
    flags[list(recording.of_interest)] |= INTEREST_BIT
    pose = parts.placement.pose[parked]
    _put(
        record,
        agent_size=tracks.size[moving],
        agent_kind=tracks.kind[moving],
        agent_id=tracks.track_id[moving],
        agent_flags=flags[moving],
        agent_extension=parts.extension,
        parked_xy=pose[:, :2],
        parked_z=pose[:, 2],
        parked_heading=pose[:, 3],
        parked_size=tracks.size[parked],
        parked_kind=tracks.kind[parked],
        parked_id=tracks.track_id[parked],
    )


def _fill_lights(record: Record, parts: Parts) -> None:
    lights, stops = parts.lights, parts.stops
    steps, count = lights.state.shape[1], len(lights.z)
    record["light_state"][:steps, :count] = lights.state.T
    _put(
        record,
        light_line=lights.line,
        light_z=lights.z,
        light_lane=lights.lane,
        light_heading=lights.heading,
        light_exit_heading=lights.exit_heading,
        stop_xy=stops.xy,
        stop_lane=stops.lane,
    )


def _fill_segments(record: Record, parts: Parts, recording: Recording) -> None:
    grid, roads, kept = parts.grid, parts.roads, parts.polylines
    segments = grid.segments
    row_of = np.full(roads.lines.count + 1, -1)
    row_of[kept] = np.arange(len(kept))
    source_ids = np.array([feature.feature_id for feature in recording.features], dtype=np.int64)
    _put(
        record,
        segment_a=segments.a,
        segment_b=segments.b,
        segment_kind=segments.kind,
        segment_feature=row_of[segments.polyline],
        segment_lane=lane_of_feature(parts.graph, segments.feature),
        segment_start_m=segments.start_m,
        segment_blocks=grid.blocks,
        feature_id=source_ids[roads.feature[kept]],
        feature_kind=roads.kind[kept],
        feature_closed=roads.closed[kept],
        grid_edge=grid.edge_start,
        grid_lane=grid.lane_start,
        grid_side=parts.sides,
        grid_origin=grid.grid.origin,
    )


def _fill_lanes(record: Record, parts: Parts) -> None:
    graph = parts.graph
    light_of, stops_at = np.full(graph.count, -1), np.zeros(graph.count, dtype=bool)
    for i in reversed(np.flatnonzero(parts.lights.lane >= 0)):
        light_of[parts.lights.lane[i]] = i
    stops_at[parts.stops.lane[parts.stops.lane >= 0]] = True
    _put(
        record,
        lane_id=graph.lane_id,
        lane_kind=graph.kind,
        lane_length=graph.lines.length,
        lane_width=graph.width,
        lane_limit=graph.limit,
        lane_interpolating=graph.interpolating,
        lane_successor=graph.successor,
        lane_predecessor=graph.predecessor,
        lane_left=graph.left,
        lane_right=graph.right,
        lane_light=light_of,
        lane_stop=stops_at,
    )


def _fill_routes(record: Record, parts: Parts) -> None:
    limits = np.append(parts.graph.limit, -1.0)
    for k, route in enumerate(parts.routes.routes):
        count = len(route.xyz)
        record["route_xy"][k, :count] = route.xyz[:, :2]
        record["route_z"][k, :count] = route.xyz[:, 2]
        record["route_heading"][k, :count] = route.heading
        record["route_lane"][k, :count] = route.lane
        record["route_limit"][k, :count] = limits[route.lane]
        record["route_points"][k] = count
    record["goal_xy"] = parts.routes.goal
    _put(record, log_progress=parts.routes.progress)


def _fill_rows(record: Record, rows: RoadRows) -> None:
    names = ("xy", "direction", "length", "kind", "limit", "curvature")
    _put(record, **{f"road_{name}": getattr(rows, name) for name in names})
    record["road_rows"] = len(rows.kind)


def _fill_event(record: Record, row: int, event: Event) -> None:
    for name in ("kind", "start", "end"):
        record[f"event_{name}"][row] = getattr(event, name)
    actors = event.actors[:EVENT_ACTORS]
    record["event_actor"][row, : len(actors)] = actors
