"""Logged experience: what an expert did at each step, what reward it got, and how steps are drawn by weight.

No observation is stored: a step is an index (scenario, step), observed when it is drawn by the function that observes
simulated steps. Rewards and ends depend on all earlier steps, so they are replayed once before training.

Steps are drawn by the inverse of the cumulative distribution in integers: float32 would round a weight among a million
others by a twentieth, 32 bits by a five-thousandth, and no number leads to a step of weight zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from drivax.errors import DataError, UsageError
from drivax.learning.environment import Environment
from drivax.learning.replay import Transitions
from drivax.scenario.record import record, static
from drivax.scenario.store import ScenarioSet
from drivax.stats.intervals import effective_size

#: What follows the weights: all learning, or only the policy, while values are learned from uniform steps.
Weighted = Literal["all", "policy"]
#: Scenarios and steps that were drawn.
StepIndex = tuple[Int[Array, "..."], Int[Array, "..."]]

_LAST = 2**32 - 1


@dataclass(frozen=True)
class WeightedSet:
    """Scenarios to train on, with weights ``[scenario, step]`` of at least 0 that steps are drawn in proportion to."""

    scenarios: ScenarioSet
    weights: np.ndarray


@record
class Sampler:
    """A distribution over the steps of scenarios, made by :func:`sampler`.

    Attributes:
        cumulative: Share of all weight up to each step, scenario by scenario, in units of ``1 / (2^32 - 1)``.
        effective: Effective sample size (:func:`~drivax.stats.intervals.effective_size`).
        steps: Steps per scenario.
    """

    cumulative: UInt[Array, " places"]
    effective: Float[Array, ""]
    steps: int = static()


def sampler(weights: np.ndarray) -> Sampler:
    """Return a sampler that draws each step in proportion to its weight ``[N, T]``, at least 0.

    A step with a share of all weight below ``2^-32`` may never be drawn. Raises DataError if no weight is above 0.
    """
    total = np.cumsum(weights.reshape(-1), dtype=np.float64)
    if not total[-1] > 0.0:
        raise DataError("no step has any weight", cure="give a usable step a weight above 0")
    cumulative = np.floor(total / total[-1] * _LAST).astype(np.uint32)
    effective = jnp.asarray(effective_size(weights), jnp.float32)
    return Sampler(jnp.asarray(cumulative), effective, weights.shape[1])


def draw(sampler: Sampler, key: Array, shape: tuple[int, ...]) -> StepIndex:
    """Draw step indices with replacement."""
    number = jnp.minimum(jax.random.bits(key, shape, jnp.uint32), jnp.uint32(_LAST - 1))
    # The first step whose share exceeds the number: never a step without weight.
    position = jnp.searchsorted(sampler.cumulative, number, side="right").astype(jnp.int32)
    return position // sampler.steps, position % sampler.steps


def check_weights(weights: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return weights ``[N, T]`` in double precision.

    Raises:
        UsageError: They have another shape, are negative, or not finite.
    """
    weights = np.asarray(weights)
    if weights.shape != shape:
        raise UsageError(
            f"weights of shape {weights.shape} for {shape[0]} scenarios of {shape[1]} steps",
            cure="make weights for every step of this scenario set",
        )
    bad = np.argwhere(~(np.isfinite(weights) & (weights >= 0.0)))
    if len(bad):
        scenario, step = bad[0]
        raise UsageError(
            f"the weight of step {step} of scenario {scenario} is {weights[scenario, step]}",
            cure="use finite numbers of at least 0",
        )
    return weights.astype(np.float64)


@record
class ExpertSteps:
    """What an expert did at each of T steps of N scenarios, and the outcome.

    Attributes:
        action: Actions within the bounds.
        reward: Rewards.
        terminated: Episode ended for good: bootstrap zero.
        truncated: Episode was cut off: bootstrap the value of the state that the step led to.
        usable: Whether a step can be learned from (:meth:`Recorded.expert_steps`); elsewhere all else is undefined.
        clipped: The expert did what no action does, so the action does not lead to its next state.
    """

    action: Float[Array, "N T D"]
    reward: Float[Array, "N T"]
    terminated: Bool[Array, "N T"]
    truncated: Bool[Array, "N T"]
    usable: Bool[Array, "N T"]
    clipped: Bool[Array, "N T"]


@runtime_checkable
class Recorded(Environment, Protocol):
    """An environment whose data hold episodes of an expert."""

    def expert_steps(self, data: Any) -> ExpertSteps:
        """Return the expert's steps; usable are those with a valid expert before the end of the episode."""
        ...

    def observe_recorded(self, data: Any, index: StepIndex) -> dict[str, Array]:
        """Observe a batch of logged steps as the environment shows them when the expert acts."""
        ...


def recorded(environment: Environment) -> Recorded:
    """Return the environment; raises UsageError if it has no expert episodes."""
    if not isinstance(environment, Recorded):
        raise UsageError(
            f"{type(environment).__name__} has no logged episodes", cure="implement `expert_steps`"
        )
    return environment


@record
class Experience:
    """What offline algorithms learn from.

    Attributes:
        data: The environment's data.
        expert: The expert's steps.
        usable: Steps to learn from.
        uniform: Draws usable steps uniformly.
        critic: Draws the steps that values are learned from.
        policy: Draws the steps that the policy is improved at; None: the critic's steps.
    """

    data: Any
    expert: ExpertSteps
    usable: Bool[Array, "N T"]
    uniform: Sampler
    critic: Sampler
    policy: Sampler | None = None

    def sizes(self) -> dict[str, Float[Array, ""]]:
        """Return effective sample sizes to log."""
        policy = self.policy or self.critic
        return {
            "sampler/critic_effective": self.critic.effective,
            "sampler/policy_effective": policy.effective,
        }


@dataclass(frozen=True)
class ExperienceConfig:
    """Which logged steps are learned from.

    Attributes:
        mask_clipped: Leave out steps at which the expert did what no action does. Otherwise they have the nearest
            action, which does not lead to the expert's next state.
        weighted: What follows the weights of a training: ``all``, or only the ``policy``.
    """

    mask_clipped: bool = True
    weighted: Weighted = "all"

    def of(self, environment: Environment, data: Any, weights: np.ndarray | None = None) -> Experience:
        """Return the experience in an environment's data, drawn by ``weights`` ``[N, T]`` or uniformly.

        Raises:
            UsageError: The environment has no expert, or the weights do not fit the data.
            DataError: No step is usable.
        """
        expert = _expert_steps(recorded(environment), data)
        usable = expert.usable & ~(expert.clipped & self.mask_clipped)
        uniform = sampler(np.asarray(usable, np.float64))
        if weights is None:
            return Experience(data, expert, usable, uniform, uniform)
        weighted = sampler(np.asarray(usable) * check_weights(weights, usable.shape))
        if self.weighted == "all":
            return Experience(data, expert, usable, uniform, weighted)
        return Experience(data, expert, usable, uniform, uniform, weighted)


@partial(jax.jit, static_argnums=0)
def _expert_steps(environment: Recorded, data: Any) -> ExpertSteps:
    return environment.expert_steps(data)


def expert_actions(
    environment: Recorded, experience: Experience, index: StepIndex
) -> tuple[dict[str, Array], Float[Array, "B D"], Bool[Array, " B"]]:
    """Return observations of logged steps, the expert's actions, and whether those were clipped."""
    expert = experience.expert
    observation = environment.observe_recorded(experience.data, index)
    return observation, expert.action[index], expert.clipped[index]


def transitions(environment: Recorded, experience: Experience, index: StepIndex) -> Transitions:
    """Return logged steps, observed before and after."""
    (scenario, step), expert = index, experience.expert
    observation, action, _ = expert_actions(environment, experience, index)
    return Transitions(
        observation=observation,
        action=action,
        reward=expert.reward[index],
        terminated=expert.terminated[index],
        # A usable step is never the last step of the log.
        next_observation=environment.observe_recorded(experience.data, (scenario, step + 1)),
    )
