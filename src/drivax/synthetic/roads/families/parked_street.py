"""A narrow street, one lane each way or one way, with rows of parked cars along one or both sides."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drivax.synthetic.roads.curves import STEP_M, Pose, winding
from drivax.synthetic.roads.draft import Draft
from drivax.synthetic.roads.families.street import Street, cuts, strips
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.roads.style import GRID, RoadStyle


@dataclass(frozen=True)
class ParkedStreet:
    """Settings of the family ``parked_street``.

    Attributes:
        length_m: Length of the reference line.
        section_m: Lanes are cut into sections of this length.
        tightest_m: Radius of the tightest bend, drawn per road, low and high.
        widest_turn: Largest difference of two headings, rad.
        one_way_share: Share of one-way streets.
        both_sides_share: Share of streets with bays on both sides.
        crossing_share: Share of streets with a place to cross, half of them marked.
        row_m: Width of a row of bays, low and high.
    """

    length_m: float = 480.0
    section_m: float = 80.0
    tightest_m: tuple[float, float] = (80.0, 600.0)
    widest_turn: float = math.radians(60.0)
    one_way_share: float = 0.35
    both_sides_share: float = 0.65
    crossing_share: float = 0.5
    row_m: tuple[float, float] = (2.0, 2.4)
    name: str = "parked_street"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draws a street; its limit is one of the two lowest of the style, its lanes are the narrowest."""
        one_way = rng.random() < self.one_way_share
        middle = winding(
            rng,
            self.length_m,
            max_curvature=style.curvature / float(rng.uniform(*self.tightest_m)),
            max_turn=self.widest_turn,
            start=Pose(0.0, 0.0, float(rng.uniform(-math.pi, math.pi))),
        )
        row = float(rng.uniform(*self.row_m))
        sides = (1, 1) if rng.random() < self.both_sides_share else [(1, 0), (0, 1)][int(rng.integers(2))]
        sections, narrowest = cuts(self.length_m, self.section_m), style.width_m[0]
        street = Street(
            middle=middle,
            cuts=sections,
            strips=strips(1, 0 if one_way else 1, len(sections) - 1),
            width_m=float(rng.uniform(narrowest - 0.1, narrowest + 0.2)),
            limit_mps=float(rng.choice(sorted(style.limits_mps)[:2])),
            shoulder_m=float(rng.uniform(0.1, 0.4)),
            rows_m=(row * sides[0], row * sides[1]),
        )
        draft = Draft()
        laid = street.lay(draft)
        street.bound(draft)
        street.paint(draft)
        street.walk(draft, rng)
        if rng.random() < self.crossing_share:
            at = round(float(rng.uniform(170.0, 250.0)) / STEP_M)
            street.cross(draft, laid, at, marked=bool(rng.random() < 0.5))
        street.park(draft, laid, (15.0, self.length_m - 15.0), rng)
        return draft.network(self.name, street.starts(draft, laid))
