"""Heights: agents lifted onto a 3-D map, and everything put on one plane."""

from __future__ import annotations

import numpy as np
import pytest

from drivax.datasets import parsing
from drivax.datasets.parsing import flatten, lift
from drivax.scenario.recording import MapFeature, Tracks
from drivax.scenario.schema import AgentKind, RoadKind


def tracks(xy, height=1.6, kind=AgentKind.VEHICLE) -> Tracks:
    """One track with these positions; the last step is not valid."""
    xy = np.array([xy], np.float64)
    steps = xy.shape[1]
    valid = np.arange(steps)[None] < steps - 1
    size = np.where(valid[..., None], [4.0, 2.0, height], 0.0)
    return Tracks(
        xy=np.where(valid[..., None], xy, 0.0),
        z=np.full((1, steps), 77.0),
        heading=np.zeros((1, steps)),
        velocity=np.zeros((1, steps, 2)),
        size=size,
        valid=valid,
        kind=np.array([kind], np.int8),
        track_id=np.array([1]),
    )


def ramp() -> MapFeature:
    """A lane of two points that climbs 10 m over 100 m."""
    return MapFeature(1, RoadKind.LANE_SURFACE, np.array([[0.0, 0, 20], [100, 0, 30]]))


def test_agents_stand_on_the_slope_between_sparse_points():
    x = np.linspace(0, 100, 41)
    lifted = lift(tracks(np.column_stack((x, np.full(41, 2.0)))), [ramp()])
    np.testing.assert_allclose(lifted.z[0, :-1], 20 + x[:-1] / 10 + 0.8, atol=0.05)
    assert lifted.z[0, -1] == 0.0  # not valid


def test_the_nearest_line_decides():
    low = MapFeature(2, RoadKind.EDGE_BOUNDARY, np.array([[0.0, 50, 5], [100, 50, 5]]))
    lifted = lift(tracks([[10, 40], [10, 10], [0, 0]]), [ramp(), low])
    np.testing.assert_allclose(lifted.z[0, :2], [5.8, 21.8], atol=0.05)


def test_heights_equal_brute_force():
    rng = np.random.default_rng(3)
    features = [
        MapFeature(i, RoadKind.LINE_UNKNOWN, np.cumsum(rng.uniform(-9, 9, (5, 3)) * [1, 1, 0.1], axis=0))
        for i in range(20)
    ]
    xy = rng.uniform(-30, 30, (200, 2))
    z = lift(tracks(xy), features).z[0, :-1] - 0.8
    part = np.linspace(0, 1, 201)[:, None, None]
    a = np.concatenate([f.points[:-1] for f in features])
    b = np.concatenate([f.points[1:] for f in features])
    dense = (a + part * (b - a)).reshape(-1, 3)
    for point, found in zip(xy, z, strict=False):
        apart = np.hypot(*(dense[:, :2] - point).T)
        # Samples are a metre apart: what is nearly as near as the nearest may win.
        near = dense[apart < apart.min() + 0.2, 2]
        assert np.abs(near - found).min() < 0.05


def test_unknown_sizes_take_half_the_height_of_their_class():
    lifted = lift(tracks([[5, 0], [0, 0]], height=0.0, kind=AgentKind.PEDESTRIAN), [ramp()])
    assert lifted.z[0, 0] == pytest.approx(20.5 + 0.9, abs=0.05)


def test_without_a_map_agents_stand_at_zero():
    np.testing.assert_array_equal(lift(tracks([[5, 0], [0, 0]]), []).z, [[0.8, 0.0]])


def test_a_map_of_absurd_length_costs_no_memory(monkeypatch):
    monkeypatch.setattr(parsing, "_MOST_SAMPLES", 50)
    far = MapFeature(1, RoadKind.LANE_SURFACE, np.array([[0.0, 0, 0], [1e7, 0, 10]]))
    assert len(parsing._samples([far])) <= 52
    assert lift(tracks([[1e7, 0], [0, 0]]), [far]).z[0, 0] == pytest.approx(10.8)


def test_flatten_puts_agents_and_map_on_one_plane():
    original = tracks([[5, 0], [9, 0], [0, 0]])
    flat, features = flatten(original, [ramp()])
    np.testing.assert_array_equal(flat.z, [[0.8, 0.8, 0.0]])
    np.testing.assert_array_equal(features[0].points, [[0, 0, 0], [100, 0, 0]])
    assert features[0].feature_id == 1 and ramp().points[1, 2] == 30.0
    np.testing.assert_array_equal(flat.xy, original.xy)
