"""Cost of a step: independent of the map, at most proportional to agents; one compilation per configuration."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest

from drivax.evaluation.rollout import drive, evaluation_task
from drivax.planners.simple import ConstantVelocity
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.simulator import contact, situation
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.bank_data import prepare_bank
from drivax.simulator.traffic.override import OverrideTraffic, with_override
from drivax.simulator.traffic.reactive import make_traffic
from drivax.studies.bench import BenchConfig, _parts, _repeat_part
from drivax.synthetic.world import generate_recording
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task
from drivax.testing.worlds import pad_agents
from scenes import GLIMPSE

BATCH = 4096


@pytest.fixture(scope="module")
def bank():
    """One scenario with all its padding."""
    return ScenarioBank.from_scenarios([assemble(generate_recording(7, 0))], trim=False)


def with_segments(bank, more):
    pad = ((0, 0), (0, 0), (0, more))
    return replace(bank, edges=jnp.pad(bank.edges, pad), lanes=jnp.pad(bank.lanes, pad))


def operations(bank, simulator=None):
    """Arithmetic of a step and an observation of one environment, as the compiler counts it before it optimises."""
    simulator = simulator or Simulator(Task())

    def one(bank, state, action):
        after, transition = simulator.step(bank, state, action)
        return transition.reward, after.episode, simulator.observe(bank, after.context)

    state = jax.eval_shape(jax.vmap(simulator.reset, (None, 0)), bank, jnp.zeros(BATCH, jnp.int32))
    traced = jax.jit(jax.vmap(one, (None, 0, 0))).lower(bank, state, jnp.zeros((BATCH, 2)))
    return traced.cost_analysis()["flops"] / BATCH


@pytest.fixture(scope="module")
def plain(bank):
    return operations(bank)


def test_a_step_costs_the_same_on_a_map_of_twice_the_segments(bank, plain):
    assert operations(with_segments(bank, 4096)) == pytest.approx(plain, rel=1e-3)


def test_a_step_costs_at_most_in_proportion_to_agents(bank, plain):
    few, many = plain, operations(pad_agents(bank, bank.agents.shape[2]))
    assert few < many < 1.5 * few


@pytest.mark.slow
def test_operation_count_detects_pairwise_agent_work(bank):
    class Pairs(Simulator):
        def observe(self, bank, context, driven=None):
            xy = bank.agents[context.index, context.step, :, :2]
            return {"apart": jnp.sum((xy[:, None] - xy) ** 2)}

    few = operations(bank, Pairs(Task(metrics="none")))
    many = operations(pad_agents(bank, bank.agents.shape[2]), Pairs(Task(metrics="none")))
    assert many - few > 3 * 64 * 64 * 2  # differences and squares of pairs, four times as many


@pytest.mark.slow
def test_optional_facts_cost_nothing_unless_requested(bank, monkeypatch):
    called = set()

    def record_calls(module, name):
        real = getattr(module, name)

        def call(*arguments):
            called.add(name)
            return real(*arguments)

        monkeypatch.setattr(module, name, call)

    record_calls(situation.queries, "lane_passage")
    record_calls(contact, "nearest_gap")
    less = operations(bank, Simulator(Task(observation=GLIMPSE, rewards=RewardConfig(preset="published"))))
    assert called == set()
    rewards = RewardConfig(preset="published", lane_change=0.2, close=-0.1)
    assert operations(bank, Simulator(Task(observation=GLIMPSE, rewards=rewards))) > less
    assert called == {"lane_passage", "nearest_gap"}


#: Kinds of traffic with the most bytes that a state may take.
KINDS = [
    (make_traffic("log"), 4096),
    (make_traffic("idm"), 16384),
    (OverrideTraffic(), 16384),
    (OverrideTraffic(make_traffic("idm")), 16384),
]
every_traffic = pytest.mark.parametrize(
    ("traffic", "most"), KINDS, ids=lambda kind: getattr(kind, "name", "")
)


def overridden(bank):
    """The bank, with four agents overridden to stand at the origin."""
    return with_override(bank, jnp.arange(1, 5)[None], jnp.zeros((1, bank.steps, 4, 4)))


@every_traffic
def test_states_are_small(bank, traffic, most):
    simulator = Simulator(Task(observation=GLIMPSE), traffic)
    state = jax.eval_shape(
        lambda bank: simulator.reset(overridden(bank), jnp.zeros((), jnp.int32)), prepare_bank(traffic, bank)
    )
    assert sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state)) <= most


@every_traffic
def test_a_state_has_the_same_types_after_a_reset_and_after_a_step(bank, traffic, most):
    """Otherwise the step compiles twice and every loop over steps is traced twice."""
    simulator, bank = (
        Simulator(Task(observation=GLIMPSE), traffic),
        jax.eval_shape(overridden, prepare_bank(traffic, bank)),
    )

    def types(state):
        return [(leaf.shape, leaf.dtype, leaf.weak_type) for leaf in jax.tree.leaves(state)]

    state = jax.eval_shape(simulator.reset, bank, jnp.zeros((), jnp.int32))
    after = jax.eval_shape(lambda bank, s: simulator.step(bank, s, jnp.zeros(2))[0], bank, state)
    assert types(after) == types(state)


@pytest.mark.slow
@pytest.mark.parametrize("traffic", ["log", "idm"])
def test_one_configuration_is_compiled_once(traffic):
    model = make_traffic(traffic)

    def driven(scenarios, rows, trim=True):
        bank = prepare_bank(model, ScenarioBank.from_scenarios(scenarios, trim=trim))
        keys = jax.random.split(jax.random.key(0), 2)
        drive(Simulator(evaluation_task(Task()), model), ConstantVelocity(), bank, jnp.asarray(rows), keys)
        return drive._cache_size()

    data = [assemble(generate_recording(7, i)) for i in range(3)]
    assert driven(data, [0, 1]) == driven(data, [2, 0])
    # Banks of other scenarios that keep their padding share the program, too.
    assert driven(data[:1], [0, 0], trim=False) == driven(data[1:2], [0, 0], trim=False)


@pytest.mark.slow
@pytest.mark.parametrize("part", ["reset", "metrics"])
def test_components_are_timed_on_unmodified_states(part):
    # Empty accumulators are infinite or undefined; the states of the next timed round must be neither.
    bank = ScenarioBank.from_scenarios([assemble(generate_recording(7, 0))])
    simulator, config = Simulator(Task(observation=GLIMPSE)), BenchConfig(batch=2, steps=3)
    states = jax.jit(jax.vmap(simulator.reset, (None, 0)))(bank, jnp.zeros(2, jnp.int32))
    shift = _repeat_part(config, _parts(simulator)[part])(bank, states, None)
    assert (jnp.abs(shift) < 1e-9).all()
