"""Measure this package on an accelerator: simulation, training, evaluation, memory, and a long PPO run.

The measurements of each stage run until its share of the time is spent; others are listed as not run. The result is
written after each measurement, so that a stopped run keeps its results.

python -m experiments.gpu --out gpu.json [--minutes 9]

Scenarios are generated. On a machine without a GPU, choose smaller sizes with --batches and --environments.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import jax

from drivax import api, settings
from drivax.evaluation.audit import audit
from drivax.evaluation.episode_table import EpisodeTable
from drivax.evaluation.runner import evaluate
from drivax.files import write_json
from drivax.learning.config import TrainConfig
from drivax.learning.loop import train
from drivax.learning.program import Program, Seeds
from drivax.planners.catalogue import make_planner
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.simulator.traffic.log import LogTraffic
from drivax.studies import bench
from drivax.synthetic.generate import Generation, generate
from drivax.tracking.run_folder import versions
from experiments.speed.machine import machine_ms
from experiments.speed.simulator import TASKS

#: Share of the time after which the measurements of a stage stop; the long training gets the rest.
SHARES = {"simulation": 0.35, "training": 0.6, "evaluation": 0.7, "long training": 1.0}
BATCHES = (1024, 4096, 16384, 65536)
_NO_WARM_UP = ("--algorithm.warm_up", "512")
#: Preset and changes of each timed training.
TRAININGS = {
    "ppo, mlp": ("ppo",),
    "ppo, lq small, float32": (
        "ppo", "--algorithm.network.encoder.kind", "lq", "--algorithm.network.encoder.size", "small",
    ),
    "ppo, lq small, bfloat16": (
        "ppo", "--algorithm.network.encoder.kind", "lq", "--algorithm.network.encoder.size", "small",
        "--algorithm.network.encoder.dtype", "bfloat16",
    ),
    "sac, mlp": ("sac", *_NO_WARM_UP),
    "sac, lq small, float32": (
        "sac", *_NO_WARM_UP, "--algorithm.network.encoder.kind", "lq", "--algorithm.network.encoder.size", "small",
    ),
}  # fmt: skip
PLANNERS = ("constant_velocity", "idm", "pdm")
#: Seconds for compilation and the evaluation after the long training.
_MARGIN_S = 45.0


@dataclass
class Recorder:
    """Results by stage, written to a file after each measurement; a stage stops when its time is spent."""

    out: Path
    seconds: float
    start_s: float = field(default_factory=time.monotonic)
    results: dict[str, Any] = field(default_factory=dict)

    def remaining_s(self, stage: str) -> float:
        """Seconds until the stage has to end."""
        return self.start_s + SHARES[stage] * self.seconds - time.monotonic()

    def measure(self, stage: str, name: str, measurement: Callable[[], Any]) -> None:
        """Run one measurement and store its result, ``not run`` or the error."""
        if self.remaining_s(stage) <= 0:
            result: Any = "not run"
        else:
            try:
                result = measurement()
            except (jax.errors.JaxRuntimeError, MemoryError) as error:
                result = f"failed: {' '.join(str(error).split())[:200]}"
        self.results.setdefault(stage, {})[name] = result
        write_json(self.out, self.results)
        print(f"{time.monotonic() - self.start_s:4.0f} s  {stage}: {name}: {json.dumps(result)}", flush=True)


def simulation(bank: ScenarioBank, task: str, traffic: str, batch: int) -> dict[str, Any]:
    """Return environment steps per second of ``drivax bench``, and memory per environment."""
    config = bench.BenchConfig(batch, steps=20, task=TASKS[task], traffic=traffic)
    program = bench.compile_program(bank, config)
    return {
        "steps_per_second": round(bench.steps_per_second([program], 3)[0]),
        "compile_seconds": round(program.compile_seconds, 1),
        "state_bytes": program.state_bytes,
        "temporary_bytes": program.temporary_bytes,
    }


def training(bank: ScenarioBank, preset: Sequence[str], environments: int | None) -> dict[str, Any]:
    """Return environment steps per second of training iterations, and the device's peak memory."""
    more = () if environments is None else ("--algorithm.environments", str(environments))
    config = settings.load(TrainConfig, preset[0], [*preset[1:], *more])
    learner = config.algorithm.build(config.environment(LogTraffic()), bank, config.iterations)
    begin, seconds = time.perf_counter(), []
    program = Program(Seeds(learner, (0,)), bank, config.devices)
    state = program.initial_state()
    for _ in range(4):
        state, logs, *_ = program.step(state)
        jax.block_until_ready((state, logs))
        seconds.append(time.perf_counter() - begin)
        begin = time.perf_counter()
    return {
        "steps_per_second": round(config.algorithm.steps_per_iteration / statistics.median(seconds[1:])),
        "compile_seconds": round(seconds[0], 1),
        "peak_bytes": peak_bytes(),
    }


def evaluation(scenarios: ScenarioSet, planner: str, traffic: str) -> dict[str, Any]:
    """Return seconds per 1,000 scenarios, with compilation and again, and the success."""
    driver = make_planner(planner, None)

    def run() -> tuple[float, EpisodeTable]:
        begin = time.perf_counter()
        table = evaluate(driver, scenarios, traffic=api.as_traffic(traffic))
        return round((time.perf_counter() - begin) * 1000 / len(scenarios), 1), table

    (first, table), (again, _) = run(), run()
    success = round(float(table.metrics["success"].mean()), 4)
    return {"first_s": first, "again_s": again, "success": success}


def long_training(
    scenarios: ScenarioSet, held_out: ScenarioSet, out: Path, environments: int, steps: int
) -> dict[str, Any]:
    """Train PPO, and evaluate it on held-out scenarios in log traffic."""
    overrides = ["--total_steps", str(steps), "--algorithm.environments", str(environments)]
    begin = time.perf_counter()
    run = train(settings.load(TrainConfig, "ppo", overrides), scenarios, out, validation=None)
    seconds = time.perf_counter() - begin
    summary = api.evaluate(run.path, api.load(held_out.path)).summary()
    return {"steps": steps, "seconds": round(seconds), "held_out": summary["metrics"]["success"]}


def peak_bytes() -> int | None:
    """Largest memory in use so far on the first device; None where the device does not say."""
    return (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--scenarios", type=int, default=512, help="to train on; a quarter is held out")
    parser.add_argument("--minutes", type=float, default=9.0)
    parser.add_argument("--batches", type=int, nargs="+", default=BATCHES)
    parser.add_argument("--environments", type=int, default=2048, help="of a PPO training")
    args = parser.parse_args()
    recorder = Recorder(args.out, args.minutes * 60)
    with tempfile.TemporaryDirectory() as folder:
        measure_all(recorder, args, Path(folder))


def measure_all(recorder: Recorder, args: argparse.Namespace, folder: Path) -> None:
    """Run all stages."""
    device = jax.devices()[0]
    recorder.results |= {
        "command": "python -m experiments.gpu --out FILE",
        "when": datetime.now(UTC).isoformat(timespec="minutes"),
        "device": device.device_kind,
        "machine_ms": machine_ms(),
        "environments": args.environments,
        "versions": versions(),
    }
    workers = Generation(workers=os.cpu_count() or 1)
    sizes = {"train": args.scenarios, "held_out": args.scenarios // 4}
    train_set, held_out = (
        ScenarioSet.open(generate(folder / name, size, seed, workers, audit=audit).path)
        for seed, (name, size) in enumerate(sizes.items())
    )
    bank = ScenarioBank.from_scenarios(list(train_set))
    recorder.results["bank_bytes"] = bank.nbytes
    # The largest batches last: they may not fit.
    for batch, task, traffic in product(sorted(args.batches), TASKS, ("log", "idm")):
        recorder.measure(
            "simulation", f"{task}, {traffic}, {batch}", partial(simulation, bank, task, traffic, batch)
        )
    for name, preset in TRAININGS.items():
        environments = args.environments if preset[0] == "ppo" else None
        recorder.measure("training", name, partial(training, bank, preset, environments))
    for planner, traffic in product(PLANNERS, ("log", "idm")):
        recorder.measure(
            "evaluation", f"{planner}, {traffic}", partial(evaluation, held_out, planner, traffic)
        )
    speed = recorder.results["training"]["ppo, mlp"]
    if isinstance(speed, dict):
        seconds = recorder.remaining_s("long training") - _MARGIN_S
        steps = max(1, int(speed["steps_per_second"] * seconds))
        recorder.measure(
            "long training",
            "ppo",
            partial(long_training, train_set, held_out, folder / "run", args.environments, steps),
        )


if __name__ == "__main__":
    main()
