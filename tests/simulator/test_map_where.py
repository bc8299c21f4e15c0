"""Sparse evaluation of a batched function."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.simulator.simulator import AT_ONCE, map_where

ROWS = 3 * AT_ONCE + 1


@pytest.mark.parametrize("requested", [0, 1, AT_ONCE, AT_ONCE + 1, ROWS])
def test_map_where_equals_vmap_where_requested_and_zero_elsewhere(requested):
    rng = np.random.default_rng(requested)
    mask = np.zeros(ROWS, bool)
    mask[rng.permutation(ROWS)[:requested]] = True
    number, keys = rng.normal(size=(ROWS, 2)).astype(np.float32), jax.random.split(jax.random.key(3), ROWS)

    def draw(number, key):
        return {"sum": number + jax.random.normal(key, (2,)), "whole": jnp.int32(7), "flag": number[0] > 0}

    found = jax.jit(lambda mask, *rows: map_where(mask, draw, *rows))(mask, number, keys)
    every = jax.vmap(draw)(number, keys)
    for name, leaf in every.items():
        expected = np.where(mask.reshape(-1, *([1] * (leaf.ndim - 1))), leaf, np.zeros_like(leaf))
        np.testing.assert_allclose(found[name], expected, atol=1e-6)


def test_nested_batches_may_request_different_elements():
    mask = jnp.asarray(np.random.default_rng(0).random((3, ROWS)) < 0.4)
    number = jnp.arange(3.0 * ROWS).reshape(3, ROWS) + 1.0
    found = jax.jit(jax.vmap(lambda mask, number: map_where(mask, jnp.square, number)))(mask, number)
    np.testing.assert_array_equal(found, np.where(mask, number**2, 0.0))
