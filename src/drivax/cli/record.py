"""``drivax record``: record episodes of several planners, to learn from offline."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from drivax.api import as_traffic, find_planner, load
from drivax.checks import check_at_least
from drivax.cli import record_of
from drivax.cli.evaluate import requested_task
from drivax.errors import DataError, UsageError
from drivax.escaping import show
from drivax.evaluation.runner import EvaluationConfig, format_summary, run_evaluation
from drivax.files import replace_folder
from drivax.learning.policies import open_policy
from drivax.planners.catalogue import PLANNERS
from drivax.planners.planner import add_noise
from drivax.scenario.schema import CURRENT_STEP
from drivax.scenario.store import ScenarioSet
from drivax.tasks.conditions import fix_conditions
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.run_folder import RunFolder, is_policy, run_and_step

#: Planners and noise of the mixtures, named like those of D4RL (Fu et al. 2020, arXiv 2004.07219).
MIXTURES: dict[str, tuple[tuple[str, float], ...]] = {
    "medium": (("zoo:bc", 0.0), ("zoo:bc", 0.2)),
    "mixed": (
        ("expert", 0.0), ("expert_actions", 0.3), ("pdm", 0.0), ("idm", 0.0), ("idm", 0.3), ("constant_speed", 0.2),
        ("zoo:bc", 0.0), ("zoo:aggressive", 0.0),
    ),
}  # fmt: skip
#: Suffix of a training run whose checkpoints are all recorded, as in the ``replay`` data sets of D4RL.
_ALL = "@all"


@dataclass(frozen=True, kw_only=True)
class RecordConfig:
    """Configuration of recorded episodes, stored as ``config.yaml``.

    Attributes:
        noise: Standard deviations of noise on the actions of each planner; mixtures have their own.
        seeds: Number of episodes of each kind per scenario; without noise and sampling they are identical.
        seed: First seed.
        sample: Let trained policies sample their actions instead of taking the mode.
        traffic: Traffic model, as for drivax evaluate; training must have the same.
        start_step: Step of the log at which episodes start.
        filter: Only scenarios that meet this condition; repeat it to combine several.
        limit: Only the first N scenarios that remain after filtering.
    """

    planners: tuple[str, ...]
    noise: tuple[float, ...] = (0.0,)
    seeds: int = 1
    seed: int = 0
    sample: bool = False
    traffic: str = "log"
    start_step: int = CURRENT_STEP
    filter: tuple[str, ...] = ()
    limit: int | None = None

    def __post_init__(self) -> None:
        check_at_least(self, 1, "seeds")
        if not self.planners or not self.noise:
            raise UsageError(
                "no planner to record" if self.noise else "no noise level", cure="give one or more"
            )


@dataclass(frozen=True, kw_only=True)
class Record(RecordConfig):
    """Record episodes of planners on every scenario of a set, failures included, for offline learning.

    PLANNER is a planner of drivax evaluate, RUN@all (every checkpoint of a training run), or a mixture: medium
    (behaviour cloning without and with noise) or mixed (the log, and a driver that follows it with noise; pdm; idm
    without and with noise; behaviour cloning; an aggressive driver; one that ignores traffic). --task.KEY VALUE changes
    the task of planners that are not trained.

    OUT has a run folder of drivax evaluate per planner, noise and seed; drivax train --episodes OUT learns from them.

    Example: drivax record mixed --data sets/train --out episodes/mixed

    Example: drivax record idm pdm runs/ppo@all --noise 0 0.3 --data sets/train --out episodes/all
    """

    planners: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PLANNER")]
    """Planners and mixtures."""
    data: Path
    """Scenario set."""
    out: Path
    """Folder to write."""
    filter: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    trust_code: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="MODULE")] = ()
    """Run code of this module of yours that a trained policy names; repeat it to trust several."""
    overwrite: bool = False
    """Replace OUT if it is a folder of recorded episodes."""


def run(args: Record, overrides: Sequence[str] = ()) -> int:
    """Record all episodes, then print their headline metrics."""
    RunFolder.check(args.out, args.overwrite, "episodes")
    traffic, task = as_traffic(args.traffic, args.trust_code), requested_task(overrides)
    data, summaries = ScenarioSet.open(args.data), []
    first = load(args.data, 1, filters=args.filter)
    seeds = range(args.seed, args.seed + args.seeds)
    drivers = {}
    # Before the first evaluation, so that errors come at once.
    for name, noise in _drivers(args.planners, args.noise):
        is_trained = is_policy(run_and_step(name)[0], PLANNERS)
        planner, driver_task = find_planner(
            name, first.bank, args.sample and is_trained, None if is_trained else task, args.trust_code
        )
        add_noise(planner, noise)
        drivers[name, noise] = planner, driver_task, is_trained
    runs = []
    with replace_folder(args.out) as partial_folder:
        run_folder = RunFolder.create(
            partial_folder, record_of(RecordConfig, args), [data], overwrite=True, kind="episodes"
        )
        for number, ((name, noise), seed) in enumerate(itertools.product(drivers, seeds)):
            planner, driver_task, is_trained = drivers[name, noise]
            config = EvaluationConfig(
                planner=name,
                traffic=args.traffic,
                start_step=args.start_step,
                filter=args.filter,
                limit=args.limit,
                seed=seed,
                sample=args.sample and is_trained,
                noise=noise,
                task=replace(driver_task, conditions=fix_conditions(driver_task.conditions)),
            )
            text = re.sub(r"[^\w.]+", "-", name)[-40:]
            runs.append(f"{number:02d}-{text}")
            table = run_evaluation(
                config, planner, data, partial_folder / runs[-1], traffic=traffic, sizes=first.sizes
            )
            summaries.append(table.summary())
        run_folder.note(runs=runs)
    show(format_summary(summaries))
    show(f"wrote {args.out}")
    return 0


def _drivers(planners: Sequence[str], noise: Sequence[float]) -> Iterator[tuple[str, float]]:
    """Yield planner and noise of every kind of episode."""
    for name in planners:
        if name in MIXTURES:
            yield from MIXTURES[name]
        elif name.endswith(_ALL):
            run = name.removesuffix(_ALL)
            steps = Checkpoints(open_policy(run).checkpoints).steps()
            if not steps:
                raise DataError("has no checkpoint", file=run, cure="name a training run")
            yield from itertools.product([f"{run}@{step}" for step in sorted(steps)], noise)
        else:
            yield from itertools.product([name], noise)
