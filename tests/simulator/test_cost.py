"""What a step costs does not grow with the map, and grows with agents no faster than they do; one compilation each."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest

from drivax.evaluation.rollout import drive, judging
from drivax.planners.simple import ConstantVelocity
from drivax.scenario.assemble import assemble
from drivax.scenario.bank import ScenarioBank
from drivax.simulator.catalogue import make_traffic, prepared
from drivax.simulator.simulator import Simulator
from drivax.synthetic.world import generate_recording
from drivax.tasks.task import Task

BATCH = 4096


@pytest.fixture(scope="module")
def bank():
    """One scenario with all its padding."""
    return ScenarioBank.from_scenarios([assemble(generate_recording(7, 0))], trim=False)


def with_segments(bank, more):
    pad = ((0, 0), (0, 0), (0, more))
    return replace(bank, edges=jnp.pad(bank.edges, pad), lanes=jnp.pad(bank.lanes, pad))


def with_agents(bank, more):
    return replace(
        bank,
        agents=jnp.pad(bank.agents, ((0, 0), (0, 0), (0, more), (0, 0))),
        agent_box=jnp.pad(bank.agent_box, ((0, 0), (0, more), (0, 0))),
        extension=jnp.pad(bank.extension, ((0, 0), (0, more), (0, 0), (0, 0))),
    )


def operations(bank, simulator=None):
    """Arithmetic of a step and an observation of one environment, as the compiler counts it before it optimises."""
    simulator = simulator or Simulator(Task())

    def one(bank, state, action):
        after, transition = simulator.step(bank, state, action)
        return transition.reward, after.episode, simulator.observe(bank, after.scene)

    state = jax.eval_shape(jax.vmap(simulator.reset, (None, 0)), bank, jnp.zeros(BATCH, jnp.int32))
    traced = jax.jit(jax.vmap(one, (None, 0, 0))).lower(bank, state, jnp.zeros((BATCH, 2)))
    return traced.cost_analysis()["flops"] / BATCH


def test_a_step_costs_the_same_on_a_map_of_twice_the_segments(bank):
    assert operations(with_segments(bank, 4096)) == pytest.approx(operations(bank), rel=1e-3)


def test_a_step_costs_at_most_in_proportion_to_agents(bank):
    few, many = operations(bank), operations(with_agents(bank, bank.agents.shape[2]))
    assert few < many < 2.0 * few


def test_the_count_would_see_pairs_of_agents(bank):
    class Pairs(Simulator):
        def observe(self, bank, scene, cast=None):
            xy = bank.agents[scene.index, scene.step, :, :2]
            return {"apart": jnp.sum((xy[:, None] - xy) ** 2)}

    few = operations(bank, Pairs(Task()))
    many = operations(with_agents(bank, bank.agents.shape[2]), Pairs(Task()))
    assert many - few > 3 * 64 * 64 * 2  # differences and squares of pairs, four times as many


@pytest.mark.parametrize(("traffic", "most"), [("log", 4096), ("idm", 16384)])
def test_states_are_small(bank, traffic, most):
    chosen = make_traffic(traffic)
    state = jax.eval_shape(Simulator(Task(), chosen).reset, prepared(chosen, bank), jnp.zeros((), jnp.int32))
    assert sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state)) <= most


@pytest.mark.slow
def test_one_configuration_is_compiled_once():
    data = [assemble(generate_recording(7, i)) for i in range(3)]
    bank = ScenarioBank.from_scenarios(data)
    keys = jax.random.split(jax.random.key(0), 2)
    before = drive._cache_size()
    for task in (Task(), Task()):
        for rows in ([0, 1], [2, 0]):
            drive(Simulator(judging(task)), ConstantVelocity(), bank, jnp.array(rows), keys)
    assert drive._cache_size() == before + 1
    # Banks of other scenarios that keep their padding share the program, too.
    drive(
        Simulator(judging(Task())),
        ConstantVelocity(),
        ScenarioBank.from_scenarios(data[:1], trim=False),
        jnp.zeros(2, int),
        keys,
    )
    full = drive._cache_size()
    drive(
        Simulator(judging(Task())),
        ConstantVelocity(),
        ScenarioBank.from_scenarios(data[1:2], trim=False),
        jnp.zeros(2, int),
        keys,
    )
    assert drive._cache_size() == full
