"""Training with kernels against XLA: the gradient of one minibatch of the presets, and resuming bit for bit."""

import itertools
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.tree_util import keystr

from drivax import kernels, settings
from drivax.learning.algorithms.sac import SacParameters
from drivax.learning.config import TrainConfig
from drivax.learning.loop import train
from drivax.learning.replay import Transitions
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.store import ScenarioSet
from drivax.simulator.traffic.log import LogTraffic
from drivax.synthetic.generate import Generation, generate
from drivax.synthetic.world import generate_recording
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.run_folder import RunFolder
from kernels.compare import assert_close, needs_kernels

pytestmark = needs_kernels

BATCH = 64
OVERRIDES = {
    "ppo": [
        "--algorithm.environments",
        str(BATCH),
        "--algorithm.unroll",
        "1",
        "--algorithm.minibatches",
        "1",
    ],
    "sac": ["--algorithm.environments", str(BATCH), "--algorithm.replay.capacity", "512"],
}


def ppo_gradient(learner, observation, parameters, rng):
    """The gradient of a minibatch of a preset's batch, as a function of the parameters."""
    policy, value = learner.network(parameters).policy_and_value(observation)
    raw_action = policy.sample(jax.random.key(1))
    minibatch = {
        "observation": observation,
        "raw_action": raw_action,
        "log_prob": policy.log_prob(raw_action),
        "advantage": normal(rng),
        "target": value + normal(rng),
        "alive": jnp.asarray(rng.random(BATCH) < 0.9, jnp.float32),
        "noise": normal(rng, learner.environment.action_size),
    }
    minibatch = jax.tree.map(lambda leaf: leaf[None], minibatch)
    return lambda parameters: learner._gradient(parameters, minibatch, jax.random.key(2), None)


def sac_gradient(learner, observation, parameters, rng):
    """The gradient of a batch from the buffer; its next observations are those of other environments."""
    action = jnp.tanh(normal(rng, learner.environment.action_size))
    after = jax.tree.map(partial(jnp.roll, shift=1, axis=0), observation)
    ends = jnp.asarray(rng.random(BATCH) < 0.2)
    batch = Transitions(observation, action, normal(rng), ends, after, jnp.full(BATCH, 0.9))
    target = {"critic": parameters.critic}
    keys = jax.random.split(jax.random.key(2), (BATCH, 2))
    return lambda parameters: learner.gradient(parameters, target, batch, keys, jax.random.key(3), None)


def normal(rng, *shape):
    return jnp.asarray(rng.normal(size=(BATCH, *shape)), jnp.float32)


@pytest.fixture(scope="module", params=["ppo", pytest.param("sac", marks=pytest.mark.slow)])
def problem(request):
    """The algorithm of a preset, its compiled gradient on observations of generated scenarios, and parameters."""
    config = settings.load(TrainConfig, request.param, OVERRIDES[request.param])
    bank = ScenarioBank.from_scenarios([assemble(generate_recording(5, number)) for number in range(4)])
    learner = config.algorithm.build(config.environment(LogTraffic()), bank, 1)
    state = jax.jit(learner.init)(bank, jax.random.key(0))
    observation, rng = state.environments.observation, np.random.default_rng(0)
    if request.param == "ppo":
        parameters = state.trained
        return config.algorithm, jax.jit(ppo_gradient(learner, observation, parameters, rng)), parameters
    parameters = SacParameters(state.trained, state.critic, state.log_temperature)
    return config.algorithm, jax.jit(sac_gradient(learner, observation, parameters, rng)), parameters


def test_gradient_of_a_minibatch_equals_that_of_xla(problem):
    _, gradient, parameters = problem
    logs, actual = gradient(parameters)
    assert "drivax_differentiate_sets" in gradient.lower(parameters).as_text()
    with kernels.without_kernels():
        expected_logs, expected = gradient(parameters)
        assert "drivax_" not in gradient.lower(parameters).as_text()
    jax.tree.map(assert_close, actual, expected)
    for name, value in expected_logs.items():
        np.testing.assert_allclose(logs[name], value, rtol=1e-5, atol=1e-5, err_msg=name)


def ppo_loss(config, logs):
    return (
        logs["policy"]
        + config.value_coefficient * logs["value"]
        - config.entropy_coefficient * logs["entropy"]
    )


#: Parameters move by this distance.
STEP = 1e-3
#: Of each preset: networks, and the loss whose gradient theirs is, given the logs.
LOSSES = {
    "ppo": [("", ppo_loss)],
    "sac": [(".critic", lambda _, logs: logs["critic"]), (".policy", lambda _, logs: logs["policy"])],
}


def test_gradient_of_a_minibatch_equals_finite_differences(problem):
    """Along the gradient of each loss, where rounding matters least."""
    config, gradient, parameters = problem
    gradients = gradient(parameters)[1]
    for network, loss in LOSSES[config.kind]:
        slope = jax.tree.map_with_path(
            lambda path, leaf, network=network: leaf * keystr(path).startswith(network), gradients
        )
        norm = optax.tree.norm(slope)
        moved = [optax.tree.add_scale(parameters, step / norm, slope) for step in (STEP, -STEP)]
        before, after = (loss(config, gradient(parameters)[0]) for parameters in moved)
        np.testing.assert_allclose((before - after) / (2 * STEP), norm, rtol=2e-3)


@pytest.mark.slow
def test_resuming_with_kernels_is_bit_for_bit(tmp_path):
    """A process that resumes ends in the state of one that was not stopped."""
    generate(tmp_path / "set", 3, 11, Generation(workers=0))
    data = ScenarioSet.open(tmp_path / "set")
    small = ["--algorithm.environments", "8", "--algorithm.unroll", "4", "--total_steps", "96"]
    config = settings.load(TrainConfig, "ppo", [*small, "--checkpoint_every", "1", "--evaluate_every", "0"])
    whole = train(config, data, tmp_path / "whole", validation=None)
    assert whole.info["machine"]["kernels"] == kernels.state()
    cut = Path(shutil.copytree(whole.path, tmp_path / "cut"))
    for step in (64, 96):
        shutil.rmtree(cut / "checkpoints" / f"step-{step:09}")
    command = [sys.executable, "-m", "drivax", "train", "ppo", "--resume", "--validation", "none"]
    subprocess.run([*command, "--data", str(data.path), "--out", str(cut)], check=True)
    bank = ScenarioBank.from_scenarios(data)
    learner = config.algorithm.build(config.environment(LogTraffic()), bank, config.iterations)
    shapes = jax.eval_shape(learner.init, bank, jax.random.key(0))
    states = [Checkpoints(path / "checkpoints").restore(shapes, 96) for path in (whole.path, cut)]
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(*map(plain, (a, b))), *states)
    logs = [RunFolder.open(path).read_metrics() for path in (whole.path, cut)]
    for row in itertools.chain(*logs):
        del row["steps_per_second"]
    assert logs[0] == logs[1] and len(logs[0]) == 3


def plain(leaf):
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
