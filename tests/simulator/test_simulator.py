"""The simulator as a whole: log replay, resets, groups, invariance, sizes."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.evaluation.rollout import drive, evaluation_task
from drivax.planners.simple import ConstantVelocity, Expert, IdmPlanner
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import STEPS, Flag
from drivax.simulator.contact import Contact
from drivax.simulator.lights import remember_lights
from drivax.simulator.simulator import Simulator
from drivax.simulator.situation import measure
from drivax.synthetic.world import generate_recording
from drivax.tasks.observations import PRESETS
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task
from drivax.testing.worlds import rotate_recording
from scenes import GLIMPSE, RED, bank_of, car, straight_road


@pytest.fixture(scope="module")
def simulator():
    return Simulator(evaluation_task(Task(observation=GLIMPSE)))


def measuring(*metrics):
    """A simulator of tests that need a few metrics: a program of half the size."""
    return Simulator(Task(observation=GLIMPSE, metrics=metrics, to_the_end=True))


@pytest.fixture(scope="module")
def world():
    """The scenarios of ``tests/evaluation/test_audit.py``, which drives the expert in the same compiled program."""
    return ScenarioBank.from_scenarios([assemble(generate_recording(9, i)) for i in range(6)])


@pytest.fixture(scope="module")
def single():
    """A simulator whose episodes may end, and its compiled reset and step of one environment."""
    simulator = Simulator(Task(observation=GLIMPSE))
    return simulator, jax.jit(simulator.reset), jax.jit(simulator.step)


def episodes(simulator, planner, bank, slot=0):
    keys = jax.random.split(jax.random.key(0), len(bank))
    # The slot is an argument, so that one program serves all agents.
    return drive(simulator, planner, bank, jnp.arange(len(bank)), keys, slot=slot)


def metric(result, name):
    value = result.metrics[name]
    return np.where(value.defined, value.value, np.nan)


def test_replayed_expert_has_no_violations_and_no_divergence(simulator, world):
    keys = jax.random.split(jax.random.key(0), len(world))
    result = drive(simulator, Expert(), world, jnp.arange(len(world)), keys)
    for name, expected in (("accuracy", 1.0), ("success", 1.0), ("collision", 0.0), ("offroad", 0.0)):
        np.testing.assert_array_equal(metric(result, name), expected)
    np.testing.assert_allclose(metric(result, "fde"), 0.0, atol=1e-5)
    np.testing.assert_allclose(metric(result, "progress_ratio"), 1.0, atol=1e-3)


@pytest.mark.slow
def test_driven_expert_follows_the_log(world):
    assert metric(episodes(measuring("fde"), Expert(replays=False), world), "fde").max() < 0.2


def test_a_state_is_small(simulator, world):
    state = jax.eval_shape(lambda b: simulator.reset(b, 0), world)
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state))
    facts = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state.facts))
    context = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state.context))
    assert size <= 4096 and facts <= 256 and context <= 400


def test_collision_with_a_stopped_car(simulator):
    bank = bank_of(straight_road([car(0, 0, 0, 10), car(30, 0, 0, 0)]))
    result = episodes(simulator, ConstantVelocity(), bank)
    # 30 m between centres less one length of 4.8 m at 10 m/s: contact after 2.52 s, first seen at step 36.
    assert metric(result, "collision")[0] == 1.0 and metric(result, "at_fault_collision")[0] == 1.0
    assert int(result.events["collision"][0]) == 36
    assert metric(result, "collision_type")[0] == 6.0
    assert metric(result, "min_ttc")[0] == 0.0 and metric(result, "accuracy")[0] == 0.0


def test_agent_overlapping_at_the_start_is_ignored_until_it_separates(simulator):
    bank = bank_of(straight_road([car(0, 0, 0, 5), car(1, 0.5, 0, 5)]))
    result = episodes(simulator, ConstantVelocity(), bank)
    assert metric(result, "collision")[0] == 0.0 and metric(result, "min_ttc")[0] == 5.0


def test_an_agent_that_appears_on_top_of_ego_is_ignored(simulator):
    bank = bank_of(straight_road([car(0, 0, 0, 5), car(1, 0.5, 0, 5, steps=range(40, 91))]))
    assert metric(episodes(simulator, ConstantVelocity(), bank), "collision")[0] == 0.0


def test_leaving_the_road_is_offroad(simulator):
    # The log drives straight; a heading of 3 deg leads off the right edge, 1.85 m away.
    bank = bank_of(straight_road([car(0, 0, np.deg2rad(-3), 10)]))
    result = episodes(simulator, ConstantVelocity(), bank)
    assert metric(result, "offroad")[0] == 1.0
    # The front right corner is 0.3 m beyond the edge when 10 t sin(3 deg) + 1.0 cos + 2.4 sin = 2.15 m: 2 s.
    corner = 1.0 * np.cos(np.deg2rad(3)) + 2.4 * np.sin(np.deg2rad(3))
    steps = int(np.ceil((1.85 + 0.3 - corner) / (10 * np.sin(np.deg2rad(3))) / 0.1))
    assert int(result.events["offroad"][0]) == 10 + steps


def test_running_a_red_light(simulator):
    red = bank_of(straight_road([car(0, 0, 0, 10)], light=RED))
    result = episodes(simulator, ConstantVelocity(), red)
    # The front bumper, 2.4 m ahead of the centre, passes x = 40 at 3.76 s.
    assert metric(result, "red_light")[0] == 1.0
    assert int(result.events["red_light"][0]) == 10 + 38
    green = bank_of(straight_road([car(0, 0, 0, 10)], light=6))
    assert metric(episodes(simulator, ConstantVelocity(), green), "red_light")[0] == 0.0
    turned = np.full(91, RED)
    turned[47:] = 6  # green one step before the bumper reaches the line
    late = bank_of(straight_road([car(0, 0, 0, 10)], light=turned))
    assert metric(episodes(simulator, ConstantVelocity(), late), "red_light")[0] == 0.0


@pytest.mark.slow
def test_idm_stops_for_red_and_behind_a_standing_car(simulator):
    red = episodes(simulator, IdmPlanner(), bank_of(straight_road([car(0, 0, 0, 10)], light=RED)))
    front = np.asarray(red.motion)[0, -1, 0] + 2.4
    assert metric(red, "red_light")[0] == 0.0 and 35.0 < front < 40.0
    queue = episodes(simulator, IdmPlanner(), bank_of(straight_road([car(0, 0, 0, 10), car(50, 0, 0, 0)])))
    gap = 50 - 2.4 - (np.asarray(queue.motion)[0, -1, 0] + 2.4)
    assert metric(queue, "collision")[0] == 0.0 and 1.0 < gap < 6.0


def test_metrics_without_lights_are_undefined(simulator):
    recording = straight_road([car(0, 0, 0, 5)])
    bank = bank_of(replace(recording, flags=recording.flags & ~Flag.LIGHTS))
    result = episodes(simulator, ConstantVelocity(), bank)
    assert np.isnan(metric(result, "red_light")[0]) and np.isnan(metric(result, "vmax_score")[0])
    assert metric(result, "vmax_score_partial")[0] == pytest.approx(1.0, abs=1e-4)
    assert metric(result, "nuplan_score")[0] == pytest.approx(1.0, abs=1e-4)


@pytest.mark.slow
def test_results_are_invariant_to_translation_and_rotation(simulator):
    cars = [car(0, 0, 0, 9), car(25, 0.4, 0, 6), car(-12, 3.7, 0, 11), car(40, 3.5, np.pi, 3)]
    recording = straight_road(cars, light=RED)
    recordings = recording, rotate_recording(recording, 2.1, 4000.0, -7000.0)
    one, other = (episodes(simulator, IdmPlanner(), bank_of(recording)) for recording in recordings)
    for name in one.metrics:
        np.testing.assert_allclose(metric(one, name), metric(other, name), rtol=2e-3, atol=2e-2, err_msg=name)


@pytest.mark.slow
def test_order_and_padding_of_agents_change_nothing(simulator):
    cars = [car(0, 0, 0, 9), car(25, 0.4, 0, 6), car(-12, 3.7, 0, 11), car(40, 3.5, 0, 3)]
    plain = bank_of(straight_road(cars))
    mixed = bank_of(straight_road([cars[i] for i in (0, 3, 1, 2)]))
    padded = ScenarioBank.from_scenarios(
        [
            assemble(straight_road(cars)),
            assemble(straight_road([*cars, *[car(180 + 9 * i, 3.7, 0, 4) for i in range(12)]])),
        ]
    )
    base = episodes(simulator, ConstantVelocity(), plain)
    for bank in (mixed, padded):
        other = episodes(simulator, ConstantVelocity(), bank)
        for name in base.metrics:
            np.testing.assert_allclose(
                metric(base, name)[0], metric(other, name)[0], rtol=1e-4, atol=1e-5, err_msg=name
            )


@pytest.mark.slow
def test_step_or_reset_equals_step_and_reset(single, world):
    simulator, reset, step = single
    either = jax.jit(simulator.step_or_reset)
    rows = jnp.arange(4)
    state, another = reset(world, rows[1]), jax.jit(simulator.new_episode)(world, rows[3])
    action = jnp.array([0.2, 0.05])
    plain, _ = step(world, state, action)
    same, _ = either(world, state, action, jnp.asarray(False), another)
    frame = simulator.now(world, state.context)
    with_frame, _ = either(world, state, action, jnp.asarray(False), another, frame)
    restarted, transition = either(world, plain, action, jnp.asarray(True), another)
    for a, b in ((plain, same), (plain, with_frame), (reset(world, rows[3]), restarted)):
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-6), a, b)
    assert not bool(transition.terminated) and not bool(transition.truncated)


def test_a_stop_before_the_episode_is_as_old_as_it_was_long_ago():
    """Ego stands 1 m before a stop line up to step 5; episodes start at that step, and 1 and 5 steps later."""
    driven_m = 0.6 * np.clip(np.arange(STEPS) - 5, 0, None)
    ego = car(36.6)
    ego |= {
        "xy": ego["xy"] + driven_m[:, None] * [1.0, 0.0],
        "velocity": (driven_m > 0)[:, None] * [6.0, 0.0],
    }
    bank, simulator = bank_of(straight_road([ego], light=RED)), measuring("red_light")
    reset = jax.jit(jax.vmap(partial(simulator.reset, bank, 0)))
    assert reset(jnp.array([5, 6, 10])).lights.pause[:, 0].tolist() == [0, 1, 5]


@pytest.mark.slow
def test_two_driven_agents_see_each_other():
    simulator = measuring("collision")
    bank = bank_of(straight_road([car(0, 0, 0, 8), car(20, 0, 0, 8)]))
    # The one in front brakes fully, the one behind keeps its speed.
    actions = jnp.array([[0.0, 0.0], [-1.0, 0.0]])

    @jax.jit
    def together(bank):
        pair = jax.vmap(lambda slot: simulator.reset(bank, 0, 10, slot))(jnp.array([0, 1]))
        return jax.lax.fori_loop(0, 30, lambda _, s: simulator.step_together(bank, s, actions)[0], pair)

    @jax.jit
    def by_itself(bank):
        state = simulator.reset(bank, 0, 10, 0)
        return jax.lax.fori_loop(0, 30, lambda _, s: simulator.step(bank, s, actions[0])[0], state)

    assert together(bank).facts.collision.all()
    assert not bool(by_itself(bank).facts.collision)


def test_other_vehicles_as_ego_replay_cleanly():
    bank = bank_of(straight_road([car(0, 0, 0, 8), car(20, 3.7, 0, 9)]))
    result = episodes(measuring("fde", "distance"), Expert(), bank, slot=1)
    assert metric(result, "fde")[0] < 1e-4 and metric(result, "distance")[0] == pytest.approx(72.0, abs=0.1)


@pytest.mark.slow
def test_vmap_equals_a_loop(single, world):
    simulator, reset, step = single
    action = jnp.array([0.3, -0.1])
    rows = jnp.array([0, 2, 5])

    @jax.jit
    def together(bank, rows):
        many = jax.vmap(simulator.reset, in_axes=(None, 0))(bank, rows)
        return jax.vmap(simulator.step, in_axes=(None, 0, None))(bank, many, action)[0]

    batch = together(world, rows)
    for place, row in enumerate(rows):
        alone, _ = step(world, reset(world, row), action)
        part = jax.tree.map(lambda leaf, place=place: leaf[place], batch)
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-4), alone, part)


@pytest.mark.slow
def test_jit_changes_nothing():
    simulator = Simulator(Task(observation=PRESETS["minimal"]))
    bank = bank_of(straight_road([car(0, 0, 0, 8), car(20, 0, 0, 8)], light=RED))
    state = jax.jit(simulator.reset)(bank, 0)
    action = jnp.array([0.3, -0.1])
    compiled, _ = jax.jit(simulator.step)(bank, state, action)
    with jax.disable_jit():
        plain, _ = simulator.step(bank, state, action)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-4), plain, compiled)


def test_schedule_compares_with_the_log_now_and_a_second_later():
    """A log at 9 m/s: where it is, 3 m ahead, 3 m behind; after its last step it continues at its last speed."""
    simulator = Simulator(Task(observation=GLIMPSE, rewards=RewardConfig(preset="pace", completion=1.0)))
    bank = bank_of(straight_road([car(0, 0, 0, 9)]))
    cases = [(10, 0.0, 0.0, -9.0), (10, 3.0, -3.0, -6.0), (40, -3.0, 3.0, -12.0), (90, 1.0, -1.0, -8.0)]

    @jax.jit
    @jax.vmap
    def schedule(step, ahead_m):
        context = simulator.context(bank, 0, step)
        context = replace(context, history=context.history.at[:, 0].add(ahead_m))
        now = simulator.now(bank, context)
        apart, lights = (
            jnp.full(now.valid.shape, int(Contact.APART), jnp.int8),
            remember_lights(bank, context),
        )
        return measure(bank, context, now, now, apart, lights, simulator.task.reads)[0].facts

    steps, ahead_m, late_m, early_m = np.array(cases, np.float32).T
    facts = schedule(steps.astype(np.int32), ahead_m)
    # Progress on the route never decreases: behind the log it stays that of the log.
    np.testing.assert_allclose(facts.late_m, np.minimum(late_m, 0.0), atol=1e-3)
    np.testing.assert_allclose(facts.early_m, np.where(late_m > 0, -9.0, early_m), atol=1e-3)
    done = np.clip((9 * (steps - 10) / 10 + np.maximum(ahead_m, 0)) / 72, 0, 1)
    np.testing.assert_allclose(facts.completed, done, atol=1e-4)


def test_schedule_of_a_standing_log():
    """Driving gains nothing: 3 m ahead is 3 m early, and the path is completed from the start."""
    simulator = Simulator(Task(observation=GLIMPSE, rewards=RewardConfig(preset="pace", completion=1.0)))
    state = jax.jit(simulator.reset)(bank := bank_of(straight_road([car(0, 0, 0, 0)])), 0)
    assert float(state.facts.late_m) == 0.0 and float(state.facts.early_m) == 0.0
    assert float(state.facts.completed) == 1.0
    moved = replace(state, context=replace(state.context, route_m=state.context.route_m + 3.0))
    after, transition = jax.jit(simulator.step)(bank, moved, jnp.zeros(2))
    assert float(after.facts.early_m) == pytest.approx(3.0, abs=1e-3)
    terms = transition.reward_terms
    assert float(terms["pace"]) == pytest.approx(0.1 * np.exp(-2 / 8), rel=1e-3)
    assert float(terms["completion"]) == 0.0
