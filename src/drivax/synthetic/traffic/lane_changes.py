"""Lane changes: when to change (MOBIL), when one has to, and how others help.

MOBIL: Kesting, Treiber and Helbing, "General lane-changing model MOBIL for car-following models", Transportation
Research Record 1999 (2007). A change is made when it is safe for the new follower, ``a_n' > -b_safe``, and when
``a' - a + p (a_n' - a_n + a_o' - a_o) > threshold``, with the own acceleration a, those of the new and the old
follower a_n and a_o, a dash for after the change, and the politeness p.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from jaxtyping import Bool, Float64, Int64

from drivax.scenario.schema import RoadKind
from drivax.simulator.idm import IdmParameters, idm_acceleration
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.obstacles import Boxes
from drivax.synthetic.traffic.path_arrays import PathTables
from drivax.synthetic.traffic.roles import Drivers

#: MOBIL: threshold and safe braking, m/s2; the latter grows to the second value as the own lane runs out.
_THRESHOLD_MPS2 = 0.25
_SAFE_MPS2, _URGENT_MPS2 = 2.5, 4.5
#: Who has to leave a lane begins to want so this far before its end, m, or this long.
_LEAVE_M, _LEAVE_S = 120.0, 9.0
#: A change takes this long, s, and at least this far, m; and is not made for pleasure below this speed, m/s.
_DURATION_S, _SHORTEST_M, _LEAST_MPS = 4.2, 14.0, 3.0
#: Bumper-to-bumper room that must be left ahead and behind, m and s.
_ROOM_M, _ROOM_S = 2.0, 0.25
#: After a change a driver stays for this long, s; no changes this close behind or before a junction, m.
_REST_S, _AFTER_M, _BEFORE_M = 4.0, 12.0, 25.0
#: Largest braking to make room for others, m/s2.
HELP_MPS2 = 1.8


class LaneChains:
    """Lanes that follow each other without a fork or a connector, as one line each.

    Attributes:
        chain, offset_m: Chain of each lane (-1: a connector), and where on it the lane begins.
        length_m, ends: Per chain: its length, and whether it runs out although the road goes on.
        left, right: Neighbour of each lane (-1: none that may be changed to).
    """

    def __init__(self, network: RoadNetwork) -> None:
        lanes = network.lanes
        self.chain, self.offset_m = np.full(len(lanes), -1), np.zeros(len(lanes))
        lengths, ends = [], []
        follows = {i: self._next(network, i) for i in range(len(lanes)) if not lanes[i].connector}
        heads = [i for i in follows if i not in set(follows.values())]
        for head in heads:
            at, lane = 0.0, head
            while True:
                self.chain[lane], self.offset_m[lane] = len(lengths), at
                at += lanes[lane].length_m
                if follows[lane] < 0:
                    break
                lane = follows[lane]
            lengths.append(at)
            ends.append(lanes[lane].ends and not lanes[lane].successors)
        self.length_m, self.ends = np.array([*lengths, 0.0]), np.array([*ends, False])
        self.left = np.array([self._open(network, lane.left) for lane in lanes])
        self.right = np.array([self._open(network, lane.right) for lane in lanes])
        self.lane_m = np.array([lane.length_m for lane in lanes])
        self.exit = np.array([lane.exit_only for lane in lanes])
        self.limit = np.array([lane.limit_mps for lane in lanes])

    @staticmethod
    def _next(network: RoadNetwork, lane: int) -> int:
        after = network.lanes[lane].successors
        if (
            len(after) != 1
            or network.lanes[after[0]].connector
            or len(network.lanes[after[0]].predecessors) != 1
        ):
            return -1
        return after[0]

    @staticmethod
    def _open(network: RoadNetwork, lane: int) -> int:
        closed = lane < 0 or network.lanes[lane].connector or network.lanes[lane].kind == RoadKind.LANE_BIKE
        return -1 if closed else lane


@dataclass(frozen=True)
class Change:
    """A decision: a vehicle goes over to a lane, over a length."""

    vehicle: int
    lane: int
    length_m: float


@dataclass(frozen=True)
class Helped:
    """Who must leave a lane, the vehicle ahead of which or behind which it will be, and their gap.

    Attributes:
        behind: Who follows the other (vehicle rows).
        ahead: Who is ahead.
        gap_m: Bumper-to-bumper gap along the lane less the difference of path positions, which is constant.
    """

    behind: Int64[np.ndarray, " pair"]
    ahead: Int64[np.ndarray, " pair"]
    gap_m: Float64[np.ndarray, " pair"]


@dataclass(frozen=True)
class Situation:
    """State of all vehicles when lane changes are decided.

    Attributes:
        free: Mask of vehicles that may change (not ego, cyclists, or vehicles that are changing).
        fastest: Fastest speed on the own path here.
        acceleration: Preferred acceleration on the own path.
    """

    at_m: Float64[np.ndarray, " v"]
    speed: Float64[np.ndarray, " v"]
    active: Bool[np.ndarray, " v"]
    free: Bool[np.ndarray, " v"]
    fastest: Float64[np.ndarray, " v"]
    acceleration: Float64[np.ndarray, " v"]


#: Row (-1: none or a thing), gap and speed of the nearest ahead or behind, per candidate.
_Next = tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]]
_Pair = tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]]


def _rows(parameters: IdmParameters, rows: Int64[np.ndarray, " k"]) -> IdmParameters:
    return replace(
        parameters,
        headway_s=parameters.headway_s[rows],
        acceleration_mps2=parameters.acceleration_mps2[rows],
        comfortable_braking_mps2=parameters.comfortable_braking_mps2[rows],
    )


class LaneChanges:
    """Lane-change decisions of all vehicles.

    Args:
        network: The roads.
        drivers: Who drives.
        standing: Things that stand in lanes.
    """

    def __init__(self, network: RoadNetwork, drivers: Drivers, standing: Boxes) -> None:
        self.chains, self._drivers, self._idm = LaneChains(network), drivers, drivers.idm
        self._half = drivers.size_m[:, 0] / 2
        self._thing_chain, self._thing_m = _on_chains(network, self.chains, standing)
        self._thing_half = np.full(len(self._thing_chain), 2.4)

    def decide(self, now: Situation, tables: PathTables) -> tuple[list[Change], Helped]:
        """Return lane changes that begin now, and pairs that open gaps for mandatory ones."""
        rows = np.arange(len(now.at_m))
        lane, along = tables.on(now.at_m, rows)
        own = lane[:, 0]
        chains = self.chains
        candidates = now.free & now.active & (own >= 0) & ~self._drivers.cyclist
        candidates &= (chains.left[own] >= 0) | (chains.right[own] >= 0)
        vehicles = np.flatnonzero(candidates)
        none = np.zeros(0, int)
        if not len(vehicles):
            return [], Helped(none, none, np.zeros(0))
        line = np.where(lane >= 0, chains.chain[lane], -1)
        line[~now.active] = -1
        place = chains.offset_m[lane] + along
        # To the left first, then to the right: who has a lane there, and may or must go over to it.
        target = np.concatenate([chains.left[own[vehicles]], chains.right[own[vehicles]]])
        sides = np.flatnonzero(target >= 0)
        vehicles, target = vehicles[sides % len(vehicles)], target[sides]
        options = self._possible(now, vehicles, target, (own[vehicles], along[vehicles, 0]))
        if not len(options.vehicles):
            return [], Helped(none, none, np.zeros(0))
        return self._chosen(now, self._weighed(now, options, (line, place)))

    def _possible(
        self,
        now: Situation,
        vehicles: Int64[np.ndarray, " k"],
        target: Int64[np.ndarray, " k"],
        here: tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, " k"]],
    ) -> _Options:
        """Changes for which there is room on the lanes, and those that have to be made."""
        own, along = here
        chains = self.chains
        chain = chains.chain[target]
        at = chains.offset_m[target] + along / chains.lane_m[own] * chains.lane_m[target]
        here_chain = chains.chain[own]
        here_at = chains.offset_m[own] + along
        left = chains.length_m[here_chain] - here_at
        speed = now.speed[vehicles]
        mandatory = chains.ends[here_chain] & (left < np.maximum(_LEAVE_M, _LEAVE_S * speed))
        length = np.maximum(_DURATION_S * speed, _SHORTEST_M)
        length = np.where(mandatory, np.minimum(length, np.maximum(left - 2.0, 8.0)), length)
        rest = chains.length_m[chain] - at
        possible = (rest > length + 3.0) & (~chains.ends[here_chain] | (left > length))
        wish = possible & (speed > _LEAST_MPS) & (at > _AFTER_M) & (rest > length + _BEFORE_M)
        wish &= ~chains.exit[target] & ~chains.ends[chain]
        possible = np.where(mandatory, possible & ~chains.ends[chain], wish)
        limit = now.fastest[vehicles] * chains.limit[target] / chains.limit[own]
        k = np.flatnonzero(possible | mandatory)
        return _Options(vehicles[k], target[k], length[k], possible[k], mandatory[k], limit[k], left[k],
                        (chain[k], at[k]), (here_chain[k], here_at[k]))  # fmt: skip

    def _weighed(
        self,
        now: Situation,
        options: _Options,
        lines: tuple[Int64[np.ndarray, "v slot"], Float64[np.ndarray, "v slot"]],
    ) -> _Weighed:
        """Evaluate the incentive and safety of each option."""
        o, vehicles, mandatory = options, options.vehicles, options.mandatory
        speed = now.speed[vehicles]
        new_lead, new = self._next(now, vehicles, o.there, lines)
        ahead, ahead_gap, ahead_speed = new_lead
        behind, behind_gap, _ = new
        mine = self._follow(vehicles, speed, o.limit_mps, ahead_gap, ahead_speed)
        # The new follower follows the vehicle ahead today and this one then; with the old one it is the other way.
        new_then, new_today = self._followed(now, vehicles, new, new_lead)
        old_lead, old = self._next(now, vehicles, o.here, lines)
        old_today, old_then = self._followed(now, vehicles, old, old_lead)
        others = new_then - new_today + old_then - old_today
        gain = mine - now.acceleration[vehicles] + self._drivers.politeness[vehicles] * others
        urgency = np.where(mandatory, 1.0 - np.clip(o.left_m / _LEAVE_M, 0.0, 1.0), 0.0)
        safe = _SAFE_MPS2 + urgency * (_URGENT_MPS2 - _SAFE_MPS2)
        follower_speed = np.where(behind >= 0, now.speed[np.maximum(behind, 0)], 0.0)
        ok = o.possible & (new_then > -safe) & (mine > -safe)
        ok &= ahead_gap > _ROOM_M + _ROOM_S * np.maximum(speed - ahead_speed, 0.0) * 4
        ok &= behind_gap > _ROOM_M + _ROOM_S * follower_speed * (1 - 0.6 * urgency)
        return _Weighed(o, ok & (mandatory | (gain > _THRESHOLD_MPS2)), gain,
                        ahead, ahead_gap, behind, behind_gap)  # fmt: skip

    def _followed(
        self, now: Situation, vehicles: Int64[np.ndarray, " k"], behind: _Next, ahead: _Next
    ) -> _Pair:
        """Return followers' accelerations behind the vehicle and behind its leader; 0 without a follower."""
        row, gap, _ = behind
        there, row = row >= 0, np.maximum(row, 0)
        gaps = np.stack([gap, gap + 2 * self._half[vehicles] + ahead[1]])
        then = self._follow(
            row, now.speed[row], now.fastest[row], gaps, np.stack([now.speed[vehicles], ahead[2]])
        )
        near, far = np.where(there, then, 0.0)
        return near, far

    def _follow(
        self,
        rows: Int64[np.ndarray, " k"],
        speed: Float64[np.ndarray, " k"],
        preferred: Float64[np.ndarray, " k"],
        gap: Float64[np.ndarray, "*k"],
        leader_speed: Float64[np.ndarray, "*k"],
    ) -> Float64[np.ndarray, "*k"]:
        return idm_acceleration(speed, preferred, gap, leader_speed, _rows(self._idm, rows))

    def _next(
        self,
        now: Situation,
        vehicles: Int64[np.ndarray, " k"],
        where: tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, " k"]],
        lines: tuple[Int64[np.ndarray, "v slot"], Float64[np.ndarray, "v slot"]],
    ) -> tuple[_Next, _Next]:
        """The nearest on a chain ahead of a place, and the nearest behind it."""
        line, place = lines
        chain, at = where
        pair = np.arange(len(vehicles))
        apart = place - at[:, None, None]
        seen = line == chain[:, None, None]
        seen[pair, vehicles] = False
        neighbours = []
        for distance in (apart, -apart):
            slots = np.where(seen & (distance >= 0), distance, np.inf)
            # NumPy reduces a last axis this short several times more slowly.
            gap = reduce(np.minimum, np.moveaxis(slots, -1, 0)) - self._half
            row = gap.argmin(axis=1)
            nearest = gap[pair, row]
            neighbours.append((np.where(np.isfinite(nearest), row, -1), nearest, now.speed[row]))
        (row, nearest, speed), (back, behind, slower) = neighbours
        if len(self._thing_m):
            ahead = self._thing_m - at[:, None]
            there = (self._thing_chain == chain[:, None]) & (ahead > -3.0)
            thing = np.where(there, ahead, np.inf).min(axis=1) - 2.4
            stands = thing < nearest
            row, speed = np.where(stands, -1, row), np.where(stands, 0.0, speed)
            nearest = np.minimum(nearest, thing)
        return (row, nearest - self._half[vehicles], speed), (back, behind - self._half[vehicles], slower)

    def _chosen(self, now: Situation, weighed: _Weighed) -> tuple[list[Change], Helped]:
        changes: list[Change] = []
        taken: list[tuple[int, float]] = []
        o = weighed.options
        order = sorted(
            (-float(weighed.gain[k]) - 100.0 * bool(o.mandatory[k]), int(o.vehicles[k]), k)
            for k in np.flatnonzero(weighed.ok)
        )
        moved: set[int] = set()
        for _, row, k in order:
            chain = int(self.chains.chain[o.target[k]])
            # Two who go for the same gap in the same moment would meet in it.
            crowded = any(c == chain and abs(now.at_m[row] - at) < 40.0 for c, at in taken)
            if row not in moved and not crowded:
                moved.add(row)
                taken.append((chain, float(now.at_m[row])))
                changes.append(Change(row, int(o.target[k]), float(o.length_m[k])))
        return changes, _helped(now, weighed, moved)


@dataclass(frozen=True)
class _Options:
    """Changes that may or must be made, one entry per change: to the left first, each side in order of vehicles.

    Attributes:
        vehicles, target: The vehicle and its new lane.
        length_m: How long the change takes.
        possible, mandatory: Whether it may be made as far as the lanes go, and whether it has to.
        limit_mps: The speed that the driver likes on the new lane.
        left_m: What is left of the own chain of lanes.
        there, here: Chain and place on the new and the own lane.
    """

    vehicles: Int64[np.ndarray, " k"]
    target: Int64[np.ndarray, " k"]
    length_m: Float64[np.ndarray, " k"]
    possible: Bool[np.ndarray, " k"]
    mandatory: Bool[np.ndarray, " k"]
    limit_mps: Float64[np.ndarray, " k"]
    left_m: Float64[np.ndarray, " k"]
    there: tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, " k"]]
    here: tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, " k"]]


@dataclass(frozen=True)
class _Weighed:
    """Options with what they bring, and the nearest ahead and behind on the new lane."""

    options: _Options
    ok: Bool[np.ndarray, " k"]
    gain: Float64[np.ndarray, " k"]
    ahead: Int64[np.ndarray, " k"]
    ahead_gap: Float64[np.ndarray, " k"]
    behind: Int64[np.ndarray, " k"]
    behind_gap: Float64[np.ndarray, " k"]


def _helped(now: Situation, weighed: _Weighed, moved: set[int]) -> Helped:
    """Pairs that adjust to each other because one of them must change and has not found room yet."""
    pairs: list[tuple[int, int, float]] = []
    for k in np.flatnonzero(weighed.options.mandatory):
        row, ahead, behind = (
            int(vehicles[k]) for vehicles in (weighed.options.vehicles, weighed.ahead, weighed.behind)
        )
        if row in moved:
            continue
        if ahead >= 0 and ahead not in moved:
            pairs.append((row, ahead, float(weighed.ahead_gap[k])))
        if behind >= 0 and behind not in moved:
            pairs.append((behind, row, float(weighed.behind_gap[k])))
    behind = np.array([p[0] for p in pairs], int)
    ahead = np.array([p[1] for p in pairs], int)
    gap = np.array([p[2] for p in pairs]) - (now.at_m[ahead] - now.at_m[behind])
    return Helped(behind, ahead, gap)


def _on_chains(
    network: RoadNetwork, chains: LaneChains, boxes: Boxes
) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
    """Where standing things block lanes: chain and position of each."""
    thing_chain, thing_m = [], []
    for index, lane in enumerate(network.lanes):
        if chains.chain[index] < 0 or not len(boxes):
            continue
        gap = np.sum((boxes.xy[:, None] - lane.curve.xy[::2]) ** 2, axis=-1)
        for thing in np.flatnonzero(gap.min(axis=1) < (0.95 + boxes.size_m[:, 1] / 2) ** 2):
            thing_chain.append(chains.chain[index])
            thing_m.append(chains.offset_m[index] + float(lane.curve.arc_m[::2][np.argmin(gap[thing])]))
    return np.array(thing_chain, int), np.array(thing_m)
