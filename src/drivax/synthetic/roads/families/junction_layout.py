"""Layout of junctions: arms, their lanes, connectors, kerbs, sidewalks, markings and crossings.

A *site* is one junction with approaches in counter-clockwise order: for traffic on approach ``i`` the next one is on
the right. Outwards from the junction an approach has the mouth, where the corners' kerbs begin, the crosswalk if it is
marked, and the stop line, where connectors begin and end.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from drivax.geometry.vectors import wrap
from drivax.scenario.schema import RoadKind
from drivax.synthetic.roads.curves import (
    STEP_M,
    Curve,
    Pose,
    connect_poses,
    draw_winding_curve,
    join_curves,
    resample,
    straight,
    tangent_lengths,
)
from drivax.synthetic.roads.network import Crossing, Draft, Line, RoadStyle, Start, points, ring

#: Distances from the mouth of the crossing's two sides and of the stop line, with a crosswalk and without, m.
_CROSSING_M = ((0.8, 4.0), (0.2, 3.0))
_STOP_LINE_M = (5.5, 3.6)
#: Least distance between the centres of adjacent or opposing lanes, m; closer lanes would be in conflict.
_LEAST_PITCH_M = 3.2
#: Deviation of two arms from a straight line below which they have no corner, rad.
_NO_CORNER = math.radians(25.0)
#: Largest distance of ego's start from the stop line, in seconds at the limit and in m, and the least one, m.
_EARLIEST_S, _EARLIEST_M, _LATEST_M = 6.0, 85.0, 12.0


class Turn(enum.IntEnum):
    """Turns at a junction; a lower number has right of way over a higher one."""

    STRAIGHT = 0
    RIGHT = 1
    LEFT = 2


@dataclass(frozen=True)
class CrossSection:
    """Cross-section of an arm.

    Attributes:
        inward, outward: Numbers of lanes towards the junction and away from it.
        shoulder_m: Drivable width beyond the outer lanes.
        marked: Whether the mouth has a crosswalk.
    """

    inward: int
    outward: int
    width_m: float
    shoulder_m: float
    limit_mps: float
    marked: bool = True

    @property
    def gap_m(self) -> float:
        """Gap between the innermost lanes of both directions."""
        return max(0.0, _LEAST_PITCH_M - self.width_m)

    @property
    def left_m(self) -> float:
        """Distance from the middle line to the left edge, looking outwards."""
        return self.gap_m / 2 + self.inward * self.width_m + self.shoulder_m

    @property
    def right_m(self) -> float:
        """Distance from the middle line to the right edge, looking outwards."""
        return self.gap_m / 2 + self.outward * self.width_m + self.shoulder_m

    @property
    def crossing_m(self) -> tuple[float, float]:
        """Distance from the mouth to the near and the far side of the crossing."""
        return _CROSSING_M[0 if self.marked else 1]

    @property
    def stop_line_m(self) -> float:
        """Distance from the mouth to the stop line."""
        return _STOP_LINE_M[0 if self.marked else 1]


@dataclass(frozen=True)
class Arm:
    """A street at the junction; ``base`` is the pose of its middle line next to the centre, looking outwards."""

    base: Pose
    street: CrossSection


@dataclass(frozen=True)
class Approach:
    """An arm with its lanes.

    Attributes:
        mouth_m: Distance of the mouth from the arm's base.
        middle, side: Middle line outwards, from the stop line (for the lanes) and from the mouth (for the edges).
        inward, outward: Lanes, each from the middle to the edge.
    """

    arm: Arm
    mouth_m: float
    middle: Curve
    side: Curve
    inward: tuple[int, ...]
    outward: tuple[int, ...]


@dataclass(frozen=True)
class Move:
    """A connector lane, the numbers of the approaches from (``arm``) and to (``to``) which it leads, and its turn."""

    lane: int
    arm: int
    to: int
    turn: Turn


@dataclass(frozen=True)
class Site:
    """A junction with its lanes and connectors."""

    approaches: tuple[Approach, ...]
    moves: tuple[Move, ...] = ()

    @property
    def inward(self) -> list[int]:
        """Inward lanes of all approaches."""
        return [lane for approach in self.approaches for lane in approach.inward]


@dataclass(frozen=True)
class Reach:
    """Arms beyond the stop line: straight, then bent, with headings that differ by at most ``widest_turn`` (rad)."""

    arm_m: float = 230.0
    straight_m: float = 30.0
    tightest_m: float = 120.0
    widest_turn: float = math.radians(28.0)

    def draw(self, rng: np.random.Generator, start: Pose) -> Curve:
        """Draw the middle line of an arm."""
        near = straight(start, self.straight_m)
        length, curvature = self.arm_m - self.straight_m, 1.0 / self.tightest_m
        bent = draw_winding_curve(
            rng, length, max_curvature=curvature, max_turn=self.widest_turn, start=near.end
        )
        return join_curves(near, bent)


@dataclass(frozen=True)
class Geometry:
    """Geometry of a junction.

    Attributes:
        skew, offset_m: Largest deviation of an arm from its direction, rad, and from the centre, m.
        corner_m: Radius of the corners' kerbs, low and high.
        sidewalk_m: Distance of sidewalks from the edge, low and high.
    """

    skew: float = math.radians(6.0)
    offset_m: float = 0.8
    corner_m: tuple[float, float] = (6.0, 12.0)
    sidewalk_m: tuple[float, float] = (1.0, 2.5)
    reach: Reach = field(default_factory=Reach)

    def arms(
        self, rng: np.random.Generator, headings: Sequence[float], streets: Sequence[CrossSection]
    ) -> list[Arm]:
        """Draw arms in approximately these directions, each centred on its lanes."""
        arms = []
        for heading, street in zip(headings, streets, strict=True):
            pose = Pose(0.0, 0.0, heading + float(rng.uniform(-self.skew, self.skew)))
            centred = (street.outward - street.inward) * street.width_m / 2
            arms.append(
                Arm(pose.shift_left(centred + float(rng.uniform(-self.offset_m, self.offset_m))), street)
            )
        return arms

    def mouths(self, rng: np.random.Generator, arms: Sequence[Arm]) -> list[float]:
        """Draw radii of the corners and return the distance from each arm's base to its mouth.

        A corner of radius r between edges that turn by an angle a begins ``r tan(a / 2)`` from their intersection.
        """
        mouths = [0.0] * len(arms)
        for i, arm in enumerate(arms):
            k = (i + 1) % len(arms)
            angle = math.pi - (arms[k].base.heading - arm.base.heading) % (2 * math.pi)
            radius = float(rng.uniform(*self.corner_m))
            if abs(angle) < _NO_CORNER:
                continue
            tangent = radius * math.tan(angle / 2)
            before_m, after_m = _intersection(arm, arms[k])
            mouths[i] = max(mouths[i], before_m + tangent)
            mouths[k] = max(mouths[k], after_m + tangent)
        return mouths


def draw_street(
    rng: np.random.Generator, style: RoadStyle, lanes: tuple[int, int], limit_mps: float, marked: bool = True
) -> CrossSection:
    """Draw a street with these numbers of lanes inward and outward."""
    width = float(rng.uniform(*style.width_m))
    if max(lanes) > 1:
        width = max(width, _LEAST_PITCH_M)
    return CrossSection(*lanes, width, float(rng.uniform(*style.shoulder_m)), limit_mps, marked)


def _intersection(before: Arm, after: Arm) -> tuple[float, float]:
    """Intersect an arm's left edge with the next arm's right edge; return the distances along both middle lines."""
    start, end = before.base.shift_left(before.street.left_m), after.base.shift_left(-after.street.right_m)
    before_m, behind_m = tangent_lengths(start, end, math.sin(end.heading - start.heading))
    return before_m, -behind_m


def open_approach(rng: np.random.Generator, draft: Draft, arm: Arm, mouth_m: float, reach: Reach) -> Approach:
    """Add an arm that leads off the map, and return its approach."""
    middle = reach.draw(rng, arm.base.ahead(mouth_m + arm.street.stop_line_m))
    side = join_curves(straight(arm.base.ahead(mouth_m), arm.street.stop_line_m), middle)
    return Approach(arm, mouth_m, middle, side, *add_lanes(draft, arm.street, middle))


def add_lanes(draft: Draft, street: CrossSection, middle: Curve) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Add the lanes of a street, whose middle line leads outwards; return inward and outward lanes."""

    def add_direction(count: int, side: float) -> tuple[int, ...]:
        lanes = []
        for j in range(count):
            curve = middle.parallel(side * (street.gap_m / 2 + (j + 0.5) * street.width_m))
            curve = curve if side < 0 else curve.reverse()
            lanes.append(draft.lane(curve, street.width_m, street.limit_mps))
        for pair in pairwise(lanes):
            draft.link_neighbours(*pair)
        return tuple(lanes)

    return add_direction(street.inward, 1.0), add_direction(street.outward, -1.0)


def open_site(rng: np.random.Generator, arms: Sequence[Arm], geometry: Geometry) -> tuple[Draft, Site]:
    """Start a draft with all arms of a single junction, without connectors."""
    draft, mouths = Draft(), geometry.mouths(rng, arms)
    pairs = zip(arms, mouths, strict=True)
    return draft, Site(tuple(open_approach(rng, draft, arm, mouth, geometry.reach) for arm, mouth in pairs))


def open_crossroads(
    rng: np.random.Generator, streets: Sequence[CrossSection], geometry: Geometry, skew: float
) -> tuple[Draft, Site]:
    """Start a draft with the arms of two streets that cross at a right angle, up to a deviation ``skew`` (rad)."""
    first = float(rng.uniform(-math.pi, math.pi))
    second = first + math.pi / 2 + float(rng.uniform(-skew, skew))
    headings = [first, second, first + math.pi, second + math.pi]
    return open_site(rng, geometry.arms(rng, headings, [*streets, *streets]), geometry)


def connect(draft: Draft, site: Site, left_only: Sequence[bool]) -> Site:
    """Add the connectors of a site whose approaches have at most one other approach per :class:`Turn`.

    Left turns connect innermost lanes, right turns outermost ones, and straight connectors match lanes from the
    outside. The innermost lane is only for left turns where fewer lanes leave straight on than arrive, and on
    ``left_only`` approaches with several lanes and a left turn.
    """
    moves = []
    for i, approach in enumerate(site.approaches):
        others = [(i + step) % len(site.approaches) for step in range(1, len(site.approaches))]
        turns = {_turn(approach.arm, site.approaches[k].arm): k for k in others}
        lanes = approach.inward
        for turn, k in sorted(turns.items()):
            targets = site.approaches[k].outward
            if turn == Turn.STRAIGHT:
                first = 1 if left_only[i] and approach.arm.street.inward > 1 and Turn.LEFT in turns else 0
                shift = len(targets) - len(lanes)
                pairs = [(lanes[j], targets[shift + j]) for j in range(first, len(lanes)) if shift + j >= 0]
            else:
                pairs = [(lanes[0], targets[0]) if turn == Turn.LEFT else (lanes[-1], targets[-1])]
            ends_m = (approach.arm.street.stop_line_m, site.approaches[k].arm.street.stop_line_m)
            moves += [Move(_add_connector(draft, a, b, ends_m), i, k, turn) for a, b in pairs]
    return Site(site.approaches, tuple(moves))


def _turn(before: Arm, after: Arm) -> Turn:
    """Classify the turn from one arm to another."""
    angle = float(wrap(after.base.heading - before.base.heading - math.pi))
    if abs(angle) < math.pi / 4:
        return Turn.STRAIGHT
    return Turn.LEFT if angle > 0 else Turn.RIGHT


def _add_connector(draft: Draft, before: int, after: int, ends_m: tuple[float, float]) -> int:
    """Add a connector between lanes, straight over the distances ``ends_m`` from the stop lines to the mouths."""
    a, b = draft.lanes[before], draft.lanes[after]
    # The bend lies between the mouths: a turn from the stop line would cut the corner.
    first = straight(a.curve.end, ends_m[0])
    last = straight(b.curve.start.ahead(-ends_m[1]), ends_m[1])
    curve = join_curves(first, connect_poses(first.end, last.start), last)
    connector = draft.lane(resample(curve, STEP_M), a.width_m, a.limit_mps, connector=True)
    draft.link(before, connector)
    draft.link(connector, after)
    return connector


def starts(draft: Draft, lanes: Sequence[int]) -> tuple[Start, ...]:
    """Return starts on inward lanes; a repeated lane is drawn more often."""
    result = []
    for index in lanes:
        length, limit = draft.lanes[index].length_m, draft.lanes[index].limit_mps
        result.append(Start(index, length - min(_EARLIEST_M, _EARLIEST_S * limit), length - _LATEST_M))
    return tuple(result)


#: An approach: number of its site, and its number there.
Place = tuple[int, int]


def finish_sites(
    rng: np.random.Generator, style: RoadStyle, draft: Draft, sites: Sequence[Site],
    links: dict[Place, Place], geometry: Geometry,
) -> None:  # fmt: skip
    """Add the counter-clockwise boundary of all sites, markings, crossings, and, at the style's rate, sidewalks.

    ``links`` pairs the approaches at the two ends of a street, in both directions; linked sites form a tree.
    """
    first = next((0, i) for i in range(len(sites[0].approaches)) if (0, i) not in links)
    kerbs, end = [], first
    while not kerbs or end != first:
        kerb, end = _kerb_between_ends(sites, links, end)
        kerbs.append(kerb)
    draft.edges.append(Line(RoadKind.EDGE_BOUNDARY, ring(*kerbs)))
    sidewalk_m = float(rng.uniform(*geometry.sidewalk_m))
    if rng.random() < style.sidewalk_share:
        draft.sidewalks += [kerb.parallel(-sidewalk_m) for kerb in kerbs]
    for number, site in enumerate(sites):
        for i, approach in enumerate(site.approaches):
            # A street between two sites is marked once.
            if links.get((number, i), (number, i)) >= (number, i):
                _add_markings(draft, approach.arm.street, approach.middle)
        _add_crossings(draft, site)


def _kerb_between_ends(sites: Sequence[Site], links: dict[Place, Place], begin: Place) -> tuple[Curve, Place]:
    """Return the edge from one arm that leads off the map to the next such arm, and that arm.

    The edge leads inwards on the left of an arm, round the corners, and outwards on the right of another arm.
    """

    def approach(place: Place) -> Approach:
        return sites[place[0]].approaches[place[1]]

    pieces = [approach(begin).side.parallel(approach(begin).arm.street.left_m).reverse()]
    end = begin
    while True:
        after = (end[0], (end[1] + 1) % len(sites[end[0]].approaches))
        side = approach(after).side.parallel(-approach(after).arm.street.right_m)
        pieces += [connect_poses(pieces[-1].end, side.start), side]
        if after not in links:
            return join_curves(*pieces), after
        end = links[after]


def _add_markings(draft: Draft, street: CrossSection, middle: Curve) -> None:
    """Add the markings of a street."""
    draft.mark(RoadKind.LINE_SOLID_DOUBLE_YELLOW, middle)
    for side, count in ((1.0, street.inward), (-1.0, street.outward)):
        for j in range(1, count + 1):
            kind = RoadKind.LINE_SOLID_SINGLE_WHITE if j == count else RoadKind.LINE_BROKEN_SINGLE_WHITE
            draft.mark(kind, middle.parallel(side * (street.gap_m / 2 + j * street.width_m)))


def _add_crossings(draft: Draft, site: Site) -> None:
    """Add a crossing at the mouth of each approach, with a crosswalk where it is marked."""
    for i, approach in enumerate(site.approaches):
        street = approach.arm.street
        left, right, (begin, end) = street.left_m, -street.right_m, street.crossing_m
        near, far = (approach.arm.base.ahead(approach.mouth_m + metres) for metres in (begin, end))
        if street.marked:
            draft.crosswalk(
                near.shift_left(left), far.shift_left(left), far.shift_left(right), near.shift_left(right)
            )
        # Connectors begin and end at the stop line.
        to_axis_m = street.stop_line_m - (begin + end) / 2
        entering = [(move.lane, to_axis_m) for move in site.moves if move.arm == i]
        leaving = [
            (move.lane, draft.lanes[move.lane].length_m - to_axis_m) for move in site.moves if move.to == i
        ]
        middle = near.ahead((end - begin) / 2)
        axis = points(middle.shift_left(left), middle.shift_left(right))
        draft.crossings.append(Crossing(axis, end - begin, (*entering, *leaving), street.marked))
