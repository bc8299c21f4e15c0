"""The table on which a family draws a road network: lanes are added and linked, then frozen."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from drivax.scenario.schema import RoadKind
from drivax.synthetic.roads.curves import Curve
from drivax.synthetic.roads.network import Bay, Crossing, Lane, Line, RoadNetwork, Start
from drivax.synthetic.roads.signals import SignalPlan


@dataclass
class Draft:
    """Lanes and lines on their way into a :class:`~drivax.synthetic.roads.network.RoadNetwork`."""

    lanes: list[Lane] = field(default_factory=list)
    edges: list[Line] = field(default_factory=list)
    markings: list[Line] = field(default_factory=list)
    crosswalks: list[Line] = field(default_factory=list)
    crossings: list[Crossing] = field(default_factory=list)
    walks: list[Curve] = field(default_factory=list)
    bays: list[Bay] = field(default_factory=list)

    def lane(self, curve: Curve, width_m: float, limit_mps: float, **more: Any) -> int:
        """Add a lane with further attributes of :class:`Lane` and return its index."""
        self.lanes.append(Lane(curve, width_m, limit_mps, **more))
        return len(self.lanes) - 1

    def change(self, lane: int, **attributes: Any) -> None:
        """Gives a lane other attributes, such as rules that are known once all lanes are there."""
        self.lanes[lane] = replace(self.lanes[lane], **attributes)

    def link(self, before: int, after: int) -> None:
        """Traffic may go on from lane ``before`` to lane ``after``."""
        a, b = self.lanes[before], self.lanes[after]
        self.lanes[before] = replace(a, successors=(*a.successors, after))
        self.lanes[after] = replace(b, predecessors=(*b.predecessors, before))

    def beside(self, left: int, right: int) -> None:
        """The two lanes run side by side in the same direction."""
        self.lanes[left] = replace(self.lanes[left], right=right)
        self.lanes[right] = replace(self.lanes[right], left=left)

    def mark(self, kind: RoadKind, curve: Curve) -> None:
        """Adds a marking of about 1 m sampling along a curve."""
        self.markings.append(Line(kind, curve.xy[::2]))

    def network(
        self, family: str, starts: tuple[Start, ...], signals: SignalPlan | None = None
    ) -> RoadNetwork:
        """The finished network."""
        return RoadNetwork(
            family=family,
            lanes=tuple(self.lanes),
            edges=tuple(self.edges),
            markings=tuple(self.markings),
            crosswalks=tuple(self.crosswalks),
            signals=signals,
            starts=starts,
            crossings=tuple(self.crossings),
            walks=tuple(self.walks),
            bays=tuple(self.bays),
        )


def ring(*curves: Curve) -> np.ndarray:
    """The points of curves put one after the other as a closed ring, about 1 m apart, none repeated."""
    points = np.concatenate([np.concatenate([curve.xy[:-1:2], curve.xy[-1:]]) for curve in curves])
    far = np.hypot(*(points - np.roll(points, 1, axis=0)).T) > 1e-6
    return points[far]
