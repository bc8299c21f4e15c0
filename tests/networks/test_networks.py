"""Distributions against numerical integration; the encoder's masks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from drivax.networks.actor_critic import ActorCritic, ActorCriticConfig
from drivax.networks.distributions import SquashedGaussian
from drivax.networks.encoders import MlpConfig, group_spec


def test_squashed_density_integrates_to_one():
    one = SquashedGaussian(jnp.array([0.4]), jnp.array([0.7]))
    action = np.linspace(-0.9999, 0.9999, 20001)
    log_prob = jax.vmap(lambda a: one.log_prob(jnp.arctanh(a)[None]))(jnp.asarray(action))
    assert np.trapezoid(np.exp(log_prob), action) == pytest.approx(1.0, abs=2e-3)


def test_saturated_actions_have_finite_gradients():
    def of(loc):
        return SquashedGaussian(loc, jnp.array([0.5, 0.5])).log_prob(jnp.array([12.0, -9.0]))

    assert bool(jnp.isfinite(jax.grad(of)(jnp.zeros(2))).all())


def test_sample_mean_and_mode():
    one = SquashedGaussian(jnp.array([0.3, -1.0]), jnp.array([0.2, 0.4]))
    samples = jax.vmap(one.sample)(jax.random.split(jax.random.key(0), 4000))
    np.testing.assert_allclose(samples.mean(0), one.loc, atol=0.03)
    np.testing.assert_allclose(samples.std(0), one.scale, atol=0.03)
    np.testing.assert_allclose(one.mode(), np.tanh([0.3, -1.0]), rtol=1e-6)


def observation(rng):
    mask = rng.random((4, 2)) < 0.6
    return {
        "agents": jnp.asarray(rng.normal(size=(4, 2, 3)), jnp.float32),
        "agents_mask": jnp.asarray(mask),
        "ego": jnp.asarray(rng.normal(size=(2, 6)), jnp.float32),
    }


@pytest.mark.parametrize("rows", [(), (8, 8)])
def test_masked_rows_never_matter_and_batches_agree(rows):
    rng = np.random.default_rng(0)
    one = observation(rng)
    config = ActorCriticConfig(encoder=MlpConfig(rows=rows, hidden=(16, 16)), head=(8,))
    network = ActorCritic(config, group_spec(one), nnx.Rngs(0))
    noisy = dict(one, agents=jnp.where(one["agents_mask"][..., None], one["agents"], 99.0))
    np.testing.assert_array_equal(network.policy(one).loc, network.policy(noisy).loc)
    other = observation(rng)
    batch = jax.tree.map(lambda a, b: jnp.stack([a, b]), one, other)
    for row, single in enumerate((one, other)):
        np.testing.assert_allclose(network.value(batch)[row], network.value(single), rtol=1e-5)
        np.testing.assert_allclose(network.policy(batch).scale[row], network.policy(single).scale, rtol=1e-5)


def test_pooled_rows_have_no_order():
    one = observation(np.random.default_rng(2))
    order = jnp.array([2, 0, 3, 1])
    mixed = dict(one, agents=one["agents"][order], agents_mask=one["agents_mask"][order])
    config = ActorCriticConfig(encoder=MlpConfig(rows=(8,), hidden=(16,)), head=(8,))
    network = ActorCritic(config, group_spec(one), nnx.Rngs(0))
    np.testing.assert_allclose(network.value(one), network.value(mixed), rtol=1e-6)
    nobody = dict(one, agents_mask=jnp.zeros_like(one["agents_mask"]))
    assert bool(jnp.isfinite(network.value(nobody)))


def test_an_untrained_policy_is_near_zero_with_the_first_scale():
    one = observation(np.random.default_rng(1))
    network = ActorCritic(ActorCriticConfig(), group_spec(one), nnx.Rngs(0))
    policy = network.policy(one)
    assert float(jnp.abs(policy.loc).max()) < 0.2
    np.testing.assert_allclose(policy.scale, 0.3, atol=0.1)
