"""Train, measure and export the zoo's aggressive policy.

drivax train aggressive --data BENCHMARK/train --out RUNS/aggressive
drivax train aggressive --data BENCHMARK/train --out RUNS/clone --total_steps 1536000 --algorithm.kind bc
    --algorithm.network.encoder.rows "[32, 32]" --algorithm.network.encoder.hidden "[128, 128]"
    --algorithm.network.first_scale 0.1
python -m experiments.learning.aggressive judge --data BENCHMARK/validation --runs RUNS [--only ego|others|traffic]
    [--write]
python -m experiments.learning.aggressive pack --data BENCHMARK/validation --runs RUNS
python -m experiments.learning.aggressive table

BENCHMARK is the output of `drivax generate BENCHMARK --benchmark`. The clone has the observation of the aggressive
policy and its number of behaviour cloning updates. `judge` evaluates on the validation split: all planners as ego, both
policies in place of other vehicles, one at a time, as in traffic, and an IDM car in each kind of traffic. `pack`
exports the policy and its measurements to the package.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drivax.evaluation.audit import scenario_names
from drivax.evaluation.episode_table import EpisodeTable, interval_of
from drivax.evaluation.result_tables import paired_difference
from drivax.evaluation.rollout import drive, evaluation_task
from drivax.evaluation.runner import evaluate
from drivax.learning.policies import export_policy, find_traffic, load_policy, policy_traffic
from drivax.planners.catalogue import make_planner
from drivax.planners.planner import Planner
from drivax.planners.planner_traffic import with_driver
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import CURRENT_STEP
from drivax.scenario.store import ScenarioSet
from drivax.simulator.simulator import Simulator
from drivax.tasks.task import Task
from drivax.tracking.run_folder import versions
from experiments.repository import RESULTS, ROOT

RESULT = RESULTS / "aggressive.json"
ZOO = ROOT / "src" / "drivax" / "zoo"
OWN_METRICS = tuple(
    f"boldness:{name}"
    for name in ("speed_ratio", "short_ttc", "lane_changes", "max_acceleration", "max_braking")
)
BOLD_METRICS = tuple(name.partition(":")[2] for name in OWN_METRICS)
FAILURES = ("collision", "at_fault_collision", "offroad", "red_light")
#: Number of vehicles per scenario to replace by the policies, and number of parallel simulations.
OTHERS, BATCH = 2, 64

Table = dict[str, dict[str, Any]]


def evaluate_as_ego(bank: ScenarioBank, names: list[dict[str, str]], runs: Path) -> dict[str, Any]:
    """Evaluate log, IDM, behaviour cloning and aggressive policy as ego."""
    drivers: dict[str, tuple[Planner, Task]] = {
        "log": (make_planner("expert"), Task()),
        "idm": (make_planner("idm"), Task()),
        **{name: load_policy(runs / name, bank) for name in ("clone", "aggressive")},
    }
    metrics_shown = (*BOLD_METRICS, "min_ttc", *FAILURES, "off_route", "progress_ratio", "success")
    episodes = {
        name: evaluate(planner, bank, names, task=replace(task, metrics=OWN_METRICS))
        for name, (planner, task) in drivers.items()
    }
    differences = {
        other: {
            metric: paired_difference(episodes["aggressive"], episodes[other], metric).as_dict()
            for metric in metrics_shown
        }
        for other in ("clone", "log")
    }
    return {
        "drivers": {name: _summary(table, metrics_shown) for name, table in episodes.items()},
        "minus": differences,
    }


def _summary(episodes: EpisodeTable, names: tuple[str, ...]) -> dict[str, Any]:
    metrics = episodes.summary()["metrics"]
    return {name: metrics[name] for name in names}


def evaluate_as_others(bank: ScenarioBank, names: list[dict[str, str]], runs: Path) -> Table:
    """Evaluate both policies in place of the vehicles nearest to ego, one at a time, among logged agents."""
    traffic = policy_traffic(runs / "aggressive", count=OTHERS)
    start = jax.jit(jax.vmap(lambda bank, row: traffic.start(bank, row, CURRENT_STEP), (None, 0)))
    table: Table = {}
    for name in ("clone", "aggressive"):
        planner, task = load_policy(runs / name, bank)
        slots = np.asarray(start(with_driver(bank, planner), jnp.arange(len(bank))).contexts.slot)
        row, column = np.nonzero(slots < bank.agents.shape[2])
        values = _agent_metrics(
            Simulator(evaluation_task(replace(task, metrics=OWN_METRICS))),
            planner,
            bank,
            row,
            slots[row, column],
        )
        segments = np.array([names[number]["segment"] for number in row])
        table[name] = {
            metric: interval_of(metric, values[metric], segments).as_dict()
            for metric in (*BOLD_METRICS, "min_ttc", *FAILURES, "left_map")
        }
    return table


def _agent_metrics(
    simulator: Simulator,
    planner: Planner,
    bank: ScenarioBank,
    row: np.ndarray[Any, Any],
    slot: np.ndarray[Any, Any],
) -> dict[str, np.ndarray[Any, Any]]:
    """Return the metrics of the agent that the planner drives in each row, NaN where undefined."""

    def drive_agent(planner: Planner, bank: ScenarioBank, row: jax.Array, slot: jax.Array) -> Any:
        keys = jax.random.key(0)[None]
        return drive(simulator, planner, bank, row[None], keys, CURRENT_STEP, slot).metrics

    drive_batch = jax.jit(jax.vmap(drive_agent, (None, None, 0, 0)))
    batches = []
    for first in range(0, len(row), BATCH):
        indices = np.arange(first, first + BATCH).clip(max=len(row) - 1)
        metrics = jax.device_get(
            drive_batch(planner, bank, jnp.asarray(row[indices]), jnp.asarray(slot[indices]))
        )
        count = min(BATCH, len(row) - first)
        batches.append({name: np.where(v.defined, v.value, np.nan)[:count, 0] for name, v in metrics.items()})
    return {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}


def evaluate_in_traffic(bank: ScenarioBank, names: list[dict[str, str]], runs: Path) -> Table:
    """Evaluate an IDM car along its route in each kind of traffic."""
    kinds = {name: find_traffic(name) for name in ("log", "idm")}
    kinds |= {name: policy_traffic(runs / name) for name in ("clone", "aggressive")}
    metrics_shown = ("short_ttc", "min_ttc", "max_braking", "collision", "at_fault_collision", "success")
    return {
        name: _summary(
            evaluate(make_planner("idm"), bank, names, task=Task(metrics=OWN_METRICS), traffic=traffic),
            metrics_shown,
        )
        for name, traffic in kinds.items()
    }


PARTS = {"ego": evaluate_as_ego, "others": evaluate_as_others, "traffic": evaluate_in_traffic}


def judge(args: argparse.Namespace) -> None:
    """Measure, print, and with --write merge the result with the stored parts."""
    scenario_set = ScenarioSet.open(args.data)
    scenarios = list(scenario_set)
    bank, names = ScenarioBank.from_scenarios(scenarios), [dict(row) for row in scenario_names(scenarios)]
    results: dict[str, Any] = json.loads(RESULT.read_text()) if RESULT.is_file() else {}
    results |= {
        "command": "python -m experiments.learning.aggressive judge --data BENCHMARK/validation --runs RUNS --write",
        "when": datetime.now(UTC).isoformat(timespec="minutes"),
        "validation": {"scenarios": len(scenarios), "hash": scenario_set.hash},
        "versions": versions(),
    }
    for name in [args.only] if args.only else PARTS:
        results[name] = PARTS[name](bank, names, args.runs)
        print(json.dumps({name: _keep_means(results[name])}, indent=1), flush=True)
        if args.write:
            RESULT.write_text(json.dumps(results, indent=1) + "\n")


def _keep_means(results: Mapping[str, Any]) -> dict[str, Any]:
    """Return the same tables with means only."""
    if "mean" in results:
        return results["mean"] if results["mean"] is None else round(results["mean"], 4)
    return {name: _keep_means(value) for name, value in results.items()}


def pack(args: argparse.Namespace) -> None:
    """Export the policy and its measurements to the package."""
    results = json.loads(RESULT.read_text())
    bank = ScenarioBank.from_scenarios([ScenarioSet.open(args.data)[0]])
    measurements = {
        "validation": results["validation"],
        "ego": _keep_means(results["ego"]["drivers"]["aggressive"]),
        "others": _keep_means(results["others"]["aggressive"]),
    }
    folder = export_policy(
        args.runs / "aggressive", ZOO / "aggressive", bank, {"measured": measurements}, overwrite=True
    )
    print(f"wrote {folder.path}")


COLUMNS = {
    "speed_ratio": "speed / limit", "short_ttc": "ttc < 1 s", "min_ttc": "least ttc, s", "lane_changes": "lane changes",
    "max_acceleration": "acceleration", "max_braking": "braking", "collision": "`collision`",
    "at_fault_collision": "at fault", "offroad": "`offroad`", "red_light": "`red_light`", "success": "`success`",
}  # fmt: skip


def tables() -> str:
    """Return the stored results as Markdown tables."""
    results = json.loads(RESULT.read_text())
    row_groups = (results["ego"]["drivers"], results["ego"]["minus"], results["others"], results["traffic"])
    return "\n".join(_table(rows) for rows in row_groups)


def _table(rows: Mapping[str, Any]) -> str:
    names = [name for name in COLUMNS if name in next(iter(rows.values()))]
    lines = [f"| | {' | '.join(COLUMNS[name] for name in names)} |", "|---" * (len(names) + 1) + "|"]
    for row, cells in rows.items():
        texts = [
            f"{cells[name]['mean']:.3f} [{cells[name]['low']:.3f}, {cells[name]['high']:.3f}]"
            for name in names
        ]
        lines.append(f"| {row} | {' | '.join(texts)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, export, or print the stored results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("table")
    judging_command, packing = commands.add_parser("judge"), commands.add_parser("pack")
    judging_command.add_argument("--only", choices=list(PARTS))
    judging_command.add_argument("--write", action="store_true", help="store the result")
    for command in (judging_command, packing):
        command.add_argument("--data", type=Path, required=True)
        command.add_argument("--runs", type=Path, required=True)
    args = parser.parse_args()
    if args.command == "table":
        print(tables())
        return
    (judge if args.command == "judge" else pack)(args)


if __name__ == "__main__":
    main()
