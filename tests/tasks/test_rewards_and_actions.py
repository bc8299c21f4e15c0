"""Reward terms on hand-made facts; action spaces there and back."""

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.planners.simple import logged_motion
from drivax.simulator.simulator import Simulator
from drivax.tasks.actions import PHYSICAL, PUBLISHED
from drivax.tasks.rewards import PRESETS, RewardConfig
from drivax.tasks.task import Task
from quick import quick
from scenes import bank_of, car, straight_road


@pytest.fixture(scope="module")
def measured():
    bank = bank_of(straight_road([car(0, 0, 0, 9)]))
    simulator = Simulator(Task())

    @jax.jit
    def measure(bank):
        state = simulator.reset(bank, 0)
        return state.facts, simulator.situation(bank, state).surroundings

    return measure(bank)


def reward(config, before, now, around):
    return {k: float(v) for k, v in Task(rewards=config).reward(before, now, around).items()}


def test_navigation_by_hand(measured):
    facts, around = measured
    # 0.6 m of progress is half of what 12 m/s gain in one step.
    now = replace(facts, progress_m=facts.progress_m + 0.6)
    terms = reward(RewardConfig(), facts, now, around)
    assert terms["progress"] == pytest.approx(0.1, abs=1e-4)
    assert sum(terms.values()) == pytest.approx(0.1, abs=1e-4)
    crash = replace(now, collision=jnp.asarray(True), offroad=jnp.asarray(True), red_light=jnp.asarray(True))
    assert sum(reward(RewardConfig(), facts, crash, around).values()) == pytest.approx(-2.9, abs=1e-4)
    lost = replace(now, off_route=jnp.asarray(True))
    assert sum(reward(RewardConfig(), facts, lost, around).values()) == pytest.approx(-0.1, abs=1e-4)


def test_behaviour_by_hand(measured):
    facts, around = measured
    now = replace(
        facts, acceleration_mps2=jnp.asarray(-2.025), jerk_mps3=jnp.asarray(0.0),
        lateral_acceleration_mps2=jnp.asarray(0.0), speed_mps=jnp.asarray(13.4 + 2.3),
    )  # fmt: skip
    terms = reward(RewardConfig(preset="behaviour"), facts, now, around)
    assert terms["discomfort"] == pytest.approx(-0.2 * 0.25)
    assert terms["speeding"] == pytest.approx(-0.1)


def test_presets_include_the_previous_preset():
    names = ["safety", "navigation", "behaviour"]
    for less, more in pairwise(names):
        assert PRESETS[less].items() <= PRESETS[more].items()
    assert RewardConfig(preset="safety", progress=0.5).weights() == {**PRESETS["safety"], "progress": 0.5}


@pytest.mark.parametrize("space", [PHYSICAL, PUBLISHED])
def test_action_spaces_invert_and_keep_zero(space):
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)), -1).reshape(-1, 2)
    there_and_back = jax.vmap(lambda action: space.action(jnp.zeros(4), *space.command(action, 4.8), 4.8))
    np.testing.assert_allclose(quick(there_and_back, jnp.asarray(grid, jnp.float32)), grid, atol=1e-5)
    np.testing.assert_array_equal(jnp.stack(space.command(jnp.zeros(2), 4.8)), 0.0)


def test_bounds_of_the_action_spaces():
    assert [float(v) for v in PHYSICAL.command(jnp.array([1.0, 1.0]), 4.8)] == pytest.approx([6.0, 0.3])
    assert [float(v) for v in PHYSICAL.command(jnp.array([-9.0, -9.0]), 4.8)] == pytest.approx([-6.0, -0.3])
    acceleration, curvature = PUBLISHED.command(jnp.array([-1.0, 1.0]), 5.0)
    assert float(acceleration) == -4.0
    assert float(curvature) == pytest.approx(np.tan(0.3) / 3.0)


def test_termination_and_truncation_are_separate(measured):
    facts, _ = measured
    bank = bank_of(straight_road([car(0, 0, 0, 9)]))
    task, context = Task(), Simulator(Task()).context(bank, 0, 90)
    ends = jax.tree.map(bool, task.check_end(bank, context, facts))
    assert ends == (False, True)
    crash = replace(facts, collision=jnp.asarray(True))
    assert jax.tree.map(bool, task.check_end(bank, context, crash)) == (True, False)
    assert jax.tree.map(bool, replace(task, to_the_end=True).check_end(bank, context, crash)) == (False, True)
    away = replace(facts, left_map=jnp.asarray(True))
    assert jax.tree.map(bool, task.check_end(bank, Simulator(task).context(bank, 0, 20), away)) == (
        False,
        True,
    )


LAG = Simulator(Task(rewards=RewardConfig(preset="safety", lag=-1.0), metrics="none", ends=()))


@jax.jit
def displaced(bank, shift):
    state = LAG.reset(bank, 0)
    motion = logged_motion(bank, state.context, 1)
    after, transition = LAG.replay(bank, state, motion + shift, jnp.zeros(2))
    return after.facts.lag_m, transition.reward_terms["lag"]


@pytest.mark.parametrize(
    ("x", "y", "heading", "lag"),
    [(-3.0, 0.0, 0.0, 3.0), (2.0, 0.5, 0.0, -2.0), (-3.0, 1.0, np.pi / 3, 0.634)],
)
def test_lag_is_the_distance_behind_the_log(x, y, heading, lag):
    """At a pose displaced from the logged one: x ahead of it, y to its left, turned by an angle.

    The log is then at (-x, -y), of which the part along the heading is -x cos - y sin: 3/2 - 0.866 in the last case.
    """
    bank = bank_of(straight_road([car(0, 0, 0, 9)]))
    lag_m, term = displaced(bank, jnp.asarray([x, y, heading, 0.0]))
    assert float(lag_m) == pytest.approx(lag, abs=1e-3)
    assert float(term) == pytest.approx(-max(lag, 0.0), abs=1e-3)
