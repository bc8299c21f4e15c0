"""Draw the built-in world: every family of roads in each domain, and every kind of labelled event.

Draws the first generated scenario of each family or event. An event is drawn at the step at which ego and its actor are
closest, with both paths.

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
from drivax.report.pictures.drawing import road_lines
from drivax.report.pictures.palette import LIGHT
from drivax.report.pictures.still import draw_on
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import CURRENT_STEP, Scenario
from drivax.synthetic.domains import DOMAINS
from drivax.synthetic.events import EventKind
from drivax.synthetic.world import WorldConfig, generate_one
from experiments.repository import DOCS, save_picture
from experiments.world.measures import all_agents

mpl.use("Agg")

#: Tiles in a row, and the side of a tile in inches and dots.
COLUMNS, TILE_IN, DPI = 3, 3.6, 100
#: Half the side of a family's tile, and the least and most of an event's, m.
FAMILY_REACH_M, EVENT_REACH_M = 55.0, (24.0, 45.0)
#: What is this near to ego counts; ego is drawn so far before the place with the most to see, m.
SIGHT_M, BEFORE_M = 35.0, 22.0
#: Scenarios that are looked at in any case, and the most that are kept of one family.
LEAST, AMONG = 80, 5
#: Scenarios that are tried before a picture is given up.
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
    """Return a common scenario of each family: of the first few, the one with the most to see."""
    found: dict[str, list[tuple[float, Tile]]] = {family.name: [] for family, _ in DOMAINS[domain].families}
    for index, scenario in scenarios(domain, seed, 0.0):
        name = scenario.tags["family"]
        if len(found[name]) < AMONG:
            found[name].append((sight(scenario)[0], Tile(name.replace("_", " "), scenario, index)))
        if index >= LEAST and all(found.values()):
            break
    return [max(of, key=lambda pair: pair[0])[1] for of in found.values() if of]


def sight(scenario: Scenario) -> tuple[float, int]:
    """Largest number of map features near ego and its step: road bends (rad), crosswalks, lane ends."""
    layers = road_lines(scenario)
    places, worth = [np.zeros((0, 2))], [np.zeros(0)]
    for line in layers["edge"]:
        way = np.diff(line, axis=0)
        heading = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
        places.append(line[1:-1])
        worth.append(np.abs(np.diff(heading)))
    for line in layers["crosswalk"]:
        places.append(line.mean(axis=0, keepdims=True))
        worth.append(np.ones(1))
    begin, end = (np.array([line[k] for line in layers["lane"]]) for k in (0, -1))
    alone = np.hypot(*np.moveaxis(end[:, None] - begin, -1, 0)).min(axis=1) > 0.5
    places.append(end[alone])
    worth.append(np.full(int(alone.sum()), 2.0))
    steps = np.arange(CURRENT_STEP, int(scenario.steps), 4)
    place, at = np.concatenate(places)[None], scenario.agent_xy[steps, None, 0]
    near = np.hypot(*np.moveaxis(place - at, -1, 0)) < SIGHT_M
    seen = (np.concatenate(worth) * near).sum(axis=1)
    best = int(seen.argmax())
    return float(seen[best]), int(steps[best])


def event_tiles(seed: int) -> list[Tile]:
    """Return the first scenario of each kind of event, alternating between domains."""
    found: dict[str, Tile] = {}
    names = [kind.name.lower() for kind in EventKind if kind]
    # Kinds are drawn from seed and index, so domains with the same seed would show the same ones.
    sources = {domain: scenarios(domain, seed + k, 1.0) for k, domain in enumerate(sorted(DOMAINS))}
    for domain, source in (pair for _ in range(TRIES) for pair in sources.items()):
        index, scenario = next(source)
        name = scenario.tags["event"]
        title = f"{name.replace('_', ' ')} ({domain}, {scenario.tags['severity_mps2']} m/s2)"
        found.setdefault(name, Tile(title, scenario, index))
        if len(found) == len(names):
            break
    return [found[name] for name in names if name in found]


def draw_family(axes: Axes, scenario: Scenario) -> None:
    """Draw the step just before ego reaches the most map features, and ego's log to its end."""
    way = scenario.agent_xy[:, 0].astype(np.float64)
    _, there = sight(scenario)
    left = np.hypot(*(way[: there + 1] - way[there]).T)
    step = int(np.flatnonzero(left <= BEFORE_M)[0])
    draw_on(axes, scenario, step, tuple(way[there]), FAMILY_REACH_M)
    # In a tile of this size the palette's crosswalks would not be seen.
    crossings = road_lines(scenario)["crosswalk"]
    axes.add_collection(PolyCollection(crossings, facecolor=LIGHT["parked"], zorder=0.1))
    axes.plot(*way[step:].T, color=LIGHT["ego"], linewidth=1.0, zorder=4.5)


def draw_event(axes: Axes, scenario: Scenario) -> None:
    """Draw the step at which ego and an actor are closest during the event, with both paths."""
    box, _, valid, _, number = all_agents(scenario)
    actors = scenario.event_actor[0]
    rows = np.flatnonzero(np.isin(number, actors[actors >= 0]))
    first = int(scenario.event_start[0])
    step, actor = nearest(box, valid, rows, first)
    middle = (box[step, 0, :2] + box[step, actor, :2]) / 2
    reach = float(np.clip(np.hypot(*(box[step, 0, :2] - box[step, actor, :2])) * 0.8 + 18.0, *EVENT_REACH_M))
    draw_on(axes, scenario, step, tuple(middle), reach)
    axes.plot(*box[step:, 0, :2].T, color=LIGHT["ego"], linewidth=1.0, zorder=4.5)
    for row in rows:
        there = valid[:, row]
        axes.plot(
            *box[there, row, :2].T, color=LIGHT["mark"], linewidth=1.6, linestyle=(0, (3, 1.5)), zorder=4.6
        )
        if there[step]:
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
        f"{(step - first) * 0.1:+.1f} s",
        transform=axes.transAxes,
        ha="right",
        fontsize=10,
        color=LIGHT["ink"],
    )


def nearest(box: np.ndarray, valid: np.ndarray, rows: np.ndarray, first: int) -> tuple[int, int]:
    """Step and row at which an actor's box is closest to ego's, from the event's first step on."""
    shapes = shapely.polygons(corners(box[first:, [0, *rows]]))
    apart = np.where(valid[first:, rows], shapely.distance(shapes[:, :1], shapes[:, 1:]), np.inf)
    step, column = np.unravel_index(int(apart.argmin()), apart.shape)
    return first + int(step), int(rows[column])


def sheet(tiles: list[Tile], draw: Callable[[Axes, Scenario], None], out: Path) -> None:
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
            sheet(family_tiles(domain, args.seed), draw_family, args.folder / f"world-families-{domain}.png")
    if args.only in (None, "events"):
        sheet(event_tiles(args.seed), draw_event, args.folder / "world-events.png")


if __name__ == "__main__":
    main()
