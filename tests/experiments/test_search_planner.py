"""The search over braking and steering, in scenes with a known answer."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from search_planner import SearchPlanner, advance, extrapolate

from drivax.evaluation.audit import scenario_names
from drivax.evaluation.runner import evaluate
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import AgentKind
from drivax.simulator.simulator import Simulator
from drivax.tasks.task import Task
from drivax.testing.worlds import rotate_recording
from scenes import GLIMPSE, RED, SMALL, bank_of, car, straight_road

TASK = Task(observation=GLIMPSE, metrics="none")
SIMULATOR = Simulator(TASK)
PERSON = partial(car, length=0.6, width=0.6, kind=AgentKind.PEDESTRIAN)


@jax.jit
def first_action(bank, stood_s=0.0):
    planner, key = SearchPlanner(), jax.random.key(0)
    state = SIMULATOR.reset(bank, 0, 10, 0)
    carry = planner.init(bank, state, key)
    carry = replace(carry, stood_s=carry.stood_s + stood_s)
    return planner.act(carry, bank, state, SIMULATOR.situation(bank, state), None, key)[0]


def action(recording, stood_s=0.0):
    """The first action, after all standing agents have stood for ``stood_s``."""
    return np.asarray(first_action(bank_of(recording), stood_s))


@pytest.mark.slow
def test_free_road_is_driven_by_idm():
    throttle, steering = action(straight_road([car(0, 0, 0, 9)]))
    # Acceleration 2 m/s2 (1 - (v / v0)^4), v0 the limit of 13.4 m/s.
    assert throttle * 6.0 == pytest.approx(2.0 * (1 - (9 / 13.4) ** 4), rel=1e-3)
    assert steering == pytest.approx(0.0, abs=1e-3)


def test_brakes_for_a_pedestrian_about_to_step_in_front_of_ego():
    """At (25, -3.75), 1.5 m/s to the left: in the middle of the lane after 2.5 s, when ego gets there at 10 m/s."""
    walking = PERSON(25, -3.75, np.pi / 2, 1.5)
    standing = PERSON(25, -3.75, np.pi / 2, 0.0)
    alongside = car(2.0, 3.7, 0, 10)
    throttle, steering = action(straight_road([car(0, 0, 0, 10), walking, alongside]))
    assert throttle < -0.1 and abs(steering) < 0.01
    throttle, steering = action(straight_road([car(0, 0, 0, 10), standing, alongside]))
    assert throttle > 0.1 and abs(steering) < 0.01


def test_passes_a_standing_obstacle_on_the_side_with_road():
    throttle, steering = action(straight_road([car(0, 0, 0, 10), car(24, 0, 0, 0)]))
    assert steering > 0.01  # to the left: on the right is the edge
    # An agent drives there: only braking is left.
    alongside = car(2.0, 3.7, 0, 10)
    throttle, steering = action(straight_road([car(0, 0, 0, 10), car(20, 0, 0, 0), alongside]))
    assert throttle < -0.3 and abs(steering) < 0.01


@pytest.mark.slow
def test_first_action_does_not_depend_on_the_future():
    bank = bank_of(straight_road([car(0, 0, 0, 10), car(30, 0, 0, 5), PERSON(25, -5, np.pi / 2, 1.0)]))
    other = replace(bank, agents=bank.agents.at[:, 11:, 1:, :7].add(3.0))
    assert np.array_equal(np.asarray(first_action(bank)), np.asarray(first_action(other)))


def test_action_is_invariant_to_rotation_and_translation():
    recording = straight_road([car(0, 0, 0, 10), car(24, 0, 0, 0), PERSON(40, -4, np.pi / 2, 1.0)])
    turned = rotate_recording(recording, 0.7, 1000.0, -500.0)
    assert action(turned) == pytest.approx(action(recording), abs=2e-3)


@pytest.mark.slow
def test_handles_a_pedestrian_an_obstacle_a_cut_in_and_a_red_light():
    """In closed loop; constant velocity for 8 s fails in each scene."""
    scenes = [
        straight_road([car(0, 0, 0, 10), PERSON(25, -3.75, np.pi / 2, 1.5)]),
        straight_road([car(0, 0, 0, 10), car(30, 0, 0, 0)]),
        straight_road([car(0, 0, 0, 10), car(10, 3.7, -0.15, 8.0)]),
        straight_road([car(0, 0, 0, 10)], light=RED),
    ]
    scenarios = [assemble(recording, SMALL) for recording in scenes]
    bank = ScenarioBank.from_scenarios(scenarios, trim=False)
    result = evaluate(SearchPlanner(), bank, scenario_names(scenarios), task=TASK).metrics
    assert result["accuracy"].tolist() == [1.0, 1.0, 1.0, 1.0]


def test_stays_in_its_lane_behind_a_queue():
    """Two agents that stand one behind the other are a queue; one that has long stood alone is not."""
    behind_it, alone = [car(20, 0, 0, 0), car(28, 0, 0, 0)], [car(20, 0, 0, 0), car(45, 0, 0, 0)]
    _, steering = action(straight_road([car(0, 0, 0, 5), *behind_it]), stood_s=5.0)
    assert abs(steering) < 0.01
    _, steering = action(straight_road([car(0, 0, 0, 5), *alone]), stood_s=5.0)
    assert steering > 0.01
    _, steering = action(straight_road([car(0, 0, 0, 5), *alone]), stood_s=1.0)
    assert abs(steering) < 0.01


def test_brakes_for_an_object_that_may_stop_in_its_lane():
    """A box that is pushed onto the road at 3.5 m/s would cross it in time, but may stop in ego's path."""
    pushed = partial(car, length=1.0, width=1.0, kind=AgentKind.OTHER)
    # Ego is there after 2.5 s; at a constant 3.5 m/s the box has left its lane after 1.8 s.
    alongside = car(2.0, 3.7, 0, 12)
    throttle, _ = action(straight_road([car(0, 0, 0, 12), pushed(32, -3.5, np.pi / 2, 3.5), alongside]))
    assert throttle < -0.1
    throttle, _ = action(straight_road([car(0, 0, 0, 12), pushed(32, -3.5, -np.pi / 2, 3.5), alongside]))
    assert throttle > 0.0


def test_lets_an_agent_change_into_its_lane():
    """The agent is more than a metre out of its lane, heads 11 degrees towards ego's and is 3 m/s slower."""
    alongside = car(-1, 3.7, 0, 11)
    throttle, _ = action(straight_road([car(0, 0, 0, 11), car(8, 2.5, -0.2, 8), alongside]))
    assert throttle < -0.2
    throttle, _ = action(straight_road([car(0, 0, 0, 11), car(8, 3.7, 0.0, 8), alongside]))
    assert throttle > 0.0


def test_does_not_cross_just_before_an_agent_that_may_come_early():
    """Ego crosses in 2.9 s; the front of the other is then 3.3 - 2.4 = 0.9 m before the middle of ego's path."""
    crossing = partial(car, 30, heading=np.pi / 2, speed=8)
    throttle, _ = action(straight_road([car(0, 0, 0, 10), crossing(-2.9 * 8 - 3.3)]))
    assert throttle < -0.1
    # 2.5 s later there is no hurry.
    throttle, _ = action(straight_road([car(0, 0, 0, 10), crossing(-5.4 * 8 - 3.3)]))
    assert throttle * 6.0 == pytest.approx(2.0 * (1 - (10 / 13.4) ** 4), rel=1e-2)


def test_accelerates_away_from_an_agent_that_would_hit_its_rear():
    """Braking from 13.3 m/s takes 14.7 m, the other crosses 6 m ahead; at the limit IDM adds nothing."""
    throttle, steering = action(straight_road([car(0, 0, 0, 13.3), car(6, -12, np.pi / 2, 10)]))
    assert throttle * 6.0 > 1.0 and abs(steering) < 0.01


def test_does_not_overtake_moving_agents():
    for ahead in (car(25, 0, 0, 8), car(15, 0, 0, 6)):
        throttle, steering = action(straight_road([car(0, 0, 0, 10), ahead]))
        assert throttle < 0.05 and abs(steering) < 0.01


def test_accelerations_are_extrapolated_for_a_while():
    boxes = jnp.asarray([[0.0, 0.0, 1.0, 0.0, 4.8, 2.0]] * 3)
    velocity = jnp.asarray([[5.0, 0.0], [12.0, 0.0], [5.0, 0.0]])
    box, speed = extrapolate(boxes, velocity, jnp.zeros(3), jnp.asarray([1.5, 1.5, -1.5]))
    # After 2 s 5 + 2 x 1.5 m/s; up to 13.4 m/s; braking lasts 1 s.
    assert np.asarray(speed)[-1] == pytest.approx([8.0, 13.4, 3.5])
    # 2 s of acceleration and 3 s at 8 m/s; the sum over steps of 0.25 s is a little larger.
    assert float(box[-1, 0, 0]) == pytest.approx(5.0 * 2 + 1.5 * 2.0**2 / 2 + 3 * 8.0, abs=0.5)


def test_brakes_for_a_pedestrian_who_starts_to_walk_onto_the_road():
    """At 0.6 m/s the pedestrian would not reach the lane in the 2.5 s that ego needs, but may run."""
    starts, away = PERSON(25, -3.7, np.pi / 2, 0.6), PERSON(25, -3.7, -np.pi / 2, 0.6)
    alongside = car(2.0, 3.7, 0, 10)
    assert action(straight_road([car(0, 0, 0, 10), starts, alongside]))[0] < -0.1
    assert action(straight_road([car(0, 0, 0, 10), away, alongside]))[0] > 0.1


def test_makes_room_for_a_cyclist_who_swerves_towards_ego():
    """20 degrees towards ego's lane from 1.7 m right of its middle; at constant velocity it would end up left of it."""
    rider = partial(car, length=1.8, width=0.6, kind=AgentKind.CYCLIST)
    _, steering = action(straight_road([car(0, 0, 0, 12), rider(30, -1.7, np.pi - 0.35, 5.5)]))
    assert steering > 0.01


def test_predicted_pose_lies_on_a_circle():
    """The pose after 0.25 s of a manoeuvre."""
    speed, curvature = 10.0, 0.02
    pose, moved_m = jnp.asarray([1.0, 2.0, np.cos(0.3), np.sin(0.3)]), speed * 0.25
    result = np.asarray(advance(pose, jnp.asarray(curvature), jnp.asarray(moved_m)))
    # A circle of 50 m radius, driven for 2.5 m.
    angle, radius = moved_m * curvature, 1.0 / curvature
    chord = 2.0 * radius * np.sin(angle / 2)
    oracle = [1.0 + chord * np.cos(0.3 + angle / 2), 2.0 + chord * np.sin(0.3 + angle / 2)]
    assert result[:2] == pytest.approx(oracle, abs=1e-3)
    assert result[2:] == pytest.approx([np.cos(0.3 + angle), np.sin(0.3 + angle)], abs=1e-5)
