"""Lane changes: discretionary (MOBIL) and mandatory ones, and the gaps that other drivers open for the latter.

MOBIL: Kesting, Treiber and Helbing, "General lane-changing model MOBIL for car-following models", Transportation
Research Record 1999 (2007). A change is made when it is safe for the new follower, ``a_n' > -b_safe``, and when
``a' - a + p (a_n' - a_n + a_o' - a_o) > threshold``, with the vehicle's acceleration a, those of the new and the old
follower a_n and a_o, a prime for after the change, and the politeness p. Here it must also be safe for the vehicle
itself (``a' > -b_safe``), with minimum gaps on the new lane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from drivax.scenario.schema import RoadKind, nonzero
from drivax.simulator.idm import idm_acceleration
from drivax.synthetic.roads.network import RoadNetwork, per_roads
from drivax.synthetic.traffic.obstacles import Boxes
from drivax.synthetic.traffic.path_arrays import PathTables, PerVehicle, VehicleMask, Worlds
from drivax.synthetic.traffic.roles import Drivers

#: MOBIL: threshold and safe braking, m/s2; the latter rises to the urgent one towards the end of the old lane.
_THRESHOLD_MPS2 = 0.25
_SAFE_BRAKING_MPS2, _URGENT_BRAKING_MPS2 = 2.5, 4.5
#: Distance and time from the end of a lane at which a change becomes mandatory, m and s.
_MANDATORY_M, _MANDATORY_S = 120.0, 9.0
#: Duration of a change, s, its least length, m (8 at the end of a lane), and lowest speed of a discretionary one, m/s.
_DURATION_S, _MIN_LENGTH_M, _MIN_SPEED_MPS = 4.2, 14.0, 3.0
#: Required bumper-to-bumper gap on the new lane, m; times added at the follower's speed behind and at the closing speed
#: ahead, s; share by which urgency reduces the time behind.
_GAP_M, _FOLLOWER_S, _CLOSING_S, _URGENT_SHARE = 2.0, 0.25, 1.0, 0.6
#: Least distances of a discretionary change to the beginning and the end of the new chain of lanes, m.
_FROM_JUNCTION_M, _TO_JUNCTION_M = 12.0, 25.0
#: Half the length of a static obstacle, m, and distance behind a vehicle up to which it counts as ahead, m.
_HALF_OBSTACLE_M, _OBSTACLE_BEHIND_M = 2.4, 3.0
#: Half the width of a car that an obstacle may block, m.
_HALF_CAR_M = 0.95
#: Least distance between simultaneous changes into one chain, m, and gain by which mandatory ones precede others, m/s2.
_ENTRY_SPACING_M, _MANDATORY_GAIN_MPS2 = 40.0, 100.0
#: Largest braking to open a gap for others, m/s2.
MAKE_ROOM_MPS2 = 1.8

#: A number, a flag and an index per candidate.
_Values = Float64[np.ndarray, " k"]
_Stack = Float64[np.ndarray, "*k"]
_Mask = Bool[np.ndarray, " k"]
_Indices = Int64[np.ndarray, " k"]


class _ChainPositions(NamedTuple):
    """Chains of lanes (-1: none) and positions along them, per candidate or per lane that a vehicle occupies."""

    chain: Int64[np.ndarray, "*k"]
    position_m: _Stack


class _Neighbours(NamedTuple):
    """Nearest vehicle or obstacle ahead of each candidate, or nearest vehicle behind it: row, gap and speed.

    The row is -1 for none and for an obstacle; the gap is infinite for none.
    """

    row: _Indices
    gap_m: _Values
    speed: _Values


@dataclass(frozen=True)
class LaneChains:
    """Chains of successive lanes without a fork, a merge or a connector between them.

    Attributes:
        chain, offset_m: Chain of each lane (-1: a connector), and position of the lane's start along it.
        length_m, ends: Per chain: its length, and whether it ends while the road continues.
        left, right: Adjacent lane of each lane to which cars may change (-1: none).
        lane_length_m, exit_only, limit_mps: Length of each lane, whether it leads off the road, and its limit.
    """

    chain: Int64[np.ndarray, " lane"]
    offset_m: Float64[np.ndarray, " lane"]
    length_m: Float64[np.ndarray, " chain"]
    ends: Bool[np.ndarray, " chain"]
    left: Int64[np.ndarray, " lane"]
    right: Int64[np.ndarray, " lane"]
    lane_length_m: Float64[np.ndarray, " lane"]
    exit_only: Bool[np.ndarray, " lane"]
    limit_mps: Float64[np.ndarray, " lane"]

    @classmethod
    def from_network(cls, network: RoadNetwork) -> LaneChains:
        """Return the chains of a network."""
        lanes = network.lanes
        chain, offset_m = np.full(len(lanes), -1), np.zeros(len(lanes))
        lengths, ends = [], []
        successor = {i: _next_in_chain(network, i) for i in range(len(lanes)) if not lanes[i].connector}
        for head in sorted(successor.keys() - set(successor.values())):
            position, last, lane = 0.0, head, head
            while lane >= 0:
                chain[lane], offset_m[lane] = len(lengths), position
                position += lanes[lane].length_m
                last, lane = lane, successor[lane]
            lengths.append(position)
            ends.append(lanes[last].ends)
        return cls(
            chain=chain,
            offset_m=offset_m,
            length_m=np.array(lengths),
            ends=np.array(ends, bool),
            left=_targets(network, [lane.left for lane in lanes]),
            right=_targets(network, [lane.right for lane in lanes]),
            lane_length_m=np.array([lane.length_m for lane in lanes]),
            exit_only=np.array([lane.exit_only for lane in lanes]),
            limit_mps=np.array([lane.limit_mps for lane in lanes]),
        )

    @classmethod
    def join(cls, worlds: Worlds) -> LaneChains:
        """Concatenate the chains of all worlds, and add a chain without length for connectors."""
        chains = [lane_chains(network) for network in worlds.networks]
        first = np.cumsum([0, *(len(chain.length_m) for chain in chains)])
        result = {name: np.concatenate([getattr(c, name) for c in chains]) for name in vars(chains[0])}
        world = np.repeat(np.arange(len(worlds)), np.diff(worlds.first_lane))
        for name, offset in (("chain", first), ("left", worlds.first_lane), ("right", worlds.first_lane)):
            result[name] = np.where(result[name] < 0, -1, result[name] + offset[world])
        ends = {"length_m": np.append(result["length_m"], 0.0), "ends": np.append(result["ends"], False)}
        return cls(**result | ends)


lane_chains = per_roads(LaneChains.from_network)


def _next_in_chain(network: RoadNetwork, lane: int) -> int:
    """Return the only successor of a lane, if the lane is its only predecessor, else -1."""
    match network.lanes[lane].successors:
        case (after,) if not network.lanes[after].connector and len(network.lanes[after].predecessors) == 1:
            return after
    return -1


def _targets(network: RoadNetwork, neighbours: list[int]) -> Int64[np.ndarray, " lane"]:
    """Return the neighbours, with -1 in place of those to which cars may not change."""

    def is_open(lane: int) -> bool:
        return not network.lanes[lane].connector and network.lanes[lane].kind != RoadKind.LANE_BIKE

    return np.array([lane if lane >= 0 and is_open(lane) else -1 for lane in neighbours])


@dataclass(frozen=True)
class Change:
    """A lane change that starts now: vehicle, new lane, and length of the manoeuvre."""

    vehicle: int
    lane: int
    length_m: float


@dataclass(frozen=True)
class GapPairs:
    """Pairs of vehicles on adjacent lanes; the one behind opens a gap for a mandatory change.

    ``gap_m`` is the bumper-to-bumper gap along the lane minus the difference of path positions: a constant.
    """

    behind: Int64[np.ndarray, " pair"]
    ahead: Int64[np.ndarray, " pair"]
    gap_m: Float64[np.ndarray, " pair"]


NO_GAP_PAIRS = GapPairs(np.zeros(0, int), np.zeros(0, int), np.zeros(0))


@dataclass(frozen=True)
class VehicleState:
    """State of all vehicles, with the highest speed and the preferred acceleration on the present path.

    ``free`` is a mask of vehicles that may change lanes: neither ego nor vehicles in or just after a manoeuvre.
    """

    at_m: PerVehicle
    speed: PerVehicle
    active: VehicleMask
    free: VehicleMask
    fastest: PerVehicle
    acceleration: PerVehicle


@dataclass(frozen=True)
class _Options:
    """Candidate changes, those to the left first, each side in order of vehicles.

    Attributes:
        target, limit_mps: The new lane and the preferred speed on it.
        length_m: Length of the manoeuvre.
        possible, mandatory: Whether the lanes allow the change, and whether the vehicle must change.
        remaining_m: Distance to the end of the present chain.
        new, own: Positions on the new and on the present chain.
    """

    vehicles: _Indices
    target: _Indices
    length_m: _Values
    possible: _Mask
    mandatory: _Mask
    limit_mps: _Values
    remaining_m: _Values
    new: _ChainPositions
    own: _ChainPositions


class LaneChanges:
    """Lane-change decisions of all vehicles."""

    def __init__(self, worlds: Worlds, drivers: Drivers, standing: Sequence[Boxes]) -> None:
        self.chains, self._drivers, self._worlds = LaneChains.join(worlds), drivers, worlds
        self._half = drivers.size_m[:, 0] / 2
        self._half_of_column = self._half.take(worlds.rows)
        obstacles = [
            (first + lane, position)
            for first, network, boxes in zip(worlds.first_lane[:-1], worlds.networks, standing, strict=True)
            for lane, position in _obstacle_positions(network, boxes)
        ]
        lanes = np.array([lane for lane, _ in obstacles], int)
        self._obstacle_chain = self.chains.chain[lanes]
        self._obstacle_m = self.chains.offset_m[lanes] + np.array([position for _, position in obstacles])

    def decide(self, now: VehicleState, tables: PathTables) -> tuple[list[Change], GapPairs]:
        """Return lane changes that start now, and pairs that open gaps for mandatory ones."""
        lane, along = tables.lanes_at(now.at_m)
        own_lane, chains = lane[:, 0], self.chains
        candidates = now.free & now.active & (own_lane >= 0) & ~self._drivers.cyclist
        candidates &= (chains.left[own_lane] >= 0) | (chains.right[own_lane] >= 0)
        vehicles = np.flatnonzero(candidates)
        if not len(vehicles):
            return [], NO_GAP_PAIRS
        target = np.concatenate([chains.left[own_lane[vehicles]], chains.right[own_lane[vehicles]]])
        sides = np.flatnonzero(target >= 0)
        vehicles = vehicles[sides % len(vehicles)]
        options = self._options(now, vehicles, target[sides], own_lane[vehicles], along[vehicles, 0])
        if not len(options.vehicles):
            return [], NO_GAP_PAIRS
        chain = np.where((lane >= 0) & now.active[:, None], chains.chain[lane], -1)
        return self._choose(now, options, _ChainPositions(chain, chains.offset_m[lane] + along))

    def _options(
        self, now: VehicleState, vehicles: _Indices, target: _Indices, lane: _Indices, along: _Values
    ) -> _Options:
        """Return mandatory changes and those for which the lanes have room; ``along`` is the position on ``lane``."""
        chains = self.chains
        chain, own_chain = chains.chain[target], chains.chain[lane]
        position = chains.offset_m[target] + along / chains.lane_length_m[lane] * chains.lane_length_m[target]
        own_position = chains.offset_m[lane] + along
        remaining = chains.length_m[own_chain] - own_position
        speed = now.speed[vehicles]
        mandatory = chains.ends[own_chain] & (remaining < np.maximum(_MANDATORY_M, _MANDATORY_S * speed))
        length = np.maximum(_DURATION_S * speed, _MIN_LENGTH_M)
        length = np.where(mandatory, np.minimum(length, np.maximum(remaining - 2.0, 8.0)), length)
        target_remaining = chains.length_m[chain] - position
        possible = (target_remaining > length + 3.0) & (~chains.ends[own_chain] | (remaining > length))
        optional = possible & (speed > _MIN_SPEED_MPS) & (position > _FROM_JUNCTION_M)
        optional &= target_remaining > length + _TO_JUNCTION_M
        optional &= ~chains.exit_only[target] & ~chains.ends[chain]
        possible = np.where(mandatory, possible & ~chains.ends[chain], optional)
        limit = now.fastest[vehicles] * chains.limit_mps[target] / chains.limit_mps[lane]
        k = np.flatnonzero(possible | mandatory)
        return _Options(
            vehicles=vehicles[k],
            target=target[k],
            length_m=length[k],
            possible=possible[k],
            mandatory=mandatory[k],
            limit_mps=limit[k],
            remaining_m=remaining[k],
            new=_ChainPositions(chain[k], position[k]),
            own=_ChainPositions(own_chain[k], own_position[k]),
        )

    def _choose(
        self, now: VehicleState, options: _Options, occupancy: _ChainPositions
    ) -> tuple[list[Change], GapPairs]:
        """Apply MOBIL to each option; take mandatory changes first, then those with the largest gain."""
        o, vehicles = options, options.vehicles
        speed = now.speed[vehicles]
        leader, follower = self._neighbours(now, vehicles, o.new, occupancy)
        own_after = self._follow(vehicles, speed, o.limit_mps, leader.gap_m, leader.speed)
        # After the change the new follower follows the vehicle, and the old follower the vehicle's old leader.
        new_after, new_before = self._follower_accelerations(now, vehicles, follower, leader)
        old_leader, old_follower = self._neighbours(now, vehicles, o.own, occupancy)
        old_before, old_after = self._follower_accelerations(now, vehicles, old_follower, old_leader)
        others = new_after - new_before + old_after - old_before
        gain = own_after - now.acceleration[vehicles] + self._drivers.politeness[vehicles] * others
        urgency = np.where(o.mandatory, 1.0 - np.clip(o.remaining_m / _MANDATORY_M, 0.0, 1.0), 0.0)
        safe_mps2 = _SAFE_BRAKING_MPS2 + urgency * (_URGENT_BRAKING_MPS2 - _SAFE_BRAKING_MPS2)
        follower_speed = np.where(follower.row >= 0, now.speed[np.maximum(follower.row, 0)], 0.0)
        accepted = o.possible & (new_after > -safe_mps2) & (own_after > -safe_mps2)
        accepted &= leader.gap_m > _GAP_M + _CLOSING_S * np.maximum(speed - leader.speed, 0.0)
        accepted &= follower.gap_m > _GAP_M + _FOLLOWER_S * follower_speed * (1 - _URGENT_SHARE * urgency)
        accepted &= o.mandatory | (gain > _THRESHOLD_MPS2)
        changes = self._select_changes(now, options, accepted, gain)
        changing = {change.vehicle for change in changes}
        return changes, _gap_pairs(now, options, changing, leader, follower)

    def _follower_accelerations(
        self, now: VehicleState, vehicles: _Indices, follower: _Neighbours, leader: _Neighbours
    ) -> tuple[_Values, _Values]:
        """Return followers' accelerations behind the vehicle and behind its leader; 0 without a follower."""
        exists, row = follower.row >= 0, np.maximum(follower.row, 0)
        gaps = np.stack([follower.gap_m, follower.gap_m + 2 * self._half[vehicles] + leader.gap_m])
        leader_speed = np.stack([now.speed[vehicles], leader.speed])
        near, far = np.where(
            exists, self._follow(row, now.speed[row], now.fastest[row], gaps, leader_speed), 0.0
        )
        return near, far

    def _follow(
        self, rows: _Indices, speed: _Values, preferred: _Values, gap: _Stack, leader_speed: _Stack
    ) -> _Stack:
        return idm_acceleration(speed, preferred, gap, leader_speed, self._drivers.idm(rows))

    def _neighbours(
        self, now: VehicleState, vehicles: _Indices, positions: _ChainPositions, occupancy: _ChainPositions
    ) -> tuple[_Neighbours, _Neighbours]:
        """Return the nearest vehicle or obstacle ahead of each position on its chain, and nearest vehicle behind it."""
        chain, position = positions
        candidates, world = np.arange(len(vehicles)), self._worlds.world[vehicles]
        rows = self._worlds.rows[world]
        is_candidate = (occupancy.chain.take(rows, axis=0) == chain[:, None, None]) & (rows >= 0)[..., None]
        is_candidate[rows == vehicles[:, None]] = False
        candidate, place, slot = nonzero(is_candidate)
        separation = occupancy.position_m[rows[candidate, place], slot] - position[candidate]
        half_of_column = self._half_of_column[world]
        neighbours = []
        for distance in (separation, -separation):
            gap, k = np.full(rows.shape, np.inf), (distance >= 0).nonzero()[0]
            np.minimum.at(gap, (candidate[k], place[k]), distance[k])
            gap -= half_of_column
            column = gap.argmin(axis=1)
            row, gap_m = rows[candidates, column], gap[candidates, column] - self._half[vehicles]
            neighbours.append(_Neighbours(np.where(np.isfinite(gap_m), row, -1), gap_m, now.speed[row]))
        leader, follower = neighbours
        if len(self._obstacle_m):
            ahead = self._obstacle_m - position[:, None]
            is_ahead = (self._obstacle_chain == chain[:, None]) & (ahead > -_OBSTACLE_BEHIND_M)
            gap_m = np.where(is_ahead, ahead, np.inf).min(axis=1) - _HALF_OBSTACLE_M - self._half[vehicles]
            is_nearer = gap_m < leader.gap_m
            row, speed = np.where(is_nearer, -1, leader.row), np.where(is_nearer, 0.0, leader.speed)
            leader = _Neighbours(row, np.minimum(leader.gap_m, gap_m), speed)
        return leader, follower

    def _select_changes(
        self, now: VehicleState, options: _Options, accepted: _Mask, gain: _Values
    ) -> list[Change]:
        """Return the best option of each vehicle.

        Of vehicles less than 40 m apart (in positions along their own paths) only the best one enters a chain.
        """
        changes: dict[int, Change] = {}
        entries: list[tuple[int, float]] = []  # chain and position of the changes so far
        order = sorted(
            (-float(gain[k]) - _MANDATORY_GAIN_MPS2 * bool(options.mandatory[k]), int(options.vehicles[k]), k)
            for k in np.flatnonzero(accepted)
        )
        for _, row, k in order:
            target, position = int(options.target[k]), float(now.at_m[row])
            chain = int(self.chains.chain[target])
            is_taken = any(
                chain == other and abs(position - entry_m) < _ENTRY_SPACING_M for other, entry_m in entries
            )
            if row not in changes and not is_taken:
                entries.append((chain, position))
                changes[row] = Change(row, target, float(options.length_m[k]))
        return list(changes.values())


def _gap_pairs(
    now: VehicleState, options: _Options, changing: set[int], leader: _Neighbours, follower: _Neighbours
) -> GapPairs:
    """Return pairs that open a gap for a mandatory change which has no room yet."""
    pairs: list[tuple[int, int, float]] = []
    for k in np.flatnonzero(options.mandatory):
        row, ahead, behind = (int(rows[k]) for rows in (options.vehicles, leader.row, follower.row))
        if row in changing:
            continue
        if ahead >= 0 and ahead not in changing:
            pairs.append((row, ahead, float(leader.gap_m[k])))
        if behind >= 0 and behind not in changing:
            pairs.append((behind, row, float(follower.gap_m[k])))
    behind, ahead = np.array([pair[:2] for pair in pairs], int).reshape(-1, 2).T
    gap = np.array([pair[2] for pair in pairs]) - (now.at_m[ahead] - now.at_m[behind])
    return GapPairs(behind, ahead, gap)


def _obstacle_positions(network: RoadNetwork, boxes: Boxes) -> list[tuple[int, float]]:
    """Return each lane of a chain that a standing obstacle blocks, and the position along it, m."""
    if not len(boxes):
        return []
    result, chain = [], lane_chains(network).chain
    for index in np.flatnonzero(chain >= 0).tolist():
        curve = network.lanes[index].curve
        dx, dy = (np.subtract.outer(boxes.xy[:, k], curve.xy[::2, k]) for k in (0, 1))
        squared_gap = dx * dx + dy * dy
        for box in np.flatnonzero(squared_gap.min(axis=1) < (_HALF_CAR_M + boxes.size_m[:, 1] / 2) ** 2):
            result.append((index, float(curve.arc_m[::2][np.argmin(squared_gap[box])])))
    return result
