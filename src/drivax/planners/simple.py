"""Reference planners: the expert (replayed or driven), constant velocity, and random actions."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.planners.planner import Memoryless, RuleBased
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record, static
from drivax.simulator.types import AgentContext, SimState, Situation
from drivax.tasks.actions import ActionSpace, Physical


def logged_motion(bank: ScenarioBank, context: AgentContext, ahead: int) -> Float[Array, "4"]:
    """Return the logged motion of the agent ``ahead`` steps from now; its present motion where the log has none.

    Beyond the end of the log its last motion continues at constant velocity.
    """
    at = context.step + ahead
    logged = bank.agents[context.index, jnp.minimum(at, bank.steps - 1), context.slot]
    heading, velocity = logged[AgentColumn.HEADING], logged[AgentColumn.VELOCITY]
    speed = jnp.maximum(jnp.sum(velocity * heading), 0.0)
    beyond_s = jnp.maximum(at - (bank.steps - 1), 0) * 0.1
    xy = logged[AgentColumn.XY] + beyond_s * velocity
    motion = jnp.stack([xy[0], xy[1], jnp.arctan2(logged[AgentColumn.SIN], logged[AgentColumn.COS]), speed])
    return jnp.where(logged[AgentColumn.VALID] > 0, motion, context.history[-1])


def expert_action(bank: ScenarioBank, context: AgentContext, actions: ActionSpace) -> Float[Array, " D"]:
    """Return the action that follows the log from here; not clipped, for ``actions.clipped``."""
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

    def act(
        self, carry: Any, bank: ScenarioBank, state: SimState, situation: Situation, observation: Any,
        key: Array,
    ) -> tuple[Float[Array, " D"], Any]:  # fmt: skip
        """Return the action that follows the log."""
        return expert_action(bank, state.context, self.actions), carry


@record
class ConstantVelocity(RuleBased):
    """Keeps speed and heading."""

    actions: ActionSpace = static(default=Physical())
    name: str = static(default="constant_velocity")
    replays: bool = static(default=False)

    def controls(self, bank: ScenarioBank, situation: Situation) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return zeros."""
        return jnp.zeros(()), jnp.zeros(())


@record
class RandomActions(Memoryless):
    """Draws actions uniformly from the action space, independently at every step."""

    name: str = static(default="random")
    replays: bool = static(default=False)

    def act(
        self, carry: Any, bank: ScenarioBank, state: SimState, situation: Situation, observation: Any,
        key: Array,
    ) -> tuple[Float[Array, " D"], Any]:  # fmt: skip
        """Return independent numbers in [-1, 1)."""
        return jax.random.uniform(key, state.context.action.shape, minval=-1.0, maxval=1.0), carry
