"""``drivax curate``: criticality scores of a scenario set."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Curate:
    """Score how critical every scenario and step of a set is.

    kinematic: how soon and how hard the recorded driver had to act (time to collision, required braking).

    Example: drivax curate kinematic --data sets/world --out scores.npz
    """

    method: Annotated[Literal["kinematic"], tyro.conf.Positional, tyro.conf.arg(metavar="METHOD")]
    """How to score: kinematic."""
    data: Path
    """Scenario set."""
    out: Path
    """Table of scores to write."""
    overwrite: bool = False
    """Replace OUT if it is a file."""


def run(args: Curate) -> int:
    """Score, write the table, and say how the scores lie."""
    import numpy as np

    from drivax.curation.kinematic import KinematicConfig, score_kinematic
    from drivax.curation.scores import ScoreTable, refuse_existing, write_scores
    from drivax.scenario.store import ScenarioSet
    from drivax.tracking.progress import Progress

    refuse_existing(args.out, args.overwrite)
    data, config = ScenarioSet.open(args.data), KinematicConfig()
    with Progress("scoring", "scenarios", len(data)) as bar:
        steps = score_kinematic(data, config, lambda done, total: bar.update(done))
    ids = tuple(entry["scenario_id"] for entry in data.entries)
    table = ScoreTable(args.method, asdict(config), data.hash, ids, steps)
    write_scores(table, args.out, args.overwrite)
    low, middle, high, most = np.quantile(table.scenarios, (0.05, 0.5, 0.95, 1.0))
    first = table.scenario_ids[int(table.scenarios.argmax())]
    print(f"{args.out}: {len(table.scenario_ids):,} scenarios, {args.method} criticality")
    print(f"  5 % {low:.3f}, median {middle:.3f}, 95 % {high:.3f}, largest {most:.3f} ({first})")
    return 0
