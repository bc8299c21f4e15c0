"""Off-policy evaluation in a small Markov decision process whose values are known."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from drivax.rl.equations import doubly_robust, weighted_importance_sampling

STATES, ACTIONS, STEPS, GAMMA = 3, 2, 4, 0.9
RNG = np.random.default_rng(0)
#: Probabilities of next states; action 1 in state 2 ends the episode.
NEXT = RNG.dirichlet(np.ones(STATES), (STATES, ACTIONS))
REWARD = RNG.normal(size=(STATES, ACTIONS))
TARGET = np.array([[0.8, 0.2], [0.3, 0.7], [0.6, 0.4]])
BEHAVIOUR = np.array([[0.5, 0.5], [0.6, 0.4], [0.3, 0.7]])


def values(policy):
    """Q and V of each step and state by backward induction."""
    q, v = np.zeros((STEPS, STATES, ACTIONS)), np.zeros((STEPS + 1, STATES))
    for t in reversed(range(STEPS)):
        follow = NEXT @ v[t + 1]
        follow[2, 1] = 0.0
        q[t] = REWARD + GAMMA * follow
        v[t] = (policy * q[t]).sum(axis=1)
    return q, v


def episodes(count, rng):
    """Episodes of the behaviour policy from state 0: states, actions, rewards, usable steps."""
    state, alive = np.zeros(count, int), np.ones(count, bool)
    columns = []
    for _ in range(STEPS):
        action = (rng.random(count) >= BEHAVIOUR[state, 0]).astype(int)
        columns.append((state, action, np.where(alive, REWARD[state, action], 99.0), alive))
        alive = alive & ~((state == 2) & (action == 1))
        draw = rng.random(count)[:, None]
        state = (draw > np.cumsum(NEXT[state, action], axis=1)).sum(axis=1)
    return tuple(np.stack(column, axis=1) for column in zip(*columns, strict=True))


def estimate(count, rng, policy=TARGET, error=0.0):
    """Estimates of a policy's return, with an error of Q and value in the doubly robust one."""
    state, action, reward, usable = episodes(count, rng)
    ratio = policy[state, action] / BEHAVIOUR[state, action]
    q, v = values(policy)
    steps = np.arange(STEPS)
    arrays = (jnp.asarray(reward), jnp.asarray(ratio), jnp.asarray(usable))
    q, v = q[steps, state, action] + error, v[steps, state] + error
    return (
        weighted_importance_sampling(*arrays, GAMMA),
        doubly_robust(*arrays, jnp.asarray(q), jnp.asarray(v), GAMMA),
    )


def test_both_estimators_converge_to_the_value():
    expected = values(TARGET)[1][0, 0]
    assert abs(expected - values(BEHAVIOUR)[1][0, 0]) > 0.1
    for error in (0.0, 0.5):
        for result in estimate(200_000, np.random.default_rng(1), error=error):
            assert float(result.value) == pytest.approx(expected, abs=0.02)


def test_doubly_robust_estimates_vary_less_with_a_good_q():
    draws = np.array(
        [[float(x.value) for x in estimate(50, np.random.default_rng(seed))] for seed in range(200)]
    )
    sampling, robust = draws.std(axis=0)
    assert robust < 0.7 * sampling
    assert draws[:, 1].mean() == pytest.approx(values(TARGET)[1][0, 0], abs=3 * robust / np.sqrt(200) + 0.01)


def test_estimates_of_the_behaviour_policy_are_mean_returns():
    _, _, reward, usable = episodes(500, np.random.default_rng(2))
    ones = jnp.ones(reward.shape)
    expected = (np.where(usable, reward, 0.0) * GAMMA ** np.arange(STEPS)).sum(axis=1).mean()
    result = weighted_importance_sampling(jnp.asarray(reward), ones, jnp.asarray(usable), GAMMA)
    assert float(result.value) == pytest.approx(expected, rel=1e-5)
    assert float(result.effective) == pytest.approx(500, rel=1e-4)


def test_two_episodes_by_hand():
    """Ratios 2 and 1, then 1 and 3; the second episode has one step, and keeps its weight."""
    reward, ratio = jnp.array([[1.0, 2.0], [4.0, 99.0]]), jnp.array([[2.0, 1.0], [1.0, 3.0]])
    usable = jnp.array([[True, True], [True, False]])
    result = weighted_importance_sampling(reward, ratio, usable, 0.5)
    assert float(result.value) == pytest.approx((2 * 1 + 1 * 4) / 3 + 0.5 * (2 * 2) / 3)
    assert float(result.effective) == pytest.approx(1 / ((2 / 3) ** 2 + (1 / 3) ** 2))
    q, v = jnp.array([[1.5, 1.0], [3.0, 7.0]]), jnp.array([[2.0, 1.0], [1.0, 7.0]])
    robust = doubly_robust(reward, ratio, usable, q, v, 0.5)
    first = 2 / 3 * (1 - 1.5) + 1 / 3 * (4 - 3) + 0.5 * (2 + 1)
    second = 2 / 3 * (2 - 1) + 2 / 3 * 1
    assert float(robust.value) == pytest.approx(first + 0.5 * second)


def test_ratios_of_long_episodes_do_not_overflow():
    ratio = jnp.full((4, 1000), 5.0).at[0].set(4.0)
    reward = jnp.ones((4, 1000))
    result = partial(weighted_importance_sampling, usable=reward > 0, gamma=0.9)(reward, ratio)
    assert float(result.value) == pytest.approx(10.0, rel=1e-4) and float(result.effective) == pytest.approx(
        3
    )
