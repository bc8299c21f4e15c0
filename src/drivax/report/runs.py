"""Run folders for a report: evaluations (episodes, trajectories) and trainings (learning curves)."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int16, Int64

from drivax.errors import DataError, UsageError
from drivax.evaluation.stored import AGAIN, EpisodeTable, ScenarioKey, present, read_about, read_episodes
from drivax.metrics.catalogue import EVENTS
from drivax.tracking.run_folder import seed_folders

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Trajectories:
    """Trajectories of the evaluated agent, one row per episode, in each scenario's local frame.

    Attributes:
        rows: (scenario id, number of earlier rows of that scenario) -> row.
        ego: Position [m], heading [rad] and speed [m/s] at every step from ``start`` on.
        action: Its actions from ``start`` on; NaN in a run without them.
        start: Step of the log at which the planner took over.
        events: Step of the first event by name (:data:`EVENTS`), -1 for none.
        others: All agents from ``start`` on (``evaluation.traffic_trajectories``); None in log traffic.
    """

    rows: Mapping[tuple[str, int], int]
    ego: Float32[Array, "episode step 4"]
    action: Float32[Array, "episode action D"]
    start: Int64[Array, " episode"]
    events: Mapping[str, Int64[Array, " episode"]]
    others: Int16[Array, "episode step A 3"] | None = None


@dataclass(frozen=True)
class Evaluation(EpisodeTable):
    """Episodes of one planner with their trajectories; :func:`read_runs` makes its name unique.

    Attributes:
        trajectories: The trajectories.
        crashes: Step and error by scenario, where the planner crashed.
    """

    trajectories: Trajectories
    crashes: Mapping[ScenarioKey, tuple[int, str]] = field(default_factory=dict)

    @property
    def occurrences(self) -> list[tuple[str, int]]:
        """The key of each episode in ``trajectories.rows``."""
        return _occurrences(self.keys["scenario_id"])


@dataclass(frozen=True)
class Training:
    """The log of one training run.

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
    """Read run folders of either kind; repeated names get the folder's name as a suffix.

    A folder with one run per seed stands for all of them.

    Raises:
        DataError: A folder or file is missing or damaged, or is no run.
        UsageError: No folder was given, or one was given twice.
    """
    folders = [inside for folder in folders for inside in seed_folders(folder)]
    resolved = [folder.resolve() for folder in folders]
    if not folders or len(set(resolved)) < len(resolved):
        raise UsageError("name every run once, and at least one", cure="drivax report RUN [RUN ...]")
    evaluations, trainings = [], []
    # A training and the evaluation of its policy may share a name: no table holds both.
    names: set[str] = set()
    charts: set[str] = set()
    for folder in folders:
        about = read_about(folder)
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


def read_evaluations(folders: Sequence[Path]) -> list[Evaluation]:
    """Read run folders, at least one of them an evaluation; see :func:`read_runs`."""
    evaluations, _ = read_runs(folders)
    if not evaluations:
        raise UsageError("no evaluation was given", cure="name run folders of drivax evaluate")
    return evaluations


def _unique(name: str, folder: Path, names: set[str]) -> str:
    candidate, number = name, 2
    while candidate in names:
        candidate = f"{name} ({folder.name})" if number == 2 else f"{name} ({folder.name} {number - 1})"
        number += 1
    names.add(candidate)
    return candidate


def _evaluation(folder: Path, name: str, about: Mapping[str, Any]) -> Evaluation:
    columns = read_episodes(folder)
    replayed = about.get("traffic", "log") == "log"
    trajectories = _trajectories(present(folder / "trajectories.npz"), replayed)
    return Evaluation(folder, name, about, *columns, trajectories, _crashes(folder / "crashes.json"))


def _crashes(path: Path) -> dict[ScenarioKey, tuple[int, str]]:
    """Return the contents of ``crashes.json``; nothing where the planner never crashed."""
    if not path.is_file():
        return {}
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
        return {(row["dataset"], row["scenario_id"]): (int(row["step"]), str(row["error"])) for row in rows}
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"cannot be read ({error})", file=path, cure=AGAIN) from error


def _trajectories(path: Path, replayed: bool) -> Trajectories:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            ids = [_decoded(value) for value in stored["scenario_id"]]
            ego = stored["ego"].astype(np.float32)
            action = (stored["action"] if "action" in stored else ego[:, 1:, :0]).astype(np.float32)
            start = stored["start"].astype(np.int64)
            events = {name: stored[f"{name}_step"].astype(np.int64) for name in EVENTS}
            others = None if replayed else stored["others"]
    except KeyError as error:
        raise DataError(f"lacks an array: {error.args[0]}", file=path, cure=AGAIN) from error
    except (ValueError, IndexError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise DataError(f"cannot be read ({error})", file=path, cure=AGAIN) from error
    n = len(ids)
    if ego.ndim != 3 or ego.shape[::2] != (n, 4) or action.shape[:-1] != (n, ego.shape[1] - 1) or any(
        array.shape != (n,) for array in (start, *events.values())
    ) or (others is not None and (
        others.ndim != 4 or others.shape[:2] != ego.shape[:2] or others.shape[3] != 3 or others.dtype != np.int16
    )):  # fmt: skip
        raise DataError("its arrays disagree in shape", file=path, cure=AGAIN)
    rows = {key: row for row, key in enumerate(_occurrences(ids))}
    return Trajectories(rows, ego, action, start, events, others)


def _occurrences(ids: Sequence[str]) -> list[tuple[str, int]]:
    """Return each scenario id with the number of its earlier occurrences."""
    seen: dict[str, int] = {}
    keys = []
    for scenario_id in ids:
        keys.append((scenario_id, seen.get(scenario_id, 0)))
        seen[scenario_id] = seen.get(scenario_id, 0) + 1
    return keys


def _decoded(value: Any) -> str:
    return value.rstrip(b"\0").decode() if isinstance(value, bytes) else str(value)


def _curves(folder: Path) -> dict[str, Array]:
    path = present(folder / "metrics.jsonl", "train again, or leave this run out")
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
            if name not in ("step", "time_s") and isinstance(value, int | float) and math.isfinite(value):
                points.setdefault(name, []).append((step, float(value)))
    return {name: np.array(values) for name, values in points.items()}
