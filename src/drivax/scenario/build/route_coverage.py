"""How well routes cover the log: the measure that the route generator is judged by."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.geometry.angles import wrap
from drivax.geometry.polylines import point_to_segment, project
from drivax.scenario.schema import Flag, Scenario

Array = np.ndarray[Any, Any]

#: Row of the route to the goal, and of the log's own route (privileged).
GOAL_ROW, LOG_ROW = 0, 1
#: A candidate covers the log when it stays this near to it, for this share of the steps.
REACH_M, SHARE = 1.5, 0.95
SAME_WAY_RAD = np.deg2rad(60.0)


def coverage(scenario: Scenario, reach_m: float = REACH_M) -> Float[Array, " route"]:
    """Share of the log's valid steps within reach of each route; 0 for empty rows.

    Distances are from the ego's centre to the route's line, in the plane, at every valid step of the log.
    """
    log = scenario.agent_xy[scenario.agent_valid[:, 0], 0].astype(np.float64)
    share = np.zeros(scenario.capacity.routes)
    for row, points in enumerate(scenario.route_points):
        if points >= 2:
            _, distance = project(scenario.route_xy[row, :points].astype(np.float64), log)
            share[row] = float((distance <= reach_m).mean())
    return share


def candidate_coverage(scenario: Scenario) -> float:
    """The largest coverage of a candidate: of any route that does not come from the log itself."""
    of_log = [LOG_ROW] if Flag.ROUTE in scenario.has else [GOAL_ROW, LOG_ROW]
    return float(np.delete(coverage(scenario), of_log).max(initial=0.0))


def lane_coverage(scenario: Scenario, reach_m: float = REACH_M) -> float:
    """Share of the log's valid steps within reach of any car lane that runs within 60 degrees of ego's heading.

    Where a log drives between lanes or cuts a corner, no route along lanes covers more of it than about this.
    """
    begin, end = scenario.segment_blocks[1:3]
    if begin == end:
        return 0.0
    valid = scenario.agent_valid[:, 0]
    log, heading = scenario.agent_xy[valid, 0].astype(np.float64), scenario.agent_heading[valid, 0]
    a, b = (x[begin:end, :2].astype(np.float64) for x in (scenario.segment_a, scenario.segment_b))
    distance, _ = point_to_segment(log[:, None], a[None], b[None])
    turn = np.abs(wrap(np.arctan2(b[:, 1] - a[:, 1], b[:, 0] - a[:, 0]) - heading[:, None]))
    return float((np.where(turn <= SAME_WAY_RAD, distance, np.inf).min(axis=1) <= reach_m).mean())
