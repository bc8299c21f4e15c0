"""The maximum over rows against its plain form: values, gradients, ties, and rows without a maximum."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.networks.encoders import dense, max_pool


def plain(activation, layers, rows, valid):
    return jnp.max(dense(activation, layers, rows), axis=-2, initial=0.0, where=valid[..., None])


def case(rows, sizes, seed=0):
    rng = np.random.default_rng(seed)
    layers = [
        (
            rng.normal(size=(inputs, outputs)).astype(np.float32),
            rng.normal(size=outputs).astype(np.float32) - 0.5,
        )
        for inputs, outputs in pairwise(sizes)
    ]
    valid = rng.random((2, 3, rows)) < 0.5
    valid[0, 0], valid[1, 1] = False, True
    return layers, rng.normal(size=(2, 3, rows, sizes[0])).astype(np.float32), valid


def value_and_gradients(function, activation, layers, rows, valid):
    weights = np.random.default_rng(1).normal(size=(*rows.shape[:-2], len(layers[-1][1]))).astype(np.float32)

    def total(layers, rows):
        value = function(activation, layers, rows, jnp.asarray(valid))
        return jnp.sum(weights * value), value

    return jax.jit(jax.value_and_grad(total, argnums=(0, 1), has_aux=True))(layers, rows)


@pytest.mark.parametrize("activation", ["relu", "tanh", "gelu", "silu"])
@pytest.mark.parametrize(("rows", "sizes"), [(40, (3, 5, 4)), (3, (3, 6, 5, 4)), (9, (2, 3))])
def test_values_and_gradients_are_those_of_the_plain_maximum(activation, rows, sizes):
    arguments = jax.tree.map(jnp.asarray, case(rows, sizes))
    pooled = value_and_gradients(max_pool, activation, *arguments)
    expected = value_and_gradients(plain, activation, *arguments)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), pooled, expected)
    undifferentiated = max_pool(activation, *arguments)
    np.testing.assert_allclose(undifferentiated, expected[0][1], rtol=1e-5)
    assert (np.asarray(undifferentiated)[0, 0] == 0).all()


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_equal_rows_share_the_gradient_and_invalid_ones_have_none(activation):
    layers, rows, _ = case(4, (3, 5, 4))
    rows[..., 1, :] = rows[..., 3, :] = rows[..., 0, :]
    valid = np.broadcast_to(np.array([True, True, True, False]), rows.shape[:-1])
    _, (weights, by_row) = value_and_gradients(max_pool, activation, layers, rows, valid)
    # Without the copies, the gradient of the weights is the same.
    _, (alone, by_row_alone) = value_and_gradients(
        max_pool, activation, layers, rows[..., ::2, :], valid[..., ::2]
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), weights, alone)
    np.testing.assert_allclose(by_row[..., 0, :], by_row[..., 1, :], rtol=1e-6)
    np.testing.assert_allclose(2.0 * by_row[..., 0, :], by_row_alone[..., 0, :], rtol=1e-4, atol=1e-6)
    assert (np.asarray(by_row)[..., 3, :] == 0.0).all() and np.abs(by_row[..., 0, :]).max() > 0.0


def test_networks_of_several_learners_have_gradients_of_their_own():
    layers, rows, valid = jax.tree.map(jnp.asarray, case(6, (3, 5, 4)))
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, 2.0 * leaf]), layers)

    slope = jax.jit(jax.grad(lambda layers: jnp.sum(max_pool("relu", layers, rows, valid) ** 2)))
    together = jax.vmap(slope)(both)
    for number in range(2):
        alone = slope(jax.tree.map(lambda leaf, number=number: leaf[number], both))
        jax.tree.map(
            lambda a, b, number=number: np.testing.assert_allclose(a[number], b, rtol=1e-4, atol=1e-5),
            together,
            alone,
        )
