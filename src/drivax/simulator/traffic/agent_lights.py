"""Which stop lines a path crosses, and which of the lights there is the one that it has to obey."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from drivax.geometry.vectors import wrap
from drivax.scenario.bank.columns import LightRow
from drivax.scenario.bank.queries import LEVEL_M
from drivax.scenario.bank.scenario_bank import NEVER_M, ScenarioBank

#: Stop lines of a path that are kept, the first ones.
STOPS = 4
#: Lines that a path crosses this near to each other are one place to stop, m.
_ONE_PLACE_M = 3.0
#: Of the lights at one place that one counts whose lane ends most nearly in the path's heading so much further on, m.
_JUDGED_AFTER_M = 20.0
#: A line counts for paths that cross it within this angle of its lane's heading.
_ASKEW_COS = 0.5
Array = np.ndarray[Any, Any]


def light_arcs(
    bank: ScenarioBank, scenario: Int[np.ndarray, " V"], points: Float[np.ndarray, "V M 6"],
    spacing: Float[np.ndarray, " V"],
) -> tuple[Float[np.ndarray, "V 4"], Int[np.ndarray, "V 4"]]:  # fmt: skip
    """Arc lengths of the stop lines that paths cross forwards, and the light of each.

    Args:
        bank: The scenarios.
        scenario: Row of the bank of each path.
        points: Paths: x, y, cos, sin (``simulator.traffic.agent_paths.AgentPaths.points``), then height and speed
            (``profile``).
        spacing: Arc length between two points, m.

    Returns:
        The first four places to stop, in order, very far away where there are fewer; and slots of lights.
    """
    arcs = np.full((len(scenario), STOPS), NEVER_M)
    lights = np.zeros((len(scenario), STOPS), np.int64)
    line, state = np.asarray(bank.light_line, np.float64), np.asarray(bank.light_state)
    exits = np.arctan2(line[:, LightRow.EXIT_SIN], line[:, LightRow.EXIT_COS])
    for row in np.unique(scenario):
        seen = np.flatnonzero((state[row] >= 0).any(axis=0))
        mine = np.flatnonzero(scenario == row)
        if not len(seen):
            continue
        crossed = _crossings(line[row][:, seen], points[mine], spacing[mine])
        for path, arc in zip(mine, crossed, strict=True):
            heading = np.arctan2(points[path, :, 3], points[path, :, 2])
            found = _places(arc, heading, spacing[path], exits[row, seen])
            for place, (where, light) in enumerate(found[:STOPS]):
                arcs[path, place], lights[path, place] = where, seen[light]
    return arcs, lights


def _crossings(line: Array, points: Array, spacing: Array) -> Float[np.ndarray, "V L"]:
    """Arc length at which each path first passes forwards through each stop line; infinite where it does not."""
    cos, sin = line[LightRow.COS], line[LightRow.SIN]
    dx, dy = (points[:, :, None, i] - line[at] for i, at in ((0, LightRow.X), (1, LightRow.Y)))
    ahead, left = dx * cos + dy * sin, dy * cos - dx * sin
    before, after = ahead[:, :-1], ahead[:, 1:]
    share = -before / np.where(after > before, after - before, 1.0)
    through = np.abs(left[:, :-1] + share * np.diff(left, axis=1)) <= line[LightRow.HALF]
    facing = points[:, :-1, None, 2] * cos + points[:, :-1, None, 3] * sin > _ASKEW_COS
    level = np.abs(points[:, :-1, None, 4] - line[LightRow.Z]) <= LEVEL_M
    crosses = (before < 0.0) & (after >= 0.0) & through & facing & level
    first = np.argmax(crosses, axis=1)
    arc = (first + np.take_along_axis(share, first[:, None], axis=1)[:, 0]) * spacing[:, None]
    return np.where(crosses.any(axis=1), arc, np.inf)


def _places(arc: Array, heading: Array, spacing: float, exits: Array) -> list[tuple[float, int]]:
    """Places to stop in order, one light for each: arc length and light."""
    order = [int(light) for light in np.argsort(arc) if np.isfinite(arc[light])]
    groups: list[list[int]] = []
    for light in order:
        if groups and arc[light] - arc[groups[-1][0]] <= _ONE_PLACE_M:
            groups[-1].append(light)
        else:
            groups.append([light])
    places = []
    for group in groups:
        later = min(round((arc[group[0]] + _JUDGED_AFTER_M) / spacing), len(heading) - 1)
        light = min(group, key=lambda one: abs(float(wrap(exits[one] - heading[later]))))
        places.append((float(arc[light]), light))
    return places
