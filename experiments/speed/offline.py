"""Time offline learning: updates of every preset ``offline/*``, ensemble members alone and together, and draws.

Nothing else may run on the machine.

python -m experiments.speed.offline --data SET --write
python -m experiments.speed.offline --table     (what is stored, into docs/algorithms/offline.md)
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from drivax import settings
from drivax.curation.ensemble import EnsembleConfig, train_ensemble
from drivax.learning.algorithm import training_data
from drivax.learning.config import TrainConfig
from drivax.learning.experience import sample_steps, sampler
from drivax.learning.program import Program, Seeds
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.tracking.run_folder import versions
from experiments.repository import DOCS, RESULTS

RESULT = RESULTS / "offline.json"
PAGE = DOCS / "algorithms" / "offline.md"
BEGIN, END = "<!-- offline.py: begin -->", "<!-- offline.py: end -->"
ALGORITHMS = ("bc", "cql", "cql_bc", "iql", "td3_bc")
SCENARIOS, DRAWS = 10_000, 1_000_000


def seconds(call: Callable[[], Any], repeats: int) -> float:
    """Median time of a call after the first."""
    return statistics.median([elapsed(call) for _ in range(repeats + 1)][1:])


def elapsed(call: Callable[[], Any]) -> float:
    """Seconds of a call."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def training(config: TrainConfig, data: ScenarioSet) -> tuple[Callable[[], Any], dict[str, Any]]:
    """Return a training's iteration function and its number of trained parameters."""
    environment, bank = config.environment(), ScenarioBank.from_scenarios(data)
    learner = config.algorithm.build(environment, bank, config.iterations)
    start = time.perf_counter()
    weights = np.ones((len(bank), bank.steps))
    experience = jax.block_until_ready(training_data(config.algorithm, environment, bank, weights))
    preparation_s = time.perf_counter() - start
    program = Program(Seeds(learner, (0,)), experience, 1)
    state = [program.initial_state()]
    trained = state[0].parameters, getattr(state[0], "rest", ())
    size = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(trained))

    def iterate() -> Any:
        state[0], logs, *_ = program.step(state[0])
        return logs

    algorithm: Any = config.algorithm
    return iterate, {
        "batch": algorithm.batch,
        "parameters": size,
        "seconds_to_prepare": round(preparation_s, 1),
    }


def updates(data: ScenarioSet, repeats: int) -> dict[str, dict[str, Any]]:
    """Updates per second of every algorithm (median, slowest, fastest) and its size, measured alternately."""
    configs = {name: replace(settings.load(TrainConfig, f"offline/{name}"), devices=1) for name in ALGORITHMS}
    programs = {name: training(config, data) for name, config in configs.items()}
    rates = {name: list[float]() for name in ALGORITHMS}
    for turn in range(repeats + 1):
        for name, (iterate, _) in programs.items():
            duration_s = elapsed(iterate)
            if turn:  # the first time it is compiled
                algorithm: Any = configs[name].algorithm
                rates[name].append(algorithm.updates / duration_s)
    return {
        name: {
            "updates_per_second": round(statistics.median(rates[name]), 1),
            "range": [round(min(rates[name]), 1), round(max(rates[name]), 1)],
            **size,
        }
        for name, (_, size) in programs.items()
    }


def members(data: ScenarioSet, repeats: int) -> dict[str, Any]:
    """Seconds per iteration of the default ensemble and of a single member, measured alternately."""
    config = EnsembleConfig()
    iterate, size = training(TrainConfig(task=config.task, algorithm=config.cloning, devices=1), data)
    config = replace(config, total_steps=(repeats + 1) * config.cloning.steps_per_iteration)
    start, ensemble_s, single_s = [0.0], list[float](), list[float]()

    def turn(done: int, total: int) -> None:
        end = time.perf_counter()
        jax.block_until_ready(iterate())
        if done > 1:
            ensemble_s.append(end - start[0])
            single_s.append(time.perf_counter() - end)
        start[0] = time.perf_counter()

    train_ensemble(config, data, turn)
    single, ensemble = statistics.median(single_s), statistics.median(ensemble_s)
    return {
        "members": config.folds,
        "parameters_of_one": size["parameters"],
        "batch": config.cloning.batch,
        "updates": config.cloning.updates,
        "seconds_of_one": round(single, 3),
        "seconds_of_all": round(ensemble, 3),
        "ratio": round(ensemble / single, 2),
    }


def draws() -> int:
    """Steps drawn per second among 10,000 scenarios of 91 steps, with uneven weights."""
    steps = sampler(np.random.default_rng(0).gamma(0.5, size=(SCENARIOS, 91)))
    call = partial(jax.jit, static_argnums=2)(sample_steps)
    return round(DRAWS / seconds(lambda: call(steps, jax.random.key(0), (DRAWS,)), 5))


def table(result: dict[str, Any]) -> str:
    """Table of the page."""
    rows = [
        "| algorithm | updates/s | slowest to quickest | batch | parameters |",
        "|---|---:|---:|---:|---:|",
    ]
    rows += [
        f"| `offline/{name}` | {row['updates_per_second']:.0f} | {row['range'][0]:.0f} to {row['range'][1]:.0f} | "
        f"{row['batch']} | {row['parameters']:,} |"
        for name, row in result["algorithms"].items()
    ]
    members = result["members"]
    sizes = f"{members['members']} members of {members['parameters_of_one']:,} parameters, batch {members['batch']}"
    times = (
        f"{members['seconds_of_all']} s for {members['updates']} updates of each, {members['ratio']} times"
    )
    return "\n".join(rows) + (
        f"\n\n{sizes}: {times} as long as one "
        f"alone. Steps are drawn {result['draws_per_second']:,} times per second ({', '.join(result['devices'])})."
    )


def main() -> None:
    """Measure, print and store."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--write", action="store_true", help="store the result")
    parser.add_argument("--table", action="store_true", help="put what is stored into the page")
    args = parser.parse_args()
    if args.table:
        before, rest = PAGE.read_text().split(BEGIN)
        text = table(json.loads(RESULT.read_text()))
        PAGE.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{rest.split(END)[1]}")
        return
    if args.data is None:
        parser.error("--data is needed")
    data = ScenarioSet.open(args.data)
    result = {
        "command": "python -m experiments.speed.offline --data SET --write",
        "when": datetime.now(UTC).isoformat(timespec="minutes"),
        "devices": [device.device_kind for device in jax.devices()],
        "scenarios": len(data),
        "draws_per_second": draws(),
        "members": members(data, args.repeats),
        "algorithms": updates(data, args.repeats),
        "versions": versions(),
    }
    print(json.dumps(result, indent=1))
    if args.write:
        RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
