"""Cloning against NumPy, and imitation in addition to learning by reward."""

from dataclasses import dataclass, replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from drivax.errors import UsageError
from drivax.learning.algorithms.behaviour_cloning import BcConfig, Cloning
from drivax.learning.algorithms.ppo import PpoConfig
from drivax.learning.algorithms.sac import SacConfig
from drivax.learning.algorithms.warm_start import BcPpoConfig, WarmStart
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.distributions import Grid, SquashedGaussian
from drivax.networks.encoders import MlpConfig
from pendulum import Demonstrations, Pendulum

TINY = NetworkConfig(encoder=MlpConfig(hidden=(8,)), head=(8,))
CLONING = Cloning(batch=16, updates=3)
PPO = PpoConfig(network=TINY, environments=4, unroll=4, epochs=1, minibatches=2)


@dataclass(frozen=True)
class Logged(Pendulum):
    """Always the same moments."""

    def demonstrations(self, data, key, count):
        return data


@pytest.fixture(scope="module")
def demonstrations():
    """What a pendulum's expert might do: push against the rate."""
    angle, rate = jax.random.uniform(jax.random.key(0), (2, 500), minval=-3.0, maxval=3.0)
    return Demonstrations({"angle": angle, "rate": rate}, jnp.tanh(-rate)[:, None])


def gaussian(parameters, observation):
    return SquashedGaussian(parameters["loc"], parameters["scale"])


@pytest.mark.parametrize("mask", [True, False])
def test_losses_against_numpy(mask):
    rng = np.random.default_rng(0)
    loc, action = rng.normal(size=(2, 6, 2)).astype(np.float32)
    scale = rng.uniform(0.2, 1.0, size=(6, 2)).astype(np.float32)
    action, clipped = np.tanh(action), np.array([0, 1, 0, 0, 1, 0], bool)
    counts = ~clipped if mask else np.ones(6, bool)
    data = ({"pendulum": jnp.zeros((6, 3))}, jnp.asarray(action), jnp.asarray(clipped))
    parameters = {"loc": jnp.asarray(loc), "scale": jnp.asarray(scale)}
    error = np.tanh(loc) - action
    # By change of variables from the normal density of SciPy; the derivative of arctanh is 1 / (1 - a^2).
    density = stats.norm.logpdf(np.arctanh(action.astype(float)), loc, scale) - np.log1p(-(action**2.0))
    for loss, expected in (("mse", (error**2).mean(axis=-1)), ("likelihood", -density.sum(axis=-1))):
        cloning = Cloning(loss=loss, mask_clipped=mask)
        value, logs = cloning.batch_loss(gaussian, parameters, Logged(), data, jax.random.key(0))
        assert float(value) == pytest.approx(expected[counts].mean(), rel=1e-4)
        assert float(logs["imitation_error"]) == pytest.approx(np.abs(error)[counts].mean(), rel=1e-4)
        assert float(logs["left_out"]) == pytest.approx(2 / 6 if mask else 0.0, abs=1e-6)


def test_clipped_steps_have_no_loss():
    clipped = jnp.array([True, False])
    data = ({"pendulum": jnp.zeros((2, 3))}, jnp.array([[1.0], [0.3]]), clipped)
    parameters = {"loc": jnp.zeros((2, 1)), "scale": jnp.full((2, 1), 0.3)}
    for loss in ("mse", "likelihood"):

        def of(parameters, loss=loss):
            return Cloning(loss=loss).batch_loss(gaussian, parameters, Logged(), data, jax.random.key(0))[0]

        slope = jax.grad(of)(parameters)["loc"][:, 0]
        assert slope[0] == 0.0 and slope[1] < 0.0


def test_likelihood_fits_the_standard_deviation(demonstrations):
    """Of an expert that acts by N(0.4, 0.2) before squashing, whatever it sees."""
    action = jnp.tanh(0.4 + 0.2 * jax.random.normal(jax.random.key(1), demonstrations.action.shape))
    data = replace(demonstrations, action=action)
    config = BcConfig(loss="likelihood", batch=256, updates=300, learning_rate=1e-2, network=TINY)
    learner = config.build(Pendulum(), data, 1)
    state, _ = jax.jit(learner.iterate)(data, jax.jit(learner.init)(data, jax.random.key(0)))
    policy = learner.distribution(state.parameters, Pendulum().observe_all(data, data.stored))
    raw_action = np.arctanh(np.asarray(action))
    assert float(policy.loc.mean()) == pytest.approx(raw_action.mean(), abs=0.03)
    assert float(policy.scale.mean()) == pytest.approx(raw_action.std(), rel=0.1)


def test_a_grid_and_missing_experts_are_refused(demonstrations):
    levels = (tuple(np.linspace(-1, 1, 5)),)
    environment = Pendulum(levels=levels)
    network = replace(TINY, distribution="grid")
    with pytest.raises(UsageError, match="use loss: likelihood"):
        BcConfig(network=network).build(environment, demonstrations, 1)
    learner = BcConfig(network=network, loss="likelihood", batch=8, updates=2).build(
        environment, demonstrations, 1
    )
    state = jax.jit(learner.init)(demonstrations, jax.random.key(0))
    assert isinstance(learner.distribution(state.parameters, {"pendulum": jnp.zeros(3)}), Grid)
    with pytest.raises(UsageError, match="reparameterised samples"):
        SacConfig(network=network)


def test_imitation_weight_decays():
    weights = [float(WarmStart(weight=0.8, half_life=10).weight_at(jnp.asarray(i))) for i in (0, 10, 30)]
    np.testing.assert_allclose(weights, [0.8, 0.4, 0.1], rtol=1e-6)
    assert float(WarmStart(weight=0.8).weight_at(jnp.asarray(1000))) == pytest.approx(0.8)
    with pytest.raises(UsageError, match="use 0 or more"):
        WarmStart(weight=-1.0)
    with pytest.raises(UsageError, match="raise total_steps"):
        WarmStart(iterations=5).online_iterations(5)
    assert WarmStart(iterations=5).online_iterations(8) == 3


@pytest.mark.parametrize("shared", [False, True])
def test_settling_fits_ppo_values_to_a_fixed_policy(demonstrations, shared):
    network = replace(TINY, shared_encoder=shared)
    start, ppo = WarmStart(iterations=1, cloning=CLONING, settle=1), replace(PPO, network=network)
    learner = BcPpoConfig(warm_start=start, ppo=ppo).build(Pendulum(), demonstrations, 3)
    states, iterate = [jax.jit(learner.init)(demonstrations, jax.random.key(0))], jax.jit(learner.iterate)
    for _ in range(3):
        states.append(iterate(demonstrations, states[-1])[0])

    def changes(name):
        parts = [jax.tree.leaves(state.parameters[name]) for state in states[1:]]
        return [max(float(abs(a - b).max()) for a, b in zip(*pair, strict=True)) for pair in pairwise(parts)]

    (settling, learning), values = changes("policy"), changes("value")
    assert settling == 0.0 and learning > 1e-5 and min(values) > 1e-5


@pytest.mark.slow
def test_imitation_loss_keeps_the_policy_near_the_expert(demonstrations):
    """From the same clone, learning by reward with a large weight stays nearer to the expert than without."""
    errors = {}
    for weight in (0.0, 30.0):
        start = WarmStart(iterations=1, cloning=replace(CLONING, updates=100), weight=weight)
        ppo = replace(PPO, learning_rate=1e-2)
        learner = BcPpoConfig(warm_start=start, ppo=ppo).build(Pendulum(), demonstrations, 21)
        state = jax.jit(learner.init)(demonstrations, jax.random.key(0))

        def run(state, learner=learner):
            return jax.lax.scan(lambda s, _: learner.iterate(demonstrations, s), state, None, 21)[0]

        state = jax.jit(run)(state)
        observations = Pendulum().observe_all(demonstrations, demonstrations.stored)
        policy = learner.online.distribution(state.parameters, observations)
        errors[weight] = float(jnp.abs(policy.mode() - demonstrations.action).mean())
    assert errors[30.0] < 0.5 * errors[0.0], errors
