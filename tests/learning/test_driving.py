"""Driving as an environment: its rollouts, and the actions of the expert."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.learning.algorithms.behaviour_cloning import BcConfig
from drivax.learning.algorithms.ppo import PpoConfig
from drivax.learning.algorithms.sac import SacConfig
from drivax.learning.driving import Driving
from drivax.learning.environment import Environment, collect
from drivax.learning.replay import ReplayConfig
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.encoders import MlpConfig
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.dynamics import bicycle
from drivax.simulator.simulator import Simulator
from drivax.tasks.actions import PHYSICAL, ROUTE, Discrete, execute
from drivax.tasks.observations import ObservationConfig, OwnGroup
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task


def moment(bank, context, frames):
    """A feature: scenario, step, last action."""
    place = jnp.stack([context.index, context.step]).astype(jnp.float32)
    return jnp.concatenate([place, context.action])[None]


OBSERVATION = ObservationConfig(agents=1, steps=1, road=0, lights=1, route=2, own=(OwnGroup(moment),))
EARLIEST, LATEST = 4, 30


@pytest.fixture(scope="module")
def bank(data):
    return ScenarioBank.from_scenarios(data)


@pytest.fixture(scope="module")
def driving():
    return Driving(Simulator(Task(observation=OBSERVATION, metrics=("steps", "red_light"))), LATEST, EARLIEST)


@pytest.fixture(scope="module")
def experience(bank, driving):
    """120 steps of 6 environments that swerve, with what the actor saw."""
    environments = jax.jit(driving.start, static_argnums=2)(bank, jax.random.key(0), 6)

    def actor(observation, key):
        raw_action = 0.5 * jax.random.normal(key, (6, 2))
        return raw_action, jnp.tanh(raw_action), {"route": observation["route"]}

    run = jax.jit(lambda b, e, k: collect(driving, b, e, actor, k, 120, "state"))
    return jax.device_get(run(bank, environments, jax.random.key(1)))


def test_driving_is_an_environment(bank, driving):
    assert isinstance(driving, Environment)
    assert driving.action_size == 2 and driving.levels is None
    assert driving.shapes(bank)["moment"] == (1, 4)
    grid = Driving(Simulator(Task(actions=Discrete(accelerations=3, curvatures=5))))
    assert grid.levels == ((-1.0, 0.0, 1.0), (-1.0, -0.25, 0.0, 0.25, 1.0))
    with pytest.raises(UsageError, match=r"use 10 \(earliest_start\) or more"):
        Driving(driving.simulator, 9)
    with pytest.raises(UsageError, match=r"latest_start is 89; use 10 \(earliest_start\) to 88"):
        Driving(driving.simulator, 89).start(bank, jax.random.key(0), 1)
    with pytest.raises(UsageError, match="earliest_start is 89; use 0 to 88"):
        Driving(driving.simulator, 90, 89).start(bank, jax.random.key(0), 1)


NETWORK = NetworkConfig(encoder=MlpConfig(rows=(8,), hidden=(8,)), distribution="grid")
ON_LEVELS = [
    PpoConfig(environments=4, unroll=4, epochs=1, minibatches=1, network=NETWORK),
    BcConfig(batch=8, updates=2, loss="likelihood", network=NETWORK),
    SacConfig(
        environments=4, unroll=4, batch=8, replay=ReplayConfig(64), warm_up=16,
        network=replace(NETWORK, distribution="gaussian"),
    ),
]  # fmt: skip


@pytest.mark.parametrize("config", ON_LEVELS, ids=lambda config: config.kind)
def test_algorithms_learn_discrete_actions(config, bank):
    """Levels are read while the network is traced."""
    task = Task(actions=Discrete(accelerations=3, curvatures=5), observation=OBSERVATION, metrics="none")
    environment = Driving(Simulator(task), LATEST)
    learner = config.build(environment, bank, 2)
    iterate = jax.eval_shape(learner.iterate, bank, jax.eval_shape(learner.init, bank, jax.random.key(0)))
    assert iterate[0].iteration.shape == ()


@pytest.mark.slow
def test_discrete_policy_takes_levels(bank):
    task = Task(actions=Discrete(accelerations=3, curvatures=5), observation=OBSERVATION, metrics="none")
    environment = Driving(Simulator(task), LATEST)
    learner = ON_LEVELS[0].build(environment, bank, 2)
    state, logs = jax.jit(learner.iterate)(bank, learner.init(bank, jax.random.key(0)))
    assert all(np.isfinite(value).all() for value in jax.tree.leaves(logs))
    policy, _ = learner.network(state.parameters).policy_and_value(
        environment.start(bank, jax.random.key(1), 6).observation
    )
    actions = policy.action(policy.sample(jax.random.key(2)))
    accelerations, curvatures = environment.levels
    assert (
        np.isin(actions[:, 0], accelerations).all() and np.isin(actions[:, 1], np.float32(curvatures)).all()
    )


def test_row_after_an_end_holds_the_final_state(experience):
    after, rollout, _ = experience
    ended, alive = rollout.terminated | rollout.truncated, rollout.alive
    assert ended.sum() >= 6 and rollout.terminated.any() and rollout.observation is None
    # Every end is followed by exactly one row that only begins an episode, and by nothing else.
    np.testing.assert_array_equal(~alive[1:], ended[:-1])
    np.testing.assert_array_equal(after.over, ended[-1])
    assert not (ended & ~alive).any() and (rollout.reward[~alive] == 0).all()
    context = rollout.state
    # Whatever happens, what a step led to is the same scenario one step later, seen with the same past.
    steps = alive[:-1]
    np.testing.assert_array_equal(context.index[1:][steps], context.index[:-1][steps])
    np.testing.assert_array_equal(context.step[1:][steps], context.step[:-1][steps] + 1)
    np.testing.assert_array_equal(context.history[1:][steps][:, :-1], context.history[:-1][steps][:, 1:])
    # Nothing of that reaches the episode that begins behind it.
    first_steps = context.step[1:][~steps]
    assert (
        (first_steps >= EARLIEST).all() and (first_steps <= LATEST).all() and len(np.unique(first_steps)) > 2
    )
    assert (context.action[1:][~steps] == 0).all() and (context.route_m[1:][~steps] >= 0).all()


def test_new_episodes_begin_as_logged(experience, bank):
    context, alive = experience[1].state, experience[1].alive
    rows = np.argwhere(~alive[:-1]) + np.array([1, 0])
    for time, number in rows:
        step, history = context.step[time, number], context.history[time, number]
        logged = np.asarray(bank.agents)[context.index[time, number], max(step - 9, 0) : step + 1, 0]
        np.testing.assert_allclose(history[-len(logged) :, :2], logged[:, :2], atol=1e-4)


def test_episodes_begin_at_requested_steps(bank):
    late = replace(bank, agents=bank.agents.at[1, :3, 0, AgentColumn.VALID].set(0.0))
    logged = Driving(Simulator(Task()))
    index, step, *_ = logged._draw(late, jax.random.key(2), 64, 0, 0)
    np.testing.assert_array_equal(step, np.where(index == 1, 10, 0))
    step = logged._draw(bank, jax.random.key(2), 256, 0, LATEST)[1]
    assert set(np.asarray(step)) == set(range(LATEST + 1))
    for earliest, latest, words in ((-1, 0, "use 0 or more"), (5, 4, r"use 5 \(earliest_start\) or more")):
        with pytest.raises(UsageError, match=words):
            Driving(Simulator(Task()), latest, earliest)


def test_stored_states_give_the_same_observation(experience, bank, driving):
    _, rollout, _ = experience
    rows = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), rollout.state)
    again = jax.jit(driving.observe_all)(bank, rows)
    np.testing.assert_allclose(
        again["route"], rollout.extra["route"].reshape(again["route"].shape), atol=1e-5
    )
    one = jax.jit(driving.simulator.observe)(bank, jax.tree.map(lambda leaf: leaf[7], rows))
    np.testing.assert_allclose(one["route"], again["route"][7], atol=1e-5)


def test_sums_leave_out_resets(experience, driving):
    _, rollout, totals = experience
    ended = rollout.terminated | rollout.truncated
    assert totals["episodes"] == ended.sum() == totals["steps/n"] == totals["red_light/n"]
    terms = [totals[f"reward/{name}"] for name in driving.task.rewards.weights()]
    assert sum(terms) == pytest.approx(rollout.reward.sum(), rel=1e-4, abs=1e-3)


def test_demonstrations_follow_the_log(bank, driving):
    observation, action, clipped = jax.device_get(
        jax.jit(driving.demonstrations, static_argnums=2)(bank, jax.random.key(3), 256)
    )
    index, step = observation["moment"][:, 0, :2].astype(int).T
    assert step.min() >= 10 and step.max() <= bank.steps - 3 and set(index) == {0, 1, 2}
    assert (np.abs(action) <= 1).all()
    # Driven through the dynamics, every action leads to where the log goes.
    rows = np.asarray(bank.agents)[index[:, None], step[:, None] + np.arange(2), 0]
    speed = (rows[..., 5:7] * rows[..., 3:5]).sum(-1).clip(0)
    motion = np.stack(
        [
            rows[..., 0],
            rows[..., 1],
            np.arctan2(rows[..., AgentColumn.SIN], rows[..., AgentColumn.COS]),
            speed,
        ],
        axis=-1,
    )
    next_motion = jax.vmap(bicycle)(motion[:, 0], 6.0 * action[:, 0], 0.3 * action[:, 1])
    distance = np.linalg.norm(next_motion[:, :2] - motion[:, 1, :2], axis=-1)
    assert (~clipped).mean() > 0.9 and distance[~clipped].max() < 0.05
    # The last action that is seen is what the expert did a step before.
    action_at = {(i, s): a for i, s, a in zip(index, step, action, strict=True)}
    pairs = [(action_at[i, s - 1], o[0, 2:]) for i, s, o in zip(index, step, observation["moment"], strict=True)
             if (i, s - 1) in action_at]  # fmt: skip
    assert len(pairs) > 20
    np.testing.assert_allclose(*map(np.array, zip(*pairs, strict=True)), atol=1e-5)


def test_demonstrations_leave_out_gaps_of_the_log(bank, driving):
    """Ego is not logged at steps 40 to 43; the action of step 39 looks at 41."""
    gap = replace(bank, agents=bank.agents.at[:, 40:44, 0, AgentColumn.VALID].set(0.0))
    observation, *_ = jax.jit(driving.demonstrations, static_argnums=2)(gap, jax.random.key(3), 256)
    steps = set(np.asarray(observation["moment"][:, 0, 1]).astype(int))
    assert 37 in steps and not steps & set(range(38, 44))
    # Nor may step 10, which has no action either, take their place.
    gap = replace(bank, agents=bank.agents.at[:, 11:-20, 0, AgentColumn.VALID].set(0.0))
    observation, *_ = jax.jit(driving.demonstrations, static_argnums=2)(gap, jax.random.key(3), 256)
    assert set(np.asarray(observation["moment"][:, 0, 1]).astype(int)) == set(
        range(bank.steps - 20, bank.steps - 2)
    )


def test_held_decision_takes_its_steps_and_stops_at_an_end(bank, driving):
    """Two steps of one action equal two single steps; rewards add up, and an ended episode waits for its reset."""
    task = replace(driving.task, rewards=RewardConfig(preset="pace"), metrics="none")
    single = Driving(Simulator(task), LATEST, EARLIEST)
    double = Driving(Simulator(replace(task, hold=2)), LATEST, EARLIEST)
    start = jax.jit(single.start, static_argnums=2)(bank, jax.random.key(0), 24)
    steps = {name: jax.jit(each.step) for name, each in (("single", single), ("double", double))}
    draw, cache_of = jax.jit(single.draw, static_argnums=2), jax.jit(single.cache)
    action, now = jnp.tile(jnp.array([[1.0, 0.4], [-1.0, -0.4]]), (12, 1)), start
    ended = 0
    for number in range(40):
        drawn, cache = draw(bank, jax.random.key(number), 24), cache_of(bank, now.state)
        held, result = steps["double"](bank, now, cache, action, drawn)
        first, one = steps["single"](bank, now, cache, action, drawn)
        second, two = steps["single"](bank, first, one.cache, action, drawn)
        idle = np.asarray(now.over | first.over)
        ended += int((np.asarray(first.over) & ~np.asarray(now.over)).sum())
        expected = np.asarray(one.reward) + np.where(idle, 0.0, two.reward)
        running = ~np.asarray(now.over)
        np.testing.assert_allclose(result.reward[running], expected[running], atol=1e-5)
        np.testing.assert_array_equal(
            result.terminated | result.truncated, first.over | (second.over & ~idle)
        )
        motion = np.where(
            idle[:, None], first.state.context.history[:, -1], second.state.context.history[:, -1]
        )
        np.testing.assert_allclose(held.state.context.history[:, -1], motion, atol=1e-4)
        now = held
    assert ended > 3


@pytest.mark.slow
def test_expert_of_the_route_space_is_cloned_by_its_offset(bank):
    """What the clone requests is executed as the expert's action, which the next state remembers."""
    route = Driving(Simulator(Task(actions=ROUTE, observation=OBSERVATION, metrics="none")), LATEST)
    physical = replace(route, simulator=Simulator(replace(route.task, actions=PHYSICAL)))
    key = jax.random.key(0)
    (observations, offset, clipped), (_, action, _) = (
        jax.jit(each.demonstrations, static_argnums=2)(bank, key, 32) for each in (route, physical)
    )
    index, step = (observations["moment"][:, 0, column].astype(int) for column in (0, 1))
    contexts = jax.vmap(route._logged_context, (None, 0, 0))(bank, index, step)
    executed = jax.vmap(lambda context, a: execute(ROUTE, bank, context, a))(contexts, offset)
    unclipped = ~np.asarray(clipped)
    assert unclipped.sum() > 20
    np.testing.assert_allclose(executed[unclipped], action[unclipped], atol=1e-3)
