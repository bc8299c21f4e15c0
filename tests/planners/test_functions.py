"""Planners that are one function, in Python or JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.evaluation.rollout import drive, episode_keys
from drivax.planners.catalogue import PLANNERS, default_task, make_planner
from drivax.planners.functions import collect_errors, python_actions, python_planner
from drivax.planners.pdm.brake import EmergencyBrake
from drivax.planners.planner import Held, Planner
from drivax.planners.simple import IdmPlanner
from drivax.simulator.simulator import Simulator
from drivax.tasks.actions import Physical, Published
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from own_drivers import slow_jax, slow_python
from scenes import bank_of, car, straight_road

SEEN = ObservationConfig(agents=1, steps=1, road=0, lights=1, route=3)
SIMULATOR = Simulator(Task(observation=SEEN, metrics="none", to_the_end=True))
STEPS = (10, 15, 40)


@pytest.fixture(scope="module")
def bank():
    """The second scenario has ego only."""
    return bank_of(straight_road([car(0, 0.5, 0.1, 9), car(30, 0, 0, 5)]), straight_road([car(0, 0, 0, 3)]))


@pytest.fixture(scope="module")
def moments(bank):
    """States, situations and observations of both scenarios at three steps."""

    def moment(index, step):
        state = SIMULATOR.reset(bank, index, step)
        return state, SIMULATOR.situation(bank, state), SIMULATOR.observe(bank, state.context)

    steps = np.array(STEPS)
    return jax.jit(jax.vmap(jax.vmap(moment, (None, 0)), (0, None)))(np.arange(2), steps)


def actions(planner, bank, moments, batched=True):
    def act(state, situation, observation):
        key = jax.random.key(0)
        return planner.act(planner.init(bank, state, key), bank, state, situation, observation, key)[0]

    if batched:
        return np.asarray(jax.jit(jax.vmap(jax.vmap(act)))(*moments))
    row = jax.tree.map(lambda leaf: leaf[0, 0], moments)
    return np.asarray(jax.jit(act)(*row))


@pytest.mark.slow
def test_action_space_of_a_wrapper_is_that_of_the_wrapped_planner(monkeypatch):
    monkeypatch.setitem(PLANNERS, "braking", lambda: EmergencyBrake(IdmPlanner()))
    planner = make_planner("braking", Published())
    assert planner == EmergencyBrake(IdmPlanner(actions=Published()), actions=Published())
    assert make_planner("braking") == EmergencyBrake(IdmPlanner())


def test_default_task_has_the_action_space_of_a_wrapped_planner():
    assert default_task(Held(IdmPlanner(actions=Published()), 2)).actions == Published()
    assert default_task(Held(python_planner(lambda *_: 0), 2)).actions == Physical()


def test_python_and_jax_planners_agree_batched_or_alone(bank, moments):
    with collect_errors() as errors:
        python, in_jax = (actions(planner, bank, moments) for planner in (slow_python, slow_jax))
        np.testing.assert_allclose(
            actions(slow_python, bank, moments, batched=False), python[0, 0], rtol=1e-6
        )
    sound = np.ones((2, 3), bool)
    sound[1, 1] = False
    np.testing.assert_array_equal(np.isfinite(python).all(axis=-1), sound)
    np.testing.assert_array_equal(np.isfinite(in_jax).all(axis=-1), sound)
    np.testing.assert_allclose(python[sound], in_jax[sound], rtol=1e-5, atol=1e-6)
    # 9 m/s where 5 are wanted; the route lies 0.5 m to the right, and heading 0.1 rad to the left of it.
    assert python[0, 0, 0] == pytest.approx((5 - 9) / 6, rel=1e-5) and python[0, 0, 1] < 0
    assert list(errors) == [(int(bank.identity[1]), 15)]
    assert errors[int(bank.identity[1]), 15].startswith("LookupError: nobody to follow (own_drivers.py:")


@pytest.mark.slow
def test_python_and_jax_planners_have_the_same_episodes(bank):
    """Inside the compiled loop over all steps; both crash at step 15 of the scenario with ego only."""
    rows = jnp.arange(2)
    keys = episode_keys(bank, rows, 0)
    with collect_errors() as errors:
        python, in_jax = (
            jax.device_get(drive(SIMULATOR, planner, bank, rows, keys)) for planner in (slow_python, slow_jax)
        )
    assert python.crashed.tolist() == in_jax.crashed.tolist() == [-1, 15]
    assert list(errors) == [(int(bank.identity[1]), 15)]
    np.testing.assert_allclose(python.motion, in_jax.motion, rtol=1e-4, atol=1e-4)
    assert np.isfinite(python.motion).all() and abs(python.motion[0, -1, 3] - 5.0) < 0.1
    assert (python.motion[1, 5:] == python.motion[1, 5]).all(), "nobody drives it any more"


def test_invalid_actions_are_reported(bank, moments):
    @python_planner
    def three(situation, observation):
        return 0.0, 0.0, 0.0

    @python_planner
    def none(situation, observation):
        pass

    messages = "returned 3 numbers; return 2", "returned nothing; return 2 numbers"
    for planner, words in zip((three, none), messages, strict=True):
        with collect_errors() as errors:
            assert np.isnan(actions(planner, bank, moments)).all()
        assert len({who for who, _ in errors}) == 2
        assert all(words in text for text in errors.values()), errors


def test_a_plan_may_be_an_array_of_poses():
    """The function gets numpy arrays of one scenario at a time; its numbers are flattened."""

    def plan(speed):
        assert isinstance(speed, np.ndarray | np.float32) and np.shape(speed) == ()
        return np.stack([speed * np.arange(4), np.zeros(4), np.zeros(4)], axis=1)

    steps = jnp.array([10, 11], jnp.int32)
    batched = jax.jit(jax.vmap(lambda step: python_actions(plan, step, step, (0.5 * step,), 12)))
    np.testing.assert_allclose(batched(steps).reshape(2, 4, 3)[..., 0], np.outer([5.0, 5.5], np.arange(4)))


def test_errors_end_a_custom_loop(bank, moments):
    with pytest.raises(Exception, match="nobody"):
        actions(slow_python, bank, moments)


def test_planner_functions_are_loaded_by_name():
    for name in ("slow_python", "slow_jax"):
        planner = make_planner(f"own_drivers:{name}")
        assert isinstance(planner, Planner) and planner.name == name and not planner.replays
    with pytest.raises(UsageError, match=r"takes \(situation, observation\).*put @drivax.python_planner or"):
        make_planner("own_drivers:plain")
    with pytest.raises(UsageError, match=r"takes \(function: .*; name a function that makes drivax.planners"):
        make_planner("drivax.planners.functions:FunctionPlanner")
    with pytest.raises(UsageError, match="unknown planner 'ide'; did you mean 'idm'"):
        make_planner("ide")
    assert make_planner("own_drivers:fragile").name == "fragile"
