"""Policies, values and critics; the MLP encoder's masks."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from drivax import settings
from drivax.errors import UsageError
from drivax.networks.actor_critic import ActorCritic, NetworkConfig, Policy, TwinCritic, graph_of
from drivax.networks.attention import EntityConfig
from drivax.networks.distributions import Actions
from drivax.networks.encoders import MlpConfig
from drivax.networks.transformers import LqConfig, LqhConfig, MtrConfig, WayformerConfig
from quick import drawn, quick

SMALL = NetworkConfig(encoder=MlpConfig(hidden=(8,)), head=(4,))
LEVELS = ((-1.0, 0.0, 1.0), (-1.0, -0.5, 0.0, 0.5, 1.0))


def shapes(observation):
    return {name: value.shape for name, value in observation.items()}


def observation(rng):
    mask = rng.random((4, 2)) < 0.6
    return {
        "agents": jnp.asarray(rng.normal(size=(4, 2, 3)), jnp.float32),
        "agents_mask": jnp.asarray(mask),
        "ego": jnp.asarray(rng.normal(size=(2, 6)), jnp.float32),
        # Without a row: as if it were not there.
        "lights": jnp.zeros((0, 7)),
        "lights_mask": jnp.zeros(0, bool),
    }


def size(parameters):
    return sum(leaf.size for leaf in jax.tree.leaves(parameters))


def stacked(*observations):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *observations)


@pytest.mark.parametrize("rows", [(), (8, 8)])
def test_masked_rows_have_no_effect_and_batches_agree(rows):
    rng = np.random.default_rng(0)
    one, other = observation(rng), observation(rng)
    config = NetworkConfig(encoder=MlpConfig(rows=rows, hidden=(16, 16)), head=(8,))
    graph, parameters = drawn(lambda: ActorCritic(config, shapes(one), nnx.Rngs(0)))
    noisy = dict(one, agents=jnp.where(one["agents_mask"][..., None], one["agents"], 99.0))
    all_masked = dict(one, agents_mask=jnp.zeros_like(one["agents_mask"]))

    def run(parameters, single, batch):
        network = nnx.merge(graph, parameters)
        return network.policy_and_value(single), network.policy_and_value(batch)

    single, batch = quick(run, parameters, one, stacked(one, noisy, other, all_masked))
    for alone, together in zip(jax.tree.leaves(single), jax.tree.leaves(batch), strict=True):
        np.testing.assert_array_equal(together[0], together[1])
        np.testing.assert_allclose(together[0], alone, rtol=1e-5)
        assert np.abs(together[2] - together[0]).max() > 1e-3 and np.isfinite(together[3]).all()


def test_pooled_rows_have_no_order():
    one = observation(np.random.default_rng(2))
    order = jnp.array([2, 0, 3, 1])
    permuted = dict(one, agents=one["agents"][order], agents_mask=one["agents_mask"][order])
    spec = shapes(one)
    graph, parameters = drawn(lambda: MlpConfig(rows=(8,), hidden=(16,)).build(spec, nnx.Rngs(0)))
    result = quick(lambda p, groups: nnx.merge(graph, p)(groups), parameters, stacked(one, permuted))
    np.testing.assert_allclose(result[0], result[1], rtol=1e-6)


@pytest.mark.parametrize("kind", ["gaussian", "beta", "grid", "mixture"])
def test_heads_of_all_distributions_start_at_zero(kind):
    one = observation(np.random.default_rng(1))
    config = NetworkConfig(encoder=MlpConfig(hidden=(8,)), distribution=kind)

    def run(groups, key):
        result = Policy(config, shapes(one), nnx.Rngs(key), Actions(2, LEVELS))(groups)
        many = jax.vmap(result.sample)(jax.random.split(key, 2000))
        return result.mean_action(), result.action(many), result.log_prob(many[0])

    mean, actions, log_prob = quick(run, stacked(one, one, one), jax.random.key(0))
    assert mean.shape == (3, 2) and np.abs(mean).max() < 0.05
    assert log_prob.shape == (3,) and actions.shape == (2000, 3, 2)
    # 0.3 as configured, less by tanh. Levels of the grid are too coarse, and means of a mixture differ.
    if kind in ("gaussian", "beta"):
        np.testing.assert_allclose(actions.std(0), 0.28 if kind == "gaussian" else 0.3, atol=0.025)


@pytest.mark.parametrize("shared", [False, True])
def test_shared_encoder_runs_once_for_policy_and_value(shared):
    one = observation(np.random.default_rng(3))
    config = NetworkConfig(SMALL.encoder, (4,), shared_encoder=shared)
    graph, parameters = drawn(lambda: ActorCritic(config, shapes(one), nnx.Rngs(0)))
    # 24 + 8 + 12 inputs: 24 of agents, their 8 masks, 12 of ego; heads 8 -> 4 -> 4 and 8 -> 4 -> 1.
    encoder, heads = (24 + 8 + 12) * 8 + 8, (8 * 4 + 4 + 4 * 4 + 4) + (8 * 4 + 4 + 4 + 1)
    assert size(parameters) == encoder * (1 if shared else 2) + heads

    def run(parameters, groups):
        network = nnx.merge(graph, parameters)
        alone, weights = nnx.split(network.policy)
        policy, value = network.policy_and_value(groups)
        apart = network.policy(groups).loc, network.value(groups), nnx.merge(alone, weights)(groups).loc
        return (policy.loc, value, policy.loc), apart

    together, apart = quick(run, parameters, one)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), together, apart)

    gradient = quick(jax.grad(lambda p: nnx.merge(graph, p).value(one)), parameters)
    reaches_policy = any(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(gradient["policy"]))
    assert reaches_policy == shared


def test_twin_critics_share_nothing_and_can_be_negative():
    rng = np.random.default_rng(4)
    one = observation(rng)
    graph, parameters = drawn(lambda: TwinCritic(SMALL, shapes(one), nnx.Rngs(0), Actions(2)))
    assert size(parameters) == 2 * ((24 + 8 + 12) * 8 + 8 + (8 + 2) * 4 + 4 + 4 + 1)
    batch = stacked(*(observation(rng) for _ in range(64)))
    actions = jnp.asarray(rng.uniform(-1, 1, (64, 2)), jnp.float32)

    def run(parameters, batch, actions):
        values, pull = jax.vjp(lambda p, a: nnx.merge(graph, p)(batch, a), parameters, actions)
        return values, *pull(jnp.stack([jnp.ones(64), jnp.zeros(64)]))

    values, by_parameters, by_action = quick(run, parameters, batch, actions)
    assert values.shape == (2, 64) and values.min() < 0 < values.max()
    assert np.abs(values[0] - values[1]).max() > 1e-2
    reached = [
        max(np.abs(leaf).max() for leaf in jax.tree.leaves(by_parameters["critics"][number]))
        for number in (0, 1)
    ]
    assert reached[0] > 0 and reached[1] == 0
    assert (np.abs(by_action).max(-1) > 0).all()


def test_normalised_critics_against_numpy():
    one = observation(np.random.default_rng(5))
    config = NetworkConfig(SMALL.encoder, (4,), critic_norm=True)
    graph, parameters = drawn(lambda: TwinCritic(config, shapes(one), nnx.Rngs(0), Actions(2)))
    action = jnp.array([[0.3, -0.2], [300.0, -200.0]])

    def run(parameters, groups, action):
        critics = nnx.merge(graph, parameters)
        embedding = jnp.stack([critic.encoder(groups) for critic in critics.critics])
        return critics(groups, action), embedding, nnx.state([critic.head for critic in critics.critics])

    values, embedding, heads = quick(run, parameters, one, action)
    for number in (0, 1):
        head = heads[number]
        inputs = np.concatenate([np.broadcast_to(embedding[number], (2, 8)), action], axis=1)
        hidden = inputs @ head["hidden"][0]["kernel"] + head["hidden"][0]["bias"]
        mean, variance = hidden.mean(-1, keepdims=True), hidden.var(-1, keepdims=True)
        normalised = (hidden - mean) / np.sqrt(variance + 1e-6)
        activated = np.tanh(normalised * head["norms"][0]["scale"] + head["norms"][0]["bias"])
        expected = activated @ head["out"]["kernel"] + head["out"]["bias"]
        np.testing.assert_allclose(values[number], expected[:, 0], rtol=1e-4, atol=1e-5)
    # The policy's head has none.
    plain, with_norm = (
        drawn(lambda config=config: Policy(config, shapes(one), nnx.Rngs(0), Actions(2)))[1]
        for config in (SMALL, config)
    )
    assert size(plain) == size(with_norm)


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
        ("encoder: {kind: lqq}", r"^encoder: unknown kind 'lqq'; did you mean 'lq'"),
        (
            "encoder: {kind: cnn}",
            r"^encoder: unknown kind 'cnn'; use one of mlp, lq, lqh, mtr, wayformer, entity",
        ),
        ("encoder: {kind: lq, size: tiny}", r"^encoder\.size: 'tiny' is not one of published, small"),
        ("encoder: {kind: mtr, latents: 8}", r"^encoder\.latents: unknown setting"),
        ("encoder: {kind: lq, width: 10}", r"^encoder: width 10 is not a multiple of 4 heads"),
        (
            "encoder: {kind: wayformer, fusion: soon}",
            r"^encoder\.fusion: 'soon' is not one of early, late, hier",
        ),
        ("distribution: normal", r"^distribution: 'normal' is not one of gaussian, beta, grid"),
        ("first_scale: 0", r"^first_scale is 0(\.0)?; use one or more numbers above 0"),
        ("first_scale: []", r"^first_scale is \(\); use one or more"),
        ("first_scale: .nan", "^first_scale is nan; use one or more"),
        ("head: [0]", "^head has a layer of width 0; use 1 or more"),
        ("encoder: {kind: mlp, hidden: [8, -1]}", "^encoder: hidden has a layer of width -1"),
    ],
)
def test_mistaken_networks_are_named(text, message):
    with pytest.raises(UsageError, match=message):
        load(text)


@pytest.mark.parametrize("layers", [2, 20])
def test_networks_of_many_parameters_are_refused(layers):
    """Each layer has 16.8 million, and none takes memory."""
    config = NetworkConfig(encoder=MlpConfig(hidden=(4096,) * layers))
    network = nnx.eval_shape(lambda: Policy(config, {"ego": (3,)}, nnx.Rngs(0)))
    if layers == 2:
        assert graph_of(network) == nnx.graphdef(network)
        return
    with pytest.raises(UsageError, match=r"a network has 319,[\d,]+ parameters; use 33,554,432 or less"):
        graph_of(network)


def test_policy_explores_by_action_and_never_less_than_a_share():
    """Heads that ask for tiny standard deviations get a tenth of the first ones."""
    spec = {"ego": (3,)}
    config = NetworkConfig(encoder=MlpConfig(hidden=(8,)), first_scale=(0.3, 0.02), least_scale=0.1)
    policy = Policy(config, spec, nnx.Rngs(0))
    fresh = policy({"ego": jnp.zeros(3)})
    np.testing.assert_allclose(fresh.scale, [0.3, 0.02], rtol=0.02)
    policy.head.out.bias[...] = jnp.full(4, -20.0)
    np.testing.assert_allclose(policy({"ego": jnp.zeros(3)}).scale, [0.03, 0.002], rtol=1e-5)
    with pytest.raises(
        UsageError, match="first_scale has 3 numbers for actions of 2; give one, or one for each number"
    ):
        Policy(replace(config, first_scale=(0.1, 0.1, 0.1)), spec, nnx.Rngs(0))({"ego": jnp.zeros(3)})


def test_mlp_without_hidden_layers_returns_the_features():
    encoder, ego = MlpConfig(hidden=()).build({"ego": (3,)}, nnx.Rngs(0)), jnp.array([1.0, 2.0, 3.0])
    assert encoder.width == 3 and encoder({"ego": ego}).tolist() == ego.tolist()


def test_flat_groups_keep_the_order_of_their_rows():
    """A pooled group is the same in any order of its rows, a flat one is not."""
    spec = {"agents": (4, 3), "agents_mask": (4,), "route": (4, 3), "route_mask": (4,)}
    encoder = MlpConfig(rows=(8,), flat=("route",), hidden=(16,)).build(spec, nnx.Rngs(0))
    rows = jax.random.normal(jax.random.key(0), (4, 3))
    groups = dict.fromkeys(("agents", "route"), rows) | dict.fromkeys(
        ("agents_mask", "route_mask"), jnp.ones(4, bool)
    )
    whole = encoder(groups)
    np.testing.assert_allclose(encoder(groups | {"agents": rows[::-1]}), whole, atol=1e-6)
    assert np.abs(encoder(groups | {"route": rows[::-1]}) - whole).max() > 0.01
