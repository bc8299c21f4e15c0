"""A street along a reference line: strips of lanes side by side, cut into sections, with edges, bays and walks.

Families of roads without junctions describe their cross-section with :class:`Street` and let it draw itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float64

from drivax.scenario.schema import RoadKind
from drivax.synthetic.roads.curves import STEP_M, Curve, smooth_step
from drivax.synthetic.roads.draft import Draft, ring
from drivax.synthetic.roads.network import Bay, Crossing, Line, Start

#: Lanes of a street by the place of their strip and the number of their section.
Laid = dict[tuple[int, int], int]
#: Width of a crosswalk, m.
CROSSWALK_M = 3.2
#: Between a median's kerb and the lane beside it, m.
_KERB_M = 0.4
#: No bay begins this near to a crossing's axis, m.
_BAY_CLEAR_M = 8.0


@dataclass(frozen=True)
class Strip:
    """One lane's width along the street.

    Attributes:
        place: -1 is the first lane right of the middle line, -2 the one beyond it, 1 the first one to the left.
        forward: Whether traffic goes along the middle line or against it.
        first, last: Its sections: from the first up to, not including, the last.
        fork: In the section before the first it branches off from the strip that is nearer to the middle.
        ends: Its last lane ends although the road goes on, and the road narrows behind it.
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
    """Strips over the whole length: lanes ahead right of the middle line, lanes back to the left of it."""
    forward = [Strip(-j - 1, True, 0, sections) for j in range(ahead)]
    return (*forward, *(Strip(j + 1, False, 0, sections) for j in range(back)))


@dataclass(frozen=True)
class Street:
    """A cross-section along a reference line.

    Attributes:
        middle: The reference line: between the directions, or anywhere in a one-way road.
        cuts: Samples of the line at which sections begin, and its last sample.
        median_m: Width of the raised median along the middle line, 0 none.
        rows_m: Width of the parking rows beyond the lanes, right and left of the middle line.
        taper_m: Length over which the edge moves in behind a strip that ends.
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
        """Where the centre of a strip lies, m left of the middle line."""
        return float(np.sign(place)) * (self.median_m / 2 + (abs(place) - 0.5) * self.width_m)

    @cached_property
    def reach_m(self) -> tuple[Float64[np.ndarray, " point"], Float64[np.ndarray, " point"]]:
        """From the middle line to the outer side of the outermost lane, right and left, at every sample."""
        right, left = (np.full(len(self.middle.xy), self.median_m / 2) for _ in range(2))
        for strip in self.strips:
            side = right if strip.place < 0 else left
            side += self.width_m * self.presence(strip)
        return right, left

    @cached_property
    def edge_m(self) -> tuple[Float64[np.ndarray, " point"], Float64[np.ndarray, " point"]]:
        """From the middle line to the road's edges, right and left, at every sample."""
        right, left = self.reach_m
        return right + self.shoulder_m + self.rows_m[0], left + self.shoulder_m + self.rows_m[1]

    def presence(self, strip: Strip) -> Float64[np.ndarray, " point"]:
        """How much of a strip's width the road has at every sample: it grows along a fork and shrinks on a taper."""
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

    def lay(self, draft: Draft) -> Laid:
        """Adds all lanes with their links."""
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
            self._beside(draft, strip, laid)
            if strip.fork:
                laid[strip.place, strip.first - 1] = self._fork(draft, strip, laid)
        return laid

    def starts(self, draft: Draft, laid: Laid) -> tuple[Start, ...]:
        """Ego may begin in the second half of the second section of any lane ahead."""
        lanes = [laid[s.place, 1] for s in self.strips if s.forward and (s.place, 1) in laid]
        lengths = [draft.lanes[lane].length_m for lane in lanes]
        return tuple(Start(k, 0.5 * m, 0.94 * m) for k, m in zip(lanes, lengths, strict=True))

    def _beside(self, draft: Draft, strip: Strip, laid: Laid) -> None:
        """Links a strip with the one to its right as seen along the middle line."""
        place = strip.place - 1 or -1
        right = next((s for s in self.strips if s.place == place and s.forward == strip.forward), None)
        if right is None or (self.median_m and place * strip.place < 0):
            return
        for k in range(max(strip.first, right.first), min(strip.last, right.last)):
            pair = laid[strip.place, k], laid[place, k]
            draft.beside(*(pair if strip.forward else pair[::-1]))

    def _fork(self, draft: Draft, strip: Strip, laid: Laid) -> int:
        """The lane by which a strip branches off from its neighbour nearer to the middle line."""
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
        """Adds the road's boundary and the median's island."""
        right, left = self.edge_m
        outer = ring(self.middle.displaced(-right), self.middle.displaced(left).reversed())
        draft.edges.append(Line(RoadKind.EDGE_BOUNDARY, outer))
        self.divide(draft)

    def divide(self, draft: Draft) -> None:
        """Adds the median's island, if there is a median; traffic may pass around its ends."""
        if self.median_m:
            half, end = self.median_m / 2 - _KERB_M, round(2 / STEP_M)
            inner = self.middle.piece(end, len(self.middle.xy) - 1 - end)
            island = ring(inner.shifted(half), inner.shifted(-half).reversed())
            draft.edges.append(Line(RoadKind.EDGE_MEDIAN, island))

    def paint(self, draft: Draft) -> None:
        """White lines between lanes of one direction and beside the outer ones, yellow ones between directions."""
        for side, reach in zip((-1.0, 1.0), self.reach_m, strict=True):
            if reach[0] > self.median_m / 2:
                draft.mark(RoadKind.LINE_SOLID_SINGLE_WHITE, self.middle.displaced(side * reach))
        self.paint_inside(draft)

    def paint_inside(self, draft: Draft) -> None:
        """The lines between lanes and between directions."""
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
        """Adds a sidewalk on both sides, 1.2 to 2.5 m outside the edges."""
        right, left = self.edge_m
        away = float(rng.uniform(1.2, 2.5))
        draft.walks += [self.middle.displaced(-right - away), self.middle.displaced(left + away)]

    def cross(self, draft: Draft, laid: Laid, at: int, marked: bool) -> None:
        """Adds a crossing at a sample of the middle line, with its crosswalk where it is marked."""
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
            ends = [here.ahead(CROSSWALK_M / 2 * sign) for sign in (-1.0, 1.0)]
            near, far = ends
            corners = [
                near.aside(-right[at]),
                near.aside(left[at]),
                far.aside(left[at]),
                far.aside(-right[at]),
            ]
            draft.crosswalks.append(Line(RoadKind.CROSSWALK, np.array([[p.x, p.y] for p in corners])))

    def _along(self, draft: Draft, place: int, section: int, lane: int, at: int) -> float:
        """Where on a lane of a section the sample ``at`` of the middle line is, m."""
        forward = next(s.forward for s in self.strips if s.place == place)
        index = at - self.cuts[section] if forward else self.cuts[section + 1] - at
        return float(draft.lanes[lane].curve.arc_m[index])

    def park(
        self, draft: Draft, laid: Laid, between_m: tuple[float, float], rng: np.random.Generator
    ) -> None:
        """Adds bays in the parking rows, with gaps for driveways and at crossings already drawn."""
        for side, row in zip((-1, 1), self.rows_m, strict=True):
            places = [strip.place for strip in self.strips if strip.place * side > 0]
            if not row:
                continue
            outer = max(places, key=abs) if places else -side
            aside = side * (self.median_m / 2 + len(places) * self.width_m + row / 2)
            at, pitch = between_m[0] + float(rng.uniform(0.0, 8.0)), float(rng.uniform(5.8, 6.6))
            # The inner row of a bend is shorter than the middle line.
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
        # Bays leave the view on crossings free.
        along = np.array([np.cos(pose.heading), np.sin(pose.heading)])
        to = [crossing.axis.mean(axis=0) - [pose.x, pose.y] for crossing in draft.crossings]
        if any(np.hypot(*d) < 30.0 and abs(d @ along) < _BAY_CLEAR_M for d in to):
            return
        forward = next(s.forward for s in self.strips if s.place == place)
        pose = pose if forward else pose.turned()
        lane = laid[place, section]
        draft.bays.append(Bay(pose, length_m, lane, self._along(draft, place, section, lane, at)))


def cuts(length_m: float, section_m: float) -> tuple[int, ...]:
    """Samples at which a line of this length is cut into sections of about the wanted length."""
    sections = max(1, round(length_m / section_m))
    last = round(length_m / STEP_M)
    return tuple(int(k) for k in np.linspace(0, last, sections + 1).round())
