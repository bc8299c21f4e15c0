"""Traffic in which some agents follow given trajectories or actions (``override``)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.errors import UsageError
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.queries import around_lanes
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.traffic.bank_data import TrafficData, data_of, prepare_bank, with_data
from drivax.simulator.traffic.log import LogTraffic, agent_rows, logged_history
from drivax.simulator.types import AgentContext, Traffic

#: Cure for a bank without overrides.
_CURE = "use override.with_override"
#: Function from motion, action and length (m) to the next motion, such as ``Task.motion``.
Move = Callable[[Float[Array, " 4"], Float[Array, " D"], Any], Float[Array, " 4"]]


@record
class OverrideMotions(TrafficData):
    """Trajectories of K agents of every scenario."""

    slot: Int[Array, "N K"]  # Their slots, -1 for none
    motion: Float[Array, "N T K 4"]  # x, y, heading, speed
    z: Float[Array, "N T K"]  # Height of the box centre, m
    valid: Bool[Array, "N T K"]


@dataclass(frozen=True)
class OverrideTraffic:
    """Agents of :class:`OverrideMotions` follow their trajectories; all others behave as in ``base``.

    In reactive traffic the others avoid them.
    """

    base: Traffic = field(default_factory=LogTraffic)

    @property
    def name(self) -> str:
        """``override``, followed by the name of another base than the log (``override+idm``)."""
        return "override" if self.base.name == "log" else f"override+{self.base.name}"

    def prepare(self, bank: ScenarioBank) -> ScenarioBank:
        """Return the bank with the data of ``base``."""
        return prepare_bank(self.base, bank)

    def start(self, bank: ScenarioBank, index: Any, step: Any) -> Any:
        """Return the state of ``base``."""
        data_of(bank, OverrideMotions, _CURE)
        return self.base.start(bank, index, step)

    def advance(self, bank: ScenarioBank, context: AgentContext, frame: Any) -> Any:
        """Return the state of ``base`` one step later."""
        return self.base.advance(bank, context, frame)

    def agents(self, bank: ScenarioBank, context: AgentContext, back: int) -> Float[Array, "A 8"]:
        """Return the rows of ``base``, replaced by those of the override for its agents."""
        rows, override = self.base.agents(bank, context, back), data_of(bank, OverrideMotions, _CURE)
        step = jnp.clip(context.step - back, 0, bank.steps - 1)
        key, slot = (context.index, step), override.slot[context.index]
        new_rows = agent_rows(override.motion[key], override.z[key], override.valid[key].astype(jnp.float32))
        return rows.at[jnp.where(slot >= 0, slot, rows.shape[0])].set(new_rows, mode="drop")


def with_override(
    bank: ScenarioBank, slots: Int[Array, "N K"], motion: Float[Array, "N T K 4"],
    valid: Bool[Array, "N T K"] | None = None,
) -> ScenarioBank:  # fmt: skip
    """Return the bank with trajectories of some agents, differentiable with respect to ``motion``.

    ``motion`` is x, y (m), heading (rad), speed (m/s) at every step of the log, with the mask ``valid`` (by default
    all); ``slots`` are moving agents of each scenario, -1 for none. Heights follow the nearest lane on the level of the
    step before, starting at the agent's first logged height.

    Raises:
        UsageError: ``motion`` has another number of scenarios or steps than the bank.
    """
    if motion.shape[:2] != (len(bank), bank.steps):
        problem = f"motion of {motion.shape[0]} scenarios and {motion.shape[1]} steps"
        raise UsageError(problem, cure=f"use those of the bank, {len(bank)} and {bank.steps}")
    valid = jnp.ones(motion.shape[:3], bool) if valid is None else valid
    slots = jnp.asarray(slots, jnp.int32)

    def heights(index: Array, slot: Array, motion: Float[Array, "T 4"]) -> Float[Array, " T"]:
        """Return the heights of one agent's box centre along its trajectory."""
        slot = jnp.maximum(slot, 0)
        first_step = jnp.argmax(bank.agents[index, :, slot, AgentColumn.VALID] > 0)
        half_height = bank.height_m(index, slot) / 2

        def climb(ground: Array, pose: Array) -> tuple[Array, Array]:
            """Return the heights of the ground at a pose, on the level of the last one, and of the box centre."""
            heading = jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
            ground = around_lanes(bank, index, pose[:2], heading, pose[None, :2], ground).z
            return ground, ground + half_height

        ground = bank.agents[index, first_step, slot, AgentColumn.Z] - half_height
        return jax.lax.scan(climb, ground, jax.lax.stop_gradient(motion))[1]

    z = jax.vmap(jax.vmap(heights, (None, 0, 1), 1))(jnp.arange(len(bank)), slots, motion)
    return with_data(bank, OverrideMotions(slots, motion, z, valid))


def motions_of_actions(
    bank: ScenarioBank, slots: Int[Array, "N K"], actions: Float[Array, "N steps K D"], move: Move,
    begin: int = CURRENT_STEP,
) -> Float[Array, "N T K 4"]:  # fmt: skip
    """Return the trajectories of agents that follow the log until step ``begin`` and then execute actions.

    Differentiable with respect to ``actions``: one per step, the last one is repeated. ``move`` is the dynamics of the
    action space, such as ``Task().motion``. ``slots`` are moving agents of each scenario, -1 for none. An agent that
    the log lacks at ``begin`` starts at its last valid step before, or else at its first. Until ``begin`` it has the 22
    steps before its start as logged; before them the earliest motion is repeated.

    Raises:
        UsageError: ``begin`` is not a step of the log, or there are no actions.
    """
    if not 0 <= begin < bank.steps or not actions.shape[1]:
        problem = f"{actions.shape[1]} actions from step {begin} on, in a log of {bank.steps} steps"
        raise UsageError(problem, cure="give one action or more, from a step of the log on")
    steps = bank.steps - 1 - begin
    action_index = jnp.minimum(jnp.arange(steps), actions.shape[1] - 1)

    def drive(index: Array, slot: Array, actions: Float[Array, "steps D"]) -> Float[Array, "T 4"]:
        """Return the trajectory of one agent."""
        slot = jnp.maximum(slot, 0)
        # Rows that are not valid are zero: start from the last valid step until ``begin``, or from the first one.
        valid, log_steps = bank.agents[index, :, slot, AgentColumn.VALID] > 0, jnp.arange(bank.steps)
        last_valid = jnp.max(jnp.where(valid & (log_steps <= begin), log_steps, -1))
        past = logged_history(bank, index, jnp.where(last_valid >= 0, last_valid, jnp.argmax(valid)), slot)
        length_m = bank.length_m(index, slot)

        def advance(motion: Array, action: Array) -> tuple[Array, Array]:
            next_motion = move(motion, action, length_m)
            return next_motion, next_motion

        future = jax.lax.scan(advance, past[-1], actions[action_index])[1]
        before = jnp.concatenate([jnp.repeat(past[:1], max(begin + 1 - len(past), 0), 0), past])[-begin - 1 :]
        return jnp.concatenate([before, future])

    return jax.vmap(jax.vmap(drive, (None, 0, 1), 1))(jnp.arange(len(bank)), jnp.asarray(slots), actions)
