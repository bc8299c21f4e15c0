"""``drivax generate``: scenarios of the built-in world -> scenario set."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from drivax.evaluation.audit import audit
from drivax.scenario.splits import parse_shares, write_splits
from drivax.scenario.store import ScenarioSet
from drivax.synthetic.generate import GeneratedSet, Generation, generate
from drivax.tracking.progress import Progress


@dataclass(frozen=True)
class Generate:
    """Generate scenarios of the built-in traffic world; no data set is needed.

    Winding roads and junctions with lights, other vehicles that follow, yield and stop, and an expert log that
    neither collides nor leaves the road. The same seed gives the same set, byte for byte.

    Example: drivax generate sets/world --scenarios 256 --seed 0
    """

    out: tyro.conf.Positional[Path]
    """Scenario set to write (a folder)."""
    scenarios: int = 256
    """How many scenarios."""
    seed: int = 0
    """Seed of the set; scenario i of a seed is the same whatever the number of scenarios."""
    workers: int | None = None
    """Processes; as many as there are CPU cores by default."""
    capacity: Literal["default", "large"] = "default"
    """Padded sizes; sets that are used together need the same."""
    split: str | None = None
    """Write lists for train/validation/test to OUT/splits, by recording: percentages, as 80/10/10."""
    overwrite: bool = False
    """Replace OUT if it is a scenario set."""


def run(args: Generate) -> int:
    """Generate, then print the rate and what was rejected per family."""
    shares = None if args.split is None else parse_shares(args.split)
    options = Generation(
        workers=args.workers if args.workers is not None else os.cpu_count() or 1,
        capacity=args.capacity,
        overwrite=args.overwrite,
    )
    with Progress("generating", "scenarios") as bar:
        result = generate(
            args.out,
            args.scenarios,
            args.seed,
            options,
            lambda done, total: bar.update(done, total=total),
            audit,
        )
    if shares is not None:
        write_splits(args.out, ScenarioSet.open(args.out).entries, shares)
    print(summary(result))
    return 0


def summary(result: GeneratedSet) -> str:
    """One line about the set, and one per family of roads."""
    rate = result.scenarios / max(result.seconds, 1e-9)
    lines = [f"{result.path}: {result.scenarios:,} scenarios in {result.seconds:.1f} s ({rate:.1f}/s)"]
    width = max(map(len, result.families))
    for name, count in result.families.items():
        causes = ", ".join(f"{cause} {times}" for cause, times in sorted(count.rejected.items()))
        line = f"  {name:<{width}}  {count.kept:>6,} kept, {count.rejection_rate:6.2%} of draws rejected"
        lines.append(line + (f" ({causes})" if causes else ""))
    return "\n".join(lines)
