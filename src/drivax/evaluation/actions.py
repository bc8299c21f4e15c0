"""What a planner asked of its car, step by step, and how unsteadily it did."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int

Array = np.ndarray[Any, Any]


def until_crash(
    actions: Float[Array, "episode step D"], crashed: Int[Array, " episode"], start: int
) -> Float[Array, "episode step D"]:
    """Actions with NaN from the step on at which the planner crashed: what follows is not its own.

    Args:
        actions: One per step from ``start`` on.
        crashed: The step of the log at which each did, -1 for none.
        start: The step of the log of the first action.
    """
    step = start + np.arange(actions.shape[1])
    own = (crashed[:, None] < 0) | (step < crashed[:, None])
    return np.where(own[..., None], actions, np.nan)


def action_jerk(actions: Float[Array, "episode step D"]) -> Float64[Array, " episode"]:
    """Standard deviation of the change of the action from one step to the next, the root of the mean over its numbers.

    ``sqrt(mean_d var_t(a[t + 1, d] - a[t, d]))`` with the population's variance. A steady change (a ramp) has none;
    uniform random actions in [-1, 1] have about ``sqrt(2 / 3) = 0.82``. In the units of the action space.

    Args:
        actions: NaN where there is none.

    Returns:
        NaN where there are fewer than two actions.
    """
    change = np.diff(np.asarray(actions, np.float64), axis=1)
    with warnings.catch_warnings():
        # Less than two actions have no change, of which NumPy warns.
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.sqrt(np.nanvar(change, axis=1).mean(axis=-1))
