"""Statistics of features against NumPy, and what they make of observations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from drivax.networks.encoders import MlpConfig, NormalisedConfig, feature_statistics, set_statistics
from quick import quick

SPEC = {"ego": (3,), "agents": (4, 2), "agents_mask": (4,)}


@pytest.fixture(scope="module")
def groups():
    rng = np.random.default_rng(0)
    mask = rng.random((50, 4)) < 0.6
    agents = rng.normal([100.0, -3.0], [0.5, 20.0], size=(50, 4, 2))
    ego = rng.normal(size=(50, 3)) * [1.0, 5.0, 0.0]
    return {
        "ego": jnp.asarray(ego, jnp.float32),
        "agents": jnp.asarray(np.where(mask[..., None], agents, 0.0), jnp.float32),
        "agents_mask": jnp.asarray(mask),
    }


def test_statistics_use_valid_rows_only(groups):
    statistics = feature_statistics(groups)
    assert set(statistics) == {"ego", "agents"}
    rows = np.asarray(groups["agents"], np.float64)[np.asarray(groups["agents_mask"])]
    np.testing.assert_allclose(statistics["agents"][0], rows.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(statistics["agents"][1], rows.std(axis=0), rtol=1e-4)
    np.testing.assert_allclose(
        statistics["ego"][1], np.asarray(groups["ego"], np.float64).std(axis=0), atol=1e-5
    )
    # Another order of rows, and other numbers in masked ones, are the same rows.
    order = np.random.default_rng(1).permuted(np.tile(np.arange(4), (50, 1)), axis=1)
    filled = jnp.where(groups["agents_mask"][..., None], groups["agents"], jnp.nan)
    other = {
        "ego": groups["ego"],
        "agents": jnp.take_along_axis(filled, jnp.asarray(order)[..., None], axis=1),
        "agents_mask": jnp.take_along_axis(groups["agents_mask"], jnp.asarray(order), axis=1),
    }
    for one, again in zip(
        jax.tree.leaves(statistics), jax.tree.leaves(feature_statistics(other)), strict=True
    ):
        np.testing.assert_allclose(one, again, rtol=1e-4, atol=1e-6)
    all_masked = groups | {"agents_mask": jnp.zeros((50, 4), bool)}
    np.testing.assert_array_equal(jnp.stack(feature_statistics(all_masked)["agents"]), [[0, 0], [1, 1]])


def test_normalised_features_have_zero_mean_and_unit_deviation(groups):
    encoder = NormalisedConfig(MlpConfig(rows=(8,), hidden=(8,))).build(SPEC, nnx.Rngs(0))
    plain = encoder.encoder
    # Without statistics it changes nothing but what is very far.
    near = {**groups, "agents": groups["agents"] / 100, "ego": groups["ego"] / 10}
    np.testing.assert_allclose(encoder(near), plain(near), rtol=1e-5)
    set_statistics(encoder, feature_statistics(groups))
    rows = np.asarray(encoder._normalise("agents", groups["agents"]))[np.asarray(groups["agents_mask"])]
    np.testing.assert_allclose(rows.mean(axis=0), 0.0, atol=1e-3)
    np.testing.assert_allclose(rows.std(axis=0), 1.0, rtol=1e-3)
    # A feature that is always the same stays finite, and one that is far off is clipped.
    assert np.isfinite(encoder({**groups, "ego": groups["ego"].at[:, 2].set(7.0)})).all()
    assert float(encoder._normalise("ego", jnp.array([1e6, 0.0, 0.0]))[0]) == 10.0


def test_no_gradient_reaches_statistics(groups):
    encoder = NormalisedConfig(MlpConfig(hidden=(8,))).build(SPEC, nnx.Rngs(0))
    set_statistics(encoder, feature_statistics(groups))
    graph, parameters = nnx.split(encoder, nnx.Param)
    slopes = quick(jax.grad(lambda p: nnx.merge(graph, p)(groups).sum()), parameters)
    for name in ("mean", "deviation"):
        assert all((np.asarray(leaf) == 0.0).all() for leaf in jax.tree.leaves(slopes[name]))
    assert any((np.asarray(leaf) != 0.0).any() for leaf in jax.tree.leaves(slopes["encoder"]))
