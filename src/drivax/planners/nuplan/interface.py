"""What planners with nuPlan's interface are given: states, boxes, tracked objects, history and lights.

Names and meanings are those of nuplan-devkit 1.2 (Apache-2.0); its enumerations compare equal to these. SI units;
positions in the source's frame.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from drivax.errors import missing_package
from drivax.geometry.boxes import corners
from drivax.scenario.schema import DT_S, AgentKind, LightState
from drivax.simulator.contact import REAR_AXLE
from drivax.simulator.controller import TrackingConfig

#: Centre of gravity ahead of the rear axle, as a share of the length (nuPlan's vehicle: 1.67 m of 5.176 m).
_GRAVITY = 1.67 / 5.176


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
class Point2D:
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

    def __iter__(self) -> Iterator[float]:
        return iter((self.x, self.y, self.heading))


@dataclass(frozen=True, order=True)
class TimePoint:
    """Time since the start of the scenario."""

    time_us: int

    @property
    def time_s(self) -> float:
        """Seconds."""
        return self.time_us * 1e-6

    @classmethod
    def of_step(cls, step: int) -> TimePoint:
        """Return the time of a step of the log."""
        return cls(round(step * DT_S * 1e6))

    def __add__(self, other: Any) -> TimePoint:
        return TimePoint(self.time_us + int(getattr(other, "time_us", other)))

    def __sub__(self, other: Any) -> TimePoint:
        return TimePoint(self.time_us - int(getattr(other, "time_us", other)))


@dataclass(frozen=True)
class OrientedBox:
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

    def all_corners(self) -> list[Point2D]:
        """Front left, rear left, rear right, front right."""
        cos, sin = math.cos(self.center.heading), math.sin(self.center.heading)
        box = np.array([self.center.x, self.center.y, cos, sin, self.length, self.width])
        points = corners(box)[[0, 3, 2, 1]].tolist()
        return [Point2D(*point) for point in points]

    @cached_property
    def geometry(self) -> Any:
        """The box as a polygon of shapely."""
        return shapely().Polygon([tuple(corner) for corner in self.all_corners()])


@dataclass(frozen=True)
class VehicleParameters:
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

    @property
    def rear_axle_to_center_dist(self) -> float:
        """Distance of the box centre from the rear axle."""
        return self.vehicle_parameters.rear_axle_to_center

    @property
    def rear_axle(self) -> StateSE2:
        """Pose of the rear axle."""
        return self.center.ahead(-self.rear_axle_to_center_dist)


@dataclass(frozen=True)
class DynamicCarState:
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
        """Acceleration of the box centre, a rigid body's."""
        away, acceleration = self.rear_axle_to_center_dist, self.rear_axle_acceleration_2d
        return StateVector2D(
            acceleration.x - away * self.angular_velocity**2,
            acceleration.y + away * self.angular_acceleration,
        )


@dataclass(frozen=True)
class EgoState:
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
        """Ego as a tracked object."""
        velocity, heading = self.dynamic_car_state.center_velocity_2d, self.center.heading
        cos, sin = math.cos(heading), math.sin(heading)
        turned = StateVector2D(velocity.x * cos - velocity.y * sin, velocity.x * sin + velocity.y * cos)
        return TrackedObject(TrackedObjectType.EGO, self.car_footprint, turned, "ego", -1, self.time_us)


@dataclass(frozen=True)
class TrackedObject:
    """Another road user or thing; its velocity is in the source's frame. Also stands for its own ``metadata``."""

    tracked_object_type: TrackedObjectType
    box: OrientedBox
    velocity: StateVector2D
    track_token: str
    track_id: int
    timestamp_us: int

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
class TrackedObjects:
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
class DetectionsTracks:
    """The observation."""

    tracked_objects: TrackedObjects


@dataclass(frozen=True)
class TrafficLightStatusData:
    """Observed state of the traffic light of a lane (connector)."""

    status: TrafficLightStatusType
    lane_connector_id: int
    timestamp: int


@dataclass(frozen=True)
class SimulationIteration:
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
class SimulationHistoryBuffer:
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
class PlannerInitialization:
    """What a planner knows of a scenario before it starts."""

    route_roadblock_ids: list[str]
    mission_goal: StateSE2
    map_api: Any


@dataclass(frozen=True)
class PlannerInput:
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
