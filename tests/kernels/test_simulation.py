"""Kernels of the simulator's step against XLA: contacts, the look ahead along the route, frames and lights."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import kernels
from drivax.scenario.bank.columns import NEVER_M, LightRow
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.simulator.ahead import ahead
from drivax.simulator.contact import Contact
from drivax.simulator.situation import _measure_contacts
from drivax.simulator.types import HISTORY, AgentContext, Frame
from kernels.compare import TARGETS, needs_kernels, run_on_target
from scenes import RED, SMALL, car, straight_road

pytestmark = needs_kernels

READS = frozenset({"ttc_s", "collision", "at_fault", "collision_type"})
#: Samples of a fuzzed batch.
BATCH = 192


@cache
def jitted(function, axes):
    """The function of a batch, by kernels and by XLA."""
    batch = jax.jit(jax.vmap(function, axes))

    @jax.jit
    def reference(*arguments):
        with kernels.without_kernels():
            return jax.vmap(function, axes)(*arguments)

    return batch, reference


def widen(leaf):
    leaf = np.asarray(leaf)
    return leaf.astype(np.float64) if leaf.dtype == np.float32 else leaf


def equal_samples(actual, expected):
    """Mask of the samples of which all leaves are equal, floats up to 1e-5."""
    same = True
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        a, b = (np.asarray(leaf).reshape(len(leaf), -1) for leaf in (a, b))
        if b.dtype.kind == "f":
            near = np.isclose(a, b, rtol=1e-5, atol=1e-5, equal_nan=True)
        else:
            near = a == b
        same &= near.all(axis=1)
    return same


def assert_same(function, axes, arguments, rare=0.01):
    """Kernels give what XLA gives, but for samples on a threshold, which rounding moves to either side.

    These are found in float64: when their numbers change by the rounding of float32, the result becomes that of the
    kernel, too. At most the share ``rare`` of the samples may be such ones.
    """
    native, xla = jitted(function, axes)
    actual, expected = jax.device_get((native(*arguments), xla(*arguments)))
    differs = np.flatnonzero(~equal_samples(actual, expected))
    assert len(differs) <= rare * len(jax.tree.leaves(actual)[0])
    for sample in differs:
        result = jax.tree.map(lambda leaf, i=sample: np.stack([leaf[i]] * 100), actual)
        nearby = jax.tree.map(widen, results_nearby(function, axes, arguments, sample))
        assert equal_samples(result, nearby).any(), sample
    return expected


@cache
def jitted_in_float64(function, axes):
    return jax.jit(jax.vmap(function, axes))


def results_nearby(function, axes, arguments, sample, count=100):
    """Results in float64 of a sample whose numbers change by the rounding of float32."""
    rng = np.random.default_rng(0)

    def spread(leaf):
        values = np.broadcast_to(widen(leaf)[sample], (count, *np.shape(leaf)[1:]))
        if values.dtype != np.float64:
            return values
        noise = rng.uniform(-1, 1, values.shape) * np.maximum(np.abs(values), 1.0)
        return values + 2e-7 * noise * rng.choice([0.1, 1.0, 8.0], (count,) + (1,) * (values.ndim - 1))

    with jax.enable_x64(True):
        spreads = [
            jax.tree.map(spread if axis == 0 else widen, argument)
            for argument, axis in zip(arguments, axes, strict=True)
        ]
        return jax.device_get(jitted_in_float64(function, axes)(*spreads))


def random_frames(rng, slots, batch=BATCH, share=0.7, spread_m=12.0, known=False):
    """Agents around the origin, some of them on other levels; empty slots hold any numbers, but for ``known`` ones."""
    shape = (batch, slots)
    heading = rng.choice([0.0, np.pi / 2, np.pi, 0.6], shape) + rng.normal(0, 0.2, shape)
    size = rng.uniform([0.5, 0.5], [6.0, 2.5], (*shape, 2))
    xy = rng.normal(0, spread_m, (*shape, 2))
    box = np.concatenate([xy, np.cos(heading)[..., None], np.sin(heading)[..., None], size], -1)
    velocity = rng.normal(0, 6, (*shape, 2)) * rng.choice([0.0, 0.004, 1.0], (*shape, 1), p=[0.2, 0.1, 0.7])
    z = rng.choice([0.0, 2.0, 5.0], shape, p=[0.8, 0.1, 0.1])
    valid = rng.random(shape) < share
    any_number = rng.choice([np.nan, np.inf, -np.inf, 1e38, 0.0], shape)
    has_numbers = valid | known
    box, velocity = (
        np.where(has_numbers[..., None], part, any_number[..., None]).astype(np.float32)
        for part in (box, velocity)
    )
    kind, lights = rng.integers(0, 6, shape, np.int32), np.full((batch, 1), -1, np.int8)
    z = np.where(has_numbers, z, any_number).astype(np.float32)
    return Frame(*map(jnp.asarray, (box, velocity, z, valid, kind, lights)))


def random_context(rng, slot, batch=BATCH):
    history = np.zeros((batch, HISTORY, 4), np.float32)
    history[:, :, 3] = rng.uniform(0, 12, (batch, 1)) * rng.choice([0.0, 0.004, 1.0], (batch, 1))
    index = jnp.zeros(batch, jnp.int32)
    zero = jnp.zeros(batch, jnp.float32)
    return AgentContext(index, index, jnp.asarray(slot), jnp.asarray(history), zero[:, None], zero, zero, ())


def contact_problem(seed, slots, batch=BATCH):
    rng = np.random.default_rng(seed)
    # The driven agent is in any slot, or in none: then it is measured as the last one.
    slot = rng.integers(0, slots + 1, batch, np.int32)
    own = np.minimum(slot, slots - 1)[:, None] == np.arange(slots)
    frame = random_frames(rng, slots, batch, rng.choice([0.0, 0.3, 1.0]), rng.choice([3.0, 12.0]), own)
    previous = random_frames(rng, slots, batch)
    before = rng.choice(7, (batch, slots), p=[0.1, 0.6, 0.06, 0.06, 0.06, 0.06, 0.06]).astype(np.int8)
    unlawful = rng.random(batch) < 0.5
    return random_context(rng, slot, batch), frame, previous, jnp.asarray(before), jnp.asarray(unlawful)


measure = partial(_measure_contacts, reads=READS)


@pytest.mark.parametrize("slots", [1, 2, 3, 7, 16, 33, 64])
def test_contacts_equal_those_of_xla(slots):
    kinds = set()
    for seed in range(8):
        codes, fault, kind, _ = assert_same(measure, (0,) * 5, contact_problem(seed + 100 * slots, slots))
        kinds |= set(np.unique(kind))
        assert fault.any() or slots < 16 or not np.isin(codes, Contact.AT_FAULT).any()
    assert slots < 16 or kinds == set(range(7))


@pytest.fixture(scope="module")
def bank():
    """Scenarios of a hand-made road with five lights, whose arrays tests replace."""
    recordings = [straight_road([car()], light=RED) for _ in range(8)]
    scenarios = [assemble(recording, replace(SMALL, lights=5)) for recording in recordings]
    return ScenarioBank.from_scenarios(scenarios, trim=False)


def random_routes(rng, bank):
    """The bank with random routes of all lengths, straight, bent or turning on the spot, and random stop lines."""
    count, size, _ = bank.routes.shape
    curvature = np.repeat(rng.normal(0, 1, (count, size // 10)), 10, axis=1)
    curvature *= rng.choice([0.0, 1e-4, 0.01, 0.1, 1.0], (count, 1))
    heading = np.cumsum(curvature, axis=1) + rng.uniform(-np.pi, np.pi, (count, 1))
    cos, sin = np.cos(heading), np.sin(heading)
    limit = np.repeat(rng.choice([-1.0, 8.0, 13.4, 29.1], (count, size // 10)), 10, axis=1)
    x, y = np.cumsum(cos, axis=1), np.cumsum(sin, axis=1)
    routes = np.stack([x, y, 0 * x, cos, sin, limit, 0 * x], axis=-1)
    points = rng.choice([0, 1, 2, 3, 30, 90, size - 1, size], count)
    lines = np.asarray(bank.light_line).copy()
    arcs = rng.uniform(0, 300, lines[:, LightRow.ARC].shape)
    lines[:, LightRow.ARC] = np.where(rng.random(arcs.shape) < 0.3, NEVER_M, arcs)
    return replace(
        bank,
        routes=jnp.asarray(routes, jnp.float32),
        route_points=jnp.asarray(points, bank.route_points.dtype),
        light_line=jnp.asarray(lines),
    )


def following_problem(bank, seed, slots, batch=BATCH):
    rng = np.random.default_rng(seed)
    bank = random_routes(rng, bank)
    routes, points = np.asarray(bank.routes), np.asarray(bank.route_points)
    index, slot = rng.integers(0, len(bank), batch, np.int32), rng.integers(0, slots, batch, np.int32)
    route_m = (rng.uniform(0, 1.02, batch) * np.minimum(points[index], 200)).astype(np.float32)
    share = rng.choice([0.0, 0.1, 1.0])
    own = np.arange(slots) == slot[:, None]
    # Where no agent is near, the speed of the first slot is read.
    known = own | (np.arange(slots) == 0)
    frame = random_frames(rng, slots, batch, share, 60.0, known)
    # Most agents are near the route, along it or across, the driven one at its arc length.
    along = np.where(own, 0.0, rng.uniform(-10, 95, own.shape))
    place = np.clip(route_m[:, None] + along, 0, routes.shape[1] - 1).astype(int)
    x, y, _, cos, sin, _, _ = np.moveaxis(routes[index[:, None], place], -1, 0)
    forward, lateral = rng.normal(0, [[[1.0]], [[2.5]]], (2, *own.shape))
    turn = rng.choice([0.0, 0.3, np.pi / 2, np.pi], own.shape)
    pose = [x + forward * cos - lateral * sin, y + forward * sin + lateral * cos]
    pose += [cos * np.cos(turn) - sin * np.sin(turn), sin * np.cos(turn) + cos * np.sin(turn)]
    is_near = own | (np.asarray(frame.valid) & (rng.random(own.shape) < 0.8))
    box = np.asarray(frame.box).copy()
    box[..., :4] = np.where(is_near[..., None], np.stack(pose, -1), box[..., :4])
    lights = rng.integers(-1, 9, (batch, bank.light_line.shape[2])).astype(np.int8)
    frame = replace(frame, box=jnp.asarray(box), lights=jnp.asarray(lights))
    context = replace(
        random_context(rng, slot, batch), index=jnp.asarray(index), route_m=jnp.asarray(route_m)
    )
    return bank, context, frame


look_ahead = partial(ahead, min_gap_m=2.0)


@pytest.mark.parametrize("slots", [1, 2, 7, 24, 65])
def test_look_ahead_equals_that_of_xla(bank, slots):
    leaders = 0
    for seed in range(6):
        problem = following_problem(bank, seed + 100 * slots, slots)
        leaders += (assert_same(look_ahead, (None, 0, 0), problem).gap < 90).sum()
    assert leaders > 50


@pytest.mark.parametrize("target", TARGETS)
def test_older_instruction_sets_pass_the_same_tests(target):
    run_on_target(target, __file__)
