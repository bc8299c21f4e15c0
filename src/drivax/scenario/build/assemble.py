"""Assembly of scenarios from recordings: checks, local frame, map index, routes, and the padded record."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from drivax.errors import DataError
from drivax.scenario.build.grid import EDGE_BLOCK, LANE_BLOCK, GridSegments, arrange, cell_sides, ringed_cells
from drivax.scenario.build.lanes import (
    LaneGraph,
    LaneSegments,
    Lights,
    Stops,
    lane_graph,
    lane_of_feature,
    place_lights,
    place_stops,
    select,
)
from drivax.scenario.build.routes import STANDS_M, EgoLog, Intent, Route, RouteSet, RouteStyle, find_routes
from drivax.scenario.build.segments import (
    RoadLines,
    RoadRows,
    cut,
    inside_box,
    path_distance,
    road_lines,
    road_rows,
    thin_path,
)
from drivax.scenario.build.tracks import (
    EGO_BIT,
    INTEREST_BIT,
    PREDICT_BIT,
    LocalTracks,
    Placement,
    extend,
    local_tracks,
    place,
)
from drivax.scenario.recording import Recording, check, differentiate, plausible_steps, step_seconds
from drivax.scenario.schema import (
    CAPACITIES,
    CAR_LANE_KINDS,
    CURRENT_STEP,
    EDGE_KINDS,
    LANE_KINDS,
    LEAST_STEPS,
    LINE_KINDS,
    NAMES,
    AgentKind,
    Capacity,
    Flag,
    RoadKind,
    Scenario,
    SourceCounts,
    among,
    blank,
    stored_name,
)
from drivax.scenario.select.tags import scenario_tags

Array = np.ndarray[Any, Any]
Record = np.ndarray[Any, Any]

#: Margin of the map around the box of the ego's log, and largest total length of its lines (readers crop a city's map).
MARGIN_M, MAP_M = 100.0, 500_000.0
#: Largest deviation from the median step without ``JITTERED_TIME``, and largest range of heights without ``ELEVATION``.
JITTER_S, FLAT_M = 0.002, 0.01
#: Flags that assembly alone decides; those of the reader are ignored. ``LIGHTS`` is not among them: a source may know
#: that there are no lights.
MEASURED = (
    Flag.LANE_GRAPH | Flag.DEFAULT_LIMITS | Flag.SPEED_LIMITS | Flag.CHAINED_GRAPH
    | Flag.CLOSED_EDGES | Flag.OVERFLOW | Flag.ROUTE | Flag.ELEVATION
)  # fmt: skip
#: Actors that a record stores per event.
EVENT_ACTORS = 4
#: Lanes whose class has a limit (``scenario.bank.scenario_bank.CLASS_LIMIT_MPS``).
_LIMITED_KINDS = (RoadKind.LANE_FREEWAY, RoadKind.LANE_SURFACE)
_FEATURE_GROUPS = {
    "lane": LANE_KINDS, "road_line": LINE_KINDS, "road_edge": EDGE_KINDS, "crosswalk": (RoadKind.CROSSWALK,),
    "speed_bump": (RoadKind.SPEED_BUMP,), "stop_sign": (RoadKind.STOP_SIGN,), "driveway": (RoadKind.DRIVEWAY,),
}  # fmt: skip
#: Logs of further egos end where they leave the box of the recorded ego's log, widened by this; the stored map reaches
#: 20 m further.
_KNOWN_M = 80.0


@dataclass(frozen=True)
class Parts:
    """Parts of a scenario in the local frame; ``polylines`` are the rows of ``roads`` that are stored as features."""

    tracks: LocalTracks
    placement: Placement
    extension: Float[Array, "slot point 2"]
    graph: LaneGraph
    routes: RouteSet
    egos: list[FurtherEgo]
    grid: GridSegments
    sides: Int[Array, " cell"]
    ringed: bool
    roads: RoadLines
    polylines: Int[Array, " polyline"]
    rows: RoadRows
    lights: Lights
    stops: Stops


def count_source(recording: Recording) -> SourceCounts:
    """Count the steps, tracks, map features and lights (one per lane) of the source, before cropping and capping."""
    kinds = np.array([feature.kind for feature in recording.features], dtype=np.int64)
    tracks = recording.tracks
    return SourceCounts(
        steps=len(recording.timestamps_s),
        tracks=len(tracks.track_id),
        tracks_valid_now=int(tracks.valid[:, recording.current_step].sum()),
        map_features={name: int(among(kinds, group).sum()) for name, group in _FEATURE_GROUPS.items()},
        map_points=sum(len(feature.points) for feature in recording.features),
        lights=len({light.lane_id for light in recording.lights}),
    )


def assemble(
    recording: Recording, capacity: Capacity = CAPACITIES["default"], routes: RouteStyle = "graph"
) -> Scenario:
    """Assemble a scenario from a recording of at most ``capacity.steps`` steps (cut longer ones with ``windows``).

    Items that do not fit the capacity, mostly the farthest from the ego's log, are dropped and counted in ``overflow``;
    further routes and egos are not counted. ``routes`` is the source of candidate routes (``scenario.build.routes``).

    Raises:
        DataError: The recording is invalid, or road edges near the ego's log do not fit the capacity.
    """
    check(recording, capacity)
    try:
        return _assemble(recording, capacity, routes)
    except DataError as error:
        raise DataError(error.problem, record=recording.scenario_id, cure=error.cure) from error


def _assemble(recording: Recording, capacity: Capacity, style: RouteStyle) -> Scenario:
    recording = _drop_jumps(recording)
    now, ego = recording.current_step, recording.ego
    origin = np.append(recording.tracks.xy[ego, now], recording.tracks.z[ego, now]).astype(np.float64)
    tracks = local_tracks(recording.tracks, ego, origin)
    log = ego_log(tracks, now)
    path = thin_path(log.positions[:, :2])
    roads = road_lines(recording.features, origin, recording.split_gap_m)
    _check_map_length(roads)
    segments = cut(roads)
    full_graph = lane_graph(recording.features, origin)
    lane_segments = LaneSegments.of(segments, full_graph)
    intent, missing_lanes = _intent(recording, full_graph)
    preferred = (*recording.to_predict, *recording.of_interest)
    placement = place(tracks, preferred, capacity.agents, capacity.parked)
    sizes = {"most_routes": capacity.routes, "most_points": capacity.route_points}
    find = partial(find_routes, lane_segments, style=style, **sizes)
    routes, egos = find(log, intent), _further_egos(tracks, placement.moving, log, capacity.egos - 1, find)
    on_route = _lanes_of([*routes.routes, *(ego.routes.routes[0] for ego in egos)])
    in_crop = inside_box(segments.middle, path, MARGIN_M)
    in_crop |= np.isin(segments.feature, full_graph.feature[on_route])
    grid = arrange(segments.take(in_crop), path, MARGIN_M, capacity)
    keep, lost_lanes = _select_lanes(full_graph, segments.feature[in_crop], on_route, path, capacity.lanes)
    graph = select(full_graph, keep)
    polylines, lost_features = _select_polylines(roads, grid, path, capacity.features)
    edges, lanes = (segments.take(segments.block == block) for block in (EDGE_BLOCK, LANE_BLOCK))
    closed = roads.closed[edges.polyline]
    ringed = ringed_cells(grid.grid, edges, closed, path, MARGIN_M)
    stored_lanes = LaneSegments.of(segments, graph)
    parts = Parts(
        tracks=tracks,
        placement=placement,
        extension=extend(tracks, placement.moving, lane_segments, capacity.extension),
        graph=graph,
        routes=_renumber(routes, keep, full_graph.count),
        egos=[replace(ego, routes=_renumber(ego.routes, keep, full_graph.count)) for ego in egos],
        grid=grid,
        sides=cell_sides(grid.grid, edges, lanes.middle, closed, ringed),
        ringed=bool(ringed.any()),
        roads=roads,
        polylines=polylines,
        rows=road_rows(roads, recording.features, path, MARGIN_M, capacity.road_rows),
        lights=place_lights(recording.lights, stored_lanes, origin, path, MARGIN_M, capacity.lights),
        stops=place_stops(recording.features, graph, origin, path, MARGIN_M, capacity.stops),
    )
    lost = Counter({name: int(count) for name, count in recording.lost.items()})
    lost += Counter({**full_graph.lost, **missing_lanes})
    overflow = _overflow(parts, recording, capacity, {"lanes": lost_lanes, "features": lost_features})
    flags = _flags(recording, parts)
    flags |= Flag.OVERFLOW if overflow else Flag.NONE
    return Scenario(
        record=fill(parts, recording, capacity, origin, flags),
        capacity=capacity,
        source=replace(count_source(recording), lost=dict(lost)),
        overflow=overflow,
        tags=scenario_tags(recording, tracks, graph, parts.routes, parts.lights, flags, style),
        names={name: getattr(recording, name) for name in NAMES},
    )


def _further_egos(
    tracks: LocalTracks, moving: Int[Array, " slot"], log: EgoLog, most: int,
    find: Callable[[EgoLog, Intent], RouteSet],
) -> list[FurtherEgo]:  # fmt: skip
    """Return up to ``most`` egos in addition to the recorded one, with routes from ``find`` without intended lanes."""
    return [
        FurtherEgo(slot, last, find(ego_log(tracks, log.current, int(moving[slot]), last), Intent()))
        for slot, last in _select_egos(tracks, moving, log, most)
    ]


@dataclass(frozen=True)
class FurtherEgo:
    """A further ego: its slot, the last step of its unbroken log, and its routes, of which the first is stored."""

    slot: int
    last: int
    routes: RouteSet


def _select_egos(
    tracks: LocalTracks, moving: Int[Array, " slot"], log: EgoLog, most: int
) -> list[tuple[int, int]]:
    """Return slot and last step of up to ``most`` vehicles, the nearest to the recorded ego first.

    From the current step on, their log lasts 2 s or more and leads more than 2 m away. It ends at the first gap, or
    where it leaves the box of ``_KNOWN_M``. ``moving`` holds the track of every slot, ``log`` is the recorded ego's.
    """
    if most < 1:
        return []
    now, path = log.current, log.positions[:, :2]
    xy, valid = tracks.xyz[moving, now:, :2], tracks.valid[moving, now:]
    low, high = path.min(axis=0) - _KNOWN_M, path.max(axis=0) + _KNOWN_M
    unbroken = np.logical_and.accumulate(valid & ((xy >= low) & (xy <= high)).all(axis=2), axis=1)
    steps = unbroken.sum(axis=1)
    travel = np.where(unbroken, np.hypot(*np.moveaxis(xy - xy[:, :1], -1, 0)), 0.0).max(axis=1)
    eligible = (steps >= LEAST_STEPS - CURRENT_STEP) & (travel > STANDS_M)
    eligible &= (tracks.kind[moving] == AgentKind.VEHICLE) & (moving != tracks.ego)
    slots = np.flatnonzero(eligible)
    distance = np.hypot(*(xy[slots, 0] - log.xyz[now, :2]).T)
    chosen = slots[np.argsort(distance, kind="stable")[:most]]
    return [(int(slot), now + int(steps[slot]) - 1) for slot in chosen]


def _lanes_of(routes: Sequence[Route]) -> Int[Array, " route_lane"]:
    """Dense indices of the lanes of routes."""
    lanes = np.unique(np.concatenate([route.lane for route in routes]))
    return lanes[lanes >= 0]


def _drop_jumps(recording: Recording) -> Recording:
    """Drop steps of tracks that are not plausible, and count the tracks that lose some."""
    tracks = recording.tracks
    valid = plausible_steps(recording)
    has_jump = (valid != tracks.valid).any(axis=1)
    if not has_jump.any():
        return recording
    velocity = tracks.velocity.copy()
    if Flag.DIFFERENTIATED_VELOCITY in recording.flags:
        # Velocities next to a jump were computed from it.
        velocity[has_jump] = differentiate(tracks.xy[has_jump], valid[has_jump], recording.timestamps_s)
    lost = {**recording.lost, "jumping_tracks": int(has_jump.sum())}
    return replace(recording, tracks=replace(tracks, valid=valid, velocity=velocity), lost=lost)


def _intent(recording: Recording, graph: LaneGraph) -> tuple[Intent, dict[str, int]]:
    """Intended route in dense indices, and the numbers of its lanes that the map lacks."""
    index, sources = graph.index(), (recording.route_lanes, recording.route_corridor)
    dense = [tuple(index[lane] for lane in lanes if lane in index) for lanes in sources]
    counts = [len(lanes) - len(indices) for lanes, indices in zip(sources, dense, strict=True)]
    return Intent(*dense), {"route_lanes_missing": counts[0], "route_corridor_missing": counts[1]}


def _check_map_length(roads: RoadLines) -> None:
    """Raise a DataError if the lines of the map are implausibly long together."""
    length = float(roads.lines.length.sum())
    if length > MAP_M:
        problem = f"the map's lines are {length / 1000:.0f} km long together, more than {MAP_M / 1000:.0f} km"
        raise DataError(problem, cure="crop the map in the reader, or repair the points that jump")


def ego_log(
    tracks: LocalTracks, current_step: int, row: int | None = None, last: int | None = None
) -> EgoLog:
    """Return the log of the ego, or of another track, up to step ``last``."""
    row = tracks.ego if row is None else row
    speed, valid = np.hypot(*tracks.velocity[row].T), tracks.valid[row].copy()
    if last is not None:
        valid[last + 1 :] = False
    return EgoLog(tracks.xyz[row], tracks.heading[row], speed, valid, current_step)


def _select_lanes(
    graph: LaneGraph,
    feature: Int[Array, " segment"],
    on_route: Int[Array, " route_lane"],
    path: Float[Array, "step 2"],
    most: int,
) -> tuple[Int[Array, " lane"], int]:
    """Return the lanes to store, in order of the source, and the number that did not fit.

    These are the lanes with a segment in the crop, whose features ``feature`` holds. Lanes of routes come first, then
    those for cars, then others, the nearest to ``path`` first.
    """
    lanes = np.flatnonzero(np.isin(graph.feature, feature))
    distance = np.full(graph.count, np.inf)
    np.minimum.at(distance, graph.lines.row, path_distance(graph.lines.points[:, :2], path))
    not_for_cars, off_route = ~among(graph.kind, CAR_LANE_KINDS), ~np.isin(np.arange(graph.count), on_route)
    order = lanes[np.lexsort((distance[lanes], not_for_cars[lanes], off_route[lanes]))]
    return np.sort(order[:most]), max(len(lanes) - most, 0)


def _select_polylines(
    roads: RoadLines, grid: GridSegments, path: Float[Array, "step 2"], most: int
) -> tuple[Int[Array, " polyline"], int]:
    """Return the nearest polylines with a stored segment, and the number that did not fit."""
    polylines = np.unique(grid.segments.polyline)
    distance = np.full(roads.lines.count, np.inf)
    np.minimum.at(distance, grid.segments.polyline, path_distance(grid.segments.middle, path))
    nearest = polylines[np.argsort(distance[polylines], kind="stable")[:most]]
    return np.sort(nearest), max(len(polylines) - most, 0)


def _renumber(routes: RouteSet, keep: Int[Array, " lane"], count: int) -> RouteSet:
    """Return routes in the dense indices of the stored lanes ``keep``, -1 for the others of ``count`` lanes."""
    new_index = np.full(count + 1, -1)  # the last entry is that of -1
    new_index[keep] = np.arange(len(keep))
    return replace(
        routes, routes=tuple(replace(route, lane=new_index[route.lane]) for route in routes.routes)
    )


def _overflow(parts: Parts, recording: Recording, capacity: Capacity, lost: dict[str, int]) -> dict[str, int]:
    """Positive numbers of items that did not fit, by name; ``lost`` has those of lanes and features."""
    counts = parts.placement.overflow | lost
    for part in (parts.grid, parts.lights, parts.stops, parts.rows):
        counts |= part.overflow
    counts["lane_links"] = parts.graph.dropped_links
    counts["events"] = len(recording.events) - capacity.events
    events = recording.events[: capacity.events]
    counts["event_actors"] = sum(max(len(event.actors) - EVENT_ACTORS, 0) for event in events)
    return dict(+Counter(counts))  # drops zero and negative numbers


def _flags(recording: Recording, parts: Parts) -> Flag:
    """Flags of the reader, except those of ``MEASURED``, and the flags that the parts justify."""
    slots, segments = parts.placement, parts.grid.segments
    heights = np.concatenate((segments.a[:, 2], segments.b[:, 2]))
    facts = (
        (Flag.LIGHTS, len(parts.lights.z) > 0),
        (Flag.NO_FUTURE, len(recording.timestamps_s) < LEAST_STEPS),
        (Flag.DEFAULT_SIZES, parts.tracks.has_default_size[np.append(slots.moving, slots.parked)].any()),
        (Flag.CLOSED_EDGES, parts.ringed),
        (Flag.JITTERED_TIME, step_seconds(recording.timestamps_s)[1] > JITTER_S),
        (Flag.ROUTE, parts.routes.on_lanes),
        (Flag.DEFAULT_LIMITS, ((parts.graph.limit <= 0) & among(parts.graph.kind, _LIMITED_KINDS)).any()),
        (Flag.ELEVATION, len(heights) > 0 and np.ptp(heights) > FLAT_M),
    )
    flags = (recording.flags & ~MEASURED) | parts.graph.flags
    for flag, holds in facts:
        flags |= flag if holds else Flag.NONE
    return flags


def fill(
    parts: Parts, recording: Recording, capacity: Capacity, origin: Float[Array, "3"], flags: Flag
) -> Record:
    """Return the record of a scenario: a zero-dimensional structured array of ``record_dtype(capacity)``."""
    record = blank(capacity)
    for name in NAMES:
        record[name] = stored_name(getattr(recording, name), record.dtype[name].itemsize)
    # Rounded to a micrometre: the last bits of generated recordings depend on the processor. Adding 0 turns -0 into 0.
    record["origin"] = np.round(origin, 6) + 0.0
    record["dt_s"] = step_seconds(recording.timestamps_s)[0]
    record["current_step"] = recording.current_step
    record["steps"] = len(recording.timestamps_s)
    record["flags"] = int(flags)
    _fill_agents(record, parts, recording)
    _fill_map(record, parts, recording)
    _fill_lanes(record, parts)
    _fill_routes(record, parts)
    for i, event in enumerate(recording.events[: capacity.events]):
        for name in ("kind", "start", "end"):
            record[f"event_{name}"][i] = getattr(event, name)
        actors = event.actors[:EVENT_ACTORS]
        record["event_actor"][i, : len(actors)] = actors
    return record


def _put(record: Record, **values: Array) -> None:
    """Write arrays into fields, from index 0 of their first axis on."""
    for name, value in values.items():
        record[name][: len(value)] = value


def _copy(record: Record, prefix: str, part: Any, *names: str) -> None:
    """Write the named arrays of a part into the fields ``prefix_name``."""
    _put(record, **{f"{prefix}_{name}": getattr(part, name) for name in names})


def _fill_agents(record: Record, parts: Parts, recording: Recording) -> None:
    tracks, moving, parked = parts.tracks, parts.placement.moving, parts.placement.parked
    seen = tracks.valid if recording.seen is None else tracks.valid & recording.seen
    series = {
        "xy": tracks.xyz[moving, :, :2],
        "z": tracks.xyz[moving, :, 2],
        "heading": tracks.heading[moving],
        "velocity": tracks.velocity[moving],
    }
    steps = tracks.valid.shape[1]
    for name, value in series.items():
        record[f"agent_{name}"][:steps, : len(moving)] = np.swapaxes(value, 0, 1)
    for block, rows in (("agent", moving), ("parked", parked)):
        record[f"{block}_valid"][:steps, : len(rows)] = tracks.valid[rows].T
        record[f"{block}_seen"][:steps, : len(rows)] = seen[rows].T
        values = {"size": tracks.size[rows], "kind": tracks.kind[rows], "id": tracks.track_id[rows]}
        _put(record, **{f"{block}_{name}": value for name, value in values.items()})
    flags = np.zeros(len(tracks.kind), dtype=np.uint8)
    flags[tracks.ego] |= EGO_BIT
    flags[list(recording.to_predict)] |= PREDICT_BIT
    flags[list(recording.of_interest)] |= INTEREST_BIT
    pose = parts.placement.pose[parked]
    _put(record, agent_flags=flags[moving], agent_extension=parts.extension)
    _put(record, parked_xy=pose[:, :2], parked_z=pose[:, 2], parked_heading=pose[:, 3])


def _fill_map(record: Record, parts: Parts, recording: Recording) -> None:
    grid, roads, polylines, lights = parts.grid, parts.roads, parts.polylines, parts.lights
    # Features that are not stored have row -1.
    row_of = np.full(roads.lines.count + 1, -1)
    row_of[polylines] = np.arange(len(polylines))
    source_ids = np.array([feature.feature_id for feature in recording.features], dtype=np.int64)
    _copy(record, "segment", grid.segments, "a", "b", "kind", "start_m")
    _put(
        record,
        segment_feature=row_of[grid.segments.polyline],
        segment_lane=lane_of_feature(parts.graph, grid.segments.feature),
        segment_blocks=grid.blocks,
        feature_id=source_ids[roads.feature[polylines]],
        feature_kind=roads.kind[polylines],
        feature_closed=roads.closed[polylines],
        grid_edge=grid.edge_start,
        grid_lane=grid.lane_start,
        grid_side=parts.sides,
        grid_origin=grid.grid.origin,
    )
    steps, count = lights.state.shape[1], len(lights.z)
    record["light_state"][:steps, :count] = lights.state.T
    _copy(record, "light", lights, "line", "z", "lane", "heading", "exit_heading")
    _copy(record, "stop", parts.stops, "xy", "lane")
    _copy(record, "road", parts.rows, "xy", "direction", "length", "kind", "limit", "curvature")
    record["road_rows"] = len(parts.rows.kind)


def _fill_lanes(record: Record, parts: Parts) -> None:
    graph = parts.graph
    light, has_stop = np.full(graph.count, -1), np.zeros(graph.count, dtype=bool)
    # Of several lights of a lane the first, which is nearest to the log, is written last.
    for i in reversed(np.flatnonzero(parts.lights.lane >= 0)):
        light[parts.lights.lane[i]] = i
    has_stop[parts.stops.lane[parts.stops.lane >= 0]] = True
    _copy(record, "lane", graph, "kind", "width", "limit", "interpolating")
    _copy(record, "lane", graph, "successor", "predecessor", "left", "right")
    _put(record, lane_id=graph.lane_id, lane_length=graph.lines.length, lane_light=light, lane_stop=has_stop)


def _fill_routes(record: Record, parts: Parts) -> None:
    for k, route in enumerate(parts.routes.routes):
        _put_route(record, "route", k, route, parts.graph)
    record["goal_xy"] = parts.routes.goal
    _put(record, log_progress=parts.routes.progress)
    for k, ego in enumerate(parts.egos):
        _put_route(record, "ego_route", k, ego.routes.routes[0], parts.graph)
        record["ego_slot"][k], record["ego_last_step"][k] = ego.slot, ego.last
        record["ego_on_lanes"][k], record["ego_goal_xy"][k] = ego.routes.on_lanes, ego.routes.goal
        record["ego_log_progress"][k, : len(ego.routes.progress)] = ego.routes.progress


def _put_route(record: Record, prefix: str, row: int, route: Route, graph: LaneGraph) -> None:
    """Write a route into row ``row`` of the fields ``prefix_name``."""
    limits, count = np.append(graph.limit, -1.0), len(route.xyz)  # the last limit is that of -1, no lane
    values = {"xy": route.xyz[:, :2], "z": route.xyz[:, 2], "heading": route.heading, "lane": route.lane}
    for name, value in (values | {"limit": limits[route.lane]}).items():
        record[f"{prefix}_{name}"][row, :count] = value
    record[f"{prefix}_points"][row] = count
