"""A task: action space, observation, reward, termination and metrics."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.errors import UsageError
from drivax.metrics.catalogue import MetricNames, select_metrics
from drivax.metrics.episode import Episode, episode_add, episode_start
from drivax.plugins import check_unique
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.types import (
    Action,
    AgentContext,
    Facts,
    Frame,
    History,
    Motion,
    Situation,
    Surroundings,
)
from drivax.tasks.actions import ActionSpace, Physical, action_of, execute
from drivax.tasks.conditions import (
    Conditions,
    by_name,
    check_conditions,
    draw_conditions,
    scale_conditions,
)
from drivax.tasks.features import Frames
from drivax.tasks.observations import Observation, ObservationConfig, observe
from drivax.tasks.rewards import RewardConfig

#: Largest number of steps of a decision.
MOST_HOLD = 100
Failure = Literal["collision", "offroad", "red_light"]


@dataclass(frozen=True)
class Task:
    """Definition of a driving task.

    Attributes:
        actions: Action space and dynamics.
        hold: Steps for which a planner's decision is executed before it decides again.
        observation: Groups and sizes.
        rewards: Preset, weights and custom terms.
        metrics: ``none``, ``training``, ``full``, or a list of sets, metrics and dotted names of custom metrics. Others
            are neither measured nor carried.
        ends: Failures that terminate an episode.
        conditions: Weights and options of the reward that training draws for each agent and episode, observed as group
            ``conditions``; all others are the same in all episodes.
        to_the_end: Whether episodes continue to the end of the log after a failure, as in evaluation.
    """

    actions: ActionSpace = field(default_factory=Physical)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    rewards: RewardConfig = field(default_factory=RewardConfig)
    ends: tuple[Failure, ...] = ("collision", "offroad", "red_light")
    to_the_end: bool = False
    metrics: MetricNames = "full"
    hold: int = 1
    conditions: Conditions = ()

    def __post_init__(self) -> None:
        select_metrics(self.metrics)
        if not 1 <= self.hold <= MOST_HOLD:
            raise UsageError(f"task.hold is {self.hold}", cure=f"use 1 to {MOST_HOLD} steps")
        check_conditions(self.conditions, self.rewards)
        if self.conditions:
            check_unique("observation.own", [group.name for group in self.observation.own], ("conditions",))

    @property
    def reads(self) -> frozenset[str]:
        """Facts that rewards, terminations and metrics read."""
        ends = frozenset() if self.to_the_end else frozenset({*self.ends, "left_map"})
        return select_metrics(self.metrics).reads | self.rewards.reads | ends

    def motion(self, motion: Motion, action: Action, length: Any) -> Motion:
        """Return the next motion by the dynamics of the action space."""
        return self.actions.move(motion, action, length)

    def actuate(self, bank: ScenarioBank, context: AgentContext, action: Action) -> Action:
        """Return the executed action, within bounds and actuator rates."""
        return execute(self.actions, bank, context, action)

    def coast(self, bank: ScenarioBank, context: AgentContext) -> Action:
        """Return the action that keeps speed and heading."""
        return action_of(self.actions, bank, context, jnp.zeros(()), jnp.zeros(()))

    def first_action(self, history: History, length: Any) -> Action:
        """Return the action that counts as the last one at the start of an episode."""
        return self.actions.first(history, length)

    def draw_conditions(self, slot: Any, key: Any) -> tuple[()] | Float[Array, " C"]:
        """Return the conditions of an agent's episode, or those of evaluation if ``key`` is None."""
        return draw_conditions(self.conditions, slot, key)

    def observe(self, bank: ScenarioBank, context: AgentContext, frames: Frames, frame: Frame) -> Observation:
        """Return the observation of a context; ``frames`` returns earlier frames, ``frame`` is the present one."""

        def frames_with_present(back: int, slots: Int[Array, " K"] | None = None) -> Frame:
            """Return an earlier frame, or the present one without computing it again."""
            if back:
                return frames(back, slots)
            return frame if slots is None else frame.at(slots)

        observation = observe(self.observation, bank, context, frames_with_present)
        if self.conditions:
            observation["conditions"] = scale_conditions(self.conditions, context.conditions)
        return observation

    def reward(
        self, before: Facts, now: Facts, around: Surroundings, conditions: Any = ()
    ) -> dict[str, Float[Array, ""]]:
        """Return weighted reward terms by name; ``conditions`` are those of the context."""
        return self.rewards.weigh(before, now, around, by_name(self.conditions, conditions))

    def check_end(
        self, bank: ScenarioBank, context: AgentContext, facts: Facts
    ) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Return terminated (by a failure in ``ends``) and truncated (at the end of log or map).

        With ``to_the_end`` only the end of the log counts.
        """
        log_ends, terminated = context.step >= bank.last_step[context.row], jnp.zeros((), bool)
        if self.to_the_end:
            return terminated, log_ends
        for name in self.ends:
            terminated = terminated | getattr(facts, name)
        return terminated, (log_ends | facts.left_map) & ~terminated

    def episode_start(self) -> Episode:
        """Return empty metric accumulators."""
        return episode_start(self.metrics)

    def episode_add(
        self, episode: Any, situation: Situation, start: Int[Array, ""], final: Bool[Array, ""]
    ) -> Episode:
        """Return the accumulators after the step to ``situation``."""
        return episode_add(episode, situation, start, final)
