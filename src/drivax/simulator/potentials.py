"""Smooth stand-ins for collision and off-road, for optimisation: how close a pose comes to either.

A potential is positive wherever the metric of the same name holds, zero beyond a margin, and in between
``max(0, 1 - d / margin)^2`` of a distance d that grows away from the fault. Its gradient is continuous, but for places
that are equally far from two edges of the road. The metrics themselves stay
what they are; a trajectory that was optimised with potentials is evaluated by them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from drivax.errors import UsageError
from drivax.geometry.boxes import COS, LENGTH, SIN, WIDTH, X, Y, corners
from drivax.scenario.bank.queries import (
    LEVEL_M,
    OFFROAD_TOLERANCE_M,
    around_lanes,
    is_mapped,
    offroad_distance,
)
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.types import AgentContext, Frame

#: Width of the transition where two faces of a box, or two signs of an angle, take over from each other (m, 1).
_BLEND_M, _BLEND_TURN = 0.03, 0.01
#: Edges further away do not exist for queries, m.
_EDGES_M = 3.0


def separation(box: Float[Array, " 6"], others: Float[Array, "S 6"]) -> Float[Array, " S"]:
    """How far boxes are apart along the best of the four separating axes, m; negative where they overlap.

    A smooth upper bound of ``max over axes of (|centre offset| - reach)``, whose sign decides overlap (separating axis
    theorem) and which is the distance between the boxes, or less where they face each other corner to corner. The
    bound is at most 0.063 m too large, plus 0.01 times half of both lengths and widths.
    """
    dx, dy = others[:, X] - box[X], others[:, Y] - box[Y]
    cos = box[COS] * others[:, COS] + box[SIN] * others[:, SIN]
    sin = box[COS] * others[:, SIN] - box[SIN] * others[:, COS]
    cos, sin = _magnitude(cos), _magnitude(sin)
    (la, wa), (lb, wb) = (box[LENGTH] / 2, box[WIDTH] / 2), (others[:, LENGTH] / 2, others[:, WIDTH] / 2)
    along_a = (dx * box[COS] + dy * box[SIN], la + lb * cos + wb * sin)
    across_a = (dy * box[COS] - dx * box[SIN], wa + lb * sin + wb * cos)
    along_b = (dx * others[:, COS] + dy * others[:, SIN], lb + la * cos + wa * sin)
    across_b = (dy * others[:, COS] - dx * others[:, SIN], wb + la * sin + wa * cos)
    axes = (along_a, across_a, along_b, across_b)
    gaps = jnp.stack([sign * offset - reach for offset, reach in axes for sign in (1.0, -1.0)])
    return _BLEND_M * jax.nn.logsumexp(gaps / _BLEND_M, axis=0)


def collision_potential(frame: Frame, slot: Int[Array, ""], margin_m: float = 0.5) -> Float[Array, " S"]:
    """Potential of every other agent of a frame for the agent in ``slot``.

    Args:
        frame: All agents.
        slot: The agent whose pose is evaluated; gradients flow to all agents.
        margin_m: Separation at which the potential ends; at least 0.3, more for boxes longer than 20 m.

    Returns:
        Positive where the boxes overlap (``contact.overlaps``); zero where one of the separating axes keeps them apart
        by the margin (1.5 margins of distance always do), for oneself, for who is not there and on another level.
    """
    others = frame.valid & (jnp.arange(frame.valid.shape[0]) != slot)
    others &= jnp.abs(frame.z - frame.z[slot]) <= LEVEL_M
    return jnp.where(others, _rise(separation(frame.box[slot], frame.box), margin_m), 0.0)


def offroad_potential(
    bank: ScenarioBank, index: Int[Array, ""], box: Float[Array, " 6"], ground: Float[Array, ""],
    margin_m: float = 0.5,
) -> Float[Array, ""]:  # fmt: skip
    """Potential of the road's edges for a box: the sum over its corners.

    Args:
        bank: The scenarios.
        index: Row of the bank.
        box: x, y, cos, sin, length, width.
        ground: Height of the road under the box, m.
        margin_m: Distance before the tolerance of the metric (0.3 m beyond an edge) at which the potential begins; at
            most 3, since edges further away are not seen.

    Returns:
        Positive where a corner is off the road, zero where every corner is further than the margin from being so and
        where nothing is mapped. Further than 3 m beyond every edge it is constant: no direction is known.

    Raises:
        UsageError: A wider margin.
    """
    if margin_m > _EDGES_M:
        raise UsageError(f"margin_m is {margin_m:g}", cure=f"use at most {_EDGES_M:g}")
    points = corners(box)
    near = around_lanes(bank, index, box[:2], box[2:4], points, ground).points_near
    beyond = offroad_distance(bank, index, box[:2], points, near, ground)
    return jnp.where(is_mapped(bank, index), _rise(OFFROAD_TOLERANCE_M - beyond, margin_m).sum(), 0.0)


def fault_potential(
    bank: ScenarioBank, context: AgentContext, frame: Frame, margin_m: float = 0.5
) -> Float[Array, ""]:
    """Both potentials of a context's driven agent, added up: positive wherever it collides or is off the road.

    Args:
        bank: The scenarios.
        context: The context.
        frame: All agents in it (``Simulator.frame``).
        margin_m: As above.
    """
    ground = frame.z[context.slot] - bank.height_m(context.index, context.slot) / 2
    away = offroad_potential(bank, context.index, frame.box[context.slot], ground, margin_m)
    return away + collision_potential(frame, context.slot, margin_m).sum()


def _rise(distance: Float[Array, " K"], margin_m: float) -> Float[Array, " K"]:
    return jnp.maximum(1.0 - distance / margin_m, 0.0) ** 2


def _magnitude(value: Float[Array, " S"]) -> Float[Array, " S"]:
    """Absolute value with a rounded tip; never above it and at most the blend below."""
    return jnp.sqrt(value * value + _BLEND_TURN**2) - _BLEND_TURN
