"""Sets to train on, and recorded episodes in them: evaluations of any planners."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from drivax import settings
from drivax.errors import DataError, UsageError
from drivax.evaluation.audit import scenario_names
from drivax.evaluation.episode_table import EpisodeTable
from drivax.files import inside
from drivax.learning.algorithm import training_data
from drivax.learning.algorithms.behaviour_cloning import BcConfig
from drivax.learning.algorithms.offline import OfflineConfig
from drivax.learning.config import TrainConfig
from drivax.learning.driving import Driving, count_egos
from drivax.learning.experience import Experience
from drivax.learning.mixture import Mixture, training_environment
from drivax.learning.recorded_episodes import (
    RecordedDriving,
    RecordedEpisodes,
    StoredDriving,
    StoredEpisodes,
    match_observations,
    replay_episodes,
)
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.bank.sizes import Sizes
from drivax.scenario.schema import Scenario
from drivax.scenario.store import ScenarioSet, Subset
from drivax.simulator.simulator import Simulator
from drivax.tasks.task import Task
from drivax.tracking.run_folder import RunFolder

#: Numbers of scenarios in a set.
Indices = Int[np.ndarray, " n"]

_RECORD = "record them again: drivax record"


@dataclass(frozen=True)
class TrainingSet:
    """Scenarios to train on, with what offline algorithms and behaviour cloning learn from.

    Attributes:
        scenarios: The scenarios.
        weights: Sampling weights of steps, at least 0, ``[M, T]`` (:meth:`ExperienceConfig.of`); None: uniform.
        episodes: Episodes to learn from instead of the logs: recorded in these scenarios (:func:`read_episodes`), or
            stored with the observations of the training task.
    """

    scenarios: ScenarioSet
    weights: np.ndarray | None = None
    episodes: tuple[EpisodeTable, ...] | StoredEpisodes = ()


@dataclass(frozen=True)
class Source:
    """The scenarios of a training run as data of its environment, and of the iterations of its algorithm.

    Attributes:
        config: Settings of the run.
        environment: Environment of the run; for episodes, that of recorded or stored ones.
        scenarios, weights, episodes: Those of the training set that are not held out for validation.
    """

    config: TrainConfig
    environment: Driving | Mixture
    scenarios: ScenarioSet | Subset
    weights: np.ndarray | None
    episodes: tuple[EpisodeTable, ...] | StoredEpisodes

    @classmethod
    def of(
        cls, config: TrainConfig, scenarios: ScenarioSet | Subset, weights: np.ndarray | None,
        episodes: tuple[EpisodeTable, ...] | StoredEpisodes, trust: Sequence[str],
    ) -> Source:  # fmt: skip
        """Return the source of a run; ``trust`` is that of :func:`~drivax.learning.loop.train`.

        Raises:
            UsageError: The training cannot use the episodes.
        """
        environment = training_environment(config, trust)
        if not episodes:
            return cls(config, environment, scenarios, weights, ())
        if not isinstance(config.algorithm, OfflineConfig | BcConfig):
            problem = f"{type(config.algorithm).__name__} does not learn from recorded episodes"
            raise UsageError(problem, cure="leave out the episodes, or use bc, cql, iql, awac or td3_bc")
        if not isinstance(environment, Driving) or config.egos != "recorded":
            problem = "recorded episodes are those of the recorded ego, in one kind of traffic"
            raise UsageError(problem, cure="leave out egos, and use one traffic")
        if not isinstance(episodes, StoredEpisodes):
            return cls(config, recorded_environment(environment, episodes), scenarios, weights, episodes)
        if weights is not None:
            raise UsageError("weights of scenarios do not fit stored episodes", cure="leave out one of both")
        return cls(config, StoredDriving(environment.simulator), scenarios, None, episodes)

    def bank(self, scenarios: Iterable[Scenario], sizes: bool | Sizes = True) -> ScenarioBank:
        """Return the bank of some scenarios, prepared for the environment; ``sizes`` as in ``from_scenarios``.

        Raises:
            UsageError: ``egos`` is moving, but the set has no further egos.
        """
        bank = ScenarioBank.from_scenarios(scenarios, trim=sizes)
        count_egos(self.config.egos, bank.most_egos)
        return self.environment.prepare(bank)

    def load(self) -> Any:
        """Return the data of the environment: a bank of all scenarios, or the episodes in it.

        Raises:
            UsageError: ``egos`` is moving, but the set has no further egos; or stored observations do not fit the task.
            DataError: No recorded episode is in these scenarios.
        """
        bank, environment, episodes = self.bank(self.scenarios), self.environment, self.episodes
        if isinstance(episodes, StoredEpisodes):
            shapes = Driving.shapes(cast(Driving, environment), bank)
            return match_observations(episodes, shapes, environment.action_size)
        if not isinstance(environment, RecordedDriving):
            return bank
        recorded = prepare_episodes(environment, bank, self.scenarios, episodes)
        if recorded is None:
            cure = "record some: drivax record"
            raise DataError("no recorded episode is in the scenarios to train on", cure=cure)
        return recorded

    def draws_steps(self) -> bool:
        """Return whether the algorithm draws logged steps by weight; one scenario is loaded to find out."""
        if self.episodes:
            return True
        bank = self.bank(self.scenarios.take([0]))
        try:
            return isinstance(self.complete(bank, np.arange(1)), Experience)
        except DataError:  # no step of this scenario is usable
            return True

    def complete(self, data: Any, rows: Indices | None = None) -> Any:
        """Return the data of the algorithm's iterations, given those of the environment (:func:`training_data`).

        ``rows`` are the numbers of the scenarios that these contain; None: all.
        """
        weights = self.weights
        if weights is not None and rows is not None:
            weights = weights.reshape(len(self.scenarios), -1, weights.shape[-1])[rows]
            weights = weights.reshape(-1, weights.shape[-1])
        return training_data(self.config.algorithm, self.environment, data, weights)


def recorded_environment(environment: Driving, episodes: Sequence[EpisodeTable]) -> RecordedDriving:
    """Return the environment of recorded episodes, with the task and traffic of a training environment."""
    start_step = int(episodes[0].settings["start_step"])
    return RecordedDriving(Simulator(environment.task, environment.simulator.traffic), start_step=start_step)


def episodes_digest(episodes: Iterable[EpisodeTable] | StoredEpisodes) -> str | None:
    """Return a SHA-256 for ``run.json``: of scenarios, motion and actions, or of all arrays of stored episodes.

    None if there are no episodes.
    """
    digest, empty = hashlib.sha256(), True
    if isinstance(episodes, StoredEpisodes):
        for values in jax.tree.leaves(episodes):
            digest.update(np.ascontiguousarray(values).tobytes())
        return digest.hexdigest()
    for table in episodes:
        digest.update(repr(table.scenarios).encode())
        for values in (table.trajectories.ego, table.trajectories.action):
            digest.update(np.ascontiguousarray(values).tobytes())
        empty = False
    return None if empty else digest.hexdigest()


def read_episodes(
    paths: Iterable[str | Path], scenarios: ScenarioSet, task: Task, traffic: str = "log"
) -> tuple[EpisodeTable, ...]:
    """Read recorded episodes: folders of ``drivax record``, or run folders of ``drivax evaluate``.

    Raises:
        DataError: A folder is missing or damaged, or its episodes are in another set.
        UsageError: Action space, decision interval or traffic of the episodes differ from those of the training task,
            or the episodes do not begin as logged, or not at the same step.
    """
    tables = tuple(EpisodeTable.read(folder) for path in paths for folder in episode_folders(path))
    expected: dict[str, Any] = {"task.hold": task.hold, "traffic": traffic, "noisy_start": False}
    expected["start_step"] = tables[0].settings.get("start_step") if tables else None
    if tables and type(expected["start_step"]) is not int:
        problem = f"start_step of its episodes is {expected['start_step']!r}"
        raise DataError(problem, file=tables[0].folder, cure=_RECORD)
    dynamics = _dynamics(settings.plain(task)["actions"])
    for table in tables:
        folder = table.folder
        if table.data.get("hash") != scenarios.hash:
            problem = f"its episodes are not in the scenarios of {scenarios.path}"
            raise DataError(problem, file=folder, cure="give the set in which they were recorded with --data")
        if _dynamics(_entry(table.settings, "task.actions")) != dynamics:
            problem = "its episodes have another action space than the training"
            raise UsageError(problem, file=folder, cure=f"train with theirs (task.actions), or {_RECORD}")
        for name, value in expected.items():
            if (recorded := _entry(table.settings, name)) != value:
                problem = f"{name} of its episodes is {recorded}, not {value}"
                raise UsageError(problem, file=folder, cure=f"train with it, or {_RECORD}")
    return tables


def episode_folders(path: str | Path) -> list[Path]:
    """Return the run folders of a recording (``drivax record``), or the path itself."""
    folder = RunFolder.open(path)
    return [inside(folder.path, str(name)) for name in folder.info.get("runs", ())] or [folder.path]


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


def prepare_episodes(
    environment: RecordedDriving,
    bank: ScenarioBank,
    scenarios: Sequence[Scenario],
    tables: Sequence[EpisodeTable],
) -> RecordedEpisodes | None:
    """Return the episodes of tables in the scenarios of a bank, prepared for the environment's traffic.

    None if no episode is in these scenarios.

    Raises:
        DataError: Trajectories are damaged.
    """
    row_of = {
        (name["dataset"], name["scenario_id"]): row for row, name in enumerate(scenario_names(scenarios))
    }
    episodes = [_episodes_in(table, row_of, environment, bank.steps) for table in tables]
    index, motion, action = (np.concatenate(columns) for columns in zip(*episodes, strict=True))
    if not len(index):
        return None
    return replay_episodes(environment, bank, *map(jnp.asarray, (index, motion, action)))


def _episodes_in(
    table: EpisodeTable, row_of: Mapping[tuple[str, str], int], environment: RecordedDriving, steps: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return bank row, motion and action of a table's episodes in a bank."""
    index = np.array([row_of.get(key, -1) for key in table.scenarios])
    known, episodes = np.flatnonzero(index >= 0), table.trajectories
    file = None if table.folder is None else table.folder / "trajectories.npz"
    expected = (steps - environment.start_step, environment.action_size)
    shape = (episodes.ego.shape[1], episodes.action.shape[2])
    if shape != expected or (episodes.start != environment.start_step).any():
        problem = f"{shape[0]} steps and {shape[1]} numbers per action, not {expected[0]} and {expected[1]}"
        raise DataError(problem, file=file, cure=_RECORD)
    if not np.isfinite(episodes.ego).all():
        raise DataError("a motion is not finite", file=file, cure=_RECORD)
    return index[known].astype(np.int32), episodes.ego[known], episodes.action[known]
