"""The maximum over rows against its plain form, values and gradients, and what its backward pass costs."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.networks.encoders import dense, max_pool, recomputes_maxima


def plain(activation, layers, rows, there):
    return jnp.max(dense(activation, layers, rows), axis=-2, initial=0.0, where=there[..., None])


def case(rows, sizes, seed=0):
    rng = np.random.default_rng(seed)
    layers = [
        (rng.normal(size=(one, other)).astype(np.float32), rng.normal(size=other).astype(np.float32) - 0.5)
        for one, other in pairwise(sizes)
    ]
    there = rng.random((2, 3, rows)) < 0.5
    there[0, 0], there[1, 1] = False, True
    return layers, rng.normal(size=(2, 3, rows, sizes[0])).astype(np.float32), there


@pytest.mark.parametrize("activation", ["relu", "tanh", "gelu", "silu"])
@pytest.mark.parametrize(("rows", "sizes"), [(40, (3, 5, 4)), (3, (3, 5, 4)), (9, (2, 3))])
def test_values_and_gradients_are_those_of_the_plain_maximum(activation, rows, sizes):
    assert recomputes_maxima(rows, sizes) == (rows > 3)
    arguments = case(rows, sizes)
    weights = np.random.default_rng(1).normal(size=(2, 3, sizes[-1])).astype(np.float32)

    def both(layers, x, there):
        def total(function):
            def of(layers, x):
                value = function(activation, layers, x, there)
                return jnp.sum(weights * value), value

            return jax.value_and_grad(of, argnums=(0, 1), has_aux=True)(layers, x)

        return total(max_pool), total(plain), max_pool(activation, layers, x, there)

    found, wanted, undifferentiated = jax.jit(both)(*arguments)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), found, wanted)
    np.testing.assert_allclose(undifferentiated, wanted[0][1], rtol=1e-5)
    assert (np.asarray(undifferentiated)[0, 0] == 0).all()


def test_gradients_of_many_rows_take_a_fraction_of_the_work():
    layers, x, there = jax.tree.map(jnp.asarray, case(64, (11, 16, 16)))

    def operations(function):
        def loss(layers):
            return jnp.sum(function("relu", layers, x, there) ** 2)

        return jax.jit(jax.grad(loss)).lower(layers).compile().cost_analysis()["flops"]

    # A third is the forward pass; of the rest, 16 of 64 rows and the first layer only.
    assert operations(max_pool) < 0.6 * operations(plain)
