"""Argoverse 2 maps: lane segments, drivable areas and crossings of one log, as JSON next to it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from drivax.datasets import parsing
from drivax.datasets.argoverse.tables import FARTHEST_M
from drivax.datasets.road_edges import Area, road_edges
from drivax.errors import DataError
from drivax.geometry.polylines import arc_lengths
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import RoadKind

Array = np.ndarray[Any, Any]

#: File-name pattern of the map of a scenario or log.
MAP_PATTERN = "log_map_archive_*.json"
_AGAIN = "download the map again"
#: Largest plausible distance of a point from the median point; a local map spans some hundred metres.
_SPREAD_M = 20_000.0
#: Largest spacing of centre line points interpolated between boundaries, and length of the shortest usable line.
_SPACING_M, _SHORTEST_M = 2.0, 1e-3
#: Upper bound of lane ids: ids of edges, lines and crosswalks, which follow the largest one, must fit in 64 bits.
_ID_END = 2**62
_LANES = {"VEHICLE": RoadKind.LANE_SURFACE, "BUS": RoadKind.LANE_SURFACE, "BIKE": RoadKind.LANE_BIKE}
#: ``RoadKind`` has WOMD's kinds, which lack two: white lines that are dashed on one side and solid on the other become
#: double solid, double dashed white lines become single.
_MARKS = {
    "DASHED_WHITE": RoadKind.LINE_BROKEN_SINGLE_WHITE,
    "DOUBLE_DASH_WHITE": RoadKind.LINE_BROKEN_SINGLE_WHITE,
    "SOLID_WHITE": RoadKind.LINE_SOLID_SINGLE_WHITE,
    **dict.fromkeys(
        ("DOUBLE_SOLID_WHITE", "DASH_SOLID_WHITE", "SOLID_DASH_WHITE"), RoadKind.LINE_SOLID_DOUBLE_WHITE
    ),
    "DASHED_YELLOW": RoadKind.LINE_BROKEN_SINGLE_YELLOW,
    "DOUBLE_DASH_YELLOW": RoadKind.LINE_BROKEN_DOUBLE_YELLOW,
    "SOLID_YELLOW": RoadKind.LINE_SOLID_SINGLE_YELLOW,
    "DOUBLE_SOLID_YELLOW": RoadKind.LINE_SOLID_DOUBLE_YELLOW,
    **dict.fromkeys(("DASH_SOLID_YELLOW", "SOLID_DASH_YELLOW"), RoadKind.LINE_PASSING_DOUBLE_YELLOW),
}
#: Fields of map elements that are read.
_FIELDS = frozenset((
    "id", "is_intersection", "lane_type", "centerline", "predecessors", "successors", "area_boundary", "edge1", "edge2",
    *(f"{side}_{name}" for side in ("left", "right") for name in ("lane_boundary", "lane_mark_type", "neighbor_id")),
))  # fmt: skip


class ArgoverseMap(NamedTuple):
    """Features of a map, and counts of lost elements by name."""

    features: tuple[MapFeature, ...]
    lost: dict[str, int]


def read_map(path: Path) -> ArgoverseMap:
    """Read a local map: lanes, painted lines (once each), road edges and crossings, in the city's frame, metres.

    Lanes keep their ids, their links (some lead outside the map) and all neighbours, oncoming lanes included.
    """
    try:
        return _decode(parsing.load_json(path))
    except DataError as error:
        raise DataError(error.problem, file=path, record=error.record, cure=error.cure or _AGAIN) from error


def _decode(content: Any) -> ArgoverseMap:
    """Decode a parsed map; edges, painted lines and crossings get ids above those of the lanes."""
    groups = ("lane_segments", "drivable_areas", "pedestrian_crossings")
    if not isinstance(content, dict) or not all(isinstance(content.get(group), dict) for group in groups):
        raise DataError(f"is not an Argoverse 2 map with {', '.join(groups)}", cure=_AGAIN)
    segments, drivable_areas, crossings = ([*content[group].values()] for group in groups)
    lanes = [lane for segment in segments if (lane := _lane(segment)) is not None]
    lines = _lines(segments)
    areas: list[Area] = [(_points(area, "area_boundary"), ()) for area in drivable_areas]
    # Both edges of a crossing run in the same direction, so reverse one to close the outline.
    outlines = [np.concatenate((_points(item, "edge1"), _points(item, "edge2")[::-1])) for item in crossings]
    outlines = [outline for outline in outlines if len(outline) >= 3]
    _check_extent(
        [*(lane.points for lane in lanes), *(line for _, line in lines), *(r for r, _ in areas), *outlines]
    )
    first_id = 1 + max((lane.feature_id for lane in lanes), default=0)
    edges = road_edges(areas, first_id)
    shapes = [*lines, *((RoadKind.CROSSWALK, outline) for outline in outlines)]
    markings = (MapFeature(id, *shape) for id, shape in enumerate(shapes, first_id + len(edges)))
    fields = (content.keys() - {*groups}).union(*segments, *drivable_areas, *crossings)
    lost = parsing.nonzero(
        lanes_without_length=len(segments) - len(lanes), unknown_fields=len(fields - _FIELDS)
    )
    return ArgoverseMap((*lanes, *edges, *markings), lost)


def _lane(segment: Any) -> MapFeature | None:
    """Return the lane of a segment; None if a boundary has no length."""
    left, right = _points(segment, "left_lane_boundary"), _points(segment, "right_lane_boundary")
    lengths = [arc_lengths(line).max(initial=0.0) for line in (left, right)]
    if min(lengths) < _SHORTEST_M:
        return None
    # Points at the same fraction of both boundaries face each other. The cap bounds the memory of damaged lines until
    # ``_check_extent`` refuses them.
    count = int(min(max(lengths), 2 * _SPREAD_M) / _SPACING_M) + 2
    fractions = np.linspace(0.0, 1.0, max(len(left), len(right), count))
    left, right = _sample(left, fractions), _sample(right, fractions)
    return MapFeature(
        feature_id=_id(segment.get("id")),
        kind=_LANES.get(str(segment.get("lane_type")), RoadKind.LANE_UNDEFINED),
        points=_centre(segment, (left + right) / 2),
        width_m=float(np.median(np.hypot(*(left - right)[:, :2].T))),
        successors=_ids(segment, "successors"),
        predecessors=_ids(segment, "predecessors"),
        left_neighbours=_neighbour(segment, "left_neighbor_id"),
        right_neighbours=_neighbour(segment, "right_neighbor_id"),
        interpolating=segment.get("is_intersection") is True,
    )


def _sample(line: Float[Array, "point 3"], fractions: Float[Array, " sample"]) -> Float[Array, "sample 3"]:
    """Interpolate points at fractions of a line's length."""
    arc = arc_lengths(line)
    return np.column_stack([np.interp(fractions * arc[-1], arc, line[:, axis]) for axis in range(3)])


def _centre(segment: Any, middle: Float[Array, "point 3"]) -> Float[Array, "centre 3"]:
    """Return the segment's centre line with heights from ``middle`` (its own may be 0); without one, ``middle``."""
    if segment.get("centerline") is None:
        return middle
    centre = _points(segment, "centerline")
    arc = arc_lengths(centre)
    if arc.max(initial=0.0) < _SHORTEST_M:
        return middle
    centre[:, 2] = _sample(middle, arc / arc[-1])[:, 2]
    return centre


def _lines(segments: Sequence[Any]) -> list[tuple[RoadKind, Float[Array, "_ 3"]]]:
    """Return painted boundaries, each once: adjacent lanes share the line between them."""
    lines: dict[bytes, tuple[RoadKind, Array]] = {}
    for segment in segments:
        for side in ("left", "right"):
            mark = str(segment.get(f"{side}_lane_mark_type"))
            points = _points(segment, f"{side}_lane_boundary")
            if mark == "NONE" or len(points) < 2:
                continue
            # The key is the same for both directions in which lanes may store a shared line.
            centimetres = np.round(points * 100) + 0.0  # no negative zeros
            ends = centimetres[0].tolist(), centimetres[-1].tolist()
            key = (centimetres if ends[0] <= ends[1] else centimetres[::-1]).tobytes()
            lines.setdefault(key, (_MARKS.get(mark, RoadKind.LINE_UNKNOWN), points))
    return list(lines.values())


def _points(record: Any, name: str) -> Float[Array, "point 3"]:
    """Read the points ``record[name]``: x, y, z in metres."""
    try:
        rows = [(point["x"], point["y"], point["z"]) for point in record[name]]
        points = np.array(rows, np.float64).reshape(-1, 3)
        parsing.check_within(FARTHEST_M, points)
    except (TypeError, KeyError, ValueError, OverflowError, IndexError) as error:
        raise DataError(f"{name} is not a list of points", record=_record_id(record), cure=_AGAIN) from error
    return points


def _record_id(record: Any) -> str | None:
    return str(record.get("id"))[:40] if isinstance(record, dict) else None


def _ids(record: Any, name: str) -> tuple[int, ...]:
    links = record.get(name)
    if not isinstance(links, list):
        raise DataError(f"{name} is not a list of ids", record=_record_id(record), cure=_AGAIN)
    return tuple(_id(link) for link in links)


def _neighbour(record: Any, name: str) -> tuple[int, ...]:
    return () if record.get(name) is None else (_id(record[name]),)


def _id(value: Any) -> int:
    if not isinstance(value, int) or not 0 <= value < _ID_END:
        raise DataError(f"{str(value)[:40]!r} is not an id of a map element", cure=_AGAIN)
    return value


def _check_extent(lines: Sequence[Float[Array, "_ 3"]]) -> None:
    """Refuse points far away from the others: lines of that length would be cut into millions of segments."""
    points = np.concatenate([np.zeros((0, 3)), *lines])
    if len(points) and not (np.abs(points - np.median(points, axis=0)) <= _SPREAD_M).all():
        problem = f"a point of the map is more than {_SPREAD_M / 1000:.0f} km away from the others"
        raise DataError(problem, cure=_AGAIN)
