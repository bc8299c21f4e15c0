"""Layout of a street along a reference line: strips of lanes, cut into sections, with edges, bays and sidewalks."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from drivax.scenario.schema import RoadKind
from drivax.synthetic.roads.curves import STEP_M, Curve, Pose, draw_winding_curve, smooth_step
from drivax.synthetic.roads.network import Bay, Crossing, Draft, Line, RoadNetwork, Start, points, ring

#: Width of a crosswalk, m.
CROSSWALK_M = 3.2
#: Distance from a median's kerb to the adjacent lane, m.
_KERB_M = 0.4
#: Least distance of a bay's middle from a crossing's axis, m.
_BAY_CLEAR_M = 8.0
#: Length of bays and of gaps for driveways, low and high, m, and probability of such a gap.
_BAY_M, _DRIVEWAY_M, _DRIVEWAY_SHARE = (5.8, 6.6), (4.0, 9.0), 0.08


@dataclass(frozen=True)
class Strip:
    """A lane over some sections of a street.

    Attributes:
        place: -1 is the first lane right of the middle line, -2 the next one, 1 the first one to the left.
        forward: Whether traffic goes along the middle line or against it.
        first, last: Range of its sections, ``last`` excluded.
        fork: Whether it branches off from the strip nearer to the middle in the section before ``first``.
        ends: Whether its last lane ends while the road continues and narrows.
        exit_only: Whether it leads off the road at its end.
    """

    place: int
    forward: bool
    first: int
    last: int
    fork: bool = False
    ends: bool = False
    exit_only: bool = False


def strips(ahead: int, back: int, sections: int) -> tuple[Strip, ...]:
    """Return strips over the whole length: lanes ahead on the right of the middle line, opposite ones on the left."""
    forward = [Strip(-j - 1, True, 0, sections) for j in range(ahead)]
    return (*forward, *(Strip(j + 1, False, 0, sections) for j in range(back)))


@dataclass(frozen=True)
class Street:
    """A street along a reference line, and the draft to which it is added.

    Attributes:
        middle: The reference line: between the directions, or anywhere in a one-way road.
        cuts: Samples of the line at which sections begin, and its last sample.
        median_m: Gap between the directions, for a raised median along the middle line; 0 without one.
        rows_m: Width of the parking rows beyond the lanes, right and left of the middle line.
        taper_m: Length over which the edge moves in beyond a strip that ends.
        lanes: Lanes of the draft by the place of their strip and their section.
    """

    middle: Curve
    cuts: tuple[int, ...]
    strips: tuple[Strip, ...]
    width_m: float
    limit_mps: float
    shoulder_m: float
    median_m: float = 0.0
    rows_m: tuple[float, float] = (0.0, 0.0)
    taper_m: float = 45.0
    kind: RoadKind = RoadKind.LANE_SURFACE
    draft: Draft = field(default_factory=Draft)
    lanes: dict[tuple[int, int], int] = field(default_factory=dict)

    def offset_m(self, place: int) -> float:
        """Offset of a strip's centre from the middle line, m, positive to the left."""
        return float(np.sign(place)) * (self.median_m / 2 + (abs(place) - 0.5) * self.width_m)

    @cached_property
    def reach_m(self) -> tuple[Float64[np.ndarray, " point"], Float64[np.ndarray, " point"]]:
        """Distance from the middle line to the outer side of the outermost lane, right and left, at every sample."""
        right, left = (np.full(len(self.middle.xy), self.median_m / 2) for _ in range(2))
        for strip in self.strips:
            side = right if strip.place < 0 else left
            side += self.width_m * self.presence(strip)
        return right, left

    @cached_property
    def edge_m(self) -> tuple[Float64[np.ndarray, " point"], Float64[np.ndarray, " point"]]:
        """Distance from the middle line to the road's edges, right and left, at every sample."""
        right, left = self.reach_m
        return right + self.shoulder_m + self.rows_m[0], left + self.shoulder_m + self.rows_m[1]

    def presence(self, strip: Strip) -> Float64[np.ndarray, " point"]:
        """Return the share of a strip's width at every sample, which grows along a fork and shrinks on a taper."""
        index = np.arange(len(self.middle.xy))
        inside = (index >= self.cuts[strip.first]) & (index <= self.cuts[strip.last])
        share = inside.astype(float)
        if strip.fork:
            begin, end = self.cuts[strip.first - 1], self.cuts[strip.first]
            share = np.where(index < end, smooth_step((index - begin) / (end - begin)), share)
        if strip.ends:
            taper = (index - self.cuts[strip.last]) * STEP_M / self.taper_m
            share = np.where(taper > 0, 1.0 - smooth_step(taper), share)
        return share

    def build(self) -> None:
        """Add the lanes, the edges and the markings."""
        self.add_lanes()
        right, left = self.edge_m
        outer = ring(self.middle.offset_by(-right), self.middle.offset_by(left).reverse())
        self.draft.edges.append(Line(RoadKind.EDGE_BOUNDARY, outer))
        self.add_median()
        for side, reach in zip((-1.0, 1.0), self.reach_m, strict=True):
            if reach[0] > self.median_m / 2:
                self.draft.mark(RoadKind.LINE_SOLID_SINGLE_WHITE, self.middle.offset_by(side * reach))
        self.add_markings()

    def add_lanes(self) -> None:
        """Add all lanes with their links."""
        for strip in self.strips:
            line = self.middle.parallel(self.offset_m(strip.place))
            for k in range(strip.first, strip.last):
                piece = line.piece(self.cuts[k], self.cuts[k + 1])
                self.lanes[strip.place, k] = self.draft.lane(
                    piece if strip.forward else piece.reverse(),
                    self.width_m,
                    self.limit_mps,
                    ends=strip.ends and k == strip.last - 1,
                    exit_only=strip.exit_only,
                    kind=self.kind,
                )
            for k in range(strip.first, strip.last - 1):
                pair = self.lanes[strip.place, k], self.lanes[strip.place, k + 1]
                self.draft.link(*(pair if strip.forward else pair[::-1]))
        for strip in self.strips:
            self._link_neighbours(strip)
            if strip.fork:
                self._add_fork(strip)

    def network(self, name: str) -> RoadNetwork:
        """Return the network; ego starts in the second half of the second section of any lane ahead."""
        lanes = [self.lanes[s.place, 1] for s in self.strips if s.forward and (s.place, 1) in self.lanes]
        lengths = [self.draft.lanes[lane].length_m for lane in lanes]
        starts = (Start(k, 0.5 * m, 0.94 * m) for k, m in zip(lanes, lengths, strict=True))
        return self.draft.network(name, tuple(starts))

    def _link_neighbours(self, strip: Strip) -> None:
        """Link a strip with the one to its right as seen along the middle line."""
        place = strip.place - 1 or -1
        right = next((s for s in self.strips if s.place == place and s.forward == strip.forward), None)
        if right is None or (self.median_m and place * strip.place < 0):
            return
        for k in range(max(strip.first, right.first), min(strip.last, right.last)):
            pair = self.lanes[strip.place, k], self.lanes[place, k]
            self.draft.link_neighbours(*(pair if strip.forward else pair[::-1]))

    def _add_fork(self, strip: Strip) -> None:
        """Add the lane by which a strip branches off from its neighbour nearer to the middle line."""
        inner = strip.place - int(np.sign(strip.place))
        k, offset = strip.first - 1, self.offset_m(inner)
        piece = self.middle.piece(self.cuts[k], self.cuts[k + 1])
        share = smooth_step(np.linspace(0.0, 1.0, len(piece.xy)))
        curve = piece.offset_by(offset + share * (self.offset_m(strip.place) - offset))
        lane = self.draft.lane(curve, self.width_m, self.limit_mps, exit_only=strip.exit_only, kind=self.kind)
        self.draft.link(self.lanes[inner, k - 1], lane)
        self.draft.link(lane, self.lanes[strip.place, strip.first])
        self.lanes[strip.place, k] = lane

    def add_median(self) -> None:
        """Add the median, if any, up to 2 m before both ends of the street."""
        if self.median_m:
            half, end = self.median_m / 2 - _KERB_M, round(2 / STEP_M)
            inner = self.middle.piece(end, len(self.middle.xy) - 1 - end)
            island = ring(inner.parallel(half), inner.parallel(-half).reverse())
            self.draft.edges.append(Line(RoadKind.EDGE_MEDIAN, island))

    def add_markings(self) -> None:
        """Add the markings between lanes, and along the middle line: white within a direction, else yellow."""
        for strip in self.strips:
            inner = strip.place - int(np.sign(strip.place))
            if inner:
                lateral = self.offset_m(strip.place) + (0.5 if inner < 0 else -0.5) * self.width_m
                line = self.middle.piece(self.cuts[strip.first], self.cuts[strip.last]).parallel(lateral)
                self.draft.mark(RoadKind.LINE_BROKEN_SINGLE_WHITE, line)
        self._mark_middle()

    def _mark_middle(self) -> None:
        """Add the markings along the middle line."""
        one_way = len({strip.forward for strip in self.strips}) == 1
        left = next((strip for strip in self.strips if strip.place == 1), None)
        kind, lines = RoadKind.LINE_SOLID_SINGLE_YELLOW, [self.middle]
        if one_way and left is not None:
            kind = RoadKind.LINE_BROKEN_SINGLE_WHITE
            lines = [self.middle.piece(self.cuts[left.first], self.cuts[left.last])]
        elif self.median_m and not one_way:
            lines = [self.middle.parallel(side * self.median_m / 2) for side in (-1, 1)]
        elif not one_way:
            broken = len(self.strips) == 2
            kind = RoadKind.LINE_BROKEN_SINGLE_YELLOW if broken else RoadKind.LINE_SOLID_DOUBLE_YELLOW
        for line in lines:
            self.draft.mark(kind, line)

    def add_sidewalks(self, rng: np.random.Generator) -> None:
        """Add a sidewalk on both sides, 1.2 to 2.5 m outside the edges."""
        right, left = self.edge_m
        distance_m = float(rng.uniform(1.2, 2.5))
        self.draft.sidewalks += [
            self.middle.offset_by(-right - distance_m),
            self.middle.offset_by(left + distance_m),
        ]

    def add_crossing(self, at: int, marked: bool) -> None:
        """Add a crossing at a sample of the middle line, with a crosswalk where it is marked."""
        current, right, left = self.middle.pose(at), -self.edge_m[0][at], self.edge_m[1][at]
        section = self._section(at)
        lanes = tuple(self._on_lane(place, k, at) for place, k in self.lanes if k == section)
        axis = points(current.shift_left(right), current.shift_left(left))
        self.draft.crossings.append(Crossing(axis, CROSSWALK_M, lanes, marked))
        if marked:
            near, far = (current.ahead(CROSSWALK_M / 2 * sign) for sign in (-1.0, 1.0))
            self.draft.crosswalk(
                near.shift_left(right), near.shift_left(left), far.shift_left(left), far.shift_left(right)
            )

    def _on_lane(self, place: int, section: int, at: int) -> tuple[int, float]:
        """Return the lane of a section, and the distance along it at sample ``at`` of the middle line, m."""
        lane = self.lanes[place, section]
        index = at - self.cuts[section] if self._forward(place) else self.cuts[section + 1] - at
        return lane, float(self.draft.lanes[lane].curve.arc_m[index])

    def _section(self, at: int) -> int:
        return next(k for k, last in enumerate(self.cuts[1:]) if at <= last)

    def _forward(self, place: int) -> bool:
        return next(strip.forward for strip in self.strips if strip.place == place)

    def add_bays(self, margin_m: float, rng: np.random.Generator) -> None:
        """Add bays in the parking rows, away from the road's ends, with gaps for driveways and at crossings."""
        end_m = STEP_M * self.cuts[-1] - margin_m
        for side, row_m in zip((-1, 1), self.rows_m, strict=True):
            places = [strip.place for strip in self.strips if strip.place * side > 0]
            if not row_m:
                continue
            outer = max(places, key=abs) if places else -side
            lateral = side * (self.median_m / 2 + len(places) * self.width_m + row_m / 2)
            position, pitch = margin_m + float(rng.uniform(0.0, 8.0)), float(rng.uniform(*_BAY_M))
            # In bends the inner row is shorter than the middle line.
            stretch = 1.0 - lateral * np.gradient(self.middle.heading, STEP_M)
            while position + 1.5 * pitch < end_m:
                if rng.random() < _DRIVEWAY_SHARE:
                    position += float(rng.uniform(*_DRIVEWAY_M))
                    continue
                room = pitch / float(stretch[round((position + pitch / 2) / STEP_M)])
                self._add_bay(outer, lateral, position + room / 2, pitch)
                position += room

    def _add_bay(self, place: int, lateral: float, at_m: float, length_m: float) -> None:
        sample = round(at_m / STEP_M)
        pose = self.middle.pose(sample).shift_left(lateral)
        # Keep the view of crossings free; in a bend, one far away may also be level with the bay.
        along = np.array([np.cos(pose.heading), np.sin(pose.heading)])
        offsets = [crossing.axis.mean(axis=0) - [pose.x, pose.y] for crossing in self.draft.crossings]
        if not any(np.hypot(*offset) < 30.0 and abs(offset @ along) < _BAY_CLEAR_M for offset in offsets):
            pose = pose if self._forward(place) else pose.reverse()
            self.draft.bays.append(Bay(pose, length_m, *self._on_lane(place, self._section(sample), sample)))


@dataclass(frozen=True)
class StreetFamily:
    """Settings that families of streets share.

    Attributes:
        length_m: Length of the reference line; the map of a stored scenario is a square of 640 m.
        section_m: Length of the sections into which lanes are cut.
        tightest_m: Least radius of bends, drawn per road, low and high; except on highways, the style's ``curvature``
            divides it.
        widest_turn: Largest difference of two headings, rad.
    """

    length_m: float = 640.0
    section_m: float = 80.0
    tightest_m: tuple[float, float] = (150.0, 900.0)
    widest_turn: float = math.radians(60.0)

    @cached_property
    def cuts(self) -> tuple[int, ...]:
        """Samples at which the reference line is cut into sections."""
        sections = max(1, round(self.length_m / self.section_m))
        last = round(self.length_m / STEP_M)
        return tuple(int(k) for k in np.linspace(0, last, sections + 1).round())

    def draw_middle(self, rng: np.random.Generator, curvature: float = 1.0) -> Curve:
        """Draw the reference line; ``curvature`` divides the least radius."""
        return draw_winding_curve(
            rng,
            self.length_m,
            max_curvature=curvature / float(rng.uniform(*self.tightest_m)),
            max_turn=self.widest_turn,
            start=Pose(0.0, 0.0, float(rng.uniform(-math.pi, math.pi))),
        )
