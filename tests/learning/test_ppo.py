"""PPO on the pendulum: what it bootstraps, heads; its optimiser."""

import math
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.flatten_util import ravel_pytree
from scipy import stats

from drivax.errors import UsageError
from drivax.learning.algorithms.behaviour_cloning import Cloning
from drivax.learning.algorithms.optimisers import (
    chunk_size,
    clip_per_network,
    clipped_adam,
    trained_parameters,
)
from drivax.learning.algorithms.ppo import PpoConfig, minibatch_order
from drivax.learning.algorithms.sac import SacConfig
from drivax.learning.environment import Rollout
from drivax.learning.replay import ReplayConfig
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.encoders import MlpConfig
from pendulum import Pendulum

NETWORK = NetworkConfig(encoder=MlpConfig(hidden=(8,), activation="tanh"), head=(4,))
SAC = SacConfig(
    network=NETWORK, environments=8, unroll=4, batch=16, warm_up=32, replay=ReplayConfig(capacity=512)
)
CONFIG = PpoConfig(network=NETWORK, environments=8, unroll=6, epochs=2, minibatches=2)


def test_a_truncated_step_bootstraps_its_own_final_state():
    """Rows of one environment: a step, the last one of its episode, the row that begins the next one, a step."""
    learner = CONFIG.build(Pendulum(), (), 1)
    value = jnp.array([[1.0], [2.0], [30.0], [4.0]])
    reward = jnp.array([[0.1], [0.2], [0.0], [0.4]])
    ended = jnp.array([[False], [True], [False], [False]])
    for truncated in (True, False):
        cut, failed = (ended, ~ended & ended) if truncated else (~ended & ended, ended)
        rows = Rollout(
            observation={"pendulum": jnp.zeros((4, 1, 3))}, state=None, raw_action=jnp.zeros((4, 1, 1)),
            extra={"value": value, "log_prob": jnp.zeros((4, 1))}, reward=reward, terminated=failed,
            truncated=cut, alive=jnp.array([[True], [True], [False], [True]]),
        )  # fmt: skip
        batch = learner._batch(rows, jnp.array([5.0]))
        # gamma 0.99, lambda 0.95: by hand. The value 30 of the final state counts only where the log ended.
        last = 0.2 + (0.99 * 30.0 if truncated else 0.0) - 2.0
        first = 0.1 + 0.99 * 2.0 - 1.0 + 0.99 * 0.95 * last
        open_end = 0.4 + 0.99 * 5.0 - 4.0
        np.testing.assert_allclose(
            batch["advantage"][jnp.array([0, 1, 3]), 0], [first, last, open_end], rtol=1e-6
        )
        np.testing.assert_allclose(batch["target"][:2, 0], [first + 1.0, last + 2.0], rtol=1e-6)
        np.testing.assert_array_equal(batch["alive"][:, 0], [1, 1, 0, 1])


def minibatch_of(learner, parameters):
    """Return 32 samples, every fourth between episodes (``alive`` 0)."""
    keys = jax.random.split(jax.random.key(1), 6)
    minibatch = {
        "observation": {"pendulum": jax.random.normal(keys[0], (32, 3))},
        "raw_action": jax.random.normal(keys[1], (32, 1)),
        "advantage": 3.0 + 2.0 * jax.random.normal(keys[2], (32,)),
        "target": jax.random.normal(keys[3], (32,)),
        "alive": jnp.array([1.0, 1.0, 0.0, 1.0] * 8),
        "noise": jax.random.normal(keys[5], (32, 1)),
    }
    policy = learner.network(parameters).policy(minibatch["observation"])
    log_prob = policy.log_prob(minibatch["raw_action"])
    return minibatch | {"log_prob": log_prob + 0.3 * jax.random.normal(keys[4], (32,))}


def in_chunks(minibatch, count):
    return jax.tree.map(lambda leaf: leaf.reshape(count, -1, *leaf.shape[1:]), minibatch)


LOSS = PpoConfig(network=NETWORK, clip=0.1, value_coefficient=0.7, entropy_coefficient=0.03)


@pytest.fixture(scope="module")
def sampled():
    """A learner with parameters, a minibatch, and a key."""
    learner = LOSS.build(Pendulum(), (), 1)

    @jax.jit
    def draw(key):
        parameters = learner.init((), key).parameters
        return parameters, minibatch_of(learner, parameters)

    return learner, *draw(jax.random.key(0)), jax.random.key(2)


def test_logged_losses_against_numpy(sampled):
    """Samples between episodes do not count, advantages are normalised."""
    learner, parameters, minibatch, key = sampled
    logs, _ = jax.jit(learner._gradient, static_argnums=3)(
        parameters, in_chunks(minibatch, 4), key, lambda *_: (jnp.float32(0.5), {"also": jnp.ones(())})
    )

    policy, value = learner.network(parameters).policy_and_value(minibatch["observation"])
    alive = np.asarray(minibatch["alive"], bool)
    advantage, target, log_prob, new_log_prob, value, entropy = (
        np.asarray(samples, np.float64)[alive]
        for samples in (
            minibatch["advantage"], minibatch["target"], minibatch["log_prob"],
            policy.log_prob(minibatch["raw_action"]), value,
            policy.entropy_estimate(minibatch["noise"]),
        )
    )  # fmt: skip
    ratio = np.exp(new_log_prob - log_prob)
    advantage = (advantage - advantage.mean()) / advantage.std()
    errors = np.square(value - target).mean()
    expected = {
        "policy": -np.minimum(ratio * advantage, np.clip(ratio, 0.9, 1.1) * advantage).mean(),
        "value": errors,
        "entropy": entropy.mean(),
        "also": 1.0,
        "clipped_share": (abs(ratio - 1) > 0.1).mean(),
        "kl": -np.log(ratio).mean(),
        "explained_variance": 1 - errors / target.var(),
    }
    assert {name: float(value) for name, value in logs.items()} == pytest.approx(expected, rel=1e-4, abs=1e-6)
    assert 0.2 < expected["clipped_share"] < 0.9


def auxiliary_loss(parameters, key):
    loss = 0.1 * sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(parameters))
    return loss * jax.random.uniform(key), {}


@pytest.fixture(scope="module")
def whole_gradient(sampled):
    """The gradient of the loss of the minibatch as one formula."""
    learner, parameters, minibatch, key = sampled
    alive = np.asarray(minibatch["alive"]) > 0

    @jax.jit
    @jax.grad
    def gradient(parameters):
        policy, value = learner.network(parameters).policy_and_value(minibatch["observation"])
        ratio = jnp.exp(policy.log_prob(minibatch["raw_action"]) - minibatch["log_prob"])
        advantage = minibatch["advantage"]
        advantage = (advantage - advantage[alive].mean()) / advantage[alive].std()
        surrogate = jnp.minimum(ratio * advantage, jnp.clip(ratio, 0.9, 1.1) * advantage)
        entropy = policy.entropy_estimate(minibatch["noise"])
        total = -surrogate + 0.7 * (value - minibatch["target"]) ** 2 - 0.03 * entropy
        return total[alive].mean() + auxiliary_loss(parameters, key)[0]

    return gradient(parameters)


@pytest.mark.parametrize("chunks", [1, 4, 16])
def test_gradient_in_chunks_is_that_of_the_whole_minibatch(sampled, whole_gradient, chunks):
    learner, parameters, minibatch, key = sampled
    _, gradient = jax.jit(learner._gradient, static_argnums=3)(
        parameters, in_chunks(minibatch, chunks), key, auxiliary_loss
    )
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-6), gradient, whole_gradient
    )


@pytest.mark.parametrize(
    ("time", "environments", "minibatches"), [(4, 3, 2), (8, 1, 8), (3, 4, 2), (5, 4, 4), (13, 1, 1)]
)
def test_minibatches_are_uniform_and_take_equally_of_each_environment(time, environments, minibatches):
    draw = partial(minibatch_order, shape=(time, environments), minibatches=minibatches)
    keys = jax.random.split(jax.random.key(0), 4096)
    order = np.asarray(jax.vmap(draw)(keys)).reshape(4096, minibatches, -1)
    steps = time * environments
    np.testing.assert_array_equal(
        np.sort(order.reshape(4096, -1)), np.broadcast_to(np.arange(steps), (4096, steps))
    )
    members = minibatches // math.gcd(time, minibatches)
    groups = order % environments // members
    for group in range(environments // members):
        assert ((groups == group).sum(axis=-1) == time * members // minibatches).all()
    for index in range(steps):  # is in every minibatch equally often
        counts = (order == index).any(axis=-1).sum(axis=0)
        assert minibatches == 1 or stats.chisquare(counts).pvalue > 1e-4


def test_minibatches_do_not_depend_on_the_number_of_devices():
    """Each of two devices finds half of every chunk among its own environments."""
    key = jax.random.key(0)
    alone, divided = (np.asarray(minibatch_order(key, (4, 64), 2, devices)) for devices in (1, 2))
    assert alone.shape == divided.shape == (2, 2, 64)
    np.testing.assert_array_equal(*(np.sort(order.reshape(2, -1)) for order in (alone, divided)))
    np.testing.assert_array_equal(divided % 64 // 32, np.broadcast_to(np.arange(64) // 32, (2, 2, 64)))


@pytest.mark.parametrize(("batch", "chunk"), [(2048, 64), (96, 48), (40, 40), (97, 97), (8, 8), (320, 64)])
def test_chunks_divide_a_batch(batch, chunk):
    assert chunk_size(batch) == chunk


@pytest.mark.parametrize(
    "network",
    [
        NetworkConfig(encoder=NETWORK.encoder, head=(4,), distribution="grid", shared_encoder=True),
        pytest.param(
            NetworkConfig(encoder=NETWORK.encoder, head=(4,), distribution="beta"), marks=pytest.mark.slow
        ),
    ],
    ids=["grid-shared", "beta"],
)
def test_every_head_learns_and_samples_valid_actions(network):
    environment = Pendulum(levels=((-1.0, 0.0, 1.0),))
    config = PpoConfig(network=network, environments=4, unroll=4, epochs=1, minibatches=2)
    learner = config.build(environment, (), 1)
    state = jax.jit(learner.init)((), jax.random.key(0))
    after, logs = jax.jit(learner.iterate)((), state)
    assert all(np.isfinite(value) for value in logs.values())
    moved = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), after.parameters, state.parameters)
    assert max(jax.tree.leaves(moved)) > 1e-5
    policy = learner.distribution(after.parameters, {"pendulum": jnp.zeros(3)})
    action = policy.action(policy.sample(jax.random.key(1)))
    assert action.shape == (1,) and abs(float(action[0])) <= 1.0
    assert network.distribution != "grid" or float(action[0]) in (-1.0, 0.0, 1.0)


def test_networks_are_clipped_by_their_own_norms():
    gradient = {
        "policy": {"w": jnp.array([0.3, 0.4])},
        "value": {"w": jnp.array([30.0]), "b": jnp.array([40.0])},
    }
    clipped, _ = clip_per_network(1.0).update(gradient, optax.EmptyState())
    np.testing.assert_allclose(clipped["policy"]["w"], [0.3, 0.4], rtol=1e-6)
    np.testing.assert_allclose([clipped["value"]["w"][0], clipped["value"]["b"][0]], [0.6, 0.8], rtol=1e-6)
    nothing, _ = clip_per_network(1.0).update({"policy": jnp.zeros(2)}, optax.EmptyState())
    np.testing.assert_array_equal(nothing["policy"], [0.0, 0.0])


@pytest.mark.parametrize("name", ["environments", "unroll", "epochs", "minibatches"])
def test_settings_of_zero_are_refused(name):
    with pytest.raises(UsageError, match=f"{name} is 0; use 1 or more"):
        PpoConfig(**{name: 0})


def test_learning_rate_falls_to_a_tenth():
    """The first step of Adam is the rate itself, whatever the gradient; and so are all, if it stays the same."""
    optimiser = clipped_adam(0.5, 1.0, updates=10, eps=0.0)
    weights, state = {"w": jnp.zeros(1)}, optimiser.init({"w": jnp.zeros(1)})
    sizes = []
    for _ in range(12):
        change, state = optimiser.update({"w": jnp.ones(1)}, state, weights)
        sizes.append(-float(change["w"][0]))
    expected_sizes = [0.5 - 0.045 * min(step, 10) for step in range(12)]
    np.testing.assert_allclose(sizes, expected_sizes, rtol=1e-4)


@pytest.mark.parametrize("last", [0.1, 1.0])
def test_settings_of_rate_and_norm_reach_the_optimisers(last):
    """Without clipping, Adam's second step tells how large gradients were; at the end the rate is ``last``."""
    cloning = Cloning(learning_rate=0.5, last_rate=last, gradient_norm=None, updates=2).optimiser(2)
    ppo = PpoConfig(
        network=NETWORK, environments=2, unroll=2, epochs=1, minibatches=2, learning_rate=0.5, last_rate=last,
        gradient_norm=None,
    ).build(Pendulum(), (), 1).optimiser  # fmt: skip
    for optimiser in (cloning, ppo):
        weights, state = {"w": jnp.zeros(1)}, optimiser.init({"w": jnp.zeros(1)})
        sizes = []
        for gradient in (100.0, 300.0, 300.0):
            change, state = optimiser.update({"w": jnp.array([gradient])}, state, weights)
            sizes.append(-float(change["w"][0]))
        # Adam by hand: moments of 100, 300, 300 with their biases taken out.
        first, second, expected_sizes = 0.0, 0.0, []
        for step, gradient in enumerate((100.0, 300.0, 300.0), 1):
            first, second = 0.9 * first + 0.1 * gradient, 0.999 * second + 0.001 * gradient**2
            rate = 0.5 * (1.0 + (last - 1.0) * min(step - 1, 2) / 2)
            expected_sizes.append(rate * first / (1 - 0.9**step) / np.sqrt(second / (1 - 0.999**step)))
        np.testing.assert_allclose(sizes, expected_sizes, rtol=1e-4)


def test_updates_are_skipped_beyond_the_target_divergence():
    """At a huge learning rate the first of four updates moves the policy far; the others do not happen."""
    states, shares = {}, {}
    first = jax.jit(CONFIG.build(Pendulum(), (), 1).init)((), jax.random.key(0))
    for name, target in (("none", None), ("far", 1e9), ("near", 1e-3)):
        config = replace(CONFIG, learning_rate=0.1, target_kl=target)
        states[name], logs = jax.jit(config.build(Pendulum(), (), 1).iterate)((), first)
        shares[name] = float(logs.get("loss/skipped_share", -1.0))
    assert shares == {"none": -1.0, "far": 0.0, "near": 0.75}
    same = [jax.tree.leaves(states[name].parameters) for name in ("none", "far")]
    for left, right in zip(*same, strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-5, atol=1e-6)
    assert int(states["near"].optimiser[1][0].count) == 1 and int(states["far"].optimiser[1][0].count) == 4


@pytest.mark.parametrize("config", [CONFIG, SAC], ids=["ppo", "sac"])
def test_average_of_parameters(config):
    """By hand: the mean of the first iterations, then a moving average; training itself is not affected."""
    environment, decay = Pendulum(), 0.75
    plain, averaged = (replace(config, average=value).build(environment, (), 6) for value in (0.0, decay))
    first = state = plain.init((), jax.random.key(0))
    averaging = averaged.init((), jax.random.key(0))
    assert state.trained is None and averaging.trained is not None
    iterate = jax.jit(partial(plain.iterate, ()))
    # A state may be donated: no array is in it twice.
    iterate_averaged = jax.jit(partial(averaged.iterate, ()), donate_argnums=0)
    history = []
    for _ in range(6):
        state, _ = iterate(state)
        averaging, _ = iterate_averaged(averaging)
        history.append(ravel_pytree(averaging.trained)[0])
        np.testing.assert_allclose(history[-1], ravel_pytree(state.parameters)[0], rtol=1e-3, atol=1e-5)
        expected = np.mean(history[:4], axis=0)
        for later in history[4:]:
            expected = decay * expected + (1.0 - decay) * later
        np.testing.assert_allclose(ravel_pytree(averaging.parameters)[0], expected, rtol=2e-5, atol=1e-6)
    assert np.abs(history[-1] - history[0]).max() > 1e-4
    # A pretraining sets the parameters alone: training goes on from them.
    pretrained = replace(averaging, parameters=state.parameters, iteration=first.iteration)
    jax.tree.map(np.testing.assert_array_equal, trained_parameters(pretrained), state.parameters)
