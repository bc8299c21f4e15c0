"""Highways with an on-ramp, an off-ramp, or both with a weaving lane between them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from drivax.scenario.schema import RoadKind
from drivax.synthetic.roads.curves import STEP_M, Curve, from_curvature
from drivax.synthetic.roads.draft import Draft, ring
from drivax.synthetic.roads.families.street_layout import Laid, Street, StreetFamily, Strip, strips
from drivax.synthetic.roads.network import Line, RoadNetwork, Start
from drivax.synthetic.roads.style import GRID, RoadStyle

#: Length over which a ramp's curvature rises and falls, m.
_EASING_M = 40.0
#: Drivable width left of a ramp's lane, m.
_RAMP_SHOULDER_M = 0.7


@dataclass(frozen=True)
class _Ramp:
    """A ramp, its edges, and the nose, where its left edge meets the highway's right edge.

    Attributes:
        left, right: Edges in the direction of traffic; the left one ends at the nose.
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
        two_way_share: Share of highways of two or three lanes with the other direction beyond a median.
        median_m: Width of that median, low and high.
        shoulder_m: Drivable width beyond the outer lanes, low and high.
        ramp_m: Length of an on-ramp and of an off-ramp.
        ramp_radius_m: Radius of a ramp's bend, low and high.
        ramp_turn: Angle of a ramp's bend, rad, low and high.
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
        """Draw a highway; ego starts 25 to 70 m before the section with a ramp, or on the on-ramp."""
        middle = self.draw_middle(rng)
        lanes = int(rng.integers(2, 5))
        # At most five lanes in total fit the map of a stored scenario.
        back = int(rng.integers(2, 6 - lanes)) if lanes < 4 and rng.random() < self.two_way_share else 0
        extra = self._extra(rng, lanes)
        street = Street(
            middle=middle,
            cuts=self.cuts,
            strips=(*strips(lanes, back, len(self.cuts) - 1), extra),
            width_m=max(3.4, float(rng.uniform(*style.width_m))),
            limit_mps=float(rng.choice(style.fast_limits_mps)),
            shoulder_m=float(rng.uniform(*self.shoulder_m)),
            median_m=float(rng.uniform(*self.median_m)) if back else 0.0,
            taper_m=float(rng.uniform(50.0, 90.0)),
            kind=RoadKind.LANE_FREEWAY,
        )
        draft = Draft()
        laid = street.lay(draft)
        on = None if extra.fork else self._ramp(rng, draft, street, laid, extra, away=-1)
        off = self._ramp(rng, draft, street, laid, extra, away=1) if extra.exit_only else None
        _edges(draft, street, extra, on, off)
        _paint(draft, street, extra, on, off)
        starts = [Start(laid[-j - 1, 2], 20.0, 65.0) for j in range(lanes)]
        if on is not None:
            starts += [Start(on.lane, self.ramp_m[0] - 110.0, self.ramp_m[0] - 30.0)] * 2
        return draft.network(self.name, tuple(starts))

    def _extra(self, rng: np.random.Generator, lanes: int) -> Strip:
        """Draw the auxiliary lane: for entering, for leaving, or for both."""
        purpose = rng.choice(3, p=self.shares)
        place, length = -lanes - 1, int(rng.integers(2, 4))
        if purpose == 0:
            return Strip(place, True, 3, 3 + length, ends=True)
        if purpose == 1:
            return Strip(place, True, 4, 3 + length, fork=True, exit_only=True)
        return Strip(place, True, 3, 3 + length, exit_only=True)

    def _ramp(
        self, rng: np.random.Generator, draft: Draft, street: Street, laid: Laid, extra: Strip, away: int
    ) -> _Ramp:
        """Add a ramp at the beginning of the auxiliary lane (``away`` -1) or at its end (1)."""
        section = extra.first if away < 0 else extra.last - 1
        at = street.cuts[extra.first if away < 0 else extra.last]
        length = self.ramp_m[0 if away < 0 else 1]
        line = draft.lanes[laid[extra.place, section]].curve
        gore = line.start.turned() if away < 0 else line.end
        # Seen from the highway, an on-ramp bends to the left and an off-ramp to the right.
        side = np.gradient(street.middle.heading, STEP_M)[at::away][: round(length / STEP_M) + 1] * away
        bend = _bend(length, float(rng.uniform(*self.ramp_radius_m)), float(rng.uniform(*self.ramp_turn)))
        outward = from_curvature(side - away * bend, STEP_M, gore)
        curve = outward if away > 0 else outward.reversed()
        limit = street.limit_mps * float(rng.uniform(*self.ramp_limit))
        lane = draft.lane(curve, street.width_m, limit, kind=street.kind, exit_only=away > 0)
        draft.link(*((lane, laid[extra.place, section]) if away < 0 else (laid[extra.place, section], lane)))
        half = street.width_m / 2
        left, right = curve.shifted(half + _RAMP_SHOULDER_M), curve.shifted(-half - street.shoulder_m)
        nose, sample = _nose(street, extra, left if away > 0 else left.reversed())
        last = len(left.xy) - 1
        left = left.piece(nose, last) if away > 0 else left.piece(0, last - nose)
        return _Ramp(lane, left, right, sample)


def _bend(length_m: float, radius_m: float, angle: float) -> Float64[np.ndarray, " point"]:
    """Curvature that rises to 1 / radius, holds, and falls, and integrates to an angle."""
    hold = max(0.0, angle * radius_m - _EASING_M)
    knots = np.cumsum([0.0, _EASING_M, hold, _EASING_M])
    at = STEP_M * np.arange(round(length_m / STEP_M) + 1)
    peak = angle / (hold + _EASING_M)
    return np.interp(at, knots, [0.0, peak, peak, 0.0])


def _main_edge(street: Street, extra: Strip) -> Curve:
    """Right edge of the highway without its auxiliary lane."""
    reach = street.reach_m[0] - street.width_m * street.presence(extra) + street.shoulder_m
    return street.middle.displaced(-reach)


def _nose(street: Street, extra: Strip, left: Curve) -> tuple[int, int]:
    """First sample of a ramp's left edge beyond the highway's edge, and the nearest sample of that edge."""
    edge = _main_edge(street, extra)
    # The nose lies within 150 m of the beginning of the ramp.
    span = round(150.0 / STEP_M)
    gore = int(np.argmin(np.sum((edge.xy - left.xy[0]) ** 2, axis=-1)))
    first, points = max(0, gore - span), left.xy[:span]
    window = edge.xy[first : gore + span]
    near = first + np.argmin(np.sum((points[:, None] - window[None]) ** 2, axis=-1), axis=1)
    to = points - edge.xy[near]
    aside = -to[:, 0] * np.sin(edge.heading[near]) + to[:, 1] * np.cos(edge.heading[near])
    sample = int(np.argmax(aside < -0.05))
    return sample, int(near[sample])


def _edges(draft: Draft, street: Street, extra: Strip, on: _Ramp | None, off: _Ramp | None) -> None:
    """Add the boundary, counter-clockwise: along the right edge with the ramps, and back along the left edge."""
    right, left = street.edge_m
    main, full, last = _main_edge(street, extra), street.middle.displaced(-right), len(right) - 1
    parts, begin = [], 0
    if on is not None:
        begin = street.cuts[extra.first]
        parts += [main.piece(0, on.nose - 2), on.left.reversed(), on.right]
    end = last if off is None else street.cuts[extra.last]
    parts.append(full.piece(begin, end))
    if off is not None:
        parts += [off.right, off.left.reversed(), main.piece(off.nose + 2, last)]
    parts.append(street.middle.displaced(left).reversed())
    draft.edges.append(Line(RoadKind.EDGE_BOUNDARY, ring(*parts)))
    street.divide(draft)


def _paint(draft: Draft, street: Street, extra: Strip, on: _Ramp | None, off: _Ramp | None) -> None:
    street.paint_inside(draft)
    inset = replace(street, shoulder_m=0.1)
    right, left = inset.edge_m
    first, last = street.cuts[extra.first], street.cuts[extra.last]
    main, full = _main_edge(inset, extra), street.middle.displaced(-right)
    solid = RoadKind.LINE_SOLID_SINGLE_WHITE
    if on is not None:
        draft.mark(solid, main.piece(0, on.nose))
    draft.mark(solid, full.piece(0 if on is None else first, len(right) - 1 if off is None else last))
    if off is not None:
        draft.mark(solid, main.piece(off.nose, len(right) - 1))
    if any(strip.place > 0 for strip in street.strips):
        draft.mark(solid, street.middle.displaced(left))
    for ramp in (on, off):
        if ramp is not None:
            draft.mark(solid, ramp.left.shifted(-_RAMP_SHOULDER_M))
            draft.mark(solid, ramp.right.shifted(street.shoulder_m))
