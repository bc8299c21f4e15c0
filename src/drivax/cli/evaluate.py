"""``drivax evaluate``: drive a planner through a scenario set and judge it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from drivax.api import find_planner, load
from drivax.errors import UsageError
from drivax.evaluation.runs import EvaluationConfig, format_summary, run_evaluation
from drivax.learning.policy_traffic import find_traffic
from drivax.metrics.selection import selected
from drivax.scenario.schema import CURRENT_STEP
from drivax.scenario.store import ScenarioSet


@dataclass(frozen=True)
class Evaluate:
    """Drive a planner through every scenario of a set, to the end of each log, and measure it.

    A planner is expert, expert_actions, constant_velocity, random, idm, pdm, search, module:name of your own, the
    run folder of `drivax train`, or zoo:aggressive, a policy that comes with the package.

    Writes episodes.csv, summary.json and trajectories.npz.

    Example: drivax evaluate --planner idm --data sets/test --out runs/idm

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
    limit: int | None = None
    """Only the first so many scenarios."""
    metrics: tuple[str, ...] = ()
    """Metrics of your own beside all of ours, as module:name (docs/guide/custom.md)."""
    seed: int = 0
    """Of planners that draw random numbers."""
    sample: bool = False
    """Let a trained policy sample its actions instead of acting by the mode."""
    overwrite: bool = False
    """Replace OUT if it is a run folder."""


def run(args: Evaluate) -> int:
    """Evaluate and print the headline metrics."""
    if args.limit is not None and args.limit < 1:
        raise UsageError(f"--limit {args.limit} leaves no scenario", cure="use 1 or more")
    # Names that do not exist are refused before the long work.
    traffic = find_traffic(args.traffic)
    selected(args.metrics)
    data = ScenarioSet.open(args.data)
    bank = load(args.data, args.limit).bank
    planner, task = find_planner(args.planner, bank, args.sample)
    config = EvaluationConfig(
        planner=args.planner,
        traffic=args.traffic,
        noisy_start=args.noisy_start,
        start_step=args.start_step,
        limit=args.limit,
        seed=args.seed,
        metrics=args.metrics,
    )
    results = run_evaluation(
        config, planner, data, args.out, bank=bank, task=task, traffic=traffic, overwrite=args.overwrite
    )
    print(format_summary([results.summary()]))
    print(f"wrote {args.out}")
    return 0
