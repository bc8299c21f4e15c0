"""Contacts of the driven agent with all others: codes, fault and type of collision, and time to collision."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.kernels.library import call, constants


class Agents(NamedTuple):
    """All agents at a step.

    Attributes:
        box: x, y, cosine, sine, length, width.
        velocity: m/s.
        z: Height of the box centre, m.
        valid: Whether the slot has an agent.
        kind: ``scenario.schema.AgentKind``.
    """

    box: Float[Array, "S 6"]
    velocity: Float[Array, "S 2"]
    z: Float[Array, " S"]
    valid: Bool[Array, " S"]
    kind: Int[Array, " S"]


def measure_contacts(
    agents: Agents, previous: tuple[Float[Array, "S 2"], Bool[Array, " S"]], slot: Int[Array, ""],
    speed: Float[Array, ""], unlawful: Bool[Array, ""], before: Int[Array, " S"], rules: Mapping[str, float],
) -> tuple[Int[Array, " S"], Bool[Array, ""], Int[Array, ""], Float[Array, ""]]:  # fmt: skip
    """Return contact codes, whether a new contact is at fault, the type of the nearest one, and time to collision.

    Args:
        agents: All agents.
        previous: Their velocities and ``valid`` one step before.
        slot: Slot of the driven agent.
        speed: Its larger one of before and after the step, m/s.
        unlawful: Whether it is at fault in a lateral hit.
        before: Contact codes one step before.
        rules: ``ContactRules`` in ``native/contacts.cc``.
    """
    slots = agents.valid.shape
    results = [
        jax.ShapeDtypeStruct(shape, dtype)
        for shape, dtype in ((slots, jnp.int8), ((), jnp.bool_), ((), jnp.int8), ((), jnp.float32))
    ]
    batched = (*agents, *previous, slot, speed, unlawful, before)
    codes, at_fault, kind, time_s = call(
        "measure_contacts", results, (), batched, attributes=constants(rules)
    )
    return codes, at_fault, kind, time_s
