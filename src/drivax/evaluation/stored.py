"""Evaluations read back from their run folders, and the pairs of episodes that two of them make."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float, Float64

from drivax import settings
from drivax.errors import DataError
from drivax.evaluation.results import ADDED, KEYS, Results
from drivax.metrics.catalogue import METRICS, Column, Direction
from drivax.scenario.store import ScenarioSet
from drivax.stats.clusters import recordings
from drivax.tracking.run_folder import CONFIG_FILE

#: The cure for a run folder that is damaged.
AGAIN = "run drivax evaluate again"

#: Settings of an evaluation that make other episodes.
ALIKE = ("noisy_start", "start_step")

Array = np.ndarray[Any, Any]
#: A scenario of a data set: ``(dataset, scenario_id)``.
ScenarioKey = tuple[str, str]


@dataclass(frozen=True)
class EpisodeTable:
    """What one planner did in one scenario set: the rows of its ``episodes.csv``.

    Attributes:
        folder: The run folder.
        name: Name of the planner in tables.
        about: ``run.json``.
        keys: Columns of :data:`KEYS`, as text.
        metrics: Columns of metrics; NaN where undefined.
    """

    folder: Path
    name: str
    about: Mapping[str, Any]
    keys: Mapping[str, tuple[str, ...]]
    metrics: Mapping[str, Float[Array, " episode"]]

    @classmethod
    def of(cls, results: Results) -> EpisodeTable:
        """The episodes of an evaluation that has just been made, as if read back; all digits, and no folder."""
        rows = results.rows()
        keys = {name: tuple(row[name] for row in rows) for name in KEYS}
        about = {"planner": results.planner, "traffic": results.traffic, **results.notes()}
        return cls(Path(os.devnull), results.planner, about, keys, results.metrics)

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.keys["scenario_id"])

    @property
    def traffic(self) -> str:
        """How the other agents moved: ``log`` or ``idm``."""
        return str(self.about.get("traffic", "log"))

    @property
    def own_metrics(self) -> Mapping[str, Column]:
        """What the run says about metrics of the user's own."""
        told = self.about.get("own_metrics") or {}
        return {
            name: Column(str(m["unit"]), cast(Direction, str(m["better"])), str(m["text"]))
            for name, m in told.items()
        }

    @property
    def data(self) -> Mapping[str, Any]:
        """Path, hash and name of the scenario set, as far as they are known."""
        data = self.about.get("data") or {}
        return data[0] if isinstance(data, list) and data else data if isinstance(data, dict) else {}

    @cached_property
    def settings(self) -> Mapping[str, Any]:
        """What ``config.yaml`` says; nothing where there is none."""
        file = self.folder / CONFIG_FILE
        found = settings.parse_yaml(file.read_text(encoding="utf-8"), file) if file.is_file() else {}
        return found if isinstance(found, dict) else {}

    @property
    def scenarios(self) -> list[ScenarioKey]:
        """The scenario of every episode."""
        return list(zip(self.keys["dataset"], self.keys["scenario_id"], strict=True))

    @property
    def clusters(self) -> list[str]:
        """Cluster of every episode: its segment, or its scenario where no segment is known."""
        return recordings(*(self.keys[name] for name in ("dataset", "segment", "scenario_id")))

    def metric(self, name: str) -> Column | None:
        """Unit and direction of a metric; None where nobody told."""
        return METRICS.get(name) or ADDED.get(name) or self.own_metrics.get(name)

    def by_scenario(self, metric: str) -> dict[ScenarioKey, float]:
        """Mean of a metric per scenario over its defined episodes; NaN where there is none."""
        values = self.metrics.get(metric)
        gathered: dict[ScenarioKey, list[float]] = {}
        for row, key in enumerate(self.scenarios):
            gathered.setdefault(key, []).append(math.nan if values is None else float(values[row]))
        means = {}
        for key, cells in gathered.items():
            there = [cell for cell in cells if not math.isnan(cell)]
            means[key] = float(np.mean(there)) if there else math.nan
        return means


@dataclass(frozen=True)
class Pairs:
    """The scenarios that evaluations have in common, in the order of the first.

    Attributes:
        keys: The scenarios.
        clusters: Cluster of each.
    """

    keys: tuple[ScenarioKey, ...]
    clusters: tuple[str, ...]

    @classmethod
    def of(cls, one: EpisodeTable, *others: EpisodeTable) -> Pairs:
        """The common scenarios of evaluations."""
        cluster = dict(zip(one.scenarios, one.clusters, strict=True))
        driven = [set(other.scenarios) for other in others]
        keys = tuple(key for key in cluster if all(key in theirs for theirs in driven))
        return cls(keys, tuple(cluster[key] for key in keys))

    def values(self, table: EpisodeTable, metric: str) -> Float64[Array, " scenario"]:
        """A metric of one of the evaluations, scenario by scenario; repeated episodes are averaged."""
        means = table.by_scenario(metric)
        return np.array([means[key] for key in self.keys], np.float64)


def mismatch(one: EpisodeTable, other: EpisodeTable) -> tuple[str, str] | None:
    """What makes the episodes of two runs no pairs, in words that follow their names, and its cure; None: nothing.

    They have to have driven the same scenario set, in the same traffic, from the same starts.
    """
    hashes = [str(run.data.get("hash") or "") for run in (one, other)]
    if all(hashes) and hashes[0] != hashes[1]:
        sets = f"{hashes[0][:12]} and {hashes[1][:12]}"
        return f"drove different scenario sets ({sets})", "evaluate both with the same --data"
    if one.traffic != other.traffic:
        traffic = f"{one.traffic} and {other.traffic}"
        return f"drove in different traffic ({traffic})", "evaluate both with the same --traffic"
    for name in ALIKE:
        values = [run.settings.get(name) for run in (one, other)]
        if None not in values and values[0] != values[1]:
            return f"differ in {name} ({values[0]} and {values[1]})", "evaluate both with the same"
    return None


def comparable(one: EpisodeTable, other: EpisodeTable) -> bool:
    """Whether the episodes of two runs can be paired."""
    return mismatch(one, other) is None


def read_evaluation(folder: Path) -> EpisodeTable:
    """The episodes of a run folder of ``drivax evaluate``.

    Raises:
        DataError: The folder or a file is missing or damaged, or it is no evaluation.
    """
    about = read_about(folder)
    if about.get("kind") != "evaluation":
        raise DataError(
            f"is of kind {about.get('kind')!r}, not evaluation",
            file=folder / "run.json",
            cure="give a folder written by drivax evaluate",
        )
    return EpisodeTable(folder, str(about.get("planner", folder.name)), about, *read_episodes(folder))


def read_seeds(folder: Path) -> tuple[EpisodeTable, ...]:
    """The evaluation in a folder; or those in its sub-folders, one for each seed of a policy, in order of their names.

    Raises:
        DataError: A folder or a file is missing or damaged, or there is no evaluation.
    """
    inside = sorted(file.parent for file in folder.glob("*/episodes.csv"))
    if (folder / "run.json").is_file() or not inside:
        return (read_evaluation(folder),)
    return tuple(read_evaluation(one) for one in inside)


def open_driven_set(run: EpisodeTable, data: Path | None = None) -> ScenarioSet:
    """The scenario set that a run drove.

    Args:
        run: The evaluation.
        data: Where the set is, if it has moved.

    Raises:
        DataError: It is not there, or another one is.
    """
    named = run.data.get("path")
    if data is None and named is None:
        raise DataError("names no scenario set", file=run.folder / "run.json", cure="pass it with --data SET")
    path = data if data is not None else Path(str(named))
    if data is None and not path.exists():
        raise DataError(
            "the scenario set of this run is not there any more",
            file=path,
            cure="pass its new place with --data SET",
        )
    scenarios = ScenarioSet.open(path)
    wanted = run.data.get("hash")
    if wanted and scenarios.hash != wanted:
        raise DataError(
            f"is not the set that {run.name!r} was evaluated on (hash {scenarios.hash[:12]}, not {str(wanted)[:12]})",
            file=path,
            cure="pass the set that was evaluated with --data SET",
        )
    return scenarios


def read_about(folder: Path) -> dict[str, Any]:
    """``run.json`` of a run folder.

    Raises:
        DataError: The folder or the file is missing or damaged.
    """
    if not folder.is_dir():
        raise DataError(
            "there is no such run folder", file=folder, cure="check the path, or run drivax evaluate"
        )
    path = present(folder / "run.json", "give a folder written by drivax evaluate or drivax train")
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DataError(f"is not JSON ({error})", file=path, cure="run the command again") from error
    if not isinstance(about, dict):
        raise DataError("holds no table of facts", file=path, cure="run the command again")
    return about


def present(path: Path, cure: str = AGAIN) -> Path:
    """A file that has to be there.

    Raises:
        DataError: It is not.
    """
    if not path.is_file():
        raise DataError("is missing", file=path, cure=cure)
    return path


def read_episodes(folder: Path) -> tuple[dict[str, tuple[str, ...]], dict[str, Array]]:
    """Columns of ``episodes.csv``: those of :data:`KEYS` as text, and the metrics, NaN where undefined.

    Raises:
        DataError: The file is missing or damaged.
    """
    path = present(folder / "episodes.csv")
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    header = rows[0] if rows else []
    missing = [key for key in KEYS if key not in header]
    if missing or len(set(header)) < len(header):
        problem = f"lacks the column {missing[0]!r}" if missing else "names a column twice"
        raise DataError(problem, file=path, record="header", cure=AGAIN)
    if len(rows) < 2:
        raise DataError("holds no episodes", file=path, cure=AGAIN)
    for number, row in enumerate(rows[1:], start=1):
        if len(row) != len(header):
            raise DataError(f"has {len(row)} cells, not {len(header)}", file=path, record=number, cure=AGAIN)
    columns = {name: [row[place] for row in rows[1:]] for place, name in enumerate(header)}
    keys = {name: tuple(columns[name]) for name in KEYS}
    return keys, {name: _column(path, name, columns[name]) for name in header if name not in KEYS}


def _column(path: Path, name: str, cells: Sequence[str]) -> Array:
    """A metric's cells as float64; an empty cell is NaN (undefined)."""
    values = np.full(len(cells), np.nan)
    for row, cell in enumerate(cells):
        try:
            values[row] = float(cell) if cell.strip() else math.nan
        except ValueError:
            problem = f"{name} is {cell!r}, not a number or empty"
            raise DataError(problem, file=path, record=row + 1, cure=AGAIN) from None
        if cell.strip() and not math.isfinite(values[row]):
            # An undefined value is an empty cell; a number that is none is a defect, not a missing value.
            problem = f"{name} is {'infinite' if math.isinf(values[row]) else 'NaN'}"
            raise DataError(problem, file=path, record=row + 1, cure=AGAIN)
    return values
