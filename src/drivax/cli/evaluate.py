"""``drivax evaluate``: drive a planner through a scenario set and judge it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from drivax.api import find_planner, load
from drivax.evaluation.run_evaluation import (
    EvaluationConfig,
    format_crashes,
    format_metrics,
    format_summary,
    run_evaluation,
)
from drivax.learning.policies import find_traffic
from drivax.metrics.selection import select_metrics
from drivax.scenario.schema import CURRENT_STEP
from drivax.scenario.store import ScenarioSet


@dataclass(frozen=True)
class Evaluate:
    """Drive a planner through every scenario of a set, to the end of each log, and measure it.

    A planner is expert, expert_actions, constant_velocity, random, idm, pdm, search, module:name of your own, the
    run folder of `drivax train`, or zoo:aggressive, a policy that comes with the package.

    Writes episodes.csv, summary.json, trajectories.npz, and crashes.json where the planner crashed.

    Example: drivax evaluate --planner idm --data sets/test --out runs/idm

    Example: drivax evaluate --planner my_drivers:cruise --data sets/test --filter type=turn_left --out runs/turns

    Example: drivax evaluate --planner idm --data sets/test --traffic zoo:aggressive --out runs/idm-pushed
    """

    planner: str
    """Name of a planner, run folder of a training run (RUN or RUN@STEP for an earlier checkpoint), or zoo:NAME."""
    data: Path
    """Scenario set."""
    out: Path
    """Run folder to write."""
    traffic: str = "log"
    """How the others move: log replays them, idm lets vehicles react, a run folder or zoo:NAME drives those near ego
    (with +idm behind it the others react), or module:name of your own."""
    noisy_start: bool = False
    """Begin after a second of wrong driving, drawn per scenario from --seed (docs/guide/dynamics.md)."""
    start_step: int = CURRENT_STEP
    """Step of the log at which to begin."""
    filter: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Only scenarios for which this holds (NAME=A|B, NAME!=A, NAME>=N); may be given several times."""
    scenarios: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID|FILE")] = ()
    """Only scenarios with these ids, or that a file names, one id per line."""
    limit: int | None = None
    """Only the first so many scenarios of those that the filters leave."""
    metrics: tuple[str, ...] = ()
    """Also print these: a set (training, full), metrics by name, or your own as module:name (docs/guide/custom.md). All
    of ours are measured and written in any case, your own beside them."""
    seed: int = 0
    """Of all chance: noisy starts, planners that draw random numbers."""
    sample: bool = False
    """Let a trained policy sample its actions instead of acting by the mode."""
    batch: int | None = None
    """Scenarios that are loaded at a time; as many as free memory allows by default. No result depends on it."""
    overwrite: bool = False
    """Replace OUT if it is a run folder."""


def run(args: Evaluate) -> int:
    """Evaluate and print the headline metrics, and who crashed."""
    # Names that do not exist are refused before the long work.
    traffic = find_traffic(args.traffic)
    select_metrics(args.metrics)
    data = ScenarioSet.open(args.data)
    some = load(args.data, 1, filters=args.filter, scenarios=args.scenarios)
    planner, task = find_planner(args.planner, some.bank, args.sample)
    config = EvaluationConfig(
        planner=args.planner,
        traffic=args.traffic,
        noisy_start=args.noisy_start,
        start_step=args.start_step,
        filter=args.filter,
        scenarios=args.scenarios,
        limit=args.limit,
        seed=args.seed,
        metrics=args.metrics,
        sample=args.sample,
        batch=args.batch,
    )
    results = run_evaluation(
        config,
        planner,
        data,
        args.out,
        task=task,
        traffic=traffic,
        sizes=some.sizes,
        overwrite=args.overwrite,
    )
    print(format_summary([results.summary()]))
    if args.metrics:
        print(format_metrics(results.summary(), args.metrics))
    if crashes := format_crashes(results):
        print(crashes)
    print(f"wrote {args.out}")
    return 0
