"""What curation has to be compared with: no preference, a preference by lot, and the truth."""

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


def matched(table: ScoreTable, seed: int, usable: Bool[Array, "N T"] | None = None) -> ScoreTable:
    """The scores of a table, dealt out anew by lot: each scenario is given those of another, from a random step on.

    What weights prefer is chance then, but how they are spread stays: over all steps, within a scenario, and among
    scenarios; exactly where equally many steps of all scenarios can be drawn. (A row that is too long is cut, one that
    is too short begins anew.) Steps that were dealt out one by one would spread over all scenarios alike, and a
    weighting of single steps would be compared with more scenarios than it sees itself.

    Args:
        table: What to match.
        seed: Of the lot.
        usable: Which steps can be drawn (:func:`drivax.curation.weights.weights_of`).
    """
    rng = np.random.default_rng(seed)
    drawn = table.drawn if usable is None else usable
    steps, scenarios = table.steps.copy(), table.scenarios.copy()
    rows = np.flatnonzero(drawn.any(axis=1))
    for row, other in zip(rows, rng.permutation(rows), strict=True):
        scores = table.steps[other, drawn[other]]
        scores = np.roll(scores, rng.integers(len(scores)))
        steps[row, drawn[row]] = np.resize(scores, int(drawn[row].sum()))
        scenarios[row] = table.scenarios[other]
    config = {"like": table.method, "like_config": dict(table.config), "seed": seed}
    return replace(
        table, method="random_matched", config=config, steps=steps, scenarios=scenarios, components={}
    )


def event_steps(data: ScenarioSet) -> Bool[Array, "N T"]:
    """At which steps a labelled event of the built-in world goes on.

    Raises:
        DataError: The set is not of the built-in world, or of before its labels.
    """
    dataset = {str(entry["dataset"]) for entry in data.entries}
    if dataset != {"drivax"}:
        raise DataError(
            f"only the built-in world knows its rare events, this set is of {', '.join(sorted(dataset))}",
            file=data.path,
            cure="use another method, or a set that `drivax generate` made",
        )
    step = np.arange(data.capacity.steps)
    rows = []
    for scenario in data:
        kind, first, last = (scenario.record[f"event_{name}"][:, None] for name in ("kind", "start", "end"))
        rows.append(((kind > EventKind.NONE) & (step >= first) & (step <= last)).any(axis=0))
    return np.stack(rows)


def event_kinds(data: ScenarioSet) -> Int[Array, " N"]:
    """Kind of the first event of every scenario (:class:`drivax.synthetic.events.EventKind`), 0 where there is none."""
    return np.array([max(int(scenario.record["event_kind"][0]), 0) for scenario in data])
