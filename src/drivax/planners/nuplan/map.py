"""A map with nuPlan's interface, from the lanes of a stored scenario: lanes, lane connectors and roadblocks.

Lanes are strips of their width around the centre line. The drivable area is that of all lanes, an intersection that
of a roadblock connector. There are no surveyed polygons, crosswalks, stop lines or rasters.
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
from drivax.scenario.roadblocks import lane_lines, roadblocks
from drivax.scenario.schema import Scenario

Points = Float[np.ndarray, "point 2"]


class SemanticMapLayer(enum.IntEnum):
    """Layers of the map; car parks are not known, so that layer is empty."""

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
        """The line as shapely has it."""
        return import_extra("shapely").LineString(self.points)

    @cached_property
    def discrete_path(self) -> list[StateSE2]:
        """Poses at the points of the line, at most 4 m apart."""
        return [StateSE2(*row) for row in np.column_stack([self.points, self.heading]).tolist()]

    def get_nearest_arc_length_from_position(self, point: Any) -> float:
        """Return the arc length nearest to a point, m."""
        return float(project(self.points, _xy(point))[0][0])

    def get_nearest_pose_from_position(self, point: Any) -> StateSE2:
        """Return the pose nearest to a point; its heading is that of the segment."""
        at = self.get_nearest_arc_length_from_position(point)
        segment = min(int(np.searchsorted(self.arc, at, side="right")) - 1, len(self.arc) - 2)
        along = self.points[segment + 1] - self.points[segment]
        span = self.arc[segment + 1] - self.arc[segment]
        x, y = self.points[segment] + along * (at - self.arc[segment]) / max(span, 1e-9)
        return StateSE2(float(x), float(y), float(np.arctan2(along[1], along[0])))

    def get_curvature_at_arc_length(self, arc_length: float) -> float:
        """Return the curvature at an arc length, left positive, 1/m."""
        turn, span = wrap(np.diff(self.heading)), np.diff(self.arc)
        segment = np.clip(np.searchsorted(self.arc, arc_length, side="right") - 1, 0, len(span) - 1)
        return float(turn[segment] / max(span[segment], 1e-9))

    def get_nearest_curvature_from_position(self, point: Any) -> float:
        """Return the curvature nearest to a point, 1/m."""
        return self.get_curvature_at_arc_length(self.get_nearest_arc_length_from_position(point))


class _Edge(DevkitObject):
    """A node of the graph with an area: a lane, a connector or a roadblock."""

    _interface = ""

    def devkit_names(self) -> tuple[str, ...]:
        """Return the devkit's class, or its interface where only that is imported."""
        return type(self).__name__, self._interface

    def __init__(self, map_api: MapApi, name: str, connector: bool) -> None:
        self.id, self.is_connector, self._map = name, connector, map_api

    @property
    def stop_lines(self) -> list[Any]:
        """Nothing: stop lines are not known."""
        return []


class NuPlanLane(_Edge):
    """A lane."""

    _interface = "Lane"

    def __init__(self, map_api: MapApi, row: int, points: Points) -> None:
        scenario = map_api.scenario
        self.row, width = row, float(scenario.lane_width[row])
        self.half_width_m = (width if width > 0 else DEFAULT_LANE_WIDTH_M) / 2
        limit = float(scenario.lane_limit[row])
        self.speed_limit_mps = limit if limit > 0 else None
        name = str(int(scenario.lane_id[row]))
        super().__init__(map_api, name, bool(scenario.lane_interpolating[row]))
        self.baseline_path = Polyline(name, points)

    def _boundary(self, side: int) -> Polyline:
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
        """Lanes that lead into this one."""
        return self._map.linked(self._map.scenario.lane_predecessor[self.row])

    @property
    def outgoing_edges(self) -> list[NuPlanLane]:
        """Lanes that this one leads into."""
        return self._map.linked(self._map.scenario.lane_successor[self.row])

    @property
    def adjacent_edges(self) -> tuple[NuPlanLane | None, NuPlanLane | None]:
        """The neighbours of the same direction, on the left and on the right."""
        left, right = self._map.scenario.lane_left[self.row], self._map.scenario.lane_right[self.row]
        return next(iter(self._map.linked([left])), None), next(iter(self._map.linked([right])), None)

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
        """Number of lanes of the roadblock to the left."""
        seen, lane = {self.row}, self
        while (lane := lane.adjacent_edges[0]) is not None and lane.row not in seen:
            seen.add(lane.row)
        return len(seen) - 1

    def is_left_of(self, other: NuPlanLane) -> bool:
        """Return whether the lane is to the left of another one of its roadblock."""
        return self.is_same_roadblock(other) and self.index < other.index

    def is_right_of(self, other: NuPlanLane) -> bool:
        """Return whether the lane is to the right of another one of its roadblock."""
        return other.is_left_of(self)

    def get_roadblock_id(self) -> str:
        """Return the id of the roadblock."""
        return self._map.block_of[self.row]

    def is_same_roadblock(self, other: NuPlanLane) -> bool:
        """Return whether another lane is in the same roadblock."""
        return self.get_roadblock_id() == other.get_roadblock_id()

    def has_traffic_lights(self) -> bool:
        """Return whether a traffic light controls the lane."""
        return int(self._map.scenario.lane_light[self.row]) >= 0

    @cached_property
    def polygon(self) -> Any:
        """The strip around the centre line as shapely has it."""
        return self.baseline_path.linestring.buffer(self.half_width_m, cap_style="flat")

    def contains_point(self, point: Any) -> bool:
        """Return whether a point is on the lane."""
        return self.distance_m(point) <= 0.0

    def distance_m(self, point: Any) -> float:
        """Return the distance of a point from the lane; 0 or less inside."""
        line = self.baseline_path
        at, apart = (float(value[0]) for value in project(line.points, _xy(point)))
        end = 0 if at <= 0.0 else -1 if at >= line.length else None
        if end is not None:
            away, heading = _xy(point)[0] - line.points[end], line.heading[end]
            beyond = (away[0] * np.cos(heading) + away[1] * np.sin(heading)) * (1 if end else -1)
            if beyond > 0.0:
                side = abs(away[1] * np.cos(heading) - away[0] * np.sin(heading)) - self.half_width_m
                return float(np.hypot(beyond, max(side, 0.0)))
        return apart - self.half_width_m


class NuPlanLaneConnector(NuPlanLane):
    """A lane through a junction."""

    _interface = "LaneConnector"


class Area:
    """Strips of some lanes."""

    def __init__(self, name: str, lanes: Sequence[NuPlanLane]) -> None:
        self.id, self.interior_edges = name, list(lanes)

    @cached_property
    def polygon(self) -> Any:
        """The strips of all lanes as shapely has them."""
        return import_extra("shapely").unary_union([lane.polygon for lane in self.interior_edges])

    def contains_point(self, point: Any) -> bool:
        """Return whether a point is on one of the lanes."""
        return self.distance_m(point) <= 0.0

    def distance_m(self, point: Any) -> float:
        """Return the distance of a point from the nearest lane."""
        return min(lane.distance_m(point) for lane in self.interior_edges)


class NuPlanRoadBlock(Area, _Edge):
    """Lanes next to each other in one direction."""

    _interface = "RoadBlockGraphEdgeMapObject"

    def __init__(self, map_api: MapApi, name: str, lanes: Sequence[NuPlanLane]) -> None:
        _Edge.__init__(self, map_api, name, lanes[0].is_connector)
        Area.__init__(self, name, lanes)

    @property
    def incoming_edges(self) -> list[NuPlanRoadBlock]:
        """Roadblocks that lead into this one."""
        return _unique(other.parent for lane in self.interior_edges for other in lane.incoming_edges)

    @property
    def outgoing_edges(self) -> list[NuPlanRoadBlock]:
        """Roadblocks that this one leads into."""
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
        inner = scenario.lane_interpolating
        self.lanes = {
            row: (NuPlanLaneConnector if inner[row] else NuPlanLane)(self, row, points + origin)
            for row, points in enumerate(lines)
            if len(points)
        }
        numbers = roadblocks(scenario)
        self.block_of = {row: str(int(scenario.lane_id[numbers[row]])) for row in self.lanes}
        names = dict.fromkeys(self.block_of.values())
        members = {
            name: [lane for row, lane in self.lanes.items() if self.block_of[row] == name] for name in names
        }
        self.blocks = {
            name: (NuPlanRoadBlockConnector if lanes[0].is_connector else NuPlanRoadBlock)(self, name, lanes)
            for name, lanes in members.items()
        }

    @property
    def map_name(self) -> str:
        """Name of the place, or of the data set."""
        return self.scenario.tags.get("location", self.scenario.text("dataset"))

    def linked(self, rows: Iterable[Any]) -> list[NuPlanLane]:
        """Return the lanes of some rows of the lane graph; those without a line are left out."""
        return [self.lanes[int(row)] for row in rows if int(row) in self.lanes]

    def get_available_map_objects(self) -> list[SemanticMapLayer]:
        """Return the layers that are not empty."""
        return [layer for layer in SemanticMapLayer if self._objects(layer)]

    def get_all_map_objects(self, point: Any, layer: Any) -> list[Any]:
        """Return the objects of a layer that contain a point, the nearest centre line first."""
        inside = [(item.distance_m(point), item) for item in self._objects(layer)]
        return [item for apart, item in sorted(inside, key=lambda pair: pair[0]) if apart <= 0.0]

    def get_one_map_object(self, point: Any, layer: Any) -> Any:
        """Return the object that contains a point, the nearest centre line of several; None without one."""
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
        """Return an object by its id; None if the layer has none."""
        return next((item for item in self._objects(layer) if item.id == str(object_id)), None)

    _get_lane = partialmethod(get_map_object, layer=SemanticMapLayer.LANE)
    _get_lane_connector = partialmethod(get_map_object, layer=SemanticMapLayer.LANE_CONNECTOR)
    _get_roadblock = partialmethod(get_map_object, layer=SemanticMapLayer.ROADBLOCK)
    _get_roadblock_connector = partialmethod(get_map_object, layer=SemanticMapLayer.ROADBLOCK_CONNECTOR)

    def get_distance_to_nearest_map_object(self, point: Any, layer: Any) -> tuple[str | None, float | None]:
        """Return id and distance of the nearest object of a layer; (None, None) without one."""
        apart = [(max(item.distance_m(point), 0.0), item.id) for item in self._objects(layer)]
        return min(apart)[::-1] if apart else (None, None)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name in ("lanes", "blocks", "block_of", "scenario"):
            raise AttributeError(name)
        known = [method for method in dir(MapApi) if method.startswith(("get_", "is_"))]
        raise NotImplementedError(f"the map has no {name}; {did_you_mean(name, known)}")

    def _objects(self, layer: Any) -> list[Any]:
        try:
            known = SemanticMapLayer(int(layer))
        except ValueError:
            name = getattr(layer, "name", layer)
            raise NotImplementedError(f"the map has no layer {name}; it has {', '.join(_LAYERS)}") from None
        return self._layers.get(known, [])

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
    """Roadblocks without repetitions, in order."""
    return list({block.id: block for block in blocks}.values())


def _xy(point: Any) -> Float[np.ndarray, "1 2"]:
    """A point as a row."""
    return np.array([[point.x, point.y]], np.float64)
