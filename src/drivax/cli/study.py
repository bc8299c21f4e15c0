"""``drivax study``: a whole experiment with its controls, from training to verdicts."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from drivax import settings
from drivax.studies.longtail import study
from drivax.studies.longtail_drives import LongtailConfig, Sets


@dataclass(frozen=True)
class Study:
    """Run an experiment and write its report.

    longtail: does training on critical moments more often make a safer driver? Scores, trains, drives and judges all
    arms and controls; OUT/report.html has the verdicts.

    A study that was stopped goes on where it was if it is called again. Settings can be given behind, as
    --total_steps 500000 or --arms [baseline,bc,heuristic,random_matched].

    Example: drivax study longtail --data sets/bench --seeds 5 --out studies/longtail
    """

    study: Annotated[Literal["longtail"], tyro.conf.Positional, tyro.conf.arg(metavar="STUDY")]
    """Which."""
    data: Path
    """Scenario set to train on, or a folder of drivax generate --benchmark."""
    out: Path
    """Folder of the study."""
    validation: Path | None = None
    """Scenario set that chooses checkpoints."""
    test: tuple[Path, ...] = ()
    """Scenario sets to drive in the end; where events are labelled, half of the scenarios taken have one."""
    seeds: int | None = None
    """Trainings of each arm; 5 unless the configuration says otherwise."""
    config: Path | None = None
    """YAML file with settings."""
    cores: int | None = None
    """Trainings side by side, one core each; all cores by default."""
    anyway: bool = False
    """Go on even if the baseline does not drive well enough for a comparison."""


def run(args: Study, overrides: Sequence[str] = ()) -> int:
    """Run the study; progress goes to standard error."""
    config = settings.load(LongtailConfig, args.config or {}, overrides)
    if args.seeds is not None:
        config = replace(config, seeds=args.seeds)
    results = study(
        config,
        Sets.of(args.data, args.validation, args.test),
        args.out,
        cores=args.cores,
        anyway=args.anyway,
        log=lambda line: print(line, file=sys.stderr),
    )
    for claim in results["claims"]:
        needed = f" ({claim['needed']})" if claim["needed"] else ""
        print(f"{claim['verdict']:<12} {claim['claim']['words']}{needed}")
    print(f"{args.out / 'report.html'}")
    return 0
