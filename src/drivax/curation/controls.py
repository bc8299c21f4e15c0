"""Controls of curation: permuted scores, and the event labels of the built-in world."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from drivax.curation.scores import ScoreTable
from drivax.errors import DataError
from drivax.scenario.store import ScenarioSet
from drivax.synthetic.events import EventKind

Array = np.ndarray[Any, Any]


def permute_scores(table: ScoreTable, seed: int, usable: Bool[Array, "N T"] | None = None) -> ScoreTable:
    """Return the matched random control of a table: every scenario gets the scores of another one, cyclically shifted.

    The distribution of the scores is kept over all steps, within a scenario, and among scenarios; exactly where all
    scenarios have the same number of drawable steps. (Longer sequences are cut, shorter ones repeated.) Permuting
    single steps would spread large scores evenly over all scenarios, and the control would see more scenarios.

    Args:
        table: The table to match.
        seed: Seed of the permutation.
        usable: Steps that can be drawn (:func:`drivax.curation.weights.sampling_weights`).
    """
    rng = np.random.default_rng(seed)
    drawable = table.drawable if usable is None else usable
    steps, scenarios = table.steps.copy(), table.scenarios.copy()
    indices = np.flatnonzero(drawable.any(axis=1))
    for index, other in zip(indices, rng.permutation(indices), strict=True):
        scores = table.steps[other, drawable[other]]
        scores = np.roll(scores, rng.integers(len(scores)))
        steps[index, drawable[index]] = np.resize(scores, int(drawable[index].sum()))
        scenarios[index] = table.scenarios[other]
    config = {"like": table.method, "like_config": dict(table.config), "seed": seed}
    return replace(
        table, method="random_matched", config=config, steps=steps, scenarios=scenarios, components={}
    )


def event_steps(data: ScenarioSet) -> Bool[Array, "N T"]:
    """Return the steps within a labelled event of the built-in world.

    Raises:
        DataError: The set is not of the built-in world.
    """
    dataset = {str(entry["dataset"]) for entry in data.entries}
    if dataset != {"drivax"}:
        raise DataError(
            f"only the built-in world has event labels, this set is of {', '.join(sorted(dataset))}",
            file=data.path,
            cure="use another method, or a set that `drivax generate` made",
        )
    step = np.arange(data.capacity.steps)
    events = []
    for scenario in data:
        kind, first, last = (scenario.record[f"event_{name}"][:, None] for name in ("kind", "start", "end"))
        events.append(((kind > EventKind.NONE) & (step >= first) & (step <= last)).any(axis=0))
    return np.stack(events)


def event_kinds(data: ScenarioSet) -> Int[Array, " N"]:
    """Return the :class:`~drivax.synthetic.events.EventKind` of every scenario's first event, 0 where it has none."""
    return np.array([max(int(scenario.record["event_kind"][0]), 0) for scenario in data])
