"""Emergency brake of PDM-Closed, for any planner: stop if ego is about to cause a collision.

Source: Dauner, Hallgarten, Geiger and Chitta, "Parting with Misconceptions about Learning-based Vehicle Motion
Planning" (CoRL 2023) and its published implementation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.errors import UsageError
from drivax.geometry.boxes import LENGTH, WIDTH
from drivax.planners.pdm.forecast import Contacts, Forecast
from drivax.planners.planner import Planner
from drivax.scenario.bank.scenario_bank import Scalar, ScenarioBank
from drivax.scenario.record import record, static
from drivax.scenario.schema import DT_S
from drivax.simulator.contact import overlaps
from drivax.simulator.types import MOTION_HEADING, MOTION_SPEED, Motion, SimState, Situation
from drivax.tasks.actions import ActionSpace, Physical, Route, Trajectory

#: Maximum number of agents to consider (those nearest to the path), and their maximum distance from ego, m.
_MAX_AGENTS, _RADIUS_M = 24, 50.0
#: Stride of the forecast motions that form the path.
_STRIDE = 5
#: Factor on the speed of the plan that brakes a car in the action space ``trajectory``, as published.
_OVERSHOOT = 1.1


@dataclass(frozen=True)
class BrakeConfig:
    """Thresholds and gains of the emergency brake; defaults as published.

    Attributes:
        within_s: Largest time to an at-fault collision that triggers the brake.
        up_to_mps: Largest speed at which the brake triggers.
        least_mps2, most_mps2: Bounds of the acceleration (nuPlan's comfort limits).
        gains, slow_gains: Gains on the speed (1/s) and on the acceleration; ``slow_gains`` up to ``slow_mps``.
        slow_mps: Speed at which the gains change.
    """

    within_s: float = 2.0
    up_to_mps: float = 5.0
    least_mps2: float = -4.05
    most_mps2: float = 2.40
    gains: tuple[float, float] = (10.0, 0.0)
    slow_gains: tuple[float, float] = (4.0, 1.0)
    slow_mps: float = 0.2

    def __post_init__(self) -> None:
        if not 0.0 <= self.within_s < math.inf:
            raise UsageError(f"the brake's within_s is {self.within_s:g}", cure="use 0 or a positive number")
        if not self.least_mps2 <= self.most_mps2:
            problem = f"the brake accelerates from {self.least_mps2:g} to {self.most_mps2:g} m/s2"
            raise UsageError(problem, cure="use least_mps2 <= most_mps2")


def is_emergency(fault_s: Scalar, speed: Scalar, config: BrakeConfig = BrakeConfig()) -> Bool[Array, ""]:
    """Return whether to brake at a time to an at-fault collision (infinite for none) and a speed (m/s)."""
    # Tolerate rounding: times are multiples of a step in float32.
    return (fault_s <= config.within_s + DT_S / 10) & (speed <= config.up_to_mps)


def braking_acceleration(speed: Scalar, acceleration: Scalar, config: BrakeConfig = BrakeConfig()) -> Scalar:
    """Return the acceleration that stops a car, m/s2: ``-k_p v - k_d a``, clipped."""
    (p, d), (slow_p, slow_d) = config.gains, config.slow_gains
    fast, slow = -p * speed - d * acceleration, -slow_p * speed - slow_d * acceleration
    return jnp.clip(jnp.where(speed > config.slow_mps, fast, slow), config.least_mps2, config.most_mps2)


def stop(
    actions: ActionSpace, motion: Motion, acceleration: Scalar, length_m: Scalar,
    config: BrakeConfig = BrakeConfig(),
) -> Float[Array, " D"]:  # fmt: skip
    """Return the action that brakes straight ahead; for the space ``route``, an action of :class:`Physical`.

    In the action space ``trajectory``, the plan has a constant speed, as published: ``1.1 (v + a)`` m/s if ego drives
    faster than ``slow_mps``, else ``a``. A plan of negative speed leads backwards; the car, unable to reverse, stops.
    """
    if not isinstance(actions, Trajectory):
        return actions.action(motion, acceleration, jnp.zeros(()), length_m)
    speed, heading = motion[MOTION_SPEED], motion[MOTION_HEADING]
    plan_speed = jnp.where(speed > config.slow_mps, _OVERSHOOT * (speed + acceleration), acceleration)
    step = jnp.stack([jnp.cos(heading), jnp.sin(heading), jnp.zeros(())]) * plan_speed * DT_S
    return actions.plan(jnp.stack([motion[:3], motion[:3] + step]))


@record
class EmergencyBrake:
    """Wrap a planner: brake if its action leads to an at-fault collision.

    The forecast holds the action constant (in the space ``route``, its curvature); in the space ``trajectory``, it
    follows the plan exactly. In ``direct_state``, where an action is a single motion, ego stays there. Other agents
    keep their velocities; agents that already touch ego are ignored.

    Attributes:
        planner: The wrapped planner.
        actions: Its action space.
        config: When to brake.
    """

    planner: Planner
    actions: ActionSpace = static(default=Physical())
    config: BrakeConfig = static(default=BrakeConfig())
    replays: bool = static(default=False)

    @property
    def name(self) -> str:
        """Name of the planner plus ``+brake``."""
        return f"{self.planner.name}+brake"

    @property
    def prepare(self) -> Any:
        """Function that hands stored scenarios to the wrapped planner; None if it needs none."""
        return getattr(self.planner, "prepare", None)

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> Any:
        """Return the carry of the wrapped planner."""
        return self.planner.init(bank, state, key)

    def act(
        self, carry: Any, bank: ScenarioBank, state: SimState, situation: Situation, observation: Any,
        key: Array,
    ) -> tuple[Float[Array, " D"], Any]:  # fmt: skip
        """Return the planner's action, or brake straight ahead."""
        action, carry = self.planner.act(carry, bank, state, situation, observation, key)
        context, frame = situation.context, situation.surroundings.frame
        motion, box = context.history[-1], frame.box[context.slot]

        # In the space ``route`` an action is an offset: forecast its curvature, and brake at the offset of curvature 0.
        space = self.actions if isinstance(self.actions, Route) else None
        steered_action = space.steer(bank, context, action) if space else action
        path = self._forecast(motion, steered_action, context.action, box[LENGTH])
        is_touching = overlaps(frame, context.slot)
        others = Forecast.of(frame, context.slot, is_touching, path[::_STRIDE, :2], _MAX_AGENTS, _RADIUS_M)
        # The lanes at the present pose stand for those along the path.
        is_unlawful = jnp.broadcast_to(situation.surroundings.lanes.leaving_lane, path.shape[:1])
        fault_s = jnp.min(Contacts.along(path, box[LENGTH : WIDTH + 1], others).fault_times(is_unlawful))
        speed = motion[MOTION_SPEED]
        acceleration = braking_acceleration(
            speed, (speed - context.history[-2, MOTION_SPEED]) / DT_S, self.config
        )
        brake_action = stop(self.actions, motion, acceleration, box[LENGTH], self.config)
        brake_action = space.unsteer(bank, context, brake_action) if space else brake_action
        return jnp.where(is_emergency(fault_s, speed, self.config), brake_action, action), carry

    def _forecast(
        self, motion: Motion, action: Float[Array, " D"], last_action: Float[Array, " D"], length_m: Scalar
    ) -> Float[Array, "n 4"]:
        """Return the motions from now on, with the action held constant or along the planned poses."""
        steps = round(self.config.within_s / DT_S)
        if isinstance(self.actions, Trajectory):
            # A trajectory has three steps or more; contacts after ``within_s`` do not trigger the brake.
            poses = replace(self.actions, steps=max(steps, 3)).plan(action.reshape(-1, 3)).reshape(-1, 3)
            speeds = jnp.linalg.norm(jnp.diff(poses[:, :2], axis=0), axis=-1) / DT_S
            return jnp.column_stack([poses, jnp.concatenate([motion[MOTION_SPEED:], speeds])])

        def step(state: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
            motion, last_action = state
            executed_action = self.actions.actuate(motion, action, last_action, length_m)
            return (self.actions.move(motion, executed_action, length_m), executed_action), motion

        (end, _), motions = jax.lax.scan(step, (motion, last_action), None, steps)
        return jnp.concatenate([motions, end[None]])
