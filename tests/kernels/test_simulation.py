"""Kernels of the simulator's step against XLA: contacts, the look ahead along the route, frames and lights."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import kernels
from drivax.simulator.contact import Contact
from drivax.simulator.situation import _measure_contacts
from drivax.simulator.types import HISTORY, AgentContext, Frame
from kernels.compare import TARGETS, needs_kernels, run_on_target

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


def random_frames(rng, slots, batch=BATCH, share=0.7, spread_m=12.0):
    """Agents around the origin, some of them on other levels; empty slots hold any numbers."""
    shape = (batch, slots)
    heading = rng.choice([0.0, np.pi / 2, np.pi, 0.6], shape) + rng.normal(0, 0.2, shape)
    size = rng.uniform([0.5, 0.5], [6.0, 2.5], (*shape, 2))
    xy = rng.normal(0, spread_m, (*shape, 2))
    box = np.concatenate([xy, np.cos(heading)[..., None], np.sin(heading)[..., None], size], -1)
    velocity = rng.normal(0, 6, (*shape, 2)) * rng.choice([0.0, 0.004, 1.0], (*shape, 1), p=[0.2, 0.1, 0.7])
    z = rng.choice([0.0, 2.0, 5.0], shape, p=[0.8, 0.1, 0.1])
    valid = rng.random(shape) < share
    any_number = rng.choice([np.nan, np.inf, -np.inf, 1e38, 0.0], shape)
    box, velocity = (
        np.where(valid[..., None], part, any_number[..., None]).astype(np.float32) for part in (box, velocity)
    )
    kind, lights = rng.integers(0, 6, shape, np.int32), np.full((batch, 1), -1, np.int8)
    z = np.where(valid, z, any_number).astype(np.float32)
    return Frame(*map(jnp.asarray, (box, velocity, z, valid, kind, lights)))


def random_context(rng, slot, batch=BATCH):
    history = np.zeros((batch, HISTORY, 4), np.float32)
    history[:, :, 3] = rng.uniform(0, 12, (batch, 1)) * rng.choice([0.0, 0.004, 1.0], (batch, 1))
    index = jnp.zeros(batch, jnp.int32)
    zero = jnp.zeros(batch, jnp.float32)
    return AgentContext(index, index, jnp.asarray(slot), jnp.asarray(history), zero[:, None], zero, zero, ())


def contact_problem(seed, slots, batch=BATCH):
    rng = np.random.default_rng(seed)
    # The driven agent is near the others, and in any slot, in the last one, or in none.
    frame = random_frames(rng, slots, batch, rng.choice([0.0, 0.3, 1.0]), rng.choice([3.0, 12.0]))
    slot = rng.integers(0, slots + 1, batch, np.int32)
    own = np.minimum(slot, slots - 1)[:, None] == np.arange(slots)
    ego = random_frames(rng, slots, batch, 1.0, 1.0)
    frame = jax.tree.map(
        lambda a, b: jnp.where(own.reshape(*own.shape, *(1,) * (a.ndim - 2)), b, a), frame, ego
    )
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


@pytest.mark.parametrize("target", TARGETS)
def test_older_instruction_sets_pass_the_same_tests(target):
    run_on_target(target, __file__)
