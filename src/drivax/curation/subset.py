"""The most critical scenarios of a set, as a set of their own that holds their scores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from drivax.curation.scores import OWN_SCORES, ScoreTable, write_scores
from drivax.datasets.export.writer import Exported, refuse_part, write_part
from drivax.errors import UsageError
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.stats.clusters import recordings_of


def check_top(
    data: ScenarioSet, out: Path, count: int, overwrite: bool = False, all_windows: bool = False
) -> None:
    """Refuses a subset that cannot be written, before any work is done.

    Raises:
        UsageError: There are not so many recordings (with ``all_windows``: scenarios), or ``out`` exists, or is the
            set itself.
    """
    total, found = len(data), len(set(recordings_of(data.entries)))
    if not all_windows and found < total and not 1 <= count <= found:
        raise UsageError(
            f"the {count} most critical of {found} recordings, one scenario of each",
            cure=f"ask for 1 to {found}, or pass --all-windows to choose among all {total} scenarios",
        )
    if not 1 <= count <= total:
        raise UsageError(f"the {count} most critical of {total} scenarios", cure=f"ask for 1 to {total}")
    refuse_part(data, out)
    ScenarioWriter(out, data.capacity, overwrite=overwrite)  # nothing is written before it is entered


def top_rows(table: ScoreTable, count: int, recordings: Sequence[str] | None = None) -> list[int]:
    """Rows of the most critical scenarios, in their order (``ScoreTable.order``).

    Args:
        table: The scores.
        count: How many, at most.
        recordings: Of every row; only the most critical scenario of each counts. None: all scenarios do.
    """
    rows = table.order
    if recordings is not None:
        first = np.unique(np.asarray(recordings)[rows], return_index=True)[1]
        rows = rows[np.sort(first)]
    return rows[:count].tolist()


def part_of_table(table: ScoreTable, rows: Sequence[int], part: ScenarioSet) -> ScoreTable:
    """The scores of a part of a set; which one and of what, its configuration says as ``part_of``.

    Args:
        table: Scores of the whole set.
        rows: Which of them, in the order of the part.
        part: The part, as :func:`~drivax.datasets.export.writer.write_part` writes it.
    """
    chosen = list(rows)
    told = part.manifest["source"]["part_of"]
    told = {name: value for name, value in told.items() if name not in ("method", "config")}
    return replace(
        table,
        config={**table.config, "part_of": told},
        set_hash=part.hash,
        scenario_ids=tuple(table.scenario_ids[row] for row in chosen),
        valid=table.valid[chosen],
        steps=table.steps[chosen],
        scenarios=table.scenarios[chosen],
        components={name: component[chosen] for name, component in table.components.items()},
    )


def write_top(
    table: ScoreTable,
    data: ScenarioSet,
    count: int,
    out: Path,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    all_windows: bool = False,
) -> Exported:
    """Writes the most critical scenarios as a scenario set, the most critical first, and their scores in its folder.

    Args:
        table: Scores of ``data``.
        data: The set.
        count: How many.
        out: Folder to create.
        overwrite: Replace an existing scenario set.
        progress: Called with (scenarios done, scenarios).
        all_windows: Choose among all scenarios, not only the most critical one of each recording.

    Raises:
        UsageError: There are not so many, or ``out`` exists.
    """
    check_top(data, out, count, overwrite, all_windows)
    rows = top_rows(table, count, None if all_windows else recordings_of(data.entries))
    how = {"most_critical": count, "all_windows": all_windows}
    chosen_by = {**how, "method": table.method, "config": dict(table.config)}

    def further(folder: Path) -> None:
        write_scores(part_of_table(table, rows, ScenarioSet.open(folder)), folder / OWN_SCORES)

    return write_part(data, rows, out, overwrite, progress, chosen_by, further)
