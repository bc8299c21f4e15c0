"""Assembly of scenarios from recordings: checks, local frame, padding, map index and routes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from drivax.errors import DataError
from drivax.scenario.build.filling import EVENT_ACTORS, Parts, fill
from drivax.scenario.build.grid import GridSegments, arrange, cell_sides
from drivax.scenario.build.lanes import LaneGraph, LaneSegments, lane_graph, select
from drivax.scenario.build.lights import place_lights, place_stops
from drivax.scenario.build.roads import road_rows
from drivax.scenario.build.routes import EgoLog, Intent, RouteSet, RouteStyle, find_routes
from drivax.scenario.build.segments import RoadLines, cut, inside_box, path_distance, road_lines, thin_path
from drivax.scenario.build.tracks import LocalTracks, extend, local_tracks, place
from drivax.scenario.recording import Recording, check, step_seconds
from drivax.scenario.schema import (
    CAPACITIES,
    CAR_LANE_KINDS,
    EDGE_KINDS,
    LANE_KINDS,
    LINE_KINDS,
    Capacity,
    Flag,
    RoadKind,
    Scenario,
    SourceCounts,
    among,
)
from drivax.scenario.select.tags import scenario_tags

Array = np.ndarray[Any, Any]

#: Margin of the map around the box of the ego's log.
MARGIN_M = 100.0
#: Largest total length of map lines; readers crop the map of a city.
MAP_M = 500_000.0
#: Largest deviation from the median step without ``JITTERED_TIME``.
JITTER_S = 0.002
#: Smallest range of heights that counts as elevation.
FLAT_M = 0.01
#: Flags that are measured here and override those of the reader. ``LIGHTS`` is not among them: a source may know that
#: there are no lights.
MEASURED = (
    Flag.LANE_GRAPH
    | Flag.DEFAULT_LIMITS
    | Flag.SPEED_LIMITS
    | Flag.CHAINED_GRAPH
    | Flag.CLOSED_EDGES
    | Flag.OVERFLOW
    | Flag.ROUTE
    | Flag.ELEVATION
)
#: Lanes whose class has a limit (``scenario.bank.scenario_bank.CLASS_LIMIT_MPS``).
_LIMITED_KINDS = (RoadKind.LANE_FREEWAY, RoadKind.LANE_SURFACE)
_COUNTED = {
    "lane": LANE_KINDS,
    "road_line": LINE_KINDS,
    "road_edge": EDGE_KINDS,
    "crosswalk": (RoadKind.CROSSWALK,),
    "speed_bump": (RoadKind.SPEED_BUMP,),
    "stop_sign": (RoadKind.STOP_SIGN,),
    "driveway": (RoadKind.DRIVEWAY,),
}


def count_source(recording: Recording) -> SourceCounts:
    """Count the features and points of the source, before cropping and capping."""
    kinds = np.array([feature.kind for feature in recording.features], dtype=np.int64)
    tracks = recording.tracks
    return SourceCounts(
        steps=len(recording.timestamps_s),
        tracks=len(tracks.track_id),
        tracks_valid_now=int(tracks.valid[:, recording.current_step].sum()),
        map_features={name: int(among(kinds, group).sum()) for name, group in _COUNTED.items()},
        map_points=sum(len(feature.points) for feature in recording.features),
        lights=len({light.lane_id for light in recording.lights}),
    )


def assemble(
    recording: Recording, capacity: Capacity = CAPACITIES["default"], routes: RouteStyle = "graph"
) -> Scenario:
    """Assemble a scenario from a recording.

    Args:
        recording: At most ``capacity.steps`` steps; cut longer recordings with ``windows``.
        capacity: Padded sizes; the farthest items from the ego's log that do not fit are counted in ``overflow``.
        routes: Source of candidate routes (``scenario.build.routes``).

    Raises:
        DataError: The recording is invalid.
    """
    check(recording, capacity)
    try:
        return _assemble(recording, capacity, routes)
    except DataError as error:
        raise DataError(error.problem, record=recording.scenario_id, cure=error.cure) from error


def _assemble(recording: Recording, capacity: Capacity, style: RouteStyle) -> Scenario:
    now, ego = recording.current_step, recording.ego
    origin = np.append(recording.tracks.xy[ego, now], recording.tracks.z[ego, now]).astype(np.float64)
    tracks = local_tracks(recording.tracks, ego, origin)
    log = ego_log(tracks, now)
    path = thin_path(log.seen[:, :2])
    roads = road_lines(recording.features, origin, recording.split_gap_m)
    _refuse_endless(roads)
    segments = cut(roads)
    whole = lane_graph(recording.features, origin)
    on = LaneSegments.of(segments, whole)
    intent, unknown = _intent(recording, whole)
    routes = find_routes(whole, on, log, intent, style, capacity.routes, capacity.route_points)
    marked = (*recording.to_predict, *recording.of_interest)
    placement = place(tracks, marked, capacity.agents, capacity.parked)
    on_route = _lanes_of(routes)
    inside = inside_box(segments.middle, path, MARGIN_M)
    inside |= np.isin(segments.feature, whole.feature[on_route])
    grid = arrange(segments.take(inside), path, capacity)
    keep, lost_lanes = _kept_lanes(whole, segments.feature[inside], on_route, path, capacity.lanes)
    graph = select(whole, keep)
    polylines, lost_features = _kept_polylines(roads, grid, path, capacity.features)
    is_lane = among(segments.kind, CAR_LANE_KINDS)
    is_edge, is_ring = among(segments.kind, EDGE_KINDS), roads.closed[among(roads.kind, EDGE_KINDS)]
    rings = len(is_ring) > 0 and bool(is_ring.all())
    stored_on = LaneSegments.of(segments, graph)
    parts = Parts(
        tracks=tracks,
        placement=placement,
        extension=extend(tracks, placement.moving, whole, on, capacity.extension),
        graph=graph,
        routes=_renumber(routes, keep, whole.count),
        grid=grid,
        sides=cell_sides(grid.grid, segments.take(is_edge), segments.take(is_lane).middle, rings),
        roads=roads,
        polylines=polylines,
        rows=road_rows(roads, recording.features, path, MARGIN_M, capacity.road_rows),
        lights=place_lights(recording.lights, graph, stored_on, origin, path, capacity.lights),
        stops=place_stops(recording.features, graph, origin, path, capacity.stops),
    )
    overflow = _overflow(parts, recording, capacity, {"lanes": lost_lanes, "features": lost_features})
    flags = _flags(recording, parts, rings, capacity)
    flags |= Flag.OVERFLOW if overflow else Flag.NONE
    return Scenario(
        record=fill(parts, recording, capacity, origin, flags),
        capacity=capacity,
        source=replace(count_source(recording), lost=_lost(recording, {**whole.lost, **unknown})),
        overflow=overflow,
        tags=scenario_tags(recording, parts, flags, style),
    )


def _intent(recording: Recording, graph: LaneGraph) -> tuple[Intent, dict[str, int]]:
    """Intended route in dense indices, and the numbers of its missing lanes."""
    index = graph.index()
    source = {"route_lanes": recording.route_lanes, "route_corridor": recording.route_corridor}
    known = {name: tuple(index[lane] for lane in lanes if lane in index) for name, lanes in source.items()}
    missing = {f"{name}_missing": len(source[name]) - len(known[name]) for name in source}
    return Intent(known["route_lanes"], known["route_corridor"]), missing


def _lost(recording: Recording, lost: Mapping[str, int]) -> dict[str, int]:
    """Nonzero numbers of items that the reader and the assembly left out, by name."""
    names = dict.fromkeys((*recording.lost, *lost))
    counts = {name: int(recording.lost.get(name, 0)) + lost.get(name, 0) for name in names}
    return {name: count for name, count in counts.items() if count}


def _refuse_endless(roads: RoadLines) -> None:
    """Refuse maps that are too long for one place."""
    length = float(roads.lines.length.sum())
    if length > MAP_M:
        problem = f"the map's lines are {length / 1000:.0f} km long together, more than {MAP_M / 1000:.0f} km"
        raise DataError(problem, cure="crop the map in the reader, or repair the points that jump")


def ego_log(tracks: LocalTracks, current_step: int) -> EgoLog:
    """Return the log of the ego."""
    row = tracks.ego
    speed = np.hypot(*tracks.velocity[row].T)
    return EgoLog(tracks.xyz[row], tracks.heading[row], speed, tracks.valid[row], current_step)


def _lanes_of(routes: RouteSet) -> Int[Array, " lane"]:
    """Return the dense indices of all lanes under routes."""
    lanes = np.unique(np.concatenate([route.lane for route in routes.routes]))
    return lanes[lanes >= 0]


def _kept_lanes(
    graph: LaneGraph,
    near: Int[Array, " segment"],
    on_route: Int[Array, " routed"],
    path: Float[Array, "step 2"],
    most: int,
) -> tuple[Int[Array, " kept"], int]:
    """Return the lanes to store, in order of the source, and the number that did not fit.

    These are the lanes with a segment in the crop; routes come first, bike lanes and distant lanes last.
    """
    rows = np.flatnonzero(np.isin(graph.feature, near))
    far = np.full(graph.count, np.inf)
    np.minimum.at(far, graph.lines.row, path_distance(graph.lines.points[:, :2], path))
    last = ~among(graph.kind, CAR_LANE_KINDS)
    first = np.zeros(graph.count, dtype=bool)
    first[on_route] = True
    order = rows[np.lexsort((far[rows], last[rows], ~first[rows]))]
    return np.sort(order[:most]), max(len(rows) - most, 0)


def _kept_polylines(
    roads: RoadLines, grid: GridSegments, path: Float[Array, "step 2"], most: int
) -> tuple[Int[Array, " polyline"], int]:
    """Return the nearest polylines with a stored segment, and the number that did not fit."""
    rows = np.unique(grid.segments.polyline)
    far = np.full(roads.lines.count, np.inf)
    np.minimum.at(far, grid.segments.polyline, path_distance(grid.segments.middle, path))
    return np.sort(rows[np.argsort(far[rows], kind="stable")[:most]]), max(len(rows) - most, 0)


def _renumber(routes: RouteSet, keep: Int[Array, " lane"], count: int) -> RouteSet:
    """Return routes in the dense indices of the stored lanes."""
    new = np.full(count + 1, -1)
    new[keep] = np.arange(len(keep))
    return replace(routes, routes=tuple(replace(r, lane=new[r.lane]) for r in routes.routes))


def _overflow(parts: Parts, recording: Recording, capacity: Capacity, lost: dict[str, int]) -> dict[str, int]:
    """Nonzero numbers of items that did not fit, by name."""
    actors = sum(max(len(event.actors) - EVENT_ACTORS, 0) for event in recording.events)
    counts = {
        **parts.placement.overflow,
        **lost,
        **parts.grid.overflow,
        **parts.lights.overflow,
        **parts.stops.overflow,
        **parts.rows.overflow,
        "lane_links": parts.graph.dropped_links,
        "events": max(len(recording.events) - capacity.events, 0),
        "event_actors": actors,
    }
    return {name: count for name, count in counts.items() if count}


def _flags(recording: Recording, parts: Parts, rings: bool, capacity: Capacity) -> Flag:
    """Flags of the reader, with those that are measured here."""
    heights = parts.roads.lines.points[:, 2]
    facts: Sequence[tuple[Flag, Any]] = (
        (Flag.LIGHTS, len(parts.lights.z) > 0),
        (Flag.NO_FUTURE, len(recording.timestamps_s) < capacity.steps),
        (Flag.DEFAULT_SIZES, parts.tracks.defaulted > 0),
        (Flag.CLOSED_EDGES, rings),
        (Flag.JITTERED_TIME, step_seconds(recording.timestamps_s)[1] > JITTER_S),
        (Flag.ROUTE, parts.routes.on_lanes),
        (Flag.DEFAULT_LIMITS, ((parts.graph.limit <= 0) & among(parts.graph.kind, _LIMITED_KINDS)).any()),
        (Flag.ELEVATION, len(heights) > 0 and np.ptp(heights) > FLAT_M),
    )
    flags = (recording.flags & ~MEASURED) | parts.graph.flags
    for flag, holds in facts:
        flags |= flag if holds else Flag.NONE
    return flags
