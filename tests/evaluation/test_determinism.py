"""The same seed gives the same bits; batch size, neighbours and automatic resets do not change episodes.

Bits are equal where one compiled program runs. Programs of other batch sizes round differently (vectorised and scalar
tails), so between them truths and counts are equal and numbers agree to rounding. The quick run compares single steps
(``tests/simulator/test_simulator.py``).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.evaluation.rollout import drive, evaluation_task
from drivax.metrics.episode import episode_metrics
from drivax.planners.simple import RandomActions
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.simulator.simulator import Simulator
from drivax.synthetic.world import generate_recording
from drivax.tasks.task import Task

COUNT, LATE = 6, 60
#: Metrics of each kind: booleans, ratios, means, filters over the history, sums.
METRICS = ("accuracy", "offroad", "progress_ratio", "ade", "max_jerk", "distance")


@pytest.fixture(scope="module")
def world():
    return ScenarioBank.from_scenarios([assemble(generate_recording(23, i)) for i in range(COUNT)])


def episodes(simulator, bank, rows, **options):
    keys = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(4), jnp.asarray(rows))
    return drive(simulator, RandomActions(), bank, jnp.asarray(rows), keys, **options)


def same_bits(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


def same_but_rounding(one, other):
    def same(a, b):
        if np.asarray(a).dtype.kind == "f":
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)
        else:
            np.testing.assert_array_equal(a, b)

    jax.tree.map(same, one, other)


def check_batches(simulator, bank):
    rows = np.arange(COUNT)
    whole = episodes(simulator, bank, rows, start_step=LATE)
    same_bits(whole, episodes(simulator, bank, rows, start_step=LATE))
    backwards = episodes(simulator, bank, rows[::-1], start_step=LATE)
    same_bits(whole, jax.tree.map(lambda leaf: leaf[::-1], backwards))
    pairs = [episodes(simulator, bank, rows[i : i + 2], start_step=LATE) for i in range(0, COUNT, 2)]
    same_but_rounding(whole, jax.tree.map(lambda *leaf: np.concatenate(leaf), *pairs))


@pytest.mark.slow
def test_episodes_do_not_depend_on_batch_size_or_neighbours(world):
    check_batches(Simulator(Task(metrics=METRICS, to_the_end=True)), world)


@pytest.mark.slow
def test_metrics_do_not_depend_on_batch_size_or_neighbours(world):
    check_batches(Simulator(evaluation_task(Task())), world)


@pytest.mark.slow
def test_automatic_resets_change_no_episode(world):
    """Three environments run six scenarios; each episode equals a separate run."""
    simulator = Simulator(Task(metrics=METRICS))

    def action(context):
        # Depends only on scenario and step; some episodes leave the road.
        phase = 1.7 * context.index + 0.4 * context.step
        return 0.5 * jnp.stack([jnp.sin(phase), jnp.cos(1.3 * phase)])

    @jax.jit
    def step(bank, states):
        def one(state):
            after, transition = simulator.step(bank, state, action(state.context))
            return after, transition.terminated | transition.truncated, episode_metrics(bank, after)

        return jax.vmap(one)(states)

    @jax.jit
    def step_or_reset(bank, states, over, next_rows):
        def one(state, over, row):
            start = simulator.new_episode(bank, row, LATE)
            after, transition = simulator.step_or_reset(bank, state, action(state.context), over, start)
            return after, transition.terminated | transition.truncated, episode_metrics(bank, after)

        return jax.vmap(one)(states, over, next_rows)

    begin = jax.jit(jax.vmap(lambda bank, row: simulator.reset(bank, row, LATE), in_axes=(None, 0)))
    expected, states, live = {}, begin(world, jnp.arange(COUNT)), set(range(COUNT))
    while live:
        states, done, metrics = step(world, states)
        for row in [row for row in live if done[row]]:
            expected[row] = jax.tree.map(lambda leaf, row=row: np.asarray(leaf[row]), (states, metrics))
            live.remove(row)
    result, over, rows = {}, jnp.zeros(3, bool), np.arange(3)
    states = begin(world, jnp.arange(COUNT))
    states = jax.tree.map(lambda leaf: leaf[:3], states)
    while len(result) < COUNT:
        rows = np.where(over, rows + 3, rows) % COUNT
        states, over, metrics = step_or_reset(world, states, over, jnp.asarray(rows))
        for environment in np.flatnonzero(over):
            row = int(states.context.index[environment])
            assert row == rows[environment]
            result[row] = jax.tree.map(lambda leaf, at=environment: np.asarray(leaf[at]), (states, metrics))
    assert len({int(state.context.step) for state, _ in expected.values()}) > 1, "some end early"
    for row in range(COUNT):
        same_but_rounding(expected[row], result[row])
