"""Right of way at connectors: lights, signs, priority, and room to leave.

A driver asks for a connector when it comes so near that it would have to begin to brake for its line. Once granted,
the connector is held until the tail has left what others need of it; conflicting connectors are not granted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int8, Int64

from drivax.geometry.vectors import wrap
from drivax.scenario.schema import DT_S
from drivax.synthetic.roads.curves import resample
from drivax.synthetic.roads.network import CLEARANCE_M, Control, RoadNetwork
from drivax.synthetic.roads.signals import Colour
from drivax.synthetic.traffic.path_arrays import PathTables, PerVehicle, VehicleMask, VehicleRows
from drivax.synthetic.traffic.roles import Drivers

#: A driver asks for the way when it would brake this gently for the line, m/s2, with this much time and room to spare.
_ASK_MPS2, _ASK_S, _ASK_M = 2.0, 0.7, 3.5
#: A driver that expects a blocker to clear in time brakes at this deceleration at the latest, m/s2; turning speed.
_LATEST_MPS2, _TURNING_MPS = 3.4, 7.0
#: A driver that would have to brake harder than this does not stop for others, m/s2.
_HARDEST_MPS2 = 6.5
#: Standing at a stop sign: slower than this, and nearer to the line.
_STANDS_MPS, _STANDS_M = 0.2, 4.5
#: How long drivers look before they leave a stop sign, s.
_PAUSE_S = 0.45
#: Who stood within this time of each other arrived together, s.
_TIE_S = 0.35
#: Slowest speed with which others with priority are expected to come, m/s.
_EXPECTED_MPS = 3.0
#: Waiting this long makes drivers accept two thirds of their usual gap, s.
_IMPATIENT_S = 30.0
# Plain numbers: members of enumerations are looked up slowly.
_NONE, _STOP, _ALL_WAY_STOP = int(Control.NONE), int(Control.STOP), int(Control.ALL_WAY_STOP)
_RED, _YELLOW = int(Colour.RED), int(Colour.YELLOW)


@dataclass(frozen=True)
class TrafficState:
    """State of all vehicles when drivers decide.

    Attributes:
        step, colour, to_red: The step, and what each lane's light shows and how long until it turns red, s.
        front_m, rear_m: Positions of both bumpers on the own paths.
        room_m, leader, leader_speed: Gap to the vehicle ahead, its row and its speed.
        promised: Number of connectors on the path that a vehicle will enter whatever others do (-1: it asks).
        promises: Whether any vehicle has promised.
    """

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
    promised: VehicleRows
    promises: bool


def conflict_zones(
    network: RoadNetwork,
) -> tuple[Float64[np.ndarray, "lane lane"], Float64[np.ndarray, "lane lane"]]:
    """From where to where along each connector the space is needed by each other one, m (nan: nowhere).

    Connectors that leave the same lane do not conflict: there the one behind follows.
    """
    count = len(network.lanes)
    begin, end = np.full((count, count), np.nan), np.full((count, count), np.nan)
    points = {i: resample(lane.curve, 1.0).xy for i, lane in enumerate(network.lanes) if lane.connector}
    box = {i: (xy.min(axis=0), xy.max(axis=0)) for i, xy in points.items()}
    for a, xy_a in points.items():
        origin = set(network.lanes[a].predecessors)
        for b, other in points.items():
            if b <= a or origin & set(network.lanes[b].predecessors):
                continue
            if np.any(box[a][0] > box[b][1] + CLEARANCE_M) or np.any(box[b][0] > box[a][1] + CLEARANCE_M):
                continue
            near = np.sum((xy_a[:, None] - other) ** 2, axis=-1) < CLEARANCE_M**2
            for i, j, hit in ((a, b, near.any(axis=1)), (b, a, near.any(axis=0))):
                if hit.any():
                    step = network.lanes[i].length_m / (len(hit) - 1)
                    places = np.flatnonzero(hit)
                    begin[i, j], end[i, j] = places[0] * step, places[-1] * step
    return begin, end


def time_to_cover(
    distance_m: Float64[np.ndarray, "*n"], speed: float, acceleration: float, top: float
) -> Float64[np.ndarray, "*n"]:
    """Time to cover distances when speeding up evenly to a top speed, s (0 for distances below zero)."""
    distance = np.maximum(distance_m, 0.0)
    top = max(top, speed, 0.1)
    ramp = (top**2 - speed**2) / (2 * acceleration)
    early = (np.sqrt(speed**2 + 2 * acceleration * distance) - speed) / acceleration
    late = (top - speed) / acceleration + (distance - ramp) / top
    return np.where(distance < ramp, early, late)


def _number(mask: Bool[np.ndarray, "v k"]) -> VehicleRows:
    """How many of each row are true."""
    return np.add.reduce(mask, axis=1, dtype=np.int64)


class RightOfWay:
    """Grants connectors to drivers.

    Args:
        network: The roads.
        drivers: Who drives.
    """

    def __init__(self, network: RoadNetwork, drivers: Drivers) -> None:
        self._lanes, self._drivers = network.lanes, drivers
        self._zone_begin, self._zone_end = conflict_zones(network)
        self._conflict = ~np.isnan(self._zone_begin)
        self._control = np.array([lane.control for lane in network.lanes])
        self._yields = [
            np.array([b for b in lane.yields_to if self._conflict[a, b]], int)
            for a, lane in enumerate(network.lanes)
        ]
        self._free = ~self._conflict.any(axis=1) & (self._control < _STOP)
        self._length = drivers.size_m[:, 0]
        self._rows = np.arange(len(self._length))
        self.reset()

    def reset(self) -> None:
        """Reset for a new run."""
        count = len(self._length)
        self._granted = np.zeros(count, int)
        self._stood = np.full(count, np.inf)
        self._asked = np.full(count, -1)
        self._denied = np.zeros(count, bool)

    def swapped(self, row: int, tables: PathTables, front_m: float) -> None:
        """A vehicle has gone over to another path: it holds what it has entered there, and asks for the rest."""
        self._granted[row] = int(np.sum(tables.connector_begin[row] < front_m))
        self._stood[row], self._asked[row] = np.inf, -1

    def lines(self, state: TrafficState, tables: PathTables) -> PerVehicle:
        """Distance from the front bumper to the next line at which to stop (infinite: none)."""
        connectors = tables.connector.shape[1]
        entered = _number(tables.connector_begin < state.front_m[:, None])
        self._granted = np.maximum(self._granted, entered)
        stop, halts = self._lights(state, tables)
        self._granted = np.maximum(np.minimum(self._granted, halts), entered)
        ask = state.speed**2 / (2 * _ASK_MPS2) + _ASK_S * state.speed + _ASK_M
        if state.promises:
            self._granted = np.where(state.promised >= 0, np.maximum(state.promised, entered), self._granted)
        place = np.minimum(self._granted, connectors - 1)
        flat = place + connectors * self._rows
        distance = tables.connector_begin.ravel().take(flat) - state.front_m
        # Where there is no connector ahead, it is infinitely far away.
        asks = (distance >= 0) & (distance <= ask) & state.active & (halts > place)
        if state.promises:
            promises = state.promised >= 0
            asks &= ~promises
            stop[promises] = np.inf
        self._denied &= asks
        asking = asks.nonzero()[0]
        if len(asking):
            self._decide(state, tables, asking, place, stop)
        return stop

    def _lights(self, state: TrafficState, tables: PathTables) -> tuple[PerVehicle, VehicleRows]:
        """Distance to the nearest line held by a light, and which connector it is (none: their number)."""
        begin, count = tables.connector_begin, tables.connector.shape[1]
        if not np.count_nonzero(state.colour):
            return np.full(len(begin), np.inf), np.full(len(begin), count)
        distance = begin - state.front_m[:, None]
        distance[distance < 0.0] = np.inf
        speed = state.speed[:, None]
        needed = speed**2 / (2 * np.maximum(distance, 0.05))
        colour = state.colour.take(tables.connector)
        late = distance > speed * state.to_red.take(tables.connector)
        yellow = (colour == _YELLOW) & (
            (needed <= self._drivers.yellow_mps2[:, None]) | (late & (needed <= 5.0))
        )
        halt = (yellow | ((colour == _RED) & (needed <= 8.0))) & (distance < np.inf)
        first = halt.argmax(axis=1)
        flat = first + count * self._rows
        held = halt.ravel().take(flat)
        return np.where(held, distance.ravel().take(flat), np.inf), np.where(held, first, count)

    def _decide(
        self,
        state: TrafficState,
        tables: PathTables,
        asking: Int64[np.ndarray, " asking"],
        place: VehicleRows,
        stop: PerVehicle,
    ) -> None:
        """Grant or deny what drivers ask for, nearest in time first, at all-way stops in the order of standing."""
        index = np.arange(tables.connector.shape[1])
        held = (
            (index < self._granted[:, None])
            & (tables.connector_end > state.rear_m[:, None])
            & state.active[:, None]
        )
        holder, slot = np.nonzero(held & (tables.connector >= 0))
        holders = list(zip(holder.tolist(), tables.connector[holder, slot].tolist(), strict=True))
        for i in asking.tolist():
            self._note_standing(state, tables, i, int(place[i]))
        waiting: list[tuple[int, int]] = []  # who stands at an all-way stop and has not been let in
        for i in self._in_order(state, tables, asking, place):
            connector = int(tables.connector[i, place[i]])
            distance = float(tables.connector_begin[i, place[i]] - state.front_m[i])
            hard = state.speed[i] ** 2 / (2 * max(distance, 0.05)) > _HARDEST_MPS2
            ok = self._free[connector] or (hard and state.speed[i] > 2.0)
            ok = ok or self._may_enter(state, tables, (i, connector, int(place[i])), holders, waiting)
            if not ok and self._clears_in_time(state, tables, (i, connector, int(place[i])), holders):
                continue
            self._denied[i] = not ok
            if ok:
                self._granted[i] = place[i] + 1
                self._stood[i] = np.inf
                holders.append((i, connector))
            else:
                stop[i] = min(stop[i], distance)
                if self._control[connector] == _ALL_WAY_STOP and np.isfinite(self._stood[i]):
                    waiting.append((i, connector))

    def _note_standing(self, state: TrafficState, tables: PathTables, i: int, place: int) -> None:
        connector, distance = (
            int(tables.connector[i, place]),
            tables.connector_begin[i, place] - state.front_m[i],
        )
        if self._asked[i] != connector:
            self._asked[i], self._stood[i] = connector, np.inf
        if state.speed[i] < _STANDS_MPS and distance < _STANDS_M and not np.isfinite(self._stood[i]):
            self._stood[i] = state.step * DT_S

    def _in_order(
        self,
        state: TrafficState,
        tables: PathTables,
        asking: Int64[np.ndarray, " asking"],
        place: VehicleRows,
    ) -> list[int]:
        connectors = tables.connector[asking, place[asking]]
        arrival = (tables.connector_begin[asking, place[asking]] - state.front_m[asking]) / np.maximum(
            state.speed[asking], 1.0
        )
        all_way = self._control[connectors] == _ALL_WAY_STOP
        stood = self._stood[asking]
        key = np.where(all_way, 1e3 + np.minimum(stood, 1e6), arrival)
        for k in np.flatnonzero(all_way & np.isfinite(stood)):
            # Of those who came together the vehicle without another to its right goes first.
            tied = all_way & (np.abs(stood - stood[k]) < _TIE_S)
            here = self._lanes[connectors[k]].curve.heading[0]
            turned = np.array([wrap(self._lanes[w].curve.heading[0] - here) for w in connectors[tied]])
            key[k] += 0.5 * _TIE_S * bool(np.any((turned > math.pi / 4) & (turned < 3 * math.pi / 4)))
        return asking[np.lexsort((asking, key))].tolist()

    def _may_enter(
        self,
        state: TrafficState,
        tables: PathTables,
        request: tuple[int, int, int],
        holders: list[tuple[int, int]],
        waiting: list[tuple[int, int]],
    ) -> bool:
        i, connector, place = request
        control = self._control[connector]
        if control >= _STOP and state.step * DT_S - self._stood[i] < _PAUSE_S:
            return False
        ahead = int(state.leader[i])
        line = tables.connector_begin[i, place]
        tail = state.front_m[i] + state.room_m[i]
        if tail < line and self._denied[ahead]:
            return False
        if self._blockers(state, tables, i, connector, holders):
            return False
        if any(self._conflict[connector, other] for _, other in waiting):
            return False
        full = tail < tables.connector_end[i, place] + self._length[i] + 1.5 and state.leader_speed[i] < 1.5
        if full and tail >= line - 1.0 and control != _NONE:
            return False
        return not len(self._yields[connector]) or self._gap_is_accepted(state, tables, request)

    def _blockers(
        self, state: TrafficState, tables: PathTables, i: int, connector: int, holders: list[tuple[int, int]]
    ) -> list[tuple[int, int, float]]:
        """Who holds what a driver needs: its row, its connector, and how far its tail has to go to leave it, m."""
        result = []
        for j, other in holders:
            if j != i and self._conflict[connector, other]:
                past = tables.begin[j, other] + tables.scale[j, other] * self._zone_end[other, connector]
                if state.rear_m[j] < past + 0.3:
                    result.append((j, other, float(past - state.rear_m[j]) + 0.3))
        return result

    def _clears_in_time(
        self,
        state: TrafficState,
        tables: PathTables,
        request: tuple[int, int, int],
        holders: list[tuple[int, int]],
    ) -> bool:
        """Whether a driver with priority need not brake yet: those in its way move and will be gone."""
        i, connector, place = request
        away = float(tables.connector_begin[i, place] - state.front_m[i])
        gentle = state.speed[i] ** 2 / (2 * max(away, 0.05)) < _LATEST_MPS2
        blockers = self._blockers(state, tables, i, connector, holders)
        connectors = {other for _, other, _ in blockers}
        if (
            not blockers
            or not gentle
            or self._control[connector] >= _STOP
            or connectors & set(self._yields[connector].tolist())
        ):
            return False
        for j, other, left in blockers:
            leaves = time_to_cover(np.array([left]), float(state.speed[j]), 1.0, _TURNING_MPS)[0]
            if state.speed[j] < 0.5 or leaves + 1.0 > (away + self._zone_begin[connector, other]) / max(
                state.speed[i], 1.0
            ):
                return False
        return True

    def _gap_is_accepted(
        self, state: TrafficState, tables: PathTables, request: tuple[int, int, int]
    ) -> bool:
        """Whether the gap to users with priority is accepted."""
        i, connector, place = request
        others = self._yields[connector]
        begin = tables.begin[:, others]
        scale = tables.scale[:, others]
        reach = begin + scale * self._zone_begin[others, connector] - state.front_m[:, None]
        clear = begin + scale * self._zone_end[others, connector] - state.rear_m[:, None]
        coming = (clear > 0) & state.active[:, None]
        coming[i] = False
        # Who faces a red light or has been made to wait is not coming.
        waits = (state.colour[others] == _RED) | (self._denied & (state.speed < 0.5))[:, None]
        coming &= ~(waits & (reach > 0))
        if not coming.any():
            return True
        rows, columns = np.nonzero(coming)
        speed = state.speed[rows]
        arrival = np.maximum(reach[rows, columns], 0.0) / np.maximum(speed, _EXPECTED_MPS)
        gone = clear[rows, columns] / np.maximum(speed, 0.3)
        own = others[columns]
        start = tables.connector_begin[i, place] - state.front_m[i]
        top = float(tables.at(np.array([tables.connector_begin[i, place] + 5.0]), np.array([i]))[0, 3])
        push = float(self._drivers.acceleration_mps2[i])
        enter = time_to_cover(start + self._zone_begin[connector, own], state.speed[i], push, top)
        leave = time_to_cover(
            start + self._zone_end[connector, own] + self._length[i], state.speed[i], push, top
        )
        waited = state.step * DT_S - self._stood[i] if np.isfinite(self._stood[i]) else 0.0
        patience = 1.0 - min(waited / _IMPATIENT_S, 1.0) / 3.0
        needed = np.maximum(self._drivers.critical_gap_s[i] * patience, leave + 0.5)
        return not np.any((arrival < needed) & (gone > enter - 0.3))
