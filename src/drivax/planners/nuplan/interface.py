"""What planners with nuPlan's interface are given: states, boxes, tracked objects, history and lights.

Names and meanings are those of nuplan-devkit 1.2 (Apache-2.0). Its enumerations compare equal to these, and objects
pass ``isinstance`` for its classes once it is imported. SI units; positions in the source's frame.
"""

from __future__ import annotations

import enum
import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, total_ordering
from typing import Any

import numpy as np

from drivax.errors import missing_package
from drivax.scenario.schema import DT_S, AgentKind, LightState
from drivax.simulator.contact import REAR_AXLE
from drivax.simulator.controller import TrackingConfig

#: Centre of gravity ahead of the rear axle, as a share of the length (nuPlan's vehicle: 1.67 m of 5.176 m).
_GRAVITY = 1.67 / 5.176
#: Steps of history that planners get, as in nuPlan's simulation (2 s); time counts from so long before the log.
BUFFER = 20
_STATE, _PLANNING, _MAPS = "nuplan.common.actor_state", "nuplan.planning.simulation", "nuplan.common.maps"
#: Modules of the devkit by the classes that are looked for there.
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
    """Base of classes whose ``__class__`` is the devkit's where that is imported, which ``isinstance`` honours."""

    def devkit_names(self) -> tuple[str, ...]:
        """Return names of the devkit's classes, the first choice first."""
        return (type(self).__name__,)

    @property
    def __class__(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        modules = ((name, sys.modules.get(_MODULES.get(name, ""))) for name in self.devkit_names())
        return next((found for name, module in modules if (found := getattr(module, name, None))), type(self))

    def __reduce__(self) -> Any:
        # The default refuses an object whose __class__ is another than its type.
        return object.__new__, (type(self),), self.__dict__


class TrackedObjectType(enum.Enum):
    """Class of a tracked object; equal to the devkit's member of this name."""

    VEHICLE = 0
    PEDESTRIAN = 1
    BICYCLE = 2
    TRAFFIC_CONE = 3
    BARRIER = 4
    CZONE_SIGN = 5
    GENERIC_OBJECT = 6
    EGO = 7

    @property
    def fullname(self) -> str:
        """Name in lower case."""
        return self.name.lower()

    def __int__(self) -> int:
        return self.value

    def __eq__(self, other: object) -> bool:
        return (self.name, self.value) == (getattr(other, "name", None), getattr(other, "value", None))

    def __hash__(self) -> int:
        return hash((self.name, self.value))


AGENT_TYPES = (TrackedObjectType.VEHICLE, TrackedObjectType.PEDESTRIAN, TrackedObjectType.BICYCLE)
#: Sources do not tell cones, barriers and signs apart.
TYPE_OF_KIND = {
    AgentKind.VEHICLE: TrackedObjectType.VEHICLE,
    AgentKind.PEDESTRIAN: TrackedObjectType.PEDESTRIAN,
    AgentKind.CYCLIST: TrackedObjectType.BICYCLE,
    AgentKind.OTHER: TrackedObjectType.GENERIC_OBJECT,
    AgentKind.STATIC: TrackedObjectType.GENERIC_OBJECT,
}


class TrafficLightStatusType(enum.IntEnum):
    """State of a traffic light."""

    GREEN = 0
    YELLOW = 1
    RED = 2
    UNKNOWN = 3


STATUS_OF_LIGHT = {
    LightState.ARROW_STOP: TrafficLightStatusType.RED,
    LightState.STOP: TrafficLightStatusType.RED,
    LightState.ARROW_CAUTION: TrafficLightStatusType.YELLOW,
    LightState.CAUTION: TrafficLightStatusType.YELLOW,
    LightState.ARROW_GO: TrafficLightStatusType.GREEN,
    LightState.GO: TrafficLightStatusType.GREEN,
}


@dataclass(frozen=True)
class Point2D(DevkitObject):
    """A point, m."""

    x: float
    y: float

    @property
    def array(self) -> np.ndarray[Any, Any]:
        """Both numbers."""
        return np.array([self.x, self.y])

    def __iter__(self) -> Iterator[float]:
        return iter((self.x, self.y))


@dataclass(frozen=True)
class StateVector2D(Point2D):
    """A vector along and across the car's heading, or of an object in the source's frame."""

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

    def ahead(self, distance_m: float) -> StateSE2:
        """Return the pose moved along its heading."""
        dx, dy = distance_m * math.cos(self.heading), distance_m * math.sin(self.heading)
        return StateSE2(self.x + dx, self.y + dy, self.heading)

    def beside(self, distance_m: float) -> StateSE2:
        """Return the pose moved to its left."""
        dx, dy = -distance_m * math.sin(self.heading), distance_m * math.cos(self.heading)
        return StateSE2(self.x + dx, self.y + dy, self.heading)

    def distance_to(self, state: Any) -> float:
        """Return the distance to another pose or point, m."""
        return math.hypot(self.x - state.x, self.y - state.y)

    def as_matrix(self) -> np.ndarray[Any, Any]:
        """Return the 3 x 3 matrix that maps points of this frame to the source's."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return np.array([[cos, -sin, self.x], [sin, cos, self.y], [0.0, 0.0, 1.0]])

    @staticmethod
    def from_matrix(matrix: Any) -> StateSE2:
        """Return the pose of such a matrix."""
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
    """Time since 2 s before the log; compares and adds with whatever has ``time_us``."""

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
        """Return the time since another."""
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


#: Share of half the length ahead and of half the width to the left: front, rear, front left, front right, rear left,
#: rear right, centre, left, right.
_POINTS = dict(enumerate(((1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1), (0, 0), (0, 1), (0, -1)), 1))


@dataclass(frozen=True)
class OrientedBox(DevkitObject):
    """A box around its centre."""

    center: StateSE2
    length: float
    width: float
    height: float

    @property
    def half_length(self) -> float:
        """Half the length."""
        return self.length / 2

    @property
    def half_width(self) -> float:
        """Half the width."""
        return self.width / 2

    @property
    def half_height(self) -> float:
        """Half the height."""
        return self.height / 2

    def corner(self, point: Any) -> Point2D:
        """Return a point of the box by the devkit's ``OrientedBoxPointType`` (1: front, ... 9: right)."""
        ahead, left = _POINTS[int(point)]
        return self.center.ahead(ahead * self.half_length).beside(left * self.half_width).point

    def all_corners(self) -> list[Point2D]:
        """Front left, rear left, rear right, front right."""
        return [self.corner(point) for point in (3, 5, 6, 4)]

    @cached_property
    def geometry(self) -> Any:
        """The box as a polygon of shapely."""
        return shapely().Polygon([tuple(corner) for corner in self.all_corners()])


@dataclass(frozen=True)
class VehicleParameters(DevkitObject):
    """Ego's dimensions, in nuPlan's proportions (5.176 m long, 1.461 m from rear axle to centre, wheelbase 3.089 m)."""

    length: float
    width: float
    height: float

    @property
    def half_length(self) -> float:
        """Half the length."""
        return self.length / 2

    @property
    def half_width(self) -> float:
        """Half the width."""
        return self.width / 2

    @property
    def rear_axle_to_center(self) -> float:
        """Distance of the box centre from the rear axle."""
        return REAR_AXLE * self.length

    @property
    def front_length(self) -> float:
        """Distance of the front from the rear axle."""
        return self.half_length + self.rear_axle_to_center

    @property
    def rear_length(self) -> float:
        """Distance of the rear from the rear axle."""
        return self.half_length - self.rear_axle_to_center

    @property
    def wheel_base(self) -> float:
        """Distance between the axles."""
        return TrackingConfig.wheelbase * self.length

    @property
    def cog_position_from_rear_axle(self) -> float:
        """Distance of the centre of gravity from the rear axle."""
        return _GRAVITY * self.length


@dataclass(frozen=True)
class CarFootprint(OrientedBox):
    """Ego's box."""

    vehicle_parameters: VehicleParameters

    @property
    def oriented_box(self) -> OrientedBox:
        """The box itself."""
        return self

    def get_point_of_interest(self, point: Any) -> Point2D:
        """Return a point of the box."""
        return self.corner(point)

    @property
    def rear_axle_to_center_dist(self) -> float:
        """Distance of the box centre from the rear axle."""
        return self.vehicle_parameters.rear_axle_to_center

    @property
    def rear_axle(self) -> StateSE2:
        """Pose of the rear axle."""
        return self.center.ahead(-self.rear_axle_to_center_dist)


@dataclass(frozen=True)
class DynamicCarState(DevkitObject):
    """Ego's motion; vectors along and across its heading."""

    rear_axle_velocity_2d: StateVector2D
    rear_axle_acceleration_2d: StateVector2D
    angular_velocity: float
    angular_acceleration: float
    tire_steering_rate: float
    rear_axle_to_center_dist: float

    @property
    def speed(self) -> float:
        """Speed of the rear axle."""
        return self.rear_axle_velocity_2d.magnitude()

    @property
    def acceleration(self) -> float:
        """Size of the acceleration of the rear axle."""
        return self.rear_axle_acceleration_2d.magnitude()

    @property
    def center_velocity_2d(self) -> StateVector2D:
        """Velocity of the box centre."""
        velocity = self.rear_axle_velocity_2d
        return StateVector2D(velocity.x, velocity.y + self.rear_axle_to_center_dist * self.angular_velocity)

    @property
    def center_acceleration_2d(self) -> StateVector2D:
        """Acceleration of the box centre."""
        # As the devkit's get_acceleration_shifted, which is not a rigid body's (x - d w^2, y + d alpha).
        shift = self.rear_axle_to_center_dist * (self.angular_velocity**2 + self.angular_acceleration)
        return StateVector2D(self.rear_axle_acceleration_2d.x + shift, self.rear_axle_acceleration_2d.y)


@dataclass(frozen=True)
class SplitState(DevkitObject):
    """Numbers of a state by the way they are interpolated."""

    linear_states: list[float]
    angular_states: list[float]
    fixed_states: list[Any]

    def __len__(self) -> int:
        return len(self.linear_states) + len(self.angular_states) + len(self.fixed_states)


@dataclass(frozen=True)
class Waypoint(DevkitObject):
    """A box and its velocity at a time."""

    time_point: TimePoint
    oriented_box: OrientedBox
    velocity: StateVector2D | None = None

    @property
    def center(self) -> StateSE2:
        """Pose of the box centre."""
        return self.oriented_box.center

    @property
    def time_us(self) -> int:
        """Time, microseconds."""
        return self.time_point.time_us


@dataclass(frozen=True)
class EgoState(DevkitObject):
    """Ego at a time."""

    car_footprint: CarFootprint
    dynamic_car_state: DynamicCarState
    tire_steering_angle: float
    time_point: TimePoint
    is_in_auto_mode: bool = True

    @property
    def center(self) -> StateSE2:
        """Pose of the box centre."""
        return self.car_footprint.center

    @property
    def rear_axle(self) -> StateSE2:
        """Pose of the rear axle."""
        return self.car_footprint.rear_axle

    @property
    def time_us(self) -> int:
        """Time, microseconds."""
        return self.time_point.time_us

    @property
    def time_seconds(self) -> float:
        """Time, seconds."""
        return self.time_point.time_s

    @property
    def agent(self) -> TrackedObject:
        """Ego as a tracked object; its velocity is along and across its heading, as the devkit's."""
        velocity = self.dynamic_car_state.center_velocity_2d
        return TrackedObject(TrackedObjectType.EGO, self.car_footprint, velocity, "ego", -1, self.time_us)

    @property
    def waypoint(self) -> Waypoint:
        """Ego's box and velocity."""
        return Waypoint(self.time_point, self.car_footprint, self.dynamic_car_state.rear_axle_velocity_2d)

    def __iter__(self) -> Iterator[float]:
        """Time, pose, velocity and acceleration of the rear axle, and steering angle."""
        split = self.to_split_state()
        return iter([*split.linear_states[:3], *split.angular_states, *split.linear_states[3:]])

    def to_split_state(self) -> SplitState:
        """Return the state as the devkit interpolates it."""
        axle, car = self.rear_axle, self.dynamic_car_state
        vectors = *car.rear_axle_velocity_2d, *car.rear_axle_acceleration_2d
        linear = [self.time_us, axle.x, axle.y, *vectors, self.tire_steering_angle]
        return SplitState(linear, [axle.heading], [self.car_footprint.vehicle_parameters])

    @staticmethod
    def from_split_state(split: Any) -> EgoState:
        """Return the state of interpolated numbers; it does not turn, as in the devkit."""
        time_us, x, y, vx, vy, ax, ay, steering = split.linear_states
        vehicle = split.fixed_states[0]
        ahead = vehicle.rear_axle_to_center
        centre = StateSE2(x, y, split.angular_states[0]).ahead(ahead)
        box = CarFootprint(centre, vehicle.length, vehicle.width, vehicle.height, vehicle)
        car = DynamicCarState(StateVector2D(vx, vy), StateVector2D(ax, ay), 0.0, 0.0, 0.0, ahead)
        return EgoState(box, car, steering, TimePoint(int(time_us)))


@dataclass(frozen=True)
class TrackedObject(DevkitObject):
    """Another road user or thing; its velocity is in the source's frame. Also stands for its own ``metadata``."""

    tracked_object_type: TrackedObjectType
    box: OrientedBox
    velocity: StateVector2D
    track_token: str
    track_id: int
    timestamp_us: int
    angular_velocity: float | None = None
    predictions: None = None
    past_trajectory: None = None
    category_name: None = None

    def devkit_names(self) -> tuple[str, ...]:
        """Return the devkit's class for the type."""
        moves = self.tracked_object_type in (*AGENT_TYPES, TrackedObjectType.EGO)
        return ("Agent",) if moves else ("StaticObject",)

    @property
    def center(self) -> StateSE2:
        """Pose of the box centre."""
        return self.box.center

    @property
    def token(self) -> str:
        """Name of the track at this time."""
        return f"{self.track_token}@{self.timestamp_us}"

    @property
    def metadata(self) -> TrackedObject:
        """Names and time."""
        return self


@dataclass(frozen=True)
class TrackedObjects(DevkitObject):
    """Tracked objects, ordered by type."""

    tracked_objects: list[TrackedObject]

    def __iter__(self) -> Iterator[TrackedObject]:
        return iter(self.tracked_objects)

    def __len__(self) -> int:
        return len(self.tracked_objects)

    def get_tracked_objects_of_type(self, tracked_object_type: Any) -> list[TrackedObject]:
        """Return the objects of a type."""
        return [item for item in self if item.tracked_object_type == tracked_object_type]

    def get_tracked_objects_of_types(self, tracked_object_types: Iterable[Any]) -> list[TrackedObject]:
        """Return the objects of some types, type after type."""
        return [item for kind in tracked_object_types for item in self.get_tracked_objects_of_type(kind)]

    def get_agents(self) -> list[TrackedObject]:
        """Return vehicles, pedestrians and bicycles."""
        return self.get_tracked_objects_of_types(AGENT_TYPES)

    def get_static_objects(self) -> list[TrackedObject]:
        """Return everything else."""
        return [item for item in self if item.tracked_object_type not in AGENT_TYPES]


@dataclass(frozen=True)
class DetectionsTracks(DevkitObject):
    """The observation."""

    tracked_objects: TrackedObjects

    def detection_type(self) -> str:
        """Return the name of the observation."""
        return "DetectionsTracks"


@dataclass(frozen=True)
class TrafficLightStatusData(DevkitObject):
    """Observed state of the traffic light of a lane (connector)."""

    status: TrafficLightStatusType
    lane_connector_id: int
    timestamp: int


@dataclass(frozen=True)
class SimulationIteration(DevkitObject):
    """Number of the simulated step, from 0, and its time."""

    time_point: TimePoint
    index: int

    @property
    def time_us(self) -> int:
        """Time, microseconds."""
        return self.time_point.time_us

    @property
    def time_s(self) -> float:
        """Time, seconds."""
        return self.time_point.time_s


@dataclass(frozen=True)
class SimulationHistoryBuffer(DevkitObject):
    """States and observations of the last seconds, the present ones last."""

    ego_states: Sequence[EgoState]
    observations: Sequence[DetectionsTracks]
    sample_interval: float = DT_S

    @property
    def current_state(self) -> tuple[EgoState, DetectionsTracks]:
        """The present state and observation."""
        return self.ego_states[-1], self.observations[-1]

    @property
    def ego_state_buffer(self) -> Sequence[EgoState]:
        """The states."""
        return self.ego_states

    @property
    def observation_buffer(self) -> Sequence[DetectionsTracks]:
        """The observations."""
        return self.observations

    @property
    def size(self) -> int:
        """Number of samples."""
        return len(self.ego_states)

    @property
    def duration(self) -> float:
        """Time from the first sample to the present, s."""
        return (self.size - 1) * self.sample_interval

    def __len__(self) -> int:
        return self.size


@dataclass(frozen=True)
class PlannerInitialization(DevkitObject):
    """What a planner knows of a scenario before it starts."""

    route_roadblock_ids: list[str]
    mission_goal: StateSE2
    map_api: Any


@dataclass(frozen=True)
class PlannerInput(DevkitObject):
    """What a planner knows at a step."""

    iteration: SimulationIteration
    history: SimulationHistoryBuffer
    traffic_light_data: list[TrafficLightStatusData]


def shapely() -> Any:
    """Return the package shapely.

    Raises:
        UsageError: It is not installed.
    """
    try:
        import shapely as package
    except ModuleNotFoundError as error:
        raise missing_package(error) or error from error
    return package
