"""A winding road with one to three lanes ahead and none to two the other way, sometimes with a median."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from drivax.scenario.schema import RoadKind
from drivax.synthetic.curves import STEP_M, Curve, Pose, winding
from drivax.synthetic.drafting import Draft, ring
from drivax.synthetic.roads import Line, RoadNetwork, Start
from drivax.synthetic.style import GRID, RoadStyle

#: Lanes ahead and lanes the other way, with the share of each layout.
_LAYOUTS = ((1, 1), (2, 0), (2, 1), (2, 2), (3, 0), (3, 1))
_SHARES = (0.28, 0.16, 0.12, 0.24, 0.1, 0.1)


@dataclass(frozen=True)
class CurvedRoad:
    """Settings of the family ``curved_road``.

    Attributes:
        length_m: Length of the reference line.
        section_m: Lanes are cut into sections of this length, all at the same stations.
        tightest_m: Radius of the tightest bend of the reference line, drawn per road, low and high.
        widest_turn: Largest difference of two headings, rad.
        limits_mps: Speed limits to choose from.
        median_share: Share of roads with traffic both ways that have a raised median.
        shoulder_m: Drivable width beyond the outer lanes, low and high.
    """

    length_m: float = 640.0
    section_m: float = 80.0
    tightest_m: tuple[float, float] = (30.0, 140.0)
    widest_turn: float = math.radians(150.0)
    limits_mps: tuple[float, ...] = (11.2, 13.4, 15.6, 17.9)
    median_share: float = 0.3
    shoulder_m: tuple[float, float] = (0.5, 1.5)
    name: str = "curved_road"

    def build(self, rng: np.random.Generator, style: RoadStyle = GRID) -> RoadNetwork:
        """Draws a road; ego may begin in the second section of any lane ahead."""
        ahead, back = _LAYOUTS[rng.choice(len(_LAYOUTS), p=_SHARES)]
        tightest = float(rng.uniform(*self.tightest_m))
        middle = winding(
            rng,
            self.length_m,
            max_curvature=1.0 / tightest,
            max_turn=self.widest_turn,
            start=Pose(0.0, 0.0, float(rng.uniform(-math.pi, math.pi))),
        )
        width = float(rng.uniform(3.35, 3.75))
        limit = float(rng.choice(self.limits_mps))
        median = float(rng.uniform(1.5, 3.0)) if back and rng.random() < self.median_share else 0.0
        draft = Draft()
        columns = [
            self._column(draft, middle.shifted(-median / 2 - (j + 0.5) * width), width, limit)
            for j in range(ahead)
        ]
        oncoming = [
            self._column(draft, middle.shifted(median / 2 + (j + 0.5) * width).reversed(), width, limit)
            for j in range(back)
        ]
        for way in (columns, oncoming):
            for left, right in pairwise(way):
                for a, b in zip(left, right, strict=True):
                    draft.beside(a, b)
        shoulder = float(rng.uniform(*self.shoulder_m))
        self._edges(draft, middle, ahead * width + median / 2, back * width + median / 2, shoulder, median)
        _markings(draft, middle, (ahead, back), width, median)
        return RoadNetwork(
            family=self.name,
            lanes=tuple(draft.lanes),
            edges=tuple(draft.edges),
            markings=tuple(draft.markings),
            starts=tuple(Start(column[1], 40.0, 75.0) for column in columns),
        )

    def _column(self, draft: Draft, curve: Curve, width: float, limit: float) -> list[int]:
        """One lane from end to end, cut into sections."""
        sections = max(1, round(self.length_m / self.section_m))
        cuts = np.linspace(0, len(curve.xy) - 1, sections + 1).round().astype(int)
        lanes = [draft.lane(curve.piece(int(a), int(b)), width, limit) for a, b in pairwise(cuts)]
        for before, after in pairwise(lanes):
            draft.link(before, after)
        return lanes

    def _edges(
        self, draft: Draft, middle: Curve, right: float, left: float, shoulder: float, median: float
    ) -> None:
        outer = ring(middle.shifted(-right - shoulder), middle.shifted(left + shoulder).reversed())
        draft.edges.append(Line(RoadKind.EDGE_BOUNDARY, outer))
        if median:
            # Traffic keeps half a metre to the kerb of the median, and may pass around its ends.
            half = median / 2 - 0.4
            inner = middle.piece(round(2 / STEP_M), len(middle.xy) - 1 - round(2 / STEP_M))
            island = ring(inner.shifted(half), inner.shifted(-half).reversed())
            draft.edges.append(Line(RoadKind.EDGE_MEDIAN, island))


def _markings(draft: Draft, middle: Curve, lanes: tuple[int, int], width: float, median: float) -> None:
    """White lines between and beside lanes of one direction, yellow ones between the directions."""
    ahead, back = lanes
    for count, side in ((ahead, -1.0), (back, 1.0)):
        for j in range(1, count + 1):
            kind = RoadKind.LINE_SOLID_SINGLE_WHITE if j == count else RoadKind.LINE_BROKEN_SINGLE_WHITE
            draft.mark(kind, middle.shifted(side * (median / 2 + j * width)))
    if not back:
        draft.mark(RoadKind.LINE_SOLID_SINGLE_YELLOW, middle)
    elif median:
        draft.mark(RoadKind.LINE_SOLID_SINGLE_YELLOW, middle.shifted(-median / 2))
        draft.mark(RoadKind.LINE_SOLID_SINGLE_YELLOW, middle.shifted(median / 2))
    elif ahead + back == 2:
        draft.mark(RoadKind.LINE_BROKEN_SINGLE_YELLOW, middle)
    else:
        draft.mark(RoadKind.LINE_SOLID_DOUBLE_YELLOW, middle)
