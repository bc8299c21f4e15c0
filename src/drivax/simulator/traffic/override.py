"""Agents that follow given motions (``override``): given trajectories, or given actions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.queries import around_lanes
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.traffic.bank_data import TrafficData, data_of, prepare_bank, with_data
from drivax.simulator.traffic.log import LogTraffic, logged_history
from drivax.simulator.types import AgentContext, Traffic

#: Next motion for a motion, an action and a length in metres, such as ``Task.motion``.
Move = Callable[[Float[Array, " 4"], Float[Array, " D"], Any], Float[Array, " 4"]]


@record
class OverrideMotions(TrafficData):
    """Motions of K agents of every scenario.

    Attributes:
        slot: Their slots, -1 for none.
        motion: x, y, heading, speed.
        z: Height of the box centre, m.
        valid: Whether they are there.
    """

    slot: Int[Array, "N K"]
    motion: Float[Array, "N T K 4"]
    z: Float[Array, "N T K"]
    valid: Bool[Array, "N T K"]


@dataclass(frozen=True)
class OverrideTraffic:
    """The agents of :class:`OverrideMotions` follow given motions, every other agent behaves as in ``base``.

    In reactive traffic the others see and avoid them.
    """

    base: Traffic = field(default_factory=LogTraffic)

    @property
    def name(self) -> str:
        """As printed in tables: ``override``, or ``override+idm``."""
        return "override" if self.base.name == "log" else f"override+{self.base.name}"

    def prepare(self, bank: ScenarioBank) -> ScenarioBank:
        """The bank with what ``base`` needs."""
        return prepare_bank(self.base, bank)

    def start(self, bank: ScenarioBank, index: Any, step: Any) -> Any:
        """State of ``base``; the bank says the rest.

        Raises:
            UsageError: If nothing is given in the bank.
        """
        data_of(bank, OverrideMotions, "use override.with_override")
        return self.base.start(bank, index, step)

    def advance(self, bank: ScenarioBank, context: AgentContext, frame: Any) -> Any:
        """State of ``base`` one step later."""
        return self.base.advance(bank, context, frame)

    def agents(self, bank: ScenarioBank, context: AgentContext, back: int) -> Float[Array, "A 8"]:
        """Rows of ``base``, with those of the overridden agents as given."""
        rows, given = self.base.agents(bank, context, back), data_of(bank, OverrideMotions)
        step = jnp.clip(context.step - back, 0, bank.steps - 1)
        motion, valid = given.motion[context.index, step], given.valid[context.index, step]
        cos, sin = jnp.cos(motion[:, 2]), jnp.sin(motion[:, 2])
        parts = [motion[:, 0], motion[:, 1], given.z[context.index, step], cos, sin]
        parts += [motion[:, 3] * cos, motion[:, 3] * sin, valid.astype(cos.dtype)]
        slot = given.slot[context.index]
        slot = jnp.where(slot >= 0, slot, rows.shape[0])
        return rows.at[slot].set(jnp.stack(parts, axis=-1), mode="drop")


def with_override(
    bank: ScenarioBank, slots: Int[Array, "N K"], motion: Float[Array, "N T K 4"],
    valid: Bool[Array, "N T K"] | None = None,
) -> ScenarioBank:  # fmt: skip
    """The bank with given trajectories; heights are those of the nearest lane, from the logged one on.

    Differentiable with respect to ``motion``.

    Args:
        bank: The scenarios.
        slots: Moving agents of each scenario, -1 for none.
        motion: x, y (m), heading (rad), speed (m/s) at every step of the log.
        valid: Whether they are there; always by default.
    """
    valid = jnp.ones(motion.shape[:3], bool) if valid is None else valid
    slots = jnp.asarray(slots, jnp.int32)

    def heights(index: Array, slot: Array, line: Float[Array, "T 4"]) -> Float[Array, " T"]:
        at = jnp.maximum(slot, 0)
        seen = jnp.argmax(bank.agents[index, :, at, AgentColumn.VALID] > 0)
        half = bank.height_m(index, at) / 2

        def climb(ground: Array, pose: Array) -> tuple[Array, Array]:
            heading = jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
            ground = around_lanes(bank, index, pose[:2], heading, pose[None, :2], ground).z
            return ground, ground + half

        line = jax.lax.stop_gradient(line)
        return jax.lax.scan(climb, bank.agents[index, seen, at, AgentColumn.Z] - half, line)[1]

    z = jax.vmap(jax.vmap(heights, (None, 0, 1), 1))(jnp.arange(len(bank)), slots, motion)
    return with_data(bank, OverrideMotions(slots, motion, z, valid))


def motions_of_actions(
    bank: ScenarioBank, slots: Int[Array, "N K"], actions: Float[Array, "N steps K D"], move: Move,
    begin: int = CURRENT_STEP,
) -> Float[Array, "N T K 4"]:  # fmt: skip
    """Trajectories of agents that carry out given actions from step ``begin`` on; as logged until then.

    Differentiable with respect to ``actions``. Agents that were not seen at step ``begin`` begin where they were seen
    last, or first.

    Args:
        bank: The scenarios.
        slots: Moving agents of each scenario, -1 for none.
        actions: One per step from ``begin`` on; after the last one it is repeated.
        move: The dynamics under the action space, such as ``Task().motion``.
        begin: Step of the log at which they take over, at most 15 steps of whose past are kept.
    """
    steps = bank.steps - 1 - begin
    desired = jnp.minimum(jnp.arange(steps), actions.shape[1] - 1)

    def drive(index: Array, slot: Array, acts: Float[Array, "steps D"]) -> Float[Array, "T 4"]:
        at = jnp.maximum(slot, 0)
        past = logged_history(bank, index, begin, at)
        size = bank.length_m(index, at)

        def advance(motion: Array, action: Array) -> tuple[Array, Array]:
            after = move(motion, action, size)
            return after, after

        driven = jax.lax.scan(advance, past[-1], acts[desired])[1]
        before = jnp.concatenate([jnp.repeat(past[:1], max(begin + 1 - len(past), 0), 0), past])[-begin - 1 :]
        return jnp.concatenate([before, driven])

    return jax.vmap(jax.vmap(drive, (None, 0, 1), 1))(jnp.arange(len(bank)), jnp.asarray(slots), actions)
