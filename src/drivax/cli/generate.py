"""``drivax generate``: scenarios of the built-in world -> scenario set, or the fixed benchmark splits."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from drivax.cli import record_of
from drivax.errors import UsageError
from drivax.escaping import show
from drivax.scenario.schema import CAPACITIES, Scenario
from drivax.settings import load
from drivax.synthetic.domains import DOMAINS
from drivax.synthetic.generate import (
    BENCHMARK_VERSION,
    FamilyCount,
    GeneratedSet,
    Generation,
    generate,
    generate_benchmark,
)
from drivax.synthetic.world import WORLD_VERSION, WorldConfig
from drivax.tracking.progress import Progress

_SCENARIOS = 256


@dataclass(frozen=True, kw_only=True)
class Generate(Generation):  # noqa: D101
    __doc__ = f"""Generate scenarios of the built-in traffic world; no data set is needed.

    Many kinds of roads, other road users that follow, yield and stop, labelled rare events, and an expert log without
    collisions that stays on the road. The same seed gives the same set, byte for byte.

    Settings of the world follow as --domain {"|".join(DOMAINS)} (wide lanes, lights and higher speeds, or narrow
    streets, dense traffic and roundabouts), --rare_rate 0.05 (share of scenarios with a labelled rare event),
    --critical_share, --lane_change_share, --scenarios_per_map and --noise.KEY, --sensor.KEY (docs/guide/world.md has
    all).

    Example: drivax generate sets/world --scenarios 256 --seed 0

    Example: drivax generate sets/ring --domain ring --rare_rate 0.2
    """

    out: tyro.conf.Positional[Path]
    """Scenario set to write (a folder); with --benchmark the folder of the four sets."""
    scenarios: int | None = None
    """Number of scenarios, 256 by default; with --benchmark those of train, 4,096 by default, others in proportion."""
    seed: int | None = None
    """Seed of the set, 0 by default; scenario i of a seed does not depend on the number of scenarios."""
    config: Path | None = None
    """YAML file with settings of the world."""
    benchmark: bool = False
    """Write the fixed, versioned splits OUT/train, validation, test and test-rare."""
    workers: int = os.cpu_count() or 1
    """Processes; as many as there are CPU cores by default."""
    capacity: Annotated[str, tyro.conf.arg(metavar="|".join(CAPACITIES))] = "default"
    world: tyro.conf.Suppress[tyro.conf.Fixed[WorldConfig]] = field(default_factory=WorldConfig)


def run(args: Generate, overrides: Sequence[str] = ()) -> int:
    """Generate, then print the rate, the rejections of each family, and the number of each event."""
    world = load(WorldConfig, args.config or {}, overrides)
    if args.benchmark and (args.seed is not None or args.split is not None):
        raise UsageError("the benchmark has seeds and splits of its own", cure="leave out --seed and --split")
    if args.benchmark and world != WorldConfig(domain=world.domain):
        raise UsageError("the benchmark has a fixed world", cure="leave out all of its settings but --domain")
    options = record_of(Generation, args, world=world)
    scenarios = _SCENARIOS if args.scenarios is None else args.scenarios
    with Progress("generating", "scenarios") as bar:

        def report(done: int, total: int) -> None:
            bar.update(done, total=total)

        if args.benchmark:
            sets = generate_benchmark(args.out, options, args.scenarios, report, _audit)
        else:
            sets = {"": generate(args.out, scenarios, args.seed or 0, options, report, _audit)}
    if args.benchmark:
        show(f"benchmark {BENCHMARK_VERSION} of world {WORLD_VERSION}, domain {options.world.domain}")
    show("\n".join(map(summary, sets.values())))
    return 0


def _audit(scenarios: list[Scenario]) -> list[dict[str, Any]]:
    """Audit scenarios; the thread of the audit imports JAX while workers generate."""
    from drivax.evaluation.audit import audit

    return audit(scenarios)


def summary(result: GeneratedSet) -> str:
    """Return one line about the set, one per family of roads, and a table of families and events, if there are any."""
    rate = result.scenarios / max(result.seconds, 1e-9)
    lines = [f"{result.path}: {result.scenarios:,} scenarios in {result.seconds:.1f} s ({rate:.1f}/s)"]
    width = max(map(len, result.families))
    for name, family in result.families.items():
        causes = ", ".join(f"{cause} {times}" for cause, times in sorted(family.rejected.items()))
        line = f"  {name:<{width}}  {family.kept:>6,} kept, {family.rejection_rate:6.2%} of draws rejected"
        line += f" ({causes})" if causes else ""
        lines.append(line + (f"; {family.unsuited:,} draws without the event" if family.unsuited else ""))
    return "\n".join((*lines, *coverage(result.families)))


def coverage(families: Mapping[str, FamilyCount]) -> list[str]:
    """Return the lines of a table of events (rows) and the families in which they happened."""
    totals: Counter[str] = Counter()
    for family in families.values():
        totals.update(family.events)
    if not totals:
        return []
    width = max(map(len, totals))
    lines = [f"  {sum(totals.values()):,} scenarios with an event:"]
    for event in sorted(totals):
        counts_text = ", ".join(
            f"{name} {family.events[event]}" for name, family in families.items() if event in family.events
        )
        lines.append(f"    {event:<{width}}  {totals[event]:>6,} ({counts_text})")
    return lines
