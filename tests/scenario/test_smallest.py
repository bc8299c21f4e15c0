import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from drivax.scenario.bank.smallest import embed_number, first_smallest, number_of

smallest = jax.jit(first_smallest, static_argnames=("axis", "least"))


def test_first_smallest_by_hand():
    values = jnp.array([[3.0, 1.0, 2.0, 1.0, jnp.inf], [jnp.inf] * 5, [0.0, 5e-7, 1e-6, 9.0, 1e-3]])
    np.testing.assert_array_equal(smallest(values), [1, 0, 0])
    np.testing.assert_array_equal(smallest(values.T, axis=0), [1, 0, 0])
    np.testing.assert_array_equal(smallest(jnp.array([4.0, -3.0, -7.5]), least=-50.0), 2)
    assert smallest(jnp.array([7.0])) == 0


@given(arrays(np.float32, (4, 37), elements=st.floats(0, 2.0**20, width=32)))
def test_no_value_is_smaller_than_the_minimum(values):
    found = np.asarray(smallest(jnp.asarray(values)))
    chosen = values[np.arange(4), found]
    # Six of the 23 bits are given up.
    np.testing.assert_array_less(chosen, values.min(axis=1) * (1 + 2.0**-16) + 2e-6)


@given(arrays(np.float32, 8, elements=st.floats(-50, 1e4, width=32)))
def test_negative_values_are_compared_from_least(values):
    found = int(smallest(jnp.asarray(values), least=-50.0))
    assert values[found] <= values.min() + (values.min() + 51) * 2.0**-19


@pytest.mark.parametrize("size", [2, 37, 300])
def test_first_smallest_equals_argmin_of_distinct_values(size):
    rng = np.random.default_rng(size)
    values = jnp.asarray(np.stack([rng.permutation(size) + 1.0 for _ in range(64)]), jnp.float32)
    np.testing.assert_array_equal(smallest(values), np.argmin(values, axis=-1))


def test_nan_values_give_a_valid_index():
    assert 0 <= int(smallest(jnp.array([1.0, jnp.nan, 2.0]))) < 3
    assert 0 <= int(smallest(jnp.full(5, jnp.nan))) < 5


def test_low_bits_hold_the_number():
    values = jnp.array([1.0, 2.5, 1e6])
    keys = embed_number(values, jnp.array([0, 5, 7]), 3)
    np.testing.assert_array_equal(number_of(keys, 3), [0, 5, 7])
    np.testing.assert_allclose(keys, values, rtol=2.0**-20)


def test_indices_have_no_gradient():
    slope = jax.grad(lambda values: values[first_smallest(values)] * 3.0)(jnp.array([2.0, 1.0, 5.0]))
    np.testing.assert_array_equal(slope, [0.0, 3.0, 0.0])
