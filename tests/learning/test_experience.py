"""Logged experience: equal to an expert in the simulator, and drawn by weight."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import DataError, UsageError
from drivax.learning.algorithms.cql import CqlConfig
from drivax.learning.algorithms.ppo import PpoConfig
from drivax.learning.algorithms.warm_start import BcSacConfig
from drivax.learning.config import TrainConfig
from drivax.learning.driving import Driving
from drivax.learning.experience import ExperienceConfig, LoggedEnvironment, transitions
from drivax.learning.loop import usable_steps
from drivax.planners.simple import Expert, logged_motion
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.simulator import Simulator
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from pendulum import Pendulum

OBSERVATION = ObservationConfig(agents=2, steps=2, road=0, lights=1, route=3)
JUMP = 40
DRIVING = Driving(Simulator(Task(observation=OBSERVATION, metrics="none")))


@pytest.fixture(scope="module")
def bank(data):
    bank = ScenarioBank.from_scenarios(data)
    # In the first scenario an agent stands where ego is 0.5 s after the current step: the episode ends there.
    ego, box = bank.agents[0, 15, 0], bank.agent_box[0, 0]
    agents = bank.agents.at[0, :, 1].set(ego)
    # In the last, the log loses ego.
    agents = agents.at[2, 70:, 0, AgentColumn.VALID].set(0.0)
    # In the second, ego's logged heading is wrong at one step.
    agents = agents.at[1, JUMP, 0, 3:5].set(-agents[1, JUMP, 0, 4:2:-1])
    return replace(bank, agents=agents, agent_box=bank.agent_box.at[0, 1].set(box))


@pytest.fixture(scope="module")
def experience(bank):
    return ExperienceConfig().of(DRIVING, bank)


def drive_expert(bank, indices):
    """Drive the planner ``expert`` in the simulator; return all steps from the current one on."""
    simulator, planner = DRIVING.simulator, Expert(DRIVING.task.actions)

    def step(state, _):
        observation = simulator.observe(bank, state.context)
        situation = simulator.situation(bank, state)
        action, _ = planner.act((), bank, state, situation, observation, jax.random.key(0))
        action = DRIVING.task.actuate(bank, state.context, action)
        after, transition = simulator.replay(bank, state, logged_motion(bank, state.context, 1), action)
        next_observation = simulator.observe(bank, after.context)
        return after, (
            dict(observation), action, transition.reward, transition.terminated, dict(next_observation),
            transition.truncated,
        )  # fmt: skip

    states = jax.vmap(partial(simulator.reset, bank))(indices)
    # Map the step, not the loop: to map a loop, JAX traces its body several times.
    _, steps = jax.lax.scan(jax.vmap(step, (0, None)), states, None, bank.steps - 11)
    return jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), steps)


def test_transitions_equal_a_simulated_expert(bank, experience):
    online = jax.device_get(jax.jit(drive_expert)(bank, jnp.arange(3)))
    expert = jax.device_get(experience.expert)
    index, step = np.nonzero(expert.usable)
    positions = jnp.asarray(index), jnp.asarray(step)
    result = jax.device_get(jax.jit(lambda e, p: transitions(DRIVING, e, p, 0.9))(experience, positions))
    observation, action, reward, terminated, next_observation, truncated = jax.tree.map(
        lambda leaf: leaf[index, step - 10], online
    )
    first = step == 10
    assert first.sum() == 3 and len(index) > 100
    for name, value in observation.items():
        # At its first step an episode does not know the expert's previous action.
        np.testing.assert_allclose(
            result.observation[name][~first], value[~first], atol=1e-3, rtol=1e-4, err_msg=name
        )
        np.testing.assert_allclose(
            result.next_observation[name], next_observation[name], atol=1e-3, rtol=1e-4, err_msg=name
        )
    np.testing.assert_allclose(result.action, action, atol=1e-4)
    np.testing.assert_allclose(result.reward, reward, atol=1e-4, rtol=1e-4)
    np.testing.assert_array_equal(result.terminated, terminated)
    np.testing.assert_array_equal(expert.truncated[index, step], truncated)
    assert np.abs(reward).max() > 0


@pytest.mark.parametrize("hold", [1, 2])
def test_returns_of_logged_decisions_against_plain_loops(bank, experience, hold):
    """Of three decisions, cut short by the failure in the first scenario and by the end of each log."""
    expert = jax.device_get(experience.expert)
    index, first = np.nonzero(expert.usable)
    held = replace(experience, expert=replace(experience.expert, hold=hold))
    find = jax.jit(lambda e, at: (transitions(DRIVING, e, at, 0.9, 3), DRIVING.observe_recorded(bank, at)))
    result, _ = jax.device_get(find(held, (jnp.asarray(index), jnp.asarray(first))))
    last, cut = [], 0
    for number, (scenario, start) in enumerate(zip(index, first, strict=True)):
        step, reward, failed = start, 0.0, False
        while step < start + 3 * hold and expert.usable[scenario, step]:
            reward += 0.9 ** ((step - start) // hold) * expert.reward[scenario, step]
            failed |= bool(expert.terminated[scenario, step])
            step += 1
        assert result.reward[number] == pytest.approx(reward, rel=1e-4, abs=1e-5)
        assert result.terminated[number] == failed
        assert result.discount[number] == pytest.approx(0.9 ** np.ceil((step - start) / hold), rel=1e-5)
        last.append(step)
        cut += step < start + 3 * hold
    assert result.terminated.any() and 0 < cut < len(index)
    _, next_observation = jax.device_get(find(held, (jnp.asarray(index), jnp.asarray(last))))
    for name, value in next_observation.items():
        np.testing.assert_allclose(result.next_observation[name], value, atol=1e-5, err_msg=name)


def test_steps_after_an_end_or_without_expert_are_unusable(experience):
    expert = jax.device_get(experience.expert)
    assert isinstance(DRIVING, LoggedEnvironment)
    end = int(np.argmax(expert.terminated[0]))
    assert 10 <= end < 16 and expert.terminated[0, end]
    np.testing.assert_array_equal(np.nonzero(expert.usable[0])[0], np.arange(10, end + 1))
    # An action looks two steps ahead, so the last one is that of step 88.
    whole, lost = expert.usable[1], expert.usable[2]
    assert whole[10:89].all() and not whole[:10].any() and not whole[89:].any()
    assert lost[10:68].all() and not lost[68:].any()


def test_clipped_steps_are_left_out_by_default(bank, experience):
    expert = jax.device_get(experience.expert)
    index, step = np.nonzero(expert.clipped & expert.usable)
    assert {JUMP - 1} <= {s for i, s in zip(index, step, strict=True) if i == 1}
    assert (np.abs(expert.action) <= 1.0).all()
    unmasked = ExperienceConfig(mask_clipped=False).of(DRIVING, bank)
    for each, drawn in ((experience, False), (unmasked, True)):
        chances = np.diff(np.asarray(each.critic.cumulative).astype(np.int64), prepend=0)
        assert ((chances.reshape(expert.usable.shape)[index, step] > 0) == drawn).all()


def test_weights_apply_to_policy_or_all(bank, experience):
    usable = np.asarray(experience.expert.usable & ~experience.expert.clipped)
    weights = np.zeros(usable.shape)
    weights[1, 20], weights[1, 30], weights[0, 3] = 3.0, 1.0, 100.0
    both = ExperienceConfig().of(DRIVING, bank, weights)
    policy_only = ExperienceConfig(weighted="policy").of(DRIVING, bank, weights)
    assert both.policy is None and policy_only.policy is not None
    # (3 + 1)^2 / (9 + 1); the weight of the unusable step 3 has no effect.
    assert float(both.critic.effective) == pytest.approx(1.6) == float(policy_only.policy.effective)
    assert float(policy_only.critic.effective) == pytest.approx(usable.sum())
    np.testing.assert_array_equal(policy_only.critic.cumulative, experience.critic.cumulative)
    for each in (both, policy_only):
        np.testing.assert_array_equal(each.usable, usable)
        # What features are normalised by.
        np.testing.assert_array_equal(each.uniform.cumulative, experience.critic.cumulative)


def test_usable_steps_are_the_drawn_steps(data):
    config = TrainConfig(task=DRIVING.task, algorithm=CqlConfig())
    own = ExperienceConfig().of(DRIVING, ScenarioBank.from_scenarios(data))
    usable = usable_steps(config, data)
    np.testing.assert_array_equal(usable, own.expert.usable & ~own.expert.clipped)
    assert usable.any() and not usable[:, :10].any()
    # These draw scenarios, not steps.
    for algorithm in (PpoConfig(), BcSacConfig()):
        assert usable_steps(replace(config, algorithm=algorithm), data).all()


def test_unusable_experience_is_refused(bank):
    shape = (3, 91)
    for weights, words in (
        (np.ones((3, 90)), r"weights of shape \(3, 90\) for 3 scenarios of 91 steps"),
        (np.full(shape, -1.0), "step 0 of scenario 0 is -1"),
        (np.full(shape, np.nan), "step 0 of scenario 0 is nan"),
        (np.full(shape, 1e200), r"is 1e\+200; use numbers from 0 to 1e100"),
    ):
        with pytest.raises(UsageError, match=words):
            ExperienceConfig().of(DRIVING, bank, weights)
    with pytest.raises(DataError, match="all weights are 0"):
        ExperienceConfig().of(DRIVING, bank, np.zeros(shape))
    blind = replace(bank, agents=bank.agents.at[:, 11:, 0, AgentColumn.VALID].set(0.0))
    with pytest.raises(DataError, match="no logged step has an expert action; check the set"):
        ExperienceConfig().of(DRIVING, blind)
    with pytest.raises(UsageError, match="Pendulum has no logged episodes"):
        ExperienceConfig().of(Pendulum(), ())
