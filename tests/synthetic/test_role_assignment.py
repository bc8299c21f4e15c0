from __future__ import annotations

import dataclasses

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from drivax.synthetic.roads.families import FAMILIES
from drivax.synthetic.roads.network import Control
from drivax.synthetic.traffic.paths import LaneChange, Sway, lane_path
from drivax.synthetic.traffic.role_assignment import add_feeders, conflicts_on, yielding_destinations

from .traffic_scenes import crossroads, road


def draw_roads(name, seed):
    family = next(family for family in FAMILIES if family.name == name)
    return family.build(np.random.default_rng(seed))


def test_conflicts_are_connectors_with_priority_that_need_not_wait():
    network = crossroads()
    lanes = list(network.lanes)
    lanes[1] = dataclasses.replace(lanes[1], yields_to=(4,), control=Control.YIELD)
    yielding = dataclasses.replace(network, lanes=tuple(lanes))
    assert conflicts_on(yielding, lane_path(yielding, (0, 1, 2), Sway())) == {4}
    assert conflicts_on(yielding, lane_path(yielding, (3, 4, 5), Sway())) == frozenset()
    assert [place.lane for place in yielding_destinations(yielding)] == [1]
    lanes[4] = dataclasses.replace(lanes[4], yields_to=(1,))
    both = dataclasses.replace(network, lanes=tuple(lanes))
    assert conflicts_on(both, lane_path(both, (0, 1, 2), Sway())) == frozenset()
    assert yielding_destinations(both) == ()


def test_all_crossing_connectors_conflict_at_an_all_way_stop():
    network = crossroads(control=[Control.ALL_WAY_STOP] * 2)
    assert conflicts_on(network, lane_path(network, (0, 1, 2), Sway())) == {4}
    assert sorted(place.lane for place in yielding_destinations(network)) == [1, 4]


def test_the_target_lane_of_a_lane_change_conflicts():
    network, columns = road(lanes=2)
    path = lane_path(network, (columns[0][0], columns[1][0]), Sway(), LaneChange(0, 20.0, 60.0))
    assert conflicts_on(network, path) == {columns[1][0]}


def test_feeders_are_the_lanes_within_reach_against_shortest_paths():
    for seed in range(4):
        network = draw_roads("corridor", seed)
        target = next(k for k, lane in enumerate(network.lanes) if lane.connector and lane.predecessors)
        # Going back from a lane to the one before costs the lane's own length.
        edges = [(i, k, lane.length_m) for i, lane in enumerate(network.lanes) for k in lane.predecessors]
        begin, end, cost = zip(*edges, strict=True)
        away = dijkstra(csr_array((cost, (begin, end)), shape=[len(network.lanes)] * 2), indices=target)
        expected = set(np.flatnonzero(away < 160.0).tolist())
        assert add_feeders(network, frozenset({target})) == expected
