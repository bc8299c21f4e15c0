"""The bank: what it refuses, how large it is, and that padding costs nothing but memory."""

from dataclasses import fields, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import DataError, DrivaxError, UsageError
from drivax.evaluation.rollout import drive, evaluation_task
from drivax.planners.nuplan.map import lane_count
from drivax.planners.simple import IdmPlanner
from drivax.scenario.bank import scenario_bank
from drivax.scenario.bank import sizes as sizes_module
from drivax.scenario.bank.columns import LaneRow
from drivax.scenario.bank.scenario_bank import WORD, ScenarioBank, as_words
from drivax.scenario.bank.sizes import Sizes
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import Scenario
from drivax.simulator.simulator import Simulator
from drivax.synthetic.world import generate_recording
from drivax.tasks.task import Task
from scenes import GLIMPSE, SMALL, bank_of, car, straight_road


def without_future(scenario: Scenario) -> Scenario:
    record = scenario.record.copy()
    record["steps"] = 30
    return replace(scenario, record=record)


def test_bank_refuses_empty_input_and_logs_without_future():
    with pytest.raises(DrivaxError, match="at least one"):
        ScenarioBank.from_scenarios([])
    short = without_future(assemble(straight_road([car(0, 0, 0, 5)])))
    with pytest.raises(DataError, match=r"hand-made: has 30 steps, fewer than 31"):
        ScenarioBank.from_scenarios([short])
    assert len(ScenarioBank.from_scenarios([short], allow_no_future=True)) == 1


def test_bank_size_per_scenario_is_bounded():
    scenarios = [assemble(generate_recording(3, i)) for i in range(3)]
    whole, trimmed = (ScenarioBank.from_scenarios(scenarios, trim=trim) for trim in (False, True))
    assert trimmed.nbytes // 3 < 300_000 < whole.nbytes // 3 <= 600_000


@pytest.fixture(scope="module")
def both():
    """A bank that is trimmed, and one that is not."""
    scenarios = [assemble(generate_recording(4, i)) for i in range(3)]
    return [ScenarioBank.from_scenarios(scenarios, trim=trim) for trim in (True, False)]


@jax.jit
def moments(bank):
    """Facts at logged poses of ego, and the actions of IDM there."""
    simulator = Simulator(Task(observation=GLIMPSE))

    def one(row, step):
        state = simulator.reset(bank, row, step)
        action, _ = IdmPlanner().act(
            (), bank, state, simulator.situation(bank, state), None, jax.random.key(0)
        )
        return state.facts, action

    row, step = (jnp.asarray(part.ravel()) for part in np.mgrid[0 : len(bank), 10:90:8])
    return jax.vmap(one)(row, step)


@pytest.mark.slow
def test_trimming_keeps_all_measurements(both):
    one, other = map(moments, both)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), one, other)


@pytest.mark.slow
def test_trimming_keeps_all_results(both):
    simulator, rows, keys = (
        Simulator(evaluation_task(Task())),
        np.arange(3),
        jax.random.split(jax.random.key(0), 3),
    )
    one, other = (drive(simulator, IdmPlanner(), bank, rows, keys) for bank in both)
    np.testing.assert_allclose(one.motion, other.motion, atol=1e-4)
    for name in one.metrics:
        for part in ("value", "defined"):
            a, b = (np.asarray(getattr(result.metrics[name], part)) for result in (one, other))
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4, err_msg=name)


def test_a_long_ego_is_marked():
    assert not bank_of(straight_road([car(0, 0, 0, 5)])).long_ego
    assert bank_of(straight_road([car(0, 0, 0, 5, length=11.0, width=2.5)])).long_ego


def test_limits_fall_back_to_the_class_of_the_lane():
    bank = bank_of(straight_road([car(0, 0, 0, 5)], limit=None))
    used = np.asarray(bank.lanes)[0, 6]
    np.testing.assert_allclose(used[used < 1e5], 13.4, rtol=1e-6)


@pytest.mark.parametrize("batch", [2, 3])
def test_batches_of_scenarios_stack_as_single_scenarios(monkeypatch, batch):
    scenarios = [assemble(generate_recording(5, i)) for i in range(5)]
    scenarios.insert(2, assemble(straight_road([car(0, 0, 0, 5)], limit=None)))
    sizes = Sizes.used(scenarios)
    alone = [ScenarioBank.from_scenarios([scenario], trim=sizes) for scenario in scenarios]
    for module in (scenario_bank, sizes_module):
        monkeypatch.setattr(module, "BATCH", batch)
    assert Sizes.used(iter(scenarios)) == sizes
    bank = ScenarioBank.from_scenarios(scenarios, trim=sizes)
    for name in (field.name for field in fields(ScenarioBank) if not field.metadata):
        if name == "chances":
            assert bank.chances is None
            continue
        each = np.concatenate([np.asarray(getattr(single, name)) for single in alone])
        np.testing.assert_array_equal(np.asarray(getattr(bank, name)), each, err_msg=name)


def test_sizes_that_are_too_small_are_refused_by_name():
    scenario = assemble(generate_recording(4, 0))
    used, whole = Sizes.used([scenario]), Sizes.whole(scenario.capacity)
    for sizes in (used, whole):
        assert not ScenarioBank.from_scenarios([scenario], trim=sizes).trimmed
    for name in (field.name for field in fields(Sizes) if field.name != "long_ego"):
        least = getattr(used, name)
        small = replace(used, **{name: least - 1})
        with pytest.raises(UsageError, match=rf"too small: {name} {least - 1} < {least}; use Sizes.used"):
            ScenarioBank.from_scenarios([scenario], trim=small)
    large = Sizes.whole(replace(scenario.capacity, agents=128))
    with pytest.raises(UsageError, match="too large: agents 128 > 80 of the capacity"):
        ScenarioBank.from_scenarios([scenario], trim=large)


def test_segments_of_lanes_that_do_not_fit_have_no_lane():
    scenario = assemble(straight_road([car(0, 0, 0, 5)]), replace(SMALL, lanes=2))
    assert scenario.overflow == {"lanes": 1}
    first, last = scenario.segment_blocks[1:3]
    lanes = np.asarray(ScenarioBank.from_scenarios([scenario]).lanes)[0, LaneRow.HALF_WIDTH :, : last - first]
    assert set(np.floor(lanes[2]).tolist()) == {-1.0, 0.0, 1.0}
    np.testing.assert_allclose(
        np.unique(lanes[:, scenario.segment_lane[first:last] < 0]), [-1.0, 1.85], rtol=1e-6
    )


def test_ids_of_lanes_may_be_negative():
    recording = straight_road([car(0, 0, 0, 5)])

    def negated(feature):
        names = ("successors", "predecessors", "left_neighbours", "right_neighbours")
        links = {name: tuple(-other for other in getattr(feature, name)) for name in names}
        return replace(feature, feature_id=-feature.feature_id, **links)

    route = tuple(-lane for lane in recording.route_lanes)
    negative = replace(recording, features=tuple(map(negated, recording.features)), route_lanes=route)
    lanes, other = (np.asarray(bank_of(each).lanes) for each in (recording, negative))
    np.testing.assert_array_equal(lanes, other)
    assert lane_count(assemble(negative)) == lane_count(assemble(recording)) == 3


def test_sizes_cover_the_largest_scenario():
    scenarios = [assemble(generate_recording(6, i)) for i in range(3)]
    each = [Sizes.used([scenario]) for scenario in scenarios]
    largest = {field.name: max(getattr(sizes, field.name) for sizes in each) for field in fields(Sizes)}
    assert Sizes.used(scenarios) == Sizes(**largest)


@pytest.mark.parametrize("steps", [1, 31, 32, 91])
def test_words_hold_a_bit_per_step(steps):
    when = np.random.default_rng(steps).random((2, steps, 5)) < 0.5
    words = as_words(when)
    assert words.dtype == np.uint32 and words.shape == (2, -(-steps // WORD), 5)
    for n, t, slot in np.ndindex(when.shape):
        assert (int(words[n, t // WORD, slot]) >> (t % WORD) & 1) == when[n, t, slot]
    assert as_words(when[..., :0]).shape == (2, -(-steps // WORD), 0)


def test_bank_shares_memory_without_losing_it_to_donation():
    bank = bank_of(straight_road([car(0, 0, 0, 5)]))
    agents = np.array(bank.agents)
    moved = jax.jit(lambda values: values + 1.0, donate_argnums=0)(bank.agents)
    np.testing.assert_array_equal(moved, agents + 1.0)
