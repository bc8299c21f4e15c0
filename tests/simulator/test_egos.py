"""Driving a further ego equals driving the same vehicle as the recorded ego of its recording."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.metrics.episode import episode_metrics
from drivax.planners.simple import ConstantSpeed, IdmPlanner, logged_motion
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import CAPACITIES
from drivax.simulator.ahead import has_route
from drivax.simulator.simulator import Simulator
from drivax.simulator.types import FACTS, ON_REQUEST
from drivax.synthetic.world import generate_recording
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from scenes import RED, car, further_egos, straight_road

SMALL = replace(CAPACITIES["default"], name="small", agents=40, parked=24, routes=6)
EGOS = 4
STEPS = 60
OBSERVATION = ObservationConfig(agents=1, steps=1, road=0, lights=4, route=6)


@dataclass(frozen=True)
class Everything(Task):
    """Measure all facts, those on request included."""

    @property
    def reads(self):
        return FACTS | ON_REQUEST


SIMULATOR = Simulator(
    Everything(observation=OBSERVATION, metrics=("success", "progress_ratio", "last_step", "red_light"))
)


@pytest.fixture(scope="module")
def worlds():
    """A bank with further egos, and (index, slot, last step) of each with a bank in which it is the recorded ego."""
    recordings = [
        generate_recording(0, 8),
        straight_road([car(0, 0, 0, 10), car(-20, 0, 0, 9), car(10, 3.7, 0, 12)], RED, light_x=25.0),
    ]
    scenarios, alone, places = further_egos(recordings, SMALL, EGOS)
    egos = [(scenarios[index].ego_slot[k - 1], scenarios[index].ego_last_step[k - 1]) for index, k in places]
    banks = (ScenarioBank.from_scenarios(each, trim=False) for each in (scenarios, alone))
    return *banks, np.column_stack([places[:, 0], egos])


@jax.jit
def roll(bank, index, slot, left_m):
    """States and transitions of an agent that follows its log, ever further to the left of it, and observations."""

    def step(state, _):
        x, y, heading, speed = logged_motion(bank, state.context, 1)
        offset = left_m * (state.context.step - 9)
        motion = jnp.stack([x - offset * jnp.sin(heading), y + offset * jnp.cos(heading), heading, speed])
        after, result = SIMULATOR.replay(bank, state, motion, jnp.zeros(2))
        situation = SIMULATOR.situation(bank, after)
        controls = [planner.controls(bank, situation) for planner in (ConstantSpeed(), IdmPlanner())]
        obs = SIMULATOR.observe(bank, after.context)
        metrics = episode_metrics(bank, after)
        return after, (after.facts, has_route(bank, after.context), obs, controls, metrics, result.truncated)

    states = jax.vmap(lambda index, slot: SIMULATOR.reset(bank, index, 10, slot))(index, slot)
    # Map the step, not the loop: to map a loop, JAX traces its body several times.
    _, steps = jax.lax.scan(jax.vmap(step, (0, None)), states, None, STEPS)
    return jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), steps)


@pytest.fixture(scope="module", params=[0.0, 0.2], ids=["log", "offset"])
def both(request, worlds):
    bank, alone, places = worlds
    index, slot, _ = jnp.asarray(places.T, jnp.int32)
    zero = jnp.zeros_like(slot)
    first = roll(bank, index, slot, request.param)
    return first, roll(alone, jnp.arange(len(places)), zero, request.param), request.param


def test_measurements_and_observations_are_those_of_a_recorded_ego(both, worlds):
    (facts, routed, obs, controls, _, _), (own, own_routed, own_obs, own_controls, _, _), offset = both
    lasts = worlds[2][:, 2]
    assert np.asarray(routed).all() and np.asarray(own_routed).all()
    # Lanes have other numbers; goals and completed shares differ where a log ends earlier than its scenario.
    names = set(FACTS | ON_REQUEST) - {"strand", "goal_distance_m", "completed", "early_m"}
    for row, last in enumerate(lasts):
        steps = slice(0, min(last - 10, STEPS))
        every = names | ({"goal_distance_m", "completed", "early_m"} if last == 90 else set())
        for name in every:
            values = (np.asarray(getattr(each, name), float)[row, steps] for each in (facts, own))
            np.testing.assert_allclose(*values, atol=5e-3, err_msg=f"{name} of {row}")
        groups = {"route", "route_mask", "lights"} & set(obs)
        for name in groups if last == 90 else ():
            np.testing.assert_allclose(obs[name][row, steps], own_obs[name][row, steps], atol=2e-3)
        for pair, own_pair in zip(controls, own_controls, strict=True):
            for control, own_control in zip(pair, own_pair, strict=True):
                np.testing.assert_allclose(control[row, steps], own_control[row, steps], atol=2e-2)
    if offset:
        assert np.asarray(facts.off_route).any() and (np.asarray(facts.late_m) > 0.05).any()
    else:
        assert np.asarray(facts.red_light).any()


def test_metrics_are_those_of_a_recorded_ego(both, worlds):
    (*_, metrics, truncated), (*_, own, _), offset = both
    for row, last in enumerate(worlds[2][:, 2]):
        assert int(metrics["last_step"].value[row, 0]) == last
        if not offset:
            assert np.flatnonzero(truncated[row]).tolist() == [*range(last - 11, STEPS)]
        if last == 90:
            for name in set(metrics) - {"last_step"}:
                assert np.asarray(metrics[name].defined[row]).tolist() == own[name].defined[row].tolist()
                np.testing.assert_allclose(
                    metrics[name].value[row], own[name].value[row], atol=5e-3, err_msg=name
                )


def test_other_vehicles_have_no_route(worlds):
    bank = worlds[0]
    others = set(range(5)) - set(np.asarray(bank.egos[0]).tolist())
    for slot in others:
        assert not has_route(bank, SIMULATOR.context(bank, 0, 10, slot))
    assert has_route(bank, SIMULATOR.context(bank, 0, 10, 0))
