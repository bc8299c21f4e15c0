"""Definition of a study: arms, claims about them, settings and scenario sets.

A study is declared by a YAML file (:class:`StudyDefinition`); ``configs/studies/longtail.yaml`` is the long-tail study.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from drivax import settings
from drivax.curation.ensemble import EnsembleConfig
from drivax.curation.methods import METHODS
from drivax.curation.scores import ScoreTable
from drivax.curation.weights import Scale, WeightConfig, permute_scores, sampling_weights
from drivax.errors import UsageError, did_you_mean
from drivax.learning.config import TrainConfig
from drivax.learning.experience import WeightedSet
from drivax.metrics.catalogue import METRICS
from drivax.planners.catalogue import PLANNERS
from drivax.scenario.store import ScenarioSet

#: Scenarios that a claim is about: all, weighted as in ordinary traffic, or those of one stratum.
Stratum = Literal["ordinary", "common", "rare"]
#: From the name of a curation method to its score table of a set.
Tables = Callable[[str], ScoreTable]


@dataclass(frozen=True)
class Arm:
    """An arm of a study.

    Attributes:
        preset: Its training configuration.
        method: Name of the curation method that scores its steps.
        scale: Whether weights are of steps or of scenarios.
        permuted: Whether the scores are permuted among scenarios: the matched random control of ``method``.
        weights: Settings of the sampling weights; None: those of the study.
    """

    preset: str = "offline/cql"
    method: str = "uniform"
    scale: Scale = "step"
    permuted: bool = False
    weights: WeightConfig | None = None

    def weighted(
        self, data: ScenarioSet, tables: Tables, config: WeightConfig, usable: np.ndarray | None = None,
        seed: int = 0,
    ) -> WeightedSet:  # fmt: skip
        """Return a set with the sampling weights of this arm.

        Args:
            data: The set.
            tables: Score tables of the set.
            config: Settings of the sampling weights, for arms without ``weights``.
            usable: Steps that the training learns from (:func:`~drivax.curation.weights.sampling_weights`).
            seed: Seed of the permutation.

        Raises:
            UsageError: The table is of another method, or no step has a weight or a label.
        """
        table = tables(self.method)
        if table.method != self.method:
            raise UsageError(
                f"scores of {table.method!r} for an arm that is curated by {self.method!r}",
                cure=f"drivax curate {self.method} --data {data.path} --out SCORES",
            )
        if self.method == "oracle" and not table.steps.any():
            raise UsageError(
                "no scenario has a labelled event", file=data.path, cure="use an arm without labels"
            )
        if self.permuted:
            table = permute_scores(table, seed, usable)
        return WeightedSet(data, sampling_weights(table, self.weights or config, self.scale, usable))


@dataclass(frozen=True)
class Claim:
    """A claim about two arms.

    Attributes:
        words: Text of the claim.
        arm: The arm that is claimed to be better.
        reference: The arm that it is compared with.
        group: Claims whose p-values are adjusted together.
        metric: Metric of the comparison.
        rows: Scenarios of the comparison.
        change: Claimed relative change, at least; None: only its direction is claimed.
    """

    words: str
    arm: str
    reference: str
    group: str
    metric: str = "collision"
    rows: Stratum = "ordinary"
    change: float | None = None


@dataclass(frozen=True)
class StudyDefinition:
    """Definition of a study in a YAML file.

    Attributes:
        title: Title of its report.
        baselines: Arms that must meet the conditions before the others are trained. The smallest detectable difference
            is estimated from the first two; ``checkpoints_by`` is tested on the first.
        planners: Planners without training that are evaluated next to the arms.
        metrics: Metrics that are reported, by name.
        groups: Heading of each group of claims.
        arms: The arms.
        claims: The claims.
        checkpoints_by: Training metric whose maximum selects another checkpoint of the first baseline; the cost of that
            rule is reported.
    """

    title: str
    baselines: tuple[str, ...]
    planners: tuple[str, ...]
    metrics: tuple[str, ...]
    groups: dict[str, str]
    arms: dict[str, Arm]
    claims: tuple[Claim, ...]
    checkpoints_by: str

    def __post_init__(self) -> None:
        if len(self.baselines) < 2:
            raise ValueError("a study needs two baselines")
        for names, available, kind in (
            (self.baselines, self.arms, "baseline"), (self.planners, PLANNERS, "planner"),
            (self.metrics, METRICS, "metric"), ([arm.method for arm in self.arms.values()], METHODS, "method"),
        ):  # fmt: skip
            for name in names:
                if name not in available:
                    raise ValueError(f"unknown {kind} {name!r}; {did_you_mean(name, list(available))}")
        for claim in self.claims:
            for name, available in (
                (claim.arm, self.arms), (claim.reference, self.arms), (claim.group, self.groups),
                (claim.metric, self.metrics),
            ):  # fmt: skip
                if name not in available:
                    raise ValueError(f"the claim {claim.words!r} names {name!r}, which the study lacks")


@cache
def load_study(source: str | Path) -> StudyDefinition:
    """Return the definition of a study from a YAML file, or by the name of one in ``configs/studies``.

    Raises:
        UsageError: There is none, or it is invalid.
    """
    name = str(source)
    return settings.load(StudyDefinition, source if name.endswith(".yaml") else f"studies/{name}")


@dataclass(frozen=True)
class StudyConfig:
    """Settings of a study: its arms and their budget.

    Attributes:
        arms: Names of its arms, its baselines among them; empty: all.
        seeds: Number of training runs of each arm.
        total_steps: Logged steps that each training draws; null: those of its preset.
        training: Further settings of every training, as on the command line: ``[--algorithm.batch, "128"]``.
        validations: Number of validations in closed loop; the best checkpoint is tested.
        weights: Settings of the sampling weights, the same for all methods.
        ensemble: The ensemble.
        progress: Every seed of a baseline must make this share of the expert's progress on the validation set.
        flat: Largest change of a baseline's score, mean over seeds, from the third to the last quarter of its
            validations.
        rare: Share of test scenarios that count as rare by the kinematic heuristic, if none are labelled.
    """

    renamed: ClassVar[dict[str, str]] = {"agents": "arms", "scouts": "ensemble"}

    arms: tuple[str, ...] = ()
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
        if self.seeds < 2 or self.validations < 4:
            raise UsageError(
                f"{self.seeds} seeds and {self.validations} validations", cure="use 2 or more, and 4 or more"
            )


@dataclass(frozen=True)
class StudySets:
    """Scenario sets of a study.

    Attributes:
        train: Training set.
        validation: Validation set, which chooses checkpoints.
        test: One test set or several; of labelled sets all scenarios with an event are taken, and as many without.
            Events are as frequent in the first set as in ordinary traffic.
    """

    train: Path
    validation: Path
    test: tuple[Path, ...]

    @classmethod
    def of(cls, data: Path, validation: Path | None, test: Sequence[Path]) -> StudySets:
        """Return the sets as given, or those of a benchmark's folder.

        Raises:
            UsageError: One is missing.
        """
        if (data / "train").is_dir():
            test_sets = tuple(path for path in (data / "test", data / "test-rare") if path.is_dir())
            validation, test = validation or data / "validation", tuple(test) or test_sets
            data = data / "train"
        if not data.is_dir():
            raise UsageError(
                "scenario set not found", file=data, cure="name a scenario set, or a benchmark's folder"
            )
        if validation is None or not test:
            raise UsageError(
                "no validation or test set",
                file=data,
                cure="pass --validation and --test, or a folder of `drivax generate --benchmark`",
            )
        return cls(data, validation, tuple(test))


@dataclass(frozen=True)
class Study:
    """A study on given sets, and the names of the files in its folder.

    Raises:
        UsageError: ``config`` names an unknown arm or lacks a baseline.
    """

    definition: StudyDefinition
    config: StudyConfig
    sets: StudySets
    folder: Path

    def __post_init__(self) -> None:
        available = list(self.definition.arms)
        for name in self.config.arms:
            if name not in available:
                raise UsageError(f"unknown arm {name!r}", cure=did_you_mean(name, available))
        for name in self.definition.baselines if self.config.arms else ():
            if name not in self.config.arms:
                raise UsageError(f"baseline {name!r} is missing", cure="add it to arms")
        object.__setattr__(self, "config", replace(self.config, arms=self.config.arms or tuple(available)))

    @property
    def arms(self) -> Mapping[str, Arm]:
        """The arms that are compared."""
        return {name: self.definition.arms[name] for name in self.config.arms}

    @property
    def claims(self) -> list[Claim]:
        """The claims about these arms."""
        return [claim for claim in self.definition.claims if {claim.arm, claim.reference} <= set(self.arms)]

    def run(self, arm: str, seed: int) -> Path:
        """Return the run folder of a training."""
        return self.folder / "runs" / arm / f"seed-{seed}"

    def evaluation(self, name: str, seed: int | None = None) -> Path:
        """Return the evaluation of an arm with one seed, or of a planner."""
        folder = self.folder / "drives" / name
        return folder if seed is None else folder / f"seed-{seed}"

    def evaluations(self, arm: str) -> tuple[str, ...]:
        """Return the names of an arm's evaluations: the first baseline is evaluated at other checkpoints, too."""
        return (arm, self.rival) if arm == self.definition.baselines[0] else (arm,)

    @property
    def rival(self) -> str:
        """Name of the evaluations of the first baseline at checkpoints chosen by ``checkpoints_by``."""
        return f"{self.definition.baselines[0]}_by_{self.definition.checkpoints_by.rpartition('/')[2]}"

    @property
    def test(self) -> Path:
        """The scenario set of the test."""
        return self.folder / "test"

    @property
    def results(self) -> Path:
        """The results as JSON."""
        return self.folder / "results.json"

    def scores(self, method: str) -> Path:
        """Return the file of a method's scores of the training set."""
        return self.folder / "scores" / f"{method}.npz"

    def train_config(self, arm: str, seed: int) -> TrainConfig:
        """Return the training configuration of an arm with one seed."""
        config = settings.load(TrainConfig, self.definition.arms[arm].preset, self.config.training)
        config = replace(config, seed=seed, total_steps=self.config.total_steps or config.total_steps)
        every = max(config.iterations // self.config.validations, 1)
        # All checkpoints of the first baseline stay: another rule chooses among them afterwards.
        keep = config.iterations if arm == self.definition.baselines[0] else config.keep
        return replace(config, evaluate_every=every, checkpoint_every=every, keep=keep)
