"""Offline learning from a mixture of 5 % good and 95 % poor drives of the pendulum.

Weighted by return every algorithm swings up; from steps that are all alike none does. The good driver pumps energy; the
poor one damps every swing.
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


def swings_up(seen, key):
    """Pumps energy until that of the upright pendulum is there, and holds it near the top."""
    cos, sin, rate = jnp.moveaxis(seen, -1, 0)
    angle, energy = jnp.arctan2(sin, cos), 0.5 * rate**2 + 15.0 * (cos - 1.0)
    near = (jnp.abs(angle) < 0.6) & (jnp.abs(rate) < 3.0)
    torque = jnp.where(near, -8.0 * angle - 2.0 * rate, -0.3 * energy * jnp.sign(rate + 1e-3))
    return _shaken(jnp.clip(torque / MAX_TORQUE, -1.0, 1.0), 0.05, key)


def damps(seen, key):
    """Works against every swing."""
    return _shaken(0.8 * jnp.clip(-0.5 * seen[:, 2], -1.0, 1.0), 0.2, key)


def _shaken(action, noise, key):
    return jnp.clip(action + noise * jax.random.normal(key, action.shape), -1.0, 1.0)[:, None]


@pytest.fixture(scope="module")
def mixture():
    """The episodes, their returns, and a weight per step that follows the return of its episode."""
    good, earned = jax.jit(lambda key: episodes(swings_up, key, GOOD))(jax.random.key(1))
    poor, lost = jax.jit(lambda key: episodes(damps, key, EPISODES - GOOD))(jax.random.key(2))
    table = jax.tree.map(lambda *parts: jnp.concatenate(parts), good, poor)
    found = np.concatenate([earned, lost]).astype(float)
    share = (found - found.min()) / (found.max() - found.min())
    # As trajectories are weighed by Hong et al. 2023 (arXiv 2306.13085): exp of the normalised return over 0.1.
    weights = np.exp(share / 0.1)[:, None] * np.ones(table.reward.shape)
    return table, found, weights


def earns(config, table, weights):
    """Mean return, by its mode, of what was learned."""
    learner = config.build(Logged(), table, ITERATIONS)
    made = training_data(config, Logged(), table, weights)

    @jax.jit
    def run(made):
        state = learner.init(made, jax.random.key(0))
        state = jax.lax.scan(lambda s, _: learner.iterate(made, s), state, None, ITERATIONS)[0]
        return returns(learner.distribution, state.parameters, jax.random.key(9))[0].mean()

    return float(run(made))


def test_demonstrations_are_a_mixture(mixture):
    _, found, weights = mixture
    assert found[:GOOD].min() > -500 and found[GOOD:].max() < -1400
    assert weights[:GOOD].sum() / weights.sum() > 0.95 and GOOD / EPISODES == 0.05


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in ALGORITHMS]
)
def test_weights_by_return_recover_the_good_policy(mixture, name):
    """Half of the way from the mixture's mean to the good policy, at least; without them, not a tenth of it."""
    table, found, weights = mixture
    judge = partial(earns, ALGORITHMS[name], table)
    gained = [
        (judge(by) - found.mean()) / (found[:GOOD].mean() - found.mean())
        for by in (weights, np.ones_like(weights))
    ]
    assert gained[0] > 0.5, gained
    assert gained[1] < 0.1, gained
