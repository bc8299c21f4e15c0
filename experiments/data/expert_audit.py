"""Audit the expert: its violations reveal defects of map, converter or metric.

Replays logs exactly (``expert``) and through the dynamics (``expert_actions``) on the built-in world and on every real
file: every window, with the source's ego and with every moving logged vehicle as ego. Steps without the ego in the log
are skipped. An off-road step is "contradicted" if every corner is on the drivable side of its nearest edge, however
far.

    python -m experiments.data.expert_audit --data ../shared/data [--write] [--pictures FOLDER]

``--write`` stores docs/results/expert-audit.md and experiments/results/expert_audit.json; ``--pictures`` draws the
first violation of every exact replay.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from drivax.datasets.formats import detect, survey
from drivax.datasets.reader import BadRecord
from drivax.evaluation.audit import BATCH, replay
from drivax.geometry.boxes import corners
from drivax.scenario.bank.queries import LEVEL_M, OFFROAD_TOLERANCE_M
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Recording, windows, with_ego
from drivax.scenario.schema import CURRENT_STEP, AgentKind, Flag, Scenario
from drivax.synthetic.world import generate_recording
from drivax.tracking.run_folder import versions
from experiments.repository import DOCS, RESULTS

RESULT = RESULTS / "expert_audit.json"
PAGE = DOCS / "results" / "expert-audit.md"
COMMAND = "python -m experiments.data.expert_audit --data ../shared/data --write"
#: A logged vehicle is taken as ego if it is valid for this many steps from now on, and moves this far meanwhile, m.
VALID_STEPS, MOVES_M = 21, 2.0
PLANNERS = ("expert", "expert_actions")
HEAD = (
    "scenarios", "planner", "n", "distance m (median, max)", "collisions", "off-road steps", "contradicted",
    "steps off the map",
    "red lights", "mean divergence m (median, max)", "divergence at the end m (median, max)",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A scenario and its line in the table."""

    group: str
    scenario: Scenario


def moving_vehicles(recording: Recording) -> list[int]:
    """Rows of logged vehicles, without ego, that are valid at the current step and move."""
    now, tracks = recording.current_step, recording.tracks
    rows = []
    for row in np.flatnonzero((tracks.kind == AgentKind.VEHICLE) & tracks.valid[:, now]):
        ahead = tracks.valid[row, now:]
        steps = len(ahead) if ahead.all() else int(np.argmin(ahead))
        xy = tracks.xy[row, now : now + steps]
        moved = np.hypot(*np.diff(xy, axis=0).T).sum() if steps >= VALID_STEPS else 0.0
        if row != recording.ego and moved >= MOVES_M and np.hypot(*(xy[-1] - xy[0])) >= MOVES_M:
            rows.append(int(row))
    return rows


def cases(data: Path | None, world: int) -> Iterator[Case]:
    """Yield the built-in world, then every window of every file with its ego and its other vehicles."""
    for index in range(world):
        yield Case("built-in world: ego", assemble(generate_recording(0, index)))
    if data is None:
        return
    for file in survey(data).paths():
        for recording in detect(file).read(file):
            if isinstance(recording, BadRecord):
                raise SystemExit(str(recording.error()))
            name = f"{file.relative_to(data).parts[0]}/{file.name}" if data != file else file.name
            for window in windows(recording):
                yield Case(f"{name}: ego", assemble(window))
                for row in moving_vehicles(window):
                    yield Case(f"{name}: others", assemble(with_ego(window, row)))


def rows_of(batch: list[Case], planner: str) -> list[dict[str, Any]]:
    """Return the audit of each case of a batch, padded so that one program serves all batches."""
    filled = [case.scenario for case in batch] + [batch[-1].scenario] * (BATCH - len(batch))
    bank = ScenarioBank.from_scenarios(filled, trim=False)
    facts = {name: np.asarray(v) for name, v in replay(bank, jnp.arange(BATCH), planner != "expert").items()}
    return [
        _row(case, planner, {name: values[index] for name, values in facts.items()})
        for index, case in enumerate(batch)
    ]


def _row(case: Case, planner: str, facts: Mapping[str, np.ndarray]) -> dict[str, Any]:
    counted = facts["logged"].copy()
    counted[0] = False
    names = ("collision", "offroad", "left_map", "red_light")
    violations = {name: facts[name] & counted for name in names}
    divergence = facts["log_divergence_m"][counted]
    offroad_steps = CURRENT_STEP + np.flatnonzero(violations["offroad"])
    contradicted = sum(nearest_edges_say_on_road(case.scenario, int(step)) for step in offroad_steps)
    has_lights = Flag.LIGHTS in case.scenario.has
    return {
        "group": case.group,
        "scenario": case.scenario.id,
        "planner": planner,
        "steps": int(counted.sum()),
        "distance_m": round(float(facts["moved_m"][counted].sum()), 2),
        "collision_step": _first(violations["collision"]),
        "offroad_steps": int(violations["offroad"].sum()),
        "contradicted_steps": contradicted if planner == "expert" else None,
        "first_offroad_step": _first(violations["offroad"]),
        "left_map_steps": int(violations["left_map"].sum()),
        "red_light_step": _first(violations["red_light"]) if has_lights else None,
        "mean_divergence_m": round(float(divergence.mean()), 3) if len(divergence) else None,
        "final_divergence_m": round(float(divergence[-1]), 3) if len(divergence) else None,
    }


def nearest_edges_say_on_road(scenario: Scenario, step: int) -> bool:
    """Whether every corner of the logged ego is on the drivable side of its nearest stored edge, however far.

    A second check of an off-road step, by brute force over all edges of the ego's level and without grid, cut-off and
    lanes. A corner right of its nearest edge by up to 0.3 m still counts as on the road.
    """
    count = int(scenario.segment_blocks[1])
    a, b = (scenario.record[name][:count].astype(np.float64) for name in ("segment_a", "segment_b"))
    ground = scenario.agent_z[step, 0] - scenario.agent_size[0, 2] / 2
    level = np.abs((a[:, 2] + b[:, 2]) / 2 - ground) <= LEVEL_M
    a, b = a[level, :2], b[level, :2]
    if not len(a):
        return False
    heading = float(scenario.agent_heading[step, 0])
    box = np.array(
        [*scenario.agent_xy[step, 0], np.cos(heading), np.sin(heading), *scenario.agent_size[0, :2]]
    )
    points = np.asarray(corners(jnp.asarray(box)))
    return all(_left_of_nearest(point, a, b) >= -OFFROAD_TOLERANCE_M for point in points)


def _left_of_nearest(point: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Signed distance of a point to the nearest segment, m, positive on its left."""
    along, from_a = b - a, point - a
    squared = np.maximum((along**2).sum(1), 1e-12)
    share = np.clip((along * from_a).sum(1) / squared, 0.0, 1.0)
    distance = np.hypot(*(from_a - share[:, None] * along).T)
    left = (along[:, 0] * from_a[:, 1] - along[:, 1] * from_a[:, 0]) / np.sqrt(squared)
    tied = np.flatnonzero(distance <= distance.min() + 1e-3)
    clearest = tied[np.abs(left[tied]).argmax()]
    return float(np.copysign(distance[clearest], left[clearest]))


def _first(holds: np.ndarray) -> int | None:
    return CURRENT_STEP + int(holds.argmax()) if holds.any() else None


def is_clean(row: Mapping[str, Any]) -> bool:
    """Whether there is no collision, off-road step or red light."""
    return row["collision_step"] is None and row["offroad_steps"] == 0 and row["red_light_step"] is None


def table(rows: list[dict[str, Any]]) -> str:
    """Table with one line per group and planner."""
    lines = [f"| {' | '.join(HEAD)} |", "|---" * len(HEAD) + "|"]
    for group in dict.fromkeys(row["group"] for row in rows):
        for planner in PLANNERS:
            group_rows = [row for row in rows if (row["group"], row["planner"]) == (group, planner)]
            cells = (
                group,
                planner,
                len(group_rows),
                _median_and_max(group_rows, "distance_m", 1),
                sum(row["collision_step"] is not None for row in group_rows),
                f"{sum(row['offroad_steps'] for row in group_rows)} of {sum(row['steps'] for row in group_rows)}",
                sum(row["contradicted_steps"] for row in group_rows) if planner == "expert" else "",
                sum(row["left_map_steps"] for row in group_rows),
                sum(row["red_light_step"] is not None for row in group_rows),
                _median_and_max(group_rows, "mean_divergence_m", 2),
                _median_and_max(group_rows, "final_divergence_m", 2),
            )
            lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def _median_and_max(rows: list[dict[str, Any]], name: str, digits: int) -> str:
    values = [row[name] for row in rows if row[name] is not None]
    return f"{np.median(values):.{digits}f}, {max(values):.{digits}f}" if values else "–"


def offenders(rows: list[dict[str, Any]]) -> str:
    """Table of exact replays with a violation."""
    violations = [row for row in rows if row["planner"] == "expert" and not is_clean(row)]
    if not violations:
        return "Every exact replay is clean."
    lines = [
        "Exact replays that are not clean:",
        "",
        "| scenarios | scenario | what | distance m |",
        "|---" * 4 + "|",
    ]
    for row in violations:
        what = []
        if row["collision_step"] is not None:
            what.append(f"collides at step {row['collision_step']}")
        if row["offroad_steps"]:
            what.append(
                f"{row['offroad_steps']} of {row['steps']} steps off the road from {row['first_offroad_step']}"
            )
        if row["red_light_step"] is not None:
            what.append(f"red light at step {row['red_light_step']}")
        lines.append(f"| {row['group']} | `{row['scenario']}` | {'; '.join(what)} | {row['distance_m']} |")
    return "\n".join(lines)


def draw(row: Mapping[str, Any], scenario: Scenario, folder: Path) -> None:
    """Draw a violation at its first step."""
    from drivax.report.pictures.drawing import draw_scenario

    steps = [row[name] for name in ("collision_step", "first_offroad_step", "red_light_step")]
    step = min(step for step in steps if step is not None)
    name = f"{row['scenario']}-{step}".replace("/", "_")
    draw_scenario(scenario, step, reach_m=40.0).savefig(folder / f"{name}.png")


def main() -> int:
    """Audit, print, and store on request."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=None)
    parser.add_argument("--world", type=int, default=128)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--pictures", type=Path, default=None)
    args = parser.parse_args()
    begin, rows, batch = time.monotonic(), [], []
    if args.pictures is not None:
        args.pictures.mkdir(parents=True, exist_ok=True)

    def finish() -> None:
        for planner in PLANNERS:
            batch_rows = rows_of(batch, planner)
            rows.extend(batch_rows)
            if planner == "expert" and args.pictures is not None:
                for row, case in zip(batch_rows, batch, strict=True):
                    if not is_clean(row):
                        draw(row, case.scenario, args.pictures)
        seconds = time.monotonic() - begin
        print(f"{len(rows) // 2} scenarios in {seconds:.0f} s, now {batch[-1].group}", file=sys.stderr)
        batch.clear()

    for case in cases(args.data, args.world):
        batch.append(case)
        if len(batch) == BATCH:
            finish()
    if batch:
        finish()
    text = f"{table(rows)}\n\n{offenders(rows)}\n"
    print(text)
    if args.write:
        about = {"command": COMMAND, "versions": versions(), "columns": list(rows[0])}
        lines = ",\n".join(f"  {json.dumps(list(row.values()))}" for row in rows)
        RESULT.write_text(f'{json.dumps(about, indent=1)[:-2]},\n "episodes": [\n{lines}\n ]\n}}\n')
        PAGE.write_text(f"{PAGE.read_text().split('<!-- table -->')[0]}<!-- table -->\n\n{text}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
