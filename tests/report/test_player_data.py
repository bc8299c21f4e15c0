from __future__ import annotations

import base64
import json

import numpy as np
import pytest

from drivax.report.pictures.drawing import Rollout
from drivax.report.pictures.player_data import ABSENT, Scale, pack_episode

from .conftest import make_scenario, offset_path


def shorts(text, *shape):
    return np.frombuffer(base64.b64decode(text), "<i2").reshape(*shape).astype(np.float64)


@pytest.fixture(scope="module")
def scenario():
    return make_scenario(0)


@pytest.fixture(scope="module")
def drive(scenario):
    ego = offset_path(scenario, 3.0).astype(np.float64)
    ego[80:] = np.nan
    return Rollout("policy", ego, 10, {"collision": 40, "offroad": -1, "red_light": 3}, "collision")


@pytest.fixture(scope="module")
def packed(scenario, drive):
    return json.loads(json.dumps(pack_episode(scenario, [drive], "title"), allow_nan=False))


def test_rollouts_are_packed_within_half_a_unit(packed, drive):
    stored = packed["rollouts"][0]
    pose = shorts(stored["pose"], 91, 3)
    xy = pose[:80, :2] * packed["unit"] + packed["centre"]
    assert np.abs(xy - drive.ego[:80, :2]).max() <= packed["unit"] / 2 + 1e-9
    assert np.abs(pose[:80, 2] / 1e4 - drive.ego[:80, 2]).max() <= 0.5e-4 + 1e-9
    assert (pose[80:] == ABSENT).all(), "where the car is gone nothing is drawn"
    np.testing.assert_allclose(shorts(stored["speed"], 91)[:80] / 100, drive.ego[:80, 3], atol=0.0051)
    assert stored["events"] == {"collision": 40, "red_light": 3} and stored["start"] == 10


def test_near_agents_are_packed_and_far_ones_left_out(packed, scenario):
    agents = packed["agents"]
    assert agents["kind"] == ["vehicle", "pedestrian", "cyclist"]
    pose = shorts(agents["pose"], 3, 91, 3)
    valid = scenario.agent_valid[:, 1:4].T
    np.testing.assert_array_equal(pose[..., 0] != ABSENT, valid)
    xy = pose[..., :2] * packed["unit"] + packed["centre"]
    assert np.abs(xy - scenario.agent_xy[:, 1:4].swapaxes(0, 1))[valid].max() <= packed["unit"] / 2 + 1e-6
    sizes = shorts(agents["size"], 3, 2) * packed["unit"]
    np.testing.assert_allclose(sizes, scenario.agent_size[1:4, :2], atol=packed["unit"])
    assert packed["parked"]["kind"] == ["parked"]
    assert shorts(packed["parked"]["seen"], 1, 2).tolist() == [[5, 79]]


def test_map_route_and_lights_are_packed(packed, scenario):
    lane = packed["map"]["lane"]
    counts = shorts(lane["counts"], -1)
    points = shorts(lane["points"], -1, 2) * packed["unit"] + packed["centre"]
    assert counts.sum() == len(points) and len(points) > 30
    radius = np.linalg.norm(points - (0, 80.0), axis=1)
    np.testing.assert_allclose(radius, 81.8, atol=packed["unit"])
    states = np.frombuffer(base64.b64decode(packed["lights"]["state"]), np.int8).reshape(91, 1)
    assert set(states[:50, 0]) == {1} and set(states[50:, 0]) == {3}
    line = shorts(packed["lights"]["line"], 2, 2) * packed["unit"] + packed["centre"]
    np.testing.assert_allclose(line.ravel(), scenario.light_line[0], atol=packed["unit"])
    route = shorts(packed["route"], -1, 2) * packed["unit"] + packed["centre"]
    np.testing.assert_allclose(route, scenario.route_xy[0, :100], atol=packed["unit"])


def test_packed_episode_is_below_40_kb(packed):
    assert len(json.dumps(packed)) < 40_000


def test_long_episodes_use_a_coarser_unit():
    scale = Scale.of((-900.0, 0.0, 900.0, 10.0))
    assert 0.01 < scale.unit_m < 0.03
    points = np.array([[-905.0, 0.0], [905.0, 10.0]])
    back = scale.points(points).astype(float) * scale.unit_m + scale.centre
    np.testing.assert_allclose(back, points, atol=scale.unit_m / 2)


def test_headings_are_wrapped():
    scale = Scale.of((0.0, 0.0, 1.0, 1.0))
    packed = scale.poses(np.zeros((3, 2)), np.array([7.0, -3.2, 0.0]), np.array([True, True, False]))
    np.testing.assert_allclose(packed[:2, 2] / 1e4, [7.0 - 2 * np.pi, -3.2 + 2 * np.pi], atol=1e-4)
    assert (packed[2] == ABSENT).all()
