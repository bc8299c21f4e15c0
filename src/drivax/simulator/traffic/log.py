"""How agents that are not motion move. ``log``: they replay; they appear and disappear as recorded.

Others: ``simulator.traffic.reactive`` (``idm``) and ``simulator.traffic.override``; ``simulator.traffic.catalogue``
knows them by name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.scenario.bank.columns import AgentColumn, SizeColumn
from drivax.scenario.bank.scenario_bank import WORD, ScenarioBank
from drivax.simulator.types import HISTORY, AgentContext, Frame


@dataclass(frozen=True)
class LogTraffic:
    """The others replay the recording and do not react."""

    name: str = "log"

    def start(self, bank: ScenarioBank, index: Any, step: Any) -> tuple[()]:
        """Nothing: the bank and the step say it all."""
        return ()

    def advance(self, bank: ScenarioBank, context: AgentContext, frame: Frame) -> tuple[()]:
        """Nothing."""
        return ()

    def agents(self, bank: ScenarioBank, context: AgentContext, back: int) -> Float[Array, "A 8"]:
        """The logged rows ``back`` steps ago; steps before the recording repeat its first one."""
        return bank.agents[context.index, jnp.clip(context.step - back, 0, bank.steps - 1)]


def logged_history(bank: ScenarioBank, index: Any, step: Any, slot: Any) -> Float[Array, "history 4"]:
    """The logged motions of a slot up to ``step``, as many as a context holds.

    Where the log does not reach back (before its start, or before the agent appeared) the motion is extended
    backwards at the velocity of the earliest known step.
    """
    at = step - jnp.arange(HISTORY - 1, -1, -1)
    rows = bank.agents[index, jnp.clip(at, 0, bank.steps - 1), slot]
    known = (rows[:, AgentColumn.VALID] > 0) & (at >= 0)
    # The earliest row of the unbroken stretch that ends now.
    unbroken = jnp.flip(jnp.cumprod(jnp.flip(known.astype(jnp.int32)))) > 0
    first = jnp.minimum(HISTORY - jnp.sum(unbroken), HISTORY - 1)
    base = rows[first]
    missing = (first - jnp.arange(HISTORY))[:, None] * 0.1
    heading = jnp.arctan2(rows[:, AgentColumn.SIN], rows[:, AgentColumn.COS])
    speed = jnp.sum(rows[:, AgentColumn.VELOCITY] * rows[:, AgentColumn.HEADING], axis=-1)
    own = jnp.stack(
        [rows[:, AgentColumn.X], rows[:, AgentColumn.Y], heading, jnp.maximum(speed, 0.0)], axis=-1
    )
    extended = own[first] - missing * jnp.stack([base[5], base[6], jnp.zeros(()), jnp.zeros(())])
    return jnp.where(unbroken[:, None], own, extended)


def frame_of(
    bank: ScenarioBank, index: Any, step: Any, agents: Float[Array, "A 8"], driven: AgentContext, back: int
) -> Frame:
    """Return the frame at one step from traffic rows, driven agents and parked agents.

    Args:
        bank: The scenarios.
        index: Row of the bank.
        step: The present step; the frame is that of ``step - back``.
        agents: Rows of the moving slots, from the traffic model.
        driven: Contexts of all driven agents of the scenario, stacked ``[K]``; slots beyond the last are empty.
        back: Steps ago, 0 to 15; reactive traffic remembers 9.
    """
    motion = driven.history[:, HISTORY - 1 - back]
    cos, sin = jnp.cos(motion[:, 2]), jnp.sin(motion[:, 2])
    present = jnp.ones_like(cos)
    # Heights apart: measuring changes them alone, so that the rest of the frame before and after it is computed once.
    rows = [motion[:, 0], motion[:, 1], jnp.zeros_like(present), cos, sin]
    rows += [motion[:, 3] * cos, motion[:, 3] * sin, present]
    # Before the recording no other agent was seen.
    agents = agents.at[:, AgentColumn.VALID].mul(step >= back)
    z = agents[:, AgentColumn.Z].at[driven.slot].set(driven.z, mode="drop")
    agents = agents.at[driven.slot].set(jnp.stack(rows, axis=-1), mode="drop")
    box = bank.agent_box[index]
    at = jnp.clip(step - back, 0, bank.steps - 1)
    bit = bank.parked_when[index, at // WORD] >> (at % WORD).astype(jnp.uint32)
    there = (bit & 1 > 0) & (step >= back)
    parked, more = bank.parked[index], len(box) - len(agents)
    z = jnp.where(there, parked[:, AgentColumn.Z], jnp.pad(z, (0, more)))
    agents = jnp.where(there[:, None], parked, jnp.pad(agents, ((0, more), (0, 0))))
    return Frame(
        box=jnp.concatenate(
            [agents[:, AgentColumn.XY], agents[:, AgentColumn.HEADING], box[:, SizeColumn.FOOTPRINT]], axis=-1
        ),
        velocity=agents[:, AgentColumn.VELOCITY],
        z=z,
        valid=agents[:, AgentColumn.VALID] > 0,
        kind=box[:, SizeColumn.KIND].astype(jnp.int32),
        lights=jnp.where(step >= back, bank.light_state[index, at], -1),
    )


def alone(context: AgentContext) -> AgentContext:
    """Stack the context of a single driven agent."""
    return jax.tree.map(lambda leaf: leaf[None], context)
