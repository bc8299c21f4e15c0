"""What a long-tail study is: agents, budget, scenario sets, and where in its folder everything lies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from drivax import settings
from drivax.curation.arms import ARMS
from drivax.curation.ensemble import EnsembleConfig
from drivax.curation.weights import WeightConfig
from drivax.errors import UsageError, did_you_mean
from drivax.learning.config import TrainConfig

#: Which recorded steps are learned from.
Usable = Bool[np.ndarray, "N T"]

#: What has to drive well before anything is compared.
FIRST = ("baseline", "bc")
#: Who drives the test beside the agents: the recording itself, and two who know rules, but nothing of the future.
REFERENCES = ("expert", "idm", "pdm")
SCORES, RUNS, DRIVES, TEST = "scores", "runs", "drives", "test"
RESULTS, REPORT, CRITICAL = "results.json", "report.html", "critical.html"
#: Name of the evaluations of the baseline's checkpoints that the published rule would have chosen.
BY_MEAN_Q = "baseline_by_mean_q"


@dataclass(frozen=True)
class LongtailConfig:
    """What is compared, and under which budget.

    Attributes:
        agents: Names of :data:`~drivax.curation.arms.ARMS`; ``baseline`` and ``bc`` among them.
        seeds: Trainings of each.
        total_steps: Recorded steps that each learns from; null: as its preset says.
        training: More settings of every training, as on a command line: ``[--algorithm.batch, "128"]``.
        validations: Times that each is validated by driving; the best checkpoint is tested.
        weights: How scores become weights, the same way for all.
        scouts: The ensemble.
        progress: Every seed of ``baseline`` and ``bc`` has to make this share of the expert's progress on the
            validation set.
        flat: And their scores may change by no more, mean over seeds, from the third to the last quarter of their
            validations.
        rare: Share of the test scenarios that count as rare, by the kinematic heuristic, where none are labelled.
    """

    agents: tuple[str, ...] = tuple(ARMS)
    seeds: int = 5
    total_steps: int | None = None
    training: tuple[str, ...] = ()
    validations: int = 8
    weights: WeightConfig = field(default_factory=WeightConfig)
    scouts: EnsembleConfig = field(default_factory=EnsembleConfig)
    progress: float = 0.8
    flat: float = 0.03
    rare: float = 0.2

    def __post_init__(self) -> None:
        for name in self.agents:
            if name not in ARMS:
                raise UsageError(f"there is no agent {name!r}", cure=did_you_mean(name, list(ARMS)))
        if missing := [name for name in FIRST if name not in self.agents]:
            raise UsageError(f"a study without {missing[0]}", cure="everything is compared with it; add it")
        if self.seeds < 2 or self.validations < 4:
            raise UsageError(
                f"{self.seeds} seeds and {self.validations} validations", cure="use 2 or more, and 4 or more"
            )

    def train_config(self, agent: str, seed: int) -> TrainConfig:
        """The training of one agent with one seed."""
        config = settings.load(TrainConfig, ARMS[agent].preset, self.training)
        config = replace(config, seed=seed, total_steps=self.total_steps or config.total_steps)
        every = max(config.iterations // self.validations, 1)
        # All of the baseline's stay, those of interruptions too: the one with the highest mean Q is driven.
        keep = config.iterations if agent == "baseline" else config.keep
        return replace(config, evaluate_every=every, checkpoint_every=every, keep=keep)


@dataclass(frozen=True)
class Sets:
    """The scenario sets of a study.

    Attributes:
        train: What is learned from.
        validation: What chooses checkpoints.
        test: What is driven in the end, one or several; of labelled sets all scenarios with an event are taken, and as
            many without. How often events occur in ordinary traffic, the first of them says.
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
    agent: str
    seed: int
    usable: Usable

    @property
    def run(self) -> Path:
        """Its run folder."""
        return run_of(self.out, self.agent, self.seed)

    @property
    def train_config(self) -> TrainConfig:
        """Its settings."""
        return self.config.train_config(self.agent, self.seed)


def run_of(out: Path, agent: str, seed: int) -> Path:
    """The run folder of a training."""
    return out / RUNS / agent / f"seed-{seed}"


def drive_of(out: Path, agent: str, seed: int) -> Path:
    """The evaluation of an agent."""
    return out / DRIVES / agent / f"seed-{seed}"
