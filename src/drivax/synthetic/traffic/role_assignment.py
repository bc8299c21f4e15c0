"""Draw the roles of a scenario: ego's route, other vehicles and drivers, pedestrians, parked cars, lights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float64

from drivax.synthetic.domains import Domain
from drivax.synthetic.events.destinations import (
    Destination,
    DestinationRoute,
    draw_route,
    green_on_arrival,
    rearrange,
)
from drivax.synthetic.expert import driver as expert
from drivax.synthetic.roads.network import Control, RoadNetwork
from drivax.synthetic.roads.signals import SignalPlan
from drivax.synthetic.traffic.path_arrays import driver_profile
from drivax.synthetic.traffic.paths import Path, random_lanes
from drivax.synthetic.traffic.pedestrians import place_pedestrians
from drivax.synthetic.traffic.placement import (
    draw_drivers,
    draw_path,
    join_drivers,
    parked_cars,
    place_vehicles,
)
from drivax.synthetic.traffic.roles import Drivers, Roles

#: Length of lanes with dense traffic before a conflict, m.
_FEEDER_LENGTH_M = 160.0
#: Arrival of an unhindered ego at a place where it gives way, s after the warm-up.
_ARRIVAL_S = (0.4, 4.0)
#: Least position of ego along its path before the warm-up, m.
_MIN_START_M = 12.0
#: Largest number of further draws of a route, until ego must give way on it.
_EXTRA_ROUTES = 4
#: Shares of the states of ego's next light at time 0: green, turning green, turning yellow within 5 s.
SignalTiming = tuple[float, float, float]
_Values = Float64[np.ndarray, " n"]


def yielding_destinations(network: RoadNetwork) -> tuple[Destination, ...]:
    """Return destinations on connectors at all-way stops, and on those that yield to connectors which never yield."""
    return tuple(
        Destination(index, (0.0, min(3.0, lane.length_m)), _ARRIVAL_S)
        for index, lane in enumerate(network.lanes)
        if lane.control == Control.ALL_WAY_STOP or any(not network.lanes[k].yields_to for k in lane.yields_to)
    )


def conflicts_on(network: RoadNetwork, path: Path) -> frozenset[int]:
    """Return the lanes whose traffic ego must let pass on a path.

    These are the connectors to which it yields, unless these yield too, the conflicting connectors at all-way stops,
    and the lanes to which it changes.
    """
    result: set[int] = set()
    for before, span in pairwise((path.spans[0], *path.spans)):
        lane, previous = network.lanes[span.lane], network.lanes[before.lane]
        if span.lane in (previous.left, previous.right):
            result.add(span.lane)
        if lane.control == Control.ALL_WAY_STOP:
            result.update(np.flatnonzero(network.conflicts[span.lane]).tolist())
        result.update(rival for rival in lane.yields_to if not network.lanes[rival].yields_to)
    return frozenset(result)


def add_feeders(network: RoadNetwork, lanes: frozenset[int]) -> frozenset[int]:
    """Add the lanes that lead to any of several lanes within 160 m.

    The search is depth first: a lane that it first reaches by the longer of two paths may lack feeders.
    """
    result: set[int] = set()
    queue = [(lane, 0.0) for lane in sorted(lanes)]
    while queue:
        lane, distance_m = queue.pop()
        if lane not in result and distance_m < _FEEDER_LENGTH_M:
            result.add(lane)
            current = network.lanes[lane]
            queue += [(before, distance_m + current.length_m) for before in current.predecessors]
    return frozenset(result)


def assign_roles(
    network: RoadNetwork, domain: Domain, times_s: _Values, lane_change_share: float, timing: SignalTiming,
    rng: np.random.Generator, destinations: Sequence[Destination] = (), critical: bool = False,
) -> Roles:  # fmt: skip
    """Draw ego, its route and its lights, then all other users.

    Args:
        network: The roads.
        domain: Density and composition of traffic.
        times_s: Times of all steps; the warm-up of traffic ends at time 0.
        lane_change_share: Share of random routes with room for it on which ego plans a lane change.
        timing: Shares of the states of ego's next light at time 0; on a route past an ``alone`` destination the light
            is green on arrival.
        rng: Source of randomness.
        destinations: Candidate places for ego to pass; if the draws of routes past them fail, its route is random.
        critical: Whether ego must give way to dense traffic, if the roads allow it; ``destinations`` are ignored.
    """
    driver = expert.draw_expert(rng)
    destination_route = draw_route(network, yielding_destinations(network) if critical else destinations, rng)
    attempts = _EXTRA_ROUTES if critical and destination_route is None else 0
    lanes, path, position = _draw_route(
        network, driver, float(times_s[0]), lane_change_share, rng, destination_route, attempts
    )
    rivals = add_feeders(network, conflicts_on(network, path)) if critical else frozenset()
    network = network.with_signals(_shift_lights(network, lanes, timing, destination_route, rng))
    current = max((span for span in path.spans if span.begin_m <= position), key=lambda span: span.begin_m)
    density, share = domain.density, float(rng.uniform(*domain.parked_share))
    parked = parked_cars(network, share, domain.double_share, rng, len(times_s))
    others = place_vehicles(network, current.lane, position - current.begin_m, density, rng, parked, rivals)
    if destination_route is not None:
        others = rearrange(others, destination_route, (current.lane, position - current.begin_m), rng)
    first_lanes = [network.lanes[lane] for lane in others.lane]
    drivers = join_drivers(driver, draw_drivers(len(first_lanes), density, rng, first_lanes))
    paths = [path]
    for lane, cyclist in zip(others.lane, drivers.cyclist[1:], strict=True):
        paths.append(draw_path(network, random_lanes(network, lane, rng, rivals), bool(cyclist), rng))
    distance = np.array([position, *others.along_m])
    return Roles(
        network=network,
        paths=paths,
        drivers=drivers,
        distance_m=distance,
        speed_mps=_initial_speeds(network, paths, drivers, distance, rng),
        route=lanes,
        pedestrians=place_pedestrians(network, float(rng.uniform(*domain.pedestrians)), rng, times_s),
        parked=parked,
    )


def _draw_route(
    network: RoadNetwork, driver: Drivers, first_s: float, lane_change_share: float, rng: np.random.Generator,
    destination_route: DestinationRoute | None, attempts: int = 0,
) -> tuple[tuple[int, ...], Path, float]:  # fmt: skip
    """Draw ego's lanes, path and position before the warm-up; redraw up to ``attempts`` times until it must yield."""
    if destination_route is None:
        start = network.starts[int(rng.integers(len(network.starts)))]
        lanes, change = expert.expert_lanes(network, start.lane, lane_change_share, rng)
    else:
        start, lanes, change = destination_route.start, destination_route.lanes, None
    path = expert.expert_path(network, lanes, change, rng)
    cruise = 0.9 * float(driver.speed_factor[0]) * network.lanes[start.lane].limit_mps
    first = next(span for span in path.spans if span.lane == start.lane)
    position = max(
        _MIN_START_M, float(first.begin_m + rng.uniform(start.low_m, start.high_m) + first_s * cruise)
    )
    if attempts and not conflicts_on(network, path):
        return _draw_route(network, driver, first_s, lane_change_share, rng, destination_route, attempts - 1)
    return lanes, path, position


def _shift_lights(
    network: RoadNetwork, lanes: tuple[int, ...], timing: SignalTiming,
    destination_route: DestinationRoute | None, rng: np.random.Generator,
) -> SignalPlan | None:  # fmt: skip
    """Shift the plan: ego's next light is green at time 0 or on arrival, or turns green or yellow within 5 s."""
    plan, ahead = network.signals, lanes if destination_route is None else lanes[destination_route.place :]
    signalised = [lane for lane in ahead if network.lanes[lane].control == Control.SIGNAL]
    if plan is None or not signalised:
        return plan
    if destination_route is not None and destination_route.alone:
        return green_on_arrival(plan, signalised[0])
    phase = plan.phase_of(signalised[0])
    match int(rng.choice(3, p=timing)):
        case 0:
            green_at = -rng.uniform(0.0, 3.0)
        case 1:
            green_at = rng.uniform(0.5, 5.0)
        case _:
            green_at = rng.uniform(0.3, 4.5) - plan.green_s[phase]
    return replace(plan, offset_s=float(green_at) - plan.starts_s[phase])


def _initial_speeds(
    network: RoadNetwork, paths: list[Path], drivers: Drivers, distance: _Values, rng: np.random.Generator
) -> _Values:
    """Draw speeds at which each vehicle can stop 2 m before its next connector at 1.5 m/s2."""
    speeds = []
    for i, path in enumerate(paths):
        fastest = driver_profile(path, drivers, i)
        speed = fastest[min(int(distance[i] / path.step_m), len(fastest) - 1)] * rng.uniform(0.7, 1.0)
        front = distance[i] + drivers.size_m[i, 0] / 2
        lines = [s.begin_m - front for s in path.spans if network.lanes[s.lane].connector]
        room = min((line for line in lines if line >= 0), default=math.inf)
        speeds.append(min(float(speed), math.sqrt(2 * 1.5 * max(room - 2.0, 0.0))))
    return np.array(speeds)
