"""A moving average of parameters, which is validated and exported in place of those that are trained.

States of averaging algorithms have fields ``parameters`` (of the planner), ``trained`` (None without an average) and
``iteration``.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax

from drivax.errors import UsageError


def check_average(decay: float) -> None:
    """Raise UsageError if the decay of an average is outside [0, 1)."""
    if not 0.0 <= decay < 1.0:
        raise UsageError(f"average is {decay}", cure="use 0 or more, and less than 1")


def unless_first(state: Any, parameters: Any) -> Any:
    """Return ``parameters``; before the first iteration those of the planner, which pretraining may have set."""
    return jax.tree.map(partial(jnp.where, state.iteration == 0), state.parameters, parameters)


def trained_parameters(state: Any) -> Any:
    """Return the parameters that are trained."""
    return state.parameters if state.trained is None else unless_first(state, state.trained)


def average(state: Any, trained: Any, decay: float) -> dict[str, Any]:
    """Return ``parameters`` and ``trained`` after an iteration that begins in ``state`` and ends with ``trained``.

    The average is the mean over all iterations for the first ``1 / (1 - decay)`` of them, then exponential.
    """
    if state.trained is None:
        return {"parameters": trained, "trained": None}
    rate = jnp.maximum(1.0 - decay, 1.0 / (state.iteration + 1))
    return {"parameters": optax.incremental_update(trained, state.parameters, rate), "trained": trained}
