"""The map of a stored scenario as polylines to draw."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.report.pictures.palette import road_layer
from drivax.scenario.schema import Scenario

#: Layers in the order in which they are drawn.
LAYERS = ("crosswalk", "lane", "bike", "line", "edge")
#: Neighbouring segments closer than this are one line, metres.
_JOINT_M = 0.02

Box = tuple[float, float, float, float]
Lines = list[Float[np.ndarray[Any, Any], "_ 2"]]


def road_lines(scenario: Scenario, box: Box | None = None) -> dict[str, Lines]:
    """Polylines of every layer, joined again from the stored segments.

    Segments are stored by grid cell; within a feature they are put in order of their arc length and chained where
    ends meet.

    Args:
        scenario: The scenario.
        box: Keep segments whose midpoint lies in (low x, low y, high x, high y), metres, local frame.

    Returns:
        Layer name -> polylines ``[point, 2]`` in metres; every layer is present.
    """
    used = int(scenario.segment_blocks[3])
    rows = np.lexsort((scenario.segment_start_m[:used], scenario.segment_feature[:used]))
    a, b = scenario.segment_a[rows, :2], scenario.segment_b[rows, :2]
    if box is not None:
        middle = (a + b) / 2
        inside = np.all((middle >= box[:2]) & (middle <= box[2:]), axis=1)
        rows, a, b = rows[inside], a[inside], b[inside]
    layers: dict[str, Lines] = {name: [] for name in LAYERS}
    if not len(rows):
        return layers
    feature = scenario.segment_feature[rows]
    joined = (feature[1:] == feature[:-1]) & (np.abs(a[1:] - b[:-1]).max(axis=1) < _JOINT_M)
    starts = np.flatnonzero(np.concatenate(([True], ~joined)))
    for begin, end in zip(starts, [*starts[1:], len(rows)], strict=True):
        line = np.concatenate((a[begin:end], b[end - 1 : end]))
        layers[road_layer(int(scenario.segment_kind[rows[begin]]))].append(line)
    return layers


def stop_signs(scenario: Scenario) -> Float[np.ndarray[Any, Any], "sign 2"]:
    """Positions of the stop signs, metres."""
    return scenario.stop_xy[(scenario.stop_xy != 0).any(axis=1)]


def light_rows(scenario: Scenario) -> np.ndarray[Any, Any]:
    """Rows of the lights that exist: those with a stop line and at least one observed state."""
    line = scenario.light_line
    drawn = np.abs(line[:, :2] - line[:, 2:]).max(axis=1, initial=0.0) > 0
    return np.flatnonzero(drawn & (scenario.light_state >= 0).any(axis=0))


def route(scenario: Scenario, row: int = 0) -> Float[np.ndarray[Any, Any], "point 2"]:
    """Points of a route, metres; none where the scenario has no such route."""
    return scenario.route_xy[row, : int(scenario.route_points[row])]
