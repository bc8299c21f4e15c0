"""Policies, values and critics; the MLP encoder's masks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from drivax import settings
from drivax.errors import UsageError
from drivax.networks.actor_critic import ActorCritic, NetworkConfig, Policy, TwinCritic
from drivax.networks.distributions import Actions
from drivax.networks.encoders import MlpConfig, group_spec
from drivax.networks.entity import EntityConfig
from drivax.networks.transformers import LqConfig, LqhConfig, MtrConfig, WayformerConfig

SMALL = NetworkConfig(encoder=MlpConfig(hidden=(8,)), head=(4,))
LEVELS = ((-1.0, 0.0, 1.0), (-1.0, -0.5, 0.0, 0.5, 1.0))


def observation(rng):
    mask = rng.random((4, 2)) < 0.6
    return {
        "agents": jnp.asarray(rng.normal(size=(4, 2, 3)), jnp.float32),
        "agents_mask": jnp.asarray(mask),
        "ego": jnp.asarray(rng.normal(size=(2, 6)), jnp.float32),
    }


def size(module):
    return sum(leaf.size for leaf in jax.tree.leaves(nnx.state(module, nnx.Param)))


@pytest.mark.parametrize("rows", [(), (8, 8)])
def test_masked_rows_never_matter_and_batches_agree(rows):
    rng = np.random.default_rng(0)
    one = observation(rng)
    config = NetworkConfig(encoder=MlpConfig(rows=rows, hidden=(16, 16)), head=(8,))
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
    config = NetworkConfig(encoder=MlpConfig(rows=(8,), hidden=(16,)), head=(8,))
    network = ActorCritic(config, group_spec(one), nnx.Rngs(0))
    np.testing.assert_allclose(network.value(one), network.value(mixed), rtol=1e-6)
    nobody = dict(one, agents_mask=jnp.zeros_like(one["agents_mask"]))
    assert bool(jnp.isfinite(network.value(nobody)))


def test_an_untrained_policy_is_near_zero_with_the_first_scale():
    one = observation(np.random.default_rng(1))
    network = ActorCritic(NetworkConfig(), group_spec(one), nnx.Rngs(0))
    policy = network.policy(one)
    assert float(jnp.abs(policy.loc).max()) < 0.2
    np.testing.assert_allclose(policy.scale, 0.3, atol=0.1)


@pytest.mark.parametrize("kind", ["gaussian", "beta", "grid"])
def test_every_distribution_has_a_head(kind):
    one = observation(np.random.default_rng(1))
    config = NetworkConfig(encoder=MlpConfig(hidden=(8,)), distribution=kind)
    policy = Policy(config, group_spec(one), nnx.Rngs(0), Actions(2, LEVELS))
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), one)
    found = jax.jit(lambda groups, key: (d := policy(groups), d.sample(key)))(batch, jax.random.key(0))
    action = found[0].action(found[1])
    assert action.shape == (3, 2) and float(jnp.abs(found[0].mean_action()).max()) < 0.05
    assert found[0].log_prob(found[1]).shape == (3,)


@pytest.mark.parametrize("shared", [False, True])
def test_both_is_policy_and_value_and_a_shared_encoder_is_one(shared):
    one = observation(np.random.default_rng(3))
    network = ActorCritic(
        NetworkConfig(SMALL.encoder, (4,), shared_encoder=shared), group_spec(one), nnx.Rngs(0)
    )
    policy, value = network.both(one)
    np.testing.assert_allclose(policy.loc, network.policy(one).loc, rtol=1e-6)
    np.testing.assert_allclose(value, network.value(one), rtol=1e-6)
    # 16 + 8 + 12 numbers in: 24 of agents, their 8 masks, 12 of ego; heads 8 -> 4 -> 4 and 8 -> 4 -> 1.
    encoder, heads = (24 + 8 + 12) * 8 + 8, (8 * 4 + 4 + 4 * 4 + 4) + (8 * 4 + 4 + 4 + 1)
    assert size(network) == encoder * (1 if shared else 2) + heads
    graph, parameters = nnx.split(network)

    def loss(parameters):
        return nnx.merge(graph, parameters).value(one)

    gradient = jax.grad(loss)(parameters)
    reaches_policy = any(float(jnp.abs(leaf).max()) > 0 for leaf in jax.tree.leaves(gradient["policy"]))
    assert reaches_policy == shared
    alone, weights = nnx.split(network.policy)
    np.testing.assert_array_equal(nnx.merge(alone, weights)(one).loc, policy.loc)


def test_twin_critics_share_nothing_and_can_be_negative():
    rng = np.random.default_rng(4)
    one = observation(rng)
    twins = TwinCritic(SMALL, group_spec(one), nnx.Rngs(0), Actions(2))
    graph, parameters = nnx.split(twins)
    assert size(twins) == 2 * ((24 + 8 + 12) * 8 + 8 + (8 + 2) * 4 + 4 + 4 + 1)
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(observation(rng) for _ in range(64)))
    values = twins(batch, jnp.asarray(rng.uniform(-1, 1, (64, 2)), jnp.float32))
    assert values.shape == (2, 64) and float(values.min()) < 0 < float(values.max())
    assert float(jnp.abs(values[0] - values[1]).max()) > 1e-2
    action = jnp.array([0.3, -0.2])
    first = jax.grad(lambda p: nnx.merge(graph, p)(one, action)[0])(parameters)
    reached = [
        float(jnp.abs(first["critics"][i]["head"]["out"]["kernel"].get_value()).max()) for i in range(2)
    ]
    assert reached[0] > 0 and reached[1] == 0
    by_action = jax.grad(lambda a: twins(one, a)[0])(action)
    assert float(jnp.abs(by_action).min()) > 0


def load(text):
    return settings.load(NetworkConfig, settings.parse_yaml(text))


def test_encoders_in_yaml():
    assert load("encoder: {kind: lq, size: small}").encoder == LqConfig()
    assert load("encoder: lqh").encoder == LqhConfig()
    assert load("encoder: {hidden: [8]}").encoder == MlpConfig(hidden=(8,))
    wayformer = load(
        "encoder: {kind: wayformer, size: published, fusion: early, latents: 4, dtype: bfloat16}"
    ).encoder
    assert wayformer == WayformerConfig(size="published", fusion="early", latents=4, dtype="bfloat16")
    assert (wayformer.sizes.width, wayformer.sizes.heads, wayformer.sizes.layers) == (256, 8, 4)
    for encoder in (
        wayformer,
        LqConfig(embedding=()),
        MtrConfig(layers=1),
        EntityConfig(goal=("route", "goal")),
    ):
        config = NetworkConfig(encoder=encoder, distribution="beta")
        assert load(settings.dump(config)) == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("encoder: {kind: lqq}", r"^encoder: there is no kind 'lqq'; did you mean 'lq'"),
        (
            "encoder: {kind: cnn}",
            r"^encoder: there is no kind 'cnn'; use one of mlp, lq, lqh, mtr, wayformer, entity",
        ),
        ("encoder: {kind: lq, size: tiny}", r"^encoder\.size: 'tiny' is none of published, small"),
        ("encoder: {kind: mtr, latents: 8}", r"^encoder\.latents: there is no such setting"),
        ("encoder: {kind: lq, width: 10}", r"^encoder: width 10 is no multiple of 4 heads"),
        (
            "encoder: {kind: wayformer, fusion: soon}",
            r"^encoder\.fusion: 'soon' is none of early, late, hier",
        ),
        ("distribution: normal", r"^distribution: 'normal' is none of gaussian, beta, grid"),
        ("first_scale: 0", r"^first_scale is 0; use more than 0"),
    ],
)
def test_mistaken_networks_are_named(text, message):
    with pytest.raises(UsageError, match=message):
        load(text)
