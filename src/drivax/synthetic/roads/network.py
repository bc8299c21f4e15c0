"""What a family of roads builds: lanes with links and rules, closed edges, markings, crosswalks, lights, starts."""

from __future__ import annotations

import enum
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64

from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import RoadKind
from drivax.synthetic.roads.curves import Curve, Pose
from drivax.synthetic.roads.signals import SignalPlan

#: Centre lines closer than this belong to movements that cannot be driven at the same time, m.
CLEARANCE_M = 2.9
#: Lanes are written with every second sample: about 1 m apart.
_STRIDE = 2


class Control(enum.IntEnum):
    """What a driver meets where a lane begins."""

    NONE = 0
    SIGNAL = 1
    YIELD = 2
    STOP = 3
    ALL_WAY_STOP = 4


@dataclass(frozen=True)
class Lane:
    """A lane; its index is its place in ``RoadNetwork.lanes``, links are indices, -1 is none.

    Attributes:
        connector: True for a way across a junction: where lanes may cross and where rules hold at the entry.
        left, right: The neighbour of the same direction whose ends lie beside this lane's ends.
        control: The rule at the entry of a connector; the stop line is where the lane begins.
        yields_to: Connectors whose users go first where both would meet: the priority road at a yield or stop sign,
            the oncoming traffic of a left turn, who circulates in a roundabout. With all-way stops who stood first
            goes first, and this is empty.
        ends: The lane ends without a successor although the road goes on: its users must change to a neighbour
            (lane drops, acceleration lanes).
        exit_only: The lane leads off the road (a deceleration lane): who goes straight on does not use it.
        kind: For cars or for bicycles only.
    """

    curve: Curve
    width_m: float
    limit_mps: float
    successors: tuple[int, ...] = ()
    predecessors: tuple[int, ...] = ()
    left: int = -1
    right: int = -1
    connector: bool = False
    control: Control = Control.NONE
    yields_to: tuple[int, ...] = ()
    ends: bool = False
    exit_only: bool = False
    kind: RoadKind = RoadKind.LANE_SURFACE

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
class Crossing:
    """Where people cross: the axis from kerb to kerb, and the crosswalk's width; unmarked ones are not painted.

    Attributes:
        axis: Two points, one on each kerb.
        width_m: Width of the crosswalk.
        lanes: The lanes that it crosses, and where on each (m along its centre) the axis does.
        marked: Whether there is a crosswalk, so that drivers have to let people cross.
    """

    axis: Float64[np.ndarray, "2 2"]
    width_m: float
    lanes: tuple[tuple[int, float], ...]
    marked: bool = True


@dataclass(frozen=True)
class Bay:
    """A place to park beside the lanes, inside the road's edges: its middle, heading and length.

    Attributes:
        lane: The lane beside it; a car that stands in that lane beside the bay is double-parked.
        along_m: Where on that lane the middle of the bay is.
    """

    pose: Pose
    length_m: float
    lane: int
    along_m: float


@dataclass(frozen=True)
class RoadNetwork:
    """A road map in its own frame (metres).

    Attributes:
        family: Name of the family that built it.
        lanes: All lanes.
        edges: Closed rings without the repeated point: the outer boundary counter-clockwise, islands clockwise.
        signals: The lights of its junctions, or None.
        starts: Where ego may begin.
        crossings: Where people may cross.
        walks: Sidewalks, outside the edges; people walk along them in both directions.
        bays: Places where cars may be parked.
        busy: Lanes on which traffic is denser than elsewhere.
    """

    family: str
    lanes: tuple[Lane, ...]
    edges: tuple[Line, ...]
    markings: tuple[Line, ...] = ()
    crosswalks: tuple[Line, ...] = ()
    signals: SignalPlan | None = None
    starts: tuple[Start, ...] = ()
    crossings: tuple[Crossing, ...] = ()
    walks: tuple[Curve, ...] = ()
    bays: tuple[Bay, ...] = ()
    busy: tuple[int, ...] = ()

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
    low = np.array([lanes[i].curve.xy.min(axis=0) for i in ways]).reshape(-1, 2)
    high = np.array([lanes[i].curve.xy.max(axis=0) for i in ways]).reshape(-1, 2)
    # Most pairs of a network with several junctions are far apart: their bounding boxes tell.
    far = ((low[:, None] - high[None]).max(axis=-1) > CLEARANCE_M) | (
        (low[None] - high[:, None]).max(axis=-1) > CLEARANCE_M
    )
    for place, a in enumerate(ways):
        for other, b in enumerate(ways[place + 1 :], place + 1):
            if far[place, other] or set(lanes[a].predecessors) & set(lanes[b].predecessors):
                continue
            near = _distance(lanes[a].curve.xy[::2], lanes[b].curve.xy[::2]) < CLEARANCE_M
            result[a, b] = result[b, a] = near
    return result


def _distance(a: Float64[np.ndarray, "a 2"], b: Float64[np.ndarray, "b 2"]) -> float:
    dx, dy = (np.subtract.outer(a[:, k], b[:, k]) for k in (0, 1))
    return float(np.sqrt((dx * dx + dy * dy).min()))


def _shared_length(a: Curve, b: Curve) -> float:
    gap = np.sqrt(np.min(np.sum((a.xy[:, None] - b.xy[None]) ** 2, axis=-1), axis=1))
    apart = gap > CLEARANCE_M
    return float(a.arc_m[int(np.argmax(apart))] if apart.any() else a.arc_m[-1])


def feature_id(lane: int) -> int:
    """The map feature id of a lane index."""
    return lane + 1


def map_features(network: RoadNetwork) -> tuple[MapFeature, ...]:
    """The network as map features: lanes first (ids 1, 2, ...), then edges, markings, crosswalks, stop signs."""
    features = [_lane_feature(index, lane) for index, lane in enumerate(network.lanes)]
    for line in network.edges:
        features.append(_line_feature(len(features) + 1, line.kind, np.concatenate([line.xy, line.xy[:1]])))
    for line in network.markings + network.crosswalks:
        features.append(_line_feature(len(features) + 1, line.kind, line.xy))
    for stop in _stop_signs(network):
        features.append(replace(stop, feature_id=len(features) + 1))
    return tuple(features)


def _stop_signs(network: RoadNetwork) -> list[MapFeature]:
    """One sign per lane from which connectors with a stop begin, at the stop line."""
    signs: dict[int, list[int]] = {}
    for index, lane in enumerate(network.lanes):
        if lane.control in (Control.STOP, Control.ALL_WAY_STOP):
            for before in lane.predecessors:
                signs.setdefault(before, []).append(index)
    return [
        MapFeature(
            feature_id=0,
            kind=RoadKind.STOP_SIGN,
            points=_flat(network.lanes[before].curve.xy[-1:]),
            lanes=tuple(map(feature_id, ways)),
        )
        for before, ways in signs.items()
    ]


def _lane_feature(index: int, lane: Lane) -> MapFeature:
    return MapFeature(
        feature_id=feature_id(index),
        kind=lane.kind,
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
