"""Lane changes: discretionary (MOBIL) and mandatory ones, and the gaps that other drivers open for the latter.

MOBIL: Kesting, Treiber and Helbing, "General lane-changing model MOBIL for car-following models", Transportation
Research Record 1999 (2007). A change is made when it is safe for the new follower, ``a_n' > -b_safe``, and when
``a' - a + p (a_n' - a_n + a_o' - a_o) > threshold``, with the own acceleration a, those of the new and the old
follower a_n and a_o, a dash for after the change, and the politeness p.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from jaxtyping import Bool, Float64, Int64

from drivax.scenario.schema import RoadKind
from drivax.simulator.idm import idm_acceleration
from drivax.synthetic.roads.network import RoadNetwork, per_roads
from drivax.synthetic.traffic.obstacles import Boxes
from drivax.synthetic.traffic.path_arrays import PathTables, PerVehicle, VehicleMask, Worlds
from drivax.synthetic.traffic.roles import Drivers

#: MOBIL: threshold and safe braking, m/s2; the latter grows to the second value as the own lane runs out.
_THRESHOLD_MPS2 = 0.25
_SAFE_MPS2, _URGENT_MPS2 = 2.5, 4.5
#: A change becomes mandatory at this distance from the end of a lane, m, or at this time, s.
_LEAVE_M, _LEAVE_S = 120.0, 9.0
#: Duration of a change, s, and its least length, m; lowest speed of a discretionary one, m/s.
_DURATION_S, _SHORTEST_M, _LEAST_MPS = 4.2, 14.0, 3.0
#: Bumper-to-bumper gap required ahead and behind, m and s.
_ROOM_M, _ROOM_S = 2.0, 0.25
#: No discretionary change this close behind or before a junction, m.
_AFTER_M, _BEFORE_M = 12.0, 25.0
#: Half the length of a static obstacle, m.
_HALF_OBSTACLE_M = 2.4
#: Largest braking to make room for others, m/s2.
MAKE_ROOM_MPS2 = 1.8

#: A number, a flag and an index per candidate.
_Values = Float64[np.ndarray, " k"]
_Stack = Float64[np.ndarray, "*k"]
_Mask = Bool[np.ndarray, " k"]
_Indices = Int64[np.ndarray, " k"]
#: Chain of lanes and position along it, per candidate, and for all lanes that the vehicles occupy.
_Place = tuple[_Indices, _Values]
_Occupied = tuple[Int64[np.ndarray, "v slot"], Float64[np.ndarray, "v slot"]]
#: Row (-1: none, or an obstacle), gap and speed of the nearest vehicle ahead or behind, per candidate.
_Neighbour = tuple[_Indices, _Values, _Values]


@dataclass(frozen=True)
class LaneChains:
    """Lanes that follow each other without a fork or a connector, joined to chains.

    Attributes:
        chain, offset_m: Chain of each lane (-1: a connector), and position of the lane's start along it.
        length_m, ends: Per chain: its length, and whether it ends while the road continues.
        left, right: Adjacent lane of each lane to which cars may change (-1: none).
        lane_m, exit, limit: Length of each lane, whether it leads off the road, and its speed limit.
    """

    chain: Int64[np.ndarray, " lane"]
    offset_m: Float64[np.ndarray, " lane"]
    length_m: Float64[np.ndarray, " chain"]
    ends: Bool[np.ndarray, " chain"]
    left: Int64[np.ndarray, " lane"]
    right: Int64[np.ndarray, " lane"]
    lane_m: Float64[np.ndarray, " lane"]
    exit: Bool[np.ndarray, " lane"]
    limit: Float64[np.ndarray, " lane"]

    @classmethod
    def of(cls, network: RoadNetwork) -> LaneChains:
        """Return the chains of a network."""
        lanes = network.lanes
        chain, offset_m = np.full(len(lanes), -1), np.zeros(len(lanes))
        lengths, ends = [], []
        following = {i: _next_in_chain(network, i) for i in range(len(lanes)) if not lanes[i].connector}
        inner = set(following.values())
        for head in [i for i in following if i not in inner]:
            position, last, lane = 0.0, head, head
            while lane >= 0:
                chain[lane], offset_m[lane] = len(lengths), position
                position += lanes[lane].length_m
                last, lane = lane, following[lane]
            lengths.append(position)
            ends.append(lanes[last].ends and not lanes[last].successors)
        left, right = (
            np.array([-1 if other < 0 or _is_closed(network, other) else other for other in side])
            for side in ([lane.left for lane in lanes], [lane.right for lane in lanes])
        )
        return cls(
            chain, offset_m, np.array(lengths), np.array(ends, bool), left, right,
            lane_m=np.array([lane.length_m for lane in lanes]),
            exit=np.array([lane.exit_only for lane in lanes]),
            limit=np.array([lane.limit_mps for lane in lanes]),
        )  # fmt: skip

    @classmethod
    def join(cls, worlds: Worlds) -> LaneChains:
        """Join the chains of all worlds; a last chain without length stands for connectors."""
        chains = [lane_chains(network) for network in worlds.networks]
        first = np.cumsum([0, *(len(chain.length_m) for chain in chains)])
        result = {name: np.concatenate([getattr(c, name) for c in chains]) for name in vars(chains[0])}
        world = np.repeat(np.arange(len(worlds)), np.diff(worlds.first_lane))
        for name, offset in (("chain", first), ("left", worlds.first_lane), ("right", worlds.first_lane)):
            result[name] = np.where(result[name] < 0, -1, result[name] + offset[world])
        ends = {"length_m": np.append(result["length_m"], 0.0), "ends": np.append(result["ends"], False)}
        return cls(**result | ends)


lane_chains = per_roads(LaneChains.of)


def _next_in_chain(network: RoadNetwork, lane: int) -> int:
    after = network.lanes[lane].successors
    single = len(after) == 1 and not network.lanes[after[0]].connector
    return after[0] if single and len(network.lanes[after[0]].predecessors) == 1 else -1


def _is_closed(network: RoadNetwork, lane: int) -> bool:
    return network.lanes[lane].connector or network.lanes[lane].kind == RoadKind.LANE_BIKE


@dataclass(frozen=True)
class Change:
    """A lane change that begins now: vehicle, new lane, and length of the manoeuvre."""

    vehicle: int
    lane: int
    length_m: float


@dataclass(frozen=True)
class GapPairs:
    """Pairs of vehicles on adjacent lanes of which the one behind opens a gap for a mandatory change.

    ``gap_m`` is the bumper-to-bumper gap along the lane less the difference of path positions, which is constant.
    """

    behind: Int64[np.ndarray, " pair"]
    ahead: Int64[np.ndarray, " pair"]
    gap_m: Float64[np.ndarray, " pair"]


NO_GAP_PAIRS = GapPairs(np.zeros(0, int), np.zeros(0, int), np.zeros(0))


@dataclass(frozen=True)
class VehicleState:
    """State of all vehicles, with the fastest speed and the preferred acceleration on the own path.

    ``free`` is a mask of vehicles that may change (neither ego nor vehicles that are changing).
    """

    at_m: PerVehicle
    speed: PerVehicle
    active: VehicleMask
    free: VehicleMask
    fastest: PerVehicle
    acceleration: PerVehicle


@dataclass(frozen=True)
class _Options:
    """Candidate changes, one entry each: those to the left first, each side in order of vehicles.

    Attributes:
        target, limit_mps: The new lane and the preferred speed there.
        length_m: Length of the manoeuvre.
        possible, mandatory: Whether the lanes allow the change, and whether it must be made.
        left_m: Distance to the end of the own chain.
        place, own_place: Place on the new and on the own chain.
    """

    vehicles: _Indices
    target: _Indices
    length_m: _Values
    possible: _Mask
    mandatory: _Mask
    limit_mps: _Values
    left_m: _Values
    place: _Place
    own_place: _Place


class LaneChanges:
    """Decides the lane changes of all vehicles."""

    def __init__(self, worlds: Worlds, drivers: Drivers, standing: Sequence[Boxes]) -> None:
        self.chains, self._drivers, self._worlds = LaneChains.join(worlds), drivers, worlds
        self._half = drivers.size_m[:, 0] / 2
        self._half_of_column = self._half.take(worlds.rows)
        blocked = [
            (self.chains.chain[first + lane], self.chains.offset_m[first + lane] + position)
            for first, network, boxes in zip(worlds.first_lane[:-1], worlds.networks, standing, strict=True)
            for lane, position in _blocked_lanes(network, boxes)
        ]
        self._obstacle_chain = np.array([chain for chain, _ in blocked], int)
        self._obstacle_m = np.array([position for _, position in blocked])

    def decide(self, now: VehicleState, tables: PathTables) -> tuple[list[Change], GapPairs]:
        """Return lane changes that begin now, and pairs that open gaps for mandatory ones."""
        lane, along = tables.lanes_at(now.at_m)
        own, chains = lane[:, 0], self.chains
        candidates = now.free & now.active & (own >= 0) & ~self._drivers.cyclist
        candidates &= (chains.left[own] >= 0) | (chains.right[own] >= 0)
        vehicles = np.flatnonzero(candidates)
        if not len(vehicles):
            return [], NO_GAP_PAIRS
        target = np.concatenate([chains.left[own[vehicles]], chains.right[own[vehicles]]])
        sides = np.flatnonzero(target >= 0)
        vehicles = vehicles[sides % len(vehicles)]
        options = self._options(now, vehicles, target[sides], (own[vehicles], along[vehicles, 0]))
        if not len(options.vehicles):
            return [], NO_GAP_PAIRS
        chain = np.where((lane >= 0) & now.active[:, None], chains.chain[lane], -1)
        return self._choose(now, options, (chain, chains.offset_m[lane] + along))

    def _options(self, now: VehicleState, vehicles: _Indices, target: _Indices, current: _Place) -> _Options:
        """Changes for which the lanes have room, and mandatory ones; ``current`` is the lane and the position on it."""
        own, along = current
        chains = self.chains
        chain, own_chain = chains.chain[target], chains.chain[own]
        position = chains.offset_m[target] + along / chains.lane_m[own] * chains.lane_m[target]
        own_at = chains.offset_m[own] + along
        left = chains.length_m[own_chain] - own_at
        speed = now.speed[vehicles]
        mandatory = chains.ends[own_chain] & (left < np.maximum(_LEAVE_M, _LEAVE_S * speed))
        length = np.maximum(_DURATION_S * speed, _SHORTEST_M)
        length = np.where(mandatory, np.minimum(length, np.maximum(left - 2.0, 8.0)), length)
        remainder = chains.length_m[chain] - position
        possible = (remainder > length + 3.0) & (~chains.ends[own_chain] | (left > length))
        optional = possible & (speed > _LEAST_MPS) & (position > _AFTER_M) & (remainder > length + _BEFORE_M)
        optional &= ~chains.exit[target] & ~chains.ends[chain]
        possible = np.where(mandatory, possible & ~chains.ends[chain], optional)
        limit = now.fastest[vehicles] * chains.limit[target] / chains.limit[own]
        k = np.flatnonzero(possible | mandatory)
        return _Options(vehicles[k], target[k], length[k], possible[k], mandatory[k], limit[k], left[k],
                        (chain[k], position[k]), (own_chain[k], own_at[k]))  # fmt: skip

    def _choose(
        self, now: VehicleState, options: _Options, occupied: _Occupied
    ) -> tuple[list[Change], GapPairs]:
        """Apply MOBIL to each option; take mandatory changes first, then those with the largest gain."""
        o, vehicles = options, options.vehicles
        speed = now.speed[vehicles]
        new_leader, new_follower = self._neighbours(now, vehicles, o.place, occupied)
        _, ahead_gap, ahead_speed = new_leader
        behind, behind_gap, _ = new_follower
        own = self._follow(vehicles, speed, o.limit_mps, ahead_gap, ahead_speed)
        # After the change the new follower follows the vehicle, and the old follower the vehicle's old leader.
        new_after, new_before = self._follower_accelerations(now, vehicles, new_follower, new_leader)
        old_leader, old_follower = self._neighbours(now, vehicles, o.own_place, occupied)
        old_before, old_after = self._follower_accelerations(now, vehicles, old_follower, old_leader)
        others = new_after - new_before + old_after - old_before
        gain = own - now.acceleration[vehicles] + self._drivers.politeness[vehicles] * others
        urgency = np.where(o.mandatory, 1.0 - np.clip(o.left_m / _LEAVE_M, 0.0, 1.0), 0.0)
        safe = _SAFE_MPS2 + urgency * (_URGENT_MPS2 - _SAFE_MPS2)
        follower_speed = np.where(behind >= 0, now.speed[np.maximum(behind, 0)], 0.0)
        accepted = o.possible & (new_after > -safe) & (own > -safe)
        accepted &= ahead_gap > _ROOM_M + _ROOM_S * np.maximum(speed - ahead_speed, 0.0) * 4
        accepted &= behind_gap > _ROOM_M + _ROOM_S * follower_speed * (1 - 0.6 * urgency)
        accepted &= o.mandatory | (gain > _THRESHOLD_MPS2)
        changes = self._drop_contested(now, options, accepted, gain)
        changing = {change.vehicle for change in changes}
        return changes, _gap_pairs(now, options, changing, new_leader, new_follower)

    def _follower_accelerations(
        self, now: VehicleState, vehicles: _Indices, follower: _Neighbour, leader: _Neighbour
    ) -> tuple[_Values, _Values]:
        """Return followers' accelerations behind the vehicle and behind its leader; 0 without a follower."""
        row, gap, _ = follower
        exists, row = row >= 0, np.maximum(row, 0)
        gaps = np.stack([gap, gap + 2 * self._half[vehicles] + leader[1]])
        leader_speed = np.stack([now.speed[vehicles], leader[2]])
        near, far = np.where(
            exists, self._follow(row, now.speed[row], now.fastest[row], gaps, leader_speed), 0.0
        )
        return near, far

    def _follow(
        self, rows: _Indices, speed: _Values, preferred: _Values, gap: _Stack, leader_speed: _Stack
    ) -> _Stack:
        return idm_acceleration(speed, preferred, gap, leader_speed, self._drivers.idm(rows))

    def _neighbours(
        self, now: VehicleState, vehicles: _Indices, place: _Place, occupied: _Occupied
    ) -> tuple[_Neighbour, _Neighbour]:
        """The nearest vehicle or obstacle ahead of each place on its chain, and the nearest vehicle behind."""
        chain, position = place
        pair, world = np.arange(len(vehicles)), self._worlds.world[vehicles]
        rows = self._worlds.rows[world]
        separation = occupied[1].take(rows, axis=0) - position[:, None, None]
        seen = (occupied[0].take(rows, axis=0) == chain[:, None, None]) & (rows >= 0)[..., None]
        seen[rows == vehicles[:, None]] = False
        half_of_column = self._half_of_column[world]
        neighbours = []
        for distance in (separation, -separation):
            slots = np.where(seen & (distance >= 0), distance, np.inf)
            # NumPy reduces a last axis this short several times more slowly.
            gap = reduce(np.minimum, np.moveaxis(slots, -1, 0)) - half_of_column
            column = gap.argmin(axis=1)
            nearest, row = gap[pair, column], rows[pair, column]
            neighbours.append((np.where(np.isfinite(nearest), row, -1), nearest, now.speed[row]))
        (row, nearest, speed), (behind, behind_gap, behind_speed) = neighbours
        if len(self._obstacle_m):
            ahead = self._obstacle_m - position[:, None]
            on_chain = (self._obstacle_chain == chain[:, None]) & (ahead > -3.0)
            obstacle = np.where(on_chain, ahead, np.inf).min(axis=1) - _HALF_OBSTACLE_M
            row, speed = np.where(obstacle < nearest, -1, row), np.where(obstacle < nearest, 0.0, speed)
            nearest = np.minimum(nearest, obstacle)
        half = self._half[vehicles]
        return (row, nearest - half, speed), (behind, behind_gap - half, behind_speed)

    def _drop_contested(self, now: VehicleState, options: _Options, ok: _Mask, gain: _Values) -> list[Change]:
        """Return the best option of each vehicle; only one vehicle enters a gap at a time."""
        changes: dict[int, Change] = {}
        entries: list[tuple[int, float]] = []
        order = sorted(
            (-float(gain[k]) - 100.0 * bool(options.mandatory[k]), int(options.vehicles[k]), k)
            for k in np.flatnonzero(ok)
        )
        for _, row, k in order:
            chain, own = int(self.chains.chain[options.target[k]]), float(now.at_m[row])
            if row not in changes and not any(
                c == chain and abs(own - position) < 40.0 for c, position in entries
            ):
                entries.append((chain, own))
                changes[row] = Change(row, int(options.target[k]), float(options.length_m[k]))
        return list(changes.values())


def _gap_pairs(
    now: VehicleState, options: _Options, changing: set[int], leader: _Neighbour, follower: _Neighbour
) -> GapPairs:
    """Pairs that adjust to each other because a mandatory change has found no room yet."""
    pairs: list[tuple[int, int, float]] = []
    for k in np.flatnonzero(options.mandatory):
        row, ahead, behind = (int(rows[k]) for rows in (options.vehicles, leader[0], follower[0]))
        if row in changing:
            continue
        if ahead >= 0 and ahead not in changing:
            pairs.append((row, ahead, float(leader[1][k])))
        if behind >= 0 and behind not in changing:
            pairs.append((behind, row, float(follower[1][k])))
    behind, ahead = np.array([pair[:2] for pair in pairs], int).reshape(-1, 2).T
    gap = np.array([pair[2] for pair in pairs]) - (now.at_m[ahead] - now.at_m[behind])
    return GapPairs(behind, ahead, gap)


def _blocked_lanes(network: RoadNetwork, boxes: Boxes) -> list[tuple[int, float]]:
    """Each lane of a chain that a standing obstacle blocks, and the position along it, m."""
    result, chain = [], lane_chains(network).chain
    for index in np.flatnonzero(chain >= 0).tolist() if len(boxes) else ():
        curve = network.lanes[index].curve
        dx, dy = (np.subtract.outer(boxes.xy[:, k], curve.xy[::2, k]) for k in (0, 1))
        gap = dx * dx + dy * dy
        for box in np.flatnonzero(gap.min(axis=1) < (0.95 + boxes.size_m[:, 1] / 2) ** 2):
            result.append((index, float(curve.arc_m[::2][np.argmin(gap[box])])))
    return result
