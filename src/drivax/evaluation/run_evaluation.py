"""Evaluate a planner into a run folder, and format its summary as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from drivax.evaluation.episode_table import EpisodeTable
from drivax.evaluation.runner import evaluate
from drivax.files import replace_folder
from drivax.metrics.selection import select_metrics
from drivax.planners.planner import Planner
from drivax.scenario.bank.scenario_bank import Sizes
from drivax.scenario.schema import CURRENT_STEP
from drivax.scenario.select.selection import select_scenarios
from drivax.scenario.store import ScenarioSet
from drivax.simulator.starts import LogStart, NoisyStart
from drivax.simulator.traffic.reactive import make_traffic
from drivax.simulator.types import Traffic
from drivax.table import Cell, Column, Table
from drivax.tasks.task import Task
from drivax.tracking.progress import Progress
from drivax.tracking.run_folder import RunFolder, learned_from

#: Columns of the headline table, with their short names.
HEADLINE = {
    "success": "success", "accuracy": "accuracy", "at_fault_collision": "at fault", "collision": "collision",
    "offroad": "off-road", "red_light": "red light", "progress_ratio": "progress", "comfortable": "comfort",
    "vmax_score": "vmax",
}  # fmt: skip
#: Crashes that are listed one by one.
_LISTED = 5


@dataclass(frozen=True)
class EvaluationConfig:
    """What is evaluated; stored as ``config.yaml``.

    Attributes:
        planner: Planner to evaluate: a name, module:name of your own, the run folder of a training run (RUN or
            RUN@STEP for an earlier checkpoint), or zoo:NAME.
        traffic: Traffic model: log replays the log, idm lets vehicles react to ego, a run folder or zoo:NAME drives
            the vehicles near ego (with +idm appended the others react), or module:name of your own.
        noisy_start: Start after a second of perturbed driving, drawn per scenario from the seed
            (docs/guide/dynamics.md).
        start_step: Step of the log at which episodes start.
        filter: Only scenarios that meet this condition (NAME=A|B, NAME!=A, NAME>=N); repeat it to combine several.
        scenarios: Only scenarios with these ids, or with the ids in a file, one per line.
        limit: Only the first N scenarios that remain after filtering.
        metrics: Metrics to print in addition to the headline: a set (training, full), names, or module:name of your
            own (docs/guide/custom.md). All built-in metrics are always computed and written.
        seed: Seed of all random numbers: noisy starts and planners that sample.
        sample: Let a trained policy sample its actions instead of taking the mode.
        batch: Scenarios loaded at a time; as many as memory allows by default. Results do not depend on it.
        task: Action space and observation of the planner.
    """

    planner: str
    traffic: str = "log"
    noisy_start: bool = False
    start_step: int = CURRENT_STEP
    filter: tuple[str, ...] = ()
    scenarios: tuple[str, ...] = ()
    limit: int | None = None
    seed: int = 0
    metrics: tuple[str, ...] = ()
    sample: bool = False
    batch: int | None = None
    task: Task = field(default_factory=Task)


def run_evaluation(
    config: EvaluationConfig,
    planner: Planner,
    data: ScenarioSet,
    out: str | Path,
    *,
    traffic: Traffic | None = None,
    sizes: Sizes | None = None,
    overwrite: bool = False,
) -> EpisodeTable:
    """Evaluate a planner on a scenario set, and write the run folder.

    Args:
        config: Task, scenarios, starts, seed, and the names of planner and traffic.
        planner: The planner.
        data: Scenario set, from which ``config`` selects.
        out: Run folder; it appears once all episodes are done.
        traffic: Traffic model; by default the built-in one named ``config.traffic``.
        sizes: Sizes that the whole set uses, if they are known already.
        overwrite: Replace an existing run folder.
    """
    scenarios = [data[row] for row in select_scenarios(data, config.filter, config.scenarios, config.limit)]
    RunFolder.check(Path(out), overwrite, "evaluation")
    with Progress(f"evaluating {planner.name}", "scenarios", len(scenarios)) as bar:
        table = evaluate(
            planner,
            scenarios,
            task=with_metrics(config.task, config.metrics),
            traffic=traffic or make_traffic(config.traffic),
            start=NoisyStart() if config.noisy_start else LogStart(),
            start_step=config.start_step,
            seed=config.seed,
            batch=config.batch,
            # The scenarios to evaluate have been verified; of the others only the sizes are read.
            sizes=sizes or Sizes.used(ScenarioSet.open(data.path, verify=False)),
            progress=lambda done, total: bar.update(done),
        )
    info: dict[str, Any] = {"kind": "evaluation", **table.info}
    if trained := learned_from(config.planner):
        info["trained_on"] = trained
    with replace_folder(Path(out)) as partial:
        RunFolder.create(partial, config, data=[data], overwrite=True, **info)
        table.write(partial)
    return table


def with_metrics(task: Task, more: tuple[str, ...]) -> Task:
    """Return the task with further metrics."""
    metrics = task.metrics if isinstance(task.metrics, tuple) else (task.metrics,)
    return replace(task, metrics=tuple(dict.fromkeys((*metrics, *more)))) if more else task


def format_summary(summaries: Sequence[Mapping[str, Any]]) -> str:
    """Format headline metrics of planners as a table of at most 100 columns; undefined means are empty."""
    means = [[summary["metrics"][name]["mean"] for name in HEADLINE] for summary in summaries]
    rows = [
        (Cell(summary["planner"]), *(Cell("" if mean is None else f"{mean:.3f}") for mean in row))
        for summary, row in zip(summaries, means, strict=True)
    ]
    columns = (Column("planner", label=True), *map(Column, HEADLINE.values()))
    return Table("summary", columns, tuple(rows)).text()


def format_metrics(summary: Mapping[str, Any], names: tuple[str, ...]) -> str:
    """Format metrics of one planner as a table: mean, 95 % interval and n.

    Args:
        summary: Summary of an evaluation.
        names: Metric sets, metrics and user-defined metrics (``metrics.selection``).
    """
    rows = []
    for name in select_metrics(names).names:
        if (metric := summary["metrics"].get(name)) is not None:
            mean, low, high = (
                "" if metric[key] is None else f"{metric[key]:.4g}" for key in ("mean", "low", "high")
            )
            rows.append(
                (Cell(name), Cell(mean), Cell(f"{low} to {high}" if low else ""), Cell(f"{metric['n']:,}"))
            )
    columns = (Column("metric", label=True), *map(Column, ("mean", "95 % interval", "n")))
    return Table("metrics", columns, tuple(rows)).text()


def format_crashes(table: EpisodeTable) -> str:
    """The first crashes, a line each; empty without any."""
    if not table.crashes:
        return ""
    count = len(table.crashes)
    lines = [f"{table.planner} crashed in {count} of {len(table)} episodes, which count as failed:"]
    lines += [f"  {crash.scenario_id}, step {crash.step}: {crash.error}" for crash in table.crashes[:_LISTED]]
    if count > _LISTED:
        lines.append(f"  and {count - _LISTED} more, in crashes.json")
    return "\n".join(lines)
