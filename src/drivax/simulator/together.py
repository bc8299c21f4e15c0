"""Several driven agents in one scenario: selection of slots and padding."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.types import SimState


def slots_of(
    bank: ScenarioBank, index: Any, mask: Bool[Array, " A"], count: int, step: Any = CURRENT_STEP
) -> Int[Array, " K"]:
    """Return K slots of the agents of a mask that the log has at ``step``, padded with A (an empty slot).

    Args:
        bank: The scenarios.
        index: Row of the bank.
        mask: Moving agents to drive.
        count: K; further agents of the mask are left to traffic.
        step: First step.
    """
    there = mask & (bank.agents[index, step, :, AgentColumn.VALID] > 0)
    return jnp.nonzero(there, size=count, fill_value=mask.shape[0])[0].astype(jnp.int32)


def is_driven(bank: ScenarioBank, states: SimState) -> Bool[Array, " K"]:
    """Mask of the states that belong to an agent; the others are padding."""
    return states.context.slot < bank.agents.shape[2]
