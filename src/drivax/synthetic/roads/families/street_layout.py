"""Layout of a street along a reference line: strips of lanes, cut into sections, with edges, bays and sidewalks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float64

from drivax.scenario.schema import RoadKind
from drivax.synthetic.roads.curves import STEP_M, Curve, Pose, smooth_step, winding
from drivax.synthetic.roads.draft import Draft, ring
from drivax.synthetic.roads.network import Bay, Crossing, Line, Start

#: Lanes of a street by the place of their strip and their section.
Laid = dict[tuple[int, int], int]
#: Width of a crosswalk, m.
CROSSWALK_M = 3.2
#: Distance from a median's kerb to the adjacent lane, m.
_KERB_M = 0.4
#: Least distance of a bay to a crossing's axis, m.
_BAY_CLEAR_M = 8.0


@dataclass(frozen=True)
class Strip:
    """A lane's width along the street.

    Attributes:
        place: -1 is the first lane right of the middle line, -2 the next one, 1 the first one to the left.
        forward: Whether traffic goes along the middle line or against it.
        first, last: Range of its sections, ``last`` excluded.
        fork: It branches off from the strip nearer to the middle in the section before ``first``.
        ends: Its last lane ends while the road continues and narrows.
        exit_only: It leads off the road at its end.
    """

    place: int
    forward: bool
    first: int
    last: int
    fork: bool = False
    ends: bool = False
    exit_only: bool = False


def strips(ahead: int, back: int, sections: int) -> tuple[Strip, ...]:
    """Strips over the whole length: lanes ahead right of the middle line, opposite lanes to the left of it."""
    forward = [Strip(-j - 1, True, 0, sections) for j in range(ahead)]
    return (*forward, *(Strip(j + 1, False, 0, sections) for j in range(back)))


@dataclass(frozen=True)
class Street:
    """A cross-section along a reference line.

    Attributes:
        middle: The reference line: between the directions, or anywhere in a one-way road.
        cuts: Samples of the line at which sections begin, and its last sample.
        median_m: Width of the raised median along the middle line, 0 without one.
        rows_m: Width of the parking rows beyond the lanes, right and left of the middle line.
        taper_m: Length over which the edge moves in beyond a strip that ends.
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
        """Share of a strip's width at every sample: it grows along a fork and shrinks on a taper."""
        index = np.arange(len(self.middle.xy))
        here = (index >= self.cuts[strip.first]) & (index <= self.cuts[strip.last])
        present = here.astype(float)
        if strip.fork:
            begin, end = self.cuts[strip.first - 1], self.cuts[strip.first]
            present = np.where(index < end, smooth_step((index - begin) / (end - begin)), present)
        if strip.ends:
            beyond = (index - self.cuts[strip.last]) * STEP_M / self.taper_m
            present = np.where(beyond > 0, 1.0 - smooth_step(beyond), present)
        return present

    def start_draft(self) -> tuple[Draft, Laid]:
        """Return a draft with the street's lanes, edges and markings, and its lanes."""
        draft = Draft()
        laid = self.lay(draft)
        self.bound(draft)
        self.paint(draft)
        return draft, laid

    def lay(self, draft: Draft) -> Laid:
        """Add all lanes with their links."""
        laid: Laid = {}
        for strip in self.strips:
            line = self.middle.shifted(self.offset_m(strip.place))
            for k in range(strip.first, strip.last):
                piece = line.piece(self.cuts[k], self.cuts[k + 1])
                laid[strip.place, k] = draft.lane(
                    piece if strip.forward else piece.reversed(),
                    self.width_m,
                    self.limit_mps,
                    ends=strip.ends and k == strip.last - 1,
                    exit_only=strip.exit_only,
                    kind=self.kind,
                )
            for k in range(strip.first, strip.last - 1):
                a, b = laid[strip.place, k], laid[strip.place, k + 1]
                draft.link(*((a, b) if strip.forward else (b, a)))
        for strip in self.strips:
            self._link_neighbours(draft, strip, laid)
            if strip.fork:
                laid[strip.place, strip.first - 1] = self._fork(draft, strip, laid)
        return laid

    def starts(self, draft: Draft, laid: Laid) -> tuple[Start, ...]:
        """Starts in the second half of the second section of all lanes ahead."""
        lanes = [laid[s.place, 1] for s in self.strips if s.forward and (s.place, 1) in laid]
        lengths = [draft.lanes[lane].length_m for lane in lanes]
        return tuple(Start(k, 0.5 * m, 0.94 * m) for k, m in zip(lanes, lengths, strict=True))

    def _link_neighbours(self, draft: Draft, strip: Strip, laid: Laid) -> None:
        """Link a strip with the one to its right as seen along the middle line."""
        place = strip.place - 1 or -1
        right = next((s for s in self.strips if s.place == place and s.forward == strip.forward), None)
        if right is None or (self.median_m and place * strip.place < 0):
            return
        for k in range(max(strip.first, right.first), min(strip.last, right.last)):
            pair = laid[strip.place, k], laid[place, k]
            draft.link_neighbours(*(pair if strip.forward else pair[::-1]))

    def _fork(self, draft: Draft, strip: Strip, laid: Laid) -> int:
        """Add the lane by which a strip branches off from its neighbour nearer to the middle line."""
        inner = strip.place - int(np.sign(strip.place))
        k, offset = strip.first - 1, self.offset_m(inner)
        piece = self.middle.piece(self.cuts[k], self.cuts[k + 1])
        share = smooth_step(np.linspace(0.0, 1.0, len(piece.xy)))
        curve = piece.displaced(offset + share * (self.offset_m(strip.place) - offset))
        lane = draft.lane(curve, self.width_m, self.limit_mps, exit_only=strip.exit_only, kind=self.kind)
        draft.link(laid[inner, k - 1], lane)
        draft.link(lane, laid[strip.place, strip.first])
        return lane

    def bound(self, draft: Draft) -> None:
        """Add the road's boundary and the median."""
        right, left = self.edge_m
        outer = ring(self.middle.displaced(-right), self.middle.displaced(left).reversed())
        draft.edges.append(Line(RoadKind.EDGE_BOUNDARY, outer))
        self.divide(draft)

    def divide(self, draft: Draft) -> None:
        """Add the median, if any; traffic may pass around its ends."""
        if self.median_m:
            half, end = self.median_m / 2 - _KERB_M, round(2 / STEP_M)
            inner = self.middle.piece(end, len(self.middle.xy) - 1 - end)
            island = ring(inner.shifted(half), inner.shifted(-half).reversed())
            draft.edges.append(Line(RoadKind.EDGE_MEDIAN, island))

    def paint(self, draft: Draft) -> None:
        """Add the markings: white along and between lanes of one direction, yellow between directions."""
        for side, reach in zip((-1.0, 1.0), self.reach_m, strict=True):
            if reach[0] > self.median_m / 2:
                draft.mark(RoadKind.LINE_SOLID_SINGLE_WHITE, self.middle.displaced(side * reach))
        self.paint_inside(draft)

    def paint_inside(self, draft: Draft) -> None:
        """Add the markings between lanes and between directions."""
        for strip in self.strips:
            inner = strip.place - int(np.sign(strip.place))
            if inner:
                first, last = self.cuts[strip.first], self.cuts[strip.last]
                aside = self.offset_m(strip.place) + (0.5 if inner < 0 else -0.5) * self.width_m
                line = self.middle.piece(first, last).shifted(aside)
                draft.mark(RoadKind.LINE_BROKEN_SINGLE_WHITE, line)
        self._paint_middle(draft)

    def _paint_middle(self, draft: Draft) -> None:
        one_way = len({strip.forward for strip in self.strips}) == 1
        left = [strip for strip in self.strips if strip.place > 0]
        if one_way and left:
            first, last = max(s.first for s in left), max(s.last for s in left)
            middle = self.middle.piece(self.cuts[first], self.cuts[last])
            draft.mark(RoadKind.LINE_BROKEN_SINGLE_WHITE, middle)
        elif one_way:
            draft.mark(RoadKind.LINE_SOLID_SINGLE_YELLOW, self.middle)
        elif self.median_m:
            draft.mark(RoadKind.LINE_SOLID_SINGLE_YELLOW, self.middle.shifted(-self.median_m / 2))
            draft.mark(RoadKind.LINE_SOLID_SINGLE_YELLOW, self.middle.shifted(self.median_m / 2))
        elif len(self.strips) == 2:
            draft.mark(RoadKind.LINE_BROKEN_SINGLE_YELLOW, self.middle)
        else:
            draft.mark(RoadKind.LINE_SOLID_DOUBLE_YELLOW, self.middle)

    def walk(self, draft: Draft, rng: np.random.Generator) -> None:
        """Add a sidewalk on both sides, 1.2 to 2.5 m outside the edges."""
        right, left = self.edge_m
        away = float(rng.uniform(1.2, 2.5))
        draft.walks += [self.middle.displaced(-right - away), self.middle.displaced(left + away)]

    def cross(self, draft: Draft, laid: Laid, at: int, marked: bool) -> None:
        """Add a crossing at a sample of the middle line, with a crosswalk where it is marked."""
        right, left = self.edge_m
        here = self.middle.pose(at)
        axis = np.array([[p.x, p.y] for p in (here.aside(-right[at]), here.aside(left[at]))])
        lanes = []
        for (place, k), lane in laid.items():
            first, last = self.cuts[k], self.cuts[k + 1]
            if first < at <= last:
                lanes.append((lane, self._along(draft, place, k, lane, at)))
        draft.crossings.append(Crossing(axis, CROSSWALK_M, tuple(lanes), marked))
        if marked:
            near, far = (here.ahead(CROSSWALK_M / 2 * sign) for sign in (-1.0, 1.0))
            draft.crosswalk(
                near.aside(-right[at]), near.aside(left[at]), far.aside(left[at]), far.aside(-right[at])
            )

    def _along(self, draft: Draft, place: int, section: int, lane: int, at: int) -> float:
        """Distance along a lane of a section at sample ``at`` of the middle line, m."""
        forward = next(s.forward for s in self.strips if s.place == place)
        index = at - self.cuts[section] if forward else self.cuts[section + 1] - at
        return float(draft.lanes[lane].curve.arc_m[index])

    def park(
        self, draft: Draft, laid: Laid, between_m: tuple[float, float], rng: np.random.Generator
    ) -> None:
        """Add bays in the parking rows, with gaps for driveways and at crossings."""
        for side, row in zip((-1, 1), self.rows_m, strict=True):
            places = [strip.place for strip in self.strips if strip.place * side > 0]
            if not row:
                continue
            outer = max(places, key=abs) if places else -side
            aside = side * (self.median_m / 2 + len(places) * self.width_m + row / 2)
            at, pitch = between_m[0] + float(rng.uniform(0.0, 8.0)), float(rng.uniform(5.8, 6.6))
            # In bends the inner row is shorter than the middle line.
            stretch = 1.0 - aside * np.gradient(self.middle.heading, STEP_M)
            while at + 1.5 * pitch < between_m[1]:
                if rng.random() < 0.08:
                    at += float(rng.uniform(4.0, 9.0))
                    continue
                room = pitch / float(stretch[round((at + pitch / 2) / STEP_M)])
                self._bay(draft, laid, outer, aside, at + room / 2, pitch)
                at += room

    def _bay(self, draft: Draft, laid: Laid, place: int, aside: float, at_m: float, length_m: float) -> None:
        at = round(at_m / STEP_M)
        section = next(k for k, (_, last) in enumerate(pairwise(self.cuts)) if at <= last)
        pose = self.middle.pose(at).aside(aside)
        # Bays do not hide crossings.
        along = np.array([np.cos(pose.heading), np.sin(pose.heading)])
        to = [crossing.axis.mean(axis=0) - [pose.x, pose.y] for crossing in draft.crossings]
        if any(np.hypot(*d) < 30.0 and abs(d @ along) < _BAY_CLEAR_M for d in to):
            return
        forward = next(s.forward for s in self.strips if s.place == place)
        pose = pose if forward else pose.turned()
        lane = laid[place, section]
        draft.bays.append(Bay(pose, length_m, lane, self._along(draft, place, section, lane, at)))


@dataclass(frozen=True)
class StreetFamily:
    """Settings that families of streets share.

    Attributes:
        length_m: Length of the reference line; a whole route must fit the grid of a stored scenario.
        section_m: Length of the sections into which lanes are cut.
        tightest_m: Radius of the tightest bend, drawn per road, low and high.
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
        """Draw the reference line; ``curvature`` is the style's factor on the tightest bend."""
        return winding(
            rng,
            self.length_m,
            max_curvature=curvature / float(rng.uniform(*self.tightest_m)),
            max_turn=self.widest_turn,
            start=Pose(0.0, 0.0, float(rng.uniform(-math.pi, math.pi))),
        )
