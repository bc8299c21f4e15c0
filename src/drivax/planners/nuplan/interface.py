"""Inputs of planners with nuPlan's interface: ego, tracked objects, history and lights.

Names and meanings are those of nuplan-devkit 1.2 (Apache-2.0). The devkit's enumerations compare equal to these, and
objects pass ``isinstance`` for the devkit's classes once it is imported. SI units; positions in the source's frame.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from drivax.planners.nuplan.poses import (
    DevkitObject,
    HalfExtents,
    OrientedBox,
    Point2D,
    StateSE2,
    StateVector2D,
    TimePoint,
)
from drivax.scenario.schema import DT_S, AgentKind, LightState
from drivax.simulator.contact import REAR_AXLE
from drivax.simulator.controller import TrackingConfig

#: Distance of the centre of gravity from the rear axle, as a share of the length (nuPlan's vehicle: 1.67 m of 5.176 m).
_COG_SHARE = 1.67 / 5.176


class TrackedObjectType(enum.Enum):
    """Class of a tracked object; compares equal to the devkit's member of the same name."""

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
#: Stored kinds do not distinguish cones, barriers and signs.
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
class VehicleParameters(HalfExtents):
    """Ego's dimensions, in nuPlan's proportions (5.176 m long, 1.461 m from rear axle to centre, wheelbase 3.089 m)."""

    length: float
    width: float
    height: float

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
        return _COG_SHARE * self.length


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
        """Magnitude of the acceleration of the rear axle."""
        return self.rear_axle_acceleration_2d.magnitude()

    @property
    def center_velocity_2d(self) -> StateVector2D:
        """Velocity of the box centre."""
        velocity = self.rear_axle_velocity_2d
        return StateVector2D(velocity.x, velocity.y + self.rear_axle_to_center_dist * self.angular_velocity)

    @property
    def center_acceleration_2d(self) -> StateVector2D:
        """Acceleration of the box centre."""
        # As in the devkit's get_acceleration_shifted; a rigid body's would be (x - d w^2, y + d alpha).
        shift = self.rear_axle_to_center_dist * (self.angular_velocity**2 + self.angular_acceleration)
        return StateVector2D(self.rear_axle_acceleration_2d.x + shift, self.rear_axle_acceleration_2d.y)


@dataclass(frozen=True)
class SplitState(DevkitObject):
    """Components of a state by kind of interpolation."""

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
        """Ego as a tracked object, with its velocity along and across its heading, as in the devkit."""
        velocity = self.dynamic_car_state.center_velocity_2d
        return TrackedObject(TrackedObjectType.EGO, self.car_footprint, velocity, "ego", -1, self.time_us)

    @property
    def waypoint(self) -> Waypoint:
        """Ego's box and velocity."""
        return Waypoint(self.time_point, self.car_footprint, self.dynamic_car_state.rear_axle_velocity_2d)

    def __iter__(self) -> Iterator[float]:
        """Iterate over time, pose, velocity and acceleration of the rear axle, and steering angle."""
        split = self.to_split_state()
        return iter([*split.linear_states[:3], *split.angular_states, *split.linear_states[3:]])

    def to_split_state(self) -> SplitState:
        """Return the components that the devkit interpolates."""
        axle, car = self.rear_axle, self.dynamic_car_state
        vectors = *car.rear_axle_velocity_2d, *car.rear_axle_acceleration_2d
        linear = [self.time_us, axle.x, axle.y, *vectors, self.tire_steering_angle]
        return SplitState(linear, [axle.heading], [self.car_footprint.vehicle_parameters])

    @staticmethod
    def from_split_state(split: Any) -> EgoState:
        """Return the state with these components and without a yaw rate, as in the devkit."""
        time_us, x, y, vx, vy, ax, ay, steering = split.linear_states
        vehicle = split.fixed_states[0]
        ahead = vehicle.rear_axle_to_center
        centre = StateSE2(x, y, split.angular_states[0]).ahead(ahead)
        box = CarFootprint(centre, vehicle.length, vehicle.width, vehicle.height, vehicle)
        car = DynamicCarState(StateVector2D(vx, vy), StateVector2D(ax, ay), 0.0, 0.0, 0.0, ahead)
        return EgoState(box, car, steering, TimePoint(int(time_us)))


@dataclass(frozen=True)
class TrackedObject(DevkitObject):
    """Another road user or object, with its velocity in the source's frame. ``metadata`` is the object itself."""

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
        """Return the objects of several types, grouped by type."""
        return [item for kind in tracked_object_types for item in self.get_tracked_objects_of_type(kind)]

    def get_agents(self) -> list[TrackedObject]:
        """Return vehicles, pedestrians and bicycles."""
        return self.get_tracked_objects_of_types(AGENT_TYPES)

    def get_static_objects(self) -> list[TrackedObject]:
        """Return all other objects."""
        return [item for item in self if item.tracked_object_type not in AGENT_TYPES]


@dataclass(frozen=True)
class DetectionsTracks(DevkitObject):
    """Observation of a planner: the tracked objects."""

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
    """Index of the simulated step, from 0, and its time."""

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
    """Recent states and observations, oldest first."""

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
    """Route, goal and map, which a planner gets before it starts."""

    route_roadblock_ids: list[str]
    mission_goal: StateSE2
    map_api: Any


@dataclass(frozen=True)
class PlannerInput(DevkitObject):
    """Input of a planner at a step."""

    iteration: SimulationIteration
    history: SimulationHistoryBuffer
    traffic_light_data: list[TrafficLightStatusData]
