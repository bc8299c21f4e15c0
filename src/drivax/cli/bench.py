"""``drivax bench``: speed on this machine, of the simulator by part or of encoders."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from drivax import settings
from drivax.cli import record_of
from drivax.errors import UsageError
from drivax.escaping import show
from drivax.learning.program import use_all_cores
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.studies.bench import BenchConfig, EncoderBench, bench, bench_encoders, bench_metrics
from drivax.synthetic.generate import Generation, generate
from drivax.tasks.task import Task
from drivax.tracking.progress import Progress


@dataclass(frozen=True)
class Bench(BenchConfig):
    """Time environment steps with observation, reward, metrics and resets, and each part alone, driven by IDM.

    Generates scenarios of the built-in world unless --data is given. Change settings of the task with flags such as
    --task.metrics training.

    With --encoders, time encoders on the observation `optimal` instead. Change their settings with flags such as
    --only "[lq small]" --batches "[1, 512]".

    Example: drivax bench --batch 512 --json
    """

    data: Path | None = None
    """Scenario set to simulate."""
    scenarios: int = 1024
    """Number of scenarios to generate without --data."""
    trust_code: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="MODULE")] = ()
    task: tyro.conf.Suppress[tyro.conf.Fixed[Task]] = field(default_factory=Task)
    metrics: bool = False
    """Compare the metric sets none, training and full at batch 32, 128 and the fastest, instead of timing parts."""
    encoders: bool = False
    """Time the encoders and count their parameters, instead of the simulator."""
    json: bool = False
    """Print one JSON object instead of text."""


#: Flags without a meaning for encoders.
_SIMULATOR_FLAGS = ("data", "scenarios", "batch", "steps", "traffic", "trust_code", "metrics")


def run(args: Bench, overrides: Sequence[str] = ()) -> int:
    """Run the benchmark and print its results."""
    if args.encoders:
        ignored = [name for name in _SIMULATOR_FLAGS if getattr(args, name) != getattr(Bench, name)]
        if ignored:
            flags = " ".join(f"--{name.replace('_', '-')}" for name in ignored)
            raise UsageError("--encoders uses no flags of the simulator", cure=f"leave out {flags}")
        times = bench_encoders(settings.load(EncoderBench, {"repeats": args.repeats}, overrides))
        show(json.dumps(times, indent=1) if args.json else _encoders_text(times))
        return 0
    config = settings.load(BenchConfig, settings.plain(record_of(BenchConfig, args)), overrides)
    use_all_cores()
    if args.data is None:
        bank = _generate_bank(args.scenarios)
    else:
        bank = ScenarioBank.from_scenarios(ScenarioSet.open(args.data))
    if args.metrics:
        result, format_text = bench_metrics(bank, config), _metric_sets_text
    else:
        result, format_text = bench(bank, config), _parts_text
    show(json.dumps(result, indent=1) if args.json else format_text(result))
    return 0


def _generate_bank(scenarios: int) -> ScenarioBank:
    with tempfile.TemporaryDirectory() as folder, Progress("generating", "scenarios", scenarios) as bar:
        options = Generation(workers=os.cpu_count() or 1)
        out = Path(folder) / "set"
        generate(out, scenarios, 0, options, lambda done, total: bar.update(done))
        return ScenarioBank.from_scenarios(ScenarioSet.open(out))


def _parts_text(result: dict[str, Any]) -> str:
    lines = [
        f"{result['environment_steps_per_second']:,} environment steps/s (batch {result['batch']}, "
        f"{result['devices']} device(s), {result['scenarios']:,} scenarios, "
        f"{result['traffic']} traffic, with resets, observation, reward, metrics)",
        f"state {result['state_bytes']:,} B, scenario {result['bank_bytes_per_scenario']:,} B, "
        f"compiled in {result['compile_seconds']} s; native kernels: {result['kernels']}",
        f"map queries {result['brute_force_ratio']}x faster than brute force over the same segments",
        "per environment and step, each part alone:    us  operations     bytes",
    ]
    for name, value in result["by_part"].items():
        cost = result["cost_by_part"][name]
        lines.append(f"  {name:<39} {value:8.2f} {cost['operations']:11,.0f} {cost['bytes']:9,.0f}")
    return "\n".join(lines)


def _metric_sets_text(result: dict[str, Any]) -> str:
    lines = [
        f"environment steps/s by metric set ({result['scenarios']:,} scenarios); x is relative to full at batch 32",
        "  metrics     batch   steps/s      x",
    ]
    for row in result["rows"]:
        batch = str(row["batch"]) + (" (best)" if row["best"] else "")
        lines.append(f"  {row['metrics']:<9} {batch:>12} {row['steps_per_second']:9,} {row['relative']:6.2f}")
    return "\n".join(lines)


def _encoders_text(result: dict[str, Any]) -> str:
    headings = [*(f"batch {batch}" for batch in result["rows"][0]["forward_us"]), "backward"]
    headings_text = "".join(f" {heading:>10}" for heading in headings)
    lines = [
        f"encoders of an observation on {result['device']}; us per observation: forward, and forward and backward",
        f"  {'encoder':<30} {'computes in':<11} {'parameters':>10} {'width':>5}{headings_text}",
    ]
    for row in result["rows"]:
        times = "".join(f" {time_us:10.1f}" for time_us in (*row["forward_us"].values(), row["gradient_us"]))
        lines.append(
            f"  {row['encoder']:<30} {row['dtype']:<11} {row['parameters']:>10,} {row['width']:>5}{times}"
        )
    return "\n".join(lines)
