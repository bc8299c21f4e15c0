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

#: Name of a map next to a log.
MAP_PATTERN = "log_map_archive_*.json"
_AGAIN = "download the map again"
#: A local map spans some hundred metres; a point this far from the others is damage.
_SPREAD_M = 20_000.0
#: Largest spacing of points on a centre line between boundaries, and length of the shortest line that is used.
_SPACING_M, _SHORTEST_M = 2.0, 1e-3
#: Ids are below this, so that those of edges and lines, which follow the largest, fit into 64 bits.
_ID_END = 2**62
_LANES = {"VEHICLE": RoadKind.LANE_SURFACE, "BUS": RoadKind.LANE_SURFACE, "BIKE": RoadKind.LANE_BIKE}
#: WOMD has no white lines that are dashed on one side and solid on the other, which become double solid, and no double
#: dashed ones, which become single.
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
#: Names of elements of a map that are read.
_FIELDS = frozenset((
    "id", "is_intersection", "lane_type", "centerline", "predecessors", "successors", "area_boundary", "edge1", "edge2",
    *(f"{side}_{name}" for side in ("left", "right") for name in ("lane_boundary", "lane_mark_type", "neighbor_id")),
))  # fmt: skip


class ArgoverseMap(NamedTuple):
    """A map's features, and counts of what is lost."""

    features: tuple[MapFeature, ...]
    lost: dict[str, int]


def read_map(path: Path) -> ArgoverseMap:
    """Read a local map: lanes, painted lines (once each), road edges and crossings, in the city's frame, metres.

    Lanes keep their ids, their links (some dangle) and all neighbours, oncoming ones included.
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
    segments, areas, crossings = ([*content[group].values()] for group in groups)
    lanes = [lane for segment in segments if (lane := _lane(segment)) is not None]
    lines = _lines(segments)
    rings: list[Area] = [(_points(area, "area_boundary"), ()) for area in areas]
    # A crossing has two edges in the same direction.
    outlines = [np.concatenate((_points(item, "edge1"), _points(item, "edge2")[::-1])) for item in crossings]
    outlines = [outline for outline in outlines if len(outline) >= 3]
    _check_extent(
        [*(lane.points for lane in lanes), *(line for _, line in lines), *(r for r, _ in rings), *outlines]
    )
    first_id = 1 + max((lane.feature_id for lane in lanes), default=0)
    edges = road_edges(rings, first_id)
    shapes = [*lines, *((RoadKind.CROSSWALK, outline) for outline in outlines)]
    drawn = (MapFeature(id, kind, points) for id, (kind, points) in enumerate(shapes, first_id + len(edges)))
    names = (content.keys() - {*groups}).union(*segments, *areas, *crossings)
    lost = parsing.nonzero(
        lanes_without_length=len(segments) - len(lanes), unknown_fields=len(names - _FIELDS)
    )
    return ArgoverseMap((*lanes, *edges, *drawn), lost)


def _lane(segment: Any) -> MapFeature | None:
    """Build a lane; None for a segment with a boundary of no length."""
    left, right = _points(segment, "left_lane_boundary"), _points(segment, "right_lane_boundary")
    lengths = [arc_lengths(line).max(initial=0.0) for line in (left, right)]
    if min(lengths) < _SHORTEST_M:
        return None
    # Sampled at the same fractions of their lengths, points of one row face each other.
    # A longer line is damage, which ``_check_extent`` refuses; until then it takes little memory.
    count = int(min(max(lengths), 2 * _SPREAD_M) / _SPACING_M) + 2
    fraction = np.linspace(0.0, 1.0, max(len(left), len(right), count))
    left, right = _at(left, fraction), _at(right, fraction)
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


def _at(line: Float[Array, "point 3"], fraction: Float[Array, " sample"]) -> Float[Array, "sample 3"]:
    """Interpolate points at fractions of a line's length."""
    arc = arc_lengths(line)
    return np.column_stack([np.interp(fraction * arc[-1], arc, line[:, axis]) for axis in range(3)])


def _centre(segment: Any, middle: Float[Array, "point 3"]) -> Float[Array, "centre 3"]:
    """Return the segment's own centre line at the height of the middle (some have z = 0), else the middle."""
    if segment.get("centerline") is None:
        return middle
    centre = _points(segment, "centerline")
    arc = arc_lengths(centre)
    if arc.max(initial=0.0) < _SHORTEST_M:
        return middle
    centre[:, 2] = _at(middle, arc / arc[-1])[:, 2]
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
    """Read a list of points of the map."""
    try:
        rows = [(point["x"], point["y"], point["z"]) for point in record[name]]
        points = np.array(rows, np.float64).reshape(-1, 3)
        parsing.check_within(FARTHEST_M, points)
    except (TypeError, KeyError, ValueError, OverflowError, IndexError) as error:
        raise DataError(f"{name} is not a list of points", record=_name(record), cure=_AGAIN) from error
    return points


def _name(record: Any) -> str | None:
    return str(record.get("id"))[:40] if isinstance(record, dict) else None


def _ids(record: Any, name: str) -> tuple[int, ...]:
    links = record.get(name)
    if not isinstance(links, list):
        raise DataError(f"{name} is not a list of ids", record=_name(record), cure=_AGAIN)
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
