from __future__ import annotations

import math

import numpy as np
import pytest

from drivax.synthetic.roads.curves import STEP_M, join_curves
from drivax.synthetic.roads.families import CurvedRoad, SignalisedJunction
from drivax.synthetic.traffic.paths import LaneChange, Sway, lane_path, random_lanes

from .oracles import distance_to_polyline


def tangent_error(path) -> float:
    """Largest angle between stored headings and the directions of the chords, rad."""
    chord = np.arctan2(*np.diff(path.curve.xy, axis=0).T[::-1])
    middle = (path.curve.heading[1:] + path.curve.heading[:-1]) / 2
    return float(np.abs((chord - middle + math.pi) % (2 * math.pi) - math.pi).max())


@pytest.mark.parametrize("family", [CurvedRoad(), SignalisedJunction()])
def test_path_follows_its_lanes(family):
    rng = np.random.default_rng(5)
    network = family.build(rng)
    lanes = random_lanes(network, network.starts[0].lane, rng)
    assert not network.lanes[lanes[-1]].successors
    path = lane_path(network, lanes, Sway())
    assert path.length_m == pytest.approx(sum(network.lanes[i].length_m for i in lanes), abs=0.05)
    assert path.step_m == pytest.approx(STEP_M, abs=0.01)
    # Where a path says that the vehicle is on a lane, it is there.
    for sample in range(0, len(path.curve.xy), 37):
        lane, along = network.lanes[path.lane[sample, 0]], path.lane_m[sample, 0]
        arc = lane.curve.arc_m
        expected = [np.interp(along, arc, lane.curve.xy[:, k]) for k in (0, 1)]
        assert np.hypot(*(expected - path.curve.xy[sample])) < 0.06
        assert path.limit_mps[sample] == lane.limit_mps
    assert tangent_error(path) < 0.01


@pytest.mark.parametrize("seed", range(4))
def test_sway_is_small_and_consistent_with_heading(seed):
    rng = np.random.default_rng(seed)
    network = CurvedRoad().build(rng)
    lanes = random_lanes(network, 0, rng)
    centre = lane_path(network, lanes, Sway())
    sway = Sway.draw(rng, 0.2)
    path = lane_path(network, lanes, sway)
    gap = distance_to_polyline(path.curve.xy[::9], centre.curve.xy)
    assert 0.02 < gap.max() < 0.21
    assert tangent_error(path) < 0.01
    assert path.spans[-1].begin_m == pytest.approx(
        path.length_m - network.lanes[lanes[-1]].length_m * path.spans[-1].scale, abs=0.01
    )


def two_lane_road():
    for seed in range(50):
        network = CurvedRoad().build(np.random.default_rng(seed))
        if network.lanes[2].right >= 0:
            return network
    raise AssertionError("no road with two lanes in fifty")


def test_lane_change_is_smooth_between_lane_centres():
    network = two_lane_road()
    neighbour = network.lanes[2].right
    change = LaneChange(section=2, begin_m=8.0, length_m=56.0)
    lanes = (0, 1, 2, *random_lanes(network, neighbour, np.random.default_rng(0)))
    path = lane_path(network, lanes, Sway(), change)
    begin = next(s.begin_m for s in path.spans if s.lane == 2)
    old, new = (join_curves(*(network.lanes[i].curve for i in ids)).xy for ids in ((0, 1, 2), lanes[3:]))

    def gap(at, centre):
        return distance_to_polyline(path.curve.xy[round(at / path.step_m)][None], centre)[0]

    width = network.lanes[2].width_m
    assert gap(begin + 7.0, old) < 0.05
    assert gap(begin + 8.0 + 28.0, old) == pytest.approx(width / 2, abs=0.12)
    assert gap(begin + 8.0 + 57.0, new) < 0.05
    assert gap(begin + 100.0, new) < 0.05
    assert tangent_error(path) < 0.01
    # The car is on both lanes while it changes, on one before and after.
    lanes_at = {at: set(path.lane[round((begin + at) / path.step_m)]) - {-1} for at in (-20.0, 30.0, 75.0)}
    assert lanes_at[-20.0] == {1} and lanes_at[30.0] == {2, neighbour} and lanes_at[75.0] == {neighbour}
    # Curvature: that of the road plus the quintic's 10 / sqrt(3) x width / length^2.
    calm = lane_path(network, random_lanes(network, 0, np.random.default_rng(0)), Sway())
    assert np.abs(path.curvature).max() < np.abs(calm.curvature).max() * 1.15 + 5.8 * width / 56.0**2 + 0.002


def test_turning_vehicle_occupies_the_straight_path_until_clear():
    network = SignalisedJunction().build(np.random.default_rng(0))
    first = network.starts[0].lane
    turning = next(
        way for way in network.lanes[first].successors
        if abs(network.lanes[way].curve.heading[-1] - network.lanes[way].curve.heading[0]) > 0.8
    )  # fmt: skip
    others = set(network.lanes[first].successors) - {turning}
    path = lane_path(network, (first, turning, *network.lanes[turning].successors), Sway())
    begin = path.spans[1].begin_m
    early = set(path.lane[round((begin + 2.0) / path.step_m)]) - {-1}
    late = set(path.lane[round((begin + network.lanes[turning].length_m - 1.0) / path.step_m)]) - {-1}
    assert early == {turning} | others
    assert late == {turning}
