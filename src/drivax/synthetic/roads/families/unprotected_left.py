"""A four-way junction with left-turn lanes whose users give way to oncoming traffic.

Either the lights are green for both directions at once, or the road has priority and the side streets stop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

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
from drivax.synthetic.roads.families.rules import LeftTurns, set_lights, set_priorities
from drivax.synthetic.roads.network import Control, RoadNetwork, conflicting
from drivax.synthetic.roads.style import GRID, RoadStyle

#: Lanes inward and outward of the main road, with the share of each layout; the left one is for turning left.
_LAYOUTS = ((2, 1), (2, 2), (3, 2))
_SHARES = (0.4, 0.3, 0.3)
#: The left-turn lane is this many times as likely to be ego's as another one.
_LEFT_WEIGHT = 4


@dataclass(frozen=True)
class UnprotectedLeft:
    """Settings of the family ``unprotected_left``.

    Attributes:
        geometry: Angles, offsets and corners.
        cross_skew: Largest deviation of the two streets from a right angle, rad.
        signal_share: Share of junctions with lights.
        green_s: Green time of a phase, low and high; long enough to wait for a gap.
    """

    geometry: Geometry = field(
        default_factory=lambda: Geometry(skew=math.radians(4.0), offset_m=0.5, corner_m=(5.5, 10.0))
    )
    cross_skew: float = math.radians(15.0)
    signal_share: float = 0.6
    green_s: tuple[float, float] = (11.0, 20.0)
    name: str = "unprotected_left"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draws a junction; ego begins on the main road, most often in its left-turn lane, and many come towards it."""
        lights = bool(rng.random() < self.signal_share)
        limit = float(rng.choice(style.limits_mps))
        slower = min(limit, float(rng.choice(style.limits_mps)))
        layout = _LAYOUTS[rng.choice(len(_LAYOUTS), p=_SHARES)]
        main = draw_street(rng, style, layout, limit, lights)
        side = draw_street(rng, style, (1, 1), slower)
        arms = self.geometry.arms(rng, four_headings(rng, self.cross_skew), (main, side) * 2)
        draft = Draft()
        site = connect(draft, open_site(rng, draft, arms, self.geometry), (True, False) * 2)
        draw_surroundings(draft, site, draw_sidewalk_m(rng, style, self.geometry))
        conflicts, signals = conflicting(tuple(draft.lanes)), None
        if lights:
            how = LeftTurns(protected=False, permissive=True)
            green = [float(g) for g in rng.uniform(*self.green_s, size=4)]
            signals = set_lights(draft, site.moves, conflicts, (how, how), green)
        else:
            set_priorities(draft, site.moves, conflicts, (0, 2), Control.STOP)
        chosen = [
            lane
            for i in (0, 2)
            for j, lane in enumerate(site.approaches[i].inward)
            for _ in range(1 if j else _LEFT_WEIGHT)
        ]
        oncoming = tuple(lane for i in (0, 2) for lane in site.approaches[i].inward[1:])
        return replace(draft.network(self.name, starts(draft, chosen), signals), busy=oncoming)
