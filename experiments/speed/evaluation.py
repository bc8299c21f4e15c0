"""Time evaluations of every planner in log replay and reactive traffic, without compilation.

The first batch compiles, so the others are timed, and extrapolated to 1,000 scenarios of 80 steps. Nothing else may run
on the machine.

python -m experiments.speed.evaluation --data SET [--planner NAME ...] [--write]     SET: at least 1,024 scenarios
python -m experiments.speed.evaluation --table                                       what is stored, into the page
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

from drivax.api import find_planner
from drivax.evaluation.audit import scenario_names
from drivax.evaluation.runner import evaluate, program_width
from drivax.learning.policies import find_traffic
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import CURRENT_STEP
from drivax.scenario.store import ScenarioSet
from drivax.tracking.run_folder import versions
from experiments.repository import DOCS, RESULTS
from experiments.speed.machine import HEADINGS, cells, conditions

RESULT = RESULTS / "evaluation.json"
PAGE = DOCS / "results" / "speed.md"
BEGIN, END = "<!-- evaluation.py: begin -->", "<!-- evaluation.py: end -->"
#: Whole batches, so that their times are equal.
SCENARIOS = 1024
#: Seconds that 1,000 scenarios of 80 steps may take in log replay traffic.
AIMS = {"expert": 8, "constant_velocity": 8, "idm": 8, "zoo:aggressive": 12, "pdm": 600}
TRAFFIC = ("log", "idm")


def evaluation_seconds(planner: str, traffic: str, bank: ScenarioBank, names: list[dict[str, str]]) -> float:
    """Seconds for 1,000 scenarios of 80 steps."""
    driver, task = find_planner(planner, bank, False)
    ends: list[float] = []
    evaluate(
        driver,
        bank,
        names,
        task=task,
        traffic=find_traffic(traffic),
        progress=lambda done, total: ends.append(time.perf_counter()),
    )
    batch_s = (ends[-1] - ends[0]) / (len(ends) - 1)
    return 1000 / program_width() * batch_s * 80 / (bank.steps - 1 - CURRENT_STEP)


def measure(data: Path, planners: list[str]) -> dict[str, Any]:
    """Seconds by planner and traffic."""
    stored = ScenarioSet.open(data)
    scenarios = [stored[row] for row in range(SCENARIOS)]
    bank, names = ScenarioBank.from_scenarios(scenarios), scenario_names(scenarios)
    rows: dict[str, dict[str, Any]] = {}
    for planner in planners:
        with conditions() as record:
            rows[planner] = {
                kind: round(evaluation_seconds(planner, kind, bank, names), 2) for kind in TRAFFIC
            }
        rows[planner] |= record
        print(planner, rows[planner], flush=True)
    return {
        "command": "python -m experiments.speed.evaluation --data SET --write",
        "seconds": rows,
        "versions": versions(),
    }


def table(result: dict[str, Any]) -> str:
    """Return a Markdown table of times next to their limits."""
    lines = [
        f"| planner | `log` (s) | may take (s) | `idm` (s) | `idm` / `log` | {HEADINGS} |",
        "|---|---:|---:|---:|---:|---|---|",
    ]
    for planner, row in result["seconds"].items():
        log, idm = (row[kind] for kind in TRAFFIC)
        speed = f"{log:,.1f} | {AIMS[planner]} | {idm:,.1f} | {idm / log:.2f}"
        lines.append(f"| `{planner}` | {speed} | {cells(row)} |")
    return "\n".join(lines)


def main() -> None:
    """Measure, store and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path)
    parser.add_argument("--planner", nargs="+", choices=list(AIMS), default=list(AIMS))
    parser.add_argument("--write", action="store_true", help="store the result")
    parser.add_argument("--table", action="store_true", help="put what is stored into the page")
    args = parser.parse_args()
    if args.table:
        before, rest = PAGE.read_text().split(BEGIN)
        text = table(json.loads(RESULT.read_text()))
        PAGE.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{rest.split(END)[1]}")
        return
    if args.data is None:
        parser.error("the following arguments are required: --data")
    result = measure(args.data, args.planner)
    if args.write:
        RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
