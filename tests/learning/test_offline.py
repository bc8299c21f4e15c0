"""Offline algorithms: losses against NumPy on the networks' own outputs, and what they learn of small worlds."""

import json
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from jax.flatten_util import ravel_pytree
from scipy import special

from drivax import settings
from drivax.errors import DataError, UsageError
from drivax.learning.algorithm import training_data
from drivax.learning.algorithms.awac import AwacConfig
from drivax.learning.algorithms.cql import CqlConfig
from drivax.learning.algorithms.iql import IqlConfig
from drivax.learning.algorithms.offline import PolicyBatch, read_statistics
from drivax.learning.algorithms.td3_bc import Td3BcConfig
from drivax.learning.config import TrainConfig
from drivax.learning.experience import ExperienceConfig
from drivax.learning.loop import train
from drivax.learning.policies import load_policy
from drivax.learning.replay import Transitions
from drivax.learning.training_set import TrainingSet
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.encoders import MlpConfig, NormalisedEncoder, group_names
from drivax.planners.planner import Planner
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.traffic.log import LogTraffic
from drivax.testing import check_algorithm
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.sinks import read_rows
from recorded import Logged, Table, arms

NETWORK = NetworkConfig(encoder=MlpConfig(hidden=(8,)), head=(8,))
COUNT, ACTIONS = 16, 3
CQL = CqlConfig(network=NETWORK, batch=COUNT, actions=ACTIONS, gamma=0.9, penalty=2.0)
IQL = IqlConfig(network=NETWORK, batch=COUNT, gamma=0.9)
AWAC = AwacConfig(network=NETWORK, batch=COUNT, gamma=0.9)
TD3_BC = Td3BcConfig(network=NETWORK, batch=COUNT, gamma=0.9)


@pytest.fixture(scope="module")
def batch():
    """A batch of steps."""
    keys = jax.random.split(jax.random.key(1), 5)
    return Transitions(
        observation={"pendulum": jax.random.normal(keys[0], (COUNT, 3))},
        action=jax.random.uniform(keys[1], (COUNT, 1), minval=-0.9, maxval=0.9),
        reward=jax.random.normal(keys[2], (COUNT,)),
        terminated=jax.random.bernoulli(keys[3], 0.3, (COUNT,)),
        next_observation={"pendulum": jax.random.normal(keys[4], (COUNT, 3))},
        discount=jnp.full(COUNT, 0.9),
    )


@pytest.fixture(scope="module")
def policy_batch(batch):
    """Other steps, to improve the policy at."""
    return PolicyBatch({"pendulum": 0.5 - batch.observation["pendulum"]}, -batch.action)


def build_learner(config):
    """A learner with what it trains, and targets that differ from what they follow."""
    learner = config.build(Logged(), arms([0.0], [0.0]), 1)
    state = jax.jit(learner.init)((), jax.random.key(0))
    target = jax.tree.map(lambda leaf: leaf + 0.1, state.target)
    return learner, {"policy": state.parameters, **state.rest}, target


def step_keys(count):
    """``count`` keys of each step of the batch, and its key."""
    keys = jax.random.split(jax.random.key(7), COUNT)
    return jax.vmap(lambda key: jax.random.split(key, count))(keys).T, keys


def draw_raw(policy, keys):
    """A raw action of each step, by its own key."""
    return jax.vmap(lambda step, key: step.sample(key))(policy, keys)


def draw_several(policy, keys, count):
    """``count`` raw actions of each step."""
    own = jax.vmap(lambda key: jax.random.split(key, count))(keys)
    return jnp.stack([draw_raw(policy, own[:, number]) for number in range(count)])


def losses(learner, trained, target, batch, policy_batch, keys):
    """What is logged of a batch."""
    result = jax.jit(lambda t: learner.loss(t, target, batch, policy_batch, keys))(trained)
    return float(result[0]), {name: float(value) for name, value in result[1].items()}


def to_numpy(tree):
    return {name: np.asarray(value, np.float64) for name, value in tree.items()}


def combined(q, min_q_weight):
    """The value of both critics."""
    return min_q_weight * q.min(axis=0) + (1.0 - min_q_weight) * q.max(axis=0)


@pytest.mark.parametrize("min_q_weight", [1.0, 0.7])
def test_cql_against_numpy(min_q_weight, batch, policy_batch):
    config = replace(
        CQL, min_q_weight=min_q_weight, gap=1.5, imitation=0.7, penalty_temperature=2.0, backup_actions=2
    )
    learner, trained, target = build_learner(config)
    (policy_keys, next_keys, uniform_keys, now_keys, then_keys), keys = step_keys(5)
    total, logs = losses(learner, trained, target, batch, policy_batch, keys)

    @jax.jit
    def outputs(trained):
        """What the losses are made of, drawn by the same keys."""
        following = learner.distribution(trained["policy"], batch.next_observation)
        now = learner.distribution(trained["policy"], batch.observation)
        there = learner.distribution(trained["policy"], policy_batch[0])
        then = jnp.tanh(draw_several(following, next_keys, 2))
        draw_uniform = partial(jax.random.uniform, shape=(ACTIONS, 1), minval=-1.0)
        uniform = jax.vmap(draw_uniform, out_axes=1)(uniform_keys)
        drawn = {
            "now": draw_several(now, now_keys, ACTIONS),
            "then": draw_several(following, then_keys, ACTIONS),
        }
        rows = {"uniform": [], "now": [], "then": []}
        for number in range(ACTIONS):
            for name, policy in (("now", now), ("then", following)):
                raw_action = drawn[name][number]
                q = learner.q_values(trained["critic"], batch.observation, jnp.tanh(raw_action))
                rows[name].append((q, policy.log_prob(raw_action)))
            rows["uniform"].append(
                (learner.q_values(trained["critic"], batch.observation, uniform[number]), None)
            )
        raw_action = draw_raw(there, policy_keys)
        return {
            "target": learner.q_values(target["critic"], batch.next_observation, then),
            "q": learner.q_values(trained["critic"], batch.observation, batch.action),
            **{f"q_{name}": jnp.stack([q for q, _ in result]) for name, result in rows.items()},
            **{f"p_{name}": jnp.stack([p for _, p in rows[name]]) for name in ("now", "then")},
            "judged": learner.q_values(trained["critic"], policy_batch[0], jnp.tanh(raw_action)),
            "log_prob": there.log_prob(raw_action),
            "mode": there.mode(),
        }

    result = to_numpy(outputs(trained))
    value = combined(result["target"], min_q_weight).max(axis=0)
    assert (value > combined(result["target"], min_q_weight)[0]).any()
    td_target = np.asarray(batch.reward) + 0.9 * np.where(batch.terminated, 0.0, value)
    error = 0.5 * ((result["q"] - td_target) ** 2).mean()
    stacked = np.concatenate([
        result["q_uniform"] / 2 + np.log(2.0),
        result["q_now"] / 2 - result["p_now"][:, None],
        result["q_then"] / 2 - result["p_then"][:, None],
    ])  # fmt: skip
    penalty = (2 * (special.logsumexp(stacked, axis=0) - np.log(3 * ACTIONS)) - result["q"]).mean()
    soft = 0.1 * result["log_prob"] - result["judged"].min(axis=0)
    mode_error = result["mode"] - np.asarray(policy_batch[1])
    policy = (soft / np.abs(result["judged"].min(axis=0)).mean()).mean() + 0.7 * (mode_error**2).mean()
    expected = {
        "critic": error,
        "penalty": penalty,
        "penalty_weight": 2.0,
        "mean_q": result["q"].mean(),
        "largest_q": np.abs(result["q"]).max(),
        "mean_q_uniform": result["q_uniform"].mean(),
        "policy": policy,
        "mean_q_policy": result["judged"].mean(),
        "entropy": -result["log_prob"].mean(),
        "temperature": 0.1,
        "imitation_error": np.abs(mode_error).mean(),
    }
    assert set(logs) == set(expected)
    for name, number in expected.items():
        assert logs[name] == pytest.approx(number, rel=1e-4, abs=1e-5), name
    temperature_loss = -0.1 * (result["log_prob"].mean() - 1.0)
    multiplier = -2.0 * (penalty - 1.5)
    assert total == pytest.approx(error + 2 * penalty + multiplier + policy + temperature_loss, rel=1e-4)


@pytest.mark.slow
def test_published_penalty_includes_the_logged_action(batch, policy_batch):
    config = replace(CQL, importance=False, next_actions=False, imitation=0.0)
    learner, trained, target = build_learner(config)
    (*_, uniform_keys, now_keys, then_keys), keys = step_keys(5)
    _, logs = losses(learner, trained, target, batch, policy_batch, keys)
    now, following = (
        learner.distribution(trained["policy"], observation)
        for observation in (batch.observation, batch.next_observation)
    )
    action, density = learner._penalty_actions(
        now, following, batch.action, (uniform_keys, now_keys, then_keys)
    )
    assert action.shape == (2 * ACTIONS + 1, COUNT, 1) and not np.asarray(density).any()
    np.testing.assert_array_equal(action[-1], batch.action)
    q = np.asarray(learner.q_values(trained["critic"], batch.observation, action), np.float64)
    data = np.asarray(learner.q_values(trained["critic"], batch.observation, batch.action), np.float64)
    # The study's, but for a constant: the logarithm of how many there are.
    expected = (special.logsumexp(q, axis=1) - data).mean() - np.log(2 * ACTIONS + 1)
    assert logs["penalty"] == pytest.approx(expected, rel=1e-4)


@pytest.mark.slow
def test_relative_penalty_follows_the_values(batch, policy_batch):
    learner, trained, target = build_learner(replace(CQL, penalty=0.5, relative=True))
    _, keys = step_keys(5)
    _, logs = losses(learner, trained, target, batch, policy_batch, keys)
    q = np.asarray(learner.q_values(trained["critic"], batch.observation, batch.action))
    assert logs["penalty_weight"] == pytest.approx(0.5 * np.abs(q).mean(), rel=1e-5)
    gradient = jax.grad(lambda t: learner.loss(t, target, batch, policy_batch, keys)[0])(trained)
    fixed, *_ = build_learner(replace(CQL, penalty=logs["penalty_weight"]))
    expected = jax.grad(lambda t: fixed.loss(t, target, batch, policy_batch, keys)[0])(trained)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6), gradient, expected)


@pytest.mark.parametrize("config", [IQL, AWAC], ids=["iql", "awac"])
def test_relative_advantages_do_not_depend_on_the_scale(config, batch, policy_batch):
    learner, *_ = build_learner(config)
    relative, trained, _ = build_learner(replace(config, relative=True))
    advantage = jax.random.normal(jax.random.key(3), (COUNT,))
    expected = learner.imitation(trained, policy_batch, advantage / jnp.std(advantage))
    for scale in (0.01, 50.0):
        result = relative.imitation(trained, policy_batch, scale * advantage)
        assert float(result[0]) == pytest.approx(float(expected[0]), rel=1e-4)
        assert float(result[1]["weight"]) == pytest.approx(float(expected[1]["weight"]), rel=1e-4)
    constant = relative.imitation(trained, policy_batch, jnp.zeros(COUNT))
    assert float(constant[1]["weight"]) == 1.0


@pytest.mark.parametrize("min_q_weight", [1.0, 0.7])
def test_iql_against_numpy(min_q_weight, batch, policy_batch):
    learner, trained, target = build_learner(replace(IQL, min_q_weight=min_q_weight, largest_weight=1.05))
    total, logs = losses(learner, trained, target, batch, policy_batch, step_keys(1)[1])

    @jax.jit
    def outputs(trained):
        policy = learner.distribution(trained["policy"], policy_batch[0])
        return {
            "target": learner.q_values(target["critic"], batch.observation, batch.action),
            "q": learner.q_values(trained["critic"], batch.observation, batch.action),
            "value": learner._value(trained["value"], batch.observation),
            "then": learner._value(trained["value"], batch.next_observation),
            "there": learner.q_values(target["critic"], *policy_batch[:2]),
            "value_there": learner._value(trained["value"], policy_batch[0]),
            "log_prob": policy.log_prob(jnp.arctanh(policy_batch[1])),
        }

    result = to_numpy(outputs(trained))
    error = combined(result["target"], min_q_weight) - result["value"]
    value = (np.where(error > 0, 0.7, 0.3) * error**2).mean()
    td_target = np.asarray(batch.reward) + 0.9 * np.where(batch.terminated, 0.0, result["then"])
    critic = 0.5 * ((result["q"] - td_target) ** 2).mean()
    advantage = combined(result["there"], min_q_weight) - result["value_there"]
    weights = np.minimum(np.exp(3.0 * advantage), 1.05)
    policy = -(weights * result["log_prob"]).mean()
    assert 0.0 < logs["weights_cut"] == (weights == 1.05).mean() < 1.0
    for name, number in (
        ("value", value),
        ("critic", critic),
        ("policy", policy),
        ("weight", weights.mean()),
    ):
        assert logs[name] == pytest.approx(number, rel=1e-4), name
    assert total == pytest.approx(value + critic + policy, rel=1e-4)
    assert logs["largest_q"] == pytest.approx(np.abs(result["q"]).max(), rel=1e-4)


@pytest.mark.parametrize("min_q_weight", [1.0, 0.7])
def test_awac_against_numpy(min_q_weight, batch, policy_batch):
    learner, trained, target = build_learner(
        replace(AWAC, min_q_weight=min_q_weight, inverse_temperature=2.0, largest_weight=1.05)
    )
    (next_keys, policy_keys), keys = step_keys(2)
    total, logs = losses(learner, trained, target, batch, policy_batch, keys)

    @jax.jit
    def outputs(trained):
        following = learner.distribution(trained["policy"], batch.next_observation)
        there = learner.distribution(trained["policy"], policy_batch[0])
        then, own = jnp.tanh(draw_raw(following, next_keys)), jnp.tanh(draw_raw(there, policy_keys))
        return {
            "target": learner.q_values(target["critic"], batch.next_observation, then),
            "q": learner.q_values(trained["critic"], batch.observation, batch.action),
            "logged": learner.q_values(trained["critic"], *policy_batch[:2]),
            "own": learner.q_values(trained["critic"], policy_batch[0], own),
            "log_prob": there.log_prob(jnp.arctanh(policy_batch[1])),
        }

    result = to_numpy(outputs(trained))
    td_target = np.asarray(batch.reward) + 0.9 * np.where(
        batch.terminated, 0.0, combined(result["target"], min_q_weight)
    )
    critic = 0.5 * ((result["q"] - td_target) ** 2).mean()
    advantage = combined(result["logged"], min_q_weight) - combined(result["own"], min_q_weight)
    weights = np.minimum(np.exp(2.0 * advantage), 1.05)
    policy = -(weights * result["log_prob"]).mean()
    assert 0.0 < logs["weights_cut"] == (weights == 1.05).mean() < 1.0
    assert logs["critic"] == pytest.approx(critic, rel=1e-4)
    assert logs["advantage"] == pytest.approx(advantage.mean(), rel=1e-3)
    assert logs["policy"] == pytest.approx(policy, rel=1e-4)
    assert total == pytest.approx(critic + policy, rel=1e-4)


@pytest.mark.parametrize("config", [IQL, AWAC], ids=["iql", "awac"])
def test_advantages_of_logged_returns(config, batch):
    """The advantage is that of the batch's rewards and next states; values and critics learn as before."""
    learner, trained, target = build_learner(config)
    hindsight, *_ = build_learner(replace(config, advantage="return"))
    (next_keys, policy_keys), keys = step_keys(2)
    own = PolicyBatch(batch.observation, batch.action)
    before, logs = (losses(each, trained, target, batch, own, keys)[1] for each in (learner, hindsight))

    @jax.jit
    def values(trained):
        if config is IQL:
            return [learner._value(trained["value"], seen) for seen in (batch.next_observation, own[0])]
        pairs = (
            (batch.next_observation, next_keys, target["critic"]),
            (own[0], policy_keys, target["critic"]),
        )
        return [
            learner.q_value(
                critic, seen, jnp.tanh(draw_raw(learner.distribution(trained["policy"], seen), own_keys))
            )
            for seen, own_keys, critic in pairs
        ]

    then, now = (np.asarray(value, np.float64) for value in values(trained))
    advantage = np.asarray(batch.reward) + 0.9 * np.where(batch.terminated, 0.0, then) - now
    assert logs["advantage"] == pytest.approx(advantage.mean(), rel=1e-3)
    weights = np.minimum(np.exp(config.inverse_temperature * advantage), 100.0)
    assert logs["weight"] == pytest.approx(weights.mean(), rel=1e-3)
    assert abs(before["advantage"] - logs["advantage"]) > 0.05
    assert before["critic"] == logs["critic"] and before.get("value") == logs.get("value")


def test_n_step_returns_end_with_the_episode():
    """Two episodes of five steps, of which the second ends by failure after three."""
    reward = np.random.default_rng(4).normal(size=(2, 6))
    usable = np.arange(6) < np.array([[5], [3]])
    terminated, last = np.zeros((2, 6), bool), np.array([4, 2])
    terminated[1, 2] = True
    truncated = np.zeros((2, 6), bool)
    truncated[0, 4] = True
    seen = np.arange(12.0).reshape(2, 6, 1) + np.zeros(3)
    table = Table(*map(jnp.asarray, (seen, np.zeros((2, 6, 1)), reward, terminated, truncated, usable)))
    learner = replace(IQL, steps=3, batch=256).build(Logged(), table, 1)
    experience = training_data(learner.config, Logged(), table, None)
    drawn, *_ = jax.jit(learner._draw)(experience, jax.random.key(0))
    places = np.asarray(drawn.observation["pendulum"])[:, 0].astype(int)
    assert sorted(set(places)) == [0, 1, 2, 3, 4, 6, 7, 8]
    for number, place in enumerate(places):
        episode, step = divmod(place, 6)
        end = min(step + 3, last[episode] + 1)
        expected = sum(0.9 ** (t - step) * reward[episode, t] for t in range(step, end))
        assert float(drawn.reward[number]) == pytest.approx(expected, rel=1e-5)
        assert float(drawn.discount[number]) == pytest.approx(0.9 ** (end - step), rel=1e-6)
        assert float(drawn.next_observation["pendulum"][number, 0]) == episode * 6 + end
        assert bool(drawn.terminated[number]) == (episode == 1 and end == 3)


@pytest.mark.parametrize("min_q_weight", [1.0, 0.7])
def test_td3_bc_against_numpy(min_q_weight, batch, policy_batch):
    learner, trained, target = build_learner(
        replace(TD3_BC, noise=0.5, noise_bound=0.3, min_q_weight=min_q_weight)
    )
    _, keys = step_keys(1)
    total, logs = losses(learner, trained, target, batch, policy_batch, keys)

    @jax.jit
    def outputs(trained):
        mode = learner.distribution(target["policy"], batch.next_observation).mode()
        noise = 0.5 * jax.vmap(lambda key: jax.random.normal(key, mode.shape[1:]))(keys)
        then = jnp.clip(mode + jnp.clip(noise, -0.3, 0.3), -1.0, 1.0)
        action = learner.distribution(trained["policy"], policy_batch[0]).mode()
        return {
            "target": learner.q_values(target["critic"], batch.next_observation, then),
            "q": learner.q_values(trained["critic"], batch.observation, batch.action),
            "judged": learner.q_values(trained["critic"], policy_batch[0], action)[0],
            "off": action - policy_batch[1],
            "noise": noise,
        }

    result = to_numpy(outputs(trained))
    assert (np.abs(result["noise"]) > 0.3).any() and (np.abs(result["noise"]) < 0.3).any()
    next_q = combined(result["target"], min_q_weight)
    td_target = np.asarray(batch.reward) + 0.9 * np.where(batch.terminated, 0.0, next_q)
    critic = 0.5 * ((result["q"] - td_target) ** 2).mean()
    policy = -2.5 * result["judged"].mean() / np.abs(result["judged"]).mean() + (result["off"] ** 2).mean()
    assert logs["critic"] == pytest.approx(critic, rel=1e-4)
    assert logs["policy"] == pytest.approx(policy, rel=1e-4)
    assert total == pytest.approx(critic + policy, rel=1e-4)
    assert logs["largest_q"] == pytest.approx(np.abs(result["q"]).max(), rel=1e-4)


@pytest.mark.parametrize(
    "config", [replace(CQL, gap=1.5, imitation=0.5), IQL, AWAC, TD3_BC], ids=["cql", "iql", "awac", "td3"]
)
def test_every_loss_reaches_its_own_parameters_only(config, batch, policy_batch):
    learner, trained, target = build_learner(config)

    @jax.jit
    def slopes(trained):
        def of(trained, name):
            total, logs = learner.loss(trained, target, batch, policy_batch, step_keys(1)[1])
            return total if name == "total" else logs[name]

        return {name: jax.grad(of)(trained, name) for name in ("total", "critic", "policy")}

    result = slopes(trained)
    largest = partial(
        jax.tree.reduce, lambda most, leaf: max(most, float(jnp.abs(leaf).max())), initializer=0.0
    )
    for part_of_loss in ("critic", "policy"):
        for name in trained:
            reached = largest(result[part_of_loss][name])
            assert (reached > 1e-6) == (name == part_of_loss), (part_of_loss, name)
    # Nothing but the critics' own losses moves them; of CQL these are two.
    if not isinstance(config, CqlConfig):
        jax.tree.map(
            partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6),
            result["total"]["critic"], result["critic"]["critic"],
        )  # fmt: skip
    for name in set(trained) - {"policy", "critic"}:
        assert largest(result["total"][name]) > 0.0, name


@pytest.mark.parametrize(
    "config", [replace(CQL, imitation=0.5), IQL, AWAC, TD3_BC], ids=["cql", "iql", "awac", "td3"]
)
def test_policy_without_guidance_does_not_depend_on_critics(config, batch, policy_batch):
    learner, trained, target = build_learner(config)
    others = [name for name in trained if name in ("critic", "value")]
    changed = trained | {name: jax.tree.map(lambda leaf: leaf + 0.3, trained[name]) for name in others}

    @jax.jit
    def slope(trained, guidance):
        def loss(policy):
            own = policy_batch._replace(guidance=guidance)
            return learner.loss(trained | {"policy": policy}, target, batch, own, step_keys(1)[1])[0]

        return ravel_pytree(jax.grad(loss)(trained["policy"]))[0]

    imitation = slope(trained, jnp.zeros(COUNT))
    assert jnp.abs(imitation).max() > 1e-3
    np.testing.assert_allclose(slope(changed, jnp.zeros(COUNT)), imitation, atol=1e-6)
    assert jnp.abs(slope(changed, jnp.ones(COUNT)) - slope(trained, jnp.ones(COUNT))).max() > 1e-3


def test_temperature_stays_without_guidance(batch, policy_batch):
    """Nothing would bring the entropy to its target."""
    learner, trained, target = build_learner(replace(CQL, imitation=0.5))

    @jax.jit
    def slope(guidance):
        def loss(temperature):
            parts = trained | {"log_temperature": temperature}
            own = policy_batch._replace(guidance=guidance)
            return learner.loss(parts, target, batch, own, step_keys(1)[1])[0]

        return jax.grad(loss)(trained["log_temperature"])

    assert slope(jnp.zeros(COUNT)) == 0.0 and abs(slope(jnp.ones(COUNT))) > 1e-6


@pytest.mark.parametrize(
    ("config", "cloning"),
    [(TD3_BC, {"q_weight": 0.0}), (AWAC, {"inverse_temperature": 0.0})],
    ids=["td3", "awac"],
)
def test_policy_only_imitates_without_failures(bandit, config, cloning):
    """One episode in 25 fails, or one in 10."""
    config = replace(config, updates=5, needs_failures=True)
    for failures, same in ((20, replace(config, **cloning)), (50, replace(config, needs_failures=False))):
        fails = jnp.arange(len(bandit.terminated))[:, None] < failures
        data = replace(bandit, terminated=bandit.terminated & fails, truncated=bandit.terminated & ~fails)
        _, state, logs = train_learner(config, data, iterations=2)
        assert logs["sampler/failures"] == pytest.approx(failures / 500)
        _, expected, _ = train_learner(same, data, iterations=2)
        jax.tree.map(np.testing.assert_array_equal, state.parameters, expected.parameters)


def train_learner(config, data, iterations=20, weights=None):
    """A learner and its state after n iterations, and what the last one logged."""
    learner = config.build(Logged(), data, iterations)
    experience = training_data(config, Logged(), data, weights)

    @jax.jit
    def run(experience):
        state = learner.init(experience, jax.random.key(0))
        return jax.lax.scan(lambda s, _: learner.iterate(experience, s), state, None, iterations)

    state, logs = run(experience)
    return learner, state, jax.tree.map(lambda leaf: float(leaf[-1]), logs)


FAST = {"batch": 64, "updates": 50, "policy_rate": 3e-3, "critic_rate": 3e-3}


@pytest.fixture(scope="module")
def bandit():
    """Arms from -0.5 to 0.5, of which the higher ones pay more; those beyond are not logged, and pay -1."""
    action = np.random.default_rng(0).uniform(-0.5, 0.5, 500)
    return arms(action, action)


@pytest.mark.parametrize(
    ("config", "stays"),
    [
        pytest.param(
            CqlConfig(network=NETWORK, penalty=0.0, **FAST), False, id="sac", marks=pytest.mark.slow
        ),
        pytest.param(CqlConfig(network=NETWORK, penalty=1.0, **FAST), True, id="cql"),
        pytest.param(IqlConfig(network=NETWORK, inverse_temperature=10.0, **FAST), True, id="iql"),
        pytest.param(
            Td3BcConfig(network=NETWORK, q_weight=100.0, **FAST), False, id="td3", marks=pytest.mark.slow
        ),
        pytest.param(Td3BcConfig(network=NETWORK, q_weight=0.2, **FAST), True, id="td3_bc"),
    ],
)
def test_unlogged_arms_are_not_overestimated(bandit, config, stays):
    """Without a term that keeps them there, actions go where the critic makes up values."""
    learner, state, _ = train_learner(config, bandit)
    observation = {"pendulum": jnp.ones(3)}
    action = learner.distribution(state.parameters, observation).mode()
    predicted = float(learner.q_values(state.rest["critic"], observation, action).min())
    true = float(action[0]) if abs(float(action[0])) <= 0.5 else -1.0
    assert (abs(float(action[0])) <= 0.55) == stays, float(action[0])
    assert (predicted - true > 0.5) == (not stays), (predicted, true)
    if stays:
        assert float(action[0]) > 0.05, "better than what is done on average"


@pytest.mark.slow
def test_multiplier_reaches_the_gap():
    """Arms from 0.2 to 0.4: a lower gap needs a larger weight; with a gap above the penalty the weight falls to 0."""
    action = np.random.default_rng(0).uniform(0.2, 0.4, 500)
    settings = {"network": NETWORK, "penalty": 1.0, "penalty_rate": 0.01, **FAST}
    result = {}
    for gap in (1.0, -0.5, -1.0):
        _, _, logs = train_learner(CqlConfig(gap=gap, **settings), arms(action, action), iterations=60)
        result[gap] = logs["loss/penalty_weight"], logs["loss/penalty"]
    assert result[1.0][0] < 1e-2 < result[-0.5][0] < 1.0 < result[-1.0][0] < 100.0
    assert result[1.0][1] > result[-0.5][1] > result[-1.0][1]


def test_values_bootstrap_at_timeouts_but_not_at_terminations():
    """One state for ever, paid 1 a step: 1 / (1 - gamma) where episodes are cut off, 1 where they end."""
    ones, number = jnp.ones((20, 10)), jnp.broadcast_to(jnp.arange(10), (20, 10))
    never = jnp.zeros((20, 10), bool)
    table = Table(jnp.ones((20, 10, 3)), jnp.zeros((20, 10, 1)), ones, never, number == 8, number < 9)
    config = IqlConfig(network=NETWORK, gamma=0.8, tau=0.1, expectile=0.5, **FAST)
    for data, worth in ((table, 5.0), (replace(table, terminated=table.usable), 1.0)):
        _, _, logs = train_learner(config, data)
        assert logs["loss/mean_value"] == pytest.approx(worth, rel=0.05)


@pytest.mark.slow
def test_weights_select_training_steps(bandit):
    """Only the arms around 0.3 have weight: for policy and critics, or for the policy alone."""
    weights = np.zeros((500, 2))
    weights[:, 0] = np.abs(np.asarray(bandit.action[:, 0, 0]) - 0.3) < 0.05
    chosen = bandit.action[:, 0, 0][weights[:, 0] > 0]
    config = IqlConfig(network=NETWORK, inverse_temperature=0.0, loss="mse", **FAST)
    for weighted, mean in (("all", float(chosen.mean())), ("policy", 0.0)):
        records = ExperienceConfig(weighted=weighted)
        learner, state, logs = train_learner(replace(config, records=records), bandit, weights=weights)
        action = float(learner.distribution(state.parameters, {"pendulum": jnp.ones(3)}).mode()[0])
        assert action == pytest.approx(0.3, abs=0.05)
        assert logs["loss/mean_q"] == pytest.approx(mean, abs=0.08)
        assert logs["sampler/policy_effective"] == pytest.approx(len(chosen))
        assert logs["sampler/critic_effective"] == pytest.approx(len(chosen) if weighted == "all" else 500)


def test_impossible_settings_are_refused():
    grid = replace(NETWORK, distribution="grid")
    for config in (CqlConfig, Td3BcConfig, partial(IqlConfig, loss="mse")):
        with pytest.raises(UsageError, match=r"a gradient through its actions; .* bc with loss: likelihood"):
            config(network=grid)
    assert IqlConfig(network=grid).loss == "likelihood"
    for config, words in (
        (partial(IqlConfig, expectile=1.0), "expectile is 1"),
        (partial(IqlConfig, inverse_temperature=-1.0), "inverse_temperature is -1.0; use 0 or more"),
        (partial(CqlConfig, actions=0), "actions is 0; use 1 or more"),
        (partial(CqlConfig, backup_actions=0), "backup_actions is 0"),
        (partial(CqlConfig, relative=True, gap=1.0), "a gap replaces the weight of the penalty"),
        (partial(CqlConfig, needs_failures=True), "needs a policy that imitates; use imitation above 0"),
        (partial(CqlConfig, penalty=0.0, gap=1.0), "penalty is 0, .*; use more than 0, or no gap"),
        (partial(Td3BcConfig, delay=0), "delay is 0; use 1 or more"),
        (partial(CqlConfig, steps=0), "steps is 0; use 1 or more"),
        (
            partial(AwacConfig, advantage="return", records=ExperienceConfig(weighted="policy")),
            "advantage: return needs the transitions .*; set records.weighted to all",
        ),
    ):
        with pytest.raises(UsageError, match=words):
            config()


RESUMED = {
    "td3_bc": replace(TD3_BC, updates=3, normalise=True),
    "cql": replace(CQL, updates=3, gap=1.0, imitation=1.0),
    "iql": replace(IQL, updates=3, records=ExperienceConfig(weighted="policy")),
    "awac": replace(AWAC, updates=3),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", RESUMED)
def test_resuming_is_bit_for_bit(bandit, name, tmp_path):
    """Stopped in the middle, with an odd number of updates behind it, and restored from disk."""
    config, weights = RESUMED[name], np.random.default_rng(0).uniform(size=(500, 2))
    learner = config.build(Logged(), bandit, 4)
    data = training_data(config, Logged(), bandit, weights)
    iterate, states = jax.jit(learner.iterate), [jax.jit(learner.init)(data, jax.random.key(5))]
    for _ in range(4):
        states.append(iterate(data, states[-1])[0])
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, states[1])
    # Restored into shapes alone, and for the environment's bare data, as a fresh process does.
    state = checkpoints.restore(jax.eval_shape(learner.init, bandit, jax.random.key(0)))
    again = training_data(config, Logged(), bandit, weights)
    for _ in range(3):
        state = iterate(again, state)[0]
    one, other = ([_plain(leaf) for leaf in jax.tree.leaves(batch)] for batch in (state, states[-1]))
    for left, right in zip(one, other, strict=True):
        np.testing.assert_array_equal(left, right)
    if name == "td3_bc":
        # Six updates with a delay of two: the policy moved in three of them.
        counts = {
            int(leaf)
            for leaf in jax.tree.leaves(states[2].optimiser)
            if jnp.issubdtype(leaf.dtype, jnp.integer)
        }
        assert counts == {3, 6}


def _plain(leaf):
    key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if key else leaf)


@pytest.mark.slow
@pytest.mark.parametrize("name", RESUMED)
def test_algorithms_pass_their_checks(name):
    check_algorithm(RESUMED[name])


@pytest.mark.slow
def test_held_out_values_are_logged_without_ranking(data, tmp_path):
    """Of one run: validation in closed loop next to the mean Q, and a policy that drives."""
    network = {"encoder": {"rows": [8], "hidden": [16]}, "head": [8]}
    values = {
        "task": {"observation": {"agents": 2, "steps": 1, "road": 0, "lights": 1, "route": 3}},
        "algorithm": {"kind": "td3_bc", "network": network, "batch": 8, "updates": 2},
        "total_steps": 64,
        "evaluate_every": 2,
    }
    config = settings.load(TrainConfig, values)
    run = train(config, TrainingSet(data, np.ones((3, 91))), tmp_path / "run", validation=data)
    rows = [row for row in read_rows(run.metrics) if "validation/mean_q" in row]
    assert len(rows) == 2 and all("validation/vmax_score" in row for row in rows)
    assert rows[0]["sampler/policy_effective"] > 100
    bank = ScenarioBank.from_scenarios(data)
    planner, _ = load_policy(run.path, bank)
    learner = config.algorithm.build(config.environment(LogTraffic()), bank, config.iterations)
    held_out = training_data(config.algorithm, config.environment(LogTraffic()), bank)
    state = Checkpoints(run.checkpoints).restore(jax.eval_shape(learner.init, bank, jax.random.key(0)))
    assert rows[-1]["validation/mean_q"] == pytest.approx(
        learner.held_out_metrics(held_out, state)["mean_q"], rel=1e-5
    )
    assert isinstance(planner, Planner)


@pytest.mark.parametrize(("kind", "every"), [(IQL, 1), (TD3_BC, TD3_BC.delay)])
@pytest.mark.parametrize("decay_share", [1.0, 0.5])
def test_rates_fall_linearly_over_the_run_or_a_part_of_it(kind, every, decay_share):
    """Adam's step under a constant gradient is its rate; the policy of TD3+BC takes every second step."""
    config = replace(
        kind, updates=10, last_rate=0.25, decay_share=decay_share, policy_rate=1e-3, gradient_norm=1e6
    )
    weights = jnp.zeros(1)

    def rates(config, count):
        adam = config.build(Logged(), arms([0.0], [0.0]), 4).adam(config.policy_rate, every)

        def move(state, _):
            change, state = adam.update(jnp.ones(1), state, weights)
            return state, change[0]

        return -np.asarray(jax.lax.scan(move, adam.init(weights), None, count)[1])

    count = 40 // every + 1
    share = np.minimum(np.arange(count) / (decay_share * 40 // every), 1.0)
    np.testing.assert_allclose(rates(config, count), 1e-3 - 0.75e-3 * share, rtol=1e-4)
    # A share of less than one update is one update.
    np.testing.assert_allclose(rates(replace(config, decay_share=1e-3), 2), [1e-3, 0.25e-3], rtol=1e-4)
    with pytest.raises(UsageError, match=r"decay_share is 0\.0; use more than 0"):
        replace(config, decay_share=0.0)


@pytest.mark.parametrize("kind", ["bc", "iql"])
def test_former_key_of_the_decay_share_is_read(kind):
    config = settings.load(TrainConfig, {"algorithm": {"kind": kind, "falling": 0.25}})
    assert config.algorithm.decay_share == 0.25
    changed = settings.load(TrainConfig, f"offline/{kind}", ["--algorithm.falling", "0.25"])
    assert changed.algorithm.decay_share == 0.25


def test_statistics_of_a_file_normalise_features(bandit, tmp_path):
    file, data = tmp_path / "statistics.json", bandit
    spec = Logged().shapes(data)
    names = {group: [f"{column}" for column in range(spec[group][-1])] for group in group_names(spec)}
    rows = [
        {"group": group, "name": f"{column}", "mean": 3.0 + column, "std": None if column else 2.0}
        for group in group_names(spec)
        for column in range(spec[group][-1])
    ]
    file.write_text(json.dumps({"features": rows}))
    learner = replace(TD3_BC, normalise=str(file)).build(Logged(), data, 2)
    state = learner.init(training_data(learner.config, Logged(), data, None), jax.random.key(0))
    policy = nnx.merge(learner.graphs["policy"], state.parameters)
    (encoder,) = (node for _, node in nnx.iter_graph(policy) if isinstance(node, NormalisedEncoder))
    for group in group_names(spec):
        size = spec[group][-1]
        np.testing.assert_array_equal(encoder.mean[group][...], 3.0 + np.arange(size))
        np.testing.assert_array_equal(encoder.deviation[group][...], [2.0, *[1.0] * (size - 1)])
    for damage, words in (
        ({"features": rows[1:]}, "the features of pendulum are not 0, 1, 2"),
        ({"features": rows[::-1]}, "the features of pendulum are not 0, 1, 2"),
        (
            {"features": [*rows[:-1], {**rows[-1], "std": -1.0}]},
            "a mean or a deviation of pendulum is invalid",
        ),
        (
            {"features": [*rows[:-1], {**rows[-1], "mean": "inf"}]},
            "a mean or a deviation of pendulum is invalid",
        ),
        ({"features": 3}, "no statistics of observations"),
        ([], "no statistics of observations"),
    ):
        file.write_text(json.dumps(damage))
        with pytest.raises(DataError, match=rf"statistics.json.*{words}.*drivax inspect SET --observations"):
            read_statistics(file, names)
