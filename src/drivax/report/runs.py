"""Run folders for a report: evaluations (episodes, trajectories) and training runs (learning curves)."""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.errors import DataError, UsageError
from drivax.evaluation.episode_table import EpisodeTable
from drivax.files import path_end
from drivax.seal import edited_files, mark_edited
from drivax.tracking.run_folder import RunFolder, seed_folders

Array = np.ndarray[Any, Any]
#: Maximum number of curves of a training; those of the presets have up to a hundred.
_MOST_CURVES = 10_000


@dataclass(frozen=True)
class TrainingCurves:
    """Learning curves of one training run: points (environment steps, value) by quantity.

    ``info`` is the content of ``run.json``.
    """

    folder: Path
    name: str
    info: Mapping[str, Any]
    curves: Mapping[str, Float[Array, "point 2"]]


def read_runs(folders: Sequence[Path]) -> tuple[list[EpisodeTable], list[TrainingCurves]]:
    """Read evaluation and training runs, with every seed of a run.

    An evaluation is named after its planner, a training run after its folder (a seed ``RUN/seed-N``). A repeated name
    gets as suffix the shortest end of its path that distinguishes it from the runs before it.

    Raises:
        DataError: A folder is missing, damaged, or neither an evaluation nor a training run.
        UsageError: No folder is given, or one twice.
    """
    folders = [seed_folder for folder in folders for seed_folder in seed_folders(folder)]
    paths = [folder.resolve() for folder in folders]
    if not folders:
        raise UsageError("no run folder is given", cure="drivax report RUN [RUN ...]")
    if repeated := [folder for row, folder in enumerate(folders) if paths[row] in paths[:row]]:
        raise UsageError("duplicate run", file=repeated[0], cure="name each run once")
    evaluations, trainings = [], []
    # A training and the evaluation of its policy may share a name: no table holds both.
    tables, charts = dict[str, list[Path]](), dict[str, list[Path]]()
    for folder, path in zip(folders, paths, strict=True):
        run = RunFolder.open(folder)
        if run.kind == "training":
            curves = _curves(run)
            label = f"{path.parent.name}/{path.name}" if path.name.startswith("seed-") else path.name
            name = mark_edited(label, edited_files(folder) or run.info.get("edited"))
            name = _unique_name(name, path, charts)
            trainings.append(TrainingCurves(folder, name, run.info, curves))
        elif run.kind == "evaluation":
            table = EpisodeTable.read(folder)
            _ = table.trajectories  # reads the file, to report damage before any work
            name = mark_edited(table.name, edited_files(folder))
            evaluations.append(replace(table, name=_unique_name(name, path, tables)))
        else:
            problem = f"is of kind {run.kind!r}, not evaluation or training"
            cure = "give folders written by drivax evaluate or drivax train"
            raise DataError(problem, file=folder / "run.json", cure=cure)
    return evaluations, trainings


def read_evaluations(folders: Sequence[Path]) -> list[EpisodeTable]:
    """Read the evaluations among run folders.

    Raises:
        DataError: As in :func:`read_runs`.
        UsageError: As in :func:`read_runs`, or no folder is an evaluation.
    """
    evaluations, _ = read_runs(folders)
    if not evaluations:
        raise UsageError("no run folder is an evaluation", cure="name run folders of drivax evaluate")
    return evaluations


def _unique_name(name: str, path: Path, namesakes: dict[str, list[Path]]) -> str:
    """Return the name, with a suffix if earlier runs have it; ``namesakes`` has the paths of all runs by name."""
    earlier = namesakes.setdefault(name, [])
    suffix = f" ({path_end(path, earlier)})" if earlier else ""
    earlier.append(path)
    return name + suffix


def _curves(run: RunFolder) -> dict[str, Array]:
    """Return the finite logged values of each quantity as points (environment steps, value)."""
    points: dict[str, array[float]] = {}
    for row in run.metric_rows():
        for name, value in row.items():
            if name not in ("step", "time_s") and isinstance(value, int | float) and math.isfinite(value):
                points.setdefault(name, array("d")).extend((float(row["step"]), float(value)))
        if len(points) > _MOST_CURVES:
            problem = f"has more than {_MOST_CURVES:,} quantities"
            raise DataError(problem, file=run.metrics, record=row["step"], cure="train again")
    return {name: np.frombuffer(values).reshape(-1, 2) for name, values in points.items()}
