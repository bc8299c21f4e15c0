"""Draw the most critical scenario of each family of methods, with its components.

Run: python -m experiments.curation.pictures --data SET [--folder docs/guide] [--only kinematic|ensemble|rarity]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drivax.curation.ensemble import EnsembleConfig, train_ensemble
from drivax.curation.logged import score_steps
from drivax.curation.methods import Request, curate, ensemble_table
from drivax.curation.rarity import ExpertActions, KernelRarity, known_actions
from drivax.curation.scores import ScoreTable
from drivax.report.pictures.drawing import draw_on
from drivax.report.pictures.palette import LIGHT, SERIES
from drivax.scenario.schema import DT_S, STEPS
from drivax.scenario.store import ScenarioSet
from experiments.repository import DOCS, save_picture

mpl.use("Agg")

#: Width and height, inches; dots per inch; half the side of the drawn map, m.
SIZE, DPI, REACH_M = (11.0, 4.4), 100, 40.0
#: Draws the plots next to the map, for a scenario (row) at a step.
DrawPlots = Callable[[list[Axes], int, int], None]


def draw_picture(data: ScenarioSet, table: ScoreTable, plots: int, draw_plots: DrawPlots, out: Path) -> None:
    """Draw the most critical scenario at its most critical step, with plots next to it."""
    row = int(table.order[0])
    step = int(table.steps[row].argmax())
    page = Figure(figsize=SIZE, dpi=DPI, facecolor="white", layout="constrained")
    grid = page.add_gridspec(plots, 2, width_ratios=(1, 1.45))
    map_axes, scenario = page.add_subplot(grid[:, 0]), data[row]
    x, y = (float(number) for number in scenario.agent_xy[step, 0])
    draw_on(map_axes, scenario, step, (x, y), REACH_M)
    map_axes.set_title(f"{step * DT_S:.1f} s, score {table.steps[row, step]:.2f}", fontsize=10)
    draw_plots([page.add_subplot(grid[number, 1]) for number in range(plots)], row, step)
    save_picture(page, out)
    print(f"{out.name}: {table.scenario_ids[row]}, step {step}")


def label_time_axis(axes: Axes, step: int, title: str) -> None:
    """Label the time axis in seconds and mark the drawn step."""
    axes.axvline(step * DT_S, color=LIGHT["log"], linewidth=1.0, linestyle=":")
    axes.set(xlabel="s", xlim=(0.0, (STEPS - 1) * DT_S), title=title)
    axes.title.set_fontsize(10)
    axes.spines[["top", "right"]].set_visible(False)


def kinematic(data: ScenarioSet, out: Path) -> None:
    """Plot weighted components over time, and the score."""
    table = curate("kinematic", Request(data))

    def draw_plots(axes: list[Axes], row: int, step: int) -> None:
        valid = np.flatnonzero(table.valid[row])
        components = {
            name: weight * table.components[name][row, valid] for name, weight in _weights(table).items()
        }
        labels = [name.replace("_", " ") for name in components]
        axes[0].stackplot(valid * DT_S, list(components.values()), labels=labels, colors=SERIES)
        axes[0].legend(fontsize=8, frameon=False, loc="upper left")
        axes[0].set_ylim(0.0, 1.0)
        label_time_axis(axes[0], step, "components times their weights: the score of a step is their sum")

    draw_picture(data, table, 1, draw_plots, out)


def _weights(table: ScoreTable) -> dict[str, float]:
    return dict(table.combination.weights)


def ensemble(data: ScenarioSet, out: Path) -> None:
    """Plot the members' predictions, the expert's actions, and the score."""
    ensemble = train_ensemble(EnsembleConfig(), data)
    table, predictions = ensemble_table(ensemble, data), ensemble.predictions(data)

    def draw_plots(axes: list[Axes], row: int, step: int) -> None:
        known = np.flatnonzero(predictions.known[row])
        for number, (name, panel) in enumerate({"acceleration": axes[0], "steering": axes[1]}.items()):
            panel.plot(
                known * DT_S, predictions.action[row, known, :, number], color=LIGHT["ego"], linewidth=0.9
            )
            panel.plot(
                known * DT_S, predictions.expert[row, known, number], color=LIGHT["ink"], linewidth=1.6
            )
            label_time_axis(
                panel,
                step,
                f"{name}: five members, and the expert (black); units of the action space",
            )
        valid = np.flatnonzero(table.valid[row])
        axes[2].fill_between(valid * DT_S, table.steps[row, valid], color=LIGHT["mark"])
        axes[2].set_ylim(0.0, 1.0)
        label_time_axis(axes[2], step, "score, by the variance among them")

    draw_picture(data, table, 3, draw_plots, out)


def rarity(data: ScenarioSet, out: Path) -> None:
    """Plot the density of all actions, and the actions of the scenario."""
    table = curate("action_rarity", Request(data))
    expert = score_steps(data, ExpertActions(), None)
    action, known = np.asarray(expert["action"]), np.asarray(expert["known"])
    ticks = np.linspace(-1.0, 1.0, 201)
    grid = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    kernel = KernelRarity()
    density = kernel.density(kernel.histogram(known_actions(action, known)), grid).reshape(201, 201)

    def draw_plots(axes: list[Axes], row: int, step: int) -> None:
        mesh: Any = axes[0].pcolormesh(ticks, ticks, np.log10(density + 1e-4), cmap="Greys", rasterized=True)
        axes[0].figure.colorbar(mesh, ax=axes[0], label="density of all actions, power of ten")
        scenario_actions = action[row, known[row]]
        axes[0].scatter(*scenario_actions.T, s=14, c=LIGHT["ego"], linewidths=0)
        axes[0].scatter(*action[row, step], s=90, facecolors="none", edgecolors=LIGHT["mark"], linewidths=2.0)
        axes[0].set(xlabel="acceleration", ylabel="steering", title="actions of this scenario and of the set")
        axes[0].title.set_fontsize(10)

    draw_picture(data, table, 1, draw_plots, out)


def main() -> None:
    """Score, draw, and print the drawn scenarios."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = {"kinematic": kinematic, "ensemble": ensemble, "rarity": rarity}
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--folder", type=Path, default=DOCS / "guide")
    parser.add_argument("--only", choices=kinds, default=None)
    args = parser.parse_args()
    data = ScenarioSet.open(args.data)
    for name, draw in kinds.items():
        if args.only in (None, name):
            draw(data, args.folder / f"curation-{name}.png")


if __name__ == "__main__":
    main()
