"""Scores of an episode from its metrics; in [0, 1] by construction. Definitions: semantics, Metrics."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drivax.scenario.record import record


@record
class Value:
    """A metric's value and whether it is defined; an undefined value is never read as a number."""

    value: Float[Array, "*batch"]
    defined: Bool[Array, "*batch"]


#: Weights of the two scores, and the metrics that multiply them.
NUPLAN_WEIGHTS = {"ttc_ok": 5.0, "progress_ratio": 5.0, "speed_compliance": 4.0, "comfortable": 2.0}
VMAX_WEIGHTS = {**NUPLAN_WEIGHTS, "lane_keeping": 3.0}
NUPLAN_GATES = ("at_fault_collision", "offroad")
VMAX_GATES = (*NUPLAN_GATES, "red_light")
_PASSES = ("making_progress", "direction")
NUPLAN_INPUTS = (*NUPLAN_WEIGHTS, *NUPLAN_GATES, *_PASSES)
VMAX_INPUTS = (*VMAX_WEIGHTS, *VMAX_GATES, *_PASSES)


def score(
    metrics: Mapping[str, Value], weights: Mapping[str, float], gates: tuple[str, ...]
) -> tuple[Value, Value]:
    """Weighted mean of metrics in [0, 1], times one minus each gate, times progress and direction.

    Returns:
        The full score, defined where every input is; and the partial one, where some input is undefined: undefined
        terms leave the weighted mean, undefined gates count as passed.
    """
    terms = jnp.stack([jnp.clip(metrics[name].value, 0.0, 1.0) for name in weights])
    known = jnp.stack([metrics[name].defined for name in weights])
    share = jnp.asarray(list(weights.values()))[(...,) + (None,) * (terms.ndim - 1)] * known
    total = share.sum(axis=0)
    mean = (share * terms).sum(axis=0) / jnp.maximum(total, 1e-9)
    complete = known.all(axis=0)
    for name in gates:
        mean = mean * jnp.where(metrics[name].defined, 1.0 - metrics[name].value, 1.0)
        complete = complete & metrics[name].defined
    for name in _PASSES:
        mean = mean * jnp.where(metrics[name].defined, metrics[name].value, 1.0)
        complete = complete & metrics[name].defined
    return Value(mean, complete), Value(mean, ~complete & (total > 0))


def nuplan_score(metrics: Mapping[str, Value]) -> tuple[Value, Value]:
    """NuPlan's closed-loop score: full and partial."""
    return score(metrics, NUPLAN_WEIGHTS, NUPLAN_GATES)


def vmax_score(metrics: Mapping[str, Value]) -> tuple[Value, Value]:
    """The V-Max aggregate: nuPlan's terms and lane keeping, gated by red lights too; full and partial."""
    return score(metrics, VMAX_WEIGHTS, VMAX_GATES)
