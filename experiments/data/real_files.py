"""Evaluate every planner on every real file: outcome and score per scenario, in log replay and reactive traffic.

python -m experiments.data.real_files --data ../shared/data [--write]     (--write stores the result and the page)
python -m experiments.data.real_files --table                             (write the stored result to the page)

A file longer than a scenario yields several scenarios; the ego is that of the source.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from drivax.api import find_planner
from drivax.datasets.formats import detect, survey
from drivax.datasets.reader import BadRecord
from drivax.evaluation.audit import scenario_names
from drivax.evaluation.runner import evaluate
from drivax.learning.policies import find_traffic
from drivax.report.episodes import outcome
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Recording, windows
from drivax.scenario.schema import STEPS
from drivax.tracking.run_folder import versions, zoo
from experiments.learning.tables import label
from experiments.repository import DOCS, RESULTS

RESULT = RESULTS / "real_files.json"
PAGE = DOCS / "results" / "real-files.md"
BEGIN, END = "<!-- real_files.py: begin -->", "<!-- real_files.py: end -->"
RULES = ("expert", "expert_actions", "pdm", "idm", "search", "constant_speed", "constant_velocity", "random")
#: Planners outside of the package.
MODULES = {"search": "search_planner:SearchPlanner"}
TRAFFIC = ("log", "idm")


def read_windows(data: Path) -> Iterator[tuple[str, Recording]]:
    """Yield every window of every file, with the name of the file relative to the folder."""
    for file in survey(data).paths():
        for recording in detect(file).read(file):
            if isinstance(recording, BadRecord):
                raise SystemExit(str(recording.error()))
            for window in windows(recording):
                yield file.relative_to(data).as_posix(), window


def measure(data: Path) -> dict[str, Any]:
    """Return outcome, score and progress of every planner by scenario."""
    sys.path.append(str(Path(__file__).resolve().parents[1] / "planners"))
    files, recordings = zip(*read_windows(data), strict=True)
    scenarios = [assemble(recording) for recording in recordings]
    bank, names = ScenarioBank.from_scenarios(scenarios), scenario_names(scenarios)
    rows = [
        {"source": file.split("/")[0], "scenario_id": scenario.id, "steps": int(scenario.steps)}
        for file, scenario in zip(files, scenarios, strict=True)
    ]
    results: dict[str, Any] = {kind: {} for kind in TRAFFIC}
    for planner in (*RULES, *zoo()):
        driver, task = find_planner(MODULES.get(planner, planner), bank, False)
        for kind in TRAFFIC:
            table = evaluate(driver, bank, names, task=task, traffic=find_traffic(kind))
            results[kind][planner] = [
                {
                    "outcome": outcome(table, row),
                    **{name: _number(table.metrics[name][row]) for name in ("vmax_score", "progress")},
                }
                for row in range(len(rows))
            ]
            print(planner, kind, [episode["outcome"] for episode in results[kind][planner]], flush=True)
    return {
        "command": "python -m experiments.data.real_files --data ../shared/data --write",
        "when": datetime.now(UTC).isoformat(timespec="minutes"),
        "files": len(set(files)),
        "recordings": len({scenario.text("segment") for scenario in scenarios}),
        "scenarios": rows,
        "planners": results,
        "versions": versions(),
    }


def _number(value: float) -> float | None:
    return round(float(value), 3) if np.isfinite(value) else None


def tables(result: dict[str, Any]) -> str:
    """Return the counts, and a table per kind of traffic: scenarios in rows, planners in columns."""
    rows = [row for planners in result["planners"].values() for row in planners.values()]
    scenarios = result["scenarios"]
    short = sum(scenario["steps"] < STEPS for scenario in scenarios)
    lines = [
        f"{result['files']} files of {result['recordings']} drives, {len(scenarios)} scenarios ({short} of them "
        f"shorter than {STEPS} steps), {sum(map(len, rows))} episodes.",
        "",
    ]
    for kind, planners in result["planners"].items():
        lines += [
            f"In `{kind}` traffic:",
            "",
            f"| source | scenario | {' | '.join(map(label, planners))} |",
        ]
        lines.append("|---|---|" + "---|" * len(planners))
        for row, scenario in enumerate(scenarios):
            cells = [_cell(episodes[row]) for episodes in planners.values()]
            lines.append(f"| {scenario['source']} | {scenario['scenario_id']} | {' | '.join(cells)} |")
        counts = [sum(e["outcome"] == "success" for e in episodes) for episodes in planners.values()]
        lines += [f"| | **successes** of {len(scenarios)} | {' | '.join(map(str, counts))} |", ""]
    return "\n".join(lines[:-1])


def _cell(episode: dict[str, Any]) -> str:
    score = "" if episode["vmax_score"] is None else f" {episode['vmax_score']:.2f}"
    return f"{episode['outcome']}{score}"


def write_page(result: dict[str, Any]) -> None:
    """Write the tables to the page."""
    before, rest = PAGE.read_text().split(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}\n\n{tables(result)}\n\n{END}{rest.split(END)[1]}")


def main() -> None:
    """Measure, store and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path)
    parser.add_argument("--write", action="store_true", help="store the result, and put it into the page")
    parser.add_argument("--table", action="store_true", help="put what is stored into the page")
    args = parser.parse_args()
    if args.table:
        write_page(json.loads(RESULT.read_text()))
        return
    if args.data is None:
        parser.error("the following arguments are required: --data")
    result = measure(args.data)
    if args.write:
        RESULT.write_text(json.dumps(result, indent=1) + "\n")
        write_page(result)


if __name__ == "__main__":
    main()
