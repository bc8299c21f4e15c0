"""Run folders read back: evaluations (episodes, trajectories) and trainings (learning curves)."""

from __future__ import annotations

import csv
import json
import math
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int64

from drivax.errors import DataError, UsageError
from drivax.tracking.runs import seed_folders

#: Columns of ``episodes.csv`` that say which episode it was; all others are metrics.
KEYS = ("planner", "dataset", "scenario_id", "segment", "seed", "traffic")
EVENTS = ("collision", "offroad", "red_light")
_AGAIN = "run drivax evaluate again"

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Trajectories:
    """Where the judged car drove, one row per episode, in each scenario's local frame.

    Attributes:
        rows: (scenario id, how many rows of that scenario came before) -> row.
        ego: Position [m], heading [rad] and speed [m/s] at every step from ``start`` on.
        start: Step of the log at which the planner took over.
        events: Step of the first event by name (:data:`EVENTS`), -1 where there was none.
    """

    rows: Mapping[tuple[str, int], int]
    ego: Float32[Array, "episode step 4"]
    start: Int64[Array, " episode"]
    events: Mapping[str, Int64[Array, " episode"]]


@dataclass(frozen=True)
class OwnMetric:
    """A metric that drivax does not know: unit, direction (``high``, ``low``, ``-``) and one line of text."""

    unit: str
    better: str
    text: str


@dataclass(frozen=True)
class Evaluation:
    """One planner driven through one scenario set.

    Attributes:
        folder: The run folder.
        name: Name of the planner in tables; made unique by :func:`read_runs`.
        about: ``run.json``.
        keys: Columns of :data:`KEYS`, as text.
        metrics: Columns of metrics; NaN where undefined.
        trajectories: What was driven.
    """

    folder: Path
    name: str
    about: Mapping[str, Any]
    keys: Mapping[str, tuple[str, ...]]
    metrics: Mapping[str, Float[Array, " episode"]]
    trajectories: Trajectories

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.keys["scenario_id"])

    @property
    def traffic(self) -> str:
        """How the other agents moved: ``log`` or ``idm``."""
        return str(self.about.get("traffic", "log"))

    @property
    def own_metrics(self) -> Mapping[str, OwnMetric]:
        """What the run says about metrics of the user's own."""
        told = self.about.get("own_metrics") or {}
        return {name: OwnMetric(str(m["unit"]), str(m["better"]), str(m["text"])) for name, m in told.items()}

    @property
    def data(self) -> Mapping[str, Any]:
        """Path, hash and name of the scenario set, as far as they are known."""
        data = self.about.get("data") or {}
        return data[0] if isinstance(data, list) and data else data if isinstance(data, dict) else {}

    @property
    def occurrences(self) -> list[tuple[str, int]]:
        """(scenario id, how many episodes of that scenario came before), by episode: the key of trajectories."""
        seen: dict[str, int] = {}
        keys = []
        for scenario_id in self.keys["scenario_id"]:
            keys.append((scenario_id, seen.get(scenario_id, 0)))
            seen[scenario_id] = seen.get(scenario_id, 0) + 1
        return keys


@dataclass(frozen=True)
class Training:
    """One training run: what was logged on the way.

    Attributes:
        folder: The run folder.
        name: The run's name in charts.
        about: ``run.json``.
        curves: Quantity -> points (environment steps, value).
    """

    folder: Path
    name: str
    about: Mapping[str, Any]
    curves: Mapping[str, Float[Array, "point 2"]]


def read_runs(folders: Sequence[Path]) -> tuple[list[Evaluation], list[Training]]:
    """Read run folders of either kind; names that repeat get the folder's name as a suffix.

    The folder of several agents stands for those of all of them.

    Raises:
        DataError: A folder or file is missing or damaged, or is no run.
        UsageError: No folder was given, or one was given twice.
    """
    folders = [inside for folder in folders for inside in seed_folders(folder)]
    resolved = [folder.resolve() for folder in folders]
    if not folders or len(set(resolved)) < len(resolved):
        raise UsageError("name every run once, and at least one", cure="drivax report RUN [RUN ...]")
    evaluations, trainings = [], []
    # A training and the evaluation of its policy may share a name: they never stand in one table.
    names: set[str] = set()
    charts: set[str] = set()
    for folder in folders:
        about = _about(folder)
        if about.get("kind") == "training":
            trainings.append(Training(folder, _unique(folder.name, folder, charts), about, _curves(folder)))
        elif about.get("kind") == "evaluation":
            name = _unique(str(about.get("planner", folder.name)), folder, names)
            evaluations.append(_evaluation(folder, name, about))
        else:
            raise DataError(
                f"is of kind {about.get('kind')!r}, not evaluation or training",
                file=folder / "run.json",
                cure="give folders written by drivax evaluate or drivax train",
            )
    return evaluations, trainings


def _unique(name: str, folder: Path, names: set[str]) -> str:
    candidate, number = name, 2
    while candidate in names:
        candidate = f"{name} ({folder.name})" if number == 2 else f"{name} ({folder.name} {number - 1})"
        number += 1
    names.add(candidate)
    return candidate


def _about(folder: Path) -> dict[str, Any]:
    if not folder.is_dir():
        raise DataError(
            "there is no such run folder", file=folder, cure="check the path, or run drivax evaluate"
        )
    path = _present(folder / "run.json", "give a folder written by drivax evaluate or drivax train")
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DataError(f"is not JSON ({error})", file=path, cure="run the command again") from error
    if not isinstance(about, dict):
        raise DataError("holds no table of facts", file=path, cure="run the command again")
    return about


def _present(path: Path, cure: str = _AGAIN) -> Path:
    if not path.is_file():
        raise DataError("is missing", file=path, cure=cure)
    return path


def _evaluation(folder: Path, name: str, about: Mapping[str, Any]) -> Evaluation:
    keys, metrics = _episodes(_present(folder / "episodes.csv"))
    trajectories = _trajectories(_present(folder / "trajectories.npz"))
    return Evaluation(folder, name, about, keys, metrics, trajectories)


def _episodes(path: Path) -> tuple[dict[str, tuple[str, ...]], dict[str, Array]]:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    header = rows[0] if rows else []
    missing = [key for key in KEYS if key not in header]
    if missing or len(set(header)) < len(header):
        problem = f"lacks the column {missing[0]!r}" if missing else "names a column twice"
        raise DataError(problem, file=path, record="header", cure=_AGAIN)
    if len(rows) < 2:
        raise DataError("holds no episodes", file=path, cure=_AGAIN)
    for number, row in enumerate(rows[1:], start=1):
        if len(row) != len(header):
            raise DataError(f"has {len(row)} cells, not {len(header)}", file=path, record=number, cure=_AGAIN)
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
            raise DataError(problem, file=path, record=row + 1, cure=_AGAIN) from None
        if math.isinf(values[row]):
            raise DataError(f"{name} is infinite", file=path, record=row + 1, cure=_AGAIN)
    return values


def _trajectories(path: Path) -> Trajectories:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            ids = [_text(value) for value in stored["scenario_id"]]
            ego = stored["ego"].astype(np.float32)
            start = stored["start"].astype(np.int64)
            events = {name: stored[f"{name}_step"].astype(np.int64) for name in EVENTS}
    except KeyError as error:
        raise DataError(f"lacks an array: {error.args[0]}", file=path, cure=_AGAIN) from error
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise DataError(f"cannot be read ({error})", file=path, cure=_AGAIN) from error
    n = len(ids)
    if ego.ndim != 3 or ego.shape[0] != n or ego.shape[2] != 4 or any(
        array.shape != (n,) for array in (start, *events.values())
    ):  # fmt: skip
        raise DataError("its arrays disagree in shape", file=path, cure=_AGAIN)
    seen: dict[str, int] = {}
    rows = {}
    for row, scenario_id in enumerate(ids):
        rows[scenario_id, seen.get(scenario_id, 0)] = row
        seen[scenario_id] = seen.get(scenario_id, 0) + 1
    return Trajectories(rows, ego, start, events)


def _text(value: Any) -> str:
    return value.rstrip(b"\0").decode() if isinstance(value, bytes) else str(value)


def _curves(folder: Path) -> dict[str, Array]:
    path = _present(folder / "metrics.jsonl", "train again, or leave this run out")
    points: dict[str, list[tuple[float, float]]] = {}
    lines = path.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines, start=1):
        try:
            row = json.loads(line)
            step = float(row["step"])
        except (json.JSONDecodeError, KeyError, TypeError, ValueError):
            if number == len(lines):  # a run that was killed, or still writes, may leave half a last row
                continue
            raise DataError("is no row of metrics", file=path, record=number, cure="train again") from None
        for name, value in row.items():
            if name not in ("step", "time_s") and _finite(value):
                points.setdefault(name, []).append((step, float(value)))
    return {name: np.array(values) for name, values in points.items()}


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)
