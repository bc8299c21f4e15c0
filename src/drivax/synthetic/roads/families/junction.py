"""What junctions are made of: arms that meet, their lanes and the ways across.

A *site* is one junction. Its approaches are numbered counter-clockwise, so for who comes in on approach ``i`` the next
one is to the right. Each approach has, from the junction outwards: the mouth, where the corners' kerbs begin, the
crosswalk if it is marked, and the stop line, where connectors begin and end.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from drivax.geometry.vectors import wrap
from drivax.synthetic.roads.curves import STEP_M, Curve, Pose, connected, joined, resampled, straight, winding
from drivax.synthetic.roads.draft import Draft
from drivax.synthetic.roads.network import Start
from drivax.synthetic.roads.style import RoadStyle

#: From the mouth outwards, with a crosswalk and without: the strip where people cross, and the stop line, m.
_CROSSING_M = ((0.8, 4.0), (0.2, 3.0))
_STOP_LINE_M = (5.5, 3.6)
#: Lanes beside each other need this much, as do opposing ones: below it their users count as in conflict, m.
_LEAST_PITCH_M = 3.2
#: Two arms that differ less than this from a straight line make no corner, rad.
_NO_CORNER = math.radians(25.0)
#: Where ego may begin: so far before the stop line at most, in seconds at the limit and in m, and so far at least.
_EARLIEST_S, _EARLIEST_M, _LATEST_M = 6.0, 85.0, 12.0


class Turn(enum.IntEnum):
    """Ways across a junction; of two that meet, the lower number goes first."""

    STRAIGHT = 0
    RIGHT = 1
    LEFT = 2


@dataclass(frozen=True)
class CrossSection:
    """The cross-section of an arm.

    Attributes:
        inward, outward: Lanes towards the junction and away from it.
        shoulder_m: Drivable width beyond the outer lanes.
        marked: Whether a crosswalk is painted at the mouth.
    """

    inward: int
    outward: int
    width_m: float
    shoulder_m: float
    limit_mps: float
    marked: bool = True

    @property
    def gap_m(self) -> float:
        """Between the innermost lanes of both directions."""
        return max(0.0, _LEAST_PITCH_M - self.width_m)

    @property
    def left_m(self) -> float:
        """From the middle line to the left edge, looking outwards."""
        return self.gap_m / 2 + self.inward * self.width_m + self.shoulder_m

    @property
    def right_m(self) -> float:
        """From the middle line to the right edge, looking outwards."""
        return self.gap_m / 2 + self.outward * self.width_m + self.shoulder_m

    @property
    def crossing_m(self) -> tuple[float, float]:
        """From the mouth to the near and the far side of the strip where people cross."""
        return _CROSSING_M[0 if self.marked else 1]

    @property
    def stop_line_m(self) -> float:
        """From the mouth to the stop line."""
        return _STOP_LINE_M[0 if self.marked else 1]


@dataclass(frozen=True)
class Arm:
    """A street that meets the junction.

    Attributes:
        base: Where its middle line passes the junction's centre, looking outwards.
    """

    base: Pose
    street: CrossSection


@dataclass(frozen=True)
class Approach:
    """What an arm became.

    Attributes:
        mouth_m: Distance of the mouth from the arm's base.
        middle: The middle line from the stop line outwards, as far as the lanes go.
        side: The middle line from the mouth outwards, as far as the edges go.
        inward, outward: Its lanes, each from the middle to the edge.
    """

    arm: Arm
    mouth_m: float
    middle: Curve
    side: Curve
    inward: tuple[int, ...]
    outward: tuple[int, ...]


@dataclass(frozen=True)
class Move:
    """A connector: from which approach to which, and how it turns."""

    lane: int
    arm: int
    to: int
    turn: Turn


@dataclass(frozen=True)
class Site:
    """A junction whose lanes have been laid."""

    approaches: tuple[Approach, ...]
    moves: tuple[Move, ...] = ()


@dataclass(frozen=True)
class Reach:
    """How arms go on beyond the junction: straight first, then bending gently.

    Attributes:
        arm_m: Length beyond the stop line.
        straight_m: Length of the straight part.
        tightest_m: Radius of the tightest bend.
        widest_turn: Largest difference of two headings, rad.
    """

    arm_m: float = 230.0
    straight_m: float = 30.0
    tightest_m: float = 120.0
    widest_turn: float = math.radians(28.0)


@dataclass(frozen=True)
class Geometry:
    """What junction families have in common.

    Attributes:
        skew: Largest deviation of an arm from its direction, rad.
        offset_m: Largest sideways offset of an arm from the centre.
        corner_m: Radius of the corners' kerbs, low and high.
        walk_m: Distance of sidewalks from the edge, low and high.
        reach: How the arms go on.
    """

    skew: float = math.radians(6.0)
    offset_m: float = 0.8
    corner_m: tuple[float, float] = (6.0, 12.0)
    walk_m: tuple[float, float] = (1.0, 2.5)
    reach: Reach = field(default_factory=Reach)

    def arms(
        self, rng: np.random.Generator, headings: Sequence[float], streets: Sequence[CrossSection]
    ) -> list[Arm]:
        """Arms in about these directions; where lanes inward and outward differ, the street stays centred."""
        arms = []
        for heading, street in zip(headings, streets, strict=True):
            at = Pose(0.0, 0.0, heading + float(rng.uniform(-self.skew, self.skew)))
            centred = (street.outward - street.inward) * street.width_m / 2
            offset = float(rng.uniform(-self.offset_m, self.offset_m))
            arms.append(Arm(at.aside(centred + offset), street))
        return arms

    def mouths(self, rng: np.random.Generator, arms: Sequence[Arm]) -> list[float]:
        """How far from its base each arm's mouth is, so that all corners get their radius.

        A corner of radius r between edges that turn by an angle a begins ``r tan(a / 2)`` from where they meet.
        """
        mouths = [0.0] * len(arms)
        for i, arm in enumerate(arms):
            k = (i + 1) % len(arms)
            angle = math.pi - (arms[k].base.heading - arm.base.heading) % (2 * math.pi)
            radius = float(rng.uniform(*self.corner_m))
            if abs(angle) < _NO_CORNER:
                continue
            tangent = radius * math.tan(angle / 2)
            mine, theirs = _meeting(arm, arms[k])
            mouths[i] = max(mouths[i], mine + tangent)
            mouths[k] = max(mouths[k], theirs + tangent)
        return mouths


def draw_street(
    rng: np.random.Generator, style: RoadStyle, lanes: tuple[int, int], limit_mps: float, marked: bool = True
) -> CrossSection:
    """A street with this many lanes inward and outward, in the style of the domain."""
    width = float(rng.uniform(*style.width_m))
    if max(lanes) > 1:
        width = max(width, _LEAST_PITCH_M)
    return CrossSection(*lanes, width, float(rng.uniform(*style.shoulder_m)), limit_mps, marked)


def four_headings(rng: np.random.Generator, cross_skew: float) -> list[float]:
    """Directions of the arms where two streets cross."""
    first = float(rng.uniform(-math.pi, math.pi))
    second = first + math.pi / 2 + float(rng.uniform(-cross_skew, cross_skew))
    return [first, second, first + math.pi, second + math.pi]


def _meeting(right: Arm, left: Arm) -> tuple[float, float]:
    """How far out along both middle lines the left edge of one arm meets the right edge of the next one."""
    a, b = right.base, left.base
    sin = math.sin(b.heading - a.heading)
    start, end = a.aside(right.street.left_m), b.aside(-left.street.right_m)
    dx, dy = end.x - start.x, end.y - start.y
    along_a = (dx * math.sin(b.heading) - dy * math.cos(b.heading)) / sin
    along_b = (dx * math.sin(a.heading) - dy * math.cos(a.heading)) / sin
    return along_a, along_b


def open_approach(rng: np.random.Generator, draft: Draft, arm: Arm, mouth_m: float, reach: Reach) -> Approach:
    """Lays an arm that leads off the map."""
    near = straight(arm.base.ahead(mouth_m + arm.street.stop_line_m), reach.straight_m)
    far = winding(
        rng,
        reach.arm_m - reach.straight_m,
        max_curvature=1.0 / reach.tightest_m,
        max_turn=reach.widest_turn,
        start=near.end,
    )
    middle = joined(near, far)
    side = joined(straight(arm.base.ahead(mouth_m), arm.street.stop_line_m), middle)
    inward, outward = lay_lanes(draft, arm.street, middle)
    return Approach(arm, mouth_m, middle, side, inward, outward)


def lay_lanes(draft: Draft, street: CrossSection, middle: Curve) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Adds the lanes of a street whose middle line leads away from the junction: inward ones, outward ones."""
    inward, outward = (
        [
            draft.lane(
                curve if side < 0 else curve.reversed(),
                street.width_m,
                street.limit_mps,
            )
            for j in range(count)
            for curve in [middle.shifted(side * (street.gap_m / 2 + (j + 0.5) * street.width_m))]
        ]
        for side, count in ((1.0, street.inward), (-1.0, street.outward))
    )
    for way in (inward, outward):
        for a, b in pairwise(way):
            draft.beside(a, b)
    return tuple(inward), tuple(outward)


def open_site(rng: np.random.Generator, draft: Draft, arms: Sequence[Arm], geometry: Geometry) -> Site:
    """Lays all arms of a junction that stands alone; its connectors are still missing."""
    mouths = geometry.mouths(rng, arms)
    return Site(
        tuple(
            open_approach(rng, draft, arm, mouth, geometry.reach)
            for arm, mouth in zip(arms, mouths, strict=True)
        )
    )


def connect(draft: Draft, site: Site, left_only: Sequence[bool]) -> Site:
    """Adds the ways across.

    Left turns begin in the lane next to the middle and end in one, right turns use the outermost lanes, and lanes
    that go straight on are matched from the outside. Where fewer lanes leave than arrive, the innermost one is for
    turning only.

    Args:
        draft: Where lanes are added.
        site: The junction.
        left_only: Per approach, whether its innermost lane is for turning left only (where there are several).
    """
    moves = []
    for i, approach in enumerate(site.approaches):
        ways = {_turn(approach.arm, site.approaches[k].arm): k for k in _others(i, len(site.approaches))}
        lanes = approach.inward
        for turn, k in sorted(ways.items()):
            out = site.approaches[k].outward
            if turn == Turn.STRAIGHT:
                first = 1 if left_only[i] and approach.arm.street.inward > 1 and Turn.LEFT in ways else 0
                shift = len(out) - len(lanes)
                pairs = [(lanes[j], out[shift + j]) for j in range(first, len(lanes)) if shift + j >= 0]
            else:
                pairs = [(lanes[0], out[0]) if turn == Turn.LEFT else (lanes[-1], out[-1])]
            ends = (approach.arm.street.stop_line_m, site.approaches[k].arm.street.stop_line_m)
            moves += [Move(_connector(draft, a, b, ends), i, k, turn) for a, b in pairs]
    return Site(site.approaches, tuple(moves))


def _others(i: int, count: int) -> list[int]:
    return [(i + step) % count for step in range(1, count)]


def _turn(before: Arm, after: Arm) -> Turn:
    angle = float(wrap(after.base.heading - before.base.heading - math.pi))
    if abs(angle) < math.pi / 4:
        return Turn.STRAIGHT
    return Turn.LEFT if angle > 0 else Turn.RIGHT


def _connector(draft: Draft, before: int, after: int, ends_m: tuple[float, float]) -> int:
    a, b = draft.lanes[before], draft.lanes[after]
    # The bend lies between the mouths: a turn that began at the stop line would cut the corner.
    first = straight(a.curve.end, ends_m[0])
    last = straight(b.curve.start.ahead(-ends_m[1]), ends_m[1])
    curve = joined(first, connected(first.end, last.start), last)
    way = draft.lane(resampled(curve, STEP_M), a.width_m, a.limit_mps, connector=True)
    draft.link(before, way)
    draft.link(way, after)
    return way


def starts(draft: Draft, lanes: Sequence[int]) -> tuple[Start, ...]:
    """Places for ego on inward lanes; a lane that is named more than once is chosen as many times as often."""
    result = []
    for index in lanes:
        lane = draft.lanes[index]
        earliest = min(_EARLIEST_M, _EARLIEST_S * lane.limit_mps)
        result.append(Start(index, lane.length_m - earliest, lane.length_m - _LATEST_M))
    return tuple(result)
