"""The present frame of a driven agent under log traffic: logged, parked and driven agents in their slots."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from drivax.kernels.library import call

#: Arrays of all scenarios (``scenario.bank.scenario_bank``): agents, sizes, parked agents and when, states of lights.
Logs = tuple[
    Float[Array, "N T A 8"], Float[Array, "N S 4"], Float[Array, "N S 8"], Shaped[Array, "N W S"],
    Int[Array, "N T L"],
]  # fmt: skip
#: Boxes, velocities, heights, mask, kinds and states of lights.
FrameArrays = tuple[
    Float[Array, "S 6"], Float[Array, "S 2"], Float[Array, " S"], Bool[Array, " S"], Int[Array, " S"],
    Int[Array, " L"],
]  # fmt: skip


def read_frame(
    logs: Logs, index: Int[Array, ""], step: Int[Array, ""], slot: Int[Array, ""], motion: Float[Array, " 4"],
    direction: Float[Array, " 2"],
) -> FrameArrays:  # fmt: skip
    """Return the agents at a step, with the driven one at its motion, but at the height of the log.

    Without the height, the frame depends on nothing that measuring changes: XLA computes it once per step.

    Args:
        logs: Arrays of all scenarios.
        index: Scenario.
        step: Of the log.
        slot: That of the driven agent; slots beyond the moving agents drive none.
        motion: Its x, y, heading and speed.
        direction: Cosine and sine of its heading.
    """
    slots, lights = logs[1].shape[1], logs[4].shape[2]
    results = [
        jax.ShapeDtypeStruct(shape, dtype)
        for shape, dtype in (
            ((slots, 6), jnp.float32), ((slots, 2), jnp.float32), ((slots,), jnp.float32),
            ((slots,), jnp.bool_), ((slots,), jnp.int32), ((lights,), jnp.int8),
        )
    ]  # fmt: skip
    box, velocity, z, valid, kind, states = call(
        "read_frames", results, logs, (index, step, slot, motion, direction)
    )
    return box, velocity, z, valid, kind, states
