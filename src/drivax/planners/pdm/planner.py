"""PDM-Closed: simulate 15 proposals along the route, score them as nuPlan does, and drive the best one.

Source: Dauner, Hallgarten, Geiger and Chitta, "Parting with Misconceptions about Learning-based Vehicle Motion
Planning" (CoRL 2023), and its published implementation; ``docs/guide/planners.md`` lists the differences.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.errors import UsageError
from drivax.geometry.boxes import LENGTH, WIDTH
from drivax.planners.pdm import scoring
from drivax.planners.pdm.brake import BrakeConfig, braking, is_emergency, stop
from drivax.planners.pdm.forecast import Contacts, Forecast
from drivax.planners.pdm.ground import ground_along
from drivax.planners.pdm.proposals import LINE_ALONG, LINE_Z, Lines, Proposals, unroll_idm
from drivax.planners.pdm.scoring import ProposalMetrics, ScoringConfig
from drivax.planners.pdm.tracking import Car, Reference, track
from drivax.scenario.bank.scenario_bank import Scalar, ScenarioBank
from drivax.scenario.record import record, static
from drivax.simulator.ahead import stop_line_m
from drivax.simulator.contact import overlaps
from drivax.simulator.controller import ACCELERATION, STEERING, TrackingConfig, recent_actuators, steering_of
from drivax.simulator.idm import IdmParameters
from drivax.simulator.types import MOTION_SPEED, SimState, Situation
from drivax.tasks.actions import ActionSpace, Physical, Trajectory, action_of

#: IDM of the proposals.
PUBLISHED_DRIVER = IdmParameters(1.0, 1.5, 1.5, 3.0, exponent=10.0, max_braking_mps2=3.0)
#: Stride of the points of the first line that are compared with forecasts.
_STRIDE = 5


@dataclass(frozen=True)
class PdmConfig:
    """Settings of PDM-Closed; defaults as published, except ``agents`` and ``scoring.ground_every``.

    Attributes:
        fractions: Target speeds of the proposals, relative to the speed limit.
        offsets_m: Lateral offsets from the route, positive to the left.
        fallback_mps: Speed limit where unknown.
        driver: IDM parameters of the proposals.
        steps: Horizon of the proposals, steps of 0.1 s. Their lines end about 160 m ahead.
        leader_every: Steps between updates of a proposal's leader.
        radius_m: Largest distance of agents to consider.
        agents: Number of agents to consider, those that come nearest to the line of the first offset. The publication
            uses the nearest 50 vehicles, 25 pedestrians, 10 cyclists and 50 other objects.
        tracking: Tracker and vehicle model.
        scoring: Weights and limits of the score.
        brake: The emergency brake.
    """

    fractions: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8, 1.0)
    offsets_m: tuple[float, ...] = (0.0, -1.0, 1.0)
    fallback_mps: float = 15.0
    driver: IdmParameters = field(default_factory=lambda: PUBLISHED_DRIVER)
    steps: int = 40
    leader_every: int = 2
    radius_m: float = 50.0
    agents: int = 24
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    scoring: ScoringConfig = field(default_factory=ScoringConfig)
    brake: BrakeConfig = field(default_factory=BrakeConfig)

    def __post_init__(self) -> None:
        if not self.fractions or not self.offsets_m:
            raise UsageError("PDM has no proposals", cure="give it at least one fraction and one offset")
        for name, every in (("leader_every", self.leader_every), ("ground_every", self.scoring.ground_every)):
            if every < 1 or self.steps % every:
                raise UsageError(f"{name} is {every}, steps {self.steps}", cure="use a divisor of steps")
        if self.agents < 1:
            raise UsageError(f"PDM considers {self.agents} agents", cure="use agents: 1 or more")
        if self.steps < 15:
            raise UsageError(f"{self.steps} steps are too few to judge comfort", cure="use 15 or more")


@record
class Memory:
    """Carry of PDM."""

    touched: Bool[Array, " S"]  # Agents that have overlapped ego since the episode started; ignored
    acceleration: Float[Array, ""]  # Last requested acceleration, m/s2
    steering: Float[Array, ""]  # Steering angle, rad


@record
class ScoredProposals:
    """Simulated and scored proposals of a step: speeds of one line after each other, lines in order."""

    plans: Float[Array, "N T 3"]  # Poses along the lines, which cars track
    cars: Car  # Simulated motion, step by step
    metrics: ProposalMetrics  # Metrics of each proposal
    score: Float[Array, " N"]  # In [0, 1]


@record
class PdmPlanner:
    """Drive the best proposal (of 15 by default), or brake.

    Reads the true situation, not observations. Other agents are predicted at constant velocity; the planner reads the
    log's future only in scenarios without a route on lanes, where it follows the path of the log.
    """

    actions: ActionSpace = static(default=Physical())
    config: PdmConfig = static(default=PdmConfig())
    name: str = static(default="pdm")
    replays: bool = static(default=False)

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> Memory:
        """Return a carry without touched agents; acceleration and steering from the last half second."""
        context = state.context
        length_m = jnp.maximum(bank.length_m(context.index, context.slot), 1.0)
        actuators = recent_actuators(context.history, length_m, self.config.tracking)
        touched = jnp.zeros(bank.agent_box.shape[1], bool)
        return Memory(touched, actuators[ACCELERATION], actuators[STEERING])

    def act(
        self, carry: Memory, bank: ScenarioBank, state: SimState, situation: Situation, observation: Any,
        key: Array,
    ) -> tuple[Float[Array, " D"], Memory]:  # fmt: skip
        """Return the first action of the best proposal (in the space ``trajectory`` all of its poses), or brake."""
        context = situation.context
        motion, length = context.history[-1], situation.surroundings.frame.box[context.slot, LENGTH]
        touched = carry.touched | overlaps(situation.surroundings.frame, context.slot)
        carry, space = replace(carry, touched=touched), self._plan_space
        if space:
            steering = steering_of(context.action[:3], space.controller)
            carry = replace(carry, acceleration=context.action[ACCELERATION], steering=steering)
        proposals = self.score_proposals(carry, bank, situation)
        best = jnp.argmax(proposals.score)
        speed, brake = motion[MOTION_SPEED], self.config.brake
        is_braking = is_emergency(proposals.metrics.fault_s[best], speed, brake)
        brake_acceleration = braking(speed, carry.acceleration, brake)
        acceleration = jnp.where(is_braking, brake_acceleration, proposals.cars.acceleration[best, 1])
        steering = jnp.where(is_braking, 0.0, proposals.cars.steering[best, 1])
        curvature = jnp.tan(steering) / self._wheelbase(length)
        action = action_of(self.actions, bank, context, acceleration, curvature)
        if space:
            stop_plan = stop(space, motion, brake_acceleration, length, brake)
            action = jnp.where(is_braking, stop_plan, space.plan(proposals.plans[best]))
        return action, Memory(touched, acceleration, steering)

    def score_proposals(self, carry: Memory, bank: ScenarioBank, situation: Situation) -> ScoredProposals:
        """Simulate and score all proposals."""
        config, context, surroundings = self.config, situation.context, situation.surroundings
        frame, motion = surroundings.frame, context.history[-1]
        box, speed = frame.box[context.slot], motion[MOTION_SPEED]
        size = box[LENGTH : WIDTH + 1]
        lines = Lines.along_route(bank, context.row, surroundings.route.along_m, config.offsets_m, box)
        path = lines.points[0, ::_STRIDE, :2]
        others = Forecast.of(frame, context.slot, carry.touched, path, config.agents, config.radius_m)
        # Without barriers, XLA would compute a stage again in every operation that uses it.
        lines, others = jax.lax.optimization_barrier((lines, others))
        limit = jnp.where(lines.limit > 0.0, lines.limit, config.fallback_mps)
        desired = jnp.where(lines.remaining_m > 0.0, limit, 0.0) * jnp.asarray(config.fractions)
        stop_m = stop_line_m(bank, context, frame)
        updates = range(0, config.steps, config.leader_every)
        proposals = unroll_idm(lines, others, size, speed, desired, stop_m, config.driver, updates)
        wheelbase, car = self._wheelbase(size[0]), Car(motion, carry.acceleration, carry.steering)
        plans, cars = self._simulate(lines, proposals, car, wheelbase)
        rows = lines.at(proposals.arc_m).reshape(*plans.shape[:2], -1)
        ground_z = frame.z[context.slot] - bank.height_m(context.index, context.slot) / 2
        z, on_route = ground_z + rows[..., LINE_Z], rows[..., LINE_ALONG] <= lines.remaining_m
        # The controller of ``trajectory`` swings out in bends, and would touch curbs between look-ups.
        every = 1 if self._plan_space else config.scoring.ground_every
        contacts = jax.vmap(Contacts.along, in_axes=(0, None, None))(cars.motion, size, others)
        needs_lanes = jax.vmap(partial(Contacts.needs_lanes, steps=config.steps + 1))(contacts)
        ground = ground_along(bank, context.row, cars.motion, size, z, on_route, needs_lanes, every)
        progress_m = lines.route_distances(cars.motion[:, -1, :2]) - lines.route_distances(motion[:2])
        yaw_rate = speed * jnp.tan(carry.steering) / wheelbase

        metrics = jax.vmap(scoring.evaluate_proposal, in_axes=(0, None, None, None, 0, 0, 0, None))(
            cars, yaw_rate, size, others, contacts, ground, progress_m, config.scoring
        )
        return ScoredProposals(plans, cars, metrics, scoring.scores(metrics, config.scoring))

    def _simulate(
        self, lines: Lines, proposals: Proposals, car: Car, wheelbase: Scalar
    ) -> tuple[Float[Array, "N T 3"], Car]:
        """Return the plans of all proposals, and the cars that track them."""
        reference = jax.lax.optimization_barrier(proposals.reference(lines))
        heading = jnp.arctan2(reference.pose[..., 3:], reference.pose[..., 2:3])
        plans = jnp.concatenate([reference.pose[..., :2], heading], axis=-1)
        # One copy per proposal: XLA vectorises over arrays of one shape.
        copies = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (len(plans), *leaf.shape)), (car, wheelbase)
        )
        cars, wheelbases = jax.lax.optimization_barrier(copies)
        return plans, jax.lax.optimization_barrier(jax.vmap(self._track)(cars, wheelbases, reference, plans))

    def _track(self, car: Car, wheelbase: Scalar, reference: Reference, plan: Float[Array, "T 3"]) -> Car:
        """Track one proposal as it would be executed."""
        space = self._plan_space
        if space is None:
            return track(car, reference, wheelbase, self.config.tracking)
        poses = replace(space, steps=max(space.steps, self.config.steps)).plan(plan).reshape(-1, 3)
        axle_reference = Reference.fitted(poses, self.config.steps, wheelbase, space.controller)
        return track(car, axle_reference, wheelbase, space.controller, about_axle=True)

    @property
    def _plan_space(self) -> Trajectory | None:
        """The action space ``trajectory``, whose controller executes plans; None for other action spaces."""
        return self.actions if isinstance(self.actions, Trajectory) else None

    def _wheelbase(self, length_m: Scalar) -> Scalar:
        """Return the wheelbase for a length, m; empty slots have length 0 and count as 1 m long."""
        tracking = self._plan_space.controller if self._plan_space else self.config.tracking
        return tracking.wheelbase * jnp.maximum(length_m, 1.0)
