"""Planners defined by one user function, in JAX or in plain Python, or by a trained policy.

A function maps the situation and observation of one scenario to an action of the task's action space. A planner with
memory or random numbers is a class (``planners.planner.Planner``).
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from drivax.planners.planner import Memoryless
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record, static
from drivax.simulator.types import Action, Situation

Drive = Callable[[Situation, Any], Any]

#: Folder of the package.
_PACKAGE = Path(__file__).parents[1]
#: Active collectors of errors; the last one receives them.
_listeners: list[dict[tuple[int, int], str]] = []


class PlannerError(Exception):
    """A failure of a planner whose text is complete."""


@record
class FunctionPlanner(Memoryless):
    """Drive by a function; created by :func:`jax_planner` and :func:`python_planner`.

    Attributes:
        function: ``(situation, observation) -> action``.
        in_python: Whether to call it outside the compiled program, with numpy arrays.
    """

    function: Drive = static()
    in_python: bool = static(default=False)

    @property
    def name(self) -> str:
        """Name of the function."""
        return str(getattr(self.function, "__name__", type(self.function).__name__))

    def choose(self, bank: ScenarioBank, situation: Situation, observation: Any, key: Array) -> Action:
        """Return the function's action; NaN where it raised an error."""
        if not self.in_python:
            return jnp.ravel(jnp.asarray(self.function(situation, observation), jnp.float32))
        # The traffic state is internal.
        seen = replace(situation, context=replace(situation.context, traffic=()))
        context = situation.context
        identity, size = bank.identity[context.index], context.action.shape[0]
        return python_actions(self.function, identity, context.step, (seen, observation), size)


def jax_planner(function: Drive) -> FunctionPlanner:
    """Create a planner from a JAX function ``(situation, observation) -> action``.

    It becomes part of the compiled program: use ``jnp.where`` instead of ``if``.
    """
    return FunctionPlanner(function)


def python_planner(function: Drive) -> FunctionPlanner:
    """Create a planner from a Python function ``(situation, observation) -> action``.

    It is called scenario by scenario and step by step with numpy arrays. An error that it raises fails the episode
    (``evaluation.runner``). It must not call JAX, which waits for it.
    """
    return FunctionPlanner(function, in_python=True)


def python_actions(
    function: Callable[..., Any], identity: Array, step: Array, arguments: tuple[Any, ...], size: int
) -> Array:
    """Return ``size`` numbers of a Python function, called outside the compiled program; NaN where it raised an error.

    ``identity`` and ``step`` are those of the scenario, by which errors are collected (:func:`raised`); ``arguments``
    are pytrees, which the function gets as numpy arrays of one scenario.
    """

    def answer(identity: Any, steps: Any, arguments: Any) -> Any:
        identity, steps = np.asarray(identity), np.asarray(steps)
        return _answers(function, identity, steps, jax.tree.map(np.asarray, arguments), size)

    result = jax.ShapeDtypeStruct((size,), jnp.float32)
    return jax.pure_callback(answer, result, identity, step, arguments, vmap_method="broadcast_all")


@record
class NetworkPlanner(Memoryless):
    """A policy network that acts by its mode, or by a sample.

    Attributes:
        parameters: Weights of the network.
        graph: Structure of the network.
        samples: Whether to act by a sample.
    """

    parameters: Any
    graph: Any = static()
    name: str = static(default="policy")
    samples: bool = static(default=False)

    def choose(self, bank: ScenarioBank, situation: Situation, observation: Any, key: Array) -> Action:
        """Return the policy's action for the observation."""
        # Flax takes longer to import than the rest of this package; most planners have no network.
        from flax import nnx

        distribution = nnx.merge(self.graph, self.parameters)(observation)
        return distribution.action(distribution.sample(key)) if self.samples else distribution.mode()


@contextmanager
def raised() -> Iterator[dict[tuple[int, int], str]]:
    """Collect errors of Python functions, by the scenario's identity and the step of the log.

    Outside of this context errors end the program.
    """
    _listeners.append({})
    try:
        yield _listeners[-1]
    finally:
        _listeners.pop()


def _answers(
    function: Callable[..., Any], identity: Any, steps: Any, seen: tuple[Any, ...], size: int
) -> Any:
    """Return the function's action for each scenario of a batch of any shape."""
    actions = np.full((*identity.shape, size), np.nan, np.float32)
    for at in np.ndindex(identity.shape):
        try:
            action = np.asarray(function(*jax.tree.map(lambda leaf, at=at: leaf[at], seen)), np.float32)
            if action.size != size:
                raise ValueError(f"{list(action.shape)} is not an action; give {size} numbers")
            actions[at] = action.ravel()
        except Exception as error:
            if not _listeners:
                raise
            _listeners[-1][int(identity[at]), int(steps[at])] = error_text(error)
    return actions


def error_text(error: Exception) -> str:
    """Format an error with its line in the user's function."""
    if isinstance(error, PlannerError):
        return str(error)
    text = " ".join(f"{type(error).__name__}: {error}".split())
    places = traceback.extract_tb(error.__traceback__)
    theirs = [place for place in places if not Path(place.filename).is_relative_to(_PACKAGE)]
    return f"{text} ({Path(theirs[0].filename).name}:{theirs[0].lineno})" if theirs else text
