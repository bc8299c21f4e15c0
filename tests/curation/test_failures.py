"""Scores by failures and near misses of planners."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.cli import main
from drivax.curation.failures import FailureConfig, times_to_collision
from drivax.curation.kinematic import scale_urgency
from drivax.curation.methods import Request, curate
from drivax.curation.scores import read_scores
from drivax.errors import DataError, UsageError
from drivax.evaluation.episode_table import EpisodeTable
from drivax.evaluation.runner import EvaluationConfig, run_evaluation
from drivax.planners.simple import ConstantVelocity, IdmPlanner
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.simulator.simulator import Simulator
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task
from scenes import SMALL, car, straight_road


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A stopped car 30 m ahead, which the log goes around in no way; and an empty road."""
    path = tmp_path_factory.mktemp("failures") / "set"
    with ScenarioWriter(path, SMALL) as writer:
        for row, others in enumerate(([car(x=30.0)], [])):
            recording = straight_road([car(speed=10.0), *others])
            recording = replace(recording, scenario_id=f"s{row}", segment=f"r{row}")
            writer.add(assemble(recording, SMALL))
    return ScenarioSet.open(path)


def evaluated(data, planner, out, **config):
    run_evaluation(EvaluationConfig(planner=planner.name, **config), planner, data, out)
    return out


def test_failures_and_near_misses_of_an_evaluation(data, tmp_path):
    run, scores = evaluated(data, ConstantVelocity(), tmp_path / "run"), tmp_path / "scores.npz"
    call = ["curate", "failures", "--data", str(data.path), "--runs", str(run)]
    assert main([*call, "--out", str(scores)]) == 0
    table, driven = read_scores(scores, data), EpisodeTable.read(run).trajectories
    hit = int(driven.events["collision"][0])
    assert 10 < hit < 60 and driven.events["collision"][1] == -1
    step = np.arange(91)
    rise = np.clip(1.0 - (hit - step) / 30.0, 0.0, 1.0) * (step <= hit)
    np.testing.assert_allclose(table.components["failure"][0], rise, atol=1e-6)
    assert not table.components["failure"][1].any() and not table.components["near_miss"][1].any()
    # At 10 m/s towards a car whose rear is 30 m less both half lengths ahead.
    gap = 30.0 - 4.8 - 10.0 * 0.1 * (step - 10)
    expected = np.where((step >= 10) & (step < hit), scale_urgency(jnp.maximum(gap / 10.0, 1e-3), 0.95), 0.0)
    near = table.components["near_miss"][0]
    np.testing.assert_allclose(near[:hit], expected[:hit], atol=0.05)
    assert table.scenarios.argmax() == 0 and table.config["planners"] == ["constant_velocity"]


def test_several_evaluations_are_averaged_over_those_of_a_scenario(data, tmp_path):
    runs = [
        evaluated(data, ConstantVelocity(), tmp_path / "fast"),
        evaluated(data, IdmPlanner(), tmp_path / "idm"),
        evaluated(data, ConstantVelocity(), tmp_path / "part", limit=1),
    ]
    tables = [curate("failures", Request(data, runs=[run])) for run in runs]
    both = curate("failures", Request(data, runs=runs))
    for name, values in both.components.items():
        first, second, part = (table.components[name] for table in tables)
        np.testing.assert_allclose(values[0], (first[0] + second[0] + part[0]) / 3, atol=1e-6)
        np.testing.assert_allclose(values[1], (first[1] + second[1]) / 2, atol=1e-6)


@pytest.mark.slow
def test_times_to_collision_are_those_of_the_simulator(data, tmp_path):
    run = evaluated(data, IdmPlanner(), tmp_path / "run")
    motion = jnp.asarray(EpisodeTable.read(run).trajectories.ego)
    bank, task = ScenarioBank.from_scenarios(data), Task(rewards=RewardConfig("safety", urgency=-1.0))
    simulator = Simulator(task)
    times = np.asarray(times_to_collision(simulator, bank, motion, 10))
    replay = jax.jit(lambda state, pose: simulator.replay(bank, state, pose, jnp.zeros(2))[0])
    state = simulator.reset(bank, 0)
    for step in range(11, 91):
        state = replay(state, motion[0, step - 10])
        expected = float(state.facts.ttc_s) if state.facts.ttc_defined else 5.0
        assert times[0, step] == pytest.approx(expected, abs=1e-4)
    assert (times[:, :10] == 5.0).all() and times[0].min() < 5.0


def test_other_sets_and_missing_runs_are_refused(data, tmp_path, capsys):
    run = evaluated(data, ConstantVelocity(), tmp_path / "run")
    other = tmp_path / "other"
    with ScenarioWriter(other, SMALL) as writer:
        writer.add(assemble(straight_road([car(speed=4.0)]), SMALL))
    with pytest.raises(DataError, match="its episodes are not in"):
        curate("failures", Request(ScenarioSet.open(other), runs=[run]))
    with pytest.raises(UsageError, match=r"failures needs --runs RUN, .*; pass --runs RUN"):
        curate("failures", Request(data))
    with pytest.raises(UsageError, match="no other method takes it; leave out --runs"):
        curate("kinematic", Request(data, runs=[run]))
    with pytest.raises(UsageError, match="before_s is 0"):
        FailureConfig(before_s=0.0)
    assert main(["curate", "failures", "--data", str(data.path), "--out", str(tmp_path / "x.npz")]) == 2
    assert "pass --runs RUN" in capsys.readouterr().err
