"""A road that loses a lane, right or left, or gains one."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from drivax.synthetic.roads.curves import Pose, winding
from drivax.synthetic.roads.draft import Draft
from drivax.synthetic.roads.families.street import Street, Strip, cuts, strips
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.roads.style import GRID, RoadStyle


@dataclass(frozen=True)
class LaneDrop:
    """Settings of the family ``lane_drop``.

    Attributes:
        length_m: Length of the reference line.
        section_m: Lanes are cut into sections of this length.
        tightest_m: Radius of the tightest bend, drawn per road, low and high.
        widest_turn: Largest difference of two headings, rad.
        two_way_share: Share of roads with traffic the other way.
        left_share: Share of the other roads on which the left lane ends.
        gain_share: Share of roads that gain a lane in place of losing one.
        taper_m: Length over which the road narrows behind the lane's end, low and high.
    """

    length_m: float = 640.0
    section_m: float = 80.0
    tightest_m: tuple[float, float] = (150.0, 900.0)
    widest_turn: float = math.radians(60.0)
    two_way_share: float = 0.5
    left_share: float = 0.4
    gain_share: float = 0.2
    taper_m: tuple[float, float] = (30.0, 70.0)
    name: str = "lane_drop"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draws a road with two or three lanes ahead; the change lies 100 to 200 m ahead of ego."""
        middle = winding(
            rng,
            self.length_m,
            max_curvature=style.curvature / float(rng.uniform(*self.tightest_m)),
            max_turn=self.widest_turn,
            start=Pose(0.0, 0.0, float(rng.uniform(-math.pi, math.pi))),
        )
        sections = cuts(self.length_m, self.section_m)
        street = Street(
            middle=middle,
            cuts=sections,
            strips=self._strips(rng, len(sections) - 1),
            width_m=float(rng.uniform(*style.width_m)),
            limit_mps=float(rng.choice(style.limits_mps)),
            shoulder_m=float(rng.uniform(*style.shoulder_m)),
            taper_m=float(rng.uniform(*self.taper_m)),
        )
        draft = Draft()
        laid = street.lay(draft)
        street.bound(draft)
        street.paint(draft)
        if rng.random() < style.walk_share:
            street.walk(draft, rng)
        return draft.network(self.name, street.starts(draft, laid))

    def _strips(self, rng: np.random.Generator, sections: int) -> tuple[Strip, ...]:
        """The lanes, of which the outermost one right or the one left of the middle line changes."""
        lanes, where = int(rng.integers(2, 4)), int(rng.integers(3, 5))
        both_ways = rng.random() < self.two_way_share
        gains, left = rng.random() < self.gain_share, rng.random() < self.left_share
        if gains:
            *rest, outer = strips(lanes, 0, sections)
            changed = (*rest, replace(outer, first=where, fork=True))
        elif left and not both_ways:
            return (Strip(1, True, 0, where, ends=True), *strips(lanes - 1, 0, sections))
        else:
            *rest, outer = strips(lanes, 0, sections)
            changed = (*rest, replace(outer, last=where, ends=True))
        return (*changed, *strips(0, int(both_ways), sections))
