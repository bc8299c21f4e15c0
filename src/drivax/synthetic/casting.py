"""Who takes part in a scenario: ego on its way, the others with their drivers, people on foot, parked cars, lights."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from drivax.synthetic import expert
from drivax.synthetic.cast import Cast
from drivax.synthetic.domains import Domain
from drivax.synthetic.drivers import Drivers
from drivax.synthetic.parking import parked_cars
from drivax.synthetic.paths import Path, random_lanes
from drivax.synthetic.population import drawn_drivers, driven_path, joined_drivers, placed
from drivax.synthetic.roads import Control, RoadNetwork
from drivax.synthetic.signals import SignalPlan
from drivax.synthetic.tables import speed_profile
from drivax.synthetic.walkers import placed_walkers

#: Shares of what the light does for ego: green on arrival, turning green, turning red.
SignalTiming = tuple[float, float, float]


def draw_cast(
    network: RoadNetwork,
    domain: Domain,
    times_s: Float64[np.ndarray, " time"],
    lane_change_share: float,
    timing: SignalTiming,
    rng: np.random.Generator,
) -> Cast:
    """Draws ego, its way and lights, then the others and theirs.

    Args:
        network: The roads.
        domain: How full they are, and of whom.
        times_s: Times of all steps; the recording begins at time 0, before it traffic warms up.
        lane_change_share: Share of scenarios with room for it in which ego plans a lane change.
        timing: Shares of what the light does for ego.
        rng: Source of chance.
    """
    start = network.starts[int(rng.integers(len(network.starts)))]
    lanes, change = expert.expert_lanes(network, start.lane, lane_change_share, rng)
    driver = expert.drawn_expert(rng)
    path = expert.expert_path(network, lanes, change, rng)
    if network.signals is not None:
        ways = [lane for lane in lanes if network.lanes[lane].control == Control.SIGNAL]
        if ways:
            network = replace(network, signals=_timed(network.signals, ways[0], timing, rng))
    # Ego begins so far back that the warm-up brings it to where the recording should begin.
    cruise = 0.9 * float(driver.speed_factor[0]) * network.lanes[start.lane].limit_mps
    first = next(span for span in path.spans if span.lane == start.lane)
    at = max(12.0, float(first.begin_m + rng.uniform(start.low_m, start.high_m) + times_s[0] * cruise))
    here = max((span for span in path.spans if span.begin_m <= at), key=lambda span: span.begin_m)
    density = domain.density
    parked = parked_cars(
        network, float(rng.uniform(*domain.parked_share)), domain.double_share, rng, len(times_s)
    )
    others = placed(network, here.lane, at - here.begin_m, density, rng, parked)
    begin = [network.lanes[lane] for lane in others.lane]
    drivers = joined_drivers(driver, drawn_drivers(len(begin), density, rng, begin))
    paths = [path]
    for lane, cyclist in zip(others.lane, drivers.cyclist[1:], strict=True):
        paths.append(driven_path(network, random_lanes(network, lane, rng), bool(cyclist), rng))
    distance = np.array([at, *others.along_m])
    return Cast(
        network=network,
        paths=paths,
        drivers=drivers,
        distance_m=distance,
        speed_mps=_first_speeds(network, paths, drivers, distance, rng),
        route=lanes,
        walkers=placed_walkers(network, float(rng.uniform(*domain.walkers)), rng, times_s),
        parked=parked,
    )


def _timed(
    plan: SignalPlan, way: int, shares: tuple[float, float, float], rng: np.random.Generator
) -> SignalPlan:
    """Sets the plan's clock so that ego's light does something of interest during the recording (time 0 on)."""
    phase = plan.phase_of(way)
    what = int(rng.choice(3, p=shares))
    if what == 0:  # green for a while before ego comes
        green_at = -rng.uniform(0.0, 3.0)
    elif what == 1:  # turns green
        green_at = rng.uniform(0.5, 5.0)
    else:  # turns yellow, then red
        green_at = rng.uniform(0.3, 4.5) - plan.green_s[phase]
    return replace(plan, offset_s=float(green_at) - plan.starts_s[phase])


def _first_speeds(
    network: RoadNetwork,
    paths: list[Path],
    drivers: Drivers,
    distance: Float64[np.ndarray, " vehicle"],
    rng: np.random.Generator,
) -> Float64[np.ndarray, " vehicle"]:
    """Speeds from which everybody can still stop at the next stop line, whatever the light will do."""
    speeds = []
    for i, path in enumerate(paths):
        fastest = speed_profile(
            path,
            drivers.speed_factor[i],
            drivers.lateral_mps2[i],
            drivers.slowing_mps2[i],
            drivers.top_speed_mps[i],
        )
        speed = fastest[min(int(distance[i] / path.step_m), len(fastest) - 1)] * rng.uniform(0.7, 1.0)
        front = distance[i] + drivers.size_m[i, 0] / 2
        lines = [s.begin_m - front for s in path.spans if network.lanes[s.lane].connector]
        room = min((line for line in lines if line >= 0), default=math.inf)
        speeds.append(min(float(speed), math.sqrt(2 * 1.5 * max(room - 2.0, 0.0))))
    return np.array(speeds)
