"""The look ahead of a car-following driver: the leader on its route, lights that require a stop, and curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.kernels.library import call, constants

#: Arrays of all scenarios: routes and the numbers of their points, and stop lines.
Maps = tuple[Float[Array, "M R 7"], Int[Array, " M"], Float[Array, "N F L"]]
#: All agents: boxes, velocities, heights of their centres, and the mask of valid ones.
Agents = tuple[Float[Array, "S 6"], Float[Array, "S 2"], Float[Array, " S"], Bool[Array, " S"]]


def look_ahead(
    maps: Maps, agents: Agents, lights: Int[Array, " L"], numbers: Sequence[Int[Array, ""]],
    route_m: Float[Array, ""], speed: Float[Array, ""], min_gap_m: Float[Array, ""], rules: Mapping[str, float],
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:  # fmt: skip
    """Return the gap to the nearest obstacle (m), its speed along the route, and the desired speed (m/s).

    Args:
        maps: Routes, numbers of their points, and stop lines of all scenarios.
        agents: Boxes, velocities, heights and mask of all agents.
        lights: States.
        numbers: Slot, scenario and route of the driven agent, and row of the arc lengths of stop lines on that route.
        route_m: Arc length of the agent along it, m.
        speed: Of the agent, m/s.
        min_gap_m: Gap that the driver keeps behind a standing leader.
        rules: ``FollowingRules`` in ``native/following.cc``.
    """
    number = jax.ShapeDtypeStruct((), jnp.float32)
    batched = (*agents, lights.astype(jnp.int8), *numbers, route_m, speed, min_gap_m)
    gap_m, leader_mps, desired_mps = call(
        "look_ahead", [number] * 3, maps, batched, attributes=constants(rules)
    )
    return gap_m, leader_mps, desired_mps
