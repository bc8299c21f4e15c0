"""Who may enter a connector, and when: lights, signs, priority, and room to leave it again.

A driver asks for a connector when it comes so near that it would have to begin to brake for its line. Once granted,
the connector is held until the tail has left what others need of it; nobody is granted what conflicts with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int8, Int64

from drivax.geometry.vectors import wrap
from drivax.scenario.schema import DT_S
from drivax.synthetic.roads.curves import resampled
from drivax.synthetic.roads.network import CLEARANCE_M, Control, RoadNetwork
from drivax.synthetic.roads.signals import Colour
from drivax.synthetic.traffic.drivers import Drivers
from drivax.synthetic.traffic.path_arrays import PathTables

#: A driver asks for the way when it would brake this gently for the line, m/s2, with this much time and room to spare.
_ASK_MPS2, _ASK_S, _ASK_M = 2.0, 0.7, 3.5
#: Whoever expects another to clear the way in time waits no longer with braking than for this, m/s2; speed of turns.
_LATEST_MPS2, _TURNING_MPS = 3.4, 7.0
#: Nobody stops for others who would have to brake harder, m/s2.
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
class Moment:
    """Where everyone is when drivers decide.

    Attributes:
        step, colour, to_red: The step, and what each lane's light shows and how long until it turns red, s.
        front_m, rear_m: Positions of both bumpers on the own paths.
        room_m, leader, leader_speed: Gap to the vehicle ahead, its row and its speed.
        promised: Number of connectors on the path that a vehicle will enter whatever others do (-1: it asks).
        told: Whether anybody has promised.
    """

    step: int
    colour: Int8[np.ndarray, " lane"]
    to_red: Float64[np.ndarray, " lane"]
    front_m: Float64[np.ndarray, " v"]
    rear_m: Float64[np.ndarray, " v"]
    speed: Float64[np.ndarray, " v"]
    active: Bool[np.ndarray, " v"]
    room_m: Float64[np.ndarray, " v"]
    leader: Int64[np.ndarray, " v"]
    leader_speed: Float64[np.ndarray, " v"]
    promised: Int64[np.ndarray, " v"]
    told: bool


def conflict_zones(
    network: RoadNetwork,
) -> tuple[Float64[np.ndarray, "lane lane"], Float64[np.ndarray, "lane lane"]]:
    """From where to where along each connector the space is needed by each other one, m (nan: nowhere).

    Connectors that leave the same lane do not conflict: there the one behind follows.
    """
    count = len(network.lanes)
    begin, end = np.full((count, count), np.nan), np.full((count, count), np.nan)
    points = {i: resampled(lane.curve, 1.0).xy for i, lane in enumerate(network.lanes) if lane.connector}
    box = {i: (xy.min(axis=0), xy.max(axis=0)) for i, xy in points.items()}
    for a, one in points.items():
        origin = set(network.lanes[a].predecessors)
        for b, other in points.items():
            if b <= a or origin & set(network.lanes[b].predecessors):
                continue
            if np.any(box[a][0] > box[b][1] + CLEARANCE_M) or np.any(box[b][0] > box[a][1] + CLEARANCE_M):
                continue
            near = np.sum((one[:, None] - other) ** 2, axis=-1) < CLEARANCE_M**2
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


def _number(mask: Bool[np.ndarray, "v k"]) -> Int64[np.ndarray, " v"]:
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
        """Forgets everything: a new run begins."""
        count = len(self._length)
        self._granted = np.zeros(count, int)
        self._stood = np.full(count, np.inf)
        self._asked = np.full(count, -1)
        self._denied = np.zeros(count, bool)

    def swapped(self, row: int, tables: PathTables, front_m: float) -> None:
        """A vehicle has gone over to another path: it holds what it has entered there, and asks for the rest."""
        self._granted[row] = int(np.sum(tables.way_begin[row] < front_m))
        self._stood[row], self._asked[row] = np.inf, -1

    def lines(self, now: Moment, tables: PathTables) -> Float64[np.ndarray, " v"]:
        """Distance from the front bumper to the next line at which to stop (infinite: none)."""
        ways = tables.way.shape[1]
        entered = _number(tables.way_begin < now.front_m[:, None])
        self._granted = np.maximum(self._granted, entered)
        stop, halts = self._lights(now, tables)
        self._granted = np.maximum(np.minimum(self._granted, halts), entered)
        ask = now.speed**2 / (2 * _ASK_MPS2) + _ASK_S * now.speed + _ASK_M
        if now.told:
            self._granted = np.where(now.promised >= 0, np.maximum(now.promised, entered), self._granted)
        place = np.minimum(self._granted, ways - 1)
        flat = place + ways * self._rows
        distance = tables.way_begin.ravel().take(flat) - now.front_m
        # Where there is no connector ahead, it is infinitely far away.
        asks = (distance >= 0) & (distance <= ask) & now.active & (halts > place)
        if now.told:
            told = now.promised >= 0
            asks &= ~told
            stop[told] = np.inf
        self._denied &= asks
        who = asks.nonzero()[0]
        if len(who):
            self._hear(now, tables, who, place, stop)
        return stop

    def _lights(
        self, now: Moment, tables: PathTables
    ) -> tuple[Float64[np.ndarray, " v"], Int64[np.ndarray, " v"]]:
        """Distance to the nearest line held by a light, and which connector it is (none: their number)."""
        begin, count = tables.way_begin, tables.way.shape[1]
        if not np.count_nonzero(now.colour):
            return np.full(len(begin), np.inf), np.full(len(begin), count)
        distance = begin - now.front_m[:, None]
        distance[distance < 0.0] = np.inf
        speed = now.speed[:, None]
        needed = speed**2 / (2 * np.maximum(distance, 0.05))
        colour = now.colour.take(tables.way)
        late = distance > speed * now.to_red.take(tables.way)
        yellow = (colour == _YELLOW) & (
            (needed <= self._drivers.yellow_mps2[:, None]) | (late & (needed <= 5.0))
        )
        halt = (yellow | ((colour == _RED) & (needed <= 8.0))) & (distance < np.inf)
        first = halt.argmax(axis=1)
        flat = first + count * self._rows
        held = halt.ravel().take(flat)
        return np.where(held, distance.ravel().take(flat), np.inf), np.where(held, first, count)

    def _hear(
        self,
        now: Moment,
        tables: PathTables,
        who: Int64[np.ndarray, " asking"],
        place: Int64[np.ndarray, " v"],
        stop: Float64[np.ndarray, " v"],
    ) -> None:
        """Grants or denies what drivers ask for, nearest in time first, at all-way stops in the order of standing."""
        index = np.arange(tables.way.shape[1])
        held = (index < self._granted[:, None]) & (tables.way_end > now.rear_m[:, None]) & now.active[:, None]
        holder, slot = np.nonzero(held & (tables.way >= 0))
        holders = list(zip(holder.tolist(), tables.way[holder, slot].tolist(), strict=True))
        for i in who.tolist():
            self._note_standing(now, tables, i, int(place[i]))
        before: list[tuple[int, int]] = []  # who stands at an all-way stop and has not been let in
        for i in self._in_order(now, tables, who, place):
            way = int(tables.way[i, place[i]])
            distance = float(tables.way_begin[i, place[i]] - now.front_m[i])
            hard = now.speed[i] ** 2 / (2 * max(distance, 0.05)) > _HARDEST_MPS2
            ok = self._free[way] or (hard and now.speed[i] > 2.0)
            ok = ok or self._may(now, tables, (i, way, int(place[i])), holders, before)
            if not ok and self._clears_in_time(now, tables, (i, way, int(place[i])), holders):
                continue
            self._denied[i] = not ok
            if ok:
                self._granted[i] = place[i] + 1
                self._stood[i] = np.inf
                holders.append((i, way))
            else:
                stop[i] = min(stop[i], distance)
                if self._control[way] == _ALL_WAY_STOP and np.isfinite(self._stood[i]):
                    before.append((i, way))

    def _note_standing(self, now: Moment, tables: PathTables, i: int, place: int) -> None:
        way, distance = int(tables.way[i, place]), tables.way_begin[i, place] - now.front_m[i]
        if self._asked[i] != way:
            self._asked[i], self._stood[i] = way, np.inf
        if now.speed[i] < _STANDS_MPS and distance < _STANDS_M and not np.isfinite(self._stood[i]):
            self._stood[i] = now.step * DT_S

    def _in_order(
        self,
        now: Moment,
        tables: PathTables,
        who: Int64[np.ndarray, " asking"],
        place: Int64[np.ndarray, " v"],
    ) -> list[int]:
        ways = tables.way[who, place[who]]
        arrival = (tables.way_begin[who, place[who]] - now.front_m[who]) / np.maximum(now.speed[who], 1.0)
        all_way = self._control[ways] == _ALL_WAY_STOP
        stood = self._stood[who]
        key = np.where(all_way, 1e3 + np.minimum(stood, 1e6), arrival)
        for k in np.flatnonzero(all_way & np.isfinite(stood)):
            # Of those who came together the one with nobody to its right goes first.
            tied = all_way & (np.abs(stood - stood[k]) < _TIE_S)
            here = self._lanes[ways[k]].curve.heading[0]
            turned = np.array([wrap(self._lanes[w].curve.heading[0] - here) for w in ways[tied]])
            key[k] += 0.5 * _TIE_S * bool(np.any((turned > math.pi / 4) & (turned < 3 * math.pi / 4)))
        return who[np.lexsort((who, key))].tolist()

    def _may(
        self,
        now: Moment,
        tables: PathTables,
        request: tuple[int, int, int],
        holders: list[tuple[int, int]],
        before: list[tuple[int, int]],
    ) -> bool:
        i, way, place = request
        control = self._control[way]
        if control >= _STOP and now.step * DT_S - self._stood[i] < _PAUSE_S:
            return False
        ahead = int(now.leader[i])
        line = tables.way_begin[i, place]
        tail = now.front_m[i] + now.room_m[i]
        if tail < line and self._denied[ahead]:
            return False
        if self._in_the_way(now, tables, i, way, holders):
            return False
        if any(self._conflict[way, other] for _, other in before):
            return False
        full = tail < tables.way_end[i, place] + self._length[i] + 1.5 and now.leader_speed[i] < 1.5
        if full and tail >= line - 1.0 and control != _NONE:
            return False
        return not len(self._yields[way]) or self._gap_is_accepted(now, tables, request)

    def _in_the_way(
        self, now: Moment, tables: PathTables, i: int, way: int, holders: list[tuple[int, int]]
    ) -> list[tuple[int, int, float]]:
        """Who holds what a driver needs: its row, its connector, and how far its tail has to go to leave it, m."""
        result = []
        for j, other in holders:
            if j != i and self._conflict[way, other]:
                past = tables.begin[j, other] + tables.scale[j, other] * self._zone_end[other, way]
                if now.rear_m[j] < past + 0.3:
                    result.append((j, other, float(past - now.rear_m[j]) + 0.3))
        return result

    def _clears_in_time(
        self, now: Moment, tables: PathTables, request: tuple[int, int, int], holders: list[tuple[int, int]]
    ) -> bool:
        """Whether a driver with priority need not brake yet: those in its way move and will be gone."""
        i, way, place = request
        away = float(tables.way_begin[i, place] - now.front_m[i])
        gentle = now.speed[i] ** 2 / (2 * max(away, 0.05)) < _LATEST_MPS2
        found = self._in_the_way(now, tables, i, way, holders)
        ways = {other for _, other, _ in found}
        if not found or not gentle or self._control[way] >= _STOP or ways & set(self._yields[way].tolist()):
            return False
        for j, other, left in found:
            leaves = time_to_cover(np.array([left]), float(now.speed[j]), 1.0, _TURNING_MPS)[0]
            if now.speed[j] < 0.5 or leaves + 1.0 > (away + self._zone_begin[way, other]) / max(
                now.speed[i], 1.0
            ):
                return False
        return True

    def _gap_is_accepted(self, now: Moment, tables: PathTables, request: tuple[int, int, int]) -> bool:
        """Whether nobody with priority would arrive too soon."""
        i, way, place = request
        others = self._yields[way]
        begin = tables.begin[:, others]
        scale = tables.scale[:, others]
        reach = begin + scale * self._zone_begin[others, way] - now.front_m[:, None]
        clear = begin + scale * self._zone_end[others, way] - now.rear_m[:, None]
        coming = (clear > 0) & now.active[:, None]
        coming[i] = False
        # Who faces a red light or has been made to wait is not coming.
        waits = (now.colour[others] == _RED) | (self._denied & (now.speed < 0.5))[:, None]
        coming &= ~(waits & (reach > 0))
        if not coming.any():
            return True
        rows, columns = np.nonzero(coming)
        speed = now.speed[rows]
        arrival = np.maximum(reach[rows, columns], 0.0) / np.maximum(speed, _EXPECTED_MPS)
        gone = clear[rows, columns] / np.maximum(speed, 0.3)
        own = others[columns]
        start = tables.way_begin[i, place] - now.front_m[i]
        top = float(tables.at(np.array([tables.way_begin[i, place] + 5.0]), np.array([i]))[0, 3])
        push = float(self._drivers.acceleration_mps2[i])
        enter = time_to_cover(start + self._zone_begin[way, own], now.speed[i], push, top)
        leave = time_to_cover(start + self._zone_end[way, own] + self._length[i], now.speed[i], push, top)
        waited = now.step * DT_S - self._stood[i] if np.isfinite(self._stood[i]) else 0.0
        patience = 1.0 - min(waited / _IMPATIENT_S, 1.0) / 3.0
        needed = np.maximum(self._drivers.critical_gap_s[i] * patience, leave + 0.5)
        return not np.any((arrival < needed) & (gone > enter - 0.3))
