"""The whole pipeline on the built-in world: generate, train, evaluate, report."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivax import settings
from drivax.evaluation.audit import audit
from drivax.evaluation.result_tables import paired_difference
from drivax.evaluation.runner import EvaluationConfig, format_summary, run_evaluation
from drivax.files import check_output, inside, write_json
from drivax.learning.config import TrainConfig
from drivax.learning.loop import train
from drivax.learning.policies import load_policy
from drivax.planners.catalogue import make_planner
from drivax.planners.planner import Planner
from drivax.report.pages.report import write_report
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.synthetic.generate import Generation, generate
from drivax.table import MISSING
from drivax.tasks.task import Task
from drivax.tracking.progress import Progress
from drivax.tracking.run_folder import describe_run

#: Planners to compare the trained policy with.
REFERENCES = ("expert", "constant_velocity", "constant_speed", "idm")
#: Metrics of the paired comparison.
_METRICS = ("success", "vmax_score")
#: Seeds of the training set and the held-out set.
_TRAINING_SEED, _HELD_OUT_SEED = 0, 1_000_000


@dataclass(frozen=True)
class DemoConfig:
    """Settings of the demo.

    Attributes:
        training: Number of training scenarios.
        held_out: Number of test scenarios.
        preset: Training configuration.
        overrides: Changes to the training configuration, as on the command line.
        workers: Number of generating processes; one per CPU core by default.
    """

    training: int = 256
    held_out: int = 128
    preset: str = "demo"
    overrides: tuple[str, ...] = ()
    workers: int | None = None


@dataclass(frozen=True)
class DemoResult:
    """Result of the demo: the report, a summary of each planner, the policy's paired differences, seconds by stage."""

    report: Path
    summaries: list[dict[str, Any]]
    differences: dict[str, dict[str, dict[str, float | int | None]]]
    stages_s: dict[str, float]

    def as_json(self) -> dict[str, Any]:
        """Return the fields except the report, and a description of the run."""
        return {
            "summaries": self.summaries,
            "policy_minus": self.differences,
            "stages_s": self.stages_s,
            **describe_run(),
        }

    def text(self) -> str:
        """Return a table of the planners, a line per comparison, and the time of each stage."""
        lines = [format_summary(self.summaries), ""]
        for planner, metrics in self.differences.items():
            for name, difference in metrics.items():
                numbers = (difference[key] for key in ("mean", "low", "high"))
                mean, low, high = (MISSING if number is None else f"{number:+.3f}" for number in numbers)
                count = f"over {difference['n']} scenarios"
                lines.append(f"policy - {planner}: {name} {mean} [{low}, {high}] {count}")
        lines += ["", ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in self.stages_s.items())]
        return "\n".join(lines)


class _Stages:
    """Announces the four stages, and times them."""

    def __init__(self, log: Callable[[str], None]) -> None:
        self._log = log
        self._starts_s: dict[str, float] = {}

    def start(self, name: str, line: str) -> None:
        """Start a stage, which ends the one before, and log its line."""
        self._starts_s[name] = time.monotonic()
        self._log(f"{len(self._starts_s)}/4  {line}")

    def seconds(self) -> dict[str, float]:
        """Return the time of each stage; the last one ends now."""
        ends = [*self._starts_s.values(), time.monotonic()][1:]
        pairs = zip(self._starts_s.items(), ends, strict=True)
        return {name: round(end - start, 1) for (name, start), end in pairs}


def run_demo(
    out: Path, config: DemoConfig | None = None, log: Callable[[str], None] = lambda _: None, *,
    overwrite: bool = False,
) -> DemoResult:  # fmt: skip
    """Generate both sets, train, evaluate all planners and write the report.

    Args:
        out: Folder for sets, runs and ``report.html``.
        config: Settings.
        log: Called with a line before each stage.
        overwrite: Replace the output of an earlier demo in ``out``.

    Raises:
        UsageError: ``out`` is a file; or it is not empty, and ``overwrite`` is false.
        DataError: A name in ``out`` is a symbolic link.
    """
    config = config or DemoConfig()
    is_empty = out.is_dir() and not any(out.iterdir())
    check_output(out, overwrite or is_empty, folder=True)
    out.mkdir(parents=True, exist_ok=True)
    training_set, held_out_set = inside(out, "sets", "train"), inside(out, "sets", "held_out")
    run_folder, report_file = inside(out, "training", "policy"), inside(out, "report.html")
    evaluations = {name: inside(out, "evaluation", name) for name in (*REFERENCES, "policy")}
    result_file = inside(out, "demo.json")
    stages = _Stages(log)
    stages.start(
        "generation",
        f"{config.training} training and {config.held_out} held-out scenarios of the built-in world",
    )
    training = _generate_set(training_set, config.training, _TRAINING_SEED, config)
    held_out = _generate_set(held_out_set, config.held_out, _HELD_OUT_SEED, config)
    stages.start("training", f"training by the preset {config.preset}")
    training_config = settings.load(TrainConfig, config.preset, list(config.overrides))
    # No scenarios are set aside for validation: the held-out set is the test.
    run = train(training_config, training, run_folder, validation=None, overwrite=True).path
    stages.start("evaluation", "evaluating on the held-out scenarios")
    results = {}
    planners: dict[str, tuple[Planner, Task]] = {name: (make_planner(name), Task()) for name in REFERENCES}
    planners["policy"] = load_policy(
        run, ScenarioBank.from_scenarios(held_out[:1]), trust=settings.modules_of(training_config)
    )
    for name, (planner, task) in planners.items():
        folder = evaluations[name]
        folder.parent.mkdir(exist_ok=True)
        evaluation = EvaluationConfig(planner=name if name in REFERENCES else str(run), task=task)
        results[name] = run_evaluation(evaluation, planner, held_out, folder, overwrite=True)
    stages.start("report", "writing the report")
    report = write_report([run, *evaluations.values()], report_file, overwrite=True)
    policy = results["policy"]
    differences = {
        name: {metric: paired_difference(policy, results[name], metric).as_dict() for metric in _METRICS}
        for name in REFERENCES
    }
    summaries = [result.summary() for result in results.values()]
    demo = DemoResult(report, summaries, differences, stages.seconds())
    write_json(result_file, demo.as_json())
    return demo


def _generate_set(path: Path, count: int, seed: int, config: DemoConfig) -> ScenarioSet:
    path.parent.mkdir(parents=True, exist_ok=True)
    options = Generation(workers=config.workers or os.cpu_count() or 1, overwrite=True)
    with Progress("generating", "scenarios", count) as bar:
        generate(path, count, seed, options, lambda done, total: bar.update(done), audit)
    return ScenarioSet.open(path)
