"""What a family of roads builds: lanes with links, closed edges, markings, crosswalks, lights and starts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64

from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import RoadKind
from drivax.synthetic.curves import Curve
from drivax.synthetic.signals import SignalPlan

#: Centre lines closer than this belong to movements that cannot be driven at the same time, m.
CLEARANCE_M = 2.9
#: Lanes are written with every second sample: about 1 m apart.
_STRIDE = 2


@dataclass(frozen=True)
class Lane:
    """A lane; its index is its place in ``RoadNetwork.lanes``, links are indices, -1 is none.

    Attributes:
        connector: True for a way across a junction: where lanes may cross and a light may control the entry.
        left, right: The neighbour of the same direction whose ends lie beside this lane's ends.
    """

    curve: Curve
    width_m: float
    limit_mps: float
    successors: tuple[int, ...] = ()
    predecessors: tuple[int, ...] = ()
    left: int = -1
    right: int = -1
    connector: bool = False

    @cached_property
    def length_m(self) -> float:
        """Length of the centre line, m."""
        return float(self.curve.arc_m[-1])


@dataclass(frozen=True)
class Line:
    """An edge (closed ring, drivable side on its left), a marking or a crosswalk's outline."""

    kind: RoadKind
    xy: Float64[np.ndarray, "point 2"]


@dataclass(frozen=True)
class Start:
    """Where ego may be when the recording begins: a lane and the range of distances along it, m."""

    lane: int
    low_m: float
    high_m: float


@dataclass(frozen=True)
class RoadNetwork:
    """A road map in its own frame (metres).

    Attributes:
        family: Name of the family that built it.
        lanes: All lanes.
        edges: Closed rings without the repeated point: the outer boundary counter-clockwise, islands clockwise.
        signals: The lights of its junction, or None.
        starts: Where ego may begin.
    """

    family: str
    lanes: tuple[Lane, ...]
    edges: tuple[Line, ...]
    markings: tuple[Line, ...] = ()
    crosswalks: tuple[Line, ...] = ()
    signals: SignalPlan | None = None
    starts: tuple[Start, ...] = ()

    @cached_property
    def conflicts(self) -> Bool[np.ndarray, "lane lane"]:
        """Which connectors come closer than ``CLEARANCE_M`` although they begin at different lanes."""
        return conflicting(self.lanes)

    @cached_property
    def shared_m(self) -> dict[tuple[int, int], float]:
        """For lanes that leave the same lane: how far along the first both need the same space, m."""
        result: dict[tuple[int, int], float] = {}
        for lane in self.lanes:
            for a in lane.successors:
                for b in lane.successors:
                    if a != b:
                        result[a, b] = _shared_length(self.lanes[a].curve, self.lanes[b].curve)
        return result


def conflicting(lanes: tuple[Lane, ...]) -> Bool[np.ndarray, "lane lane"]:
    """See :attr:`RoadNetwork.conflicts`."""
    result = np.zeros((len(lanes), len(lanes)), bool)
    ways = [i for i, lane in enumerate(lanes) if lane.connector]
    for place, a in enumerate(ways):
        for b in ways[place + 1 :]:
            if set(lanes[a].predecessors) & set(lanes[b].predecessors):
                continue
            near = _distance(lanes[a].curve.xy[::2], lanes[b].curve.xy[::2]) < CLEARANCE_M
            result[a, b] = result[b, a] = near
    return result


def _distance(a: Float64[np.ndarray, "a 2"], b: Float64[np.ndarray, "b 2"]) -> float:
    return float(np.sqrt(np.min(np.sum((a[:, None] - b[None]) ** 2, axis=-1))))


def _shared_length(a: Curve, b: Curve) -> float:
    gap = np.sqrt(np.min(np.sum((a.xy[:, None] - b.xy[None]) ** 2, axis=-1), axis=1))
    apart = gap > CLEARANCE_M
    return float(a.arc_m[int(np.argmax(apart))] if apart.any() else a.arc_m[-1])


def feature_id(lane: int) -> int:
    """The map feature id of a lane index."""
    return lane + 1


def map_features(network: RoadNetwork) -> tuple[MapFeature, ...]:
    """The network as map features: lanes first (ids 1, 2, ...), then edges, markings and crosswalks."""
    features = [_lane_feature(index, lane) for index, lane in enumerate(network.lanes)]
    for line in network.edges:
        features.append(_line_feature(len(features) + 1, line.kind, np.concatenate([line.xy, line.xy[:1]])))
    for line in network.markings + network.crosswalks:
        features.append(_line_feature(len(features) + 1, line.kind, line.xy))
    return tuple(features)


def _lane_feature(index: int, lane: Lane) -> MapFeature:
    return MapFeature(
        feature_id=feature_id(index),
        kind=RoadKind.LANE_SURFACE,
        points=_flat(_thinned(lane.curve.xy)),
        limit_mps=lane.limit_mps,
        width_m=lane.width_m,
        successors=tuple(map(feature_id, lane.successors)),
        predecessors=tuple(map(feature_id, lane.predecessors)),
        left_neighbours=() if lane.left < 0 else (feature_id(lane.left),),
        right_neighbours=() if lane.right < 0 else (feature_id(lane.right),),
        interpolating=lane.connector,
    )


def _line_feature(number: int, kind: RoadKind, xy: Float64[np.ndarray, "point 2"]) -> MapFeature:
    return MapFeature(feature_id=number, kind=kind, points=_flat(xy))


def _thinned(xy: Float64[np.ndarray, "point 2"]) -> Float64[np.ndarray, "kept 2"]:
    return xy if len(xy) < 3 else np.concatenate([xy[:-1:_STRIDE], xy[-1:]])


def _flat(xy: Float64[np.ndarray, "point 2"]) -> Float64[np.ndarray, "point 3"]:
    return np.concatenate([xy, np.zeros((len(xy), 1))], axis=1)
