"""Initial placement of vehicles with safe gaps, parked cars, and drivers."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from drivax.scenario.schema import AgentKind, RoadKind
from drivax.synthetic.roads.curves import Pose
from drivax.synthetic.roads.network import Bay, Lane, RoadNetwork
from drivax.synthetic.traffic.paths import Path, Sway, lane_path
from drivax.synthetic.traffic.roles import Drivers, ScriptedUser

#: Width left next to a double-parked car where it can be passed within the lane, m.
_PASSAGE_M = 2.3
#: Free length in an occupied bay, m.
_MANOEUVRING_ROOM_M = 0.6
#: Distance of double-parked cars from the ends of lanes, m.
_MIN_FROM_ENDS_M = 15.0
#: Smallest distance between centres of vehicles placed on a lane (except from ego to the leader of ``leader_share``):
#: a vehicle's length and a gap, m, and a time gap, s.
_LENGTH_M, _GAP_M, _GAP_S = 10.0, 5.0, 0.9
#: Least distance of placed vehicles from the ends of lanes, m.
_LANE_END_M = 6.0
#: Free gaps on busy lanes relative to those elsewhere.
_BUSY_GAP_SHARE = 0.4
#: Speed limit above which no cyclists start, except on bicycle lanes, m/s; cyclists' distance from the right side, m.
_MAX_CYCLING_LIMIT_MPS, _KERB_M = 16.0, 0.55
#: Time before the end of a lane with ``ends`` within which no vehicle is placed, s.
_MERGE_S = 5.0
#: Free distance before and behind an obstacle in a lane, and width of the widest vehicle, m.
_FREE_BEFORE_M, _FREE_BEHIND_M, _MAX_WIDTH_M = 30.0, 14.0, 2.55
#: Distance between centres of vehicles on different lanes that share space, m.
_MIN_SEPARATION_M = 15.0
_CAR, _VAN, _TRUCK, _BUS, _CYCLIST = range(5)
#: Smallest and largest length, width and height of each type, m.
_SIZES = np.array(
    [
        [[3.9, 1.7, 1.35], [5.3, 2.05, 1.85]],
        [[5.0, 1.95, 2.0], [6.4, 2.1, 2.7]],
        [[7.0, 2.3, 2.8], [9.5, 2.5, 3.6]],
        [[10.5, 2.5, 2.9], [12.0, 2.55, 3.3]],
        [[1.7, 0.6, 1.65], [1.9, 0.7, 1.85]],
    ]
)
#: Length and width of the largest vehicle, m.
LARGEST_VEHICLE_M: tuple[float, float] = (float(_SIZES[_BUS, 1, 0]), float(_SIZES[_BUS, 1, 1]))

#: Lane and distance along it, m.
_Place = tuple[int, float]
_Places = list[_Place]


def parked_cars(
    network: RoadNetwork, share: float, double_share: float, rng: np.random.Generator, steps: int
) -> tuple[ScriptedUser, ...]:
    """Draw parked cars in bays, and sometimes a double-parked one.

    A bay is occupied with probability ``share``. With probability ``double_share`` a car is double-parked next to a bay
    where others can pass it: on an adjacent or oncoming lane, or within the lane.
    """
    result = []
    for bay in network.bays:
        # Draw for every bay, so that the cars do not depend on the share of occupied bays.
        size = _draw_size(rng, bay.length_m)
        along, lateral = rng.normal(0.0, 0.15), rng.normal(0.0, 0.07)
        turn = math.pi * (rng.random() < 0.03) + rng.normal(0.0, math.radians(1.2))
        is_occupied = rng.random() < share
        if is_occupied and size[0] < bay.length_m:
            clearance = (bay.length_m - size[0]) / 2
            pose = bay.pose.ahead(float(np.clip(along, -clearance, clearance)))
            pose = replace(pose.shift_left(float(np.clip(lateral, -0.15, 0.15))), heading=pose.heading + turn)
            result.append(ScriptedUser.from_pose(AgentKind.VEHICLE, size, pose, steps))
    has_double_parked, gap_m = rng.random() < double_share, float(rng.uniform(0.0, 0.25))
    for index in rng.permutation(len(network.bays)).tolist() if has_double_parked else ():
        bay, size = network.bays[index], _draw_size(rng, network.bays[index].length_m)
        if _can_double_park(network, bay, size[1], gap_m):
            pose = _double_parked_pose(network, bay, size[1], gap_m)
            return (*result, ScriptedUser.from_pose(AgentKind.VEHICLE, size, pose, steps))
    return tuple(result)


def _draw_size(rng: np.random.Generator, room_m: float) -> tuple[float, float, float]:
    """Draw the size of a car or, in one of eight bays longer than 6.2 m, a van that fits the bay."""
    length = float(np.clip(rng.normal(4.5, 0.35), 3.6, 5.2))
    if rng.random() < 0.125 and room_m > 6.2:
        return min(length + 0.8, room_m - _MANOEUVRING_ROOM_M), 2.0, 2.3
    return min(length, room_m - _MANOEUVRING_ROOM_M), float(np.clip(rng.normal(1.82, 0.06), 1.65, 1.95)), 1.55


def _double_parked_pose(network: RoadNetwork, bay: Bay, width_m: float, gap_m: float) -> Pose:
    """Return the pose in the lane next to a bay, at the lane's border."""
    lane = network.lanes[bay.lane]
    centre = _pose_at(lane, bay.along_m)
    dx, dy = bay.pose.x - centre.x, bay.pose.y - centre.y
    side = math.copysign(1.0, dy * math.cos(centre.heading) - dx * math.sin(centre.heading))
    return centre.shift_left(side * ((lane.width_m - width_m) / 2 - gap_m))


def _can_double_park(network: RoadNetwork, bay: Bay, width_m: float, gap_m: float) -> bool:
    """Return whether a car may be double-parked next to a bay: away from lane ends, with room for others to pass."""
    lane = network.lanes[bay.lane]
    if lane.connector or not _MIN_FROM_ENDS_M < bay.along_m < lane.length_m - _MIN_FROM_ENDS_M:
        return False
    if lane.left >= 0 or lane.right >= 0 or lane.width_m - width_m - gap_m >= _PASSAGE_M:
        return True
    return _has_oncoming_lane(network, lane, bay.along_m)


def _has_oncoming_lane(network: RoadNetwork, lane: Lane, along_m: float) -> bool:
    """Return whether a lane has an adjacent lane of the other direction."""
    current = _pose_at(lane, along_m)
    for other in network.lanes:
        gap = np.hypot(other.curve.xy[:, 0] - current.x, other.curve.xy[:, 1] - current.y)
        index = int(np.argmin(gap))
        separation = (lane.width_m + other.width_m) / 2 + 0.5
        if gap[index] < separation and math.cos(other.curve.heading[index] - current.heading) < -0.9:
            return True
    return False


def _pose_at(lane: Lane, along_m: float) -> Pose:
    """Interpolate the pose at a distance along a lane."""
    arc = lane.curve.arc_m
    x, y = (float(np.interp(along_m, arc, lane.curve.xy[:, axis])) for axis in (0, 1))
    return Pose(x, y, float(np.interp(along_m, arc, lane.curve.heading)))


@dataclass(frozen=True)
class Density:
    """Density and composition of traffic.

    Attributes:
        spacing_m: Mean gap between vehicles of a lane beyond the smallest one, drawn per scenario, low and high.
        vehicles: Maximum number of vehicles without ego; those nearest to ego are kept.
        van_share, truck_share, bus_share: Shares of vehicle types; the rest are cars.
        cyclist_share: Share of cyclists on lanes with a limit of at most 16 m/s.
        leader_share: Share of scenarios, of those with room on ego's lane, in which a vehicle is first placed 18 to
            45 m ahead of ego.
    """

    spacing_m: tuple[float, float] = (25.0, 90.0)
    vehicles: int = 32
    van_share: float = 0.1
    truck_share: float = 0.05
    bus_share: float = 0.02
    cyclist_share: float = 0.03
    leader_share: float = 0.5


@dataclass(frozen=True)
class Placement:
    """Vehicles placed on lanes: lane index, and distance of the centre along it in m."""

    lane: tuple[int, ...]
    along_m: tuple[float, ...]


def place_vehicles(
    network: RoadNetwork, ego_lane: int, ego_along_m: float, density: Density, rng: np.random.Generator,
    parked: tuple[ScriptedUser, ...] = (), busy: Collection[int] = (),
) -> Placement:  # fmt: skip
    """Draw initial positions off connectors, with safe gaps to ego, other vehicles and parked cars.

    Ego's leader is on ego's lane, even if that is a connector, and may be as close as 18 m.
    Lanes in ``busy`` are as dense as the network's busy ones.
    """
    spacing = rng.uniform(*density.spacing_m)
    vehicles: _Places = []
    if rng.random() < density.leader_share:
        ahead = ego_along_m + rng.uniform(18.0, 45.0)
        if ahead < network.lanes[ego_lane].length_m - _LANE_END_M:
            vehicles.append((ego_lane, ahead))
    for index, lane in enumerate(network.lanes):
        if lane.connector:
            continue
        minimum = _least_spacing_m(lane)
        occupied = [along for other, along in vehicles if other == index]
        occupied += [ego_along_m] if index == ego_lane else []
        mean = spacing * (_BUSY_GAP_SHARE if index in network.busy or index in busy else 1.0)
        position = rng.uniform(_LANE_END_M, _LANE_END_M + mean)
        while position < lane.length_m - (_MERGE_S * lane.limit_mps if lane.ends else _LANE_END_M):
            if all(abs(position - other) > minimum for other in occupied):
                vehicles.append((index, float(position)))
                occupied.append(float(position))
            position += minimum + rng.exponential(mean)
    blockers = [(*user.xy[0].tolist(), float(user.size_m[1])) for user in parked]
    vehicles = [vehicle for vehicle in vehicles if not _is_blocked(network, *vehicle, blockers)]
    vehicles = _drop_close_followers(network, vehicles, (ego_lane, ego_along_m))
    current = network.lanes[ego_lane].curve
    ego_xy = current.xy[np.searchsorted(current.arc_m, ego_along_m).clip(max=len(current.xy) - 1)]
    vehicles.sort(key=lambda vehicle: float(np.hypot(*(_point_on_lane(network, *vehicle) - ego_xy))))
    vehicles = _drop_overlapping(network, vehicles, (ego_lane, ego_along_m), density.vehicles)
    return Placement(tuple(lane for lane, _ in vehicles), tuple(along for _, along in vehicles))


def _least_spacing_m(lane: Lane) -> float:
    return _LENGTH_M + _GAP_M + _GAP_S * lane.limit_mps


def _drop_overlapping(network: RoadNetwork, vehicles: _Places, ego: _Place, most: int) -> _Places:
    """Drop vehicles close to an earlier one, even on another lane; keep at most the first ``most`` of the others."""
    centres: list[tuple[float, float]] = []
    result = []
    for lane, along in [ego, *vehicles]:
        curve = network.lanes[lane].curve
        x, y = _point_on_lane(network, lane, along).tolist()
        heading = np.interp(along, curve.arc_m, curve.heading)
        cos, sin = float(np.cos(heading)), float(np.sin(heading))
        is_close = (
            abs((x - a) * cos + (y - b) * sin) < _MIN_SEPARATION_M
            and abs((y - b) * cos - (x - a) * sin) < _MAX_WIDTH_M
            for a, b in centres
        )
        if not any(is_close):
            centres.append((x, y))
            result.append((lane, along))
        if len(result) > most:
            break
    return result[1:]


def _is_blocked(
    network: RoadNetwork, lane: int, along: float, parked: Sequence[tuple[float, float, float]]
) -> bool:
    """Return whether a parked car is in a straight strip, a vehicle wide, from 14 m behind a position to 30 m ahead.

    ``parked`` has the x, y and width of each car. Bends are ignored: cars in bays on their outside may count, and cars
    in the lane further ahead may not.
    """
    curve = network.lanes[lane].curve
    index = min(int(along / network.lanes[lane].length_m * len(curve.xy)), len(curve.xy) - 1)
    x, y = curve.xy[index].tolist()
    cos, sin = float(np.cos(curve.heading[index])), float(np.sin(curve.heading[index]))
    for other_x, other_y, width in parked:
        dx, dy = other_x - x, other_y - y
        ahead, lateral = dx * cos + dy * sin, abs(dy * cos - dx * sin)
        if -_FREE_BEHIND_M < ahead < _FREE_BEFORE_M and lateral < (_MAX_WIDTH_M + width) / 2:
            return True
    return False


def _drop_close_followers(network: RoadNetwork, vehicles: _Places, ego: _Place) -> _Places:
    """Drop vehicles too close across the end of a lane: to the first one on the next lane, or to ego behind them."""
    remaining = []
    first: dict[int, float] = {}
    last: dict[int, float] = {}
    for lane, along in [*vehicles, ego]:
        first[lane], last[lane] = min(along, first.get(lane, np.inf)), max(along, last.get(lane, 0.0))
    ego_lane, ego_along_m = ego
    ego_to_end_m = network.lanes[ego_lane].length_m - ego_along_m
    for lane, along in vehicles:
        current = network.lanes[lane]
        minimum = _least_spacing_m(current)
        # Only the last vehicle of a lane can be too close to the first one of the next lane.
        next_along = min((first.get(b, np.inf) for b in current.successors), default=np.inf)
        is_too_close = along >= last[lane] and current.length_m - along + next_along <= minimum
        # Ego always stays: the vehicle ahead of it is dropped instead.
        is_too_close |= ego_lane in current.predecessors and ego_to_end_m + along <= minimum
        if not is_too_close:
            remaining.append((lane, along))
    return remaining


def _point_on_lane(network: RoadNetwork, lane: int, along: float) -> Float64[np.ndarray, " 2"]:
    """Return the sample of a lane at about a distance along it."""
    curve = network.lanes[lane].curve
    return curve.xy[min(int(along / network.lanes[lane].length_m * len(curve.xy)), len(curve.xy) - 1)]


def draw_drivers(
    count: int, density: Density, rng: np.random.Generator, lanes: Sequence[Lane] | None = None
) -> Drivers:
    """Draw vehicles and drivers.

    With ``lanes``, the first lane of each vehicle, fast roads get no cyclists, and bicycle lanes only cyclists.
    """
    shares = np.cumsum([density.van_share, density.truck_share, density.bus_share, density.cyclist_share])
    # Types in the order of the shares; the rest are cars.
    kind = (np.searchsorted(shares, rng.random(count), side="right") + 1) % (len(shares) + 1)
    if lanes is not None:
        is_fast = np.array([lane.limit_mps > _MAX_CYCLING_LIMIT_MPS for lane in lanes], bool)
        kind[(kind == _CYCLIST) & is_fast] = _CAR
        kind[np.array([lane.kind == RoadKind.LANE_BIKE for lane in lanes], bool)] = _CYCLIST
    size = rng.uniform(_SIZES[kind, 0], _SIZES[kind, 1])
    is_heavy, cyclist = (kind == _TRUCK) | (kind == _BUS), kind == _CYCLIST
    speed_scale = np.where(is_heavy, 0.85, 1.0)
    return Drivers(
        kind=np.where(cyclist, AgentKind.CYCLIST, AgentKind.VEHICLE).astype(np.int8),
        size_m=size,
        speed_factor=speed_scale * rng.normal(0.92, 0.12, count).clip(0.55, 1.1),
        top_speed_mps=np.where(cyclist, rng.uniform(4.0, 7.0, count), np.inf),
        lateral_mps2=np.where(is_heavy, 0.8, 1.0) * rng.uniform(1.8, 2.5, count),
        slowing_mps2=rng.uniform(1.1, 1.8, count),
        yellow_mps2=rng.uniform(2.3, 3.0, count),
        jerk_mps3=rng.uniform(3.0, 5.0, count),
        headway_s=rng.uniform(1.1, 2.0, count),
        acceleration_mps2=np.where(cyclist, 0.6, np.where(is_heavy, 0.7, 1.0)) * rng.uniform(1.1, 2.0, count),
        braking_mps2=rng.uniform(2.0, 3.0, count),
        politeness=rng.uniform(0.0, 0.5, count),
        reaction_s=rng.uniform(0.1, 0.6, count),
        critical_gap_s=rng.uniform(3.5, 6.0, count),
    )


def draw_path(network: RoadNetwork, lanes: tuple[int, ...], cyclist: bool, rng: np.random.Generator) -> Path:
    """Draw a path along lanes: cars near the centre, cyclists near the right side."""
    if not cyclist:
        return lane_path(network, lanes, Sway.draw(rng, 0.2))
    narrowest = min(network.lanes[lane].width_m for lane in lanes)
    return lane_path(network, lanes, Sway.draw(rng, 0.1, aside_m=_KERB_M - narrowest / 2))


def join_drivers(*drivers: Drivers) -> Drivers:
    """Concatenate sets of drivers."""
    names = vars(drivers[0])
    return Drivers(**{name: np.concatenate([getattr(group, name) for group in drivers]) for name in names})
