"""Replay: what is sampled is what happened, whatever was written over, and every step as often as any other."""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from drivax.errors import UsageError
from drivax.learning.driving import Driving
from drivax.learning.environment import Environments, Outcome, collect
from drivax.learning.replay import Replay, ReplayBuffer, ReplayConfig
from drivax.simulator.simulator import Simulator
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from drivax.testing import worlds

COUNT = 3


@dataclass(frozen=True)
class Counting:
    """Every state is a different one: environment, episode, step. Episodes have 1 to 5 steps; even ones terminate."""

    action_size: int = 1
    levels: None = None

    def shapes(self, data):
        return {"place": (3,), "place_mask": ()}

    def start(self, data, key, count):
        state = jnp.stack([jnp.arange(count), jnp.zeros(count, int), jnp.zeros(count, int)], axis=-1)
        return Environments(state, jnp.zeros(count, bool), self.observe_all(data, state))

    def stored(self, state):
        return state

    def observe_all(self, data, stored):
        return {"place": stored.astype(jnp.float32), "place_mask": stored[..., 2] > 0}

    observe = observe_all

    def cache(self, data, state):
        return ()

    def draw(self, data, key, count):
        return key

    def step(self, data, now, cache, action, drawn):
        env, episode, step = jnp.moveaxis(now.state, -1, 0)
        moved = jnp.stack([env, episode, step + 1], axis=-1)
        fresh = jnp.stack([env, episode + 1, jnp.zeros_like(step)], axis=-1)
        state = jnp.where(now.over[:, None], fresh, moved)
        over = ~now.over & (state[:, 2] >= 1 + (state[:, 0] + 2 * state[:, 1]) % 5)
        ends = state[:, 1] % 2 == 0
        outcome = Outcome(10.0 * moved[:, 1] + moved[:, 2], over & ends, over & ~ends, (), {})
        return Environments(state, over, self.observe_all(data, state)), outcome


def act(observation, key):
    action = observation["place"][:, 2:] / 10.0
    return action, action, {}


@partial(jax.jit, static_argnames=("unroll", "store"))
def run(environments, unroll, store):
    return collect(Counting(), (), environments, act, jax.random.key(0), unroll, store)[:2]


@partial(jax.jit, static_argnames="buffer")
def add(buffer, replay, rollout):
    return buffer.add(replay, rollout)


def fill(config, steps, unroll):
    """Return a buffer, its contents after ``steps``, and the steps that it should hold, found by plain loops."""
    environment = Counting()
    environments = environment.start((), jax.random.key(0), COUNT)
    buffer = ReplayBuffer(config, environment)
    replay = buffer.init(environments)
    for _ in range(steps // unroll):
        environments, rollout = run(environments, unroll, config.store)
        replay = add(buffer, replay, rollout)
    stored_steps = set()
    for env in range(COUNT):
        row, episode, step = 0, 0, 0
        first = max(0, steps - config.capacity // COUNT)
        while row < steps:
            length = 1 + (env + 2 * episode) % 5
            # A row per step, and one that only begins the next episode; the newest row has no successor.
            if step < length and first <= row < steps - 1:
                stored_steps.add((env, episode, step))
            episode, step = (episode + 1, 0) if step == length else (episode, step + 1)
            row += 1
    return buffer, replay, stored_steps


@partial(jax.jit, static_argnames=("buffer", "count", "n"))
def sample_batch(buffer, replay, count, n=1):
    return buffer.sample((), replay, buffer.draw(replay, jax.random.key(1), (count,)), 0.9, n)


@pytest.mark.parametrize("environments", [1, 6, 16])
def test_drawn_number_counts_the_steps_with_a_successor(environments):
    alive = np.random.default_rng(0).random((9, environments)) < 0.6
    empty = jnp.zeros_like(alive, float)
    is_step = jnp.array(alive)
    replay = Replay((), empty[..., None], empty, is_step, is_step, jnp.int32(4), "state")
    buffer, key = ReplayBuffer(ReplayConfig(), Counting()), jax.random.key(3)
    row, column = jax.jit(buffer.draw, static_argnums=2)(replay, key, (5, 40))
    alive[3] = False  # the newest row
    expected = np.argwhere(alive)[jax.random.randint(key, (5, 40), 0, alive.sum())]
    np.testing.assert_array_equal(np.stack([row, column], axis=-1), expected)


@pytest.mark.parametrize("store", ["state", "observation"])
@pytest.mark.parametrize(("capacity", "steps"), [(60, 12), (60, 20), (60, 24), (37, 48), (60, 84)])
def test_samples_are_collected_steps(store, capacity, steps):
    """Before the ring is full, exactly full, and after it was written over once and four times."""
    buffer, replay, stored_steps = fill(ReplayConfig(capacity, store), steps, 4)
    batch = sample_batch(buffer, replay, 4000)
    before, after = (
        np.asarray(part["place"]).astype(int) for part in (batch.observation, batch.next_observation)
    )
    assert {tuple(row) for row in before.tolist()} == stored_steps
    # What a step led to is the next state of the same episode, final states included.
    np.testing.assert_array_equal(after, before + np.array([0, 0, 1]))
    final = after[:, 2] == 1 + (after[:, 0] + 2 * after[:, 1]) % 5
    assert final.any() and not final.all()
    np.testing.assert_array_equal(batch.terminated, final & (after[:, 1] % 2 == 0))
    np.testing.assert_allclose(batch.reward, 10.0 * before[:, 1] + after[:, 2])
    np.testing.assert_allclose(batch.action[:, 0], before[:, 2] / 10.0, rtol=1e-6)
    assert batch.observation["place_mask"].dtype == bool


@pytest.mark.parametrize("store", ["state", "observation"])
@pytest.mark.parametrize("steps", [12, 20, 24, 84])
def test_n_step_returns_against_plain_loops(store, steps):
    """Of three steps: whole, cut short by either end of an episode, and by the newest row."""
    buffer, replay, stored_steps = fill(ReplayConfig(60, store), steps, 4)
    batch = sample_batch(buffer, replay, 2000, n=3)
    before, after = (
        np.asarray(part["place"]).astype(int) for part in (batch.observation, batch.next_observation)
    )
    assert {tuple(state) for state in before.tolist()} == stored_steps
    lengths = set()
    for number, (env, episode, first) in enumerate(before.tolist()):
        last, reward, length = first, 0.0, 1 + (env + 2 * episode) % 5
        while last < first + 3 and (env, episode, last) in stored_steps:
            reward += 0.9 ** (last - first) * (10.0 * episode + last + 1)
            last += 1
        ended = last == length
        lengths.add((last - first, ended, episode % 2))
        assert after[number].tolist() == [env, episode, last]
        assert float(batch.reward[number]) == pytest.approx(reward, rel=1e-6)
        assert float(batch.discount[number]) == pytest.approx(0.9 ** (last - first), rel=1e-6)
        assert bool(batch.terminated[number]) == (ended and episode % 2 == 0)
    # Whole windows, and those that a termination or a truncation cuts short.
    assert {(3, False, 0), (1, True, 0), (1, True, 1), (2, True, 1)} <= lengths


def test_steps_are_sampled_uniformly():
    buffer, replay, stored_steps = fill(ReplayConfig(60), 84, 4)
    batch = np.asarray(sample_batch(buffer, replay, 20_000).observation["place"]).astype(int)
    counts = np.unique(batch, axis=0, return_counts=True)[1]
    assert len(counts) == len(stored_steps)
    assert stats.chisquare(counts).pvalue > 0.01
    # The oracle sees a bias: one of two environments twice as often fails it.
    assert stats.chisquare(np.concatenate([counts, 2 * counts])).pvalue < 1e-9


def test_rollouts_that_do_not_fit_are_refused():
    with pytest.raises(UsageError, match=r"capacity to 6 or more"):
        ReplayConfig(capacity=5).rows(3)
    buffer, replay, _ = fill(ReplayConfig(12), 4, 4)
    environment = buffer.environment
    environments = environment.start((), jax.random.key(0), COUNT)
    _, rollout, _ = collect(environment, (), environments, act, jax.random.key(0), 5, "state")
    with pytest.raises(UsageError, match="5 steps do not fit a replay buffer of 4 rows"):
        buffer.add(replay, rollout)


@pytest.mark.slow
def test_states_and_observations_give_the_same_batch():
    """In driving: observed when sampled is what the policy saw, within the precision of what is stored."""
    observation = ObservationConfig(agents=2, steps=1, road=0, lights=1, route=3)
    environment = Driving(Simulator(Task(observation=observation, metrics="none")), latest_start=80)

    def drive(observation, key):
        action = jnp.tanh(jax.random.normal(key, (4, 2)))
        return action, action, dict(observation)

    def batches(bank):
        environments = environment.start(bank, jax.random.key(0), 4)
        _, rollout, _ = collect(environment, bank, environments, drive, jax.random.key(1), 16, "state")
        for part in (rollout, replace(rollout, state=None, observation=rollout.extra)):
            store = "state" if part.observation is None else "observation"
            buffer = ReplayBuffer(ReplayConfig(64, store), environment)
            replay = buffer.add(buffer.init(environments), part)
            yield buffer.sample(bank, replay, buffer.draw(replay, jax.random.key(2), (64,)), 0.9)

    exact, stored = jax.jit(lambda bank: tuple(batches(bank)))(worlds.worlds())
    assert bool(exact.terminated.any()) or float(jnp.abs(exact.reward).max()) > 0
    for name in ("action", "reward", "terminated"):
        np.testing.assert_array_equal(getattr(exact, name), getattr(stored, name))
    for one, other in (
        (exact.observation, stored.observation),
        (exact.next_observation, stored.next_observation),
    ):
        assert set(one) == set(other)
        for name in one:
            # bfloat16 keeps 8 bits.
            np.testing.assert_allclose(one[name], other[name], rtol=2**-8, atol=1e-6, err_msg=name)
    moved = np.abs(np.asarray(exact.observation["route"]) - np.asarray(exact.next_observation["route"]))
    assert moved.max() > 1e-3
