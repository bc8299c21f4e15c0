"""A copy of nuPlan's planner interface, as a planner for its devkit sees it, and planners that use it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import namedtuple

import numpy as np

Pose = namedtuple("Pose", "x y heading")
Time = namedtuple("Time", "time_us")
State = namedtuple("State", "rear_axle time_point")
LANE, LANE_CONNECTOR, ROADBLOCK, ROADBLOCK_CONNECTOR = 0, 11, 17, 18
RED = 2


class DetectionsTracks:
    """Type of the observation."""


class Sensors:
    """Another type of observation."""


class AbstractPlanner(ABC):
    """The interface."""

    requires_scenario = False

    @abstractmethod
    def name(self):
        """Name of the planner."""

    @abstractmethod
    def initialize(self, initialization):
        """Take route, goal and map."""

    @abstractmethod
    def observation_type(self):
        """Type of the observation."""

    @abstractmethod
    def compute_planner_trajectory(self, current_input):
        """Return a trajectory."""


class Trajectory:
    """A sampled trajectory, as the devkit's interpolated one."""

    def __init__(self, states):
        self._states = states

    def get_sampled_trajectory(self):
        return self._states


def sampled(time_us, poses, step_s):
    return [State(Pose(*pose), Time(time_us + round(k * step_s * 1e6))) for k, pose in enumerate(poses)]


class RouteIdm(AbstractPlanner):
    """Follows the baselines of its route by IDM, and stops for red lights."""

    def name(self):
        return "route_idm"

    def observation_type(self):
        return DetectionsTracks

    def initialize(self, initialization):
        self.map, self.route = initialization.map_api, initialization.route_roadblock_ids

    def _path(self, point):
        """Poses along the nearest lane of the route and those after it, and where the lanes start."""
        layers = (ROADBLOCK, ROADBLOCK_CONNECTOR)
        blocks = [self.map.get_map_object(i, layer) for i in self.route for layer in layers]
        lanes = [lane for block in blocks if block for lane in block.interior_edges]
        away = lambda lane: lane.baseline_path.get_nearest_pose_from_position(point).point.array - point.array  # noqa: E731
        lane = min(lanes, key=lambda lane: math.hypot(*away(lane)))
        here, limit = lane.baseline_path.get_nearest_arc_length_from_position(point), lane.speed_limit_mps
        path, begins = list(lane.baseline_path.discrete_path), []
        while len(begins) < 20 and (
            following := [edge for edge in lane.outgoing_edges if edge.get_roadblock_id() in self.route]
        ):
            lane = following[0]
            begins.append((len(path) - 1, lane.id))
            path += lane.baseline_path.discrete_path[1:]
        return np.array([[pose.x, pose.y, pose.heading] for pose in path]), begins, here, limit

    def compute_planner_trajectory(self, current_input):
        ego, observation = current_input.history.current_state
        path, begins, here, limit = self._path(ego.rear_axle.point)
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))])
        front = here + ego.car_footprint.vehicle_parameters.front_length
        red = {data.lane_connector_id for data in current_input.traffic_light_data if data.status == RED}
        gaps = [(arc[row] - front, 0.0) for row, lane in begins if int(lane) in red]
        for agent in observation.tracked_objects.get_agents():
            away = np.hypot(*(path[:, :2] - agent.center.point.array).T)
            if away.min() < 2.0:
                gaps.append((arc[away.argmin()] - agent.box.half_length - front, agent.velocity.magnitude()))
        gap, ahead = min([gap for gap in gaps if gap[0] > 0.0], default=(1e4, 0.0))
        speed, at, poses = ego.dynamic_car_state.speed, here, []
        path[:, 2] = np.unwrap(path[:, 2])
        for _ in range(17):
            poses.append([np.interp(at, arc, column) for column in path.T])
            closing = max(0.0, 2.0 + 1.5 * speed + speed * (speed - ahead) / (2 * math.sqrt(3.0)))
            free, near = (speed / (limit or 15.0)) ** 4, (closing / max(gap, 0.5)) ** 2
            speed = max(speed + 0.5 * max(1.0 - free - near, -3.0), 0.0)
            at, gap = at + 0.5 * speed, gap + 0.5 * (ahead - speed)
        return Trajectory(sampled(current_input.iteration.time_us, poses, 0.5))


class Replay(AbstractPlanner):
    """Repeats given poses of the rear axle, a row per step of the log, and keeps what it was given."""

    def __init__(self, axle, seen):
        self.axle, self.seen = axle, seen

    def __deepcopy__(self, memo):
        return Replay(self.axle, self.seen)

    def name(self):
        return "replay"

    def observation_type(self):
        return DetectionsTracks

    def initialize(self, initialization):
        self.seen.append(initialization)

    def compute_planner_trajectory(self, current_input):
        self.seen.append(current_input)
        step = round(current_input.iteration.time_s / 0.1)
        return sampled(current_input.iteration.time_us, self.axle[step:].tolist(), 0.1)


class Faulty(RouteIdm):
    """Raises an error in its third step."""

    def name(self):
        return "faulty"

    def compute_planner_trajectory(self, current_input):
        if current_input.iteration.index == 2:
            raise ZeroDivisionError("no\nway out")
        return super().compute_planner_trajectory(current_input)


class Late(RouteIdm):
    """Plans from the next step on."""

    def compute_planner_trajectory(self, current_input):
        return super().compute_planner_trajectory(current_input).get_sampled_trajectory()[1:]


class Seeing(RouteIdm):
    """Asks for sensors."""

    def observation_type(self):
        return Sensors


class Sized(RouteIdm):
    """Needs an argument."""

    def __init__(self, size):
        self.size = size


class Broken(RouteIdm):
    """Cannot be made."""

    def __init__(self):
        raise FileNotFoundError("weights.ckpt")
