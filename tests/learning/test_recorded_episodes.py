"""Recorded episodes: as driven in the training's simulator, failures included, and learned from."""

import json
import shutil
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import settings
from drivax.cli import main
from drivax.errors import DataError, UsageError
from drivax.evaluation.episode_table import EpisodeTable
from drivax.evaluation.runner import EvaluationConfig, run_evaluation
from drivax.learning.config import TrainConfig
from drivax.learning.driving import Driving
from drivax.learning.experience import ExperienceConfig, sample_steps, transitions
from drivax.learning.loop import train, usable_steps
from drivax.learning.training_set import TrainingSet, prepare_episodes, read_episodes, recorded_environment
from drivax.planners.planner import add_noise
from drivax.planners.simple import ConstantVelocity, Expert, IdmPlanner
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record as record_class
from drivax.scenario.store import ScenarioSet
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.bank_data import prepare_bank
from drivax.simulator.traffic.reactive import make_traffic
from drivax.simulator.types import AgentContext
from drivax.synthetic.generate import Generation, generate
from drivax.tasks.actions import Physical, Published, Route
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task
from drivax.tracking.run_folder import RunFolder

OBSERVATION = ObservationConfig(agents=2, steps=2, road=0, lights=1, route=3)
TASK = Task(observation=OBSERVATION, rewards=RewardConfig("behaviour"), metrics="none")
NETWORK = {"encoder": {"rows": [8], "hidden": [16]}, "head": [8]}
TINY = {
    "task": {"observation": {"agents": 2, "steps": 1, "road": 0, "lights": 1, "route": 3}},
    "algorithm": {"kind": "awac", "network": NETWORK, "batch": 8, "updates": 2},
    "total_steps": 64, "evaluate_every": 2,
}  # fmt: skip


def record(planner, data, out, traffic="log", task=TASK, **config):
    """Evaluate a planner into a run folder."""
    config = EvaluationConfig(planner=planner.name, traffic=traffic, task=task, **config)
    run_evaluation(config, planner, data, out)
    return out


def episodes_of(data, *folders, task=TASK, traffic="log"):
    """The environment of recorded episodes, and these."""
    tables = read_episodes(folders, data, task, traffic)
    driving = Driving(Simulator(task, make_traffic(traffic)))
    bank = driving.prepare(ScenarioBank.from_scenarios(data))
    environment = recorded_environment(driving, tables)
    return environment, prepare_episodes(environment, bank, data, tables)


def simulate(planner, bank, traffic, task=TASK):
    """Drive a planner in the training's task; return observation, action, reward and ends of every step."""
    simulator = Simulator(task, make_traffic(traffic))
    bank = prepare_bank(simulator.traffic, bank)

    def step(state, key):
        observation = simulator.observe(bank, state.context)
        situation = simulator.situation(bank, state)
        action, _ = planner.act((), bank, state, situation, observation, key)
        after, result = simulator.step(bank, state, action)
        outcome = (after.context.action, result.reward, result.terminated, result.truncated)
        return after, (dict(observation), dict(simulator.observe(bank, after.context)), *outcome)

    states = jax.vmap(partial(simulator.reset, bank))(jnp.arange(len(bank)))
    _, steps = jax.lax.scan(
        jax.vmap(step, (0, None)), states, jax.random.split(jax.random.key(0), bank.steps - 11)
    )
    return jax.tree.map(lambda leaf: np.swapaxes(np.asarray(leaf), 0, 1), steps)


@pytest.mark.slow
@pytest.mark.parametrize("traffic", ["log", "idm"])
def test_episodes_equal_those_in_the_simulator_of_the_training(data, tmp_path, traffic):
    """The evaluation measured other facts and did not end at failures; rewards and ends are those of the training."""
    run = record(ConstantVelocity(), data, tmp_path / "run", traffic)
    environment, episodes = episodes_of(data, run, traffic=traffic)
    observation, next_observation, action, reward, terminated, truncated = simulate(
        ConstantVelocity(), ScenarioBank.from_scenarios(data), traffic
    )
    experience = ExperienceConfig().of(environment, episodes)
    steps = jax.device_get(episodes.steps)
    ends = terminated | truncated
    alive = np.cumsum(ends, axis=1) - ends == 0
    np.testing.assert_array_equal(steps.usable[:, 10:-1], alive)
    assert not steps.usable[:, :10].any() and not steps.usable[:, -1].any()
    assert terminated.any(), "constant velocity leaves the road somewhere"
    row, step = np.nonzero(steps.usable)
    index = jnp.asarray(row), jnp.asarray(step)
    batch = jax.device_get(jax.jit(lambda e, i: transitions(environment, e, i, 0.9))(experience, index))
    at = (row, step - 10)
    # Evaluations store actions as half-precision numbers.
    for expected, found in ((observation, batch.observation), (next_observation, batch.next_observation)):
        for name, value in expected.items():
            np.testing.assert_allclose(found[name], value[at], atol=2e-3, rtol=1e-4, err_msg=name)
    np.testing.assert_allclose(batch.action, action[at], atol=1e-3)
    np.testing.assert_allclose(batch.reward, reward[at], atol=1e-4, rtol=1e-4)
    np.testing.assert_array_equal(batch.terminated, terminated[at])


def test_recorded_expert_equals_the_log(data, tmp_path):
    """Where its actions are within the bounds; others lead elsewhere."""
    run = record(Expert(), data, tmp_path / "run")
    _, episodes = episodes_of(data, run)
    bank = ScenarioBank.from_scenarios(data)
    logged = jax.device_get(Driving(Simulator(TASK)).expert_steps(bank))
    steps = jax.device_get(episodes.steps)
    both = logged.usable & steps.usable
    assert both.sum() == logged.usable.sum() > 100
    np.testing.assert_array_equal(steps.clipped[both], logged.clipped[both])
    np.testing.assert_allclose(steps.reward[both], logged.reward[both], atol=1e-4)
    np.testing.assert_allclose(steps.action[both], logged.action[both], atol=1e-3)


def test_clipped_actions_of_any_replay_of_the_log_are_left_out(data, tmp_path):
    @record_class
    class MyReplay(Expert):
        name = "mine"

    _, expected = episodes_of(data, record(Expert(), data, tmp_path / "expert"))
    _, episodes = episodes_of(data, record(MyReplay(), data, tmp_path / "mine"))
    np.testing.assert_array_equal(episodes.steps.clipped, expected.steps.clipped)


@pytest.mark.slow
def test_held_decisions_are_recorded_with_the_sum_of_their_rewards(data, tmp_path):
    task = replace(TASK, hold=5)
    environment, episodes = episodes_of(
        data, record(IdmPlanner(), data, tmp_path / "run", task=task), task=task
    )
    experience, steps = ExperienceConfig().of(environment, episodes), jax.device_get(episodes.steps)
    row, step = np.nonzero(np.asarray(experience.usable))
    assert set(step) == set(range(10, 90, 5))
    batch = jax.device_get(transitions(environment, experience, (jnp.asarray(row), jnp.asarray(step)), 0.9))
    for n in range(len(row)):
        window = np.s_[row[n], step[n] : step[n] + 5]
        executed = steps.usable[window]
        assert (steps.action[window][executed] == batch.action[n]).all()
        assert batch.reward[n] == pytest.approx(steps.reward[window][executed].sum(), abs=1e-5)


def test_steps_after_a_crash_of_the_planner_are_not_used(data, tmp_path):
    @record_class
    class Crashing(IdmPlanner):
        name = "crashing"

        def choose(self, bank, situation, observation, key):
            action = super().choose(bank, situation, observation, key)
            return jnp.where(situation.context.step < 20, action, jnp.nan)

    _, episodes = episodes_of(data, record(Crashing(), data, tmp_path / "run"))
    usable = np.asarray(episodes.steps.usable)
    assert usable[:, 10:20].all() and not usable[:, 20:].any()


@pytest.mark.slow
def test_route_actions_steer_as_recorded(data, tmp_path):
    """Executed actions of the space ``route`` are physical; an offset is recovered from them."""
    task = replace(TASK, actions=Route())
    run = record(IdmPlanner(actions=Route()), data, tmp_path / "run", task=task)
    _, episodes = episodes_of(data, run, task=task)
    _, physical = episodes_of(data, run)
    bank, steps = episodes.bank, episodes.steps
    row, step = (jnp.asarray(index[::7]) for index in np.nonzero(np.asarray(steps.usable)))
    values = jax.tree.map(lambda leaf: leaf[row, step], episodes.contexts)
    history = episodes.motion[row[:, None], step[:, None] + jnp.arange(23)]
    contexts = AgentContext(**values, history=history)
    steered = jax.vmap(partial(Route().steer, bank))(contexts, steps.action[row, step])
    expected = physical.steps.action[row, step]
    within = np.abs(np.asarray(steps.action[row, step, 1])) < 0.99
    assert within.mean() > 0.8
    np.testing.assert_allclose(np.asarray(steered)[within], np.asarray(expected)[within], atol=2e-3)
    with pytest.raises(UsageError, match="another action space"):
        episodes_of(data, run, task=replace(TASK, actions=Published()))


def test_weights_of_scenarios_apply_to_their_episodes(data, tmp_path):
    runs = [record(planner, data, tmp_path / planner.name) for planner in (IdmPlanner(), ConstantVelocity())]
    environment, episodes = episodes_of(data, *runs)
    np.testing.assert_array_equal(episodes.steps.scenario, [0, 1, 2, 0, 1, 2])
    weights = np.zeros((3, 91))
    weights[1, 20:30] = 1.0
    experience = ExperienceConfig().of(environment, episodes, weights)
    probability = np.diff(np.asarray(experience.critic.cumulative, np.float64), prepend=0.0).reshape(6, 91)
    drawn = probability > 0
    np.testing.assert_array_equal(drawn, np.asarray(experience.usable) * weights[[0, 1, 2, 0, 1, 2]] > 0)
    assert drawn[1].any() and drawn[4].any()
    with pytest.raises(UsageError, match="weights of shape"):
        ExperienceConfig().of(environment, episodes, weights[:, :50])
    with pytest.raises(UsageError, match="for 3 scenarios"):
        ExperienceConfig().of(environment, episodes, np.ones((4, 91)))


def test_best_drives_have_the_highest_return_of_their_scenario(data, tmp_path):
    runs = [record(planner, data, tmp_path / planner.name) for planner in (IdmPlanner(), ConstantVelocity())]
    environment, episodes = episodes_of(data, *runs)
    steps = jax.device_get(episodes.steps)
    returns = (steps.reward * steps.usable).sum(axis=1).reshape(2, 3)
    kept = np.asarray(ExperienceConfig(best=0.5).of(environment, episodes).usable).any(axis=1).reshape(2, 3)
    np.testing.assert_array_equal(kept.sum(axis=0), 1)
    np.testing.assert_array_equal(kept.argmax(axis=0), returns.argmax(axis=0))
    alone = ExperienceConfig(best=0.5, weighted="policy").of(environment, episodes)
    drawn, all_drawn = (np.unique(sample_steps(which, jax.random.key(0), (4096,))[0]) for which in
        (alone.policy, alone.critic))  # fmt: skip
    best = np.arange(2)[:, None] == returns.argmax(axis=0)
    np.testing.assert_array_equal(drawn, np.flatnonzero(best))
    np.testing.assert_array_equal(all_drawn, np.arange(6))
    with pytest.raises(UsageError, match="best is 0"):
        ExperienceConfig(best=0.0)


@pytest.mark.slow
def test_episodes_of_another_set_traffic_or_start_are_refused(data, tmp_path):
    run = record(IdmPlanner(), data, tmp_path / "run", start_step=12)
    with pytest.raises(UsageError, match="traffic of its episodes is log, not idm; train with it, or"):
        read_episodes([run], data, TASK, "idm")
    with pytest.raises(UsageError, match="start_step of its episodes is 10, not 12"):
        read_episodes([run, record(IdmPlanner(), data, tmp_path / "ten")], data, TASK)
    with pytest.raises(UsageError, match="noisy_start of its episodes is True, not False"):
        read_episodes([record(IdmPlanner(), data, tmp_path / "noisy", noisy_start=True)], data, TASK)
    generate(tmp_path / "other", 2, 12, Generation(workers=0))
    with pytest.raises(DataError, match="its episodes are not in the scenarios of"):
        read_episodes([run], ScenarioSet.open(tmp_path / "other"), TASK)
    config = settings.load(TrainConfig, TINY | {"algorithm": {"kind": "ppo"}})
    episodes = read_episodes([run], data, config.task)
    with pytest.raises(UsageError, match="PpoConfig does not learn from recorded episodes"):
        train(config, TrainingSet(data, episodes=episodes), tmp_path / "ppo", validation=None)


def test_noise_has_its_deviation_and_correlation(data):
    """Over many episodes: a standard deviation of 0.2 at the first and the last step, a correlation of exp(-1/10)."""
    bank = ScenarioBank.from_scenarios(data)
    simulator, planner = Simulator(TASK), add_noise(ConstantVelocity(), 0.2)
    state = simulator.reset(bank, 0)
    situation = simulator.situation(bank, state)

    def noise(key):
        def step(carry, key):
            action, carry = planner.act(carry, bank, state, situation, {}, key)
            return carry, action

        init_key, key = jax.random.split(key)
        carry = planner.init(bank, state, init_key)
        return jax.lax.scan(step, carry, jax.random.split(key, 30))[1]

    actions = np.asarray(jax.jit(jax.vmap(noise))(jax.random.split(jax.random.key(0), 4000)))
    for step in (0, 29):
        np.testing.assert_allclose(actions[:, step].std(axis=0), 0.2, rtol=0.05)
    correlation = [np.corrcoef(actions[:, 10, d], actions[:, 11, d])[0, 1] for d in range(2)]
    np.testing.assert_allclose(correlation, np.exp(-0.1), atol=0.02)
    assert abs(np.corrcoef(actions[:, 10].T)[0, 1]) < 0.06
    assert planner.name == "constant_velocity (noise 0.2)"
    assert add_noise(IdmPlanner(), 0.0) == IdmPlanner()
    with pytest.raises(UsageError, match=r"expert replays the log, .*; use expert_actions"):
        add_noise(Expert(), 0.1)


@pytest.mark.slow
def test_command_records_and_training_learns_from_it(data, tmp_path, capsys):
    out, settings_file = tmp_path / "episodes", tmp_path / "tiny.yaml"
    settings_file.write_text(json.dumps(TINY))
    call = ["record", "idm", "constant_speed", "--noise", "0", "0.3", "--seeds", "2"]
    assert main([*call, "--data", str(data.path), "--out", str(out)]) == 0
    names = [EpisodeTable.read(folder).planner for folder in sorted(out.glob("*/"))]
    kinds = ["idm", "idm (noise 0.3)", "constant_speed", "constant_speed (noise 0.3)"]
    assert names == [name for name in kinds for _ in range(2)]
    assert "constant_speed (noise 0.3)" in capsys.readouterr().out
    assert RunFolder.open(out).kind == "episodes"
    assert main([*call, "--data", str(data.path), "--out", str(out)]) == 2
    train_call = ["train", str(settings_file), "--data", str(data.path), "--validation", str(data.path)]
    run = tmp_path / "run"
    assert main([*train_call, "--episodes", str(out), "--out", str(run)]) == 0
    info = RunFolder.open(run).info
    assert len(info["recorded_episodes"]) == 64 and isinstance(info["critics"], list)
    assert main([*train_call, "--out", str(run), "--resume"]) == 2
    assert "was trained on other episodes or none; resume with the same --episodes" in capsys.readouterr().err
    usable = usable_steps(
        settings.load(TrainConfig, TINY), TrainingSet(data, episodes=read_episodes([out], data, Task()))
    )
    assert usable.shape == (3, 91) and usable[:, 10].all() and not usable[:, :10].any()


@pytest.mark.slow
def test_all_checkpoints_of_a_run_are_recorded_and_none_may_be_missing(data, tmp_path):
    values = TINY | {"algorithm": {"kind": "bc", "network": NETWORK, "batch": 8, "updates": 1}}
    config = settings.load(TrainConfig, values | {"total_steps": 24, "evaluate_every": 1, "keep": 3})
    run = train(config, data, tmp_path / "run", validation=data)
    out = tmp_path / "all"
    assert main(["record", f"{run.path}@all", "--data", str(data.path), "--out", str(out)]) == 0
    tables = read_episodes([out], data, config.task)
    assert [table.settings["planner"] for table in tables] == [f"{run.path}@{step}" for step in (8, 16, 24)]
    shutil.rmtree(tables[1].folder)
    with pytest.raises(DataError, match="run folder not found"):
        read_episodes([out], data, config.task)


@pytest.mark.slow
@pytest.mark.parametrize("with_episodes", [False, True])
def test_critics_are_checked_in_reactive_traffic(data, tmp_path, with_episodes):
    """The simulated returns and the replay need the data of the traffic in the held-out scenarios, too."""
    config = settings.load(TrainConfig, TINY | {"traffic": "idm"})
    episodes = ()
    if with_episodes:
        task = replace(Task(), actions=config.task.actions)
        episodes = read_episodes(
            [record(IdmPlanner(), data, tmp_path / "idm", "idm", task)], data, config.task, "idm"
        )
    run = train(config, TrainingSet(data, episodes=episodes), tmp_path / "run", validation=data)
    assert np.isfinite(run.read_metrics()[-1]["validation/q_error"])
    assert run.info["critics"] is not None


@pytest.mark.slow
def test_held_out_scenarios_without_drives_are_validated_without_metrics_of_critics(data, tmp_path):
    generate(tmp_path / "other", 2, 12, Generation(workers=0))
    config = settings.load(TrainConfig, TINY)
    episodes = read_episodes([record(IdmPlanner(), data, tmp_path / "idm")], data, config.task)
    other = ScenarioSet.open(tmp_path / "other")
    run = train(config, TrainingSet(data, episodes=episodes), tmp_path / "run", validation=other)
    row = run.read_metrics()[-1]
    assert "validation/vmax_score" in row and "validation/mean_q" not in row
    assert run.info["critics"] is None


def test_filtered_cloning_without_drives_is_refused(data, tmp_path):
    config = settings.load(TrainConfig, TINY | {"algorithm": {"kind": "bc", "network": NETWORK, "best": 0.5}})
    with pytest.raises(UsageError, match=r"best is 0\.5, but there are no recorded episodes to choose from"):
        train(config, data, tmp_path / "run", validation=None)


def test_recording_is_refused_before_the_first_evaluation(data, tmp_path, capsys):
    call = ["--data", str(data.path), "--out", str(tmp_path / "out")]
    for planners, words in (
        (["idm", "expert", "--noise", "0.3"], "planner expert replays the log"),
        (["idm", "imd"], "unknown planner 'imd'"),
        (["idm", "--noise", "-1"], "noise is -1; use 0 or more"),
    ):
        assert main(["record", *planners, *call]) == 2
        err = capsys.readouterr().err
        assert words in err and "evaluating" not in err
    assert not (tmp_path / "out").exists()
    evaluation = record(IdmPlanner(), data, tmp_path / "idm")
    assert main(["record", "idm", *call[:2], "--out", str(evaluation), "--overwrite"]) == 2
    assert "output folder contains a run of kind evaluation, not episodes" in capsys.readouterr().err


def test_noise_keeps_what_evaluation_reads_of_a_planner():
    class Prepared(IdmPlanner):
        def prepare(self, scenario_of):
            return None

    noisy = add_noise(Prepared(), 0.1)
    assert noisy.actions == Physical() and callable(noisy.prepare)
    assert not hasattr(add_noise(IdmPlanner(), 0.1), "prepare")
