"""Families of streets without junctions: curved and straight roads, lane drops, crosswalks, parked cars."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from drivax.synthetic.roads.curves import STEP_M
from drivax.synthetic.roads.families.street_layout import Street, StreetFamily, Strip, strips
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.roads.style import GRID, RoadStyle

#: Lanes ahead, lanes the other way, and the share of that layout.
_Layouts = tuple[tuple[int, int, float], ...]
#: Highest limit of curved roads with bays, m/s, and of streets with crosswalks, m/s.
_PARKING_LIMIT_MPS, _CROSSING_LIMIT_MPS = 14.0, 17.0
_CROSSWALK_LAYOUTS: _Layouts = ((1, 1, 0.45), (2, 2, 0.25), (2, 1, 0.1), (2, 0, 0.1), (1, 0, 0.1))


def _draw_layout(rng: np.random.Generator, layouts: _Layouts) -> tuple[int, int]:
    ahead, back, _ = layouts[rng.choice(len(layouts), p=[share for *_, share in layouts])]
    return ahead, back


@dataclass(frozen=True)
class CurvedRoad(StreetFamily):
    """Settings of the families ``curved_road`` and ``straight_road``.

    Attributes:
        layouts: Lanes ahead, lanes the other way, and the share of that layout.
        median_share: Share of two-way roads with a raised median.
    """

    tightest_m: tuple[float, float] = (30.0, 140.0)
    widest_turn: float = math.radians(150.0)
    layouts: _Layouts = (
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
        """Draw a road; ego starts in the second section of any lane ahead."""
        ahead, back = _draw_layout(rng, self.layouts)
        middle = self.draw_middle(rng, style.curvature)
        limit = float(rng.choice(style.limits_mps))
        parking = limit < _PARKING_LIMIT_MPS and rng.random() < style.parking_share
        row = float(rng.uniform(2.1, 2.4)) if parking else 0.0
        street = Street(
            middle=middle,
            cuts=self.cuts,
            strips=strips(ahead, back, len(self.cuts) - 1),
            width_m=float(rng.uniform(*style.width_m)),
            limit_mps=limit,
            shoulder_m=float(rng.uniform(*style.shoulder_m)),
            median_m=float(rng.uniform(1.5, 3.0)) if back and rng.random() < self.median_share else 0.0,
            rows_m=(row, row if back else 0.0),
        )
        draft, laid = street.start_draft()
        if rng.random() < style.walk_share:
            street.walk(draft, rng)
        street.park(draft, laid, (20.0, self.length_m - 20.0), rng)
        return draft.network(self.name, street.starts(draft, laid))


#: The family ``straight_road``: up to four lanes, slight bends.
STRAIGHT_ROAD = CurvedRoad(
    tightest_m=(500.0, 5000.0),
    widest_turn=math.radians(25.0),
    layouts=((1, 1, 0.2), (2, 2, 0.3), (3, 3, 0.15), (2, 0, 0.1), (3, 0, 0.1), (4, 0, 0.05), (3, 2, 0.1)),
    name="straight_road",
)


@dataclass(frozen=True)
class LaneDrop(StreetFamily):
    """Settings of the family ``lane_drop``: a road that loses a lane, right or left, or gains one.

    Attributes:
        two_way_share: Share of two-way roads.
        left_share: Share of one-way roads on which the left lane ends.
        gain_share: Share of roads that gain a lane instead of losing one.
        taper_m: Length over which the road narrows beyond the lane's end, low and high.
    """

    tightest_m: tuple[float, float] = (150.0, 900.0)
    two_way_share: float = 0.5
    left_share: float = 0.4
    gain_share: float = 0.2
    taper_m: tuple[float, float] = (30.0, 70.0)
    name: str = "lane_drop"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draw a road with two or three lanes ahead; the change lies 100 to 200 m ahead of ego."""
        street = Street(
            middle=self.draw_middle(rng, style.curvature),
            cuts=self.cuts,
            strips=self._strips(rng, len(self.cuts) - 1),
            width_m=float(rng.uniform(*style.width_m)),
            limit_mps=float(rng.choice(style.limits_mps)),
            shoulder_m=float(rng.uniform(*style.shoulder_m)),
            taper_m=float(rng.uniform(*self.taper_m)),
        )
        draft, laid = street.start_draft()
        if rng.random() < style.walk_share:
            street.walk(draft, rng)
        return draft.network(self.name, street.starts(draft, laid))

    def _strips(self, rng: np.random.Generator, sections: int) -> tuple[Strip, ...]:
        """Draw the lanes; the rightmost one, or the one left of the middle line, changes."""
        lanes, where = int(rng.integers(2, 4)), int(rng.integers(3, 5))
        both_ways = rng.random() < self.two_way_share
        gains, left = rng.random() < self.gain_share, rng.random() < self.left_share
        if left and not both_ways and not gains:
            return (Strip(1, True, 0, where, ends=True), *strips(lanes - 1, 0, sections))
        *rest, outer = strips(lanes, 0, sections)
        outer = replace(outer, first=where, fork=True) if gains else replace(outer, last=where, ends=True)
        return (*rest, outer, *strips(0, int(both_ways), sections))


@dataclass(frozen=True)
class MidblockCrosswalk(StreetFamily):
    """Settings of the family ``midblock_crosswalk``: a street with crossings away from junctions.

    Attributes:
        crossing_m: Station of the first crossing, low and high; ego starts at 120 to 155 m.
        apart_m: Distance to a second crossing, low and high.
        marked_share: Share of crossings with a crosswalk.
        second_share: Share of streets with two crossings.
        median_share: Share of two-way streets with a raised median.
    """

    length_m: float = 560.0
    tightest_m: tuple[float, float] = (90.0, 600.0)
    crossing_m: tuple[float, float] = (180.0, 250.0)
    apart_m: tuple[float, float] = (60.0, 130.0)
    marked_share: float = 0.75
    second_share: float = 0.5
    median_share: float = 0.25
    name: str = "midblock_crosswalk"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draw a street with sidewalks on both sides and one or two crossings."""
        ahead, back = _draw_layout(rng, _CROSSWALK_LAYOUTS)
        middle = self.draw_middle(rng, style.curvature)
        row = float(rng.uniform(2.1, 2.4)) if rng.random() < style.parking_share else 0.0
        street = Street(
            middle=middle,
            cuts=self.cuts,
            strips=strips(ahead, back, len(self.cuts) - 1),
            width_m=float(rng.uniform(*style.width_m)),
            limit_mps=float(rng.choice([v for v in style.limits_mps if v < _CROSSING_LIMIT_MPS])),
            shoulder_m=float(rng.uniform(*style.shoulder_m)),
            median_m=float(rng.uniform(1.8, 3.0)) if back and rng.random() < self.median_share else 0.0,
            rows_m=(row, row if back else 0.0),
        )
        draft, laid = street.start_draft()
        street.walk(draft, rng)
        at = float(rng.uniform(*self.crossing_m))
        stations = [at, at + float(rng.uniform(*self.apart_m))] if rng.random() < self.second_share else [at]
        for station in stations:
            street.cross(draft, laid, round(station / STEP_M), marked=bool(rng.random() < self.marked_share))
        street.park(draft, laid, (20.0, self.length_m - 20.0), rng)
        return draft.network(self.name, street.starts(draft, laid))


@dataclass(frozen=True)
class ParkedStreet(StreetFamily):
    """Settings of the family ``parked_street``: a narrow street with parked cars along one or both sides.

    Attributes:
        one_way_share: Share of one-way streets.
        both_sides_share: Share of streets with bays on both sides.
        crossing_share: Share of streets with a crossing, half of them marked.
        row_m: Width of a row of bays, low and high.
    """

    length_m: float = 480.0
    tightest_m: tuple[float, float] = (80.0, 600.0)
    one_way_share: float = 0.35
    both_sides_share: float = 0.65
    crossing_share: float = 0.5
    row_m: tuple[float, float] = (2.0, 2.4)
    name: str = "parked_street"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draw a street with one of the two lowest limits of the style and its narrowest lanes."""
        one_way = rng.random() < self.one_way_share
        middle = self.draw_middle(rng, style.curvature)
        row = float(rng.uniform(*self.row_m))
        sides = (1, 1) if rng.random() < self.both_sides_share else [(1, 0), (0, 1)][int(rng.integers(2))]
        narrowest = style.width_m[0]
        street = Street(
            middle=middle,
            cuts=self.cuts,
            strips=strips(1, 0 if one_way else 1, len(self.cuts) - 1),
            width_m=float(rng.uniform(narrowest - 0.1, narrowest + 0.2)),
            limit_mps=float(rng.choice(sorted(style.limits_mps)[:2])),
            shoulder_m=float(rng.uniform(0.1, 0.4)),
            rows_m=(row * sides[0], row * sides[1]),
        )
        draft, laid = street.start_draft()
        street.walk(draft, rng)
        if rng.random() < self.crossing_share:
            at = round(float(rng.uniform(170.0, 250.0)) / STEP_M)
            street.cross(draft, laid, at, marked=bool(rng.random() < 0.5))
        street.park(draft, laid, (15.0, self.length_m - 15.0), rng)
        return draft.network(self.name, street.starts(draft, laid))
