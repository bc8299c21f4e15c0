"""The log of one seed's training: metrics, checkpoints, the validations that rank them, and divergence.

Numbers that are not finite stop a seed; large ones cause a warning.
"""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import Any, Literal, Self

import numpy as np

from drivax.errors import DrivaxError
from drivax.evaluation.audit import scenario_names
from drivax.evaluation.runner import evaluate
from drivax.learning.program import trained_leaves
from drivax.planners.planner import Planner
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import Scenario
from drivax.seal import seal, unseal
from drivax.simulator.types import Traffic
from drivax.tasks.task import Task
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.run_folder import RunFolder
from drivax.tracking.sinks import MetricLog

#: How checkpoints are ranked. ``score``: the V-Max score. ``success``: successes, then the V-Max score.
#: ``lexicographic``: fewest failures, then progress, then comfort. ``fitted_q``: the return that fitted-Q evaluation
#: expects on held-out steps; needs ``fitted_q.updates``.
Rule = Literal["score", "success", "lexicographic", "fitted_q"]

_SCORES = ("vmax_score", "vmax_score_partial")
_METRICS = (
    "success", "accuracy", "accuracy_at_fault", "collision", "offroad", "red_light", "progress_ratio", "comfortable",
)  # fmt: skip
_ORDER = ("accuracy", "progress_ratio", "comfortable")
#: Absolute logged values beyond which training warns: a KL divergence of 1 nat per iteration, and Q values that only
#: rewards of +-100 per step reach at a discount of 0.99.
_LOG_BOUNDS = {"loss/kl": 1.0, "loss/mean_q": 1e4, "loss/largest_q": 1e4}
#: Prefixes of logged values that must be finite, causes before their effects.
_FINITE_PREFIXES = ("rollout/action_magnitude", "reward/", "loss/")


class DivergenceError(DrivaxError):
    """The training of a seed stopped because its rewards, losses, parameters or actions are not finite."""


@dataclass(frozen=True)
class Validation:
    """Held-out scenarios that rank checkpoints, and the ``data`` of a learner's metrics on them (None: no metrics)."""

    bank: ScenarioBank
    names: Sequence[Mapping[str, str]]
    data: Any = None

    @classmethod
    def of(cls, data: Iterable[Scenario]) -> Validation:
        """Load scenarios."""
        scenarios = list(data)
        return cls(ScenarioBank.from_scenarios(scenarios), scenario_names(scenarios))


def validate(planner: Planner, validation: Validation, task: Task, traffic: Traffic) -> dict[str, float]:
    """Evaluate a planner in closed loop on held-out scenarios.

    Returns ``validation/<metric>``: means over the scenarios that define it. Where ``success`` is defined, it and the
    shares ``late`` (only the goal is not reached), ``at_fault`` and ``not_at_fault`` (a failure) sum to 1.

    Raises:
        DivergenceError: Actions are not finite.
    """
    results = evaluate(planner, validation.bank, validation.names, task=task, traffic=traffic)
    if results.crashes:
        problem = f"actions of the policy are not finite in {len(results.crashes)} of {len(results)} episodes"
        raise DivergenceError(problem)
    values = {name: x for name, x in results.metrics.items() if np.isfinite(x).any()}
    # Prefer full scores, and never mix them with partial ones.
    score = next(name for name in _SCORES if name in values)
    means = {name: float(np.nanmean(values[name])) for name in (score, *_METRICS) if name in values}
    if "success" in means:
        means |= _split_unsuccessful(values)
    return {f"validation/{name}": mean for name, mean in means.items()}


def _split_unsuccessful(values: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return the shares of scenarios without success by reason."""
    names = ("success", "accuracy", "accuracy_at_fault")
    defined = np.isfinite(values["success"])
    success, accuracy, no_fault = (float(values[name][defined].mean()) for name in names)
    # Each metric implies the next one, so that differences are shares.
    return {"late": accuracy - success, "at_fault": 1.0 - no_fault, "not_at_fault": no_fault - accuracy}


def rank(rule: Rule, row: Mapping[str, Any]) -> tuple[float, ...] | None:
    """Return the rank of a checkpoint (higher is better) from its row of ``metrics.jsonl``.

    Undefined values rank last. None if the row has no validation.
    """
    prefix = "validation/"
    values = {name.removeprefix(prefix): value for name, value in row.items() if name.startswith(prefix)}
    if not values:
        return None
    if rule == "fitted_q":
        return (_or_last(values["fitted_q"], -math.inf),)
    if rule in ("score", "success"):
        score = float(next(values[name] for name in _SCORES if name in values))
        return (score,) if rule == "score" else (_or_last(values.get("success")), score)
    return tuple(_or_last(values.get(name)) for name in _ORDER)


def _or_last(value: float | None, last: float = -1.0) -> float:
    return float(value) if value is not None and math.isfinite(value) else last


def patience_exceeded(ranks: Sequence[tuple[float, ...]], patience: int) -> bool:
    """Return whether the last ``patience`` validations did not improve on the best before them; False if it is 0."""
    return 0 < patience < len(ranks) and max(ranks[-patience:]) <= max(ranks[:-patience])


class Preempted(DrivaxError):
    """SIGTERM stopped the run after a checkpoint; it can be resumed."""

    status = 128 + signal.SIGTERM


class StopSignal:
    """Context that records SIGTERM instead of ending the process; a second SIGTERM ends it.

    Batch systems send SIGTERM some seconds before they end a job. The context has no effect outside of the main thread.
    """

    def __init__(self) -> None:
        self.received = False
        self._previous: Any = None

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._previous = signal.signal(signal.SIGTERM, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        if self._previous is not None:
            signal.signal(signal.SIGTERM, self._previous)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self.received = True
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


class TrainingLog:
    """The run folder of one seed during training: metrics, checkpoints, and the ranks of its validations.

    ``rule``, ``keep`` and ``patience`` are those of the training configuration.
    """

    def __init__(self, folder: RunFolder, rule: Rule, keep: int, patience: int) -> None:
        self.folder = folder
        self.checkpoints = Checkpoints(folder.checkpoints, keep)
        self._rule: Rule = rule
        self._patience = patience
        self._ranks: list[tuple[float, ...]] = []
        self._warnings = set[str]()
        self._log: MetricLog | None = None
        newest = self.newest
        if newest is not None and folder.metrics.is_file():
            self._read_ranks(newest)

    @property
    def newest(self) -> int | None:
        """Step of the newest checkpoint."""
        return max(self.checkpoints.steps(), default=None)

    @property
    def out_of_patience(self) -> bool:
        """Whether patience is exceeded."""
        return patience_exceeded(self._ranks, self._patience)

    @property
    def divergence(self) -> DivergenceError | None:
        """The error of a seed that diverged, also in an earlier process; None for a healthy one."""
        info = self.folder.info.get("divergence")
        if info is None:
            return None
        path, problem = self.folder.path, info["problem"]
        checkpoint = None if self.newest is None else f"{path}@{self.newest}"
        text = f"training diverged at step {info['step']:,}: {problem}"
        return DivergenceError(text, file=path, cure=divergence_cure(problem, checkpoint))

    @property
    def stopped(self) -> bool:
        """Whether patience is exceeded or the seed diverged, after which nothing is written."""
        return self.folder.info.get("divergence") is not None or self.out_of_patience

    def start(self, step: int | None) -> None:
        """Open a new log, or the log of the run up to a step.

        Later rows and checkpoints, superseded checkpoints, and files of killed processes are deleted.
        """
        self.checkpoints.drop_after(-1 if step is None else step)
        self.checkpoints.delete_superseded()
        for leftover in self.folder.path.glob(".*.partial*"):
            if not leftover.is_dir() or leftover.is_symlink():
                leftover.unlink()
        self._ranks = []
        if step is not None:
            self._read_ranks(step)
        unseal(self.folder.path, self.folder.metrics.name)
        self._log = MetricLog(self.folder.path, resume_step=step)

    def save(self, step: int, state: Any, score: tuple[float, ...] | None) -> None:
        """Write a checkpoint, after the rows of the log up to it."""
        if self._log is None:
            raise RuntimeError("call start first")
        self._log.sync()
        self.checkpoints.write(step, state, score)

    def diverge(self, step: int, problem: str) -> None:
        """Note in ``run.json`` that the seed diverged."""
        self.folder = self.folder.note(divergence={"step": step, "problem": problem})

    def retry(self) -> None:
        """Remove the note of a divergence from ``run.json``."""
        self.folder = self.folder.note(divergence=None)

    def new_warnings(self, row: Mapping[str, float]) -> list[str]:
        """Return warnings of large values in an iteration, only one per name and process."""
        texts = large_logs(row)
        warnings = [text for name, text in texts.items() if name not in self._warnings]
        self._warnings |= set(texts)
        return warnings

    def _read_ranks(self, step: int) -> None:
        """Read the ranks of the validations up to a step."""
        ranks = (rank(self._rule, row) for row in self.folder.metric_rows() if row["step"] <= step)
        self._ranks = [values for values in ranks if values is not None]

    def write(self, step: int, row: Mapping[str, float]) -> tuple[float, ...] | None:
        """Log the values of one iteration and return the rank of its checkpoint."""
        if self._log is None:
            raise RuntimeError("call start first")
        self._log.write(step, row)
        values = rank(self._rule, row)
        if values is not None:
            self._ranks.append(values)
        return values

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._log is not None:
            self._log.close()
            if kind is None:
                seal(self.folder.path, self.folder.metrics.name)


def nonfinite_log(row: Mapping[str, float]) -> str | None:
    """Return the first action, reward or loss of an iteration that is NaN or infinite; None if there is none."""
    names = (name for prefix in _FINITE_PREFIXES for name in row if name.startswith(prefix))
    return next((f"{name} is {_word(row[name])}" for name in names if not np.isfinite(row[name])), None)


def nonfinite_leaf(state: Any) -> str | None:
    """Return the first trained leaf of a seed's state with a NaN or infinite number; None if there is none."""
    for name, leaf in trained_leaves(state).items():
        values = np.asarray(leaf, np.float32)
        if not np.isfinite(values).all():
            return f"{name} is {_word(values)}"
    return None


def large_logs(row: Mapping[str, float]) -> dict[str, str]:
    """Return the logged values beyond their bounds by name, as text."""
    return {
        name: f"{name} is {row[name]:.3g}, beyond {bound:g}"
        for name, bound in _LOG_BOUNDS.items()
        if name in row and abs(row[name]) > bound
    }


def divergence_cure(problem: str, checkpoint: str | None) -> str:
    """Return the cure of a divergence, given the last healthy checkpoint as ``RUN@STEP``."""
    name = problem.split(" ")[0]
    term = name.removeprefix("reward/")
    change = "lower the learning rate" if term == name else f"correct the reward term {term}"
    if checkpoint is None:
        return f"{change} and start again with --overwrite; there is no healthy checkpoint yet"
    return f"{change} and start a new run from the last healthy checkpoint: --from {checkpoint}"


def _word(values: Any) -> str:
    return "NaN" if np.isnan(values).any() else "infinite"
