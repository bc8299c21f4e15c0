"""Logs of different lengths: short logs in banks of longer ones, and scenarios of 15 s.

The oracle of a short log: the same log in a bank that has no room for more steps, where no code can see a difference
between the end of the log and the end of the arrays. All values agree, because all that looks ahead (goal, routes,
paths of traffic) sees the same log. The first steps of a longer log are another oracle, of what does not look ahead.
"""

from dataclasses import fields, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.adapters.gym import DrivingEnv
from drivax.curation.kinematic import KinematicConfig, PublishedConfig
from drivax.curation.logged import score_bank
from drivax.errors import DataError, UsageError
from drivax.evaluation import runner
from drivax.evaluation.audit import audit, scenario_names
from drivax.evaluation.observation_statistics import observation_statistics
from drivax.evaluation.runner import evaluate
from drivax.learning.driving import Driving
from drivax.learning.environment import collect
from drivax.planners.functions import python_planner
from drivax.planners.simple import ConstantVelocity, Expert, IdmPlanner
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import CAPACITIES, STEPS, Flag
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.reactive import IdmTraffic
from drivax.tasks.task import Task
from metric_scenes import driven
from scenes import GLIMPSE, RED, SMALL, car, straight_road

SHORT = 45
TASK = Task(observation=GLIMPSE)
#: Metrics that see the whole log: the goal and the route to it, and the log's own progress.
LOOK_AHEAD = {
    "progress", "progress_ratio", "making_progress", "route_deviation_mean", "route_deviation_max", "off_route",
    "goal_distance", "reached_goal", "success", "success_moving", "vmax_score", "nuplan_score",
    "vmax_score_partial", "nuplan_score_partial",
}  # fmt: skip


def cut(recording, steps):
    """Return the first steps of a recording."""
    timed = {f.name: getattr(recording.tracks, f.name) for f in fields(recording.tracks)}
    timed = {name: value[:, :steps] if value.ndim > 1 else value for name, value in timed.items()}
    lights = tuple(replace(light, states=light.states[:steps]) for light in recording.lights)
    times = recording.timestamps_s[:steps]
    return replace(recording, tracks=replace(recording.tracks, **timed), lights=lights, timestamps_s=times)


def scenes():
    """A scenario with a red light and a collision, and one behind a braking and an appearing car."""
    braking = driven(np.clip(9.0 - 0.15 * np.arange(STEPS), 0.0, None))
    late = car(x=-14.0, y=3.7, speed=9.0, steps=range(20, STEPS))
    weave = driven(np.clip(8.0 + 0.1 * np.arange(STEPS), 8.0, 14.0), 0.03 * np.sin(np.arange(STEPS) / 6))
    ahead = braking | {"xy": braking["xy"] + [25.0, 0.0]}
    return [
        straight_road([car(speed=10.0), car(x=33.0, speed=0.0)], light=RED, light_x=20.0),
        straight_road([weave, ahead, late], light=[4] * 30 + [6] * 61, light_x=60.0),
    ]


def named(recording, name, capacity=SMALL):
    return assemble(replace(recording, scenario_id=name, segment=name), capacity)


@pytest.fixture(scope="module")
def logs():
    """Scenarios of the same short logs, with padding next to long logs and without room for further steps."""
    exact = replace(SMALL, steps=SHORT)
    padded = [named(cut(scene, SHORT), f"short-{i}") for i, scene in enumerate(scenes())]
    alone = [named(cut(scene, SHORT), f"short-{i}", exact) for i, scene in enumerate(scenes())]
    long = [named(scene, f"long-{i}") for i, scene in enumerate(scenes())]
    assert not any(Flag.NO_FUTURE in scenario.has for scenario in (*padded, *alone))
    return padded, alone, long


@pytest.mark.parametrize(
    ("planner", "traffic"),
    [
        (Expert(), None),
        pytest.param(Expert(replays=False), None, marks=pytest.mark.slow),
        pytest.param(IdmPlanner(), IdmTraffic(), marks=pytest.mark.slow),
    ],
)
def test_short_log_next_to_long_ones_is_judged_to_its_last_step(logs, planner, traffic):
    padded, alone, long = logs
    mixed = evaluate(planner, [long[0], *padded, long[1]], task=TASK, traffic=traffic)
    other = evaluate(planner, alone, task=TASK, traffic=traffic)
    whole = evaluate(planner, long, task=TASK, traffic=traffic)
    for name, values in mixed.metrics.items():
        expected = np.insert(whole.metrics[name], 1, other.metrics[name])
        np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-5, err_msg=name)
    np.testing.assert_array_equal(mixed.metrics["last_step"], [90, SHORT - 1, SHORT - 1, 90])
    np.testing.assert_array_equal(mixed.metrics["steps"], [80, SHORT - 11, SHORT - 11, 80])
    for name, steps in mixed.trajectories.events.items():
        np.testing.assert_array_equal(steps[1:3], other.trajectories.events[name], err_msg=name)
        assert (steps[1:3] < SHORT).all()
    actions = SHORT - 11
    shown = mixed.trajectories
    np.testing.assert_allclose(shown.ego[1:3, : actions + 1], other.trajectories.ego, atol=1e-5)
    np.testing.assert_allclose(shown.action[1:3, :actions], other.trajectories.action, atol=1e-5)
    assert np.isnan(shown.action[1:3, actions:]).all() and np.isfinite(shown.action[[0, 3]]).all()
    # The scenes are not trivial: they differ by what happens after the end of the short log.
    assert (whole.metrics["distance"] > other.metrics["distance"] + 5.0).any()


@pytest.mark.slow
def test_first_steps_of_a_long_log_equal_the_short_log(logs):
    _, alone, long = logs
    bank = ScenarioBank.from_scenarios(long, trim=False)
    early = replace(bank, last_step=jnp.full(2, SHORT - 1))
    for planner in (Expert(), ConstantVelocity()):
        first = evaluate(planner, early, scenario_names(long), task=TASK)
        other = evaluate(planner, alone, task=TASK)
        assert first.metrics.keys() >= LOOK_AHEAD
        for name in first.metrics.keys() - LOOK_AHEAD:
            np.testing.assert_allclose(
                first.metrics[name], other.metrics[name], rtol=1e-5, atol=1e-5, err_msg=name
            )
    assert (first.metrics["red_light"] == [1, 0]).all() and (first.metrics["collision"] == [1, 0]).all()


@pytest.mark.slow
def test_a_planner_cannot_crash_after_the_end_of_the_log(logs):
    padded, _, long = logs

    def fragile(situation, observation):
        if situation.context.step >= SHORT - 1:
            raise RuntimeError("too late")
        return np.zeros(2)

    table = evaluate(python_planner(fragile), [padded[0], long[0]], task=TASK)
    np.testing.assert_array_equal(table.metrics["crashed"], [0, 1])


def test_starts_after_the_end_of_the_log_are_refused(logs):
    padded, _, long = logs
    for step, counted in ((SHORT - 1, "2 of 3"), (60, "2 of 3")):
        with pytest.raises(UsageError, match=rf"no action after step {step} in {counted}"):
            evaluate(Expert(), [*padded, long[0]], task=TASK, start_step=step)
    assert len(runner._stored_names(padded, SHORT - 2)) == 2
    with pytest.raises(UsageError, match="use 0 to 43"):
        evaluate(Expert(), logs[1], task=TASK, start_step=SHORT - 1)


@pytest.mark.slow
def test_episode_of_one_step_starts_before_the_end_of_the_log(logs):
    table = evaluate(Expert(), logs[0], task=TASK, start_step=SHORT - 2)
    assert table.metrics["steps"].tolist() == [1, 1]


@pytest.mark.slow
def test_audit_of_a_short_log_ends_with_it(logs):
    padded, alone, long = logs
    result = audit([*padded, long[0]])
    assert result[:2] == audit(alone)
    assert result[2] == audit(long)[0]
    assert result[0]["distance_m"] == pytest.approx(10.0 * 0.1 * (SHORT - 11), abs=0.01)


def test_criticality_of_a_short_log_is_that_of_the_log_alone(logs):
    padded, alone, long = logs
    mixed = ScenarioBank.from_scenarios([*padded, long[0]], trim=False)
    other = ScenarioBank.from_scenarios(alone, trim=False)
    for config in (KinematicConfig(), PublishedConfig()):
        scores, expected = score_bank(config, mixed), score_bank(config, other)
        for name, values in expected.items():
            np.testing.assert_allclose(scores[name][:2, :SHORT], values, atol=1e-5, err_msg=name)


@pytest.mark.slow
def test_expert_steps_of_a_short_log_end_with_it(logs):
    padded, alone, long = logs
    driving = Driving(Simulator(replace(TASK, metrics="none", ends=())))
    mixed = driving.expert_steps(ScenarioBank.from_scenarios([*padded, long[0]], trim=False))
    other = driving.expert_steps(ScenarioBank.from_scenarios(alone, trim=False))
    usable = np.asarray(mixed.usable)
    assert not usable[:2, SHORT - 2 :].any() and usable[2, SHORT - 2 : 88].all()
    np.testing.assert_array_equal(usable[:2, :SHORT], other.usable)
    assert np.asarray(mixed.truncated)[:2, SHORT - 2].all()
    for name in ("action", "reward", "terminated", "clipped"):
        values, expected = (np.asarray(getattr(steps, name)) for steps in (mixed, other))
        known = np.asarray(other.usable)
        np.testing.assert_allclose(values[:2, :SHORT][known], expected[known], atol=1e-5, err_msg=name)


def test_training_episodes_lie_within_their_logs(logs):
    padded, _, long = logs
    bank = ScenarioBank.from_scenarios([*padded, long[0]], trim=False)
    last = np.asarray(bank.last_step)
    for latest in (None, 60):
        index, step = map(
            np.asarray, Driving(Simulator(Task()))._draw(bank, jax.random.key(0), 4000, 10, latest)[:2]
        )
        for row in range(3):
            most = min(last[row] - 2, latest or 88)
            counts = np.bincount(step[index == row], minlength=91)[10 : most + 1]
            # Uniform over the steps of the log, not heaped at the current step.
            assert (
                counts.sum() == (index == row).sum() and counts.min() > 0 and counts.max() < 3 * counts.mean()
            )


def test_collected_episodes_are_truncated_at_the_last_step_of_their_log(logs):
    padded, _, long = logs
    bank = ScenarioBank.from_scenarios([*padded, long[0]], trim=False)
    driving = Driving(Simulator(replace(TASK, ends=(), metrics="none")))

    def actor(observation, key):
        action = jnp.zeros((8, 2))
        return action, action, {}

    @jax.jit
    def run(bank):
        environments = driving.start(bank, jax.random.key(0), 8)
        return collect(driving, bank, environments, actor, jax.random.key(1), 100, "state")[1]

    rollout = run(bank)
    index, step, alive, truncated = map(
        np.asarray, (rollout.state.index, rollout.state.step, rollout.alive, rollout.truncated)
    )
    last = np.asarray(bank.last_step)[index]
    assert not rollout.terminated.any()
    np.testing.assert_array_equal(truncated[alive], (step == last - 1)[alive])
    assert (step[alive] < last[alive]).all()
    assert {0, 1, 2} == set(index[truncated & alive].tolist())


def test_gymnasium_truncates_a_short_log_at_its_end(tmp_path):
    from drivax.scenario.store import ScenarioWriter

    with ScenarioWriter(tmp_path / "set", SMALL) as writer:
        for name, steps in (("short", SHORT), ("long", STEPS)):
            writer.add(named(cut(straight_road([car(speed=8.0)]), steps), name))
    env = DrivingEnv(tmp_path / "set", replace(TASK, metrics="none"))
    for row, steps in ((0, SHORT), (1, STEPS)):
        env.reset(options={"scenario": row})
        ends = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(steps - 11)]
        assert ends == [(False, False)] * (steps - 12) + [(False, True)]


@pytest.mark.slow
def test_sampled_states_lie_within_their_logs(logs):
    mixed, other = (
        observation_statistics(
            ConstantVelocity(),
            ScenarioBank.from_scenarios(scenarios, trim=False),
            TASK,
            permute=False,
            every=2,
        )
        for scenarios in logs[:2]
    )
    assert mixed.states == other.states == 2 * (SHORT - 11) // 2
    for feature, expected in zip(mixed.features, other.features, strict=True):
        assert (feature.count, feature.broken) == (expected.count, 0)
        for name in ("mean", "std", "low", "high", "collision"):
            value = getattr(expected, name)
            assert getattr(feature, name) == pytest.approx(value, abs=1e-4, nan_ok=True), feature.name


def test_capacity_for_fifteen_seconds_has_room_for_longer_routes():
    longer = CAPACITIES["default"].with_future(15.0)
    assert (longer.steps, longer.route_points, longer.name) == (161, 680, "default-15s")
    assert CAPACITIES["large"].with_future(8.0) is CAPACITIES["large"]
    assert CAPACITIES["default"].with_future(3.0).steps == 41


def test_scenarios_of_several_lengths_are_refused_together(logs):
    with pytest.raises(
        DataError, match=r"'default' \(45 steps\), others 'default' \(91 steps\); convert all"
    ):
        ScenarioBank.from_scenarios([logs[0][0], logs[1][0]])
