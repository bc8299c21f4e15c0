"""Reference planners: the expert (replayed or driven), constant velocity, random actions, and IDM along the route."""

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
from drivax.simulator.ahead import ahead
from drivax.simulator.idm import IdmParameters
from drivax.simulator.types import MOTION_SPEED, Action, AgentContext, Motion, Situation
from drivax.tasks.actions import ActionSpace, Physical, Trajectory


def logged_motion(bank: ScenarioBank, context: AgentContext, ahead: int) -> Motion:
    """Return the logged motion of the agent ``ahead`` steps from now; its present motion where the log has none.

    Beyond the end of the log its last motion continues at constant velocity.
    """
    at, last = context.step + ahead, bank.last_step[context.index]
    logged = bank.agents[context.index, jnp.minimum(at, last), context.slot]
    heading, velocity = logged[AgentColumn.HEADING], logged[AgentColumn.VELOCITY]
    speed = jnp.maximum(jnp.sum(velocity * heading), 0.0)
    beyond_s = jnp.maximum(at - last, 0) * 0.1
    xy = logged[AgentColumn.XY] + beyond_s * velocity
    motion = jnp.stack([xy[0], xy[1], jnp.arctan2(logged[AgentColumn.SIN], logged[AgentColumn.COS]), speed])
    return jnp.where(logged[AgentColumn.VALID] > 0, motion, context.history[-1])


def logged_poses(bank: ScenarioBank, context: AgentContext, steps: int) -> Float[Array, "steps1 3"]:
    """Return the logged poses from now on; gaps and the time after the log continue at constant velocity."""
    logged, time = bank.agents[context.index, :, context.slot], jnp.arange(bank.steps)
    seen = jax.lax.cummax(jnp.where(logged[:, AgentColumn.VALID] > 0, time, 0))
    at = context.step + jnp.arange(steps + 1)
    last = seen[jnp.minimum(at, bank.steps - 1)]
    row = logged[last]
    xy = row[:, AgentColumn.XY] + ((at - last) * DT_S)[:, None] * row[:, AgentColumn.VELOCITY]
    heading = jnp.arctan2(row[:, AgentColumn.SIN], row[:, AgentColumn.COS])
    return jnp.concatenate([xy, heading[:, None]], axis=1)


def expert_action(bank: ScenarioBank, context: AgentContext, actions: ActionSpace) -> Action:
    """Return the action that follows the log from here; not clipped, for ``actions.exceeds_bounds``."""
    if isinstance(actions, Trajectory):
        return actions.plan(logged_poses(bank, context, actions.steps))
    ahead, beyond = logged_motion(bank, context, 1), logged_motion(bank, context, 2)
    return actions.expert(context.history[-1], ahead, beyond, bank.length_m(context.index, context.slot))


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
    """Keeps speed and heading."""

    actions: ActionSpace = static(default=Physical())
    name: str = static(default="constant_velocity")

    def controls(self, bank: ScenarioBank, situation: Situation) -> tuple[Scalar, Scalar]:
        """Return zeros."""
        return jnp.zeros(()), jnp.zeros(())


@record
class RandomActions(Memoryless):
    """Draws actions uniformly from the action space, independently at every step."""

    name: str = static(default="random")

    def choose(self, bank: ScenarioBank, situation: Situation, observation: Any, key: Array) -> Action:
        """Return independent numbers in [-1, 1)."""
        return jax.random.uniform(key, situation.context.action.shape, minval=-1.0, maxval=1.0)


@record
class IdmPlanner(RuleBased):
    """Follow the leader along the route by IDM, stop for red lights, slow down in curves, steer by pure pursuit.

    Reads the true situation, not observations. The desired speed is the limit, 13.4 m/s where none is known. In a
    scenario without a route on lanes it follows the path of the log.
    """

    actions: ActionSpace = static(default=Physical())
    parameters: IdmParameters = static(default=IdmParameters())
    name: str = static(default="idm")

    def controls(self, bank: ScenarioBank, situation: Situation) -> tuple[Scalar, Scalar]:
        """Return IDM acceleration and pure-pursuit curvature."""
        context, frame = situation.context, situation.surroundings.frame
        me, speed = frame.box[context.slot], context.history[-1, MOTION_SPEED]
        seen = ahead(bank, context, frame, self.parameters.min_gap_m)
        ahead_m = jnp.clip(0.8 * speed + 3.0, 4.0, 20.0)
        left_m = bank.route_points[context.index, 0] - 1 - context.route_m
        ahead_m = jnp.minimum(ahead_m, jnp.maximum(left_m, 0.0))
        points, _ = route_ahead(bank, context.index, context.route_m, ahead_m[None])
        return seen.acceleration(speed, self.parameters), pursuit(me, points[0, RouteColumn.XY] - me[:2])


def pursuit(me: Float[Array, " pose"], target: Float[Array, " 2"]) -> Scalar:
    """Return the curvature of the arc from a pose or box to a point relative to it; 0 where the point lies behind.

    Pure pursuit (Coulter 1992): k = 2 y / L^2, with the point at (x, y) in the box's frame and L away.
    """
    forward = target[0] * me[2] + target[1] * me[3]
    left = target[1] * me[2] - target[0] * me[3]
    arc = 2.0 * left / jnp.maximum(forward * forward + left * left, 1.0)
    return jnp.where(forward > 1.0, arc, 0.0)
