"""Several driven agents in one scenario."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.scenario.bank.columns import AgentColumn
from drivax.simulator.simulator import Simulator, is_driven, slots_of
from drivax.simulator.traffic.agent_paths import AgentPaths
from drivax.simulator.traffic.bank_data import data_of
from drivax.simulator.traffic.reactive import IdmTraffic
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from scenes import GLIMPSE, bank_of, car, straight_road

OBSERVATION = ObservationConfig(agents=8, steps=1, road=0, lights=1, route=2)
REACTIVE = Simulator(Task(observation=OBSERVATION, metrics="training"), IdmTraffic())
#: With all that can be measured: half a minute of compilation.
MEASURED = Simulator(Task(observation=OBSERVATION), IdmTraffic())
CARS = [car(0, 0, 0, 10), car(40, 0, 0, 10), car(-15, 3.7, 0, 10), car(-50, 0, 0, 10)]


@pytest.fixture(scope="module")
def bank():
    return IdmTraffic().prepare(bank_of(straight_road(CARS)))


@partial(jax.jit, static_argnums=0)
def together(simulator, bank, slots, actions):
    """Return states and transitions of every step of a stack of agents, and their last observations."""
    states = simulator.reset_together(bank, 0, slots)

    def one(states, action):
        after, transitions = simulator.step_together(bank, states, action)
        return after, (after, transitions)

    last, out = jax.lax.scan(one, states, actions)
    return out, simulator.observe_together(bank, last)


@partial(jax.jit, static_argnums=0)
def single(simulator, bank, actions):
    def one(state, action):
        after, transitions = simulator.step(bank, state, action)
        return after, (after, transitions)

    last, out = jax.lax.scan(one, simulator.reset(bank, 0), actions)
    return out, simulator.observe(bank, last.context)


@pytest.fixture(scope="module")
def braking(bank):
    """The leader brakes hard, ego keeps its speed. The leader is in slot 2: the car of slot 1 is closer to ego."""
    leader = int(np.argmax(np.asarray(bank.agents[0, 10, :, 0])))
    slots = slots_of(bank, 0, jnp.isin(jnp.arange(16), jnp.asarray([0, leader])), 3)
    actions = np.zeros((30, 3, 2), np.float32)
    actions[:, 1, 0] = -1.0
    return slots, leader, together(REACTIVE, bank, slots, jnp.asarray(actions))


def test_slots_are_present_agents_of_the_mask():
    cars = [car(0, 0, 0, 5), car(20, 0, 0, 5), car(40, 0, 0, 5, steps=range(30, 91)), car(60, 0, 0, 5)]
    bank = bank_of(straight_road(cars))
    present = np.flatnonzero(np.asarray(bank.agents[0, 10, :, AgentColumn.VALID]) > 0)
    assert present.size == 3
    mask = jnp.ones(16, bool)
    assert slots_of(bank, 0, mask, 5).tolist() == [*present, 16, 16]
    assert slots_of(bank, 0, mask, 2).tolist() == present[:2].tolist()
    assert slots_of(bank, 0, mask, 5, step=40).tolist() == [0, 1, 2, 3, 16]


def test_driven_agents_observe_each_other_where_they_drive(bank, braking):
    slots, leader, ((states, _), observations) = braking
    assert slots.tolist() == [0, leader, 16]
    x = np.asarray(states.context.history)[:, :, -1, 0]
    # 10 m/s braked with 6 m/s2 stands after 8.33 m; ego drives on.
    assert x[-1, 1] - 40.0 == pytest.approx(25 / 3, abs=0.01)
    assert x[-1, 0] == pytest.approx(30.0, abs=1e-3)
    # Bumpers meet when ego has driven 40 - 4.8 + 8.33 m: not yet. Both see the same distance.
    assert not np.asarray(states.facts.collision)[:, :2].any()
    ahead = x[-1, 1] - x[-1, 0]
    first = np.asarray(observations["agents"])[:, :, -1, 0] * 50
    assert np.isclose(first[0], ahead, atol=0.02).any() and np.isclose(first[1], -ahead, atol=0.02).any()


def test_padding_agents_do_nothing(bank, braking):
    _, _, ((states, transitions), _) = braking
    assert np.asarray(is_driven(bank, jax.tree.map(lambda leaf: leaf[0], states))).tolist() == [
        True,
        True,
        False,
    ]
    for name in ("reward", "terminated", "truncated"):
        assert not np.asarray(getattr(transitions, name))[:, 2].any()
    check_finite(states, transitions)


def check_finite(states, transitions):
    for leaf in jax.tree.leaves((states.facts, transitions.reward)):
        assert np.isfinite(np.asarray(leaf, np.float64)).all()


def test_reactive_traffic_sees_every_driven_agent(bank, braking):
    slots, _, ((states, _), _) = braking
    last_slot = int(np.argmin(np.asarray(bank.agents[0, 10, :4, 0])))
    row = int(np.flatnonzero(np.asarray(data_of(bank, AgentPaths).slot[0]) == last_slot)[0])
    free = np.asarray(states.context.traffic.speed)[:, :, -1, row]
    # All states of the stack hold the same traffic.
    np.testing.assert_array_equal(free[:, 0], free[:, 1])
    # The last car follows ego: when ego brakes it does, too.
    brakes = jnp.zeros((30, 3, 2)).at[:, 0, 0].set(-0.7)
    (slowed, _), _ = together(REACTIVE, bank, slots, brakes)
    assert np.asarray(slowed.context.traffic.speed)[-1, 0, -1, row] < free[-1, 0] - 0.5


@pytest.mark.slow
def test_stack_of_one_equals_a_single_agent(bank):
    actions = jax.random.uniform(jax.random.key(0), (30, 3, 2), minval=-0.5, maxval=0.3)
    slots = jnp.asarray([0, 16, 16])
    (states, transitions), observations = together(MEASURED, bank, slots, actions)
    check_finite(states, transitions)
    (expected_states, expected_transitions), observation = single(MEASURED, bank, actions[:, 0])
    pairs = (
        (states.context.history[:, 0], expected_states.context.history),
        (transitions.reward[:, 0], expected_transitions.reward),
    )
    for got, expected in (*pairs, *((observations[name][0], observation[name]) for name in observation)):
        np.testing.assert_allclose(np.asarray(got, np.float32), np.asarray(expected, np.float32), atol=1e-5)


@pytest.mark.slow
def test_agents_whose_episode_ended_get_no_reward_and_no_metrics(bank):
    simulator = Simulator(Task(observation=GLIMPSE, metrics=("distance", "comfort")))
    crash = bank_of(straight_road([car(0, 0, 0, 10), car(22, 0, 0, 0)]))

    @jax.jit
    def run(bank):
        states = simulator.reset_together(bank, 0, jnp.asarray([0, 16]))

        def one(carry, _):
            states, over = carry
            after, transitions = simulator.step_together(bank, states, jnp.zeros((2, 2)), over)
            over |= transitions.terminated | transitions.truncated
            return (after, over), (transitions.reward[0], transitions.terminated[0], after.episode.total[0])

        return jax.lax.scan(one, (states, jnp.zeros(2, bool)), None, length=40)[1]

    reward, terminated, total = (np.asarray(part) for part in run(crash))
    # Bumpers are 22 - 4.8 m apart: the eighteenth step closes the gap.
    assert np.flatnonzero(terminated).tolist() == [17]
    assert reward[17] == pytest.approx(-1.0, abs=0.3) and not reward[18:].any()
    np.testing.assert_array_equal(total[17:], np.broadcast_to(total[17], (23, *total[17].shape)))
    assert (total[17] != total[16]).any()
