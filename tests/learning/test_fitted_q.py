"""Fitted-Q evaluation where the answer is known."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import settings
from drivax.errors import UsageError
from drivax.learning.algorithm import training_data
from drivax.learning.algorithms.iql import IqlConfig
from drivax.learning.algorithms.off_policy_evaluation import (
    MOST_RATIO,
    FittedQ,
    FittedQConfig,
    estimate_return,
)
from drivax.learning.config import TrainConfig
from drivax.learning.experience import ExperienceConfig
from drivax.learning.training_log import rank
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.distributions import SquashedGaussian
from drivax.networks.encoders import MlpConfig
from recorded import Logged, Table

NETWORK = NetworkConfig(encoder=MlpConfig(hidden=(32,)), head=(32,), activation="relu")
GAMMA, LENGTH = 0.8, 6


@pytest.fixture(scope="module")
def table():
    """A loop in which pushing right pays 1 and pushing left nothing; half of the expert's pushes go either way."""
    shape = (40, LENGTH + 1)
    right = np.random.default_rng(0).random(shape) < 0.5
    number = np.broadcast_to(np.arange(LENGTH + 1), shape)
    never = jnp.zeros(shape, bool)
    return Table(
        seen=jnp.stack([jnp.asarray(number / LENGTH, jnp.float32)] * 3, axis=-1),
        action=jnp.where(jnp.asarray(right), 0.5, -0.5)[..., None],
        reward=jnp.asarray(right, jnp.float32),
        terminated=never,
        truncated=jnp.asarray(number == LENGTH - 1),
        usable=jnp.asarray(number < LENGTH),
    )


def test_fitted_q_estimates_returns(table):
    """By hand: always right earns 1 / (1 - gamma) = 5 without ends, and (1 - gamma^6) / (1 - gamma) = 3.69 with one."""
    ends = replace(table, terminated=table.truncated, truncated=table.terminated)
    # Where episodes are cut off the same state follows, so that the loop goes on for ever.
    loops = replace(table, seen=jnp.ones_like(table.seen))
    evaluation = FittedQ(FittedQConfig(updates=1500, batch=64, rate=5e-3, tau=0.05), NETWORK, Logged(), GAMMA)

    @jax.jit
    def both(data):
        def always(push):
            return evaluation.value(data, lambda seen: jnp.full((*seen["pendulum"].shape[:-1], 1), push))

        return always(0.5), always(-0.5)

    for data, worth in ((loops, 1 / (1 - GAMMA)), (ends, (1 - GAMMA**LENGTH) / (1 - GAMMA))):
        right, left = both(ExperienceConfig().of(Logged(), data))
        assert float(right) == pytest.approx(worth, rel=0.05)
        assert float(left) == pytest.approx(0.0, abs=0.1)


def test_estimates_of_returns_against_plain_loops(table):
    """A target that prefers right, from a neutral behaviour policy; Q is constant, so that its mean is known."""
    scale, q = 0.5, 1.5
    steps = jnp.asarray(np.random.default_rng(1).random(table.reward.shape) < 0.2)
    data = ExperienceConfig().of(Logged(), table)
    data = replace(data, expert=replace(data.expert, clipped=steps))

    def gaussian(loc):
        def policy(observation):
            shape = (*observation["pendulum"].shape[:-1], 1)
            return SquashedGaussian(jnp.full(shape, loc), jnp.full(shape, scale))

        return policy

    def constant(observation, action):
        return jnp.full(observation["pendulum"].shape[:-1], q)

    loc = math.atanh(0.5)
    result = estimate_return(Logged(), data, gaussian(loc), gaussian(0.0), constant, GAMMA)
    raw = np.arctanh(np.asarray(table.action[..., 0], np.float64))
    ratio = np.exp((raw**2 - (raw - loc) ** 2) / (2 * scale**2))
    assert ratio.min() > 0.1 and ratio.max() < 10.0
    ratio = np.where(np.asarray(steps), 1.0, ratio)
    reward, count = np.asarray(table.reward), len(table.reward)
    before, sampling, robust = np.full(count, 1 / count), 0.0, 0.0
    for step in range(LENGTH):
        product = ratio[:, : step + 1].prod(axis=1)
        weight = product / product.sum()
        sampling += GAMMA**step * (weight * reward[:, step]).sum()
        robust += GAMMA**step * (weight * (reward[:, step] - q) + before * q).sum()
        before = weight
    assert float(result["weighted_importance_sampling"].value) == pytest.approx(sampling, rel=1e-3)
    assert float(result["doubly_robust"].value) == pytest.approx(robust, rel=1e-3)


def test_ratios_of_estimates_are_limited(table):
    """Two policies so far apart that every ratio is 10 or 0.1."""
    data = ExperienceConfig().of(Logged(), table)

    def policy(loc):
        return lambda o: SquashedGaussian(*(jnp.full((*o["pendulum"].shape[:-1], 1), x) for x in (loc, 0.01)))

    result = estimate_return(
        Logged(), data, policy(0.5), policy(-0.5), lambda o, a: jnp.zeros(o["pendulum"].shape[:-1]), GAMMA
    )
    right = np.asarray(table.reward[:, :LENGTH])
    product = np.cumprod(np.where(right > 0, MOST_RATIO, 1 / MOST_RATIO), axis=1)
    weight = product / product.sum(axis=0)
    expected = (weight * right).sum(axis=0) @ GAMMA ** np.arange(LENGTH)
    assert float(result["weighted_importance_sampling"].value) == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_learner_logs_fitted_q(table):
    """A clone of pushes to the right, all features of which lie close together, and only normalisation separates them.

    Pushing right pays as much as the number of the step then, so that a critic that sees no steps cannot know it.
    """
    right = np.asarray(table.action[..., 0]) > 0
    number = np.broadcast_to(np.arange(LENGTH + 1), right.shape)
    reward = jnp.asarray(right * number, jnp.float32)
    near = replace(table, seen=100.0 + 1e-2 * table.seen, reward=reward, terminated=table.truncated)
    worth = sum(GAMMA**step * step for step in range(LENGTH))
    fitted_q = FittedQConfig(updates=1500, batch=64, rate=5e-3, tau=0.05)
    config = IqlConfig(
        network=NETWORK, batch=64, updates=100, gamma=GAMMA, loss="mse", inverse_temperature=0.0, fitted_q=fitted_q,
        policy_rate=1e-2,
    )  # fmt: skip
    metrics = {}
    for normalise in (True, False):
        learner = replace(config, normalise=normalise).build(Logged(), near, 4)
        experience = training_data(learner.config, Logged(), near, np.asarray(right, np.float64))
        state = jax.jit(learner.init)(experience, jax.random.key(0))
        for _ in range(4):
            state, _ = jax.jit(learner.iterate)(experience, state)
        metrics[normalise] = learner.held_out_metrics(ExperienceConfig().of(Logged(), near), state)
    assert metrics[True]["fitted_q"] == pytest.approx(worth, rel=0.05)
    assert abs(metrics[False]["fitted_q"] - worth) > 0.2 * worth


def test_checkpoints_are_ranked_by_fitted_q():
    row = {"validation/fitted_q": -3.0, "validation/mean_q": 9.0, "validation/vmax_score": 0.5}
    assert rank("fitted_q", row) == (-3.0,) < rank("fitted_q", row | {"validation/fitted_q": -2.0})
    assert rank("fitted_q", row | {"validation/fitted_q": float("nan")}) == (-np.inf,)
    assert rank("score", row) == (0.5,)
    values = {"checkpoint_rule": "fitted_q", "evaluate_every": 1}
    for algorithm in ({"kind": "bc"}, {"kind": "iql"}):
        with pytest.raises(UsageError, match="needs fitted-Q evaluation"):
            settings.load(TrainConfig, values | {"algorithm": algorithm})
    fitted_q = {"kind": "iql", "fitted_q": {"updates": 5}}
    assert settings.load(TrainConfig, values | {"algorithm": fitted_q}).checkpoint_rule == "fitted_q"
