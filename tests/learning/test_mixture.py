"""Offline learning from a mixture of 5 % good and 95 % poor episodes of the pendulum.

With weights by return every algorithm recovers at least half of the good policy's advantage, with uniform weights less
than a tenth. The good policy pumps energy; the poor one damps every swing.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.learning.algorithm import training_data
from drivax.learning.algorithms.behaviour_cloning import BcConfig
from drivax.learning.algorithms.cql import CqlConfig
from drivax.learning.algorithms.iql import IqlConfig
from drivax.learning.algorithms.td3_bc import Td3BcConfig
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.encoders import MlpConfig
from pendulum import MAX_TORQUE, returns
from recorded import Logged, episodes

EPISODES, GOOD = 200, 10
NETWORK = NetworkConfig(encoder=MlpConfig(hidden=(64,)), head=(64,), activation="relu")
SIZES = {"network": NETWORK, "batch": 128, "updates": 100}
RATES = {"policy_rate": 2e-3, "critic_rate": 2e-3, "gamma": 0.97, "tau": 0.01}
ALGORITHMS = {
    "bc": BcConfig(learning_rate=2e-3, **SIZES),
    "iql": IqlConfig(inverse_temperature=0.1, **SIZES, **RATES),
    "td3_bc": Td3BcConfig(q_weight=0.1, delay=1, **SIZES, **RATES),
    "cql": CqlConfig(penalty=10.0, actions=4, temperature=0.02, target_entropy=-2.0, **SIZES, **RATES),
    "cql_bc": CqlConfig(penalty=2.0, actions=4, imitation=20.0, **SIZES, **RATES),
}
ITERATIONS = 20
QUICK = ("bc",)


def swing_up(observation, key):
    """Pump energy up to that of the upright pendulum, and hold it near the top."""
    cos, sin, rate = jnp.moveaxis(observation, -1, 0)
    angle, energy = jnp.arctan2(sin, cos), 0.5 * rate**2 + 15.0 * (cos - 1.0)
    near = (jnp.abs(angle) < 0.6) & (jnp.abs(rate) < 3.0)
    torque = jnp.where(near, -8.0 * angle - 2.0 * rate, -0.3 * energy * jnp.sign(rate + 1e-3))
    return _add_noise(jnp.clip(torque / MAX_TORQUE, -1.0, 1.0), 0.05, key)


def damp(observation, key):
    """Work against every swing."""
    return _add_noise(0.8 * jnp.clip(-0.5 * observation[:, 2], -1.0, 1.0), 0.2, key)


def _add_noise(action, noise, key):
    return jnp.clip(action + noise * jax.random.normal(key, action.shape), -1.0, 1.0)[:, None]


@pytest.fixture(scope="module")
def mixture():
    """The episodes, their returns, and a weight per step that follows the return of its episode."""
    good, good_returns = jax.jit(lambda key: episodes(swing_up, key, GOOD))(jax.random.key(1))
    poor, poor_returns = jax.jit(lambda key: episodes(damp, key, EPISODES - GOOD))(jax.random.key(2))
    table = jax.tree.map(lambda *parts: jnp.concatenate(parts), good, poor)
    episode_returns = np.concatenate([good_returns, poor_returns]).astype(float)
    share = (episode_returns - episode_returns.min()) / (episode_returns.max() - episode_returns.min())
    # As trajectories are weighed by Hong et al. 2023 (arXiv 2306.13085): exp of the normalised return over 0.1.
    weights = np.exp(share / 0.1)[:, None] * np.ones(table.reward.shape)
    return table, episode_returns, weights


def mean_return(config, table, weights):
    """Return the mean return of the learned policy's mode."""
    learner = config.build(Logged(), table, ITERATIONS)
    experience = training_data(config, Logged(), table, weights)

    @jax.jit
    def run(experience):
        state = learner.init(experience, jax.random.key(0))
        state = jax.lax.scan(lambda s, _: learner.iterate(experience, s), state, None, ITERATIONS)[0]
        return returns(learner.distribution, state.parameters, jax.random.key(9))[0].mean()

    return float(run(experience))


def test_demonstrations_are_a_mixture(mixture):
    _, episode_returns, weights = mixture
    assert episode_returns[:GOOD].min() > -500 and episode_returns[GOOD:].max() < -1400
    assert weights[:GOOD].sum() / weights.sum() > 0.95 and GOOD / EPISODES == 0.05


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in ALGORITHMS]
)
def test_weights_by_return_recover_the_good_policy(mixture, name):
    """More than half of the way from the mean return to that of the good episodes; without weights, under a tenth."""
    table, episode_returns, weights = mixture
    evaluate = partial(mean_return, ALGORITHMS[name], table)
    gains = [
        (evaluate(step_weights) - episode_returns.mean())
        / (episode_returns[:GOOD].mean() - episode_returns.mean())
        for step_weights in (weights, np.ones_like(weights))
    ]
    assert gains[0] > 0.5, gains
    assert gains[1] < 0.1, gains
