"""Collecting, PPO and resuming."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import settings
from drivax.errors import UsageError
from drivax.learning.collector import collect
from drivax.learning.config import TrainConfig
from drivax.learning.driving import Driving
from drivax.learning.loop import logged, train
from drivax.learning.policies import load_policy
from drivax.scenario.bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.simulator.simulator import Simulator
from drivax.synthetic.generate import Generation, generate
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from drivax.tracking.sinks import read_rows

SMALL = {
    "task": {"observation": {"agents": 4, "steps": 1, "road": 0, "lights": 1, "route": 4}},
    "algorithm": {
        "kind": "ppo",
        "network": {"encoder": {"rows": [8], "hidden": [16]}, "head": [8]},
        "environments": 8, "unroll": 16, "epochs": 2, "minibatches": 2,
    },
    "total_steps": 4 * 8 * 16,
    "checkpoint_every": 1,
}  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("learning") / "set"
    generate(path, 4, 11, Generation(workers=1))
    return ScenarioSet.open(path)


@pytest.fixture(scope="module")
def config():
    return settings.load(TrainConfig, SMALL)


def test_collected_experience_is_consistent(data):
    bank = ScenarioBank.from_scenarios(data)
    simulator = Simulator(Task(observation=ObservationConfig(agents=2, steps=1, road=0, lights=1, route=2)))
    driving = Driving(simulator)
    environments = jax.jit(driving.start, static_argnums=2)(bank, jax.random.key(0), 6)

    def actor(observation, key):
        choice = 0.3 * jax.random.normal(key, (6, 2))
        return choice, jnp.tanh(choice), {}

    run = jax.jit(lambda b, e, k: collect(driving, b, e, actor, k, 120))
    after, rollout, totals = run(bank, environments, jax.random.key(1))
    ended = np.asarray(rollout.terminated | rollout.truncated)
    alive = np.asarray(rollout.alive)
    # Every end is followed by exactly one step that only resets, and by nothing else.
    np.testing.assert_array_equal(~alive[1:], ended[:-1])
    assert ended.sum() >= 6 and not (ended & ~alive).any()
    assert (np.asarray(rollout.reward)[~alive] == 0).all()
    assert float(totals["episodes"]) == ended.sum() and float(totals["steps"]) == alive.sum()
    weights = sum(float(totals[f"reward/{name}"]) for name in simulator.task.rewards.weights())
    assert weights == pytest.approx(float(rollout.reward.sum()), rel=1e-4, abs=1e-3)
    np.testing.assert_array_equal(after.over, ended[-1])


def test_resume_is_bit_for_bit(data, config, tmp_path):
    whole = train(config, data, tmp_path / "whole")
    short = settings.load(TrainConfig, SMALL | {"total_steps": 4 * 8 * 16})
    # The same run, cut off after two of its four iterations.
    cut = train(short, data, tmp_path / "cut")
    for folder in cut.checkpoints.glob("step-*"):
        if int(folder.name.removeprefix("step-")) > 3 * 8 * 16:
            _remove(folder)
    resumed = train(short, data, tmp_path / "cut", resume=True)
    rows = [list(read_rows(run.metrics)) for run in (whole, resumed)]
    assert [row["step"] for row in rows[0]] == [128, 256, 384, 512] == [row["step"] for row in rows[1]]
    for one, other in zip(*rows, strict=True):
        for name in one:
            if not name.startswith(("time", "steps_per_second")):
                assert one[name] == other[name], name
    bank = ScenarioBank.from_scenarios(data)
    policies = [load_policy(run.path, bank)[0].parameters for run in (whole, resumed)]
    jax.tree.map(np.testing.assert_array_equal, *policies)


def _remove(folder):
    import shutil

    shutil.rmtree(folder)


def test_a_run_is_never_overwritten_or_resumed_on_other_data(data, config, tmp_path):
    train(config, data, tmp_path / "run")
    with pytest.raises(UsageError, match="--overwrite"):
        train(config, data, tmp_path / "run")
    generate(tmp_path / "other", 4, 12, Generation(workers=1))
    with pytest.raises(UsageError, match="other scenarios"):
        train(config, ScenarioSet.open(tmp_path / "other"), tmp_path / "run", resume=True)
    with pytest.raises(UsageError, match="same --validation"):
        train(config, data, tmp_path / "run", resume=True, validation=ScenarioSet.open(tmp_path / "other"))
    info = json.loads((tmp_path / "run" / "run.json").read_text())
    assert info["kind"] == "training" and info["data"][0]["hash"] == data.hash


def test_means_of_an_iteration():
    raw = {
        "rollout/episodes": 4.0, "rollout/steps": 50.0, "rollout/success": 3.0, "rollout/success/n": 4.0,
        "rollout/red_light": 0.0, "rollout/red_light/n": 0.0, "rollout/reward/progress": 5.0, "loss/value": 0.5,
    }  # fmt: skip
    assert logged(raw) == {
        "rollout/episodes": 4.0, "rollout/success": 0.75, "reward/progress": 0.1, "loss/value": 0.5,
    }  # fmt: skip


@pytest.mark.slow
def test_ppo_learns_to_follow_the_route(data, tmp_path):
    longer = settings.load(TrainConfig, SMALL | {"total_steps": 200_000}, ["--algorithm.environments", "64"])
    rows = list(read_rows(train(longer, data, tmp_path / "run").metrics))
    first, last = (np.mean([row["reward/progress"] for row in part]) for part in (rows[:10], rows[-10:]))
    assert last > 1.5 * first and last > 0.08
