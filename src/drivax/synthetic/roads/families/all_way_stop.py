"""A crossing of two streets where everybody stops, and who stood first goes first."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from drivax.synthetic.roads.draft import Draft
from drivax.synthetic.roads.families.junction import (
    Geometry,
    connect,
    draw_street,
    four_headings,
    open_site,
    starts,
)
from drivax.synthetic.roads.families.roadside import draw_sidewalk_m, draw_surroundings
from drivax.synthetic.roads.families.rules import set_all_way_stop
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.roads.style import GRID, RoadStyle


@dataclass(frozen=True)
class AllWayStop:
    """Settings of the family ``all_way_stop``.

    Attributes:
        geometry: Angles, offsets and corners.
        cross_skew: Largest deviation of the two streets from a right angle, rad.
        two_lane_share: Share of streets with two lanes per direction.
        fastest_mps: Streets with a higher limit are not drawn, unless the domain has no slower ones.
        marked_share: Share of junctions with crosswalks.
    """

    geometry: Geometry = field(default_factory=lambda: Geometry(corner_m=(5.0, 9.0)))
    cross_skew: float = math.radians(12.0)
    two_lane_share: float = 0.15
    fastest_mps: float = 14.0
    marked_share: float = 0.7
    name: str = "all_way_stop"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draws a junction; ego may begin on any approach, 12 to 85 m (6 s) before its stop line."""
        limits = [v for v in style.limits_mps if v <= self.fastest_mps] or [min(style.limits_mps)]
        marked = bool(rng.random() < self.marked_share)
        streets = []
        for _ in range(2):
            lanes = 2 if rng.random() < self.two_lane_share else 1
            streets.append(draw_street(rng, style, (lanes, lanes), float(rng.choice(limits)), marked))
        arms = self.geometry.arms(rng, four_headings(rng, self.cross_skew), streets * 2)
        draft = Draft()
        site = connect(draft, open_site(rng, draft, arms, self.geometry), (False,) * 4)
        draw_surroundings(draft, site, draw_sidewalk_m(rng, style, self.geometry))
        set_all_way_stop(draft, site.moves)
        return draft.network(
            self.name, starts(draft, [lane for approach in site.approaches for lane in approach.inward])
        )
