"""Find the most critical moments of all moving vehicles in real files, by `kinematic`, and draw them.

python -m experiments.curation.moments --data ../shared/data [--write]    (--write stores the result, picture and page)
python -m experiments.curation.moments --table                            (write the stored result to the page)

Every vehicle that is seen at the current step and for 2 s from it on, and ends more than 2 m from where it began, is
the scored agent of its own scenario (`--egos moving` has at most eight per scenario). Of moments of one recording that
are less than 3 s and 30 m apart, the most critical one counts.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from drivax.curation.methods import Request, curate
from drivax.curation.scores import ScoreTable
from drivax.files import write_json
from drivax.report.pictures.drawing import draw_on
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Recording
from drivax.scenario.schema import CAPACITIES, CURRENT_STEP, DT_S, LEAST_STEPS, AgentKind, Scenario
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.tracking.run_folder import versions
from experiments.data.real_files import read_windows
from experiments.learning.tables import table
from experiments.repository import DOCS, RESULTS, fill_places, save_picture

mpl.use("Agg")

RESULT = RESULTS / "critical_moments.json"
PAGE = DOCS / "results" / "critical-moments.md"
PICTURE = PAGE.with_suffix(".png")
MOMENTS, APART_S, APART_M = 10, 3.0, 30.0
#: Least distance between the first and the last position of a moving vehicle, metres.
MOVES_M = 2.0
#: Half the side of a drawn map, metres; columns and rows of the picture.
REACH_M, GRID = 30.0, (5, 2)
#: What a person would say of the pictures and the second and a half before and after, by scenario.
VERDICTS = {
    "a3bb37c25ce56418/52": "worth a look: turns right from a lane for straight on, 4 m from a pedestrian",
    "a3bb37c25ce56418/81": "noise: parked cars overlap, and the box of one turns round and back",
    "scene-0553@80/50": "noise: the speed of a car next to a van jumps from 8 to 4 m/s and back",
    "3b3570b4-7b0b-3268-a571-b0889dbf40b6@0/35": "tight: starts a left turn while a car still passes at 16 m/s",
    "scene-0916_8a26f7d33ff04b1a8c8679f8c4a7da91_048a45dd2cf54aa5808d8ccc85731d44/28": (
        "routine: a bus turns in a yard; it points at standing people, and turns away from them"
    ),
    "3b3570b4-7b0b-3268-a571-b0889dbf40b6@0/51": "tight: a truck turns in between a waiting and a parked car",
    "3b3570b4-7b0b-3268-a571-b0889dbf40b6@40/22": "tight: passes a slower car that drifts towards it, then to the kerb",
    "scene-0553@40/22": "routine: a bus turns left; for a moment it points at the oncoming lane",
    "scene-0553@40/16": "routine: a car turns left at the same place, with a jump of its speed as it appears",
    "db4edc9bd0c9d18c/71": "routine: turns slowly at a stop sign, past a waiting car",
}


def recordings_by_ego(recording: Recording) -> Iterator[Recording]:
    """Yield the recording with each moving vehicle as its ego, where its log suffices."""
    tracks = recording.tracks
    now = recording.current_step
    for row in np.flatnonzero((tracks.kind == AgentKind.VEHICLE) & tracks.valid[:, now]):
        steps = np.flatnonzero(tracks.valid[row])
        moved = np.hypot(*(tracks.xy[row, steps[-1]] - tracks.xy[row, steps[0]]))
        if moved > MOVES_M and np.sum(steps >= now) >= LEAST_STEPS - CURRENT_STEP:
            name = f"{recording.scenario_id}/{tracks.track_id[row]}"
            yield replace(
                recording, ego=int(row), scenario_id=name, route_lanes=(), route_corridor=(), seen=None
            )


def write_set(data: Path, out: Path) -> dict[str, str]:
    """Write a set with a scenario for each moving vehicle; return the file of each scenario by its id."""
    files = {}
    with ScenarioWriter(out, CAPACITIES["default"]) as writer:
        for file, window in read_windows(data):
            for recording in recordings_by_ego(window):
                scenario = assemble(recording)
                writer.add(scenario)
                files[scenario.id] = file
    return files


def most_critical(scores: ScoreTable, data: ScenarioSet) -> Iterator[tuple[int, int]]:
    """Yield row and step of moments that are apart from all earlier ones, the most critical first."""
    earlier: list[tuple[str, float, np.ndarray[Any, Any]]] = []
    for row in map(int, scores.order):
        scenario, step = data[row], int(scores.steps[row].argmax())
        xy = scenario.record["origin"][:2] + scenario.agent_xy[step, 0]
        _, _, start = scenario.id.partition("/")[0].rpartition("@")
        segment, time_s = scenario.text("segment"), ((int(start) if start.isdigit() else 0) + step) * DT_S
        if all(
            segment != other or abs(time_s - other_s) > APART_S or np.hypot(*(xy - other_xy)) > APART_M
            for other, other_s, other_xy in earlier
        ):
            earlier.append((segment, time_s, xy))
            yield row, step


def measure(data: Path) -> tuple[dict[str, Any], Figure]:
    """Return the most critical moments of all vehicles, and their pictures."""
    with tempfile.TemporaryDirectory() as folder:
        files = write_set(data, out := Path(folder, "set"))
        scenarios = ScenarioSet.open(out)
        scores = curate("kinematic", Request(scenarios))
        chosen = list(islice(most_critical(scores, scenarios), MOMENTS))
        weights = scores.combination.weights
        rows = [
            {
                "scenario": scenarios[row].id,
                "source": files[scenarios[row].id].split("/")[0],
                "time_s": round(step * DT_S, 1),
                "scenario_score": round(float(scores.scenarios[row]), 3),
                "step_score": round(float(scores.steps[row, step]), 3),
                "components": {
                    name: round(weight * float(scores.components[name][row, step]), 3)
                    for name, weight in weights.items()
                    if weight
                },
            }
            for row, step in chosen
        ]
        picture = draw([(scenarios[row], step) for row, step in chosen])
    command = "python -m experiments.curation.moments --data ../shared/data --write"
    counts = {
        "files": len(set(files.values())),
        "recordings": len({entry["segment"] for entry in scenarios.entries}),
        "scenarios": len(scenarios),
        "quantiles": _quantiles(scores.scenarios),
    }
    return {"command": command, **counts, "moments": rows, "versions": versions()}, picture


def _quantiles(values: np.ndarray[Any, Any]) -> dict[str, float]:
    shares = {"median": 0.5, "p95": 0.95}
    return {name: round(float(np.quantile(values, share)), 3) for name, share in shares.items()}


def draw(moments: Sequence[tuple[Scenario, int]]) -> Figure:
    """Return a figure with a map of each moment, the scored vehicle in its middle."""
    columns, rows = GRID
    page = Figure(figsize=(2.6 * columns, 2.8 * rows), dpi=100, facecolor="white", layout="constrained")
    for number, (scenario, step) in enumerate(moments, start=1):
        axes = page.add_subplot(rows, columns, number)
        x, y = (float(value) for value in scenario.agent_xy[step, 0])
        draw_on(axes, scenario, step, (x, y), REACH_M)
        axes.set_title(f"{number}", fontsize=10)
    return page


def page_tables(result: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the table of moments, with what a person says of each, and the counts."""
    rows = []
    for number, moment in enumerate(result["moments"], start=1):
        largest = sorted(moment["components"].items(), key=lambda item: -item[1])[:3]
        rows.append(
            [
                f"{number}", f"{moment['source']} `{moment['scenario']}`", f"{moment['time_s']:.1f} s",
                f"{moment['scenario_score']:.2f}",
                ", ".join(f"{name.replace('_', ' ')} {value:.2f}" for name, value in largest if value >= 0.005),
                VERDICTS.get(moment["scenario"], ""),
            ]
        )  # fmt: skip
    quantiles = result["quantiles"]
    counts = (
        f"{result['scenarios']:,} scenarios of moving vehicles from {result['files']} files of "
        f"{result['recordings']} drives; scores: median "
        f"{quantiles['median']:.2f}, 95 % {quantiles['p95']:.2f}."
    )
    head = [
        "",
        "source and scenario/vehicle",
        "at",
        "score",
        "largest components times their weights",
        "what a person would say",
    ]
    return {"counts": [counts], "moments": table(head, rows)}


def main() -> None:
    """Measure, store and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path)
    parser.add_argument("--write", action="store_true", help="store result, picture and page")
    parser.add_argument("--table", action="store_true", help="put what is stored into the page")
    args = parser.parse_args()
    if args.table:
        result = json.loads(RESULT.read_text())
    elif args.data is None:
        parser.error("needs --data FOLDER")
    else:
        result, picture = measure(args.data.resolve())
        print(json.dumps(result, indent=1))
        if args.write:
            write_json(RESULT, result)
            save_picture(picture, PICTURE)
    if args.write or args.table:
        PAGE.write_text(fill_places(PAGE.read_text(), "moments.py", page_tables(result)))


if __name__ == "__main__":
    main()
