"""What the expert does wrong, which is what map, converter or metric do wrong.

Drives the exact log (``expert``) and its actions through the dynamics (``expert_actions``) on the built-in world and on
every real file that a reader exists for; in the real files every logged vehicle that moves is taken as ego too.

    python benchmarks/expert_audit.py --data ../shared/data [--write]

``--write`` stores docs/results/expert-audit.md and benchmarks/results/expert_audit.json.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivax.api import load
from drivax.datasets.formats import detect, find_files
from drivax.datasets.reader import BadRecord
from drivax.evaluation.results import Results
from drivax.evaluation.runner import evaluate
from drivax.planners.catalogue import make_planner
from drivax.scenario.assemble import assemble, with_ego
from drivax.scenario.recording import Recording
from drivax.scenario.schema import AgentKind, Scenario
from drivax.synthetic.world import generate_recording
from drivax.tracking.runs import versions

ROOT = Path(__file__).resolve().parent.parent
#: A logged vehicle is taken as ego when it is seen now, for at least this long ahead, and moves at least this far.
SEEN_STEPS, MOVES_M = 41, 2.0


@dataclass(frozen=True)
class Group:
    """Scenarios that are reported together."""

    name: str
    scenarios: list[Scenario]


def moving_vehicles(recording: Recording) -> list[int]:
    """Rows of logged vehicles, ego aside, that can be driven."""
    rows = []
    now, tracks = recording.current_step, recording.tracks
    for row in range(len(tracks.kind)):
        valid = tracks.valid[row]
        ahead = valid[now:]
        unbroken = int(np.argmin(ahead)) if not ahead.all() else len(ahead)
        xy = tracks.xy[row, now : now + unbroken]
        if row == recording.ego or tracks.kind[row] != AgentKind.VEHICLE or unbroken < SEEN_STEPS:
            continue
        if np.linalg.norm(xy[-1] - xy[0]) >= MOVES_M and unbroken == len(ahead):
            rows.append(row)
    return rows


def groups(data: Path | None, world: int) -> list[Group]:
    """The built-in world, and per real file its ego and its other vehicles."""
    found = [Group("built-in world", [assemble(generate_recording(0, i)) for i in range(world)])]
    if data is None:
        return found
    for file in find_files(data)[0]:
        for recording in detect(file).read(file):
            if isinstance(recording, BadRecord):
                raise SystemExit(str(recording.error()))
            name = f"{file.parent.name}/{file.name}"
            found.append(Group(f"{name}: ego", [assemble(recording)]))
            others = [assemble(with_ego(recording, row)) for row in moving_vehicles(recording)]
            if others:
                found.append(Group(f"{name}: other vehicles", others))
    return found


def rows_of(results: Results) -> list[dict[str, object]]:
    """What the audit tells of each episode."""
    steps = results.motion.shape[1] - 1
    return [
        {
            "scenario": results.scenarios[i]["scenario_id"],
            "planner": results.planner,
            "distance_m": round(float(results.metrics["distance"][i]), 2),
            "collision": bool(results.metrics["collision"][i]),
            "offroad_steps": int(results.offroad_steps[i]),
            "steps": steps,
            "red_light": _bool(results.metrics["red_light"][i]),
            "ade_m": round(float(results.metrics["ade"][i]), 3),
            "fde_m": round(float(results.metrics["fde"][i]), 3),
            "accuracy": float(results.metrics["accuracy"][i]),
        }
        for i in range(len(results))
    ]


def _bool(value: float) -> bool | None:
    return bool(value) if np.isfinite(value) else None


def audit(group: Group) -> dict[str, list[dict[str, object]]]:
    """Both experts on a group."""
    loaded = load(group.scenarios)
    planners = ("expert", "expert_actions")
    return {name: rows_of(evaluate(make_planner(name), loaded.bank, loaded.names)) for name in planners}


def table(found: dict[str, dict[str, list[dict[str, object]]]]) -> str:
    """One line per group and planner, then every episode that is not clean."""
    head = "scenarios|planner|n|distance m (median, max)|collisions|off-road steps|red lights|accuracy|"
    head += "FDE m (median, max)"
    lines = [f"| {head.replace('|', ' | ')} |", "|---" * len(head.split("|")) + "|"]
    offenders = []
    for name, planners in found.items():
        for planner, rows in planners.items():
            distance, fde = ([row[key] for row in rows] for key in ("distance_m", "fde_m"))
            total = sum(int(str(row["steps"])) for row in rows)
            off = sum(int(str(row["offroad_steps"])) for row in rows)
            lines.append(
                f"| {name} | {planner} | {len(rows)} | {np.median(distance):.1f}, {max(distance):.1f} | "
                f"{sum(bool(row['collision']) for row in rows)} | {off} of {total} | "
                f"{sum(bool(row['red_light']) for row in rows)} | {np.mean([row['accuracy'] for row in rows]):.3f} | "
                f"{np.median(fde):.2f}, {max(fde):.2f} |"
            )
            offenders += [(name, row) for row in rows if planner == "expert" and row["accuracy"] != 1.0]
    lines += ["", "Exact replays that are not clean:" if offenders else "Every exact replay is clean.", ""]
    for name, row in offenders:
        lines.append(
            f"- {name}, `{row['scenario']}`: collision {row['collision']}, {row['offroad_steps']} steps off the road, "
            f"red light {row['red_light']}, {row['distance_m']} m"
        )
    return "\n".join(lines)


def main() -> int:
    """Audit, print, and store where asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=None)
    parser.add_argument("--world", type=int, default=128)
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    found = {group.name: audit(group) for group in groups(args.data, args.world)}
    text = table(found)
    print(text)
    if args.write:
        result = {
            "command": "python benchmarks/expert_audit.py --data ../shared/data --write",
            "versions": versions(),
        }
        target = ROOT / "benchmarks" / "results" / "expert_audit.json"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(json.dumps(result | {"episodes": found}, indent=1) + "\n")
        page = ROOT / "docs" / "results" / "expert-audit.md"
        head = page.read_text().split("<!-- table -->")[0] if page.exists() else "# The expert audit\n\n"
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text(f"{head}<!-- table -->\n\n{text}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
