"""Compare our metrics and the devkit profile with values of nuPlan's devkit on synthetic scenes.

python -m experiments.data.nuplan --data ../shared/data [--write]     (--write stores the result and the page)
python -m experiments.data.nuplan --table                             (write the stored result to the page)

Every scene becomes a scenario whose logged ego has the scene's motion; the planner `expert` replays it.
"""

from __future__ import annotations

import argparse
import gzip
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drivax.evaluation.runner import evaluate
from drivax.planners.catalogue import make_planner
from drivax.scenario.arrays import scenario_from_arrays
from drivax.scenario.schema import DT_S, Scenario
from experiments.learning.tables import table
from experiments.repository import DOCS, RESULTS

RESULT = RESULTS / "nuplan.json"
PAGE = DOCS / "results" / "nuplan.md"
BEGIN, END = "<!-- nuplan.py: begin -->", "<!-- nuplan.py: end -->"
_WIDTH_M, _BEGIN_M, _JOINT_M, _END_M = 3.7, -150.0, 300.0, 350.0
_CAR_M = (5.176, 2.297, 1.777)
#: Our metric of each of the devkit's terms that do not depend on the logged ego; the first two are 1 minus ours. Not
#: taken from ``evaluation.profiles``, so that the script also runs with sources that lack it.
METRICS = {
    "fault_score": "at_fault_collision", "drivable": "offroad", "ttc_ok": "ttc_ok", "direction": "direction",
    "speed": "speed_compliance", "comfortable": "comfortable",
}  # fmt: skip
#: Largest difference of values that count as equal.
_TOLERANCE = 0.005


def scenario(scene: Mapping[str, Any], name: str) -> Scenario:
    """Return the scene as a scenario: ego has its motion, other agents keep their velocity."""
    rows = np.concatenate([np.array(scene["past"])[:-1], np.array(scene["ego"])])
    time_s = DT_S * (np.arange(len(rows)) - 10)
    agents = scene["agents"]
    velocities = [agent["v"] * np.array([np.cos(agent["h"]), np.sin(agent["h"])]) for agent in agents]
    xy = [
        np.array([agent["x"], agent["y"]]) + time_s[:, None] * other_velocity
        for agent, other_velocity in zip(agents, velocities, strict=True)
    ]
    heading = np.stack([rows[:, 2], *(np.full(len(rows), agent["h"]) for agent in agents)])
    velocity = rows[:, 6:7] * np.stack([np.cos(rows[:, 2]), np.sin(rows[:, 2])], axis=-1)
    lane = {"limit_mps": scene["limit"], "width_m": _WIDTH_M}
    other = [[_BEGIN_M, _WIDTH_M], [_END_M, _WIDTH_M]]
    # In two pieces, so that there is a lane graph.
    lanes = [
        {"points": [[_BEGIN_M, 0.0], [_JOINT_M, 0.0]], "successors": [1], **lane},
        {"points": [[_JOINT_M, 0.0], [_END_M, 0.0]], **lane},
        {"points": other[::-1] if scene["two_way"] else other, **lane},
    ]
    if not scene["two_way"]:
        lanes[0]["left"] = lanes[1]["left"] = [2]
        lanes[2]["right"] = [0, 1]
    half = _WIDTH_M / 2
    edge = [[_BEGIN_M, -half], [_END_M, -half], [_END_M, 3 * half], [_BEGIN_M, 3 * half], [_BEGIN_M, -half]]
    return scenario_from_arrays(
        name,
        {
            "xy": np.stack([rows[:, 4:6], *xy]),
            "heading": heading,
            "velocity": np.stack([velocity, *(np.broadcast_to(v, (len(rows), 2)) for v in velocities)]),
            "valid": np.ones(heading.shape, bool),
            "size": np.array([_CAR_M, *([*agent["size"], 1.5] for agent in agents)]),
            "kind": ["vehicle", *(agent["kind"] for agent in agents)],
        },
        {"lanes": lanes, "edges": [edge]},
        route=[0, 1],
        dataset="nuplan-devkit",
    )


def measure(data: Path) -> dict[str, Any]:
    """Count, for each group, the scenes in which a metric agrees with the devkit."""
    groups = json.loads(gzip.decompress((data / "nuplan_metrics" / "verdicts.json.gz").read_bytes()))
    counts: dict[str, Any] = {}
    for group, scenes in groups.items():
        scenarios = [scenario(scene, f"{group}-{number}") for number, scene in enumerate(scenes)]
        metrics = evaluate(make_planner("expert"), scenarios).metrics
        counts[group] = {"scenes": len(scenes)}
        for name, metric in METRICS.items():
            values = metrics[metric]
            ours = 1.0 - values if name in ("fault_score", "drivable") else values
            theirs = np.array([_verdict(scene["devkit"], name) for scene in scenes])
            counts[group][name] = int((np.abs(ours - theirs) <= _TOLERANCE).sum())
            counts[group][f"{name}_undefined"] = int(np.isnan(ours).sum())
    return counts


def _verdict(devkit: Mapping[str, Any], name: str) -> float:
    return float(devkit["comfort"]["comfortable"] if name == "comfortable" else devkit[name])


def agreement_table(result: Mapping[str, Mapping[str, Mapping[str, int]]]) -> str:
    """Return the counts of every stored state in Markdown."""
    groups = list(next(iter(result.values())))
    heads = ["metric", "ours", *(f"{group}, {state}" for group in groups for state in result)]
    rows = [
        [name, metric] + [_agreement(result[state][group], name) for group in groups for state in result]
        for name, metric in METRICS.items()
    ]
    return "\n".join(table(heads, rows))


def _agreement(counts: Mapping[str, int], name: str) -> str:
    return f"{counts[name]} of {counts['scenes'] - counts[f'{name}_undefined']}"


def main() -> None:
    """Measure, store, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path)
    parser.add_argument("--state", default="now", help="name under which the counts are stored")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--table", action="store_true")
    args = parser.parse_args()
    result = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    if not args.table:
        if args.data is None:
            parser.error("the following arguments are required: --data")
        result[args.state] = measure(args.data)
        print(json.dumps(result[args.state], indent=1))
        if not args.write:
            return
        RESULT.write_text(json.dumps(result, indent=1) + "\n")
    before, rest = PAGE.read_text().split(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}\n\n{agreement_table(result)}\n\n{END}{rest.split(END)[1]}")


if __name__ == "__main__":
    main()
