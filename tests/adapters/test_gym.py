"""The Gymnasium environment: its own checker, the simulator, and an evaluation as oracles."""

import importlib.util
import sys
from dataclasses import replace

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import drivax
from drivax.adapters import gym
from drivax.adapters.gym import TASKS, DrivingEnv, VectorDrivingEnv
from drivax.errors import DataError, UsageError
from drivax.evaluation.rollout import evaluation_task
from drivax.metrics.catalogue import METRICS
from drivax.planners.simple import ConstantVelocity
from drivax.scenario.build.assemble import assemble
from drivax.scenario.store import ScenarioWriter
from drivax.tasks.observations import SPEED_MPS, ObservationConfig
from drivax.tasks.task import Task
from scenes import car, straight_road

#: Every group, a few rows of each, and what training measures: all environments here share its programs.
SMALL = Task(observation=ObservationConfig(agents=4, steps=2, road=8, lights=1, route=3), metrics="training")
STILL = np.zeros(2, np.float32)


@pytest.fixture(scope="module")
def data():
    """Row 0: a free road, left at constant speed. Row 1: a stopped car 30 m ahead."""
    free = replace(straight_road([car(speed=8.0)]), scenario_id="free")
    blocked = replace(straight_road([car(speed=10.0), car(x=30.0)]), scenario_id="blocked")
    return drivax.load([assemble(free), assemble(blocked)])


@pytest.fixture(scope="module")
def env(data):
    return DrivingEnv(data, SMALL)


def drive(env, row, action=STILL):
    env.reset(options={"scenario": row})
    steps = [env.step(action)]
    while not (steps[-1][2] or steps[-1][3]):
        steps.append(env.step(action))
    return steps


def test_gymnasiums_own_checker(data):
    """Warnings are errors here, and a spec lets the checker make and close environments of its own."""
    spec = EnvSpec("Driving-v0", entry_point=DrivingEnv, kwargs={"data": data, "task": SMALL})
    check_env(gymnasium.make(spec).unwrapped)


@pytest.mark.parametrize("name", sorted(TASKS))
def test_environment_ids_are_registered(name):
    """The spec says what the environment is; none is made here."""
    spec = gymnasium.spec(f"drivax/{name}-v0")
    assert spec.kwargs == {"task": TASKS[name]}
    assert (spec.entry_point, spec.vector_entry_point) == (
        "drivax.adapters.gym:DrivingEnv",
        "drivax.adapters.gym:VectorDrivingEnv",
    )


@pytest.mark.slow
def test_environments_by_id(data):
    """On loaded data, and on two scenarios of the built-in world; Gymnasium's own wrappers check every call."""
    made = gymnasium.make("drivax/minimal-v0", data=data).unwrapped
    assert made.observation_space == DrivingEnv(data, TASKS["minimal"]).observation_space
    env = gymnasium.make("drivax/minimal-v0", data=data, task=SMALL)
    env.reset(seed=1)
    env.step(env.action_space.sample())
    built_in = gymnasium.make("drivax/minimal-v0", data=2, task=SMALL)
    assert built_in.reset(seed=0)[1]["scenario_id"].startswith("w")
    vector = gymnasium.make_vec("drivax/minimal-v0", num_envs=2, data=data)
    assert isinstance(vector, VectorDrivingEnv) and vector.num_envs == 2


@pytest.mark.slow
def test_discrete_action_is_a_pair_of_acceleration_and_curvature_levels(data):
    """Choice i of 7 x 13 is acceleration level i // 13 and curvature level i % 13; the middle one does nothing."""
    env = DrivingEnv(data, replace(SMALL, actions=TASKS["discrete"].actions))
    assert env.action_space == gymnasium.spaces.Discrete(91)
    env.reset(options={"scenario": 0})
    seen = env.step(np.int64(91 // 2))[0]
    np.testing.assert_allclose(seen["ego"][-1, 4] * SPEED_MPS, 8.0, rtol=1e-5)
    seen = env.step(6 * 13 + 6)[0]  # full acceleration, straight on: 6 m/s2 for 0.1 s
    np.testing.assert_allclose(seen["ego"][-1, 4] * SPEED_MPS, 8.6, rtol=1e-5)
    for action in (91, -1, 0.5, [1, 2]):
        with pytest.raises(UsageError, match="give choices from 0 to 90"):
            env.step(action)


@pytest.mark.slow
def test_spaces_are_the_tasks_groups(data):
    env = DrivingEnv(data)
    assert set(env.observation_space) == {
        "ego", "ego_static", "agents", "agents_mask", "road", "road_mask", "lights", "lights_mask", "route",
        "route_mask",
    }  # fmt: skip
    assert env.observation_space["agents"].shape == (16, 5, 12)
    assert env.observation_space["agents_mask"] == gymnasium.spaces.MultiBinary((16, 5))
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    without = DrivingEnv(data, Task(observation=ObservationConfig(road=0, lights=0)))
    assert not {"road", "lights", "lights_mask"} & set(without.observation_space)
    assert without.reset(seed=0)[0] in without.observation_space


def test_step_equals_the_simulator(env, data):
    simulator = drivax.make_simulator(SMALL)
    action = np.array([0.5, -0.1], np.float32)

    @jax.jit
    def two_moments(bank, action):
        state = simulator.reset(bank, 1)
        after, transition = simulator.step(bank, state, action)
        return (
            simulator.observe(bank, state.context),
            simulator.observe(bank, after.context),
            transition.reward,
        )

    before, after, reward = two_moments(data.bank, jnp.asarray(action))
    seen, info = env.reset(options={"scenario": 1})
    assert info == {"scenario_id": "blocked"}
    then, earned, terminated, truncated, info = env.step(action)
    assert (terminated, truncated, info) == (False, False, {"scenario_id": "blocked"})
    assert earned == pytest.approx(float(reward), abs=1e-6) and earned > 0.1
    for got, wanted in ((seen, before), (then, after)):
        assert set(got) == set(wanted)
        for name in wanted:
            np.testing.assert_allclose(got[name], wanted[name], atol=1e-5, err_msg=name)


@pytest.mark.slow
def test_end_of_log_truncates_with_the_metrics_of_an_evaluation(data):
    """Zero actions are the planner constant_velocity."""
    env = DrivingEnv(data, evaluation_task(SMALL))
    results = drivax.evaluate(ConstantVelocity(), data, task=SMALL)
    for row in range(len(data)):
        steps = drive(env, row)
        assert len(steps) == 80
        assert not any(terminated for _, _, terminated, _, _ in steps)
        assert [truncated for *_, truncated, _ in steps] == [False] * 79 + [True]
        assert all(set(info) == {"scenario_id"} for *_, info in steps[:-1])
        wanted = {k: float(results.metrics[k][row]) for k in METRICS if np.isfinite(results.metrics[k][row])}
        assert steps[-1][4]["metrics"] == pytest.approx(wanted, abs=1e-4)


def test_a_collision_terminates(env):
    """Box centres 30 m apart, boxes 4.8 m long, 10 m/s: they overlap after 2.52 s, so at the 26th step."""
    steps = drive(env, 1)
    *_, reward, terminated, truncated, info = steps[-1]
    assert (len(steps), terminated, truncated) == (26, True, False)
    assert reward == pytest.approx(
        -1.0 + 0.2 * 10.0 / 12.0, abs=0.02
    )  # collision, and the progress of one step
    assert info["metrics"]["collision"] == 1.0 and info["metrics"]["steps"] == 26
    assert "red_light" in info["metrics"]


def test_seeds_choose_scenarios_and_results_are_copies(env):
    first, second = ([env.reset(seed=5)[1], *(env.reset()[1] for _ in range(20))] for _ in range(2))
    assert first == second
    assert {info["scenario_id"] for info in first} == {"free", "blocked"}
    seen, _ = env.reset(options={"scenario": 0})
    kept = seen["ego"].copy()
    env.step(np.array([1.0, 0.3], np.float32))
    np.testing.assert_array_equal(seen["ego"], kept)


def test_scenario_set_folder_is_loaded(tmp_path, data):
    with ScenarioWriter(tmp_path / "set", data.scenarios[0].capacity) as writer:
        for scenario in data.scenarios:
            writer.add(scenario)
    env = DrivingEnv(str(tmp_path / "set"), SMALL)
    for row, (name, speed) in enumerate((("free", 8.0), ("blocked", 10.0))):
        seen, info = env.reset(options={"scenario": row})
        assert info["scenario_id"] == name
        np.testing.assert_allclose(seen["ego"][-1, 4] * SPEED_MPS, speed, rtol=1e-5)
    with pytest.raises(DataError, match="folder not found"):
        DrivingEnv(tmp_path / "nowhere")


def test_errors_are_one_line(env):
    env.reset(seed=0)
    for options, words in (
        ({"scenario": 2}, "unknown scenario 2; use a row from 0 to 1"),
        ({"scenario": -1}, "unknown scenario -1; use a row from 0 to 1"),
        ({"scenario": "a"}, "unknown scenario 'a'; use a row from 0 to 1"),
        ({"scenari": 1}, "unknown reset option 'scenari'; the only one is 'scenario'"),
    ):
        with pytest.raises(UsageError) as error:
            env.reset(options=options)
        assert str(error.value) == words
    for action in (np.zeros(3), np.array([np.nan, 0.0])):
        with pytest.raises(UsageError, match="give 2 finite numbers"):
            env.step(action)
    for action in ("left", [[1.0], [1.0, 2.0]], {"steer": 1.0}):
        with pytest.raises(UsageError, match="is not an action; give 2 finite numbers"):
            env.step(action)
    drive(env, 1)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(STILL)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: DrivingEnv(0), "0 scenarios to generate; use 1 or more"),
        (lambda: VectorDrivingEnv(0, 1), "num_envs is 0; use 1 or more"),
        (lambda: gym.make(num_envs=-1), "num_envs is -1; use 1 or more"),
    ],
)
def test_environments_without_scenarios_or_places_are_refused(make, words):
    with pytest.raises(UsageError) as error:
        make()
    assert str(error.value) == words


def test_choices_of_a_batch_are_one_per_environment(data):
    vector = VectorDrivingEnv(2, data, replace(SMALL, actions=TASKS["discrete"].actions))
    for actions in ([1, 2, 3], [[1], [2, 3]], 1):
        with pytest.raises(UsageError, match="give choices from 0 to 90, one for each of 2 environments"):
            vector._backend.convert_actions(actions, (2,))


def test_held_decisions_are_refused(data):
    with pytest.raises(UsageError, match="holds decisions for 2 steps; set hold to 1 and repeat the action"):
        gym.DrivingEnv(data, Task(hold=2))


def test_missing_gymnasium_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    spec = importlib.util.spec_from_file_location("gym_again", gym.__file__)
    with pytest.raises(UsageError) as error:
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
    assert str(error.value) == "gymnasium is not installed; pip install 'drivax[gym]'"


def test_steps_are_compiled_once(data):
    """Another environment of the same task and data shapes costs no compilation."""
    first, second = DrivingEnv(data, SMALL), DrivingEnv(data, SMALL)
    for env in (first, second):
        env.reset(seed=0)
        env.step(STILL)
    compiled = gym._step._cache_size()
    third = DrivingEnv(data, SMALL)
    third.reset(options={"scenario": 1})
    third.step(STILL)
    assert gym._step._cache_size() == compiled
    assert {device.platform for leaf in jax.tree.leaves(third._state) for device in leaf.devices()} == {"cpu"}


@pytest.mark.slow
def test_vector_environment_equals_single_environments(data, env):
    """Every number of a batch of three against the same episodes one by one, through ends and new beginnings."""
    vector = VectorDrivingEnv(3, data, SMALL)
    assert vector.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.NEXT_STEP
    seen, info = vector.reset(seed=3, options={"scenarios": [1, 0, 1]})
    assert list(info["scenario_id"]) == ["blocked", "free", "blocked"] and seen in vector.observation_space
    rng = np.random.default_rng(0)
    actions = (rng.uniform(-0.1, 0.2, (95, 3, 2)) * (1.0, 0.01)).astype(np.float32)
    log = [vector.step(action) for action in actions]
    ended = 0
    for place in range(3):
        begins, row = True, [1, 0, 1][place]
        single, _ = env.reset(options={"scenario": row})
        for step, (seen, reward, terminated, truncated, info) in enumerate(log):
            if not begins and over:
                row = ["free", "blocked"].index(info["scenario_id"][place])
                single, _ = env.reset(options={"scenario": row})
                wanted = (0.0, False, False)
            else:
                single, *wanted, own = env.step(actions[step, place])
            begins, over = False, wanted[1] or wanted[2]
            for name in single:
                np.testing.assert_allclose(seen[name][place], single[name], atol=2e-4, err_msg=name)
            assert reward[place] == pytest.approx(wanted[0], abs=1e-4)
            assert (terminated[place], truncated[place]) == tuple(wanted[1:])
            if over:
                ended += 1
                metrics = {n: v[place] for n, v in info["metrics"].items() if n in own["metrics"]}
                assert metrics == pytest.approx(own["metrics"], abs=1e-3)
                assert info["_metrics"][place]
    assert ended >= 3 and any(truncated.any() for *_, truncated, _ in log)


def test_seeds_and_errors_of_a_batch(data):
    vector = VectorDrivingEnv(3, data, SMALL)
    with pytest.raises(gymnasium.error.ResetNeeded):
        vector.step(np.zeros((3, 2)))
    drawn = [[list(vector.reset(seed=seed)[1]["scenario_id"]) for _ in range(2)] for seed in range(4)]
    assert all(one == other for one, other in drawn) and len({tuple(one) for one, _ in drawn}) > 1
    for options, words in (
        ({"scenarios": [0, 1]}, "2 scenarios for 3 environments; give one per environment"),
        ({"scenarios": [0, 1, 2]}, "unknown scenario 2; use a row from 0 to 1"),
        ({"scenario": 1}, "unknown reset option 'scenario'; the only one is 'scenarios'"),
        ({"scenarios": 1}, "the reset option 'scenarios' is 1; give a list of 3 rows"),
    ):
        rows = vector._rows
        with pytest.raises(UsageError) as error:
            vector.reset(options=options)
        assert str(error.value) == words
        assert vector._rows is rows  # the episodes that run go on
    with pytest.raises(UsageError, match="give 3 x 2 finite numbers"):
        vector.step(np.zeros((2, 2)))


@pytest.mark.slow
def test_render_draws_ego_at_its_simulated_pose(data):
    """Rendering shows ego at its simulated pose; braking changes the picture, not its size."""
    env = DrivingEnv(data, SMALL, render_mode="rgb_array")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.render()
    pictures = []
    for action in ([0.0, 0.0], [-1.0, 0.0]):
        env.reset(options={"scenario": 0})
        env.step(np.array(action, np.float32))
        env.step(np.array(action, np.float32))
        pictures.append(env.render())
    first, second = pictures
    assert first.dtype == np.uint8 and first.shape == second.shape and first.shape[2] == 3
    assert (first != second).any()
    assert env._path.shape == (13, 4) and np.isfinite(env._path).all()
    assert DrivingEnv(data, SMALL).render() is None
    with pytest.raises(UsageError, match="the only one is 'rgb_array'"):
        DrivingEnv(data, SMALL, render_mode="human")
    vector = VectorDrivingEnv(3, data, SMALL, render_mode="rgb_array")
    vector.reset(options={"scenarios": [0, 0, 0]})
    brake = np.array([[0.0, 0.0], [-1.0, 0.0], [0.0, 0.0]], np.float32)
    for _ in range(2):
        vector.step(brake)
    for picture, wanted in zip(vector.render(), [first, second, first], strict=True):
        np.testing.assert_array_equal(picture, wanted)


@pytest.mark.parametrize("num_envs", [None, 2])
def test_make_passes_trust_on(num_envs, monkeypatch):
    def refuse(*arguments):
        raise RuntimeError(*arguments)

    monkeypatch.setattr(gym, "_Backend", refuse)
    with pytest.raises(RuntimeError) as error:
        gym.make(SMALL, 3, num_envs=num_envs, traffic="idm", trust=("mine",))
    assert error.value.args == (3, SMALL, "idm", ("mine",))


@pytest.mark.parametrize(("traffic", "name"), [("idm", "idm"), ("own_terms:Drift", "drift")])
def test_environments_accept_the_traffic_of_evaluation(data, traffic, name):
    env = gym.make(SMALL, data, traffic=traffic)
    assert isinstance(env, DrivingEnv) and env._backend.simulator.traffic.name == name
    env.reset(options={"scenario": 1})
    assert np.isfinite(env.step(STILL)[1])
    with pytest.raises(UsageError, match="did you mean 'optimal'"):
        gym.make("optmal", data)
