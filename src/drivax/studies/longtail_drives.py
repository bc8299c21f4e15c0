"""The drives of a long-tail study: its test set, who drives it, and what is read back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float

from drivax import settings
from drivax.curation.arms import ARMS
from drivax.curation.ensemble import EnsembleConfig
from drivax.curation.methods import Request, curate, event_kinds
from drivax.curation.weights import WeightConfig
from drivax.errors import UsageError, did_you_mean
from drivax.evaluation.episode_table import EpisodeTable
from drivax.evaluation.runner import EvaluationConfig, run_evaluation
from drivax.learning.config import TrainConfig
from drivax.learning.policies import load_policy
from drivax.planners.catalogue import make_planner
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.stats.clusters import recordings_of
from drivax.tracking.run_folder import RunFolder
from drivax.tracking.sinks import read_rows

#: Which recorded steps are learned from.
Usable = Bool[np.ndarray, "N T"]

#: What has to drive well before anything is compared.
FIRST = ("baseline", "bc")
#: Who drives the test next to the arms: the recording itself, and two who know rules, but nothing of the future.
REFERENCES = ("expert", "idm", "pdm")
SCORES, RUNS, DRIVES, TEST = "scores", "runs", "drives", "test"
RESULTS, REPORT, CRITICAL = "results.json", "report.html", "critical.html"
#: Name of the evaluations of the baseline's checkpoints that the published rule would have chosen.
BY_MEAN_Q = "baseline_by_mean_q"


@dataclass(frozen=True)
class LongtailConfig:
    """What is compared, and under which budget.

    Attributes:
        arms: Names of :data:`~drivax.curation.arms.ARMS`; ``baseline`` and ``bc`` among them.
        seeds: Trainings of each.
        total_steps: Recorded steps that each learns from; null: as its preset says.
        training: More settings of every training, as on a command line: ``[--algorithm.batch, "128"]``.
        validations: Times that each is validated by driving; the best checkpoint is tested.
        weights: How scores become weights, the same way for all.
        ensemble: The ensemble.
        progress: Every seed of ``baseline`` and ``bc`` has to make this share of the expert's progress on the
            validation set.
        flat: And their scores may change by no more, mean over seeds, from the third to the last quarter of their
            validations.
        rare: Share of the test scenarios that count as rare, by the kinematic heuristic, where none are labelled.
    """

    renamed: ClassVar[dict[str, str]] = {"agents": "arms", "scouts": "ensemble"}

    arms: tuple[str, ...] = tuple(ARMS)
    seeds: int = 5
    total_steps: int | None = None
    training: tuple[str, ...] = ()
    validations: int = 8
    weights: WeightConfig = field(default_factory=WeightConfig)
    ensemble: EnsembleConfig = field(default_factory=EnsembleConfig)
    progress: float = 0.8
    flat: float = 0.03
    rare: float = 0.2

    def __post_init__(self) -> None:
        for name in self.arms:
            if name not in ARMS:
                raise UsageError(f"there is no arm {name!r}", cure=did_you_mean(name, list(ARMS)))
        if missing := [name for name in FIRST if name not in self.arms]:
            raise UsageError(f"a study without {missing[0]}", cure="everything is compared with it; add it")
        if self.seeds < 2 or self.validations < 4:
            raise UsageError(
                f"{self.seeds} seeds and {self.validations} validations", cure="use 2 or more, and 4 or more"
            )

    def train_config(self, arm: str, seed: int) -> TrainConfig:
        """The training of one arm with one seed."""
        config = settings.load(TrainConfig, ARMS[arm].preset, self.training)
        config = replace(config, seed=seed, total_steps=self.total_steps or config.total_steps)
        every = max(config.iterations // self.validations, 1)
        # All of the baseline's stay, those of interruptions too: the one with the highest mean Q is episodes.
        keep = config.iterations if arm == "baseline" else config.keep
        return replace(config, evaluate_every=every, checkpoint_every=every, keep=keep)


@dataclass(frozen=True)
class Sets:
    """The scenario sets of a study.

    Attributes:
        train: What is learned from.
        validation: What chooses checkpoints.
        test: One set or several to evaluate on; of labelled sets all scenarios with an event are taken, and as many
            without. The first set has the frequency of events in ordinary traffic.
    """

    train: Path
    validation: Path
    test: tuple[Path, ...]

    @classmethod
    def of(cls, data: Path, validation: Path | None, test: Sequence[Path]) -> Sets:
        """As given; or of a benchmark, which holds all of them.

        Raises:
            UsageError: One is missing.
        """
        if (data / "train").is_dir():
            rest = tuple(path for path in (data / "test", data / "test-rare") if path.is_dir())
            return cls(data / "train", validation or data / "validation", tuple(test) or rest)
        if not data.is_dir():
            raise UsageError("does not exist", file=data, cure="name a scenario set, or a benchmark's folder")
        if validation is None or not test:
            raise UsageError(
                "a study needs scenarios to train, to validate and to test on",
                file=data,
                cure="pass --validation and --test, or a folder of `drivax generate --benchmark`",
            )
        return cls(data, validation, tuple(test))


@dataclass(frozen=True)
class Job:
    """One training: what a process of its own needs to know."""

    config: LongtailConfig
    sets: Sets
    out: Path
    arm: str
    seed: int
    usable: Usable

    @property
    def run(self) -> Path:
        """Its run folder."""
        return run_of(self.out, self.arm, self.seed)

    @property
    def train_config(self) -> TrainConfig:
        """Its settings."""
        return self.config.train_config(self.arm, self.seed)


def run_of(out: Path, arm: str, seed: int) -> Path:
    """The run folder of a training."""
    return out / RUNS / arm / f"seed-{seed}"


def evaluation_of(out: Path, arm: str, seed: int) -> Path:
    """The evaluation of an arm."""
    return out / DRIVES / arm / f"seed-{seed}"


#: What critics expect of the policy on held-out steps: by it the published study advises to choose checkpoints.
MEAN_Q = "validation/mean_q"
Log = Callable[[str], None]


def test_set(sets: Sets, out: Path) -> ScenarioSet:
    """The scenarios of the test, as a set of their own: half of them with an event where events are labelled."""
    path = out / TEST
    if not path.is_dir():
        parts = [ScenarioSet.open(one) for one in sets.test]
        rows = [(part, row) for part in parts for row in range(len(part))]
        with_event = np.concatenate([event_kinds(part) for part in parts]) > 0
        if with_event.any() and not with_event.all():
            most = min(with_event.sum(), (~with_event).sum())
            kinds = [np.flatnonzero(one)[:most] for one in (with_event, ~with_event)]
            rows = [rows[place] for place in np.sort(np.concatenate(kinds))]
        source = {"command": "study longtail", "sets": [part.hash for part in parts]}
        with ScenarioWriter(path, parts[0].capacity, source) as writer:
            for part, row in rows:
                writer.add(part[row])
    return ScenarioSet.open(path)


def rare_rows(config: LongtailConfig, test: ScenarioSet) -> Bool[np.ndarray, " n"]:
    """Which scenarios of the test are rare: those with an event, or the most critical ones where none are labelled."""
    labelled = event_kinds(test) > 0
    if labelled.any():
        return labelled
    scores = curate("kinematic", Request(test)).scenarios
    return scores >= np.quantile(scores, 1.0 - config.rare)


def ordinary_share(sets: Sets) -> float | None:
    """Share of scenarios with an event in ordinary traffic: in the first test set; None where nothing is labelled."""
    labelled = event_kinds(ScenarioSet.open(sets.test[0])) > 0
    return float(labelled.mean()) if labelled.any() else None


def evaluate_references(out: Path, test: ScenarioSet, log: Log) -> None:
    """Drives the test set with those who need no training, unless they have."""
    for name in REFERENCES:
        folder = out / DRIVES / name
        if not folder.is_dir():
            log(f"driving the test set: {name}")
            run_evaluation(EvaluationConfig(name), make_planner(name), test, folder)


def evaluate_arm(out: Path, arm: str, seed: int) -> None:
    """Drives the test set with an arm, unless it has; with the baseline by other checkpoints, too."""
    test, run = ScenarioSet.open(out / TEST), run_of(out, arm, seed)
    bank = ScenarioBank.from_scenarios([test[0]])
    for name in names(arm):
        folder = evaluation_of(out, name, seed)
        if not folder.is_dir():
            step = step_by_mean_q(run) if name == BY_MEAN_Q else None
            planner, task = load_policy(run, bank, step=step)
            planner_name = str(run) if step is None else f"{run}@{step}"
            run_evaluation(EvaluationConfig(planner_name, task=task), planner, test, folder)


def is_evaluated(out: Path, arm: str, seed: int) -> bool:
    """Whether an arm has episodes the test set.

    Raises:
        UsageError: It was trained again since.
    """
    folders = [evaluation_of(out, name, seed) for name in names(arm)]
    for folder in folders:
        if folder.is_dir():
            _refuse_older(folder, run_of(out, arm, seed))
    return all(folder.is_dir() for folder in folders)


def names(arm: str) -> tuple[str, ...]:
    """What the drives of an arm are called."""
    return (arm, BY_MEAN_Q) if arm == "baseline" else (arm,)


def _refuse_older(folder: Path, run: Path) -> None:
    """Refuses a drive that is older than the run that it is said to be of.

    Raises:
        UsageError: The arm was trained again since.
    """
    evaluated, started = (
        datetime.fromisoformat(RunFolder.open(one).info["started"]) for one in (folder, run)
    )
    if evaluated < started:
        raise UsageError(
            "is older than the run that evaluated it", file=folder, cure="remove it; it is evaluated again"
        )


def step_by_mean_q(run: Path) -> int:
    """The step of the validation at which critics expected most."""
    rows = [row for row in read_rows(run / "metrics.jsonl") if MEAN_Q in row]
    return int(max(rows, key=lambda row: row[MEAN_Q])["step"])


def episodes(config: LongtailConfig, out: Path, arm: str) -> dict[str, Float[np.ndarray, "seed scenario"]]:
    """What the arms of one name did in the test, by metric, in the order of the test set."""
    tables = [EpisodeTable.read(evaluation_of(out, arm, seed)) for seed in range(config.seeds)]
    return {name: np.stack([table.metrics[name] for table in tables]) for name in tables[0].metrics}


def clusters(test: ScenarioSet) -> list[str]:
    """The recording of every scenario."""
    return recordings_of(test.entries)
