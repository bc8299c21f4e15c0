"""What an algorithm is to the training loop, so that one of the user's own takes its place beside PPO."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array

from drivax.errors import UsageError
from drivax.learning.environment import Environment
from drivax.planners.planner import Planner

#: A further loss of a policy: from its parameters and a key to the loss, and what to log of it.
Also = Callable[[Any, Array], tuple[Array, dict[str, Array]]]


@runtime_checkable
class LearnerState(Protocol):
    """A pytree with all that a run needs to continue; a frozen ``scenario.record.record``, so that it has names.

    A class attribute ``networks`` names the fields that a run which begins from another one takes over (only
    ``parameters`` where there is none); one of them may be such a state itself.
    """

    @property
    def parameters(self) -> Any:
        """What the planner is made of; an evaluation restores nothing else."""
        ...

    @property
    def iteration(self) -> Array:
        """Iterations done, an integer."""
        ...


@runtime_checkable
class Learner(Protocol):
    """An algorithm in one environment. Holds configuration; everything computed is in the state.

    One that learns from data alone and divides its batches among devices (``devices.divided``) has their size as
    ``batch``.
    """

    def init(self, data: Any, key: Array) -> Any:
        """The state (:class:`LearnerState`) before the first iteration. Pure."""
        ...

    def iterate(self, data: Any, state: Any) -> tuple[Any, dict[str, Array]]:
        """The state after one iteration, and numbers to log by name.

        Pure; compiled with the state donated. Names are logged as they are, but for the sums that
        ``collector.collect`` returns: passed on as ``rollout/<name>``, they are logged as means.
        """
        ...

    def planner(self, parameters: Any, name: str, samples: bool) -> Planner:
        """The driver that these parameters make; it samples its actions, or acts by the mode."""
        ...


@runtime_checkable
class AlgorithmConfig(Protocol):
    """Settings of an algorithm; own ones are frozen dataclasses, named in YAML as ``kind: package.module:Name``."""

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps that one iteration counts as."""
        ...

    def build(self, environment: Environment, data: Any, iterations: int) -> Learner:
        """The learner; of the data only shapes may be looked at, ``iterations`` is the length of the whole run."""
        ...


@runtime_checkable
class LearnsFromRecords(Protocol):
    """Settings of an algorithm that learns from recorded steps: what its learner is given is prepared once."""

    def experience(self, environment: Environment, data: Any, weights: np.ndarray | None) -> Any:
        """The ``data`` of :meth:`Learner.iterate`, made of the environment's, with steps drawn by these weights."""
        ...


@runtime_checkable
class Judges(Protocol):
    """A learner that has something to say of held-out data, beside how its policy drives there."""

    def judge(self, data: Any, state: Any) -> dict[str, float]:
        """Numbers to log as ``validation/<name>``; ``data`` are :func:`training_data` of what is held out."""
        ...


def training_data(
    config: AlgorithmConfig, environment: Environment, data: Any, weights: np.ndarray | None = None
) -> Any:
    """What a learner's iterations are given: the environment's data, or what the algorithm makes of them.

    Args:
        config: The algorithm.
        environment: What it learns in.
        data: The environment's data.
        weights: ``[N, T]`` of every recorded step, at least 0; None: all alike.

    Raises:
        UsageError: There are weights, but the algorithm learns from what it drives itself.
    """
    if isinstance(config, LearnsFromRecords):
        return config.experience(environment, data, weights)
    if weights is not None:
        raise UsageError(
            f"{type(config).__name__} learns from no recorded steps that weights could choose",
            cure="leave out the weights, or use bc, cql, iql or td3_bc",
        )
    return data
