"""Stand-ins for classes of nuPlan's devkit, as strict about types; states are split and interpolated."""

from __future__ import annotations

import types
from abc import ABC, abstractmethod

import numpy as np

STATE, PLANNING, MAPS = "nuplan.common.actor_state", "nuplan.planning.simulation", "nuplan.common.maps"


class TimePoint:
    def __init__(self, time_us):
        assert time_us >= 0
        self.time_us = time_us

    def __add__(self, other):
        return TimePoint(self.time_us + other.time_us) if isinstance(other, TimePoint) else NotImplemented

    def __le__(self, other):
        return self.time_us <= other.time_us if isinstance(other, TimePoint) else NotImplemented

    def __eq__(self, other):
        return self.time_us == other.time_us if isinstance(other, TimePoint) else NotImplemented


class Point2D:
    def __init__(self, x, y):
        self.x, self.y = x, y


class StateSE2(Point2D):
    def __init__(self, x, y, heading):
        super().__init__(x, y)
        self.heading = heading


class StateVector2D:
    def __init__(self, x, y):
        self.x, self.y = x, y


class Agent:
    pass


class StaticObject:
    pass


class DetectionsTracks:
    pass


class NuPlanLane:
    pass


class Lane:
    pass


class RoadBlockGraphEdgeMapObject:
    pass


class AbstractMap:
    pass


class SplitState:
    def __init__(self, linear_states, angular_states, fixed_states):
        self.linear_states, self.angular_states, self.fixed_states = (
            linear_states,
            angular_states,
            fixed_states,
        )

    def __len__(self):
        return len(self.linear_states) + len(self.angular_states) + len(self.fixed_states)


class Interpolatable(ABC):
    @abstractmethod
    def to_split_state(self):
        """Return the numbers."""


class EgoState(Interpolatable):
    def __init__(self, pose, speed, time_point, vehicle):
        self.rear_axle, self.speed, self.time_point, self.vehicle = pose, speed, time_point, vehicle

    @classmethod
    def build_from_center(cls, centre, speed, time_point, vehicle):
        assert isinstance(time_point, TimePoint)
        behind = vehicle.rear_axle_to_center
        x, y = centre.x - behind * np.cos(centre.heading), centre.y - behind * np.sin(centre.heading)
        return cls(StateSE2(x, y, centre.heading), speed, time_point, vehicle)

    @property
    def time_us(self):
        return self.time_point.time_us

    def to_split_state(self):
        linear = [self.time_us, self.rear_axle.x, self.rear_axle.y, self.speed, 0.0, 0.0, 0.0, 0.0]
        return SplitState(linear, [self.rear_axle.heading], [self.vehicle])

    @staticmethod
    def from_split_state(split):
        assert len(split) == 10
        time_us, x, y, speed = split.linear_states[:4]
        pose = StateSE2(x, y, split.angular_states[0])
        return EgoState(pose, speed, TimePoint(int(time_us)), split.fixed_states[0])


class InterpolatedTrajectory:
    def __init__(self, states):
        assert isinstance(states[0], Interpolatable)
        self.kind = states[0].__class__
        assert all(isinstance(state, self.kind) for state in states)
        split = [state.to_split_state() for state in states]
        self.states, self.fixed = states, split[0].fixed_states
        self.linear = np.array([state.linear_states for state in split], float)
        self.angular = np.unwrap(np.array([state.angular_states for state in split], float), axis=0)

    def get_state_at_time(self, time_point):
        assert self.states[0].time_point <= time_point <= self.states[-1].time_point
        linear, angular = (
            [np.interp(time_point.time_us, self.linear[:, 0], column) for column in columns.T]
            for columns in (self.linear, self.angular)
        )
        return self.kind.from_split_state(SplitState(linear, angular, self.fixed))

    def get_sampled_trajectory(self):
        return self.states


CLASSES = {
    f"{STATE}.state_representation": (TimePoint, Point2D, StateSE2, StateVector2D),
    f"{STATE}.agent": (Agent,),
    f"{STATE}.static_object": (StaticObject,),
    f"{STATE}.ego_state": (EgoState,),
    f"{PLANNING}.observation.observation_type": (DetectionsTracks,),
    f"{MAPS}.nuplan_map.lane": (NuPlanLane,),
    f"{MAPS}.abstract_map": (AbstractMap,),
    f"{MAPS}.abstract_map_objects": (Lane, RoadBlockGraphEdgeMapObject),
}


def modules():
    """Modules by name, for ``sys.modules``."""
    found = {name: types.ModuleType(name) for name in CLASSES}
    for name, classes in CLASSES.items():
        vars(found[name]).update({item.__name__: item for item in classes})
    return found
