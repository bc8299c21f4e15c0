"""Traffic at 10 Hz: vehicles on paths follow, stop, give way, change lanes and avoid obstacles.

The car-following law is the simulator's (:mod:`drivax.simulator.idm`). All vehicles move at once: one step is a few
dozen array operations over all vehicles.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float64

from drivax.scenario.schema import DT_S, AgentKind
from drivax.simulator.idm import idm_acceleration
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.lane_changes import HELP_MPS2, NO_HELP, Change, LaneChanges, Situation
from drivax.synthetic.traffic.lateral import (
    DETOUR_MARGIN_M,
    LOOK_M,
    Detours,
    change_onto,
    detour_request,
    positions_along,
)
from drivax.synthetic.traffic.obstacles import Boxes, StaticObstacles, nearest_obstacles
from drivax.synthetic.traffic.path_arrays import PathTables, PerVehicle, VehicleMask, VehicleRows
from drivax.synthetic.traffic.paths import SLOTS, Path, Sway, lane_path, next_lanes
from drivax.synthetic.traffic.pedestrians import Pedestrians
from drivax.synthetic.traffic.right_of_way import RightOfWay, TrafficState
from drivax.synthetic.traffic.roles import Drivers, EgoPlan, Motion, Roles, Scripted, Staging

#: Half the lane width that passing a cyclist takes, m: half a bicycle, its distance from the kerb, and 1.5 m to a car.
_PASS_CYCLIST_M = 0.35 + 0.55 + 1.5
#: Distance between the front bumper and a stop line at standstill, m.
_STOP_SHORT_M = 1.0
#: Distance kept to an obstacle in the lane, to leave room for passing it, and to the end of a lane, m.
_KEEP_M, _END_M = 5.0, 10.0
#: Time constant with which a driver follows the speed profile, s.
_SPEED_TIME_S = 0.6
#: Jerk limit beyond a driver's own when braking harder than this, m/s2 and m/s3.
_EMERGENCY_MPS2, _EMERGENCY_JERK = 3.6, 25.0
#: Steps between decisions about lane changes and detours.
_DECIDE_EVERY = 5
#: Steps between the end of a decision to leave the lane and the next one.
_REST_STEPS = round(4.0 / DT_S)
#: Braking that drivers accept for pedestrians, m/s2: to begin to stop, and once they brake.
_YIELD_MPS2, _HARDEST_MPS2 = 3.0, 8.0
#: Limit of the braking for lines, as a multiple of what is needed.
_FIRMLY = 1.3
#: Longest reaction, steps.
_SLOWEST = 6
#: A planned ego claims junctions this many steps ahead.
_FORESEEN = 25
#: Steps between checkpoints, from which a run resumes that differs later.
_CHECKPOINT_STEPS = 8
#: Attributes of a run that change, tables of paths apart.
_STATE = (
    "_right_of_way", "_pedestrians", "_occupied_crossings", "_halting", "_at", "_speed",
    "_last", "_memory", "_busy_m", "_rest", "_helped", "_leaders", "_gaps", "_leads", "_moving_users", "_vehicles",
)  # fmt: skip


def boxes_at(scripted: tuple[Scripted, ...], step: int) -> Boxes:
    """Boxes of scripted users at a step."""
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

    pose: Float64[np.ndarray, "v time 3"]
    speed: Float64[np.ndarray, "v time"]
    valid: Bool[np.ndarray, "v time"]
    at_m: Float64[np.ndarray, "v time"]
    acceleration: Float64[np.ndarray, "v time"]
    pedestrian_poses: Float64[np.ndarray, "pedestrian time 4"]

    def motion(self, roles: Roles, staging: Staging, paths: list[Path]) -> Motion:
        """Return the motion of all users, the scripted ones included."""
        scripted, steps = (*roles.parked, *staging.extras), self.speed.shape[1]
        users = [*roles.pedestrians, *scripted]
        kinds = [AgentKind.PEDESTRIAN] * len(roles.pedestrians) + [user.kind for user in scripted]

        def concatenate(vehicles: np.ndarray, pedestrians: np.ndarray, name: str) -> np.ndarray:
            return np.concatenate([vehicles, pedestrians, *(vars(s)[name][None, :steps] for s in scripted)])

        return Motion(
            kind=np.concatenate([roles.drivers.kind, np.array(kinds, np.int8)]),
            size_m=np.concatenate([roles.drivers.size_m, np.array([u.size_m for u in users]).reshape(-1, 3)]),
            xy=concatenate(self.pose[..., :2], self.pedestrian_poses[..., :2], "xy"),
            heading=concatenate(self.pose[..., 2], self.pedestrian_poses[..., 2], "heading"),
            speed=concatenate(self.speed, self.pedestrian_poses[..., 3], "speed"),
            valid=concatenate(self.valid, np.ones(self.pedestrian_poses.shape[:2], bool), "valid"),
            distance_m=self.at_m,
            acceleration=self.acceleration,
            paths=paths,
        )


class Leaders:
    """Finds the leader of every vehicle."""

    def __init__(self, network: RoadNetwork, drivers: Drivers) -> None:
        self._half_m, width_m = drivers.size_m[:, 0] / 2, drivers.size_m[:, 1]
        self._rows = np.arange(len(width_m))
        self._cyclist, self._any_cyclist = drivers.cyclist, bool(drivers.cyclist.any())
        # Half the width of the widest car that may pass a cyclist within the lane.
        spare_m = np.array([lane.width_m for lane in network.lanes]) / 2 - _PASS_CYCLIST_M
        self._passes = spare_m >= width_m[:, None] / 2
        self._nearest = np.full(len(width_m), np.inf), np.zeros(len(width_m), int)

    def ahead(
        self, tables: PathTables, at_m: PerVehicle, active: VehicleMask
    ) -> tuple[PerVehicle, VehicleRows]:
        """Gap to the nearest vehicle ahead on the own lanes (infinite: none), and its row."""
        own = at_m[:, None]
        lane, along = tables.on(at_m)
        lane[~active] = -1
        # position[i, k]: position of the k-th occupied (vehicle, lane) on the path of vehicle i.
        slots = (lane.ravel() >= 0).nonzero()[0]
        if not len(slots):
            return self._nearest
        vehicles_ahead, lanes = slots // SLOTS, lane.ravel().take(slots)
        # nan where the lane is not on the path, or not relevant at this position: comparisons are false.
        begin = np.where((tables.since <= own) & (own <= tables.until), tables.begin, np.nan)
        position = tables.scale.take(lanes, axis=1)
        position *= along.ravel().take(slots)
        position = begin.take(lanes, axis=1) + position
        seen = (position > own) & (vehicles_ahead != self._rows[:, None])
        if self._any_cyclist:
            # Where the lane is wide enough, cyclists are overtaken within it.
            seen &= ~(self._cyclist[vehicles_ahead] & self._passes.take(lanes, axis=1))
        position -= self._half_m[vehicles_ahead]
        gap = np.where(seen, position, np.inf) - own - self._half_m[:, None]
        nearest = gap.argmin(axis=1)
        self._nearest = gap[self._rows, nearest], vehicles_ahead[nearest]
        return self._nearest


class Traffic:
    """Traffic of all users, advanced step by step."""

    def __init__(self, roles: Roles, times_s: Float64[np.ndarray, " time"]) -> None:
        self.roles, self.times_s = roles, times_s
        self.tables = PathTables(roles.network, roles.paths, roles.drivers)
        self.parked = boxes_at(roles.parked, 0)
        self.standing = StaticObstacles(self.parked, self.tables, roles.drivers.size_m[:, 1])
        self.right_of_way = RightOfWay(roles.network, roles.drivers)
        self.detours = Detours(roles.network)
        self._latest: _Run | None = None
        shape = (len(times_s), len(roles.network.lanes))
        self.colour, self.to_red = np.zeros(shape, np.int8), np.zeros(shape)
        if roles.network.signals is not None:
            self.colour, self.to_red = roles.network.signals.colours(times_s, shape[1])

    def before_step(self, steps: int) -> Traffic:
        """Return the traffic with fewer steps."""
        shorter = copy.copy(self)
        shorter.times_s = self.times_s[:steps]
        return shorter

    def run(self, staging: Staging | None = None, ego: EgoPlan | None = None) -> Motion:
        """Run all steps, with the changes of an event, and with ego on a plan (None: ego drives like the others).

        A run resumes from the latest one where the two begin to differ.
        """
        run = _Run(self, staging or Staging(), ego)
        if self._latest is not None:
            run.resume(self._latest)
        self._latest = run
        return run.finish()


def first_effect(staging: Staging) -> int | None:
    """First step at which traffic with a staging can differ from traffic without (None: at no step)."""
    extras = staging.extras
    if staging.tailgates or staging.removed or any(user.is_static for user in extras):
        return 0
    steps = [override.first_step for override in staging.overrides]
    return min([*steps, *(int(user.valid.argmax()) for user in extras)], default=None)


_Tables = TypeVar("_Tables", PathTables, StaticObstacles, RightOfWay)


def _copy_tables(tables: _Tables) -> _Tables:
    """Copy an object with its arrays and lists."""
    result = copy.copy(tables)
    for name, value in vars(tables).items():
        setattr(result, name, copy.copy(value) if isinstance(value, np.ndarray | list) else value)
    return result


def _copy_state(state: dict[str, Any]) -> dict[str, Any]:
    """Copy the attributes of a run that change."""
    result = {name: copy.copy(state[name]) for name in _STATE}
    result["_right_of_way"] = _copy_tables(result["_right_of_way"])
    return result


@dataclass(frozen=True)
class _Checkpoint:
    """State of a run before a step, the present path of each vehicle, and the columns of crossings."""

    step: int
    state: dict[str, Any]
    paths: list[Path]
    crossings: int


class _Run:
    """State of one run."""

    def __init__(self, traffic: Traffic, staging: Staging, ego: EgoPlan | None) -> None:
        self._fixed, self._staging, self._ego = traffic, staging, ego
        roles = traffic.roles
        self._network, self._drivers = roles.network, roles.drivers
        for tailgate in staging.tailgates:
            self._drivers = self._drivers.with_headway(tailgate.vehicle, tailgate.headway_s)
        self._half_m, self._width_m = roles.drivers.size_m[:, 0] / 2, roles.drivers.size_m[:, 1]
        count = len(roles.paths)
        self._rows = np.arange(count)
        self._idm = self._drivers.idm()
        self._tables, self._owns_tables = traffic.tables, False
        self._checkpoints: list[_Checkpoint] = []
        static = tuple(user for user in staging.extras if user.is_static)
        self._movers = tuple(user for user in staging.extras if not user.is_static)
        boxes = traffic.parked.concatenate(boxes_at(static, 0))
        self._standing = StaticObstacles(boxes, self._tables, self._width_m) if static else traffic.standing
        self._right_of_way = copy.copy(traffic.right_of_way)
        self._right_of_way.reset()
        self._changes = LaneChanges(self._network, roles.drivers, boxes)
        self._pedestrians = (
            Pedestrians(self._network, roles.pedestrians, traffic.times_s) if roles.pedestrians else None
        )
        self._occupied_crossings = np.zeros(len(self._network.crossings), bool)
        self._halting = np.zeros((0, 0), bool)  # per vehicle and crossing on its path
        self._delay = np.rint(roles.drivers.reaction_s / DT_S).astype(int).clip(0, _SLOWEST)
        self._at, self._speed = roles.distance_m.copy(), roles.speed_mps.copy()
        for row in staging.removed:
            self._at[row] = roles.paths[row].length_m
        self._last = np.zeros(count)
        self._memory = np.zeros((_SLOWEST + 1, count))
        self._busy_m = np.full(count, -np.inf)  # path position at which a lane change or detour ends
        self._rest = np.zeros(count, int)  # first step of the next decision
        self._helped = NO_HELP
        self._leaders = Leaders(self._network, self._drivers)
        # Gap to and speed of the next leader, line and obstacle.
        self._gaps, self._leads = np.full((3, count), np.inf), np.zeros((3, count))
        self._plan_at = positions_along(self._tables.paths[0], ego.xy) if ego is not None else np.zeros(0)
        self._moving_users = self._vehicles = _NO_BOXES
        shape = (count, len(traffic.times_s))
        speed, position, acceleration = np.zeros((3, *shape))
        pedestrian_poses = np.zeros((len(roles.pedestrians), shape[1], 4))
        self._log = _Log(
            np.zeros((*shape, 3)), speed, np.zeros(shape, bool), position, acceleration, pedestrian_poses
        )

    def resume(self, other: _Run) -> None:
        """Take over another run's state at its last checkpoint before this one differs from it."""
        steps = [run._ego.first_step for run in (self, other) if run._ego is not None]
        stagings = self._staging, other._staging
        if stagings[0] is not stagings[1]:
            steps += [step for step in map(first_effect, stagings) if step is not None]
        last = min([*steps, len(self._fixed.times_s) - 1])
        self._checkpoints = [checkpoint for checkpoint in other._checkpoints if checkpoint.step <= last]
        if self._checkpoints:
            checkpoint = self._checkpoints[-1]
            vars(self).update(_copy_state(checkpoint.state))
            for row, path in enumerate(checkpoint.paths):
                if path is not self._tables.paths[row]:
                    self._replace_path(row, path)
            self._tables.widen(checkpoint.crossings)
            for name, record in vars(self._log).items():
                record[:, : checkpoint.step] = vars(other._log)[name][:, : checkpoint.step]

    def finish(self) -> Motion:
        """Run all steps and collect the motion."""
        begin = self._checkpoints[-1].step if self._checkpoints else 0
        for t in range(begin, len(self._fixed.times_s)):
            if t % _CHECKPOINT_STEPS == 0 and t > begin:
                p = self._tables
                checkpoint = _Checkpoint(t, _copy_state(vars(self)), p.paths.copy(), p.crossing.shape[1])
                self._checkpoints.append(checkpoint)
            self._step(t)
        if self._ego is not None:
            first, log = self._ego.first_step, self._log
            log.acceleration[0, first:-1] = np.diff(log.speed[0, first:]) / DT_S
        return self._log.motion(self._fixed.roles, self._staging, self._tables.paths)

    def _step(self, t: int) -> None:
        """Record a step and advance all users to the next one."""
        log, k = self._log, self._plan_step(t)
        if self._ego is not None and k >= 0:
            self._at[0], self._speed[0] = self._plan_at[k], self._ego.speed[k]
        active = self._at + self._half_m < self._tables.length_m
        soon = self._at + self._speed * _SPEED_TIME_S
        sample = self._tables.at(np.concatenate((self._at, soon)).reshape(2, -1))
        pose, fastest, fastest_soon = sample[0, :, :3], sample[0, :, 3], sample[1, :, 3]
        if self._ego is not None and k >= 0:
            active[0] = True
            pose[0] = (*self._ego.xy[k], self._ego.heading[k])
        self._vehicles = Boxes(pose[:, :2], pose[:, 2], self._speed, self._drivers.size_m[:, :2])
        self._advance_pedestrians(t, active)
        log.pose[:, t], log.speed[:, t], log.at_m[:, t], log.valid[:, t] = pose, self._speed, self._at, active
        preferred = self._preferred_acceleration(t, fastest, fastest_soon, active)
        if t % _DECIDE_EVERY == 0:
            self._decide(t, preferred, fastest, active)
        log.acceleration[:, t] = self._advance(self._apply_reaction_times(t, preferred), active)

    def _plan_step(self, t: int) -> int:
        """Step of ego's plan (negative: ego is not planned)."""
        return -1 if self._ego is None else t - self._ego.first_step

    def _swap(self, t: int, row: int, path: Path, at: float, end_m: float) -> None:
        """Put a vehicle on another path, which it follows undisturbed up to a position."""
        self._replace_path(row, path)
        self._at[row] = at
        self._halting[row : row + 1] = False
        self._right_of_way.reset_vehicle(row, self._tables, at + self._half_m[row])
        self._busy_m[row], self._rest[row] = end_m, t + _REST_STEPS

    def _replace_path(self, row: int, path: Path) -> None:
        if not self._owns_tables:
            self._tables, self._standing = _copy_tables(self._tables), _copy_tables(self._standing)
            self._owns_tables = True
        self._tables.replace(row, path)
        self._standing.replace(row, path)

    def _advance_pedestrians(self, t: int, active: VehicleMask) -> None:
        """Advance the pedestrians and gather scripted users."""
        users, colour = _NO_BOXES, self._fixed.colour[t]
        if self._pedestrians is not None:
            users, self._occupied_crossings = self._pedestrians.step(t, self._vehicles, active, colour)
            log = self._log.pedestrian_poses[:, t]
            log[:, :2], log[:, 2], log[:, 3] = users.xy, users.heading, users.speed
        movers = tuple(user for user in self._movers if user.valid[t])
        self._moving_users = users.concatenate(boxes_at(movers, t)) if movers else users

    def _preferred_acceleration(
        self, t: int, fastest: PerVehicle, fastest_soon: PerVehicle, active: VehicleMask
    ) -> PerVehicle:
        """The least of the accelerations towards leaders, lines, obstacles and the preferred speed (now and soon)."""
        gaps, leads = self._gaps, self._leads
        gaps[0], leader = self._leaders.ahead(self._tables, self._at, active)
        leads[0] = self._speed[leader]
        # Lines and obstacles are updated in alternate steps, and extrapolated in between.
        if t % 2 or t == 0:
            gaps[1] = self._stops(t, active, leader)
        else:
            gaps[1] -= self._speed * DT_S
        if t % 2 == 0:
            gaps[2], leads[2] = nearest_obstacles(
                self._tables, self._vehicles, self._at, active, self._moving_users
            )
        else:
            gaps[2] += (leads[2] - self._speed) * DT_S
        # Only a planned ego reverses; the IDM treats it as standing.
        speed = np.maximum(self._speed, 0.0)
        accelerations = idm_acceleration(speed, fastest, gaps, np.maximum(leads, 0.0), self._idm)
        # Braking for a line is limited to a little more than it takes to stop there.
        to_stop = speed**2 / (2 * np.maximum(gaps[1] - (2.0 - _STOP_SHORT_M), 0.1))
        lines = np.maximum(accelerations[1], -_FIRMLY * to_stop - 0.5)
        preferred = np.minimum(np.minimum(accelerations[0], lines), accelerations[2])
        preferred = np.minimum(preferred, (fastest_soon - self._speed) / _SPEED_TIME_S)
        return self._open_gaps(preferred, fastest)

    def _open_gaps(self, preferred: PerVehicle, fastest: PerVehicle) -> PerVehicle:
        """Open gaps for mandatory lane changes on both lanes."""
        h = self._helped
        if len(h.behind):
            gap = h.gap_m + self._at[h.ahead] - self._at[h.behind]
            idm, speed = self._drivers.idm(h.behind), self._speed[h.behind]
            helpful = idm_acceleration(speed, fastest[h.behind], gap, self._speed[h.ahead], idm)
            # Vehicles that are already past need no gap, and slow ones open none.
            helpful = np.where((gap > -2.0) & (speed > 1.5), np.maximum(helpful, -HELP_MPS2), np.inf)
            np.minimum.at(preferred, h.behind, helpful)
        return preferred

    def _stops(self, t: int, active: VehicleMask, leader: VehicleRows) -> PerVehicle:
        """Gap to the next place to stop (line, crossing, obstacle, end of the lane), plus the IDM's gap of 2 m."""
        p, front = self._tables, self._at + self._half_m
        committed, k = -1, self._plan_step(t)
        if k >= 0:
            then = min(k + _FORESEEN, len(self._plan_at) - 1)
            committed = int(np.sum(p.connector_begin[0] < self._plan_at[then] + self._half_m[0]))
        state = TrafficState(
            tables=p,
            step=t,
            colour=self._fixed.colour[t],
            to_red=self._fixed.to_red[t],
            front_m=front,
            rear_m=self._at - self._half_m,
            speed=self._speed,
            active=active,
            room_m=self._gaps[0],
            leader=leader,
            leader_speed=self._leads[0],
            committed=committed,
        )
        room = self._right_of_way.lines(state) + 2.0 - _STOP_SHORT_M
        if np.count_nonzero(self._occupied_crossings):
            room = np.minimum(room, self._crossings(front) + 2.0 - _STOP_SHORT_M)
        room = np.minimum(room, p.stop_m - front - _END_M)
        if len(self._standing.boxes):
            room = np.minimum(room, self._standing.gap(front) + 2.0 - _KEEP_M)
        return room

    def _crossings(self, front: PerVehicle) -> PerVehicle:
        """Distance to the next occupied crossing at which a vehicle can stop."""
        away = self._tables.crossing_m - front[:, None]
        to_stop = self._speed[:, None] ** 2 / (2 * np.maximum(away, 0.05))
        halt = self._occupied_crossings[self._tables.crossing] & (self._tables.crossing >= 0) & (away > -0.5)
        if self._halting.shape != halt.shape:
            self._halting = np.zeros_like(halt)
        self._halting = halt & (to_stop < np.where(self._halting, _HARDEST_MPS2, _YIELD_MPS2))
        return np.where(self._halting, away, np.inf).min(axis=1)

    def _apply_reaction_times(self, t: int, preferred: PerVehicle) -> PerVehicle:
        """Return the accelerations preferred a reaction time ago, bounded by overrides."""
        depth = len(self._memory)
        if t == 0:
            self._memory[:] = preferred
        self._memory[t % depth] = preferred
        result = self._memory[(t - self._delay) % depth, self._rows]
        for override in self._staging.overrides:
            if override.first_step <= t <= override.last_step:
                result[override.vehicle] = min(result[override.vehicle], override.acceleration_mps2)
        return result

    def _advance(self, preferred: PerVehicle, active: VehicleMask) -> PerVehicle:
        """Advance by one step and return accelerations; speeds stay non-negative."""
        jerk = np.where(preferred < -_EMERGENCY_MPS2, _EMERGENCY_JERK, self._drivers.jerk_mps3) * DT_S
        a = np.clip(preferred, self._last - jerk, self._last + self._drivers.jerk_mps3 * DT_S)
        after = self._speed + a * DT_S
        stops = after <= 0.0
        # Vehicles that stop within the step travel v^2 / (2 |a|).
        distance = np.where(
            stops, self._speed**2 / (2 * np.maximum(-a, 1e-9)), (self._speed + after) * DT_S / 2
        )
        self._at = self._at + np.where(active, distance, 0.0)
        self._last = np.where(stops, 0.0, a)
        self._speed = np.where(active, np.maximum(after, 0.0), 0.0)
        return a

    def _decide(self, t: int, preferred: PerVehicle, fastest: PerVehicle, active: VehicleMask) -> None:
        """Start lane changes and detours."""
        calm = (self._at > self._busy_m) & (self._rest <= t) & active
        for override in self._staging.overrides:
            calm[override.vehicle] &= t < override.first_step
        free = calm.copy()
        free[0] = False
        state = Situation(self._at, self._speed, active, free, fastest, preferred)
        changes, self._helped = self._changes.decide(state, self._tables)
        for change in changes:
            self._change(t, change)
            calm[change.vehicle] = False
        calm[0] &= self._plan_step(t) < 0
        self._pass(t, calm)

    def _change(self, t: int, change: Change) -> None:
        """Start a lane change; beyond it the vehicle keeps to its old lanes where it can."""
        row, present = change.vehicle, self._tables.paths[change.vehicle]
        lanes = [change.lane]
        ahead = {span.lane for span in present.spans}
        while self._network.lanes[lanes[-1]].successors:
            after = next_lanes(self._network, lanes)
            on_path = [lane for lane in after if lane in ahead]
            # Elsewhere branches take turns: this draws no random number.
            lanes.append(on_path[0] if on_path else after[(row + len(lanes)) % len(after)])
        sway = Sway((0.08,), (0.07,), (float(row),))
        target = lane_path(self._network, tuple(lanes), sway)
        path, position = change_onto(target, present, self._at[row], change.length_m)
        self._swap(t, row, path, position, position + change.length_m)

    def _pass(self, t: int, calm: VehicleMask) -> None:
        """Start detours of vehicles near a standing obstacle."""
        stuck = np.zeros(len(self._rows), bool)
        for override in self._staging.overrides:
            state = override.first_step <= t <= override.last_step
            stuck[override.vehicle] |= state and self._speed[override.vehicle] < 0.05
        halts = np.abs(self._moving_users.speed) < 0.05
        big = halts & (self._moving_users.size_m[:, 0] > 1.2)
        any_halted = bool(stuck.any() or big.any())
        if not (any_halted or len(self._standing.boxes)):
            return
        if stuck.any() or halts.any():
            near = calm & (self._speed < 3.0)
        else:
            near = calm & (self._standing.gap(self._at + self._half_m) < 45.0)
        rows = np.flatnonzero(near & (self._speed < 9.0)).tolist()
        if not rows:
            return
        standing = self._standing.boxes.concatenate(self._vehicles.select(stuck))
        standing = standing.concatenate(self._moving_users.select(big))
        for row in rows:
            front, half = self._at[row] + self._half_m[row], self._width_m[row] / 2
            if any_halted or self._standing.meets(row, front, half + DETOUR_MARGIN_M, LOOK_M):
                self._start_detour(t, row, standing, stuck)

    def _start_detour(self, t: int, row: int, standing: Boxes, stuck: VehicleMask) -> None:
        """Start a detour around an obstacle ahead, if there is one."""
        others = self._vehicles.select((self._rows != row) & ~stuck & (self._at > 0.0))
        moving = others.concatenate(self._moving_users.select(np.abs(self._moving_users.speed) >= 0.05))
        position, size = float(self._at[row]), (float(2 * self._half_m[row]), float(self._width_m[row]))
        request = detour_request(self._network, self._tables, row, (position, self._speed[row]), size)
        detour = self._fixed.detours.find(request, standing, moving)
        if detour is not None:
            self._swap(t, row, detour[0], position, detour[1])
