"""Time PPO training and the shares of simulation, inference and update in an iteration.

Times three programs alternately in one run: a whole iteration, collection only, and collection with constant actions.
The differences of their medians give the shares. Nothing else may run on the machine.

python -m experiments.speed.training --data SET [--write]     SET: at least 1,024 scenarios
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from drivax import settings
from drivax.learning.algorithms.ppo import Ppo
from drivax.learning.config import TrainConfig
from drivax.learning.environment import collect
from drivax.learning.program import Program, Seeds
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.simulator.traffic.log import LogTraffic
from drivax.tracking.run_folder import versions
from experiments.repository import RESULTS
from experiments.speed.machine import conditions

RESULT = RESULTS / "training.json"
SCENARIOS = 1024
_TWO_ENCODERS = ("--algorithm.network.shared_encoder", "false")
#: What is trained: the preset; with an encoder each for policy and value; these with more passes over the experience;
#: and the preset with the small latent-query encoder in bfloat16.
KINDS = {
    "ppo": (),
    "ppo, two encoders": _TWO_ENCODERS,
    "ppo, two encoders, 4 epochs of 8 minibatches": (
        *_TWO_ENCODERS, "--algorithm.epochs", "4", "--algorithm.minibatches", "8",
    ),
    "ppo, lq small in bfloat16": (
        "--algorithm.network.encoder.kind", "lq", "--algorithm.network.encoder.size", "small",
        "--algorithm.network.encoder.dtype", "bfloat16",
    ),
}  # fmt: skip


def programs(config: TrainConfig, bank: ScenarioBank) -> dict[str, Callable[[], Any]]:
    """Return the programs to time: a whole iteration, and parts of it that always start at the same state."""
    learner = config.algorithm.build(config.environment(LogTraffic()), bank, config.iterations)
    assert isinstance(learner, Ppo)
    program = Program(Seeds(learner, (0,)), bank, config.devices)
    steps = learner.config.unroll

    def rollout(bank: ScenarioBank, state: Any, actor: Any) -> Any:
        return collect(learner.environment, bank, state.environments, actor, state.key, steps)

    def act(bank: ScenarioBank, state: Any) -> Any:
        network = learner.network(state.parameters)

        def actor(seen: Mapping[str, Array], key: Array) -> tuple[Array, Array, dict[str, Array]]:
            policy, value = network.policy_and_value(seen)
            raw_action = policy.sample(key)
            return (
                raw_action,
                policy.action(raw_action),
                {"log_prob": policy.log_prob(raw_action), "value": value},
            )

        return rollout(bank, state, actor)

    def simulate(bank: ScenarioBank, state: Any) -> Any:
        def actor(seen: Mapping[str, Array], key: Array) -> tuple[Array, Array, dict[str, Array]]:
            zeros = jnp.zeros((learner.config.environments, learner.environment.action_size))
            return zeros, zeros, {}

        return rollout(bank, state, actor)

    def run(part: Callable[..., Any]) -> Callable[[], Any]:
        compiled = jax.jit(part)
        state = program.initial_state()
        return lambda: compiled(program.data, state)

    state = [program.initial_state()]

    def whole() -> Any:
        state[0], logs, *_ = program.step(state[0])
        return logs

    return {"whole": whole, "acting": run(act), "simulating": run(simulate)}


def measure(data: Path, repeats: int, environments: int | None) -> dict[str, Any]:
    """Steps per second of training and its shares, measured alternately, as in ``drivax train``."""
    scenarios = ScenarioSet.open(data)
    bank = ScenarioBank.from_scenarios([scenarios[row] for row in range(SCENARIOS)])
    calls, steps = {}, {}
    for name, overrides in KINDS.items():
        more = [] if environments is None else ["--algorithm.environments", str(environments)]
        config = settings.load(TrainConfig, "ppo", [*overrides, *more])
        steps[name] = config.algorithm.steps_per_iteration
        calls |= {(name, part): call for part, call in programs(config, bank).items()}
    times: dict[tuple[str, str], list[float]] = {kind: [] for kind in calls}
    for turn in range(repeats + 1):
        for kind, call in calls.items():
            start = time.perf_counter()
            jax.block_until_ready(call())
            if turn:
                times[kind].append(time.perf_counter() - start)
    result = {}
    for name in KINDS:
        whole, acting, simulating = (
            statistics.median(times[name, part]) for part in ("whole", "acting", "simulating")
        )
        result[name] = {
            "steps_per_second": round(steps[name] / whole),
            "share": {
                "simulation": round(simulating / whole, 3),
                "inference": round((acting - simulating) / whole, 3),
                "update": round((whole - acting) / whole, 3),
            },
        }
    return {
        "command": "python -m experiments.speed.training --data SET --write",
        "devices": [device.device_kind for device in jax.devices()],
        "scenarios": SCENARIOS,
        "environments": environments,
        "training": result,
        "versions": versions(),
    }


def main() -> None:
    """Measure, print and store."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument(
        "--environments", type=int, help="side by side, in place of the preset's; more on a GPU"
    )
    parser.add_argument("--write", action="store_true", help="store the result")
    args = parser.parse_args()
    with conditions() as record:
        result = measure(args.data, args.repeats, args.environments)
    result |= record
    print(json.dumps(result["training"], indent=1))
    if args.write:
        RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
