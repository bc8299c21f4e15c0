"""``drivax inspect``: contents, audit and integrity of scenario sets."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from drivax.cli import console
from drivax.escaping import show

if TYPE_CHECKING:
    from drivax.evaluation.observation_statistics import ObservationStatistics
    from drivax.report.inspection import Inspection

#: Number of scenarios for --observations, evenly spread over the selected ones.
_OBSERVED_SCENARIOS = 256


@dataclass(frozen=True)
class Inspect:
    """Summarise a scenario set: sources, sizes, tags, flags, audit, integrity.

    Compares several sets side by side.

    Example: drivax inspect sets/womd sets/nuplan --filter agents>=20 --html sets.html

    Example: drivax inspect sets/womd --observations --planner runs/ppo --draw observation.png
    """

    sets: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SET")]
    """Scenario sets (folders), one or more."""
    filter: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Only scenarios with this property (NAME=A|B, NAME!=A, NAME>=N); can be repeated."""
    json: bool = False
    """Print the counts of every scenario as JSON."""
    html: Path | None = None
    """Write a page with histograms to this file instead of printing tables."""
    no_check: bool = False
    """Skip the verification of checksums, which reads the whole set."""
    observations: bool = False
    """Describe the observations of a planner: distributions, correlation with collisions and actions."""
    planner: str | None = None
    """Planner of --observations: a name, the run folder of a training run or zoo:NAME; the log by default."""
    traffic: str | None = None
    """Traffic of --observations: log (the default), idm, zoo:NAME, ... as for drivax evaluate."""
    trust_code: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="MODULE")] = ()
    """Run code of this module of yours that a trained policy names; repeat it to trust several."""
    task: str | None = None
    """Training configuration (preset or file) of the observations; a trained policy has its own."""
    draw: Path | None = None
    """Also draw the observation of the first scenario at its current step into this PNG file."""
    overwrite: bool = False
    """Replace the file of --html or --draw."""


def run(args: Inspect) -> int:
    """Verify the sets, then print tables or JSON, write a page, or describe observations."""
    from drivax.errors import UsageError
    from drivax.report.inspection import Inspection
    from drivax.scenario.select.selection import Selection

    if not args.sets:
        raise UsageError("no scenario set given", cure="write drivax inspect SET")
    if args.json and args.html is not None:
        raise UsageError("--json and --html are mutually exclusive", cure="run drivax inspect twice")
    _check_flags(args)
    selection = Selection.parse(args.filter)
    inspections = [Inspection.open(path, selection, not args.no_check) for path in args.sets]
    if args.observations:
        _observe(args, inspections[0])
    elif args.json:
        sets = [{"scenarios": inspection.describe()} for inspection in inspections]
        named_sets = [{"set": str(path), **content} for path, content in zip(args.sets, sets, strict=True)]
        json.dump(sets[0] if len(sets) == 1 else named_sets, sys.stdout, indent=1)
        show()
    elif args.html is not None:
        from drivax.report.pages.inspection import write_histograms

        show(write_histograms(inspections, args.html, args.overwrite))
    else:
        _print(inspections)
    return 0


def _print(inspections: list[Inspection]) -> None:
    """Print one set in detail, or several side by side."""
    from drivax.report import inspection as tables

    terminal = console()
    if len(inspections) > 1:
        for table in tables.comparison(inspections):
            terminal.print(table.rich())
            terminal.print()
        return
    (inspection,) = inspections
    terminal.print(tables.overview(inspection).rich())
    terminal.print()
    audit = tables.audit_table(inspection)
    if audit is None:
        show("audit: not done")
    else:
        terminal.print(audit.rich())
    terminal.print()
    terminal.print(tables.scenarios_table(inspection).rich())
    if len(inspection) > tables.MAX_LISTED:
        show(f"{len(inspection) - tables.MAX_LISTED:,} more; --json lists all")


def _check_flags(args: Inspect) -> None:
    """Refuse mutually exclusive flags, and an existing picture."""
    from drivax.errors import UsageError
    from drivax.files import check_output

    if args.observations and (len(args.sets) > 1 or args.html is not None):
        raise UsageError(
            "--observations takes one set, and writes no page", cure="name one set, without --html"
        )
    for name in ("planner", "traffic", "trust_code", "task", "draw"):
        if getattr(args, name) and not args.observations:
            flag = f"--{name.replace('_', '-')}"
            raise UsageError(f"{flag} needs --observations", cure="add --observations")
    if args.task is not None and args.planner:
        from drivax.planners.catalogue import PLANNERS
        from drivax.tracking.run_folder import is_policy

        if is_policy(args.planner.partition("@")[0], PLANNERS):
            raise UsageError("a trained policy has its own task", cure="leave out --task")
    if args.draw is not None:
        check_output(args.draw, args.overwrite)


def _observe(args: Inspect, inspection: Inspection) -> None:
    """Evaluate the planner, print statistics of its observations, and draw one observation."""
    from drivax import settings
    from drivax.api import find_planner
    from drivax.evaluation.observation_statistics import observation_statistics
    from drivax.files import atomic_write
    from drivax.learning.config import TrainConfig
    from drivax.learning.policies import find_traffic
    from drivax.report.pictures.observation import draw_log_observation
    from drivax.scenario.bank.scenario_bank import ScenarioBank

    scenarios = list(inspection.sample(_OBSERVED_SCENARIOS))
    bank = ScenarioBank.from_scenarios(scenarios)
    requested_task = None if args.task is None else settings.load(TrainConfig, args.task).task
    planner, task = find_planner(args.planner or "expert", bank, task=requested_task, trust=args.trust_code)
    traffic = find_traffic(args.traffic or "log", args.trust_code)
    statistics = observation_statistics(planner, bank, task, permute=not planner.replays, traffic=traffic)
    if args.json:
        json.dump(statistics.as_dict(), sys.stdout, indent=1)
        show()
    else:
        _print_observations(statistics)
    if args.draw is not None:
        title = f"{scenarios[0].id}, step {int(scenarios[0].current_step)}"
        figure = draw_log_observation(task, bank, title, step=int(scenarios[0].current_step))
        with atomic_write(args.draw) as file:
            figure.savefig(file, format=args.draw.suffix[1:] or "png")
        show(args.draw, sys.stderr if args.json else sys.stdout)


def _print_observations(statistics: ObservationStatistics) -> None:
    from drivax.report import inspection as tables

    show(tables.observation_overview(statistics))
    show()
    console().print(tables.observation_table(statistics).rich())
