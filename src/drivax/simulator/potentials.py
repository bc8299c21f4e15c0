"""Smooth surrogates of collision and off-road, for trajectory optimisation.

A potential is ``max(0, 1 - d / margin)^2`` of a distance d that grows away from the violation: positive wherever the
metric of the same name holds, and zero beyond the margin. Its gradient is continuous except where two road edges are
equally far away, or an edge is 3 m away. Optimised trajectories are still evaluated by the metrics.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.errors import UsageError
from drivax.geometry.boxes import COS, LENGTH, SIN, WIDTH, X, Y, corners
from drivax.scenario.bank.queries import OFFROAD_TOLERANCE_M, around_lanes, is_mapped, offroad_distance
from drivax.scenario.bank.scenario_bank import Integer, Scalar, ScenarioBank
from drivax.simulator.contact import others_on_level
from drivax.simulator.types import AgentContext, Frame

#: Width of the smooth transitions in the maximum over separating axes (m), and in absolute sines and cosines.
_BLEND_M, _BLEND_TURN = 0.03, 0.01
#: Reach of edge queries, m.
_EDGES_M = 3.0
#: Minimum margin of collisions, m.
_LEAST_MARGIN_M = 0.3


def separation(box: Float[Array, " 6"], others: Float[Array, "S 6"]) -> Float[Array, " S"]:
    """Return the gap between boxes along the best of the four separating axes, m; negative for deep overlaps.

    A smooth upper bound of ``max over axes of (|centre offset| - reach)``, whose sign decides overlap (separating axis
    theorem) and which is the distance between the boxes, or less where they face each other corner to corner. The
    bound is at most 0.063 m too large, plus 0.01 times half of both lengths and widths.
    """
    dx, dy = others[:, X] - box[X], others[:, Y] - box[Y]
    cos = box[COS] * others[:, COS] + box[SIN] * others[:, SIN]
    sin = box[COS] * others[:, SIN] - box[SIN] * others[:, COS]
    cos, sin = _smooth_abs(cos), _smooth_abs(sin)
    (la, wa), (lb, wb) = (box[LENGTH] / 2, box[WIDTH] / 2), (others[:, LENGTH] / 2, others[:, WIDTH] / 2)
    along_a = (dx * box[COS] + dy * box[SIN], la + lb * cos + wb * sin)
    across_a = (dy * box[COS] - dx * box[SIN], wa + lb * sin + wb * cos)
    along_b = (dx * others[:, COS] + dy * others[:, SIN], lb + la * cos + wa * sin)
    across_b = (dy * others[:, COS] - dx * others[:, SIN], wb + la * sin + wa * cos)
    axes = (along_a, across_a, along_b, across_b)
    gaps = jnp.stack([sign * offset - reach for offset, reach in axes for sign in (1.0, -1.0)])
    return _BLEND_M * jax.nn.logsumexp(gaps / _BLEND_M, axis=0)


def collision_potential(frame: Frame, slot: Integer, margin_m: float = 0.5) -> Float[Array, " S"]:
    """Return the potential of every other agent for the agent in ``slot``; gradients flow to all agents.

    Positive where the boxes overlap (``contact.overlaps``); zero where a separating axis has a gap of the margin or
    more (always at a distance of 1.5 margins), for the agent itself, for absent agents and on another level. Boxes
    longer than 20 m need a margin of more than 0.3 m.

    Raises:
        UsageError: The margin is below 0.3 m, where the potential of a slight overlap could be zero.
    """
    if not margin_m >= _LEAST_MARGIN_M:
        raise UsageError(f"margin_m is {margin_m:g}", cure=f"use at least {_LEAST_MARGIN_M:g}")
    potentials = _squared_hinge(separation(frame.box[slot], frame.box), margin_m)
    return jnp.where(others_on_level(frame, slot), potentials, 0.0)


def offroad_potential(
    bank: ScenarioBank, index: Integer, box: Float[Array, " 6"], ground: Scalar, margin_m: float = 0.5
) -> Scalar:
    """Return the off-road potential of a box, summed over its corners.

    ``ground`` is the height of the road under the box, m. The limit is that of the metric, 0.3 m beyond a road edge.
    The potential is positive where a corner is beyond it, zero where every corner is at least ``margin_m`` inside it,
    zero without a map, and constant further than 3 m beyond every edge.

    Raises:
        UsageError: The margin is not positive, or wider than 3 m, the reach of edge queries.
    """
    if not 0.0 < margin_m <= _EDGES_M:
        raise UsageError(f"margin_m is {margin_m:g}", cure=f"use more than 0, at most {_EDGES_M:g}")
    points = corners(box)
    points_near = around_lanes(bank, index, box[:2], box[2:4], points, ground).points_near
    offroad_m = offroad_distance(bank, index, box[:2], points, points_near, ground)
    has_map = is_mapped(bank, index)
    return jnp.where(has_map, _squared_hinge(OFFROAD_TOLERANCE_M - offroad_m, margin_m).sum(), 0.0)


def fault_potential(bank: ScenarioBank, context: AgentContext, frame: Frame, margin_m: float = 0.5) -> Scalar:
    """Return the sum of the driven agent's potentials; ``frame`` holds all agents (``Simulator.frame``)."""
    ground = frame.z[context.slot] - bank.height_m(context.index, context.slot) / 2
    offroad = offroad_potential(bank, context.index, frame.box[context.slot], ground, margin_m)
    return offroad + collision_potential(frame, context.slot, margin_m).sum()


def _squared_hinge(distance: Float[Array, " K"], margin_m: float) -> Float[Array, " K"]:
    """Return ``max(0, 1 - distance / margin)^2``."""
    return jnp.maximum(1.0 - distance / margin_m, 0.0) ** 2


def _smooth_abs(value: Float[Array, " S"]) -> Float[Array, " S"]:
    """Return a smooth lower bound of the absolute value, at most ``_BLEND_TURN`` below it."""
    return jnp.sqrt(value * value + _BLEND_TURN**2) - _BLEND_TURN
