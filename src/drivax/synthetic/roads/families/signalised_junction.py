"""A four-way junction with lights: random angles, one to three lanes per approach.

Left turns have a phase of their own (protected, with arrows), go together with oncoming traffic and give way to it
(permissive), or the approaches take turns (split phases). No other movements that could meet are ever green together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from drivax.synthetic.roads.draft import Draft
from drivax.synthetic.roads.families.junction import (
    CrossSection,
    Geometry,
    connect,
    draw_street,
    four_headings,
    open_site,
    starts,
)
from drivax.synthetic.roads.families.roadside import draw_sidewalk_m, draw_surroundings
from drivax.synthetic.roads.families.rules import LeftTurns, set_lights
from drivax.synthetic.roads.network import RoadNetwork, conflicting
from drivax.synthetic.roads.style import GRID, RoadStyle

#: Lanes inward and outward of a street, with the share of each layout. An extra lane inward is for turning left.
_LAYOUTS = ((1, 1), (2, 1), (2, 2), (3, 2))
_SHARES = (0.35, 0.15, 0.38, 0.12)


@dataclass(frozen=True)
class SignalisedJunction:
    """Settings of the family ``signalised_junction``.

    Attributes:
        geometry: Angles, offsets and corners.
        cross_skew: Largest deviation of the two streets from a right angle, rad.
        left_lane_share: Share of streets with as many lanes inward as outward whose left lane is for turning only.
        protected_share: Share of streets with left-turn lanes whose left turns are protected.
        permissive_share: Share of the other streets whose left turns are permissive.
        green_s: Green time of a phase, low and high.
    """

    geometry: Geometry = field(default_factory=Geometry)
    cross_skew: float = math.radians(15.0)
    left_lane_share: float = 0.6
    protected_share: float = 0.6
    permissive_share: float = 0.6
    green_s: tuple[float, float] = (7.0, 14.0)
    name: str = "signalised_junction"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draws a junction; ego may begin on any approach, 12 to 85 m (6 s) before its stop line."""
        streets = [_draw_street(rng, style) for _ in range(2)]
        arms = self.geometry.arms(rng, four_headings(rng, self.cross_skew), streets * 2)
        draft = Draft()
        site = open_site(rng, draft, arms, self.geometry)
        left_only = [_has_left_lane(street, rng, self.left_lane_share) for street in streets]
        site = connect(draft, site, left_only * 2)
        draw_surroundings(draft, site, draw_sidewalk_m(rng, style, self.geometry))
        lefts = [
            LeftTurns(only and rng.random() < self.protected_share, rng.random() < self.permissive_share)
            for only in left_only
        ]
        signals = set_lights(
            draft,
            site.moves,
            conflicting(tuple(draft.lanes)),
            (lefts[0], lefts[1]),
            [float(green) for green in rng.uniform(*self.green_s, size=4)],
        )
        lanes = [lane for approach in site.approaches for lane in approach.inward]
        return draft.network(self.name, starts(draft, lanes), signals)


def _draw_street(rng: np.random.Generator, style: RoadStyle) -> CrossSection:
    """A street as it meets lights."""
    layout = _LAYOUTS[rng.choice(len(_LAYOUTS), p=_SHARES)]
    return draw_street(rng, style, layout, float(rng.choice(style.limits_mps)))


def _has_left_lane(street: CrossSection, rng: np.random.Generator, share: float) -> bool:
    if street.inward > street.outward:
        return True
    return street.inward > 1 and bool(rng.random() < share)
