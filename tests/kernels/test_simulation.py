"""Kernels of the simulator's step against XLA: contacts, the look ahead along the route, frames and lights."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import kernels
from drivax.evaluation.rollout import evaluation_task
from drivax.scenario.bank.columns import NEVER_M, AgentColumn, LightRow
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.simulator.ahead import ahead
from drivax.simulator.contact import Contact
from drivax.simulator.simulator import Simulator
from drivax.simulator.situation import _measure_contacts
from drivax.simulator.types import HISTORY, AgentContext, Frame
from drivax.synthetic.world import generate_recording
from drivax.tasks.task import Task
from kernels.compare import TARGETS, assert_same, equal_samples, needs_kernels, run_on_target
from scenes import GLIMPSE, RED, SMALL, car, straight_road

pytestmark = needs_kernels

READS = frozenset({"ttc_s", "collision", "at_fault", "collision_type"})
#: Samples of a fuzzed batch.
BATCH = 192


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
    before = rng.choice(8, (batch, slots), p=[0.1, 0.6, *[0.05] * 6]).astype(np.int8)
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
    return hand_made_bank()


def hand_made_bank():
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


def random_log(rng, bank, moving, slots):
    """The bank with random moving agents in the first slots, parked ones in the others, and states of lights."""
    count, steps, words = len(bank), bank.steps, bank.parked_when.shape[1]
    rows = rng.normal(0, 50, (count, steps, moving, 8)).astype(np.float32)
    rows[..., AgentColumn.VALID] = rng.random(rows.shape[:3]) < 0.7
    parked = rng.normal(0, 50, (count, slots, 8)).astype(np.float32)
    parked[..., AgentColumn.VALID] = 1.0
    when = rng.integers(0, 2**32, (count, words, slots), np.uint32)
    when[:, :, :moving] = 0
    size = rng.integers(0, 6, (count, slots, 4)).astype(np.float32)
    state = rng.integers(-1, 9, bank.light_state.shape).astype(np.int8)
    extension = np.zeros((count, moving, *bank.extension.shape[2:]), np.float32)
    arrays = {"agents": rows, "agent_box": size, "parked": parked, "parked_when": when, "light_state": state}
    arrays["extension"] = extension
    return replace(bank, **{name: jnp.asarray(array) for name, array in arrays.items()})


simulator = Simulator(Task(observation=GLIMPSE))


@pytest.mark.parametrize(("moving", "slots"), [(1, 1), (3, 3), (5, 9), (16, 40)])
def test_frames_equal_those_of_xla(bank, moving, slots):
    rng = np.random.default_rng(slots)
    logs = random_log(rng, bank, moving, slots)
    context = random_context(rng, rng.integers(0, slots + 1, BATCH, np.int32))
    history = rng.normal(0, 20, (BATCH, HISTORY, 4))
    context = replace(
        context,
        index=jnp.asarray(rng.integers(0, len(bank), BATCH, np.int32)),
        step=jnp.asarray(rng.integers(-3, bank.steps + 2, BATCH, np.int32)),
        history=jnp.asarray(history, jnp.float32),
        z=jnp.asarray(rng.normal(0, 3, BATCH), jnp.float32),
    )
    frame = assert_same(simulator.now, (None, 0), (logs, context), rare=0)
    assert frame.valid.any()


@pytest.fixture(scope="module")
def generated():
    """Generated scenarios, the steps of a batch of their egos, and their states after the first."""
    scenarios = ScenarioBank.from_scenarios([assemble(generate_recording(5, i)) for i in range(4)])
    return scenarios, jnp.arange(12, dtype=jnp.int32) % 4


def drive(bank, index, steps=25):
    """The facts of an episode, and what a car-following driver sees, at each step; the agent leaves its log."""
    state = simulator_full.reset(bank, index)

    def step(state, number):
        action = jnp.stack([jnp.where(number < 8, 0.3, -0.2), 0.1 * jnp.sin(number * index)])
        state = simulator_full.step(bank, state, action)[0]
        frame = simulator_full.now(bank, state.context)
        return state, (state.facts, state.contacts, ahead(bank, state.context, frame, 2.0))

    return jax.lax.scan(step, state, jnp.arange(steps))[1]


simulator_full = Simulator(replace(evaluation_task(Task()), observation=GLIMPSE))


def test_episodes_of_generated_scenarios_equal_those_of_xla(generated):
    facts, contacts, _ = assert_same(drive, (None, 0), generated, rare=0)
    assert (contacts == Contact.APART).any()
    assert (facts.ttc_s < 5).any()


def observe(bank, index, speed=0.0):
    """What the kernels return at the start of an episode, ego faster than its log by ``speed``."""
    context = simulator.context(bank, index)
    context = replace(context, history=context.history.at[-1, 3].add(speed))
    frame = simulator.now(bank, context)
    before = jnp.full(frame.valid.shape, int(Contact.APART), jnp.int8)
    contacts = measure(context, frame, frame, before, jnp.zeros((), bool))
    return frame, contacts, ahead(bank, context, frame, 2.0)


def test_batches_of_batches_and_of_banks_equal_single_calls(generated):
    bank, index = generated
    index = index[:4]
    single = jax.jit(observe)
    expected = jax.tree.map(lambda *leaves: np.stack(leaves), *[single(bank, i) for i in index])
    nested = jax.jit(jax.vmap(jax.vmap(observe, (None, 0)), (None, 0)))(bank, index.reshape(2, 2))
    assert equal_samples(jax.tree.map(lambda leaf: leaf.reshape(4, *leaf.shape[2:]), nested), expected).all()
    banks = jax.tree.map(lambda leaf: jnp.stack([leaf] * 4), bank)
    assert equal_samples(jax.jit(jax.vmap(observe))(banks, index), expected).all()


def test_derivatives_are_those_of_xla(generated):
    bank, index = generated

    def total(speed, index):
        _, (_, _, _, ttc_s), obstacles = observe(bank, index, speed)
        return ttc_s + obstacles.desired + 0.01 * obstacles.gap + 0.1 * obstacles.leader

    derivative = jax.vmap(jax.grad(total), (None, 0))
    speed = jnp.float32(1.0)
    actual = jax.jit(derivative)(speed, index)
    with kernels.without_kernels():
        expected = jax.jit(lambda *arguments: derivative(*arguments))(speed, index)
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-5)
    assert np.isfinite(actual).all()
    assert (actual != 0).any()


@pytest.mark.parametrize("target", TARGETS)
def test_older_instruction_sets_pass_the_same_tests(target):
    run_on_target(target, __file__)
