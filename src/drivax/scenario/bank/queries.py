"""Map queries: pure, unbatched functions of a pose.

A query of edges or lanes reads the 3 x 3 grid cells around the pose as three contiguous runs and measures exactly
inside them. Segments beyond its cut-off (edges 3 m from a point, lanes 4 m or half their width, 8 m at the border of
the map) never change its result, so no result depends on the grid; ``tests/scenario/test_queries.py`` compares with
brute force. Segments more than 3 m above or below are ignored. Neither holds for :func:`vertex_distances`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax import kernels
from drivax.geometry.vectors import norm, root
from drivax.kernels import bindings
from drivax.scenario.bank.columns import EdgeRow, LaneRow, LightRow, RouteColumn, StrandColumn
from drivax.scenario.bank.scenario_bank import Integer, Scalar, ScenarioBank, Vector
from drivax.scenario.bank.smallest import first_smallest
from drivax.scenario.build.grid import NOT_DRIVABLE, SPLIT
from drivax.scenario.record import record

EDGE_CUTOFF_M = 3.0
LANE_CUTOFF_M = 4.0
LEVEL_M = 3.0
#: Distance beyond an edge from which a corner counts as off the road (metric ``offroad``).
OFFROAD_TOLERANCE_M = 0.3
#: Tolerance of lane borders (metric ``lane_straddle``).
LANE_MARGIN_M = 0.2
#: Largest distance to the nearest lane, m, at which its straight continuation decides whether the road goes on beyond
#: the box of the map; the grid finds every segment up to there.
_GOES_ON_M = 8.0
#: Smallest cosine between the directions of a car and of the lane that it drives (30 deg), and how far a car may be
#: beyond the ends of a segment, m.
_PARALLEL_COS, _JOINT_M = 0.75**0.5, 0.5
#: Parameters of the native kernels.
_LANE_RULES = {
    "cutoff_m": LANE_CUTOFF_M, "level_m": LEVEL_M, "margin_m": LANE_MARGIN_M, "goes_on_m": _GOES_ON_M,
    "joint_m": _JOINT_M, "parallel_cos": _PARALLEL_COS,
}  # fmt: skip
_EDGE_RULES = {"cutoff_m": EDGE_CUTOFF_M, "level_m": LEVEL_M, "split": SPLIT, "not_drivable": NOT_DRIVABLE}
#: Largest distance to the centre of a followed lane, m.
_FOLLOWED_M = 2.5
#: A car changes lanes this far beyond the line between two lanes; centres of parallel lanes are at least the second
#: distance apart (nearer lanes fork or join); a lane is left in a merge up to the third distance before its end, m.
BEYOND_M, SIDE_BY_SIDE_M, MERGE_M = 0.3, 2.0, 100.0
_FAR = 1e9
#: Points in the window of a projection on a route, and those behind the last known arc length.
_WINDOW, _WINDOW_BEHIND = 40, 6
#: Largest distance ahead of that arc length at which a projection lies in the window, m.
_WINDOW_AHEAD_M = 33.0


def left_of_edges(
    bank: ScenarioBank, index: Integer, centre: Vector, points: Float[Array, "P 2"], z: Scalar
) -> tuple[Float[Array, " P"], Bool[Array, " P"]]:
    """Signed distance of points to the nearest edge, m (left, the drivable side, positive), and whether it is known.

    It is known if an edge of this level lies within the cut-off. At a vertex two segments are equally near; the segment
    whose line is further away decides. Points must lie within 5 m of ``centre``, whose cells are read.
    """
    rows, inside = edges_around(bank, index, centre)
    return left_of_segments(rows, inside & is_level(rows[EdgeRow.Z], z), points)


def left_of_segments(
    rows: Float[Array, "5 K"], counts: Bool[Array, " K"], points: Float[Array, "P 2"]
) -> tuple[Float[Array, " P"], Bool[Array, " P"]]:
    """Return the values of :func:`left_of_edges` for those of the edges ``rows`` that the mask ``counts`` selects."""
    squared, side = to_segments(rows, points)
    squared = jnp.where(counts, squared, _FAR)
    nearest = squared.min(axis=1)
    tied = squared <= (nearest + 1e-4 + 1e-4 * nearest)[:, None]
    left = jnp.max(jnp.where(tied, side, -_FAR), axis=1)
    right = jnp.max(jnp.where(tied, -side, -_FAR), axis=1)
    distance = root(nearest)
    return jnp.where(left >= right, distance, -distance), nearest <= EDGE_CUTOFF_M**2


def edges_around(
    bank: ScenarioBank, index: Integer, xy: Vector
) -> tuple[Float[Array, "5 K"], Bool[Array, " K"]]:
    """Road edges (:class:`EdgeRow`) in the 3 x 3 cells around a point, and the mask of valid ones."""
    return _around(bank, bank.grid_edge, bank.edges, bank.edge_run, index, xy)


def lanes_around(
    bank: ScenarioBank, index: Integer, xy: Vector
) -> tuple[Float[Array, "8 K"], Bool[Array, " K"]]:
    """Car lanes (:class:`LaneRow`) in the 3 x 3 cells around a point, and the mask of valid ones."""
    return _around(bank, bank.grid_lane, bank.lanes, bank.lane_run, index, xy)


def _around(
    bank: ScenarioBank, start: Int[Array, "N cells1"], rows: Float[Array, "N F S"], run: int,
    index: Integer, xy: Vector,
) -> tuple[Float[Array, "F K"], Bool[Array, " K"]]:  # fmt: skip
    """Read three contiguous runs of fixed length; a grid of a single cell is read whole."""
    grid = round((start.shape[1] - 1) ** 0.5)
    if grid == 1:
        return rows[index], jnp.arange(rows.shape[2]) < start[index, 1]
    # Clamped so that the 3 x 3 block lies in the grid.
    cell = jnp.floor((xy - bank.grid_origin[index]) / bank.cell_m).astype(jnp.int32)
    cell = jnp.clip(cell, 1, grid - 2)
    blocks, inside = [], []
    for below in (-1, 0, 1):
        first = (cell[1] + below) * grid + cell[0] - 1
        bounds = jax.lax.dynamic_slice(start, (index, first), (1, 4))[0].astype(jnp.int32)
        block = jax.lax.dynamic_slice(rows, (index, jnp.int32(0), bounds[0]), (1, rows.shape[1], run))[0]
        blocks.append(block)
        inside.append(jnp.arange(run) < bounds[3] - bounds[0])
    # Read once: without the barrier XLA repeats the reads in every operation that uses them.
    return jax.lax.optimization_barrier((jnp.concatenate(blocks, axis=1), jnp.concatenate(inside)))


def to_segments(
    rows: Float[Array, "F K"] | Sequence[Float[Array, " K"]], points: Float[Array, "P 2"]
) -> tuple[Float[Array, "P K"], Float[Array, "P K"]]:
    """Squared distance of each point to each segment, and signed distance to its line (positive: left of it)."""
    ax, ay, bx, by = (rows[k] for k in (EdgeRow.X_A, EdgeRow.Y_A, EdgeRow.X_B, EdgeRow.Y_B))
    ux, uy = bx - ax, by - ay
    wx, wy = points[:, 0:1] - ax, points[:, 1:2] - ay
    squared = jnp.maximum(ux * ux + uy * uy, 1e-9)
    along = jnp.clip((wx * ux + wy * uy) / squared, 0.0, 1.0)
    dx, dy = wx - along * ux, wy - along * uy
    return dx * dx + dy * dy, (ux * wy - uy * wx) * jax.lax.rsqrt(squared)


def is_level(height: Float[Array, " K"], z: Scalar) -> Bool[Array, " K"]:
    """Return whether segments are on the level of a height (:data:`LEVEL_M`)."""
    return jnp.abs(height - z) <= LEVEL_M


def _chord(rows: Float[Array, "F K"]) -> tuple[Float[Array, " K"], Float[Array, " K"]]:
    return rows[LaneRow.X_B] - rows[LaneRow.X_A], rows[LaneRow.Y_B] - rows[LaneRow.Y_A]


def _runs_along(rows: Float[Array, "F K"], heading: Vector) -> Bool[Array, " K"]:
    """Return whether segments lead less than 90 degrees away from a heading."""
    ux, uy = _chord(rows)
    return ux * heading[0] + uy * heading[1] > 0.0


@record
class LaneHits:
    """Lanes around a box; values at its centre unless stated otherwise.

    Attributes:
        near, points_near: A lane centre lies within the cut-off; the same for each corner. A corner outside the map's
            box is near, too, if it is within the cut-off of the lane nearest to the centre, continued straight, or if
            no lane is within 8 m of the centre.
        on_corridor: Inside a lane of the corridor of the route.
        wrong_way: Inside a lane against its direction (more than 135 deg), and no lane within 90 deg is nearer.
        straddling: Some corner is outside all lanes in the direction of the ego (within 90 deg).
        leaving_lane: The box drives a lane, but no lane in its direction holds all corners (nuPlan's multiple lanes,
            for fault).
        limit: Speed limit of the lane that is driven, m/s; -1 unknown.
        z: Height of the nearest lane, or of the query without one.
    """

    near: Bool[Array, ""]
    points_near: Bool[Array, " P"]
    on_corridor: Bool[Array, ""]
    wrong_way: Bool[Array, ""]
    straddling: Bool[Array, ""]
    leaving_lane: Bool[Array, ""]
    limit: Scalar
    z: Scalar


def around_lanes(
    bank: ScenarioBank, index: Integer, centre: Vector, heading: Vector,
    points: Float[Array, "P 2"], z: Scalar, routed: bool | Bool[Array, ""] = True, row: Any = 0,
) -> LaneHits:  # fmt: skip
    """Query the lanes around a box given by centre, heading (cosine, sine), corners ``points`` and height.

    Of the lanes that hold the centre and lead at most 30 degrees away from the heading, the box drives that with the
    highest limit, lanes of the corridor of the route ``row`` before others if ``routed``. Without such lanes it
    drives the nearest within 30 degrees, else the nearest within 90 degrees.
    """
    if bindings.supports_grid(_lane_grid(bank), points, centre, heading, z):
        return _native_lanes(bank, index, bindings.Box(centre, heading, points, z), routed, row)
    return _xla_lanes(bank, index, centre, heading, points, z, routed, row)


def _xla_lanes(
    bank: ScenarioBank, index: Integer, centre: Vector, heading: Vector,
    points: Float[Array, "P 2"], z: Scalar, routed: bool | Bool[Array, ""], row: Any,
) -> LaneHits:  # fmt: skip
    rows, inside = lanes_around(bank, index, centre)
    inside = inside & is_level(rows[LaneRow.Z], z)
    box = jnp.concatenate([centre[None], points])
    squared, side = to_segments(rows, box)
    squared = jnp.where(inside, squared, _FAR)
    half = rows[LaneRow.HALF_WIDTH]
    ux, uy = _chord(rows)
    aligned_cos = (ux * heading[0] + uy * heading[1]) * jax.lax.rsqrt(jnp.maximum(ux * ux + uy * uy, 1e-9))
    aligned, against = aligned_cos > 0.0, aligned_cos < -(0.5**0.5)
    centre_m2, corner_m2 = squared[0], squared[1:]
    alongside = centre_m2 - side[0] * side[0] <= _JOINT_M**2
    parallel = alongside & (aligned_cos > _PARALLEL_COS)
    holds_centre = parallel & (centre_m2 <= half * half)
    corridor = in_corridor(bank, rows, row)
    # Lanes that hold the centre rank first, by limit, those on the route before others; then the nearest parallel lane.
    rank = jnp.where(corridor & routed, 0.0, 0.2) + 1e-3 * (100.0 - rows[LaneRow.LIMIT])
    fallback = jnp.where(parallel & (centre_m2 <= LANE_CUTOFF_M**2), 1.0 + centre_m2, 100.0 + centre_m2)
    rank = jnp.where(holds_centre, rank, jnp.where(aligned, fallback, _FAR))
    # Only these two lanes are read again, so that no more values are stored for all lanes.
    numbers = jnp.stack([first_smallest(rank), first_smallest(centre_m2)])
    lanes = rows[:, numbers]
    (driven_lane, nearest_lane), (lane_m2, lane_side) = lanes.T, to_segments(lanes, box)
    is_driven_near, is_near = inside[numbers] & (lane_m2[0] <= LANE_CUTOFF_M**2)
    has_lane = is_driven_near & _runs_along(lanes, heading)[0]
    opposed_m2 = jnp.where(against & (centre_m2 <= half * half), centre_m2, _FAR).min()
    aligned_m2 = jnp.where(aligned, centre_m2, _FAR).min()
    if bank.long_ego:
        points_near, outside = jax.vmap(lambda point: _corner_lanes(bank, index, point, heading, z))(points)
    else:
        # Both flags of each corner by one reduction over one array.
        flags = (corner_m2 <= LANE_CUTOFF_M**2) + 2 * _holds(corner_m2, aligned, half).astype(jnp.int32)
        flags = jax.lax.reduce(flags, jnp.int32(0), jax.lax.bitwise_or, (1,))
        points_near, outside = flags & 1 > 0, flags < 2
    road_goes_on = (
        (jnp.abs(lane_side[1:, 1]) <= LANE_CUTOFF_M) | ~inside[numbers[1]] | (lane_m2[0, 1] > _GOES_ON_M**2)
    )
    outside_m = jnp.where(aligned & alongside, reduce(jnp.maximum, jnp.abs(side[1:])) - half, _FAR).min()
    outside_m = jnp.minimum(outside_m, jnp.abs(lane_side[1:, 0]).max() - driven_lane[LaneRow.HALF_WIDTH])
    return LaneHits(
        near=is_near,
        points_near=points_near | (_outside_box(bank, index, points, 0.0) & road_goes_on),
        on_corridor=(corridor & (centre_m2 <= (half + LANE_MARGIN_M) ** 2)).any(),
        wrong_way=(opposed_m2 < _FAR / 2) & (opposed_m2 < aligned_m2),
        straddling=outside.any(),
        leaving_lane=has_lane & (outside_m > LANE_MARGIN_M),
        limit=jnp.where(has_lane, driven_lane[LaneRow.LIMIT], -1.0),
        z=jnp.where(is_near, nearest_lane[LaneRow.Z], z),
    )


def _native_lanes(
    bank: ScenarioBank, index: Integer, box: bindings.Box, routed: bool | Bool[Array, ""], row: Any
) -> LaneHits:
    """Return the result of :func:`around_lanes`, computed by the native kernel."""
    lanes = bindings.query_lanes(
        _lane_grid(bank), bank.map_box, jnp.asarray(index, jnp.int32), box,
        jnp.asarray(bank.ego_number(row), jnp.int32), jnp.asarray(routed), _LANE_RULES,
    )  # fmt: skip
    return LaneHits(
        near=lanes.near,
        points_near=lanes.corners_near,
        on_corridor=lanes.on_corridor,
        wrong_way=lanes.wrong_way,
        straddling=lanes.straddling,
        leaving_lane=lanes.leaving_lane,
        limit=lanes.limit,
        z=jnp.where(lanes.near, lanes.nearest_z, box.ground),
    )


def in_corridor(bank: ScenarioBank, lanes: Float[Array, "8 K"], row: Any) -> Bool[Array, " K"]:
    """Mask of lanes (:class:`LaneRow`) in the corridor of a route."""
    code = lanes[LaneRow.LANE]
    if bank.most_egos == 1:
        return code > jnp.floor(code)
    # Multiplying by a power of two is exact: it shifts the bit of the ego to the first place after the point.
    code = code * (1 << bank.ego_number(row))
    return code - jnp.floor(code) >= 0.5


def lane_distance(bank: ScenarioBank, index: Integer, xy: Vector, z: Scalar) -> Scalar:
    """Distance to the nearest lane centre in any direction, m; infinite beyond the cut-off."""
    rows, inside = lanes_around(bank, index, xy)
    squared = to_segments(rows, xy[None])[0][0]
    nearest = jnp.where(inside & is_level(rows[LaneRow.Z], z), squared, _FAR).min()
    return jnp.where(nearest <= LANE_CUTOFF_M**2, root(nearest), jnp.inf)


def vertex_distances(
    bank: ScenarioBank, index: Integer, xy: Vector, spacing_m: float
) -> tuple[Scalar, Scalar]:
    """Distances to the nearest vertex of a road edge and of a lane centre, on any level, m.

    Reproduces tools that store maps as points, for the curation method ``published``: each segment has a vertex every
    ``spacing_m`` from its beginning, and one at its end. Distances are exact within the cut-offs; beyond them they may
    be too large.
    """
    edges, lanes = edges_around(bank, index, xy), lanes_around(bank, index, xy)
    return _nearest_vertex(*edges, xy, spacing_m), _nearest_vertex(*lanes, xy, spacing_m)


def _nearest_vertex(
    rows: Float[Array, "F K"], inside: Bool[Array, " K"], xy: Vector, spacing_m: float
) -> Scalar:
    begin, end = rows[EdgeRow.A], rows[EdgeRow.B]
    u, w = end - begin, xy[:, None] - begin
    length = root(jnp.sum(u * u, axis=0))
    along = jnp.sum(u * w, axis=0) / jnp.maximum(length, 1e-6)
    across = (u[0] * w[1] - u[1] * w[0]) / jnp.maximum(length, 1e-6)
    last = jnp.floor(length / spacing_m) * spacing_m
    vertex = jnp.clip(jnp.round(along / spacing_m) * spacing_m, 0.0, last)
    offset = jnp.minimum(jnp.abs(along - vertex), jnp.abs(along - length))
    return root(jnp.where(inside, across * across + offset * offset, _FAR).min())


def _holds(
    squared: Float[Array, "P K"], aligned: Bool[Array, " K"], half: Float[Array, " K"]
) -> Bool[Array, "P K"]:
    """Return whether lanes in the direction of the ego hold points."""
    return aligned & (squared <= (half + LANE_MARGIN_M) ** 2)


def _corner_lanes(
    bank: ScenarioBank, index: Integer, point: Vector, heading: Vector, z: Scalar
) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Return whether a lane is near a corner of a long box, and whether the corner is outside all lanes."""
    rows, inside = lanes_around(bank, index, point)
    squared = to_segments(rows, point[None])[0]
    squared = jnp.where(inside & is_level(rows[LaneRow.Z], z), squared, _FAR)
    holds = _holds(squared, _runs_along(rows, heading), rows[LaneRow.HALF_WIDTH])
    return squared.min() <= LANE_CUTOFF_M**2, ~holds.any()


def offroad_distance(
    bank: ScenarioBank, index: Integer, centre: Vector, points: Float[Array, "P 2"],
    points_near_lane: Bool[Array, " P"], z: Scalar,
) -> Float[Array, " P"]:  # fmt: skip
    """Signed distance of points beyond the nearest road edge, m: positive off the road, negative on it.

    Without an edge within the cut-off the stored side decides, and if that is unknown, whether a lane centre is near;
    the distance is then plus or minus the cut-off.
    """
    query = _xla_offroad_distance
    if bindings.supports_grid(_edge_grid(bank), points, centre, z):
        query = kernels.with_reference(_native_offroad_distance, query)
    return query(bank, index, centre, points, points_near_lane, z)


def _xla_offroad_distance(
    bank: ScenarioBank, index: Integer, centre: Vector, points: Float[Array, "P 2"],
    points_near_lane: Bool[Array, " P"], z: Scalar,
) -> Float[Array, " P"]:  # fmt: skip
    if bank.long_ego:
        look = jax.vmap(lambda p: left_of_edges(bank, index, p, p[None], z))
        left, known = (part[:, 0] for part in look(points))
    else:
        left, known = left_of_edges(bank, index, centre, points, z)
    distance, is_known = offroad_by_edges(bank, index, points, left, known)
    return jnp.where(is_known, distance, jnp.where(points_near_lane, -EDGE_CUTOFF_M, EDGE_CUTOFF_M))


def _native_offroad_distance(
    bank: ScenarioBank, index: Integer, centre: Vector, points: Float[Array, "4 2"],
    points_near_lane: Bool[Array, "4"], z: Scalar,
) -> Float[Array, "4"]:  # fmt: skip
    """Return the result of :func:`offroad_distance`, computed by the native kernel."""
    return bindings.query_edges(
        _edge_grid(bank), bank.grid_side, jnp.asarray(index, jnp.int32), centre, points, points_near_lane, z,
        _EDGE_RULES,
    )  # fmt: skip


def _edge_grid(bank: ScenarioBank) -> bindings.SegmentGrid:
    return bindings.SegmentGrid(
        bank.edges, bank.grid_edge, bank.grid_origin, bank.cell_m, bank.edge_run, bank.long_ego
    )


def _lane_grid(bank: ScenarioBank) -> bindings.SegmentGrid:
    return bindings.SegmentGrid(
        bank.lanes, bank.grid_lane, bank.grid_origin, bank.cell_m, bank.lane_run, bank.long_ego
    )


def offroad_by_edges(
    bank: ScenarioBank, index: Integer, points: Float[Array, "P 2"], left: Float[Array, " P"],
    known: Bool[Array, " P"],
) -> tuple[Float[Array, " P"], Bool[Array, " P"]]:  # fmt: skip
    """Return :func:`offroad_distance` by edges and stored sides, and the mask of points where these decide.

    ``left`` and ``known`` are the values of :func:`left_of_edges`.
    """
    side_code = _stored_side(bank, index, points)
    sides = jnp.where(side_code == NOT_DRIVABLE, EDGE_CUTOFF_M, -EDGE_CUTOFF_M)
    return jnp.where(known, -left, sides), known | (side_code != 0)


def _stored_side(bank: ScenarioBank, index: Integer, points: Float[Array, "P 2"]) -> Int[Array, " P"]:
    """Code of the side cell of each point (``scenario.build.grid.pack_sides``); 0 outside the grid."""
    grid = round(bank.grid_side.shape[1] ** 0.5)
    side_cell = jnp.floor((points - bank.grid_origin[index]) / (bank.cell_m / SPLIT)).astype(jnp.int32)
    inside = ((side_cell >= 0) & (side_cell < grid * SPLIT)).all(axis=1)
    cell, sub_cell = jnp.clip(side_cell // SPLIT, 0, grid - 1), side_cell % SPLIT
    word = bank.grid_side[index, cell[:, 1] * grid + cell[:, 0]]
    return jnp.where(inside, (word >> (2 * (sub_cell[:, 1] * SPLIT + sub_cell[:, 0]))) & 3, 0)


def left_the_map(bank: ScenarioBank, index: Integer, xy: Vector) -> Bool[Array, ""]:
    """Return whether a point lies outside the box of all edges and lanes, if any, widened by the cut-off of lanes."""
    return _outside_box(bank, index, xy, LANE_CUTOFF_M) & is_mapped(bank, index)


def _outside_box(
    bank: ScenarioBank, index: Integer, points: Float[Array, "*n 2"], margin_m: float
) -> Bool[Array, "*n"]:
    box = bank.map_box[index]
    return ((points < box[:2] - margin_m) | (points > box[2:] + margin_m)).any(axis=-1)


def is_mapped(bank: ScenarioBank, index: Integer) -> Bool[Array, ""]:
    """Return whether the scenario has any edge or lane."""
    return (bank.grid_edge[index, -1] > 0) | (bank.grid_lane[index, -1] > 0)


@record
class RouteHit:
    """Projection on the route: arc length, signed (left positive) and absolute distance, m; heading cosine and sine."""

    along_m: Scalar
    lateral_m: Scalar
    distance_m: Scalar
    heading: Vector


def project_on_route(
    bank: ScenarioBank, row: Integer, xy: Vector, near_m: Scalar, ahead_m: float | Scalar = _WINDOW_AHEAD_M
) -> RouteHit:
    """Project a point on the route of a row, from 6 m behind to ``ahead_m`` ahead of its last known arc length.

    ``near_m`` is that arc length; ``ahead_m``, of which 33 m count at most, keeps a car off the other leg of a hairpin.
    The window stays within the array of points: near the end of the array it begins further behind.
    """
    return project_on_path(bank.routes, bank.route_points, row, xy, near_m, ahead_m)


def project_on_path(
    routes: Float[Array, "M R 7"], points: Int[Array, " M"], row: Integer, xy: Vector, near_m: Scalar,
    ahead_m: float | Scalar = _WINDOW_AHEAD_M,
) -> RouteHit:  # fmt: skip
    """Project a point as :func:`project_on_route`, on a row of M paths (:class:`RouteColumn`).

    ``points`` are the numbers of points of the paths.
    """
    count = routes.shape[1]
    first = jnp.clip(near_m.astype(jnp.int32) - _WINDOW_BEHIND, 0, max(count - _WINDOW, 0))
    size = min(_WINDOW, count)
    window = jax.lax.dynamic_slice(routes, (row, first, jnp.int32(0)), (1, size, RouteColumn.LIMIT))[0]
    a, b = window[:-1], window[1:]
    point = first + jnp.arange(size - 1)
    is_valid = (point + 1 < points[row]) & (point <= near_m + ahead_m)
    ends = [end[:, column] for end in (a, b) for column in (RouteColumn.X, RouteColumn.Y)]
    squared, side = to_segments(ends, xy[None])
    k = first_smallest(jnp.where(is_valid, squared[0], _FAR))
    u, w = b[k, RouteColumn.XY] - a[k, RouteColumn.XY], xy - a[k, RouteColumn.XY]
    fraction = jnp.clip(jnp.sum(u * w) / jnp.maximum(jnp.sum(u * u), 1e-9), 0.0, 1.0)
    distance = root(squared[0, k])
    lateral = jnp.where(side[0, k] >= 0, distance, -distance)
    along_m = (first + k).astype(jnp.float32) + fraction
    return RouteHit(along_m, lateral, distance, window[k, RouteColumn.HEADING])


def route_ahead(
    bank: ScenarioBank, row: Integer, along_m: Scalar, offsets_m: Float[Array, " K"]
) -> tuple[Float[Array, "K 7"], Bool[Array, " K"]]:
    """Points of a route (:class:`RouteColumn`) at arc lengths ``along_m + offsets_m``, and the mask of valid ones."""
    at = jnp.maximum(along_m + offsets_m, 0.0)
    last = bank.route_points[row] - 1
    low = jnp.clip(at.astype(jnp.int32), 0, bank.routes.shape[1] - 2)
    # Limits and lanes are not interpolated.
    fraction = (at - low)[:, None] * (jnp.arange(bank.routes.shape[-1]) < RouteColumn.LIMIT)
    rows = bank.routes[row, low] * (1 - fraction) + bank.routes[row, low + 1] * fraction
    return rows, (along_m + offsets_m <= last.astype(jnp.float32)) & (last > 0)


def light_crossing(
    bank: ScenarioBank, index: Integer, before: Vector, now: Vector, z: Scalar
) -> tuple[Bool[Array, " L"], Float[Array, " L"]]:
    """Mask of the stop lines that a point crossed forwards between two steps, and its distance before each line, m.

    A line is crossed if the signed distance along the heading of its lane changes sign and the point passes through the
    finite segment. The distance is infinite for lines on other levels and for those that end more than 2 m to the side.
    """
    line = bank.light_line[index]
    cos, sin, half = line[LightRow.COS], line[LightRow.SIN], line[LightRow.HALF]

    def to_line_frame(point: Vector) -> tuple[Float[Array, " L"], Float[Array, " L"]]:
        dx, dy = point[0] - line[LightRow.X], point[1] - line[LightRow.Y]
        return dx * cos + dy * sin, dy * cos - dx * sin

    (s0, t0), (s1, t1) = to_line_frame(before), to_line_frame(now)
    fraction = -s0 / jnp.where(s1 > s0, s1 - s0, 1.0)
    is_through = jnp.abs(t0 + (t1 - t0) * fraction) <= half
    is_on_level = jnp.abs(line[LightRow.Z] - z) <= LEVEL_M
    before_m = jnp.where(is_on_level & (jnp.abs(t1) <= half + 2.0), -s1, jnp.inf)
    return (s0 < 0.0) & (s1 >= 0.0) & is_through & is_on_level, before_m


def lane_course(
    bank: ScenarioBank, index: Integer, xy: Vector, heading: Vector, z: Scalar
) -> tuple[Vector, Scalar, Bool[Array, ""]]:
    """Lane that a car at a pose follows: direction, distance of the car from it (left positive, m), whether it exists.

    It is the best lane within 2.5 m and 60 degrees, where a metre weighs as much as 15 degrees: a car that has started
    to turn follows the turn.
    """
    rows, inside = lanes_around(bank, index, xy)
    squared, side = to_segments(rows, xy[None])
    ux, uy = _chord(rows)
    length = jnp.sqrt(jnp.maximum(ux * ux + uy * uy, 1e-9))
    cos = (ux * heading[0] + uy * heading[1]) / length
    sin = (ux * heading[1] - uy * heading[0]) / length
    fits = inside & is_level(rows[LaneRow.Z], z) & (cos > 0.5) & (squared[0] <= _FOLLOWED_M**2)
    best = first_smallest(jnp.where(fits, squared[0] + (4.0 * sin) ** 2, _FAR))
    direction = jnp.stack([ux[best], uy[best]]) / length[best]
    return direction, side[0, best], fits[best]


@record
class Passage:
    """Strand of a car (-1 without a near lane in its direction), and whether it changed lanes or merged at this step.

    It changed lanes if the previous strand is parallel to this one. It merged if the previous strand ends in a merge
    (:class:`StrandColumn`) within 100 m, and the car changed lanes or is on the strand that it merges onto.
    """

    strand: Integer
    changed: Bool[Array, ""]
    merged: Bool[Array, ""]


def lane_passage(
    bank: ScenarioBank, index: Integer, xy: Vector, heading: Vector, z: Scalar, before: Any
) -> Passage:
    """Return the passage of a car from the strand ``before`` (-1 without one); ``z`` is the height of the ground.

    A car stays on a strand of lanes (``routes_and_strands``) until its centre is 0.3 m beyond the line between the
    strand and another, so that a car that drives along the line does not change lanes at every step.
    """
    rows, inside = lanes_around(bank, index, xy)
    segment_m2, side = to_segments(rows, xy[None])
    is_candidate = inside & _runs_along(rows, heading) & is_level(rows[LaneRow.Z], z)
    lane = jnp.where(is_candidate, rows[LaneRow.LANE], -1.0).astype(jnp.int32)
    squared, side = jnp.where(is_candidate, segment_m2[0], _FAR), side[0]
    strands = bank.lane_strands[index]
    strand = jnp.where(lane >= 0, strands[lane, StrandColumn.STRAND], -1.0).astype(jnp.int32)
    best = first_smallest(squared)
    before_m2 = jnp.where((strand == before) & (strand >= 0), squared, _FAR)
    closest = first_smallest(before_m2)
    has_lane, has_before = squared[best] <= LANE_CUTOFF_M**2, before_m2[closest] <= LANE_CUTOFF_M**2
    stays = has_before & (root(before_m2[closest]) - root(squared[best]) <= 2 * BEYOND_M)
    now = jnp.where(stays, before, jnp.where(has_lane, strand[best], -1))
    old, new = strands[lane[closest]], strands[lane[best]]
    adjacent = (new[StrandColumn.LEFT] == before) | (new[StrandColumn.RIGHT] == before)
    adjacent = (adjacent | (old[StrandColumn.LEFT] == now) | (old[StrandColumn.RIGHT] == now)) & has_before
    is_new_strand = (before >= 0) & (now >= 0) & (now != before)
    changed = is_new_strand & adjacent & (jnp.abs(side[closest] - side[best]) >= SIDE_BY_SIDE_M)
    previous = strands[before]
    ends_nearby = norm(xy - previous[StrandColumn.END]) <= MERGE_M
    merged = is_new_strand & ends_nearby & (changed | (previous[StrandColumn.ONTO] == now))
    return Passage(now.astype(jnp.int16), changed, merged)
