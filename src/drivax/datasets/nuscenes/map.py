"""The nuScenes map expansion (one JSON file per city) as map features."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.datasets.parsing import load_json
from drivax.datasets.road_edges import Area, road_edges
from drivax.errors import DataError, import_extra
from drivax.geometry.polylines import headings
from drivax.geometry.vectors import wrap
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import EDGE_KINDS, LINE_KINDS, RoadKind

Array = np.ndarray[Any, Any]

_AGAIN = "unpack the map expansion again"
#: Layers that are read row by row, and other keys of the map expansion.
_LAYERS = (
    "line", "polygon", "drivable_area", "lane", "lane_connector", "lane_divider", "road_divider", "ped_crossing",
    "stop_line",
)  # fmt: skip
_OTHER_KEYS = (
    "version", "node", "arcline_path_3", "connectivity", "road_segment", "road_block", "walkway", "carpark_area",
    "traffic_light", "canvas_edge",
)  # fmt: skip
#: Known fields of the rows of these layers; some are not read.
_FIELDS = (
    "token", "node_tokens", "exterior_node_tokens", "holes", "polygon_token", "polygon_tokens", "line_token",
    "lane_divider_segments", "stop_line_type", "lane_type", "from_edge_line_token", "to_edge_line_token",
    "left_lane_divider_segments", "right_lane_divider_segments", "road_segment_token", "ped_crossing_tokens",
    "traffic_light_tokens", "road_block_token",
)  # fmt: skip
#: Largest spacing of points of centre lines, metres.
SPACING_M = 0.5
#: Longest plausible arc line, metres.
_LONGEST_M = 5_000.0
_TURNS = {"L": 1.0, "S": 0.0, "R": -1.0}
#: Adjacent lanes: spacing of their centres, angle between them, largest offset along them between compared points.
_NEIGHBOUR_M, _PARALLEL_RAD, _ABREAST_M = (2.2, 5.5), np.deg2rad(20.0), 1.0
#: Plausible widths of lanes, and largest distance from the end of a lane to its stop line.
_WIDTHS_M, _STOP_M = (2.0, 6.0), 1.0


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the plane, metres."""

    low: Float[Array, "2"]
    high: Float[Array, "2"]

    @classmethod
    def around(cls, xy: Float[Array, "point 2"], margin_m: float) -> Box:
        """Return the bounding box of some points, widened by ``margin_m`` on all sides."""
        return cls(xy.min(axis=0) - margin_m, xy.max(axis=0) + margin_m)

    def pieces(self, points: Float[Array, "point dim"]) -> Iterator[Float[Array, "part dim"]]:
        """Yield the runs of segments of a polyline whose bounds touch the box; a polyline inside stays whole."""
        a, b = points[:-1, :2], points[1:, :2]
        touches = np.all((np.maximum(a, b) >= self.low) & (np.minimum(a, b) <= self.high), axis=-1)
        change = np.flatnonzero(np.diff(np.concatenate(([False], touches, [False]))))
        for start, end in zip(change[::2], change[1::2], strict=True):
            yield points[start : end + 1]


@dataclass(frozen=True)
class City:
    """The map of one city in metres from its south-west corner, z = 0.

    ``lost`` counts by name, for the whole city, unusable elements and references to missing ones.
    """

    features: tuple[MapFeature, ...]
    lost: Mapping[str, int]

    def around(self, xy: Float[Array, "point 2"], margin_m: float) -> tuple[MapFeature, ...]:
        """Return the features in the box around some points; edges and lines are cut, lanes and polygons stay whole."""
        box = Box.around(xy, margin_m)
        number = len(self.features)
        result: list[MapFeature] = []
        for feature in self.features:
            # A stop sign is one point: make it a segment, which the box can cut.
            points = np.repeat(feature.points, 2, axis=0) if len(feature.points) == 1 else feature.points
            pieces = list(box.pieces(points))
            if feature.kind not in (*EDGE_KINDS, *LINE_KINDS):
                result += [feature] if pieces else []
                continue
            # The first piece keeps the id; others get ids above those of the city.
            for i, piece in enumerate(pieces):
                number += i > 0
                result.append(replace(feature, feature_id=number if i else feature.feature_id, points=piece))
        return tuple(result)


@lru_cache(maxsize=4)
def city(path: Path) -> City:
    """Read the map in a file of the map expansion (v1.2 or later); the last four files are cached, not read again."""
    content = load_json(path)
    try:
        return _Layers(content).city()
    except DataError as error:
        raise DataError(error.problem, file=path, cure=error.cure) from error
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
        raise DataError(f"the map is damaged ({error!r})", file=path, cure=_AGAIN) from error


class _Layers:
    """The layers of one file, looked up by token."""

    def __init__(self, content: Mapping[str, Any]) -> None:
        self._content = content
        self._nodes = {node["token"]: (float(node["x"]), float(node["y"])) for node in content["node"]}
        if not np.isfinite(np.array(list(self._nodes.values()))).all():
            raise ValueError("a node is not finite")
        self._lines = {line["token"]: line["node_tokens"] for line in content["line"]}
        self._polygons = {polygon["token"]: polygon for polygon in content["polygon"]}
        self._lost: dict[str, int] = {}
        fields = {name for layer in _LAYERS for row in self._layer(layer) for name in row}
        unknown = content.keys() - {*_LAYERS, *_OTHER_KEYS} | fields.difference(_FIELDS)
        self._count("unknown_fields", len(unknown))

    def city(self) -> City:
        """Return all features, lanes first, numbered in this order."""
        lanes = self._lanes()
        lines = [*self._dividers(), *self._crossings()]
        features = [replace(line, feature_id=len(lanes) + i) for i, line in enumerate(lines)]
        stops = self._stops(lanes, len(lanes) + len(features))
        areas = [area for row in self._layer("drivable_area") for area in self._areas(row["polygon_tokens"])]
        edges = road_edges(areas, len(lanes) + len(features) + len(stops))
        return City((*lanes, *features, *stops, *edges), self._lost)

    def _layer(self, name: str) -> Sequence[Mapping[str, Any]]:
        """Return the rows of a layer, none if it is missing."""
        return self._content.get(name, ())

    def _points(self, tokens: Sequence[str]) -> Float[Array, "point 3"]:
        """Return nodes by token; count missing ones."""
        nodes = [self._nodes[token] for token in tokens if token in self._nodes]
        self._count("nodes", len(tokens) - len(nodes))
        return np.column_stack((np.array(nodes, np.float64).reshape(-1, 2), np.zeros(len(nodes))))

    def _count(self, name: str, number: int) -> None:
        if number:
            self._lost[name] = self._lost.get(name, 0) + number

    def _areas(self, tokens: Sequence[str]) -> Iterator[Area]:
        """Yield polygons by token; count missing ones."""
        for token in tokens:
            polygon = self._polygons.get(token)
            if polygon is None:
                self._count("polygons", 1)
                continue
            holes = [self._points(hole["node_tokens"]) for hole in polygon.get("holes", ())]
            yield self._points(polygon["exterior_node_tokens"]), holes

    def _lanes(self) -> list[MapFeature]:
        """Return lanes and lane connectors along their arc lines, with links and neighbours."""
        if not {"arcline_path_3", "connectivity"} <= self._content.keys():
            raise DataError("contains no centre lines of lanes", cure="download the map expansion v1.3")
        paths, links = self._content["arcline_path_3"], self._content["connectivity"]
        rows = [(row, name) for name in ("lane", "lane_connector") for row in self._layer(name)]
        lines = {row["token"]: arc_line(paths[row["token"]]) for row, _ in rows if row["token"] in paths}
        with_path = [(row, name) for row, name in rows if len(lines.get(row["token"], ())) > 1]
        self._count("lanes_without_path", len(rows) - len(with_path))
        index = {row["token"]: i for i, (row, _) in enumerate(with_path)}
        lanes: list[MapFeature] = []
        for i, (row, name) in enumerate(with_path):
            is_connector, line = name == "lane_connector", lines[row["token"]]
            link = links.get(row["token"], {})
            successors, predecessors = (
                [index.get(token) for token in link.get(direction, ())]
                for direction in ("outgoing", "incoming")
            )
            self._count("dangling_links", [*successors, *predecessors].count(None))
            lanes.append(
                MapFeature(
                    i,
                    RoadKind.LANE_SURFACE,
                    np.column_stack((line, np.zeros(len(line)))),
                    width_m=None if is_connector else self._width(row, line),
                    successors=tuple(lane for lane in successors if lane is not None),
                    predecessors=tuple(lane for lane in predecessors if lane is not None),
                    interpolating=is_connector,
                )
            )
        return with_neighbours(lanes)

    def _width(self, row: Mapping[str, Any], line: Float[Array, "point 2"]) -> float | None:
        """Return the area of a lane's polygon over the length of its centre line; None for an implausible width."""
        length = float(np.hypot(*np.diff(line, axis=0).T).sum())
        for exterior, _ in self._areas([row["polygon_token"]]):
            x, y = exterior[:, 0], exterior[:, 1]
            area = abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2
            if length > 0.0 and _WIDTHS_M[0] <= area / length <= _WIDTHS_M[1]:
                return area / length
        return None

    def _dividers(self) -> Iterator[MapFeature]:
        """Yield painted lane dividers in runs of one kind, and road dividers, whose paint is not in the map."""
        for row in self._layer("lane_divider"):
            segments = row["lane_divider_segments"]
            for name, run in groupby(enumerate(segments), key=lambda item: str(item[1]["segment_type"])):
                numbers = [number for number, _ in run]
                # A segment's type holds up to the node of the next one.
                nodes = [segment["node_token"] for segment in segments[numbers[0] : numbers[-1] + 2]]
                kind, points = marking(name), self._points(nodes)
                if kind is not None and len(points) > 1:
                    yield MapFeature(0, kind, points)
        for row in self._layer("road_divider"):
            points = self._points(self._lines.get(row["line_token"], ()))
            if len(points) > 1:
                yield MapFeature(0, RoadKind.LINE_UNKNOWN, points)

    def _crossings(self) -> Iterator[MapFeature]:
        for row in self._layer("ped_crossing"):
            for exterior, _ in self._areas([row["polygon_token"]]):
                if len(exterior) > 2:
                    yield MapFeature(0, RoadKind.CROSSWALK, exterior)

    def _stops(self, lanes: Sequence[MapFeature], first_id: int) -> list[MapFeature]:
        """Return stop lines of stop signs: one point each, with the lanes that end in them."""
        shapely = import_extra("shapely")
        stops: list[MapFeature] = []
        signs = [row for row in self._layer("stop_line") if row.get("stop_line_type") == "STOP_SIGN"]
        areas = [exterior for row in signs for exterior, _ in self._areas([row["polygon_token"]])]
        ends = shapely.points(np.array([lane.points[-1, :2] for lane in lanes]).reshape(-1, 2))
        for exterior in (exterior for exterior in areas if len(exterior) > 2):
            polygon = shapely.make_valid(shapely.Polygon(exterior[:, :2]))
            rows = np.flatnonzero(shapely.dwithin(ends, polygon, _STOP_M)).tolist()
            stop_lanes = tuple(i for i in rows if not lanes[i].interpolating)
            centre = np.array([[polygon.centroid.x, polygon.centroid.y, 0.0]])
            stops.append(MapFeature(first_id + len(stops), RoadKind.STOP_SIGN, centre, lanes=stop_lanes))
        return stops


def arc_line(path: Sequence[Mapping[str, Any]]) -> Float[Array, "point 2"]:
    """Sample a lane's arc lines (Dubins curves in the nuScenes map expansion) every 0.5 m or less.

    Each starts at ``start_pose`` (x, y, heading) and has three segments with lengths ``segment_length``. ``shape`` says
    whether each turns left (L), goes straight (S) or turns right (R); curves have the radius ``radius``.
    """
    parts = [np.zeros((0, 2))]
    for arc in path:
        x, y, heading = (float(value) for value in arc["start_pose"])
        lengths = [float(value) for value in arc["segment_length"]]
        radius = float(arc["radius"])
        if not np.isfinite([x, y, heading, *lengths]).all() or not radius > 0.0 or min(lengths) < 0.0:
            raise ValueError(f"an arc line of radius {radius} and lengths {lengths}")
        if sum(lengths) > _LONGEST_M:
            raise ValueError(f"an arc line of {sum(lengths):.0f} m")
        for turn, length in zip(arc["shape"], lengths, strict=True):
            curvature = _TURNS[turn] / radius
            s = np.linspace(0.0, length, int(np.ceil(length / SPACING_M)) + 1)
            yaw = heading + curvature * s
            if curvature == 0.0:
                xs, ys = x + s * np.cos(heading), y + s * np.sin(heading)
            else:
                xs = x + (np.sin(yaw) - np.sin(heading)) / curvature
                ys = y - (np.cos(yaw) - np.cos(heading)) / curvature
            parts.append(np.stack((xs, ys), axis=-1))
            x, y, heading = xs[-1], ys[-1], float(yaw[-1])
    line = np.concatenate(parts)
    return line[np.append(True, np.hypot(*np.diff(line, axis=0).T) > 1e-6)] if len(line) else line


def marking(name: str) -> RoadKind | None:
    """Return the kind of a painted divider by its nuScenes name; None for no paint (NIL)."""
    if name == "NIL":
        return None
    style = "BROKEN" if "DASHED" in name else "SOLID"
    colour = "YELLOW" if "YELLOW" in name else "WHITE"
    double = "DOUBLE" in name and (style, colour) != ("BROKEN", "WHITE")  # WOMD has no such kind
    return RoadKind[f"LINE_{style}_{'DOUBLE' if double else 'SINGLE'}_{colour}"]


def with_neighbours(lanes: Sequence[MapFeature]) -> list[MapFeature]:
    """Add neighbours to lanes: up to one parallel lane on each side, 2.2 to 5.5 m from the middle of the lane.

    A neighbour need not be the nearest such lane. Lane connectors, and lanes of two points, have none.
    """
    from scipy.spatial import KDTree

    rows = [i for i, lane in enumerate(lanes) if not lane.interpolating and len(lane.points) > 2]
    if not rows:
        return list(lanes)
    lane_of = np.concatenate([np.full(len(lanes[i].points), i) for i in rows])
    points = np.concatenate([lanes[i].points[:, :2] for i in rows])
    heading = np.concatenate([headings(lanes[i].points) for i in rows])
    tree = KDTree(points)
    result = list(lanes)
    for i in rows:
        middle = len(lanes[i].points) // 2
        xy, yaw = lanes[i].points[middle, :2], headings(lanes[i].points)[middle]
        # Half a metre more than the distance sideways covers the offset along the lane.
        nearby = np.array(tree.query_ball_point(xy, _NEIGHBOUR_M[1] + 0.5), dtype=np.int64)
        nearby = nearby[(lane_of[nearby] != i) & (np.abs(wrap(heading[nearby] - yaw)) < _PARALLEL_RAD)]
        offset = points[nearby] - xy
        ahead_m = offset @ np.array([np.cos(yaw), np.sin(yaw)])
        left_m = offset @ np.array([-np.sin(yaw), np.cos(yaw)])
        is_adjacent = (np.abs(left_m) >= _NEIGHBOUR_M[0]) & (np.abs(left_m) <= _NEIGHBOUR_M[1])
        is_adjacent &= np.abs(ahead_m) < _ABREAST_M
        sides = {
            side: tuple(int(lane) for lane in lane_of[nearby[is_adjacent & (sign * left_m > 0)]][:1])
            for side, sign in (("left_neighbours", 1), ("right_neighbours", -1))
        }
        result[i] = replace(result[i], **sides)
    return result
