"""An evaluation as a run folder, and its headline as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from drivax.evaluation.results import Results
from drivax.evaluation.runner import evaluate_scenarios
from drivax.files import replace_folder
from drivax.metrics.selection import select_metrics
from drivax.planners.planner import Planner
from drivax.scenario.bank.scenario_bank import Sizes
from drivax.scenario.schema import CURRENT_STEP
from drivax.scenario.select.selection import select_scenarios
from drivax.scenario.store import ScenarioSet
from drivax.simulator.simulator import Simulator
from drivax.simulator.starts import LogStart, NoisyStart
from drivax.simulator.traffic.catalogue import make_traffic
from drivax.simulator.types import Traffic
from drivax.tasks.task import Task
from drivax.tracking.progress import Progress
from drivax.tracking.run_folder import RunFolder, learned_from, refuse_existing

#: Columns of the headline, with their short names.
HEADLINE = {
    "success": "success", "accuracy": "accuracy", "at_fault_collision": "at fault", "collision": "collision",
    "offroad": "off-road", "red_light": "red light", "progress_ratio": "progress", "comfortable": "comfort",
    "vmax_score": "vmax",
}  # fmt: skip
#: So many crashes are told one by one.
_TOLD = 5


@dataclass(frozen=True)
class EvaluationConfig:
    """What was evaluated; written as ``config.yaml``.

    Attributes:
        planner, traffic: What they are called.
        noisy_start, start_step: How episodes begin, and at which step of the log.
        filter, scenarios, limit: Which scenarios were driven (``scenario.select.selection``).
        seed: Of all chance.
        metrics: What was asked for beside the headline; metrics of the user's own are measured beside all of ours.
        sample: Whether a trained policy drew its actions.
        batch: How many scenarios were loaded at a time; None: as many as memory allowed.
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


def run_evaluation(
    config: EvaluationConfig,
    planner: Planner,
    data: ScenarioSet,
    out: str | Path,
    *,
    task: Task | None = None,
    traffic: Traffic | None = None,
    sizes: Sizes | None = None,
    overwrite: bool = False,
) -> Results:
    """Evaluates a planner on a set and writes the run folder.

    Args:
        config: Which scenarios, starts and seed; what planner and traffic are called.
        planner: The driver.
        data: The scenarios, of which ``config`` chooses.
        out: Run folder; it appears after the drive.
        task: Action space and observation of the planner.
        traffic: How the others move; by default what ``config.traffic`` is called in the simulator's catalogue.
        sizes: What the whole set uses, if that is known already.
        overwrite: Replace an existing run folder.
    """
    scenarios = [data[row] for row in select_scenarios(data, config.filter, config.scenarios, config.limit)]
    refuse_existing(Path(out), overwrite, "evaluation")
    start = NoisyStart() if config.noisy_start else LogStart()
    judged = with_metrics(task or Task(), config.metrics)
    with Progress(f"driving {planner.name}", "scenarios", len(scenarios)) as bar:
        results = evaluate_scenarios(
            Simulator(judged, traffic or make_traffic(config.traffic), start),
            planner,
            scenarios,
            start_step=config.start_step,
            seed=config.seed,
            batch=config.batch,
            # Checksums are tested where a scenario is driven; this only looks at what each record uses.
            sizes=sizes or Sizes.used(ScenarioSet.open(data.path, verify=False)),
            progress=lambda done, total: bar.update(done),
        )
    notes: dict[str, Any] = {"kind": "evaluation", "planner": results.planner, "traffic": results.traffic}
    if trained := learned_from(config.planner):
        notes["trained_on"] = trained
    # A folder of that name is always a whole run.
    with replace_folder(Path(out)) as partial:
        RunFolder.create(partial, config, data=[data], overwrite=True, **notes, **results.notes())
        results.write(partial)
    return results


def with_metrics(task: Task, more: tuple[str, ...]) -> Task:
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


def format_metrics(summary: Mapping[str, Any], wanted: tuple[str, ...]) -> str:
    """Metrics of one planner as a table: mean, 95 % interval and n; codes and counts have none.

    Args:
        summary: Of an evaluation.
        wanted: Sets, metrics, and those of the user's own (``metrics.selection``).
    """
    found = {
        name: summary["metrics"][name] for name in select_metrics(wanted).names if name in summary["metrics"]
    }
    width = max(map(len, ("metric", *found)))
    lines = [f"{'metric':<{width}}  {'mean':>9}  {'95 % interval':>20}  {'n':>7}"]
    for name, cells in found.items():
        mean, low, high = (
            "" if cells[part] is None else f"{cells[part]:.4g}" for part in ("mean", "low", "high")
        )
        between = f"{low} to {high}" if low else ""
        lines.append(f"{name:<{width}}  {mean:>9}  {between:>20}  {cells['n']:>7,}")
    return "\n".join(lines)


def format_crashes(results: Results) -> str:
    """The first crashes in words, a line each; empty where there were none."""
    if not results.crashes:
        return ""
    count = len(results.crashes)
    lines = [f"{results.planner} crashed in {count} of {len(results)} episodes, which count as failed:"]
    lines += [
        f"  {row['scenario_id']}, step {row['step']}: {row['error']}" for row in results.crash_rows()[:_TOLD]
    ]
    if count > _TOLD:
        lines.append(f"  and {count - _TOLD} more, in crashes.json")
    return "\n".join(lines)
