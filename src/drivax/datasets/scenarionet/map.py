"""The map of a ScenarioNet file: lanes, markings, polygons, and road edges with the drivable side on their left."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivax.datasets import parsing
from drivax.datasets.scenarionet.values import (  # fmt: skip
    MOST_NUMBERS,
    SKIP,
    Names,
    extent,
    floats,
    items,
    number,
    text,
)
from drivax.errors import DataError
from drivax.geometry.polylines import point_to_segment
from drivax.geometry.vectors import wrap
from drivax.scenario.build.lanes import WIDTHS_M
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import EDGE_KINDS, LANE_KINDS, POLYGON_KINDS, RoadKind

#: Lane points within this distance say on which side of an edge one drives, metres.
NEIGHBOUR_M = 8.0
#: Places along a ring that are looked up in the other rings; rings may touch in some.
_PROBES = 5
_MOST_COMPARISONS = 100_000_000
#: Comparisons of points and segments at once.
_BLOCK = 500_000


def outlines_on_left(lines: Sequence[Array]) -> list[Array]:
    """Rings of the outline of drivable space, exteriors anticlockwise and holes clockwise.

    Rings do not cross, so one inside an even number of others is an exterior, else a hole. A line that is no ring
    (the outline was clipped) is turned round: GEOS, which makes these outlines, runs clockwise around areas.

    Args:
        lines: Points of the rings, metres; the first point is repeated at the end.
    """
    ring = [len(points) >= 4 and bool((points[0, :2] == points[-1, :2]).all()) for points in lines]
    rings = [points[:, :2] for points, closed in zip(lines, ring, strict=True) if closed]
    if _PROBES * len(rings) * sum(map(len, rings)) > _MOST_COMPARISONS:
        raise DataError(f"an outline of {len(rings)} rings", cure=SKIP)
    depth = iter([_depth(points, [other for other in rings if other is not points]) for points in rings])
    turned = []
    for points, closed in zip(lines, ring, strict=True):
        anticlockwise = closed and _area(points) > 0
        exterior = closed and next(depth) % 2 == 0
        turned.append(points if closed and anticlockwise == exterior else points[::-1].copy())
    return turned


def _area(ring: Array) -> float:
    """Twice the signed area, anticlockwise positive (shoelace formula around the first point)."""
    x, y = (ring[:, :2] - ring[0, :2]).T
    return float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))


def _depth(ring: Array, others: Sequence[Array]) -> int:
    """In how many other rings a ring lies, as most of a few places along it tell."""
    at = np.linspace(0, len(ring) - 2, _PROBES).astype(np.int64)
    place = (ring[at] + ring[at + 1]) / 2
    return sum(int(2 * inside(place, other).sum() > _PROBES) for other in others)


def inside(points: Array, ring: Array) -> Array:
    """Which points lie inside a closed ring (even-odd rule)."""
    a, b = ring[:-1], ring[1:]
    above = points[:, None, 1] >= a[None, :, 1]
    crosses = above != (points[:, None, 1] >= b[None, :, 1])
    rise = np.where(a[:, 1] == b[:, 1], 1.0, b[:, 1] - a[:, 1])
    x = a[:, 0] + (points[:, None, 1] - a[:, 1]) / rise * (b - a)[:, 0]
    return ((crosses & (x > points[:, None, 0])).sum(axis=1) % 2).astype(bool)


def drivable_on_left(edges: Sequence[Array], lanes: Sequence[Array]) -> list[Array]:
    """Edges with most of the lanes next to them on their left; unchanged where no lane is near.

    Args:
        edges: Points of road edges, metres.
        lanes: Points of lane centres.
    """
    centres = np.concatenate([points[:, :2] for points in lanes]) if lanes else np.zeros((0, 2))
    if sum(map(len, edges)) * len(centres) > _MOST_COMPARISONS:
        raise DataError("road edges and lanes of too many points", cure=SKIP)
    return [points[::-1].copy() if _votes_left(points[:, :2], centres) < 0 else points for points in edges]


def _votes_left(edge: Array, centres: Array) -> int:
    """Lane points next to an edge that are on its left, less those on its right."""
    low, high = edge.min(axis=0) - NEIGHBOUR_M, edge.max(axis=0) + NEIGHBOUR_M
    near = centres[np.all((centres >= low) & (centres <= high), axis=1)]
    block = max(_BLOCK // len(edge), 1)
    return sum(_votes(edge, near[first : first + block]) for first in range(0, len(near), block))


def _votes(edge: Array, points: Array) -> int:
    a, b = edge[:-1], edge[1:]
    distance, along = point_to_segment(points[:, None], a[None], b[None])
    rows = np.arange(len(points))
    nearest = distance.argmin(axis=1)
    place = nearest + along[rows, nearest]
    # What is nearest to an end lies before or behind the edge, not next to it.
    adjacent = (distance[rows, nearest] <= NEIGHBOUR_M) & (place > 0) & (place < len(a))
    step, offset = (b - a)[nearest], points - a[nearest]
    side = np.sign(step[:, 0] * offset[:, 1] - step[:, 1] * offset[:, 0])
    return int(side[adjacent].sum())


Array = np.ndarray[Any, Any]

_MPS_PER_KMH = 1 / 3.6
#: A limit above this is a placeholder (MetaDrive's is 1000 km/h).
_FASTEST_MPS = 45.0
#: Data sets whose converters write invented limits: 100 km/h on every connector, 85 mph everywhere.
_MADE_UP_LIMITS = ("nuscenes", "lyft", "nuplan", "av2")
#: Data sets whose files have road edges with the drivable side on the left.
_ORIENTED = ("womd",)
#: Type names of MetaDrive (metadrive/type.py); what is not here (sidewalks) is left out and counted.
_KINDS = {
    "LANE_UNKNOWN": RoadKind.LANE_UNDEFINED,
    "LANE_FREEWAY": RoadKind.LANE_FREEWAY,
    "LANE_SURFACE_STREET": RoadKind.LANE_SURFACE,
    "LANE_SURFACE_UNSTRUCTURE": RoadKind.LANE_SURFACE,
    "LANE_BIKE_LANE": RoadKind.LANE_BIKE,
    "UNKNOWN_LINE": RoadKind.LINE_UNKNOWN,
    **{f"ROAD_{kind.name}": kind for kind in RoadKind if kind.name.startswith("LINE_")},
    "UNKNOWN": RoadKind.EDGE_UNKNOWN,
    "ROAD_EDGE_BOUNDARY": RoadKind.EDGE_BOUNDARY,
    "ROAD_EDGE_MEDIAN": RoadKind.EDGE_MEDIAN,
    "GUARDRAIL": RoadKind.EDGE_BOUNDARY,
    "STOP_SIGN": RoadKind.STOP_SIGN,
    "CROSSWALK": RoadKind.CROSSWALK,
    "SPEED_BUMP": RoadKind.SPEED_BUMP,
    "DRIVEWAY": RoadKind.DRIVEWAY,
}
#: How converters call rings of the outline of all drivable space, which they store as markings.
_OUTLINE = "boundary_"
#: The third column of lanes is their heading where its median difference from the points' direction is below this.
_YAW_RAD = 0.05
#: Nothing of a recording's map lies further from its ego, and no map is longer in all, metres.
_FARTHEST_M, _LONGEST_M = 1e5, 2e6


@dataclass(frozen=True)
class RoadMap:
    """A map as it was read.

    Attributes:
        features: The features; links to features that the file lacks are left out.
        names: Numbers of the features' names.
        flat: Whether the file knows no heights.
        lost: What was left out, by name and number.
    """

    features: tuple[MapFeature, ...]
    names: Names
    flat: bool
    lost: Mapping[str, int]


@dataclass(frozen=True)
class _Reading:
    """What holds for all features of one file."""

    dataset: str
    around: Array
    names: Names
    lost: Counter[str]
    #: Features that the file gives three columns.
    spatial: set[int]


def road_map(table: Mapping[Any, Any], dataset: str, around: Array) -> RoadMap:
    """Reads ``map_features``.

    Args:
        table: Features by name.
        dataset: Where the data come from; decides which limits and which sides of edges can be believed.
        around: A place (x, y) where the ego has been, metres.
    """
    named = {name: body for key, body in table.items() if (name := text(key)) and isinstance(body, dict)}
    numbers = sum(extent(value) for body in named.values() for value in body.values())
    if numbers > MOST_NUMBERS:
        raise DataError(f"a map of {numbers} numbers", cure=SKIP)
    reading = _Reading(dataset, around, Names(list(named), bits=62), Counter(), set())
    reading.lost["broken_features"] += len(table) - len(named)
    read = {name: f for name, body in named.items() if (f := _feature(name, body, reading)) is not None}
    features = list(read.values())
    _check_length(features)
    lanes = [f.points for f in features if f.kind in LANE_KINDS and f.feature_id in reading.spatial]
    flat = not reading.spatial or third_column_is_heading(lanes)
    if flat:
        features = [replace(f, points=_on_plane(f.points)) for f in features]
    outline = np.array([_is_outline(name, f) for name, f in read.items()], dtype=bool)
    return RoadMap(
        features=tuple(_with_edges(features, outline, dataset)),
        names=reading.names,
        flat=flat,
        lost=parsing.nonzero(**reading.lost),
    )


def _feature(name: str, body: Mapping[Any, Any], reading: _Reading) -> MapFeature | None:
    """One feature with the third column as the file has it; None where it is left out."""
    kind = _KINDS.get(body["type"]) if isinstance(body.get("type"), str) else None
    feature_id = reading.names.get(name)
    if kind is None or feature_id is None:
        reading.lost["features_of_other_types"] += 1
        return None
    points = _points(name, kind, body)
    if (
        points is None or not (np.abs(points[:, :2] - reading.around) < _FARTHEST_M).all()
    ):  # NaN compares false
        reading.lost["broken_features"] += 1
        return None
    if points.shape[1] == 3:
        reading.spatial.add(feature_id)
    else:
        points = _on_plane(points)
    if kind in LANE_KINDS:
        return _lane(MapFeature(feature_id, kind, points), body, reading)
    controlled = _links(body.get("lane"), reading) if kind == RoadKind.STOP_SIGN else ()
    return MapFeature(feature_id, kind, points, lanes=controlled)


def _points(name: str, kind: RoadKind, body: Mapping[Any, Any]) -> Array | None:
    """The points as the file has them; None where there are none."""
    part = "polygon" if kind in POLYGON_KINDS else "position" if kind == RoadKind.STOP_SIGN else "polyline"
    if body.get(part) is None:
        return None
    points = floats(body[part], f"map_features {name[:40]!r}: {part}")
    points = points[None] if kind == RoadKind.STOP_SIGN and points.ndim == 1 else points
    return points if points.ndim == 2 and points.shape[1] in (2, 3) and len(points) else None


def _near(points: Array, around: Array) -> bool:
    away = points - np.append(around, 0.0)[: points.shape[1]]
    return bool((np.abs(away) < _FARTHEST_M).all())  # NaN compares false


def _on_plane(points: Array) -> Array:
    return np.pad(points[:, :2], ((0, 0), (0, 1)))


def _lane(lane: MapFeature, body: Mapping[Any, Any], reading: _Reading) -> MapFeature:
    return replace(
        lane,
        limit_mps=_limit(body, reading),
        width_m=_width(body),
        successors=_links(body.get("exit_lanes"), reading),
        predecessors=_links(body.get("entry_lanes"), reading),
        left_neighbours=_links(body.get("left_neighbor"), reading),
        right_neighbours=_links(body.get("right_neighbor"), reading),
        # Argoverse files call every lane interpolating.
        interpolating=body.get("interpolating") is True and reading.dataset != "av2",
    )


def _limit(body: Mapping[Any, Any], reading: _Reading) -> float | None:
    """The speed limit in m/s; 0 in the file means unknown."""
    given = ((body.get("speed_limit_mph"), parsing.MPS_PER_MPH), (body.get("speed_limit_kmh"), _MPS_PER_KMH))
    for value, unit in given:
        limit = number(value)
        if limit is not None and limit > 0:
            if reading.dataset in _MADE_UP_LIMITS or limit * unit > _FASTEST_MPS:
                reading.lost["made_up_speed_limits"] += 1
                return None
            return limit * unit
    return None


def _width(body: Mapping[Any, Any]) -> float | None:
    """The width of a lane, median over its points, where both distances to its boundaries make one; else None.

    The file has the distances to the left and to the right boundary, by index instead of by place, so that up to 25 m
    occur, and one that is missing is a copy of the other.
    """
    if body.get("width") is None:
        return None
    sides = floats(body["width"], "lane widths")
    if sides.ndim != 2 or sides.shape[1] != 2 or not len(sides):
        return None
    both = sides[(sides > 0).all(axis=1) & (sides[:, 0] != sides[:, 1])]
    width = float(np.median(both.sum(axis=1))) if len(both) else 0.0
    return width if WIDTHS_M[0] <= width <= WIDTHS_M[1] else None


def _links(value: Any, reading: _Reading) -> tuple[int, ...]:
    """Numbers of linked features. Links come as numbers, texts, or neighbours with a ``feature_id``."""
    links = []
    for item in items(value):
        link = reading.names.get(item.get("feature_id") if isinstance(item, dict) else item)
        if link is None:
            reading.lost["dangling_links"] += 1
        else:
            links.append(link)
    return tuple(links)


def _check_length(features: Sequence[MapFeature]) -> None:
    total = sum(float(np.hypot(*np.diff(f.points[:, :2], axis=0).T).sum()) for f in features)
    if total > _LONGEST_M:
        raise DataError(f"a map of {total / 1000:.0f} km of lines", cure=SKIP)


def third_column_is_heading(lanes: Sequence[Array]) -> bool:
    """Whether the third column of lanes is their heading (nuScenes' arc lines are sampled as x, y, yaw).

    Args:
        lanes: Points of lanes, three columns.
    """
    differences = []
    for points in lanes:
        step = np.diff(points[:, :2], axis=0)
        moved = step.any(axis=1)
        direction = np.arctan2(step[moved, 1], step[moved, 0])
        differences.append(np.abs(wrap(points[:-1, 2][moved] - direction)))
    difference = np.concatenate(differences) if differences else np.zeros(0)
    return len(difference) > 0 and float(np.median(difference)) < _YAW_RAD


def _is_outline(name: str, feature: MapFeature) -> bool:
    return name.startswith(_OUTLINE) and feature.kind == RoadKind.LINE_SOLID_SINGLE_WHITE


def _with_edges(features: list[MapFeature], outline: Array, dataset: str) -> list[MapFeature]:
    """The features with outlines of drivable space as road edges, and every edge's drivable side on its left."""
    rings = outlines_on_left(
        [f.points for f, is_outline in zip(features, outline, strict=True) if is_outline]
    )
    for row, points in zip(np.flatnonzero(outline), rings, strict=True):
        features[row] = replace(features[row], kind=RoadKind.EDGE_BOUNDARY, points=points)
    if dataset in _ORIENTED:
        return features
    lanes = [f.points for f in features if f.kind in LANE_KINDS]
    rows = [i for i, f in enumerate(features) if f.kind in EDGE_KINDS and not outline[i]]
    for row, points in zip(rows, drivable_on_left([features[i].points for i in rows], lanes), strict=True):
        features[row] = replace(features[row], points=points)
    return features
