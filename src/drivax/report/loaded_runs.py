"""Run folders read back: evaluations (episodes, trajectories) and trainings (learning curves)."""

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
    """Where the judged car drove, one row per episode, in each scenario's local frame.

    Attributes:
        rows: (scenario id, how many rows of that scenario came before) -> row.
        ego: Position [m], heading [rad] and speed [m/s] at every step from ``start`` on.
        action: What was asked of it from ``start`` on; without numbers in a run that does not tell.
        start: Step of the log at which the planner took over.
        events: Step of the first event by name (:data:`EVENTS`), -1 where there was none.
        others: Where everyone was from ``start`` on (``evaluation.traffic_trajectories``); None where the log was
            replayed.
    """

    rows: Mapping[tuple[str, int], int]
    ego: Float32[Array, "episode step 4"]
    action: Float32[Array, "episode action D"]
    start: Int64[Array, " episode"]
    events: Mapping[str, Int64[Array, " episode"]]
    others: Int16[Array, "episode step A 3"] | None = None


@dataclass(frozen=True)
class Evaluation(EpisodeTable):
    """One planner driven through one scenario set; its name is made unique by :func:`read_runs`.

    Attributes:
        trajectories: What was driven.
        crashes: Of the scenarios in which the planner crashed, the step and what it raised.
    """

    trajectories: Trajectories
    crashes: Mapping[ScenarioKey, tuple[int, str]] = field(default_factory=dict)

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


def _unique(name: str, folder: Path, names: set[str]) -> str:
    candidate, number = name, 2
    while candidate in names:
        candidate = f"{name} ({folder.name})" if number == 2 else f"{name} ({folder.name} {number - 1})"
        number += 1
    names.add(candidate)
    return candidate


def _evaluation(folder: Path, name: str, about: Mapping[str, Any]) -> Evaluation:
    columns = read_episodes(folder)
    driven = _trajectories(
        present(folder / "trajectories.npz"), replayed=about.get("traffic", "log") == "log"
    )
    return Evaluation(folder, name, about, *columns, driven, _crashes(folder / "crashes.json"))


def _crashes(path: Path) -> dict[ScenarioKey, tuple[int, str]]:
    """What ``crashes.json`` tells; nothing where the planner never crashed."""
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
            ids = [_text(value) for value in stored["scenario_id"]]
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
    seen: dict[str, int] = {}
    rows = {}
    for row, scenario_id in enumerate(ids):
        rows[scenario_id, seen.get(scenario_id, 0)] = row
        seen[scenario_id] = seen.get(scenario_id, 0) + 1
    return Trajectories(rows, ego, action, start, events, others)


def _text(value: Any) -> str:
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
            if name not in ("step", "time_s") and _finite(value):
                points.setdefault(name, []).append((step, float(value)))
    return {name: np.array(values) for name, values in points.items()}


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)
