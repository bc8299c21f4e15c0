"""Centre lines and roadblocks of the lanes of a stored scenario."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from drivax.scenario.schema import Scenario


def lane_count(scenario: Scenario) -> int:
    """Number of lanes of the lane graph."""
    return int((scenario.lane_length > 0).sum())


def lane_lines(scenario: Scenario) -> list[Float[np.ndarray, "point 2"]]:
    """Centre line of every lane of the lane graph in the local frame.

    Bike lanes, and lanes of which no segment is stored, have no points.
    """
    first, last = (int(end) for end in scenario.segment_blocks[1:3])
    lane, start_m = scenario.segment_lane[first:last], scenario.segment_start_m[first:last]
    lines = []
    for index in range(lane_count(scenario)):
        segments = first + np.flatnonzero(lane == index)[np.argsort(start_m[lane == index], kind="stable")]
        points = np.concatenate([scenario.segment_a[segments, :2], scenario.segment_b[segments[-1:], :2]])
        lines.append(points.astype(np.float64))
    return lines


def roadblocks(scenario: Scenario) -> list[int]:
    """Roadblock of every lane, by the number of its first lane.

    Parallel lanes share a roadblock, and so do connectors between the same two blocks, by their first links.
    """
    count = lane_count(scenario)
    blocks = list(range(count))
    for index in range(count):
        for other in (int(scenario.lane_left[index]), int(scenario.lane_right[index])):
            if 0 <= other < count and not scenario.lane_interpolating[index]:
                low, high = sorted((blocks[index], blocks[other]))
                blocks = [low if block == high else block for block in blocks]
    pairs: dict[tuple[int, int], int] = {}
    for index in np.flatnonzero(scenario.lane_interpolating[:count]).tolist():
        before, after = (
            int(links[index, 0]) for links in (scenario.lane_predecessor, scenario.lane_successor)
        )
        if 0 <= before < count and 0 <= after < count:
            blocks[index] = pairs.setdefault((blocks[before], blocks[after]), index)
    return blocks
