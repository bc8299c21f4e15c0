"""A T-junction: a road with priority, and a stem with a stop or a yield sign.

Who turns left from the priority road into the stem gives way to oncoming traffic, without a sign.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from drivax.synthetic.roads.draft import Draft
from drivax.synthetic.roads.families.junction import Geometry, connect, draw_street, open_site, starts
from drivax.synthetic.roads.families.roadside import draw_sidewalk_m, draw_surroundings
from drivax.synthetic.roads.families.rules import set_priorities
from drivax.synthetic.roads.network import Control, RoadNetwork, conflicting
from drivax.synthetic.roads.style import GRID, RoadStyle


@dataclass(frozen=True)
class TJunction:
    """Settings of the family ``t_junction``.

    Attributes:
        geometry: Angles, offsets and corners.
        stem_skew: Largest deviation of the stem from a right angle, rad.
        two_lane_share: Share of priority roads with two lanes per direction; half of these have a left-turn lane.
        stem_lanes_share: Share of stems with lanes of their own for left and right.
        stop_share: Share of stems with a stop sign; the others have a yield sign.
        marked_share: Share of priority roads with crosswalks; the stem has one twice as often.
    """

    geometry: Geometry = field(
        default_factory=lambda: Geometry(skew=math.radians(3.0), offset_m=0.4, corner_m=(5.0, 9.0))
    )
    stem_skew: float = math.radians(18.0)
    two_lane_share: float = 0.35
    stem_lanes_share: float = 0.25
    stop_share: float = 0.6
    marked_share: float = 0.35
    name: str = "t_junction"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draws a junction; ego may begin on any approach, 12 to 85 m (6 s) before the junction."""
        limit = float(rng.choice(style.limits_mps))
        slower = min(limit, float(rng.choice(style.limits_mps)))
        lanes = 2 if rng.random() < self.two_lane_share else 1
        main_marked, stem_marked = rng.random(2) < (self.marked_share, 2 * self.marked_share)
        main = draw_street(rng, style, (lanes, lanes), limit, bool(main_marked))
        stem_lanes = (2, 1) if rng.random() < self.stem_lanes_share else (1, 1)
        stem = draw_street(rng, style, stem_lanes, slower, bool(stem_marked))
        first = float(rng.uniform(-math.pi, math.pi))
        across = first + math.pi / 2 + float(rng.uniform(-self.stem_skew, self.stem_skew))
        arms = self.geometry.arms(rng, (first, across, first + math.pi), (main, stem, main))
        draft = Draft()
        site = open_site(rng, draft, arms, self.geometry)
        site = connect(draft, site, [bool(rng.random() < 0.5)] * 3)
        draw_surroundings(draft, site, draw_sidewalk_m(rng, style, self.geometry))
        sign = Control.STOP if rng.random() < self.stop_share else Control.YIELD
        set_priorities(draft, site.moves, conflicting(tuple(draft.lanes)), (0, 2), sign)
        return draft.network(
            self.name, starts(draft, [lane for approach in site.approaches for lane in approach.inward])
        )
