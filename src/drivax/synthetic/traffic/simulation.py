"""Traffic at 10 Hz: vehicles on paths follow, stop, give way, change lanes and avoid obstacles.

The car-following law is the simulator's (:mod:`drivax.simulator.idm`). Several worlds are simulated together: a step
is mostly array operations over all their vehicles, and each world evolves as it does alone.
"""

from __future__ import annotations

import copy
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float64

from drivax.scenario.schema import DT_S, AgentKind
from drivax.simulator.idm import idm_acceleration
from drivax.synthetic.traffic.lane_changes import (
    MAKE_ROOM_MPS2,
    NO_GAP_PAIRS,
    Change,
    LaneChanges,
    VehicleState,
)
from drivax.synthetic.traffic.lateral import (
    DETOUR_MARGIN_M,
    LOOK_M,
    Detours,
    detour_request,
    lane_change_path,
    positions_along,
)
from drivax.synthetic.traffic.obstacles import (
    NO_EXTENTS,
    Boxes,
    Extents,
    LeaderSearch,
    StaticObstacles,
    extents,
    nearest_obstacles,
)
from drivax.synthetic.traffic.path_arrays import (
    PathTables,
    PerVehicle,
    VehicleMask,
    VehicleRows,
    Worlds,
    group_indices,
    pad_steps,
)
from drivax.synthetic.traffic.paths import Path, Sway, lane_path, next_lanes
from drivax.synthetic.traffic.pedestrians import Pedestrians
from drivax.synthetic.traffic.placement import join_drivers
from drivax.synthetic.traffic.right_of_way import RightOfWay, TrafficState
from drivax.synthetic.traffic.roles import EgoPlan, Motion, Roles, ScriptedUser, Staging

#: Distance between the front bumper and a stop line at standstill, m.
_LINE_GAP_M = 1.0
#: Distance kept to an obstacle in the lane, which leaves room for passing it, m.
_OBSTACLE_GAP_M = 5.0
#: Gap that the IDM keeps, and distance kept to the end of a lane in addition to it, m.
_IDM_GAP_M, _LANE_END_GAP_M = 2.0, 10.0
#: Largest speed of a vehicle that starts a detour, in general and in worlds with a stuck vehicle or halted user, m/s.
_DETOUR_MPS, _SLOW_DETOUR_MPS = 9.0, 3.0
#: Speed below which vehicles and users count as halted, m/s, and length of users that need a detour, m.
_HALTED_MPS, _LARGE_M = 0.05, 1.2
#: Time constant with which a driver follows the speed profile, s.
_SPEED_TIME_S = 0.6
#: Deceleration beyond which a driver's own jerk limit is replaced, m/s2, and the limit that replaces it, m/s3.
_EMERGENCY_MPS2, _EMERGENCY_JERK = 3.6, 25.0
#: Steps between decisions about lane changes and detours.
_DECISION_STEPS = 5
#: Least number of steps from the start of a lane change or detour to that of the next one.
_REST_STEPS = round(4.0 / DT_S)
#: Braking that drivers accept for pedestrians, m/s2: to start to brake, and once they brake.
_COMFORTABLE_MPS2, _HARDEST_MPS2 = 3.0, 8.0
#: Limit of the braking for lines as a multiple of the required braking, to which 0.5 m/s2 is added.
_LINE_BRAKING_FACTOR = 1.3
#: Longest reaction, steps.
_MAX_REACTION_STEPS = 6
#: Steps ahead for which a planned ego reserves connectors.
_LOOKAHEAD_STEPS = 25
#: Runs that are simulated together.
_BATCH_RUNS = 8

_T = TypeVar("_T")


def boxes_at(scripted: tuple[ScriptedUser, ...], step: int) -> Boxes:
    """Return the boxes of scripted users at a step."""
    return Boxes(
        np.array([user.xy[step] for user in scripted]).reshape(-1, 2),
        np.array([user.heading[step] for user in scripted], float),
        np.array([user.speed[step] for user in scripted], float),
        np.array([user.size_m[:2] for user in scripted]).reshape(-1, 2),
    )


_NO_BOXES = boxes_at((), 0)


@dataclass(frozen=True)
class _Log:
    """Recorded motion of vehicles (x, y, heading) and pedestrians (x, y, heading, speed)."""

    pose: Float64[np.ndarray, "time v 3"]
    speed: Float64[np.ndarray, "time v"]
    valid: Bool[np.ndarray, "time v"]
    at_m: Float64[np.ndarray, "time v"]
    acceleration: Float64[np.ndarray, "time v"]
    pedestrian_poses: Float64[np.ndarray, "time pedestrian 4"]

    @classmethod
    def empty(cls, steps: int, vehicles: int, pedestrians: int) -> _Log:
        """Allocate a log."""
        speed, at_m, acceleration = np.zeros((3, steps, vehicles))
        valid = np.zeros((steps, vehicles), bool)
        poses = np.zeros((steps, vehicles, 3)), np.zeros((steps, pedestrians, 4))
        return cls(poses[0], speed, valid, at_m, acceleration, poses[1])

    def motion(self, run: Run, vehicles: slice, pedestrians: slice, paths: list[Path]) -> Motion:
        """Return the motion of all users of a run, the scripted ones included."""
        roles, steps = run.traffic.roles, len(run.traffic.times_s)
        scripted = (*roles.parked, *run.staging.extras)
        users = [*roles.pedestrians, *scripted]
        kinds = [AgentKind.PEDESTRIAN] * len(roles.pedestrians) + [user.kind for user in scripted]

        def by_user(values: np.ndarray, columns: slice = vehicles) -> np.ndarray:
            return np.ascontiguousarray(np.swapaxes(values[:steps, columns], 0, 1))

        def concatenate(vehicles: np.ndarray, pedestrians: np.ndarray, name: str) -> np.ndarray:
            return np.concatenate([vehicles, pedestrians, *(vars(s)[name][None, :steps] for s in scripted)])

        pose, speed, acceleration = map(by_user, (self.pose, self.speed, self.acceleration))
        walk = by_user(self.pedestrian_poses, pedestrians)
        if run.ego is not None:
            first = run.ego.first_step
            acceleration[0, first:-1] = np.diff(speed[0, first:]) / DT_S
        return Motion(
            kind=np.concatenate([roles.drivers.kind, np.array(kinds, np.int8)]),
            size_m=np.concatenate([roles.drivers.size_m, np.array([u.size_m for u in users]).reshape(-1, 3)]),
            xy=concatenate(pose[..., :2], walk[..., :2], "xy"),
            heading=concatenate(pose[..., 2], walk[..., 2], "heading"),
            speed=concatenate(speed, walk[..., 3], "speed"),
            valid=concatenate(by_user(self.valid), np.ones(walk.shape[:2], bool), "valid"),
            distance_m=by_user(self.at_m),
            acceleration=acceleration,
            paths=paths,
        )


class WorldTraffic:
    """Traffic of all users of a world, which can be run several times."""

    def __init__(self, roles: Roles, times_s: Float64[np.ndarray, " time"]) -> None:
        self.roles, self.times_s = roles, times_s
        self.parked = boxes_at(roles.parked, 0)
        self.detours = Detours(roles.network)
        shape = (len(times_s), len(roles.network.lanes))
        self.colour, self.to_red = np.zeros(shape, np.int8), np.zeros(shape)
        if roles.network.signals is not None:
            self.colour, self.to_red = roles.network.signals.colours(times_s, shape[1])

    def before_step(self, steps: int) -> WorldTraffic:
        """Return the traffic of the first ``steps`` steps."""
        shorter = copy.copy(self)
        shorter.times_s = self.times_s[:steps]
        return shorter

    @cached_property
    def parked_extents(self) -> list[Extents]:
        """Extents of the parked cars along each path."""
        return self.extents(self.parked)

    def extents(self, boxes: Boxes) -> list[Extents]:
        """Return the extents of boxes along each path."""
        return [extents(path, boxes)[0] if len(boxes) else NO_EXTENTS for path in self.roles.paths]

    def run(self, staging: Staging | None = None, ego: EgoPlan | None = None) -> Motion:
        """Run all steps, with the changes of an event and ego on a plan (default: ego drives like the others)."""
        return simulate([Run(self, staging or Staging(), ego)])[0]


@dataclass(frozen=True)
class Run:
    """Arguments of :meth:`WorldTraffic.run`."""

    traffic: WorldTraffic
    staging: Staging = field(default_factory=Staging)
    ego: EgoPlan | None = None


def simulate(runs: Sequence[Run]) -> list[Motion]:
    """Simulate runs together; each result is that of the run alone."""
    return _Simulation(runs).finish()


def run_all(tasks: Iterable[Generator[Run, Motion, _T]]) -> Iterator[_T]:
    """Run tasks and yield their results in order.

    Each task yields runs and receives their motion. Up to 8 runs of different tasks are simulated together.
    """
    remaining = iter(enumerate(tasks))
    results: dict[int, _T] = {}
    waiting: dict[int, tuple[Generator[Run, Motion, _T], Run]] = {}
    next_number = 0

    def advance(number: int, task: Generator[Run, Motion, _T], motion: Motion | None) -> None:
        try:
            waiting[number] = task, next(task) if motion is None else task.send(motion)
        except StopIteration as end:
            results[number] = end.value

    while True:
        while len(waiting) < _BATCH_RUNS and (entry := next(remaining, None)):
            advance(*entry, None)
        while next_number in results:
            yield results.pop(next_number)
            next_number += 1
        if not waiting:
            return
        batch, waiting = waiting, {}
        motions = simulate([run for _, run in batch.values()])
        for (number, (task, _)), motion in zip(batch.items(), motions, strict=True):
            advance(number, task, motion)


class _Simulation:
    """State of runs that are simulated together."""

    def __init__(self, runs: Sequence[Run]) -> None:
        self._runs, roles = runs, [run.traffic.roles for run in runs]
        self._worlds = worlds = Worlds([r.network for r in roles], [len(r.paths) for r in roles])
        self._ego_rows = worlds.first_row[:-1]
        drivers = join_drivers(*(r.drivers for r in roles))
        self._half_m, self._width_m = drivers.size_m[:, 0] / 2, drivers.size_m[:, 1]
        self._rows, self._size_m = np.arange(len(self._half_m)), drivers.size_m[:, :2]
        self._tables = PathTables(worlds, [path for r in roles for path in r.paths], drivers)
        self._gather_obstacles(runs)
        self._right_of_way = RightOfWay(worlds, drivers)
        self._changes = LaneChanges(worlds, drivers, self._obstacles.boxes)
        self._leaders = LeaderSearch(worlds, drivers)
        self._delay = np.rint(drivers.reaction_s / DT_S).astype(int).clip(0, _MAX_REACTION_STEPS)
        for first_row, run in zip(self._ego_rows.tolist(), runs, strict=True):
            for tailgate in run.staging.tailgates:
                drivers = drivers.with_headway(first_row + tailgate.vehicle, tailgate.headway_s)
        self._drivers, self._idm = drivers, drivers.idm()
        self._gather_pedestrians(runs)
        self._gather_scripts(runs)
        self._initialise(runs)

    def _gather_obstacles(self, runs: Sequence[Run]) -> None:
        """Gather parked cars and static scripted users."""
        boxes, path_extents = [], []
        for run in runs:
            static = tuple(user for user in run.staging.extras if user.is_static)
            boxes.append(run.traffic.parked.concatenate(boxes_at(static, 0)))
            path_extents += run.traffic.extents(boxes[-1]) if static else run.traffic.parked_extents
        self._obstacles = StaticObstacles(self._worlds, boxes, path_extents, self._width_m)
        self._has_obstacles = np.array([len(standing) > 0 for standing in boxes])

    def _gather_pedestrians(self, runs: Sequence[Run]) -> None:
        """Gather pedestrians and the state of crossings."""
        worlds, pedestrians = self._worlds, [run.traffic.roles.pedestrians for run in runs]
        times_s = [run.traffic.times_s for run in runs]
        self._pedestrians = Pedestrians(worlds, pedestrians, times_s) if any(pedestrians) else None
        self._pedestrian_world = np.repeat(np.arange(len(runs)), list(map(len, pedestrians)))
        self._pedestrians_by_world = group_indices(self._pedestrian_world, len(runs))
        self._occupied_crossings = np.zeros(worlds.first_crossing[-1], bool)
        self._crossing_world = np.repeat(np.arange(len(runs)), np.diff(worlds.first_crossing))
        self._brakes_for_crossing = np.zeros(self._tables.crossing.shape, bool)

    def _initialise(self, runs: Sequence[Run]) -> None:
        """Set the initial state of all vehicles and allocate the log."""
        traffics, count = [run.traffic for run in runs], len(self._rows)
        self._position_m = np.concatenate([traffic.roles.distance_m for traffic in traffics])
        self._speed = np.concatenate([traffic.roles.speed_mps for traffic in traffics])
        for first_row, run in zip(self._ego_rows, runs, strict=True):
            removed = first_row + np.array(run.staging.removed, int)
            self._position_m[removed] = self._tables.length_m[removed]
        self._last_acceleration = np.zeros(count)
        self._preferred_memory = np.zeros((_MAX_REACTION_STEPS + 1, count))
        # Path position at which a lane change or detour ends, and first step of the next decision.
        self._busy_m, self._rest_until = np.full(count, -np.inf), np.zeros(count, int)
        self._gap_pairs = NO_GAP_PAIRS
        # Gap to and speed of the next leader, line and obstacle.
        self._gaps, self._leader_speeds = np.full((3, count), np.inf), np.zeros((3, count))
        self._moving_users = self._vehicles = _NO_BOXES
        self._user_world, self._users_by_world = self._pedestrian_world, self._pedestrians_by_world
        self._colour = np.concatenate(pad_steps([traffic.colour for traffic in traffics]), axis=1)
        self._to_red = np.concatenate(pad_steps([traffic.to_red for traffic in traffics]), axis=1)
        steps = [len(traffic.times_s) for traffic in traffics]
        self._steps = np.array(steps)[self._worlds.world]
        self._log = _Log.empty(max(steps), count, len(self._pedestrian_world))

    def _gather_scripts(self, runs: Sequence[Run]) -> None:
        """Gather moving scripted users, overrides, and planned egos with their positions along their paths."""
        first = self._worlds.first_row
        self._movers = [
            (world, user) for world, run in enumerate(runs) for user in run.staging.extras if not user.is_static
        ]  # fmt: skip
        self._overrides = [
            (int(first[world]) + override.vehicle, override)
            for world, run in enumerate(runs)
            for override in run.staging.overrides
        ]
        self._plans = [
            (int(ego_row), run.ego, positions_along(run.traffic.roles.paths[0], run.ego.xy))
            for ego_row, run in zip(self._ego_rows, runs, strict=True)
            if run.ego is not None
        ]

    def finish(self) -> list[Motion]:
        """Run all steps and collect the motions."""
        for t in range(len(self._log.speed)):
            self._step(t)
        return [self._motion(world, run) for world, run in enumerate(self._runs)]

    def _motion(self, world: int, run: Run) -> Motion:
        """Return the motion of a world from the log."""
        pedestrians = slice(*np.searchsorted(self._pedestrian_world, [world, world + 1]).tolist())
        vehicles = self._worlds.vehicles(world)
        return self._log.motion(run, vehicles, pedestrians, self._tables.paths[vehicles])

    def _step(self, t: int) -> None:
        """Record a step and advance all users to the next one."""
        log = self._log
        plans = [
            (vehicle, plan, min(t - plan.first_step, len(plan.speed) - 1), position_m)
            for vehicle, plan, position_m in self._plans
            if t >= plan.first_step
        ]
        for vehicle, plan, k, position_m in plans:
            self._position_m[vehicle], self._speed[vehicle] = position_m[k], plan.speed[k]
        active = self._position_m + self._half_m < self._tables.length_m
        ahead_m = self._position_m + self._speed * _SPEED_TIME_S
        sample = self._tables.interpolate(np.concatenate((self._position_m, ahead_m)).reshape(2, -1))
        pose, fastest, fastest_ahead = sample[0, :, :3], sample[0, :, 3], sample[1, :, 3]
        for vehicle, plan, k, _ in plans:
            active[vehicle] = True
            pose[vehicle] = (*plan.xy[k], plan.heading[k])
        self._vehicles = Boxes(pose[:, :2], pose[:, 2], self._speed, self._size_m)
        self._advance_pedestrians(t, active)
        log.pose[t], log.speed[t], log.at_m[t], log.valid[t] = pose, self._speed, self._position_m, active
        preferred = self._preferred_acceleration(t, fastest, fastest_ahead, active)
        if t % _DECISION_STEPS == 0:
            self._start_manoeuvres(t, preferred, fastest, active)
        log.acceleration[t] = self._advance(self._apply_reaction_times(t, preferred), active)

    def _switch_path(self, t: int, vehicle: int, path: Path, position_m: float, end_m: float) -> None:
        """Put a vehicle at a position on another path; it starts no further manoeuvre before ``end_m``."""
        world = int(self._worlds.world[vehicle])
        crossings = self._tables.crossings[world]
        self._tables.replace(vehicle, path)
        self._obstacles.replace(vehicle, path)
        self._position_m[vehicle] = position_m
        # With more crossings than on any path before, all vehicles of its world decide again: stored sets depend on it.
        widened = self._tables.crossings[world] > crossings
        self._brakes_for_crossing[self._worlds.vehicles(world) if widened else vehicle] = False
        self._right_of_way.reset_vehicle(vehicle, self._tables, position_m + self._half_m[vehicle])
        self._busy_m[vehicle], self._rest_until[vehicle] = end_m, t + _REST_STEPS

    def _advance_pedestrians(self, t: int, active: VehicleMask) -> None:
        """Advance the pedestrians, and gather them and the moving scripted users of this step."""
        users = _NO_BOXES
        if self._pedestrians is not None:
            users, self._occupied_crossings = self._pedestrians.step(t, self._vehicles, active)
            log = self._log.pedestrian_poses[t]
            log[:, :2], log[:, 2], log[:, 3] = users.xy, users.heading, users.speed
        movers = [(world, user) for world, user in self._movers if t < len(user.valid) and user.valid[t]]
        self._user_world, self._users_by_world = self._pedestrian_world, self._pedestrians_by_world
        if movers:
            users = users.concatenate(boxes_at(tuple(user for _, user in movers), t))
            self._user_world = np.append(self._user_world, [world for world, _ in movers])
            self._users_by_world = group_indices(self._user_world, len(self._worlds))
        self._moving_users = users

    def _preferred_acceleration(
        self, t: int, fastest: PerVehicle, fastest_ahead: PerVehicle, active: VehicleMask
    ) -> PerVehicle:
        """Return the least acceleration for leaders, lines, obstacles, gaps to open, and top speeds here and ahead."""
        gaps, leader_speeds = self._gaps, self._leader_speeds
        gaps[0], leader = self._leaders.find(self._tables, self._position_m, active)
        leader_speeds[0] = self._speed[leader]
        # Lines and obstacles are updated in alternate steps and extrapolated in the others.
        if t % 2 or t == 0:
            gaps[1] = self._stop_gap(t, active, leader)
        else:
            gaps[1] -= self._speed * DT_S
        if t % 2 == 0:
            others = self._moving_users, self._users_by_world
            gaps[2], leader_speeds[2] = nearest_obstacles(
                self._tables, self._vehicles, self._position_m, active, *others
            )
        else:
            gaps[2] += (leader_speeds[2] - self._speed) * DT_S
        # Only an ego on a plan could reverse; the IDM treats it as standing.
        speed = np.maximum(self._speed, 0.0)
        accelerations = idm_acceleration(speed, fastest, gaps, np.maximum(leader_speeds, 0.0), self._idm)
        # Braking for a line is limited to a little more than it takes to stop there.
        to_stop = speed**2 / (2 * np.maximum(gaps[1] - (_IDM_GAP_M - _LINE_GAP_M), 0.1))
        lines = np.maximum(accelerations[1], -_LINE_BRAKING_FACTOR * to_stop - 0.5)
        preferred = np.minimum(np.minimum(accelerations[0], lines), accelerations[2])
        preferred = np.minimum(preferred, (fastest_ahead - self._speed) / _SPEED_TIME_S)
        return self._open_gaps(preferred, fastest)

    def _open_gaps(self, preferred: PerVehicle, fastest: PerVehicle) -> PerVehicle:
        """Limit the accelerations of vehicles that open gaps for mandatory lane changes."""
        behind, ahead = self._gap_pairs.behind, self._gap_pairs.ahead
        if len(behind):
            gap = self._gap_pairs.gap_m + self._position_m[ahead] - self._position_m[behind]
            idm, speed = self._drivers.idm(behind), self._speed[behind]
            limit = idm_acceleration(speed, fastest[behind], gap, self._speed[ahead], idm)
            # A vehicle that is already past needs no gap, and slow ones open none.
            limit = np.where((gap > -2.0) & (speed > 1.5), np.maximum(limit, -MAKE_ROOM_MPS2), np.inf)
            np.minimum.at(preferred, behind, limit)
        return preferred

    def _stop_gap(self, t: int, active: VehicleMask, leader: VehicleRows) -> PerVehicle:
        """Return the gap for the IDM to the next line, crossing, static obstacle or lane end to stop at."""
        tables, front = self._tables, self._position_m + self._half_m
        committed = {}
        for vehicle, plan, position_m in self._plans:
            if t >= plan.first_step:
                step = min(t - plan.first_step + _LOOKAHEAD_STEPS, len(position_m) - 1)
                front_m = position_m[step] + self._half_m[vehicle]
                committed[vehicle] = int(np.sum(tables.connector_begin[vehicle] < front_m))
        state = TrafficState(
            tables=tables,
            step=t,
            colour=self._colour[t],
            to_red=self._to_red[t],
            front_m=front,
            rear_m=self._position_m - self._half_m,
            speed=self._speed,
            active=active,
            room_m=self._gaps[0],
            leader=leader,
            leader_speed=self._leader_speeds[0],
            committed=committed,
        )
        room = self._right_of_way.stop_line_m(state) + _IDM_GAP_M - _LINE_GAP_M
        if np.count_nonzero(self._occupied_crossings):
            room = np.minimum(room, self._crossing_gap(front) + _IDM_GAP_M - _LINE_GAP_M)
        room = np.minimum(room, tables.stop_m - front - _LANE_END_GAP_M)
        if self._has_obstacles.any():
            room = np.minimum(room, self._obstacles.gap(front) + _IDM_GAP_M - _OBSTACLE_GAP_M)
        return room

    def _crossing_gap(self, front: PerVehicle) -> PerVehicle:
        """Return the distance to the next occupied marked crossing before which a vehicle can stop."""
        crossing, distance = self._tables.crossing, self._tables.crossing_m - front[:, None]
        required_mps2 = self._speed[:, None] ** 2 / (2 * np.maximum(distance, 0.05))
        brakes = self._brakes_for_crossing
        if crossing.shape[1] > brakes.shape[1]:
            brakes = np.pad(brakes, ((0, 0), (0, crossing.shape[1] - brakes.shape[1])))
        stops = self._occupied_crossings[crossing] & (crossing >= 0) & (distance > -0.5)
        stops &= required_mps2 < np.where(brakes, _HARDEST_MPS2, _COMFORTABLE_MPS2)
        # A world without an occupied crossing keeps its state.
        is_occupied = self._worlds.mask(self._crossing_world[self._occupied_crossings])
        self._brakes_for_crossing = np.where(is_occupied[self._worlds.world, None], stops, brakes)
        return np.where(stops, distance, np.inf).min(axis=1)

    def _apply_reaction_times(self, t: int, preferred: PerVehicle) -> PerVehicle:
        """Return the accelerations preferred one reaction time ago, bounded by overrides."""
        depth = len(self._preferred_memory)
        if t == 0:
            self._preferred_memory[:] = preferred
        self._preferred_memory[t % depth] = preferred
        result = self._preferred_memory[(t - self._delay) % depth, self._rows]
        for vehicle, override in self._overrides:
            if override.first_step <= t <= override.last_step:
                result[vehicle] = min(result[vehicle], override.acceleration_mps2)
        return result

    def _advance(self, preferred: PerVehicle, active: VehicleMask) -> PerVehicle:
        """Advance by one step and return the accelerations (of a vehicle that stops: until it stands)."""
        last, jerk = self._last_acceleration, self._drivers.jerk_mps3 * DT_S
        braking_jerk = np.where(preferred < -_EMERGENCY_MPS2, _EMERGENCY_JERK, self._drivers.jerk_mps3) * DT_S
        a = np.minimum(np.maximum(preferred, last - braking_jerk), last + jerk)
        after = self._speed + a * DT_S
        stops = after <= 0.0
        stopping_m = self._speed**2 / (2 * np.maximum(-a, 1e-9))
        distance = np.where(stops, stopping_m, (self._speed + after) * DT_S / 2)
        self._position_m = self._position_m + np.where(active, distance, 0.0)
        self._last_acceleration = np.where(stops, 0.0, a)
        self._speed = np.where(active, np.maximum(after, 0.0), 0.0)
        return a

    def _start_manoeuvres(
        self, t: int, preferred: PerVehicle, fastest: PerVehicle, active: VehicleMask
    ) -> None:
        """Start lane changes and detours of vehicles that may decide now."""
        # Vehicles of finished worlds keep their paths.
        may_decide = (self._position_m > self._busy_m) & (self._rest_until <= t) & active & (t < self._steps)
        for vehicle, override in self._overrides:
            may_decide[vehicle] &= t < override.first_step
        free = may_decide.copy()
        free[self._ego_rows] = False
        state = VehicleState(self._position_m, self._speed, active, free, fastest, preferred)
        changes, self._gap_pairs = self._changes.decide(state, self._tables)
        for change in changes:
            self._start_lane_change(t, change)
            may_decide[change.vehicle] = False
        for vehicle, plan, _ in self._plans:
            may_decide[vehicle] &= t < plan.first_step
        self._start_detours(t, may_decide)

    def _start_lane_change(self, t: int, change: Change) -> None:
        """Start a lane change; after it the vehicle returns to the lanes of its old path where it can."""
        vehicle, worlds = change.vehicle, self._worlds
        world, present = worlds.world[vehicle], self._tables.paths[vehicle]
        network, number = worlds.networks[world], vehicle - int(worlds.first_row[world])
        lanes = [change.lane - int(worlds.first_lane[world])]
        old_lanes = {span.lane for span in present.spans}
        while network.lanes[lanes[-1]].successors:
            options = next_lanes(network, lanes)
            on_path = [lane for lane in options if lane in old_lanes]
            # Otherwise vehicles take the branches in turn, without a random draw.
            lanes.append(on_path[0] if on_path else options[(number + len(lanes)) % len(options)])
        # One wave of 8 cm, 90 m long, with a phase of the vehicle's own.
        sway = Sway((0.08,), (0.07,), (float(number),))
        target = lane_path(network, tuple(lanes), sway)
        path, position = lane_change_path(target, present, self._position_m[vehicle], change.length_m)
        self._switch_path(t, vehicle, path, position, position + change.length_m)

    def _start_detours(self, t: int, may_decide: VehicleMask) -> None:
        """Start detours of vehicles near a standing obstacle: a static one, a stuck vehicle or a large halted user."""
        is_stuck, worlds = np.zeros(len(self._rows), bool), self._worlds
        for vehicle, override in self._overrides:
            is_overridden = override.first_step <= t <= override.last_step
            is_stuck[vehicle] |= is_overridden and self._speed[vehicle] < _HALTED_MPS
        is_halted = np.abs(self._moving_users.speed) < _HALTED_MPS
        is_large = is_halted & (self._moving_users.size_m[:, 0] > _LARGE_M)
        has_stuck = worlds.mask(worlds.world[is_stuck])
        has_halted = has_stuck | worlds.mask(self._user_world[is_large])
        may_detour = has_halted | self._has_obstacles
        if not may_detour.any():
            return
        front = self._position_m + self._half_m
        slow_only = (has_stuck | worlds.mask(self._user_world[is_halted]))[worlds.world]
        is_looking = np.where(slow_only, self._speed < _SLOW_DETOUR_MPS, self._obstacles.gap(front) < LOOK_M)
        is_looking &= may_decide & may_detour[worlds.world] & (self._speed < _DETOUR_MPS)
        half_m = self._width_m / 2 + DETOUR_MARGIN_M
        for vehicle in is_looking.nonzero()[0].tolist():
            if has_halted[worlds.world[vehicle]] or self._obstacles.is_blocked(
                vehicle, front[vehicle], half_m[vehicle], LOOK_M
            ):
                self._start_detour(t, vehicle, is_stuck, is_large)

    def _start_detour(
        self, t: int, vehicle: int, is_stuck: VehicleMask, is_large: Bool[np.ndarray, " user"]
    ) -> None:
        """Start a detour around an obstacle ahead, if there is one; ``is_large`` is a mask of large halted users."""
        world, worlds = int(self._worlds.world[vehicle]), self._worlds
        is_in_world, is_moving = self._user_world == world, np.abs(self._moving_users.speed) >= _HALTED_MPS
        is_other = (self._position_m > 0.0) & ~is_stuck & (worlds.world == world)
        is_other[vehicle] = False
        standing = self._obstacles.boxes[world].concatenate(
            self._vehicles.select(is_stuck & (worlds.world == world))
        )
        standing = standing.concatenate(self._moving_users.select(is_large & is_in_world))
        moving = self._vehicles.select(is_other).concatenate(
            self._moving_users.select(is_in_world & is_moving)
        )
        position, speed = float(self._position_m[vehicle]), float(self._speed[vehicle])
        size = 2 * float(self._half_m[vehicle]), float(self._width_m[vehicle])
        request = detour_request(self._tables, vehicle, position, speed, size)
        detour = self._runs[world].traffic.detours.find(request, standing, moving)
        if detour is not None:
            self._switch_path(t, vehicle, detour[0], position, detour[1])
