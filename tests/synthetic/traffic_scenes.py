"""Small roads and vehicles for tests of traffic."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise

import numpy as np

from drivax.synthetic.roads.curves import Pose, straight
from drivax.synthetic.roads.network import Draft, RoadNetwork
from drivax.synthetic.traffic.paths import Sway, lane_path
from drivax.synthetic.traffic.placement import Density, draw_drivers
from drivax.synthetic.traffic.roles import Roles
from drivax.synthetic.traffic.simulation import WorldTraffic

CARS = Density(van_share=0.0, truck_share=0.0, bus_share=0.0, cyclist_share=0.0)


def drivers(count, seed=0, **values):
    """Cars whose drivers react immediately, with some values equal for all."""
    table = draw_drivers(count, CARS, np.random.default_rng(seed))
    values = {"reaction_s": 0.0, **values}
    return dataclasses.replace(table, **{k: np.full(count, v) for k, v in values.items()})


def twins(count, **values):
    """Copies of one driver."""
    return drivers(1, **values).select(np.zeros(count, int))


def roles(network, routes, table, at, speed, **more):
    """Roles of vehicles in the middle of their lanes."""
    paths = [lane_path(network, route, Sway()) for route in routes]
    return Roles(network, paths, table, np.array(at, float), np.array(speed, float), routes[0], **more)


def run(network, routes, table, at, speed, seconds, staging=None, ego=None, **more):
    times = np.arange(round(seconds * 10)) / 10
    return WorldTraffic(roles(network, routes, table, at, speed, **more), times).run(staging, ego)


def road(length_m=600.0, limit=15.0, lanes=1, sections=1, width_m=3.5):
    """Straight lanes eastwards from x = 0, the first one leftmost; each is cut into sections."""
    draft = Draft()
    columns = []
    for k in range(lanes):
        part = length_m / sections
        column = [
            draft.lane(straight(Pose(part * j, -width_m * k, 0.0), part), width_m, limit)
            for j in range(sections)
        ]
        for a, b in pairwise(column):
            draft.link(a, b)
        columns.append(column)
    for left, right in pairwise(columns):
        for a, b in zip(left, right, strict=True):
            draft.link_neighbours(a, b)
    return RoadNetwork("test", tuple(draft.lanes), ()), columns


def crossroads(arms=2, limit=15.0, **rules):
    """Roads that cross at right angles at (110, 0): lanes 3k, 3k + 1 (across), 3k + 2 of the k-th.

    The first one goes east, then north, west, south. ``rules`` are fields of connectors, as a list over arms.
    """
    draft = Draft()
    for k in range(arms):
        heading = k * math.pi / 2
        begin = Pose(110.0 - 110.0 * math.cos(heading), -110.0 * math.sin(heading), heading)
        # Vehicles keep to the right of the middle.
        begin = Pose(begin.x + 2.0 * math.sin(heading), begin.y - 2.0 * math.cos(heading), heading)
        parts = [
            draft.lane(straight(begin.ahead(at), length), 3.5, limit, connector=at == 100.0)
            for at, length in ((0.0, 100.0), (100.0, 20.0), (120.0, 200.0))
        ]
        draft.link(parts[0], parts[1])
        draft.link(parts[1], parts[2])
    lanes = list(draft.lanes)
    for name, values in rules.items():
        for k, value in enumerate(values):
            lanes[3 * k + 1] = dataclasses.replace(lanes[3 * k + 1], **{name: value})
    return RoadNetwork("test", tuple(lanes), ())


def entered(motion, row, line_m, length_m):
    """First step at which a front bumper is beyond a line; the number of steps if it never is."""
    beyond = np.flatnonzero(motion.distance_m[row] + length_m / 2 > line_m)
    return int(beyond[0]) if len(beyond) else motion.distance_m.shape[1]
