"""Constraints of PPO: multipliers by hand, and a bandit whose constrained optimum is known."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.learning import TrainConfig, make_agent
from drivax.learning.algorithms.behaviour_cloning import Cloning
from drivax.learning.algorithms.ppo import Constraints, PpoConfig
from drivax.learning.algorithms.warm_start import BcPpoConfig, WarmStart
from drivax.learning.environment import Environments, Outcome, Rollout, collect
from drivax.learning.loop import mean_logs
from drivax.learning.program import Program, Seeds
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.encoders import MlpConfig
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.settings import dump, load, parse_yaml
from drivax.simulator.traffic.log import LogTraffic
from drivax.tasks.conditions import Condition
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task
from drivax.testing import check_algorithm
from drivax.tracking.checkpoints import Checkpoints


@dataclass(frozen=True)
class Bandit:
    """Episodes of one step. An action a earns u = (a + 1) / 2 and fails with probability u^2, at a price.

    With a price p of a failure the best u is 1 / (2 p).
    """

    price: float = 1.0
    action_size: int = 1
    levels: Any = None

    @property
    def penalties(self):
        return {"failure": self.price}

    def shapes(self, data):
        return {"bandit": (1,)}

    def start(self, data, key, count):
        return self._environments(count, jnp.arange(count) % 2 == 0)

    def stored(self, state):
        return state

    def observe_all(self, data, stored):
        return {"bandit": jnp.ones((*stored.shape, 1))}

    def cache(self, data, state):
        return ()

    def draw(self, data, key, count):
        return key

    def step(self, data, now, cache, action, drawn):
        pay = (action[:, 0] + 1.0) / 2.0
        fails = (jax.random.uniform(drawn, pay.shape) < pay**2) & ~now.over
        terms = {"pay": pay, "failure": -self.price * fails}
        totals = {f"reward/{name}": jnp.sum(jnp.where(now.over, 0.0, term)) for name, term in terms.items()}
        outcome = Outcome(pay + terms["failure"], fails, ~fails & ~now.over, (), totals, terms)
        return self._environments(len(pay), ~now.over), outcome

    def _environments(self, count, over):
        return Environments(jnp.zeros(count), over, self.observe_all((), jnp.zeros(count)))


NETWORK = NetworkConfig(encoder=MlpConfig(hidden=(4,)), head=(4,), first_scale=0.2)
PPO = PpoConfig(
    network=NETWORK, environments=64, unroll=16, epochs=4, minibatches=2, learning_rate=1e-2, last_rate=0.1,
    gamma=0.0, entropy_coefficient=0.0, constraints={"failure": 0.09}, multiplier_rate=0.5,
)  # fmt: skip


#: The last iterations of a run.
LAST = slice(-60, None)


def rollout_of(cost, terminated, truncated, weight):
    """Return a rollout ``[time, environment]`` with rewards of 0.5 and a penalty."""
    term = -weight * jnp.asarray(cost)
    alive, reward = jnp.ones(term.shape, bool), 0.5 + term
    ends = [jnp.asarray(ends, bool) for ends in (terminated, truncated)]
    return Rollout(None, None, term[..., None], {}, reward, *ends, alive, {"collision": term})


def test_dual_updates_by_hand():
    """The limit is 0.25, the rate 2, the first weight 3."""
    constraints = Constraints({"collision": 0.25}, {"collision": 3.0}, 2.0)
    # One of two episodes collides: 3 + 2 (1/2 - 1/4).
    collides = rollout_of([[0.0, 1.0], [0.0, 0.0]], [[0, 1], [0, 0]], [[0, 0], [1, 0]], 3.0)
    multipliers = constraints.init()
    reward, multipliers, logs = constraints.update(multipliers, collides)
    np.testing.assert_array_equal(reward, collides.reward)
    assert float(multipliers["collision"]) == 3.5
    row = mean_logs(logs)
    assert row == {"multiplier/collision": 3.0, "cost/collision": 0.5}
    # The failure now costs 3.5. None of one episode collides next: 3.5 + 2 (0 - 1/4).
    reward, multipliers, _ = constraints.update(multipliers, collides)
    np.testing.assert_allclose(reward, [[0.5, -3.0], [0.5, 0.5]])
    safe = rollout_of([[0.0, 0.0]], [[0, 0]], [[1, 0]], 3.0)
    assert float(constraints.update({"collision": jnp.float32(3.5)}, safe)[1]["collision"]) == 3.0


def test_a_multiplier_falls_to_zero_and_stays_without_episodes():
    constraints = Constraints({"collision": 0.25}, {"collision": 0.6}, 1.0)
    safe = rollout_of([[0.0, 0.0]], [[0, 0]], [[1, 1]], 0.6)
    multipliers, values = constraints.init(), []
    for _ in range(4):
        _, multipliers, _ = constraints.update(multipliers, safe)
        values.append(float(multipliers["collision"]))
    np.testing.assert_allclose(values, [0.35, 0.1, 0.0, 0.0], atol=1e-6)
    unfinished = rollout_of([[1.0, 0.0]], [[0, 0]], [[0, 0]], 0.6)
    _, after, logs = constraints.update({"collision": jnp.float32(0.4)}, unfinished)
    assert float(after["collision"]) == pytest.approx(0.4)
    assert mean_logs(logs) == {"multiplier/collision": pytest.approx(0.4)}


def run(config, environment, iterations, seed=0):
    """Return the last state and the logs."""
    learner = config.build(environment, (), iterations)

    def iterate(state, _):
        return learner.iterate((), state)

    state = learner.init((), jax.random.key(seed))
    state, logs = jax.jit(lambda state: jax.lax.scan(iterate, state, None, iterations))(state)
    return state, logs


def per_episode(logs, name, iterations):
    """Return a mean over the episodes of some iterations."""
    return float(logs[name][iterations].sum() / logs["rollout/episodes"][iterations].sum())


def test_the_constrained_optimum_of_a_bandit():
    """Without a limit u = 1/2 fails in 1/4 of episodes; u = 0.3 fails in 0.09 and has the multiplier 1 / 0.6."""
    _, logs = run(replace(PPO, constraints={}), Bandit(), 120)
    assert per_episode(logs, "rollout/reward/pay", LAST) == pytest.approx(0.5, abs=0.05)
    _, logs = run(PPO, Bandit(), 240)
    assert per_episode(logs, "loss/cost/failure", slice(5)) > 0.2
    assert per_episode(logs, "loss/cost/failure", LAST) == pytest.approx(0.09, abs=0.025)
    assert per_episode(logs, "rollout/reward/pay", LAST) == pytest.approx(0.28, abs=0.04)
    assert float(logs["loss/multiplier/failure"][LAST].mean()) == pytest.approx(1 / 0.6, abs=0.4)


def test_a_loose_constraint_costs_nothing():
    """With a limit of 0.9 the multiplier falls to 0, and the bandit takes all."""
    _, logs = run(replace(PPO, constraints={"failure": 0.9}, multiplier_rate=2.0), Bandit(), 40)
    assert float(logs["loss/multiplier/failure"][-1]) < 0.1
    assert per_episode(logs, "rollout/reward/pay", slice(-3, None)) > 0.65


def test_multipliers_at_their_start_leave_the_weighted_sum():
    """With a step size of 0, up to the rounding of another program."""
    fixed, _ = run(replace(PPO, multiplier_rate=0.0), Bandit(), 3)
    free, _ = run(replace(PPO, constraints={}), Bandit(), 3)
    assert free.multipliers == {}
    close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6)
    jax.tree.map(close, fixed.parameters, free.parameters)


def test_resuming_is_bit_for_bit(tmp_path):
    config = replace(PPO, environments=8, unroll=4)
    learner = config.build(Bandit(), (), 4)
    iterate, states = jax.jit(learner.iterate), [learner.init((), jax.random.key(1))]
    for _ in range(4):
        states.append(iterate((), states[-1])[0])
    assert len({float(state.multipliers["failure"]) for state in states}) == 5
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(2, states[2])
    state = checkpoints.restore(jax.eval_shape(learner.init, (), jax.random.key(0)))
    for _ in range(2):
        state, _ = iterate((), state)
    for left, right in zip(jax.tree.leaves(state), jax.tree.leaves(states[4]), strict=True):
        left, right = (
            jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
            for leaf in (left, right)
        )
        np.testing.assert_array_equal(left, right)


def test_each_seed_has_its_own_multiplier():
    learner = replace(PPO, environments=8, unroll=4).build(Bandit(), (), 3)
    program = Program(Seeds(learner, (3, 4)), (), 1)
    state, alone = program.initial_state(), [Program(Seeds(learner, (seed,)), (), 1) for seed in (3, 4)]
    singles = [single.initial_state() for single in alone]
    for _ in range(3):
        state, *_ = program.step(state)
        singles = [single.step(own)[0] for single, own in zip(alone, singles, strict=True)]
    together = [float(program.seeds.member(state, number).multipliers["failure"]) for number in range(2)]
    assert together[0] != together[1]
    np.testing.assert_allclose(together, [float(own.multipliers["failure"]) for own in singles], rtol=1e-5)


@pytest.mark.slow
def test_terms_of_driving_sum_to_the_reward(data):
    """With held decisions, too; a penalty over its weight is the failure."""
    rewards = RewardConfig(preset="pace", scale=0.5, at_fault_collision=-2.0)
    task = Task(rewards=rewards, metrics=("collision", "offroad"), hold=2)
    algorithm = replace(PPO, environments=8, unroll=40, constraints={"collision": 0.1, "offroad": 0.2})
    config = TrainConfig(task=task, algorithm=algorithm, latest_start=40)
    bank = ScenarioBank.from_scenarios(data)
    agent = make_agent(config, bank)
    environment = agent.environment
    failures = dict.fromkeys(("collision", "offroad", "red_light"), 1.5)
    assert environment.penalties == failures | {"at_fault_collision": 1.0}

    def actor(observation, key):
        action = jax.random.uniform(key, (8, 2), minval=-1.0)
        return action, action, {}

    factors = ("urgency", "discomfort", "speeding", "route_offset")
    names = [*rewards.weights(), *(f"pace/{name}" for name in factors)]

    def experience(bank):
        environments = environment.start(bank, jax.random.key(0), 8)
        return collect(environment, bank, environments, actor, jax.random.key(1), 80, terms=names)[1]

    rollout = jax.jit(experience)(bank)
    np.testing.assert_allclose(sum(rollout.terms.values()), rollout.reward, atol=1e-5)
    penalties = {name: np.asarray(rollout.terms[name]) / -weight for name, weight in failures.items()}
    fails = np.stack(list(penalties.values())).max(axis=0) > 0
    assert fails.sum() > 5
    np.testing.assert_array_equal(fails, rollout.terminated)
    assert {float(cost) for costs in penalties.values() for cost in np.unique(costs)} <= {0.0, 1.0}
    at_fault = np.asarray(rollout.terms["at_fault_collision"]) < 0
    assert (at_fault <= (penalties["collision"] > 0)).all()

    state, logs = jax.jit(agent.iterate)(bank, jax.jit(agent.init)(bank, jax.random.key(0)))
    assert set(state.multipliers) == {"collision", "offroad"}
    row = mean_logs(logs)
    assert row["rollout/episodes"] > 8 and row["loss/multiplier/collision"] == 1.5
    # Costs per episode are the shares of episodes that the metrics count.
    for name in ("collision", "offroad"):
        assert row[f"loss/cost/{name}"] == pytest.approx(row[f"rollout/{name}"])
    assert row["loss/cost/offroad"] > 0.0


@pytest.mark.slow
def test_constraints_after_cloning_pass_the_checks_of_algorithms():
    warm_start = WarmStart(iterations=1, cloning=Cloning(batch=8, updates=2), settle=1, weight=0.5)
    ppo = replace(PPO, environments=4, unroll=4, constraints={"collision": 0.1})
    check_algorithm(BcPpoConfig(warm_start=warm_start, ppo=ppo))


def test_mistakes_are_named():
    with pytest.raises(UsageError, match=r"'failures' is not a penalty .*; did you mean 'failure'\?"):
        replace(PPO, constraints={"failures": 0.1}).build(Bandit(), (), 1)
    with pytest.raises(
        UsageError, match=r"'lag' is not a penalty .*; give that term a weight below 0, and no cond"
    ):
        replace(PPO, constraints={"lag": 0.1}).build(Bandit(), (), 1)
    for wrong, words in (
        ({"constraints": {"failure": -0.1}}, "limit of constraint 'failure' is -0.1"),
        ({"multiplier_rate": -1.0}, "multiplier_rate is -1.0"),
    ):
        with pytest.raises(UsageError, match=f"{words}; use 0 or more"):
            replace(PPO, **wrong)


def test_a_weight_of_a_condition_is_no_penalty():
    """It differs between episodes, so that a term over its weight is no cost."""
    task = Task(rewards=RewardConfig(preset="pace"), conditions=(Condition("collision", 0.5, 2.0),))
    assert set(TrainConfig(task=task).environment(LogTraffic()).penalties) == {"offroad", "red_light"}


def test_constraints_of_file_and_flags_are_merged():
    flags = ["--algorithm.constraints.collision", "0.02", "--algorithm.multiplier_rate", "0.05"]
    config = load(TrainConfig, {"algorithm": {"kind": "ppo", "constraints": {"offroad": 0.005}}}, flags)
    assert config.algorithm.constraints == {"offroad": 0.005, "collision": 0.02}
    assert load(TrainConfig, parse_yaml(dump(config))) == config
