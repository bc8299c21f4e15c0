"""A task: action space, observation, reward and termination, as configured; what a simulator simulates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.metrics.episode import Episode, episode_add, episode_start
from drivax.scenario.bank import ScenarioBank
from drivax.simulator.dynamics import bicycle
from drivax.simulator.types import Facts, Frame, Scene, SimState, Surroundings
from drivax.tasks.actions import ActionSpace
from drivax.tasks.observations import Observation, ObservationConfig, observe
from drivax.tasks.rewards import TERMS, RewardConfig

Failure = Literal["collision", "offroad", "red_light"]


@dataclass(frozen=True)
class Task:
    """What makes driving a learning problem.

    Attributes:
        actions: The action space.
        observation: Groups and sizes.
        reward: Preset and weights.
        ends: Failures that terminate an episode.
        to_the_end: Whether episodes go on to the end of the log whatever happens, as evaluation does.
    """

    actions: ActionSpace = field(default_factory=ActionSpace)
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    rewards: RewardConfig = field(default_factory=RewardConfig)
    ends: tuple[Failure, ...] = ("collision", "offroad", "red_light")
    to_the_end: bool = False

    def motion(
        self, motion: Float[Array, " 4"], action: Float[Array, " 2"], length: Any
    ) -> Float[Array, " 4"]:
        """Next motion for an action: the kinematic bicycle."""
        return bicycle(motion, *self.actions.command(action, length))

    def observe(
        self, bank: ScenarioBank, scene: Scene, agents: Callable[[int], Frame], frame: Frame
    ) -> Observation:
        """The observation of a scene; ``agents`` gives everyone's frame some steps back."""
        return observe(self.observation, bank, scene, lambda back: agents(back) if back else frame)

    def reward(self, before: Facts, now: Facts, around: Surroundings) -> dict[str, Float[Array, ""]]:
        """Weighted terms by name."""
        weights = self.rewards.weights()
        return {name: weight * TERMS[name](before, now, around) for name, weight in weights.items()}

    def ended(
        self, bank: ScenarioBank, scene: Scene, facts: Facts
    ) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Terminated by a failure; truncated where the log or the map ends."""
        failed = {"collision": facts.collision, "offroad": facts.offroad, "red_light": facts.red_light}
        log_ends, terminated = scene.step >= bank.steps - 1, jnp.zeros((), bool)
        if self.to_the_end:
            return terminated, log_ends
        for name in self.ends:
            terminated = terminated | failed[name]
        return terminated, (log_ends | facts.left_map) & ~terminated

    def episode_start(self) -> Episode:
        """Empty accumulators."""
        return episode_start()

    def episode_add(self, episode: Any, state: SimState, final: Bool[Array, ""]) -> Episode:
        """Accumulators after the step that led to ``state``."""
        return episode_add(episode, state, final)
