"""Attention encoders against their equations in NumPy, and the rules of masks and orders."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import encoder_oracle as oracle
from drivax.errors import UsageError
from drivax.networks.attention import Attention, EntityConfig, group_shapes
from drivax.networks.encoders import MlpConfig
from drivax.networks.transformers import LqConfig, LqhConfig, MtrConfig, WayformerConfig
from quick import drawn, quick

SPEC = {
    "agents": (3, 2, 4), "agents_mask": (3, 2), "ego": (2, 3), "ego_static": (2,), "lights": (2, 3),
    "lights_mask": (2,), "route": (4, 2), "route_mask": (4,),
}  # fmt: skip
#: Groups without a row: no encoder may notice them.
EMPTY = {"cyclists": (0, 2, 4), "cyclists_mask": (0, 2), "past": (0, 3), "signs": (0, 3), "signs_mask": (0,)}
GROUPS = ("agents", "ego", "ego_static", "lights", "route")
TINY = {"width": 8, "heads": 2}
LATENT = TINY | {"layers": 2, "latents": 3, "embedding": ()}
CONFIGS = {
    "lq": LqConfig(**LATENT | {"embedding": (5,)}),
    "lqh": LqhConfig(**LATENT | {"layers": 1}),
    "mtr": MtrConfig(**TINY, layers=2, embedding=()),
    "late": WayformerConfig(**LATENT | {"layers": 1}),
    "early": WayformerConfig(**LATENT, fusion="early"),
    "hierarchical": WayformerConfig(**LATENT | {"layers": 1}, fusion="hierarchical"),
    "factorised": WayformerConfig(**LATENT | {"layers": 1}, fusion="early", factorised=True),
    "entity": EntityConfig(**TINY),
}
#: A set of series, a series and a set: enough where every group has parameters of its own.
THREE = ("agents", "ego", "route")
TESTED_GROUPS = {"lq": GROUPS, "mtr": GROUPS, "entity": GROUPS, "factorised": ("agents", "ego")}


def spec_of(name):
    return EMPTY | {
        key: SPEC[key] for key in SPEC if key.removesuffix("_mask") in TESTED_GROUPS.get(name, THREE)
    }


def build(config, spec):
    return drawn(lambda: config.build(spec, nnx.Rngs(0)))


def observation(rng, spec):
    groups = {name: rng.normal(size=shape).astype(np.float32) for name, shape in spec.items()}
    masks = {name: groups[name] > -0.5 for name in spec if name.endswith("_mask")}
    # At least one row is valid, and at least one is not.
    for mask in masks.values():
        mask.flat[:1], mask.flat[-1:] = True, False
    return groups | masks


def variants(one):
    """Return an observation, and changed ones with equal or other embeddings."""
    masked = [name for name in GROUPS if f"{name}_mask" in one]
    littered = {name: np.where(one[f"{name}_mask"][..., None], one[name], 777.0) for name in masked}
    mixed = {name: np.roll(one[name], 1, axis=0) for name in one if name.removesuffix("_mask") in masked}
    full = one | {"agents_mask": np.ones_like(one["agents_mask"])}
    return {
        "as it is": one,
        "littered": one | littered,
        "mixed": one | mixed,
        "full": full,
        "backwards": full | {"agents": full["agents"][:, ::-1]},
        "ego backwards": full | {"ego": one["ego"][::-1]} if "ego" in one else full,
        "all masked": one | {name: np.zeros_like(one[name]) for name in one if name.endswith("_mask")},
    }


def by_numpy(config, groups, parameters):
    names = [name for name in GROUPS if name in groups]
    p = jax.tree.map(lambda leaf: np.asarray(leaf, float), nnx.to_pure_dict(parameters))
    if isinstance(config, MtrConfig):
        return oracle.mtr(
            groups, ("agents", "ego", "ego_static"), ("lights", "route"), ("ego", "ego_static"), p
        )
    if isinstance(config, EntityConfig):
        parts = {"ego": ["ego", "ego_static"], "others": ["agents"], "goal": ["route"], "context": ["lights"]}
        return oracle.entity(groups, parts, p)
    return oracle.latent_encoder(groups, names, p)


@pytest.mark.parametrize("name", CONFIGS)
def test_encoders_follow_their_equations_and_rules(name):
    config, spec = CONFIGS[name], spec_of(name)
    graph, parameters = build(config, spec)
    cases = variants(observation(np.random.default_rng(5), spec))
    batch = {key: np.stack([one[key] for one in cases.values()]) for key in spec}
    result = quick(lambda p, groups: nnx.merge(graph, p)(groups), parameters, batch)
    assert result.dtype == np.float32 and result.shape == (len(cases), nnx.merge(graph, parameters).width)
    embedding = dict(zip(cases, result, strict=True))
    for key in ("as it is", "full", "all masked"):
        np.testing.assert_allclose(
            embedding[key], by_numpy(config, cases[key], parameters), rtol=1e-4, atol=2e-5
        )
    for key in ("littered", "mixed"):
        np.testing.assert_allclose(embedding[key], embedding["as it is"], rtol=1e-4, atol=1e-5)
    for key in ("backwards", "ego backwards"):
        assert np.abs(embedding[key] - embedding["full"]).max() > 1e-3, key


@pytest.mark.parametrize("name", ["lq", "entity", pytest.param("mtr", marks=pytest.mark.slow)])
def test_bfloat16_is_close_and_gives_float32(name):
    config, spec = CONFIGS[name], spec_of(name)
    graph, parameters = build(config, spec)
    half, _ = build(replace(config, dtype="bfloat16"), spec)
    batch = jax.tree.map(lambda leaf: leaf[None], observation(np.random.default_rng(5), spec))

    def run(parameters, batch):
        return tuple(nnx.merge(one, parameters)(batch) for one in (graph, half))

    whole, coarse = quick(run, parameters, batch)
    # Eight significant bits: differences of a few per cent of the largest numbers.
    assert coarse.dtype == np.float32 and 0 < np.abs(coarse - whole).max() < 0.1 * np.abs(whole).max()


@pytest.mark.parametrize("name", ["lq", "mtr", "entity"])  # every kind of layer once
def test_gradients_are_finite_where_everything_is_masked(name):
    spec = {key: shape for key, shape in SPEC.items() if key.removesuffix("_mask") in ("agents", "route")}
    config = CONFIGS[name] if name == "entity" else replace(CONFIGS[name], layers=1, embedding=())
    graph, parameters = build(config, spec)
    all_masked = variants(observation(np.random.default_rng(6), spec))["all masked"]
    masks = {name: jnp.asarray(value) for name, value in all_masked.items() if name.endswith("_mask")}
    rows = {name: value for name, value in all_masked.items() if name not in masks}

    def loss(parameters, rows):
        return jnp.sum(nnx.merge(graph, parameters)(rows | masks) ** 2)

    by_parameters, by_rows = quick(jax.grad(loss, argnums=(0, 1)), parameters, rows)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(by_parameters))
    assert any(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(by_parameters)) or name == "mtr"
    jax.tree.map(lambda leaf: np.testing.assert_array_equal(leaf, 0.0), by_rows)


@pytest.mark.parametrize("queries", [2, 6])  # few: keys go to the queries; many: queries to the keys
def test_attention_against_loops(queries):
    rng = np.random.default_rng(queries)
    width, heads = 8, 2
    graph, parameters = nnx.split(nnx.eval_shape(lambda: Attention(width, heads, nnx.Rngs(0))))
    parameters = jax.tree.map(lambda leaf: rng.normal(size=leaf.shape).astype(np.float32), parameters)
    p = jax.tree.map(lambda leaf: np.asarray(leaf, float), nnx.to_pure_dict(parameters))
    query_rows = rng.normal(size=(queries, width)).astype(np.float32)
    tokens = rng.normal(size=(4, 5, width)).astype(np.float32)
    mask = rng.random((4, 5)) < 0.6
    mask[1], mask[2] = False, True

    def run(parameters, query_rows, tokens, mask):
        attention = nnx.merge(graph, parameters)
        repeated = jnp.broadcast_to(query_rows, (4, *query_rows.shape))
        return (
            attention(query_rows, tokens, mask),
            attention(repeated, tokens, mask),
            attention(query_rows, tokens),
        )

    shared, own, unmasked = quick(run, parameters, query_rows, tokens, mask)
    for row in range(4):
        expected = oracle.attention(query_rows.astype(float), tokens[row].astype(float), mask[row], p)
        np.testing.assert_allclose(shared[row], expected, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(own[row], expected, rtol=1e-4, atol=1e-5)
        expected_unmasked = oracle.attention(
            query_rows.astype(float), tokens[row].astype(float), np.ones(5, bool), p
        )
        np.testing.assert_allclose(unmasked[row], expected_unmasked, rtol=1e-4, atol=1e-5)
    assert (shared[1] == 0).all()


def count(config):
    spec = SPEC | EMPTY
    shapes = nnx.state(nnx.eval_shape(lambda: config.build(spec, nnx.Rngs(0))), nnx.Param)
    return sum(leaf.size for leaf in jax.tree.leaves(shapes))


@pytest.mark.slow
def test_parameter_counts_equal_hand_computed_sums():
    # agents 4, ego 3, ego_static 2, lights 3, route 2 features to 8 numbers, each with bias and a norm.
    embedding = (4 + 3 + 2 + 3 + 2) * 8 + 5 * (8 + 16)
    attention, norm, feed_forward = 4 * 8 * 8, 16, 8 * 32 + 32 + 32 * 8 + 8
    block = attention + feed_forward + 2 * norm
    latents = 3 * 8 + attention + norm + block + norm
    assert count(CONFIGS["late"]) == embedding + 5 * latents
    assert count(CONFIGS["lqh"]) == embedding + 6 * latents
    assert count(CONFIGS["early"]) == embedding + latents + block
    assert count(CONFIGS["factorised"]) == embedding + latents + 5 * (2 * block + norm)
    assert (
        count(CONFIGS["mtr"]) == embedding + block + 2 * (2 * (attention + norm) + feed_forward + norm) + norm
    )
    # One hidden layer of 5 per group; two layers that look at the tokens.
    deep = (4 + 3 + 2 + 3 + 2) * 5 + 5 * 5 + 5 * (5 * 8 + 8 + 16)
    assert count(CONFIGS["lq"]) == deep + latents + attention + norm + block
    # Agents 2 x (4 + its mask), ego 2 x (3 + its mask) numbers a row.
    entities = (10 + 8 + 2 + 3 + 2) * 8 + 5 * 8
    assert count(CONFIGS["entity"]) == entities + attention + norm
    # As published: 4 layers of two attentions and 8 d^2 of dense layers, d 256, 16 latents, a linear embedding.
    d = 256
    layer = 2 * 4 * d * d + 8 * d * d + 5 * d + 3 * 2 * d
    assert count(LqConfig(size="published")) == 14 * d + 5 * 3 * d + 16 * d + 4 * layer + 2 * d


def test_groups_are_classified_by_masks_and_axes():
    result = {
        name: (f.masked, f.rows, f.times, f.features, f.series) for name, f in group_shapes(SPEC).items()
    }
    assert result == {
        "agents": (True, 3, 2, 4, True), "ego": (False, 1, 2, 3, True), "ego_static": (False, 1, 1, 2, False),
        "lights": (True, 2, 1, 3, False), "route": (True, 4, 1, 2, False),
    }  # fmt: skip
    one = group_shapes({"agents": (3, 1, 4), "agents_mask": (3, 1), "ego": (1, 3)})
    assert one["agents"].series and one["ego"].series


@pytest.mark.parametrize("config", [MlpConfig(), MlpConfig(rows=(8,)), *CONFIGS.values()])
def test_empty_observations_are_refused(config):
    for spec in ({}, EMPTY):
        with pytest.raises(UsageError, match="all groups are empty; observe at least one row"):
            config.build(spec, nnx.Rngs(0))


@pytest.mark.parametrize("name", ["lq", "mtr", "entity"])
@pytest.mark.parametrize("missing", ["masked", "unmasked"])
def test_encoders_accept_sets_only_or_ego_only(name, missing):
    expected = [g for g in GROUPS if (f"{g}_mask" in SPEC) != (missing == "masked")]
    spec = {key: shape for key, shape in SPEC.items() if key.removesuffix("_mask") in expected}
    graph, parameters = build(CONFIGS[name], spec)
    one = observation(np.random.default_rng(7), spec)
    result = quick(lambda p, groups: nnx.merge(graph, p)(groups), parameters, one)
    assert np.isfinite(result).all() and np.abs(result).max() > 0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: LqConfig(width=10, heads=4), "width 10 is not a multiple of 4 heads"),
        (lambda: LqConfig(latents=0), "latents is 0; use 1 or more"),
        (lambda: LqhConfig(local_layers=0), "local_layers is 0; use 1 or more"),
        (lambda: MtrConfig(layers=0), "layers is 0; use 1 or more"),
        (lambda: LqConfig(embedding=(8, 0)), "embedding has a layer of width 0"),
        (lambda: EntityConfig(width=6), "width 6 is not a multiple of 4 heads"),
        (lambda: EntityConfig(width=0), "width is 0; use 1 or more"),
        (lambda: EntityConfig(heads=0), "heads is 0; use 1 or more"),
    ],
)
def test_impossible_sizes_are_refused(make, words):
    with pytest.raises(UsageError, match=words):
        make()


def test_attention_of_many_tokens_is_refused():
    attention = nnx.eval_shape(lambda: Attention(64, 8, nnx.Rngs(0)))
    tokens = jax.ShapeDtypeStruct((2, 4096, 64), jnp.float32)
    with pytest.raises(
        UsageError, match="4,096 queries to 4,096 tokens has 134,217,728 weights; use 67,108,864"
    ):
        nnx.eval_shape(lambda module, x: module(x, x), attention, tokens)


@pytest.mark.parametrize("asking", [None, 2])
def test_products_of_bfloat16_in_large_batches(asking):
    """As float32 within the eight bits of the operands, gradients too: not every backend has such products itself."""
    rng = np.random.default_rng(3)
    tokens = jnp.asarray(rng.normal(size=(256, 30, 128)), jnp.float32)
    queries = tokens if asking is None else tokens[0, :asking]
    result, slopes = {}, {}
    for dtype in ("float32", "bfloat16"):
        graph, weights = nnx.split(Attention(128, 4, nnx.Rngs(0), dtype))

        def look(weights, queries, tokens, graph=graph):
            return nnx.merge(graph, weights)(queries, tokens)

        def squares(*given, look=look):
            return jnp.sum(look(*given) ** 2)

        result[dtype] = jax.jit(look)(weights, queries, tokens)
        slopes[dtype] = jax.tree.leaves(jax.jit(jax.grad(squares))(weights, queries, tokens))
    assert result["bfloat16"].dtype == jnp.float32
    exacts, others = ([result[dtype], *slopes[dtype]] for dtype in ("float32", "bfloat16"))
    for exact, other in zip(exacts, others, strict=True):
        assert 0.0 < np.abs(exact - other).max() < 0.03 * np.abs(exact).max()
