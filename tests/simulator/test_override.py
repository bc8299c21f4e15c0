"""Overridden agents, and traffic models by name."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.metrics.episode import episode_metrics
from drivax.scenario.schema import AgentKind
from drivax.simulator.contact import CollisionType
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.bank_data import prepare_bank
from drivax.simulator.traffic.log import LogTraffic, alone
from drivax.simulator.traffic.override import OverrideTraffic, motions_of_actions, with_override
from drivax.simulator.traffic.reactive import IdmTraffic, make_traffic
from drivax.tasks.task import Task
from scenes import GLIMPSE, bank_of, car, straight_road

TASK = Task()
SIMULATOR = Simulator(TASK, OverrideTraffic(IdmTraffic()))
STEPS = 79


@pytest.fixture(scope="module")
def bank():
    """Ego out of the way; a car (slot 1), one 30 m behind it (slot 2), and a cyclist (slot 3)."""
    cyclist = car(150, 3.7, 0, 4, kind=AgentKind.CYCLIST)
    cars = [car(60, 3.7, 0, 0), car(40, 0, 0, 10), car(10, 0, 0, 10), cyclist]
    bank = IdmTraffic().prepare(bank_of(straight_road(cars)))
    np.testing.assert_allclose(bank.agents[0, 10, :4, 0], [0, -20, -50, 90], atol=1e-4)
    return bank


def _frames(bank, motion, valid):
    """Frames of all agents from step 10 on, with slot 1 overridden and ego standing."""
    overridden = with_override(bank, jnp.asarray([[1, -1]]), motion, valid)

    def one(context, _):
        frame = SIMULATOR.frame(overridden, context, alone(context), 0)
        traffic = SIMULATOR.traffic.advance(overridden, context, frame)
        return replace(context, step=context.step + 1, traffic=traffic), frame

    return jax.lax.scan(one, SIMULATOR.context(overridden, 0, 10), None, length=STEPS)[1]


frames_of = jax.jit(_frames)


@jax.jit
def driven(bank, brakes):
    """Trajectories of slot 1 when it brakes with this share of 6 m/s2."""
    actions = jnp.stack([jnp.broadcast_to(brakes, (80, 2)), jnp.zeros((80, 2))], -1)[None]
    return motions_of_actions(bank, jnp.asarray([[1, -1]]), actions, TASK.motion)


VALID = jnp.ones((1, 91, 2), bool)


def test_overridden_agents_follow_given_trajectories_and_others_replay(bank):
    line = np.zeros((1, 91, 2, 4), np.float32)
    line[0, :, 0] = np.stack([np.arange(91) * 0.5, np.full(91, -3.7), np.full(91, 0.1), np.full(91, 5.0)], -1)
    frames = frames_of(bank, jnp.asarray(line), VALID.at[0, 60:].set(False))
    np.testing.assert_allclose(frames.box[40, 1, :4], [25.0, -3.7, np.cos(0.1), np.sin(0.1)], rtol=1e-6)
    np.testing.assert_allclose(frames.velocity[40, 1], [5 * np.cos(0.1), 5 * np.sin(0.1)], rtol=1e-5)
    np.testing.assert_array_equal(frames.box[40, 3, :2], bank.agents[0, 50, 3, :2])
    assert float(frames.z[40, 1]) == pytest.approx(
        float(bank.agent_box[0, 1, 2]) / 2
    )  # the road is at height 0
    np.testing.assert_array_equal(frames.valid[:, 1], np.arange(10, 10 + STEPS) < 60)


def test_override_actions_drive_like_an_agent(bank):
    motion = np.asarray(driven(bank, -0.5))
    assert motion.shape == (1, 91, 2, 4)
    np.testing.assert_allclose(motion[0, :11, 0, :2], np.asarray(bank.agents[0, :11, 1, :2]), atol=1e-4)
    # 10 m/s, 3 m/s2 of braking: 16.67 m, and not a millimetre back.
    assert motion[0, -1, 0, 0] - motion[0, 10, 0, 0] == pytest.approx(100 / 6, abs=1e-3)
    assert motion[0, -1, 0, 3] == 0.0 and (np.diff(motion[0, :, 0, 0]) >= 0).all()


def test_reactive_vehicles_stop_behind_an_overridden_agent(bank):
    frames = frames_of(bank, driven(bank, -0.5), VALID)
    x, speed = np.asarray(frames.box)[:, 1:3, 0], np.asarray(frames.velocity)[:, 2, 0]
    assert (x[:, 0] - x[:, 1] - 4.8 > 1.0).all()
    assert x[-1, 0] - x[-1, 1] - 4.8 == pytest.approx(2.0, abs=1.0) and speed[-1] < 0.8


@pytest.mark.slow
def test_ego_collides_with_an_agent_overridden_to_stand_still():
    """At 10 m/s the 5.2 m to its rear end take 0.52 s: the sixth step overlaps, is at fault, and ends the episode."""
    bank = bank_of(straight_road([car(0, 0, 0, 10), car(10, 3.7, 0, 5)]))
    task = Task(observation=GLIMPSE, metrics=("collision", "at_fault_collision", "collision_type"))
    simulator = Simulator(task, OverrideTraffic())

    @jax.jit
    def driven_past(y):
        pose = jnp.stack([bank.agents[0, 10, 1, 0], y, 0.0, 0.0])
        overridden = with_override(bank, jnp.asarray([[1]]), jnp.broadcast_to(pose, (1, 91, 1, 4)))

        def step(state, _):
            after, transition = simulator.step(overridden, state, jnp.zeros(2))
            return after, (transition.reward_terms["collision"], transition.terminated)

        state, (reward, over) = jax.lax.scan(step, simulator.reset(overridden, 0), None, length=8)
        return episode_metrics(overridden, state), reward, over

    metrics, reward, over = driven_past(0.0)
    assert {name: float(found.value) for name, found in metrics.items()} == {
        "collision": 1.0, "at_fault_collision": 1.0, "collision_type": float(CollisionType.STOPPED_OBJECT)
    }  # fmt: skip
    np.testing.assert_array_equal(over, np.arange(8) >= 5)
    np.testing.assert_array_equal(reward, np.where(np.arange(8) >= 5, -1.0, 0.0))
    # An agent that stands in the next lane is passed.
    metrics, reward, over = driven_past(3.7)
    assert float(metrics["collision"].value) == 0.0 and not over.any() and not reward.any()


@pytest.mark.slow
def test_gradients_reach_override_actions(bank):
    """The follower's distance has the finite-difference gradient with respect to another agent's override."""

    @jax.jit
    def place(brakes):
        return _frames(bank, driven(bank, brakes), VALID).box[-1, 2, 0]

    slope = float(jax.jit(jax.grad(place))(jnp.float32(-0.1)))
    finite = float(place(jnp.float32(-0.09)) - place(jnp.float32(-0.11))) / 0.02
    assert np.isfinite(slope) and slope == pytest.approx(finite, rel=0.03) and slope > 1.0


def test_bank_without_overrides_is_refused(bank):
    with pytest.raises(UsageError, match="no OverrideMotions"):
        SIMULATOR.context(bank, 0, 10)
    context = Simulator(TASK).context(bank, 0, 10)
    with pytest.raises(UsageError, match=r"no OverrideMotions; use override\.with_override"):
        OverrideTraffic().agents(bank, context, 0)
    assert (OverrideTraffic().name, OverrideTraffic(IdmTraffic()).name) == ("override", "override+idm")


def test_overrides_of_another_length_are_refused(bank):
    slots = jnp.asarray([[1]])
    with pytest.raises(
        UsageError, match="motion of 1 scenarios and 90 steps; use those of the bank, 1 and 91"
    ):
        with_override(bank, slots, jnp.zeros((1, 90, 1, 4)))
    with pytest.raises(UsageError, match="1 actions from step 91 on, in a log of 91 steps"):
        motions_of_actions(bank, slots, jnp.zeros((1, 1, 1, 2)), TASK.motion, begin=91)
    with pytest.raises(UsageError, match="0 actions from step 10 on"):
        motions_of_actions(bank, slots, jnp.zeros((1, 0, 1, 2)), TASK.motion)


@pytest.mark.parametrize(("steps", "start_x"), [(range(6), 15.0), (range(30, 91), 40.0)])
def test_agents_missing_at_the_start_begin_where_they_were_logged(steps, start_x):
    """At 10 m/s, at x = 20 m at step 10: last logged at step 5, or first at step 30."""
    bank = bank_of(straight_road([car(0, 0, 0, 9), car(20, 3.7, 0, 10, steps=steps)]))
    motion = motions_of_actions(bank, jnp.asarray([[1]]), jnp.zeros((1, 1, 1, 2)), TASK.motion)
    np.testing.assert_allclose(motion[0, 10, 0], [start_x, 3.7, 0.0, 10.0], atol=1e-3)


def test_traffic_models_are_found_by_name(bank):
    assert isinstance(make_traffic("log"), LogTraffic) and isinstance(make_traffic("idm"), IdmTraffic)
    assert isinstance(make_traffic("drivax.simulator.traffic.reactive:IdmTraffic"), IdmTraffic)
    assert prepare_bank(LogTraffic(), bank) is bank
    for name, words in (
        ("idn", "unknown traffic 'idn'; did you mean 'idm'"),
        ("trains", "unknown traffic 'trains'; use log, idm, or package.module:name"),
        ("drivax.tasks.task:Task", "makes no traffic"),
    ):
        with pytest.raises(UsageError, match=words):
            make_traffic(name)
