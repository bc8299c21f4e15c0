"""Lane changes and merges of a car, step by step.

A car stays on a strand of lanes (``scenario.bank.strands``) until its centre is 0.3 m beyond the line between the
strand and another, so that a car that drives along the line does not change lanes at every step.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool

from drivax.geometry.vectors import norm, root
from drivax.scenario.bank.columns import StrandColumn
from drivax.scenario.bank.queries import LANE_CUTOFF_M, aligned_lanes
from drivax.scenario.bank.scenario_bank import Integer, Scalar, ScenarioBank, Vector
from drivax.scenario.bank.smallest import first_smallest
from drivax.scenario.record import record

#: Distance beyond the line between two lanes at which a passage counts, m.
BEYOND_M = 0.3
#: Least distance between the centres of parallel lanes, m; nearer lanes fork or join.
SIDE_BY_SIDE_M = 2.0
#: Largest distance to the end of a lane at which leaving it is a merge, m.
MERGE_M = 100.0
_FAR = 1e9


@record
class Passage:
    """Strand of a car, and whether it changed lanes or merged at this step.

    Attributes:
        strand: Current strand, -1 without a near lane in its direction.
        changed: The previous strand is parallel to this one, in the same direction.
        merged: The previous strand ends, or joins this one, within 100 m.
    """

    strand: Integer
    changed: Bool[Array, ""]
    merged: Bool[Array, ""]


def lane_passage(
    bank: ScenarioBank, index: Integer, xy: Vector, heading: Vector, z: Scalar, before: Any
) -> Passage:
    """Return the passage of a step; ``z`` is the height of the ground, ``before`` the previous strand or -1."""
    lane, squared, side = aligned_lanes(bank, index, xy, heading, z)
    codes = bank.lane_strands[index]
    strand = jnp.where(lane >= 0, codes[lane, StrandColumn.STRAND], -1.0).astype(jnp.int32)
    best = first_smallest(squared)
    own = jnp.where((strand == before) & (strand >= 0), squared, _FAR)
    held = first_smallest(own)
    near, kept = squared[best] <= LANE_CUTOFF_M**2, own[held] <= LANE_CUTOFF_M**2
    stays = kept & (root(own[held]) - root(squared[best]) <= 2 * BEYOND_M)
    now = jnp.where(stays, before, jnp.where(near, strand[best], -1))
    old, new = codes[lane[held]], codes[lane[best]]
    adjacent = (new[StrandColumn.LEFT] == before) | (new[StrandColumn.RIGHT] == before)
    adjacent = (adjacent | (old[StrandColumn.LEFT] == now) | (old[StrandColumn.RIGHT] == now)) & kept
    passed = (before >= 0) & (now >= 0) & (now != before)
    changed = passed & adjacent & (jnp.abs(side[held] - side[best]) >= SIDE_BY_SIDE_M)
    left = codes[before]
    ending = norm(xy - left[StrandColumn.END]) <= MERGE_M
    merged = passed & ending & (changed | (left[StrandColumn.ONTO] == now))
    return Passage(now.astype(jnp.int16), changed, merged)
