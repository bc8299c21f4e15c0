"""``drivax compare``: is one planner better than another?"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro


@dataclass(frozen=True)
class Compare:
    """Compare two evaluations: intervals, effect sizes, tests, power, and a recommendation.

    A and B are run folders of `drivax evaluate` on the same scenarios, or folders with one such run for each seed of a
    policy. What counts and how it is decided is a plan, best written before the runs (--save) and given with --config;
    its other settings (smallest_difference, confidence, power, ...) are in docs/guide/compare.md.

    Example: drivax compare --primary success --minimum-scenarios 500 --save plan.yaml

    Example: drivax compare runs/policy runs/idm --config plan.yaml --html comparison.html
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="A B")] = ()
    """Two run folders; left out where the plan names them."""
    config: Path | None = None
    """The plan (YAML); the default plan without."""
    split: Literal["paired", "random", "stratified"] | None = None
    """Compare on every common scenario (paired), or give each planner scenarios of its own."""
    primary: str | None = None
    """The metric that decides."""
    secondary: tuple[str, ...] | None = None
    """Further metrics to report."""
    minimum_scenarios: int | None = None
    """Fewer scenarios give no verdict."""
    data: Path | None = None
    """Scenario set that was driven, where it has moved since (for a stratified split)."""
    save: Path | None = None
    """Write the plan to this file and stop."""
    json: bool = False
    """Print everything as JSON, for programs."""
    html: Path | None = None
    """Also write a page to this file."""
    overwrite: bool = False
    """Replace the file of --save or --html."""


def run(args: Compare) -> int:
    """Carry the plan out, or write it down."""
    from drivax import settings
    from drivax.errors import UsageError
    from drivax.evaluation.comparison import compare
    from drivax.evaluation.episode_table import EpisodeTable
    from drivax.evaluation.plan import ComparisonPlan
    from drivax.files import check_output, write_text
    from drivax.report.pages.comparison import comparison_text, write_comparison

    if len(args.runs) not in (0, 2):
        raise UsageError(f"{len(args.runs)} runs are named", cure="write drivax compare A B")
    plan = ComparisonPlan() if args.config is None else settings.load(ComparisonPlan, args.config)
    given = _given(args)
    if "primary" in given and "secondary" not in given:
        given["secondary"] = tuple(name for name in plan.secondary if name != given["primary"])
    plan = replace(plan, **given)
    for out in (args.save, args.html):
        if out is not None:
            check_output(out, args.overwrite)
    if args.save is not None:
        args.save.parent.mkdir(parents=True, exist_ok=True)
        write_text(args.save, settings.dump(plan))
        print(f"wrote {args.save}")
        return 0
    if plan.a is None or plan.b is None:
        raise UsageError("no runs are named", cure="write drivax compare A B, or name a and b in the plan")
    a, b = EpisodeTable.read_seeds(plan.a), EpisodeTable.read_seeds(plan.b)
    entries = a[0].open_set(args.data).entries if plan.split == "stratified" else ()
    comparison = compare(plan, a, b, entries)
    print(
        json.dumps(comparison.as_dict(), indent=1, allow_nan=False)
        if args.json
        else comparison_text(comparison)
    )
    if args.html is not None:
        write_comparison(comparison, args.html, args.overwrite)
        if not args.json:
            print(f"wrote {args.html}")
    return 0


def _given(args: Compare) -> dict[str, Any]:
    """What the command line says of the plan."""
    names = ("split", "primary", "secondary", "minimum_scenarios")
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    return given | (dict(zip(("a", "b"), args.runs, strict=True)) if args.runs else {})
