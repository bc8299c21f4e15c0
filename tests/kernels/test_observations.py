"""Native observation groups equal those of XLA: floats within 1e-5 (absolute; columns are about 1), masks exactly.

Rounding decides whether a piece of road within a millimetre of the box's sides is inside, and which of two agents as
near is nearer; fuzzed samples with such pieces or agents are left out.
"""

import contextlib
from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import kernels
from drivax.simulator.types import HISTORY, AgentContext, Frame
from drivax.tasks import observations
from drivax.tasks.features import COLUMNS, Features, View
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.perception import Perception
from kernels.compare import TARGETS, needs_kernels, run_on_target
from scenes import RED, bank_of, car, straight_road

pytestmark = needs_kernels

ALL = Features(agents=tuple(COLUMNS["agents"]), road=tuple(COLUMNS["road"]), route=tuple(COLUMNS["route"]))
#: Columns of the presets, all, single ones; numbers of rows around the sizes of vectors; noise and cuts.
CONFIGS = {
    "all": ObservationConfig(agents=16, steps=1, road=32, route=10, features=ALL),
    "few": ObservationConfig(
        agents=3, steps=1, road=5, lanes=False, route=1, route_step_m=3.3,
        features=Features(agents=("type", "route"), road=("limit", "curvature"), route=("goal", "curvature")),
    ),
    "default": ObservationConfig(agents=33, steps=1, road=301, edges=False, road_side_m=80.0, route=17),
    "cut": ObservationConfig(agents=1, steps=1, road=60, road_cut=5, perception=Perception(noise_m=0.5), features=ALL),
}  # fmt: skip
SIZES = [(1, 1, 2), (19, 33, 40), (40, 517, 130)]
SAMPLES, MARGIN = 24, 1e-3


def world(size, seed):
    """A random bank with its arrays that groups read, contexts and frames; masked rows hold NaN and infinity."""
    slots, pieces, points = size
    rng = np.random.default_rng(seed)
    count = 5
    base = bank_of(straight_road([car(0, 0, 0, 9), car(20, 1, 0.3, 6)], light=RED)).part(
        jnp.zeros(count, jnp.int32)
    )

    def angles(*shape):
        angle = rng.uniform(-np.pi, np.pi, shape)
        return np.cos(angle), np.sin(angle)

    routes = rng.normal(size=(count, points, 7)).cumsum(axis=1)
    routes[..., 3:5] = np.stack(angles(count, points), -1)
    routes[..., 5] = rng.choice([-1.0, 8.0, 13.4], (count, points))
    road = rng.uniform(-60, 60, (count, pieces, 7))
    road[..., 2:4] = np.stack(angles(count, pieces), -1)
    road[..., 4:] = np.stack([rng.uniform(0, 10, (count, pieces)), rng.integers(0, 4, (count, pieces)),
                              rng.choice([-1.0, 13.4], (count, pieces))], -1)  # fmt: skip
    bank = replace(
        base, routes=f32(routes), route_points=jnp.asarray(rng.integers(0, points + 1, count), jnp.int32),
        on_lanes=jnp.asarray(rng.random(count) < 0.8), goal=f32(rng.normal(size=(count, 2)) * 100), road=f32(road),
        road_at=f32(np.moveaxis(road[..., [0, 1, 5]], -1, 1)), road_curvature=f32(rng.normal(size=(count, pieces))),
        agent_box=f32(rng.uniform(0.5, 5, (count, slots, 4))), egos=jnp.zeros((count, 1), jnp.int32),
        identity=jnp.arange(count, dtype=jnp.uint32), log_routes=f32(routes), parked=jnp.zeros((count, slots, 8)),
        parked_when=jnp.zeros((count, base.parked_when.shape[1], slots), jnp.uint32),
    )  # fmt: skip
    context = AgentContext(
        index=jnp.asarray(rng.integers(0, count, SAMPLES), jnp.int32), step=jnp.full(SAMPLES, 10),
        slot=jnp.asarray(np.where(rng.random(SAMPLES) < 0.8, 0, rng.integers(0, slots, SAMPLES)), jnp.int32),
        history=f32(rng.normal(size=(SAMPLES, HISTORY, 4)) * [5, 5, 2, 3]), action=jnp.zeros((SAMPLES, 2)),
        route_m=f32(rng.uniform(0, points + 5, SAMPLES)), z=jnp.zeros(SAMPLES), traffic=(),
    )  # fmt: skip
    valid = rng.random((SAMPLES, slots)) < rng.choice([0.0, 0.5, 1.0], (SAMPLES, 1))
    valid[np.arange(SAMPLES), np.asarray(context.slot)] = True
    box = np.concatenate([rng.normal(size=(SAMPLES, slots, 2)) * 20, np.stack(angles(SAMPLES, slots), -1),
                          rng.uniform(0.5, 5, (SAMPLES, slots, 2))], -1)  # fmt: skip
    velocity = rng.normal(size=(SAMPLES, slots, 2)) * 5
    for values in (box, velocity):
        values[~valid] = rng.choice([np.nan, np.inf, -np.inf, 1e38], values.shape)[~valid]
    frame = Frame(
        box=f32(box), velocity=f32(velocity), z=jnp.zeros((SAMPLES, slots)), valid=jnp.asarray(valid),
        kind=jnp.asarray(rng.integers(0, 5, (SAMPLES, slots)), jnp.int32), lights=jnp.zeros((SAMPLES, 1), jnp.int8),
    )  # fmt: skip
    return bank, context, frame


def f32(values):
    return jnp.asarray(values, jnp.float32)


def observe(config, bank, context, frame):
    view = View.of(context)
    groups = observations._agents(
        config, bank, context, view, lambda _, s=None: frame if s is None else frame.at(s)
    )
    groups |= observations._road_group(config, bank, context, view)
    return groups | observations._route(config, bank, context, view)


def run(config, bank, context, frame, natively=True):
    with contextlib.nullcontext() if natively else kernels.without_kernels():
        return jax.device_get(program(config)(bank, context, frame))


@cache
def program(config):
    return jax.jit(jax.vmap(lambda *arrays: observe(config, *arrays), (None, 0, 0)))


def is_clear(config, bank, context, frame):
    """Return for each sample whether no piece lies within a margin of the box's sides, and no agents are as near."""
    motion = np.asarray(context.history[:, -1], np.float64)
    cos, sin = np.cos(motion[:, 2:3]), np.sin(motion[:, 2:3])
    xy = np.asarray(bank.road_at, np.float64)[np.asarray(context.index), :2]
    dx, dy = xy[:, 0] - motion[:, :1], xy[:, 1] - motion[:, 1:2]
    ahead, left = dx * cos + dy * sin, dy * cos - dx * sin
    near = [ahead - config.road_ahead_m, ahead + config.road_behind_m, np.abs(left) - config.road_side_m]
    clear_road = (np.abs(near) > MARGIN).all(axis=(0, 2))
    distance = ((np.asarray(frame.box, np.float64)[..., :2] - motion[:, None, :2]) ** 2).sum(-1)
    distance = np.sort(np.where(np.asarray(frame.valid), distance, np.inf))
    with np.errstate(invalid="ignore"):
        gaps = np.nan_to_num(np.diff(distance), nan=np.inf)
    return clear_road, (gaps > 1e-4).all(axis=1)


def assert_equal(actual, expected, clear_road, clear_agents):
    assert clear_road.mean() > 0.5 and clear_agents.mean() > 0.5
    for name, value in expected.items():
        rows = {"road": clear_road, "agents": clear_agents}.get(name.removesuffix("_mask"), slice(None))
        assert actual[name].dtype == value.dtype
        if name.endswith("_mask"):
            np.testing.assert_array_equal(actual[name][rows], value[rows], err_msg=name)
        else:
            np.testing.assert_allclose(actual[name][rows], value[rows], rtol=1e-5, atol=1e-5, err_msg=name)


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_kernel_equals_jax_on_random_arrays(name, size):
    config = CONFIGS[name]
    for seed in range(4):
        arrays = world(size, seed)
        expected = run(config, *arrays, natively=False)
        assert_equal(run(config, *arrays), expected, *is_clear(config, *arrays))


def test_single_samples_and_nested_batches_equal_batches():
    config, (bank, context, frame) = CONFIGS["all"], world(SIZES[1], 0)
    expected = run(config, bank, context, frame)
    single = jax.jit(partial(observe, config))
    for number in range(3):
        sample = single(bank, *jax.tree.map(lambda leaf, n=number: leaf[n], (context, frame)))
        jax.tree.map(lambda a, b, n=number: np.testing.assert_array_equal(a, b[n]), sample, expected)
    pairs = jax.tree.map(lambda leaf: leaf.reshape(2, -1, *leaf.shape[1:]), (context, frame))
    nested = jax.jit(jax.vmap(jax.vmap(partial(observe, config), (None, 0, 0)), (None, 0, 0)))(bank, *pairs)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a.reshape(b.shape), b), nested, expected)
    banks = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), bank)
    each = jax.jit(jax.vmap(jax.vmap(partial(observe, config), (None, 0, 0)), (0, None, None)))(
        banks, context, frame
    )
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[1], b), each, expected)


def test_derivatives_are_those_of_xla():
    config, arrays = CONFIGS["all"], world(SIZES[1], 1)
    sample = jax.tree.map(lambda leaf: leaf[0], arrays[1:])

    def total(history):
        context = replace(sample[0], history=history)
        return sum(value.sum() for value in jax.tree.leaves(observe(config, arrays[0], context, sample[1])))

    actual = jax.grad(total)(sample[0].history)
    with kernels.without_kernels():
        np.testing.assert_allclose(actual, jax.grad(total)(sample[0].history), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("target", TARGETS)
def test_older_instruction_sets_pass_the_same_tests(target):
    run_on_target(target, __file__)
