"""``drivax compare``: compare two planners by their evaluations."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from drivax.escaping import show


@dataclass(frozen=True)
class Compare:
    """Compare two evaluations: intervals, effect sizes, tests, power, and a recommendation.

    A and B are run folders of `drivax evaluate` on the same scenarios, or folders with one such run per seed of a
    policy. The plan defines metrics and decision rule: write it before the runs (--save) and pass it as --config.
    Change its settings with --primary METRIC, --secondary "[METRIC, ...]", --split paired|random|stratified,
    --minimum_scenarios N, --smallest_difference X, --confidence 0.95, --power 0.8 (all: docs/guide/compare.md).

    Example: drivax compare --primary success --minimum_scenarios 500 --save plan.yaml

    Example: drivax compare runs/policy runs/idm --config plan.yaml --html comparison.html
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="A B")] = ()
    """Two run folders; not needed if the plan names them."""
    config: Path | None = None
    """Plan (YAML) to use instead of the default plan."""
    data: Path | None = None
    """Scenario set of the runs, if it has moved since (for a stratified split)."""
    save: Path | None = None
    """Write the plan to this file and stop."""
    json: bool = False
    """Print everything as JSON."""
    html: Path | None = None
    """Also write a page to this file."""
    overwrite: bool = False
    """Replace the file of --save or --html."""


def run(args: Compare, overrides: Sequence[str] = ()) -> int:
    """Compare the runs by the plan, or write the plan."""
    from drivax import settings
    from drivax.errors import UsageError
    from drivax.evaluation.comparison import ComparisonPlan, compare
    from drivax.evaluation.episode_table import EpisodeTable
    from drivax.files import check_output, write_text
    from drivax.report.pages.comparison import comparison_text, write_comparison

    if len(args.runs) not in (0, 2):
        raise UsageError(f"{len(args.runs)} runs are named", cure="write drivax compare A B")
    plan = settings.load(ComparisonPlan, args.config or {}, overrides)
    if args.runs:
        plan = replace(plan, a=args.runs[0], b=args.runs[1])
    for out in (args.save, args.html):
        if out is not None:
            check_output(out, args.overwrite)
    if args.save is not None:
        write_text(args.save, settings.dump(plan))
        show(f"wrote {args.save}")
        return 0
    if plan.a is None or plan.b is None:
        raise UsageError("no runs are named", cure="write drivax compare A B, or name a and b in the plan")
    a, b = EpisodeTable.read_seeds(plan.a), EpisodeTable.read_seeds(plan.b)
    entries = a[0].open_set(args.data).entries if plan.split == "stratified" else ()
    comparison = compare(plan, a, b, entries)
    if args.json:
        show(json.dumps(comparison.as_dict(), indent=1, allow_nan=False))
    else:
        show(comparison_text(comparison))
    if args.html is not None:
        write_comparison(comparison, args.html, args.overwrite)
        if not args.json:
            show(f"wrote {args.html}")
    return 0
