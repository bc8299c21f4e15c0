"""Scores of PDM-Closed: gates times a weighted mean of progress, time to collision and comfort.

Source: Dauner et al. 2023 and its published implementation, which follows nuPlan's closed-loop metrics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.errors import UsageError
from drivax.geometry.boxes import COS, LENGTH, SIN
from drivax.geometry.vectors import norm, wrap
from drivax.metrics import comfort
from drivax.planners.pdm.forecast import Contacts, Forecast, boxes_of, predict_overlaps
from drivax.planners.pdm.ground import Ground
from drivax.planners.pdm.tracking import Car
from drivax.scenario.bank.scenario_bank import Scalar, Vector
from drivax.scenario.record import record
from drivax.scenario.schema import DT_S, AgentKind
from drivax.simulator.contact import REAR_AXLE
from drivax.simulator.types import MOTION_HEADING, MOTION_SPEED

#: Agents more than 150 degrees from straight ahead of the rear axle are behind.
_BEHIND_COS = -(3.0**0.5) / 2.0


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
