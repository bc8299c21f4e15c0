"""Algorithms on a control task with known results: pendulum swing-up, three seeds side by side.

``make test`` runs shorter trainings than the targets allow (SAC 30,000 steps, PPO 300,000); slow tests run full ones.
"""

from functools import partial

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.learning.algorithms.behaviour_cloning import BcConfig
from drivax.learning.algorithms.ppo import PpoConfig
from drivax.learning.algorithms.sac import SacConfig
from drivax.learning.environment import Environments
from drivax.learning.replay import ReplayConfig
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.encoders import MlpConfig
from pendulum import MAX_TORQUE, Demonstrations, Pendulum, Swing, returns

SEEDS = jnp.stack([jax.random.key(seed) for seed in range(3)])
NETWORK = NetworkConfig(encoder=MlpConfig(hidden=(64,)), head=(64,), activation="relu")
SAC = SacConfig(
    network=NETWORK,
    replay=ReplayConfig(capacity=30_000),
    environments=4,
    unroll=16,
    updates_per_step=4,
    batch=128,
    warm_up=1_000,
    policy_rate=2e-3,
    critic_rate=2e-3,
    temperature_rate=2e-3,
    gamma=0.98,
    tau=0.02,
    temperature=0.5,
)
PPO = PpoConfig(
    network=NETWORK,
    environments=16,
    unroll=128,
    epochs=10,
    minibatches=16,
    learning_rate=1e-3,
    gamma=0.95,
    lambda_=0.95,
    entropy_coefficient=0.0,
)
BC = BcConfig(network=NETWORK, batch=256, updates=100, learning_rate=2e-3)


def train(config, data, steps):
    """A learner per seed after some steps: the learner, its states, and what was logged by iteration."""
    iterations = -(-steps // config.steps_per_iteration)
    learner = config.build(Pendulum(), data, iterations)
    states = jax.jit(jax.vmap(learner.init, (None, 0)))(data, SEEDS)

    @partial(jax.jit, donate_argnums=1)
    def run(data, states):
        def one(states, _):
            return jax.vmap(learner.iterate, (None, 0))(data, states)

        return jax.lax.scan(one, states, None, iterations)

    states, logs = run(data, states)
    return learner, states, logs


@partial(jax.jit, static_argnums=0)
def evaluate(distribution, parameters, key=99):
    """Mean return of each seed over 100 episodes by the mode, and what it did in them."""
    returns_of = partial(returns, distribution, key=jax.random.key(key))
    earned, demonstrations = jax.vmap(returns_of)(parameters)
    return earned.mean(axis=1), demonstrations


@pytest.fixture(scope="module")
def expert():
    """SAC after 8,000 steps: its returns, what the first seed did in other episodes, and what was logged."""
    learner, states, logs = train(SAC, (), 8_000)
    mean_returns, _ = evaluate(learner.distribution, states.parameters)
    _, demonstrations = evaluate(learner.distribution, states.parameters, 7)
    moments = jax.tree.map(lambda leaf: leaf[0].reshape(-1, *leaf.shape[3:]), demonstrations)
    return mean_returns, Demonstrations(moments.stored, moments.action), logs


def test_pendulum_equals_gymnasiums():
    gym_pendulum = gymnasium.make("Pendulum-v1")
    gym_pendulum.reset(seed=3)
    angle, rate = gym_pendulum.unwrapped.state
    pendulum, step = Pendulum(), jax.jit(Pendulum().step)
    array = partial(jnp.full, (1,), dtype=jnp.float32)
    state = Swing(array(angle), array(rate), jnp.zeros(1, jnp.int32), array(0.0))
    now = Environments(state, jnp.zeros(1, bool), pendulum.observe_all((), pendulum.stored(state)))
    actions = np.random.default_rng(0).uniform(-1, 1, 200)
    for number, action in enumerate(actions):
        seen, reward, terminated, truncated, _ = gym_pendulum.step(np.array([MAX_TORQUE * action]))
        now, outcome = step((), now, (), jnp.array([[action]], jnp.float32), jax.random.key(0))
        np.testing.assert_allclose(outcome.reward[0], reward, rtol=2e-3, atol=2e-3)
        np.testing.assert_allclose(now.observation["pendulum"][0], seen, rtol=2e-3, atol=2e-3)
        assert (bool(outcome.terminated[0]), bool(outcome.truncated[0])) == (terminated, truncated)
        assert truncated == (number == 199)


@pytest.mark.slow
def test_sac_swings_up(expert):
    mean_returns, _, logs = expert
    assert (mean_returns > -200).all(), mean_returns
    # What is logged is what happened: whole episodes, a temperature that is learned, values of the right size.
    count = np.asarray(logs["rollout/return/n"])
    episodes = np.asarray(logs["rollout/return"])[count > 0] / count[count > 0]
    assert episodes[:3].mean() < -800 < episodes[-3:].mean()
    entropy = np.asarray(logs["loss/entropy"])[-10:] / np.asarray(logs["loss/entropy/n"])[-10:]
    assert abs(entropy.mean() + 1.0) < 0.3
    assert float(np.asarray(logs["loss/mean_q/n"])[0].max()) == 0.0, "nothing is learned while warming up"


@pytest.mark.slow
def test_ppo_swings_up():
    learner, states, _ = train(PPO, (), 80_000)
    mean_returns, _ = evaluate(learner.distribution, states.parameters)
    assert (mean_returns > -300).all(), mean_returns


@pytest.mark.slow
def test_cloned_policy_swings_up_like_its_expert(expert):
    best, demonstrations, _ = expert
    learner, states, _ = train(BC, demonstrations, 20 * BC.steps_per_iteration)
    mean_returns, _ = evaluate(learner.distribution, states.parameters)
    assert (mean_returns > 1.1 * best[0]).all(), (mean_returns, best)


@pytest.mark.slow
def test_full_length_trainings_reach_their_targets():
    for config, steps, target in ((SAC, 30_000, -200), (PPO, 300_000, -300)):
        learner, states, _ = train(config, (), steps)
        mean_returns, _ = evaluate(learner.distribution, states.parameters)
        assert (mean_returns > target).all(), mean_returns
