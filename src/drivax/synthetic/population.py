"""Who is on the road: vehicles of many sizes with drivers of many tempers, placed with safe gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from drivax.synthetic.drivers import Drivers
from drivax.synthetic.roads import RoadNetwork

#: Smallest bumper-to-bumper gap between vehicles placed on a lane, m, and the time added per m/s.
_GAP_M, _GAP_S = 5.0, 0.9


@dataclass(frozen=True)
class Density:
    """How full the roads are.

    Attributes:
        spacing_m: Mean free gap between vehicles of a lane, drawn per scenario, low and high.
        vehicles: Most vehicles beside ego; the nearest to ego are kept.
        truck_share: Share of trucks.
        leader_share: Share of scenarios in which somebody is placed right ahead of ego.
    """

    spacing_m: tuple[float, float] = (25.0, 90.0)
    vehicles: int = 32
    truck_share: float = 0.06
    leader_share: float = 0.5


@dataclass(frozen=True)
class Placement:
    """Vehicles placed on lanes: lane index, and distance of the centre along it in m."""

    lane: tuple[int, ...]
    along_m: tuple[float, ...]


def placed(
    network: RoadNetwork, ego_lane: int, ego_along_m: float, density: Density, rng: np.random.Generator
) -> Placement:
    """Draws where the others begin: nobody on a connector, and nobody too close to ego or to another.

    Args:
        network: The roads.
        ego_lane: Lane on which ego begins.
        ego_along_m: Distance of ego along that lane, m.
        density: How full the roads are.
        rng: Source of chance.
    """
    spacing = rng.uniform(*density.spacing_m)
    found: list[tuple[int, float]] = []
    if rng.random() < density.leader_share:
        ahead = ego_along_m + rng.uniform(18.0, 45.0)
        if ahead < network.lanes[ego_lane].length_m - 6.0:
            found.append((ego_lane, ahead))
    for index, lane in enumerate(network.lanes):
        if lane.connector:
            continue
        least = 10.0 + _GAP_M + _GAP_S * lane.limit_mps
        taken = [along for where, along in found if where == index]
        taken += [ego_along_m] if index == ego_lane else []
        at = rng.uniform(6.0, 6.0 + spacing)
        while at < lane.length_m - 6.0:
            if all(abs(at - other) > least for other in taken):
                found.append((index, float(at)))
                taken.append(float(at))
            at += least + rng.exponential(spacing)
    found = _apart_at_joints(network, found, ego_lane, ego_along_m)
    here = network.lanes[ego_lane].curve
    ego_xy = here.xy[np.searchsorted(here.arc_m, ego_along_m).clip(max=len(here.xy) - 1)]
    found.sort(key=lambda item: float(np.hypot(*(_point(network, *item) - ego_xy))))
    found = found[: density.vehicles]
    return Placement(tuple(lane for lane, _ in found), tuple(along for _, along in found))


def _apart_at_joints(
    network: RoadNetwork, found: list[tuple[int, float]], ego_lane: int, ego_along_m: float
) -> list[tuple[int, float]]:
    """Drops who stands too close behind the first vehicle of a following lane."""
    kept = []
    first: dict[int, float] = {}
    for lane, along in [*found, (ego_lane, ego_along_m)]:
        first[lane] = min(along, first.get(lane, np.inf))
    last: dict[int, float] = {ego_lane: ego_along_m}
    for lane, along in found:
        last[lane] = max(along, last.get(lane, 0.0))
    for lane, along in found:
        this = network.lanes[lane]
        least = 10.0 + _GAP_M + _GAP_S * this.limit_mps
        after = min((first.get(b, np.inf) for b in this.successors), default=np.inf)
        # Only the last vehicle of a lane can be too close to the next lane's first one. Ego always stays.
        behind_ego = ego_lane in this.predecessors
        gap_to_ego = network.lanes[ego_lane].length_m - ego_along_m + along if behind_ego else np.inf
        if (along < last[lane] or this.length_m - along + after > least) and gap_to_ego > least:
            kept.append((lane, along))
    return kept


def _point(network: RoadNetwork, lane: int, along: float) -> Float64[np.ndarray, " 2"]:
    curve = network.lanes[lane].curve
    return curve.xy[min(int(along / network.lanes[lane].length_m * len(curve.xy)), len(curve.xy) - 1)]


def drawn_drivers(count: int, truck_share: float, rng: np.random.Generator) -> Drivers:
    """Draws vehicles and drivers: hurried and patient, close and careful."""
    truck = rng.random(count) < truck_share
    length = np.where(truck, rng.uniform(7.0, 9.5, count), rng.normal(4.7, 0.3, count).clip(3.9, 5.6))
    width = np.where(truck, rng.uniform(2.3, 2.5, count), rng.normal(1.9, 0.08, count).clip(1.7, 2.1))
    height = np.where(truck, rng.uniform(2.8, 3.6, count), rng.normal(1.6, 0.12, count).clip(1.35, 2.0))
    return Drivers(
        size_m=np.stack([length, width, height], axis=-1),
        speed_factor=np.where(truck, 0.85, 1.0) * rng.normal(0.92, 0.12, count).clip(0.55, 1.1),
        lateral_mps2=rng.uniform(1.8, 2.5, count),
        slowing_mps2=rng.uniform(1.1, 1.8, count),
        yellow_mps2=rng.uniform(2.3, 3.0, count),
        jerk_mps3=rng.uniform(3.0, 5.0, count),
        headway_s=rng.uniform(1.1, 2.0, count),
        acceleration_mps2=np.where(truck, 0.7, 1.0) * rng.uniform(1.1, 2.0, count),
        braking_mps2=rng.uniform(2.0, 3.0, count),
    )


def joined_drivers(first: Drivers, rest: Drivers) -> Drivers:
    """One table of both."""
    return Drivers(
        **{name: np.concatenate([value, getattr(rest, name)]) for name, value in vars(first).items()}
    )
