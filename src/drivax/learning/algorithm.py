"""Protocols of the training loop, which built-in and user-defined algorithms implement."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from drivax.errors import UsageError
from drivax.learning.environment import (
    Environment,
    Environments,
    Outcome,
    Rollout,
    SampledAction,
    cumulative_probability,
)
from drivax.planners.planner import Planner
from drivax.scenario.bank.scenario_bank import ScenarioBank

#: An additional loss of a policy: maps its parameters and a key to the loss and values to log.
AuxiliaryLoss = Callable[[Any, Array], tuple[Array, dict[str, Array]]]


@runtime_checkable
class LearnerState(Protocol):
    """A pytree with all that a run needs to continue: a ``scenario.record.record``, so that leaves have names.

    A class attribute ``networks`` names the fields that fine-tuning loads from another run, by default
    ``parameters``; a field may itself be such a state. Training stops if a number is not finite, except in the fields
    ``environments`` and ``replay``.
    """

    @property
    def parameters(self) -> Any:
        """Parameters of the planner, which is all that an evaluation restores."""
        ...

    @property
    def iteration(self) -> Array:
        """Number of finished iterations."""
        ...


@runtime_checkable
class Learner(Protocol):
    """An algorithm in one environment; everything that training changes is in the state.

    A learner that divides its batches among devices has the batch size as attribute ``batch``.
    """

    def init(self, data: Any, key: Array) -> Any:
        """Return the initial state (:class:`LearnerState`). Pure."""
        ...

    def iterate(self, data: Any, state: Any) -> tuple[Any, dict[str, Array]]:
        """Return the state after one iteration, and values to log by name (``loop.mean_logs``).

        Pure; compiled with the state donated.
        """
        ...

    def planner(self, parameters: Any, name: str, samples: bool) -> Planner:
        """Return the planner with these parameters, which samples its actions or takes the mode."""
        ...


@runtime_checkable
class Agent(Learner, Protocol):
    """A learner that interacts with its environment, split into parts for a training loop of your own.

    ``iterate`` collects a rollout with :meth:`sample_action`. On-policy it then calls ``update(data, state, rollout)``;
    off-policy it adds the rollout to ``state.replay`` (``buffer.add``) and calls ``update(data, state)``.
    """

    environment: Any

    def rollout_key(self, state: Any) -> Array:
        """Return the random key of the next rollout."""
        ...

    def sample_action(self, state: Any, observation: Mapping[str, Array], key: Array) -> SampledAction:
        """Sample exploratory actions for a batch of observations."""
        ...

    def transition(self, now: Environments, sampled: SampledAction, outcome: Outcome) -> Rollout:
        """Return one row of a rollout, with the arrays that this agent learns from."""
        ...


@runtime_checkable
class AlgorithmConfig(Protocol):
    """Settings of an algorithm; your own are frozen dataclasses, named in YAML as ``kind: package.module:Name``."""

    @property
    def steps_per_iteration(self) -> int:
        """Number of environment steps that one iteration counts as."""
        ...

    def build(self, environment: Environment, data: Any, iterations: int) -> Learner:
        """Return the learner of a run of ``iterations``; only shapes of the data are read."""
        ...


@runtime_checkable
class OfflineAlgorithm(Protocol):
    """Settings of an algorithm that learns from logged steps, which are prepared once before training."""

    def experience(self, environment: Environment, data: Any, weights: np.ndarray | None) -> Any:
        """Return the ``data`` of :meth:`Learner.iterate`: the environment's data, with logged steps to draw by weight.

        None if these settings use no logged steps.
        """
        ...


@runtime_checkable
class HeldOutMetrics(Protocol):
    """A learner that computes metrics on held-out data, in addition to those of driving."""

    def held_out_metrics(self, data: Any, state: Any) -> dict[str, float]:
        """Return values to log as ``validation/<name>``; ``data`` is :func:`training_data` of the held-out set."""
        ...


@runtime_checkable
class HasCritics(Protocol):
    """A learner that checks the health of its critics at the end of a run."""

    def critic_problems(self, rows: Sequence[Mapping[str, float]]) -> list[str] | None:
        """Return the problems of the critics, given the rows of ``metrics.jsonl`` up to the loaded checkpoint.

        None if the run did not check them.
        """
        ...


def training_data(
    config: AlgorithmConfig, environment: Environment, data: Any, weights: np.ndarray | None = None
) -> Any:
    """Return the data of a learner's iterations: the environment's data, or the logged experience in it.

    ``weights`` ``[N, T]`` or ``[M, T]`` are the sampling weights of all logged steps, at least 0; None: uniform. For
    algorithms that draw no logged steps, episodes begin in each scenario in proportion to the sum over its steps.

    Raises:
        UsageError: There are weights, but neither logged steps nor scenarios to draw by weight.
        DataError: All weights are 0.
    """
    is_offline = isinstance(config, OfflineAlgorithm)
    experience = config.experience(environment, data, weights) if is_offline else None
    if experience is not None:
        return experience
    if weights is None:
        return data
    if not isinstance(data, ScenarioBank):
        problem = f"{type(config).__name__} draws neither logged steps nor scenarios by weight here"
        raise UsageError(problem, cure="leave out the weights")
    mass = np.asarray(weights, np.float64).reshape(len(data), -1).sum(axis=1)
    if data.chances is not None:  # Some scenarios may be closed to new episodes.
        mass = mass * (np.diff(np.asarray(data.chances, np.int64), prepend=0) > 0)
        if not mass.any():
            return data
    return replace(data, chances=jnp.asarray(cumulative_probability(mass)))
