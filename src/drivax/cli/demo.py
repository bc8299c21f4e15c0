"""``drivax demo``: the whole job on the built-in world."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from drivax.studies.demo import DemoConfig, run_demo


@dataclass(frozen=True)
class Demo:
    """Generate scenarios, train a policy on them, drive held-out ones with four planners, write the report.

    Takes a few minutes on two CPU cores; needs no data.

    Example: drivax demo --out demo
    """

    out: Path = Path("demo")
    """Folder for scenario sets, runs and the report."""
    steps: int | None = None
    """Environment steps to train; the preset's number by default."""
    training: int = 256
    """Scenarios to train on."""
    held_out: int = 128
    """Scenarios to judge on."""
    workers: int | None = None
    """Processes that generate; as many as there are CPU cores by default."""
    overwrite: bool = False
    """Replace what a former demo left in OUT."""


def run(args: Demo) -> int:
    """Run the demo and print its table."""
    began = time.monotonic()
    overrides = () if args.steps is None else ("--total_steps", str(args.steps))
    config = DemoConfig(args.training, args.held_out, overrides=overrides, workers=args.workers)
    result = run_demo(args.out, config, lambda line: print(line, flush=True), overwrite=args.overwrite)
    print(result.text())
    print(f"report: {result.report.resolve()}  ({time.monotonic() - began:.0f} s in all)")
    return 0
