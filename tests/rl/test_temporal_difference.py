"""Targets and losses of off-policy learning against hand-computed arrays, NumPy and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.rl.equations import (
    n_step_returns,
    polyak,
    soft_policy_loss,
    soft_value,
    td_target,
    temperature_loss,
)


def slope(of, at, step=1e-3):
    """Central difference in float64."""
    return (float(of(np.float64(at + step))) - float(of(np.float64(at - step)))) / (2 * step)


def test_td_target_by_hand():
    # 1 + 0.5 * 4 = 3; terminated: 2; truncated is no argument, so -1 + 0.5 * 6 = 2.
    target = td_target(
        jnp.array([1.0, 2.0, -1.0]), jnp.array([4.0, 8.0, 6.0]), jnp.array([False, True, False]), 0.5
    )
    np.testing.assert_allclose(target, [3.0, 2.0, 2.0])


def test_terminated_targets_ignore_values_and_have_no_gradient():
    terminated = jnp.array([True, False])
    target = td_target(jnp.ones(2), jnp.array([jnp.inf, 1.0]), terminated, 0.9)
    np.testing.assert_allclose(target, [1.0, 1.9])
    gradient = jax.grad(lambda value: td_target(jnp.ones(2), value, terminated, 0.9).sum())(jnp.ones(2))
    np.testing.assert_array_equal(gradient, 0.0)


def test_n_step_returns_by_hand():
    """Three episodes: whole, failed in the second step, cut short after one; a decision takes one step or two."""
    reward = jnp.array([[1.0, 1.0, 1.0], [2.0, 2.0, jnp.nan], [4.0, jnp.nan, 7.0]])
    terminated = jnp.array([[False, False, False], [False, True, True], [False, True, True]])
    follows = jnp.array([[True, True, True], [True, True, False], [True, False, True]])
    returns = n_step_returns(reward, terminated, follows, 0.5)
    np.testing.assert_allclose(returns.reward, [1 + 1 + 1, 1 + 1, 1])
    np.testing.assert_allclose(returns.discount, [0.125, 0.25, 0.5])
    np.testing.assert_array_equal(returns.steps, [3, 2, 1])
    np.testing.assert_array_equal(returns.terminated, [False, True, False])
    held = n_step_returns(reward, terminated, follows, 0.5, hold=2)
    np.testing.assert_allclose(held.reward, [1 + 2 + 2, 1 + 2, 1])
    np.testing.assert_allclose(held.discount, [0.25, 0.5, 0.5])


def test_td_targets_of_one_episode_add_up_to_its_return():
    """With values that are the discounted returns to go, every target is the return to go itself."""
    rng = np.random.default_rng(1)
    reward, gamma = rng.normal(size=12), 0.9
    to_go = np.array([sum(gamma ** (k - t) * reward[k] for k in range(t, 12)) for t in range(13)])
    target = td_target(
        jnp.asarray(reward, jnp.float32),
        jnp.asarray(to_go[1:], jnp.float32),
        jnp.arange(12) == 11,
        gamma,
    )
    np.testing.assert_allclose(target, to_go[:12], atol=1e-5)


def test_soft_values_against_numpy():
    rng = np.random.default_rng(0)
    q, log_prob = rng.normal(size=(2, 5, 3)), rng.normal(size=(5, 3))
    expected = np.where(q[0] < q[1], q[0], q[1]) - 0.3 * log_prob
    arrays = jnp.asarray(q, jnp.float32), jnp.asarray(log_prob, jnp.float32), jnp.asarray(0.3)
    np.testing.assert_allclose(soft_value(*arrays), expected, atol=1e-6)
    np.testing.assert_allclose(soft_policy_loss(*arrays), -expected, atol=1e-6)


def test_gradient_of_the_policy_loss_against_finite_differences():
    """Through a Gaussian with two quadratic critics; only the smaller one is climbed."""
    noise = np.random.default_rng(2).normal(size=7)

    def critics(action, np_):
        return np_.stack([-((action - 1.0) ** 2), 0.2 - 0.5 * (action + 1.0) ** 2])

    def loss(mean, np_, value):
        action = mean + 0.5 * noise
        log_prob = -0.5 * noise**2 - np.log(0.5 * np.sqrt(2 * np.pi)) + 0.1 * mean
        return value(critics(action, np_), log_prob)

    def by_numpy(mean):
        return loss(mean, np, lambda q, log_prob: np.mean(0.2 * log_prob - q.min(axis=0)))

    def ours(mean):
        return loss(
            mean,
            jnp,
            lambda q, log_prob: soft_policy_loss(
                q.astype(jnp.float32), log_prob.astype(jnp.float32), jnp.asarray(0.2)
            ).mean(),
        )

    for mean in (-1.3, 0.4, 2.0):
        assert float(jax.grad(ours)(mean)) == pytest.approx(slope(by_numpy, mean), rel=1e-3)


@pytest.mark.parametrize(("log_prob", "falls"), [(-3.0, True), (2.5, False)])
def test_temperature_moves_toward_the_target_entropy(log_prob, falls):
    """By hand: entropy -log_prob against a target of -2, temperature e^-1."""

    def by_numpy(log_temperature):
        return -np.exp(log_temperature) * (log_prob - 2.0)

    def ours(log_temperature):
        return temperature_loss(log_temperature, jnp.asarray(log_prob), -2.0)

    value, gradient = jax.value_and_grad(ours)(jnp.asarray(-1.0))
    assert float(value) == pytest.approx(by_numpy(-1.0), rel=1e-6)
    assert float(gradient) == pytest.approx(slope(by_numpy, -1.0), rel=1e-4)
    assert (float(gradient) > 0) == falls
    assert float(jax.grad(lambda x: temperature_loss(jnp.zeros(()), x, -2.0))(jnp.asarray(log_prob))) == 0.0


def test_polyak_shrinks_the_distance_by_the_rate():
    target, online = {"w": jnp.array([0.0, 4.0])}, {"w": jnp.array([1.0, 0.0])}
    np.testing.assert_allclose(polyak(target, online, 0.25)["w"], [0.25, 3.0])
    moved = target
    for _ in range(3):
        moved = polyak(moved, online, 0.1)
    # The distance shrinks by 0.9 each time.
    np.testing.assert_allclose(online["w"] - moved["w"], 0.9**3 * np.array([1.0, -4.0]), rtol=1e-6)
