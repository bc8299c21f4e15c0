"""Several agents of one scenario that are driven together: which, and how a stack of them is filled up."""

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
    """Slots of the agents of a mask that the log has at ``step``, filled up with A, an empty slot.

    Args:
        bank: The scenarios.
        index: Row of the bank.
        mask: Which moving agents are to be driven.
        count: K, the size of the stack; further agents of the mask are left to traffic.
        step: Step at which they begin.
    """
    there = mask & (bank.agents[index, step, :, AgentColumn.VALID] > 0)
    return jnp.nonzero(there, size=count, fill_value=mask.shape[0])[0].astype(jnp.int32)


def is_driven(bank: ScenarioBank, states: SimState) -> Bool[Array, " K"]:
    """Which states of a stack belong to an agent; the others fill it up."""
    return states.context.slot < bank.agents.shape[2]
