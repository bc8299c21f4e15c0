"""Write the most critical scenarios of a set as a scenario set with scores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from drivax.curation.scores import OWN_SCORES, ScoreTable, write_scores
from drivax.datasets.export.writer import Exported, refuse_part, write_part
from drivax.errors import UsageError
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.stats.clusters import recordings_of

#: Candidates per selected scenario, among which those that differ are selected.
_CANDIDATES = 4


def check_top(
    data: ScenarioSet, out: Path, count: int, overwrite: bool = False, all_windows: bool = False
) -> None:
    """Check, before any work, that a subset can be written.

    Raises:
        UsageError: ``count`` is below 1, the set has fewer recordings (with ``all_windows``: scenarios), or ``out``
            exists or is the set.
    """
    total, recordings = len(data), len(set(recordings_of(data.entries)))
    if not all_windows and recordings < total and not 1 <= count <= recordings:
        cure = f"ask for 1 to {recordings}"
        if 1 <= count <= total:
            cure += f", or pass --all-windows to choose among all {total} scenarios"
        problem = f"cannot select {count} scenarios from {recordings} recordings, one of each"
        raise UsageError(problem, cure=cure)
    if not 1 <= count <= total:
        raise UsageError(f"cannot select {count} of {total} scenarios", cure=f"ask for 1 to {total}")
    refuse_part(data, out)
    ScenarioWriter(out, data.capacity, overwrite=overwrite)  # checks ``out``, writes nothing


def top_rows(table: ScoreTable, count: int, recordings: Sequence[str] | None = None) -> list[int]:
    """Return the indices of the ``count`` most critical scenarios, or all if fewer, by ``ScoreTable.order``.

    Given the recording of every scenario, only the most critical scenario of each recording is considered.
    """
    indices = table.order
    if recordings is not None:
        first = np.unique(np.asarray(recordings)[indices], return_index=True)[1]
        indices = indices[np.sort(first)]
    return indices[:count].tolist()


def diverse_rows(rows: Sequence[int], embedding: Float[np.ndarray, "N D"], count: int) -> list[int]:
    """Return up to ``count`` scenarios that differ: a greedy k-center of the most critical ones.

    Among the first ``4 count`` of ``rows``, which are in descending order of their scores, the first is selected, then
    always the one that is farthest from those selected (Gonzalez 1985, 2-approximation of the k-center). Scenarios
    with the same embedding as a selected one are duplicates, and left out. The result is in the order of ``rows``.
    """
    candidates = np.asarray(rows[: _CANDIDATES * count])
    values = embedding[candidates].astype(np.float64)
    selected, distance = [0], np.linalg.norm(values - values[0], axis=1)
    while len(selected) < min(count, len(candidates)):
        farthest = int(distance.argmax())
        if distance[farthest] < 1e-6:
            break
        selected.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(values - values[farthest], axis=1))
    return candidates[np.sort(selected)].tolist()


def subset_of_table(table: ScoreTable, indices: Sequence[int], subset: ScenarioSet) -> ScoreTable:
    """Return the scores of a subset that ``write_part`` wrote.

    ``indices`` are the scenarios in the whole set, in the order of the subset. ``part_of`` in the configuration of the
    result identifies the whole set.
    """
    order = list(indices)
    part_of = subset.manifest["source"]["part_of"]
    part_of = {name: value for name, value in part_of.items() if name not in ("method", "config")}
    ids = tuple(table.scenario_ids[index] for index in order)
    logs = (np.array(order)[:, None] * table.egos + np.arange(table.egos)).reshape(-1)
    scores = {"valid": table.valid[logs], "steps": table.steps[logs], "scenarios": table.scenarios[order]}
    components = {name: component[logs] for name, component in table.components.items()}
    config = {**table.config, "part_of": part_of}
    return replace(
        table, config=config, set_hash=subset.hash, scenario_ids=ids, components=components, **scores
    )


def write_top(
    table: ScoreTable, data: ScenarioSet, count: int, out: Path, overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None, all_windows: bool = False,
    embedding: Float[np.ndarray, "N D"] | None = None,
) -> Exported:  # fmt: skip
    """Write the ``count`` most critical scenarios as a scenario set, in descending order, with their scores.

    Without ``all_windows``, only the most critical scenario of each recording is considered. Given an ``embedding`` of
    every scenario, those among the most critical that differ are written (:func:`diverse_rows`), without duplicates.
    ``progress`` is called with (scenarios done, scenarios).

    Raises:
        UsageError: See :func:`check_top`.
    """
    check_top(data, out, count, overwrite, all_windows)
    considered = len(data) if embedding is not None else count
    indices = top_rows(table, considered, None if all_windows else recordings_of(data.entries))
    selection = {
        "most_critical": count, "all_windows": all_windows, "method": table.method, "config": dict(table.config)
    }  # fmt: skip
    if embedding is not None:
        indices, selection["diverse"] = diverse_rows(indices, embedding, count), True

    def write_own_scores(folder: Path) -> None:
        write_scores(subset_of_table(table, indices, ScenarioSet.open(folder)), folder / OWN_SCORES)

    return write_part(data, indices, out, overwrite, progress, selection, write_own_scores)
