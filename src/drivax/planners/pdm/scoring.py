"""Scores of PDM-Closed: gates times a weighted mean of progress, time to collision and comfort.

Source: Dauner et al. 2023 and its published implementation, which follows nuPlan's closed-loop metrics.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.geometry.boxes import LENGTH
from drivax.geometry.vectors import norm, wrap
from drivax.metrics import comfort
from drivax.planners.pdm.forecast import Contacts, Forecast, boxes_of, overlapping
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
    """Weights and limits; defaults as published. Comfort has nuPlan's limits (``metrics.comfort``).

    Attributes:
        progress, ttc, comfort: Weights of the mean.
        static_collision: Gate of an at-fault collision with an object other than a vehicle, pedestrian or cyclist.
        ttc_s: Horizon of the time to collision at each step.
        standing_mps: Speed below which time to collision is not evaluated.
        astray_m: Continuous distances off the route's direction up to which the gate is 1, and up to which it is 0.5.
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


@record
class ProposalMetrics:
    """Metrics of a proposal."""

    # Gates: 1 passed, 0 failed
    collision: Float[Array, "*batch"]
    road: Float[Array, "*batch"]
    direction: Float[Array, "*batch"]
    progress_m: Float[Array, "*batch"]  # Along the route
    # 1 within limits, 0 not
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
    faults = contacts.fault_times(ground.several | ground.off)
    soon = overlapping(motion, size, others, config.ttc_s)
    alive = (others.kind == AgentKind.VEHICLE) | (others.kind == AgentKind.PEDESTRIAN)
    alive |= others.kind == AgentKind.CYCLIST
    passed = jnp.where(jnp.isfinite(faults), jnp.where(alive, 0.0, config.static_collision), 1.0)
    return ProposalMetrics(
        collision=jnp.min(passed),
        road=1.0 - ground.off.any().astype(jnp.float32),
        direction=_direction(motion, ground.astray, config),
        progress_m=progress_m,
        ttc=1.0 - _foreseen(motion, size, others, soon, config).astype(jnp.float32),
        comfort=is_comfortable(motion, car.acceleration, yaw_rate).astype(jnp.float32),
        fault_s=jnp.min(faults),
    )


def scores(metrics: ProposalMetrics, config: ScoringConfig) -> Float[Array, " N"]:
    """Scores of N proposals in [0, 1]: the product of the gates times the weighted mean.

    Progress is relative to the largest progress after gates.
    """
    gates = metrics.collision * metrics.road * metrics.direction
    gained = metrics.progress_m * gates
    most = jnp.max(gained)
    allowed = (gates > 0.0).astype(jnp.float32)
    progress = jnp.where(most > config.least_progress_m, gained / jnp.maximum(most, 1e-6), allowed)
    weights = config.progress, config.ttc, config.comfort
    terms = progress, metrics.ttc, metrics.comfort
    return gates * (sum(weight * term for weight, term in zip(weights, terms, strict=True)) / sum(weights))


def _direction(motion: Float[Array, "T 4"], astray: Bool[Array, " T"], config: ScoringConfig) -> Scalar:
    """Gate of wrong-way driving: 1, 1/2 or 0 by the longest continuous distance astray."""
    steps = norm(jnp.diff(motion[:, :2], axis=0)) * astray[1:]
    whole = jnp.cumsum(steps)
    # Distance astray up to the last step that was not.
    before = jax.lax.cummax(jnp.where(astray[1:], 0.0, whole))
    longest = jnp.max(whole - before)
    fine, half = config.astray_m
    return jnp.where(longest < fine, 1.0, jnp.where(longest < half, 0.5, 0.0))


def _foreseen(
    motion: Float[Array, "T 4"], size: Vector, others: Forecast, soon: Bool[Array, "T K"],
    config: ScoringConfig,
) -> Bool[Array, ""]:  # fmt: skip
    """Whether some step has a short time to collision with an agent that is not behind ego.

    The first such step decides for each agent. Sources do not mark intersections, so agents next to ego always count.
    """
    steps = jnp.arange(motion.shape[0])
    sees = soon & (motion[:, MOTION_SPEED] >= config.standing_mps)[:, None]
    first = jnp.min(jnp.where(sees, steps[:, None].astype(jnp.float32), jnp.inf), axis=0)
    seen = jnp.isfinite(first)
    step = jnp.where(seen, first, 0.0).astype(jnp.int32)
    me = boxes_of(motion[step], size)
    then = others.box[:, :2] + others.velocity * (step * DT_S)[:, None]
    dx, dy = jnp.moveaxis(then - me[:, :2], -1, 0)
    ahead = dx * me[:, 2] + dy * me[:, 3] + REAR_AXLE * me[:, LENGTH]
    left = dy * me[:, 2] - dx * me[:, 3]
    behind = ahead < _BEHIND_COS * jnp.sqrt(ahead * ahead + left * left)
    return (seen & ~behind).any()


def is_comfortable(
    motion: Float[Array, "T 4"], acceleration: Float[Array, " T"], yaw_rate: Scalar
) -> Bool[Array, ""]:
    """Whether a motion stays within nuPlan's comfort limits at every step, with the windows of ``metrics.comfort``."""
    steps = motion.shape[0]
    turned = wrap(jnp.diff(motion[:, MOTION_HEADING]))
    heading = jnp.concatenate([jnp.zeros(1), jnp.cumsum(turned)])
    rates = jnp.concatenate([yaw_rate[None], turned / DT_S])
    lateral = motion[:, MOTION_SPEED] * rates
    magnitude = jnp.sqrt(acceleration**2 + lateral**2 + 1e-12)

    def filtered(signal: Array, window: tuple[int, int, int]) -> Array:
        return jnp.asarray(comfort.savgol_matrix(steps, *window), jnp.float32) @ signal / DT_S ** window[2]

    low, high = comfort.LONGITUDINAL_MPS2
    smooth = filtered(acceleration, comfort.SMOOTH)
    within = ((smooth >= low) & (smooth <= high)).all()
    for values, limit in (
        (filtered(lateral, comfort.SMOOTH), comfort.LATERAL_MPS2),
        (filtered(smooth, comfort.JERK), comfort.JERK_MPS3),
        (filtered(filtered(magnitude, comfort.SMOOTH), comfort.JERK), comfort.JERK_MAGNITUDE_MPS3),
        (filtered(heading, comfort.YAW_RATE), comfort.YAW_RATE_RPS),
        (filtered(heading, comfort.YAW_ACCELERATION), comfort.YAW_ACCELERATION_RPS2),
    ):
        within &= (jnp.abs(values) <= limit).all()
    return within
