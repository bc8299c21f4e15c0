"""Families of junctions: with lights, T-junctions, all-way stops, unprotected left turns, and a corridor of two.

Lights serve left turns in a phase of their own (protected, with arrows), together with oncoming traffic that has right
of way (permissive), or serve one approach after the other (split phases). Other conflicting movements are never green
at the same time. Ego starts 12 to 85 m before a stop line, at most 6 s of travel at the speed limit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool

from drivax.synthetic.roads.curves import Curve, Pose, draw_winding_curve, join_curves, straight
from drivax.synthetic.roads.families.junction_layout import (
    Approach,
    Arm,
    CrossSection,
    Geometry,
    Move,
    Reach,
    Site,
    Turn,
    add_lanes,
    connect,
    draw_street,
    finish_sites,
    open_approach,
    open_crossroads,
    open_site,
    starts,
)
from drivax.synthetic.roads.network import (
    GRID,
    Control,
    Draft,
    Layouts,
    RoadNetwork,
    RoadStyle,
    conflict_matrix,
    draw_layout,
)
from drivax.synthetic.roads.signals import LightGroup, SignalPlan, combine_plans, yellow_time_s

#: Layouts of streets at lights; an extra lane inward is for turning left.
_SIGNAL_LAYOUTS: Layouts = ((1, 1, 0.35), (2, 1, 0.15), (2, 2, 0.38), (3, 2, 0.12))
#: Layouts of the main road at unprotected left turns; the left lane is for turning left.
_LEFT_LAYOUTS: Layouts = ((2, 1, 0.4), (2, 2, 0.3), (3, 2, 0.3))
#: Weight of a start in the left-turn lane relative to one in another lane.
_LEFT_WEIGHT = 4
#: Kinds of junctions in a corridor and their shares.
_LIGHTS, _SIDE_ROAD = "lights", "side_road"
_KINDS = {_LIGHTS: 0.5, "two_stops": 0.25, _SIDE_ROAD: 0.25}
#: Weight of a start on the main road relative to one on a side road.
_MAIN_WEIGHT = 3
#: Length of the straight ends of the road between the junctions, m.
_STRAIGHT_M = 25.0
#: Speed of platoons as a share of the limit.
_PLATOON = 0.85
#: Pairs of connectors in conflict.
Conflicts = Bool[np.ndarray, "lane lane"]


def set_priorities(draft: Draft, site: Site, major: Sequence[int], sign: Control) -> None:
    """Set the rules of a priority road: other approaches have a sign, left turns yield to oncoming traffic."""
    conflicts = conflict_matrix(draft.lanes)
    for move in site.moves:
        yields_to = _yields_to(move, site.moves, conflicts, major)
        unsigned = Control.YIELD if yields_to else Control.NONE
        draft.change(move.lane, control=unsigned if move.arm in major else sign, yields_to=yields_to)


@dataclass(frozen=True)
class LeftTurns:
    """Phases of the left turns of two opposing approaches: the first that is set and possible, else split phases.

    Protected left turns have a phase of their own, with arrows. Permissive ones are green together with oncoming
    traffic, to which they yield. Split phases serve one approach at a time.
    """

    protected: bool
    permissive: bool


def set_lights(
    rng: np.random.Generator, draft: Draft, site: Site, lefts: list[LeftTurns], green_s: tuple[float, float]
) -> SignalPlan:
    """Set the lights of a four-way junction: phases for approaches 0 and 2, then for 1 and 3.

    ``lefts`` has the left turns of both pairs of approaches, ``green_s`` the least and the largest green time.
    """
    green, conflicts = [float(g) for g in rng.uniform(*green_s, size=4)], conflict_matrix(draft.lanes)
    groups: list[LightGroup] = []
    phases: list[tuple[int, ...]] = []

    def add_phase(*approaches: list[Move], arrow: bool = False) -> None:
        phases.append(tuple(range(len(groups), len(groups) + len(approaches))))
        groups.extend(LightGroup(tuple(move.lane for move in approach), arrow) for approach in approaches)
        moves = [move for approach in approaches for move in approach]
        for move in moves:
            yields_to = _yields_to(move, moves, conflicts, ())
            draft.change(move.lane, control=Control.SIGNAL, yields_to=yields_to)

    for axis, turns in enumerate(lefts):
        approaches = [[move for move in site.moves if move.arm == arm] for arm in (axis, axis + 2)]
        left = [[move for move in approach if move.turn == Turn.LEFT] for approach in approaches]
        other = [[move for move in approach if move.turn != Turn.LEFT] for approach in approaches]
        if turns.protected and _are_separate(left, conflicts) and _are_separate(other, conflicts):
            add_phase(*left, arrow=True)
            add_phase(*other)
        elif turns.permissive and _are_separate(other, conflicts):
            add_phase(*approaches)
        else:
            for approach in approaches:
                add_phase(approach)
    yellow = yellow_time_s(max(draft.lanes[move.lane].limit_mps for move in site.moves))
    return SignalPlan(tuple(groups), tuple(phases), tuple(green[: len(phases)]), yellow_s=yellow)


def _yields_to(
    move: Move, others: Sequence[Move], conflicts: Conflicts, major: Sequence[int]
) -> tuple[int, ...]:
    """Return the connectors of conflicting moves with right of way: by priority road, then turn, then approach."""

    def order(m: Move) -> tuple[bool, Turn, int]:
        return m.arm not in major, m.turn, m.arm

    return tuple(m.lane for m in others if conflicts[move.lane, m.lane] and order(m) < order(move))


def _are_separate(approaches: list[list[Move]], conflicts: Conflicts) -> bool:
    """Return whether no moves of two approaches are in conflict."""
    a, b = approaches
    return not any(conflicts[x.lane, y.lane] for x in a for y in b)


@dataclass(frozen=True)
class SignalisedJunction:
    """Settings of the family ``signalised_junction``: random angles, one to three lanes per approach.

    Attributes:
        cross_skew: Largest deviation of the two streets from a right angle, rad.
        left_lane_share: Share of the streets with two lanes in each direction whose left lane is for turning.
        protected_share: Share of the streets with left-turn lanes whose left turns are protected, where possible.
        permissive_share: Share of the other streets whose left turns are permissive, where possible.
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
        streets = []
        for _ in range(2):
            layout = draw_layout(rng, _SIGNAL_LAYOUTS)
            streets.append(draw_street(rng, style, layout, float(rng.choice(style.limits_mps))))
        draft, site = open_crossroads(rng, streets, self.geometry, self.cross_skew)
        left_only = [
            street.inward > street.outward
            or (street.inward > 1 and bool(rng.random() < self.left_lane_share))
            for street in streets
        ]
        site = connect(draft, site, left_only * 2)
        finish_sites(rng, style, draft, (site,), {}, self.geometry)
        lefts = [
            LeftTurns(only and rng.random() < self.protected_share, rng.random() < self.permissive_share)
            for only in left_only
        ]
        signals = set_lights(rng, draft, site, lefts, self.green_s)
        return draft.network(self.name, starts(draft, site.inward), signals)


@dataclass(frozen=True)
class TJunction:
    """Settings of the family ``t_junction``: a priority road, and a stem with a stop or a yield sign.

    Attributes:
        stem_skew: Largest deviation of the stem from a right angle, rad.
        two_lane_share: Share of priority roads with two lanes per direction; half of these have a left-turn lane.
        stem_lanes_share: Share of stems with separate lanes for left and right turns.
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
        stem_limit = min(limit, float(rng.choice(style.limits_mps)))
        lanes = 2 if rng.random() < self.two_lane_share else 1
        main_marked, stem_marked = rng.random(2) < (self.marked_share, 2 * self.marked_share)
        main = draw_street(rng, style, (lanes, lanes), limit, bool(main_marked))
        stem_lanes = (2, 1) if rng.random() < self.stem_lanes_share else (1, 1)
        stem = draw_street(rng, style, stem_lanes, stem_limit, bool(stem_marked))
        first = float(rng.uniform(-math.pi, math.pi))
        stem_heading = first + math.pi / 2 + float(rng.uniform(-self.stem_skew, self.stem_skew))
        arms = self.geometry.arms(rng, (first, stem_heading, first + math.pi), (main, stem, main))
        draft, site = open_site(rng, arms, self.geometry)
        site = connect(draft, site, [bool(rng.random() < 0.5)] * 3)
        finish_sites(rng, style, draft, (site,), {}, self.geometry)
        sign = Control.STOP if rng.random() < self.stop_share else Control.YIELD
        set_priorities(draft, site, (0, 2), sign)
        return draft.network(self.name, starts(draft, site.inward))


@dataclass(frozen=True)
class AllWayStop:
    """Settings of the family ``all_way_stop``: two streets with stop signs on all approaches.

    Limits are at most ``fastest_mps``; a style with only higher ones gets its lowest.
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
        draft, site = open_crossroads(rng, streets, self.geometry, self.cross_skew)
        site = connect(draft, site, (False,) * 4)
        finish_sites(rng, style, draft, (site,), {}, self.geometry)
        for move in site.moves:
            draft.change(move.lane, control=Control.ALL_WAY_STOP)
        return draft.network(self.name, starts(draft, site.inward))


@dataclass(frozen=True)
class UnprotectedLeft:
    """Settings of the family ``unprotected_left``: left-turn lanes that yield to oncoming traffic.

    Either the lights are green for both directions at the same time, long enough to wait for a gap, or the road has
    priority over side streets.
    """

    geometry: Geometry = field(
        default_factory=lambda: Geometry(skew=math.radians(4.0), offset_m=0.5, corner_m=(5.5, 10.0))
    )
    cross_skew: float = math.radians(15.0)
    signal_share: float = 0.6
    green_s: tuple[float, float] = (11.0, 20.0)
    name: str = "unprotected_left"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draw a junction with dense oncoming traffic; ego starts on the main road, mostly in a left-turn lane."""
        has_lights = bool(rng.random() < self.signal_share)
        limit = float(rng.choice(style.limits_mps))
        side_limit = min(limit, float(rng.choice(style.limits_mps)))
        main = draw_street(rng, style, draw_layout(rng, _LEFT_LAYOUTS), limit, has_lights)
        side = draw_street(rng, style, (1, 1), side_limit)
        draft, site = open_crossroads(rng, (main, side), self.geometry, self.cross_skew)
        site = connect(draft, site, (True, False) * 2)
        finish_sites(rng, style, draft, (site,), {}, self.geometry)
        signals, lefts = None, [LeftTurns(protected=False, permissive=True)] * 2
        if has_lights:
            signals = set_lights(rng, draft, site, lefts, self.green_s)
        else:
            set_priorities(draft, site, (0, 2), Control.STOP)
        inward = [site.approaches[i].inward for i in (0, 2)]
        start_lanes = [lane for left, *others in inward for lane in [left] * _LEFT_WEIGHT + others]
        oncoming = tuple(lane for lanes in inward for lane in lanes[1:])
        return replace(draft.network(self.name, starts(draft, start_lanes), signals), busy=oncoming)


@dataclass(frozen=True)
class _JunctionOutline:
    """A junction before its lanes are added; arm 0 leads to the other junction."""

    kind: str
    arms: list[Arm]
    mouths: list[float]
    left_only: bool

    @property
    def main(self) -> tuple[int, ...]:
        """Approaches of the main road."""
        angles = [arm.base.heading - self.arms[0].base.heading for arm in self.arms]
        return tuple(i for i, angle in enumerate(angles) if abs(math.sin(angle)) <= 0.5)

    @property
    def gate(self) -> Pose:
        """Beginning of the road to the other junction, looking outwards."""
        return self.arms[0].base.ahead(self.mouths[0] + self.arms[0].street.stop_line_m)

    def move_to(self, gate: Pose) -> _JunctionOutline:
        """Move the junction so that its gate is at a pose."""
        angle = gate.heading - self.gate.heading
        cos, sin = math.cos(angle), math.sin(angle)
        arms = []
        for arm in self.arms:
            dx, dy = arm.base.x - self.gate.x, arm.base.y - self.gate.y
            base = Pose(gate.x + cos * dx - sin * dy, gate.y + sin * dx + cos * dy, arm.base.heading + angle)
            arms.append(Arm(base, arm.street))
        return replace(self, arms=arms)


@dataclass(frozen=True)
class Corridor:
    """Settings of the family ``corridor``: a main road with two junctions.

    Each junction has lights, or gives the main road priority over one or two side roads. The junctions share the lanes
    between them. Two lights may be coordinated: they have the same cycle, and the second one begins its first phase
    when vehicles arrive that left the first one at the beginning of its first phase.

    Attributes:
        side_reach: Shape of side roads: nearly straight, which keeps those of both junctions separate.
        between_m: Length of the road between the stop lines of both junctions, low and high.
        left_lane_share: Share of lights on two-lane main roads at which the left lane is for turning.
        protected_share: Share of those at which the main road's left turns are protected, where possible.
    """

    geometry: Geometry = field(
        default_factory=lambda: Geometry(
            skew=math.radians(3.0), offset_m=0.4, corner_m=(5.0, 10.0), reach=Reach(arm_m=200.0)
        )
    )
    side_reach: Reach = field(default_factory=lambda: Reach(arm_m=200.0, widest_turn=math.radians(6.0)))
    between_m: tuple[float, float] = (70.0, 115.0)
    two_lane_share: float = 0.5
    left_lane_share: float = 0.6
    protected_share: float = 0.5
    coordinated_share: float = 0.5
    green_s: tuple[float, float] = (8.0, 15.0)
    name: str = "corridor"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draw a network; ego starts before either junction, most often on the main road."""
        lanes = 2 if rng.random() < self.two_lane_share else 1
        main = draw_street(rng, style, (lanes, lanes), float(rng.choice(style.limits_mps)))
        outline = self._draw_outline(rng, style, main)
        first = outline.move_to(Pose(0.0, 0.0, float(rng.uniform(-math.pi, math.pi))))
        middle = self._draw_middle(rng, first.gate)
        second = self._draw_outline(rng, style, main).move_to(middle.end.reverse())
        draft = Draft()
        sites = self._add_sites(rng, draft, (first, second), middle)
        finish_sites(rng, style, draft, sites, {(0, 0): (1, 0), (1, 0): (0, 0)}, self.geometry)
        pairs = list(zip((first, second), sites, strict=True))
        plans = [self._set_right_of_way(rng, draft, *pair) for pair in pairs]
        start_lanes = [
            lane
            for outline, site in pairs
            for i, approach in enumerate(site.approaches[1:], 1)
            for lane in approach.inward * (_MAIN_WEIGHT if i in outline.main else 1)
        ]
        travel = (float(middle.arc_m[-1]) + first.mouths[0] + second.mouths[0]) / (_PLATOON * main.limit_mps)
        return draft.network(self.name, starts(draft, start_lanes), self._combine_signals(rng, plans, travel))

    def _draw_outline(
        self, rng: np.random.Generator, style: RoadStyle, main: CrossSection
    ) -> _JunctionOutline:
        """Draw the kind and the arms of a junction."""
        kind = list(_KINDS)[rng.choice(len(_KINDS), p=list(_KINDS.values()))]
        marked = kind == _LIGHTS or bool(rng.random() < 0.4)
        side_limit_mps = min(main.limit_mps, float(rng.choice(style.limits_mps)))
        side = draw_street(rng, style, (1, 1), side_limit_mps, kind == _LIGHTS or bool(rng.random() < 0.6))
        main = replace(main, marked=marked)
        streets, headings = [main, side, main, side], [k * math.pi / 2 for k in range(4)]
        if kind == _SIDE_ROAD:
            missing_arm = int(rng.choice([1, 3]))
            del streets[missing_arm], headings[missing_arm]
        arms = self.geometry.arms(rng, headings, streets)
        left_only = kind == _LIGHTS and main.inward > 1 and bool(rng.random() < self.left_lane_share)
        return _JunctionOutline(kind, arms, self.geometry.mouths(rng, arms), left_only)

    def _draw_middle(self, rng: np.random.Generator, gate: Pose) -> Curve:
        """Draw the middle line between the junctions: bent, with straight ends."""
        near = straight(gate, _STRAIGHT_M)
        length = float(rng.uniform(*self.between_m)) - 2 * _STRAIGHT_M
        curvature = 1.0 / self.geometry.reach.tightest_m
        bent = draw_winding_curve(
            rng, length, max_curvature=curvature, max_turn=math.radians(8.0), start=near.end
        )
        return join_curves(near, bent, straight(bent.end, _STRAIGHT_M))

    def _add_sites(
        self,
        rng: np.random.Generator,
        draft: Draft,
        outlines: tuple[_JunctionOutline, _JunctionOutline],
        middle: Curve,
    ) -> list[Site]:
        """Add the shared road, then the other arms and the connectors of both junctions."""
        near, far = outlines
        side = join_curves(
            straight(near.arms[0].base.ahead(near.mouths[0]), near.arms[0].street.stop_line_m),
            middle,
            straight(middle.end, far.arms[0].street.stop_line_m),
        )
        inward, outward = add_lanes(draft, near.arms[0].street, middle)
        shared = (
            Approach(near.arms[0], near.mouths[0], middle, side, inward, outward),
            Approach(far.arms[0], far.mouths[0], middle.reverse(), side.reverse(), outward, inward),
        )
        sites = []
        for outline, first in zip(outlines, shared, strict=True):
            approaches = [first]
            for i in range(1, len(outline.arms)):
                reach = self.geometry.reach if i in outline.main else self.side_reach
                approaches.append(open_approach(rng, draft, outline.arms[i], outline.mouths[i], reach))
            left_only = [outline.left_only and i in outline.main for i in range(len(outline.arms))]
            sites.append(connect(draft, Site(tuple(approaches)), left_only))
        return sites

    def _set_right_of_way(
        self, rng: np.random.Generator, draft: Draft, outline: _JunctionOutline, site: Site
    ) -> SignalPlan | None:
        """Set the signals or the stop signs of a junction; return its signal plan, if it has one."""
        if outline.kind != _LIGHTS:
            set_priorities(draft, site, outline.main, Control.STOP)
            return None
        protected = outline.left_only and bool(rng.random() < self.protected_share)
        lefts = [LeftTurns(protected, permissive=True), LeftTurns(protected=False, permissive=True)]
        return set_lights(rng, draft, site, lefts, self.green_s)

    def _combine_signals(
        self, rng: np.random.Generator, plans: Sequence[SignalPlan | None], travel_s: float
    ) -> SignalPlan | None:
        """Combine the plans of both junctions, coordinated or not."""
        first, second = plans
        if first is None or second is None:
            return first or second
        cycle = max(first.cycle_s, second.cycle_s)
        if rng.random() < self.coordinated_share:
            return combine_plans(first.stretch(cycle), second.stretch(cycle), travel_s)
        return combine_plans(first, second, float(rng.uniform(0.0, cycle)))
