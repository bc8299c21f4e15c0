"""Episodes as files of other programs: npz and Minari, written, read, and learned from."""

import json
import shutil
from dataclasses import replace

import gymnasium
import h5py
import jax
import minari
import numpy as np
import pytest
from minari.data_collector import DataCollector

from drivax import settings
from drivax.adapters.gym import DrivingEnv
from drivax.adapters.minari import read_minari, write_minari
from drivax.cli import main
from drivax.errors import DataError, UsageError
from drivax.evaluation.runner import EvaluationConfig, run_evaluation
from drivax.learning.config import TrainConfig
from drivax.learning.driving import Driving
from drivax.learning.experience import ExperienceConfig
from drivax.learning.loop import train
from drivax.learning.recorded_episodes import StoredDriving, StoredEpisode, StoredEpisodes, observe_episodes
from drivax.learning.training_set import TrainingSet, prepare_episodes, read_episodes, recorded_environment
from drivax.planners.simple import ConstantVelocity, Expert
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.simulator import Simulator
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task

#: Of missing descriptions, and of the temporary folder of a collector.
MINARI_WARNS = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::ResourceWarning")
OBSERVATION = ObservationConfig(agents=2, steps=2, road=0, lights=1, route=3)
TASK = Task(observation=OBSERVATION, rewards=RewardConfig("behaviour"), metrics="none")


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    """An evaluation, of which some episodes end by a failure."""
    out = tmp_path_factory.mktemp("episodes") / "run"
    run_evaluation(EvaluationConfig(planner="constant_velocity", task=TASK), ConstantVelocity(), data, out)
    return out


@pytest.fixture(scope="module")
def episodes(data, run):
    return list(observe_episodes(*recorded(data, run)))


def recorded(data, run, task=TASK):
    """The environment of an evaluation, and its episodes."""
    tables = read_episodes([run], data, task)
    environment = recorded_environment(Driving(Simulator(task)), tables)
    return environment, prepare_episodes(environment, ScenarioBank.from_scenarios(data), data, tables)


def simulate(data, row, actions):
    """An episode of the Gymnasium environment with given actions: observations, rewards, and whether it terminated."""
    env = DrivingEnv(data.path, TASK)
    observation, _ = env.reset(options={"scenario": row})
    observations, rewards, terminated = [observation], [], False
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        observations.append(observation)
        rewards.append(reward)
        if terminated or truncated:
            break
    return observations, rewards, terminated


def test_stored_episodes_equal_those_of_the_gymnasium_environment(data, episodes):
    """Actions are stored in half precision, so that later states differ slightly."""
    assert any(episode.terminated for episode in episodes) and len(episodes) == 3
    for episode in episodes:
        observations, rewards, terminated = simulate(data, episode.scenario, episode.action)
        assert len(rewards) == len(episode.reward) and terminated == episode.terminated
        np.testing.assert_allclose(episode.reward, rewards, atol=2e-3, rtol=2e-3)
        for name, first in observations[0].items():
            expected = np.stack([observation[name] for observation in observations])
            np.testing.assert_allclose(episode.observation[name][0], first, atol=1e-5)
            np.testing.assert_allclose(
                episode.observation[name], expected, atol=5e-3, rtol=5e-3, err_msg=name
            )


def test_npz_has_the_transitions_of_all_episodes(run, episodes, tmp_path, capsys):
    out = tmp_path / "episodes.npz"
    call = ["export", str(run), str(out), "--format", "npz"]
    assert main(call) == 0
    with np.load(out, allow_pickle=False) as archive:
        content = dict(archive)
    steps = sum(len(episode.reward) for episode in episodes)
    assert f"3 episodes, {steps} transitions" in capsys.readouterr().out
    layout = json.loads(str(content.pop("layout")))
    assert list(layout) == sorted(layout)
    assert {name: values.shape[0] for name, values in content.items()} == dict.fromkeys(content, steps)
    end = 0
    for episode in episodes:
        begin, end = end, end + len(episode.reward)
        offset = 0
        for name, shape in layout.items():
            size = int(np.prod(shape))
            values = episode.observation[name].reshape(len(episode.reward) + 1, size)
            for key, expected in (("observations", values[:-1]), ("next_observations", values[1:])):
                np.testing.assert_array_equal(content[key][begin:end, offset : offset + size], expected)
            offset += size
        assert offset == content["observations"].shape[1]
        np.testing.assert_array_equal(content["rewards"][begin:end], episode.reward)
        np.testing.assert_array_equal(content["actions"][begin:end], episode.action)
        ends = np.arange(begin, end) == end - 1
        np.testing.assert_array_equal(content["terminals"][begin:end], ends & episode.terminated)
        np.testing.assert_array_equal(content["timeouts"][begin:end], ends & (not episode.terminated))
        assert (content["scenario"][begin:end] == episode.scenario).all()
    assert main(call) == 2
    assert "output file already exists" in capsys.readouterr().err
    assert main([*call[:-1], "tfexample"]) != 0
    assert main([*call, "--overwrite", "--limit", "3"]) == 2
    assert "--limit is for scenario sets" in capsys.readouterr().err
    assert main([*call, "--overwrite", "--task.rewards.preset", "completion"]) == 0
    with np.load(out) as archive:
        assert not np.array_equal(archive["rewards"], content["rewards"])


def test_minari_reads_what_is_exported_and_so_does_drivax(run, episodes, tmp_path, capsys):
    out = tmp_path / "speed-v1"
    call = ["export", str(run), str(out), "--format", "minari"]
    assert main(call) == 0
    dataset = minari.MinariDataset(out / "data")
    assert dataset.spec.dataset_id == "drivax/speed-v1" and dataset.total_episodes == len(episodes)
    assert dataset.observation_space == DrivingEnv(3, TASK).observation_space
    for expected, episode in zip(episodes, dataset, strict=True):
        np.testing.assert_array_equal(episode.actions, expected.action)
        np.testing.assert_array_equal(episode.rewards, expected.reward)
        assert bool(episode.terminations[-1]) is expected.terminated is not bool(episode.truncations[-1])
        observation = {name: values[0] for name, values in episode.observations.items()}
        assert dataset.observation_space.contains(observation)
    stored = StoredEpisodes.of(
        [
            episode._replace(observation={k: v for k, v in episode.observation.items() if v.size})
            for episode in episodes
        ]
    )
    jax.tree.map(np.testing.assert_array_equal, read_minari(out), stored)
    assert main(call) == 2
    assert main([*call, "--overwrite"]) == 0
    (tmp_path / "other").mkdir()
    assert main([*call[:2], str(tmp_path / "other"), *call[3:], "--overwrite"]) == 2
    assert "is not a Minari data set" in capsys.readouterr().err


@MINARI_WARNS
def test_episodes_collected_in_the_gymnasium_environment_are_learned_from(data, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    env = DataCollector(DrivingEnv(data.path, TASK), record_infos=False)
    rng = np.random.default_rng(0)
    for seed in range(4):
        env.reset(seed=seed)
        done = False
        while not done:
            *_, terminated, truncated, _ = env.step(rng.uniform(-1, 1, 2).astype(np.float32))
            done = terminated or truncated
    env.create_dataset("mine/random-v0", algorithm_name="random")
    path = tmp_path / "mine" / "random-v0"
    values = {
        "task": settings.plain(TASK),
        "algorithm": {
            "kind": "iql", "batch": 8, "updates": 2,
            "network": {"encoder": {"rows": [8], "hidden": [16]}, "head": [8]},
        },
        "total_steps": 32,
    }  # fmt: skip
    file = tmp_path / "tiny.yaml"
    file.write_text(json.dumps(values))
    call = ["train", str(file), "--data", str(data.path), "--validation", str(data.path)]
    assert main([*call, "--episodes", str(path), "--out", str(tmp_path / "run")]) == 0
    config = settings.load(TrainConfig, values)
    other = replace(config, task=replace(TASK, observation=replace(OBSERVATION, agents=3)))
    with pytest.raises(UsageError, match="observations of the episodes are agents 2x2x"):
        train(other, TrainingSet(data, episodes=read_minari(path)), tmp_path / "other", validation=None)
    weights = TrainingSet(data, np.ones((3, 91)), read_minari(path))
    with pytest.raises(UsageError, match="weights of scenarios do not fit stored episodes"):
        train(config, weights, tmp_path / "other", validation=None)
    assert main([*call, "--episodes", str(path), str(path), "--out", str(tmp_path / "two")]) == 2


def control_episodes(count):
    """Episodes of a control task of Gymnasium with random actions, as Minari collects them."""
    env = DataCollector(gymnasium.make("Pendulum-v1"))
    env.action_space.seed(0)
    for seed in range(count):
        env.reset(seed=seed)
        done = False
        while not done:
            *_, terminated, truncated, _ = env.step(env.action_space.sample())
            done = terminated or truncated
    return env


@MINARI_WARNS
def test_control_tasks_of_gymnasium_are_read_with_scaled_actions(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = control_episodes(2).create_dataset("pendulum/random-v0")
    stored = read_minari(tmp_path / "pendulum" / "random-v0")
    steps = jax.device_get(stored.steps)
    for row, episode in enumerate(dataset):
        np.testing.assert_allclose(steps.action[row, :200], episode.actions / 2.0, atol=1e-6)
        np.testing.assert_allclose(steps.reward[row, :200], episode.rewards, rtol=1e-6)
        np.testing.assert_allclose(stored.observation["observation"][row], episode.observations)
    assert steps.usable[:, :200].all() and not steps.usable[:, 200].any() and not steps.terminated.any()
    assert (steps.truncated.sum(axis=1) == 1).all() and steps.truncated[:, 199].all()


def tiny(length, terminated, scenario=-1):
    """An episode of numbers that say its length."""
    values = np.arange(length + 1, dtype=np.float32)[:, None] + 100.0 * length
    return StoredEpisode(
        {"ego": values}, np.full((length, 2), 0.5, np.float32), np.ones(length, np.float32) * length,
        terminated, np.zeros(length, bool), scenario,
    )  # fmt: skip


def test_episodes_of_different_lengths_are_stacked():
    stored = StoredEpisodes.of([tiny(2, True), tiny(4, False)])
    steps = stored.steps
    np.testing.assert_array_equal(steps.usable, [[1, 1, 0, 0, 0], [1, 1, 1, 1, 0]])
    np.testing.assert_array_equal(steps.terminated, [[0, 1, 0, 0, 0], [0] * 5])
    np.testing.assert_array_equal(steps.truncated, [[0] * 5, [0, 0, 0, 1, 0]])
    np.testing.assert_array_equal(stored.observation["ego"][0, :, 0], [200, 201, 202, 0, 0])


def test_best_stored_episodes_of_unknown_scenarios_are_chosen_among_all(data):
    stored = StoredEpisodes.of([tiny(n, False) for n in (1, 4, 3, 2)])
    experience = ExperienceConfig(best=0.5).of(StoredDriving(Simulator(TASK)), stored)
    np.testing.assert_array_equal(np.asarray(experience.usable).any(axis=1), [False, True, True, False])


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda f: f["episode_0"].__delitem__("rewards"), "cannot be read"),
        (lambda f: f["episode_0/actions"].__setitem__((0, 0), np.nan), "a number is not finite"),
        (lambda f: f["episode_0/terminations"].__setitem__(0, True), "goes on after its termination"),
        (lambda f: f.__setitem__("episode_1", h5py.ExternalLink("/etc/passwd", "/")), "episode_1 is a link"),
        (
            lambda f: f.create_dataset("x", (3,), "u1", external=[("/etc/passwd", 0, 3)]),
            "x lies in another file",
        ),
        (lambda f: f.create_dataset("x", (2**40,), "f4", chunks=True, compression="gzip"), "bytes of memory"),
    ],
)
def test_damaged_and_hostile_minari_data_are_refused(tmp_path, damage, words):
    out = tmp_path / "tiny-v0"
    write_minari(out, TASK, [tiny(3, False)])
    assert read_minari(out).steps.usable.sum() == 3
    with h5py.File(out / "data" / "main_data.hdf5", "a") as file:
        damage(file)
    with pytest.raises(DataError, match=words):
        read_minari(out)


def test_padding_counts_towards_the_memory(tmp_path, monkeypatch):
    """One long episode among short ones: 51 x 1,001 x 4 numbers of 4 bytes."""
    out = tmp_path / "tiny-v0"
    write_minari(out, TASK, [tiny(1000, False), *[tiny(1, False)] * 50])
    monkeypatch.setattr("drivax.adapters.minari._MOST_RATIO", 0)
    size = 51 * 1001 * 4 * 4
    monkeypatch.setattr("drivax.adapters.minari._MOST_BYTES", size)
    assert read_minari(out).steps.usable.shape == (51, 1001)
    monkeypatch.setattr("drivax.adapters.minari._MOST_BYTES", size - 1)
    with pytest.raises(DataError, match=f"needs {size:,} bytes of memory"):
        read_minari(out)


def test_environments_that_metadata_name_are_not_made(tmp_path):
    """Minari makes the environment, whose code the file names, if spaces are missing."""
    out = tmp_path / "tiny-v0"
    write_minari(out, TASK, [tiny(3, False)])
    file = out / "data" / "metadata.json"
    values = json.loads(file.read_text())
    del values["action_space"]
    values["env_spec"] = json.dumps({"id": "x-v0", "entry_point": "os:abort", "kwargs": {}})
    file.write_text(json.dumps(values))
    with pytest.raises(DataError, match="metadata lack action_space"):
        read_minari(out)
    shutil.rmtree(out)
    with pytest.raises(DataError, match="not a Minari data set"):
        read_minari(out)


def test_decisions_of_several_steps_and_unbounded_actions_are_refused(data, tmp_path):
    task = replace(TASK, hold=5)
    run_evaluation(EvaluationConfig(planner="expert", task=task), Expert(), data, tmp_path / "run")
    with pytest.raises(UsageError, match="the task holds decisions for 5 steps"):
        next(observe_episodes(*recorded(data, tmp_path / "run", task)))
    with pytest.raises(UsageError, match="is not a name of a Minari data set"):
        write_minari(tmp_path / "a b-v0", TASK, [tiny(3, False)])
    with pytest.raises(DataError, match="no episode has a step"):
        write_minari(tmp_path / "none-v0", TASK, [])
    assert not (tmp_path / "none-v0").exists()
