"""Destinations of ego for an event: places that it passes at a given time, and its route and start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivax.scenario.schema import RoadKind
from drivax.synthetic.roads.network import Control, RoadNetwork, Start
from drivax.synthetic.roads.signals import SignalPlan
from drivax.synthetic.traffic.paths import next_lanes
from drivax.synthetic.traffic.placement import Placement

#: Free speed of ego as a share of the limit.
_FREE_SPEED_SHARE = 0.88
#: Requested road behind ego at the beginning of the recording: seconds at its free speed plus metres.
_BEFORE_S, _BEHIND_M = 6.0, 15.0
#: Earliest time at which ego's light turns green, and earliest time at which this green ends, s.
_GREEN_S = (-5.0, 6.0)
#: On open roads: distance of the place from the lane's ends, m, and time of ego's arrival, s.
_BEFORE_M, _AFTER_M, _MIDWAY_S = 30.0, 30.0, (3.0, 6.0)
#: A follower's distance behind ego, and its least distance to the next vehicle and to the lane's beginning, m.
_FOLLOWS_M, _APART_M, _FROM_BEGIN_M = (16.0, 28.0), 20.0, 4.0
#: Least distance of ego's start to the end of a lane, m.
_FROM_END_M = 2.0


@dataclass(frozen=True)
class Destination:
    """A place that ego should pass.

    Attributes:
        along_m: Distance along the lane, low and high.
        when_s: Time of ego's arrival at free speed after the warm-up, low and high.
        alone: Whether ego's route must be empty ahead of ego, up to the end of the lane after ``lane``.
        followed: Whether a vehicle must be behind ego.
    """

    lane: int
    along_m: tuple[float, float]
    when_s: tuple[float, float]
    alone: bool = True
    followed: bool = False


@dataclass(frozen=True)
class DestinationRoute:
    """A route past a destination, with the destination's ``alone`` and ``followed``.

    The first lanes lie behind ego's start (its position after the warm-up), if the map has any there; the destination
    is on ``lanes[place]``.
    """

    start: Start
    lanes: tuple[int, ...]
    place: int
    alone: bool
    followed: bool


def open_road(
    network: RoadNetwork, lowest_limit_mps: float = 0.0, has_neighbour: bool = False
) -> tuple[Destination, ...]:
    """Return places away from the ends of ordinary lanes with a minimum speed limit, and with neighbours if needed."""
    return tuple(
        Destination(index, (_BEFORE_M, lane.length_m - _AFTER_M), _MIDWAY_S, alone=False)
        for index, lane in enumerate(network.lanes)
        if not (lane.connector or lane.ends or lane.exit_only or lane.kind == RoadKind.LANE_BIKE)
        and lane.length_m > _BEFORE_M + _AFTER_M
        and lane.limit_mps >= lowest_limit_mps
        and (not has_neighbour or max(lane.left, lane.right) >= 0)
    )


def draw_route(
    network: RoadNetwork, destinations: Sequence[Destination], rng: np.random.Generator
) -> DestinationRoute | None:
    """Draw a route past one of several destinations, or return None if :func:`route_past` fails for each."""
    order = rng.permutation(len(destinations)).tolist()
    routes = (route_past(network, destinations[index], rng) for index in order)
    return next((route for route in routes if route is not None), None)


def route_past(
    network: RoadNetwork, destination: Destination, rng: np.random.Generator
) -> DestinationRoute | None:
    """Draw a route past a destination to the end of the map, or return None if this draw fails.

    It fails if a light or sign would delay ego, the roads before the destination are too short for the time of arrival,
    ego would start on a connector, or the route would repeat lanes.
    """
    time, position = float(rng.uniform(*destination.when_s)), float(rng.uniform(*destination.along_m))
    lane, lanes = destination.lane, [destination.lane]
    while position < time * _free_mps(network, lane):
        time -= position / _free_mps(network, lane)
        feeders = _feeders(network, lanes)
        if not feeders or (lane != destination.lane and network.lanes[lane].control != Control.NONE):
            return None
        lane = int(rng.choice(feeders))
        lanes.insert(0, lane)
        position = network.lanes[lane].length_m
    current = network.lanes[lane]
    if current.connector:
        return None
    position = min(position - time * _free_mps(network, lane), current.length_m - _FROM_END_M)
    start, room = Start(lane, position, position), position
    while room < _BEFORE_S * _free_mps(network, lane) + _BEHIND_M and (feeders := _feeders(network, lanes)):
        lanes.insert(0, int(rng.choice(feeders)))
        room += network.lanes[lanes[0]].length_m
    index = len(lanes) - 1
    while network.lanes[lanes[-1]].successors:
        options = next_lanes(network, lanes)
        if not options:
            return None
        lanes.append(int(rng.choice(options)))
    return DestinationRoute(start, tuple(lanes), index, destination.alone, destination.followed)


def rearrange(
    others: Placement, route: DestinationRoute, ego: tuple[int, float], rng: np.random.Generator
) -> Placement:
    """Adapt the placement of other vehicles to a route: empty lanes ahead of ego, a follower where there is room.

    ``ego`` is the lane on which ego begins, and the distance along it.
    """
    places = list(zip(others.lane, others.along_m, strict=True))
    if route.alone:
        first = route.lanes.index(ego[0])
        lanes_ahead = route.lanes[first + 1 : route.place + 2]
        places = [p for p in places if p[0] not in lanes_ahead and not (p[0] == ego[0] and p[1] > ego[1])]
    if route.followed:
        follower = (ego[0], ego[1] - float(rng.uniform(*_FOLLOWS_M)))
        close_places = [p for p in places if p[0] == ego[0] and follower[1] - _APART_M < p[1] < ego[1]]
        places += [follower] if follower[1] > _FROM_BEGIN_M and not close_places else []
    return Placement(tuple(lane for lane, _ in places), tuple(along for _, along in places))


def green_on_arrival(plan: SignalPlan, lane: int) -> SignalPlan:
    """Shift a plan so that a lane's light is green when ego arrives."""
    phase = plan.phase_of(lane)
    green_at = max(_GREEN_S[0], _GREEN_S[1] - plan.green_s[phase])
    return replace(plan, offset_s=green_at - plan.starts_s[phase])


def _free_mps(network: RoadNetwork, lane: int) -> float:
    return _FREE_SPEED_SHARE * network.lanes[lane].limit_mps


def _feeders(network: RoadNetwork, lanes: list[int]) -> list[int]:
    """Predecessors of the first lane that are for cars and not part of the route."""
    before = network.lanes[lanes[0]].predecessors
    return [k for k in before if k not in lanes and network.lanes[k].kind != RoadKind.LANE_BIKE]
