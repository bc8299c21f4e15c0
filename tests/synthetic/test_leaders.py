from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from drivax.scenario.schema import AgentKind
from drivax.synthetic.traffic.leaders import LeaderSearch
from drivax.synthetic.traffic.path_arrays import PathTables, Worlds
from drivax.synthetic.traffic.paths import Sway, lane_path

from .traffic_scenes import drivers, road


def leaders(routes, at, table, active=None, **roads):
    network, _ = road(300.0, **roads)
    worlds = Worlds([network], [len(routes)])
    tables = PathTables(worlds, [lane_path(network, route, Sway()) for route in routes], table)
    is_active = np.ones(len(at), bool) if active is None else np.array(active)
    return LeaderSearch(worlds, table).find(tables, np.array(at, float), is_active)


@pytest.mark.parametrize("seed", range(5))
def test_leader_is_the_nearest_vehicle_ahead_on_the_path(seed):
    # Three lanes in three sections of 100 m: lane 3k + j is the j-th section of the k-th column.
    rng = np.random.default_rng(seed)
    column, at, is_active = rng.integers(0, 3, 14), rng.uniform(5.0, 290.0, 14), rng.random(14) < 0.8
    table = drivers(14, seed)
    gap, leader = leaders(
        [(3 * k, 3 * k + 1, 3 * k + 2) for k in column.tolist()], at, table, is_active, lanes=3, sections=3
    )
    for i in range(14):
        ahead = [j for j in range(14) if is_active[j] and column[j] == column[i] and at[j] > at[i]]
        if not ahead:
            assert gap[i] == np.inf
            continue
        # The nearest by its rear: lengths differ.
        room = {j: at[j] - at[i] - (table.size_m[j, 0] + table.size_m[i, 0]) / 2 for j in ahead}
        nearest = min(room, key=lambda j: room[j])
        assert gap[i] == pytest.approx(room[nearest], abs=1e-6)
        assert leader[i] == nearest


@pytest.mark.parametrize(("width", "follows"), [(3.5, True), (7.0, False)])
def test_cyclists_are_leaders_only_on_narrow_lanes(width, follows):
    # A car of 2 m needs 1 m of half the lane; 2.4 m are the cyclist's.
    table = drivers(2)
    size = np.array([[4.6, 2.0, 1.5], [1.8, 0.7, 1.7]])
    table = dataclasses.replace(
        table, size_m=size, kind=np.array([AgentKind.VEHICLE, AgentKind.CYCLIST], np.int8)
    )
    gap, _ = leaders([(0,), (0,)], [20.0, 40.0], table, width_m=width)
    assert gap[0] == (pytest.approx(20.0 - 3.2, abs=1e-6) if follows else np.inf)


def test_empty_road_has_no_leaders():
    gap, _ = leaders([(0,), (0,)], [20.0, 40.0], drivers(2), [False, False])
    assert np.all(gap == np.inf)
