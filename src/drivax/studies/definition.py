"""Definition of a study: arms, claims about them, settings and scenario sets.

A study is declared by a YAML file (:class:`StudyDefinition`); ``configs/studies/longtail.yaml`` is the long-tail study.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from drivax import settings
from drivax.curation.ensemble import EnsembleConfig
from drivax.curation.methods import METHODS, ORACLES
from drivax.curation.scores import ScoreTable
from drivax.curation.weights import Scale, WeightConfig, permute_scores, sampling_weights
from drivax.errors import UsageError, did_you_mean
from drivax.files import inside
from drivax.learning.config import TrainConfig
from drivax.metrics.catalogue import METRICS
from drivax.planners.catalogue import PLANNERS
from drivax.scenario.store import ScenarioSet

#: Scenarios of a claim: all, weighted as in ordinary traffic, or those of one stratum.
Stratum = Literal["ordinary", "common", "rare"]
#: Maps the name of a curation method to its score table of a set.
Tables = Callable[[str], ScoreTable]


@dataclass(frozen=True)
class Arm:
    """An arm of a study.

    Attributes:
        preset: Training configuration.
        method: Name of the curation method that scores the steps.
        scale: Whether steps or whole scenarios are weighted.
        permuted: Whether to permute the scores among scenarios, for the matched random control of ``method``.
        weights: Settings of the sampling weights; None for those of the study.
    """

    preset: str = "offline/cql"
    method: str = "uniform"
    scale: Scale = "step"
    permuted: bool = False
    weights: WeightConfig | None = None

    def weigh(
        self, data: ScenarioSet, tables: Tables, config: WeightConfig, usable: np.ndarray | None = None,
        seed: int = 0,
    ) -> np.ndarray:  # fmt: skip
        """Return the sampling weights of the steps of a set in the arm, ``[M, T]``.

        Args:
            data: The set.
            tables: Score tables of the set.
            config: Settings of the sampling weights, for arms without ``weights``.
            usable: Mask of the steps to learn from (:func:`~drivax.curation.weights.sampling_weights`).
            seed: Seed of the permutation.

        Raises:
            UsageError: The table has another method, or no step has a weight or a label.
        """
        table = tables(self.method)
        if table.method != self.method:
            raise UsageError(
                f"scores of {table.method!r} for an arm with the method {self.method!r}",
                cure=f"drivax curate {self.method} --data {data.path} --out SCORES",
            )
        if self.method in ORACLES and not table.steps.any():
            raise UsageError(
                "no scenario has a labelled event", file=data.path, cure="use an arm without labels"
            )
        if self.permuted:
            table = permute_scores(table, seed, usable)
        return sampling_weights(table, self.weights or config, self.scale, usable)


@dataclass(frozen=True)
class Claim:
    """A claim about two arms.

    Attributes:
        words: Text of the claim.
        arm: The arm claimed to be better.
        reference: The arm to compare with.
        group: Group of claims whose p-values are adjusted together.
        metric: Metric of the comparison.
        rows: Scenarios of the comparison.
        change: Minimum claimed relative change; None for a claim about the direction alone.
        margin: The arm is claimed to be not worse by more than this (non-inferiority), instead of better.
        at_equal_progress: Compare at the lower progress of both arms (``progress_ratio``): whichever makes more
            progress drives slower.
    """

    words: str
    arm: str
    reference: str
    group: str
    metric: str = "collision"
    rows: Stratum = "ordinary"
    change: float | None = None
    margin: float | None = None
    at_equal_progress: bool = False

    def __post_init__(self) -> None:
        if self.change is not None and not -1 < self.change < math.inf:
            raise ValueError(f"the claim {self.words!r} has the change {self.change}; use a number above -1")
        if self.margin is not None and not (0 < self.margin < math.inf and self.change is None):
            raise ValueError(
                f"the claim {self.words!r} has the margin {self.margin}; use a positive number, and no change"
            )


@dataclass(frozen=True)
class StudyDefinition:
    """Definition of a study in a YAML file.

    Attributes:
        title: Title of the report.
        baselines: Arms that must meet the conditions before the others are trained. The first two determine the
            smallest detectable difference; the first is the one that ``checkpoints_by`` is tested on.
        planners: Untrained planners to evaluate next to the arms.
        metrics: Names of the metrics in the report.
        groups: Heading of each group of claims.
        arms: The arms.
        claims: The claims.
        checkpoints_by: Training metric whose maximum chooses checkpoints by another rule; the report has the cost of
            this rule for the first baseline.
        limiters: Shares of the speed limit, below 1, at which a limiter also slows arms down, for claims at equal
            progress.
    """

    title: str
    baselines: tuple[str, ...]
    planners: tuple[str, ...]
    metrics: tuple[str, ...]
    groups: dict[str, str]
    arms: dict[str, Arm]
    claims: tuple[Claim, ...]
    checkpoints_by: str
    limiters: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not all(0.0 < share < 1.0 for share in self.limiters) or len(set(self.limiters)) < len(
            self.limiters
        ):
            raise ValueError(f"limiters are {self.limiters}; use different numbers between 0 and 1")
        slower_names = {f"{arm}_at_{share:g}" for arm in self.arms for share in self.limiters}
        if len(slower_names) < len(self.arms) * len(self.limiters) or slower_names & self.arms.keys():
            raise ValueError(
                f"two evaluations would have the same name; change limiters {self.limiters} or arms"
            )
        if not self.limiters and any(claim.at_equal_progress for claim in self.claims):
            raise ValueError("claims at equal progress need limiters")
        if len(set(self.baselines[:2])) < 2:
            raise ValueError("a study needs two different baselines")
        methods = [arm.method for arm in self.arms.values()]
        choices = {
            "baseline": (self.baselines, self.arms), "planner": (self.planners, PLANNERS),
            "metric": (self.metrics, METRICS), "method": (methods, METHODS),
        }  # fmt: skip
        if "random_matched" in methods:
            raise ValueError("for random_matched use the method to match with permuted: true")
        for kind, (names, available) in choices.items():
            for name in names:
                if name not in available:
                    raise ValueError(f"unknown {kind} {name!r}; {did_you_mean(name, list(available))}")
        if shared_names := [name for name in self.planners if name in self.arms]:
            raise ValueError(f"{shared_names[0]!r} is a planner and an arm; rename the arm")
        for claim in self.claims:
            claim_choices = (
                (claim.arm, self.arms), (claim.reference, self.arms), (claim.group, self.groups),
                (claim.metric, self.metrics),
            )  # fmt: skip
            for name, available in claim_choices:
                if name not in available:
                    raise ValueError(f"the claim {claim.words!r} names {name!r}, which the study lacks")
            if METRICS[claim.metric].better == "-":
                raise ValueError(
                    f"the claim {claim.words!r} names {claim.metric!r}, which has no better direction"
                )


@cache
def load_study(source: str | Path) -> StudyDefinition:
    """Return the definition of a study by the name of one in ``configs/studies``, or from a YAML file.

    Raises:
        UsageError: The definition does not exist, or is invalid.
    """
    is_file = isinstance(source, Path) or settings.is_path(source)
    return settings.load(StudyDefinition, source if is_file else settings.preset(f"studies/{source}"))


@dataclass(frozen=True)
class StudyConfig:
    """Settings of a study: its arms and their budget.

    Attributes:
        arms: Names of the arms, including all baselines; empty for all arms.
        seeds: Number of training runs of each arm.
        total_steps: Number of logged steps to draw in each training run; null for that of the preset.
        training: Further settings of every run, as on the command line: ``[--algorithm.batch, "128"]``; not
            ``checkpoint_rule`` or ``patience``. The study sets ``seed``, ``evaluate_every`` and ``checkpoint_every``.
        validations: Approximate number of closed-loop validations; the test evaluates the best checkpoint.
        weights: Settings of the sampling weights, the same for all methods.
        ensemble: The ensemble.
        progress: Minimum share of the expert's progress on the validation set, for every seed of a baseline.
        flat: Maximum absolute change of a baseline's score from the third to the last quarter of its validations,
            mean over seeds.
        rare: Share of test scenarios that count as rare by the kinematic heuristic, if there are no labels.
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
        for name, minimum in (("seeds", 2), ("validations", 4)):
            if getattr(self, name) < minimum:
                raise UsageError(f"{name} is {getattr(self, name)}", cure=f"use {minimum} or more")
        if not 0 < self.rare < 1:
            raise UsageError(f"rare is {self.rare}", cure="use a number between 0 and 1")
        if duplicates := [name for number, name in enumerate(self.arms) if name in self.arms[:number]]:
            raise UsageError(f"duplicate arm {duplicates[0]!r}", cure="name each arm once")


@dataclass(frozen=True)
class StudySets:
    """Scenario sets of a study.

    Attributes:
        train: Training set.
        validation: Validation set, for the choice of checkpoints; None: recordings of the training set are held out.
        test: Test sets; all their scenarios are tested. The first set has events as often as ordinary traffic.
        episodes: Folders of ``drivax record``: episodes in the training set, to learn from instead of the logs.
    """

    train: Path
    validation: Path | None
    test: tuple[Path, ...]
    episodes: tuple[Path, ...] = ()

    @classmethod
    def of(
        cls, data: Path, validation: Path | None, test: Sequence[Path], episodes: Sequence[Path] = ()
    ) -> StudySets:
        """Return the sets at these paths, or those of a benchmark's folder.

        With ``episodes`` and no ``validation``, recordings of the training set are held out, so that critics can be
        checked on their episodes.

        Raises:
            UsageError: A set is missing.
        """
        if (data / "train").is_dir():
            test_sets = tuple(path for path in (data / "test", data / "test-rare") if path.is_dir())
            test = tuple(test) or test_sets
            validation = validation or (None if episodes else data / "validation")
            data = data / "train"
        if not data.is_dir():
            raise UsageError(
                "scenario set not found", file=data, cure="name a scenario set, or a benchmark's folder"
            )
        if (validation is None and not episodes) or not test:
            raise UsageError(
                "no validation or test set",
                file=data,
                cure="pass --validation and --test, or a folder of `drivax generate --benchmark`",
            )
        return cls(data, validation, tuple(test), tuple(episodes))

    def open(self) -> list[ScenarioSet]:
        """Return the sets: for training, for validation if there is one, and for the test."""
        paths = (self.train, self.validation, *self.test)
        return [ScenarioSet.open(path) for path in paths if path is not None]


@dataclass(frozen=True)
class Study:
    """A study on scenario sets, with the paths of its files.

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
        """The arms of the study."""
        return {name: self.definition.arms[name] for name in self.config.arms}

    @property
    def claims(self) -> list[Claim]:
        """The claims about these arms."""
        return [claim for claim in self.definition.claims if {claim.arm, claim.reference} <= set(self.arms)]

    def run(self, arm: str, seed: int) -> Path:
        """Return the run folder of a training run."""
        return inside(self.folder, "runs", arm, f"seed-{seed}")

    def evaluation(self, name: str, seed: int | None = None) -> Path:
        """Return the evaluation folder of an arm with one seed, or of a planner."""
        return inside(self.folder, "evaluations", name, *([] if seed is None else [f"seed-{seed}"]))

    def evaluations(self, arm: str) -> dict[str, float | None]:
        """Return the speed limiter in each of an arm's evaluations, by name; None for no limiter.

        The first baseline is also evaluated at other checkpoints, and arms of claims at equal progress with limiters.
        """
        evaluations: dict[str, float | None] = {arm: None}
        if arm == self.definition.baselines[0]:
            evaluations[self.rule_evaluation] = None
        if any(claim.at_equal_progress and arm in (claim.arm, claim.reference) for claim in self.claims):
            evaluations |= {self.slower(arm, share): share for share in self.definition.limiters}
        return evaluations

    def slower(self, arm: str, share: float) -> str:
        """Return the name of an arm's evaluation with a speed limiter."""
        return f"{arm}_at_{share:g}"

    @property
    def rule_evaluation(self) -> str:
        """Name of the evaluations of the first baseline at checkpoints chosen by ``checkpoints_by``."""
        return f"{self.definition.baselines[0]}_by_{self.definition.checkpoints_by.rpartition('/')[2]}"

    @property
    def test(self) -> Path:
        """The scenario set of the test."""
        return inside(self.folder, "test")

    @cached_property
    def test_hash(self) -> str:
        """Hash of the test, which must exist."""
        return ScenarioSet.open(self.test, verify=False).hash

    @property
    def results(self) -> Path:
        """The results as JSON."""
        return inside(self.folder, "results.json")

    def scores(self, method: str) -> Path:
        """Return the file of a method's scores of the training set."""
        return inside(self.folder, "scores", f"{method}.npz")

    def train_config(self, arm: str, seed: int) -> TrainConfig:
        """Return the training configuration of an arm with one seed."""
        config = settings.load(TrainConfig, self.definition.arms[arm].preset, self.config.training)
        total_steps = self.config.total_steps
        total_steps = config.total_steps if total_steps is None else total_steps
        config = replace(config, seed=seed, total_steps=total_steps)
        if config.iterations < 2:
            problem = f"a training of {total_steps} steps has one iteration, too few for validations"
            raise UsageError(problem, cure="raise total_steps")
        if config.checkpoint_rule != "score" or config.patience:
            problem = "a study chooses checkpoints by the score, and stops no training early"
            raise UsageError(problem, cure="leave out checkpoint_rule and patience")
        interval = max(config.iterations // self.config.validations, 1)
        # All checkpoints of the first baseline stay: another rule chooses among them afterwards.
        keep = config.iterations if arm == self.definition.baselines[0] else config.keep
        return replace(config, evaluate_every=interval, checkpoint_every=interval, keep=keep)
