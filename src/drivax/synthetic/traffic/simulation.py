"""Traffic at 10 Hz: vehicles on paths follow, stop, give way, change lanes and avoid obstacles.

The law of following is the simulator's own (:mod:`drivax.simulator.idm`). All vehicles move at once: one step is a
few dozen array operations over vehicles, whatever their number. Who may enter a junction is decided in
:mod:`drivax.synthetic.traffic.right_of_way`, who changes lanes in :mod:`drivax.synthetic.traffic.lane_changes`,
obstacles in :mod:`drivax.synthetic.traffic.obstacles`.
"""

from __future__ import annotations

import copy

import numpy as np
from jaxtyping import Bool, Float64

from drivax.scenario.schema import DT_S, AgentKind
from drivax.simulator.idm import idm_acceleration
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.lane_changes import HELP_MPS2, Change, Helped, LaneChanges, Situation
from drivax.synthetic.traffic.lateral import (
    DETOUR_MARGIN_M,
    LOOK_M,
    Detours,
    change_onto,
    detour_request,
    followed,
)
from drivax.synthetic.traffic.obstacles import Boxes, Standing, nearest_obstacles
from drivax.synthetic.traffic.path_arrays import PathTables, PerVehicle, VehicleMask, VehicleRows
from drivax.synthetic.traffic.paths import SLOTS, Path, Sway, lane_path, onward
from drivax.synthetic.traffic.pedestrians import Walkers
from drivax.synthetic.traffic.right_of_way import RightOfWay, TrafficState
from drivax.synthetic.traffic.roles import Drivers, EgoPlan, Motion, Roles, Scripted, Staging


def boxes_at(scripted: tuple[Scripted, ...], step: int) -> Boxes:
    """Where scripted users are at a step."""
    if not scripted:
        return Boxes(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 2)))
    return Boxes(
        np.array([s.xy[step] for s in scripted]),
        np.array([s.heading[step] for s in scripted]),
        np.array([s.speed[step] for s in scripted]),
        np.array([s.size_m[:2] for s in scripted]),
    )


def standing_and_moving(extras: tuple[Scripted, ...]) -> tuple[tuple[Scripted, ...], tuple[Scripted, ...]]:
    """Split scripted users into static and moving ones."""
    fixed = [bool(e.valid.all() and not e.speed.any() and not np.ptp(e.xy, axis=0).any()) for e in extras]
    return (
        tuple(e for e, still in zip(extras, fixed, strict=True) if still),
        tuple(e for e, still in zip(extras, fixed, strict=True) if not still),
    )


def collect_motion(
    roles: Roles,
    staging: Staging,
    vehicles: tuple[
        Float64[np.ndarray, "v time 3"],
        Float64[np.ndarray, "v time"],
        Bool[np.ndarray, "v time"],
        Float64[np.ndarray, "v time"],
        Float64[np.ndarray, "v time"],
    ],
    walked: Float64[np.ndarray, "walker time 4"],
    paths: list[Path],
) -> Motion:
    """The motion of all users of a scenario, in their order.

    Args:
        roles: Who there is.
        staging: Whose extras are there too.
        vehicles: Their poses (x, y, heading), speeds, presence, path positions and accelerations.
        walked: x, y, heading and speed of the walkers.
        paths: The vehicles' paths.
    """
    pose, speed, valid, at, acceleration = vehicles
    steps = pose.shape[1]
    scripted = (*roles.parked, *staging.extras)
    kinds = [AgentKind.PEDESTRIAN] * len(roles.walkers) + [s.kind for s in scripted]
    sizes = [w.size_m for w in roles.walkers] + [s.size_m for s in scripted]
    there = np.ones(walked.shape[:2], bool)
    return Motion(
        kind=np.concatenate([roles.drivers.kind, np.array(kinds, np.int8)]),
        size_m=np.concatenate([roles.drivers.size_m, np.array(sizes, float).reshape(-1, 3)]),
        xy=np.concatenate([pose[..., :2], walked[..., :2], *(s.xy[None, :steps] for s in scripted)]),
        heading=np.concatenate([pose[..., 2], walked[..., 2], *(s.heading[None, :steps] for s in scripted)]),
        speed=np.concatenate([speed, walked[..., 3], *(s.speed[None, :steps] for s in scripted)]),
        valid=np.concatenate([valid, there, *(s.valid[None, :steps] for s in scripted)]),
        distance_m=at,
        acceleration=acceleration,
        paths=paths,
    )


#: What a cyclist at a lane's side needs of half its width: half a bicycle, its place, and 1.5 m to a car.
_PASS_CYCLIST_M = 0.35 + 0.55 + 1.5


class Leaders:
    """Finds the leader of every vehicle.

    Args:
        network: The roads.
        drivers: Who drives.
    """

    def __init__(self, network: RoadNetwork, drivers: Drivers) -> None:
        self._half_m, width_m = drivers.size_m[:, 0] / 2, drivers.size_m[:, 1]
        self._rows = np.arange(len(width_m))
        self._cyclist, self._any_cyclist = drivers.cyclist, bool(drivers.cyclist.any())
        # Half the widest car that passes a cyclist at the side of a lane.
        spare_m = np.array([lane.width_m for lane in network.lanes]) / 2 - _PASS_CYCLIST_M
        self._passes = spare_m >= width_m[:, None] / 2
        self._nearest = np.full(len(width_m), np.inf), np.zeros(len(width_m), int)

    def ahead(
        self, tables: PathTables, at_m: PerVehicle, active: VehicleMask
    ) -> tuple[PerVehicle, VehicleRows]:
        """Gap to the nearest vehicle ahead on the own lanes (infinite: none), and that vehicle.

        Args:
            tables: All paths.
            at_m: Where they are on them.
            active: Which of them are there.
        """
        own = at_m[:, None]
        lane, along = tables.on(at_m, self._rows)
        lane[~active] = -1
        # position[i, k]: where the k-th occupied (vehicle, lane) is on the path of vehicle i.
        used = (lane.ravel() >= 0).nonzero()[0]
        if not len(used):
            return self._nearest
        vehicles_ahead, taken = used // SLOTS, lane.ravel().take(used)
        # nan where the lane is not on the path, or does not matter now: comparisons with it are false.
        begin = np.where((tables.since <= own) & (own <= tables.until), tables.begin, np.nan)
        position = tables.scale.take(taken, axis=1)
        position *= along.ravel().take(used)
        position = begin.take(taken, axis=1) + position
        seen = position > own
        seen &= vehicles_ahead != self._rows[:, None]
        if self._any_cyclist:
            # Cyclists are overtaken within the lane where it is wide enough.
            seen &= ~(self._cyclist[vehicles_ahead] & self._passes.take(taken, axis=1))
        position -= self._half_m[vehicles_ahead]
        gap = np.where(seen, position, np.inf) - own - self._half_m[:, None]
        nearest = gap.argmin(axis=1)
        self._nearest = gap[self._rows, nearest], vehicles_ahead[nearest]
        return self._nearest


#: Where drivers want to come to rest before a stop line, m from the front bumper.
_STOP_SHORT_M = 1.0
#: Before a thing that stands in the lane they keep room to pass it, m; before a lane's end, to change.
_KEEP_M, _END_M = 5.0, 10.0
#: A driver follows the speed profile with this reaction, s.
_SPEED_TIME_S = 0.6
#: Jerk beyond a driver's own is used when braking harder than this, m/s2.
_EMERGENCY_MPS2, _EMERGENCY_JERK = 3.6, 25.0
#: Steps between decisions about lane changes and detours.
_DECIDE_EVERY = 5
#: A driver stays in its lane for this long after a change, s.
_REST_S = 4.0
#: Drivers stop for people where this is enough when they come, m/s2, and once they do brake up to this.
_YIELD_MPS2, _HARDEST_MPS2 = 3.0, 8.0
#: Braking for lines, as a multiple of what is needed.
_FIRMLY = 1.3
#: Longest reaction, steps.
_SLOWEST = 6
#: A planned ego is expected at stop lines this far ahead of time, steps.
_FORESEEN = 25
_NO_BOXES = boxes_at((), 0)


class Traffic:
    """Traffic of all users, advanced step by step.

    Args:
        roles: All users.
        times_s: Times of all steps to come, on the clock of the signals.
    """

    def __init__(self, roles: Roles, times_s: Float64[np.ndarray, " time"]) -> None:
        self.roles, self.times_s = roles, times_s
        self.tables = PathTables(roles.network, roles.paths, roles.drivers)
        self.parked = boxes_at(roles.parked, 0)
        self.standing = Standing(self.parked, self.tables, roles.drivers.size_m[:, 1])
        self.right_of_way = RightOfWay(roles.network, roles.drivers)
        self.detours = Detours(roles.network)
        shape = (len(times_s), len(roles.network.lanes))
        self.colour, self.to_red = np.zeros(shape, np.int8), np.zeros(shape)
        if roles.network.signals is not None:
            self.colour, self.to_red = roles.network.signals.colours(times_s, shape[1])

    def until(self, steps: int) -> Traffic:
        """Return the traffic with fewer steps."""
        shorter = copy.copy(self)
        shorter.times_s = self.times_s[:steps]
        return shorter

    def run(self, staging: Staging | None = None, ego: EgoPlan | None = None) -> Motion:
        """Run all steps.

        Args:
            staging: What an event changes.
            ego: Ego's plan from a step on; None: ego drives like the others.
        """
        return _Run(self, staging or Staging(), ego).finished()


class _Run:
    """One run of a traffic."""

    def __init__(self, traffic: Traffic, staging: Staging, ego: EgoPlan | None) -> None:
        self._fixed, self._staging, self._ego = traffic, staging, ego
        roles = traffic.roles
        self._network, self._drivers = roles.network, roles.drivers
        for override in staging.tailgates:
            self._drivers = self._drivers.with_headway(override.vehicle, override.headway_s)
        self._size_m = roles.drivers.size_m[:, :2]
        self._half_m, self._width_m = self._size_m[:, 0] / 2, self._size_m[:, 1]
        count = len(roles.paths)
        self._rows = np.arange(count)
        self._twice = np.concatenate([self._rows, self._rows])
        self._idm = self._drivers.idm
        self._tables = traffic.tables.copy()
        self._fixtures, self._movers = standing_and_moving(staging.extras)
        boxes = traffic.parked.joined(boxes_at(self._fixtures, 0))
        self._standing = traffic.standing.copy()
        if self._fixtures:
            self._standing = Standing(boxes, self._tables, self._width_m)
        self._right_of_way = traffic.right_of_way
        self._right_of_way.reset()
        self._changes = LaneChanges(self._network, roles.drivers, boxes)
        self._walkers = Walkers(self._network, roles.walkers, traffic.times_s) if roles.walkers else None
        self._occupied_crossings = np.zeros(len(self._network.crossings), bool)
        self._halting = np.zeros((0, 0), bool)  # [vehicle, crossing on its path]: stops for walkers
        self._delay = np.rint(roles.drivers.reaction_s / DT_S).astype(int).clip(0, _SLOWEST)
        self._at, self._speed = roles.distance_m.copy(), roles.speed_mps.copy()
        for row in staging.removed:  # it has left before anything begins
            self._at[row] = roles.paths[row].length_m
        self._last = np.zeros(count)
        self._memory = np.zeros((_SLOWEST + 1, count))
        self._busy_m = np.full(count, -np.inf)  # until here on its path a vehicle is changing or passing
        self._rest = np.zeros(count, int)  # from this step on it may change again
        self._helped = Helped(np.zeros(0, int), np.zeros(0, int), np.zeros(0))
        self._leaders = Leaders(self._network, self._drivers)
        # Of leaders, lines and things: the gaps to them, and how fast they are.
        self._gaps, self._leads = np.full((3, count), np.inf), np.zeros((3, count))
        self._plan_at = followed(self._tables.paths[0], ego.xy) if ego is not None else np.zeros(0)
        self._people = self._vehicles = _NO_BOXES

    def finished(self) -> Motion:
        """Run all steps and collect the motion."""
        count, steps = len(self._rows), len(self._fixed.times_s)
        pose, walked = np.zeros((count, steps, 3)), np.zeros((len(self._fixed.roles.walkers), steps, 4))
        speed, at, acceleration = (np.zeros((count, steps)) for _ in range(3))
        valid = np.zeros((count, steps), bool)
        for t in range(steps):
            planned = self._put_ego(t)
            active = self._at + self._half_m < self._tables.last * self._tables.step_m
            active[0] |= planned
            soon = self._at + self._speed * _SPEED_TIME_S
            row = self._tables.at(np.concatenate([self._at, soon]), self._twice)
            here, fastest = row[:count, :3], row[:count, 3]
            if planned and self._ego is not None:
                k = t - self._ego.first_step
                here[0] = (*self._ego.xy[k], self._ego.heading[k])
            self._vehicles = Boxes(here[:, :2], here[:, 2], self._speed, self._size_m)
            self._walk(t, active, walked)
            pose[:, t], speed[:, t], at[:, t], valid[:, t] = here, self._speed, self._at, active
            preferred = self._preferred_acceleration(t, fastest, row[count:, 3], active)
            if t % _DECIDE_EVERY == 0:
                self._decide(t, preferred, fastest, active)
            acceleration[:, t] = self._advance(self._acted(t, preferred), active)
        if self._ego is not None:
            k = slice(self._ego.first_step, steps - 1)
            acceleration[0, k] = np.diff(speed[0, self._ego.first_step :]) / DT_S
        vehicles = (pose, speed, valid, at, acceleration)
        return collect_motion(self._fixed.roles, self._staging, vehicles, walked, self._tables.paths)

    def _swap(self, row: int, path: Path, at: float) -> None:
        self._tables.replace(row, path)
        self._standing.replace(row, path)
        self._at[row] = at
        self._halting[row : row + 1] = False
        self._right_of_way.swapped(row, self._tables, at + self._half_m[row])

    def _put_ego(self, t: int) -> bool:
        """Put ego where its plan says; whether there is a plan for this step."""
        if self._ego is None or t < self._ego.first_step:
            return False
        k = t - self._ego.first_step
        self._at[0], self._speed[0] = self._plan_at[k], self._ego.speed[k]
        return True

    def _walk(self, t: int, active: VehicleMask, walked: Float64[np.ndarray, "walker time 4"]) -> None:
        """Advance the walkers and gather scripted users."""
        self._people = _NO_BOXES
        if self._walkers is not None:
            people, self._occupied_crossings = self._walkers.step(
                t, self._vehicles, active, self._fixed.colour[t]
            )
            walked[:, t, :2], walked[:, t, 2], walked[:, t, 3] = people.xy, people.heading, people.speed
            self._people = people
        there = tuple(extra for extra in self._movers if extra.valid[t])
        if there:
            self._people = self._people.joined(boxes_at(there, t))

    def _preferred_acceleration(
        self, t: int, fastest: PerVehicle, ahead: PerVehicle, active: VehicleMask
    ) -> PerVehicle:
        """The acceleration that each driver would like: the least that leaders, lines, things and speed allow.

        The fastest speed that each driver likes is given for here, and for where it will be a little later.
        """
        gaps, leads = self._gaps, self._leads
        gaps[0], leader = self._leaders.ahead(self._tables, self._at, active)
        leads[0] = self._speed[leader]
        # Lines and things are looked at by turns; in between they come nearer as they did.
        if t % 2 or t == 0:
            gaps[1] = self._stops(t, active, leader)
        else:
            gaps[1] -= self._speed * DT_S
        if t % 2 == 0:
            gaps[2], leads[2] = nearest_obstacles(
                self._tables, self._vehicles, self._at, active, self._people
            )
        else:
            gaps[2] += (leads[2] - self._speed) * DT_S
        # Only a planned ego reverses; the IDM treats it as standing.
        speed = np.maximum(self._speed, 0.0)
        following = idm_acceleration(speed, fastest, gaps, np.maximum(leads, 0.0), self._idm)
        # What stands still is not braked for harder than it takes to stop there, and a little more.
        needed = speed**2 / (2 * np.maximum(gaps[1] - (2.0 - _STOP_SHORT_M), 0.1))
        lines = np.maximum(following[1], -_FIRMLY * needed - 0.5)
        preferred = np.minimum(np.minimum(following[0], lines), following[2])
        preferred = np.minimum(preferred, (ahead - self._speed) / _SPEED_TIME_S)
        return self._helping(preferred, fastest)

    def _helping(self, preferred: PerVehicle, fastest: PerVehicle) -> PerVehicle:
        """Open gaps for mandatory lane changes on both lanes."""
        h = self._helped
        if len(h.behind):
            gap = h.gap_m + self._at[h.ahead] - self._at[h.behind]
            idm = self._drivers.chosen(h.behind).idm
            speed = self._speed[h.behind]
            helpful = idm_acceleration(speed, fastest[h.behind], gap, self._speed[h.ahead], idm)
            # Vehicles already past need no room, and a standstill does not help.
            helpful = np.where((gap > -2.0) & (speed > 1.5), np.maximum(helpful, -HELP_MPS2), np.inf)
            np.minimum.at(preferred, h.behind, helpful)
        return preferred

    def _stops(self, t: int, active: VehicleMask, leader: VehicleRows) -> PerVehicle:
        """Room as the law counts it (2 m are kept) to where to stop: lines, crossings, things, the lane's end."""
        p, front = self._tables, self._at + self._half_m
        committed = -1
        if self._ego is not None and t >= self._ego.first_step:
            then = min(t - self._ego.first_step + _FORESEEN, len(self._plan_at) - 1)
            committed = int(np.sum(p.connector_begin[0] < self._plan_at[then] + self._half_m[0]))
        now = TrafficState(
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
        # Drivers stop closer to a line than to a bumper.
        room = self._right_of_way.lines(now) + 2.0 - _STOP_SHORT_M
        if np.count_nonzero(self._occupied_crossings):
            room = np.minimum(room, self._crossings(front) + 2.0 - _STOP_SHORT_M)
        room = np.minimum(room, p.stop_m - front - _END_M)
        if len(self._standing.boxes):
            room = np.minimum(room, self._standing.gap(front) + 2.0 - _KEEP_M)
        return room

    def _crossings(self, front: PerVehicle) -> PerVehicle:
        """Distance to the next occupied crossing at which a vehicle can stop comfortably."""
        away = self._tables.crossing_m - front[:, None]
        needed = self._speed[:, None] ** 2 / (2 * np.maximum(away, 0.05))
        halt = self._occupied_crossings[self._tables.crossing] & (self._tables.crossing >= 0) & (away > -0.5)
        if self._halting.shape != halt.shape:
            self._halting = np.zeros_like(halt)
        self._halting = halt & (needed < np.where(self._halting, _HARDEST_MPS2, _YIELD_MPS2))
        return np.where(self._halting, away, np.inf).min(axis=1)

    def _acted(self, t: int, preferred: PerVehicle) -> PerVehicle:
        """Return applied accelerations: the preferred ones a reaction time ago, bounded by overrides."""
        depth = len(self._memory)
        if t == 0:
            self._memory[:] = preferred
        self._memory[t % depth] = preferred
        result = self._memory[(t - self._delay) % depth, self._rows]
        for override in self._staging.overrides:
            if override.first_step <= t <= override.last_step:
                vehicles_ahead = override.vehicle
                result[vehicles_ahead] = min(result[vehicles_ahead], override.acceleration_mps2)
        return result

    def _advance(self, preferred: PerVehicle, active: VehicleMask) -> PerVehicle:
        """Advance by one step and return accelerations; speeds stay non-negative."""
        jerk = np.where(preferred < -_EMERGENCY_MPS2, _EMERGENCY_JERK, self._drivers.jerk_mps3) * DT_S
        a = np.clip(preferred, self._last - jerk, self._last + self._drivers.jerk_mps3 * DT_S)
        after = self._speed + a * DT_S
        halted = after <= 0.0
        # Who stops inside the step travels v^2 / (2 |a|), and stands.
        travelled = np.where(
            halted, self._speed**2 / (2 * np.maximum(-a, 1e-9)), (self._speed + after) * DT_S / 2
        )
        self._at = self._at + np.where(active, travelled, 0.0)
        self._last = np.where(halted, 0.0, a)
        self._speed = np.where(active, np.maximum(after, 0.0), 0.0)
        return a

    def _decide(self, t: int, preferred: PerVehicle, fastest: PerVehicle, active: VehicleMask) -> None:
        """Start lane changes and detours."""
        calm = (self._at > self._busy_m) & (self._rest <= t) & active
        calm &= ~self._staged(t)
        free = calm.copy()
        free[0] = False
        now = Situation(self._at, self._speed, active, free, fastest, preferred)
        changes, self._helped = self._changes.decide(now, self._tables)
        for change in changes:
            self._change(t, change)
            calm[change.vehicle] = False
        if self._ego is not None and t >= self._ego.first_step:
            calm[0] = False
        self._pass(t, calm)

    def _staged(self, t: int) -> VehicleMask:
        """Mask of vehicles under an override."""
        result = np.zeros(len(self._rows), bool)
        for override in self._staging.overrides:
            result[override.vehicle] |= t >= override.first_step
        return result

    def _change(self, t: int, change: Change) -> None:
        row, present = change.vehicle, self._tables.paths[change.vehicle]
        lanes = [change.lane]
        ahead = {span.lane for span in present.spans}
        while self._network.lanes[lanes[-1]].successors:
            after = onward(self._network, lanes)
            on_present_path = [k for k in after if k in ahead]
            # The old way where it is open, else one of the ways by turns: no chance is needed here.
            lanes.append(on_present_path[0] if on_present_path else after[(row + len(lanes)) % len(after)])
        sway = Sway((0.08,), (0.07,), (float(row),))
        path, at = change_onto(
            lane_path(self._network, tuple(lanes), sway), present, self._at[row], change.length_m
        )
        self._swap(row, path, at)
        self._busy_m[row], self._rest[row] = at + change.length_m, t + round(_REST_S / DT_S)

    def _pass(self, t: int, calm: VehicleMask) -> None:
        """Start detours of vehicles near a standing obstacle."""
        halted = self._people.chosen(np.abs(self._people.speed) < 0.05)
        stuck = np.zeros(len(self._rows), bool)
        for override in self._staging.overrides:
            stuck[override.vehicle] |= (
                override.first_step <= t <= override.last_step and self._speed[override.vehicle] < 0.05
            )
        any_halted = bool(stuck.any())
        standing = self._standing.boxes
        if any_halted or len(halted):
            near = calm & (self._speed < 3.0)
            big = halted.chosen(halted.size_m[:, 0] > 1.2)
            any_halted |= len(big) > 0
            standing = standing.joined(self._vehicles.chosen(stuck)).joined(big)
        else:
            near = calm & (self._standing.gap(self._at + self._half_m) < 45.0)
        if not len(standing):
            return
        for row in np.flatnonzero(near & (self._speed < 9.0)).tolist():
            front, half = self._at[row] + self._half_m[row], self._width_m[row] / 2
            if any_halted or self._standing.meets(row, front, half + DETOUR_MARGIN_M, LOOK_M):
                self._pass_by(t, row, standing, stuck)

    def _pass_by(self, t: int, row: int, standing: Boxes, stuck: VehicleMask) -> None:
        """Start a detour around an obstacle ahead, if there is one."""
        others = self._vehicles.chosen((self._rows != row) & ~stuck & (self._at > 0.0))
        moving = others.joined(self._people.chosen(np.abs(self._people.speed) >= 0.05))
        size = (float(2 * self._half_m[row]), float(self._width_m[row]))
        vehicles_ahead = detour_request(
            self._network, self._tables, row, (self._at[row], self._speed[row]), size
        )
        detour = self._fixed.detours.find(vehicles_ahead, standing, moving)
        if detour is not None:
            path, end = detour
            self._swap(row, path, float(self._at[row]))
            self._busy_m[row], self._rest[row] = end, t + round(_REST_S / DT_S)
