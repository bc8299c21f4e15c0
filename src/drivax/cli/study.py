"""``drivax study``: an experiment with its controls, from training to verdicts."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from drivax import settings
from drivax.escaping import show
from drivax.studies.definition import Study as Plan
from drivax.studies.definition import StudyConfig, StudySets, load_study
from drivax.studies.study import run_study


@dataclass(frozen=True)
class Study:
    """Run an experiment and write its report.

    longtail: does training on critical moments more often make a safer planner? Scores the training set, trains and
    evaluates all arms and their controls, and tests the claims; OUT/report.html has the verdicts.

    The same command resumes an interrupted study. Change settings with flags such as --total_steps 500000 or
    --arms [baseline,bc,heuristic,random_matched].

    Example: drivax study longtail --data sets/bench --seeds 5 --out studies/longtail
    """

    study: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="STUDY")]
    """longtail, or a YAML file that declares arms and claims."""
    data: Path
    """Scenario set to train on, or a folder of drivax generate --benchmark."""
    out: Path
    """Folder of the study."""
    validation: Path | None = None
    """Scenario set for the choice of checkpoints."""
    test: tuple[Path, ...] = ()
    """Scenario sets of the test; the first has events as often as ordinary traffic."""
    episodes: tuple[Path, ...] = ()
    """Folders of drivax record: episodes in the training set, to learn from instead of the logs."""
    seeds: int | None = None
    """Training runs of each arm; by default those of the configuration, or 5."""
    config: Path | None = None
    """YAML file with settings."""
    cores: int | None = None
    """Parallel training runs, one core each; all cores by default."""
    anyway: bool = False
    """Continue even if the baselines do not drive well enough for a comparison."""


def run(args: Study, overrides: Sequence[str] = ()) -> int:
    """Run the study; progress goes to standard error."""
    config = settings.load(StudyConfig, args.config or {}, overrides)
    if args.seeds is not None:
        config = replace(config, seeds=args.seeds)
    sets = StudySets.of(args.data, args.validation, args.test, args.episodes)
    results = run_study(
        Plan(load_study(args.study), config, sets, args.out),
        cores=args.cores,
        anyway=args.anyway,
        log=lambda line: show(line, sys.stderr),
    )
    for claim in results["claims"]:
        note = f" ({claim['needed']})" if claim["needed"] else ""
        show(f"{claim['verdict']:<12} {claim['claim']['words']}{note}")
    show(f"{args.out / 'report.html'}")
    return 0
