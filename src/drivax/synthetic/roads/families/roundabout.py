"""Roundabouts with three or four arms and one or two lanes; entering traffic yields to circulating traffic.

Traffic circulates counter-clockwise. With two lanes the left lane of an arm leads to the inner circle and the right
one to the outer circle, and exits lead into the lane of the same side. Exits from the inner circle cross the outer
one and yield to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from drivax.scenario.schema import RoadKind
from drivax.synthetic.roads.curves import (
    STEP_M,
    Curve,
    Pose,
    connect_poses,
    from_curvature,
    join_curves,
    smooth_step,
)
from drivax.synthetic.roads.families.junction_layout import Reach
from drivax.synthetic.roads.families.street_layout import CROSSWALK_M
from drivax.synthetic.roads.network import (
    GRID,
    Control,
    Crossing,
    Draft,
    Line,
    RoadNetwork,
    RoadStyle,
    Start,
    conflict_matrix,
    points,
    ring,
)

#: Least radius of the fillets of entries and exits, m, where the arc between them leaves room.
_FILLET_M = 11.5
#: Distances from the yield line at which the gap between the directions begins to narrow and is closed, m.
_SPLITTER_M = (13.0, 42.0)
#: Distance from the yield line to the crosswalk's axis, m: room for a car.
_CROSSING_M = 6.5
#: Distance from a kerb to the adjacent lane, m.
_KERB_M = 0.4
#: Least length of the circle between an entry and the next exit, m, which keeps vehicles on them clear of each other.
_ARC_M = 3.3


@dataclass(frozen=True)
class _Plan:
    """Dimensions of a roundabout.

    Attributes:
        radius_m: Radii of the circle's lane centres, inner first.
        join: Angle from an arm to the entry and the exit of each circle, rad.
        gap_m, yield_m: Gap between the directions at the yield lines, and distance of these from the centre.
        circle_m, width_m: Width of lanes in the circle and on the arms.
    """

    radius_m: tuple[float, ...]
    join: tuple[float, ...]
    gap_m: float
    yield_m: float
    circle_m: float
    width_m: float
    shoulder_m: float
    limit_mps: float

    def spread_m(self, middle: Curve) -> Float64[np.ndarray, " point"]:
        """Half of the gap between the directions along an arm."""
        begin, end = _SPLITTER_M
        return self.gap_m / 2 * (1.0 - smooth_step((middle.arc_m - begin) / (end - begin)))


@dataclass(frozen=True)
class _Arm:
    """An arm and its lanes by circle, inner first."""

    heading: float
    middle: Curve
    inward: list[int]
    outward: list[int]


@dataclass(frozen=True)
class Roundabout:
    """Settings of the family ``roundabout``.

    Attributes:
        arm_m: Length of arms beyond the yield line.
        radius_m: Radius of the outer circle's lane centre with one lane and with two, low and high.
        gap_m: Gap between the directions at the yield lines, low and high.
        skew: Largest deviation of an arm from an even division, rad, where room permits.
        limit_mps: Highest limit of the arms; a style with only higher ones gets its lowest.
        circle_mps: Limit of the circle, the entries and the exits.
    """

    arm_m: float = 230.0
    radius_m: tuple[tuple[float, float], tuple[float, float]] = ((13.0, 20.0), (19.0, 25.0))
    two_lane_share: float = 0.3
    three_arm_share: float = 0.35
    gap_m: tuple[float, float] = (2.0, 3.2)
    skew: float = math.radians(15.0)
    limit_mps: float = 15.7
    circle_mps: float = 8.4
    marked_share: float = 0.85
    name: str = "roundabout"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draw a roundabout; ego starts on any arm, 12 to 85 m before its yield line."""
        plan = self._plan(rng, style)
        draft = Draft()
        arms = [self._arm(rng, draft, plan, heading) for heading in self._headings(rng, plan)]
        chains = _add_circles(draft, plan, arms, self.circle_mps)
        _set_priorities(draft)
        sidewalk_m = float(rng.uniform(1.2, 2.0)) if rng.random() < style.sidewalk_share else None
        _add_boundary(draft, plan, chains, sidewalk_m)
        _add_islands(draft, plan, arms)
        marked = bool(rng.random() < self.marked_share)
        for arm in arms:
            _add_markings(draft, plan, arm)
            _add_crossing(draft, plan, arm, marked)
        lengths = {lane: draft.lanes[lane].length_m for arm in arms for lane in arm.inward}
        starts = tuple(Start(lane, length - 85.0, length - 12.0) for lane, length in lengths.items())
        return draft.network(self.name, starts)

    def _plan(self, rng: np.random.Generator, style: RoadStyle) -> _Plan:
        lanes = 2 if rng.random() < self.two_lane_share else 1
        # Adjacent lanes must not be in conflict.
        width = max(float(rng.uniform(*style.width_m)), 3.15 if lanes == 2 else 0.0)
        circle, gap = width + float(rng.uniform(0.7, 1.2)), float(rng.uniform(*self.gap_m))
        outer = float(rng.uniform(*self.radius_m[lanes - 1]))
        radius = [outer - circle * (lanes - 1 - j) for j in range(lanes)]
        join, reach = zip(
            *(_solve_join(r, gap / 2 + (j + 0.5) * width) for j, r in enumerate(radius)), strict=True
        )
        limits = [v for v in style.limits_mps if v <= self.limit_mps] or [min(style.limits_mps)]
        return _Plan(
            radius_m=tuple(radius),
            join=join,
            gap_m=gap,
            yield_m=max(*reach, outer + circle / 2 + 1.0),
            circle_m=circle,
            width_m=width,
            shoulder_m=float(rng.uniform(*style.shoulder_m)),
            limit_mps=float(rng.choice(limits)),
        )

    def _headings(self, rng: np.random.Generator, plan: _Plan) -> list[float]:
        count = 3 if rng.random() < self.three_arm_share else 4
        pairs = zip(plan.join, plan.radius_m, strict=True)
        room = 2 * math.pi / count - max(2 * join + _ARC_M / radius for join, radius in pairs)
        skew = min(self.skew, room / 2)
        base = float(rng.uniform(-math.pi, math.pi))
        return [base + 2 * math.pi * i / count + float(rng.uniform(-skew, skew)) for i in range(count)]

    def _arm(self, rng: np.random.Generator, draft: Draft, plan: _Plan, heading: float) -> _Arm:
        """Add the lanes of an arm: straight near the circle, then slightly bent."""
        reach = Reach(self.arm_m, straight_m=50.0, tightest_m=110.0, widest_turn=math.radians(24.0))
        middle = reach.draw(rng, Pose(0.0, 0.0, heading).ahead(plan.yield_m))
        spread = plan.spread_m(middle)
        inward, outward = [], []
        for j in range(len(plan.radius_m)):
            lateral = spread + (j + 0.5) * plan.width_m
            inward.append(draft.lane(middle.offset_by(lateral).reverse(), plan.width_m, plan.limit_mps))
            outward.append(draft.lane(middle.offset_by(-lateral), plan.width_m, plan.limit_mps))
        for lanes in (inward, outward):
            if len(lanes) == 2:
                draft.link_neighbours(*lanes)
        return _Arm(heading, middle, inward, outward)


def _solve_join(radius: float, lateral: float) -> tuple[float, float]:
    """Find the angle from an arm at which its lane joins the circle, and the distance from the centre to the bend.

    The arm's lane (at a distance ``lateral`` from the arm) and the circle's tangent at angle d intersect at a distance
    ``t = (r sin d - lateral) / cos d`` from the tangent point; their fillet has the radius ``t / tan(45° - d/2)``.
    """
    angles = np.linspace(math.radians(24.0), math.pi / 4 - _ARC_M / radius / 2, 40)
    tangents = (radius * np.sin(angles) - lateral) / np.cos(angles)
    is_wide = tangents / np.tan(math.pi / 4 - angles / 2) >= _FILLET_M
    index = int(np.argmax(is_wide)) if is_wide.any() else -1
    angle, tangent = float(angles[index]), float(tangents[index])
    return angle, (radius - lateral * math.sin(angle)) / math.cos(angle) + tangent


def _on_circle(radius: float, angle: float) -> Pose:
    """Return the pose on a circle at an angle."""
    return Pose(radius * math.cos(angle), radius * math.sin(angle), angle + math.pi / 2)


def _arc(radius: float, begin: float, end: float) -> Curve:
    """Return the arc of a circle between two angles."""
    count = max(4, math.ceil(radius * (end - begin) / STEP_M) + 1)
    step = (end - begin) / (count - 1)
    # Steps are chords: the samples lie on the circle.
    chord = 2 * radius * math.sin(step / 2)
    return from_curvature(np.full(count, step / chord), chord, _on_circle(radius, begin))


def _add_circles(draft: Draft, plan: _Plan, arms: list[_Arm], limit: float) -> list[list[Curve]]:
    """Add entries, exits and circles; return the outermost curves from each arm to the next one."""
    chains: list[list[Curve]] = []
    for j, (radius, join) in enumerate(zip(plan.radius_m, plan.join, strict=True)):
        # Entry, exit, and the connector that passes the arm.
        junctions: list[list[int]] = []
        for arm in arms:
            low, high = arm.heading - join, arm.heading + join
            curves = (
                connect_poses(draft.lanes[arm.inward[j]].curve.end, _on_circle(radius, high)),
                connect_poses(_on_circle(radius, low), draft.lanes[arm.outward[j]].curve.start),
                _arc(radius, low, high),
            )
            pairs = zip(curves, (plan.width_m, plan.width_m, plan.circle_m), strict=True)
            junctions.append([draft.lane(curve, width, limit, connector=True) for curve, width in pairs])
            draft.link(arm.inward[j], junctions[-1][0])
            draft.link(junctions[-1][1], arm.outward[j])
        for i, arm in enumerate(arms):
            k = (i + 1) % len(arms)
            ahead = (arms[k].heading - arm.heading) % (2 * math.pi)
            curve = _arc(radius, arm.heading + join, arm.heading + ahead - join)
            arc = draft.lane(curve, plan.circle_m, limit)
            (entry, _, before), (_, departure, after) = junctions[i], junctions[k]
            for pair in ((entry, arc), (before, arc), (arc, departure), (arc, after)):
                draft.link(*pair)
            if j == len(plan.radius_m) - 1:
                lanes = (arm.inward[j], entry, arc, departure, arms[k].outward[j])
                chains.append([draft.lanes[lane].curve for lane in lanes])
    return chains


def _set_priorities(draft: Draft) -> None:
    """Give circulating traffic right of way over entries, and over exits across the outer circle."""
    lanes, conflicts = draft.lanes, conflict_matrix(draft.lanes)
    arcs = {i for i, lane in enumerate(lanes) if len(lane.predecessors) == 2}
    circulating = {i for i, lane in enumerate(lanes) if {*lane.predecessors, *lane.successors} <= arcs}
    for i in range(len(lanes)):
        yields_to = tuple(int(k) for k in np.flatnonzero(conflicts[i]) if k in circulating)
        if yields_to and i not in circulating:
            draft.change(i, control=Control.YIELD, yields_to=yields_to)


def _add_boundary(draft: Draft, plan: _Plan, chains: list[list[Curve]], sidewalk_m: float | None) -> None:
    """Add the outer boundary and the sidewalks."""
    sides = []
    for chain in chains:
        line = join_curves(*chain)
        ends = np.cumsum([curve.arc_m[-1] for curve in chain])
        circle_share = smooth_step((line.arc_m - ends[0]) / (ends[1] - ends[0]))
        circle_share -= smooth_step((line.arc_m - ends[2]) / (ends[3] - ends[2]))
        reach = plan.width_m / 2 + plan.shoulder_m + circle_share * (plan.circle_m - plan.width_m) / 2
        sides.append(line.offset_by(-reach))
        if sidewalk_m is not None:
            draft.sidewalks.append(line.offset_by(-reach - sidewalk_m))
    draft.edges.append(Line(RoadKind.EDGE_BOUNDARY, ring(*sides)))


def _add_islands(draft: Draft, plan: _Plan, arms: list[_Arm]) -> None:
    """Add the central island, and the splitter island of each arm."""
    radius = plan.radius_m[0] - plan.circle_m / 2 - _KERB_M
    angles = np.arange(0.0, 2 * math.pi, 1.0 / radius)
    islands = [radius * np.stack([np.cos(angles), -np.sin(angles)], axis=-1)]
    for arm in arms:
        half = plan.spread_m(arm.middle) - _KERB_M
        axis_piece = arm.middle.piece(0, int(np.argmax(half < 0.15)) - 1)
        half = half[: len(axis_piece.xy)]
        islands.append(ring(axis_piece.offset_by(half), axis_piece.offset_by(-half).reverse()))
    draft.edges += [Line(RoadKind.EDGE_MEDIAN, island) for island in islands]


def _add_markings(draft: Draft, plan: _Plan, arm: _Arm) -> None:
    """Add the markings of an arm; the yellow ones are 8 cm inside the innermost lanes."""
    spread, lanes = plan.spread_m(arm.middle), len(arm.inward)
    for side in (-1.0, 1.0):
        draft.mark(RoadKind.LINE_SOLID_SINGLE_YELLOW, arm.middle.offset_by(side * (spread + 0.08)))
        for j in range(1, lanes + 1):
            kind = RoadKind.LINE_SOLID_SINGLE_WHITE if j == lanes else RoadKind.LINE_BROKEN_SINGLE_WHITE
            draft.mark(kind, arm.middle.offset_by(side * (spread + j * plan.width_m)))


def _add_crossing(draft: Draft, plan: _Plan, arm: _Arm, marked: bool) -> None:
    """Add the crossing of an arm, a car's length before the yield line."""
    half = plan.gap_m / 2 + len(arm.inward) * plan.width_m + plan.shoulder_m
    mouth = arm.middle.start
    position = mouth.ahead(_CROSSING_M)
    lanes = [(lane, draft.lanes[lane].length_m - _CROSSING_M) for lane in arm.inward]
    lanes += [(lane, _CROSSING_M) for lane in arm.outward]
    axis = points(position.shift_left(-half), position.shift_left(half))
    draft.crossings.append(Crossing(axis, CROSSWALK_M, tuple(lanes), marked))
    if marked:
        near, far = (mouth.ahead(_CROSSING_M + sign * CROSSWALK_M / 2) for sign in (-1.0, 1.0))
        draft.crosswalk(
            near.shift_left(half), far.shift_left(half), far.shift_left(-half), near.shift_left(-half)
        )
