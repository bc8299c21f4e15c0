"""Poses, vectors, times and boxes with nuPlan's interface, which pass ``isinstance`` for the devkit's classes.

SI units; positions in the source's frame.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, total_ordering
from typing import Any

import numpy as np

from drivax.errors import import_extra
from drivax.scenario.schema import DT_S

#: Steps of history for planners, as in nuPlan's simulation (2 s). Time 0 is this long before the log.
BUFFER = 20
_STATE, _PLANNING, _MAPS = "nuplan.common.actor_state", "nuplan.planning.simulation", "nuplan.common.maps"
#: Modules of the devkit by class.
_MODULES = {
    name: module
    for module, names in {
        f"{_STATE}.state_representation": "Point2D StateVector2D StateSE2 TimePoint TimeDuration",
        f"{_STATE}.oriented_box": "OrientedBox",
        f"{_STATE}.vehicle_parameters": "VehicleParameters",
        f"{_STATE}.car_footprint": "CarFootprint",
        f"{_STATE}.dynamic_car_state": "DynamicCarState",
        f"{_STATE}.ego_state": "EgoState",
        f"{_STATE}.waypoint": "Waypoint",
        f"{_STATE}.agent": "Agent",
        f"{_STATE}.static_object": "StaticObject",
        f"{_STATE}.tracked_objects": "TrackedObjects",
        "nuplan.common.utils.split_state": "SplitState",
        f"{_PLANNING}.observation.observation_type": "DetectionsTracks",
        f"{_PLANNING}.history.simulation_history_buffer": "SimulationHistoryBuffer",
        f"{_PLANNING}.planner.abstract_planner": "PlannerInitialization PlannerInput",
        f"{_PLANNING}.simulation_time_controller.simulation_iteration": "SimulationIteration",
        f"{_MAPS}.maps_datatypes": "TrafficLightStatusData",
        f"{_MAPS}.abstract_map": "AbstractMap",
        f"{_MAPS}.abstract_map_objects": "Lane LaneConnector RoadBlockGraphEdgeMapObject PolylineMapObject",
        f"{_MAPS}.nuplan_map.lane": "NuPlanLane",
        f"{_MAPS}.nuplan_map.lane_connector": "NuPlanLaneConnector",
        f"{_MAPS}.nuplan_map.roadblock": "NuPlanRoadBlock",
        f"{_MAPS}.nuplan_map.roadblock_connector": "NuPlanRoadBlockConnector",
    }.items()
    for name in names.split()
}


class DevkitObject:
    """Base of classes that pass ``isinstance`` for a class of the devkit: ``__class__`` is that class, if imported."""

    def devkit_names(self) -> tuple[str, ...]:
        """Return names of the devkit's classes, in order of preference."""
        return (type(self).__name__,)

    @property
    def __class__(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        names = self.devkit_names()
        classes = (getattr(sys.modules.get(_MODULES.get(name, "")), name, None) for name in names)
        return next(filter(None, classes), type(self))

    def __reduce__(self) -> Any:
        # The default refuses objects whose __class__ differs from their type.
        return object.__new__, (type(self),), self.__dict__


@dataclass(frozen=True)
class Point2D(DevkitObject):
    """A point, m."""

    x: float
    y: float

    @property
    def array(self) -> np.ndarray[Any, Any]:
        """Coordinates x and y as an array."""
        return np.array([self.x, self.y])

    def __iter__(self) -> Iterator[float]:
        return iter((self.x, self.y))


@dataclass(frozen=True)
class StateVector2D(Point2D):
    """A vector: of ego along and across its heading, of other objects in the source's frame."""

    def magnitude(self) -> float:
        """Length of the vector."""
        return math.hypot(self.x, self.y)


@dataclass(frozen=True)
class StateSE2(Point2D):
    """A pose."""

    heading: float

    @property
    def point(self) -> Point2D:
        """The position."""
        return Point2D(self.x, self.y)

    def ahead(self, distance_m: float, left_m: float = 0.0) -> StateSE2:
        """Return the pose shifted along its heading and to its left."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        x, y = self.x + distance_m * cos - left_m * sin, self.y + distance_m * sin + left_m * cos
        return StateSE2(x, y, self.heading)

    def distance_to(self, state: Any) -> float:
        """Return the distance to another pose or point, m."""
        return math.hypot(self.x - state.x, self.y - state.y)

    def as_matrix(self) -> np.ndarray[Any, Any]:
        """Return the 3 x 3 matrix that maps points of the pose's frame to the source's frame."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return np.array([[cos, -sin, self.x], [sin, cos, self.y], [0.0, 0.0, 1.0]])

    @staticmethod
    def from_matrix(matrix: Any) -> StateSE2:
        """Return the pose whose :meth:`as_matrix` is ``matrix``."""
        x, y = matrix[:2, 2].tolist()
        return StateSE2(x, y, math.atan2(matrix[1, 0], matrix[0, 0]))

    def serialize(self) -> list[float]:
        """Return x, y and heading."""
        return list(self)

    @staticmethod
    def deserialize(vector: Sequence[float]) -> StateSE2:
        """Return the pose of x, y and heading."""
        return StateSE2(*vector)

    def __iter__(self) -> Iterator[float]:
        return iter((self.x, self.y, self.heading))


@total_ordering
@dataclass(frozen=True, eq=False)
class TimePoint(DevkitObject):
    """Time since 2 s before the log; can be compared with, and added to, any object with ``time_us``."""

    time_us: int

    @property
    def time_s(self) -> float:
        """Seconds."""
        return self.time_us * 1e-6

    @classmethod
    def of_step(cls, step: int) -> TimePoint:
        """Return the time of a step of the log."""
        return cls(round((step + BUFFER) * DT_S * 1e6))

    def diff(self, other: Any) -> TimeDuration:
        """Return the time since another point."""
        return TimeDuration(self.time_us - _microseconds(other))

    def __add__(self, other: Any) -> TimePoint:
        return TimePoint(self.time_us + _microseconds(other))

    __radd__ = __add__

    def __sub__(self, other: Any) -> TimePoint:
        return TimePoint(self.time_us - _microseconds(other))

    def __rsub__(self, other: Any) -> TimePoint:
        return TimePoint(_microseconds(other) - self.time_us)

    def __eq__(self, other: object) -> bool:
        return self.time_us == getattr(other, "time_us", None)

    def __lt__(self, other: Any) -> bool:
        return self.time_us < other.time_us

    def __hash__(self) -> int:
        return hash(self.time_us)


class TimeDuration(TimePoint):
    """Time between two points."""


def _microseconds(time: Any) -> int:
    return int(getattr(time, "time_us", time))


#: Points of a box, in half lengths ahead and half widths to the left: front, rear, front left, front right, rear left,
#: rear right, centre, left, right.
_POINTS = dict(enumerate(((1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1), (0, 0), (0, 1), (0, -1)), 1))


class HalfExtents(DevkitObject):
    """Mixin with the half length and half width of an object."""

    length: float
    width: float

    @property
    def half_length(self) -> float:
        """Half the length."""
        return self.length / 2

    @property
    def half_width(self) -> float:
        """Half the width."""
        return self.width / 2


@dataclass(frozen=True)
class OrientedBox(HalfExtents):
    """A box around its centre."""

    center: StateSE2
    length: float
    width: float
    height: float

    @property
    def half_height(self) -> float:
        """Half the height."""
        return self.height / 2

    def corner(self, point: Any) -> Point2D:
        """Return a point of the box by the devkit's ``OrientedBoxPointType`` (1: front, ... 9: right)."""
        ahead, left = _POINTS[int(point)]
        return self.center.ahead(ahead * self.half_length, left * self.half_width).point

    def all_corners(self) -> list[Point2D]:
        """Return the corners: front left, rear left, rear right, front right."""
        return [self.corner(point) for point in (3, 5, 6, 4)]

    @cached_property
    def geometry(self) -> Any:
        """The box as a shapely polygon."""
        return import_extra("shapely").Polygon([tuple(corner) for corner in self.all_corners()])
