"""The map queries by brute force: every segment of the scenario, no grid.

The oracle of the property tests, and the baseline that ``drivax bench`` measures the grid against in the same run.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp

from drivax.scenario.bank.scenario_bank import ScenarioBank


def without_grid(bank: ScenarioBank) -> ScenarioBank:
    """The same bank with a grid of one cell, which is read whole: every query measures every segment once."""
    n = len(bank)
    return replace(
        bank,
        grid_edge=jnp.stack([jnp.zeros_like(bank.grid_edge[:, 0]), bank.grid_edge[:, -1]], axis=1),
        grid_lane=jnp.stack([jnp.zeros_like(bank.grid_lane[:, 0]), bank.grid_lane[:, -1]], axis=1),
        grid_side=jnp.zeros((n, 1), bank.grid_side.dtype),
    )
