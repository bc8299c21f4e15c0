"""Mutable draft of a road network: families add and link lanes, then freeze it."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from drivax.scenario.schema import RoadKind
from drivax.synthetic.roads.curves import Curve, Pose
from drivax.synthetic.roads.network import Bay, Crossing, Lane, Line, RoadNetwork, Start, conflicting
from drivax.synthetic.roads.signals import SignalPlan


@dataclass
class Draft:
    """Features of a future :class:`~drivax.synthetic.roads.network.RoadNetwork`."""

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
        """Change attributes of a lane, such as rules that depend on other lanes."""
        self.lanes[lane] = replace(self.lanes[lane], **attributes)

    def link(self, before: int, after: int) -> None:
        """Make lane ``after`` a successor of lane ``before``."""
        a, b = self.lanes[before], self.lanes[after]
        self.lanes[before] = replace(a, successors=(*a.successors, after))
        self.lanes[after] = replace(b, predecessors=(*b.predecessors, before))

    def link_neighbours(self, left: int, right: int) -> None:
        """Make two lanes of the same direction neighbours."""
        self.lanes[left] = replace(self.lanes[left], right=right)
        self.lanes[right] = replace(self.lanes[right], left=left)

    def mark(self, kind: RoadKind, curve: Curve) -> None:
        """Add a marking along a curve, sampled at about 1 m."""
        self.markings.append(Line(kind, curve.xy[::2]))

    def crosswalk(self, *corners: Pose) -> None:
        """Add the outline of a crosswalk."""
        self.crosswalks.append(Line(RoadKind.CROSSWALK, points(*corners)))

    def conflicts(self) -> Bool[np.ndarray, "lane lane"]:
        """See :attr:`RoadNetwork.conflicts`, of the lanes so far."""
        return conflicting(tuple(self.lanes))

    def network(
        self, family: str, starts: tuple[Start, ...], signals: SignalPlan | None = None
    ) -> RoadNetwork:
        """Return the finished network."""
        features = {item.name: tuple(getattr(self, item.name)) for item in fields(self)}
        return RoadNetwork(family, starts=starts, signals=signals, **features)


def points(*poses: Pose) -> Float64[np.ndarray, "pose 2"]:
    """Positions of poses."""
    return np.array([[pose.x, pose.y] for pose in poses])


def ring(*curves: Curve) -> Float64[np.ndarray, "point 2"]:
    """Closed ring of successive curves, sampled at about 1 m without repeated points."""
    xy = np.concatenate([np.concatenate([curve.xy[:-1:2], curve.xy[-1:]]) for curve in curves])
    far = np.hypot(*(xy - np.roll(xy, 1, axis=0)).T) > 1e-6
    return xy[far]
