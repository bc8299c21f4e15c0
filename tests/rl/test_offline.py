"""Equations of offline learning by hand, against NumPy and finite differences, and their solutions in small worlds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

from drivax.learning.program import mean_over_devices
from drivax.rl.equations import (
    advantage_weights,
    conservative_penalty,
    expectile_loss,
    log_mass,
    penalty_weight_loss,
    scaled_policy_loss,
    smoothed_action,
    td_target,
)

STATES, ACTIONS, GAMMA = 6, 4, 0.9


@pytest.fixture(scope="module")
def world():
    """A random decision process: transition [s, a, s], reward [s, a], the policy of the data [s, a]."""
    rng = np.random.default_rng(0)
    behaviour = rng.dirichlet(np.full(ACTIONS, 2.0), size=STATES) + 0.05
    return (
        rng.dirichlet(np.ones(STATES), size=(STATES, ACTIONS)),
        rng.normal(size=(STATES, ACTIONS)),
        behaviour / behaviour.sum(axis=1, keepdims=True),
    )


def solve(transition, reward, policy):
    """Q of a policy, by one linear system."""
    follows = np.einsum("sax,xb->saxb", transition, policy).reshape(STATES * ACTIONS, -1)
    q = np.linalg.solve(np.eye(STATES * ACTIONS) - GAMMA * follows, reward.reshape(-1))
    return q.reshape(STATES, ACTIONS)


def slopes(of, at, step=1e-4):
    """Central differences of a scalar function of a float64 array."""
    result = np.zeros_like(at)
    for index in np.ndindex(at.shape):
        shift = np.zeros_like(at)
        shift[index] = step
        result[index] = (of(at + shift) - of(at - shift)) / (2 * step)
    return result


def test_log_mass_by_hand():
    # Half of [-1, 1] has Q = ln 2, half 0: the integral of exp(Q) is 2 + 1 = 3.
    q = jnp.array([[np.log(2.0)], [0.0]])
    np.testing.assert_allclose(log_mass(q, jnp.full((2, 1), np.log(0.5))), [np.log(3.0)], rtol=1e-6)
    # Densities of zero: the mean of 2 and 1.
    np.testing.assert_allclose(log_mass(q, jnp.zeros((2, 1))), [np.log(1.5)], rtol=1e-6)
    # At temperature 2: 2 ln (1/2 (exp(ln 2 / 2) + 1)).
    expected = 2 * np.log(0.5 * (np.sqrt(2.0) + 1.0))
    np.testing.assert_allclose(log_mass(q, jnp.zeros((2, 1)), 2.0), [expected], rtol=1e-6)
    np.testing.assert_allclose(log_mass(q, jnp.zeros((2, 1)), 1e-3), [np.log(2.0)], atol=1e-3)


def test_log_mass_does_not_depend_on_the_sampling_distribution():
    """The integral of exp(-8 (a - 0.3)^2) over [-1, 1], from uniform and from Gaussian actions."""
    rng = np.random.default_rng(1)
    exact = np.trapezoid(np.exp(-8 * (np.linspace(-1, 1, 20_001) - 0.3) ** 2), dx=1e-4)
    uniform, gaussian = rng.uniform(-1, 1, 40_000), rng.normal(0.3, 0.5, 40_000)
    density = -0.5 * ((gaussian - 0.3) / 0.5) ** 2 - np.log(0.5 * np.sqrt(2 * np.pi))
    within = np.abs(gaussian) <= 1.0
    action = np.concatenate([uniform, gaussian])
    q = np.where(np.concatenate([np.ones(40_000, bool), within]), -8 * (action - 0.3) ** 2, -1e9)
    both = log_mass(jnp.asarray(q), jnp.asarray(np.concatenate([np.full(40_000, -np.log(2.0)), density])))
    assert float(both) == pytest.approx(np.log(exact), abs=0.01)
    # Without densities it is another number.
    assert abs(float(log_mass(jnp.asarray(q), jnp.zeros(80_000))) - np.log(exact)) > 0.3


def test_penalties_against_numpy_and_their_gradients_against_finite_differences():
    rng = np.random.default_rng(2)
    q, density, data = rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), rng.normal(size=3)

    def expected(q, data=data):
        return 0.7 * np.log(np.mean(np.exp(q / 0.7 - density), axis=0)) - data

    args = (jnp.asarray(density, jnp.float32), jnp.asarray(data, jnp.float32), 0.7)
    result = conservative_penalty(jnp.asarray(q, jnp.float32), *args)
    np.testing.assert_allclose(result, expected(q), atol=1e-5)
    slope = jax.grad(lambda q: conservative_penalty(q, *args).sum())(jnp.asarray(q, jnp.float32))
    np.testing.assert_allclose(slope, slopes(lambda q: expected(q).sum(), q), atol=1e-5)


def test_penalty_weight_moves_toward_the_gap():
    """By hand: alpha = 2, penalties of 3 and 0 around a gap of 1: -2 (3 - 1) and -2 (0 - 1)."""
    log_weight, penalty = jnp.log(2.0), jnp.array([3.0, 0.0])
    np.testing.assert_allclose(penalty_weight_loss(log_weight, penalty, 1.0), [-4.0, 2.0], rtol=1e-6)
    for above, sign in ((3.0, -1.0), (0.0, 1.0)):
        slope = jax.grad(lambda w, a=above: penalty_weight_loss(w, jnp.asarray(a), 1.0))(log_weight)
        assert np.sign(slope) == sign
    slope = jax.grad(lambda p: penalty_weight_loss(log_weight, p, 1.0).sum())(penalty)
    np.testing.assert_array_equal(slope, 0.0)


def test_expectiles_by_hand_and_against_a_root_finder():
    loss = expectile_loss(jnp.array([2.0, -3.0, 0.0]), 0.9)
    np.testing.assert_allclose(loss, [0.9 * 4.0, 0.1 * 9.0, 0.0], rtol=1e-6)
    targets = np.random.default_rng(3).normal(size=50)
    arrays = jnp.asarray(targets, jnp.float32)
    for tau in (0.5, 0.7, 0.99):

        def balance(value, tau=tau):
            error = targets - value
            return np.sum(np.where(error > 0, tau, 1 - tau) * error)

        result = optimize.brentq(balance, targets.min(), targets.max())
        slope = jax.grad(lambda v, tau=tau: expectile_loss(arrays - v, tau).sum())(jnp.float32(result))
        assert float(slope) == pytest.approx(0.0, abs=1e-4)
        differences = slopes(
            lambda v, tau=tau: np.sum(np.where(targets < v, 1 - tau, tau) * (targets - v) ** 2), np.array(0.4)
        )
        slope = jax.grad(lambda v, tau=tau: expectile_loss(arrays - v, tau).sum())(jnp.float32(0.4))
        assert float(slope) == pytest.approx(float(differences), rel=1e-4)


def test_advantage_weights_are_capped_and_have_no_gradient():
    # exp(0) = 1; exp(3 * 0.5) = 4.48; exp(3 * 2) = 403 is cut off at 100, and so is what overflows.
    advantage = jnp.array([0.0, 0.5, 2.0, 1e6])
    result = advantage_weights(advantage, 3.0, 100.0)
    np.testing.assert_allclose(result, [1.0, np.exp(1.5), 100.0, 100.0], rtol=1e-5)
    slope = jax.grad(lambda a: advantage_weights(a, 3.0, 100.0).sum())(advantage)
    np.testing.assert_array_equal(slope, 0.0)


def test_scaled_policy_loss_is_invariant_to_reward_scale():
    def scaled(q):
        return scaled_policy_loss(-q, mean_over_devices(jnp.abs(q)))

    q = jnp.array([4.0, -2.0])
    # -Q over the mean of 4 and 2.
    np.testing.assert_allclose(scaled(q), [-4 / 3, 2 / 3], rtol=1e-6)
    np.testing.assert_allclose(scaled(100 * q), scaled(q), rtol=1e-6)
    slope = jax.grad(lambda q: scaled(q).sum())(q)
    np.testing.assert_allclose(slope, [-1 / 3, -1 / 3], rtol=1e-6)
    assert np.isfinite(scaled(jnp.zeros(2))).all()


def test_smoothing_clips_noise_and_action():
    # 0.5 + 0.1; 0.5 + 0.9 is 0.5 + 0.3; 0.9 + 0.3 stops at 1.
    action, noise = jnp.array([[0.5], [0.5], [0.9]]), jnp.array([[0.1], [0.9], [0.4]])
    np.testing.assert_allclose(smoothed_action(action, noise, 0.3), [[0.6], [0.8], [1.0]], rtol=1e-6)


def test_tabular_conservative_values_have_a_closed_form(world):
    """Descent on the loss that CQL minimises ends where (I - gamma P^pi) Q = r - alpha (pi / pi_beta - 1) says.

    The policy is the softmax of Q, as the regulariser's own; its values are then below the true ones in every state.
    """
    transition, reward, behaviour = world
    alpha = 0.3
    p, r, b = (jnp.asarray(array, jnp.float32) for array in world)
    enumerated = jnp.full((ACTIONS, STATES), -jnp.log(float(ACTIONS)))

    def loss(q):
        policy = jax.nn.softmax(q, axis=1)
        value = jnp.einsum("sax,x->sa", p, jnp.sum(policy * q, axis=1))
        target = td_target(r, value, jnp.zeros(r.shape, bool), GAMMA)
        error = 0.5 * jnp.sum(b * (q - target) ** 2, axis=1)
        return jnp.sum(error + alpha * conservative_penalty(q.T, enumerated, jnp.sum(b * q, axis=1)))

    step = jax.jit(lambda q: jax.lax.fori_loop(0, 20_000, lambda _, q: q - 0.3 * jax.grad(loss)(q), q))
    result = np.asarray(step(jnp.zeros((STATES, ACTIONS))), np.float64)
    policy = np.exp(result) / np.exp(result).sum(axis=1, keepdims=True)
    expected = solve(transition, reward - alpha * (policy / behaviour - 1.0), policy)
    np.testing.assert_allclose(result, expected, atol=2e-3)
    true = solve(transition, reward, policy)
    difference = (policy * result).sum(axis=1) - (policy * true).sum(axis=1)
    assert (difference < 0.0).all(), difference


def test_implicit_values_lie_between_mean_and_best_logged_action(world):
    """Expectile 0.5 gives the value of the data's policy; near 1 that of the best policy within the data."""
    transition, reward, behaviour = world
    logged_policy = np.where(np.arange(ACTIONS) == 3, 0.0, behaviour)  # the data lack the last action
    logged_policy /= logged_policy.sum(axis=1, keepdims=True)
    mean = (logged_policy * solve(transition, reward, logged_policy)).sum(axis=1)
    best = np.zeros(STATES)
    for _ in range(500):
        best = np.where(logged_policy > 0, reward + GAMMA * transition @ best, -np.inf).max(axis=1)
    p, r, b = (jnp.asarray(array, jnp.float32) for array in (transition, reward, logged_policy))

    def values(tau):
        def improve(_, value):
            q = td_target(r, jnp.einsum("sax,x->sa", p, value), jnp.zeros(r.shape, bool), GAMMA)
            slope = jax.grad(lambda v: jnp.sum(b * expectile_loss(q - v[:, None], tau)))(value)
            return value - 0.4 * slope

        return np.asarray(jax.jit(lambda: jax.lax.fori_loop(0, 60_000, improve, jnp.zeros(STATES)))())

    np.testing.assert_allclose(values(0.5), mean, atol=1e-3)
    np.testing.assert_allclose(values(0.999), best, atol=0.1)
    between = values(0.9)
    assert (mean < between).all() and (between < best).all()


def test_truncated_steps_bootstrap():
    """A loop that always pays 1 is worth 1 / (1 - gamma) if truncated; if terminated, it is worth less."""
    reward = jnp.ones(8)
    for terminated, worth in ((jnp.zeros(8, bool), 1 / (1 - GAMMA)), (jnp.arange(8) == 7, None)):
        value = jnp.zeros(8)
        for _ in range(400):
            # The last step leads to the state of the first one.
            value = td_target(reward, jnp.roll(value, -1), terminated, GAMMA)
        if worth is None:
            expected = (1 - GAMMA ** np.arange(8, 0, -1)) / (1 - GAMMA)
            np.testing.assert_allclose(value, expected, rtol=1e-5)
        else:
            np.testing.assert_allclose(value, worth, rtol=1e-5)
