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
#: Active collectors of errors; the innermost one receives them.
_collectors: list[dict[tuple[int, int], str]] = []


class PlannerError(Exception):
    """A failure of a planner, shown without a location in the user's code."""


@record
class FunctionPlanner(Memoryless):
    """A planner that calls a function, created by :func:`jax_planner` and :func:`python_planner`.

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
        """Return the function's action; NaN if a Python function raises an error in :func:`collect_errors`."""
        if not self.in_python:
            return jnp.ravel(jnp.asarray(self.function(situation, observation), jnp.float32))
        context = situation.context
        # The traffic state is internal.
        situation = replace(situation, context=replace(context, traffic=()))
        identity, size = bank.identity[context.index], context.action.shape[0]
        return python_actions(self.function, identity, context.step, (situation, observation), size)


def jax_planner(function: Drive) -> FunctionPlanner:
    """Create a planner from a JAX function ``(situation, observation) -> action``.

    It becomes part of the compiled program: use ``jnp.where`` instead of ``if``.
    """
    return FunctionPlanner(function)


def python_planner(function: Drive) -> FunctionPlanner:
    """Create a planner from a Python function ``(situation, observation) -> action``.

    Each call gets numpy arrays of one scenario at one step. An error fails the episode (``evaluation.runner``). The
    function must not call JAX: the compiled program waits for the function, so both would wait forever.
    """
    return FunctionPlanner(function, in_python=True)


def python_actions(
    function: Callable[..., Any], identity: Array, step: Array, arguments: tuple[Any, ...], size: int
) -> Array:
    """Call a Python function outside the compiled program, and return its ``size`` numbers.

    If the function raises an error, the numbers are NaN within :func:`collect_errors`; elsewhere the program ends.

    Args:
        function: Gets ``arguments`` as numpy arrays of one scenario.
        identity: Identity of the scenario, a key of collected errors (:func:`collect_errors`).
        step: Step of the log, a key of collected errors.
        arguments: Pytrees of arrays.
        size: Number of values that the function returns.
    """

    def call(identity: Any, steps: Any, arguments: Any) -> Any:
        """Convert the arrays of a batch to NumPy, and call the function for each scenario."""
        identity, steps = np.asarray(identity), np.asarray(steps)
        return _call_batch(function, identity, steps, jax.tree.map(np.asarray, arguments), size)

    result_type = jax.ShapeDtypeStruct((size,), jnp.float32)
    return jax.pure_callback(call, result_type, identity, step, arguments, vmap_method="broadcast_all")


@record
class NetworkPlanner(Memoryless):
    """A policy network that acts by the mode of its action distribution, or by a sample.

    Attributes:
        parameters: Weights of the network.
        graph: Structure of the network.
        name: Name in tables.
        samples: Whether to sample the action instead of taking the mode.
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
def collect_errors() -> Iterator[dict[tuple[int, int], str]]:
    """Collect errors of Python functions by scenario identity and step of the log.

    The value of an entry is the text of the error. Outside of this context, errors end the program.
    """
    _collectors.append({})
    try:
        yield _collectors[-1]
    finally:
        _collectors.pop()


def _call_batch(
    function: Callable[..., Any], identity: Any, steps: Any, arguments: tuple[Any, ...], size: int
) -> Any:
    """Return the function's action for each scenario of a batch of any shape; NaN for errors, which are collected."""
    actions = np.full((*identity.shape, size), np.nan, np.float32)
    for index in np.ndindex(identity.shape):
        try:
            scenario_arguments = jax.tree.map(lambda leaf, index=index: leaf[index], arguments)
            result = function(*scenario_arguments)
            if result is None:
                raise ValueError(f"the function returned nothing; return {size} numbers")
            action = np.asarray(result, np.float32)
            if action.size != size:
                raise ValueError(f"the function returned {action.size} numbers; return {size}")
            actions[index] = action.ravel()
        except Exception as error:
            if not _collectors:
                raise
            _collectors[-1][int(identity[index]), int(steps[index])] = error_text(error)
    return actions


def error_text(error: Exception) -> str:
    """Format an error as one line, with its location in the user's code if the traceback has one."""
    if isinstance(error, PlannerError):
        return str(error)
    text = " ".join(f"{type(error).__name__}: {error}".split())
    frames = traceback.extract_tb(error.__traceback__)
    user_frames = [frame for frame in frames if not Path(frame.filename).is_relative_to(_PACKAGE)]
    if not user_frames:
        return text
    return f"{text} ({Path(user_frames[0].filename).name}:{user_frames[0].lineno})"
