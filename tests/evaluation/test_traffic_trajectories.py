"""Trajectories of reactive traffic are stored and drawn as they were simulated."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from shapely import affinity

import drivax
from drivax.cli import main
from drivax.evaluation.rollout import pack_poses, unpack_poses
from drivax.report.episodes import EvaluatedSet, rank_scenarios, rollouts_of
from drivax.report.pictures.drawing import replace_traffic
from drivax.report.runs import read_runs
from drivax.scenario.store import ScenarioSet
from drivax.synthetic.generate import Generation, generate


def test_poses_round_trip_within_a_centimetre_and_absent_agents_stay_absent():
    rng = np.random.default_rng(0)
    xy, heading = rng.uniform(-640, 640, (5, 7, 2)), rng.uniform(-np.pi, np.pi, (5, 7))
    there = rng.random((5, 7)) < 0.7
    rows = np.concatenate(
        [xy, 0 * xy[..., :1], np.cos(heading)[..., None], np.sin(heading)[..., None], 0 * xy], -1
    )
    rows = np.concatenate([rows, there[..., None]], -1)
    rows[0, 0, :2], rows[0, 0, 7], there[0, 0] = (700.0, 0.0), 1.0, False
    kept = np.asarray(pack_poses(jnp.asarray(rows, jnp.float32)))
    assert kept.dtype == np.int16 and kept.shape == (5, 7, 3)
    result = unpack_poses(kept)
    np.testing.assert_array_equal(np.isfinite(result).all(-1), there)
    np.testing.assert_allclose(result[there][:, :2], xy[there], atol=0.0101)
    turned = result[there][:, 2] - heading[there]
    np.testing.assert_allclose((turned + np.pi) % (2 * np.pi) - np.pi, 0.0, atol=6e-5)


def box(xy, heading, size):
    length, width = map(float, size[:2])
    shape = shapely.box(-length / 2, -width / 2, length / 2, width / 2)
    return affinity.translate(affinity.rotate(shape, heading, (0, 0), use_radians=True), *map(float, xy))


def nearest_m(scenario, drive, step):
    """Return the distance from ego to the nearest drawn agent at a step."""
    x, y, heading, _ = drive.ego[step]
    ego = box((x, y), heading, scenario.agent_size[0])
    moving = [
        box(scenario.agent_xy[step, k], scenario.agent_heading[step, k], scenario.agent_size[k])
        for k in np.flatnonzero(scenario.agent_valid[step])
        if k
    ]
    parked = [
        box(scenario.parked_xy[k], scenario.parked_heading[k], scenario.parked_size[k])
        for k in np.flatnonzero(scenario.parked_valid[step])
    ]
    return min(ego.distance(one) for one in moving + parked)


@pytest.mark.slow
def test_collision_in_reactive_traffic_is_drawn_as_a_contact(tmp_path):
    generate(tmp_path / "set", 24, 3, Generation(workers=0))
    call = ["evaluate", "--planner", "constant_velocity", "--data", str(tmp_path / "set"), "--traffic", "idm"]
    assert main([*call, "--out", str(tmp_path / "run")]) == 0
    evaluations, _ = read_runs([tmp_path / "run"])
    driven, gaps, missed = EvaluatedSet(evaluations[0]), [], []
    for choice in rank_scenarios(evaluations):
        scenario = driven.scenario((choice.dataset, choice.scenario_id))
        (drive,) = rollouts_of(evaluations, choice, scenario)
        seen = replace_traffic(scenario, drive)
        at = drive.events["collision"]
        np.testing.assert_array_equal(seen.agent_xy[:10], scenario.agent_xy[:10])
        if at >= 0:
            gaps.append(nearest_m(seen, drive, at))
            missed.append(nearest_m(scenario, drive, at))
    assert len(gaps) >= 3 and max(gaps) < 0.03, gaps
    assert max(missed) > 0.5, "some of them are no contact with the recording"


@pytest.mark.slow
def test_log_traffic_stores_no_trajectories(tmp_path):
    generate(tmp_path / "set", 2, 3, Generation(workers=0))
    assert drivax.evaluate("constant_velocity", tmp_path / "set").trajectories.others is None
    result = drivax.evaluate("constant_velocity", tmp_path / "set", traffic="idm").trajectories.others
    scenarios = ScenarioSet.open(tmp_path / "set")
    for rows, scenario in zip(result, scenarios, strict=True):
        # No agent has moved yet when the episode begins.
        pose, there = unpack_poses(rows[0]), scenario.agent_valid[10, : rows.shape[1]]
        np.testing.assert_allclose(pose[there][:, :2], scenario.agent_xy[10, : len(there)][there], atol=0.02)
