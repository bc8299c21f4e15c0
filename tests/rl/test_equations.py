"""RL equations against hand-computed arrays and an independent loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.rl.equations import clipped_surrogate_loss, generalised_advantages


def by_loop(reward, value, after, terminated, truncated, gamma, lambda_):
    """The definition as a sum of discounted TD errors up to the end of the episode, in float64."""
    steps = len(reward)
    result = np.zeros(steps)
    for t in range(steps):
        weight = 1.0
        for k in range(t, steps):
            bootstrap = 0.0 if terminated[k] else gamma * after[k]
            result[t] += weight * (reward[k] + bootstrap - value[k])
            if terminated[k] or truncated[k]:
                break
            weight *= gamma * lambda_
    return result


def test_advantages_against_the_definition():
    rng = np.random.default_rng(0)
    for _ in range(20):
        reward, value, after = rng.normal(size=(3, 30))
        terminated, truncated = rng.random((2, 30)) < 0.15
        truncated &= ~terminated
        result, target = generalised_advantages(
            *(jnp.asarray(x, jnp.float32) for x in (reward, value, after)),
            jnp.asarray(terminated), jnp.asarray(truncated), 0.9, 0.8,
        )  # fmt: skip
        expected = by_loop(reward, value, after, terminated, truncated, 0.9, 0.8)
        np.testing.assert_allclose(result, expected, atol=1e-5)
        np.testing.assert_allclose(target, expected + value, atol=1e-5)


def test_advantages_by_hand():
    # Two steps, the second terminates: A_1 = 2 - 3 = -1; A_0 = 1 + 0.5 * 3 - 1 + 0.5 * 0.5 * (-1) = 1.25.
    arrays = (jnp.array([1.0, 2.0]), jnp.array([1.0, 3.0]), jnp.array([3.0, 7.0]))
    result, _ = generalised_advantages(*arrays, jnp.array([False, True]), jnp.array([False, False]), 0.5, 0.5)
    np.testing.assert_allclose(result, [1.25, -1.0])
    # Truncated instead: the final state's value counts, A_1 = 2 + 0.5 * 7 - 3 = 2.5; A_0 = 1.5 + 0.25 * 2.5.
    result, _ = generalised_advantages(*arrays, jnp.array([False, False]), jnp.array([False, True]), 0.5, 0.5)
    np.testing.assert_allclose(result, [2.125, 2.5])


def test_values_that_overflow_stay_in_their_episode():
    """The next episode's values are infinite, as is that of the terminal state, which counts as zero."""
    reward, value = jnp.array([1.0, 2.0, 3.0]), jnp.array([1.0, 3.0, jnp.inf])
    for after, terminated, expected in ((jnp.inf, True, -1.0), (7.0, False, 2.5)):
        ends, inside = jnp.array([False, terminated, False]), jnp.array([False, not terminated, False])
        value_tp1 = jnp.array([3.0, after, jnp.inf])
        result, _ = generalised_advantages(reward, value, value_tp1, ends, inside, 0.5, 0.5)
        np.testing.assert_allclose(result[:2], [1.5 + 0.25 * expected, expected])


@pytest.mark.parametrize(
    ("ratio", "advantage", "loss", "slope"),
    [
        (1.1, 2.0, -2.2, True), (1.5, 2.0, -2.4, False), (0.5, 2.0, -1.0, True), (0.5, -2.0, 1.6, False),
        (1.5, -2.0, 3.0, True),
    ],
)  # fmt: skip
def test_clipped_surrogate_has_no_gradient_beyond_the_clip(ratio, advantage, loss, slope):
    def of(log_prob):
        return clipped_surrogate_loss(log_prob, jnp.zeros(()), jnp.asarray(advantage), 0.2)

    value, gradient = jax.value_and_grad(of)(jnp.log(jnp.asarray(ratio)))
    assert float(value) == pytest.approx(loss, rel=1e-5)
    assert (abs(float(gradient)) > 1e-6) == slope
    around = [float(of(jnp.log(jnp.asarray(ratio)) + shift)) for shift in (-1e-3, 1e-3)]
    assert float(gradient) == pytest.approx((around[1] - around[0]) / 2e-3, rel=2e-3, abs=1e-3)
