"""Traffic lights with their stop lines, and stop signs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Int8

from drivax.geometry.polylines import left_normals, point_to_segment
from drivax.scenario.build.lanes import END_SPAN_M, LaneGraph, LaneSegments
from drivax.scenario.build.segments import path_distance
from drivax.scenario.recording import Light, MapFeature
from drivax.scenario.schema import RoadKind

Array = np.ndarray[Any, Any]

#: Half the width of a stop line on a lane of unknown width, metres.
HALF_WIDTH_M = 1.85
#: A light without a lane takes the heading of a lane segment within this distance.
LANE_REACH_M = 2.0
LANES_PER_STOP = 4


@dataclass(frozen=True)
class Lights:
    """Traffic lights in the local frame.

    Attributes:
        line: Stop lines from left to right of the lane: x, y, x, y.
        lane: Dense lane index, -1 if the lane is missing in the map.
        heading, exit_heading: Headings of the lane at the stop point and at its end.
        state: States over time, -1 unobserved.
        overflow: Numbers of lights that do not fit or have no known direction, by name.
    """

    line: Float[Array, "light 4"]
    z: Float[Array, " light"]
    lane: Int[Array, " light"]
    heading: Float[Array, " light"]
    exit_heading: Float[Array, " light"]
    state: Int8[Array, "light time"]
    overflow: dict[str, int]


def place_lights(
    lights: Sequence[Light],
    on: LaneSegments,
    origin: Float[Array, "3"],
    path: Float[Array, "step 2"],
    most: int,
) -> Lights:
    """Place stop lines across the lanes at the stop points; keep the ``most`` lights nearest to ``path``."""
    graph, steps = on.graph, len(lights[0].states) if lights else 0
    stop = np.array([light.stop_point for light in lights], dtype=np.float64).reshape(-1, 3) - origin
    index = graph.index()
    lane = np.array([index.get(light.lane_id, -1) for light in lights], dtype=np.int64)
    heading, exit_heading = np.full(len(lights), np.nan), np.full(len(lights), np.nan)
    known = np.flatnonzero(lane >= 0)
    s = _arc_at(graph, lane[known], stop[known, :2])
    heading[known] = graph.lines.heading(lane[known], s, END_SPAN_M)
    exit_heading[known] = graph.lines.heading(lane[known], graph.lines.length[lane[known]], END_SPAN_M)
    for i in np.flatnonzero(lane < 0):
        heading[i] = exit_heading[i] = _heading_near(on, stop[i])
    width = np.append(graph.width, -1.0)[lane]
    half = np.where(width > 0, width / 2, HALF_WIDTH_M)
    directed = np.flatnonzero(~np.isnan(heading))
    rows = directed[np.argsort(path_distance(stop[directed, :2], path), kind="stable")]
    overflow = +Counter(lights=len(rows) - most, lights_without_lane=len(lights) - len(directed))
    rows = rows[:most]
    left = half[rows, None] * left_normals(heading[rows])
    states = [np.asarray(lights[i].states, dtype=np.int8) for i in rows]
    return Lights(
        line=np.concatenate((stop[rows, :2] + left, stop[rows, :2] - left), axis=1),
        z=stop[rows, 2],
        lane=lane[rows],
        heading=heading[rows],
        exit_heading=exit_heading[rows],
        state=np.stack(states) if states else np.zeros((0, steps), dtype=np.int8),
        overflow=overflow,
    )


def _arc_at(
    graph: LaneGraph, lane: Int[Array, " light"], xy: Float[Array, "light 2"]
) -> Float[Array, " light"]:
    """Arc length on each lane of the point nearest to its stop point."""
    result = np.zeros(len(lane))
    for i, (row, point) in enumerate(zip(lane, xy, strict=True)):
        line, arc = graph.lines.line(row)[:, :2], graph.lines.arc[graph.lines.start[row] :]
        distance, along = point_to_segment(point, line[:-1], line[1:])
        best = distance.argmin()
        result[i] = arc[best] + along[best] * (arc[best + 1] - arc[best])
    return result


def _heading_near(on: LaneSegments, stop: Float[Array, "3"]) -> float:
    """Heading of the nearest lane segment, NaN without one in reach."""
    if len(on.segments) == 0:
        return float("nan")
    distance, _ = point_to_segment(stop[:2], on.segments.a[:, :2], on.segments.b[:, :2])
    best = distance.argmin()
    return float(on.heading[best]) if distance[best] <= LANE_REACH_M else float("nan")


@dataclass(frozen=True)
class Stops:
    """Stop signs in the local frame, each with up to four dense lane indices (-1 padded)."""

    xy: Float[Array, "stop 2"]
    lane: Int[Array, "stop 4"]
    overflow: dict[str, int]


def place_stops(
    features: Sequence[MapFeature], graph: LaneGraph, origin: Float[Array, "3"], path: Float[Array, "step 2"],
    most: int,
) -> Stops:  # fmt: skip
    """Place stop signs with the lanes that they control; keep the ``most`` signs nearest to ``path``."""
    signs = [f for f in features if f.kind == RoadKind.STOP_SIGN and len(f.points)]
    xy = np.array([f.points[0] for f in signs], dtype=np.float64).reshape(-1, 3)[:, :2] - origin[:2]
    index = graph.index()
    lane = np.full((len(signs), LANES_PER_STOP), -1)
    lost = 0
    for i, sign in enumerate(signs):
        known = [index[number] for number in sign.lanes if number in index]
        lane[i, : min(len(known), LANES_PER_STOP)] = known[:LANES_PER_STOP]
        lost += max(len(known) - LANES_PER_STOP, 0)
    rows = np.argsort(path_distance(xy, path), kind="stable")
    return Stops(xy[rows[:most]], lane[rows[:most]], +Counter(stops=len(rows) - most, stop_lanes=lost))
