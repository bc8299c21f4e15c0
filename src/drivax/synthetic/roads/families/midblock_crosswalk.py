"""A street with places to cross between junctions: crosswalks, some of them unmarked, some with a refuge."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drivax.synthetic.roads.curves import STEP_M, Pose, winding
from drivax.synthetic.roads.draft import Draft
from drivax.synthetic.roads.families.street import Street, cuts, strips
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.roads.style import GRID, RoadStyle

#: Lanes ahead, lanes the other way, and the share of that layout.
_LAYOUTS = ((1, 1, 0.45), (2, 2, 0.25), (2, 1, 0.1), (2, 0, 0.1), (1, 0, 0.1))


@dataclass(frozen=True)
class MidblockCrosswalk:
    """Settings of the family ``midblock_crosswalk``.

    Attributes:
        length_m: Length of the reference line.
        section_m: Lanes are cut into sections of this length.
        tightest_m: Radius of the tightest bend, drawn per road, low and high.
        widest_turn: Largest difference of two headings, rad.
        crossing_m: Where the first crossing is; ego begins 120 to 155 m along the street.
        apart_m: Distance to a second crossing, low and high.
        marked_share: Share of crossings with a crosswalk.
        second_share: Share of streets with two crossings.
        median_share: Share of streets with traffic both ways that have a raised median.
    """

    length_m: float = 560.0
    section_m: float = 80.0
    tightest_m: tuple[float, float] = (90.0, 600.0)
    widest_turn: float = math.radians(60.0)
    crossing_m: tuple[float, float] = (180.0, 250.0)
    apart_m: tuple[float, float] = (60.0, 130.0)
    marked_share: float = 0.75
    second_share: float = 0.5
    median_share: float = 0.25
    name: str = "midblock_crosswalk"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draws a street with sidewalks on both sides and one or two crossings."""
        ahead, back, _ = _LAYOUTS[rng.choice(len(_LAYOUTS), p=[share for *_, share in _LAYOUTS])]
        middle = winding(
            rng,
            self.length_m,
            max_curvature=style.curvature / float(rng.uniform(*self.tightest_m)),
            max_turn=self.widest_turn,
            start=Pose(0.0, 0.0, float(rng.uniform(-math.pi, math.pi))),
        )
        row = float(rng.uniform(2.1, 2.4)) if rng.random() < style.parking_share else 0.0
        sections = cuts(self.length_m, self.section_m)
        street = Street(
            middle=middle,
            cuts=sections,
            strips=strips(ahead, back, len(sections) - 1),
            width_m=float(rng.uniform(*style.width_m)),
            limit_mps=float(rng.choice([limit for limit in style.limits_mps if limit < 17.0])),
            shoulder_m=float(rng.uniform(*style.shoulder_m)),
            median_m=float(rng.uniform(1.8, 3.0)) if back and rng.random() < self.median_share else 0.0,
            rows_m=(row, row if back else 0.0),
        )
        draft = Draft()
        laid = street.lay(draft)
        street.bound(draft)
        street.paint(draft)
        street.walk(draft, rng)
        at = float(rng.uniform(*self.crossing_m))
        places = [at, at + float(rng.uniform(*self.apart_m))] if rng.random() < self.second_share else [at]
        for place in places:
            street.cross(draft, laid, round(place / STEP_M), marked=bool(rng.random() < self.marked_share))
        street.park(draft, laid, (20.0, self.length_m - 20.0), rng)
        return draft.network(self.name, street.starts(draft, laid))
