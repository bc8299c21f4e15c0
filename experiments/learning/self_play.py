"""Measure how far policies drive per at-fault collision when they drive all further egos of the scenario, too.

python -m experiments.learning.self_play --data BENCHMARK --policy PRESET ...

BENCHMARK is the output of `drivax generate BENCHMARK --benchmark --egos 8`; `presets.py collect` has stored the
policies of each PRESET. Writes the result, and its table to the page of the benchmark.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from drivax.evaluation.audit import scenario_names
from drivax.evaluation.runner import evaluate
from drivax.learning.policies import policy_traffic
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.tracking.run_folder import versions
from experiments.learning.benchmark import (
    KM_PER_FAULT,
    PAGE,
    Episodes,
    fill_page,
    format_cells,
    km_per_fault,
    learned_planners,
    load_planners,
    mean_interval,
)
from experiments.learning.tables import table
from experiments.repository import RESULTS

RESULT = RESULTS / "self-play.json"
#: Vehicles around ego that the policy drives: all further egos of a set with --egos 8.
OTHERS = 7
COLUMNS = {
    "success": "success", "accuracy": "accuracy", "collision": "collision", "at_fault_collision": "at fault",
    "offroad": "off-road", "distance": "distance (m)",
}  # fmt: skip


def drive(name: str, data: ScenarioSet) -> Episodes:
    """Evaluate every seed of a preset among vehicles that it drives itself."""
    scenarios = list(data)
    bank, names = ScenarioBank.from_scenarios(scenarios), scenario_names(scenarios)
    tables = [
        evaluate(planner, bank, names, task=task, traffic=policy_traffic(folder, count=OTHERS))
        for folder, (planner, task) in zip(learned_planners()[name], load_planners(name, bank), strict=True)
    ]
    values = {metric: np.stack([episodes.metrics[metric] for episodes in tables]) for metric in COLUMNS}
    return Episodes(values, np.array([row["segment"] for row in names]), {"seeds": len(tables)})


def results_of(episodes: Episodes) -> dict[str, Any]:
    """Return the means over episodes with their intervals, and the kilometres per at-fault collision."""
    means = {metric: mean_interval(episodes, metric).as_dict() for metric in COLUMNS}
    return {"seeds": episodes.about["seeds"]} | means | {KM_PER_FAULT: km_per_fault(episodes).as_dict()}


def result_table(result: dict[str, Any]) -> list[str]:
    """Return the lines of the page's table."""
    rows = [
        (f"`{name}`", str(values["seeds"]), *format_cells(values, (*COLUMNS, KM_PER_FAULT)))
        for name, values in result["policies"].items()
    ]
    return table(("policy", "seeds", *COLUMNS.values(), "km per fault"), rows)


def main() -> None:
    """Evaluate the policies, and store and show the result."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--policy", nargs="+", required=True)
    args = parser.parse_args()
    data = ScenarioSet.open(args.data / "test")
    result = {
        "command": f"python -m experiments.learning.self_play --data BENCHMARK --policy {' '.join(args.policy)}",
        "test": {"hash": data.hash, "scenarios": len(data)},
        "policies": {name: results_of(drive(name, data)) for name in args.policy},
        "versions": versions(),
    }
    RESULT.write_text(json.dumps(result, indent=1) + "\n")
    PAGE.write_text(fill_page(PAGE.read_text(), {"self-play": result_table(result)}))


if __name__ == "__main__":
    main()
