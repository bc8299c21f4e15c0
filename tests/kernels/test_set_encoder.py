import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import kernels
from drivax.networks.encoders import max_pool
from kernels.compare import TARGETS, assert_close, needs_kernels, run_on_target

pytestmark = needs_kernels

#: Samples, rows, inputs, width: one of each, and numbers around the sizes of vectors and blocks.
SHAPES = [(1, 1, 1, 32), (3, 5, 7, 32), (2, 1, 21, 64), (17, 31, 6, 32), (4, 300, 19, 64), (64, 16, 21, 32)]


def problem(shape, seed, share=0.5):
    samples, count, inputs, width = shape
    rng = np.random.default_rng(seed)
    layers, size = [], inputs
    for _ in range(2):
        kernel = rng.normal(size=(size, width)) / np.sqrt(size)
        layers.append(
            (jnp.asarray(kernel, jnp.float32), jnp.asarray(rng.normal(size=width) * 0.3, jnp.float32))
        )
        size = width
    rows = rng.normal(size=(samples, count, inputs)).astype(np.float32)
    valid = rng.random((samples, count)) < share
    return tuple(layers), jnp.asarray(rows), jnp.asarray(valid)


def value_and_gradient(layers, rows, valid):
    weight = jnp.asarray(
        np.random.default_rng(7).normal(size=(*valid.shape[:-1], layers[1][1].shape[0])), jnp.float32
    )

    @jax.jit
    def loss(layers):
        output = max_pool("relu", layers, rows, valid)
        return jnp.sum(output * weight), output

    (_, output), gradient = jax.value_and_grad(loss, has_aux=True)(layers)
    return output, gradient


def compare(layers, rows, valid):
    actual = value_and_gradient(layers, rows, valid)
    with kernels.without_kernels():
        expected = value_and_gradient(layers, rows, valid)
    jax.tree.map(assert_close, actual, expected)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_values_and_gradients_equal_those_of_xla(shape, share):
    for seed in range(3):
        compare(*problem(shape, seed, share))


def test_masked_rows_have_no_effect_whatever_they_hold():
    layers, rows, valid = problem((8, 9, 5, 32), 0)
    expected = value_and_gradient(layers, rows, valid)
    for value in (np.nan, np.inf, -np.inf, 1e38):
        actual = value_and_gradient(layers, jnp.where(valid[..., None], rows, value), valid)
        jax.tree.map(np.testing.assert_array_equal, actual, expected)


def with_nan(array, rng):
    """Replace one number."""
    place = tuple(rng.integers(0, size) for size in array.shape)
    return array.at[place].set(np.nan)


@pytest.mark.parametrize("where", ["rows", "kernel1", "bias1", "kernel2", "bias2", "gradient"])
@pytest.mark.parametrize("shape", [(17, 31, 6, 32), (40, 3, 21, 64)], ids=str)
def test_no_nan_is_lost(shape, where):
    """Training stops when it sees NaN: that of a valid row, a weight or a gradient must come out.

    Outputs are those of NumPy, since maxima of XLA may drop NaN on CPUs; gradients have NaN where those of XLA have it.
    """
    for seed in range(4):
        rng = np.random.default_rng(seed)
        layers, rows, valid = problem(shape, seed)
        gradient = jnp.asarray(rng.normal(size=(shape[0], shape[3])), jnp.float32)
        weights = dict(zip(("kernel1", "bias1", "kernel2", "bias2"), jax.tree.leaves(layers), strict=True))
        if where == "rows":
            rows = rows.at[(*rng.choice(np.argwhere(valid)), rng.integers(shape[2]))].set(np.nan)
        elif where == "gradient":
            gradient = gradient.at[tuple(rng.choice(np.argwhere(pool(layers, rows, valid) > 0)))].set(np.nan)
        else:
            weights[where] = with_nan(weights[where], rng)
        layers = jax.tree.unflatten(jax.tree.structure(layers), weights.values())

        def derive(layers, rows=rows, valid=valid, gradient=gradient):
            output, pull = jax.vjp(lambda layers: max_pool("relu", layers, rows, valid), layers)
            return output, pull(gradient)

        output, actual = jax.jit(lambda layers, derive=derive: derive(layers))(layers)
        with kernels.without_kernels():
            _, expected = jax.jit(lambda layers, derive=derive: derive(layers))(layers)
        np.testing.assert_array_equal(np.isnan(output), np.isnan(pool(layers, rows, valid)))
        jax.tree.map(lambda a, b: np.testing.assert_array_equal(np.isnan(a), np.isnan(b)), actual, expected)
        assert any(np.isnan(leaf).any() for leaf in jax.tree.leaves((output, actual)))


def pool(layers, rows, valid):
    """The definition, by NumPy."""
    (kernel1, bias1), (kernel2, bias2) = jax.device_get(layers)
    products = np.maximum(np.asarray(rows) @ kernel1 + bias1, 0.0) @ kernel2
    largest = np.where(np.asarray(valid)[..., None], products, -np.inf).max(axis=1)
    return np.maximum(largest + bias2, 0.0)


def test_equal_rows_have_the_gradient_of_one():
    layers, rows, valid = problem((4, 6, 5, 32), 1, share=1.0)
    twice, both = jnp.concatenate([rows, rows], axis=1), jnp.concatenate([valid, valid], axis=1)
    jax.tree.map(
        assert_close, value_and_gradient(layers, twice, both), value_and_gradient(layers, rows, valid)
    )
    compare(layers, twice, both)


def test_gradient_equals_finite_differences():
    layers, rows, valid = problem((5, 7, 6, 32), 2)

    def loss(layers):
        return jnp.sum(max_pool("relu", layers, rows, valid) ** 2)

    gradient = jax.grad(loss)(layers)
    flat, unravel = jax.flatten_util.ravel_pytree(layers)
    direction = np.random.default_rng(0).normal(size=flat.shape).astype(np.float32)
    change = [float(loss(unravel(flat + sign * 1e-3 * direction))) for sign in (1, -1)]
    slope = jnp.vdot(jax.flatten_util.ravel_pytree(gradient)[0], direction)
    np.testing.assert_allclose(slope, (change[0] - change[1]) / 2e-3, rtol=2e-3)


def test_gradient_of_rows_is_that_of_xla():
    layers, rows, valid = problem((3, 4, 5, 32), 3)
    derive = jax.grad(lambda rows: jnp.sum(max_pool("relu", layers, rows, valid)))
    actual = derive(rows)
    with kernels.without_kernels():
        np.testing.assert_array_equal(actual, derive(rows))
    assert np.abs(actual).max() > 0


def test_batches_of_samples_and_of_weights_equal_single_calls():
    layers, rows, valid = problem((6, 5, 4, 32), 4)
    single = jnp.stack([max_pool("relu", layers, *sample) for sample in zip(rows, valid, strict=True)])
    samples = jax.vmap(lambda rows, valid: max_pool("relu", layers, rows, valid))
    np.testing.assert_array_equal(samples(rows, valid), single)
    nested = jax.jit(jax.vmap(samples))(rows.reshape(2, 3, 5, 4), valid.reshape(2, 3, 5))
    np.testing.assert_array_equal(nested.reshape(single.shape), single)

    scaled = jax.tree.map(lambda weight: jnp.stack([weight, 2 * weight]), layers)
    seeds = jax.vmap(lambda layers, rows: value_and_gradient(layers, rows, valid), in_axes=(0, None))
    for number, factor in enumerate((1, 2)):
        alone = value_and_gradient(jax.tree.map(lambda weight, f=factor: f * weight, layers), rows, valid)
        jax.tree.map(
            lambda a, b, n=number: np.testing.assert_array_equal(a[n], b), seeds(scaled, rows), alone
        )


@pytest.mark.parametrize("target", TARGETS)
def test_older_instruction_sets_pass_the_same_tests(target):
    run_on_target(target, __file__)
