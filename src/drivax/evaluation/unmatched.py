"""Why two evaluations cannot be compared, each reason in one line with its cure."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from drivax.errors import UsageError, did_you_mean
from drivax.evaluation.results import NOT_SUMMARISED
from drivax.evaluation.stored import EpisodeTable, mismatch


def refuse_misfits(a: Sequence[EpisodeTable], b: Sequence[EpisodeTable]) -> None:
    """Refuses evaluations whose episodes are no pairs.

    Args:
        a: The evaluations of A's seeds.
        b: Those of B's.

    Raises:
        UsageError: One is named twice; a side holds several planners; or they drove different sets, in different
            traffic, or from different starts.
    """
    tables = (*a, *b)
    if len({table.folder.resolve() for table in tables}) < len(tables):
        raise UsageError("A and B are the same run", file=a[0].folder, cure="name two runs")
    for side in (a, b):
        # The seeds of a policy are numbered at the end, before the checkpoint; two checkpoints are two planners.
        planners = {re.sub(r"^(.*?)[0-9]*(@[0-9]+)?$", r"\1\2", table.name): table.name for table in side}
        if len(planners) > 1:
            names = ", ".join(sorted(planners.values()))
            raise UsageError(
                f"holds evaluations of several planners ({names})",
                file=side[0].folder.parent,
                cure=f"name one of them, as {side[0].folder}",
            )
    for table in tables[1:]:
        _refuse_pair(tables[0], table)


def _refuse_pair(one: EpisodeTable, other: EpisodeTable) -> None:
    if found := mismatch(one, other):
        problem, cure = found
        raise UsageError(f"{one.folder} and {other.folder} {problem}", cure=cure)


def refuse_metric(metric: str, tables: Sequence[EpisodeTable], *, primary: bool) -> None:
    """Refuses a metric that a comparison cannot use.

    Args:
        metric: Its name.
        tables: The evaluations.
        primary: Whether it decides, which takes a direction.

    Raises:
        UsageError: An evaluation lacks it; it is a code or count, or a partial score; or it cannot decide.
    """
    for table in tables:
        if metric not in table.metrics:
            known = [name for name in table.metrics if all(name in other.metrics for other in tables)]
            raise UsageError(f"{table.folder} has no metric {metric!r}", cure=did_you_mean(metric, known))
    if metric in NOT_SUMMARISED:
        raise UsageError(f"no mean of {metric} makes sense", cure="choose another metric")
    if metric.endswith("_partial"):
        whole = metric.removesuffix("_partial")
        raise UsageError(
            f"{metric} is made up differently from scenario to scenario, so that no mean makes sense",
            cure=f"choose {whole}, or one of its inputs",
        )
    found = tables[0].metric(metric)
    if primary and (found is None or found.better == "-"):
        raise UsageError(f"{metric} is neither better high nor low", cure="choose another primary metric")


def refuse_undefined(metric: str, tables: Sequence[EpisodeTable]) -> None:
    """Refuses a primary metric without a single value to compare.

    Raises:
        UsageError: Always; it says whether the scores are partial.
    """
    partial = [table.metrics.get(f"{metric}_partial", np.full(1, np.nan)) for table in tables]
    if any(not np.isnan(values).all() for values in partial):
        raise UsageError(
            f"every {metric} is partial: one of its inputs is undefined in these scenarios",
            cure="choose another primary metric, as success or accuracy",
        )
    raise UsageError(
        f"{metric} is defined for A and B in no common scenario", cure="choose another primary metric"
    )
