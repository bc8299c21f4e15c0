"""Arms of a curation study: training preset, method that scores the logged steps, and how scores become weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np

from drivax import settings
from drivax.curation.scores import ScoreTable
from drivax.curation.weights import Scale, WeightConfig, permute_scores, sampling_weights
from drivax.errors import UsageError
from drivax.learning.experience import WeightedSet
from drivax.scenario.store import ScenarioSet

#: Against the baseline, against the permuted control, by kind of scenario, other failures, between methods.
ClaimGroup = Literal["baseline", "control", "where", "failures", "methods"]
#: From the name of a method to its score table of a set.
Tables = Callable[[str], ScoreTable]


@dataclass(frozen=True)
class Arm:
    """An arm of a study.

    Attributes:
        preset: Training configuration.
        method: Curation method that scores the steps.
        scale: Whether weights are of steps or of scenarios.
        permuted: Whether scores are permuted among scenarios: the matched random control of ``method``.
        weights: How scores become weights; None: as the study or the command line says.
    """

    preset: str = "offline/cql"
    method: str = "uniform"
    scale: Scale = "step"
    permuted: bool = False
    weights: WeightConfig | None = None


@dataclass(frozen=True)
class Claim:
    """A claim about two arms.

    Attributes:
        words: The claim.
        arm, reference: The arm that is claimed to be better, and the arm that it is compared with.
        group: Claims whose p-values are adjusted together.
        rows: ``ordinary``, ``common`` or ``rare`` scenarios.
        change: Claimed relative change, at least; None: only its direction is claimed.
    """

    words: str
    arm: str
    reference: str
    group: ClaimGroup
    metric: str = "collision"
    rows: str = "ordinary"
    change: float | None = None


@dataclass(frozen=True)
class StudyDefinition:
    """Arms and claims of a study, as ``configs/studies/NAME.yaml`` declares them."""

    arms: dict[str, Arm]
    claims: tuple[Claim, ...]


#: The long-tail study.
LONGTAIL = settings.load(StudyDefinition, "studies/longtail")
ARMS: Mapping[str, Arm] = MappingProxyType(LONGTAIL.arms)


def weighted(
    arm: Arm, data: ScenarioSet, tables: Tables, config: WeightConfig, usable: np.ndarray | None = None, seed: int = 0
) -> WeightedSet:  # fmt: skip
    """Return a set with the sampling weights of an arm; ``config`` is for arms without ``weights``.

    ``usable`` are the steps that the training learns from; ``seed`` is that of the permutation.

    Raises:
        UsageError: The table is of another method, or no step has a weight or a label.
    """
    table = tables(arm.method)
    if table.method != arm.method:
        problem = f"scores of {table.method!r} for an arm that is curated by {arm.method!r}"
        raise UsageError(problem, cure=f"drivax curate {arm.method} --data {data.path} --out SCORES")
    if arm.method == "oracle" and not table.steps.any():
        raise UsageError("no scenario has a labelled event", file=data.path, cure="use an arm without labels")
    if arm.permuted:
        table = permute_scores(table, seed, usable)
    return WeightedSet(data, sampling_weights(table, arm.weights or config, arm.scale, usable))
