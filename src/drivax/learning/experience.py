"""Recorded experience: what an expert did at every step of the data, what it earned, and how often each step is drawn.

Nothing is written to files and no observation is stored: a step is a place (scenario, step), observed when it is drawn
by the function that observes a driven step (design, ideas 1 and 4). What came of a step depends on all steps before it
and is replayed once, before learning begins: a few numbers per step.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from drivax.errors import UsageError
from drivax.learning import sampler
from drivax.learning.environment import Environment
from drivax.learning.replay import Transitions
from drivax.learning.sampler import Places, Sampler, checked_weights
from drivax.scenario.record import record
from drivax.scenario.store import ScenarioSet

#: What follows the weights: everything, or only the steps that the policy is improved at, while values are learned from
#: all steps alike.
Weighted = Literal["all", "policy"]


@dataclass(frozen=True)
class WeightedSet:
    """Scenarios to train on, with a weight of every step.

    Attributes:
        scenarios: The scenarios.
        weights: ``[scenario, step]``, at least 0: how often offline algorithms draw each recorded step, in proportion.
    """

    scenarios: ScenarioSet
    weights: np.ndarray


@record
class ExpertSteps:
    """What an expert did at each of T steps of N scenarios, and what came of it.

    Attributes:
        action: Its actions within the bounds.
        reward: What they earned.
        terminated: The episode ended for good there: bootstrap zero.
        truncated: It was cut off there: bootstrap the value of what the step led to.
        usable: Whether a step can be learned from (:meth:`Recorded.expert_steps`); where not, the rest means nothing.
        clipped: The expert did what no action does, so that its action does not lead to where it went.
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
        """What the expert did; a step is usable if the expert was there, and no episode ended at an earlier step."""
        ...

    def observe_recorded(self, data: Any, places: Places) -> dict[str, Array]:
        """Observations of a batch of steps, as the environment shows them when the expert acts."""
        ...


def recorded(environment: Environment) -> Recorded:
    """The environment, if it knows an expert's episodes.

    Raises:
        UsageError: It knows none.
    """
    if not isinstance(environment, Recorded):
        raise UsageError(
            f"{type(environment).__name__} holds no recorded episodes", cure="give it `expert_steps`"
        )
    return environment


@record
class Experience:
    """What offline algorithms learn from.

    Attributes:
        data: The environment's data.
        expert: What the expert did.
        usable: Which steps are learned from.
        alike: Draws these, all alike.
        critic: How steps are drawn that values are learned from.
        policy: How steps are drawn that the policy is improved at; None: the same steps as the critic's.
    """

    data: Any
    expert: ExpertSteps
    usable: Bool[Array, "N T"]
    alike: Sampler
    critic: Sampler
    policy: Sampler | None = None

    def sizes(self) -> dict[str, Float[Array, ""]]:
        """Effective sample sizes, to log."""
        policy = self.policy or self.critic
        return {
            "sampler/critic_effective": self.critic.effective,
            "sampler/policy_effective": policy.effective,
        }


@dataclass(frozen=True)
class ExperienceConfig:
    """Which recorded steps are learned from.

    Attributes:
        mask_clipped: Whether steps at which the expert did what no action does are left out. If not, they are taken
            with the nearest action, though that does not lead to where the expert went.
        weighted: What follows the weights that a training is given: ``all``, or only the ``policy``.
    """

    mask_clipped: bool = True
    weighted: Weighted = "all"

    def of(self, environment: Environment, data: Any, weights: np.ndarray | None = None) -> Experience:
        """The experience that an environment's data hold.

        Args:
            environment: A recorded one.
            data: Its data.
            weights: ``[N, T]`` of every step, at least 0; None: all alike.

        Raises:
            UsageError: Nobody's episodes are in the data, or weights do not fit them.
            DataError: No step can be learned from.
        """
        expert = _expert_steps(recorded(environment), data)
        usable = expert.usable & ~(expert.clipped & self.mask_clipped)
        alike = sampler.sampler(np.asarray(usable, np.float64))
        if weights is None:
            return Experience(data, expert, usable, alike, alike)
        weighted = sampler.sampler(np.asarray(usable) * checked_weights(weights, usable.shape))
        if self.weighted == "all":
            return Experience(data, expert, usable, alike, weighted)
        return Experience(data, expert, usable, alike, alike, weighted)


@partial(jax.jit, static_argnums=0)
def _expert_steps(environment: Recorded, data: Any) -> ExpertSteps:
    return environment.expert_steps(data)


def moments(
    environment: Recorded, experience: Experience, places: Places
) -> tuple[dict[str, Array], Float[Array, "B D"], Bool[Array, " B"]]:
    """Observations of the steps at these places, what the expert did there, and whether that was clipped."""
    expert = experience.expert
    observation = environment.observe_recorded(experience.data, places)
    return observation, expert.action[places], expert.clipped[places]


def transitions(environment: Recorded, experience: Experience, places: Places) -> Transitions:
    """The steps at these places, observed before and after."""
    (index, step), expert = places, experience.expert
    observation, action, _ = moments(environment, experience, places)
    return Transitions(
        observation=observation,
        action=action,
        reward=expert.reward[places],
        terminated=expert.terminated[places],
        # What can be learned from is never the last step of the log.
        following=environment.observe_recorded(experience.data, (index, step + 1)),
    )
