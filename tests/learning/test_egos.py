"""Training with any moving vehicle as the ego: draws, logged steps, weights, and sets without further egos."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.learning.config import TrainConfig
from drivax.learning.driving import Driving
from drivax.learning.experience import ExperienceConfig, sample_steps
from drivax.learning.loop import _divide, train
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import CAPACITIES
from drivax.scenario.select.splits import hold_out
from drivax.simulator.simulator import Simulator
from drivax.synthetic.world import generate_recording
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from scenes import car, further_egos, straight_road

SMALL = replace(CAPACITIES["default"], name="small", agents=40, parked=24)
EGOS = 4
TASK = Task(observation=ObservationConfig(agents=2, steps=1, road=0, lights=1, route=3), metrics=("steps",))
MOVING = Driving(Simulator(TASK), latest_start=40, earliest_start=4, egos="moving")
RECORDED = replace(MOVING, egos="recorded")


@pytest.fixture(scope="module")
def worlds():
    """A bank in which the scenarios have 4, 3 and 1 egos, and the bank of the 5 further ones as recorded egos."""
    recordings = [
        generate_recording(0, 8),
        straight_road([car(0, 0, 0, 10), car(-20, 0, 0, 9), car(10, 3.7, 0, 12, steps=range(6, 41))]),
        straight_road([car(0, 0, 0, 10), car(30, 0)]),
    ]
    scenarios, alone, places = further_egos(recordings, SMALL, EGOS)
    banks = (ScenarioBank.from_scenarios(each, trim=False) for each in (scenarios, alone))
    return *banks, places @ [EGOS, 1]


def test_scenarios_and_their_egos_are_drawn_uniformly(worlds):
    bank, count = worlds[0], 24_000
    index, step, slot = map(np.asarray, MOVING._draw(bank, jax.random.key(0), count, 4, 40)[:3])
    egos = np.asarray(bank.egos)
    assert (egos >= 0).sum(axis=1).tolist() == [4, 3, 1]
    for scenario, slots in enumerate(egos):
        drawn = slot[index == scenario]
        assert abs(len(drawn) - count / 3) < 5 * np.sqrt(count * 2 / 9)
        members = slots[slots >= 0]
        share = len(drawn) / len(members)
        assert set(drawn) == set(members)
        for member in members:
            assert abs((drawn == member).sum() - share) < 5 * np.sqrt(share)
    assert np.asarray(bank.agents)[index, step, slot, 7].all()
    last = np.asarray(bank.last_step)[np.asarray(jax.vmap(bank.row_of)(index, slot))]
    assert (step <= last - 2).all()
    # The third vehicle of the road is there from step 6 to 40.
    short = slot[index == 1] == egos[1][np.asarray(bank.last_step)[4:8] == 40]
    steps = step[index == 1][short]
    assert steps.min() == 6 and steps.max() == 38


def test_episodes_begin_with_the_drawn_ego(worlds):
    def contexts(driving):
        """Where episodes begin; what else a start computes is not compiled."""
        start = jax.jit(lambda bank, key: driving.start(bank, key, 16).state.context)
        return start(worlds[0], jax.random.key(1))

    context, bank = contexts(MOVING), worlds[0]
    assert len(set(np.asarray(context.slot).tolist())) > 2
    np.testing.assert_array_equal(context.route, jax.vmap(bank.row_of)(context.index, context.slot))
    logged = bank.agents[context.index, context.step, context.slot, :2]
    np.testing.assert_allclose(context.history[:, -1, :2], logged, atol=1e-4)
    assert not np.asarray(contexts(RECORDED).slot).any()


@pytest.mark.slow
def test_logged_steps_are_those_of_recorded_egos(worlds):
    bank, alone, rows = worlds
    steps, own_steps = (
        jax.jit(each.expert_steps)(data) for each, data in ((MOVING, bank), (RECORDED, alone))
    )
    assert steps.usable.shape == (len(bank) * EGOS, bank.steps) and steps.egos == EGOS and own_steps.egos == 1
    empty = np.asarray(bank.egos).reshape(-1) < 0
    assert not np.asarray(steps.usable)[empty].any() and np.asarray(steps.usable)[~empty].any(axis=1).all()
    for row, number in zip(rows, range(len(rows)), strict=True):
        usable, last = np.asarray(steps.usable[row]), int(bank.last_step[row])
        np.testing.assert_array_equal(usable[: last - 1], np.asarray(own_steps.usable[number])[: last - 1])
        assert not usable[last - 1 :].any()
        np.testing.assert_allclose(steps.action[row][usable], own_steps.action[number][usable], atol=5e-3)
    index = np.repeat(rows, 2), np.tile([12, 20], len(rows))
    observation = jax.jit(MOVING.observe_recorded)(bank, tuple(map(jnp.asarray, index)))
    own_index = np.repeat(np.arange(len(rows)), 2), index[1]
    own_observation = jax.jit(RECORDED.observe_recorded)(alone, tuple(map(jnp.asarray, own_index)))
    for name in ("ego", "agents", "route"):
        np.testing.assert_allclose(observation[name], own_observation[name], atol=2e-3, err_msg=name)


def test_demonstrations_are_those_of_logged_steps(worlds):
    """The actions that cloning draws are among the logged actions of all egos, and of no others."""
    bank = worlds[0]
    # Only actions are returned, so that rewards and observations are not compiled.
    logged = np.asarray(jax.jit(lambda bank: MOVING.expert_steps(bank).action)(bank)).reshape(-1, 2)
    draw = jax.jit(lambda bank, key: MOVING.demonstrations(bank, key, 128)[1])
    action = np.asarray(draw(bank, jax.random.key(2)))
    row = np.abs(logged - action[:, None]).sum(axis=2)
    assert (row.min(axis=1) < 1e-4).all()


def test_weights_of_a_scenario_apply_to_all_its_egos(worlds):
    bank, weights = worlds[0], np.zeros((3, worlds[0].steps))
    weights[1, 20], weights[0, 30] = 3.0, 1.0
    experience = ExperienceConfig(mask_clipped=False).of(MOVING, bank, weights)
    row, step = map(np.asarray, sample_steps(experience.critic, jax.random.key(0), (4000,)))
    egos = {index: [4 * index + k for k in range(EGOS) if bank.egos[index, k] >= 0] for index in (0, 1)}
    assert set(zip(row.tolist(), step.tolist(), strict=True)) == {
        *((each, 20) for each in egos[1]), *((each, 30) for each in egos[0]),
    }  # fmt: skip
    share = 9 / 13  # three egos of weight 3, four of weight 1
    assert abs((step == 20).mean() - share) < 5 * np.sqrt(share * (1 - share) / 4000)


def test_egos_may_have_weights_of_their_own(worlds):
    bank, weights = worlds[0], np.zeros((3 * EGOS, worlds[0].steps))
    weights[EGOS + 1, 20], weights[2, 30] = 3.0, 1.0
    experience = ExperienceConfig(mask_clipped=False).of(MOVING, bank, weights)
    row, step = map(np.asarray, sample_steps(experience.critic, jax.random.key(0), (4000,)))
    assert set(zip(row.tolist(), step.tolist(), strict=True)) == {(EGOS + 1, 20), (2, 30)}
    assert abs((step == 20).mean() - 0.75) < 5 * np.sqrt(0.75 * 0.25 / 4000)
    with pytest.raises(
        UsageError, match=r"weights of shape \(9, 91\) for 3 scenarios, or their 12 logs, of 91"
    ):
        ExperienceConfig().of(MOVING, bank, weights[:9])
    with pytest.raises(UsageError, match=r"weights of shape \(12, 91\) for 3 scenarios of 91 steps"):
        ExperienceConfig().of(RECORDED, bank, weights)
    weights[6, 20] = -1.0
    with pytest.raises(UsageError, match=r"the weight of step 20 of ego 2 of scenario 1 is -1\.0"):
        ExperienceConfig().of(MOVING, bank, weights)


def test_held_out_scenarios_take_the_weights_of_their_egos_along(data_of_egos):
    weights = np.arange(3 * 8)[:, None] + np.zeros(data_of_egos.capacity.steps)
    config, held_out = TrainConfig(task=TASK, egos="moving"), hold_out(data_of_egos.entries)
    assert sorted([*held_out.training, *held_out.validation]) == [0, 1, 2] and len(held_out.validation) == 1
    _, kept, _ = _divide(config, data_of_egos, weights, held_out)
    assert kept[:, 0].tolist() == [8 * row + ego for row in held_out.training for ego in range(8)]
    _, kept, _ = _divide(config, data_of_egos, weights[:3], held_out)
    assert kept[:, 0].tolist() == held_out.training
    with pytest.raises(UsageError, match="for 3 scenarios of"):
        _divide(replace(config, egos="recorded"), data_of_egos, weights, held_out)


def test_sets_without_further_egos_are_refused(data, tmp_path):
    with pytest.raises(UsageError, match=r"only the recorded ego of each scenario has a route; .* --egos 8"):
        train(TrainConfig(task=TASK, egos="moving"), data, tmp_path / "run", validation=None)
