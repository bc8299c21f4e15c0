"""Contacts of the driven agent with all others: codes, fault and type of collision, and time to collision."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.kernels.library import call, constants


def measure_contacts(
    box: Float[Array, "S 6"], velocity: Float[Array, "S 2"], z: Float[Array, " S"], valid: Bool[Array, " S"],
    kind: Int[Array, " S"], previous_velocity: Float[Array, "S 2"], previous_valid: Bool[Array, " S"],
    slot: Int[Array, ""], speed: Float[Array, ""], unlawful: Bool[Array, ""], before: Int[Array, " S"],
    **rules: float,
) -> tuple[Int[Array, " S"], Bool[Array, ""], Int[Array, ""], Float[Array, ""]]:  # fmt: skip
    """Return new contact codes, whether a contact that begins is at fault, its type, and time to collision.

    Args:
        box: All agents: x, y, cosine, sine, length, width.
        velocity: m/s.
        z: Height of the box centre, m.
        valid: Whether the slot has an agent.
        kind: ``scenario.schema.AgentKind``.
        previous_velocity: One step before.
        previous_valid: One step before.
        slot: Slot of the driven agent.
        speed: Its larger one of before and after the step, m/s.
        unlawful: Whether it is at fault in a lateral hit.
        before: Contact codes one step before.
        rules: ``ContactRules`` in ``native/contacts.cc``.
    """
    slots = valid.shape
    results = [
        jax.ShapeDtypeStruct(shape, dtype)
        for shape, dtype in ((slots, jnp.int8), ((), jnp.bool_), ((), jnp.int8), ((), jnp.float32))
    ]
    agents = (box, velocity, z, valid, kind, previous_velocity, previous_valid)
    batched = (*agents, slot, speed, unlawful, before)
    codes, at_fault, kind, time_s = call("measure_contacts", results, (), batched, **constants(**rules))
    return codes, at_fault, kind, time_s
