"""Scores of PDM-Closed: gates times a weighted mean of progress, time to collision and comfort.

Source: Dauner et al. 2023 and its published implementation, which follows nuPlan's closed-loop metrics.

The position relative to lanes and road is looked up along proposals. Queries of the grid read padded cells, with many
more segments than are near. Proposals share a path: the segments near it are selected once and sorted along it, and
groups of neighbouring poses read short runs of them. Native kernels read no padding and look up every pose in the grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax import kernels
from drivax.errors import UsageError
from drivax.geometry.boxes import COS, LENGTH, SIN, corners
from drivax.geometry.vectors import norm, wrap
from drivax.metrics import comfort
from drivax.planners.pdm.forecast import Contacts, Forecast, boxes_of, predict_overlaps
from drivax.planners.pdm.tracking import Car
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
from drivax.scenario.schema import DT_S, AgentKind
from drivax.simulator.contact import REAR_AXLE
from drivax.simulator.simulator import map_where
from drivax.simulator.types import MOTION_HEADING, MOTION_SPEED

#: Agents more than 150 degrees from straight ahead of the rear axle are behind.
_BEHIND_COS = -(3.0**0.5) / 2.0
#: Maximum number of edges, and of lanes of the corridor, near the path and near a group of poses; with more, poses are
#: looked up in the grid.
PATH_SEGMENTS, GROUP_SEGMENTS = 96, 40
#: Coordinate of padding.
_FAR_M = 1e6


@dataclass(frozen=True)
class ScoringConfig:
    """Weights and limits; defaults as published, except ``ground_every``. Comfort limits: ``metrics.comfort``.

    Attributes:
        progress, ttc, comfort: Weights of the mean.
        static_collision: Gate of an at-fault collision with an object other than a vehicle, pedestrian or cyclist.
        ttc_s: Horizon of the time to collision at each step.
        standing_mps: Speed below which time to collision is not evaluated.
        astray_m: Continuous distances outside the route's lanes below which the gate is 1, and below which it is 0.5.
        least_progress_m: If the best proposal makes less progress, all allowed proposals count as making the most.
        ground_every: Steps between look-ups of lanes and edges; in the action space ``trajectory`` every step, as
            published.
    """

    progress: float = 5.0
    ttc: float = 5.0
    comfort: float = 2.0
    static_collision: float = 0.5
    ttc_s: float = 0.9
    standing_mps: float = 0.005
    astray_m: tuple[float, float] = (2.0, 6.0)
    least_progress_m: float = 0.1
    ground_every: int = 5

    def __post_init__(self) -> None:
        weights = self.progress, self.ttc, self.comfort
        if not min(weights) >= 0.0 or not 0.0 < sum(weights) < math.inf:
            problem = f"weights of progress, ttc and comfort are {', '.join(f'{w:g}' for w in weights)}"
            raise UsageError(problem, cure="use 0 or positive numbers, one of them positive")


@record
class ProposalMetrics:
    """Metrics of a proposal."""

    # Gates: 1 passed, 0 failed; 1/2 for a collision with a static object, and for a short distance astray
    collision: Float[Array, "*batch"]
    road: Float[Array, "*batch"]
    direction: Float[Array, "*batch"]
    progress_m: Float[Array, "*batch"]  # Along the route
    # 1 within limits, else 0
    ttc: Float[Array, "*batch"]
    comfort: Float[Array, "*batch"]
    fault_s: Float[Array, "*batch"]  # Time of the first at-fault collision, infinite for none


def evaluate_proposal(
    car: Car, yaw_rate: Scalar, size: Vector, others: Forecast, contacts: Contacts, ground: Ground,
    progress_m: Scalar, config: ScoringConfig,
) -> ProposalMetrics:  # fmt: skip
    """Evaluate one proposal: the simulated car at each step, with ego's ``yaw_rate`` now (rad/s).

    ``contacts`` and ``ground`` are those along its motion.
    """
    motion = car.motion
    fault_times = contacts.fault_times(ground.is_in_several_lanes | ground.is_offroad)
    is_imminent = predict_overlaps(motion, size, others, config.ttc_s)
    is_road_user = (others.kind == AgentKind.VEHICLE) | (others.kind == AgentKind.PEDESTRIAN)
    is_road_user |= others.kind == AgentKind.CYCLIST
    fault_gates = jnp.where(is_road_user, 0.0, config.static_collision)
    return ProposalMetrics(
        collision=jnp.min(jnp.where(jnp.isfinite(fault_times), fault_gates, 1.0)),
        road=1.0 - ground.is_offroad.any().astype(jnp.float32),
        direction=_direction(motion, ground.is_astray, config),
        progress_m=progress_m,
        ttc=1.0 - _has_short_ttc(motion, size, others, is_imminent, config).astype(jnp.float32),
        comfort=is_comfortable(motion, car.acceleration, yaw_rate).astype(jnp.float32),
        fault_s=jnp.min(fault_times),
    )


def scores(metrics: ProposalMetrics, config: ScoringConfig) -> Float[Array, " N"]:
    """Return the scores of N proposals in [0, 1]: the product of the gates times the weighted mean.

    Progress is multiplied by the gates, and relative to that of the best proposal.
    """
    gates = metrics.collision * metrics.road * metrics.direction
    progress_m = metrics.progress_m * gates
    largest_m = jnp.max(progress_m)
    is_allowed = (gates > 0.0).astype(jnp.float32)
    relative = progress_m / jnp.maximum(largest_m, 1e-6)
    progress = jnp.where(largest_m > config.least_progress_m, relative, is_allowed)
    weights = config.progress, config.ttc, config.comfort
    terms = progress, metrics.ttc, metrics.comfort
    return gates * (sum(weight * term for weight, term in zip(weights, terms, strict=True)) / sum(weights))


def _direction(motion: Float[Array, "T 4"], is_astray: Bool[Array, " T"], config: ScoringConfig) -> Scalar:
    """Return the gate of wrong-way driving: 1, 1/2 or 0 by the longest continuous distance astray."""
    total_m = jnp.cumsum(norm(jnp.diff(motion[:, :2], axis=0)) * is_astray[1:])
    # Total at the last step that was not astray.
    start_m = jax.lax.cummax(jnp.where(is_astray[1:], 0.0, total_m))
    longest_m = jnp.max(total_m - start_m)
    full_m, half_m = config.astray_m
    return jnp.where(longest_m < full_m, 1.0, jnp.where(longest_m < half_m, 0.5, 0.0))


def _has_short_ttc(
    motion: Float[Array, "T 4"], size: Vector, others: Forecast, is_imminent: Bool[Array, "T K"],
    config: ScoringConfig,
) -> Bool[Array, ""]:  # fmt: skip
    """Return whether some step has a short time to collision with an agent that is not behind ego.

    The first such step decides for each agent. Not all sources mark intersections, so agents next to ego always count.
    """
    steps = jnp.arange(motion.shape[0])
    is_short = is_imminent & (motion[:, MOTION_SPEED] >= config.standing_mps)[:, None]
    first = jnp.min(jnp.where(is_short, steps[:, None].astype(jnp.float32), jnp.inf), axis=0)
    has_step = jnp.isfinite(first)
    step = jnp.where(has_step, first, 0.0).astype(jnp.int32)
    box = boxes_of(motion[step], size)
    other_xy = others.box[:, :2] + others.velocity * (step * DT_S)[:, None]
    dx, dy = jnp.moveaxis(other_xy - box[:, :2], -1, 0)
    ahead = dx * box[:, COS] + dy * box[:, SIN] + REAR_AXLE * box[:, LENGTH]
    left = dy * box[:, COS] - dx * box[:, SIN]
    is_behind = ahead < _BEHIND_COS * jnp.sqrt(ahead * ahead + left * left)
    return (has_step & ~is_behind).any()


def is_comfortable(
    motion: Float[Array, "T 4"], acceleration: Float[Array, " T"], yaw_rate: Scalar
) -> Bool[Array, ""]:
    """Return whether a motion always keeps nuPlan's comfort limits, with the windows of ``metrics.comfort``."""
    steps = motion.shape[0]
    heading_changes = wrap(jnp.diff(motion[:, MOTION_HEADING]))
    heading = jnp.concatenate([jnp.zeros(1), jnp.cumsum(heading_changes)])
    yaw_rates = jnp.concatenate([yaw_rate[None], heading_changes / DT_S])
    lateral = motion[:, MOTION_SPEED] * yaw_rates
    magnitude = jnp.sqrt(acceleration**2 + lateral**2 + 1e-12)

    def smooth(signal: Array, window: tuple[int, int, int]) -> Array:
        return jnp.asarray(comfort.savgol_matrix(steps, *window), jnp.float32) @ signal / DT_S ** window[2]

    low, high = comfort.LONGITUDINAL_MPS2
    longitudinal = smooth(acceleration, comfort.SMOOTH)
    is_within = ((longitudinal >= low) & (longitudinal <= high)).all()
    for values, limit in (
        (smooth(lateral, comfort.SMOOTH), comfort.LATERAL_MPS2),
        (smooth(longitudinal, comfort.JERK), comfort.JERK_MPS3),
        (smooth(smooth(magnitude, comfort.SMOOTH), comfort.JERK), comfort.JERK_MAGNITUDE_MPS3),
        (smooth(heading, comfort.YAW_RATE), comfort.YAW_RATE_RPS),
        (smooth(heading, comfort.YAW_ACCELERATION), comfort.YAW_ACCELERATION_RPS2),
    ):
        is_within &= (jnp.abs(values) <= limit).all()
    return is_within


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
