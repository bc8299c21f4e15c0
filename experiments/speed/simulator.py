"""Time the simulator: scaling with maps, banks and agents, the cost of reactive traffic, and each part alone.

Timings are medians; a ratio compares two timings of one run. Nothing else may run on the machine.

Run: python -m experiments.speed.simulator --data SET [--write]      SET: at least 4,096 scenarios of the built-in world
     python -m experiments.speed.simulator --data SET --again     (the speeds once more, added to simulator_runs.json)
     python -m experiments.speed.simulator --table                (the stored results into docs/results/speed.md)
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from drivax.learning.program import use_all_cores
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.simulator.simulator import Simulator, map_where
from drivax.simulator.traffic.bank_data import prepare_bank
from drivax.simulator.traffic.override import OverrideTraffic, with_override
from drivax.simulator.traffic.reactive import IdmTraffic, make_traffic
from drivax.studies.bench import (
    BenchConfig,
    bench,
    bench_metrics,
    compile_program,
    replicate,
    steps_per_second,
)
from drivax.tasks.observations import PRESETS
from drivax.tasks.task import Task
from drivax.testing.worlds import pad_agents
from drivax.tracking.run_folder import versions
from experiments.repository import DOCS, RESULTS
from experiments.speed.machine import conditions

RESULT = RESULTS / "simulator.json"
RUNS = RESULT.with_name("simulator_runs.json")
PAGE = DOCS / "results" / "speed.md"
#: What is simulated: the fullest task, and the leanest that still learns.
TASKS = {
    "full": Task(observation=PRESETS["optimal"], metrics="full"),
    "lean": Task(observation=PRESETS["minimal"], metrics="training"),
}
#: What the reference system (V-Max on Waymax) spends on the same work: MFLOP and ms per environment and step. Source:
#: its published code, run under JAX 0.5.3 on two CPU cores with a synthetic scenario of 64 agents and 30,000 map
#: points, batch 16; operations by XLA's count.
REFERENCE = {
    "observation": ("observation", "1.8", "0.8"),
    "step": ("whole step, without resets", "205", "43.6"),
    "lanes": ("driving direction, speed limit, several lanes", "5.3 + 0.85 + 0.85", "3.2 + 0.15 + 0.15"),
    "ttc": ("time to collision", "11.5", "9.9"),
    "edges": ("off-road", "184", "40 to 64"),
    "contacts": ("at fault, overlap", "1.3 + 0.24", "0.18 + 0.05"),
    "route": ("progress, wrong way, off route, red light, comfort", "less than 0.2", "less than 0.07"),
    "dynamics": ("bicycle", "0.0004", "0.02"),
}
BATCHES = (64, 128, 256, 1024)
SCENARIOS, MANY = 1024, 4096


def speeds(bank: ScenarioBank, config: BenchConfig) -> dict[str, Any]:
    """Time both tasks in both kinds of traffic at all batch sizes alternately; details are of the fastest size."""
    kinds = [(name, traffic, batch) for name in TASKS for traffic in ("log", "idm") for batch in BATCHES]
    bank = replicate(prepare_bank(IdmTraffic(), bank))
    programs = [
        compile_program(bank, replace(config, task=TASKS[name], traffic=traffic, batch=batch))
        for name, traffic, batch in kinds
    ]
    rates = dict(zip(kinds, steps_per_second(programs, config.repeats), strict=True))
    result = {}
    for name, traffic in dict.fromkeys(kind[:2] for kind in kinds):
        batch = max(BATCHES, key=lambda size, kind=(name, traffic): rates[*kind, size])
        program = programs[kinds.index((name, traffic, batch))]
        result[f"{name}, {traffic}"] = {
            "batch": batch,
            "steps_per_second": round(rates[name, traffic, batch]),
            "by_batch": {size: round(rates[name, traffic, size]) for size in BATCHES},
            "compile_seconds": round(step_compiled(bank, TASKS[name], traffic), 2),
            "program_compile_seconds": round(program.compile_seconds, 2),
            "state_bytes": program.state_bytes,
            "temporary_bytes": program.temporary_bytes,
        }
    return result


def again(folder: Path, repeats: int) -> dict[str, Any]:
    """Time the speeds again, alternately, at the best batch sizes of the stored result."""
    use_all_cores()
    stored = ScenarioSet.open(folder)
    bank = replicate(
        prepare_bank(IdmTraffic(), ScenarioBank.from_scenarios([stored[i] for i in range(SCENARIOS)]))
    )
    best = {name: speed["batch"] for name, speed in json.loads(RESULT.read_text())["speed"].items()}
    programs = []
    for name, batch in best.items():
        task, traffic = name.split(", ")
        config = BenchConfig(batch=batch, repeats=repeats, task=TASKS[task], traffic=traffic)
        programs.append(compile_program(bank, config))
    with conditions() as record:
        rates = dict(zip(best, map(round, steps_per_second(programs, repeats)), strict=True))
    return {**record, "steps_per_second": rates, "versions": versions()}


def step_compiled(bank: ScenarioBank, task: Task, traffic: str) -> float:
    """Seconds to compile a program that steps or resets, and observes a batch, on one device.

    The program that is timed does more: it drives by IDM, evaluates episodes, loops, and spans all devices.
    """
    simulator, batch = Simulator(task, make_traffic(traffic)), 64

    def step_one(bank: ScenarioBank, state: Any, action: Any, over: Any, fresh: Any) -> Any:
        after, transition = simulator.step_or_reset(bank, state, action, over, fresh)
        return transition, simulator.observe(bank, after.context)

    def step(bank: ScenarioBank, states: Any, actions: Any, over: Any, index: Any) -> Any:
        fresh = map_where(over, partial(simulator.new_episode, bank), index)
        return jax.vmap(step_one, in_axes=(None, 0, 0, 0, 0))(bank, states, actions, over, fresh)

    states = jax.eval_shape(jax.vmap(simulator.reset, in_axes=(None, 0)), bank, jnp.zeros(batch, jnp.int32))
    over, index = (jax.ShapeDtypeStruct((batch,), kind) for kind in (bool, jnp.int32))
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), bank)
    jax.clear_caches()
    start = time.perf_counter()
    jax.jit(step).lower(shapes, states, states.context.action, over, index).compile()
    return time.perf_counter() - start


def more_segments(bank: ScenarioBank) -> ScenarioBank:
    """Double the map with distant segments, to measure the cost of a larger capacity."""
    pad = ((0, 0), (0, 0), (0, 4096))
    return replace(
        bank,
        edges=jnp.pad(bank.edges, pad, constant_values=1e6),
        lanes=jnp.pad(bank.lanes, pad, constant_values=1e6),
    )


def agents(bank: ScenarioBank, count: int) -> ScenarioBank:
    """Return the bank with a number of agent slots: the first ones, padded with empty ones."""
    first = replace(
        bank,
        agents=bank.agents[:, :, :count],
        extension=bank.extension[:, :count],
        agent_box=bank.agent_box[:, :count],
        parked=bank.parked[:, :count],
        parked_when=bank.parked_when[:, :, :count],
    )
    return pad_agents(first, count - first.agents.shape[2])


def growth(small: ScenarioBank, large: ScenarioBank, config: BenchConfig) -> float:
    """Ratio of the time per step of a large and a small bank, measured alternately."""
    programs = [compile_program(bank, config) for bank in (small, large)]
    small_rate, large_rate = steps_per_second(programs, config.repeats)
    return round(small_rate / large_rate, 3)


def state_bytes(bank: ScenarioBank) -> dict[str, int]:
    """Bytes of an environment's state in each kind of traffic, full task."""
    single = jax.tree.map(lambda leaf: leaf[:1], bank)
    slots = jnp.arange(1, 5)[None]
    motion = jnp.zeros((1, bank.steps, 4, 4))
    banks = {
        "log": (single, None),
        "idm": (single, IdmTraffic()),
        "override": (with_override(single, slots, motion), OverrideTraffic()),
        "override+idm": (with_override(single, slots, motion), OverrideTraffic(IdmTraffic())),
    }
    sizes = {}
    for name, (traffic_bank, traffic) in banks.items():
        simulator = Simulator(TASKS["full"]) if traffic is None else Simulator(TASKS["full"], traffic)
        ready = prepare_bank(simulator.traffic, traffic_bank)
        state = jax.eval_shape(simulator.reset, ready, jnp.zeros((), jnp.int32))
        sizes[name] = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state))
    return sizes


def measure(folder: Path, repeats: int) -> dict[str, Any]:
    """Run all measurements."""
    use_all_cores()
    stored = ScenarioSet.open(folder)
    if len(stored) < MANY:
        raise SystemExit(f"{folder} has {len(stored)} scenarios; generate at least {MANY}")
    scenarios = [stored[i] for i in range(MANY)]
    bank = ScenarioBank.from_scenarios(scenarios[:SCENARIOS])
    config = BenchConfig(repeats=repeats)
    result: dict[str, Any] = {"scenarios": SCENARIOS, "devices": jax.device_count()}
    result |= {"state_bytes": state_bytes(bank), "speed": speeds(bank, config)}
    print(json.dumps(result["speed"], indent=1), flush=True)
    result |= {"metrics": bench_metrics(bank, config)["rows"], "parts": bench(bank, config)}
    full = BenchConfig(batch=SCENARIOS, repeats=repeats)
    untrimmed = ScenarioBank.from_scenarios(scenarios[:SCENARIOS], trim=False)
    result["growth"] = {
        "segments 4,096 to 8,192": growth(untrimmed, more_segments(untrimmed), full),
        "agents 64 to 128": growth(agents(bank, 64), agents(bank, 128), full),
        "scenarios 1,024 to 4,096": growth(bank, ScenarioBank.from_scenarios(scenarios), full),
    }
    return result


def runs_table(runs: list[dict[str, Any]]) -> list[str]:
    """Table of the speeds of every run."""
    if not runs:
        return []
    names = list(runs[0]["steps_per_second"])
    rows = [
        f"| run (UTC) | machine (ms) | {' | '.join(names)} | lean: idm / log |",
        "|---" * (len(names) + 3) + "|",
    ]
    for run in runs:
        rates = run["steps_per_second"]
        ratio = rates["lean, idm"] / rates["lean, log"]
        cells = [f"{rates[name]:,}" for name in names]
        machine = " to ".join(f"{value:.0f}" for value in sorted(run["machine_ms"]))
        rows.append(
            f"| {run['when'][:16].replace('T', ' ')} | {machine} | {' | '.join(cells)} | {ratio:.2f} |"
        )
    return rows


def table(result: dict[str, Any], runs: list[dict[str, Any]]) -> str:
    """Return the page's tables."""
    rows = ["| task | traffic | steps/s | batch | state (B) | a step, compiled (s) | all, compiled (s) |"]
    rows += ["|---|---|---|---|---|---|---|"]
    for name, speed in result["speed"].items():
        task, traffic = name.split(", ")
        rows.append(
            f"| {task} | `{traffic}` | {speed['steps_per_second']:,} | {speed['batch']} | {speed['state_bytes']:,} "
            f"| {speed['compile_seconds']:.1f} | {speed['program_compile_seconds']:.1f} |"
        )
    rows += ["", *runs_table(runs)]
    rows += ["", "| metrics | batch | steps/s | relative |", "|---|---|---|---|"]
    for row in result["metrics"]:
        batch = f"{row['batch']}{' (best)' if row['best'] else ''}"
        rows.append(f"| `{row['metrics']}` | {batch} | {row['steps_per_second']:,} | {row['relative']:.2f} |")
    rows += ["", "| part, alone | us | operations | bytes | reference: what | MFLOP | ms |"]
    rows += ["|---|---|---|---|---|---|---|"]
    parts = result["parts"]
    for name, value in sorted(parts["by_part"].items(), key=lambda pair: -pair[1]):
        cost = parts["cost_by_part"][name]
        there = " | ".join(REFERENCE.get(name, ("", "", "")))
        rows.append(f"| {name} | {value:.2f} | {cost['operations']:,} | {cost['bytes']:,} | {there} |")
    rows += ["", "| growth | time per step |", "|---|---|"]
    rows += [f"| {name} | x {ratio:.2f} |" for name, ratio in result["growth"].items()]
    rows += ["", "| traffic | state (B) |", "|---|---|"]
    rows += [f"| `{name}` | {size:,} |" for name, size in result["state_bytes"].items()]
    rows += [
        "",
        f"Edges and lanes by the grid: {parts['brute_force_ratio']} times as fast as every segment of the scenario.",
    ]
    return "\n".join(rows)


BEGIN, END = "<!-- simulator.py: begin -->", "<!-- simulator.py: end -->"


def main() -> None:
    """Measure and store, or write the stored result to the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="scenario set of at least 4,096 scenarios")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--write", action="store_true", help="store experiments/results/simulator.json")
    parser.add_argument(
        "--table", action="store_true", help="put the stored results into docs/results/speed.md"
    )
    parser.add_argument("--again", action="store_true", help="add the speeds to simulator_runs.json")
    args = parser.parse_args()
    runs = json.loads(RUNS.read_text()) if RUNS.exists() else []
    if args.table:
        before, rest = PAGE.read_text().split(BEGIN)
        text = table(json.loads(RESULT.read_text()), runs)
        PAGE.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{rest.split(END)[1]}")
        return
    if args.data is None:
        parser.error("--data is needed")
    if args.again:
        runs.append(again(args.data, args.repeats))
        RUNS.write_text(json.dumps(runs, indent=1) + "\n")
        print("\n".join(runs_table(runs)))
        return
    # Only the set's name: its folder on this machine does not matter.
    command = (
        f"python -m experiments.speed.simulator --data {args.data.name} --repeats {args.repeats} --write"
    )
    with conditions() as record:
        measured = measure(args.data, args.repeats)
    result = {"command": command, **record, **measured, "versions": versions()}
    print(table(result, runs))
    if args.write:
        RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
