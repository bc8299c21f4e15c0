"""The most critical scenarios of a set, as a set of their own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from drivax.curation.scores import ScoreTable
from drivax.datasets.export import Exported, refuse_part, write_part
from drivax.errors import UsageError
from drivax.scenario.store import ScenarioSet, ScenarioWriter


def check_top(data: ScenarioSet, out: Path, count: int, overwrite: bool = False) -> None:
    """Refuses a subset that cannot be written, before any work is done.

    Raises:
        UsageError: There are not so many scenarios, or ``out`` exists, or is the set itself.
    """
    total = len(data)
    if not 1 <= count <= total:
        raise UsageError(f"the {count} most critical of {total} scenarios", cure=f"ask for 1 to {total}")
    refuse_part(data, out)
    ScenarioWriter(out, data.capacity, overwrite=overwrite)  # nothing is written before it is entered


def top_rows(table: ScoreTable, count: int) -> list[int]:
    """Rows of the scenarios with the highest scores, the most critical first; of equal ones the first in the set."""
    return [int(row) for row in np.argsort(-table.scenarios, kind="stable")[:count]]


def write_top(
    table: ScoreTable,
    data: ScenarioSet,
    count: int,
    out: Path,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Exported:
    """Writes the most critical scenarios as a scenario set, the most critical first.

    Args:
        table: Scores of ``data``.
        data: The set.
        count: How many.
        out: Folder to create.
        overwrite: Replace an existing scenario set.
        progress: Called with (scenarios done, scenarios).

    Raises:
        UsageError: There are not so many, or ``out`` exists.
    """
    check_top(data, out, count, overwrite)
    chosen_by = {"most_critical": count, "method": table.method, "config": dict(table.config)}
    return write_part(data, top_rows(table, count), out, overwrite, progress, chosen_by)
