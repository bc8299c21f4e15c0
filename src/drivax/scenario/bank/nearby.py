"""The segments around a point, looked up in the grid: what every map query begins with."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.scenario.bank.columns import EdgeRow
from drivax.scenario.bank.scenario_bank import ScenarioBank


def edges_around(
    bank: ScenarioBank, index: Int[Array, ""], xy: Float[Array, " 2"]
) -> tuple[Float[Array, "5 K"], Bool[Array, " K"]]:
    """Rows of ``bank.edges`` in the 3 x 3 cells around a point, and which of them count."""
    return _around(bank, bank.grid_edge, bank.edges, bank.edge_run, index, xy)


def lanes_around(
    bank: ScenarioBank, index: Int[Array, ""], xy: Float[Array, " 2"]
) -> tuple[Float[Array, "8 K"], Bool[Array, " K"]]:
    """Rows of ``bank.lanes`` in the 3 x 3 cells around a point, and which of them count."""
    return _around(bank, bank.grid_lane, bank.lanes, bank.lane_run, index, xy)


def _around(
    bank: ScenarioBank, start: Int[Array, "N cells1"], rows: Float[Array, "N F S"], run: int,
    index: Int[Array, ""], xy: Float[Array, " 2"],
) -> tuple[Float[Array, "F K"], Bool[Array, " K"]]:  # fmt: skip
    """Three contiguous reads of fixed length; a grid of one cell is read whole (``scenario.bank.exhaustive``)."""
    grid = round((start.shape[1] - 1) ** 0.5)
    if grid == 1:
        return rows[index], jnp.arange(rows.shape[2]) < start[index, 1]
    # Clamped so that the 3 x 3 block lies in the grid.
    cell = jnp.floor((xy - bank.grid_origin[index]) / bank.cell_m).astype(jnp.int32)
    cell = jnp.clip(cell, 1, grid - 2)
    features, inside = [], []
    for below in (-1, 0, 1):
        first = (cell[1] + below) * grid + cell[0] - 1
        bounds = jax.lax.dynamic_slice(start, (index, first), (1, 4))[0].astype(jnp.int32)
        block = jax.lax.dynamic_slice(rows, (index, jnp.int32(0), bounds[0]), (1, rows.shape[1], run))[0]
        features.append(block)
        inside.append(jnp.arange(run) < bounds[3] - bounds[0])
    # Read once: without the barrier XLA repeats the reads in every operation that uses them.
    return jax.lax.optimization_barrier((jnp.concatenate(features, axis=1), jnp.concatenate(inside)))


def to_segments(
    rows: Float[Array, "F K"] | Sequence[Float[Array, " K"]], points: Float[Array, "P 2"]
) -> tuple[Float[Array, "P K"], Float[Array, "P K"]]:
    """Squared distance of each point to each segment, and signed distance to its line (positive: left of it)."""
    ax, ay, bx, by = (rows[k] for k in (EdgeRow.X_A, EdgeRow.Y_A, EdgeRow.X_B, EdgeRow.Y_B))
    ux, uy = bx - ax, by - ay
    wx, wy = points[:, 0:1] - ax, points[:, 1:2] - ay
    squared = jnp.maximum(ux * ux + uy * uy, 1e-9)
    along = jnp.clip((wx * ux + wy * uy) / squared, 0.0, 1.0)
    dx, dy = wx - along * ux, wy - along * uy
    return dx * dx + dy * dy, (ux * wy - uy * wx) * jax.lax.rsqrt(squared)
