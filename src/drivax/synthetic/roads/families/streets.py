"""Families of roads without junctions: curved and straight roads, lane drops, crosswalks, parked cars, highways."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from drivax.scenario.schema import RoadKind
from drivax.synthetic.roads.curves import STEP_M, Curve, from_curvature
from drivax.synthetic.roads.families.street_layout import Street, StreetFamily, Strip, strips
from drivax.synthetic.roads.network import (
    GRID,
    Layouts,
    Line,
    RoadNetwork,
    RoadStyle,
    Start,
    draw_layout,
    ring,
)

#: Limits below which curved and straight roads may have bays, and streets crossings away from junctions, m/s.
_PARKING_LIMIT_MPS, _CROSSING_LIMIT_MPS = 14.0, 17.0
_CROSSWALK_LAYOUTS: Layouts = ((1, 1, 0.45), (2, 2, 0.25), (2, 1, 0.1), (2, 0, 0.1), (1, 0, 0.1))
#: Width of a parking row, low and high, m.
_ROW_M = (2.1, 2.4)
#: Length over which a ramp's curvature rises and falls, m.
_EASING_M = 40.0
#: Drivable width left of a ramp's lane, m.
_RAMP_SHOULDER_M = 0.7


@dataclass(frozen=True)
class CurvedRoad(StreetFamily):
    """Settings of the families ``curved_road`` and ``straight_road``.

    Attributes:
        layouts: Lanes ahead, lanes the other way, and the share of that layout.
        median_share: Share of two-way roads with a raised median.
    """

    tightest_m: tuple[float, float] = (30.0, 140.0)
    widest_turn: float = math.radians(150.0)
    layouts: Layouts = ((1, 1, 0.28), (2, 0, 0.16), (2, 1, 0.12), (2, 2, 0.24), (3, 0, 0.1), (3, 1, 0.1))
    median_share: float = 0.3
    name: str = "curved_road"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draw a road; ego starts in the second section of any lane ahead."""
        ahead, back = draw_layout(rng, self.layouts)
        middle = self.draw_middle(rng, style.curvature)
        limit = float(rng.choice(style.limits_mps))
        parking = limit < _PARKING_LIMIT_MPS and rng.random() < style.parking_share
        row_m = float(rng.uniform(*_ROW_M)) if parking else 0.0
        street = Street(
            middle=middle,
            cuts=self.cuts,
            strips=strips(ahead, back, len(self.cuts) - 1),
            width_m=float(rng.uniform(*style.width_m)),
            limit_mps=limit,
            shoulder_m=float(rng.uniform(*style.shoulder_m)),
            median_m=float(rng.uniform(1.5, 3.0)) if back and rng.random() < self.median_share else 0.0,
            rows_m=(row_m, row_m if back else 0.0),
        )
        street.build()
        if rng.random() < style.sidewalk_share:
            street.add_sidewalks(rng)
        street.add_bays(20.0, rng)
        return street.network(self.name)


#: The family ``straight_road``: up to four lanes ahead, slight bends.
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
        gain_share: Share of roads that gain a lane instead of losing one.
        left_share: Of the one-way roads that lose a lane, the share that loses the left one.
        taper_m: Length over which the road narrows beyond the lane's end, low and high.
    """

    tightest_m: tuple[float, float] = (150.0, 900.0)
    two_way_share: float = 0.5
    left_share: float = 0.4
    gain_share: float = 0.2
    taper_m: tuple[float, float] = (30.0, 70.0)
    name: str = "lane_drop"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draw a road with two or three lanes ahead; one ends, or reaches full width, 85 to 200 m ahead of ego."""
        street = Street(
            middle=self.draw_middle(rng, style.curvature),
            cuts=self.cuts,
            strips=self._strips(rng, len(self.cuts) - 1),
            width_m=float(rng.uniform(*style.width_m)),
            limit_mps=float(rng.choice(style.limits_mps)),
            shoulder_m=float(rng.uniform(*style.shoulder_m)),
            taper_m=float(rng.uniform(*self.taper_m)),
        )
        street.build()
        if rng.random() < style.sidewalk_share:
            street.add_sidewalks(rng)
        return street.network(self.name)

    def _strips(self, rng: np.random.Generator, sections: int) -> tuple[Strip, ...]:
        """Draw the lanes; the rightmost one, or the one left of the middle line, changes."""
        lanes, section = int(rng.integers(2, 4)), int(rng.integers(3, 5))
        both_ways = rng.random() < self.two_way_share
        gains, left = rng.random() < self.gain_share, rng.random() < self.left_share
        if left and not both_ways and not gains:
            return (Strip(1, True, 0, section, ends=True), *strips(lanes - 1, 0, sections))
        *remainder, outer = strips(lanes, 0, sections)
        outer = replace(outer, first=section, fork=True) if gains else replace(outer, last=section, ends=True)
        return (*remainder, outer, *strips(0, int(both_ways), sections))


@dataclass(frozen=True)
class MidblockCrosswalk(StreetFamily):
    """Settings of the family ``midblock_crosswalk``: a street with crossings away from junctions.

    Attributes:
        crossing_m: Station of the first crossing, low and high; ego starts at 120 to 155 m.
        apart_m: Distance to a second crossing, low and high.
        marked_share, second_share: Shares of crossings with a crosswalk, and of streets with two crossings.
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
        ahead, back = draw_layout(rng, _CROSSWALK_LAYOUTS)
        middle = self.draw_middle(rng, style.curvature)
        row_m = float(rng.uniform(*_ROW_M)) if rng.random() < style.parking_share else 0.0
        limits = [v for v in style.limits_mps if v < _CROSSING_LIMIT_MPS] or [min(style.limits_mps)]
        street = Street(
            middle=middle,
            cuts=self.cuts,
            strips=strips(ahead, back, len(self.cuts) - 1),
            width_m=float(rng.uniform(*style.width_m)),
            limit_mps=float(rng.choice(limits)),
            shoulder_m=float(rng.uniform(*style.shoulder_m)),
            median_m=float(rng.uniform(1.8, 3.0)) if back and rng.random() < self.median_share else 0.0,
            rows_m=(row_m, row_m if back else 0.0),
        )
        street.build()
        street.add_sidewalks(rng)
        stations = [float(rng.uniform(*self.crossing_m))]
        if rng.random() < self.second_share:
            stations.append(stations[0] + float(rng.uniform(*self.apart_m)))
        for station in stations:
            street.add_crossing(round(station / STEP_M), marked=bool(rng.random() < self.marked_share))
        street.add_bays(20.0, rng)
        return street.network(self.name)


@dataclass(frozen=True)
class ParkedStreet(StreetFamily):
    """Settings of the family ``parked_street``: a narrow street with bays along one or both sides.

    A share of the streets (``crossing_share``) has a crossing, half of these a crosswalk.
    """

    length_m: float = 480.0
    tightest_m: tuple[float, float] = (80.0, 600.0)
    one_way_share: float = 0.35
    both_sides_share: float = 0.65
    crossing_share: float = 0.5
    row_m: tuple[float, float] = (2.0, 2.4)
    name: str = "parked_street"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draw a narrow street with one of the two lowest limits of the style; a repeated limit counts twice."""
        one_way = rng.random() < self.one_way_share
        middle = self.draw_middle(rng, style.curvature)
        row_m = float(rng.uniform(*self.row_m))
        sides = (1, 1) if rng.random() < self.both_sides_share else [(1, 0), (0, 1)][int(rng.integers(2))]
        narrowest = style.width_m[0]
        street = Street(
            middle=middle,
            cuts=self.cuts,
            strips=strips(1, 0 if one_way else 1, len(self.cuts) - 1),
            width_m=float(rng.uniform(narrowest - 0.1, narrowest + 0.2)),
            limit_mps=float(rng.choice(sorted(style.limits_mps)[:2])),
            shoulder_m=float(rng.uniform(0.1, 0.4)),
            rows_m=(row_m * sides[0], row_m * sides[1]),
        )
        street.build()
        street.add_sidewalks(rng)
        if rng.random() < self.crossing_share:
            sample = round(float(rng.uniform(170.0, 250.0)) / STEP_M)
            street.add_crossing(sample, marked=bool(rng.random() < 0.5))
        street.add_bays(15.0, rng)
        return street.network(self.name)


@dataclass(frozen=True)
class _Ramp:
    """A ramp, its edges, and the nose, where its left edge meets the highway's right edge.

    Attributes:
        left, right: Edges in the direction of traffic; the left one ends (off-ramp: begins) at the nose.
        nose: Sample of the highway's middle line next to the nose.
    """

    lane: int
    left: Curve
    right: Curve
    nose: int


@dataclass(frozen=True)
class Highway(StreetFamily):
    """Settings of the family ``highway``.

    Attributes:
        shares: Shares of highways with an on-ramp, with an off-ramp and with both.
        two_way_share: Share of highways of two or three lanes with the other direction beyond a median (``median_m``).
        ramp_m: Length of an on-ramp and of an off-ramp.
        ramp_radius_m, ramp_turn: Radius and angle (rad) of a ramp's bend, low and high.
        ramp_limit: Limit on ramps as a share of the highway's, low and high.
    """

    length_m: float = 720.0
    section_m: float = 90.0
    tightest_m: tuple[float, float] = (600.0, 3000.0)
    widest_turn: float = math.radians(30.0)
    shares: tuple[float, float, float] = (0.5, 0.25, 0.25)
    two_way_share: float = 0.5
    median_m: tuple[float, float] = (3.0, 8.0)
    shoulder_m: tuple[float, float] = (1.5, 3.0)
    ramp_m: tuple[float, float] = (235.0, 180.0)
    ramp_radius_m: tuple[float, float] = (180.0, 350.0)
    ramp_turn: tuple[float, float] = (math.radians(10.0), math.radians(24.0))
    ramp_limit: tuple[float, float] = (0.62, 0.75)
    name: str = "highway"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draw a highway; ego starts 25 to 70 m before the auxiliary lane begins, or on the on-ramp."""
        middle = self.draw_middle(rng)
        lanes = int(rng.integers(2, 5))
        # At most five lanes and the auxiliary lane fit the map of a stored scenario.
        back = int(rng.integers(2, 6 - lanes)) if lanes < 4 and rng.random() < self.two_way_share else 0
        strip = self._draw_auxiliary_lane(rng, lanes)
        street = Street(
            middle=middle,
            cuts=self.cuts,
            strips=(*strips(lanes, back, len(self.cuts) - 1), strip),
            width_m=max(3.4, float(rng.uniform(*style.width_m))),
            limit_mps=float(rng.choice(style.fast_limits_mps)),
            shoulder_m=float(rng.uniform(*self.shoulder_m)),
            median_m=float(rng.uniform(*self.median_m)) if back else 0.0,
            taper_m=float(rng.uniform(50.0, 90.0)),
            kind=RoadKind.LANE_FREEWAY,
        )
        street.add_lanes()
        on_ramp = None if strip.fork else self._ramp(rng, street, strip, direction=-1)
        off_ramp = self._ramp(rng, street, strip, direction=1) if strip.exit_only else None
        _add_boundary(street, strip, on_ramp, off_ramp)
        _add_markings(street, strip, on_ramp, off_ramp)
        starts = [Start(street.lanes[-j - 1, 2], 20.0, 65.0) for j in range(lanes)]
        if on_ramp is not None:
            starts += [Start(on_ramp.lane, self.ramp_m[0] - 110.0, self.ramp_m[0] - 30.0)] * 2
        return street.draft.network(self.name, tuple(starts))

    def _draw_auxiliary_lane(self, rng: np.random.Generator, lanes: int) -> Strip:
        """Draw the auxiliary lane: for entering, for leaving, or for both."""
        purpose = rng.choice(3, p=self.shares)
        place, length = -lanes - 1, int(rng.integers(2, 4))
        if purpose == 0:
            return Strip(place, True, 3, 3 + length, ends=True)
        if purpose == 1:
            return Strip(place, True, 4, 3 + length, fork=True, exit_only=True)
        return Strip(place, True, 3, 3 + length, exit_only=True)

    def _ramp(self, rng: np.random.Generator, street: Street, strip: Strip, direction: int) -> _Ramp:
        """Add a ramp at the beginning of the auxiliary lane (``direction`` -1) or at its end (1)."""
        auxiliary_lane = street.lanes[strip.place, strip.first if direction < 0 else strip.last - 1]
        cut = street.cuts[strip.first if direction < 0 else strip.last]
        length = self.ramp_m[0 if direction < 0 else 1]
        line = street.draft.lanes[auxiliary_lane].curve
        gore = line.start.reverse() if direction < 0 else line.end
        # Followed away from the highway, an on-ramp bends to the left and an off-ramp to the right.
        curvature = np.gradient(street.middle.heading, STEP_M)[cut::direction] * direction
        road_curvature = curvature[: round(length / STEP_M) + 1]
        bend = _bend(length, float(rng.uniform(*self.ramp_radius_m)), float(rng.uniform(*self.ramp_turn)))
        outward = from_curvature(road_curvature - direction * bend, STEP_M, gore)
        curve = outward if direction > 0 else outward.reverse()
        limit = street.limit_mps * float(rng.uniform(*self.ramp_limit))
        lane = street.draft.lane(curve, street.width_m, limit, kind=street.kind, exit_only=direction > 0)
        street.draft.link(*((lane, auxiliary_lane) if direction < 0 else (auxiliary_lane, lane)))
        half = street.width_m / 2
        left, right = curve.parallel(half + _RAMP_SHOULDER_M), curve.parallel(-half - street.shoulder_m)
        nose, sample = _nose(street, strip, left if direction > 0 else left.reverse())
        last = len(left.xy) - 1
        left = left.piece(nose, last) if direction > 0 else left.piece(0, last - nose)
        return _Ramp(lane, left, right, sample)


def _bend(length_m: float, radius_m: float, angle: float) -> Float64[np.ndarray, " point"]:
    """Return the curvature of a bend by an angle: it rises to 1 / radius (less for small angles), holds and falls."""
    hold = max(0.0, angle * radius_m - _EASING_M)
    knots = np.cumsum([0.0, _EASING_M, hold, _EASING_M])
    position = STEP_M * np.arange(round(length_m / STEP_M) + 1)
    peak = angle / (hold + _EASING_M)
    return np.interp(position, knots, [0.0, peak, peak, 0.0])


def _main_edge(street: Street, strip: Strip) -> Curve:
    """Return the right edge of the highway without its auxiliary lane."""
    reach = street.reach_m[0] - street.width_m * street.presence(strip) + street.shoulder_m
    return street.middle.offset_by(-reach)


def _nose(street: Street, strip: Strip, left: Curve) -> tuple[int, int]:
    """Find the first sample of a ramp's left edge beyond the highway's edge, and the nearest sample of that edge."""
    edge = _main_edge(street, strip)
    # The nose lies within 150 m of the beginning of the ramp.
    span = round(150.0 / STEP_M)
    gore = int(np.argmin(np.sum((edge.xy - left.xy[0]) ** 2, axis=-1)))
    first, points = max(0, gore - span), left.xy[:span]
    window = edge.xy[first : gore + span]
    x, y = (np.subtract.outer(points[:, axis], window[:, axis]) for axis in (0, 1))
    nearest = first + np.argmin(x**2 + y**2, axis=1)
    dx, dy = (points - edge.xy[nearest]).T
    lateral = -dx * np.sin(edge.heading[nearest]) + dy * np.cos(edge.heading[nearest])
    sample = int(np.argmax(lateral < -0.05))
    return sample, int(nearest[sample])


def _add_boundary(street: Street, strip: Strip, on_ramp: _Ramp | None, off_ramp: _Ramp | None) -> None:
    """Add the median, and the boundary: along the right edge with the ramps, and back along the left edge."""
    right, left = street.edge_m
    main, full, last = _main_edge(street, strip), street.middle.offset_by(-right), len(right) - 1
    # The main edge stops a metre from a nose, which blunts its tip.
    pieces, begin = [], 0
    if on_ramp is not None:
        begin = street.cuts[strip.first]
        pieces += [main.piece(0, on_ramp.nose - 2), on_ramp.left.reverse(), on_ramp.right]
    end = last if off_ramp is None else street.cuts[strip.last]
    pieces.append(full.piece(begin, end))
    if off_ramp is not None:
        pieces += [off_ramp.right, off_ramp.left.reverse(), main.piece(off_ramp.nose + 2, last)]
    pieces.append(street.middle.offset_by(left).reverse())
    street.draft.edges.append(Line(RoadKind.EDGE_BOUNDARY, ring(*pieces)))
    street.add_median()


def _add_markings(street: Street, strip: Strip, on_ramp: _Ramp | None, off_ramp: _Ramp | None) -> None:
    """Add the markings of the highway and its ramps."""
    street.add_markings()
    inset = replace(street, shoulder_m=0.1)
    right, left = inset.edge_m
    main, last = _main_edge(inset, strip), len(right) - 1
    begin = 0 if on_ramp is None else street.cuts[strip.first]
    end = last if off_ramp is None else street.cuts[strip.last]
    lines = [] if on_ramp is None else [main.piece(0, on_ramp.nose)]
    lines.append(street.middle.offset_by(-right).piece(begin, end))
    if off_ramp is not None:
        lines.append(main.piece(off_ramp.nose, last))
    if any(strip.place > 0 for strip in street.strips):
        lines.append(street.middle.offset_by(left))
    for ramp in (on_ramp, off_ramp):
        if ramp is not None:
            lines += [ramp.left.parallel(-_RAMP_SHOULDER_M), ramp.right.parallel(street.shoulder_m)]
    for line in lines:
        street.draft.mark(RoadKind.LINE_SOLID_SINGLE_WHITE, line)
