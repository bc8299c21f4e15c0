"""The simulator: reset and step as pure functions of a bank, a state and an action."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax import kernels
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.contact import Contact
from drivax.simulator.lights import forget_crossings, remember_lights
from drivax.simulator.situation import PASSAGES, entry_strand, measure, replace_strand, surroundings
from drivax.simulator.starts import LogStart, Start
from drivax.simulator.traffic.log import LogTraffic, alone, frame_of, present_frame
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

#: Elements that :func:`map_where` computes at a time: more episodes rarely start in a step; 8 floats fill a vector.
AT_ONCE = 8
#: The next state, and the transition to it.
Step = tuple[SimState, Transition]


@dataclass(frozen=True)
class Simulator:
    """Simulator of a task with a traffic model and a start; it holds configuration only.

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
        """Return the initial state of an episode."""
        frame = self.frame(bank, context, driven, 0)
        # Overlaps at the start are ignored until they separate, as if all agents had just appeared. No fault is
        # classified, so no previous frame is needed.
        contacts = jnp.full(frame.valid.shape, int(Contact.ABSENT), jnp.int8)
        lights = remember_lights(bank, context)
        situation, contacts, lights = measure(bank, context, frame, frame, contacts, lights, self.task.reads)
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
        # Other starts avoid the agents around ego; the traffic model returns their rows for the logged context.
        agents = self.traffic.agents(bank, context, 0)
        history, route_m = self.start.begin(bank, index, step, slot, agents, key)
        action = self.task.first_action(history, bank.length_m(index, slot))
        return replace(context, history=history, route_m=route_m, action=action)

    def new_episode(
        self, bank: ScenarioBank, index: Any, step: Any = CURRENT_STEP, slot: Any = 0, key: Any = None
    ) -> EpisodeStart:
        """Return the :meth:`context` of a new episode, with the stop-line memory and strand before its first step."""
        context = self.context(bank, index, step, slot, key)
        strand = entry_strand(bank, context) if self.task.reads & PASSAGES else None
        return EpisodeStart(context, remember_lights(bank, context), strand)

    def frame(
        self, bank: ScenarioBank, context: AgentContext, driven: AgentContext, back: int,
        slots: Int[Array, " S"] | None = None,
    ) -> Frame:  # fmt: skip
        """Return the frame ``back`` steps ago, with the driven agents ``driven [K]`` at their simulated poses.

        ``slots`` selects agents; the default is all.
        """
        is_present = back == 0 and slots is None and driven.slot.shape[0] == 1
        if is_present and type(self.traffic) is LogTraffic and kernels.in_use():
            reference = partial(self.frame, back=0)
            return kernels.with_reference(present_frame, reference)(bank, context, driven)
        agents = self.traffic.agents(bank, context, back)
        return frame_of(bank, context.index, context.step, agents, driven, back, slots)

    def now(self, bank: ScenarioBank, context: AgentContext) -> Frame:
        """Return the present frame with a single driven agent."""
        return self.frame(bank, context, alone(context), 0)

    def step(self, bank: ScenarioBank, state: SimState, action: Action) -> Step:
        """Drive one step of 0.1 s with an action of the task's action space."""
        return self._drive(bank, state, action, None)

    def replay(self, bank: ScenarioBank, state: SimState, motion: Motion, action: Action) -> Step:
        """Move the agent to ``motion`` without dynamics (exact expert); the transition records ``action``."""
        return self._drive(bank, state, action, motion)

    def reset_together(
        self, bank: ScenarioBank, index: Any, slots: Int[Array, " K"], step: Any = CURRENT_STEP,
        keys: Any = None,
    ) -> SimState:  # fmt: skip
        """Return the stacked states of K agents of one scenario, at slots from :func:`slots_of`.

        ``start`` must be :class:`LogStart`: a noisy start does not avoid the other driven agents.
        """
        contexts = jax.vmap(partial(self.context, bank, index, step))(slots, keys)
        return jax.vmap(lambda context: self._initial_state(bank, context, contexts))(contexts)

    def step_together(
        self, bank: ScenarioBank, states: SimState, actions: Float[Array, "K D"], done: Any = None,
        starts: EpisodeStart | None = None,
    ) -> Step:  # fmt: skip
        """Drive K agents of one scenario; they see each other, and traffic sees them.

        Slots beyond the moving agents are padding: never rewarded or terminated, with undefined facts. ``done`` is the
        ``[K]`` mask of agents whose episode has ended: they drive on without reward and metrics. Once it is true for
        all, padding included, all begin the episodes ``starts``, if given (stacked :meth:`new_episode` of K agents);
        see :meth:`step_or_reset`.
        """
        done = jnp.zeros(actions.shape[0], bool) if done is None else done
        first = _first(states.context)
        frame = self.frame(bank, first, states.context, 0)
        traffic = self.traffic.advance(bank, first, frame)
        contexts = jax.vmap(lambda s, a: self._move_agent(bank, s.context, a, None, traffic))(states, actions)
        if starts is not None:
            contexts = jax.tree.map(partial(jnp.where, done.all()), starts.context, contexts)
            states = jax.vmap(_clear_memory, (0, 0, None))(states, starts, done.all())
        finish = jax.vmap(lambda s, c, a: self._finish_step(bank, s, c, contexts, frame, a))
        after, transition = finish(states, contexts, actions)
        is_active = is_driven(bank, after) & ~done
        select = jax.vmap(lambda c, new, old: jax.tree.map(partial(jnp.where, c), new, old))
        after = replace(after, episode=select(is_active, after.episode, states.episode))
        if starts is not None:
            after = jax.vmap(self._start_metrics, (0, None))(after, done.all())
        terms = {name: jnp.where(is_active, term, 0.0) for name, term in transition.reward_terms.items()}
        flags = {name: getattr(transition, name) & is_active for name in ("terminated", "truncated")}
        reward = jnp.where(is_active, transition.reward, 0.0)
        return after, replace(transition, after=after, reward=reward, reward_terms=terms, **flags)

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
        self, bank: ScenarioBank, state: SimState, action: Action, done: Bool[Array, ""],
        start: EpisodeStart, frame: Frame | None = None,
    ) -> Step:  # fmt: skip
        """Step, or begin the episode ``start`` where the current one is ``done``.

        For collectors: the end of an episode costs one call that only resets, with a meaningless transition to mask. In
        exchange nothing is measured or observed twice, and a policy sees every state, final ones included, once.
        ``start`` (:meth:`new_episode`) is read only where ``done``; :func:`map_where` computes it only there.
        ``frame`` is ``now(bank, state.context)``, if already computed.
        """
        frame = self.now(bank, state.context) if frame is None else frame
        traffic = self.traffic.advance(bank, state.context, frame)
        context = self._move_agent(bank, state.context, action, None, traffic)
        context = jax.tree.map(partial(jnp.where, done), start.context, context)
        before = _clear_memory(state, start, done)
        after, transition = self._finish_step(bank, before, context, alone(context), frame, action)
        after = self._start_metrics(after, done)
        flags = {name: getattr(transition, name) & ~done for name in ("terminated", "truncated")}
        return after, replace(transition, after=after, **flags)

    def _start_metrics(self, after: SimState, done: Bool[Array, ""]) -> SimState:
        """Clear the metrics and the crossed stop lines where the previous episode is ``done``."""
        empty_episode = self.task.episode_start()
        episode = jax.tree.map(partial(jnp.where, done), empty_episode, after.episode)
        lights = jax.tree.map(partial(jnp.where, done), forget_crossings(after.lights), after.lights)
        return replace(after, episode=episode, lights=lights)

    def _drive(self, bank: ScenarioBank, state: SimState, action: Array, motion: Array | None) -> Step:
        """Drive one step by ``action``, or to ``motion`` unless it is None."""
        frame = self.now(bank, state.context)
        traffic = self.traffic.advance(bank, state.context, frame)
        context = self._move_agent(bank, state.context, action, motion, traffic)
        return self._finish_step(bank, state, context, alone(context), frame, action)

    def _move_agent(
        self, bank: ScenarioBank, context: AgentContext, action: Array, motion: Array | None, traffic: Any
    ) -> AgentContext:
        """Return the context of the driven agent one step later; ``traffic`` is the traffic state of that step."""
        if motion is None:
            action = self.task.actuate(bank, context, action)
            length_m = bank.length_m(context.index, context.slot)
            motion = self.task.motion(context.history[-1], action, length_m)
        history = jnp.concatenate([context.history[1:], motion[None]])
        return replace(context, step=context.step + 1, history=history, action=action, traffic=traffic)

    def _finish_step(
        self, bank: ScenarioBank, before: SimState, context: AgentContext, driven: AgentContext,
        previous: Frame, action: Array,
    ) -> Step:  # fmt: skip
        """Measure an agent after all agents have moved, and build the transition.

        ``context`` is the agent's after the step; ``driven`` stacks those of all driven agents; ``previous`` is the
        frame before the step.
        """
        frame = self.frame(bank, _first(driven), driven, 0)
        situation, contacts, lights = measure(
            bank,
            context,
            frame,
            previous,
            before.contacts,
            before.lights,
            self.task.reads,
            before.facts.strand,
        )
        terminated, truncated = self.task.check_end(bank, situation.context, situation.facts)
        terms = self.task.reward(before.facts, situation.facts, situation.surroundings, context.conditions)
        final = terminated | truncated | (context.step >= bank.last_step[context.row])
        episode = self.task.episode_add(before.episode, situation, before.start, final)
        after = SimState(situation.context, situation.facts, contacts, lights, episode, before.start)
        reward = sum(terms.values(), start=jnp.zeros(()))
        return after, Transition(before, after, action, reward, terms, terminated, truncated)


def _first(driven: AgentContext) -> AgentContext:
    """Return the context of the first driven agent.

    The frame is the same for all of them: if it depends on the first only, ``vmap`` over agents computes it once.
    """
    return jax.tree.map(lambda leaf: leaf[0], driven)


def _clear_memory(state: SimState, start: EpisodeStart, done: Bool[Array, ""]) -> SimState:
    """Replace the memory of an episode that is ``done`` by that of the next, which begins at ``start``."""
    return replace(
        state,
        facts=replace_strand(state.facts, done, start.strand),
        contacts=jnp.where(done, jnp.int8(Contact.ABSENT), state.contacts),
        lights=jax.tree.map(partial(jnp.where, done), start.lights, state.lights),
        start=jnp.where(done, start.context.step, state.start),
    )


def slots_of(
    bank: ScenarioBank, index: Any, mask: Bool[Array, " A"], count: int, step: Any = CURRENT_STEP
) -> Int[Array, " K"]:
    """Return the slots of the first ``count`` moving agents in a mask that the log has at ``step``.

    If there are fewer, the result is padded with A, the slot of no moving agent.
    """
    present = mask & (bank.agents[index, step, :, AgentColumn.VALID] > 0)
    return jnp.nonzero(present, size=count, fill_value=mask.shape[0])[0].astype(jnp.int32)


def is_driven(bank: ScenarioBank, states: SimState) -> Bool[Array, " K"]:
    """Mask of the states that belong to an agent; the others are padding."""
    return states.context.slot < bank.agents.shape[2]


def map_where(mask: Bool[Array, " B"], function: Callable[..., Any], *arguments: Any) -> Any:
    """Apply ``jax.vmap(function)`` where ``mask`` is true; results elsewhere are zero.

    ``function`` maps one element of each argument (pytrees of arrays ``[B, ...]``) to a pytree of arrays. The cost
    grows with the number of true elements: a loop computes 8 at a time. It has no reverse-mode derivative.
    """
    count, batched = mask.shape[0], jax.vmap(function)
    chunk = min(AT_ONCE, count)
    element = jax.eval_shape(function, *jax.tree.map(lambda leaf: leaf[0], arguments))
    zeros = jax.tree.map(lambda leaf: jnp.zeros((count, *leaf.shape), leaf.dtype), element)
    # The first element ranks highest; top_k of floats is the cheapest way to find the first few.
    rank = jnp.arange(count, 0, -1).astype(jnp.float32)

    def compute(carry: tuple[Array, Any]) -> tuple[Array, Any]:
        """Compute the next chunk; the index ``count`` pads the last one, and its results are dropped."""
        remaining, results = carry
        top_rank, index = jax.lax.top_k(jnp.where(remaining, rank, 0.0), chunk)
        index = jnp.where(top_rank > 0.0, index, count)
        values = batched(*jax.tree.map(lambda leaf: leaf.at[index].get(mode="clip"), arguments))
        results = jax.tree.map(lambda total, value: total.at[index].set(value, mode="drop"), results, values)
        return remaining.at[index].set(False, mode="drop"), results

    return jax.lax.while_loop(lambda carry: carry[0].any(), compute, (mask, zeros))[1]
