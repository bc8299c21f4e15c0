"""Whom ego meets on its way: the lanes whose users go first, and the lanes from which they come."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from drivax.synthetic.events.destinations import Aim
from drivax.synthetic.roads.network import Control, RoadNetwork
from drivax.synthetic.traffic.paths import Path

#: Lanes that lead to a meeting are followed back for this long, m.
_BACK_M = 160.0
#: When ego would come to where it gives way if nothing held it up, s after the recording's beginning.
_WHEN_S = (0.4, 4.0)


def giving_way(network: RoadNetwork) -> tuple[Aim, ...]:
    """Connectors whose users give way to others who need not wait themselves."""
    return tuple(
        Aim(index, (0.0, min(3.0, lane.length_m)), _WHEN_S)
        for index, lane in enumerate(network.lanes)
        if lane.control == Control.ALL_WAY_STOP or any(not network.lanes[k].yields_to for k in lane.yields_to)
    )


def met_on(network: RoadNetwork, path: Path) -> frozenset[int]:
    """Connectors that a path gives way to, and lanes that it changes to; of those that give way themselves none.

    Args:
        network: The roads.
        path: Ego's.
    """
    found: set[int] = set()
    for before, span in pairwise((path.spans[0], *path.spans)):
        lane, previous = network.lanes[span.lane], network.lanes[before.lane]
        if span.lane in (previous.left, previous.right):
            found.add(span.lane)
        if lane.control == Control.ALL_WAY_STOP:
            found.update(np.flatnonzero(network.conflicts[span.lane]).tolist())
        # Who has to wait for others comes when they let it.
        found.update(rival for rival in lane.yields_to if not network.lanes[rival].yields_to)
    return frozenset(found)


def with_feeders(network: RoadNetwork, lanes: frozenset[int]) -> frozenset[int]:
    """Lanes, and those from which they are reached within 160 m."""
    found: set[int] = set()
    ahead = [(lane, 0.0) for lane in sorted(lanes)]
    while ahead:
        lane, away = ahead.pop()
        if lane not in found and away < _BACK_M:
            found.add(lane)
            this = network.lanes[lane]
            ahead += [(before, away + this.length_m) for before in this.predecessors]
    return frozenset(found)
