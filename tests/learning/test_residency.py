"""Training with some of the scenarios on the device: which ones, what they hold, and that a run can be resumed."""

import shutil
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.learning.algorithms.behaviour_cloning import BcConfig, Cloning
from drivax.learning.algorithms.cql import CqlConfig
from drivax.learning.algorithms.warm_start import BcPpoConfig, WarmStart
from drivax.learning.config import Residency, TrainConfig
from drivax.learning.environment import cumulative_probability, draw_positions
from drivax.learning.loop import train
from drivax.learning.program import Program, Seeds
from drivax.learning.residency import Residents, Rotation
from drivax.learning.training_set import Source
from drivax.scenario.store import Subset
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.sinks import read_rows
from tiny_algorithms import PPO, SAC, TINY

TASK = Task(observation=ObservationConfig(agents=2, steps=1, road=0, lights=1, route=2), metrics="none")
#: An episode takes at most 92 steps, 23 iterations of 4 steps each, so two blocks are about to leave.
RESIDENCY = Residency(scenarios=5, block=1, every=24)
ITERATIONS = 100
WARM = WarmStart(iterations=97, cloning=Cloning(batch=4, updates=1))
BC = BcConfig(batch=8, updates=1, network=TINY)
OFFLINE = CqlConfig(network=TINY, batch=8, updates=2)


def config_of(algorithm, **changes):
    steps = ITERATIONS * algorithm.steps_per_iteration
    config = TrainConfig(task=TASK, algorithm=algorithm, residency=RESIDENCY, total_steps=steps, seed=2)
    return replace(config, devices=1, checkpoint_every=30, keep=9, **changes)


def prepare(config, scenarios, weights=None):
    """Return the residents of a run, its program and its initial state."""
    source = Source.of(config, scenarios, weights, (), ())
    residents = Residents.of(source, None)
    bank = residents.load(0)
    learner = config.algorithm.build(source.environment, bank, config.iterations)
    program = Program(Seeds(learner, (config.seed,)), residents.complete(bank, 0))
    return residents, program, residents.resume(program, program.initial_state(), 0, ())


def run(residents, program, state, iterations):
    """Yield the environments and the first row to leave before every exchange, and the state after it."""
    for iteration in range(1, iterations + 1):
        state, _, _ = program.step(state)
        before = jax.tree.map(jnp.copy, state)
        state, logs = residents.exchange(program, state, iteration)
        if logs:
            yield iteration, before, state


def assert_equal(first, second):
    for (path, one), (_, other) in zip(*map(jax.tree.leaves_with_path, (first, second)), strict=True):
        np.testing.assert_array_equal(one, other, err_msg=jax.tree_util.keystr(path))


@pytest.mark.parametrize(("scenarios", "block", "total"), [(6, 2, 7), (12, 3, 40), (8, 4, 9)])
def test_residents_are_those_that_exchanges_bring(scenarios, block, total):
    rotation = Rotation(Residency(scenarios, block), total, seed=3, lead=0)
    rows = rotation.resident(0)
    stream = [*rows]
    for exchange in range(3 * total):
        entering = rotation.entering(exchange)
        first = rotation.first_row(exchange)
        rows[first : first + block] = entering
        stream += [*entering]
        np.testing.assert_array_equal(rows, rotation.resident(exchange + 1))
    # Every pass through the set contains every scenario once, in another order.
    passes = [stream[start : start + total] for start in range(0, len(stream) - total, total)]
    assert all(sorted(numbers) == list(range(total)) for numbers in passes)
    assert passes[0] != passes[1]


@pytest.mark.parametrize(("every", "lead"), [(1, 3), (2, 3), (5, 7), (24, 24)])
def test_no_episode_begins_in_a_block_that_leaves_before_its_end(every, lead):
    rotation = Rotation(Residency(60, 2, every), 100, seed=0, lead=lead)
    for iteration in range(400):
        finished = iteration // every
        cumulative = rotation.chances(finished).astype(np.int64)
        is_drawn = np.diff(cumulative, prepend=0) > 0
        # Exchanges after the iterations in which an episode that begins now may still be under way.
        leaving = [
            after // every - 1 for after in range(iteration + 1, iteration + lead + 1) if after % every == 0
        ]
        for exchange in leaving:
            first = rotation.first_row(exchange)
            assert not is_drawn[first : first + 2].any()
        assert is_drawn.sum() == 60 - 2 * rotation.leaving


def test_positions_are_drawn_by_their_weights():
    weights = np.array([0.0, 1.0, 0.0, 3.0, 4.0, 0.0])
    positions = draw_positions(jnp.asarray(cumulative_probability(weights)), jax.random.key(0), (20_000,))
    share = np.bincount(np.asarray(positions), minlength=6) / 20_000
    np.testing.assert_allclose(share, weights / 8, atol=0.015)
    assert (share[weights == 0] == 0).all()


@pytest.mark.parametrize("traffic", ["log", pytest.param("idm", marks=pytest.mark.slow)])
def test_episodes_under_way_keep_their_scenario(scenarios, traffic):
    residents, program, state = prepare(config_of(PPO, traffic=traffic), scenarios)
    exchanged = 0
    for iteration, before, after in run(residents, program, state, ITERATIONS):
        row = residents.rotation.first_row(iteration // RESIDENCY.every - 1)
        here = before.environments.state.context.index == row
        assert not (here & ~before.environments.over).any()
        assert_equal(before.environments.state, after.environments.state)
        # The bank is that of the scenarios that are now resident.
        assert_equal(program.data, residents.load(iteration))
        exchanged += 1
    residents.close()
    assert exchanged == 4


@pytest.mark.slow
def test_environments_that_rest_abandon_episodes_whose_scenario_leaves(scenarios):
    config = config_of(BcPpoConfig(warm_start=WARM, ppo=PPO))
    residents, program, state = prepare(config, scenarios)
    abandoned = 0
    for iteration, before, after in run(residents, program, state, 96):
        row = residents.rotation.first_row(iteration // RESIDENCY.every - 1)
        stale = before.learner.environments.state.context.index == row
        np.testing.assert_array_equal(
            after.learner.environments.over, before.learner.environments.over | stale
        )
        abandoned += int(stale.sum())
    residents.close()
    assert abandoned > 0


def test_replay_forgets_states_of_scenarios_that_leave(scenarios):
    config = config_of(replace(SAC, replay=replace(SAC.replay, capacity=2_000)))
    residents, program, state = prepare(config, scenarios)
    forgotten = 0
    for iteration, before, after in run(residents, program, state, 96):
        row = residents.rotation.first_row(iteration // RESIDENCY.every - 1)
        stale = before.replay.stored.index == row
        np.testing.assert_array_equal(after.replay.alive, before.replay.alive & ~stale)
        forgotten += int((before.replay.alive & stale).sum())
    residents.close()
    assert forgotten > 0


@pytest.mark.parametrize(
    ("algorithm", "weighted"),
    [
        pytest.param(OFFLINE, False, marks=pytest.mark.slow),
        pytest.param(OFFLINE, True, marks=pytest.mark.slow),
        (BC, False),
        (BC, True),
    ],
    ids=["cql", "weighted cql", "bc", "weighted bc"],
)
def test_logged_steps_and_weights_are_those_of_residents(scenarios, algorithm, weighted):
    weights = np.random.default_rng(0).random((8, scenarios.capacity.steps)) if weighted else None
    config = config_of(algorithm, residency=replace(RESIDENCY, every=2))
    residents, program, state = prepare(config, scenarios, weights)
    for _ in run(residents, program, state, 6):
        pass
    numbers = residents.rotation.resident(3)
    chosen = None if weights is None else weights[numbers]
    alone = Source.of(config, Subset(scenarios, numbers.tolist()), chosen, (), ())
    assert_equal(program.data, alone.complete(residents.load(6)))
    residents.close()


@pytest.mark.parametrize("resident", [False, True], ids=["all resident", "some resident"])
def test_episodes_begin_in_scenarios_by_weight(scenarios, resident):
    weights = np.zeros((8, scenarios.capacity.steps))
    weights[1:6, 10:12] = [[1.0, 2.0], [0.5, 0.5], [4.0, 0.0], [1.0, 1.0], [0.0, 0.0]]
    weights[6:, 20] = 0.2, 0.0
    config = replace(config_of(PPO), residency=RESIDENCY if resident else None)
    residents = Residents.of(Source.of(config, scenarios, weights, (), ()), None)
    bank = residents.load()
    data = residents.complete(bank)
    numbers, closed = np.arange(8), np.zeros(8, bool)
    if resident:
        numbers = residents.rotation.resident(0)
        closed = np.arange(5) < residents.rotation.leaving
    expected = np.where(closed, 0.0, weights.sum(axis=1)[numbers])
    assert expected.any()
    chance = np.diff(np.asarray(data.chances, np.int64), prepend=0) / (2**32 - 1)
    np.testing.assert_allclose(chance, expected / expected.sum(), atol=1e-9)
    learner = config.algorithm.build(residents.source.environment, bank, config.iterations)
    state = learner.init(data, jax.random.key(0))
    assert set(np.asarray(state.environments.state.context.index)) <= set(np.flatnonzero(expected))
    effective = weights.sum() ** 2 / (weights.sum(axis=1) ** 2).sum()
    assert f"effective sample of {effective:.0f} of 8 scenarios" in residents.notices(data)[-1]
    residents.close()


def test_a_resumed_run_equals_an_uninterrupted_one(scenarios, tmp_path):
    config = config_of(PPO)
    whole = train(config, scenarios, tmp_path / "whole", validation=None)
    shutil.copytree(whole.path, tmp_path / "killed")
    Checkpoints(tmp_path / "killed" / "checkpoints").drop_after(60 * PPO.steps_per_iteration)
    resumed = train(config, scenarios, tmp_path / "killed", validation=None, resume=True)
    rows = [read_rows(folder.metrics) for folder in (whole, resumed)]
    timed = {"steps_per_second", "residency/waited_s", "residency/exchange_s"}
    one, other = ([{n: v for n, v in row.items() if n not in timed} for row in table] for table in rows)
    assert one == other


def test_memory_that_holds_all_scenarios_changes_nothing(scenarios, tmp_path):
    config = replace(config_of(BC), residency=None, total_steps=160)
    lines = []
    runs = [
        train(config, scenarios, tmp_path / name, validation=None, memory=memory, log=lines.append)
        for name, memory in (("all", None), ("fits", 10**9))
    ]
    assert runs[0].config(TrainConfig) == runs[1].config(TrainConfig)
    losses = [
        [{name: row[name] for name in row if name.startswith("loss/")} for row in read_rows(run.metrics)]
        for run in runs
    ]
    assert losses[0] == losses[1]
    assert not any("residency" in line for line in lines)


def test_memory_is_refused_where_it_cannot_work(scenarios, tmp_path):
    config = replace(config_of(PPO), residency=None)
    with pytest.raises(UsageError, match=r"resident scenarios are too few.*raise --memory"):
        train(config, scenarios, tmp_path / "few", validation=None, memory=600_000)
    with pytest.raises(UsageError, match=r"1 kB hold 0 scenarios of .*; raise --memory"):
        train(config, scenarios, tmp_path / "few", validation=None, memory=1_000)
    with pytest.raises(UsageError, match="both --memory and residency; leave out one of them"):
        train(config_of(PPO), scenarios, tmp_path / "few", validation=None, memory=10**6)
    with pytest.raises(UsageError, match="trained policies in the traffic need all scenarios on the device"):
        train(replace(config, traffic="zoo:bc"), scenarios, tmp_path / "few", validation=None, memory=10**6)
    assert not (tmp_path / "few").exists()
    with pytest.raises(UsageError, match=r"residency.scenarios is 5, residency.block 2; use a multiple of 2"):
        Residency(5, 2)
