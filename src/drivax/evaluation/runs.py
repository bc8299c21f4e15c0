"""An evaluation as a run folder, and its headline as text."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from drivax.evaluation.audit import scenario_names
from drivax.evaluation.results import Results
from drivax.evaluation.runner import evaluate_in
from drivax.planners.planner import Planner
from drivax.scenario.bank import ScenarioBank
from drivax.scenario.schema import CURRENT_STEP
from drivax.scenario.store import ScenarioSet
from drivax.simulator.catalogue import make_traffic
from drivax.simulator.simulator import Simulator
from drivax.simulator.starts import LogStart, NoisyStart
from drivax.simulator.types import Traffic
from drivax.tasks.task import Task
from drivax.tracking.progress import Progress
from drivax.tracking.runs import RunFolder, refuse_existing, training_data

#: Columns of the headline, with their short names.
HEADLINE = {
    "success": "success", "accuracy": "accuracy", "at_fault_collision": "at fault", "collision": "collision",
    "offroad": "off-road", "red_light": "red light", "progress_ratio": "progress", "comfortable": "comfort",
    "vmax_score": "vmax",
}  # fmt: skip


@dataclass(frozen=True)
class EvaluationConfig:
    """What was evaluated; written as ``config.yaml``."""

    planner: str
    traffic: str = "log"
    noisy_start: bool = False
    start_step: int = CURRENT_STEP
    limit: int | None = None
    seed: int = 0
    metrics: tuple[str, ...] = ()


def run_evaluation(
    config: EvaluationConfig,
    planner: Planner,
    data: ScenarioSet,
    out: str | Path,
    *,
    bank: ScenarioBank | None = None,
    task: Task | None = None,
    traffic: Traffic | None = None,
    overwrite: bool = False,
) -> Results:
    """Evaluates a planner on a set and writes the run folder.

    Args:
        config: Starts, start step, seed and limit; what planner and traffic are called.
        planner: The driver.
        data: The scenarios; the first ``config.limit`` of them.
        out: Run folder; it appears after the drive.
        bank: The bank of these scenarios, where it exists already.
        task: Action space and observation of the planner.
        traffic: How the others move; by default what ``config.traffic`` is called in the simulator's catalogue.
        overwrite: Replace an existing run folder.
    """
    count = len(data) if config.limit is None else min(len(data), config.limit)
    scenarios = [data[row] for row in range(count)]
    bank = ScenarioBank.from_scenarios(scenarios) if bank is None else bank
    refuse_existing(Path(out), overwrite)
    with Progress(f"driving {planner.name}", "scenarios", count) as bar:
        start = NoisyStart() if config.noisy_start else LogStart()
        results = evaluate_in(
            Simulator(
                _with_metrics(task or Task(), config.metrics), traffic or make_traffic(config.traffic), start
            ),
            planner,
            bank,
            scenario_names(scenarios),
            start_step=config.start_step,
            seed=config.seed,
            progress=lambda done, total: bar.update(done),
        )
    # Everything is written beside the final name, so that a folder of that name is always a whole run.
    out = Path(out)
    partial = out.parent / f".{out.name}.partial-{os.getpid()}"
    notes: dict[str, Any] = {"kind": "evaluation", "planner": results.planner, "traffic": results.traffic}
    if trained := training_data(config.planner):
        notes["trained_on"] = trained
    try:
        RunFolder.create(partial, config, data=[data], overwrite=True, **notes, **results.notes())
        results.write(partial)
        shutil.rmtree(out, ignore_errors=True)
        partial.rename(out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return results


def _with_metrics(task: Task, more: tuple[str, ...]) -> Task:
    """The task with further metrics."""
    given = task.metrics if isinstance(task.metrics, tuple) else (task.metrics,)
    return replace(task, metrics=tuple(dict.fromkeys((*given, *more)))) if more else task


def format_summary(summaries: Sequence[Mapping[str, Any]]) -> str:
    """Planners and their headline metrics as a table of at most 100 columns; empty where undefined."""
    width = max(len("planner"), *(len(summary["planner"]) for summary in summaries))
    lines = ["  ".join([f"{'planner':<{width}}", *(f"{short:>9}" for short in HEADLINE.values())])]
    for summary in summaries:
        cells = [f"{summary['planner']:<{width}}"]
        for name in HEADLINE:
            mean = summary["metrics"][name]["mean"]
            cells.append(f"{'' if mean is None else f'{mean:.3f}':>9}")
        lines.append("  ".join(cells))
    return "\n".join(lines)
