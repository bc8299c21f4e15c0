"""Families of single junctions: with lights, T-junctions, all-way stops, and unprotected left turns.

Lights serve left turns in a phase of their own (protected, with arrows), together with oncoming traffic that has right
of way (permissive), or serve one approach after the other (split phases). Other conflicting movements are never green
at the same time. Ego starts on any approach, 12 to 85 m (6 s) before the junction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from drivax.synthetic.roads.draft import Draft
from drivax.synthetic.roads.families.junction_layout import (
    CrossSection,
    Geometry,
    draw_four_headings,
    draw_street,
    finish_site,
    open_site,
    starts,
)
from drivax.synthetic.roads.families.rules import LeftTurns, set_lights, set_priorities
from drivax.synthetic.roads.network import Control, RoadNetwork
from drivax.synthetic.roads.style import GRID, RoadStyle

#: Lanes inward and outward of a street, with the share of each layout. An extra lane inward is for turning left.
_SIGNAL_LAYOUTS = ((1, 1), (2, 1), (2, 2), (3, 2))
_SIGNAL_SHARES = (0.35, 0.15, 0.38, 0.12)


#: Lanes inward and outward of the main road, with the share of each layout; the left one is for turning left.
_LEFT_LAYOUTS = ((2, 1), (2, 2), (3, 2))
_LEFT_SHARES = (0.4, 0.3, 0.3)
#: The left-turn lane is this many times as likely to be ego's as another one.
_LEFT_WEIGHT = 4


@dataclass(frozen=True)
class SignalisedJunction:
    """Settings of the family ``signalised_junction``: random angles, one to three lanes per approach.

    Attributes:
        cross_skew: Largest deviation of the two streets from a right angle, rad.
        left_lane_share: Share of left-turn lanes on streets with as many lanes inward as outward.
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
        """Draw a junction."""
        streets = [_draw_street(rng, style) for _ in range(2)]
        arms = self.geometry.arms(rng, draw_four_headings(rng, self.cross_skew), streets * 2)
        draft = Draft()
        site = open_site(rng, draft, arms, self.geometry)
        left_only = [_has_left_lane(street, rng, self.left_lane_share) for street in streets]
        site = finish_site(rng, style, draft, site, left_only * 2, self.geometry)
        lefts = [
            LeftTurns(only and rng.random() < self.protected_share, rng.random() < self.permissive_share)
            for only in left_only
        ]
        green = [float(g) for g in rng.uniform(*self.green_s, size=4)]
        signals = set_lights(draft, site.moves, draft.conflicts(), (lefts[0], lefts[1]), green)
        return draft.network(self.name, starts(draft, site.inward), signals)


def _draw_street(rng: np.random.Generator, style: RoadStyle) -> CrossSection:
    layout = _SIGNAL_LAYOUTS[rng.choice(len(_SIGNAL_LAYOUTS), p=_SIGNAL_SHARES)]
    return draw_street(rng, style, layout, float(rng.choice(style.limits_mps)))


def _has_left_lane(street: CrossSection, rng: np.random.Generator, share: float) -> bool:
    if street.inward > street.outward:
        return True
    return street.inward > 1 and bool(rng.random() < share)


@dataclass(frozen=True)
class TJunction:
    """Settings of the family ``t_junction``: a priority road, and a stem with a stop or a yield sign.

    Attributes:
        stem_skew: Largest deviation of the stem from a right angle, rad.
        two_lane_share: Share of priority roads with two lanes per direction; half of these have a left-turn lane.
        stem_lanes_share: Share of stems with separate lanes for left and right turns.
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
        """Draw a junction."""
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
        site = finish_site(rng, style, draft, site, [bool(rng.random() < 0.5)] * 3, self.geometry)
        sign = Control.STOP if rng.random() < self.stop_share else Control.YIELD
        set_priorities(draft, site.moves, draft.conflicts(), (0, 2), sign)
        return draft.network(self.name, starts(draft, site.inward))


@dataclass(frozen=True)
class AllWayStop:
    """Settings of the family ``all_way_stop``: two streets with stop signs on all approaches.

    Attributes:
        cross_skew: Largest deviation of the two streets from a right angle, rad.
        two_lane_share: Share of streets with two lanes per direction.
        fastest_mps: Highest limit of the streets, unless the domain has only higher ones.
        marked_share: Share of junctions with crosswalks.
    """

    geometry: Geometry = field(default_factory=lambda: Geometry(corner_m=(5.0, 9.0)))
    cross_skew: float = math.radians(12.0)
    two_lane_share: float = 0.15
    fastest_mps: float = 14.0
    marked_share: float = 0.7
    name: str = "all_way_stop"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draw a junction."""
        limits = [v for v in style.limits_mps if v <= self.fastest_mps] or [min(style.limits_mps)]
        marked = bool(rng.random() < self.marked_share)
        streets = []
        for _ in range(2):
            lanes = 2 if rng.random() < self.two_lane_share else 1
            streets.append(draw_street(rng, style, (lanes, lanes), float(rng.choice(limits)), marked))
        arms = self.geometry.arms(rng, draw_four_headings(rng, self.cross_skew), streets * 2)
        draft = Draft()
        site = open_site(rng, draft, arms, self.geometry)
        site = finish_site(rng, style, draft, site, (False,) * 4, self.geometry)
        for move in site.moves:
            draft.change(move.lane, control=Control.ALL_WAY_STOP)
        return draft.network(self.name, starts(draft, site.inward))


@dataclass(frozen=True)
class UnprotectedLeft:
    """Settings of the family ``unprotected_left``: left-turn lanes that yield to oncoming traffic.

    Either the lights are green for both directions at the same time, or the road has priority over side streets.

    Attributes:
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
        """Draw a junction; ego starts on the main road, most often in a left-turn lane, in dense oncoming traffic."""
        lights = bool(rng.random() < self.signal_share)
        limit = float(rng.choice(style.limits_mps))
        slower = min(limit, float(rng.choice(style.limits_mps)))
        layout = _LEFT_LAYOUTS[rng.choice(len(_LEFT_LAYOUTS), p=_LEFT_SHARES)]
        main = draw_street(rng, style, layout, limit, lights)
        side = draw_street(rng, style, (1, 1), slower)
        arms = self.geometry.arms(rng, draw_four_headings(rng, self.cross_skew), (main, side) * 2)
        draft = Draft()
        site = open_site(rng, draft, arms, self.geometry)
        site = finish_site(rng, style, draft, site, (True, False) * 2, self.geometry)
        signals = None
        if lights:
            lefts = LeftTurns(protected=False, permissive=True)
            green = [float(g) for g in rng.uniform(*self.green_s, size=4)]
            signals = set_lights(draft, site.moves, draft.conflicts(), (lefts, lefts), green)
        else:
            set_priorities(draft, site.moves, draft.conflicts(), (0, 2), Control.STOP)
        chosen = [
            lane
            for i in (0, 2)
            for j, lane in enumerate(site.approaches[i].inward)
            for _ in range(1 if j else _LEFT_WEIGHT)
        ]
        oncoming = tuple(lane for i in (0, 2) for lane in site.approaches[i].inward[1:])
        return replace(draft.network(self.name, starts(draft, chosen), signals), busy=oncoming)
