"""A map with nuPlan's interface, from the lanes of a stored scenario: lanes, lane connectors and roadblocks.

Lanes are strips of their width around the centre line. The drivable area is the area of all lanes, an intersection
the area of a roadblock connector. There are no surveyed polygons, crosswalks, stop lines or rasters.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Sequence
from functools import cached_property, partialmethod
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.errors import did_you_mean, import_extra
from drivax.geometry.polylines import arc_lengths, headings, left_normals, project
from drivax.geometry.vectors import wrap
from drivax.planners.nuplan.poses import DevkitObject, StateSE2
from drivax.scenario.bank.scenario_bank import DEFAULT_LANE_WIDTH_M
from drivax.scenario.schema import Scenario

Points = Float[np.ndarray, "point 2"]


class SemanticMapLayer(enum.IntEnum):
    """Layers of the map; the layer of car parks is empty, since scenarios store none."""

    LANE = 0
    INTERSECTION = 1
    DRIVABLE_AREA = 5
    LANE_CONNECTOR = 11
    CARPARK_AREA = 15
    ROADBLOCK = 17
    ROADBLOCK_CONNECTOR = 18


_LAYERS = [layer.name for layer in SemanticMapLayer]


class Polyline(DevkitObject):
    """A line of the map."""

    def devkit_names(self) -> tuple[str, ...]:
        """Return the devkit's interface of lines."""
        return ("PolylineMapObject",)

    def __init__(self, name: str, points: Points) -> None:
        self.id, self.points = name, points
        self.arc, self.heading = arc_lengths(points), headings(points)

    @property
    def length(self) -> float:
        """Length, m."""
        return float(self.arc[-1])

    @cached_property
    def linestring(self) -> Any:
        """The line as a shapely geometry."""
        return import_extra("shapely").LineString(self.points)

    @cached_property
    def discrete_path(self) -> list[StateSE2]:
        """Poses at the points of the line, at most 4 m apart."""
        return [StateSE2(*row) for row in np.column_stack([self.points, self.heading]).tolist()]

    def get_nearest_arc_length_from_position(self, point: Any) -> float:
        """Return the arc length nearest to a point, m."""
        return float(project(self.points, _xy(point))[0][0])

    def get_nearest_pose_from_position(self, point: Any) -> StateSE2:
        """Return the pose nearest to a point, with the heading of its segment."""
        arc_m = self.get_nearest_arc_length_from_position(point)
        segment = min(int(np.searchsorted(self.arc, arc_m, side="right")) - 1, len(self.arc) - 2)
        direction = self.points[segment + 1] - self.points[segment]
        length = self.arc[segment + 1] - self.arc[segment]
        x, y = self.points[segment] + direction * (arc_m - self.arc[segment]) / max(length, 1e-9)
        return StateSE2(float(x), float(y), float(np.arctan2(direction[1], direction[0])))

    def get_curvature_at_arc_length(self, arc_length: float) -> float:
        """Return the curvature at an arc length, left positive, 1/m."""
        turn, length = wrap(np.diff(self.heading)), np.diff(self.arc)
        segment = np.clip(np.searchsorted(self.arc, arc_length, side="right") - 1, 0, len(length) - 1)
        return float(turn[segment] / max(length[segment], 1e-9))

    def get_nearest_curvature_from_position(self, point: Any) -> float:
        """Return the curvature nearest to a point, 1/m."""
        return self.get_curvature_at_arc_length(self.get_nearest_arc_length_from_position(point))


class _Edge(DevkitObject):
    """An edge of the devkit's lane graph: a lane, a connector or a roadblock."""

    _interface = ""

    def devkit_names(self) -> tuple[str, ...]:
        """Return the devkit's class, then its interface, in case only that is imported."""
        return type(self).__name__, self._interface

    def __init__(self, map_api: MapApi, name: str, connector: bool) -> None:
        self.id, self.is_connector, self._map = name, connector, map_api

    @property
    def stop_lines(self) -> list[Any]:
        """Empty list, since scenarios store no polygons of stop lines."""
        return []


class NuPlanLane(_Edge):
    """A lane."""

    _interface = "Lane"

    def __init__(self, map_api: MapApi, lane_index: int, points: Points) -> None:
        scenario = map_api.scenario
        self.lane_index, width = lane_index, float(scenario.lane_width[lane_index])
        self.half_width_m = (width if width > 0 else DEFAULT_LANE_WIDTH_M) / 2
        limit = float(scenario.lane_limit[lane_index])
        self.speed_limit_mps = limit if limit > 0 else None
        name = str(int(scenario.lane_id[lane_index]))
        super().__init__(map_api, name, bool(scenario.lane_interpolating[lane_index]))
        self.baseline_path = Polyline(name, points)

    def _boundary(self, side: int) -> Polyline:
        """Return the left (``side`` 1) or right (-1) border."""
        line, offset = self.baseline_path, side * self.half_width_m
        return Polyline(f"{self.id}:{side:+d}", line.points + offset * left_normals(line.heading))

    @cached_property
    def left_boundary(self) -> Polyline:
        """The left border, half the width from the centre line."""
        return self._boundary(1)

    @cached_property
    def right_boundary(self) -> Polyline:
        """The right border."""
        return self._boundary(-1)

    @property
    def incoming_edges(self) -> list[NuPlanLane]:
        """Lanes that lead into this lane."""
        return self._map.lanes_of(self._map.scenario.lane_predecessor[self.lane_index])

    @property
    def outgoing_edges(self) -> list[NuPlanLane]:
        """Lanes that this lane leads into."""
        return self._map.lanes_of(self._map.scenario.lane_successor[self.lane_index])

    @property
    def adjacent_edges(self) -> tuple[NuPlanLane | None, NuPlanLane | None]:
        """The neighbours of the same direction, on the left and on the right; None without one."""
        scenario = self._map.scenario
        left, right = scenario.lane_left[self.lane_index], scenario.lane_right[self.lane_index]
        return self._map.lanes.get(int(left)), self._map.lanes.get(int(right))

    @property
    def parallel_edges(self) -> list[NuPlanLane]:
        """All lanes of the roadblock."""
        return self.parent.interior_edges

    @property
    def parent(self) -> NuPlanRoadBlock:
        """The roadblock."""
        return self._map.blocks[self.get_roadblock_id()]

    @property
    def index(self) -> int:
        """Number of lanes to the left, from neighbour to neighbour."""
        visited, lane = {self.lane_index}, self
        while (lane := lane.adjacent_edges[0]) is not None and lane.lane_index not in visited:
            visited.add(lane.lane_index)
        return len(visited) - 1

    def is_left_of(self, other: NuPlanLane) -> bool:
        """Return whether the lane is to the left of another lane of its roadblock."""
        return self.is_same_roadblock(other) and self.index < other.index

    def is_right_of(self, other: NuPlanLane) -> bool:
        """Return whether the lane is to the right of another lane of its roadblock."""
        return other.is_left_of(self)

    def get_roadblock_id(self) -> str:
        """Return the id of the roadblock."""
        return self._map.block_of[self.lane_index]

    def is_same_roadblock(self, other: NuPlanLane) -> bool:
        """Return whether another lane is in the same roadblock."""
        return self.get_roadblock_id() == other.get_roadblock_id()

    def has_traffic_lights(self) -> bool:
        """Return whether a traffic light controls the lane."""
        return int(self._map.scenario.lane_light[self.lane_index]) >= 0

    @cached_property
    def polygon(self) -> Any:
        """The strip around the centre line as a shapely geometry."""
        return self.baseline_path.linestring.buffer(self.half_width_m, cap_style="flat")

    def contains_point(self, point: Any) -> bool:
        """Return whether a point is on the lane."""
        return self.distance_m(point) <= 0.0

    def distance_m(self, point: Any) -> float:
        """Return the distance of a point from the lane, m; 0 or less inside."""
        line, xy = self.baseline_path, _xy(point)
        arc_m, distance_m = (float(value[0]) for value in project(line.points, xy))
        if not 0.0 < arc_m < line.length:
            # Beyond an end of the centre line, the distance is that from the straight end of the strip.
            end, outward = (0, -1) if arc_m <= 0.0 else (-1, 1)
            (x, y), heading = xy[0] - line.points[end], line.heading[end]
            beyond_m = (x * np.cos(heading) + y * np.sin(heading)) * outward
            if beyond_m > 0.0:
                lateral_m = abs(y * np.cos(heading) - x * np.sin(heading)) - self.half_width_m
                return float(np.hypot(beyond_m, max(lateral_m, 0.0)))
        return distance_m - self.half_width_m


class NuPlanLaneConnector(NuPlanLane):
    """A lane through a junction."""

    _interface = "LaneConnector"


class Area:
    """The area of several lanes."""

    def __init__(self, name: str, lanes: Sequence[NuPlanLane]) -> None:
        self.id, self.interior_edges = name, list(lanes)

    @cached_property
    def polygon(self) -> Any:
        """The strips of all lanes as a shapely geometry."""
        return import_extra("shapely").unary_union([lane.polygon for lane in self.interior_edges])

    def contains_point(self, point: Any) -> bool:
        """Return whether a point is on any of the lanes."""
        return self.distance_m(point) <= 0.0

    def distance_m(self, point: Any) -> float:
        """Return the distance of a point from the nearest lane, m; 0 or less inside."""
        return min(lane.distance_m(point) for lane in self.interior_edges)


class NuPlanRoadBlock(Area, _Edge):
    """Lanes next to each other in one direction."""

    _interface = "RoadBlockGraphEdgeMapObject"

    def __init__(self, map_api: MapApi, name: str, lanes: Sequence[NuPlanLane]) -> None:
        _Edge.__init__(self, map_api, name, lanes[0].is_connector)
        Area.__init__(self, name, lanes)

    @property
    def incoming_edges(self) -> list[NuPlanRoadBlock]:
        """Roadblocks that lead into this roadblock."""
        return _unique(other.parent for lane in self.interior_edges for other in lane.incoming_edges)

    @property
    def outgoing_edges(self) -> list[NuPlanRoadBlock]:
        """Roadblocks that this roadblock leads into."""
        return _unique(other.parent for lane in self.interior_edges for other in lane.outgoing_edges)


class NuPlanRoadBlockConnector(NuPlanRoadBlock):
    """Connectors between the same two roadblocks."""


class MapApi(DevkitObject):
    """The lanes, lane connectors and roadblocks of a scenario, in the source's frame."""

    def devkit_names(self) -> tuple[str, ...]:
        """Return the devkit's interface of maps."""
        return ("AbstractMap",)

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        lines = lane_lines(scenario)
        origin = np.asarray(scenario.origin, np.float64)[:2]
        is_connector = scenario.lane_interpolating
        self.lanes = {
            index: (NuPlanLaneConnector if is_connector[index] else NuPlanLane)(self, index, points + origin)
            for index, points in enumerate(lines)
            if len(points)
        }
        first_lanes = roadblocks(scenario)
        self.block_of = {index: str(int(scenario.lane_id[first_lanes[index]])) for index in self.lanes}
        lanes_by_block: dict[str, list[NuPlanLane]] = {}
        for index, lane in self.lanes.items():
            lanes_by_block.setdefault(self.block_of[index], []).append(lane)
        self.blocks = {
            name: (NuPlanRoadBlockConnector if lanes[0].is_connector else NuPlanRoadBlock)(self, name, lanes)
            for name, lanes in lanes_by_block.items()
        }

    @property
    def map_name(self) -> str:
        """Name of the place, or of the data set."""
        return self.scenario.tags.get("location", self.scenario.text("dataset"))

    def lanes_of(self, indices: Iterable[Any]) -> list[NuPlanLane]:
        """Return the lanes at indices of the lane graph, without lanes that have no centre line."""
        return [self.lanes[int(index)] for index in indices if int(index) in self.lanes]

    def get_available_map_objects(self) -> list[SemanticMapLayer]:
        """Return the layers that are not empty."""
        return [layer for layer in SemanticMapLayer if self._objects(layer)]

    def get_all_map_objects(self, point: Any, layer: Any) -> list[Any]:
        """Return the objects of a layer that contain a point, those with the most distant border first."""
        distances = [(item.distance_m(point), item) for item in self._objects(layer)]
        inside = [pair for pair in distances if pair[0] <= 0.0]
        return [item for _, item in sorted(inside, key=lambda pair: pair[0])]

    def get_one_map_object(self, point: Any, layer: Any) -> Any:
        """Return the first of :meth:`get_all_map_objects`, or None without any."""
        return next(iter(self.get_all_map_objects(point, layer)), None)

    def is_in_layer(self, point: Any, layer: Any) -> bool:
        """Return whether some object of a layer contains a point."""
        return bool(self.get_all_map_objects(point, layer))

    def get_proximal_map_objects(
        self, point: Any, radius: float, layers: Iterable[Any]
    ) -> dict[Any, list[Any]]:
        """Return the objects within a radius of a point, by layer."""
        return {
            layer: [item for item in self._objects(layer) if item.distance_m(point) <= radius]
            for layer in layers
        }

    def get_map_object(self, object_id: Any, layer: Any) -> Any:
        """Return an object by its id, or None if the layer lacks it."""
        return next((item for item in self._objects(layer) if item.id == str(object_id)), None)

    _get_lane = partialmethod(get_map_object, layer=SemanticMapLayer.LANE)
    _get_lane_connector = partialmethod(get_map_object, layer=SemanticMapLayer.LANE_CONNECTOR)
    _get_roadblock = partialmethod(get_map_object, layer=SemanticMapLayer.ROADBLOCK)
    _get_roadblock_connector = partialmethod(get_map_object, layer=SemanticMapLayer.ROADBLOCK_CONNECTOR)

    def get_distance_to_nearest_map_object(self, point: Any, layer: Any) -> tuple[str | None, float | None]:
        """Return id and distance of the nearest object of a layer, or (None, None) if the layer is empty."""
        distances = [(max(item.distance_m(point), 0.0), item.id) for item in self._objects(layer)]
        if not distances:
            return None, None
        distance_m, object_id = min(distances)
        return object_id, distance_m

    def __getattr__(self, name: str) -> Any:
        """Raise NotImplementedError for a method that this map lacks, and suggest the most similar one that it has."""
        if name.startswith("_") or name in ("lanes", "blocks", "block_of", "scenario"):
            raise AttributeError(name)
        methods = [method for method in dir(MapApi) if method.startswith(("get_", "is_"))]
        raise NotImplementedError(f"the map has no {name}; {did_you_mean(name, methods)}")

    def _objects(self, layer: Any) -> list[Any]:
        """Return the objects of a layer, given as a member of our or the devkit's ``SemanticMapLayer``."""
        try:
            member = SemanticMapLayer(int(layer))
        except ValueError:
            name = getattr(layer, "name", layer)
            raise NotImplementedError(f"the map has no layer {name}; it has {', '.join(_LAYERS)}") from None
        return self._layers.get(member, [])

    @cached_property
    def _layers(self) -> dict[SemanticMapLayer, list[Any]]:
        lanes, blocks = list(self.lanes.values()), list(self.blocks.values())
        junctions = [block for block in blocks if block.is_connector]
        return {
            SemanticMapLayer.LANE: [lane for lane in lanes if not lane.is_connector],
            SemanticMapLayer.LANE_CONNECTOR: [lane for lane in lanes if lane.is_connector],
            SemanticMapLayer.ROADBLOCK: [block for block in blocks if not block.is_connector],
            SemanticMapLayer.ROADBLOCK_CONNECTOR: junctions,
            SemanticMapLayer.INTERSECTION: [Area(block.id, block.interior_edges) for block in junctions],
            SemanticMapLayer.DRIVABLE_AREA: [Area("drivable_area", lanes)] if lanes else [],
        }


def _unique(blocks: Iterable[NuPlanRoadBlock]) -> list[NuPlanRoadBlock]:
    """Return the roadblocks without duplicates, in order."""
    return list({block.id: block for block in blocks}.values())


def _xy(point: Any) -> Float[np.ndarray, "1 2"]:
    """Return any object with x and y as an array of one point."""
    return np.array([[point.x, point.y]], np.float64)


def lane_count(scenario: Scenario) -> int:
    """Return the number of lanes of the lane graph."""
    return int((scenario.lane_length > 0).sum())


def lane_lines(scenario: Scenario) -> list[Float[np.ndarray, "point 2"]]:
    """Return the centre line of every lane of the lane graph in the local frame, m.

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
    """Return the roadblock of every lane, given as the index of the roadblock's first lane.

    Neighbours share a roadblock; so do connectors whose first predecessors share one and whose first successors do.
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
