"""Edge cases: slopes, no map, other slots, gaps in the log, followers, right turns on red, lines before the start."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.evaluation.rollout import drive, evaluation_task
from drivax.evaluation.runner import evaluate
from drivax.planners.simple import ConstantVelocity, Expert
from drivax.scenario.schema import LightState
from drivax.simulator.simulator import Simulator
from drivax.tasks.task import Task
from scenes import GLIMPSE, bank_of, car, straight_road, tracks

SIMULATOR = Simulator(evaluation_task(Task(observation=GLIMPSE)))
#: For what only lights decide.
LIGHTS = Simulator(Task(observation=GLIMPSE, metrics=("red_light",), to_the_end=True))


def metrics(planner, bank, simulator=SIMULATOR, slot=0, **options):
    keys = jax.random.split(jax.random.key(0), len(bank))
    # The slot is an argument, so that one program serves all agents.
    result = drive(simulator, planner, bank, jnp.arange(len(bank)), keys, slot=slot, **options)
    return {name: float(v.value[0]) if bool(v.defined[0]) else None for name, v in result.metrics.items()}


def on_a_slope(recording, grade):
    """The same world with z = grade * x; boxes stand on the road."""

    def lifted(points):
        return np.concatenate([points[:, :2], grade * points[:, :1]], axis=1)

    features = tuple(replace(f, points=lifted(f.points)) for f in recording.features)
    z = np.where(recording.tracks.valid, grade * recording.tracks.xy[..., 0] + 0.75, 0.0)
    return replace(recording, features=features, tracks=replace(recording.tracks, z=z))


@pytest.mark.slow
def test_a_car_that_falls_behind_its_log_on_a_slope_stays_on_the_road():
    # The log drives 18 m/s up a grade of 10 %; a car at its first 2 m/s is 12 m below it at the end, on the same road.
    log = car(0, 0, 0, 18)
    slow = np.arange(91) <= 11
    t = (np.arange(91) - 10) * 0.1
    x = np.where(slow, 2 * t, 0.2 + 18 * (t - 0.1))
    log["xy"], log["velocity"] = np.stack([x, 0 * x], -1), np.stack([np.where(slow, 2.0, 18.0), 0 * x], -1)
    for grade in (0.0, 0.1):
        found = metrics(
            ConstantVelocity(), bank_of(on_a_slope(straight_road([log, car(14, 0.2, 0, 0)]), grade))
        )
        assert (found["offroad"], found["lane_straddle"], found["off_route"]) == (0.0, 0.0, 0.0), grade
        assert found["collision"] == 1.0 and found["distance"] == pytest.approx(16, abs=0.2)


@pytest.mark.slow
def test_without_a_map_nothing_is_off_the_road():
    recording = straight_road([car(0, 0, 0, 5), car(30, 0, 0, 5)])
    found = metrics(Expert(), bank_of(replace(recording, features=(), route_lanes=())))
    for name in ("offroad", "left_map", "accuracy", "success", "progress", "nuplan_score", "off_route"):
        assert found[name] is None, name
    assert found["collision"] == 0.0


@pytest.mark.slow
def test_other_slots_have_no_route_and_no_route_reward():
    bank = bank_of(straight_road([car(0, 0, 0, 8), car(20, 3.7, 0, 9)]))
    found = metrics(Expert(), bank, slot=1)
    for name in ("progress", "progress_ratio", "success", "off_route", "vmax_score", "goal_distance"):
        assert found[name] is None, name
    assert found["accuracy"] == 1.0 and found["distance"] == pytest.approx(72, abs=0.1)
    simulator = Simulator(Task(observation=GLIMPSE, metrics="none"))

    @jax.jit
    def one(bank):
        state = simulator.reset(bank, 0, 10, 1)
        _, transition = simulator.step(bank, state, jnp.zeros(2))
        return simulator.observe(bank, state.context)["route_mask"], transition.reward

    mask, reward = one(bank)
    assert not np.asarray(mask).any() and float(reward) == 0.0


@pytest.mark.slow
def test_gaps_in_the_ego_log_are_no_divergence():
    steps = [*range(40), *range(50, 80)]
    bank = bank_of(straight_road([car(0, 0, 0, 5, steps=steps), car(40, 3.7, 0, 5)]))
    found = metrics(Expert(), bank)
    assert found["ade"] == pytest.approx(0.0, abs=1e-3) and found["fde"] == pytest.approx(0.0, abs=1e-3)
    names = [{"dataset": "test", "scenario_id": "gap", "segment": "gap"}]
    with pytest.raises(UsageError, match=r"gap.*not in the log at step 45"):
        evaluate(ConstantVelocity(), bank, names, start_step=45)


def test_a_follower_that_runs_into_ego_costs_no_ttc():
    bank = bank_of(straight_road([car(0, 0, 0, 5), car(-15, 0, 0, 12)]))
    found = metrics(ConstantVelocity(), bank)
    assert (found["collision"], found["at_fault_collision"], found["collision_type"]) == (1.0, 0.0, 2.0)
    assert found["min_ttc"] == 5.0 and found["ttc_ok"] == 1.0


def turning_right(stood_until):
    """A car that stands at a red light until a step, then turns right on red across the line at x = 10."""
    recording = straight_road([car(0, 0, 0, 0)], light=4, light_x=10.0)
    t = np.maximum(np.arange(91) - stood_until, 0) * 0.1
    s = np.minimum(0.5 * 3.0 * t**2, 3.0 * t)  # then up to 3 m/s
    before, turn = 10.2, 8.0  # the front bumper stands 2.6 m before the line
    angle = -np.clip((s - before + 5.0) / turn, 0.0, np.pi / 2)
    x = 5.0 + np.minimum(s, before - 5.0) + turn * np.sin(-angle)
    y = -turn * (1 - np.cos(angle))
    speed = np.gradient(s, 0.1)
    log = car()
    log |= {"xy": np.stack([x, y], -1), "heading": angle}
    log["velocity"] = speed[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    arc = np.linspace(0, np.pi / 2, 20)
    bend = np.stack([10 + 8 * np.sin(arc), -8 * (1 - np.cos(arc)), 0 * arc], -1)
    features = [replace(f, points=bend) if f.feature_id == 3 else f for f in recording.features]
    return replace(recording, tracks=tracks([log]), features=tuple(features))


@pytest.mark.slow
@pytest.mark.parametrize("start", [4, 10])
def test_a_right_turn_after_a_stop_is_lawful_wherever_the_episode_begins(start):
    bank = bank_of(turning_right(stood_until=8))
    assert metrics(Expert(), bank, LIGHTS, start_step=start)["red_light"] == 0.0


@pytest.mark.slow
def test_a_right_turn_on_red_without_a_stop_is_not():
    recording = turning_right(stood_until=8)
    moving = recording.tracks.velocity + np.array([1.0, 0.0]) * (np.arange(91) < 12)[:, None]
    still_rolling = replace(recording, tracks=replace(recording.tracks, velocity=moving))
    assert metrics(Expert(), bank_of(still_rolling), LIGHTS, start_step=10)["red_light"] == 1.0


@pytest.mark.slow
def test_stop_line_crossed_before_the_episode_does_not_count():
    # Slot 1, which has no route, crosses the red line between steps 9 and 10.
    bank = bank_of(straight_road([car(-60, 0, 0, 10), car(37.9, 0, 0, 10)], light=LightState.STOP))
    simulator = Simulator(Task(observation=GLIMPSE, metrics=("red_light",), ends=()))

    @jax.jit
    def run(bank, begin):
        def one(state, _):
            state, _ = simulator.step(bank, state, jnp.zeros(2))
            return state, state.facts.red_light

        return jax.lax.scan(one, simulator.reset(bank, 0, begin, 1), None, length=40)[1]

    assert not np.asarray(run(bank, 10)).any()
    assert np.flatnonzero(run(bank, 9)).tolist() == [20]  # decided two seconds later
