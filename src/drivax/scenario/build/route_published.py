"""Candidate routes as a published description of a data pipeline for this simulator family makes them.

The description: search breadth first from the lanes near the ego at the start of the log, keep ways of at least 250 m,
at most 10, and score them by -0.3 lane changes - 0.2 turns + 0.1 length - 0.1 curvature. It sorts by ascending score
and so puts the worst first; here the best is first. Where it gives no units, the plainest are taken (:func:`score`).
"""

from __future__ import annotations

from collections import deque

import numpy as np

from drivax.scenario.build.lane_paths import is_change
from drivax.scenario.build.lane_search import LaneSearch, Way

#: Lanes within this distance of the ego at the start of the log are where ways begin, m.
REACH_M = 2.5
LEAST_M, MOST_WAYS = 250.0, 10
#: A lane that turns by more than this is a turn.
TURN_RAD = np.deg2rad(30.0)
CHANGE_WEIGHT, TURN_WEIGHT, LENGTH_WEIGHT, CURVATURE_WEIGHT = -0.3, -0.2, 0.1, -0.1
#: Ways that are looked at before the search gives up.
MOST_EXPANSIONS = 5000


def published_ways(search: LaneSearch) -> list[Way]:
    """The first ten ways of a breadth-first search that are long enough, the best score first.

    A way is followed to the first of its lanes that ends 250 m or more ahead. From a lane the search goes to its
    successors, the straightest first, then to its left and right neighbour where there is room for a change; ways never
    use a lane twice and change lanes at most twice. Where the map ends too early for ten such ways, ways to its end
    stand in for the missing ones.

    Args:
        search: Starts at the ego's pose at the start of the log, with ``need_m`` = :data:`LEAST_M`; only starts within
            2.5 m are used.
    """
    queue = deque(way for way in search.ways if way.lateral <= REACH_M)
    complete: list[Way] = []
    ended: list[Way] = []
    for _ in range(MOST_EXPANSIONS):
        if not queue or len(complete) >= MOST_WAYS:
            break
        way = queue.popleft()
        if search.reach(way) >= search.need_m:
            complete.append(way)
            continue
        following = search.following(way)
        if not any(not is_change(search.graph, way.lanes[-1], child.lanes[-1]) for child in following):
            ended.append(way)
        queue.extend(following)
    return sorted([*complete, *ended][:MOST_WAYS], key=lambda way: -score(search, way))


def score(search: LaneSearch, way: Way) -> float:
    """-0.3 lane changes - 0.2 turns + 0.1 length - 0.1 curvature.

    Lane changes and turns (lanes whose heading changes by more than 30 degrees from end to end) are numbers, the length
    ahead of the ego is in metres, and curvature is the heading change of all lanes from end to end per metre of that
    length, rad/m. With these units a metre of length outweighs most of the rest, as published.
    """
    length = max(search.reach(way), 1.0)
    bend = search.bend[list(way.lanes)]
    return float(
        CHANGE_WEIGHT * way.changes
        + TURN_WEIGHT * int((bend > TURN_RAD).sum())
        + LENGTH_WEIGHT * length
        + CURVATURE_WEIGHT * float(bend.sum()) / length
    )
