"""A winding or nearly straight road with one to three lanes ahead and none to two the other way."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drivax.synthetic.roads.curves import Pose, winding
from drivax.synthetic.roads.draft import Draft
from drivax.synthetic.roads.families.street import Street, cuts, strips
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.roads.style import GRID, RoadStyle

#: Above this limit nobody parks beside the lanes, m/s.
_PARKING_LIMIT_MPS = 14.0


@dataclass(frozen=True)
class CurvedRoad:
    """Settings of the families ``curved_road`` and ``straight_road``.

    Attributes:
        length_m: Length of the reference line.
        section_m: Lanes are cut into sections of this length, all at the same stations.
        tightest_m: Radius of the tightest bend of the reference line, drawn per road, low and high.
        widest_turn: Largest difference of two headings, rad.
        layouts: Lanes ahead, lanes the other way, and the share of that layout.
        median_share: Share of roads with traffic both ways that have a raised median.
    """

    length_m: float = 640.0
    section_m: float = 80.0
    tightest_m: tuple[float, float] = (30.0, 140.0)
    widest_turn: float = math.radians(150.0)
    layouts: tuple[tuple[int, int, float], ...] = (
        (1, 1, 0.28),
        (2, 0, 0.16),
        (2, 1, 0.12),
        (2, 2, 0.24),
        (3, 0, 0.1),
        (3, 1, 0.1),
    )
    median_share: float = 0.3
    name: str = "curved_road"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draws a road; ego may begin in the second section of any lane ahead."""
        ahead, back, _ = self.layouts[rng.choice(len(self.layouts), p=[share for *_, share in self.layouts])]
        middle = winding(
            rng,
            self.length_m,
            max_curvature=style.curvature / float(rng.uniform(*self.tightest_m)),
            max_turn=self.widest_turn,
            start=Pose(0.0, 0.0, float(rng.uniform(-math.pi, math.pi))),
        )
        limit = float(rng.choice(style.limits_mps))
        parking = limit < _PARKING_LIMIT_MPS and rng.random() < style.parking_share
        row = float(rng.uniform(2.1, 2.4)) if parking else 0.0
        sections = cuts(self.length_m, self.section_m)
        street = Street(
            middle=middle,
            cuts=sections,
            strips=strips(ahead, back, len(sections) - 1),
            width_m=float(rng.uniform(*style.width_m)),
            limit_mps=limit,
            shoulder_m=float(rng.uniform(*style.shoulder_m)),
            median_m=float(rng.uniform(1.5, 3.0)) if back and rng.random() < self.median_share else 0.0,
            rows_m=(row, row if back else 0.0),
        )
        draft = Draft()
        laid = street.lay(draft)
        street.bound(draft)
        street.paint(draft)
        if rng.random() < style.walk_share:
            street.walk(draft, rng)
        street.park(draft, laid, (20.0, self.length_m - 20.0), rng)
        return draft.network(self.name, street.starts(draft, laid))


#: The family ``straight_road``: many lanes, hardly a bend.
STRAIGHT_ROAD = CurvedRoad(
    tightest_m=(500.0, 5000.0),
    widest_turn=math.radians(25.0),
    layouts=((1, 1, 0.2), (2, 2, 0.3), (3, 3, 0.15), (2, 0, 0.1), (3, 0, 0.1), (4, 0, 0.05), (3, 2, 0.1)),
    name="straight_road",
)
