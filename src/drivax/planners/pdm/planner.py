"""PDM-Closed: simulates 15 proposals along the route, scores them as nuPlan does, and drives the best one.

Source: Dauner, Hallgarten, Geiger and Chitta, "Parting with Misconceptions about Learning-based Vehicle Motion
Planning" (CoRL 2023), and the numbers of its published implementation; where this one departs from it is written in
``docs/guide/planners.md``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.errors import UsageError
from drivax.geometry.boxes import LENGTH, WIDTH
from drivax.geometry.vectors import wrap
from drivax.planners.pdm.brake import BrakeConfig, braking, is_emergency
from drivax.planners.pdm.forecast import Forecast
from drivax.planners.pdm.proposals import LINE_PLACE, LINE_Z, Lines, unrolled
from drivax.planners.pdm.scoring import Judgement, ScoringConfig, grounds, judged, scores
from drivax.planners.pdm.tracking import Car, TrackingConfig, tracked
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record, static
from drivax.scenario.schema import DT_S
from drivax.simulator.ahead import stop_line_m
from drivax.simulator.contact import overlaps
from drivax.simulator.idm import IdmParameters
from drivax.simulator.types import MOTION_HEADING, MOTION_SPEED, SimState, Situation
from drivax.tasks.actions import ActionSpace, Physical

#: Steps over which acceleration and yaw rate are measured when an episode begins; those of a standstill, m.
_PAST, _STILL_M = 5, 0.5
#: IDM of the proposals.
PUBLISHED_DRIVER = IdmParameters(
    min_gap_m=1.0,
    headway_s=1.5,
    acceleration_mps2=1.5,
    comfortable_braking_mps2=3.0,
    exponent=10.0,
    max_braking_mps2=3.0,
)
#: Stride of the route points that are compared with forecasts.
_SPARSE = 5


@dataclass(frozen=True)
class PdmConfig:
    """PDM-Closed; the defaults are the published ones.

    Attributes:
        fractions: Speeds of the proposals, as shares of the limit.
        offsets_m: Their lateral offsets from the route, positive to the left.
        fallback_mps: Limit where none is known.
        driver: The IDM of the proposals.
        steps: How far they are unrolled, steps of 0.1 s.
        leader_every: Steps after which a proposal looks for its leader again.
        radius_m: Others further away are not looked at.
        agents: How many others are looked at: of those within the radius the ones that come nearest to the route. The
            publication looks at the nearest 50 vehicles, 25 pedestrians, 10 cyclists and 50 other things.
        tracking: How proposals are driven.
        scoring: How they are evaluated.
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
            raise UsageError("PDM has no proposals", cure="give it a fraction and an offset at least")
        for name, every in (("leader_every", self.leader_every), ("ground_every", self.scoring.ground_every)):
            if every < 1 or self.steps % every:
                raise UsageError(f"{name} is {every}, steps {self.steps}", cure="use a divisor of steps")
        if self.steps < 15:
            raise UsageError(f"{self.steps} steps are too few to judge comfort", cure="use 15 or more")


@record
class Memory:
    """What PDM carries from step to step.

    Attributes:
        touched: Who has overlapped ego since the episode began; ignored from then on.
        acceleration: What the last step asked for, m/s2.
        steering: Angle of the front wheels, rad.
    """

    touched: Bool[Array, " S"]
    acceleration: Float[Array, ""]
    steering: Float[Array, ""]


@record
class Weighed:
    """The proposals of a step: drivers of one line after each other, lines in order.

    Attributes:
        cars: As they would be driven, step by step.
        judgement: How each is evaluated.
        score: In [0, 1].
    """

    cars: Car
    judgement: Judgement
    score: Float[Array, " N"]


@record
class PdmPlanner:
    """A rule-based driver: the best of 15 proposals, or the emergency brake; uses the situation's truth.

    Others are expected to keep their velocities; of the log's future it knows nothing.
    """

    actions: ActionSpace = static(default=Physical())
    config: PdmConfig = static(default=PdmConfig())
    name: str = static(default="pdm")
    replays: bool = static(default=False)

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> Memory:
        """No agent touched yet; acceleration and steering as the motion of the last half second has them."""
        context = state.context
        before, now = context.history[-1 - _PAST], context.history[-1]
        moved_m = (before[MOTION_SPEED] + now[MOTION_SPEED]) / 2 * _PAST * DT_S
        turned = wrap(now[MOTION_HEADING] - before[MOTION_HEADING])
        curvature = jnp.where(moved_m > _STILL_M, turned / jnp.maximum(moved_m, _STILL_M), 0.0)
        steering = jnp.arctan(curvature * self._wheelbase(bank.length_m(context.index, context.slot)))
        most = self.config.tracking.most_steering
        return Memory(
            touched=jnp.zeros(bank.agent_box.shape[1], bool),
            acceleration=(now[MOTION_SPEED] - before[MOTION_SPEED]) / (_PAST * DT_S),
            steering=jnp.clip(steering, -most, most),
        )

    def act(
        self,
        carry: Memory,
        bank: ScenarioBank,
        state: SimState,
        situation: Situation,
        observation: Any,
        key: Array,
    ) -> tuple[Float[Array, " D"], Memory]:
        """The first step of the best proposal, or the brake."""
        context = situation.context
        motion, length = context.history[-1], situation.surroundings.frame.box[context.slot, LENGTH]
        carry = self._touching(carry, situation)
        weighed = self.weigh(carry, bank, situation)
        best = jnp.argmax(weighed.score)
        speed, brake = motion[MOTION_SPEED], self.config.brake
        brakes = is_emergency(weighed.judgement.fault_s[best], speed, brake)
        stop = braking(speed, carry.acceleration, brake)
        acceleration = jnp.where(brakes, stop, weighed.cars.acceleration[best, 1])
        steering = jnp.where(brakes, 0.0, weighed.cars.steering[best, 1])
        curvature = jnp.tan(steering) / self._wheelbase(length)
        action = self.actions.action(motion, acceleration, curvature, length)
        return action, Memory(carry.touched, acceleration, steering)

    def weigh(self, carry: Memory, bank: ScenarioBank, situation: Situation) -> Weighed:
        """All proposals, driven and evaluated."""
        config, context, around = self.config, situation.context, situation.surroundings
        frame, motion = around.frame, context.history[-1]
        me = frame.box[context.slot]
        size, speed = me[LENGTH : WIDTH + 1], motion[MOTION_SPEED]
        lines = Lines.beside_route(bank, context.index, around.route.along_m, config.offsets_m, me)
        way = lines.points[0, ::_SPARSE, :2]
        others = Forecast.of(frame, context.slot, carry.touched, way, config.agents, config.radius_m)
        # Each stage is written out: XLA would compute it again in every operation that uses it.
        lines, others = jax.lax.optimization_barrier((lines, others))
        limit = jnp.where(lines.limit > 0.0, lines.limit, config.fallback_mps)
        desired = jnp.where(lines.left_m > 0.0, limit, 0.0) * jnp.asarray(config.fractions)
        stop_m = stop_line_m(bank, context, frame)
        driver = (config.driver, config.steps, config.leader_every)
        proposals = unrolled(lines, others, size, speed, desired, stop_m, driver)
        reference = jax.lax.optimization_barrier(proposals.reference(lines))
        wheelbase = self._wheelbase(size[0])
        car = Car(motion, carry.acceleration, carry.steering)
        cars = jax.vmap(lambda one: tracked(car, one, wheelbase, config.tracking))(reference)
        cars = jax.lax.optimization_barrier(cars)
        rows = lines.at(proposals.way).reshape(*reference.pose.shape[:2], -1)
        ground_z = frame.z[context.slot] - bank.height_m(context.index, context.slot) / 2
        z, on_route = ground_z + rows[..., LINE_Z], rows[..., LINE_PLACE] <= lines.left_m
        every = config.scoring.ground_every
        ground = grounds(bank, context.index, cars.motion, size, z, on_route, every)
        ends = lines.places(cars.motion[:, -1, :2]) - lines.places(motion[:2])
        yaw_rate = speed * jnp.tan(carry.steering) / wheelbase

        def judge(motion: Array, acceleration: Array, ground: Any, progress_m: Array) -> Judgement:
            return judged(motion, acceleration, yaw_rate, size, others, ground, progress_m, config.scoring)

        judgement = jax.vmap(judge)(cars.motion, cars.acceleration, ground, ends)
        return Weighed(cars, judgement, scores(judgement, config.scoring))

    def _touching(self, carry: Memory, situation: Situation) -> Memory:
        frame, slot = situation.surroundings.frame, situation.context.slot
        return Memory(carry.touched | overlaps(frame, slot), carry.acceleration, carry.steering)

    def _wheelbase(self, length_m: Float[Array, ""]) -> Float[Array, ""]:
        return self.config.tracking.wheelbase * jnp.maximum(length_m, 1.0)
