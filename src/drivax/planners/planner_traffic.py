"""Traffic in which a planner drives some agents, for example to evaluate one policy among agents of another."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from drivax.errors import UsageError
from drivax.planners.planner import Memoryless, Planner, hold
from drivax.scenario.bank.columns import AgentColumn, SizeColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.scenario.schema import AgentKind
from drivax.simulator.contact import Contact
from drivax.simulator.lights import remember_lights
from drivax.simulator.simulator import Simulator
from drivax.simulator.situation import measure
from drivax.simulator.traffic.bank_data import TrafficData, data_of, prepare_bank, with_data
from drivax.simulator.traffic.log import LogTraffic, agent_rows, alone, frame_of
from drivax.simulator.types import HISTORY, AgentContext, Frame, SimState, Traffic
from drivax.tasks.actions import Route
from drivax.tasks.task import Task

#: Only vehicles that travel more than this in the rest of the log are driven, m.
_MIN_TRAVEL_M = 2.0


@record
class TrafficDriver(TrafficData):
    """The planner that drives agents other than ego."""

    planner: Planner

    def part(self, rows: Int[Array, " n"]) -> TrafficDriver:
        """Return the planner: all scenarios share it."""
        return self


@record
class PlannerTrafficState:
    """State of the K agents that the planner drives.

    Attributes:
        begin: First step of the episode; until then all agents moved as logged.
        contexts: One context per agent; a slot equal to the number of agents is empty.
        carry: Carry of their planners, with the decisions that they hold; empty if ``Task.hold`` is 1.
        base: State of the traffic around them.
    """

    begin: Int[Array, "*batch"]
    contexts: AgentContext
    carry: Any
    base: Any


@dataclass(frozen=True)
class PlannerTraffic:
    """Traffic whose vehicles nearest to ego are driven by the planner of :func:`with_driver`, others by ``base``.

    It drives vehicles that are logged at the start of the episode and travel more than 2 m in the rest of the log. They
    see all agents, hold each decision for ``task.hold`` steps, and follow the task's dynamics to the end of the
    episode. If the simulator drives several agents, earlier frames take those after the first from ``base``. Only
    vehicles that are egos of the set have a route: for others, use a policy that can follow lanes without one. In the
    action space ``route``, only egos with a route on lanes are driven.

    Attributes:
        task: Observation and action space of the planner.
        count: Largest number of driven vehicles.
        base: Traffic model of all other agents.
        seed: Seed of the planner's draws, which otherwise depend on scenario, step and agent only.
    """

    task: Task = field(default_factory=Task)
    count: int = 4
    base: Traffic = field(default_factory=LogTraffic)
    seed: int = 0

    def __post_init__(self) -> None:
        if self.count < 1:
            raise UsageError(f"traffic with {self.count} driven vehicles", cure="use count=1 or more")
        if isinstance(self.base, PlannerTraffic):  # a bank has one TrafficDriver
            raise UsageError(
                "the base of driven traffic is driven, too", cure="use another base, such as IdmTraffic()"
            )

    @property
    def name(self) -> str:
        """``driven``, followed by the name of the base if that is not the log (``driven+idm``)."""
        return "driven" if self.base.name == "log" else f"driven+{self.base.name}"

    def prepare(self, bank: ScenarioBank) -> ScenarioBank:
        """Return the bank with the data of ``base``.

        Raises:
            UsageError: Only the recorded ego has the route that the planner's action space needs.
        """
        if isinstance(self.task.actions, Route) and bank.most_egos == 1:
            cure = "convert or generate the set with --egos 8, or use a policy of another action space"
            problem = "a policy of the action space route cannot drive others without routes"
            raise UsageError(problem, cure=cure)
        return prepare_bank(self.base, bank)

    def start(self, bank: ScenarioBank, index: Any, step: Any) -> PlannerTrafficState:
        """Return the logged traffic state at ``step``.

        Raises:
            UsageError: The bank has no driver.
        """
        data_of(bank, TrafficDriver, "use planners.planner_traffic.with_driver")
        simulator, slots = Simulator(self.task), self._slots(bank, index, step)
        contexts = jax.vmap(lambda slot: simulator.context(bank, index, step, slot))(slots)
        carry = () if self.task.hold == 1 else ((), jnp.zeros_like(contexts.action))
        base = self.base.start(bank, index, step)
        return PlannerTrafficState(jnp.asarray(step, jnp.int32), contexts, carry, base)

    def advance(self, bank: ScenarioBank, context: AgentContext, frame: Frame) -> PlannerTrafficState:
        """Advance all agents by one step of 0.1 s from the present frame."""
        traffic = context.traffic
        planner = hold(data_of(bank, TrafficDriver).planner, self.task.hold)

        def frames(back: int, slots: Int[Array, " K"] | None = None) -> Frame:
            """Return the frame ``back`` steps ago, of all slots or of some."""
            rows = self.agents(bank, context, back)
            return frame_of(bank, context.index, context.step, rows, alone(context), back, slots)

        def drive(agent: AgentContext, carry: Any) -> tuple[AgentContext, Any]:
            """Return an agent's context one step later, after an action of the planner, and the planner's carry."""
            # No earlier contacts are kept: they matter only to the facts of collisions and time to collision.
            no_contact = jnp.full(frame.valid.shape, int(Contact.APART), jnp.int8)
            lights = remember_lights(bank, agent)
            situation, contacts, lights = measure(bank, agent, frame, frames(1), no_contact, lights)
            episode = self.task.episode_start()
            state = SimState(situation.context, situation.facts, contacts, lights, episode, traffic.begin)
            key = jax.random.key(self.seed)
            for number in (bank.identity[agent.index], agent.step, agent.slot):
                key = jax.random.fold_in(key, number)
            observation = self.task.observe(bank, situation.context, frames, frame)
            action, carry = planner.act(carry, bank, state, situation, observation, key)
            action = self.task.actuate(bank, agent, action)
            length_m = bank.length_m(agent.index, agent.slot)
            motion = self.task.motion(agent.history[-1], action, length_m)
            history = jnp.concatenate([agent.history[1:], motion[None]])
            return replace(situation.context, step=agent.step + 1, history=history, action=action), carry

        base = self.base.advance(bank, replace(context, traffic=traffic.base), frame)
        contexts, carry = jax.vmap(drive)(traffic.contexts, traffic.carry)
        return PlannerTrafficState(traffic.begin, contexts, carry, base)

    def agents(self, bank: ScenarioBank, context: AgentContext, back: int) -> Float[Array, "A 8"]:
        """Return the rows of ``base`` with the driven vehicles at their simulated poses."""
        traffic = context.traffic
        rows = self.base.agents(bank, replace(context, traffic=traffic.base), back)
        slot = jnp.where(context.step - back > traffic.begin, traffic.contexts.slot, rows.shape[0])
        motion, z = traffic.contexts.history[:, HISTORY - 1 - back], traffic.contexts.z
        return rows.at[slot].set(agent_rows(motion, z, jnp.ones_like(z)), mode="drop")

    def _slots(self, bank: ScenarioBank, index: Any, step: Any) -> Int[Array, " K"]:
        """Return the slots of the vehicles to drive, nearest to ego first, padded with the number of agents."""
        rows, count = bank.agents[index], bank.agents.shape[2]
        xy, valid = rows[..., AgentColumn.XY], rows[..., AgentColumn.VALID] > 0
        squared_travel = ((xy - xy[step]) ** 2).sum(axis=-1)
        is_later = valid & (jnp.arange(bank.steps) > step)[:, None]
        travels = (is_later & (squared_travel > _MIN_TRAVEL_M**2)).any(axis=0)
        is_vehicle = bank.agent_box[index, :count, SizeColumn.KIND] == int(AgentKind.VEHICLE)
        # Slot 0 is ego.
        is_eligible = valid[step] & (jnp.arange(count) > 0) & travels & is_vehicle
        if isinstance(self.task.actions, Route):
            on_lanes = bank.on_lanes.reshape(bank.egos.shape)[index]
            is_eligible &= jnp.isin(jnp.arange(count), jnp.where(on_lanes, bank.egos[index], -1))
        squared_distance = jnp.where(is_eligible, ((xy[step] - xy[step, 0]) ** 2).sum(axis=-1), jnp.inf)
        order = jnp.argsort(squared_distance)[: self.count]
        order = jnp.pad(order, (0, self.count - order.shape[0]), constant_values=count)
        is_empty = jnp.isinf(squared_distance.at[order].get(mode="fill", fill_value=jnp.inf))
        return jnp.where(is_empty, count, order).astype(jnp.int32)


def with_driver(bank: ScenarioBank, driver: Planner) -> ScenarioBank:
    """Return the bank with the planner that drives agents in :class:`PlannerTraffic`.

    Raises:
        UsageError: The planner is not a :class:`Memoryless` one, or replays the log.
    """
    if not isinstance(driver, Memoryless) or driver.replays:
        cure = "use a trained policy, or a Memoryless planner that does not replay the log"
        raise UsageError(f"planner {driver.name!r} cannot drive others", cure=cure)
    return with_data(bank, TrafficDriver(driver))
