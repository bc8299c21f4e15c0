"""Divergence in training: numbers that are not finite, which stop a seed, and large ones, which cause a warning."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from drivax.errors import DrivaxError
from drivax.learning.program import trained_leaves

#: Absolute logged values beyond which training warns: a KL divergence of 1 nat per iteration, and Q values that only
#: rewards of +-100 per step reach at a discount of 0.99.
_BOUNDS = {"loss/kl": 1.0, "loss/mean_q": 1e4, "loss/largest_q": 1e4}
#: Prefixes of logged values that must be finite, causes before their effects.
_PREFIXES = ("rollout/action_magnitude", "reward/", "loss/")


class DivergenceError(DrivaxError):
    """The training of a seed stopped because its rewards, losses, parameters or actions are not finite."""


def nonfinite_log(row: Mapping[str, float]) -> str | None:
    """Return the first action, reward or loss of an iteration that is NaN or infinite; None if there is none."""
    names = (name for prefix in _PREFIXES for name in row if name.startswith(prefix))
    return next((f"{name} is {_word(row[name])}" for name in names if not np.isfinite(row[name])), None)


def nonfinite_leaf(state: Any) -> str | None:
    """Return the first trained leaf of a seed's state with a NaN or infinite number; None if there is none."""
    for name, leaf in trained_leaves(state).items():
        values = np.asarray(leaf, np.float32)
        if not np.isfinite(values).all():
            return f"{name} is {_word(values)}"
    return None


def large_logs(row: Mapping[str, float]) -> dict[str, str]:
    """Return the logged values beyond their bounds by name, as text."""
    return {
        name: f"{name} is {row[name]:.3g}, beyond {bound:g}"
        for name, bound in _BOUNDS.items()
        if name in row and abs(row[name]) > bound
    }


def divergence_cure(problem: str, checkpoint: str | None) -> str:
    """Return the cure of a divergence, given the last healthy checkpoint as ``RUN@STEP``."""
    name = problem.split(" ")[0]
    term = name.removeprefix("reward/")
    change = "lower the learning rate" if term == name else f"correct the reward term {term}"
    if checkpoint is None:
        return f"{change} and start again with --overwrite; there is no healthy checkpoint yet"
    return f"{change} and start a new run from the last healthy checkpoint: --from {checkpoint}"


def _word(values: Any) -> str:
    return "NaN" if np.isnan(values).any() else "infinite"
