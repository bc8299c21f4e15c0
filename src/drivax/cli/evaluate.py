"""``drivax evaluate``: evaluate a planner on a scenario set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from drivax import settings
from drivax.api import as_traffic, find_planner, load
from drivax.cli import judge, record_of
from drivax.errors import UsageError, did_you_mean, import_extra
from drivax.escaping import show
from drivax.evaluation.runner import (
    EvaluationConfig,
    format_crashes,
    format_metrics,
    format_summary,
    run_evaluation,
)
from drivax.metrics.catalogue import select_metrics
from drivax.planners.catalogue import PLANNERS
from drivax.scenario.store import ScenarioSet
from drivax.tasks.conditions import fix_conditions, parse_values
from drivax.tasks.task import Task
from drivax.tracking.run_folder import zoo

#: Name among the metrics for nuPlan's devkit profile, computed from the finished episodes.
_DEVKIT = "devkit"


@dataclass(frozen=True, kw_only=True)
class Evaluate(EvaluationConfig):  # noqa: D101
    __doc__ = f"""Evaluate a planner on every scenario of a set, to the end of each log.

    A planner is {", ".join(PLANNERS)}, your own module:name, the run folder of `drivax train`, or a policy of the
    package: {", ".join(zoo())}. Change settings of the task with --task.KEY VALUE; a trained policy has its own task.

    Writes episodes.csv, summary.json, trajectories.npz, and crashes.json if the planner crashed.

    Example: drivax evaluate --planner idm --data sets/test --out runs/idm

    Example: drivax evaluate --planner random --task.actions published --data sets/test --out runs/random

    Example: drivax evaluate --planner my_drivers:cruise --data sets/test --filter type=turn_left --out runs/turns

    Example: drivax evaluate --planner idm --data sets/test --traffic zoo:aggressive --out runs/idm-pushed
    """

    data: Path
    """Scenario set."""
    out: Path
    """Run folder to write."""
    filter: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    scenarios: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID|FILE")] = ()
    task: tyro.conf.Suppress[tyro.conf.Fixed[Task]] = field(default_factory=Task)
    condition: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME=NUMBER")
    ] = ()
    """Change a condition of a policy that was trained with conditions; repeat it to change several."""
    trust_code: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="MODULE")] = ()
    """Run code of this module of yours that a trained policy names; repeat it to trust several."""
    overwrite: bool = False
    """Replace OUT if it is a run folder."""


def run(args: Evaluate, overrides: Sequence[str] = ()) -> int:
    """Evaluate, then print the headline metrics and crashes."""
    # Check names before the evaluation starts.
    traffic = as_traffic(args.traffic, args.trust_code)
    metrics = tuple(name for name in args.metrics if name != _DEVKIT)
    select_metrics(metrics)
    if _DEVKIT in args.metrics:
        import_extra("shapely")
    own_task = requested_task(overrides)
    data = ScenarioSet.open(args.data)
    first = load(args.data, 1, filters=args.filter, scenarios=args.scenarios)
    planner, task = find_planner(args.planner, first.bank, args.sample, own_task, args.trust_code)
    task = replace(task, conditions=fix_conditions(task.conditions, parse_values(args.condition)))
    config = record_of(EvaluationConfig, args, task=task, metrics=metrics)
    results = run_evaluation(
        config, planner, data, args.out, traffic=traffic, sizes=first.sizes, overwrite=args.overwrite
    )
    show(format_summary([results.summary()]))
    if metrics:
        show(format_metrics(results.summary(), metrics))
    if crashes := format_crashes(results):
        show(crashes)
    show(f"wrote {args.out}")
    if _DEVKIT in args.metrics:
        judge.run(judge.Judge(args.out, data=args.data))
    return 0


def requested_task(overrides: Sequence[str]) -> Task | None:
    """Return the task of ``--task.KEY VALUE`` arguments, or None without any."""
    if not overrides:
        return None
    for argument in overrides:
        if argument.startswith("--") and not argument.startswith("--task."):
            names = [name for name in Evaluate.__dataclass_fields__ if name != "task"]
            options = [f"--{name.replace('_', '-')}" for name in names]
            cure = did_you_mean(argument, [*options, "--task.KEY"])
            raise UsageError(f"unknown option {argument!r}", cure=cure)
    return settings.load(EvaluationConfig, {"planner": ""}, overrides).task
