"""Driving as an environment: scenarios drawn from a bank, episodes from anywhere in the log to its end or a failure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.errors import UsageError
from drivax.learning.branches import in_any
from drivax.learning.environment import Environments, Outcome
from drivax.learning.experience import ExpertSteps
from drivax.learning.sampler import Places
from drivax.metrics.catalogue import CODES
from drivax.metrics.episode import episode_metrics
from drivax.planners.simple import expert_action, logged_motion
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import CURRENT_STEP, STEPS
from drivax.simulator.simulator import Simulator
from drivax.simulator.sparse import map_where
from drivax.simulator.starts import LogStart
from drivax.simulator.types import AgentContext, Beginning, Frame, SimState
from drivax.tasks.actions import Discrete
from drivax.tasks.task import Task

#: Scenarios that are replayed at once.
_AT_ONCE = 64


@dataclass(frozen=True)
class Driving:
    """A simulator whose scenarios are drawn with replacement.

    Attributes:
        simulator: Task, traffic and kind of start.
        latest_start: Episodes begin at a random step of the log between ``earliest_start`` and this one.
        earliest_start: See ``latest_start``; where the ego is not in the log yet, they begin at step 10.
    """

    simulator: Simulator
    latest_start: int = CURRENT_STEP
    earliest_start: int = CURRENT_STEP

    def __post_init__(self) -> None:
        if self.earliest_start < 0:
            raise UsageError(f"earliest_start is {self.earliest_start}", cure="use 0 or more")
        if not self.earliest_start <= self.latest_start < STEPS - 2:
            raise UsageError(
                f"latest_start is {self.latest_start}",
                cure=f"use {self.earliest_start} (earliest_start) to {STEPS - 3}",
            )

    @property
    def task(self) -> Task:
        """The task, with its action space.

        Raises:
            UsageError: The simulator's is not of our kind.
        """
        if not isinstance(self.simulator.task, Task):
            raise UsageError(
                f"{type(self.simulator.task).__name__} has no actions", cure="use drivax.tasks.task.Task"
            )
        return self.simulator.task

    @property
    def action_size(self) -> int:
        """Numbers in an action."""
        return self.task.actions.size

    @property
    def levels(self) -> tuple[tuple[float, ...], ...] | None:
        """The levels of the action space ``discrete``."""
        actions = self.task.actions
        if not isinstance(actions, Discrete):
            return None
        # Asked for while networks are traced, too; levels are numbers all the same.
        with jax.ensure_compile_time_eval():
            return tuple(tuple(float(level) for level in levels) for levels in actions.levels())

    def shapes(self, data: ScenarioBank) -> dict[str, tuple[int, ...]]:
        """Shapes of one observation by group."""
        # How an episode begins changes no shape; as logged is the quickest to trace.
        simulator = replace(self.simulator, start=LogStart())
        seen = jax.eval_shape(
            lambda bank: simulator.observe(bank, simulator.context(bank, 0, CURRENT_STEP)), data
        )
        return {name: tuple(value.shape) for name, value in seen.items()}

    def start(self, data: ScenarioBank, key: Array, count: int) -> Environments:
        """Environments at random steps of the log, so that their ends are staggered."""
        index, step, keys = _draw(data, key, count, self.earliest_start, data.steps - 3)
        state = jax.vmap(self.simulator.reset, (None, 0, 0, None, 0))(data, index, step, 0, keys)
        observation = self.observe_all(data, state.context)
        return Environments(state, jnp.zeros(count, bool), observation)

    def stored(self, state: SimState) -> AgentContext:
        """The context: index, step, history, and the traffic where it reacts."""
        return state.context

    def observe(self, data: ScenarioBank, stored: AgentContext) -> dict[str, Array]:
        """The task's observation of a context."""
        return dict(self.simulator.observe(data, stored))

    def observe_all(self, data: ScenarioBank, stored: AgentContext) -> dict[str, Array]:
        """The task's observations of a batch of contexts."""
        return jax.vmap(self.observe, (None, 0))(data, stored)

    def look(self, data: ScenarioBank, state: SimState) -> Frame:
        """Everyone: the next step moves on from the frame that the present observation was made of."""
        return jax.vmap(self.simulator.now, (None, 0))(data, state.context)

    def step(
        self, data: ScenarioBank, now: Environments, looked: Frame, action: Float[Array, "B D"], key: Array
    ) -> tuple[Environments, Outcome]:
        """One step of every environment; those that are over begin with another scenario instead."""
        count = now.over.shape[0]
        index, step, keys = _draw(data, key, count, self.earliest_start, self.latest_start)
        fresh = map_where(now.over, partial(self._beginning, data), index, step, keys)
        step_all = jax.vmap(self.simulator.step_or_begin, (None, 0, 0, 0, 0, 0))
        state, made = step_all(data, now.state, action, now.over, fresh, looked)
        over = made.terminated | made.truncated
        outcome = Outcome(
            reward=made.reward,
            terminated=made.terminated,
            truncated=made.truncated,
            looked=self.look(data, state),
            totals=_totals(data, state, made.reward_terms, over, now.over),
        )
        return Environments(state, over, self.observe_all(data, state.context)), outcome

    def _beginning(self, data: ScenarioBank, index: Array, step: Array, key: Array) -> Beginning:
        return self.simulator.beginning(data, index, step, 0, key)

    def demonstrations(
        self, data: ScenarioBank, key: Array, count: int
    ) -> tuple[dict[str, Array], Float[Array, "B D"], Bool[Array, " B"]]:
        """Random moments of the log, and what the expert did there.

        Moments lie between the current step and the last but one (an expert's action looks two steps ahead), in
        scenarios drawn with replacement. A moment is as if the expert had driven there in the simulator: its last
        action is what the action space makes of the log, as carried out.

        Returns:
            Observations, the expert's actions within the bounds, and whether it took clipping to get them there.
        """
        index, step, _ = _draw(data, key, count, CURRENT_STEP, data.steps - 3)

        def one(index: Array, step: Array) -> tuple[dict[str, Array], Array, Array]:
            context = self._moment(data, index, step)
            return (dict(self._logged.observe(data, context)), *self._did(data, context))

        return jax.vmap(one)(index, step)

    def observe_recorded(self, data: ScenarioBank, places: Places) -> dict[str, Array]:
        """Observations of logged moments; see :meth:`demonstrations`."""

        def one(index: Array, step: Array) -> dict[str, Array]:
            return dict(self._logged.observe(data, self._moment(data, index, step)))

        return jax.vmap(one)(*places)

    def expert_steps(self, data: ScenarioBank) -> ExpertSteps:
        """The log as a rollout of its expert from the current step on: rewards and ends as the simulator gives them.

        Everyone goes where the log goes, whatever traffic the simulator has: what happened is known for that only.
        """
        rows = jnp.arange(len(data))
        found = jax.lax.map(partial(self._rollout, data), rows, batch_size=min(len(data), _AT_ONCE))
        # Nothing happens before the first step, and nothing at the last, which only ends what was before.
        action, reward, terminated, truncated, clipped = (
            jnp.pad(part, ((0, 0), (CURRENT_STEP, 1), *((0, 0),) * (part.ndim - 2))) for part in found
        )
        ends = terminated | truncated
        over = jnp.cumsum(ends, axis=1) > ends
        return ExpertSteps(action, reward, terminated, truncated, _told(data) & ~over, clipped)

    @property
    def _logged(self) -> Simulator:
        """The simulator with everyone as logged, without metrics, which nobody looks at here."""
        return Simulator(replace(self.task, metrics="none"))

    def _moment(self, bank: ScenarioBank, index: Int[Array, ""], step: Int[Array, ""]) -> AgentContext:
        """A logged moment as if the expert had driven there."""
        context, before = (self._logged.context(bank, index, at) for at in (step, jnp.maximum(step - 1, 0)))
        return replace(context, action=self._did(bank, before)[0])

    def _did(self, bank: ScenarioBank, context: AgentContext) -> tuple[Float[Array, " D"], Bool[Array, ""]]:
        """What the expert does, as carried out, and whether it took clipping."""
        space = self.task.actions
        action = expert_action(bank, context, space)
        return space.actuated(context.history[-1], action, context.action), space.clipped(action)

    def _rollout(self, bank: ScenarioBank, index: Int[Array, ""]) -> tuple[Array, ...]:
        """What the expert did in one scenario from the current step on: action, reward, both ends, whether clipped."""
        simulator = self._logged
        begun = simulator.reset(bank, index)
        begun = replace(begun, context=self._moment(bank, index, begun.start))

        def step(state: SimState, _: None) -> tuple[SimState, tuple[Array, ...]]:
            action, clipped = self._did(bank, state.context)
            after, made = simulator.replay(bank, state, logged_motion(bank, state.context, 1), action)
            return after, (action, made.reward, made.terminated, made.truncated, clipped)

        return jax.lax.scan(step, begun, None, bank.steps - 1 - CURRENT_STEP)[1]


def _draw(
    bank: ScenarioBank, key: Array, count: int, earliest: int, latest: int
) -> tuple[Int[Array, " B"], Int[Array, " B"], Array]:
    """Scenarios, steps at which the ego is in the log (or the current one), and keys for starts."""
    index_key, step_key = jax.random.split(key)
    index = jax.random.randint(index_key, (count,), 0, len(bank))
    step = jax.random.randint(step_key, (count,), earliest, latest + 1)
    # The ego is always there at the current step.
    step = jnp.where(bank.agents[index, step, 0, AgentColumn.VALID] > 0, step, CURRENT_STEP)
    keys = jax.random.split(jax.random.fold_in(step_key, 1), count)  # not computed where starts are logged
    return index, step, keys


def _told(bank: ScenarioBank) -> Bool[Array, "N T"]:
    """Steps from the current one on at which the log tells what the expert did: ego is there, and for two steps on."""
    there = bank.agents[:, :, 0, AgentColumn.VALID] > 0
    goes_on = jnp.pad(there[:, :-2] & there[:, 1:-1] & there[:, 2:], ((0, 0), (0, 2)))
    return goes_on & (jnp.arange(bank.steps) >= CURRENT_STEP)


def _totals(
    bank: ScenarioBank, state: SimState, terms: dict[str, Array], done: Array, over: Array
) -> dict[str, Array]:
    """Sums over the batch: the task's metrics of episodes that end now, reward terms of steps that count."""
    logged = [name for name in state.episode.selection.names if name not in CODES]

    def of_episodes() -> dict[str, Array]:
        values = jax.vmap(episode_metrics, (None, 0))(bank, state)
        sums = {}
        for name in logged:
            counts = done & values[name].defined
            sums[name] = jnp.sum(jnp.where(counts, values[name].value, 0.0))
            sums[f"{name}/n"] = counts.sum().astype(jnp.float32)
        return sums

    # Most steps end no episode; the branch is on all batches of the program, so it really is skipped.
    nothing = {name: jnp.zeros(()) for metric in logged for name in (metric, f"{metric}/n")}
    totals: dict[str, Any] = jax.lax.cond(in_any(done), of_episodes, lambda: nothing)
    for name, term in terms.items():
        totals[f"reward/{name}"] = jnp.sum(jnp.where(over, 0.0, term))
    return totals
