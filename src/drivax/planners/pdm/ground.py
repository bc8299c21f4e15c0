"""Position relative to lanes and road along proposals.

Queries of the grid read padded cells, with many more segments than are near. Along proposals, which share a path,
the segments near the path are selected once and sorted along it; groups of neighbouring poses read short runs of them.
Native kernels read no padding and look up every pose in the grid.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax import kernels
from drivax.geometry.boxes import corners
from drivax.geometry.vectors import norm
from drivax.planners.pdm.forecast import boxes_of
from drivax.scenario.bank.columns import EdgeRow, LaneRow
from drivax.scenario.bank.queries import (
    EDGE_CUTOFF_M,
    LANE_MARGIN_M,
    OFFROAD_TOLERANCE_M,
    around_lanes,
    in_corridor,
    is_level,
    is_mapped,
    left_of_segments,
    offroad_by_edges,
    offroad_distance,
    to_segments,
)
from drivax.scenario.bank.scenario_bank import Integer, Scalar, ScenarioBank, Vector
from drivax.scenario.record import record
from drivax.simulator.simulator import map_where

#: Maximum number of edges, and of lanes of the corridor, near the path and near a group of poses; with more, poses are
#: looked up in the grid.
PATH_SEGMENTS, GROUP_SEGMENTS = 96, 40
#: Coordinate of padding.
_FAR_M = 1e6


@record
class Ground:
    """Position relative to lanes and road at each step of a motion."""

    is_in_several_lanes: Bool[Array, "*T"]  # On a lane, but no single lane contains all corners
    is_offroad: Bool[Array, "*T"]  # Some corner is off the road
    is_astray: Bool[Array, "*T"]  # Outside the corridor; where there is no route: wrong-way driving


def ground_at(
    bank: ScenarioBank, row: Integer, box: Float[Array, " 6"], z: Scalar, on_route: Bool[Array, ""]
) -> Ground:
    """Return the position of ego's box at a hypothetical pose, relative to lanes and road.

    ``z`` is the height of the ground (m), and ``row`` the row of the route. If the route is not on lanes, or if ego is
    beyond its end (not ``on_route``), only wrong-way driving is astray.
    """
    index, points = bank.scenario_of(row), corners(box)
    lanes = around_lanes(bank, index, box[:2], box[2:4], points, z, row=row)
    distance = offroad_distance(bank, index, box[:2], points, lanes.points_near, z).max()
    is_astray = jnp.where(bank.on_lanes[row] & on_route, ~lanes.on_corridor, lanes.wrong_way)
    is_offroad = (distance > OFFROAD_TOLERANCE_M) & is_mapped(bank, index)
    return Ground(lanes.leaving_lane, is_offroad, is_astray)


def ground_along(
    bank: ScenarioBank, row: Integer, motion: Float[Array, "N T 4"], size: Vector,
    z: Float[Array, "N T"], on_route: Bool[Array, "N T"], needs_lanes: Bool[Array, "N T"], every: int,
) -> Ground:  # fmt: skip
    """Return :func:`ground_at` along N motions that start at the same pose.

    Every ``every``-th step (a divisor of T - 1) is looked up; the steps between use the next look-up. A step that does
    not need lanes may count as being in a single lane.
    """
    count = len(motion)
    box, z, on_route = (values[:, ::every] for values in (boxes_of(motion, size), z, on_route))
    box, z, on_route = box.reshape(-1, 6), z.reshape(-1), on_route.reshape(-1)

    def each_step(value: Array) -> Array:
        value = value.reshape(count, -1)
        return jnp.concatenate([value[:, :1], jnp.repeat(value[:, 1:], every, axis=1)], axis=1)

    if kernels.in_use():
        return jax.tree.map(each_step, jax.vmap(partial(ground_at, bank, row))(box, z, on_route))
    any_needs_lanes = needs_lanes[:, 1:].reshape(count, -1, every).any(axis=2)
    needs_lanes = jnp.concatenate([needs_lanes[:, :1], any_needs_lanes], axis=1).reshape(-1)
    ground, is_exact = _look_up_sorted(bank, row, box, z, count)
    needs_query = ~is_exact | ~(bank.on_lanes[row] & on_route) | needs_lanes
    exact_ground = map_where(needs_query, partial(ground_at, bank, row), box, z, on_route)

    ground = jax.tree.map(partial(jnp.where, needs_query), exact_ground, ground)
    return jax.tree.map(each_step, ground)


def _look_up_sorted(
    bank: ScenarioBank, row: Integer, box: Float[Array, "P 6"], z: Float[Array, " P"], group: int
) -> tuple[Ground, Bool[Array, " P"]]:
    """Return the position of poses on a route, taken to be in a single lane, and the mask of poses where it is exact.

    Poses are sorted by their distance from the first one, where all motions begin, and looked up in groups of
    ``group``.
    """
    _, order = jax.lax.top_k(-norm(box[:, :2] - box[0, :2]), len(box))
    path = box[order, :2]
    index = bank.scenario_of(row)
    lanes = bank.lanes[index]
    is_in_corridor = in_corridor(bank, lanes, row)
    lanes = jnp.where(is_in_corridor, lanes, _FAR_M)
    lane_reach_m = jnp.max(jnp.where(is_in_corridor, lanes[LaneRow.HALF_WIDTH], 0.0)) + LANE_MARGIN_M
    edge_reach_m = norm(box[0, 4:]) / 2 + EDGE_CUTOFF_M
    edges_near = SortedSegments.near_path(bank.edges[index], path, edge_reach_m)
    lanes_near = SortedSegments.near_path(lanes, path, lane_reach_m)

    def look_up(poses: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        box, z = poses
        edges, has_edges = edges_near.near_points(box[:, :2])
        lanes, has_lanes = lanes_near.near_points(box[:, :2])

        def at_pose(box: Array, z: Array) -> tuple[Array, Array, Array]:
            points = corners(box)
            left, known = left_of_segments(edges, is_level(edges[EdgeRow.Z], z), points)
            distance, is_exact = offroad_by_edges(bank, index, points, left, known)
            squared = to_segments(lanes, box[None, :2])[0][0]
            is_in_lane = squared <= (lanes[LaneRow.HALF_WIDTH] + LANE_MARGIN_M) ** 2
            is_astray = ~(is_in_lane & is_level(lanes[LaneRow.Z], z)).any()
            return distance.max() > OFFROAD_TOLERANCE_M, is_astray, is_exact.all()

        is_offroad, is_astray, is_exact = jax.vmap(at_pose)(box, z)
        return is_offroad, is_astray, is_exact & has_edges & has_lanes

    groups = tuple(values[order].reshape(-1, group, *values.shape[1:]) for values in (box, z))
    masks = jax.lax.map(look_up, groups)
    is_offroad, is_astray, is_exact = (
        jnp.zeros(len(box), bool).at[order].set(mask.reshape(-1)) for mask in masks
    )
    is_offroad &= is_mapped(bank, index)
    return Ground(jnp.zeros_like(is_offroad), is_offroad, is_astray), is_exact


@record
class SortedSegments:
    """Segments near a path, sorted along the direction from its first point to its last."""

    segments: Float[Array, "F S"]  # ``EdgeRow`` or ``LaneRow``, padded far away
    direction: Vector
    begin_m: Float[Array, " S"]  # Where each segment begins along the direction
    length_m: Scalar  # Longest extent of a segment along it
    reach_m: Scalar  # Width by which the rectangle around the path is enlarged
    complete: Bool[Array, ""]  # Whether no segment within reach is missing

    @classmethod
    def near_path(
        cls, segments: Float[Array, "F A"], path: Float[Array, "P 2"], reach_m: Scalar
    ) -> SortedSegments:
        """Select the segments that meet the rectangle around a path, widened by a reach."""
        chord = path[-1] - path[0]
        chord = jnp.where(norm(chord) > 1e-3, chord, jnp.array([1.0, 0.0]))
        direction = chord / norm(chord)
        ends = segments[EdgeRow.A], segments[EdgeRow.B]

        def extent(direction: Array) -> tuple[Array, Array, Array]:
            """Return begin and end of each segment along a direction, and whether it meets the rectangle's extent."""
            a, b = (_along(direction, *end) for end in ends)
            begin, end, points = jnp.minimum(a, b), jnp.maximum(a, b), _along(direction, *path.T)
            return begin, end, (end >= points.min() - reach_m) & (begin <= points.max() + reach_m)

        begin, end, is_near = extent(direction)
        is_near &= extent(jnp.stack([-direction[1], direction[0]]))[2]
        count = min(PATH_SEGMENTS, len(begin))
        negative_begin, index = jax.lax.top_k(jnp.where(is_near, -begin, -_FAR_M), count)
        near_segments = jnp.where(negative_begin > -_FAR_M, segments[:, index], _FAR_M)
        length_m = jnp.max(jnp.where(is_near, end - begin, 0.0))
        return cls(near_segments, direction, -negative_begin, length_m, reach_m, is_near.sum() <= count)

    def near_points(self, points: Float[Array, "P 2"]) -> tuple[Float[Array, "F M"], Bool[Array, ""]]:
        """Return the segments within reach of points of the path, and whether none is missing."""
        along_m, count = _along(self.direction, *points.T), min(GROUP_SEGMENTS, len(self.begin_m))
        first = jnp.sum(self.begin_m < along_m.min() - self.reach_m - self.length_m)
        end = jnp.sum(self.begin_m <= along_m.max() + self.reach_m)
        segments = jax.lax.dynamic_slice_in_dim(self.segments, first, count, axis=1)
        return segments, self.complete & (end - first <= count)


def _along(direction: Vector, x: Float[Array, " n"], y: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return coordinates along a direction, without a matrix product, which is less exact on GPUs."""
    return direction[0] * x + direction[1] * y
