"""Planners that need no thought: the expert, replayed and driven, constant velocity, and random actions."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.planners.planner import Memoryless
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record, static
from drivax.simulator.types import AgentContext, SimState, Situation
from drivax.tasks.actions import ActionSpace, Physical


def logged_motion(bank: ScenarioBank, context: AgentContext, ahead: int) -> Float[Array, "4"]:
    """Logged motion of the driven slot ``ahead`` steps from now; its present motion where the log has none.

    Beyond the end of the log its last motion goes on at its last velocity.
    """
    at = context.step + ahead
    row = bank.agents[context.index, jnp.minimum(at, bank.steps - 1), context.slot]
    speed = jnp.maximum(jnp.sum(row[AgentColumn.VELOCITY] * row[AgentColumn.HEADING]), 0.0)
    beyond = jnp.maximum(at - (bank.steps - 1), 0) * 0.1
    xy = row[AgentColumn.XY] + beyond * row[AgentColumn.VELOCITY]
    motion = jnp.stack([xy[0], xy[1], jnp.arctan2(row[AgentColumn.SIN], row[AgentColumn.COS]), speed])
    return jnp.where(row[AgentColumn.VALID] > 0, motion, context.history[-1])


def expert_action(bank: ScenarioBank, context: AgentContext, actions: ActionSpace) -> Float[Array, " D"]:
    """The action that follows the log from here; not clipped, so that ``actions.clipped`` can say what would be."""
    ahead, beyond = logged_motion(bank, context, 1), logged_motion(bank, context, 2)
    return actions.expert(context.history[-1], ahead, beyond, bank.length_m(context.index, context.slot))


@record
class Expert(Memoryless):
    """The log. ``expert`` replays it exactly; ``expert_actions`` drives it through the dynamics."""

    actions: ActionSpace = static(default=Physical())
    replays: bool = static(default=True)

    @property
    def name(self) -> str:
        """``expert`` or ``expert_actions``."""
        return "expert" if self.replays else "expert_actions"

    def act(
        self,
        carry: Any,
        bank: ScenarioBank,
        state: SimState,
        situation: Situation,
        observation: Any,
        key: Array,
    ) -> tuple[Float[Array, " D"], Any]:
        """Follows the log."""
        action, context = expert_action(bank, state.context, self.actions), state.context
        return self.actions.actuated(context.history[-1], action, context.action), carry


@record
class ConstantVelocity(Memoryless):
    """Keeps speed and heading."""

    actions: ActionSpace = static(default=Physical())
    name: str = static(default="constant_velocity")
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
        """No acceleration, no curvature."""
        context, zero = state.context, jnp.zeros(())
        length_m = bank.length_m(context.index, context.slot)
        return self.actions.action(context.history[-1], zero, zero, length_m), carry


@record
class RandomActions(Memoryless):
    """Draws every action anew, uniform over the action space: what no driver should be worse than."""

    name: str = static(default="random")
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
        """Independent numbers in [-1, 1)."""
        return jax.random.uniform(key, state.context.action.shape, minval=-1.0, maxval=1.0), carry
