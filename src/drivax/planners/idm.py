"""IDM along the route: follows the nearest thing on the route, stops for red, slows for curves, pursues the route."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.planners.planner import Memoryless
from drivax.scenario.bank.columns import RouteColumn
from drivax.scenario.bank.queries import route_ahead
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record, static
from drivax.simulator.ahead import ahead
from drivax.simulator.idm import IdmParameters
from drivax.simulator.types import MOTION_SPEED, SimState, Situation
from drivax.tasks.actions import ActionSpace, Physical


@record
class IdmPlanner(Memoryless):
    """A rule-based driver; uses the situation's truth, not observations.

    Where no limit is known it wants 13.4 m/s, the limit of a surface street; where a scenario has no
    route on lanes it follows the path that the log takes.
    """

    actions: ActionSpace = static(default=Physical())
    parameters: IdmParameters = static(default=IdmParameters())
    name: str = static(default="idm")
    replays: bool = static(default=False)

    def act(
        self,
        carry: Any,
        bank: ScenarioBank,
        state: SimState,
        situation: Situation,
        observation: Any,
        key: Array,
    ) -> tuple[Float[Array, " D"], Any]:
        """IDM acceleration and pure-pursuit curvature."""
        context, frame = situation.context, situation.surroundings.frame
        me, motion = frame.box[context.slot], context.history[-1]
        speed = motion[MOTION_SPEED]
        seen = ahead(bank, context, frame, self.parameters.min_gap_m)
        ahead_m = jnp.clip(0.8 * speed + 3.0, 4.0, 20.0)
        left_m = bank.route_points[context.index, 0] - 1 - context.route_m
        ahead_m = jnp.minimum(ahead_m, jnp.maximum(left_m, 0.0))
        target = (
            route_ahead(bank, context.index, context.route_m, ahead_m[None])[0][0, RouteColumn.XY] - me[:2]
        )
        acceleration = seen.acceleration(speed, self.parameters)
        action = self.actions.action(motion, acceleration, pursuit(me, target), me[4])
        return self.actions.actuated(motion, action, context.action), carry


def pursuit(me: Float[Array, " pose"], target: Float[Array, " 2"]) -> Float[Array, ""]:
    """Curvature of the arc from a pose or box to a point that is given relative to it; 0 where that lies behind.

    Pure pursuit (Coulter 1992): k = 2 y / L^2, with the point at (x, y) in the box's frame and L away.
    """
    forward = target[0] * me[2] + target[1] * me[3]
    left = target[1] * me[2] - target[0] * me[3]
    arc = 2.0 * left / jnp.maximum(forward * forward + left * left, 1.0)
    return jnp.where(forward > 1.0, arc, 0.0)
