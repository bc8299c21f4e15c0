"""The simulator: reset and step as pure functions of a bank, a state and an action."""

from __future__ import annotations

from collections.abc import Mapping
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
from drivax.simulator.lights import nothing_crossed, remember_lights
from drivax.simulator.situation import forget_strand, measure, surroundings
from drivax.simulator.starts import LogStart, Start
from drivax.simulator.together import is_driven
from drivax.simulator.traffic.log import LogTraffic, alone, frame_of
from drivax.simulator.types import (
    AgentContext,
    Beginning,
    Frame,
    SimState,
    Situation,
    Task,
    Traffic,
    Transition,
)


@dataclass(frozen=True)
class Simulator:
    """A task in a kind of traffic, with a kind of start. Holds configuration only; the rest is argument or result.

    Functions are unbatched; ``jax.vmap(simulator.step, in_axes=(None, 0, 0))`` steps a batch. ``step`` never resets;
    :meth:`step_or_begin` is for collectors.
    """

    task: Task
    traffic: Traffic = field(default_factory=LogTraffic)
    start: Start = field(default_factory=LogStart)

    def reset(
        self, bank: ScenarioBank, index: Any, step: Any = CURRENT_STEP, slot: Any = 0, key: Any = None
    ) -> SimState:
        """The state of agent ``slot`` at ``step`` of scenario ``index``; ``key`` draws a start other than the log's."""
        context = self.context(bank, index, step, slot, key)
        return self._begin(bank, context, alone(context))

    def _begin(self, bank: ScenarioBank, context: AgentContext, cast: AgentContext) -> SimState:
        """The state in which an episode begins at a context."""
        now = self.frame(bank, context, cast, 0)
        # Overlaps at the start are ignored until they part, as if all agents had just appeared; so no fault is
        # evaluated, for which alone a frame before this one would be needed.
        contacts = jnp.full(now.valid.shape, int(Contact.ABSENT), jnp.int8)
        lights = remember_lights(bank, context)
        found, contacts, lights = measure(bank, context, now, now, contacts, lights, self.task.reads)
        episode, step = self.task.episode_start(), found.context.step
        return SimState(found.context, found.facts, contacts, nothing_crossed(lights), episode, step)

    def context(
        self, bank: ScenarioBank, index: Any, step: Any = CURRENT_STEP, slot: Any = 0, key: Any = None
    ) -> AgentContext:
        """Return what an episode or a sample starts from; logged unless ``start`` says otherwise."""
        index, step, slot = (jnp.asarray(value, jnp.int32) for value in (index, step, slot))
        history, route_m = LogStart().begin(bank, index, step, slot)
        context = AgentContext(
            index=index,
            step=step,
            slot=slot,
            history=history,
            action=self.task.first_action(history, bank.length_m(index, slot)),
            route_m=route_m,
            z=bank.agents[index, step, slot, AgentColumn.Z],
            traffic=self.traffic.start(bank, index, step),
        )
        if isinstance(self.start, LogStart):
            return context
        agents = self.traffic.agents(bank, context, 0)
        history, route_m = self.start.begin(bank, index, step, slot, agents, key)
        action = self.task.first_action(history, bank.length_m(index, slot))
        return replace(context, history=history, route_m=route_m, action=action)

    def beginning(
        self, bank: ScenarioBank, index: Any, step: Any = CURRENT_STEP, slot: Any = 0, key: Any = None
    ) -> Beginning:
        """The :meth:`context` of an episode that begins, and what its motion so far implies about stop lines."""
        context = self.context(bank, index, step, slot, key)
        return Beginning(context, remember_lights(bank, context))

    def frame(self, bank: ScenarioBank, context: AgentContext, cast: AgentContext, back: int) -> Frame:
        """All agents ``back`` steps ago, the driven agents of ``cast [K]`` in their place."""
        return frame_of(
            bank, context.index, context.step, self.traffic.agents(bank, context, back), cast, back
        )

    def now(self, bank: ScenarioBank, context: AgentContext) -> Frame:
        """All agents now, around one driven agent."""
        return self.frame(bank, context, alone(context), 0)

    def step(
        self, bank: ScenarioBank, state: SimState, action: Float[Array, " D"]
    ) -> tuple[SimState, Transition]:
        """Drives one step of 0.1 s with an action of the task's action space."""
        return self._drive(bank, state, action, None)

    def replay(
        self, bank: ScenarioBank, state: SimState, motion: Float[Array, " 4"], action: Float[Array, " D"]
    ) -> tuple[SimState, Transition]:
        """Puts the agent at ``motion`` one step later, without dynamics (the exact expert); ``action`` is recorded."""
        return self._drive(bank, state, action, motion)

    def reset_together(
        self, bank: ScenarioBank, index: Any, slots: Int[Array, " K"], step: Any = CURRENT_STEP
    ) -> SimState:
        """The stack of the states of several agents of one scenario (``simulator.together.slots_of`` chooses them).

        They begin as logged: a noisy start knows of one driven agent only.
        """
        contexts = jax.vmap(lambda slot: self.context(bank, index, step, slot))(slots)
        return jax.vmap(lambda context: self._begin(bank, context, contexts))(contexts)

    def step_together(
        self, bank: ScenarioBank, states: SimState, actions: Float[Array, "K D"], over: Any = None
    ) -> tuple[SimState, Transition]:
        """Drives K agents of one scenario at once; they see each other, and traffic sees them.

        Args:
            bank: The scenarios.
            states: The stack of their states. One whose slot is beyond the moving agents fills up the stack: it is on
                no road, and is never rewarded nor over; its facts mean nothing.
            actions: An action each.
            over: ``[K]`` whose episode has ended at an earlier step: they drive on by their actions, and are neither
                rewarded nor evaluated any more. None by default, which is right for tasks that drive to the end.
        """
        first = jax.tree.map(lambda leaf: leaf[0], states.context)
        seen = self.frame(bank, first, states.context, 0)
        traffic = self.traffic.advance(bank, first, seen)
        moved = jax.vmap(lambda s, a: self._drive_on(bank, s.context, a, None, traffic))(states, actions)
        after, done = jax.vmap(lambda s, m, a: self._settle(bank, s, m, moved, seen, a))(
            states, moved, actions
        )
        counts = is_driven(bank, states) & (True if over is None else ~over)
        choose = jax.vmap(lambda c, new, old: jax.tree.map(partial(jnp.where, c), new, old))
        after = replace(after, episode=choose(counts, after.episode, states.episode))
        terms = {name: jnp.where(counts, term, 0.0) for name, term in done.reward_terms.items()}
        ends = {name: getattr(done, name) & counts for name in ("terminated", "truncated")}
        reward = jnp.where(counts, done.reward, 0.0)
        return after, replace(done, after=after, reward=reward, reward_terms=terms, **ends)

    def observe_together(self, bank: ScenarioBank, states: SimState) -> Mapping[str, Any]:
        """The observation of each of K agents of one scenario, stacked."""
        return jax.vmap(lambda context: self.observe(bank, context, states.context))(states.context)

    def situation(self, bank: ScenarioBank, state: SimState, cast: AgentContext | None = None) -> Situation:
        """The state's facts with the surroundings that they were measured in; for planners.

        Args:
            bank: The scenarios.
            state: The state.
            cast: Contexts of all driven agents of the scenario, stacked; the agent alone by default.
        """
        cast = alone(state.context) if cast is None else cast
        around = surroundings(bank, state.context, self.frame(bank, state.context, cast, 0))
        return Situation(state.context, state.facts, around)

    def observe(
        self, bank: ScenarioBank, context: AgentContext, cast: AgentContext | None = None
    ) -> Mapping[str, Any]:
        """The task's observation of a context, live or replayed."""
        cast = alone(context) if cast is None else cast

        def frames(back: int) -> Frame:
            return self.frame(bank, context, cast, back)

        return self.task.observe(bank, context, frames, frames(0))

    def step_or_begin(
        self,
        bank: ScenarioBank,
        state: SimState,
        action: Float[Array, " D"],
        over: Bool[Array, ""],
        fresh: Beginning,
        seen: Frame | None = None,
    ) -> tuple[SimState, Transition]:
        """A step, or where the episode is ``over`` the beginning of another one instead.

        For collectors: an episode that ends costs one call that only resets, whose transition means nothing and is to
        be masked; in exchange nothing is measured or observed twice, and every state that a policy sees, final ones
        included, is seen once.

        Args:
            bank: The scenarios.
            state: The state.
            action: What the agent does if its episode goes on.
            over: Whether it is over.
            fresh: The :meth:`beginning` that it has then; looked at only where ``over``, so that a batch needs to
                compute it there only (:func:`simulator.sparse.map_where`).
            seen: ``now(bank, state.context)``, from who has it at hand, so that it is not computed again.
        """
        seen = self.now(bank, state.context) if seen is None else seen
        moved = self._move(bank, state.context, seen, action, None)
        context = jax.tree.map(partial(jnp.where, over), fresh.context, moved)
        before = replace(
            state,
            facts=forget_strand(state.facts, over),
            contacts=jnp.where(over, jnp.int8(Contact.ABSENT), state.contacts),
            lights=jax.tree.map(partial(jnp.where, over), fresh.lights, state.lights),
            start=jnp.where(over, fresh.context.step, state.start),
        )
        after, transition = self._settle(bank, before, context, alone(context), seen, action)
        first = self.task.episode_start()
        episode = jax.tree.map(lambda new, old: jnp.where(over, new, old), first, after.episode)
        lights = jax.tree.map(partial(jnp.where, over), nothing_crossed(after.lights), after.lights)
        after = replace(after, episode=episode, lights=lights)
        flags = {name: getattr(transition, name) & ~over for name in ("terminated", "truncated")}
        return after, replace(transition, after=after, **flags)

    def _drive(
        self, bank: ScenarioBank, state: SimState, action: Array, motion: Array | None
    ) -> tuple[SimState, Transition]:
        seen = self.now(bank, state.context)
        moved = self._move(bank, state.context, seen, action, motion)
        return self._settle(bank, state, moved, alone(moved), seen, action)

    def _move(
        self, bank: ScenarioBank, context: AgentContext, seen: Frame, action: Array, motion: Array | None
    ) -> AgentContext:
        """All agents move one step on from a frame; nothing is measured yet."""
        traffic = self.traffic.advance(bank, context, seen)
        return self._drive_on(bank, context, action, motion, traffic)

    def _drive_on(
        self, bank: ScenarioBank, context: AgentContext, action: Array, motion: Array | None, traffic: Any
    ) -> AgentContext:
        """The agent moves one step, in traffic that has moved."""
        if motion is None:
            action = self.task.actuated(context.history[-1], action, context.action)
            motion = self.task.motion(context.history[-1], action, bank.length_m(context.index, context.slot))
        return replace(
            context,
            step=context.step + 1,
            history=jnp.concatenate([context.history[1:], motion[None]]),
            action=action,
            traffic=traffic,
        )

    def _settle(
        self,
        bank: ScenarioBank,
        before: SimState,
        moved: AgentContext,
        cast: AgentContext,
        seen: Frame,
        action: Array,
    ) -> tuple[SimState, Transition]:
        """Measures an agent after all agents have moved on from a frame, and turns the step into a transition."""
        now = self.frame(bank, moved, cast, 0)
        found, contacts, lights = measure(
            bank, moved, now, seen, before.contacts, before.lights, self.task.reads, before.facts.strand
        )
        terminated, truncated = self.task.ended(bank, found.context, found.facts)
        terms = self.task.reward(before.facts, found.facts, found.surroundings)
        final = terminated | truncated | (found.context.step >= bank.steps - 1)
        episode = self.task.episode_add(before.episode, found, before.start, final)
        after = SimState(found.context, found.facts, contacts, lights, episode, before.start)
        reward = sum(terms.values(), start=jnp.zeros(()))
        return after, Transition(before, after, action, reward, terms, terminated, truncated)
