"""``drivax bench``: simulation speed on this machine, by part."""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

from drivax.scenario.bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.studies.bench import BenchConfig, bench
from drivax.synthetic.generate import Generation, generate
from drivax.tracking.progress import Progress


@dataclass(frozen=True)
class Bench:
    """Time environment steps with observation, reward, all metrics and resets, and each part alone.

    Without --data, scenarios of the built-in world are generated for it.

    Example: drivax bench --batch 512 --json
    """

    data: Path | None = None
    """Scenario set to step through."""
    scenarios: int = 1024
    """How many scenarios to generate without --data."""
    batch: int = 256
    """Environments side by side."""
    repeats: int = 7
    """Timed runs; the median counts."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(args: Bench) -> int:
    """Time and print."""
    if args.data is not None:
        bank = ScenarioBank.from_scenarios(ScenarioSet.open(args.data))
    else:
        with (
            tempfile.TemporaryDirectory() as folder,
            Progress("generating", "scenarios", args.scenarios) as bar,
        ):
            made = generate(
                Path(folder) / "set", args.scenarios, 0, Generation(workers=os.cpu_count() or 1),
                lambda done, total: bar.update(done),
            )  # fmt: skip
            bank = ScenarioBank.from_scenarios(ScenarioSet.open(made.path))
    result = bench(bank, BenchConfig(batch=args.batch, repeats=args.repeats))
    print(json.dumps(result, indent=1) if args.json else _text(result))
    return 0


def _text(result: dict[str, object]) -> str:
    parts = result["by_part"]
    assert isinstance(parts, dict)
    lines = [
        f"{result['environment_steps_per_second']:,} environment steps/s (batch {result['batch']}, "
        f"{result['scenarios']:,} scenarios, with resets, observation, reward and all metrics)",
        f"state {result['state_bytes']:,} B, scenario {result['bank_bytes_per_scenario']:,} B, "
        f"compiled in {result['compile_seconds']} s",
        f"map queries {result['brute_force_ratio']}x faster than brute force over the same segments",
        "microseconds per environment and step, each part alone:",
        *(f"  {name:<12} {value:8.2f}" for name, value in parts.items()),
    ]
    return "\n".join(lines)
