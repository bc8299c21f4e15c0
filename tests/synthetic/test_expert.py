from __future__ import annotations

import numpy as np
import pytest

from drivax.synthetic.expert import boxes, inside, leaves_road, runs_red, touching
from drivax.synthetic.families import CurvedRoad, SignalisedJunction
from drivax.synthetic.paths import Sway, lane_path
from drivax.synthetic.signals import Colour

from .oracles import box_corners, shared_area, winding_number


@pytest.mark.parametrize("family", [CurvedRoad(median_share=1.0), SignalisedJunction()])
@pytest.mark.parametrize("seed", range(2))
def test_inside_agrees_with_winding_numbers(family, seed):
    rng = np.random.default_rng(seed)
    network = family.build(rng)
    rings = tuple(edge.xy for edge in network.edges)
    around = np.concatenate([lane.curve.xy[::25] for lane in network.lanes])
    points = around + rng.normal(0.0, 4.0, around.shape)
    got = inside(points, rings)
    brute = [sum(winding_number(p, ring) for ring in rings) == 1 for p in points]
    assert got.tolist() == brute
    assert 0.1 < np.mean(brute) < 0.98


def test_touching_agrees_with_clipped_polygons():
    rng = np.random.default_rng(0)
    xy = rng.uniform(-15, 15, (12, 3, 2))
    heading = rng.uniform(-4, 4, (12, 3))
    size = rng.uniform(1.5, 7.0, (12, 3, 3))
    size[:] = size[:, :1]
    valid = rng.random((12, 3)) < 0.8
    skinless = size.copy()
    skinless[0] -= 0.2  # ego is tested with a skin of that much
    got = touching(boxes(xy, heading, skinless), valid)
    for i in range(12):
        for j in range(i + 1, 12):
            shared = [
                shared_area(
                    box_corners(xy[i, t], heading[i, t], *size[i, t, :2]),
                    box_corners(xy[j, t], heading[j, t], *size[j, t, :2]),
                )
                for t in range(3)
                if valid[i, t] and valid[j, t]
            ]
            assert got[i, j] == got[j, i] == (max(shared, default=0.0) > 1e-9)
    assert 0 < got.sum() < 12 * 11


def test_a_box_that_cuts_the_kerb_leaves_the_road():
    network = CurvedRoad().build(np.random.default_rng(1))
    lane = network.lanes[1]
    xy, heading = lane.curve.xy[50:52], lane.curve.heading[50:52]
    size = np.array([[4.8, 2.0, 1.5]] * 2)
    assert not leaves_road(network, boxes(xy, heading, size))
    right = np.stack([np.sin(heading), -np.cos(heading)], axis=-1)
    assert leaves_road(network, boxes(xy + 8.0 * 3.7 * right, heading, size))


def test_running_red_means_red_before_and_after():
    network = SignalisedJunction().build(np.random.default_rng(0))
    first = network.starts[0].lane
    way = network.lanes[first].successors[0]
    path = lane_path(network, (first, way, *network.lanes[way].successors), Sway())
    line = path.spans[1].begin_m
    times = np.arange(0.0, network.signals.cycle_s, 0.1)
    colour = network.signals.colours(times, len(network.lanes))[0][:, way]
    for step in range(1, len(times) - 1, 7):
        front = np.where(np.arange(len(times)) <= step, line - 0.5, line + 0.5)
        red = colour[step] == Colour.RED and colour[step + 1] == Colour.RED
        assert runs_red(network, path, front, times) == red
