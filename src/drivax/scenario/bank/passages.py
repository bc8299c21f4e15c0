"""From which lane to which a car passes: lane changes and merges, step by step.

A car is on a strand of lanes (``scenario.bank.strands``) until its centre is 0.3 m nearer to the middle of
another than
the line between them, so that one that drives along the line does not change lanes with every step.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.vectors import norm, root
from drivax.scenario.bank.columns import StrandColumn
from drivax.scenario.bank.queries import LANE_CUTOFF_M, aligned_lanes
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.bank.smallest import first_smallest
from drivax.scenario.record import record

#: A passage counts once the centre is so far beyond the line between two lanes, m.
BEYOND_M = 0.3
#: Lanes run side by side where their centres are so far apart, m; nearer ones fork or join there.
SIDE_BY_SIDE_M = 2.0
#: Leaving a lane this near to where it ends or joins another is a merge, m.
MERGE_M = 100.0
_FAR = 1e9


@record
class Passage:
    """Where a car is among the strands of lanes now, and what brought it there.

    Attributes:
        strand: The strand it is on, -1 where no lane that runs its way is near.
        changed: It came at this step from a strand that runs side by side with this one, the same way.
        merged: It came at this step from a strand that ends, or joins this one, within 100 m: by a lane change or along
            the lanes.
    """

    strand: Int[Array, ""]
    changed: Bool[Array, ""]
    merged: Bool[Array, ""]


def lane_passage(
    bank: ScenarioBank, index: Int[Array, ""], xy: Float[Array, " 2"], heading: Float[Array, " 2"],
    z: Float[Array, ""], before: Any,
) -> Passage:  # fmt: skip
    """The passage of one step.

    Args:
        bank: The scenarios.
        index: Row of the bank.
        xy: The car's centre, m.
        heading: Cosine and sine of its heading.
        z: Height of the ground, m.
        before: The strand that it was on a step ago, -1 for none (then it is on that of the nearest lane).
    """
    lane, squared, side = aligned_lanes(bank, index, xy, heading, z)
    codes = bank.lane_codes[index]
    strand = jnp.where(lane >= 0, codes[lane, StrandColumn.STRAND], -1.0).astype(jnp.int32)
    best = first_smallest(squared)
    own = jnp.where((strand == before) & (strand >= 0), squared, _FAR)
    held = first_smallest(own)
    near, kept = squared[best] <= LANE_CUTOFF_M**2, own[held] <= LANE_CUTOFF_M**2
    stays = kept & (root(own[held]) - root(squared[best]) <= 2 * BEYOND_M)
    now = jnp.where(stays, before, jnp.where(near, strand[best], -1))
    old, new = codes[lane[held]], codes[lane[best]]
    beside = (new[StrandColumn.LEFT] == before) | (new[StrandColumn.RIGHT] == before)
    beside = (beside | (old[StrandColumn.LEFT] == now) | (old[StrandColumn.RIGHT] == now)) & kept
    passed = (before >= 0) & (now >= 0) & (now != before)
    changed = passed & beside & (jnp.abs(side[held] - side[best]) >= SIDE_BY_SIDE_M)
    left = codes[before]
    ending = norm(xy - left[StrandColumn.END]) <= MERGE_M
    merged = passed & ending & (changed | (left[StrandColumn.ONTO] == now))
    return Passage(now.astype(jnp.int16), changed, merged)
