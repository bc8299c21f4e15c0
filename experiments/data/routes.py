"""Measure how well candidate routes cover logs in real files, with every moving logged vehicle as ego.

A candidate covers the log if it stays within 1.5 m of it for 95 % of its steps. Otherwise the table shows the share of
steps at which any lane of its direction is within 1.5 m of the log: the upper bound for routes along lanes.

    python -m experiments.data.routes --data ../shared/data [--routes published] [--pictures FOLDER] [--write]

``--pictures`` draws every log with a route that no candidate covers; ``--write`` stores
experiments/results/routes_graph.json (or routes_published.json).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.datasets.formats import detect, survey
from drivax.datasets.reader import BadRecord
from drivax.geometry.polylines import point_to_segment, project
from drivax.geometry.vectors import wrap
from drivax.scenario.build.assemble import assemble
from drivax.scenario.build.routes import RouteStyle
from drivax.scenario.recording import Recording, windows, with_ego
from drivax.scenario.schema import AgentKind, Flag, Scenario
from drivax.synthetic.world import generate_recording
from drivax.tracking.run_folder import versions
from experiments.repository import RESULTS

Array = np.ndarray[Any, Any]

#: Row of the route to the goal, and of the log's own route (privileged).
GOAL_ROW, LOG_ROW = 0, 1
#: A candidate covers the log when it stays this near to it, for this share of the steps.
REACH_M, SHARE = 1.5, 0.95
SAME_WAY_RAD = np.deg2rad(60.0)


def coverage(scenario: Scenario, reach_m: float = REACH_M) -> Float[Array, " route"]:
    """Share of the log's valid steps within reach of each route; 0 for empty rows.

    Distances are from the ego's centre to the route's line, in the plane, at every valid step of the log.
    """
    log = scenario.agent_xy[scenario.agent_valid[:, 0], 0].astype(np.float64)
    share = np.zeros(scenario.capacity.routes)
    for row, points in enumerate(scenario.route_points):
        if points >= 2:
            _, distance = project(scenario.route_xy[row, :points].astype(np.float64), log)
            share[row] = float((distance <= reach_m).mean())
    return share


def candidate_coverage(scenario: Scenario) -> float:
    """Largest coverage of a candidate, that is of a route that does not come from the log."""
    of_log = [LOG_ROW] if Flag.ROUTE in scenario.has else [GOAL_ROW, LOG_ROW]
    return float(np.delete(coverage(scenario), of_log).max(initial=0.0))


def lane_coverage(scenario: Scenario, reach_m: float = REACH_M) -> float:
    """Share of the log's valid steps within reach of any car lane that runs within 60 degrees of ego's heading.

    Where a log drives between lanes or cuts a corner, no route along lanes covers more of it than about this.
    """
    begin, end = scenario.segment_blocks[1:3]
    if begin == end:
        return 0.0
    valid = scenario.agent_valid[:, 0]
    log, heading = scenario.agent_xy[valid, 0].astype(np.float64), scenario.agent_heading[valid, 0]
    a, b = (x[begin:end, :2].astype(np.float64) for x in (scenario.segment_a, scenario.segment_b))
    distance, _ = point_to_segment(log[:, None], a[None], b[None])
    turn = np.abs(wrap(np.arctan2(b[:, 1] - a[:, 1], b[:, 0] - a[:, 0]) - heading[:, None]))
    return float((np.where(turn <= SAME_WAY_RAD, distance, np.inf).min(axis=1) <= reach_m).mean())


@dataclass(frozen=True)
class Row:
    """One vehicle as ego.

    Attributes:
        source: The file.
        scenario_id: The scenario.
        ego: Whether it is the ego of the source.
        lane_graph: ``given``, ``chained`` or ``none``.
        routed: Whether a route along lanes reaches its goal.
        goal: Share of steps within 1.5 m of the route to the goal.
        candidate: The same of the best candidate.
        lanes: The same of the nearest lane of its direction at each step.
    """

    source: str
    scenario_id: str
    ego: bool
    lane_graph: str
    routed: bool
    goal: float
    candidate: float
    lanes: float

    @property
    def covered(self) -> bool:
        """Whether a candidate covers the log."""
        return self.candidate >= SHARE


def movers(recording: Recording, style: RouteStyle) -> Iterator[tuple[Scenario, bool]]:
    """Yield every vehicle that is valid now and drives 5 m or more as ego; flag the source's ego."""
    tracks = recording.tracks
    is_vehicle = (tracks.kind == AgentKind.VEHICLE) & tracks.valid[:, recording.current_step]
    for row in np.flatnonzero(is_vehicle):
        scenario = assemble(with_ego(recording, int(row)), routes=style)
        if scenario.tags["moves"] == "yes":
            yield scenario, int(row) == recording.ego


def recordings(data: Path | None, world: int) -> Iterator[tuple[str, Recording]]:
    """Yield windows of the built-in world and of all real files."""
    for index in range(world):
        yield "built-in world", generate_recording(0, index)
    for file in survey(data).paths() if data else ():
        for recording in detect(file).read(file):
            if isinstance(recording, BadRecord):
                raise SystemExit(str(recording.error()))
            for window in windows(recording):
                yield f"{file.parent.name}/{file.name}", window


def measure(source: str, scenario: Scenario, ego: bool) -> Row:
    """Return the row of one scenario."""
    return Row(
        source=source,
        scenario_id=scenario.id,
        ego=ego,
        lane_graph=scenario.tags["lane_graph"],
        routed=Flag.ROUTE in scenario.has,
        goal=float(coverage(scenario)[GOAL_ROW]),
        candidate=candidate_coverage(scenario),
        lanes=lane_coverage(scenario),
    )


def draw(scenario: Scenario, row: Row, folder: Path) -> None:
    """Draw the log (dots), the route to the goal, the other candidates, lanes and road edges."""
    import matplotlib.pyplot as plt

    blocks = scenario.segment_blocks
    figure, axes = plt.subplots(figsize=(9, 9))
    for block, colour in ((0, "black"), (1, "0.75")):
        part = slice(blocks[block], blocks[block + 1])
        ends = np.stack((scenario.segment_a[part, :2], scenario.segment_b[part, :2]), axis=1)
        axes.plot(*np.moveaxis(ends, 0, 2).transpose(1, 0, 2), color=colour, linewidth=0.7)
    for number, points in enumerate(scenario.route_points):
        if points and number != LOG_ROW:
            colour, width = ("red", 2.0) if number == GOAL_ROW else (None, 0.8)
            axes.plot(*scenario.route_xy[number, :points].T, color=colour, linewidth=width)
    log = scenario.agent_xy[scenario.agent_valid[:, 0], 0]
    axes.plot(*log.T, ".", color="green", markersize=4)
    axes.plot(0, 0, "*", color="purple", markersize=12)
    axes.set(
        xlim=(log[:, 0].min() - 20, log[:, 0].max() + 20), ylim=(log[:, 1].min() - 20, log[:, 1].max() + 20)
    )
    axes.set(aspect="equal", title=f"{row.scenario_id}: candidate {row.candidate:.0%}, lanes {row.lanes:.0%}")
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / f"{row.scenario_id.replace('#', '-')}.png", dpi=70)
    plt.close(figure)


def table(rows: list[Row]) -> str:
    """Table by source: logs, logs with a route to the goal, covered logs, logs coverable by lanes."""
    lines = [
        "| source | lane graph | logs | with a route | covered | coverable by lanes | source's ego |",
        "|---|---|---|---|---|---|---|",
    ]
    for source in dict.fromkeys(row.source for row in rows):
        logs = [row for row in rows if row.source == source]
        ego_shares = [f"{row.candidate:.0%}" for row in logs if row.ego and source != "built-in world"]
        counts = [sum(x) for x in zip(*((r.routed, r.covered, r.lanes >= SHARE) for r in logs), strict=True)]
        cells = [source, logs[0].lane_graph, len(logs), *counts, ", ".join(ego_shares) or "-"]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def main() -> None:
    """Measure, print, draw or store."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path)
    parser.add_argument("--world", type=int, default=20)
    parser.add_argument("--routes", choices=("graph", "published"), default="graph")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    rows = []
    for source, recording in recordings(options.data, options.world):
        for scenario, ego in movers(recording, options.routes):
            rows.append(row := measure(source, scenario, ego))
            if options.pictures and row.routed and not row.covered:
                draw(scenario, row, options.pictures)
    print(table(rows))
    for row in rows:
        if row.routed and not row.covered:
            print(f"{row.source} {row.scenario_id}: candidate {row.candidate:.0%}, any lane {row.lanes:.0%}")
    if options.write:
        uncovered = [asdict(row) for row in rows if row.routed and not row.covered]
        result = {"versions": versions(), "table": table(rows).splitlines(), "uncovered": uncovered}
        file = RESULTS / f"routes_{options.routes}.json"
        file.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
