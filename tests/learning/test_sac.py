"""SAC's losses: against NumPy on the networks' own outputs, and which parameters each of them reaches."""

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.learning.algorithm import training_data
from drivax.learning.algorithms import optimisers
from drivax.learning.algorithms.behaviour_cloning import Cloning
from drivax.learning.algorithms.sac import SacConfig, SacParameters
from drivax.learning.algorithms.warm_start import BcSacConfig, WarmStart
from drivax.learning.replay import ReplayConfig, Transitions
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.encoders import MlpConfig
from pendulum import Pendulum
from recorded import Logged, Table

NETWORK = NetworkConfig(encoder=MlpConfig(hidden=(8,)), head=(4,))
CONFIG = SacConfig(network=NETWORK, replay=ReplayConfig(64), environments=4, unroll=4, batch=16, warm_up=0)
#: Two per sample, for the next state's action and for this one's.
KEYS = jax.random.split(jax.random.key(7), (16, 2))


@pytest.fixture(scope="module")
def sac():
    """A learner with its first state, target critics that differ from the critics, and a batch of steps."""
    learner = CONFIG.build(Pendulum(), (), 1)
    state = jax.jit(learner.init)((), jax.random.key(0))
    target = {"critic": jax.tree.map(lambda leaf: leaf + 0.1, state.target)}
    keys = jax.random.split(jax.random.key(1), 5)
    batch = Transitions(
        observation={"pendulum": jax.random.normal(keys[0], (16, 3))},
        action=jax.random.uniform(keys[1], (16, 1), minval=-1.0),
        reward=jax.random.normal(keys[2], (16,)),
        terminated=jax.random.bernoulli(keys[3], 0.3, (16,)),
        next_observation={"pendulum": jax.random.normal(keys[4], (16, 3))},
        discount=jax.random.uniform(keys[4], (16,)),
    )
    trained = SacParameters(state.parameters, state.critic, jnp.log(0.2))
    return learner, trained, target, batch


def test_losses_against_numpy(sac):
    learner, trained, target, batch = sac
    _, logs = jax.jit(lambda t: learner.loss(t, target, batch, KEYS))(trained)

    @jax.jit
    def outputs(trained):
        """What the losses are made of: values, log-densities, drawn by the same keys."""
        next_policy = learner.distribution(trained.policy, batch.next_observation)
        policy = learner.distribution(trained.policy, batch.observation)
        sample = jax.vmap(lambda one, key: one.sample(key))
        then, now = sample(next_policy, KEYS[:, 0]), sample(policy, KEYS[:, 1])
        return {
            "target": learner.q_values(target["critic"], batch.next_observation, jnp.tanh(then)),
            "then": next_policy.log_prob(then),
            "q": learner.q_values(trained.critic, batch.observation, batch.action),
            "policy_q": learner.q_values(trained.critic, batch.observation, jnp.tanh(now)),
            "now": policy.log_prob(now),
        }

    result = {name: np.asarray(value, np.float64) for name, value in outputs(trained).items()}
    assert not np.allclose(result["q"][0], result["q"][1]), "the critics are two networks"
    value = np.minimum(*result["target"]) - 0.2 * result["then"]
    td_target = np.asarray(batch.reward) + np.asarray(batch.discount) * np.where(batch.terminated, 0.0, value)
    expected = {
        "critic": 0.5 * ((result["q"] - td_target) ** 2).mean(),
        "policy": (0.2 * result["now"] - np.minimum(*result["policy_q"])).mean(),
        "mean_q": result["q"].mean(),
        "largest_q": np.abs(result["q"]).max(),
        "entropy": -result["now"].mean(),
        "temperature": 0.2,
    }
    assert set(logs) == set(expected)
    for name, number in expected.items():
        assert float(logs[name]) == pytest.approx(number, rel=1e-4, abs=1e-5), name


def test_every_loss_reaches_its_own_parameters_only(sac):
    learner, trained, target, batch = sac

    @jax.jit
    def slopes_of(trained):
        def part(name):
            def of(trained):
                total, logs = learner.loss(trained, target, batch, KEYS)
                return total if name == "total" else logs[name], logs

            return jax.grad(of, has_aux=True)(trained)

        return {name: part(name) for name in ("total", "critic", "policy")}

    result = slopes_of(trained)
    slopes = {name: slope for name, (slope, _) in result.items()}
    for name in ("critic", "policy"):
        own, whole = (jax.tree.leaves(getattr(slopes[which], name)) for which in (name, "total"))
        for one, other in zip(own, whole, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)
        assert max(float(jnp.abs(leaf).max()) for leaf in own) > 1e-3
    # The temperature's slope is alpha (entropy - target): by hand, from what is logged.
    slope = 0.2 * (float(result["total"][1]["entropy"]) + 1.0)
    assert float(slopes["total"].log_temperature) == pytest.approx(slope, rel=1e-3, abs=1e-5)


def auxiliary_loss(policy, key):
    scale = jax.random.uniform(key)
    return scale * sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(policy)), {"scale": scale}


@pytest.fixture(scope="module")
def whole_gradient(sac):
    """Keys of each step and of the auxiliary loss, and with them logs and gradient of the batch as one formula."""
    learner, trained, target, batch = sac
    key, auxiliary_key = jax.random.split(jax.random.key(3))
    keys = jax.random.split(key, (16, 2))

    def loss(trained):
        total, logs = learner.loss(trained, target, batch, keys)
        auxiliary, auxiliary_logs = auxiliary_loss(trained.policy, auxiliary_key)
        return total + auxiliary, auxiliary_logs | logs

    gradient, logs = jax.jit(jax.grad(loss, has_aux=True))(trained)
    return keys, auxiliary_key, (logs, gradient)


@pytest.mark.parametrize("chunk", [4, 16])
def test_gradient_in_chunks_is_that_of_the_whole_batch(sac, whole_gradient, chunk, monkeypatch):
    monkeypatch.setattr(optimisers, "_CHUNK", chunk)
    learner, trained, target, batch = sac
    keys, auxiliary_key, expected = whole_gradient
    chunked = jax.jit(
        lambda trained: learner.gradient(trained, target, batch, keys, auxiliary_key, auxiliary_loss)
    )
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-6), chunked(trained), expected
    )


def test_every_update_has_keys_of_its_own(sac):
    learner, (first, second) = sac[0], jax.random.split(jax.random.key(7))
    keys, auxiliary_keys = jax.vmap(learner._batch_keys)(jnp.stack([first, second]))
    for number, key in enumerate((first, second)):
        sample_key, auxiliary_key = jax.random.split(key)
        assert (keys[number] == jax.random.split(sample_key, (learner.config.batch, 2))).all()
        assert auxiliary_keys[number] == auxiliary_key


@pytest.fixture(scope="module")
def logged():
    """Logged steps whose numbers no step of the pendulum has."""
    steps = jnp.ones((5, 6), bool).at[:, -1].set(False)
    table = Table(
        seen=jnp.full((5, 6, 3), 9.0), action=jnp.full((5, 6, 1), 0.25), reward=jnp.full((5, 6), 50.0),
        terminated=jnp.zeros((5, 6), bool), truncated=jnp.zeros((5, 6), bool), usable=steps,
    )  # fmt: skip
    return Logged(), table


def iterated(config, logged, *settling):
    """A learner with its data, its first state, and for each ``settling`` the state and logs after an iteration."""
    environment, table = logged
    learner = config.build(environment, table, 1)
    data = training_data(config, environment, table)
    state, iterate = jax.jit(learner.init)(data, jax.random.key(0)), jax.jit(learner.iterate)
    return learner, data, state, *(iterate(data, state, None, value) for value in settling)


def test_demonstrations_are_a_share_of_each_batch(logged):
    config = replace(CONFIG, demonstrations=0.25, steps=2)
    learner, data, _, (after, logs) = iterated(config, logged, None)

    @jax.jit
    def sample(data, replay):
        index = learner._draw(data, replay, jax.random.key(0), 3)
        return learner._sample(data, replay, jax.tree.map(lambda leaf: leaf[0], index))

    batch = sample(data, after.replay)
    is_logged = np.asarray(batch.action[:, 0]) == 0.25
    assert is_logged.sum() == 4 and len(is_logged) == 16
    np.testing.assert_array_equal(np.asarray(batch.observation["pendulum"])[is_logged], 9.0)
    # Two steps where the log has them; rewards of the pendulum are negative.
    assert set(np.asarray(batch.reward)[is_logged].round(3)) <= {
        50.0,
        np.float32(50.0 + 0.99 * 50.0).round(3),
    }
    assert (np.asarray(batch.reward)[~is_logged] < 0.0).all()
    assert float(logs["loss/mean_q"]) != 0.0
    assert training_data(CONFIG, *logged) is logged[1], "without demonstrations nothing is prepared"
    with pytest.raises(UsageError, match="SacConfig draws neither logged steps nor scenarios by weight"):
        training_data(CONFIG, *logged, np.ones((5, 6)))


def largest_change(one, other):
    differences = jax.tree.map(lambda a, b: np.abs(np.asarray(a) - np.asarray(b)).max(), one, other)
    return max(jax.tree.leaves(differences))


@pytest.mark.slow
def test_clone_learns_from_demonstrations_after_settling(logged):
    """One iteration each of cloning, of fitting critics, and of SAC."""
    environment, table = logged
    sac = replace(CONFIG, demonstrations=0.5, explore="policy")
    start = WarmStart(iterations=1, settle=1, cloning=Cloning(batch=8, updates=2))
    config = BcSacConfig(warm_start=start, sac=sac)
    learner, data = config.build(environment, table, 3), training_data(config, environment, table)
    states = [jax.jit(learner.init)(data, jax.random.key(0))]
    iterate = jax.jit(learner.iterate)
    for _ in range(3):
        states.append(iterate(data, states[-1])[0])
    policy = [largest_change(a.parameters, b.parameters) for a, b in pairwise(states)]
    critic = [largest_change(a.learner.critic, b.learner.critic) for a, b in pairwise(states)]
    assert policy[0] > 1e-4 and policy[1] == 0.0 and policy[2] > 1e-4
    assert critic[0] == 0.0 and critic[1] > 1e-4 and critic[2] > 1e-4


def test_settling_fits_critics_to_a_fixed_policy(logged):
    is_settling = jnp.asarray(True)
    _, _, state, *results = iterated(CONFIG, logged, is_settling, ~is_settling, None)
    fixed, free, plain = (after for after, _ in results)

    def policy_of(state):
        inner = state.optimiser.inner_states
        return state.parameters, state.log_temperature, inner["policy"], inner["temperature"]

    assert largest_change(policy_of(fixed), policy_of(state)) == 0.0
    assert largest_change(fixed.critic, state.critic) > 1e-4
    assert largest_change(free.parameters, state.parameters) > 1e-4
    assert largest_change(policy_of(free), policy_of(plain)) < 1e-6


def test_impossible_settings_are_refused():
    with pytest.raises(UsageError, match="demonstrations is 1"):
        SacConfig(network=NETWORK, demonstrations=1)
    for share, count in ((0.03, 0), (0.97, 16)):
        with pytest.raises(UsageError, match=f"rounds to {count} logged steps in a batch of 16"):
            replace(CONFIG, demonstrations=share)
    with pytest.raises(UsageError, match="no step with a successor"):
        SacConfig(network=NETWORK, environments=4, unroll=1, warm_up=4)
    with pytest.raises(UsageError, match=r"set replay\.capacity to 400"):
        SacConfig(network=NETWORK, environments=4, unroll=100, replay=ReplayConfig(100))
