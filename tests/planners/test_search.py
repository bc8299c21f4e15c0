"""The search over braking and steering, on scenes whose answer is known."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

from drivax.evaluation.audit import scenario_names
from drivax.evaluation.runner import evaluate
from drivax.planners.search import SearchPlanner
from drivax.scenario.assemble import assemble
from drivax.scenario.bank import ScenarioBank
from drivax.scenario.schema import AgentKind
from drivax.simulator.simulator import Simulator
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from scenes import RED, SMALL, bank_of, car, moved, straight_road

TASK = Task(observation=ObservationConfig(agents=2, steps=1, road=0, lights=1, route=2))
SIMULATOR = Simulator(TASK)
PERSON = partial(car, length=0.6, width=0.6, kind=AgentKind.PEDESTRIAN)


@jax.jit
def first_action(bank):
    planner, key = SearchPlanner(), jax.random.key(0)
    state = SIMULATOR.reset(bank, 0, 10, 0)
    return planner.act(
        planner.init(bank, state, key), bank, state, SIMULATOR.situation(bank, state), None, key
    )[0]


def action(recording):
    return np.asarray(first_action(bank_of(recording)))


def test_a_free_road_is_driven_by_the_law_of_idm():
    throttle, steering = action(straight_road([car(0, 0, 0, 9)]))
    # Acceleration 2 m/s2 (1 - (v / v0)^4), v0 the limit of 13.4 m/s.
    assert throttle * 6.0 == pytest.approx(2.0 * (1 - (9 / 13.4) ** 4), rel=1e-3)
    assert steering == pytest.approx(0.0, abs=1e-3)


def test_it_brakes_for_a_person_who_is_about_to_step_in_front_of_it():
    """At (25, -3.75), 1.5 m/s to the left: in the middle of the lane after 2.5 s, when ego gets there at 10 m/s."""
    walking = PERSON(25, -3.75, np.pi / 2, 1.5)
    standing = PERSON(25, -3.75, np.pi / 2, 0.0)
    beside = car(2.0, 3.7, 0, 10)
    throttle, steering = action(straight_road([car(0, 0, 0, 10), walking, beside]))
    assert throttle < -0.1 and abs(steering) < 0.01
    throttle, steering = action(straight_road([car(0, 0, 0, 10), standing, beside]))
    assert throttle > 0.1 and abs(steering) < 0.01


def test_it_passes_what_stands_in_its_lane_on_the_side_where_there_is_road():
    throttle, steering = action(straight_road([car(0, 0, 0, 10), car(24, 0, 0, 0)]))
    assert steering > 0.01  # to the left: on the right is the edge
    # Somebody drives there: only braking is left.
    beside = car(2.0, 3.7, 0, 10)
    throttle, steering = action(straight_road([car(0, 0, 0, 10), car(20, 0, 0, 0), beside]))
    assert throttle < -0.3 and abs(steering) < 0.01


def test_it_knows_nothing_of_the_future():
    bank = bank_of(straight_road([car(0, 0, 0, 10), car(30, 0, 0, 5), PERSON(25, -5, np.pi / 2, 1.0)]))
    other = replace(bank, agents=bank.agents.at[:, 11:, 1:, :7].add(3.0))
    assert np.array_equal(np.asarray(first_action(bank)), np.asarray(first_action(other)))


def test_the_world_may_be_turned_and_shifted():
    recording = straight_road([car(0, 0, 0, 10), car(24, 0, 0, 0), PERSON(40, -4, np.pi / 2, 1.0)])
    turned = moved(recording, 0.7, 1000.0, -500.0)
    assert action(turned) == pytest.approx(action(recording), abs=2e-3)


@pytest.mark.slow
def test_it_copes_with_a_person_an_obstacle_a_cut_in_and_a_red_light():
    """Closed loop; whoever keeps a velocity of 10 m/s for the 8 s fails in each of them."""
    scenes = [
        straight_road([car(0, 0, 0, 10), PERSON(25, -3.75, np.pi / 2, 1.5)]),
        straight_road([car(0, 0, 0, 10), car(30, 0, 0, 0)]),
        straight_road([car(0, 0, 0, 10), car(10, 3.7, -0.15, 8.0)]),
        straight_road([car(0, 0, 0, 10)], light=RED),
    ]
    scenarios = [assemble(scene, SMALL) for scene in scenes]
    bank = ScenarioBank.from_scenarios(scenarios, trim=False)
    found = evaluate(SearchPlanner(), bank, scenario_names(scenarios), task=TASK).metrics
    assert found["accuracy"].tolist() == [1.0, 1.0, 1.0, 1.0]
