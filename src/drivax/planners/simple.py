"""Reference planners: the expert, constant velocity, constant speed, random actions, and IDM along the route."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.planners.planner import Memoryless, RuleBased
from drivax.scenario.bank.columns import AgentColumn, RouteColumn
from drivax.scenario.bank.queries import route_ahead
from drivax.scenario.bank.scenario_bank import Scalar, ScenarioBank
from drivax.scenario.record import record, static
from drivax.scenario.schema import DT_S
from drivax.simulator.ahead import ahead, follow_route, lookahead_m
from drivax.simulator.dynamics import pursuit
from drivax.simulator.idm import IdmParameters
from drivax.simulator.types import MOTION_SPEED, Action, AgentContext, Motion, Situation
from drivax.tasks.actions import ActionSpace, Physical, Trajectory, follow_log


def logged_motion(bank: ScenarioBank, context: AgentContext, steps: int) -> Motion:
    """Return the agent's logged motion after ``steps`` more steps, or its present motion if the log is invalid then.

    After the end of the log, the motion continues at constant velocity.
    """
    step, last = context.step + steps, bank.last_step[context.row]
    state = bank.agents[context.index, jnp.minimum(step, last), context.slot]
    heading, velocity = state[AgentColumn.HEADING], state[AgentColumn.VELOCITY]
    speed = jnp.maximum(jnp.sum(velocity * heading), 0.0)
    time_after_log_s = jnp.maximum(step - last, 0) * DT_S
    xy = state[AgentColumn.XY] + time_after_log_s * velocity
    motion = jnp.stack([xy[0], xy[1], jnp.arctan2(state[AgentColumn.SIN], state[AgentColumn.COS]), speed])
    return jnp.where(state[AgentColumn.VALID] > 0, motion, context.history[-1])


def logged_poses(bank: ScenarioBank, context: AgentContext, steps: int) -> Float[Array, "steps1 3"]:
    """Return the logged poses (x, y, heading) of now and the next ``steps`` steps.

    In gaps and after the log, the last valid pose continues at constant velocity.
    """
    track = bank.agents[context.index, :, context.slot]
    last_valid = jax.lax.cummax(jnp.where(track[:, AgentColumn.VALID] > 0, jnp.arange(bank.steps), 0))
    step = context.step + jnp.arange(steps + 1)
    source_step = last_valid[jnp.minimum(step, bank.steps - 1)]
    states = track[source_step]
    time_s = (step - source_step) * DT_S
    xy = states[:, AgentColumn.XY] + time_s[:, None] * states[:, AgentColumn.VELOCITY]
    heading = jnp.arctan2(states[:, AgentColumn.SIN], states[:, AgentColumn.COS])
    return jnp.concatenate([xy, heading[:, None]], axis=1)


def expert_action(bank: ScenarioBank, context: AgentContext, actions: ActionSpace) -> Action:
    """Return the action that follows the log from the present motion, unclipped (``actions.exceeds_bounds``)."""
    if isinstance(actions, Trajectory):
        return actions.plan(logged_poses(bank, context, actions.steps))
    first, second = logged_motion(bank, context, 1), logged_motion(bank, context, 2)
    return follow_log(actions, bank, context, first, second)


@record
class Expert(Memoryless):
    """The log: ``expert`` replays it exactly, ``expert_actions`` follows it through the dynamics."""

    actions: ActionSpace = static(default=Physical())
    replays: bool = static(default=True)

    @property
    def name(self) -> str:
        """``expert`` or ``expert_actions``."""
        return "expert" if self.replays else "expert_actions"

    def choose(self, bank: ScenarioBank, situation: Situation, observation: Any, key: Array) -> Action:
        """Return the action that follows the log."""
        return expert_action(bank, situation.context, self.actions)


@record
class ConstantVelocity(RuleBased):
    """Keep speed and heading."""

    actions: ActionSpace = static(default=Physical())
    name: str = static(default="constant_velocity")

    def controls(self, bank: ScenarioBank, situation: Situation) -> tuple[Scalar, Scalar]:
        """Return no acceleration and no curvature."""
        return jnp.zeros(()), jnp.zeros(())


@record
class ConstantSpeed(RuleBased):
    """Keep the speed and follow the route by pure pursuit, as an untrained policy does in the space ``route``."""

    actions: ActionSpace = static(default=Physical())
    name: str = static(default="constant_speed")

    def controls(self, bank: ScenarioBank, situation: Situation) -> tuple[Scalar, Scalar]:
        """Return no acceleration, and the curvature of pure pursuit to the route."""
        return jnp.zeros(()), follow_route(bank, situation.context, jnp.zeros(()))


@record
class RandomActions(Memoryless):
    """Draw every component of an action uniformly from [-1, 1), independently at every step.

    In ``delta_local`` negative draws of the first component do not move ahead. ``direct_state`` and ``trajectory`` have
    no such bounds: there the draws mean nothing.
    """

    name: str = static(default="random")

    def choose(self, bank: ScenarioBank, situation: Situation, observation: Any, key: Array) -> Action:
        """Return independent numbers in [-1, 1)."""
        return jax.random.uniform(key, situation.context.action.shape, minval=-1.0, maxval=1.0)


@record
class IdmPlanner(RuleBased):
    """Follow the leader along the route by IDM, stop at lights, slow down in curves, steer by pure pursuit.

    Reads the true situation, not observations. The desired speed is the speed limit (13.4 m/s if unknown), less before
    curves, and 0 at the end of the route. In a scenario without a route on lanes, ego follows the path of the log.
    """

    actions: ActionSpace = static(default=Physical())
    parameters: IdmParameters = static(default=IdmParameters())
    name: str = static(default="idm")

    def controls(self, bank: ScenarioBank, situation: Situation) -> tuple[Scalar, Scalar]:
        """Return IDM acceleration and pure-pursuit curvature."""
        context, frame = situation.context, situation.surroundings.frame
        box, speed = frame.box[context.slot], context.history[-1, MOTION_SPEED]
        obstacles = ahead(bank, context, frame, self.parameters.min_gap_m)
        # Route points are 1 m apart.
        remaining_m = bank.route_points[context.row] - 1 - context.route_m
        distance_m = jnp.minimum(lookahead_m(speed), jnp.maximum(remaining_m, 0.0))
        points, _ = route_ahead(bank, context.row, context.route_m, distance_m[None])
        curvature = pursuit(box, points[0, RouteColumn.XY] - box[:2])
        return obstacles.acceleration(speed, self.parameters), curvature
