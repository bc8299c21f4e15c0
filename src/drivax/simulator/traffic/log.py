"""Log replay: all agents that are not driven move, appear and disappear as recorded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from drivax.kernels.bindings import read_frame
from drivax.scenario.bank.columns import AgentColumn, SizeColumn
from drivax.scenario.bank.scenario_bank import WORD, ScenarioBank
from drivax.scenario.schema import DT_S
from drivax.simulator.types import HISTORY, MOTION_HEADING, AgentContext, Frame


@dataclass(frozen=True)
class LogTraffic:
    """All agents that are not driven replay the log."""

    name: str = "log"

    def start(self, bank: ScenarioBank, index: Any, step: Any) -> tuple[()]:
        """Return an empty state: bank and step determine everything."""
        return ()

    def advance(self, bank: ScenarioBank, context: AgentContext, frame: Frame) -> tuple[()]:
        """Return the empty state."""
        return ()

    def agents(self, bank: ScenarioBank, context: AgentContext, back: int) -> Float[Array, "A 8"]:
        """Return the logged rows ``back`` steps ago; steps before the recording repeat its first one."""
        return bank.agents[context.index, jnp.clip(context.step - back, 0, bank.steps - 1)]


def logged_history(bank: ScenarioBank, index: Any, step: Any, slot: Any) -> Float[Array, "history 4"]:
    """Return the last logged motions of a slot up to ``step``.

    Before the start of the log, and before the agent last appeared, the motion is extended backwards at the velocity of
    the step at which it appeared.
    """
    steps = step - jnp.arange(HISTORY - 1, -1, -1)
    rows = bank.agents[index, jnp.clip(steps, 0, bank.steps - 1), slot]
    valid = (rows[:, AgentColumn.VALID] > 0) & (steps >= 0)
    # The rows that are valid without a gap up to ``step``, and the earliest of them.
    is_connected = jnp.flip(jnp.cumprod(jnp.flip(valid.astype(jnp.int32)))) > 0
    first = jnp.minimum(HISTORY - jnp.sum(is_connected), HISTORY - 1)
    missing_s = (first - jnp.arange(HISTORY))[:, None] * DT_S
    heading = jnp.arctan2(rows[:, AgentColumn.SIN], rows[:, AgentColumn.COS])
    speed = jnp.maximum(jnp.sum(rows[:, AgentColumn.VELOCITY] * rows[:, AgentColumn.HEADING], axis=-1), 0.0)
    logged = jnp.stack([rows[:, AgentColumn.X], rows[:, AgentColumn.Y], heading, speed], axis=-1)
    extension = logged[first] - missing_s * jnp.pad(rows[first, AgentColumn.VELOCITY], (0, 2))
    return jnp.where(is_connected[:, None], logged, extension)


def agent_rows(
    motion: Float[Array, "K 4"], z: Float[Array, " K"], valid: Float[Array, " K"]
) -> Float[Array, "K 8"]:
    """Return rows of ``bank.agents`` from motions (x, y, heading, speed), heights and validity."""
    x, y, heading, speed = jnp.moveaxis(motion, -1, 0)
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    return jnp.stack([x, y, z, cos, sin, speed * cos, speed * sin, valid], axis=-1)


def frame_of(
    bank: ScenarioBank, index: Any, step: Any, agents: Float[Array, "A 8"], driven: AgentContext, back: int,
    slots: Int[Array, " S"] | None = None,
) -> Frame:  # fmt: skip
    """Return the frame of ``step - back`` from the traffic model's rows, driven agents and parked agents.

    ``driven`` stacks the contexts of all driven agents of the scenario ``[K]``; slots beyond the moving agents are
    empty. ``back`` is less than ``HISTORY``; reactive traffic remembers 9 steps. ``slots`` selects agents; by default
    all.
    """
    motion, valid = driven.history[:, HISTORY - 1 - back], jnp.ones_like(driven.z)
    rows = agent_rows(motion, jnp.zeros_like(valid), valid)
    log_step = jnp.clip(step - back, 0, bank.steps - 1)
    box, parked, words = bank.agent_box[index], bank.parked[index], bank.parked_when[index, log_step // WORD]
    moving_count, driven_row = len(agents), driven.slot
    if slots is None:
        padding = len(box) - moving_count
    else:
        agents = agents.at[slots].get(mode="fill", fill_value=0.0)
        box, parked, words, padding = box[slots], parked[slots], words[slots], 0
        # Row of each driven agent in the selection; the index past the end, which is dropped, if it has none.
        match = (slots[:, None] == driven.slot) & (slots[:, None] < moving_count)
        row = jnp.where(match, jnp.arange(len(slots))[:, None], 0).sum(axis=0)
        driven_row = jnp.where(match.any(axis=0), row, len(slots))
    # No other agent is valid before the recording.
    agents = agents.at[:, AgentColumn.VALID].mul(step >= back)
    # Heights in their own array: measuring changes only them, so that XLA computes the rest once per step.
    z = agents[:, AgentColumn.Z].at[driven_row].set(driven.z, mode="drop")
    agents = agents.at[driven_row].set(rows, mode="drop")
    is_parked = ((words >> (log_step % WORD).astype(jnp.uint32)) & 1 > 0) & (step >= back)
    z = jnp.where(is_parked, parked[:, AgentColumn.Z], jnp.pad(z, (0, padding)))
    agents = jnp.where(is_parked[:, None], parked, jnp.pad(agents, ((0, padding), (0, 0))))
    columns = [agents[:, AgentColumn.XY], agents[:, AgentColumn.HEADING], box[:, SizeColumn.FOOTPRINT]]
    return Frame(
        box=jnp.concatenate(columns, axis=-1),
        velocity=agents[:, AgentColumn.VELOCITY],
        z=z,
        valid=agents[:, AgentColumn.VALID] > 0,
        kind=box[:, SizeColumn.KIND].astype(jnp.int32),
        lights=jnp.where(step >= back, bank.light_state[index, log_step], -1),
    )


def present_frame(bank: ScenarioBank, context: AgentContext, driven: AgentContext) -> Frame:
    """Return the present frame with a single driven agent, by the native kernel; all others replay the log."""
    logs = (bank.agents, bank.agent_box, bank.parked, bank.parked_when, bank.light_state)
    motion, slot = driven.history[0, -1], driven.slot[0]
    heading = motion[MOTION_HEADING]
    direction = jnp.stack([jnp.cos(heading), jnp.sin(heading)])
    agents, lights = read_frame(logs, context.index, context.step, slot, motion, direction)
    is_driven = (jnp.arange(len(agents.z)) == slot) & (slot < bank.agents.shape[2])
    return Frame(*agents._replace(z=jnp.where(is_driven, driven.z[0], agents.z)), lights)


def alone(context: AgentContext) -> AgentContext:
    """Stack the context of a single driven agent."""
    return jax.tree.map(lambda leaf: leaf[None], context)
