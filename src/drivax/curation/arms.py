"""Arms of a curation study: training preset, method that scores the logged steps, and how scores become weights."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from drivax.curation.controls import permute_scores
from drivax.curation.scores import ScoreTable
from drivax.curation.weights import Scale, WeightConfig, sampling_weights
from drivax.errors import UsageError
from drivax.learning.experience import WeightedSet
from drivax.scenario.store import ScenarioSet

#: From the name of a method to its score table of a set.
Tables = Callable[[str], ScoreTable]


@dataclass(frozen=True)
class Arm:
    """An arm of a study.

    Attributes:
        preset: Its training configuration.
        method: Name of the curation method that scores its steps.
        scale: Whether weights are of steps or of scenarios.
        permuted: Whether the scores are permuted among scenarios: the matched random control of ``method``.
        weights: How scores become weights; None: as the study or the command line says.
    """

    preset: str = "offline/cql"
    method: str = "uniform"
    scale: Scale = "step"
    permuted: bool = False
    weights: WeightConfig | None = None


#: For labels, which are 0 or 1: the share of the draws that goes to steps of an event, on top of uniform draws. On the
#: benchmark's training set (one step in 40 is of an event) 0.115 gives the effective sample of rank weights, 0.66.
_LABELS, _STRONG_LABELS = (
    WeightConfig(normalise="none", temperature=1.0, most=math.inf, uniform=1.0 - share)
    for share in (0.115, 0.3)
)
#: Default weights depend on ranks, so their distribution is the same for all methods at either scale. Steps of each
#: method have a control of their own, since every method spreads its scores over scenarios differently.
ARMS: Mapping[str, Arm] = MappingProxyType(
    {
        "bc": Arm("offline/bc"),
        "baseline": Arm(),
        "cql_bc": Arm("offline/cql_bc"),
        "heuristic": Arm(method="kinematic"),
        "heuristic_scenario": Arm(method="kinematic", scale="scenario"),
        "ensemble": Arm(method="ensemble"),
        "ensemble_scenario": Arm(method="ensemble", scale="scenario"),
        "action_rarity": Arm(method="action_rarity"),
        "action_rarity_scenario": Arm(method="action_rarity", scale="scenario"),
        "random_matched": Arm(method="kinematic", permuted=True),
        "random_matched_ensemble": Arm(method="ensemble", permuted=True),
        "random_matched_action_rarity": Arm(method="action_rarity", permuted=True),
        "random_matched_scenario": Arm(method="kinematic", scale="scenario", permuted=True),
        "oracle": Arm(method="oracle", weights=_LABELS),
        "oracle_strong": Arm(method="oracle", weights=_STRONG_LABELS),
        "random_matched_oracle": Arm(method="oracle", permuted=True, weights=_LABELS),
    }
)
#: Arms that are curated by a method without labels; no controls.
CURATED = tuple(name for name in ARMS if name.startswith(("heuristic", "ensemble", "action_rarity")))


def control_of(name: str, arms: Mapping[str, Arm] = ARMS) -> str:
    """Return the matched random control of an arm: weights of the same distribution, randomly permuted.

    Raises:
        StopIteration: There is none.
    """
    arm = arms[name]
    return next(
        other
        for other, control in arms.items()
        if control.permuted
        and (control.scale, control.weights) == (arm.scale, arm.weights)
        and (arm.scale == "scenario" or control.method == arm.method)
    )


def weighted(
    arm: Arm,
    data: ScenarioSet,
    tables: Tables,
    config: WeightConfig,
    usable: np.ndarray | None = None,
    seed: int = 0,
) -> WeightedSet:
    """Return a set with the sampling weights of an arm.

    Args:
        arm: The arm.
        data: The set.
        tables: Score tables of the set.
        config: How scores become weights, for arms without ``weights``.
        usable: Steps that the training learns from (:func:`~drivax.curation.weights.sampling_weights`).
        seed: Seed of the permutation.

    Raises:
        UsageError: The table is of another method, or no step has a weight or a label.
    """
    table = tables(arm.method)
    if table.method != arm.method:
        raise UsageError(
            f"scores of {table.method!r} for an arm that is curated by {arm.method!r}",
            cure=f"drivax curate {arm.method} --data {data.path} --out SCORES",
        )
    if arm.method == "oracle" and not table.steps.any():
        raise UsageError("no scenario has a labelled event", file=data.path, cure="use an arm without labels")
    if arm.permuted:
        table = permute_scores(table, seed, usable)
    return WeightedSet(data, sampling_weights(table, arm.weights or config, arm.scale, usable))
