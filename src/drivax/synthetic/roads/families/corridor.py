"""A main road with two consecutive junctions, each with lights, two stop signs or a side road.

Both junctions share the lanes between them. Two lights may be coordinated: the same cycle, and the second one turns
green when vehicles arrive that left the first one at the beginning of green.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from drivax.synthetic.roads.curves import Curve, Pose, join_curves, straight, winding
from drivax.synthetic.roads.draft import Draft
from drivax.synthetic.roads.families.junction_layout import (
    Approach,
    Arm,
    CrossSection,
    Geometry,
    Reach,
    Site,
    add_crossings,
    connect,
    draw_sidewalk_m,
    draw_street,
    lay_lanes,
    open_approach,
    outline,
    paint,
    starts,
)
from drivax.synthetic.roads.families.rules import Conflicts, LeftTurns, set_lights, set_priorities
from drivax.synthetic.roads.network import Control, RoadNetwork
from drivax.synthetic.roads.signals import SignalPlan, combine_plans
from drivax.synthetic.roads.style import GRID, RoadStyle

#: Kinds of junctions and their shares.
_LIGHTS, _TWO_STOPS, _SIDE_ROAD = "lights", "two_stops", "side_road"
_KINDS = (_LIGHTS, _TWO_STOPS, _SIDE_ROAD)
_SHARES = (0.5, 0.25, 0.25)
#: Weight of a start on the main road relative to one on a side road.
_MAIN_WEIGHT = 3
#: Length of the straight ends of the road between the junctions, m.
_STRAIGHT_M = 25.0
#: Speed of platoons as a share of the limit.
_PLATOON = 0.85


@dataclass(frozen=True)
class _Plot:
    """A junction without lanes; arm 0 leads to the other junction."""

    kind: str
    arms: list[Arm]
    mouths: list[float]
    left_only: bool

    @property
    def main(self) -> tuple[int, ...]:
        """Approaches of the main road."""
        side = [i for i, arm in enumerate(self.arms) if abs(math.sin(self._angle(arm))) > 0.5]
        return tuple(i for i in range(len(self.arms)) if i not in side)

    def _angle(self, arm: Arm) -> float:
        return arm.base.heading - self.arms[0].base.heading

    @property
    def gate(self) -> Pose:
        """Beginning of the road to the other junction, looking outwards."""
        return self.arms[0].base.ahead(self.mouths[0] + self.arms[0].street.stop_line_m)

    def moved(self, gate: Pose) -> _Plot:
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
    """Settings of the family ``corridor``.

    Attributes:
        side_reach: Shape of side roads: nearly straight, so that those of both junctions stay apart.
        between_m: Length of the road between the stop lines of both junctions, low and high.
        two_lane_share: Share of main roads with two lanes per direction.
        left_lane_share: Share of left-turn lanes at lights of two-lane roads.
        protected_share: Share of protected left turns at lights with left-turn lanes.
        coordinated_share: Share of pairs of lights that are coordinated.
        green_s: Green time of a phase, low and high.
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
        first = self._plot(rng, style, main).moved(Pose(0.0, 0.0, float(rng.uniform(-math.pi, math.pi))))
        middle = self._between(rng, first.gate)
        second = self._plot(rng, style, main).moved(middle.end.turned())
        draft = Draft()
        sites, plots = self._sites(rng, draft, (first, second), middle), (first, second)
        outline(draft, sites, {(0, 0): (1, 0), (1, 0): (0, 0)}, draw_sidewalk_m(rng, style, self.geometry))
        paint(draft, main, middle)
        for site in sites:
            for approach in site.approaches[1:]:
                paint(draft, approach.arm.street, approach.middle)
            add_crossings(draft, site)
        conflicts = draft.conflicts()
        plans = [self._rules(rng, draft, conflicts, *pair) for pair in zip(plots, sites, strict=True)]
        chosen = [
            lane
            for plot, site in zip(plots, sites, strict=True)
            for i, approach in enumerate(site.approaches[1:], 1)
            for lane in approach.inward * (_MAIN_WEIGHT if i in plot.main else 1)
        ]
        travel = (float(middle.arc_m[-1]) + first.mouths[0] + second.mouths[0]) / (_PLATOON * main.limit_mps)
        return draft.network(self.name, starts(draft, chosen), self._signals(rng, plans, travel))

    def _plot(self, rng: np.random.Generator, style: RoadStyle, main: CrossSection) -> _Plot:
        kind = _KINDS[rng.choice(len(_KINDS), p=_SHARES)]
        marked = kind == _LIGHTS or bool(rng.random() < 0.4)
        slower = min(main.limit_mps, float(rng.choice(style.limits_mps)))
        side = draw_street(rng, style, (1, 1), slower, kind == _LIGHTS or bool(rng.random() < 0.6))
        main = replace(main, marked=marked)
        streets, headings = [main, side, main, side], [k * math.pi / 2 for k in range(4)]
        if kind == _SIDE_ROAD:
            closed = int(rng.choice([1, 3]))
            del streets[closed], headings[closed]
        arms = self.geometry.arms(rng, headings, streets)
        left_only = kind == _LIGHTS and main.inward > 1 and bool(rng.random() < self.left_lane_share)
        return _Plot(kind, arms, self.geometry.mouths(rng, arms), left_only)

    def _between(self, rng: np.random.Generator, gate: Pose) -> Curve:
        near = straight(gate, _STRAIGHT_M)
        bent = winding(
            rng,
            float(rng.uniform(*self.between_m)) - 2 * _STRAIGHT_M,
            max_curvature=1.0 / self.geometry.reach.tightest_m,
            max_turn=math.radians(8.0),
            start=near.end,
        )
        return join_curves(near, bent, straight(bent.end, _STRAIGHT_M))

    def _sites(
        self, rng: np.random.Generator, draft: Draft, plots: tuple[_Plot, _Plot], middle: Curve
    ) -> list[Site]:
        """Add the shared road, then the other arms and the connectors of both junctions."""
        near, far = plots
        side = join_curves(
            straight(near.arms[0].base.ahead(near.mouths[0]), near.arms[0].street.stop_line_m),
            middle,
            straight(middle.end, far.arms[0].street.stop_line_m),
        )
        there, back = lay_lanes(draft, near.arms[0].street, middle)[::-1]
        shared = (
            Approach(near.arms[0], near.mouths[0], middle, side, back, there),
            Approach(far.arms[0], far.mouths[0], middle.reversed(), side.reversed(), there, back),
        )
        sites = []
        for plot, first in zip(plots, shared, strict=True):
            rest = [
                open_approach(
                    rng, draft, arm, mouth, self.geometry.reach if i in plot.main else self.side_reach
                )
                for i, (arm, mouth) in enumerate(zip(plot.arms, plot.mouths, strict=True))
                if i
            ]
            left_only = [plot.left_only and i in plot.main for i in range(len(plot.arms))]
            sites.append(connect(draft, Site((first, *rest)), left_only))
        return sites

    def _rules(
        self, rng: np.random.Generator, draft: Draft, conflicts: Conflicts, plot: _Plot, site: Site
    ) -> SignalPlan | None:
        if plot.kind != _LIGHTS:
            set_priorities(draft, site.moves, conflicts, plot.main, Control.STOP)
            return None
        protected = plot.left_only and bool(rng.random() < self.protected_share)
        lefts = (LeftTurns(protected, permissive=True), LeftTurns(protected=False, permissive=True))
        green = [float(g) for g in rng.uniform(*self.green_s, size=4)]
        return set_lights(draft, site.moves, conflicts, lefts, green)

    def _signals(
        self, rng: np.random.Generator, plans: Sequence[SignalPlan | None], travel_s: float
    ) -> SignalPlan | None:
        first, second = (plan for plan in plans)
        if first is None or second is None:
            return first or second
        cycle = max(first.cycle_s, second.cycle_s)
        if rng.random() < self.coordinated_share:
            return combine_plans(first.stretched(cycle), second.stretched(cycle), travel_s)
        return combine_plans(first, second, float(rng.uniform(0.0, cycle)))
