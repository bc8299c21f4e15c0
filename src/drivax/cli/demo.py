"""``drivax demo``: the whole pipeline on the built-in world."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from drivax.cli import record_of
from drivax.escaping import show
from drivax.studies.demo import DemoConfig, run_demo


@dataclass(frozen=True)
class Demo(DemoConfig):
    """Generate scenarios, train a policy, evaluate it and four reference planners, and write the report.

    Takes a few minutes on two CPU cores; needs no data.

    Example: drivax demo --out demo
    """

    overrides: tyro.conf.Suppress[tyro.conf.Fixed[tuple[str, ...]]] = ()
    out: Path = Path("demo")
    """Folder for scenario sets, runs and the report."""
    steps: int | None = None
    """Environment steps to train; those of the preset by default."""
    overwrite: bool = False
    """Replace the output of an earlier demo in OUT."""


def run(args: Demo) -> int:
    """Run the demo and print its table."""
    start_s = time.monotonic()
    overrides = () if args.steps is None else ("--total_steps", str(args.steps))
    config = record_of(DemoConfig, args, overrides=overrides)
    result = run_demo(args.out, config, show, overwrite=args.overwrite)
    show(result.text())
    show(f"report: {result.report.resolve()}  ({time.monotonic() - start_s:.0f} s in total)")
    return 0
