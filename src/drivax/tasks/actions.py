"""Action spaces: meaning and bounds of actions, their dynamics, and expert actions.

:class:`Physical` (default) and :class:`Discrete` drive the kinematic bicycle by acceleration and curvature,
:class:`Published` by acceleration and steering angle, :class:`Route` by acceleration and lateral offset from the route.
:class:`DeltaLocal` displaces the agent, :class:`DirectState` sets its state, :class:`Trajectory` has planned poses,
which a controller tracks. Except for the last two, actions are in [-1, 1], and a component of 0 is a quantity of 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.checks import check_at_most
from drivax.errors import UsageError
from drivax.geometry.vectors import wrap
from drivax.scenario.bank.scenario_bank import Integer, Scalar, ScenarioBank, Vector
from drivax.scenario.schema import DT_S
from drivax.simulator import controller
from drivax.simulator.ahead import follow_route, offset_to_steer
from drivax.simulator.controller import TrackingConfig
from drivax.simulator.dynamics import bicycle, command_between, displace, displacement, follow
from drivax.simulator.types import Action, AgentContext, History, Motion

#: Wheelbase as a share of the length, for steering angles of ``published``.
_WHEELBASE = 0.6
#: Largest number of levels of each component of :class:`Discrete`, and of steps of :class:`Trajectory`.
MOST_LEVELS, MOST_TRAJECTORY_STEPS = 255, 1000
#: Tolerance of the bounds [-1, 1].
_ROUNDING = 1e-4
#: Tolerance of backward displacements, m.
_BACKWARD_M = 1e-3
#: Lower bound of lengths in divisors, m: empty slots have length 0.
_LEAST_LENGTH_M = 1.0


@dataclass(frozen=True)
class Physical:
    """Acceleration and curvature of the bicycle.

    Attributes:
        braking_mps2, acceleration_mps2: Braking at -1 and acceleration at +1 of the first component.
        steering: Curvature at 1 of the second component, 1/m.
        jerk_mps3: Largest change of the acceleration per second; unlimited by default.
        steering_rate: Largest change of the curvature per second, 1/m/s; unlimited by default.
    """

    size: ClassVar[int] = 2
    braking_mps2: float = 6.0
    acceleration_mps2: float = 6.0
    steering: float = 0.3
    jerk_mps3: float | None = None
    steering_rate: float | None = None

    def __post_init__(self) -> None:
        _check_positive(self, "braking_mps2", "acceleration_mps2", "steering", "jerk_mps3", "steering_rate")

    def command(self, action: Vector, length_m: Any) -> tuple[Scalar, Scalar]:
        """Return acceleration (m/s2) and curvature (1/m) of an action, clipped to [-1, 1]."""
        acceleration, steering = self._quantities(jnp.clip(action, -1.0, 1.0))
        return acceleration, self._curvature(steering, length_m)

    def action(self, motion: Motion, acceleration: Scalar, curvature: Scalar, length_m: Any) -> Vector:
        """Return the action of an acceleration and a curvature, not clipped."""
        return self._action(acceleration, self._steering(curvature, length_m))

    def expert(self, motion: Motion, target: Motion, next_target: Motion, length_m: Any) -> Vector:
        """Return the action that follows the log, from its motions one and two steps ahead; not clipped."""
        return self.action(motion, *follow(motion, target, next_target), length_m)

    def exceeds_bounds(self, action: Vector) -> Bool[Array, ""]:
        """Return whether an action is outside the bounds."""
        return (jnp.abs(action) > 1.0 + _ROUNDING).any()

    def actuate(self, motion: Motion, action: Vector, last: Vector, length_m: Any) -> Vector:
        """Clip an action to the bounds, and to the actuator rates given the last executed action.

        At standstill, the last acceleration counts as at least zero.
        """
        action = jnp.clip(action, -1.0, 1.0)
        if self.jerk_mps3 is None and self.steering_rate is None:
            return action
        acceleration, steering = self._quantities(action)
        last_acceleration, last_steering = self._quantities(last)
        last_acceleration = jnp.where(motion[3] > 0.0, last_acceleration, jnp.maximum(last_acceleration, 0.0))
        if self.jerk_mps3 is not None:
            limit = self.jerk_mps3 * DT_S
            acceleration = jnp.clip(acceleration, last_acceleration - limit, last_acceleration + limit)
        if self.steering_rate is not None:
            limit = self.steering_rate * DT_S
            steering = jnp.clip(steering, last_steering - limit, last_steering + limit)
        return self._action(acceleration, steering)

    def move(self, motion: Motion, action: Vector, length_m: Any) -> Motion:
        """Return the motion one step later."""
        return bicycle(motion, *self.command(action, length_m))

    def max_curvature(self, length_m: Any) -> Any:
        """Return the largest curvature, 1/m."""
        return self._curvature(jnp.asarray(self.steering), length_m)

    def first(self, history: History, length_m: Any) -> Vector:
        """Return the action before an episode starts: with rate limits that of the history's last step, else zero."""
        if self.jerk_mps3 is None and self.steering_rate is None:
            return jnp.zeros(2)
        command = command_between(history[-2], history[-1])
        return jnp.clip(self.action(history[-1], *command, length_m), -1.0, 1.0)

    def _quantities(self, action: Vector) -> tuple[Scalar, Scalar]:
        """Return acceleration (m/s2) and steering, in the unit of ``steering``."""
        scale = jnp.where(action[0] < 0, self.braking_mps2, self.acceleration_mps2)
        return action[0] * scale, action[1] * self.steering

    def _action(self, acceleration: Scalar, steering: Scalar) -> Vector:
        """Return the action of acceleration and steering; the inverse of :meth:`_quantities`."""
        scale = jnp.where(acceleration < 0, self.braking_mps2, self.acceleration_mps2)
        return jnp.stack([acceleration / scale, steering / self.steering])

    def _curvature(self, steering: Scalar, length_m: Any) -> Scalar:
        """Return the curvature of a steering command, 1/m: the command itself in this action space."""
        return steering

    def _steering(self, curvature: Scalar, length_m: Any) -> Scalar:
        """Return the steering command of a curvature; the inverse of :meth:`_curvature`."""
        return curvature


@dataclass(frozen=True)
class Published(Physical):
    """Acceleration and steering angle, as published: k = tan(angle) / (0.6 length).

    Attributes:
        braking_mps2, acceleration_mps2: Braking at -1 and acceleration at +1 of the first component.
        steering: Steering angle at 1 of the second component, rad.
        jerk_mps3: Largest change of the acceleration per second; unlimited by default.
        steering_rate: Largest change of the steering angle per second, rad/s; unlimited by default.
    """

    braking_mps2: float = 4.0
    acceleration_mps2: float = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steering >= math.pi / 2:
            raise UsageError(f"steering is {self.steering:g} rad", cure="use less than a right angle (1.57)")

    def _curvature(self, steering: Scalar, length_m: Any) -> Scalar:
        return jnp.tan(steering) / (_WHEELBASE * jnp.maximum(length_m, _LEAST_LENGTH_M))

    def _steering(self, curvature: Scalar, length_m: Any) -> Scalar:
        return jnp.arctan(curvature * _WHEELBASE * jnp.maximum(length_m, _LEAST_LENGTH_M))


@dataclass(frozen=True)
class Discrete(Physical):
    """``physical`` with discrete levels: the nearest level is executed.

    Level i of n, counted from the middle, is ``sign(i) (|i| / ((n - 1) / 2)) ** density`` of the bound.

    Attributes:
        accelerations, curvatures: Number of levels of each component; odd, to include zero.
        density: Exponent of the levels: 1 spaces them evenly, more makes them denser near zero.
    """

    accelerations: int = 7
    curvatures: int = 13
    density: float = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = (self.accelerations, self.curvatures)
        if not 3 <= min(counts) <= max(counts) <= MOST_LEVELS or any(count % 2 == 0 for count in counts):
            problem = f"{self.accelerations} x {self.curvatures} levels"
            raise UsageError(problem, cure=f"use odd numbers, at least 3 and at most {MOST_LEVELS}")
        if not self.density >= 1.0:
            raise UsageError(f"density is {self.density:g}", cure="use 1 (even) or more (denser near zero)")

    @property
    def choices(self) -> int:
        """Number of actions."""
        return self.accelerations * self.curvatures

    def levels(self) -> tuple[Float[Array, " A"], Float[Array, " C"]]:
        """Return the levels of both components in [-1, 1], ascending."""
        return _levels(self.accelerations, self.density), _levels(self.curvatures, self.density)

    def of_index(self, index: Integer) -> Vector:
        """Return action number ``index``: acceleration level ``index // curvatures``, curvature level the remainder."""
        accelerations, curvatures = self.levels()
        return jnp.stack([accelerations[index // self.curvatures], curvatures[index % self.curvatures]])

    def index(self, action: Vector) -> Integer:
        """Return the number of the nearest action."""
        accelerations, curvatures = self.levels()
        acceleration_level = jnp.argmin(jnp.abs(accelerations - action[0]))
        return acceleration_level * self.curvatures + jnp.argmin(jnp.abs(curvatures - action[1]))

    def actuate(self, motion: Motion, action: Vector, last: Vector, length_m: Any) -> Vector:
        """Return the nearest discrete action, limited to actuator rates as in :class:`Physical`."""
        return super().actuate(motion, self.of_index(self.index(action)), last, length_m)


@dataclass(frozen=True)
class Route(Physical):
    """Acceleration, and lateral offset from the route on lanes, to which pure pursuit steers the bicycle.

    A policy in this space plans along the route; it does not steer. Zero keeps speed and route. Without a route on
    lanes the offset is from the line straight ahead. The executed action is one of :class:`Physical`.

    Attributes:
        offset_m: Offset at 1 of the second component, to the left, m.
    """

    offset_m: float = 3.5

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_positive(self, "offset_m")

    def steer(self, bank: ScenarioBank, context: AgentContext, action: Vector) -> Vector:
        """Return the action of :class:`Physical` that steers to the offset of an action; only the offset is clipped."""
        offset_m = self.offset_m * jnp.clip(action[1], -1.0, 1.0)
        curvature = follow_route(bank, context, offset_m)
        return jnp.stack([action[0], curvature / self.steering])

    def unsteer(self, bank: ScenarioBank, context: AgentContext, action: Vector) -> Vector:
        """Return the action that :meth:`steer` turns into an action of :class:`Physical`, not clipped."""
        offset_m = offset_to_steer(bank, context, action[1] * self.steering)
        return jnp.stack([action[0], offset_m / self.offset_m])


def _check_positive(space: Any, *names: str) -> None:
    """Check that settings of an action space are positive numbers, or None."""
    for name in names:
        value = getattr(space, name)
        if value is not None and not 0.0 < value < math.inf:
            raise UsageError(f"{name} is {value:g}", cure="use a positive number")


def _levels(count: int, density: float) -> Float[Array, " count"]:
    """Return the levels of :class:`Discrete` in [-1, 1], ascending."""
    half = count // 2
    return jnp.array([math.copysign((abs(i) / half) ** density, i) for i in range(-half, half + 1)])


@dataclass(frozen=True)
class DeltaLocal:
    """Displacement in the agent's frame: ahead (never backwards), left, and turn, without a limit of grip.

    Attributes:
        ahead_m, left_m: Displacements at 1 of the first two components.
        turn_rad: Turn at 1 of the third.
    """

    size: ClassVar[int] = 3
    ahead_m: float = 6.0
    left_m: float = 6.0
    turn_rad: float = math.pi

    def __post_init__(self) -> None:
        _check_positive(self, "ahead_m", "left_m", "turn_rad")

    def action(
        self, motion: Motion, acceleration: Scalar, curvature: Scalar, length_m: Any
    ) -> Float[Array, " 3"]:
        """Return the displacement along an arc of this curvature at the accelerated speed; not clipped."""
        distance = jnp.maximum(motion[3] + acceleration * DT_S, 0.0) * DT_S
        turn = curvature * distance
        return self._action(distance * jnp.stack([jnp.cos(turn / 2), jnp.sin(turn / 2)]), turn)

    def expert(
        self, motion: Motion, target: Motion, next_target: Motion, length_m: Any
    ) -> Float[Array, " 3"]:
        """Return the displacement to the logged motion one step ahead; not clipped."""
        return self._action(*displacement(motion, target))

    def exceeds_bounds(self, action: Float[Array, " 3"]) -> Bool[Array, ""]:
        """Return whether an action is outside the bounds, or moves backwards by more than a millimetre."""
        return (jnp.abs(action) > 1.0 + _ROUNDING).any() | (action[0] * self.ahead_m < -_BACKWARD_M)

    def actuate(
        self, motion: Motion, action: Float[Array, " 3"], last: Float[Array, " 3"], length_m: Any
    ) -> Float[Array, " 3"]:
        """Return the action clipped to its bounds."""
        return jnp.clip(action, jnp.array([0.0, -1.0, -1.0]), 1.0)

    def move(self, motion: Motion, action: Float[Array, " 3"], length_m: Any) -> Motion:
        """Return the motion one step later."""
        action = self.actuate(motion, action, action, length_m)
        shift = action[:2] * jnp.array([self.ahead_m, self.left_m])
        return displace(motion, shift, action[2] * self.turn_rad)

    def max_curvature(self, length_m: Any) -> Any:
        """Return infinity: the curvature is unlimited."""
        return jnp.inf

    def first(self, history: History, length_m: Any) -> Float[Array, " 3"]:
        """Return zeros."""
        return jnp.zeros(3)

    def _action(self, shift: Vector, turn: Scalar) -> Float[Array, " 3"]:
        return jnp.stack([shift[0] / self.ahead_m, shift[1] / self.left_m, turn / self.turn_rad])


@dataclass(frozen=True)
class DirectState:
    """The next motion in the scenario's frame: x, y (m), heading (rad), speed (m/s, negative counts as 0).

    For planners that output trajectories and for trajectory optimisation; not for learning.
    """

    size: ClassVar[int] = 4

    def action(self, motion: Motion, acceleration: Scalar, curvature: Scalar, length_m: Any) -> Motion:
        """Return the motion of the bicycle one step later."""
        return bicycle(motion, acceleration, curvature)

    def expert(self, motion: Motion, target: Motion, next_target: Motion, length_m: Any) -> Motion:
        """Return the logged motion one step ahead."""
        return target

    def exceeds_bounds(self, action: Motion) -> Bool[Array, ""]:
        """Return False."""
        return jnp.zeros((), bool)

    def actuate(self, motion: Motion, action: Motion, last: Motion, length_m: Any) -> Motion:
        """Return the motion with heading in [-pi, pi) and nonnegative speed."""
        return jnp.stack([action[0], action[1], wrap(action[2]), jnp.maximum(action[3], 0.0)])

    def move(self, motion: Motion, action: Motion, length_m: Any) -> Motion:
        """Return the motion one step later."""
        return self.actuate(motion, action, action, length_m)

    def max_curvature(self, length_m: Any) -> Any:
        """Return infinity: the curvature is unlimited."""
        return jnp.inf

    def first(self, history: History, length_m: Any) -> Motion:
        """Return the current motion."""
        return history[-1]


@dataclass(frozen=True)
class Trajectory:
    """Planned poses of the box centre (x, y in m, heading in rad, in the scenario's frame), tracked by a controller.

    An action has the present pose and those of the next ``steps`` steps of 0.1 s. The executed action has the same
    size: the actuator states (``simulator.controller.Actuators``), then zeros.

    Attributes:
        steps: Horizon of a plan, steps.
        controller: nuPlan's LQR and its bicycle about the rear axle.
        initial_steering: Steering angle at the start: zero as in nuPlan, or that of the half second before it.
    """

    steps: int = 80
    controller: TrackingConfig = field(default_factory=TrackingConfig)
    initial_steering: Literal["zero", "logged"] = "zero"

    def __post_init__(self) -> None:
        if self.steps < 3:
            raise UsageError(f"a plan of {self.steps} steps is too short", cure="use steps: 3 or more")
        check_at_most(self, MOST_TRAJECTORY_STEPS, "steps")

    @property
    def size(self) -> int:
        """Length of an action: three numbers per pose."""
        return 3 * (self.steps + 1)

    def plan(self, poses: Float[Array, "n 3"]) -> Float[Array, " D"]:
        """Return the action of two or more poses from the present step on.

        The last velocity continues after the last pose; poses beyond the horizon are dropped.
        """
        shift = poses[-1, :2] - poses[-2, :2]
        step = jnp.arange(1, max(self.steps + 2 - len(poses), 1))[:, None]
        xy, heading = poses[-1, :2] + step * shift, jnp.full_like(step, poses[-1, 2], poses.dtype)
        extension = jnp.concatenate([xy, heading], axis=1)
        return jnp.concatenate([poses, extension])[: self.steps + 1].reshape(-1)

    def action(
        self, motion: Motion, acceleration: Scalar, curvature: Scalar, length_m: Any
    ) -> Float[Array, " D"]:
        """Return the plan of a bicycle with this acceleration and curvature."""

        def step(motion: Motion, _: None) -> tuple[Motion, Motion]:
            motion = bicycle(motion, acceleration, curvature)
            return motion, motion

        motions = jax.lax.scan(step, motion, None, self.steps)[1]
        return self.plan(jnp.concatenate([motion[None], motions])[:, :3])

    def expert(
        self, motion: Motion, target: Motion, next_target: Motion, length_m: Any
    ) -> Float[Array, " D"]:
        """Return the plan of the present and two logged poses; ``expert_action`` plans the whole log."""
        return self.plan(jnp.stack([motion, target, next_target])[:, :3])

    def exceeds_bounds(self, action: Float[Array, " D"]) -> Bool[Array, ""]:
        """Return False."""
        return jnp.zeros((), bool)

    def actuate(
        self, motion: Motion, action: Float[Array, " D"], last: Float[Array, " D"], length_m: Any
    ) -> Float[Array, " D"]:
        """Return the actuator states of the next step of the plan."""
        length_m = jnp.maximum(length_m, _LEAST_LENGTH_M)
        actuators = controller.track(motion, action.reshape(-1, 3), last[:3], length_m, self.controller)
        return jnp.zeros(self.size).at[:3].set(actuators)

    def move(self, motion: Motion, action: Float[Array, " D"], length_m: Any) -> Motion:
        """Return the motion one step later, from an executed action."""
        return controller.propagate(
            motion, action[:3], jnp.maximum(length_m, _LEAST_LENGTH_M), self.controller
        )

    def max_curvature(self, length_m: Any) -> Any:
        """Return the largest curvature of the rear axle, 1/m."""
        return math.tan(self.controller.most_steering) / (
            self.controller.wheelbase * jnp.maximum(length_m, _LEAST_LENGTH_M)
        )

    def first(self, history: History, length_m: Any) -> Float[Array, " D"]:
        """Return the acceleration of the history's last half second, and the initial steering angle."""
        length_m = jnp.maximum(length_m, _LEAST_LENGTH_M)
        actuators = controller.recent_actuators(history, length_m, self.controller)
        if self.initial_steering == "zero":
            actuators = actuators.at[controller.STEERING].set(0.0)
        return jnp.zeros(self.size).at[:3].set(actuators)


#: Types of ``task.actions``; ``kind:`` in YAML is ``physical``, ``published``, ``discrete``, ``route``,
#: ``delta_local``, ``direct_state`` or ``trajectory``.
ActionSpace = Physical | Published | Discrete | Route | DeltaLocal | DirectState | Trajectory

PHYSICAL, PUBLISHED, DISCRETE, ROUTE = Physical(), Published(), Discrete(), Route()
DELTA_LOCAL, DIRECT_STATE = DeltaLocal(), DirectState()


def execute(actions: ActionSpace, bank: ScenarioBank, context: AgentContext, action: Action) -> Action:
    """Return the executed action for a requested action, within bounds and actuator rates."""
    if isinstance(actions, Route):
        action = actions.steer(bank, context, action)
    length_m = bank.length_m(context.index, context.slot)
    return actions.actuate(context.history[-1], action, context.action, length_m)


def action_of(
    actions: ActionSpace, bank: ScenarioBank, context: AgentContext, acceleration: Scalar, curvature: Scalar
) -> Action:
    """Return the action of an acceleration (m/s2) and a curvature (1/m), not clipped."""
    length_m = bank.length_m(context.index, context.slot)
    action = actions.action(context.history[-1], acceleration, curvature, length_m)
    return _request(actions, bank, context, action)


def follow_log(
    actions: ActionSpace, bank: ScenarioBank, context: AgentContext, target: Motion, next_target: Motion
) -> Action:
    """Return the action that follows motions one and two steps ahead (``actions.expert``), not clipped."""
    length_m = bank.length_m(context.index, context.slot)
    action = actions.expert(context.history[-1], target, next_target, length_m)
    return _request(actions, bank, context, action)


def _request(actions: ActionSpace, bank: ScenarioBank, context: AgentContext, action: Action) -> Action:
    """Return the action that requests an executed action, not clipped: in the space ``route``, it has an offset."""
    return actions.unsteer(bank, context, action) if isinstance(actions, Route) else action
