"""Logged experience: actions of an expert, their outcome, and sampling weights of steps.

No observation is stored: a step is an index (scenario, step), observed when it is drawn. Rewards and episode ends
depend on all earlier steps, so the log is replayed once before training.

Steps are drawn by inverting the cumulative distribution, stored as 32-bit integers: rounding changes each of a million
equal weights by up to 0.02 %; in float32 it would be 6 %. A step of weight zero is never drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from drivax.checks import check_above_zero, check_at_most
from drivax.errors import DataError, UsageError
from drivax.learning.environment import Environment, cumulative_probability, draw_positions
from drivax.learning.replay import Transitions
from drivax.rl.equations import n_step_returns
from drivax.scenario.record import record, static
from drivax.stats.intervals import effective_size

#: Rows (scenarios, or egos of scenarios) and steps.
StepIndex = tuple[Int[Array, "..."], Int[Array, "..."]]
#: Observations, expert actions within the bounds, and whether the actions were clipped to them.
ExpertActions = tuple[dict[str, Array], Float[Array, "B D"], Bool[Array, " B"]]


@record
class Sampler:
    """A distribution over the steps of scenarios, made by :func:`sampler`.

    Attributes:
        cumulative: Cumulative probability up to each step, scenario by scenario, in units of ``1 / (2^32 - 1)``.
        effective: Effective sample size.
        steps: Steps per scenario.
    """

    cumulative: UInt[Array, " steps"]
    effective: Float[Array, ""]
    steps: int = static()


def sampler(weights: np.ndarray) -> Sampler:
    """Return a sampler of steps with probabilities proportional to ``weights`` ``[N, T]``.

    A step with a probability below ``2^-32`` may never be drawn.

    Raises:
        DataError: All weights are 0.
    """
    cumulative = jnp.asarray(cumulative_probability(weights))
    return Sampler(cumulative, jnp.asarray(effective_size(weights), jnp.float32), weights.shape[1])


def sample_steps(sampler: Sampler, key: Array, shape: tuple[int, ...]) -> StepIndex:
    """Draw step indices with replacement."""
    position = draw_positions(sampler.cumulative, key, shape)
    return position // sampler.steps, position % sampler.steps


def check_weights(weights: np.ndarray, scenarios: int, steps: int, egos: int) -> np.ndarray:
    """Return weights of scenarios or of their ``egos`` logs as ``[N, 1 or egos, T]`` in double precision.

    Raises:
        UsageError: The shape is wrong, or a weight is negative, NaN or above 1e100.
    """
    weights = np.asarray(weights)
    if weights.shape not in ((scenarios, steps), (scenarios * egos, steps)):
        logs = "" if egos == 1 else f", or their {scenarios * egos} logs,"
        problem = f"weights of shape {weights.shape} for {scenarios} scenarios{logs} of {steps} steps"
        raise UsageError(problem, cure="make weights for every step of this scenario set")
    weights = weights.astype(np.float64).reshape(scenarios, -1, steps)
    # The bound keeps sums of squares finite.
    invalid = np.argwhere(~((weights >= 0.0) & (weights <= 1e100)))
    if len(invalid):
        scenario, ego, step = invalid[0]
        of_ego = "" if weights.shape[1] == 1 else f"ego {ego} of "
        problem = (
            f"the weight of step {step} of {of_ego}scenario {scenario} is {weights[scenario, ego, step]}"
        )
        raise UsageError(problem, cure="use numbers from 0 to 1e100")
    return weights


@record
class ExpertSteps:
    """Actions of experts, within the bounds, at T steps of M logs (or recorded episodes), and their outcome.

    Values of steps that are not ``usable`` are undefined. A ``clipped`` action does not lead to the next state: it was
    clipped to the bounds, or is not at the first step of its decision. ``hold`` is the number of steps per decision
    (``Task.hold``), ``egos`` the number of logs per scenario. Recorded episodes also have ``scenario``, the row of
    the scenario of each, and the number of ``scenarios``.
    """

    action: Float[Array, "M T D"]
    reward: Float[Array, "M T"]
    terminated: Bool[Array, "M T"]
    truncated: Bool[Array, "M T"]
    usable: Bool[Array, "M T"]
    clipped: Bool[Array, "M T"]
    hold: int = static(default=1)
    egos: int = static(default=1)
    scenarios: int = static(default=0)
    scenario: Int[Array, " M"] | None = None


@runtime_checkable
class LoggedEnvironment(Environment, Protocol):
    """An environment whose data hold episodes of an expert."""

    def expert_steps(self, data: Any) -> ExpertSteps:
        """Return the expert's steps; usable steps have a valid expert and precede the end of the episode."""
        ...

    def observe_recorded(self, data: Any, index: StepIndex) -> dict[str, Array]:
        """Observe a batch of logged steps as if the expert had acted in the environment."""
        ...


def require_log(environment: Environment) -> LoggedEnvironment:
    """Return an environment with expert episodes.

    Raises:
        UsageError: The environment has no expert episodes.
    """
    if not isinstance(environment, LoggedEnvironment):
        problem = f"{type(environment).__name__} has no logged episodes"
        raise UsageError(problem, cure="implement `expert_steps` and `observe_recorded`")
    return environment


@record
class Experience:
    """The steps that offline algorithms learn from, and their samplers.

    Attributes:
        data: The environment's data.
        expert: The expert's steps.
        usable: Steps to learn from.
        uniform: Sampler that draws usable steps, of all episodes, with equal probability.
        critic: Sampler of steps for policy evaluation.
        policy: Sampler of steps for policy improvement; None: that of the critic.
        failures: Share of the critic's episodes that end in a failure.
    """

    data: Any
    expert: ExpertSteps
    usable: Bool[Array, "M T"]
    uniform: Sampler
    critic: Sampler
    failures: Float[Array, ""]
    policy: Sampler | None = None

    def sizes(self) -> dict[str, Float[Array, ""]]:
        """Return effective sample sizes and the share of failures, to log."""
        samplers = {"critic": self.critic, "policy": self.policy or self.critic}
        effective = {f"sampler/{name}_effective": sampler.effective for name, sampler in samplers.items()}
        return effective | {"sampler/failures": self.failures}


@dataclass(frozen=True)
class ExperienceConfig:
    """Settings of the logged steps to learn from.

    Attributes:
        mask_clipped: Leave out steps at which the expert's action is clipped to the bounds.
        weighted: What weights and ``best`` apply to: ``all``, or only the ``policy``, with values learned from uniform
            steps of all episodes.
        best: Share of the episodes of each scenario, those with the highest return, to learn from; at least one.
    """

    mask_clipped: bool = True
    weighted: Literal["all", "policy"] = "all"
    best: float = 1.0

    def __post_init__(self) -> None:
        check_above_zero(self, "best")
        check_at_most(self, 1, "best")

    def of(self, environment: Environment, data: Any, weights: np.ndarray | None = None) -> Experience:
        """Return the experience in an environment's data, drawn by ``weights`` or uniformly.

        Weights are those of the steps of all M logs, ``[M, T]``, or of all N scenarios, ``[N, T]``; those of a scenario
        apply to all of its logs.

        Raises:
            UsageError: There is no expert, or the weights do not fit the data.
            DataError: No step is usable, or the weights of all usable steps are 0.
        """
        expert = expert_steps(require_log(environment), data)
        usable = expert.usable & ~(expert.clipped & self.mask_clipped)
        if not usable.any():
            if not expert.usable.any():
                raise DataError("no logged step has an expert action", cure="check the set")
            problem = "the expert's action exceeds the bounds at all logged steps"
            raise DataError(problem, cure="choose an action space with wider bounds")
        uniform = of_policy = sampler(np.asarray(usable, np.float64))
        if self.best < 1.0:
            if expert.scenario is None:
                problem = f"best is {self.best:g}, but there are no recorded episodes to choose from"
                raise UsageError(problem, cure="give some with --episodes, or leave out best")
            usable &= _has_high_return(expert, usable, self.best)[:, None]
            of_policy = sampler(np.asarray(usable, np.float64))
        if weights is not None:
            of_policy = sampler(np.asarray(usable) * _weights_of_logs(weights, expert))
        if self.weighted == "all" or of_policy is uniform:
            return Experience(data, expert, usable, uniform, of_policy, _share_of_failures(expert, usable))
        return Experience(
            data, expert, usable, uniform, uniform, _share_of_failures(expert, expert.usable), of_policy
        )


def _share_of_failures(expert: ExpertSteps, usable: Bool[Array, "M T"]) -> Float[Array, ""]:
    """Return the share of episodes that end in a failure, out of those with a usable step."""
    failed = (expert.terminated & expert.usable).any(axis=1)
    return jnp.mean(failed, where=usable.any(axis=1))


def _has_high_return(expert: ExpertSteps, usable: Bool[Array, "M T"], share: float) -> Bool[np.ndarray, " M"]:
    """Mask of the ``share`` of the episodes of each scenario with the highest return, at least one.

    Episodes without a usable step rank last.
    """
    returns = np.where(usable.any(axis=1), np.sum(expert.reward * expert.usable, axis=1), -np.inf)
    count, scenario = len(returns), np.asarray(expert.scenario)
    order = np.lexsort((-returns, scenario))
    _, first, sizes = np.unique(scenario[order], return_index=True, return_counts=True)
    rank = np.empty(count, int)
    rank[order] = np.arange(count) - np.repeat(first, sizes)
    return rank < np.maximum(share * sizes, 1.0)[np.searchsorted(np.unique(scenario), scenario)]


def _weights_of_logs(weights: np.ndarray, expert: ExpertSteps) -> np.ndarray:
    """Return the weights of scenarios, or of all logs in their order, as those of the logs ``[M, T]``."""
    (logs, steps), egos = expert.usable.shape, expert.egos
    if expert.scenario is not None:
        scenarios = np.asarray(expert.scenario)
        return check_weights(weights, expert.scenarios, steps, 1)[scenarios, 0]
    weights = check_weights(weights, logs // egos, steps, egos)
    return np.broadcast_to(weights, (logs // egos, egos, steps)).reshape(logs, steps)


def environment_data(data: Any) -> Any:
    """Return the environment's data, given these or the experience that contains them."""
    return data.data if isinstance(data, Experience) else data


@partial(jax.jit, static_argnums=0)
def expert_steps(environment: LoggedEnvironment, data: Any) -> ExpertSteps:
    """Return the expert's steps in an environment's data."""
    return environment.expert_steps(data)


def expert_actions(environment: LoggedEnvironment, experience: Experience, index: StepIndex) -> ExpertActions:
    """Return the expert's actions at logged steps."""
    expert = experience.expert
    observation = environment.observe_recorded(experience.data, index)
    return observation, expert.action[index], expert.clipped[index]


def transitions(
    environment: LoggedEnvironment, experience: Experience, index: StepIndex, gamma: float, steps: int = 1
) -> Transitions:
    """Return transitions over up to ``steps`` logged decisions, with observations before and after them.

    A decision that is held has the expert's action at its first step.
    """
    (scenario, step), expert = index, experience.expert
    observation, action, _ = expert_actions(environment, experience, index)
    window_steps = step + jnp.arange(steps * expert.hold).reshape(-1, *[1] * step.ndim)
    # The last step of the log is never usable, so it ends the window.
    window = scenario, jnp.minimum(window_steps, expert.usable.shape[1] - 1)
    returns = n_step_returns(
        expert.reward[window], expert.terminated[window], expert.usable[window], gamma, expert.hold
    )
    return Transitions(
        observation=observation,
        action=action,
        reward=returns.reward,
        terminated=returns.terminated,
        next_observation=environment.observe_recorded(experience.data, (scenario, step + returns.steps)),
        discount=returns.discount,
    )
