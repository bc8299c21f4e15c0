"""Draw the built-in world: every family of roads in each domain, and every kind of labelled event.

Draws, among the first common scenarios of each family, the one with the most map features, and the first scenario of
each kind of event, at the step at which ego and its actor are closest, with both paths.

Run: python -m experiments.world.pictures [--seed 0] [--folder docs/guide] [--only grid|ring|events]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from drivax.errors import UsageError
from drivax.geometry.boxes import corners
from drivax.report.pictures.drawing import draw_on, road_lines
from drivax.report.pictures.palette import LIGHT
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import CURRENT_STEP, DT_S, Scenario
from drivax.synthetic.domains import DOMAINS
from drivax.synthetic.events import EventKind
from drivax.synthetic.world import WorldConfig, generate_one
from experiments.repository import DOCS, save_picture
from experiments.world.measures import all_agents

mpl.use("Agg")

#: Tiles in a row, and the side of a tile in inches and dots.
COLUMNS, TILE_IN, DPI = 3, 3.6, 100
#: Half the side of a family's tile, and its minimum and maximum for an event's tile, m.
FAMILY_REACH_M, EVENT_REACH_M = 55.0, (24.0, 45.0)
#: Radius of the counted features around ego, and distance of the drawn ego from the best place, m.
SIGHT_M, LEAD_M = 35.0, 22.0
#: Minimum number of scenarios to generate, and maximum number of candidates per family.
MIN_SCENARIOS, MAX_CANDIDATES = 80, 5
#: Maximum number of scenarios to generate for a picture.
TRIES = 600


@dataclass(frozen=True)
class Tile:
    """A scenario, its title, and its index in the seed."""

    title: str
    scenario: Scenario
    index: int


def scenarios(domain: str, seed: int, rare_rate: float) -> Iterator[tuple[int, Scenario]]:
    """Yield scenarios of a domain with their indices, one per map."""
    config = replace(WorldConfig(), domain=domain, rare_rate=rare_rate, scenarios_per_map=1)
    for index in range(TRIES):
        try:
            yield index, assemble(generate_one(seed, index, config).recording)
        except UsageError as error:
            print(f"left out: {error}")


def family_tiles(domain: str, seed: int) -> list[Tile]:
    """Return a common scenario of each family: among the first few, the one with the most map features."""
    candidates: dict[str, list[tuple[float, Tile]]] = {
        family.name: [] for family, _ in DOMAINS[domain].families
    }
    for index, scenario in scenarios(domain, seed, 0.0):
        name = scenario.tags["family"]
        if len(candidates[name]) < MAX_CANDIDATES:
            candidates[name].append(
                (feature_score(scenario)[0], Tile(name.replace("_", " "), scenario, index))
            )
        if index >= MIN_SCENARIOS and all(candidates.values()):
            break
    return [max(tiles, key=lambda pair: pair[0])[1] for tiles in candidates.values() if tiles]


def feature_score(scenario: Scenario) -> tuple[float, int]:
    """Return the largest score of map features near ego, and its step: road bends (rad), crosswalks, lane ends."""
    layers = road_lines(scenario)
    features, weights = [np.zeros((0, 2))], [np.zeros(0)]
    for line in layers["edge"]:
        steps_xy = np.diff(line, axis=0)
        heading = np.unwrap(np.arctan2(steps_xy[:, 1], steps_xy[:, 0]))
        features.append(line[1:-1])
        weights.append(np.abs(np.diff(heading)))
    for line in layers["crosswalk"]:
        features.append(line.mean(axis=0, keepdims=True))
        weights.append(np.ones(1))
    starts, ends = (np.array([line[k] for line in layers["lane"]]) for k in (0, -1))
    is_end = np.hypot(*np.moveaxis(ends[:, None] - starts, -1, 0)).min(axis=1) > 0.5
    features.append(ends[is_end])
    weights.append(np.full(int(is_end.sum()), 2.0))
    steps = np.arange(CURRENT_STEP, int(scenario.steps), 4)
    feature_xy, ego_xy = np.concatenate(features)[None], scenario.agent_xy[steps, None, 0]
    near = np.hypot(*np.moveaxis(feature_xy - ego_xy, -1, 0)) < SIGHT_M
    score = (np.concatenate(weights) * near).sum(axis=1)
    best = int(score.argmax())
    return float(score[best]), int(steps[best])


def event_tiles(seed: int) -> list[Tile]:
    """Return the first scenario of each kind of event, alternating between domains."""
    tiles: dict[str, Tile] = {}
    names = [kind.name.lower() for kind in EventKind if kind]
    # Kinds depend on seed and index: domains with the same seed would show the same kinds.
    sources = {domain: scenarios(domain, seed + k, 1.0) for k, domain in enumerate(sorted(DOMAINS))}
    for domain, source in (pair for _ in range(TRIES) for pair in sources.items()):
        index, scenario = next(source)
        name = scenario.tags["event"]
        title = f"{name.replace('_', ' ')} ({domain}, {scenario.tags['severity_mps2']} m/s2)"
        tiles.setdefault(name, Tile(title, scenario, index))
        if len(tiles) == len(names):
            break
    return [tiles[name] for name in names if name in tiles]


def draw_family(axes: Axes, scenario: Scenario) -> None:
    """Draw the step just before ego reaches the most map features, and ego's log to its end."""
    path = scenario.agent_xy[:, 0].astype(np.float64)
    _, best_step = feature_score(scenario)
    distance = np.hypot(*(path[: best_step + 1] - path[best_step]).T)
    step = int(np.flatnonzero(distance <= LEAD_M)[0])
    draw_on(axes, scenario, step, tuple(path[best_step]), FAMILY_REACH_M)
    # The palette's colour of crosswalks is too faint in a tile of this size.
    crossings = road_lines(scenario)["crosswalk"]
    axes.add_collection(PolyCollection(crossings, facecolor=LIGHT["parked"], zorder=0.1))
    axes.plot(*path[step:].T, color=LIGHT["ego"], linewidth=1.0, zorder=4.5)


def draw_event(axes: Axes, scenario: Scenario) -> None:
    """Draw the step at which ego and an actor are closest during the event, with both paths."""
    box, _, valid, _, ids = all_agents(scenario)
    actors = scenario.event_actor[0]
    rows = np.flatnonzero(np.isin(ids, actors[actors >= 0]))
    first = int(scenario.event_start[0])
    step, actor = nearest(box, valid, rows, first)
    middle = (box[step, 0, :2] + box[step, actor, :2]) / 2
    reach = float(np.clip(np.hypot(*(box[step, 0, :2] - box[step, actor, :2])) * 0.8 + 18.0, *EVENT_REACH_M))
    draw_on(axes, scenario, step, tuple(middle), reach)
    axes.plot(*box[step:, 0, :2].T, color=LIGHT["ego"], linewidth=1.0, zorder=4.5)
    for row in rows:
        present = valid[:, row]
        axes.plot(
            *box[present, row, :2].T, color=LIGHT["mark"], linewidth=1.6, linestyle=(0, (3, 1.5)), zorder=4.6
        )
        if present[step]:
            axes.add_patch(
                Polygon(
                    corners(box[step, row]),
                    closed=True,
                    facecolor=LIGHT["mark"],
                    edgecolor=LIGHT["ink"],
                    zorder=6,
                )
            )
    axes.text(
        0.97,
        0.03,
        f"{(step - first) * DT_S:+.1f} s",
        transform=axes.transAxes,
        ha="right",
        fontsize=10,
        color=LIGHT["ink"],
    )


def nearest(box: np.ndarray, valid: np.ndarray, rows: np.ndarray, first: int) -> tuple[int, int]:
    """Return the step and row where an actor's box is closest to ego's, from the event's first step on."""
    shapes = shapely.polygons(corners(box[first:, [0, *rows]]))
    distance = np.where(valid[first:, rows], shapely.distance(shapes[:, :1], shapes[:, 1:]), np.inf)
    step, column = np.unravel_index(int(distance.argmin()), distance.shape)
    return first + int(step), int(rows[column])


def draw_sheet(tiles: list[Tile], draw: Callable[[Axes, Scenario], None], out: Path) -> None:
    """Draw all tiles on one page."""
    rows = -(-len(tiles) // COLUMNS)
    page = Figure(
        figsize=(COLUMNS * TILE_IN, rows * (TILE_IN + 0.3)), dpi=DPI, facecolor="white", layout="constrained"
    )
    axes = page.subplots(rows, COLUMNS, squeeze=False).flat
    for tile, axis in zip(tiles, axes, strict=False):
        draw(axis, tile.scenario)
        axis.set_title(tile.title, fontsize=12, color=LIGHT["ink"])
        print(f"{out.stem}: {tile.title}: {tile.scenario.scenario_id.item().decode()}")
    for axis in list(axes):
        axis.set_axis_off()
    save_picture(page, out)


def main() -> None:
    """Generate, draw, and print the drawn scenarios."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=DOCS / "guide")
    parser.add_argument("--only", choices=(*sorted(DOMAINS), "events"), default=None)
    args = parser.parse_args()
    for domain in sorted(DOMAINS):
        if args.only in (None, domain):
            draw_sheet(
                family_tiles(domain, args.seed), draw_family, args.folder / f"world-families-{domain}.png"
            )
    if args.only in (None, "events"):
        draw_sheet(event_tiles(args.seed), draw_event, args.folder / "world-events.png")


if __name__ == "__main__":
    main()
