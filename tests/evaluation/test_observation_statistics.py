"""Statistics of observations against NumPy and SciPy, and in episodes with known results."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from drivax.errors import UsageError
from drivax.evaluation.observation_statistics import (
    collision_correlation,
    column_statistics,
    importances,
    observation_statistics,
    sample_states,
)
from drivax.evaluation.rollout import evaluation_task
from drivax.evaluation.runner import evaluate
from drivax.planners.planner import Memoryless
from drivax.planners.simple import Expert
from drivax.scenario.record import record, static
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.reactive import IdmTraffic
from drivax.tasks.actions import Physical, Published
from drivax.tasks.features import Features
from drivax.tasks.observations import ObservationConfig, OwnGroup
from drivax.tasks.task import Task
from scenes import bank_of, car, straight_road

STARE_M = 30.0


def faulty(bank, context, frames):
    """A feature that is not finite at steps 20 and 50 of the first scenario."""
    broken = (context.index == 0) & ((context.step == 20) | (context.step == 50))
    return jnp.where(broken, jnp.nan, context.step / 100.0)[None]


@record
class PositionPlanner(Memoryless):
    """A planner with small actions that depend only on the position of the first agent."""

    actions: Any = static(default=Physical())
    name: str = static(default="position")
    replays: bool = static(default=False)

    def act(self, carry, bank, state, situation, observation, key):
        return jnp.stack([1e-3 * observation["agents"][0, -1, 0], jnp.zeros(())]), carry


TASK = Task(
    observation=ObservationConfig(agents=2, steps=2, road=0, lights=1, route=1, own=(OwnGroup(faulty),))
)


@pytest.fixture(scope="module")
def bank():
    """One scenario in which ego at 9 m/s reaches a standing car, and two without agents in its lane."""
    standing = car(STARE_M, 0, 0, 0)
    scenes = [[car(0, 0, 0, 9), standing], *([car(0, 0, 0, 9), car(-20 - k, 3.7, 0, 5)] for k in range(2))]
    return bank_of(*(replace(straight_road(cars), scenario_id=f"s{k}") for k, cars in enumerate(scenes)))


@pytest.fixture(scope="module")
def summary(bank):
    return observation_statistics(PositionPlanner(), bank, TASK, permute=True)


def column(result, group, name):
    (feature,) = [feature for feature in result.features if (feature.group, feature.name) == (group, name)]
    return feature


@pytest.mark.slow
def test_states_are_sampled_before_and_after_the_collision(bank):
    samples = sample_states(Simulator(evaluation_task(TASK)), PositionPlanner(), bank, every=10)
    assert samples.state.context.step.tolist() == [[*range(10, 81, 10)]] * 3
    # 30 m less a car's length at 9 m/s: they touch after 2.8 s, at step 38.
    assert samples.has_collided.tolist() == [
        [step > 38 for step in range(10, 81, 10)],
        [False] * 8,
        [False] * 8,
    ]
    assert samples.collides.tolist() == [True, False, False]


@pytest.mark.slow
def test_statistics_of_a_column_are_of_its_valid_rows(summary):
    assert (summary.planner, summary.episodes, summary.collisions) == ("position", 3, 1)
    assert (summary.states, summary.permuted) == (24, 24)
    length = column(summary, "agents", "length")
    # One other agent, at both steps of each of 24 states.
    assert length.count == 48 and length.broken == 0
    np.testing.assert_allclose(
        [length.mean, length.std, length.low, length.high], [0.96, 0, 0.96, 0.96], atol=1e-6
    )
    assert column(summary, "lights", "on_route").count == 0 and np.isnan(
        column(summary, "lights", "on_route").mean
    )


@pytest.mark.slow
def test_entries_that_are_not_finite_are_counted(summary):
    feature = column(summary, "faulty", "0")
    assert (feature.broken, summary.broken, feature.count) == (2, 2, 22)
    steps = np.array([*range(10, 81, 10)] * 3)[[k for k in range(24) if k not in (1, 4)]] / 100
    np.testing.assert_allclose(
        [feature.mean, feature.std, feature.low, feature.high],
        [steps.mean(), steps.std(), 0.1, 0.8],
        rtol=1e-5,
    )
    rows = summary.as_dict()["features"]
    assert [row["broken"] for row in rows if row["group"] == "faulty"] == [2]
    (light,) = [row for row in rows if (row["group"], row["name"]) == ("lights", "on_route")]
    assert light["mean"] is None and light["count"] == 0


@pytest.mark.slow
def test_only_features_that_the_planner_uses_are_important(summary):
    result = {(feature.group, feature.name): feature.importance for feature in summary.features}
    assert result.pop(("agents", "position x")) > 0.5 and summary.groups["agents"] > 0.5
    assert set(result.values()) == {0.0}
    assert {value for name, value in summary.groups.items() if name != "agents"} == {0.0}


@pytest.mark.slow
def test_other_agents_move_by_the_traffic_model():
    """A car approaches from behind at 12 m/s: the log drives through ego, IDM brakes."""
    bank = bank_of(straight_road([car(0, 0, 0, 2), car(-40, 0, 0, 12)]))
    log, idm = (
        column(
            observation_statistics(PositionPlanner(), bank, TASK, permute=False, traffic=traffic),
            "agents",
            "velocity ahead",
        )
        for traffic in (None, IdmTraffic())
    )
    assert log.low == pytest.approx(12 / 15, abs=1e-3) and idm.low < 4 / 15


def test_planner_of_another_action_space_is_refused(bank):
    with pytest.raises(UsageError, match="another action space"):
        observation_statistics(Expert(), bank, replace(TASK, actions=Published()), permute=False)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"every": 0}, "every 0 steps"),
        ({"every": 91}, "every 91 steps; use 1 to 80"),
        ({}, "needs stored scenarios"),
    ],
)
def test_impossible_statistics_are_refused(bank, options, words, monkeypatch):
    if not options:
        monkeypatch.setattr(PositionPlanner, "prepare", lambda self, scenario_of: None, raising=False)
    with pytest.raises(UsageError, match=words):
        observation_statistics(PositionPlanner(), bank, TASK, permute=False, **options)


@record
class AlternatingPlanner(Memoryless):
    """A planner that accelerates at even steps and brakes at odd ones."""

    actions: Any = static(default=Physical())
    name: str = static(default="alternating")
    replays: bool = static(default=False)

    def act(self, carry, bank, state, situation, observation, key):
        return jnp.stack([jnp.where(state.context.step % 2 == 0, 0.5, -0.5), jnp.zeros(())]), carry


@pytest.mark.slow
def test_held_decisions_are_executed_as_in_an_evaluation():
    bank = bank_of(straight_road([car(0, 0, 0, 5)]))
    task = replace(TASK, hold=2)
    speeds = column(
        observation_statistics(AlternatingPlanner(), bank, task, permute=True), "ego", "velocity ahead"
    )
    names = [{"dataset": "d", "scenario_id": "a", "segment": "a"}]
    episodes = evaluate(AlternatingPlanner(), bank, names, task=task).trajectories
    assert speeds.high * 15 == pytest.approx(float(episodes.ego[0, :80:10, 3].max()), abs=1e-3)
    assert episodes.ego[0, 70, 3] > 20


def test_statistics_of_hand_made_observations():
    """Two episodes of three samples with one row that may be masked; the second collides at its last sample."""
    rows = np.arange(12.0).reshape(2, 3, 1, 2)
    mask = np.array([[[True], [True], [False]], [[True], [True], [True]]])
    rows[0, 1, 0, 1], rows[0, 2, 0, 1], rows[1, 0, 0, 1] = np.nan, np.inf, -np.inf
    has_collided, collides = np.array([[False] * 3, [False, False, True]]), np.array([False, True])
    widths = np.linspace(0, 1, 6).reshape(2, 3, 1)
    observation, features = (
        {"own": rows, "own_mask": mask, "ego_static": widths},
        Features(ego_static=("width",)),
    )
    first, second, width = column_statistics(features, observation, has_collided, collides, {("own", 0): 0.5})
    assert (first.group, first.name, width.name) == ("own", "0", "width")
    valid = [0.0, 2.0, 6.0, 8.0, 10.0]
    assert (first.count, first.broken, first.mean, first.low, first.high) == (5, 0, np.mean(valid), 0.0, 10.0)
    assert first.std == pytest.approx(np.std(valid)) and first.importance == 0.5
    assert np.isnan(second.importance)
    # Infinite in a masked row counts as broken, too.
    assert (second.count, second.broken, second.low, second.high) == (3, 3, 1.0, 11.0)
    assert (width.count, width.low, width.high) == (6, 0.0, 1.0)
    # Two episodes are too few; of four, r is that of their means before the collision: 1, 7, 1, 7.
    assert np.isnan(first.collision)
    twice = {name: np.concatenate([values, values]) for name, values in observation.items()}
    again = column_statistics(features, twice, np.tile(has_collided, (2, 1)), np.tile(collides, 2), {})
    assert again[0].collision == pytest.approx(1.0)


def test_correlation_equals_scipy_pointbiserialr():
    rng = np.random.default_rng(5)
    collides = rng.random(40) < 0.4
    values = rng.normal(size=(40, 6, 3)) + 0.8 * collides[:, None, None]
    valid = rng.random(values.shape) < 0.6
    valid[3] = False  # an episode without agents
    values[7, 2, 1] = np.nan
    means = [values[k][valid[k] & np.isfinite(values[k])].mean() for k in range(40) if k != 3]
    expected = stats.pointbiserialr(np.delete(collides, 3), means).statistic
    assert abs(expected) > 0.3
    assert collision_correlation(values, valid, collides) == pytest.approx(expected, abs=1e-9)
    assert np.isnan(collision_correlation(values, valid, np.zeros(40, bool)))
    assert np.isnan(collision_correlation(np.full((40, 2), 0.3), np.ones((40, 2), bool), collides))


def test_importance_of_a_linear_policy_is_known():
    """For a = 3 x + 4 y of independent x, y of variance 1, permuting x changes a by 3 sqrt(2), of its std 5."""
    rng = np.random.default_rng(1)
    count = 4000
    observation = {
        "g": rng.normal(size=(count, 3)).astype(np.float32),
        "h": rng.normal(size=(count, 2)).astype(np.float32),
    }

    def act(observation):
        x, y = observation["g"][:, 0], observation["h"][:, 1]
        return np.stack([3 * x + 4 * y, np.full(count, 0.25)], axis=-1)

    columns, groups = importances(act, observation)
    root2 = np.sqrt(2)
    assert columns[("g", 0)] == pytest.approx(0.6 * root2, rel=0.05) == groups["g"]
    assert columns[("h", 1)] == pytest.approx(0.8 * root2, rel=0.05) == groups["h"]
    assert columns[("g", 1)] == columns[("g", 2)] == columns[("h", 0)] == 0.0
    constant = importances(lambda _: np.ones((count, 2)), observation)[0]
    assert all(np.isnan(value) for value in constant.values())


def test_permutation_keeps_masks_and_moves_only_valid_entries():
    rng = np.random.default_rng(2)
    mask = rng.random((50, 4)) < 0.5
    mask[:, 0] = True
    values = np.where(mask[..., None], rng.normal(size=(50, 4, 2)), 0.0)
    observations = []

    def act(observation):
        observations.append(observation)
        return rng.normal(size=(50, 1))

    importances(act, {"g": values, "g_mask": mask})
    _, whole, first, second = observations
    order = [int(np.flatnonzero((values == row).all(axis=(1, 2)))[0]) for row in whole["g"]]
    assert sorted(order) == list(range(50)) and order != list(range(50))
    np.testing.assert_array_equal(whole["g_mask"], mask[order])
    for number, permuted in enumerate((first, second)):
        np.testing.assert_array_equal(permuted["g_mask"], mask)
        assert not permuted["g"][~mask].any()
        np.testing.assert_array_equal(permuted["g"][..., 1 - number], values[..., 1 - number])
        np.testing.assert_array_equal(np.sort(permuted["g"][mask, number]), np.sort(values[mask, number]))
        assert (permuted["g"][mask, number] != values[mask, number]).mean() > 0.9
