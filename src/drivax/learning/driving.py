"""Driving as an environment: scenarios drawn from a bank, episodes from random steps of the log."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.errors import UsageError
from drivax.learning.environment import (
    Environment,
    Environments,
    Outcome,
    any_across_learners,
    draw_positions,
)
from drivax.learning.experience import (
    ExpertActions,
    ExpertSteps,
    StepIndex,
    expert_steps,
    require_log,
)
from drivax.learning.program import map_over_devices
from drivax.metrics.catalogue import CODES
from drivax.metrics.episode import episode_metrics
from drivax.planners.simple import expert_action, logged_motion
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.scenario.schema import CURRENT_STEP
from drivax.settings.structure import kind_of
from drivax.simulator.simulator import Simulator, Step, map_where
from drivax.simulator.starts import LogStart
from drivax.simulator.traffic.bank_data import TrafficData, find_data, prepare_bank, with_data
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.types import AgentContext, Frame, SimState
from drivax.tasks.actions import ActionSpace, DirectState, Discrete, Route, Trajectory
from drivax.tasks.task import Task

#: Vehicles that the policy drives in training: recorded egos, or any ego of a scenario (``scenario.build.assemble``).
Egos = Literal["recorded", "moving"]
#: Number of logs, or recorded episodes, that are replayed in one batch.
BATCH = 64


def count_egos(egos: Egos, most: int) -> int:
    """Return the number of egos per scenario: 1 for recorded egos, ``most`` for moving ones.

    Raises:
        UsageError: ``egos`` is moving, but scenarios have no further egos.
    """
    if egos == "moving" and most == 1:
        cure = "convert or generate the set with --egos 8"
        raise UsageError("egos is moving, but only the recorded ego of each scenario has a route", cure=cure)
    return 1 if egos == "recorded" else most


def check_learnable(actions: ActionSpace) -> None:
    """Raise UsageError for an action space whose actions are not in [-1, 1]."""
    if isinstance(actions, DirectState | Trajectory):
        problem = f"policies cannot learn in {kind_of(type(actions))}"
        raise UsageError(problem, cure="choose a space in [-1, 1]")


@record
class LoggedSteps(TrafficData):
    """The expert's steps in the scenarios of a bank."""

    steps: ExpertSteps


def with_expert_steps(environment: Environment, bank: ScenarioBank) -> ScenarioBank:
    """Return the bank with the expert's steps, which :meth:`Driving.expert_steps` then need not compute."""
    return with_data(bank, LoggedSteps(expert_steps(require_log(environment), bank)))


@dataclass(frozen=True)
class Driving:
    """A simulator whose episodes start in scenarios drawn with replacement.

    Attributes:
        simulator: Task, traffic and kind of start.
        latest_start, earliest_start: Episodes begin at a random step of the log between the two; those of
            :meth:`start`, between ``earliest_start`` and the third last step. They begin at step 10 if the ego is not
            valid at the drawn step, or if the third last step of its log is before ``earliest_start``.
        egos: Vehicle to drive: the recorded ego, or a uniformly drawn ego of the scenario. Rows of logged steps
            (:data:`~drivax.learning.experience.StepIndex`) are scenarios, or the rows of all egos in the bank.
    """

    simulator: Simulator
    latest_start: int = CURRENT_STEP
    earliest_start: int = CURRENT_STEP
    egos: Egos = "recorded"

    def __post_init__(self) -> None:
        if self.earliest_start < 0:
            raise UsageError(f"earliest_start is {self.earliest_start}", cure="use 0 or more")
        if self.latest_start < self.earliest_start:
            cure = f"use {self.earliest_start} (earliest_start) or more"
            raise UsageError(f"latest_start is {self.latest_start}", cure=cure)

    @property
    def task(self) -> Task:
        """The simulator's task.

        Raises:
            UsageError: It has no action space.
        """
        task = self.simulator.task
        if not isinstance(task, Task):
            raise UsageError(f"{type(task).__name__} has no action space", cure="use drivax.tasks.Task")
        return task

    @property
    def action_size(self) -> int:
        """Number of components of an action."""
        return self.task.actions.size

    @property
    def levels(self) -> tuple[tuple[float, ...], ...] | None:
        """Levels of a discrete action space, None of a continuous one."""
        actions = self.task.actions
        if not isinstance(actions, Discrete):
            return None
        # Networks read levels while they are traced.
        with jax.ensure_compile_time_eval():
            return tuple(tuple(float(level) for level in levels) for levels in actions.levels())

    @property
    def penalties(self) -> dict[str, float]:
        """Absolute values of the reward's negative weights, by term, except of weights that are conditions."""
        conditions = {condition.name for condition in self.task.conditions}
        penalties = self.task.rewards.penalties
        return {name: weight for name, weight in penalties.items() if name not in conditions}

    def prepare(self, data: ScenarioBank) -> ScenarioBank:
        """Return the bank with the data that the traffic model needs."""
        return prepare_bank(self.simulator.traffic, data)

    def shapes(self, data: ScenarioBank) -> dict[str, tuple[int, ...]]:
        """Return the shape of each group of one observation."""
        # Traffic and start change no shape; those of the log need no prepared bank.
        simulator = replace(self.simulator, traffic=LogTraffic(), start=LogStart())
        observation = jax.eval_shape(
            lambda bank: simulator.observe(bank, simulator.context(bank, 0, CURRENT_STEP)), data
        )
        return {name: tuple(value.shape) for name, value in observation.items()}

    def start(self, data: ScenarioBank, key: Array, count: int) -> Environments:
        """Reset environments to random steps of their logs, from ``earliest_start`` to the third last.

        Raises:
            UsageError: ``earliest_start`` or ``latest_start`` is too late.
        """
        last_step = data.steps - 3
        if self.earliest_start > last_step:
            raise UsageError(f"earliest_start is {self.earliest_start}", cure=f"use 0 to {last_step}")
        if self.latest_start > last_step:
            cure = f"use {self.earliest_start} (earliest_start) to {last_step}"
            raise UsageError(f"latest_start is {self.latest_start}", cure=cure)
        state, over = self._reset(data, key, count)
        return Environments(state, over, self.observe_all(data, state.context))

    def _reset(self, data: ScenarioBank, key: Array, count: int) -> tuple[SimState, Bool[Array, " B"]]:
        """Return states at random steps of their logs, none of them over."""
        start = self._draw(data, key, count, self.earliest_start)
        return jax.vmap(_bind_bank(self.simulator.reset, data))(*start), jnp.zeros(count, bool)

    def stored(self, state: SimState) -> AgentContext:
        """Return the context: index, step, history, and reactive traffic."""
        return state.context

    def observe_all(self, data: ScenarioBank, stored: AgentContext) -> dict[str, Array]:
        """Observe a batch of contexts."""
        return dict(map_over_devices(jax.vmap(self.simulator.observe, (None, 0)), data, stored))

    def cache(self, data: ScenarioBank, state: SimState) -> Frame:
        """Return the frame of all agents, which the current observation and the next step both need."""
        return jax.vmap(self.simulator.now, (None, 0))(data, state.context)

    def step(
        self, data: ScenarioBank, now: Environments, cache: Any, action: Float[Array, "B D"], drawn: Any
    ) -> tuple[Environments, Outcome]:
        """Hold a decision for ``Task.hold`` steps in every environment, or reset it where its episode is over.

        The rewards of these steps are summed. Steps after the end of an episode do not count.
        """
        return map_over_devices(self._step_all, data, (now, cache, action, drawn))

    def _step_all(
        self, data: ScenarioBank, batch: tuple[Environments, Any, Float[Array, "B D"], Any]
    ) -> tuple[Environments, Outcome]:
        """Return environments and outcomes after a decision, given where new episodes would start.

        ``Outcome.totals`` have an axis of devices (of size 1 on one device), so that devices exchange their sums only
        once, after the rollout.
        """
        now, cache, action, start = batch
        state, result = self._step_or_reset(data, now, cache, action, start)
        summed = (result.reward, result.reward_terms, result.terminated, result.truncated)

        def step_on(carry: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], None]:
            """Take another step of the decision of every episode that neither ended nor started."""
            state, last_step, (reward, terms, terminated, truncated) = carry
            idle = now.over | terminated | truncated
            state, result = self._step_on(data, state, action, idle)
            last_step = jnp.where(idle, last_step, state.context.step)
            step_rewards = jax.tree.map(
                lambda value: jnp.where(idle, 0.0, value), (result.reward, result.reward_terms)
            )
            reward, terms = jax.tree.map(jnp.add, (reward, terms), step_rewards)
            ends = (terminated | (result.terminated & ~idle), truncated | (result.truncated & ~idle))
            return (state, last_step, (reward, terms, *ends)), None

        carry = (state, state.context.step, summed)
        # Even a scan of length 0 is traced and compiled.
        if self.task.hold > 1:
            carry, _ = jax.lax.scan(step_on, carry, None, self.task.hold - 1)
        state, last_step, (reward, terms, terminated, truncated) = carry
        if data.reward_factors is not None:
            # A loss by a soft factor, TERM/FACTOR, belongs to its term.
            terms = {n: data.reward_factors[n.partition("/")[0]] * value for n, value in terms.items()}
            reward = sum(terms.values(), start=jnp.zeros_like(reward))
        ends = terminated | truncated
        # Metrics end with the episode, although vehicles of self-play drive on.
        episodes = replace(state, context=replace(state.context, step=last_step))
        totals = {n: total[None] for n, total in _totals(data, episodes, terms, ends, now.over).items()}
        outcome = Outcome(reward, terminated, truncated, self.cache(data, state), totals, terms)
        over = self._over(data, state, now.over, ends)
        return Environments(state, over, self.observe_all(data, state.context)), outcome

    def draw(self, data: ScenarioBank, key: Array, count: int) -> Any:
        """Draw the starts of new episodes, for ``count`` environments."""
        return self._draw(data, key, count, self.earliest_start, self.latest_start)

    def _step_or_reset(
        self, data: ScenarioBank, now: Environments, cache: Any, action: Float[Array, "B D"], start: Any
    ) -> Step:
        """Take the first step of a decision, or start a new episode where the last one is over."""
        step_all = jax.vmap(self.simulator.step_or_reset, (None, 0, 0, 0, 0, 0))
        fresh = map_where(now.over, _bind_bank(self.simulator.new_episode, data), *start)
        return step_all(data, now.state, action, now.over, fresh, cache)

    def _step_on(
        self, data: ScenarioBank, state: SimState, action: Float[Array, "B D"], idle: Bool[Array, " B"]
    ) -> Step:
        """Take another step of a decision, except where the environment is ``idle``."""
        after, result = jax.vmap(self.simulator.step, (None, 0, 0))(data, state, action)
        return keep(idle, state, after), result

    def _over(
        self, data: ScenarioBank, state: SimState, over: Bool[Array, " B"], ends: Bool[Array, " B"]
    ) -> Bool[Array, " B"]:
        """Mask of the episodes that are over after a step, given the masks of those over before it and ending in it."""
        return ends

    def demonstrations(self, data: ScenarioBank, key: Array, count: int) -> ExpertActions:
        """Return the expert's actions at random steps of the log.

        Steps lie between the current one and the third last, because an expert's action looks two steps ahead. They are
        observed as if the expert had driven there in the simulator: the last action is that of the expert, as executed.
        Steps are drawn uniformly from those at which the ego is valid and stays valid for two more steps; if an ego has
        no such step, step 10 is drawn.
        """

        def demonstrate(bank: ScenarioBank, *index: Any) -> tuple[dict[str, Array], Array, Array]:
            context = self._logged_context(bank, *index)
            return (dict(self._log_simulator.observe(bank, context)), *self._expert_action(bank, context))

        *index, _ = self._draw(data, key, count, CURRENT_STEP, has_action=True)
        return map_over_devices(
            lambda data, index: jax.vmap(_bind_bank(demonstrate, data))(*index), data, index
        )

    def observe_recorded(self, data: ScenarioBank, index: StepIndex) -> dict[str, Array]:
        """Observe logged steps as in :meth:`demonstrations`."""

        def observe(data: ScenarioBank, row: Array, step: Array) -> dict[str, Array]:
            scenario, slot = self._ego_of(data, row)
            return dict(self._log_simulator.observe(data, self._logged_context(data, scenario, step, slot)))

        return map_over_devices(lambda data, index: jax.vmap(partial(observe, data))(*index), data, index)

    def expert_steps(self, data: ScenarioBank) -> ExpertSteps:
        """Return the log as a rollout of the expert from the current step on, with the simulator's rewards and ends.

        All agents follow the log, because only then is the outcome of the expert's actions known. Those of
        :func:`with_expert_steps` are returned unchanged.
        """
        known = find_data(data, LoggedSteps)
        if known is not None:
            return known.steps
        egos = count_egos(self.egos, data.most_egos)
        rows = jnp.arange(len(data) * egos)
        rollouts = jax.lax.map(partial(self._rollout, data), rows, batch_size=min(len(rows), BATCH))
        # Zeros before the current step and at the last step, which has no successor.
        action, reward, terminated, truncated, clipped = (
            jnp.pad(values, ((0, 0), (CURRENT_STEP, 1), *((0, 0),) * (values.ndim - 2)))
            for values in rollouts
        )
        ends = terminated | truncated
        over = jnp.cumsum(ends, axis=1) > ends
        usable = _has_expert_action(data, egos) & ~over
        return ExpertSteps(action, reward, terminated, truncated, usable, clipped, self.task.hold, egos)

    @property
    def _log_simulator(self) -> Simulator:
        """Simulator of log traffic without metrics."""
        return Simulator(replace(self.task, metrics="none"))

    def _ego_of(self, bank: ScenarioBank, row: Array) -> tuple[Array, Any]:
        """Return scenario and slot of a row of logged steps; a row without an ego has the slot of the recorded ego."""
        if self.egos == "recorded":
            return row, 0
        return bank.scenario_of(row), jnp.maximum(bank.ego_slot(row), 0)

    def _draw(
        self,
        bank: ScenarioBank,
        key: Array,
        count: int,
        earliest: int,
        latest: int | None = None,
        has_action: bool = False,
    ) -> tuple[Int[Array, " B"], Int[Array, " B"], Any, Array]:
        """Draw scenarios, steps, slots of egos, and keys of episodes.

        Steps are at most the third last, and step 10 where the ego is not valid. With ``has_action``, a step without an
        expert action is drawn again from those with one, or is step 10 if there is none. The slot is None if all egos
        are the recorded ones.
        """
        index_key, step_key = jax.random.split(key)
        if bank.chances is None:
            index = jax.random.randint(index_key, (count,), 0, len(bank))
        else:
            index = draw_positions(bank.chances, index_key, (count,))
        slot, row = None, index * bank.most_egos
        if self.egos == "moving":
            ego_number = jax.random.randint(
                jax.random.fold_in(index_key, 1), (count,), 0, (bank.egos[index] >= 0).sum(axis=1)
            )
            slot, row = bank.egos[index, ego_number], row + ego_number
        last_step = bank.last_step[row] - 2
        last_step = last_step if latest is None else jnp.minimum(last_step, latest)
        step = jax.random.randint(step_key, (count,), earliest, jnp.maximum(last_step, earliest) + 1)
        # Egos are always valid at the current step.
        ego_slot, fallback_step = 0 if slot is None else slot, jnp.int32(CURRENT_STEP)
        if has_action:
            steps = jnp.arange(bank.steps)
            usable = _has_successors(bank.agents[index, :, ego_slot, AgentColumn.VALID] > 0)
            usable &= (earliest <= steps) & (steps <= last_step[:, None])
            rank = jax.random.randint(jax.random.fold_in(step_key, 2), (count,), 1, usable.sum(axis=1) + 1)
            drawn = jnp.argmax(jnp.cumsum(usable, axis=1) == rank[:, None], axis=1)
            fallback_step = jnp.where(usable.any(axis=1), drawn, fallback_step)
            is_usable = usable[jnp.arange(count), step]
        else:
            is_usable = (bank.agents[index, step, ego_slot, AgentColumn.VALID] > 0) & (step <= last_step)
        step = jnp.where(is_usable, step, fallback_step)
        # Logged starts without conditions do not use the keys.
        keys = jax.random.split(jax.random.fold_in(step_key, 1), count)
        return index, step, slot, keys

    def _logged_context(self, bank: ScenarioBank, index: Array, step: Array, slot: Any = 0) -> AgentContext:
        """Return the context of a logged step as if the expert had driven there."""
        context, before = (
            self._log_simulator.context(bank, index, t, slot) for t in (step, jnp.maximum(step - 1, 0))
        )
        action = expert_action(bank, before, self.task.actions)
        return replace(context, action=self.task.actuate(bank, before, action))

    def _expert_action(
        self, bank: ScenarioBank, context: AgentContext
    ) -> tuple[Float[Array, " D"], Bool[Array, ""]]:
        """Return the expert's action, clipped to bounds (and rates unless ``route``), and whether it exceeds bounds."""
        space = self.task.actions
        action = expert_action(bank, context, space)
        # In the space ``route``, the executed action is not in the space of the requested one.
        is_route = isinstance(space, Route)
        target = jnp.clip(action, -1.0, 1.0) if is_route else self.task.actuate(bank, context, action)
        return target, space.exceeds_bounds(action)

    def _rollout(self, bank: ScenarioBank, row: Int[Array, ""]) -> tuple[Array, ...]:
        """Return action, reward, terminated, truncated and clipped of the expert from the current step on."""
        simulator, (index, slot) = self._log_simulator, self._ego_of(bank, row)
        initial = simulator.reset(bank, index, slot=slot)
        initial = replace(initial, context=self._logged_context(bank, index, initial.start, slot))

        def step(state: SimState, _: None) -> tuple[SimState, tuple[Array, ...]]:
            action, clipped = self._expert_action(bank, state.context)
            after, result = simulator.replay(bank, state, logged_motion(bank, state.context, 1), action)
            return after, (action, result.reward, result.terminated, result.truncated, clipped)

        return jax.lax.scan(step, initial, None, bank.steps - 1 - CURRENT_STEP)[1]


def keep(mask: Bool[Array, " B"], old: Any, new: Any) -> Any:
    """Return a batch with the ``old`` elements where ``mask`` holds, else the ``new`` ones."""
    return jax.vmap(lambda mask, old, new: jax.tree.map(partial(jnp.where, mask), old, new))(mask, old, new)


def _bind_bank(function: Callable[..., Any], bank: ScenarioBank) -> Callable[..., Any]:
    """Return ``function`` with its first argument bound to the bank; a slot of None becomes 0."""

    def call(index: Array, step: Array, slot: Any, *rest: Array) -> Any:
        return function(bank, index, step, 0 if slot is None else slot, *rest)

    return call


def _has_expert_action(bank: ScenarioBank, egos: int) -> Bool[Array, "M T"]:
    """Mask of steps with an expert action, for the first ``egos`` egos of each scenario.

    These are steps from the current one on at which the ego is valid and stays valid for two more steps.
    """
    steps, slot = jnp.arange(bank.steps), bank.egos[:, :egos, None]
    valid = bank.agents[jnp.arange(len(bank))[:, None, None], steps, slot, AgentColumn.VALID] > 0
    last = bank.last_step.reshape(bank.egos.shape)[:, :egos, None]
    valid = (valid & (slot >= 0) & (steps <= last)).reshape(-1, bank.steps)
    return _has_successors(valid) & (steps >= CURRENT_STEP)


def _has_successors(valid: Bool[Array, "M T"]) -> Bool[Array, "M T"]:
    """Mask of valid steps that are followed by two valid steps."""
    return jnp.pad(valid[:, :-2] & valid[:, 1:-1] & valid[:, 2:], ((0, 0), (0, 2)))


def _totals(
    bank: ScenarioBank, state: SimState, terms: dict[str, Array], done: Array, over: Array
) -> dict[str, Array]:
    """Sum metrics of ending episodes, and reward terms of steps other than resets, over the batch."""
    logged = [name for name in state.episode.selection.names if name not in CODES]

    def episode_sums() -> dict[str, Array]:
        values = jax.vmap(episode_metrics, (None, 0))(bank, state)
        sums = {}
        for name in logged:
            defined = done & values[name].defined
            sums[name] = jnp.sum(jnp.where(defined, values[name].value, 0.0))
            sums[f"{name}/n"] = defined.sum().astype(jnp.float32)
        return sums

    # Most steps end no episode; a single condition lets the program skip the branch.
    zeros = {name: jnp.zeros(()) for metric in logged for name in (metric, f"{metric}/n")}
    totals: dict[str, Any] = jax.lax.cond(any_across_learners(done), episode_sums, lambda: zeros)
    rewards = {f"reward/{name}": jnp.sum(jnp.where(over, 0.0, term)) for name, term in terms.items()}
    return totals | rewards
