"""A copy of nuPlan's planner interface, as a planner for its devkit sees it, and planners that use it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import namedtuple

import numpy as np

import nuplan_devkit as devkit

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


class DevkitIdm(AbstractPlanner):
    """Calls what the devkit's IDM planner calls, in its order, and keeps what it saw."""

    def __init__(self, seen):
        self.seen, self.path = seen, None

    def __deepcopy__(self, memo):
        return DevkitIdm(self.seen)

    def name(self):
        return "devkit_idm"

    def observation_type(self):
        return devkit.DetectionsTracks

    def initialize(self, initialization):
        assert isinstance(initialization.map_api, devkit.AbstractMap)
        self.map, self.blocks = initialization.map_api, []
        for name in initialization.route_roadblock_ids:
            block = self.map.get_map_object(name, ROADBLOCK)
            self.blocks.append(block or self.map.get_map_object(name, ROADBLOCK_CONNECTOR))
        assert len(self.blocks) >= 2
        self.edges = [edge.id for block in self.blocks for edge in block.interior_edges]

    def _plan_path(self, ego):
        """Lanes from the first one under ego, by breadth-first search."""
        edges = self.blocks[0].interior_edges + self.blocks[1].interior_edges
        away = lambda edge: edge.polygon.distance(ego.car_footprint.geometry)  # noqa: E731
        start = next((edge for edge in edges if edge.contains_point(ego.center)), min(edges, key=away))
        plans = [[start]]
        for plan in plans:
            plans += [[*plan, edge] for edge in plan[-1].outgoing_edges if edge.id in self.edges]
        ends = [plan for plan in plans if plan[-1].get_roadblock_id() == self.blocks[-1].id]
        self.limit = start.speed_limit_mps or 15.0
        poses = [pose for edge in (ends or plans)[-1] for pose in edge.baseline_path.discrete_path]
        self.path = np.array([pose.serialize() for pose in poses])

    def _leader(self, ego, observation, lights):
        """Gap and speed of the nearest agent, object or red light on the path ahead."""
        if not isinstance(observation, devkit.DetectionsTracks):
            raise ValueError(observation.detection_type())
        tracks = {item.track_token: item for item in observation.tracked_objects.tracked_objects}
        ahead = lambda point: np.array([*point]) - ego.center.array  # noqa: E731
        near = {key: item for key, item in tracks.items() if np.linalg.norm(ahead(item.center.point)) < 40.0}
        found = []
        for item in near.values():
            local = np.linalg.inv(ego.center.as_matrix()) @ [item.center.x, item.center.y, 1.0]
            if local[0] > 0.0 and abs(local[1]) < 2.0:
                speed = 0.0
                if isinstance(item, devkit.Agent):
                    turn = item.center.heading - ego.center.heading
                    speed = item.velocity.magnitude() * math.cos(turn)
                gap = ego.car_footprint.geometry.distance(item.box.geometry)
                found.append((gap, speed, isinstance(item, devkit.StaticObject)))
        for data in lights:
            if data.status == RED and str(data.lane_connector_id) in self.edges:
                lane = self.map.get_map_object(str(data.lane_connector_id), LANE_CONNECTOR)
                if lane:
                    found.append((ego.car_footprint.geometry.distance(lane.polygon), 0.0, True))
        return min(found, default=(100.0, self.limit, False))

    def compute_planner_trajectory(self, current_input):
        ego, observation = current_input.history.current_state
        if self.path is None:
            self._plan_path(ego)
        leader = self._leader(ego, observation, current_input.traffic_light_data)
        self.seen.append((ego, leader))
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.path[:, :2], axis=0).T))])
        at = arc[np.argmin(np.hypot(*(self.path[:, :2] - ego.center.array).T))]
        speed, time, vehicle = (
            ego.dynamic_car_state.center_velocity_2d.x,
            ego.time_point,
            ego.car_footprint.vehicle_parameters,
        )
        along = np.array([math.cos(ego.center.heading), math.sin(ego.center.heading)])
        row = np.array([np.interp(at, arc, column) for column in self.path.T])
        at, states, gap = at + (ego.center.array - row[:2]) @ along, [ego], leader[0]
        for _ in range(16):
            wish = 1.0 + 1.5 * speed + speed * (speed - leader[1]) / (2 * math.sqrt(3.0))
            push = 1.0 - (speed / self.limit) ** 4 - (max(wish, 0.0) / max(gap, 0.5)) ** 2
            speed = max(speed + 0.5 * max(push, -3.0), 0.0)
            at, gap, time = (
                at + 0.5 * speed,
                gap + 0.5 * (leader[1] - speed),
                time + devkit.TimePoint(500_000),
            )
            pose = devkit.StateSE2(*(np.interp(at, arc, column) for column in self.path.T))
            states.append(devkit.EgoState.build_from_center(pose, speed, time, vehicle))
        trajectory = devkit.InterpolatedTrajectory(states)
        # The simulator of the devkit asks for the state a step later.
        after = trajectory.get_state_at_time(ego.time_point + devkit.TimePoint(100_000))
        assert isinstance(after, devkit.EgoState) and after.time_us == ego.time_us + 100_000
        return trajectory


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
        # Time counts from 2 s before the log.
        step = round(current_input.iteration.time_s / 0.1) - 20
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


class Blind(RouteIdm):
    """Has no observation."""

    def observation_type(self):
        raise NotImplementedError("no observation")


class Broken(RouteIdm):
    """Cannot be made."""

    def __init__(self):
        raise FileNotFoundError("weights.ckpt")
