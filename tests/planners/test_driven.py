"""Traffic driven by a network equals several driven agents."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from drivax.errors import UsageError
from drivax.planners.functions import NetworkPlanner
from drivax.planners.planner_traffic import PlannerTraffic, TrafficDriver, with_driver
from drivax.planners.simple import Expert, RandomActions
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import AgentKind
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.bank_data import data_of
from drivax.simulator.traffic.log import alone
from drivax.tasks.actions import ROUTE
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from scenes import SMALL, bank_of, car, straight_road

TASK = Task(
    observation=ObservationConfig(agents=3, steps=3, road=8, lights=0, route=2), metrics="none", ends=()
)
TRAFFIC = PlannerTraffic(TASK, count=3)
STEPS = 30


class Choice:
    def __init__(self, action):
        self.action = action

    def mode(self):
        return self.action


class Untrained(nnx.Module):
    """One layer over everything that is seen."""

    def __init__(self, width, rngs):
        self.layer = nnx.Linear(width, 2, rngs=rngs)

    def __call__(self, groups):
        seen = jnp.concatenate([groups[name].ravel().astype(jnp.float32) for name in sorted(groups)])
        return Choice(0.5 * jnp.tanh(self.layer(seen)))


@pytest.fixture(scope="module")
def bank():
    """Ego; a car alongside, one that is nearly parked, a cyclist, a car ahead, and two further away."""
    cars = [
        car(speed=8.0), car(-3, 3.7, 0, 9), car(15, 3.7, 0, 0.1), car(10, 0, 0, 5, kind=AgentKind.CYCLIST),
        car(25, 0, 0, 7), car(60, 3.7, 0, 10), car(90, 0, 0, 10),
    ]  # fmt: skip
    bank = bank_of(straight_road(cars))
    seen = jax.eval_shape(lambda b: Simulator(TASK).observe(b, Simulator(TASK).context(b, 0, 10)), bank)
    width = sum(int(np.prod(leaf.shape)) for leaf in seen.values())
    graph, weights = nnx.split(Untrained(width, nnx.Rngs(4)), nnx.Param)
    return with_driver(bank, NetworkPlanner(weights, graph))


def nearest(bank):
    """Slots of the three cars that are driven, by hand: those at x = -3, 25 and 60, nearest first."""
    x = np.asarray(bank.agents[0, 10, :, 0])
    return [int(np.argmin(np.abs(x - at))) for at in (-3, 25, 60)]


def test_the_nearest_moving_vehicles_are_driven(bank):
    state = jax.jit(lambda b: TRAFFIC.start(b, 0, 10))(bank)
    assert state.contexts.slot.tolist() == nearest(bank)
    more = PlannerTraffic(TASK, count=6)
    slots = jax.jit(lambda b: more.start(b, 0, 10))(bank).contexts.slot.tolist()
    assert slots[:3] == nearest(bank) and slots[4:] == [bank.agents.shape[2]] * 2


def test_policies_of_the_space_route_drive_only_egos_with_a_route():
    cars = [car(speed=8.0), car(-3, 3.7, 0, 9), car(25, 0, 0, 7), car(60, 3.7, 0, 10)]
    bank = ScenarioBank.from_scenarios([assemble(straight_road(cars), SMALL.with_egos(3))], trim=False)
    traffic = PlannerTraffic(replace(TASK, actions=ROUTE), count=4)
    slots = traffic._slots(bank, 0, 10).tolist()
    assert slots == [*bank.egos[0, 1:].tolist(), *[bank.agents.shape[2]] * 2]
    without = replace(bank, on_lanes=bank.on_lanes.at[1].set(False))
    assert traffic._slots(without, 0, 10).tolist()[0] == slots[1]


def test_planners_unfit_for_traffic_are_refused(bank):
    with pytest.raises(
        UsageError, match="route cannot drive others without routes; convert or generate the set"
    ):
        PlannerTraffic(Task(actions=ROUTE)).prepare(bank)
    with pytest.raises(UsageError, match="Memoryless planner that does not replay the log"):
        with_driver(bank, Expert())
    with pytest.raises(UsageError, match="traffic with 0 driven vehicles"):
        PlannerTraffic(TASK, count=0)
    with pytest.raises(UsageError, match="the base of driven traffic is driven, too; use another base"):
        PlannerTraffic(base=PlannerTraffic())
    with pytest.raises(UsageError, match="the bank has no TrafficDriver; use planners"):
        TRAFFIC.start(bank_of(straight_road([car()])), 0, 10)


def test_driven_traffic_holds_decisions(bank):
    """Random actions differ from step to step, but the traffic executes each for two."""
    simulator = Simulator(TASK, PlannerTraffic(replace(TASK, hold=2), count=3))

    @jax.jit
    def actions(bank):
        def one(state, _):
            after, _ = simulator.step(bank, state, jnp.zeros(2))
            return after, after.context.traffic.contexts.action

        return jax.lax.scan(one, simulator.reset(bank, 0, 11), None, 6)[1]

    executed = np.asarray(actions(with_driver(bank, RandomActions())))
    np.testing.assert_array_equal(executed[0::2], executed[1::2])
    assert (executed[2::2] != executed[1:-1:2]).all()


@pytest.mark.slow
def test_driven_traffic_equals_agents_stepped_together(bank):
    """The same policy in two loops that share no step: as traffic of ego, and in a stack of driven agents with ego."""
    simulator, ego = Simulator(TASK, TRAFFIC), jnp.array([0.3, 0.05])

    @jax.jit
    def as_traffic(bank):
        def one(state, _):
            after, _ = simulator.step(bank, state, ego)
            return after, simulator.frame(bank, after.context, alone(after.context), 0)

        return jax.lax.scan(one, simulator.reset(bank, 0), None, STEPS)[1]

    stacked = Simulator(TASK)

    @jax.jit
    def together(bank, slots):
        def one(states, _):
            seen = stacked.observe_together(bank, states)
            network = nnx.merge(
                data_of(bank, TrafficDriver).planner.graph, data_of(bank, TrafficDriver).planner.parameters
            )
            act = jax.vmap(lambda groups: network(groups).mode())
            actions = act(seen).at[0].set(ego)
            after, _ = stacked.step_together(bank, states, actions)
            first = jax.tree.map(lambda leaf: leaf[0], after.context)
            return after, stacked.frame(bank, first, after.context, 0)

        return jax.lax.scan(one, stacked.reset_together(bank, 0, slots), None, STEPS)[1]

    found, expected = as_traffic(bank), together(bank, jnp.array([0, *nearest(bank)]))
    for name in ("box", "velocity", "valid", "z"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=2e-3, err_msg=name)
    logged = np.asarray(bank.agents[0, 11 : 11 + STEPS, :, :2])
    apart = np.linalg.norm(np.asarray(found.box)[:, : logged.shape[1], :2] - logged, axis=-1)[-1]
    assert (apart[nearest(bank)] > 0.5).all()
    others = [s for s in range(1, 7) if s not in nearest(bank)]
    np.testing.assert_allclose(apart[others], 0.0, atol=1e-4)
