"""``drivax inspect``: what a scenario set holds, and whether it is sound."""

from __future__ import annotations

import json
import sys
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from drivax.scenario.store import ScenarioSet

_COLUMNS = 100
_ROWS = 30
_SOURCE = ("steps", "tracks", "tracks_valid_now", "map_features", "map_points", "lights")


@dataclass(frozen=True)
class Inspect:
    """Show what a scenario set holds: source counts, sizes, flags, audit, integrity.

    Example: drivax inspect sets/womd --json
    """

    set: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SET")]
    """The scenario set (a folder)."""
    json: bool = False
    """Print the counts of every scenario as JSON, for programs."""
    no_check: bool = False
    """Leave the checksums untested (testing them reads the whole set)."""


def run(args: Inspect) -> int:
    """Test the set, then print it as tables or as JSON."""
    scenarios = ScenarioSet.open(args.set)
    if not args.no_check:
        scenarios.check()
    if args.json:
        json.dump({"scenarios": [described(entry) for entry in scenarios.entries]}, sys.stdout, indent=1)
        print()
        return 0
    console = Console(
        width=min(_COLUMNS, Console().width) if sys.stdout.isatty() else _COLUMNS, highlight=False
    )
    console.print(_overview(scenarios, not args.no_check))
    console.print()
    console.print(_listing(scenarios))
    if len(scenarios) > _ROWS:
        console.print(f"{len(scenarios) - _ROWS:,} more; --json lists all")
    return 0


def described(entry: Mapping[str, Any]) -> dict[str, Any]:
    """One scenario as ``inspect --json`` prints it: a stable contract."""
    names = ("scenario_id", "dataset", "segment")
    return {
        **{name: entry[name] for name in names},
        **{name: entry["source"][name] for name in _SOURCE},
        **{name: entry[name] for name in ("segments", "overflow", "flags", "audit")},
    }


def _overview(scenarios: ScenarioSet, checked: bool) -> Table:
    entries, manifest = scenarios.entries, scenarios.manifest
    size = sum(path.stat().st_size for path in scenarios.path.iterdir() if path.is_file())
    capacity, count = scenarios.capacity, len(entries)
    overflow: Counter[str] = Counter()
    for entry in entries:
        overflow.update(entry["overflow"])
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    segments = len({(entry["dataset"], entry["segment"]) for entry in entries})
    table.add_row("set", str(scenarios.path))
    table.add_row(
        "scenarios", f"{count:,} (recorded segments: {segments:,}, shards: {len(manifest['shards']):,})"
    )
    table.add_row("data sets", _counted(Counter(entry["dataset"] for entry in entries), count))
    table.add_row("size", f"{size / 1e6:,.1f} MB, {manifest['record_bytes'] / 1e3:,.0f} kB per scenario")
    table.add_row(
        "capacity",
        f"{capacity.name}: {capacity.agents} moving and {capacity.parked} parked agents, "
        f"{capacity.segments:,} map segments, {capacity.lanes} lanes, {capacity.lights} lights",
    )
    table.add_row("written by", f"drivax {manifest['drivax_version']}, schema {manifest['schema_version']}")
    table.add_row("flags", _counted(Counter(flag for entry in entries for flag in entry["flags"]), count))
    left_out = ", ".join(f"{name} {number:,}" for name, number in sorted(overflow.items()))
    table.add_row("did not fit", left_out or "nothing")
    table.add_row("audit", _audited(entries))
    table.add_row("integrity", "every checksum is right" if checked else "not tested (--no-check)")
    return table


def _counted(counts: Counter[str], of: int) -> str:
    parts = [
        name if number == of else f"{name} ({number:,} of {of:,})" for name, number in sorted(counts.items())
    ]
    return ", ".join(parts) or "none"


def _audited(entries: list[dict[str, Any]]) -> str:
    """Sums of what the log replay found, booleans as counts; NaN is stored as null and left out."""
    sums: defaultdict[str, float] = defaultdict(float)
    known: Counter[str] = Counter()
    for entry in entries:
        for name, value in entry["audit"].items():
            if isinstance(value, int | float):
                sums[name] += value
                known[name] += 1
    parts = [f"{name} {sums[name]:,.4g} in {known[name]:,}" for name in sorted(known)]
    return ", ".join(parts) or "not done"


def _listing(scenarios: ScenarioSet) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    table.add_column("scenario", no_wrap=True, max_width=24)
    for name in (
        "steps",
        "tracks",
        "valid now",
        "lanes",
        "lines",
        "edges",
        "others",
        "points",
        "lights",
        "segments",
    ):
        table.add_column(name, justify="right")
    for entry in scenarios.entries[:_ROWS]:
        source, kinds = entry["source"], entry["source"]["map_features"]
        others = sum(kinds.values()) - sum(kinds.get(name, 0) for name in ("lane", "road_line", "road_edge"))
        numbers = (
            source["steps"],
            source["tracks"],
            source["tracks_valid_now"],
            kinds.get("lane", 0),
            kinds.get("road_line", 0),
            kinds.get("road_edge", 0),
            others,
            source["map_points"],
            source["lights"],
            entry["segments"],
        )
        table.add_row(entry["scenario_id"], *(f"{number:,}" for number in numbers))
    return table
