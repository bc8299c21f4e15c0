"""Queries of lanes and road edges around the box of a vehicle.

Constants are those of ``scenario.bank.queries``, whose functions pass them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.kernels.library import call, constants, in_use


class SegmentGrid(NamedTuple):
    """Segments of all scenarios of a bank, sorted by the cells of their grids.

    Attributes:
        segments: Segments of lanes or of edges, by feature.
        start: First segment of each cell, and the end.
        origin: Smallest x, y of each grid.
        cell_m, longest_run: Size of a cell; longest run of three neighbouring cells.
        long_ego: Whether corners of some vehicle lie outside of the cells around its centre.
    """

    segments: Float[Array, "N features S"]
    start: Int[Array, "N cells1"]
    origin: Float[Array, "N 2"]
    cell_m: float
    longest_run: int
    long_ego: bool

    @property
    def _arrays(self) -> tuple[Array, Array, Array]:
        return self.segments, self.start, self.origin

    @property
    def _constants(self) -> dict[str, float]:
        return {"cell_m": self.cell_m, "longest_run": self.longest_run, "long_ego": self.long_ego}


class Box(NamedTuple):
    """Box of a vehicle: centre, heading (cosine, sine) and corners, and the height of the ground."""

    centre: Float[Array, "2"]
    heading: Float[Array, "2"]
    corners: Float[Array, "4 2"]
    ground: Float[Array, ""]


class Lanes(NamedTuple):
    """Values of ``queries.LaneHits``; ``nearest_z`` is the height of the nearest lane, also if it is not near."""

    near: Bool[Array, "*batch"]
    corners_near: Bool[Array, "*batch 4"]
    on_corridor: Bool[Array, "*batch"]
    wrong_way: Bool[Array, "*batch"]
    straddling: Bool[Array, "*batch"]
    leaving_lane: Bool[Array, "*batch"]
    limit: Float[Array, "*batch"]
    nearest_z: Float[Array, "*batch"]


def supports(grid: SegmentGrid, corners: Float[Array, "corners 2"], *others: Float[Array, "..."]) -> bool:
    """Whether the native kernels are in use and have these types: single precision, and four corners."""
    types = {array.dtype for array in (grid.segments, corners, *others)}
    is_compiled = types == {jnp.dtype(jnp.float32)} and grid.start.dtype == jnp.int16 and len(corners) == 4
    return is_compiled and in_use()


def query_lanes(
    grid: SegmentGrid, map_box: Float[Array, "N 4"], index: Int[Array, ""], box: Box, ego: Int[Array, ""],
    routed: Bool[Array, ""], rules: Mapping[str, float],
) -> Lanes:  # fmt: skip
    """Return what is known of the lanes around a box.

    Args:
        grid: Segments of lanes.
        map_box: Smallest and largest x, y of each map.
        index: Number of the scenario.
        box: Pose of the box.
        ego: Number of the ego of the scenario whose corridor counts.
        routed: Whether lanes of the corridor are driven before others.
        rules: ``cutoff_m``, ``level_m``, ``margin_m``, ``goes_on_m``, ``joint_m`` and ``parallel_cos``.
    """
    flag, number = (jax.ShapeDtypeStruct((), dtype) for dtype in (jnp.bool_, jnp.float32))
    corner_flags = jax.ShapeDtypeStruct((4,), jnp.bool_)
    results = [flag, corner_flags, flag, flag, flag, flag, number, number]
    common = jax.lax.stop_gradient([*grid._arrays, map_box])
    batched = jax.lax.stop_gradient([index, ego, *box, routed])
    attributes = constants({**grid._constants, **rules})
    return Lanes(*call("query_lanes", results, common, batched, attributes=attributes))


def query_edges(
    grid: SegmentGrid, sides: Int[Array, "N cells"], index: Int[Array, ""], centre: Float[Array, "2"],
    corners: Float[Array, "4 2"], near_lane: Bool[Array, "4"], ground: Float[Array, ""],
    rules: Mapping[str, float],
) -> Float[Array, "4"]:  # fmt: skip
    """Return the distances of corners beyond the nearest edge, m: positive off the road.

    Args:
        grid: Segments of edges.
        sides: Packed drivable sides of the parts of cells, ``split`` along each axis.
        index: Number of the scenario.
        centre: Centre of the box.
        corners: Its corners.
        near_lane: Whether a lane is near each corner.
        ground: Height of the ground.
        rules: ``cutoff_m``, ``level_m``, and of the parts of cells ``split`` and ``not_drivable``.
    """
    results = [jax.ShapeDtypeStruct((4,), jnp.float32)]
    batched = (index, centre, corners, near_lane, ground)
    attributes = constants({**grid._constants, **rules})
    return call("query_edges", results, (*grid._arrays, sides), batched, attributes=attributes)[0]
