"""Offline updates per second of every algorithm of the presets ``offline/*``, and how many may be drawn per second.

Nothing else may run on the machine.

python benchmarks/offline.py --data SET [--write]
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
from drivax.learning.agents import Agents
from drivax.learning.algorithm import training_data
from drivax.learning.config import TrainConfig
from drivax.learning.program import Program
from drivax.learning.sampler import draw, sampler
from drivax.scenario.bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.tracking.runs import versions

RESULT = Path(__file__).resolve().parent / "results" / "offline.json"
ALGORITHMS = ("bc", "cql", "cql_bc", "iql", "td3_bc")
SCENARIOS, DRAWS = 10_000, 1_000_000


def seconds(call: Callable[[], Any], repeats: int) -> float:
    """Median time of a call, the first of which is not counted."""
    times = []
    for turn in range(repeats + 1):
        began = time.perf_counter()
        jax.block_until_ready(call())
        if turn:
            times.append(time.perf_counter() - began)
    return statistics.median(times)


def updates(name: str, data: ScenarioSet, repeats: int) -> dict[str, Any]:
    """Of one preset: updates per second, parameters that gradients change, and what preparing the steps took."""
    config = replace(settings.load(TrainConfig, f"offline/{name}"), devices=1)
    environment, bank = config.environment(), ScenarioBank.from_scenarios(data)
    learner = config.algorithm.build(environment, bank, config.iterations)
    began = time.perf_counter()
    weights = np.ones((len(bank), bank.steps))
    made = jax.block_until_ready(training_data(config.algorithm, environment, bank, weights))
    prepared = time.perf_counter() - began
    program = Program(Agents(learner, (0,)), made, 1)
    state = [program.first_state()]
    trained = state[0].parameters, getattr(state[0], "rest", ())

    def iterate() -> Any:
        state[0], logs = program.step(state[0])
        return logs

    size = sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(trained))
    algorithm: Any = config.algorithm
    return {
        "updates_per_second": round(algorithm.updates / seconds(iterate, repeats), 1),
        "batch": algorithm.batch,
        "parameters": size,
        "seconds_to_prepare": round(prepared, 1),
    }


def draws() -> int:
    """Places drawn per second among 10,000 scenarios of 91 steps, by uneven weights."""
    made = sampler(np.random.default_rng(0).gamma(0.5, size=(SCENARIOS, 91)))
    call = partial(jax.jit, static_argnums=2)(draw)
    return round(DRAWS / seconds(lambda: call(made, jax.random.key(0), (DRAWS,)), 5))


def main() -> None:
    """Measures, shows and stores."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--write", action="store_true", help="store the result")
    args = parser.parse_args()
    data = ScenarioSet.open(args.data)
    result = {
        "command": "python benchmarks/offline.py --data SET --write",
        "when": datetime.now(UTC).isoformat(timespec="minutes"),
        "devices": [device.device_kind for device in jax.devices()],
        "scenarios": len(data),
        "draws_per_second": draws(),
        "algorithms": {name: updates(name, data, args.repeats) for name in ALGORITHMS},
        "versions": versions(),
    }
    print(json.dumps(result, indent=1))
    if args.write:
        RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
