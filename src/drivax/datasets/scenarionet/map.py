"""The map of a ScenarioNet file: lanes, markings, polygons, and road edges with the drivable side on their left."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivax.datasets import parsing
from drivax.datasets.scenarionet.pickles import (
    MOST_NUMBERS,
    SKIP,
    Names,
    as_float,
    as_list,
    as_text,
    extent,
    floats,
)
from drivax.errors import DataError
from drivax.geometry.polylines import point_to_segment
from drivax.geometry.vectors import wrap
from drivax.scenario.build.lanes import WIDTHS_M
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import EDGE_KINDS, LANE_KINDS, POLYGON_KINDS, RoadKind

Array = np.ndarray[Any, Any]

#: Lane points within this distance decide which side of an edge is drivable, metres.
NEIGHBOUR_M = 8.0
#: Points along a ring that are tested against the other rings; at some of them rings may touch.
_PROBES = 5
#: Maximum number of comparisons of points with points of rings or edges; maps that need more are refused.
_MOST_COMPARISONS = 100_000_000
#: Comparisons of points and segments at a time.
_BLOCK = 500_000
_MPS_PER_KMH = 1 / 3.6
#: A higher limit is a placeholder (MetaDrive's is 1000 km/h).
_FASTEST_MPS = 45.0
#: Data sets whose converters make limits up: 100 km/h on every connector, 85 mph everywhere.
_MADE_UP_LIMITS = ("nuscenes", "lyft", "nuplan", "av2")
#: Data sets with the drivable side on the left of road edges.
_DRIVABLE_LEFT = ("womd",)
#: Type names of MetaDrive (metadrive/type.py); others, such as sidewalks, are dropped and counted.
_KINDS = {
    "LANE_UNKNOWN": RoadKind.LANE_UNDEFINED,
    "LANE_SURFACE_STREET": RoadKind.LANE_SURFACE,
    "LANE_SURFACE_UNSTRUCTURE": RoadKind.LANE_SURFACE,
    "LANE_BIKE_LANE": RoadKind.LANE_BIKE,
    "UNKNOWN_LINE": RoadKind.LINE_UNKNOWN,
    **{f"ROAD_{kind.name}": kind for kind in RoadKind if kind.name.startswith("LINE_")},
    # The earliest version of the format.
    "BROKEN_SINGLE_YELLOW": RoadKind.LINE_BROKEN_SINGLE_YELLOW,
    "CROSS_WALK": RoadKind.CROSSWALK,
    "UNKNOWN": RoadKind.EDGE_UNKNOWN,
    "ROAD_EDGE_BOUNDARY": RoadKind.EDGE_BOUNDARY,
    "ROAD_EDGE_MEDIAN": RoadKind.EDGE_MEDIAN,
    "GUARDRAIL": RoadKind.EDGE_BOUNDARY,
    **{name: RoadKind[name] for name in ("LANE_FREEWAY", "STOP_SIGN", "CROSSWALK", "SPEED_BUMP", "DRIVEWAY")},
}
#: Known fields of features; some are not read.
_FIELDS = frozenset((
    "type", "polyline", "polygon", "position", "lane", "interpolating", "width", "speed_limit_mph", "speed_limit_kmh",
    "entry_lanes", "exit_lanes", "left_neighbor", "right_neighbor", "left_boundaries", "right_boundaries",
))  # fmt: skip
#: Prefix of outlines of drivable space, which converters store as markings.
_OUTLINE = "boundary_"
#: The third column of lanes is a heading if its median difference from the points' direction is below this.
_YAW_RAD = 0.05
#: Largest distance of a map point from ego and largest length of all lines, metres.
_FARTHEST_M, _LONGEST_M = 1e5, 2e6


def orient_outlines(lines: Sequence[Array]) -> list[Array]:
    """Orient the outline of drivable space: exteriors anticlockwise, holes clockwise.

    Rings repeat their first point and do not cross, so a ring inside an even number of others is an exterior, else a
    hole. A line that is not a ring (a clipped outline) is reversed, because GEOS makes clockwise outlines of areas.
    """
    are_rings = [len(points) >= 4 and bool((points[0, :2] == points[-1, :2]).all()) for points in lines]
    rings = [points[:, :2] for points, is_ring in zip(lines, are_rings, strict=True) if is_ring]
    if _PROBES * len(rings) * sum(map(len, rings)) > _MOST_COMPARISONS:
        raise DataError(f"an outline of {len(rings)} rings", cure=SKIP)
    depth = iter([_depth(points, [other for other in rings if other is not points]) for points in rings])
    result = []
    for points, is_ring in zip(lines, are_rings, strict=True):
        is_oriented = is_ring and (_twice_area(points) > 0) == (next(depth) % 2 == 0)
        result.append(points if is_oriented else points[::-1].copy())
    return result


def _twice_area(ring: Array) -> float:
    """Return twice the signed area of a ring, anticlockwise positive (shoelace formula around the first point)."""
    x, y = (ring[:, :2] - ring[0, :2]).T
    return float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))


def _depth(ring: Array, others: Sequence[Array]) -> int:
    """Count the other rings that contain most of a few points along a ring."""
    segments = np.linspace(0, len(ring) - 2, _PROBES).astype(np.int64)
    probes = (ring[segments] + ring[segments + 1]) / 2
    return sum(int(2 * in_ring(probes, other).sum() > _PROBES) for other in others)


def in_ring(points: Array, ring: Array) -> Array:
    """Return whether each point lies inside a closed ring (even-odd rule)."""
    a, b = ring[:-1], ring[1:]
    above = points[:, None, 1] >= a[None, :, 1]
    crosses = above != (points[:, None, 1] >= b[None, :, 1])
    # Horizontal edges cross no horizontal ray: any divisor but zero will do.
    rise = np.where(a[:, 1] == b[:, 1], 1.0, b[:, 1] - a[:, 1])
    x = a[:, 0] + (points[:, None, 1] - a[:, 1]) / rise * (b - a)[:, 0]
    return ((crosses & (x > points[:, None, 0])).sum(axis=1) % 2).astype(bool)


def orient_edges(edges: Sequence[Array], lanes: Sequence[Array]) -> list[Array]:
    """Orient road edges so that most lane points next to them are on their left; keep edges without a majority."""
    centres = np.concatenate([points[:, :2] for points in lanes]) if lanes else np.zeros((0, 2))
    if sum(map(len, edges)) * len(centres) > _MOST_COMPARISONS:
        raise DataError("road edges and lanes have too many points", cure=SKIP)
    return [points[::-1].copy() if _votes_left(points[:, :2], centres) < 0 else points for points in edges]


def _votes_left(edge: Array, centres: Array) -> int:
    """Return the number of lane points next to an edge on its left minus those on its right."""
    if len(edge) < 2:  # a point has no sides
        return 0
    low, high = edge.min(axis=0) - NEIGHBOUR_M, edge.max(axis=0) + NEIGHBOUR_M
    nearby = centres[np.all((centres >= low) & (centres <= high), axis=1)]
    block = max(_BLOCK // len(edge), 1)
    return sum(_votes(edge, nearby[first : first + block]) for first in range(0, len(nearby), block))


def _votes(edge: Array, points: Array) -> int:
    """Return :func:`_votes_left` for a block of points."""
    a, b = edge[:-1], edge[1:]
    distance, fraction = point_to_segment(points[:, None], a[None], b[None])
    rows = np.arange(len(points))
    nearest = distance.argmin(axis=1)
    position = nearest + fraction[rows, nearest]
    # A point that is nearest to an end lies before or behind the edge, not next to it.
    is_adjacent = (distance[rows, nearest] <= NEIGHBOUR_M) & (position > 0) & (position < len(a))
    step, offset = (b - a)[nearest], points - a[nearest]
    side = np.sign(step[:, 0] * offset[:, 1] - step[:, 1] * offset[:, 0])
    return int(side[is_adjacent].sum())


@dataclass(frozen=True)
class RoadMap:
    """Features, ids by name, whether the file lacks heights (``flat``), and counts of losses.

    Links lead to features of the file; links to skipped features dangle.
    """

    features: tuple[MapFeature, ...]
    names: Names
    flat: bool
    lost: Mapping[str, int]


@dataclass(frozen=True)
class _Reading:
    """State of reading one file; ``spatial`` holds the ids of features with three columns."""

    dataset: str
    around: Array
    names: Names
    lost: Counter[str]
    spatial: set[int]


def road_map(table: Mapping[Any, Any], dataset: str, around: Array) -> RoadMap:
    """Read ``map_features``; ``around`` is a position (x, y) of ego, metres.

    The original data set, ``dataset``, decides which speed limits and which orientation of edges are used.
    """
    bodies = {name: body for key, body in table.items() if (name := as_text(key)) and isinstance(body, dict)}
    numbers = sum(extent(value) for body in bodies.values() for value in body.values())
    if numbers > MOST_NUMBERS:
        raise DataError(f"a map of {numbers} numbers", cure=SKIP)
    reading = _Reading(dataset, around, Names(list(bodies), bits=62), Counter(), set())
    reading.lost["broken_features"] += len(table) - len(bodies)
    reading.lost["unknown_fields"] += len({str(key) for body in bodies.values() for key in body} - _FIELDS)
    by_name = {name: f for name, body in bodies.items() if (f := _feature(name, body, reading)) is not None}
    features = list(by_name.values())
    total = sum(float(np.hypot(*np.diff(f.points[:, :2], axis=0).T).sum()) for f in features)
    if total > _LONGEST_M:
        raise DataError(f"a map of {total / 1000:.0f} km of lines", cure=SKIP)
    lanes = [f.points for f in features if f.kind in LANE_KINDS and f.feature_id in reading.spatial]
    flat = not reading.spatial or has_headings(lanes)
    if flat:
        features = [replace(f, points=_on_plane(f.points)) for f in features]
    kind = RoadKind.LINE_SOLID_SINGLE_WHITE
    outline = np.array([name.startswith(_OUTLINE) and f.kind == kind for name, f in by_name.items()], bool)
    return RoadMap(
        features=tuple(_with_edges(features, outline, dataset)),
        names=reading.names,
        flat=flat,
        lost=parsing.nonzero(**reading.lost),
    )


def _feature(name: str, body: Mapping[Any, Any], reading: _Reading) -> MapFeature | None:
    """Return a map feature with z as in the file; None for one that is skipped."""
    kind = _KINDS.get(body["type"]) if isinstance(body.get("type"), str) else None
    feature_id = reading.names.get(name)
    if kind is None or feature_id is None:
        reading.lost["features_of_other_types"] += 1
        return None
    points = _points(name, kind, body)
    # NaN compares false.
    if points is None or not (np.abs(points[:, :2] - reading.around) < _FARTHEST_M).all():
        reading.lost["broken_features"] += 1
        return None
    if points.shape[1] == 3:
        reading.spatial.add(feature_id)
    else:
        points = _on_plane(points)
    if kind not in LANE_KINDS:
        lanes = _links(body.get("lane"), reading) if kind == RoadKind.STOP_SIGN else ()
        return MapFeature(feature_id, kind, points, lanes=lanes)
    return MapFeature(
        feature_id,
        kind,
        points,
        limit_mps=_limit(body, reading),
        width_m=_width(body),
        successors=_links(body.get("exit_lanes"), reading),
        predecessors=_links(body.get("entry_lanes"), reading),
        left_neighbours=_links(body.get("left_neighbor"), reading),
        right_neighbours=_links(body.get("right_neighbor"), reading),
        # Argoverse files call every lane interpolating.
        interpolating=body.get("interpolating") is True and reading.dataset != "av2",
    )


def _points(name: str, kind: RoadKind, body: Mapping[Any, Any]) -> Array | None:
    """Return the points as the file has them; None without any.

    The outlines of crosswalks and speed bumps are called ``polyline`` in the earliest version of the format.
    """
    keys = ("position",) if kind == RoadKind.STOP_SIGN else ("polyline",)
    keys = ("polygon", *keys) if kind in POLYGON_KINDS else keys
    key = next((key for key in keys if body.get(key) is not None), None)
    if key is None:
        return None
    points = floats(body[key], f"map_features {name[:40]!r}: {key}")
    points = points[None] if kind == RoadKind.STOP_SIGN and points.ndim == 1 else points
    return points if points.ndim == 2 and points.shape[1] in (2, 3) and len(points) else None


def _on_plane(points: Array) -> Array:
    return np.pad(points[:, :2], ((0, 0), (0, 1)))


def _limit(body: Mapping[Any, Any], reading: _Reading) -> float | None:
    """Return the speed limit in m/s; 0 in the file means unknown."""
    limits = ((body.get("speed_limit_mph"), parsing.MPS_PER_MPH), (body.get("speed_limit_kmh"), _MPS_PER_KMH))
    for value, unit in limits:
        limit = as_float(value)
        if limit is not None and limit > 0:
            if reading.dataset in _MADE_UP_LIMITS or limit * unit > _FASTEST_MPS:
                reading.lost["made_up_speed_limits"] += 1
                return None
            return limit * unit
    return None


def _width(body: Mapping[Any, Any]) -> float | None:
    """Return the median width of a lane over its points; None for a missing or implausible one.

    The file pairs lane and boundary points by index, so distances reach 25 m; a missing side is a copy of the other.
    Points whose two distances are equal, or of which one is not positive, do not count.
    """
    if body.get("width") is None:
        return None
    sides = floats(body["width"], "lane widths")
    if sides.ndim != 2 or sides.shape[1] != 2 or not len(sides):
        return None
    sides = sides[(sides > 0).all(axis=1) & (sides[:, 0] != sides[:, 1])]
    width = float(np.median(sides.sum(axis=1))) if len(sides) else 0.0
    return width if WIDTHS_M[0] <= width <= WIDTHS_M[1] else None


def _links(value: Any, reading: _Reading) -> tuple[int, ...]:
    """Return ids of linked features; files give them as numbers, texts or dictionaries with ``feature_id``."""
    names = [item.get("feature_id") if isinstance(item, dict) else item for item in as_list(value)]
    links = tuple(link for name in names if (link := reading.names.get(name)) is not None)
    if len(links) < len(names):
        reading.lost["dangling_links"] += len(names) - len(links)
    return links


def has_headings(lanes: Sequence[Array]) -> bool:
    """Return whether the third column of lanes is their heading (nuScenes' arc lines are sampled as x, y, yaw)."""
    differences = []
    for points in lanes:
        step = np.diff(points[:, :2], axis=0)
        has_length = step.any(axis=1)
        direction = np.arctan2(step[has_length, 1], step[has_length, 0])
        differences.append(np.abs(wrap(points[:-1, 2][has_length] - direction)))
    difference = np.concatenate(differences) if differences else np.zeros(0)
    return len(difference) > 0 and float(np.median(difference)) < _YAW_RAD


def _with_edges(features: list[MapFeature], outline: Array, dataset: str) -> list[MapFeature]:
    """Turn outlines of drivable space into road edges; orient edges with the drivable side on their left."""
    rows = np.flatnonzero(outline).tolist()
    for row, points in zip(rows, orient_outlines([features[row].points for row in rows]), strict=True):
        features[row] = replace(features[row], kind=RoadKind.EDGE_BOUNDARY, points=points)
    if dataset in _DRIVABLE_LEFT:
        return features
    lanes = [f.points for f in features if f.kind in LANE_KINDS]
    rows = [i for i, f in enumerate(features) if f.kind in EDGE_KINDS and not outline[i]]
    for row, points in zip(rows, orient_edges([features[i].points for i in rows], lanes), strict=True):
        features[row] = replace(features[row], points=points)
    return features
