"""The simulator: reset and step as pure functions of a bank, a state and an action."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.contact import Contact
from drivax.simulator.lights import forget_crossings, remember_lights
from drivax.simulator.situation import forget_strand, measure, surroundings
from drivax.simulator.starts import LogStart, Start
from drivax.simulator.traffic.log import LogTraffic, alone, frame_of
from drivax.simulator.types import (
    Action,
    AgentContext,
    EpisodeStart,
    Frame,
    Motion,
    SimState,
    Situation,
    Task,
    Traffic,
    Transition,
)

#: Elements that :func:`map_where` computes at a time: in most steps fewer episodes start, and vectors are filled.
AT_ONCE = 8
#: The next state, and the step to it.
Step = tuple[SimState, Transition]


@dataclass(frozen=True)
class Simulator:
    """Simulate a task with a traffic model and a start; holds configuration only.

    Functions are unbatched: ``jax.vmap(simulator.step, in_axes=(None, 0, 0))`` steps a batch. ``step`` never resets;
    :meth:`step_or_reset` is for collectors.
    """

    task: Task
    traffic: Traffic = field(default_factory=LogTraffic)
    start: Start = field(default_factory=LogStart)

    def reset(
        self, bank: ScenarioBank, index: Any, step: Any = CURRENT_STEP, slot: Any = 0, key: Any = None
    ) -> SimState:
        """Return the state of agent ``slot`` at ``step`` of scenario ``index``; ``key`` draws start and conditions."""
        context = self.context(bank, index, step, slot, key)
        return self._initial_state(bank, context, alone(context))

    def _initial_state(self, bank: ScenarioBank, context: AgentContext, driven: AgentContext) -> SimState:
        """Return the first state of an episode."""
        now = self.frame(bank, context, driven, 0)
        # Overlaps at the start are ignored until they separate, as if all agents had just appeared. No fault is
        # classified, so no previous frame is needed.
        contacts = jnp.full(now.valid.shape, int(Contact.ABSENT), jnp.int8)
        lights = remember_lights(bank, context)
        situation, contacts, lights = measure(bank, context, now, now, contacts, lights, self.task.reads)
        episode, step = self.task.episode_start(), situation.context.step
        return SimState(situation.context, situation.facts, contacts, forget_crossings(lights), episode, step)

    def context(
        self, bank: ScenarioBank, index: Any, step: Any = CURRENT_STEP, slot: Any = 0, key: Any = None
    ) -> AgentContext:
        """Return the context at a step: logged, or drawn by ``start``; ``key`` also draws the task's conditions."""
        index, step, slot = (jnp.asarray(value, jnp.int32) for value in (index, step, slot))
        history, route_m = LogStart().begin(bank, index, step, slot)
        action = self.task.first_action(history, bank.length_m(index, slot))
        z, traffic = bank.agents[index, step, slot, AgentColumn.Z], self.traffic.start(bank, index, step)
        route = bank.row_of(index, slot) if bank.most_egos > 1 else None
        conditions = self.task.draw_conditions(slot, key)
        context = AgentContext(index, step, slot, history, action, route_m, z, traffic, route, conditions)
        if isinstance(self.start, LogStart):
            return context
        # Other starts avoid the agents around, whose rows the traffic model gives for the logged context.
        agents = self.traffic.agents(bank, context, 0)
        history, route_m = self.start.begin(bank, index, step, slot, agents, key)
        action = self.task.first_action(history, bank.length_m(index, slot))
        return replace(context, history=history, route_m=route_m, action=action)

    def new_episode(
        self, bank: ScenarioBank, index: Any, step: Any = CURRENT_STEP, slot: Any = 0, key: Any = None
    ) -> EpisodeStart:
        """Return the :meth:`context` of a new episode and its stop-line memory."""
        context = self.context(bank, index, step, slot, key)
        return EpisodeStart(context, remember_lights(bank, context))

    def frame(
        self, bank: ScenarioBank, context: AgentContext, driven: AgentContext, back: int,
        slots: Int[Array, " S"] | None = None,
    ) -> Frame:  # fmt: skip
        """Return all agents ``back`` steps ago, with the driven agents ``driven [K]`` at their simulated poses.

        ``slots`` selects agents.
        """
        agents = self.traffic.agents(bank, context, back)
        return frame_of(bank, context.index, context.step, agents, driven, back, slots)

    def now(self, bank: ScenarioBank, context: AgentContext) -> Frame:
        """Return all agents now, around one driven agent."""
        return self.frame(bank, context, alone(context), 0)

    def step(self, bank: ScenarioBank, state: SimState, action: Action) -> Step:
        """Drive one step of 0.1 s with an action of the task's action space."""
        return self._drive(bank, state, action, None)

    def replay(self, bank: ScenarioBank, state: SimState, motion: Motion, action: Action) -> Step:
        """Move the agent to ``motion`` without dynamics (exact expert); ``action`` is only recorded."""
        return self._drive(bank, state, action, motion)

    def reset_together(
        self, bank: ScenarioBank, index: Any, slots: Int[Array, " K"], step: Any = CURRENT_STEP,
        keys: Any = None,
    ) -> SimState:  # fmt: skip
        """Return the stacked states of K agents of one scenario, at slots from :func:`slots_of`.

        All start as logged: a noisy start supports a single driven agent.
        """
        contexts = jax.vmap(partial(self.context, bank, index, step))(slots, keys)
        return jax.vmap(lambda context: self._initial_state(bank, context, contexts))(contexts)

    def step_together(
        self, bank: ScenarioBank, states: SimState, actions: Float[Array, "K D"], over: Any = None,
        fresh: EpisodeStart | None = None,
    ) -> Step:  # fmt: skip
        """Drive K agents of one scenario; they see each other, and traffic sees them.

        Slots beyond the moving agents are padding: never rewarded or terminated, with undefined facts. ``over`` is the
        ``[K]`` mask of agents whose episode has ended: they drive on without reward and metrics. Given ``fresh``, the
        stacked :meth:`new_episode` of K agents, all start these once all are over; see :meth:`step_or_reset`.
        """
        over = jnp.zeros(actions.shape[0], bool) if over is None else over
        first = _first(states.context)
        seen = self.frame(bank, first, states.context, 0)
        traffic = self.traffic.advance(bank, first, seen)
        moved = jax.vmap(lambda s, a: self._move_agent(bank, s.context, a, None, traffic))(states, actions)
        if fresh is not None:
            moved = jax.tree.map(partial(jnp.where, over.all()), fresh.context, moved)
            states = jax.vmap(_forget, (0, 0, None))(states, fresh, over.all())
        finish = jax.vmap(lambda s, m, a: self._finish_step(bank, s, m, moved, seen, a))
        after, transition = finish(states, moved, actions)
        counts = is_driven(bank, after) & ~over
        choose = jax.vmap(lambda c, new, old: jax.tree.map(partial(jnp.where, c), new, old))
        after = replace(after, episode=choose(counts, after.episode, states.episode))
        if fresh is not None:
            after = jax.vmap(self._restart, (0, None))(after, over.all())
        terms = {name: jnp.where(counts, term, 0.0) for name, term in transition.reward_terms.items()}
        ends = {name: getattr(transition, name) & counts for name in ("terminated", "truncated")}
        reward = jnp.where(counts, transition.reward, 0.0)
        return after, replace(transition, after=after, reward=reward, reward_terms=terms, **ends)

    def observe_together(self, bank: ScenarioBank, states: SimState) -> Mapping[str, Any]:
        """Return the stacked observations of K agents of one scenario."""
        return jax.vmap(lambda context: self.observe(bank, context, states.context))(states.context)

    def situation(self, bank: ScenarioBank, state: SimState, driven: AgentContext | None = None) -> Situation:
        """Return the facts and surroundings of a state, for planners; ``driven`` defaults to the agent alone."""
        driven = alone(state.context) if driven is None else driven
        around = surroundings(bank, state.context, self.frame(bank, state.context, driven, 0))
        return Situation(state.context, state.facts, around)

    def observe(
        self, bank: ScenarioBank, context: AgentContext, driven: AgentContext | None = None
    ) -> Mapping[str, Any]:
        """Return the task's observation of a context, live or from a replay buffer.

        ``driven`` stacks the contexts of all driven agents; it defaults to the agent alone.
        """
        driven = alone(context) if driven is None else driven
        frames = partial(self.frame, bank, _first(driven), driven)
        return self.task.observe(bank, context, frames, frames(0))

    def step_or_reset(
        self, bank: ScenarioBank, state: SimState, action: Action, over: Bool[Array, ""],
        fresh: EpisodeStart, seen: Frame | None = None,
    ) -> Step:  # fmt: skip
        """Step, or start a new episode where the current one is ``over``.

        For collectors: the end of an episode costs one call that only resets, with a meaningless transition to mask. In
        exchange nothing is measured or observed twice, and a policy sees every state, final ones included, once.
        ``fresh`` (:meth:`new_episode`) is read only where ``over``, so :func:`map_where` need not compute the others.
        ``seen`` is ``now(bank, state.context)``, if already computed.
        """
        seen = self.now(bank, state.context) if seen is None else seen
        traffic = self.traffic.advance(bank, state.context, seen)
        moved = self._move_agent(bank, state.context, action, None, traffic)
        context = jax.tree.map(partial(jnp.where, over), fresh.context, moved)
        before = _forget(state, fresh, over)
        after, transition = self._finish_step(bank, before, context, alone(context), seen, action)
        after = self._restart(after, over)
        flags = {name: getattr(transition, name) & ~over for name in ("terminated", "truncated")}
        return after, replace(transition, after=after, **flags)

    def _restart(self, after: SimState, over: Bool[Array, ""]) -> SimState:
        """Return the state after a step, as the first of a new episode where the last one is ``over``."""
        first = self.task.episode_start()
        episode = jax.tree.map(partial(jnp.where, over), first, after.episode)
        lights = jax.tree.map(partial(jnp.where, over), forget_crossings(after.lights), after.lights)
        return replace(after, episode=episode, lights=lights)

    def _drive(self, bank: ScenarioBank, state: SimState, action: Array, motion: Array | None) -> Step:
        """Drive one step by ``action``, or to ``motion`` if that is given."""
        seen = self.now(bank, state.context)
        traffic = self.traffic.advance(bank, state.context, seen)
        moved = self._move_agent(bank, state.context, action, motion, traffic)
        return self._finish_step(bank, state, moved, alone(moved), seen, action)

    def _move_agent(
        self, bank: ScenarioBank, context: AgentContext, action: Array, motion: Array | None, traffic: Any
    ) -> AgentContext:
        """Move the driven agent one step, given traffic that has already moved."""
        if motion is None:
            action = self.task.actuate(bank, context, action)
            length_m = bank.length_m(context.index, context.slot)
            motion = self.task.motion(context.history[-1], action, length_m)
        history = jnp.concatenate([context.history[1:], motion[None]])
        return replace(context, step=context.step + 1, history=history, action=action, traffic=traffic)

    def _finish_step(
        self, bank: ScenarioBank, before: SimState, moved: AgentContext, driven: AgentContext, seen: Frame,
        action: Array,
    ) -> Step:  # fmt: skip
        """Measure an agent after all agents have moved, and build the transition.

        ``driven`` stacks the contexts of all driven agents; ``seen`` is the frame before the step.
        """
        now = self.frame(bank, _first(driven), driven, 0)
        situation, contacts, lights = measure(
            bank, moved, now, seen, before.contacts, before.lights, self.task.reads, before.facts.strand
        )
        terminated, truncated = self.task.check_end(bank, situation.context, situation.facts)
        terms = self.task.reward(before.facts, situation.facts, situation.surroundings, moved.conditions)
        final = terminated | truncated | (moved.step >= bank.last_step[moved.row])
        episode = self.task.episode_add(before.episode, situation, before.start, final)
        after = SimState(situation.context, situation.facts, contacts, lights, episode, before.start)
        reward = sum(terms.values(), start=jnp.zeros(()))
        return after, Transition(before, after, action, reward, terms, terminated, truncated)


def _first(driven: AgentContext) -> AgentContext:
    """Return the context of the first driven agent, whose frame is that of all: computed once where they are mapped."""
    return jax.tree.map(lambda leaf: leaf[0], driven)


def _forget(state: SimState, fresh: EpisodeStart, over: Bool[Array, ""]) -> SimState:
    """Return the state before a step, without what may not reach the episode that starts where it is ``over``."""
    return replace(
        state,
        facts=forget_strand(state.facts, over),
        contacts=jnp.where(over, jnp.int8(Contact.ABSENT), state.contacts),
        lights=jax.tree.map(partial(jnp.where, over), fresh.lights, state.lights),
        start=jnp.where(over, fresh.context.step, state.start),
    )


def slots_of(
    bank: ScenarioBank, index: Any, mask: Bool[Array, " A"], count: int, step: Any = CURRENT_STEP
) -> Int[Array, " K"]:
    """Return ``count`` slots of the moving agents of a mask that the log has at ``step``.

    Missing ones are padded with A (an empty slot); further agents are left to traffic.
    """
    present = mask & (bank.agents[index, step, :, AgentColumn.VALID] > 0)
    return jnp.nonzero(present, size=count, fill_value=mask.shape[0])[0].astype(jnp.int32)


def is_driven(bank: ScenarioBank, states: SimState) -> Bool[Array, " K"]:
    """Mask of the states that belong to an agent; the others are padding."""
    return states.context.slot < bank.agents.shape[2]


def map_where(requested: Bool[Array, " B"], function: Callable[..., Any], *arguments: Any) -> Any:
    """``jax.vmap(function)`` where ``requested``, zeros elsewhere; cost grows with the number requested.

    ``function`` maps one element of each argument (pytrees of arrays ``[B, ...]``) to a pytree of arrays. A loop
    computes 8 elements at a time; it has no reverse-mode derivative.
    """
    count, batched = requested.shape[0], jax.vmap(function)
    chunk = min(AT_ONCE, count)
    element = jax.eval_shape(function, *jax.tree.map(lambda leaf: leaf[0], arguments))
    zeros = jax.tree.map(lambda leaf: jnp.zeros((count, *leaf.shape), leaf.dtype), element)
    # The first requested element ranks highest; top_k of floats is the cheapest way to find a few of them.
    rank = jnp.arange(count, 0, -1).astype(jnp.float32)

    def compute(carry: tuple[Array, Any]) -> tuple[Array, Any]:
        """Compute the next elements; those that fill up the last chunk have index ``count``, which is dropped."""
        remaining, results = carry
        top_rank, index = jax.lax.top_k(jnp.where(remaining, rank, 0.0), chunk)
        index = jnp.where(top_rank > 0.0, index, count)
        values = batched(*jax.tree.map(lambda leaf: leaf.at[index].get(mode="clip"), arguments))
        results = jax.tree.map(lambda total, value: total.at[index].set(value, mode="drop"), results, values)
        return remaining.at[index].set(False, mode="drop"), results

    return jax.lax.while_loop(lambda carry: carry[0].any(), compute, (requested, zeros))[1]
