"""Self-play: groups of vehicles that one policy drives, against a plain loop of ``step_together``."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.learning.algorithms.ppo import PpoConfig
from drivax.learning.driving import Driving
from drivax.learning.environment import Environment, PastPolicy, collect, past_policy
from drivax.learning.mixture import Mixture
from drivax.learning.self_play import SelfPlay, SelfPlayConfig
from drivax.networks.actor_critic import NetworkConfig
from drivax.networks.encoders import MlpConfig
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.simulator import Simulator
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task
from pendulum import Pendulum

OBSERVATION = ObservationConfig(agents=24, steps=1, road=0, lights=1, route=2)
SIMULATOR = Simulator(Task(observation=OBSERVATION, metrics=("steps", "collision")))
EARLIEST, LATEST, VEHICLES, COUNT, STEPS = 4, 30, 3, 12, 130


@pytest.fixture(scope="module")
def bank(data_of_egos):
    return ScenarioBank.from_scenarios(data_of_egos)


@pytest.fixture(scope="module")
def environment():
    return SelfPlay(SIMULATOR, LATEST, EARLIEST, config=SelfPlayConfig(VEHICLES))


def swerve(key):
    """Actions of all environments: most of them leave the road sooner or later."""
    return jnp.tanh(jnp.asarray([0.3, 0.15]) * jax.random.normal(key, (COUNT, 2)))


@pytest.fixture(scope="module")
def experience(bank, environment):
    """States before every step and after the last, actions, and results of every step."""

    @jax.jit
    def run(bank):
        now = environment.start(bank, jax.random.key(0), COUNT)

        def step(now, key):
            action = swerve(key)
            drawn = environment.draw(bank, key, COUNT)
            after, outcome = environment.step(bank, now, (), action, drawn)
            return after, (now, action, outcome)

        return jax.lax.scan(step, now, jax.random.split(jax.random.key(1), STEPS))

    _, rows = jax.device_get(run(bank))
    return rows


def grouped(leaf):
    """[time, group, vehicle, ...]"""
    return leaf.reshape(STEPS, COUNT // VEHICLES, VEHICLES, *leaf.shape[2:])


def test_self_play_is_an_environment(bank, environment):
    assert isinstance(environment, Environment) and environment.action_size == 2
    with pytest.raises(UsageError, match=r"10 environments of self-play; use a multiple of 3"):
        environment.start(bank, jax.random.key(0), 10)
    with pytest.raises(UsageError, match=r"vehicles is 1; use 2 to 8"):
        SelfPlayConfig(1)
    with pytest.raises(UsageError, match=r"cannot store states of self-play; set replay.store"):
        environment.stored(())


def test_groups_reset_once_when_all_episodes_are_over(bank, experience):
    now, _, outcome = experience
    over, ends = grouped(now.over), grouped(outcome.terminated | outcome.truncated)
    index, step = grouped(now.state.context.index), grouped(now.state.context.step)
    slot = grouped(now.state.context.slot)
    moving = bank.agents.shape[2]
    # A group is in one scenario, at one step; ego is its first vehicle, and no vehicle is there twice.
    assert (index == index[..., :1]).all() and (step == step[..., :1]).all() and (slot[..., 0] == 0).all()
    assert all(
        len({s for s in row if s < moving}) == (row < moving).sum() for row in slot.reshape(-1, VEHICLES)
    )
    resets = over.all(axis=2)[:-1]
    assert resets.sum() >= 4 and len(np.unique(index)) == 3
    np.testing.assert_array_equal(step[1:, :, 0] == step[:-1, :, 0] + 1, ~resets)
    first_steps = step[1:, :, 0][resets]
    assert (first_steps >= EARLIEST).all() and (first_steps <= LATEST).all()
    # An episode that ended stays over until its group starts again; only padding is over from the start.
    expected = np.where(resets[..., None], slot[1:] >= moving, over[:-1] | ends[:-1])
    np.testing.assert_array_equal(over[1:], expected)
    assert not (ends & over).any() and not (grouped(outcome.reward) * over).any()
    # Some drive on after their end.
    assert (over[:-1] & ~resets[..., None] & (slot[:-1] < moving)).sum() > 50


def memory_of(state):
    """What a state remembers of its episode, as numbers."""
    parts = (state.context.history, state.start, state.contacts, state.lights, state.episode)
    return [leaf for leaf in jax.tree.leaves(parts) if leaf.size]


def test_groups_step_as_a_plain_loop_of_step_together(bank, environment, experience):
    now, action, outcome = experience
    over, slots = grouped(now.over), grouped(now.state.context.slot)
    index, step = grouped(now.state.context.index), grouped(now.state.context.step)
    starts = [(0, group) for group in range(COUNT // VEHICLES)]
    starts += [(time + 1, group) for time, group in np.argwhere(over.all(axis=2)[:-1])]
    reset, one = jax.jit(SIMULATOR.reset_together), jax.jit(SIMULATOR.step_together)
    observe = jax.jit(SIMULATOR.observe_together)
    reward, memory = grouped(outcome.reward), jax.tree.map(grouped, memory_of(now.state))
    observations = {name: grouped(value) for name, value in now.observation.items()}
    for first, group in starts:
        states = reset(bank, index[first, group, 0], slots[first, group], step[first, group, 0])
        dead = slots[first, group] >= bank.agents.shape[2]
        for time in range(first, STEPS):
            remembered = jax.tree.map(lambda leaf, at=(time, group): leaf[at], memory)
            same = partial(np.testing.assert_allclose, atol=1e-3)
            jax.tree.map(same, jax.device_get(memory_of(states)), remembered)
            observation = observe(bank, states)
            for name, value in observations.items():
                np.testing.assert_allclose(observation[name], value[time, group], atol=1e-3, err_msg=name)
            np.testing.assert_array_equal(dead, over[time, group])
            if dead.all():
                break
            states, result = one(bank, states, grouped(action)[time, group], dead)
            np.testing.assert_allclose(result.reward, reward[time, group], atol=1e-3)
            dead = dead | np.asarray(result.terminated | result.truncated)


def test_vehicles_of_a_group_see_each_other_where_they_drive(bank, experience):
    """Positions in the observation against a rotation by hand, of vehicles that left their log."""
    now, _, _ = experience
    rows, mask = grouped(now.observation["agents"]), grouped(now.observation["agents_mask"])
    history, slot = grouped(now.state.context.history), grouped(now.state.context.slot)
    step, index = (grouped(getattr(now.state.context, name)) for name in ("step", "index"))
    moving, compared, off_log = bank.agents.shape[2], 0, 0.0
    for time in range(0, STEPS, 5):
        for group in range(COUNT // VEHICLES):
            x, y, heading = history[time, group, :, -1, :3].T
            for me, other in ((0, 1), (1, 0), (1, 2), (2, 1)):
                if max(slot[time, group, [me, other]]) >= moving:
                    continue
                dx, dy = x[other] - x[me], y[other] - y[me]
                cos, sin = np.cos(heading[me]), np.sin(heading[me])
                relative = np.array([cos * dx + sin * dy, cos * dy - sin * dx])
                if np.abs(relative).max() > 40.0:
                    continue
                positions = rows[time, group, me][..., -1, :2][mask[time, group, me][..., -1] > 0] * 50.0
                assert np.abs(positions - relative).max(axis=-1).min() < 0.05
                logged = bank.agents[
                    index[time, group, 0], step[time, group, 0], slot[time, group, other], :2
                ]
                off_log = max(off_log, float(np.hypot(*(np.array([x[other], y[other]]) - logged))))
                compared += 1
    assert compared > 50 and off_log > 5.0


@pytest.mark.slow
def test_padding_is_never_alive(bank):
    """Two egos in groups of four: half of the rows are dead, and nothing in them is infinite or missing."""
    bank = replace(bank, egos=bank.egos.at[:, 2:].set(-1))
    environment = SelfPlay(SIMULATOR)

    def actor(observation, key):
        return jnp.zeros((8, 2)), jnp.zeros((8, 2)), {}

    environments = jax.jit(environment.start, static_argnums=2)(bank, jax.random.key(0), 8)
    run = jax.jit(partial(collect, environment, actor=actor, key=jax.random.key(1), steps=90))
    _, rollout, totals = run(bank, environments)
    alive = np.asarray(rollout.alive).reshape(90, 2, 4)
    assert not alive[:, :, 2:].any() and alive[:, :, :2].sum() == totals["steps"] > 50
    ends = np.asarray(rollout.terminated | rollout.truncated)
    assert totals["episodes"] == totals["steps/n"] == ends.sum() >= 4
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(rollout.observation))


@pytest.mark.slow
def test_every_vehicle_keeps_the_schedule_of_its_own_route(bank):
    """As logged, each is on its route and neither late nor early; on ego's route further egos would be."""
    task = Task(
        observation=OBSERVATION, rewards=RewardConfig(preset="pace"), metrics=("route_deviation_mean",)
    )
    environment = SelfPlay(Simulator(task), LATEST, EARLIEST)
    now = jax.jit(environment.start, static_argnums=2)(bank, jax.random.key(0), 32)
    facts, context = jax.device_get((now.state.facts, now.state.context))
    further = (context.slot > 0) & ~np.asarray(now.over)
    assert further.sum() > 10 and np.isin(context.slot[further], np.asarray(bank.egos)).all()
    assert len({tuple(row) for row in context.slot.reshape(8, 4)}) > 3
    driven = ~np.asarray(now.over)
    assert facts.late_m[driven].max() < 0.5 and facts.early_m[driven].max() < 0.5
    assert facts.route_deviation_m[driven].max() < 3.0
    np.testing.assert_array_equal(facts.routed[driven], np.asarray(bank.on_lanes)[context.route[driven]])


def test_scenarios_without_further_egos_are_refused(data):
    words = r"self_play.vehicles is 4, but the scenarios have 1 with a route; generate or convert them with --egos 8"
    with pytest.raises(UsageError, match=words):
        SelfPlay(SIMULATOR).start(ScenarioBank.from_scenarios(data), jax.random.key(0), 4)


def test_past_policy_drives_all_but_ego_of_its_groups(environment):
    half = replace(environment, config=SelfPlayConfig(VEHICLES, past=0.5, refresh=7))
    assert half.past(COUNT).environments.tolist() == [1, 2, 4, 5] and half.past(COUNT).refresh == 7
    assert past_policy(half, COUNT) is not None and past_policy(environment, COUNT) is None
    log = Driving(SIMULATOR)
    mixture = Mixture((("log", log), ("self", half), ("own", log)), (0.25, 0.5, 0.25))
    assert mixture.sizes(24) == (6, 12, 6)
    assert past_policy(mixture, 24).environments.tolist() == [7, 8, 10, 11]
    assert past_policy(Mixture((("log", log), ("own", log)), (0.5, 0.5)), 24) is past_policy(log, 24) is None
    with pytest.raises(UsageError, match=r"self_play.past is 2, self_play.refresh 50; use a share"):
        SelfPlayConfig(past=2.0)
    with pytest.raises(UsageError, match=r"self_play.vehicles is 9; use 2 to 8"):
        SelfPlayConfig(vehicles=9)
    with pytest.raises(UsageError, match=r"self_play.past is 0.1 of 4 groups: none; raise it"):
        replace(environment, config=SelfPlayConfig(VEHICLES, past=0.1)).past(COUNT)


class WithPast(Pendulum):
    """Four pendulums, of which an older copy of the policy swings two."""

    def past(self, count):
        return PastPolicy(np.array([1, 3]), 2)


def test_ppo_acts_with_the_past_policy_and_learns_nothing_of_it():
    config = PpoConfig(
        network=NetworkConfig(encoder=MlpConfig(hidden=(8,)), head=(8,)), environments=4, unroll=8,
        epochs=1, minibatches=2, learning_rate=0.1,
    )  # fmt: skip
    learner = config.build(WithPast(), None, 8)
    iterate, states = (
        jax.jit(partial(learner.iterate, None)),
        [jax.jit(learner.init)(None, jax.random.key(0))],
    )
    for _ in range(4):
        states.append(iterate(states[-1])[0])

    def same(one, other):
        return all(jax.tree.leaves(jax.tree.map(np.array_equal, one, other)))

    # Copies after iterations 2 and 4.
    origin = [0, 0, 2, 2, 4]
    assert all(
        same(state.past, states[number].parameters) for state, number in zip(states, origin, strict=True)
    )
    state, observations = states[3], states[3].environments.observation
    assert not same(state.past, state.parameters)
    act = jax.jit(learner.sample_action)
    mixed, current, older = (
        act(replace(state, parameters=now, past=before), observations, jax.random.key(1)).action
        for now, before in ((state.parameters, state.past), (state.parameters,) * 2, (state.past,) * 2)
    )
    np.testing.assert_array_equal(mixed[0::2], current[0::2])
    np.testing.assert_array_equal(mixed[1::2], older[1::2])
    assert not np.isclose(mixed[1::2], current[1::2]).any()
    # What happened to the older copy changes no update.
    _, rollout, _ = jax.jit(
        lambda state: collect(
            learner.environment, None, state.environments, partial(learner.sample_action, state),
            learner.rollout_key(state), 8,
        )
    )(state)  # fmt: skip
    update = jax.jit(partial(learner.update, None))
    updated, other, changed = (
        update(state, replace(rollout, reward=rollout.reward.at[:, column].add(5.0)))[0].parameters
        for column in (jnp.array([], int), jnp.array([1, 3]), jnp.array([0]))
    )
    assert same(updated, other) and not same(updated, changed)


@pytest.mark.slow
def test_held_decision_of_a_group_takes_its_steps(bank, environment):
    """Two steps of one action equal two single steps, of vehicles that drive on after their end, too."""
    double = replace(environment, simulator=replace(SIMULATOR, task=replace(SIMULATOR.task, hold=2)))
    steps = {name: jax.jit(each.step) for name, each in (("single", environment), ("double", double))}
    draw = jax.jit(environment.draw, static_argnums=2)
    now, waits = jax.jit(environment.start, static_argnums=2)(bank, jax.random.key(0), COUNT), 0
    for number in range(60):
        action, drawn = swerve(jax.random.key(number)), draw(bank, jax.random.key(number), COUNT)
        held, result = steps["double"](bank, now, (), action, drawn)
        first, one = steps["single"](bank, now, (), action, drawn)
        second, two = steps["single"](bank, first, (), action, drawn)
        # A group that starts, or ends within the decision, takes no second step.
        groups = (np.asarray(each.over).reshape(-1, VEHICLES).all(axis=1) for each in (now, first))
        idle = np.repeat(np.logical_or(*groups), VEHICLES)
        np.testing.assert_array_equal(held.over, np.where(idle, first.over, second.over))
        expected = np.asarray(one.reward) + np.where(idle, 0.0, two.reward)
        alive = ~np.asarray(now.over)
        np.testing.assert_allclose(result.reward[alive], expected[alive], atol=1e-4)
        # Metrics end with the episode, not with the decision.
        assert not (idle & np.asarray(two.terminated | two.truncated)).any()
        for name in ("steps", "steps/n"):
            assert result.totals[name] == one.totals[name] + two.totals[name]
        motions = [each.state.context.history[:, -1] for each in (held, first, second)]
        expected = np.where(idle[:, None], motions[1], motions[2])
        np.testing.assert_allclose(motions[0], expected, atol=1e-3)
        waits += int((np.asarray(now.over) & ~idle).sum())
        now = held
    assert waits > 20
