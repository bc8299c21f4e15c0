"""Gradients of rollouts of 80 steps: finite everywhere, and equal to central finite differences in float64."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.evaluation.rollout import evaluation_task
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.bank_data import prepare_bank
from drivax.simulator.traffic.log import alone
from drivax.simulator.traffic.reactive import IdmTraffic
from drivax.tasks.actions import DELTA_LOCAL, DIRECT_STATE, PHYSICAL, PUBLISHED, Physical
from drivax.tasks.task import Task
from scenes import RED, bank_of, car, straight_road

LENGTH_M, STEPS = 4.8, 80
SPACES = {
    "physical": PHYSICAL,
    "published": PUBLISHED,
    "limited": Physical(jerk_mps3=4.0, steering_rate=0.05),
    "delta_local": DELTA_LOCAL,
    "direct_state": DIRECT_STATE,
}


@partial(jax.jit, static_argnums=0)
def rollout(space, motion, actions):
    def one(now, action):
        motion, last = now
        executed = space.actuate(motion, action, last, LENGTH_M)
        motion = space.move(motion, executed, LENGTH_M)
        return (motion, executed), motion

    return jax.lax.scan(one, (motion, jnp.zeros(space.size)), actions)[1]


def driving(space, seed):
    """Actions that start, turn over the wrap of the heading, brake to a stop, wait and start again."""
    rng = np.random.default_rng(seed)
    actions = rng.uniform(-0.2, 0.2, (STEPS, space.size))
    if space is DELTA_LOCAL:
        actions[:, 0] = rng.uniform(0.05, 0.3, STEPS)
    elif space is not DIRECT_STATE:
        actions[:, 0] += np.repeat([0.2, -0.7, -0.5, 0.4], STEPS // 4)
    return jnp.asarray(actions)


@pytest.mark.parametrize("name", SPACES)
def test_rollout_gradients_equal_finite_differences(name):
    space = SPACES[name]
    with jax.enable_x64(True):
        start, weights = jnp.array([3.0, -2.0, 3.0, 6.0]), np.random.default_rng(9).normal(size=(STEPS, 4))

        @jax.jit
        def total(start, actions):
            return (rollout(space, start, actions) * weights).sum()

        actions = driving(space, 0)
        slopes = jax.jit(jax.grad(total, argnums=(0, 1)))(start, actions)
        assert all(np.isfinite(slope).all() for slope in slopes)
        assert np.abs(slopes[1]).max() > 1.0
        step, rng = 1e-6, np.random.default_rng(5)
        for place in rng.integers(0, STEPS, 12):
            for part in range(space.size):
                towards = jnp.zeros_like(actions).at[place, part].set(step)
                moved = (total(start, actions + towards) - total(start, actions - towards)) / (2 * step)
                assert float(slopes[1][place, part]) == pytest.approx(float(moved), rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("name", SPACES)
@pytest.mark.parametrize("speed", [0.0, 5.0])
def test_gradients_are_finite_at_every_limit(name, speed):
    """At a standstill, at the bounds, at full braking and beyond, where masks and clips meet."""
    space = SPACES[name]
    slope = jax.jit(jax.grad(lambda start, actions: rollout(space, start, actions).sum(), argnums=(0, 1)))
    start = jnp.array([0.0, 0.0, -np.pi, speed])
    for level in (0.0, 1.0, -1.0, 3.0, -3.0):
        for found in slope(start, jnp.full((STEPS, space.size), level)):
            assert np.isfinite(found).all(), (name, speed, level)


@pytest.fixture(scope="module")
def together():
    """Positions of two driven agents over 80 steps, as a function of both agents' actions."""
    simulator = Simulator(Task(metrics=("ade",), ends=()))
    road = straight_road([car(0, 0, 0, 8), car(20, 3.7, 0, 6), car(60, 0, 0, 0)], light=RED)
    bank = bank_of(road)

    def positions(bank, actions):
        pair = jax.vmap(lambda slot: simulator.reset(bank, 0, 10, slot))(jnp.array([0, 1]))

        def one(states, both):
            states, _ = simulator.step_together(bank, states, both)
            return states, states.context.history[:, -1]

        return jax.lax.scan(one, pair, actions)[1]

    return bank, positions


@pytest.mark.slow
def test_simulator_gradients_equal_finite_differences(together):
    """Through the whole step and its measurements: an agent depends on its own actions, not on the other's."""
    bank, positions = together
    with jax.enable_x64(True):
        wide, rng = widened(bank), np.random.default_rng(3)
        actions = jnp.asarray(rng.uniform(-0.3, 0.3, (STEPS, 2, 2)))
        weights = rng.normal(size=(STEPS, 4))
        totals = jax.jit(lambda actions: (positions(wide, actions) * weights[:, None]).sum((0, 2)))
        slopes = np.asarray(jax.jit(jax.jacrev(lambda actions: totals(actions)))(actions))
        assert np.isfinite(slopes).all()
        assert (slopes[0][:, 1] == 0.0).all() and (slopes[1][:, 0] == 0.0).all()
        for place in (0, 1, 17, 40, 78):
            for agent in (0, 1):
                for part in (0, 1):
                    towards = jnp.zeros_like(actions).at[place, agent, part].set(1e-6)
                    moved = np.asarray(totals(actions + towards) - totals(actions - towards)) / 2e-6
                    np.testing.assert_allclose(slopes[:, place, agent, part], moved, rtol=1e-4, atol=1e-5)


def widened(bank):
    """The bank in float64, for finite differences through everything."""
    return jax.tree.map(lambda v: v.astype(jnp.float64) if v.dtype == jnp.float32 else v, bank)


@pytest.mark.slow
def test_reactive_traffic_differentiates_with_respect_to_ego():
    """A car follows ego by IDM: where it is depends on what ego did before, by the finite difference."""
    simulator = Simulator(Task(metrics="none", ends=()), IdmTraffic())
    road = straight_road([car(0, 0, 0, 8), car(-14, 0, 0, 9), car(0, 3.7, 0, 0)])
    bank = prepare_bank(simulator.traffic, bank_of(road))

    def followers(bank, actions):
        def one(state, action):
            state, _ = simulator.step(bank, state, action)
            return state, simulator.frame(bank, state.context, alone(state.context), 0).box[1, :2]

        return jax.lax.scan(one, simulator.reset(bank, 0), actions)[1]

    with jax.enable_x64(True):
        wide, rng = widened(bank), np.random.default_rng(6)
        weights = rng.normal(size=(STEPS, 2))
        total = jax.jit(lambda actions: (followers(wide, actions) * weights).sum())
        actions = jnp.asarray(rng.uniform(-0.3, 0.2, (STEPS, 2)) * [1.0, 0.05])
        slope = np.asarray(jax.jit(jax.grad(total))(actions))
        assert np.isfinite(slope).all() and np.abs(slope[:, 0]).max() > 1e-2
        for place in (0, 5, 20, 40, 60):
            for part in (0, 1):
                towards = jnp.zeros_like(actions).at[place, part].set(1e-6)
                moved = float(total(actions + towards) - total(actions - towards)) / 2e-6
                assert slope[place, part] == pytest.approx(moved, rel=1e-3, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.0, 8.0])
def test_rewards_facts_and_observations_have_finite_gradients(speed):
    """Facts, rewards, observations and motions, from a standstill or at 8 m/s, through a collision."""
    simulator = Simulator(evaluation_task(Task()))
    bank = bank_of(straight_road([car(0, 0, 0, speed), car(25, 0.4, 0, 3), car(20, 3.7, 0, 3)], light=RED))

    @jax.jit
    @jax.grad
    def slope(actions):
        def one(state, action):
            state, transition = simulator.step(bank, state, action)
            observation = simulator.observe(bank, state.context)
            leaves = jax.tree.leaves((state.facts, transition.reward, observation, state.context.history))
            return state, sum(leaf.sum() for leaf in leaves if leaf.dtype == jnp.float32)

        return jax.lax.scan(one, simulator.reset(bank, 0), actions)[1].sum()

    for action in ([0.0, 0.0], [0.4, 0.02], [-1.0, 0.0], [0.2, -0.3]):
        assert np.isfinite(slope(jnp.broadcast_to(jnp.array(action), (STEPS, 2)))).all(), action
