"""IDM along the route: follows its leader, stops for red lights, slows down in curves and steers by pure pursuit."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.planners.planner import RuleBased
from drivax.scenario.bank.columns import RouteColumn
from drivax.scenario.bank.queries import route_ahead
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record, static
from drivax.simulator.ahead import ahead
from drivax.simulator.idm import IdmParameters
from drivax.simulator.types import MOTION_SPEED, Situation
from drivax.tasks.actions import ActionSpace, Physical


@record
class IdmPlanner(RuleBased):
    """A rule-based planner that uses the true situation, not observations.

    Its desired speed is the limit, 13.4 m/s where none is known. In a scenario without a route on lanes it follows the
    path of the log.
    """

    actions: ActionSpace = static(default=Physical())
    parameters: IdmParameters = static(default=IdmParameters())
    name: str = static(default="idm")
    replays: bool = static(default=False)

    def controls(self, bank: ScenarioBank, situation: Situation) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return IDM acceleration and pure-pursuit curvature."""
        context, frame = situation.context, situation.surroundings.frame
        me, speed = frame.box[context.slot], context.history[-1, MOTION_SPEED]
        seen = ahead(bank, context, frame, self.parameters.min_gap_m)
        ahead_m = jnp.clip(0.8 * speed + 3.0, 4.0, 20.0)
        left_m = bank.route_points[context.index, 0] - 1 - context.route_m
        ahead_m = jnp.minimum(ahead_m, jnp.maximum(left_m, 0.0))
        points, _ = route_ahead(bank, context.index, context.route_m, ahead_m[None])
        return seen.acceleration(speed, self.parameters), pursuit(me, points[0, RouteColumn.XY] - me[:2])


def pursuit(me: Float[Array, " pose"], target: Float[Array, " 2"]) -> Float[Array, ""]:
    """Return the curvature of the arc from a pose or box to a point relative to it; 0 where the point lies behind.

    Pure pursuit (Coulter 1992): k = 2 y / L^2, with the point at (x, y) in the box's frame and L away.
    """
    forward = target[0] * me[2] + target[1] * me[3]
    left = target[1] * me[2] - target[0] * me[3]
    arc = 2.0 * left / jnp.maximum(forward * forward + left * left, 1.0)
    return jnp.where(forward > 1.0, arc, 0.0)
