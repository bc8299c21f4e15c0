"""Right of way at connectors: lights, signs, priority, and room to leave.

A driver requests a connector shortly before it would have to brake for its stop line. Until the rear bumper of a
vehicle has left the zone in which its connector conflicts with another one, the other one is granted only to drivers
that cannot stop any more. A closing light revokes a grant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int8, Int64

from drivax.geometry.vectors import wrap
from drivax.scenario.schema import DT_S, nonzero
from drivax.synthetic.roads.curves import resample
from drivax.synthetic.roads.network import CLEARANCE_M, Control, RoadNetwork, per_roads
from drivax.synthetic.roads.signals import Colour
from drivax.synthetic.traffic.path_arrays import PathTables, PerVehicle, VehicleMask, VehicleRows, Worlds
from drivax.synthetic.traffic.roles import Drivers

#: Braking with which a driver can still stop when it requests a connector, m/s2, and reserves of time (s) and
#: distance (m).
_REQUEST_MPS2, _REQUEST_S, _REQUEST_M = 2.0, 0.7, 3.5
#: Required braking below which drivers do not brake for blockers that clear in time, m/s2; blockers' top speed, m/s.
_WAITING_MPS2, _TURNING_MPS = 3.4, 7.0
#: Largest braking to stop at a line: for others, at red, and at yellow that turns red before the line is reached, m/s2.
_HARDEST_MPS2, _RED_MPS2, _LATE_YELLOW_MPS2 = 6.5, 8.0, 5.0
#: A vehicle has stopped at a sign below this speed, m/s, and within this distance of the line, m.
_STOPPED_MPS, _STOPPED_M = 0.2, 4.5
#: Gap to keep beyond a connector, m, and speed below which a leader beyond it blocks the exit, m/s.
_EXIT_GAP_M, _QUEUE_MPS = 1.5, 1.5
#: Least duration of a stop at a stop sign, s.
_PAUSE_S = 0.45
#: Vehicles that stop within this time of each other arrive simultaneously, s.
_TIE_S = 0.35
#: Lowest speed at which vehicles with priority are expected to approach, m/s.
_EXPECTED_MPS = 3.0
#: Waiting time after which drivers accept two thirds of their usual gap, s.
_IMPATIENT_S = 30.0
# Plain numbers, since lookups of enumeration members are slow.
_NONE, _STOP, _ALL_WAY_STOP = int(Control.NONE), int(Control.STOP), int(Control.ALL_WAY_STOP)
_RED, _YELLOW = int(Colour.RED), int(Colour.YELLOW)

#: Rows of the vehicles that request a connector.
_Requests = Int64[np.ndarray, " request"]
#: Row and connector of each vehicle that holds one.
_Holders = list[tuple[int, int]]


@dataclass(frozen=True)
class TrafficState:
    """State of all vehicles when drivers decide.

    Attributes:
        colour, to_red: Colour of each lane's light, and time until a yellow one turns red, s.
        front_m, rear_m: Positions of the front and rear bumpers along the vehicles' paths.
        room_m, leader, leader_speed: Gap to the vehicle ahead, its row and its speed.
        committed: Number of connectors that each planned vehicle (by row) enters without yielding.
    """

    tables: PathTables
    step: int
    colour: Int8[np.ndarray, " lane"]
    to_red: Float64[np.ndarray, " lane"]
    front_m: PerVehicle
    rear_m: PerVehicle
    speed: PerVehicle
    active: VehicleMask
    room_m: PerVehicle
    leader: VehicleRows
    leader_speed: PerVehicle
    committed: dict[int, int]


@per_roads
def conflict_zones(
    network: RoadNetwork,
) -> tuple[Float64[np.ndarray, "lane lane"], Float64[np.ndarray, "lane lane"]]:
    """Find the stretch of each connector that conflicts with each of the others: begin and end, m (nan: none).

    Connectors that leave the same lane do not conflict: vehicles on them follow each other.
    """
    count = len(network.lanes)
    begin, end = np.full((count, count), np.nan), np.full((count, count), np.nan)
    points = {i: resample(lane.curve, 1.0).xy for i, lane in enumerate(network.lanes) if lane.connector}
    box = {i: (xy.min(axis=0), xy.max(axis=0)) for i, xy in points.items()}
    for a, xy_a in points.items():
        origin = set(network.lanes[a].predecessors)
        for b, xy_b in points.items():
            if b <= a or origin & set(network.lanes[b].predecessors):
                continue
            if np.any(box[a][0] > box[b][1] + CLEARANCE_M) or np.any(box[b][0] > box[a][1] + CLEARANCE_M):
                continue
            dx, dy = (np.subtract.outer(xy_a[:, k], xy_b[:, k]) for k in (0, 1))
            is_near = dx * dx + dy * dy < CLEARANCE_M**2
            for i, j, hit in ((a, b, is_near.any(axis=1)), (b, a, is_near.any(axis=0))):
                if hit.any():
                    step = network.lanes[i].length_m / (hit.size - 1)
                    samples = np.flatnonzero(hit)
                    begin[i, j], end[i, j] = samples[0] * step, samples[-1] * step
    return begin, end


def time_to_cover(
    distance_m: Float64[np.ndarray, "*n"], speed: float, acceleration: float, top: float
) -> Float64[np.ndarray, "*n"]:
    """Return the time to cover distances at constant acceleration up to a top speed, s (0 for negative distances)."""
    distance = np.maximum(distance_m, 0.0)
    top = max(top, speed, 0.1)
    ramp = (top**2 - speed**2) / (2 * acceleration)
    early = (np.sqrt(speed**2 + 2 * acceleration * distance) - speed) / acceleration
    late = (top - speed) / acceleration + (distance - ramp) / top
    return np.where(distance < ramp, early, late)


@dataclass(frozen=True)
class _Request:
    """Request of a vehicle for a connector.

    Attributes:
        slot: Index of the connector among those of the path.
        line_m, distance_m: Path position of the stop line, and distance to it.
    """

    row: int
    connector: int
    slot: int
    line_m: float
    distance_m: float
    speed: float

    @property
    def required_mps2(self) -> float:
        """Deceleration required to stop at the line, m/s2."""
        return self.speed**2 / (2 * max(self.distance_m, 0.05))


class _Blocker(NamedTuple):
    """A vehicle in conflict with a request, and the distance until its rear bumper clears the conflict zone."""

    row: int
    connector: int
    clear_m: float


class Rules:
    """Rules and conflicts of the connectors of a network."""

    def __init__(self, network: RoadNetwork) -> None:
        self.zone_begin, self.zone_end = conflict_zones(network)
        self.conflict = ~np.isnan(self.zone_begin)
        self.rivals = [set(np.flatnonzero(conflict).tolist()) for conflict in self.conflict]
        self.control = [int(lane.control) for lane in network.lanes]
        # Conflicts of :attr:`RoadNetwork.conflicts` that the zones, sampled at other points, miss are left out.
        self.yields_to = [
            np.array([b for b in lane.yields_to if self.conflict[a, b]], int)
            for a, lane in enumerate(network.lanes)
        ]
        self.free = [not self.rivals[a] and self.control[a] < _STOP for a in range(len(network.lanes))]
        self.heading = [float(lane.curve.heading[0]) for lane in network.lanes]


_rules = per_roads(Rules)


class RightOfWay:
    """Grants of connectors to drivers."""

    def __init__(self, worlds: Worlds, drivers: Drivers) -> None:
        self._worlds, self._drivers = worlds, drivers
        self._rules = [_rules(network) for network in worlds.networks]
        self._length = drivers.size_m[:, 0]
        count = len(self._length)
        self._rows = np.arange(count)
        self._grants = np.zeros(count, int)  # number of connectors granted on the path
        self._stopped_at_s = np.full(count, np.inf)  # time of the stop at the requested connector, s
        self._connector = np.full(count, -1)  # of the last request
        self._is_denied = np.zeros(count, bool)

    def reset_vehicle(self, row: int, tables: PathTables, front_m: float) -> None:
        """Reset a vehicle that has changed to another path: it keeps only the connectors that it has entered."""
        self._grants[row] = int(np.sum(tables.connector_begin[row] < front_m))
        self._stopped_at_s[row], self._connector[row] = np.inf, -1

    def stop_line_m(self, state: TrafficState) -> PerVehicle:
        """Decide all requests and return the distance to the next line at which to stop (infinite: none)."""
        begin = state.tables.connector_begin
        connectors = begin.shape[1]
        entered_count = np.add.reduce(begin < state.front_m[:, None], axis=1, dtype=np.int64)
        self._grants = np.maximum(self._grants, entered_count)
        stop_m, closed_slot = self._closed_lines(state)
        self._grants = np.maximum(np.minimum(self._grants, closed_slot), entered_count)
        for row, count in state.committed.items():
            self._grants[row] = max(count, entered_count[row])
        request_m = state.speed**2 / (2 * _REQUEST_MPS2) + _REQUEST_S * state.speed + _REQUEST_M
        index = np.minimum(self._grants, connectors - 1)
        # Without a connector ahead the distance is infinite.
        distance = begin.ravel().take(index + connectors * self._rows) - state.front_m
        is_requesting = (distance >= 0) & (distance <= request_m) & state.active & (closed_slot > index)
        for row in state.committed:
            is_requesting[row], stop_m[row] = False, np.inf
        self._is_denied &= is_requesting
        rows = is_requesting.nonzero()[0]
        if len(rows):
            holders = self._holders(state)
            for world, requests in groupby(self._requests(state, rows, index), self._world):
                self._grant(state, world, list(requests), holders[world], stop_m)
        return stop_m

    def _world(self, request: _Request) -> int:
        return int(self._worlds.world[request.row])

    def _requests(self, state: TrafficState, rows: _Requests, slot: VehicleRows) -> list[_Request]:
        """Return the requests of some vehicles for the connectors in a slot of each path."""
        slot = slot[rows]
        connector = state.tables.connector[rows, slot] - self._worlds.first_lane[self._worlds.world[rows]]
        line = state.tables.connector_begin[rows, slot]
        columns = (rows, connector, slot, line, line - state.front_m[rows], state.speed[rows])
        return [_Request(*values) for values in zip(*(column.tolist() for column in columns), strict=True)]

    def _holders(self, state: TrafficState) -> list[_Holders]:
        """List the vehicles of each world that hold a connector."""
        tables = state.tables
        is_held = np.arange(tables.connector.shape[1]) < self._grants[:, None]
        is_held &= (tables.connector_end > state.rear_m[:, None]) & state.active[:, None]
        row, slot = nonzero(is_held & (tables.connector >= 0))
        world = self._worlds.world[row]
        connector = tables.connector[row, slot] - self._worlds.first_lane[world]
        result: list[_Holders] = [[] for _ in self._rules]
        holders = zip(row.tolist(), connector.tolist(), strict=True)
        for w, holder in zip(world.tolist(), holders, strict=True):
            result[w].append(holder)
        return result

    def _closed_lines(self, state: TrafficState) -> tuple[PerVehicle, VehicleRows]:
        """Return the distance to the nearest line closed by a light, and its slot (infinite, number of slots: none)."""
        begin, connector = state.tables.connector_begin, state.tables.connector
        count = connector.shape[1]
        if not np.count_nonzero(state.colour):
            return np.full(len(begin), np.inf), np.full(len(begin), count)
        distance = begin - state.front_m[:, None]
        distance[distance < 0.0] = np.inf
        speed = state.speed[:, None]
        to_stop = speed**2 / (2 * np.maximum(distance, 0.05))
        colour = state.colour.take(connector)
        is_late = distance > speed * state.to_red.take(connector)
        stops_at_yellow = to_stop <= self._drivers.yellow_mps2[:, None]
        stops_at_yellow |= is_late & (to_stop <= _LATE_YELLOW_MPS2)
        is_closed = ((colour == _YELLOW) & stops_at_yellow) | ((colour == _RED) & (to_stop <= _RED_MPS2))
        is_closed &= distance < np.inf
        first = is_closed.argmax(axis=1)
        flat = first + count * self._rows
        has_line = is_closed.ravel().take(flat)
        return np.where(has_line, distance.ravel().take(flat), np.inf), np.where(has_line, first, count)

    def _grant(
        self, state: TrafficState, world: int, requests: list[_Request], holders: _Holders, stop_m: PerVehicle
    ) -> None:
        """Grant or deny requests, nearest in time first, at all-way stops in the order of arrival.

        A denial enters the distance to the line in ``stop_m``. A request is postponed if its blockers clear in time.
        """
        rules = self._rules[world]
        for request in requests:
            i = request.row
            if self._connector[i] != request.connector:
                self._connector[i], self._stopped_at_s[i] = request.connector, np.inf
            has_stopped = request.speed < _STOPPED_MPS and request.distance_m < _STOPPED_M
            if has_stopped and self._stopped_at_s[i] == np.inf:
                self._stopped_at_s[i] = state.step * DT_S
        waiting: list[int] = []  # connectors of vehicles that stand at an all-way stop and must still wait
        for request in self._order(rules, requests):
            i, connector = request.row, request.connector
            cannot_stop = request.required_mps2 > _HARDEST_MPS2
            granted = rules.free[connector] or (cannot_stop and request.speed > 2.0)
            granted = granted or self._may_enter(state, rules, request, holders, waiting)
            if not granted and self._clears_in_time(state, rules, request, holders):
                continue
            self._is_denied[i] = not granted
            if granted:
                self._grants[i] = request.slot + 1
                self._stopped_at_s[i] = np.inf
                holders.append((i, connector))
            else:
                stop_m[i] = min(stop_m[i], request.distance_m)
                if rules.control[connector] == _ALL_WAY_STOP and self._stopped_at_s[i] < np.inf:
                    waiting.append(connector)

    def _order(self, rules: Rules, requests: list[_Request]) -> list[_Request]:
        """Sort requests into the order of decision."""
        stops = [
            (r, float(self._stopped_at_s[r.row]))
            for r in requests
            if rules.control[r.connector] == _ALL_WAY_STOP
        ]
        key = {request.row: request.distance_m / max(request.speed, 1.0) for request in requests}
        for request, stopped_s in stops:
            # Of vehicles that arrived simultaneously, the one with none to its right goes first.
            tied = (r.connector for r, other_s in stops if abs(other_s - stopped_s) < _TIE_S)
            angles = (wrap(rules.heading[c] - rules.heading[request.connector]) for c in tied)
            to_right = any(math.pi / 4 < angle < 3 * math.pi / 4 for angle in angles)
            key[request.row] = 1e3 + min(stopped_s, 1e6) + 0.5 * _TIE_S * to_right
        return sorted(requests, key=lambda request: (key[request.row], request.row))

    def _may_enter(
        self, state: TrafficState, rules: Rules, request: _Request, holders: _Holders, waiting: list[int]
    ) -> bool:
        """Return whether a vehicle may enter its connector.

        It has stopped where it must, its leader was not denied entry, no vehicle is in conflict with it, it has room to
        leave, and it need not yield.
        """
        i, connector, line_m = request.row, request.connector, request.line_m
        control = rules.control[connector]
        if control >= _STOP and state.step * DT_S - self._stopped_at_s[i] < _PAUSE_S:
            return False
        leader_rear_m = float(state.front_m[i] + state.room_m[i])
        if leader_rear_m < line_m and self._is_denied[state.leader[i]]:
            return False
        if not rules.rivals[connector].isdisjoint(waiting) or self._blockers(state, rules, request, holders):
            return False
        exit_m = state.tables.connector_end[i, request.slot]
        room_m = exit_m + self._length[i] + _EXIT_GAP_M
        is_exit_blocked = leader_rear_m < room_m and state.leader_speed[i] < _QUEUE_MPS
        # Behind a leader that is not yet in the junction, and at uncontrolled connectors, vehicles follow as elsewhere.
        if is_exit_blocked and leader_rear_m >= line_m - 1.0 and control != _NONE:
            return False
        return not len(rules.yields_to[connector]) or self._accepts_gap(state, rules, request)

    def _blockers(
        self, state: TrafficState, rules: Rules, request: _Request, holders: _Holders
    ) -> list[_Blocker]:
        """Return the vehicles on conflicting connectors that have not cleared the conflict zone."""
        result, tables = [], state.tables
        for j, other in holders:
            if other in rules.rivals[request.connector] and j != request.row:
                end_m = rules.zone_end[other, request.connector]
                clear_m = tables.begin[j, other] + tables.scale[j, other] * end_m
                if state.rear_m[j] < clear_m + 0.3:
                    result.append(_Blocker(j, other, float(clear_m - state.rear_m[j]) + 0.3))
        return result

    def _clears_in_time(
        self, state: TrafficState, rules: Rules, request: _Request, holders: _Holders
    ) -> bool:
        """Return whether a driver with priority over all blockers need not brake, since they clear in time."""
        connector = request.connector
        if rules.control[connector] >= _STOP or not request.required_mps2 < _WAITING_MPS2:
            return False
        blockers = self._blockers(state, rules, request, holders)
        priority_connectors = set(rules.yields_to[connector].tolist())
        if not blockers or any(blocker.connector in priority_connectors for blocker in blockers):
            return False
        for blocker in blockers:
            speed = float(state.speed[blocker.row])
            clear_s = time_to_cover(np.array([blocker.clear_m]), speed, 1.0, _TURNING_MPS)[0]
            to_zone = request.distance_m + rules.zone_begin[connector, blocker.connector]
            if speed < 0.5 or clear_s + 1.0 > to_zone / max(request.speed, 1.0):
                return False
        return True

    def _accepts_gap(self, state: TrafficState, rules: Rules, request: _Request) -> bool:
        """Return whether the gap to vehicles with priority is large enough."""
        i, connector, tables = request.row, request.connector, state.tables
        world = int(self._worlds.world[i])
        others, vehicles = rules.yields_to[connector], self._worlds.vehicles(world)
        begin, scale = tables.begin[vehicles][:, others], tables.scale[vehicles][:, others]
        reach = begin + scale * rules.zone_begin[others, connector] - state.front_m[vehicles, None]
        clear = begin + scale * rules.zone_end[others, connector] - state.rear_m[vehicles, None]
        is_coming = (clear > 0) & state.active[vehicles, None]
        is_coming[i - vehicles.start] = False
        # Vehicles at a red light or with a denied request are not coming.
        is_red = state.colour[self._worlds.first_lane[world] + others] == _RED
        is_waiting = is_red | (self._is_denied & (state.speed < 0.5))[vehicles, None]
        is_coming &= ~(is_waiting & (reach > 0))
        if not is_coming.any():
            return True
        rows, columns = np.nonzero(is_coming)
        speed, rivals = state.speed[vehicles][rows], others[columns]
        arrival_s = np.maximum(reach[rows, columns], 0.0) / np.maximum(speed, _EXPECTED_MPS)
        departure_s = clear[rows, columns] / np.maximum(speed, 0.3)
        top = float(tables.interpolate(np.array([request.line_m + 5.0]), slice(i, i + 1))[0, 3])
        own_speed, acceleration = request.speed, float(self._drivers.acceleration_mps2[i])
        to_zone = request.distance_m + rules.zone_begin[connector, rivals]
        through_zone = request.distance_m + rules.zone_end[connector, rivals] + self._length[i]
        enter_s = time_to_cover(to_zone, own_speed, acceleration, top)
        leave_s = time_to_cover(through_zone, own_speed, acceleration, top)
        wait_s = state.step * DT_S - self._stopped_at_s[i] if self._stopped_at_s[i] < np.inf else 0.0
        patience = 1.0 - min(wait_s / _IMPATIENT_S, 1.0) / 3.0
        least_gap_s = np.maximum(self._drivers.critical_gap_s[i] * patience, leave_s + 0.5)
        return not np.any((arrival_s < least_gap_s) & (departure_s > enter_s - 0.3))
