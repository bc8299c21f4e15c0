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
    present = rng.random((5, 7)) < 0.7
    rows = np.concatenate(
        [xy, 0 * xy[..., :1], np.cos(heading)[..., None], np.sin(heading)[..., None], 0 * xy], -1
    )
    rows = np.concatenate([rows, present[..., None]], -1)
    rows[0, 0, :2], rows[0, 0, 7], present[0, 0] = (700.0, 0.0), 1.0, False
    packed = np.asarray(pack_poses(jnp.asarray(rows, jnp.float32)))
    assert packed.dtype == np.int16 and packed.shape == (5, 7, 3)
    result = unpack_poses(packed)
    np.testing.assert_array_equal(np.isfinite(result).all(-1), present)
    np.testing.assert_allclose(result[present][:, :2], xy[present], atol=0.0101)
    error = result[present][:, 2] - heading[present]
    np.testing.assert_allclose((error + np.pi) % (2 * np.pi) - np.pi, 0.0, atol=6e-5)


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
    return min(ego.distance(other) for other in moving + parked)


@pytest.mark.slow
def test_collision_in_reactive_traffic_is_drawn_as_a_contact(tmp_path):
    generate(tmp_path / "set", 24, 3, Generation(workers=0))
    call = ["evaluate", "--planner", "constant_velocity", "--data", str(tmp_path / "set"), "--traffic", "idm"]
    assert main([*call, "--out", str(tmp_path / "run")]) == 0
    evaluations, _ = read_runs([tmp_path / "run"])
    evaluated, gaps, log_gaps = EvaluatedSet(evaluations[0]), [], []
    for choice in rank_scenarios(evaluations):
        scenario = evaluated.scenario((choice.dataset, choice.scenario_id))
        (drive,) = rollouts_of(evaluations, choice, scenario)
        drawn = replace_traffic(scenario, drive)
        step = drive.events["collision"]
        np.testing.assert_array_equal(drawn.agent_xy[:10], scenario.agent_xy[:10])
        if step >= 0:
            gaps.append(nearest_m(drawn, drive, step))
            log_gaps.append(nearest_m(scenario, drive, step))
    assert len(gaps) >= 3 and max(gaps) < 0.03, gaps
    assert max(log_gaps) > 0.5, "the logged agents would not all touch ego"


@pytest.mark.slow
def test_only_simulated_traffic_is_stored(tmp_path):
    generate(tmp_path / "set", 2, 3, Generation(workers=0))
    assert drivax.evaluate("constant_velocity", tmp_path / "set").trajectories.others is None
    result = drivax.evaluate("constant_velocity", tmp_path / "set", traffic="idm").trajectories.others
    scenarios = ScenarioSet.open(tmp_path / "set")
    for rows, scenario in zip(result, scenarios, strict=True):
        # No agent has moved yet when the episode begins.
        pose, present = unpack_poses(rows[0]), scenario.agent_valid[10, : rows.shape[1]]
        logged_xy = scenario.agent_xy[10, : len(present)][present]
        np.testing.assert_allclose(pose[present][:, :2], logged_xy, atol=0.02)
