"""Mixtures of traffic: shares become blocks of environments, and each block is that of its traffic alone."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import settings
from drivax.errors import UsageError
from drivax.learning.algorithms.behaviour_cloning import BcConfig
from drivax.learning.algorithms.ppo import PpoConfig
from drivax.learning.algorithms.sac import SacConfig
from drivax.learning.config import TrainConfig
from drivax.learning.environment import Environment
from drivax.learning.loop import make_agent, mean_logs
from drivax.learning.mixture import Mixture, divide, training_environment
from drivax.learning.replay import ReplayConfig
from drivax.learning.self_play import SelfPlay, SelfPlayConfig
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.encoders import MlpConfig
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.traffic.reactive import IdmTraffic
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from drivax.tracking.checkpoints import Checkpoints

NETWORK = NetworkConfig(encoder=MlpConfig(rows=(8,), hidden=(8,)), head=(8,))
OBSERVATION = ObservationConfig(agents=2, steps=1, road=0, lights=1, route=2)
PPO = PpoConfig(network=NETWORK, environments=12, unroll=8, epochs=1, minibatches=2)
CONFIG = TrainConfig(
    task=Task(observation=OBSERVATION, metrics=("steps", "collision")), algorithm=PPO, latest_start=40,
    traffic={"self": 0.6, "log": 0.2, "idm": 0.2}, total_steps=96,
)  # fmt: skip


@pytest.fixture(scope="module")
def bank(data_of_egos):
    return training_environment(CONFIG).prepare(ScenarioBank.from_scenarios(data_of_egos))


@pytest.mark.parametrize(
    ("count", "shares", "groups", "sizes"),
    [
        # 128 in groups; 0.35 and 0.15 of the other 128 make 89.6 and 38.4.
        (256, {"self": 0.5, "log": 0.35, "idm": 0.15}, {"self": 4}, (128, 90, 38)),
        (10, {"log": 0.5, "idm": 0.26, "own": 0.24}, {}, (5, 3, 2)),
        # 0.3 of 16 lies between one group and two, closer to one.
        (16, {"log": 0.7, "self": 0.3}, {"self": 4}, (12, 4)),
        (16, {"log": 0.6, "self": 0.4}, {"self": 4}, (8, 8)),
        (12, {"log": 0.98, "self": 0.02}, {"self": 4}, (8, 4)),
        (3, {"log": 1 / 3, "idm": 1 / 3, "own": 1 / 3}, {}, (1, 1, 1)),
    ],
)
def test_shares_become_environments(count, shares, groups, sizes):
    assert tuple(divide(count, shares, groups).values()) == sizes


def test_a_block_without_environments_is_refused():
    mixture = training_environment(replace(CONFIG, traffic={"log": 0.9, "idm": 0.1}))
    with pytest.raises(
        UsageError, match=r"traffic idm has a share of 0.1 of 4 environments: none; raise env"
    ):
        mixture.sizes(4)
    with pytest.raises(UsageError, match=r"traffic log has a share of 0\.2 of 4"):
        training_environment(CONFIG).sizes(4)


def test_traffic_is_a_name_or_shares():
    shares = {"self": 0.5, "log": 0.35, "idm": 0.15}
    text = "{self: 0.5, log: 0.35, idm: 0.15}"
    for values, flags in (
        ({"traffic": shares}, []),
        ({}, ["--traffic", text]),
        ({"traffic": "idm"}, ["--traffic", text]),
    ):
        config = settings.load(TrainConfig, values, flags)
        assert config.traffic == shares
        assert settings.load(TrainConfig, settings.parse_yaml(settings.dump(config))) == config
    assert settings.load(TrainConfig, {"traffic": shares}, ["--traffic", "idm"]).traffic == "idm"
    assert isinstance(training_environment(CONFIG), Mixture)
    for name, kind in (("log", LogTraffic), ("idm", IdmTraffic)):
        # A single name is the environment of that traffic itself.
        for traffic in (name, {name: 1.0}, {name: 1.0, "self": 0.0}):
            config = replace(CONFIG, traffic=traffic)
            assert training_environment(config) == config.environment(kind())
    assert isinstance(training_environment(replace(CONFIG, traffic="self")), SelfPlay)


@pytest.mark.parametrize(
    ("traffic", "words"),
    [
        (
            {"log": 0.5, "idm": 0.4},
            "shares of traffic are log 0.5, idm 0.4; use shares of at least 0 with a sum of 1",
        ),
        ({"log": 1.5, "idm": -0.5}, "shares of traffic are log 1.5, idm -0.5; use"),
        ({}, "shares of traffic are missing"),
        ({"log": 0.5, "idn": 0.5}, "unknown traffic 'idn'; did you mean 'idm'"),
        ({"log": "half"}, "'half' is not a number"),
    ],
)
def test_wrong_shares_are_refused(traffic, words):
    with pytest.raises(UsageError, match=words):
        settings.load(TrainConfig, {"traffic": traffic})


@pytest.mark.parametrize(
    ("traffic", "name"),
    [
        ("idm", "idm"), ("self", "log"), ({"self": 0.9, "log": 0.1}, "log"), ({"self": 0.9, "idm": 0.1}, "idm"),
        ({"idm": 0.4, "zoo:aggressive": 0.6}, "zoo:aggressive"), ({"idm": 0.9, "log": 0.1}, "log"),
    ],
)  # fmt: skip
def test_validation_has_one_traffic(traffic, name):
    assert replace(CONFIG, traffic=traffic).validation_traffic == name


def test_two_policies_are_refused(bank):
    traffic = {"zoo:aggressive": 0.5, "zoo:aggressive+idm": 0.5}
    with pytest.raises(
        UsageError, match=r"traffic zoo:aggressive\+idm replaces data of another traffic; mix at"
    ):
        training_environment(replace(CONFIG, traffic=traffic)).prepare(bank)


@pytest.mark.slow
def test_replay_of_states_is_refused(bank):
    sac = SacConfig(network=NETWORK, environments=12, unroll=8, batch=8, replay=ReplayConfig(240), warm_up=96)
    words = r"a replay buffer cannot store states of a mixture of traffic; set replay\.store to observation"
    with pytest.raises(UsageError, match=words):
        learner = make_agent(replace(CONFIG, algorithm=sac), bank)
        jax.eval_shape(learner.init, bank, jax.random.key(0))
    sac = replace(sac, replay=ReplayConfig(240, "observation"))
    learner = make_agent(replace(CONFIG, algorithm=sac), bank)
    state = jax.eval_shape(learner.init, bank, jax.random.key(0))
    assert jax.eval_shape(learner.iterate, bank, state)[0].replay.reward.shape == (20, 12)
    with pytest.raises(UsageError, match=r"self_play\.past needs ppo or bc_ppo"):
        replace(CONFIG, algorithm=sac, self_play=SelfPlayConfig(past=0.5))


@pytest.mark.slow
def test_mixture_equals_its_blocks_alone(bank):
    """Half log, half idm, against an environment of each with the same keys and actions."""
    mixture = training_environment(replace(CONFIG, traffic={"log": 0.5, "idm": 0.5}))
    assert isinstance(mixture, Environment)
    blocks = [block for _, block in mixture.blocks]
    actions = jnp.tanh(0.4 * jax.random.normal(jax.random.key(2), (60, 6, 2)))

    @jax.jit
    def together(bank):
        now = mixture.start(bank, jax.random.key(0), 6)

        def step(carry, row):
            after, outcome = mixture.step(bank, *carry, row[0], mixture.draw(bank, row[1], 6))
            return (after, outcome.cache), (after.over, after.observation, outcome.reward, outcome.totals)

        first = (now, mixture.cache(bank, now.state))
        return jax.lax.scan(step, first, (actions, jax.random.split(jax.random.key(1), 60)))[1]

    @jax.jit
    def alone(bank):
        rows = []
        for number, block in enumerate(blocks):
            now = block.start(bank, jax.random.split(jax.random.key(0), 2)[number], 3)

            def step(carry, row, block=block, number=number):
                own, key = row[0][3 * number : 3 * number + 3], jax.random.split(row[1], 2)[number]
                after, outcome = block.step(bank, *carry, own, block.draw(bank, key, 3))
                return (after, outcome.cache), (after.over, after.observation, outcome.reward, outcome.totals)

            first = (now, block.cache(bank, now.state))
            rows.append(jax.lax.scan(step, first, (actions, jax.random.split(jax.random.key(1), 60)))[1])
        return rows

    rows, (log, idm) = jax.device_get((together(bank), alone(bank)))
    assert rows[0].sum() > 3 and not np.array_equal(log[2], idm[2])
    for name, joined in rows[1].items():
        expected = np.concatenate([log[1][name], idm[1][name]], axis=1)
        np.testing.assert_allclose(joined, expected, atol=1e-4, err_msg=name)
    for number in (0, 2):
        expected = np.concatenate([log[number], idm[number]], axis=1)
        np.testing.assert_allclose(rows[number], expected, atol=1e-4)
    for name, total in rows[3].items():
        expected = (log[3][name] + idm[3][name]).sum(axis=1)
        np.testing.assert_allclose(total, expected, atol=1e-3, err_msg=name)


@pytest.mark.slow
def test_ppo_trains_in_a_mixture_and_resumes_bit_for_bit(bank, tmp_path):
    learner = make_agent(replace(CONFIG, self_play=SelfPlayConfig(past=0.5, refresh=2)), bank)
    assert learner.environment.sizes(12) == (8, 2, 2) and learner.past.environments.tolist() == [1, 2, 3]
    iterate = jax.jit(learner.iterate)
    states, rows = [jax.jit(learner.init)(bank, jax.random.key(0))], []
    for _ in range(4):
        state, logs = iterate(bank, states[-1])
        states.append(state)
        rows.append(logs)
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(2, states[2])
    state = checkpoints.restore(jax.eval_shape(learner.init, bank, jax.random.key(0)))
    for number in (2, 3):
        state, logs = iterate(bank, state)
        jax.tree.map(np.testing.assert_array_equal, logs, rows[number])
    key = (state.key, states[-1].key)
    assert np.array_equal(*map(jax.random.key_data, key))
    jax.tree.map(
        np.testing.assert_array_equal, *(replace(each, key=jnp.zeros(())) for each in (state, states[-1]))
    )
    changed = jax.tree.map(np.array_equal, states[0].parameters, states[1].parameters)
    assert not all(jax.tree.leaves(changed))
    means = [mean_logs(row) for row in rows]
    assert all(np.isfinite(value) for row in means for value in row.values())
    assert any("rollout/collision" in row for row in means)


def test_logged_steps_are_those_of_the_log(bank):
    """Behaviour cloning in a mixture draws the same demonstrations as in the log."""
    bc = BcConfig(network=NETWORK, batch=8, updates=1)
    mixture, log = (
        training_environment(replace(CONFIG, algorithm=bc, traffic=traffic))
        for traffic in ({"idm": 0.5, "log": 0.5}, "log")
    )
    demonstrations = [
        jax.jit(each.demonstrations, static_argnums=2)(bank, jax.random.key(0), 8) for each in (mixture, log)
    ]
    jax.tree.map(np.testing.assert_array_equal, *demonstrations)
