"""The modes of an evaluation, all at once, through the command line."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest

import drivax
from drivax import settings
from drivax.api import find_planner, load
from drivax.cli import main
from drivax.errors import UsageError
from drivax.evaluation.runner import EvaluationConfig
from drivax.learning.config import TrainConfig
from drivax.scenario.store import ScenarioSet
from drivax.simulator.starts import NoisyStart
from drivax.synthetic.generate import Generation, generate
from drivax.tasks.actions import Published
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from drivax.tracking.sinks import read_rows
from tiny_run import write_run

START = 60


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("modes") / "set"
    generate(path, 2, 21, Generation(workers=0))
    return path


def evaluate(data, planner, out, *more):
    """Status of the command; from a late step, after a noisy start."""
    call = ["evaluate", "--planner", planner, "--data", str(data), "--out", str(out), "--noisy-start"]
    return main([*call, "--start-step", str(START), "--seed", "7", *more])


def rollouts(out):
    with np.load(out / "trajectories.npz") as stored:
        return dict(stored)


@pytest.mark.slow
def test_sampling_checkpoint_with_noisy_start_replaces_a_run(data, tmp_path, capsys):
    run = write_run(tmp_path / "bold", load(data).bank)
    out, planner = tmp_path / "run", f"{run.path}@4"
    assert evaluate(data, planner, out, "--sample") == 0
    config = settings.load(EvaluationConfig, out / "config.yaml")
    assert config == EvaluationConfig(
        planner=planner,
        noisy_start=True,
        start_step=START,
        seed=7,
        sample=True,
        task=run.config(TrainConfig).task,
    )
    assert json.loads((out / "run.json").read_text())["planner"] == "bold@4"
    sampled, scenarios = rollouts(out), ScenarioSet.open(data)
    assert (sampled["start"] == START).all()
    assert sampled["ego"].shape == (2, 91 - START, 4) and sampled["action"].shape == (2, 90 - START, 2)
    logged = np.stack([one.agent_xy[START, 0] for one in scenarios])
    away = np.linalg.norm(sampled["ego"][:, 0, :2] - logged, axis=1)
    assert (away > 0.01).all(), "a second of wrong driving leads elsewhere than the log"
    options = {"start": NoisyStart(), "start_step": START, "seed": 7, "metrics": ("own_terms:nearest_other",)}
    found = drivax.evaluate(planner, data, sample=True, **options)
    np.testing.assert_array_equal(found.trajectories.ego, sampled["ego"])
    assert list(found.own_metrics) == ["nearest_other"]
    with pytest.raises(UsageError, match="only a trained policy by name can sample"):
        drivax.evaluate(find_planner(planner, load(data).bank)[0], data, sample=True)
    (out / "crashes.json").write_text("[]")
    capsys.readouterr()
    assert evaluate(data, planner, out) == 2 and "already exists" in capsys.readouterr().err
    assert (out / "crashes.json").exists(), "a run that was not to be replaced is whole"
    assert evaluate(data, planner, out, "--overwrite") == 0
    modes = rollouts(out)
    assert not (out / "crashes.json").exists(), "nothing of the old run stays"
    assert not settings.load(EvaluationConfig, out / "config.yaml").sample
    np.testing.assert_array_equal(modes["ego"][:, 0], sampled["ego"][:, 0])
    assert (np.abs(modes["action"] - sampled["action"]).max(axis=(1, 2)) > 0.05).all()


@pytest.mark.parametrize("planner", [pytest.param("random", marks=pytest.mark.slow), "constant_velocity"])
def test_task_flags_hold_for_rule_based_planners(data, planner, tmp_path):
    flags = ["--task.actions", "published", "--task.observation.road", "0", "--task.observation.agents", "1"]
    assert evaluate(data, planner, tmp_path / "run", *flags) == 0
    task = settings.load(EvaluationConfig, tmp_path / "run" / "config.yaml").task
    assert task == Task(actions=Published(), observation=ObservationConfig(agents=1, road=0))
    options = {"start": NoisyStart(), "start_step": START, "seed": 7}
    published = drivax.evaluate(planner, data, task=task, **options)
    ego = rollouts(tmp_path / "run")["ego"]
    np.testing.assert_array_equal(published.trajectories.ego, ego)
    if planner == "random":
        default = drivax.evaluate(planner, data, **options)
        assert np.abs(default.trajectories.ego - ego).max() > 0.1


def test_task_flags_are_refused_for_trained_policies(data, tmp_path, capsys):
    assert evaluate(data, "zoo:aggressive", tmp_path / "run", "--task.actions", "published") == 2
    assert "trained policy 'zoo:aggressive' has its own task; leave out --task" in capsys.readouterr().err
    with pytest.raises(UsageError, match="has its own task"):
        drivax.evaluate("zoo:aggressive", data, task=Task())


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--task.action", "published"], "did you mean 'actions'"),
        (["--limt", "1"], "unknown option '--limt'; did you mean '--limit'"),
        (["--task", "demo"], "unknown option '--task'; did you mean '--task.KEY'"),
        (["extra"], "extra"),
    ],
)
def test_unknown_flags_name_the_closest_one(data, flags, message, tmp_path, capsys):
    assert evaluate(data, "idm", tmp_path / "run", *flags) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "run").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    "planner", ["idm", "pdm", "search_planner:SearchPlanner", "random", "zoo:aggressive"]
)
def test_threads_and_devices_do_not_change_results(data, planner, tmp_path):
    """XLA's pool has a thread per core unless NPROC says otherwise, which it reads once per process."""
    one_thread = "--xla_cpu_multi_thread_eigen=false"
    flags = os.environ.get("XLA_FLAGS", "").replace(one_thread, "")
    variables = [{"NPROC": threads, "XLA_FLAGS": flags} for threads in ("1", "2", "8")]
    variables += [{"XLA_FLAGS": f"{flags} {one_thread}"}]
    variables += [{"XLA_FLAGS": f"{flags} --xla_force_host_platform_device_count=2"}]
    found = set()
    for number, values in enumerate(variables):
        out = tmp_path / str(number)
        call = ["evaluate", "--planner", planner, "--data", str(data), "--out", str(out), "--traffic", "idm"]
        subprocess.run(
            [sys.executable, "-m", "drivax", *call],
            env=os.environ | values | {"PYTHONPATH": os.pathsep.join(sys.path)},
            check=True,
            timeout=900,
        )
        found.add((out / "episodes.csv").read_bytes())
    assert len(found) == 1


TRAINING = """
total_steps: 1536
task: {metrics: none}
devices: 1
algorithm:
  kind: ppo
  network: {encoder: {hidden: [128]}, head: [64]}
  environments: 64
  unroll: 8
  minibatches: 2
checkpoint_every: 3
"""


@pytest.mark.slow
def test_threads_change_training_only_by_rounding(data, tmp_path):
    """Sums are divided among the threads: each number gives other roundings."""
    (tmp_path / "train.yaml").write_text(TRAINING)
    flags = os.environ.get("XLA_FLAGS", "")
    variables = [{"NPROC": threads, "XLA_FLAGS": flags} for threads in ("1", "2", "8")]
    variables += [{"XLA_FLAGS": f"{flags} --xla_cpu_multi_thread_eigen=false"}]
    rows = []
    for number, values in enumerate(variables):
        out = tmp_path / str(number)
        call = ["train", str(tmp_path / "train.yaml"), "--data", str(data), "--validation", "none"]
        subprocess.run(
            [sys.executable, "-m", "drivax", *call, "--out", str(out)],
            env=os.environ | values | {"PYTHONPATH": os.pathsep.join(sys.path)},
            check=True,
            timeout=900,
        )
        rows.append([{**row, "steps_per_second": 0.0} for row in read_rows(out / "metrics.jsonl")])
    for same_step in zip(*rows, strict=True):
        for row in same_step[1:]:
            assert row == pytest.approx(same_step[0], rel=2e-3, abs=2e-5, nan_ok=True)
