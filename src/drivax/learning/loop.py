"""The training loop: iterate on the device, log, validate, checkpoint, resume."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from drivax.errors import UsageError
from drivax.evaluation.audit import scenario_names
from drivax.evaluation.runner import evaluate
from drivax.learning.algorithm import Learner, LearnerState
from drivax.learning.config import TrainConfig
from drivax.scenario.bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.simulator.catalogue import make_traffic, prepared
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.progress import Progress
from drivax.tracking.runs import RunFolder
from drivax.tracking.sinks import MetricLog

#: Metrics of a validation that are logged.
_VALIDATION = ("success", "accuracy", "collision", "offroad", "red_light", "progress_ratio", "comfortable")


@dataclass(frozen=True)
class Validation:
    """Held-out scenarios that checkpoints are chosen by."""

    bank: ScenarioBank
    names: Sequence[Mapping[str, str]]

    @classmethod
    def of(cls, data: ScenarioSet) -> Validation:
        """From a scenario set."""
        scenarios = list(data)
        return cls(ScenarioBank.from_scenarios(scenarios), scenario_names(scenarios))


def train(
    config: TrainConfig,
    data: ScenarioSet,
    out: str | Path,
    *,
    validation: ScenarioSet | None = None,
    resume: bool = False,
    overwrite: bool = False,
) -> RunFolder:
    """Trains a policy and writes the run folder: config, metrics, checkpoints of the full state.

    Args:
        config: What to train.
        data: Scenarios to train on; all of them are held on the device.
        out: Run folder.
        validation: Scenarios that choose the best checkpoint.
        resume: Continue the run in ``out`` from its newest checkpoint, bit for bit on one CPU device.
        overwrite: Replace an existing run folder.

    Raises:
        UsageError: If ``out`` exists and neither ``resume`` nor ``overwrite`` is given, or a resumed run was trained
            on other data.
    """
    folder = _open(config, data, validation, Path(out), resume, overwrite)
    if resume:
        config = folder.config(TrainConfig)
    environment = config.environment()
    bank = prepared(environment.simulator.traffic, ScenarioBank.from_scenarios(data))
    learner = config.algorithm.build(environment, bank, config.iterations)
    checkpoints = Checkpoints(folder.checkpoints)
    state = _first_state(learner, bank, config, checkpoints if resume else None)
    held_out = None if validation is None else Validation.of(validation)
    begin = int(state.iteration)
    with (
        MetricLog(folder.path, resume_step=_steps(config, begin) if resume else None) as log,
        Progress("training", "steps", _steps(config, config.iterations)) as progress,
    ):
        progress.update(_steps(config, begin))
        _iterate(config, learner, bank, state, _Outputs(log, progress, checkpoints, held_out))
    return folder


@dataclass(frozen=True)
class _Outputs:
    log: MetricLog
    progress: Progress
    checkpoints: Checkpoints
    validation: Validation | None


def _iterate(
    config: TrainConfig, learner: Learner, bank: ScenarioBank, state: LearnerState, outputs: _Outputs
) -> None:
    step = jax.jit(learner.iterate, donate_argnums=1)
    for iteration in range(int(state.iteration) + 1, config.iterations + 1):
        began = time.perf_counter()
        state, raw = step(bank, state)
        row = logged(jax.device_get(raw))
        row["steps_per_second"] = config.algorithm.steps_per_iteration / (time.perf_counter() - began)
        done = _steps(config, iteration)
        last = iteration == config.iterations
        due = last or (config.evaluate_every > 0 and iteration % config.evaluate_every == 0)
        score = None
        if due and outputs.validation is not None:
            score, seen = validate(config, learner, state, outputs.validation)
            row |= seen
        outputs.log.write(done, row)
        note = f"success {row.get('rollout/success', float('nan')):.2f}"
        outputs.progress.update(done, note)
        if last or due or iteration % config.checkpoint_every == 0:
            outputs.checkpoints.save(done, state, score)


def validate(
    config: TrainConfig, learner: Learner, state: LearnerState, validation: Validation
) -> tuple[float, dict[str, float]]:
    """Closed-loop score of the policy's mode on held-out scenarios, and what to log."""
    planner = learner.planner(state.parameters, "policy", samples=False)
    results = evaluate(
        planner, validation.bank, validation.names, task=config.task, traffic=make_traffic(config.traffic)
    )
    # Full scores where there are any; partial ones are never mixed with them.
    name = next(n for n in ("vmax_score", "vmax_score_partial") if np.isfinite(results.metrics[n]).any())
    score = float(np.nanmean(results.metrics[name]))
    row = {f"validation/{name}": score}
    for name in _VALIDATION:
        values = results.metrics[name]
        if np.isfinite(values).any():
            row[f"validation/{name}"] = float(np.nanmean(values))
    return score, row


def logged(raw: Mapping[str, Any]) -> dict[str, float]:
    """Means to log from the numbers of an iteration.

    A name with ``<name>/n`` beside it is a sum over so many (episodes that define a metric, updates): its mean is
    logged, and nothing where there were none. Sums of ``rollout/reward/*`` are over the steps. What else there is
    is logged as it is.
    """
    values = {name: float(value) for name, value in raw.items() if not name.endswith("/n")}
    steps = values.pop("rollout/steps", 0.0)
    row = {}
    for name, value in values.items():
        if name.startswith("rollout/reward/"):
            name, count = name.removeprefix("rollout/"), steps
        else:
            count = float(raw.get(f"{name}/n", 1.0))
        if count > 0:
            row[name] = value / count
    return row


def _steps(config: TrainConfig, iteration: int) -> int:
    return iteration * config.algorithm.steps_per_iteration


def _first_state(
    learner: Learner, bank: ScenarioBank, config: TrainConfig, stored: Checkpoints | None
) -> LearnerState:
    if stored is not None and stored.steps():
        template = jax.eval_shape(learner.init, bank, jax.random.key(config.seed))
        return stored.restore(template)
    return jax.jit(learner.init)(bank, jax.random.key(config.seed))


def _open(
    config: TrainConfig,
    data: ScenarioSet,
    validation: ScenarioSet | None,
    out: Path,
    resume: bool,
    overwrite: bool,
) -> RunFolder:
    held_out = None if validation is None else validation.hash
    if not resume:
        notes = {"kind": "training", "validation": held_out}
        return RunFolder.create(out, config, data=[data], overwrite=overwrite, **notes)
    folder = RunFolder.open(out)
    if folder.info.get("validation") != held_out:
        raise UsageError(
            "was validated on other scenarios", file=out, cure="resume with the same --validation"
        )
    trained_on = [entry.get("hash") for entry in folder.info.get("data", [])]
    if trained_on != [data.hash]:
        raise UsageError("was trained on other scenarios", file=out, cure="resume with the same --data")
    return folder
