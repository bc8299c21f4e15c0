"""``drivax inspect``: what scenario sets hold, and whether they are sound."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from drivax.show.inspection import Inspection

_COLUMNS = 100


@dataclass(frozen=True)
class Inspect:
    """Show what a scenario set holds: source counts, sizes, tags, flags, audit, integrity.

    Of several sets, one table that compares them.

    Example: drivax inspect sets/womd sets/nuplan --filter agents>=20 --html sets.html
    """

    sets: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SET")]
    """Scenario sets (folders), one or more."""
    filter: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Only scenarios for which this holds (NAME=A|B, NAME!=A, NAME>=N); may be given several times."""
    json: bool = False
    """Print the counts of every scenario as JSON, for programs."""
    html: Path | None = None
    """Write a page with histograms to this file instead of printing tables."""
    no_check: bool = False
    """Leave the checksums untested (testing them reads the whole set)."""
    overwrite: bool = False
    """Replace the file of --html."""


def run(args: Inspect) -> int:
    """Test the sets, then print them as tables or as JSON, or write a page."""
    from drivax.errors import UsageError
    from drivax.scenario.selection import Selection
    from drivax.show.inspection import Inspection, described

    if not args.sets:
        raise UsageError("no scenario set is named", cure="write drivax inspect SET")
    if args.json and args.html is not None:
        raise UsageError("--json and --html exclude each other", cure="call drivax inspect twice")
    selection = Selection.parse(args.filter)
    opened = [Inspection.open(path, selection, not args.no_check) for path in args.sets]
    if args.json:
        found = [{"scenarios": [described(entry) for entry in one.entries]} for one in opened]
        named = [{"set": str(path), **one} for path, one in zip(args.sets, found, strict=True)]
        json.dump(found[0] if len(found) == 1 else named, sys.stdout, indent=1)
        print()
    elif args.html is not None:
        from drivax.show.histograms import write_histograms

        print(write_histograms(opened, args.html, args.overwrite))
    else:
        _print(opened)
    return 0


def _print(opened: list[Inspection]) -> None:
    """One set in full, or several side by side."""
    from rich.console import Console

    from drivax.show import inspection_tables as tables

    width = min(_COLUMNS, Console().width) if sys.stdout.isatty() else _COLUMNS
    console = Console(width=width, highlight=False, markup=False)
    if len(opened) > 1:
        for table in tables.comparison(opened):
            console.print(table)
            console.print()
        return
    (one,) = opened
    console.print(tables.overview(one))
    console.print()
    console.print(tables.audit_table(one) or "audit: not done")
    console.print()
    console.print(tables.listing(one))
    if len(one) > tables.LISTED:
        console.print(f"{len(one) - tables.LISTED:,} more; --json lists all")
