"""Sets to train on, and recorded drives in them: evaluations of any drivers."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from drivax import settings
from drivax.errors import DataError, UsageError
from drivax.evaluation.audit import scenario_names
from drivax.evaluation.episode_table import EpisodeTable
from drivax.learning.drives import Driven, Drives, replay_drives
from drivax.learning.driving import Driving
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import Scenario
from drivax.scenario.store import ScenarioSet
from drivax.simulator.simulator import Simulator
from drivax.tasks.task import Task

_RECORD = "record them again: drivax record"


@dataclass(frozen=True)
class TrainingSet:
    """Scenarios to train on, with what offline algorithms and behaviour cloning learn from.

    Attributes:
        scenarios: The scenarios.
        weights: Sampling weights of steps, at least 0, ``[M, T]`` (:meth:`ExperienceConfig.of`); None: uniform.
        drives: Recorded drives in these scenarios to learn from instead of the logs (:func:`read_drives`).
    """

    scenarios: ScenarioSet
    weights: np.ndarray | None = None
    drives: tuple[EpisodeTable, ...] = ()


def driven_environment(environment: Driving, drives: Sequence[EpisodeTable]) -> Driven:
    """Return the environment of recorded drives, with the task and traffic of a training environment."""
    start_step = int(drives[0].settings["start_step"])
    return Driven(Simulator(environment.task, environment.simulator.traffic), start_step=start_step)


def drives_digest(drives: Iterable[EpisodeTable]) -> str | None:
    """Return a SHA-256 of the scenarios, motions and actions of drives, for ``run.json``; None without drives."""
    digest, empty = hashlib.sha256(), True
    for table in drives:
        digest.update(repr(table.scenarios).encode())
        for values in (table.trajectories.ego, table.trajectories.action):
            digest.update(np.ascontiguousarray(values).tobytes())
        empty = False
    return None if empty else digest.hexdigest()


def read_drives(
    paths: Iterable[str | Path], scenarios: ScenarioSet, task: Task, traffic: str = "log"
) -> tuple[EpisodeTable, ...]:
    """Read recorded drives: folders of ``drivax record``, or run folders of ``drivax evaluate``.

    Raises:
        DataError: A folder is missing or damaged, or its drives are in another set.
        UsageError: They have another action space, decision interval or traffic than the training, began elsewhere than
            on the log, or at different steps.
    """
    tables = tuple(EpisodeTable.read(folder) for path in paths for folder in _runs(Path(path)))
    expected: dict[str, Any] = {"task.hold": task.hold, "traffic": traffic, "noisy_start": False}
    expected["start_step"] = tables[0].settings.get("start_step") if tables else None
    if tables and type(expected["start_step"]) is not int:
        problem = f"start_step of its drives is {expected['start_step']!r}"
        raise DataError(problem, file=tables[0].folder, cure=_RECORD)
    dynamics = _dynamics(settings.plain(task)["actions"])
    for table in tables:
        folder = table.folder
        if table.data.get("hash") != scenarios.hash:
            problem = f"its drives are not in the scenarios of {scenarios.path}"
            raise DataError(problem, file=folder, cure="give the set in which they were recorded with --data")
        if _dynamics(_entry(table.settings, "task.actions")) != dynamics:
            problem = "its drives have another action space than the training"
            raise UsageError(problem, file=folder, cure=f"train with theirs (task.actions), or {_RECORD}")
        for name, value in expected.items():
            if (recorded := _entry(table.settings, name)) != value:
                problem = f"{name} of its drives is {recorded}, not {value}"
                raise UsageError(problem, file=folder, cure=f"train with it, or {_RECORD}")
    return tables


def _runs(path: Path) -> list[Path]:
    """Return the run folders in a folder of ``drivax record``, or the path itself."""
    return sorted(file.parent for file in path.glob("*/run.json")) or [path]


def _dynamics(actions: Any) -> Any:
    """Return the settings of an action space that its executed actions depend on: those of ``route`` are physical."""
    if not isinstance(actions, Mapping) or actions.get("kind") != "route":
        return actions
    return {name: value for name, value in actions.items() if name != "offset_m"} | {"kind": "physical"}


def _entry(values: Mapping[str, Any], name: str) -> Any:
    """Return the value of a nested setting, None if it is missing."""
    section, _, rest = name.partition(".")
    value = values.get(section)
    return _entry(value, rest) if rest and isinstance(value, Mapping) else value


def have_drives(scenarios: Sequence[Scenario], tables: Sequence[EpisodeTable]) -> bool:
    """Return whether any drive is in these scenarios."""
    keys = {(name["dataset"], name["scenario_id"]) for name in scenario_names(scenarios)}
    return any(not keys.isdisjoint(table.scenarios) for table in tables)


def prepare_drives(
    environment: Driven, bank: ScenarioBank, scenarios: Sequence[Scenario], tables: Sequence[EpisodeTable]
) -> Drives:
    """Return the drives of tables in the scenarios of a bank, prepared for the environment's traffic.

    Raises:
        DataError: There are none, or trajectories are damaged.
    """
    row_of = {
        (name["dataset"], name["scenario_id"]): row for row, name in enumerate(scenario_names(scenarios))
    }
    parts = [_drives_in(table, row_of, environment, bank.steps) for table in tables]
    index, motion, action, is_logged = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    if not len(index):
        raise DataError("no drive is in the scenarios to train on", cure=_RECORD)
    return replay_drives(environment, bank, *map(jnp.asarray, (index, motion, action, is_logged)))


def _drives_in(
    table: EpisodeTable, row_of: Mapping[tuple[str, str], int], environment: Driven, steps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return bank row, motion, action, and whether the log was replayed, of a table's drives in a bank."""
    index = np.array([row_of.get(key, -1) for key in table.scenarios])
    known, drives = np.flatnonzero(index >= 0), table.trajectories
    file = None if table.folder is None else table.folder / "trajectories.npz"
    expected = (steps - environment.start_step, environment.action_size)
    shape = (drives.ego.shape[1], drives.action.shape[2])
    if shape != expected or (drives.start != environment.start_step).any():
        problem = f"{shape[0]} steps and {shape[1]} numbers per action, not {expected[0]} and {expected[1]}"
        raise DataError(problem, file=file, cure=_RECORD)
    if not np.isfinite(drives.ego).all():
        raise DataError("a motion is not finite", file=file, cure=_RECORD)
    # A crashed driver has no actions, and a log that was replayed may exceed their bounds.
    is_logged = np.full(len(known), table.settings.get("planner") == "expert")
    return index[known].astype(np.int32), drives.ego[known], drives.action[known], is_logged
