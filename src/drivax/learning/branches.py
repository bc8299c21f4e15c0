"""Branches that stay branches when several learners run side by side."""

from __future__ import annotations

from typing import Any

from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool


@custom_vmap
def in_any(condition: Bool[Array, "*batch"]) -> Bool[Array, ""]:
    """Whether it holds anywhere: in the batch, and under ``vmap`` in any learner.

    ``jax.lax.cond`` on a condition per learner would compute both sides of every branch; on this one it branches.
    Learners that train side by side are in the same iteration, so phases of a run lose nothing by it.
    """
    return condition.any()


@in_any.def_vmap
def _in_any_learner(
    axis_size: int, in_batched: Any, condition: Bool[Array, "*batch"]
) -> tuple[Bool[Array, ""], bool]:
    return in_any(condition.reshape(-1)), False
