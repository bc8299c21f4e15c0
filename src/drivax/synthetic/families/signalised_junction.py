"""A four-way junction with lights: random angles, one or two lanes per approach, protected or split phases.

No two movements that could meet are ever green together. Where an approach has one lane, or shares it between left
and straight on, the approaches take turns (split phases); where the left lane is for turning left only, opposing
left turns share a phase (protected lefts), unless the geometry brings them too close.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool

from drivax.scenario.schema import RoadKind
from drivax.synthetic.curves import STEP_M, Curve, Pose, connected, joined, resampled, straight, winding
from drivax.synthetic.drafting import Draft, ring
from drivax.synthetic.roads import Line, RoadNetwork, Start, conflicting
from drivax.synthetic.signals import LightGroup, SignalPlan
from drivax.synthetic.style import GRID, RoadStyle

_ARMS = 4
#: From the junction's mouth outwards: the crosswalk, then the stop line, m.
_CROSSWALK_M = (0.8, 4.0)
_STOP_LINE_M = 5.5


@dataclass(frozen=True)
class Arm:
    """One road that meets the junction. Its middle line runs outwards from the stop lines.

    Attributes:
        base: Where the middle line would meet the junction's centre, looking outwards.
        half_m: Width of the lanes of one direction.
        lanes: Lanes per direction.
    """

    base: Pose
    lanes: int
    width_m: float
    shoulder_m: float

    @property
    def half_m(self) -> float:
        """From the middle line to the road's edge."""
        return self.lanes * self.width_m + self.shoulder_m


@dataclass(frozen=True)
class Approach:
    """What an arm became: its middle line from the stop lines outwards and its lanes, left to right."""

    middle: Curve
    mouth_m: float
    inward: tuple[int, ...]
    outward: tuple[int, ...]


@dataclass(frozen=True)
class SignalisedJunction:
    """Settings of the family ``signalised_junction``.

    Attributes:
        arm_m: Length of every arm beyond its stop line.
        skew: Largest deviation of an arm from a right angle, rad.
        offset_m: Largest sideways offset of an arm from the centre.
        corner_m: Corner radius, low and high.
        limits_mps: Speed limits to choose from.
        protected_share: Share of junctions with two lanes per approach that have a left-turn lane.
        green_s: Green time of a phase, low and high.
    """

    arm_m: float = 230.0
    skew: float = math.radians(11.0)
    offset_m: float = 1.5
    corner_m: tuple[float, float] = (7.5, 13.0)
    limits_mps: tuple[float, ...] = (11.2, 13.4, 15.6)
    protected_share: float = 0.6
    green_s: tuple[float, float] = (7.0, 14.0)
    name: str = "signalised_junction"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draws a junction; ego may begin on any approach, 12 to 85 m before its stop line."""
        arms = self._arms(rng)
        limit = float(rng.choice(self.limits_mps))
        draft = Draft()
        corner = float(rng.uniform(*self.corner_m))
        approaches = [self._approach(rng, draft, arms, i, corner, limit) for i in range(_ARMS)]
        protected = bool(rng.random() < self.protected_share)
        moves = _connect(draft, approaches, arms, protected)
        _edges(draft, arms, approaches)
        for arm, approach in zip(arms, approaches, strict=True):
            _paint(draft, arm, approach)
        green = tuple(float(g) for g in rng.uniform(*self.green_s, size=_ARMS))
        lanes = tuple(draft.lanes)
        return RoadNetwork(
            family=self.name,
            lanes=lanes,
            edges=tuple(draft.edges),
            markings=tuple(draft.markings),
            crosswalks=tuple(draft.crosswalks),
            signals=_plan(moves, conflicting(lanes), green),
            starts=tuple(
                Start(lane, lanes[lane].length_m - 85.0, lanes[lane].length_m - 12.0)
                for approach in approaches
                for lane in approach.inward
            ),
        )

    def _arms(self, rng: np.random.Generator) -> list[Arm]:
        base = rng.uniform(-math.pi, math.pi)
        width = float(rng.uniform(3.35, 3.7))
        shoulder = float(rng.uniform(0.5, 1.2))
        lanes = rng.choice([1, 2], size=2)
        arms = []
        for i in range(_ARMS):
            heading = float(base + i * math.pi / 2 + rng.uniform(-self.skew, self.skew))
            aside = float(rng.uniform(-self.offset_m, self.offset_m))
            pose = Pose(-aside * math.sin(heading), aside * math.cos(heading), heading)
            arms.append(Arm(pose, int(lanes[i % 2]), width, shoulder))
        return arms

    def _approach(
        self, rng: np.random.Generator, draft: Draft, arms: list[Arm], i: int, corner: float, limit: float
    ) -> Approach:
        """Lays the lanes of one arm: straight near the junction, then bending gently."""
        arm = arms[i]
        left, right = arms[(i + 1) % _ARMS], arms[(i - 1) % _ARMS]
        mouth = corner + max(_corner(arm, left)[0], _corner(right, arm)[1])
        near = straight(arm.base.ahead(mouth + _STOP_LINE_M), 30.0)
        far = winding(
            rng, self.arm_m - 30.0, max_curvature=1 / 120, max_turn=math.radians(28.0), start=near.end
        )
        middle = joined(near, far)
        inward, outward = [], []
        for j in range(arm.lanes):
            aside = (j + 0.5) * arm.width_m
            inward.append(draft.lane(middle.shifted(aside).reversed(), arm.width_m, limit))
            outward.append(draft.lane(middle.shifted(-aside), arm.width_m, limit))
        for way in (inward, outward):
            for a, b in pairwise(way):
                draft.beside(a, b)
        return Approach(middle, mouth, tuple(inward), tuple(outward))


def _corner(right: Arm, left: Arm) -> tuple[float, float]:
    """How far out along both middle lines the left edge of one arm meets the right edge of the next one."""
    a, b = right.base, left.base
    sin = math.sin(b.heading - a.heading)
    ax, ay = a.x - right.half_m * math.sin(a.heading), a.y + right.half_m * math.cos(a.heading)
    bx, by = b.x + left.half_m * math.sin(b.heading), b.y - left.half_m * math.cos(b.heading)
    dx, dy = bx - ax, by - ay
    along_a = (dx * math.sin(b.heading) - dy * math.cos(b.heading)) / sin
    along_b = (dx * math.sin(a.heading) - dy * math.cos(a.heading)) / sin
    return along_a, along_b


def _connect(
    draft: Draft, approaches: list[Approach], arms: list[Arm], protected: bool
) -> list[dict[str, tuple[int, ...]]]:
    """Adds the ways across; returns per approach the connector lanes of ``left`` and of ``other`` movements."""
    moves = []
    for i, approach in enumerate(approaches):
        count = len(approach.inward)
        left_only = protected and count == 2
        right, across, left = (approaches[(i + k) % _ARMS].outward for k in (1, 2, 3))
        # Arms are numbered counter-clockwise as seen from the centre, so for who comes in the next arm is the
        # one to the right.
        pairs = {"left": [(approach.inward[0], left[0])], "other": [(approach.inward[-1], right[-1])]}
        for j in range(1 if left_only else 0, count):
            pairs["other"].append((approach.inward[j], across[j]))
        moves.append(
            {name: tuple(_way(draft, a, b, arms[i].width_m) for a, b in pair) for name, pair in pairs.items()}
        )
        moves[-1]["protected"] = (1,) if left_only else ()
    return moves


def _way(draft: Draft, before: int, after: int, width: float) -> int:
    a, b = draft.lanes[before], draft.lanes[after]
    # The bend lies between the mouths: a turn that began at the stop line would cut the corner.
    start, end = a.curve.end, b.curve.start
    first, last = straight(start, _STOP_LINE_M), straight(end.ahead(-_STOP_LINE_M), _STOP_LINE_M)
    curve = joined(first, connected(first.end, last.start), last)
    way = draft.lane(resampled(curve, STEP_M), width, a.limit_mps, connector=True)
    draft.link(before, way)
    draft.link(way, after)
    return way


def _plan(
    moves: list[dict[str, tuple[int, ...]]],
    conflicts: Bool[np.ndarray, "lane lane"],
    green: tuple[float, ...],
) -> SignalPlan:
    """Two phases per axis: protected lefts then the rest where that is safe, else one approach after the other."""
    groups: list[LightGroup] = []
    phases: list[tuple[int, ...]] = []

    def group(lanes: tuple[int, ...], arrow: bool) -> int:
        groups.append(LightGroup(lanes, arrow))
        return len(groups) - 1

    for a, b in ((moves[0], moves[2]), (moves[1], moves[3])):
        together = all(not conflicts[x, y] for kind in ("left", "other") for x in a[kind] for y in b[kind])
        if a["protected"] and b["protected"] and together:
            phases.append(tuple(group(move["left"], arrow=True) for move in (a, b)))
            phases.append(tuple(group(move["other"], arrow=False) for move in (a, b)))
        else:
            phases.extend((group(move["left"] + move["other"], arrow=False),) for move in (a, b))
    return SignalPlan(tuple(groups), tuple(phases), green)


def _edges(draft: Draft, arms: list[Arm], approaches: list[Approach]) -> None:
    """One boundary, counter-clockwise: out along each arm's right side, back along its left, round the corner."""
    curves = []
    for i, (arm, approach) in enumerate(zip(arms, approaches, strict=True)):
        inner = straight(arm.base.ahead(approach.mouth_m), _STOP_LINE_M)
        side = joined(inner, approach.middle)
        curves += [side.shifted(-arm.half_m), side.shifted(arm.half_m).reversed()]
        nxt, mouth = arms[(i + 1) % _ARMS], approaches[(i + 1) % _ARMS].mouth_m
        begin = arm.base.ahead(approach.mouth_m)
        end = nxt.base.ahead(mouth)
        curves.append(
            _kerb(
                _aside(begin, arm.half_m), _aside(end, -nxt.half_m), _corner(arm, nxt), (arm.base, arm.half_m)
            )
        )
    draft.edges.append(Line(RoadKind.EDGE_BOUNDARY, ring(*curves)))


def _aside(pose: Pose, left_m: float) -> Pose:
    return Pose(
        pose.x - left_m * math.sin(pose.heading), pose.y + left_m * math.cos(pose.heading), pose.heading
    )


def _kerb(begin: Pose, end: Pose, corner: tuple[float, float], arm: tuple[Pose, float]) -> Curve:
    """The corner's kerb: a quadratic Bezier curve between the mouths, tangent to both edges."""
    meet = _aside(arm[0].ahead(corner[0]), arm[1])
    t = np.linspace(0.0, 1.0, 33)[:, None]
    p0, p1, p2 = (np.array([p.x, p.y]) for p in (begin, meet, end))
    xy = (1 - t) ** 2 * p0 + 2 * t * (1 - t) * p1 + t**2 * p2
    rate = 2 * (1 - t) * (p1 - p0) + 2 * t * (p2 - p1)
    return Curve(xy, np.unwrap(np.arctan2(rate[:, 1], rate[:, 0])))


def _paint(draft: Draft, arm: Arm, approach: Approach) -> None:
    """Markings along the arm and the crosswalk at its mouth."""
    draft.mark(RoadKind.LINE_SOLID_DOUBLE_YELLOW, approach.middle)
    for side in (-1.0, 1.0):
        for j in range(1, arm.lanes + 1):
            kind = RoadKind.LINE_SOLID_SINGLE_WHITE if j == arm.lanes else RoadKind.LINE_BROKEN_SINGLE_WHITE
            draft.mark(kind, approach.middle.shifted(side * j * arm.width_m))
    near, far = (arm.base.ahead(approach.mouth_m + metres) for metres in _CROSSWALK_M)
    corners = [
        _aside(near, arm.half_m),
        _aside(far, arm.half_m),
        _aside(far, -arm.half_m),
        _aside(near, -arm.half_m),
    ]
    draft.crosswalks.append(Line(RoadKind.CROSSWALK, np.array([[p.x, p.y] for p in corners])))
