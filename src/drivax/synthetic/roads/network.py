"""Road networks: lanes with links and rules, closed edges, markings, crosswalks, lights, starts.

Road styles are the ranges from which all families of a domain draw networks.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, wraps
from itertools import combinations, permutations
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float64

from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import RoadKind
from drivax.synthetic.roads.curves import Curve, Pose
from drivax.synthetic.roads.signals import SignalPlan

#: Connectors whose centre lines come closer than this are in conflict, m.
CLEARANCE_M = 2.9
#: Map features have every second sample of a lane, about 1 m apart.
_STRIDE = 2
#: Numbers of lanes ahead (inward) and of opposite lanes (outward), and share, of each layout.
Layouts = tuple[tuple[int, int, float], ...]


_T = TypeVar("_T")


def per_roads(derive: Callable[[RoadNetwork], _T]) -> Callable[[RoadNetwork], _T]:
    """Cache a function of a network for all networks with the same roads (:meth:`RoadNetwork.with_signals`)."""

    @wraps(derive)
    def look_up(network: RoadNetwork) -> _T:
        if derive not in network.derived:
            network.derived[derive] = derive(network)
        return network.derived[derive]

    return look_up


class Control(enum.IntEnum):
    """Traffic control at the entry of a lane."""

    NONE = 0
    SIGNAL = 1
    YIELD = 2
    STOP = 3
    ALL_WAY_STOP = 4


@dataclass(frozen=True)
class Lane:
    """A lane; links are indices into ``RoadNetwork.lanes``, -1 is none.

    Attributes:
        left, right: Neighbours in the same direction.
        connector: Whether the lane leads across a junction; connectors may cross, and have rules at the entry.
        control: Rule at the entry of a connector; the stop line is where it begins.
        yields_to: Conflicting connectors with right of way, at lights only of the same phase; empty at all-way stops.
        ends: Whether the lane ends without a successor while the road continues (lane drops, acceleration lanes).
        exit_only: Whether the lane leads off the road (deceleration lanes and off-ramps).
        kind: Type of the lane: for cars, or for bicycles only.
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
    """An edge (closed ring, drivable side on its left), a marking or the outline of a crosswalk."""

    kind: RoadKind
    xy: Float64[np.ndarray, "point 2"]


@dataclass(frozen=True)
class Start:
    """Start of ego: a lane and the range of distances along it, m."""

    lane: int
    low_m: float
    high_m: float


@dataclass(frozen=True)
class Crossing:
    """Place where pedestrians cross, from kerb to kerb along an axis.

    Attributes:
        lanes: Crossed lanes, each with the distance along it of the axis, m.
        marked: Whether there is a crosswalk, where drivers yield to pedestrians.
    """

    axis: Float64[np.ndarray, "2 2"]
    width_m: float
    lanes: tuple[tuple[int, float], ...]
    marked: bool = True


@dataclass(frozen=True)
class Bay:
    """Parking space inside the road's edges: its middle and length, the adjacent lane and the distance along it, m."""

    pose: Pose
    length_m: float
    lane: int
    along_m: float


@dataclass(frozen=True, eq=False)
class RoadNetwork:
    """A road map in its own frame (metres), equal only to itself.

    Attributes:
        edges: Closed rings without the repeated point: the outer boundary counter-clockwise, islands clockwise.
        sidewalks: Sidewalks outside the edges.
        busy: Lanes with denser traffic.
        derived: Results that :func:`per_roads` caches.
    """

    family: str
    lanes: tuple[Lane, ...]
    edges: tuple[Line, ...]
    markings: tuple[Line, ...] = ()
    crosswalks: tuple[Line, ...] = ()
    signals: SignalPlan | None = None
    starts: tuple[Start, ...] = ()
    crossings: tuple[Crossing, ...] = ()
    sidewalks: tuple[Curve, ...] = ()
    bays: tuple[Bay, ...] = ()
    busy: tuple[int, ...] = ()
    derived: dict[Any, Any] = field(init=False, repr=False, default_factory=dict)

    def with_signals(self, signals: SignalPlan | None) -> RoadNetwork:
        """Return the same roads with another plan for the same groups of lights; both share the cached results."""
        result = replace(self, signals=signals)
        result.__dict__["derived"] = self.derived
        return result

    @property
    @per_roads
    def conflicts(self) -> Bool[np.ndarray, "lane lane"]:
        """Pairs of connectors that come closer than ``CLEARANCE_M`` and begin at different lanes."""
        return conflict_matrix(self.lanes)

    @property
    @per_roads
    def marked_crossings(self) -> dict[int, list[tuple[int, float]]]:
        """Marked crossings of each lane: index, and distance along the lane to the crossing's near side, m."""
        result: dict[int, list[tuple[int, float]]] = {}
        for number, crossing in enumerate(self.crossings):
            for lane, along in crossing.lanes if crossing.marked else ():
                result.setdefault(lane, []).append((number, along - crossing.width_m / 2))
        return result

    @property
    @per_roads
    def shared_m(self) -> dict[tuple[int, int], float]:
        """Distance along the first of two successors of a lane over which it shares space with the second, m."""
        pairs = (pair for lane in self.lanes for pair in permutations(lane.successors, 2))
        return {(a, b): _shared_length(self.lanes[a].curve, self.lanes[b].curve) for a, b in pairs}


def conflict_matrix(lanes: Sequence[Lane]) -> Bool[np.ndarray, "lane lane"]:
    """Mask of pairs of connectors that conflict (:attr:`RoadNetwork.conflicts`)."""
    result = np.zeros((len(lanes), len(lanes)), bool)
    connectors = [i for i, lane in enumerate(lanes) if lane.connector]
    low = np.array([lanes[i].curve.xy.min(axis=0) for i in connectors]).reshape(-1, 2)
    high = np.array([lanes[i].curve.xy.max(axis=0) for i in connectors]).reshape(-1, 2)
    # Bounding boxes exclude most pairs of a network with several junctions.
    is_apart = (low[:, None] - high).max(axis=-1) > CLEARANCE_M
    is_apart = is_apart | is_apart.T
    for (i, a), (k, b) in combinations(enumerate(connectors), 2):
        if not is_apart[i, k] and set(lanes[a].predecessors).isdisjoint(lanes[b].predecessors):
            squared = _squared_distances(lanes[a].curve.xy[::2], lanes[b].curve.xy[::2])
            result[a, b] = result[b, a] = math.sqrt(squared.min()) < CLEARANCE_M
    return result


def _shared_length(a: Curve, b: Curve) -> float:
    """Return the distance along ``a`` over which it shares space with ``b``, m."""
    is_clear = np.sqrt(_squared_distances(a.xy, b.xy).min(axis=1)) > CLEARANCE_M
    return float(a.arc_m[int(np.argmax(is_clear)) if is_clear.any() else -1])


def _squared_distances(
    a: Float64[np.ndarray, "a 2"], b: Float64[np.ndarray, "b 2"]
) -> Float64[np.ndarray, "a b"]:
    dx, dy = (np.subtract.outer(a[:, k], b[:, k]) for k in (0, 1))
    return dx * dx + dy * dy


@dataclass
class Draft:
    """Features of a future :class:`RoadNetwork`: families add and link them, then call :meth:`network`."""

    lanes: list[Lane] = field(default_factory=list)
    edges: list[Line] = field(default_factory=list)
    markings: list[Line] = field(default_factory=list)
    crosswalks: list[Line] = field(default_factory=list)
    crossings: list[Crossing] = field(default_factory=list)
    sidewalks: list[Curve] = field(default_factory=list)
    bays: list[Bay] = field(default_factory=list)

    def lane(self, curve: Curve, width_m: float, limit_mps: float, **extra: Any) -> int:
        """Add a lane with further attributes of :class:`Lane` and return its index."""
        self.lanes.append(Lane(curve, width_m, limit_mps, **extra))
        return len(self.lanes) - 1

    def change(self, lane: int, **attributes: Any) -> None:
        """Change attributes of a lane, such as rules that depend on other lanes."""
        self.lanes[lane] = replace(self.lanes[lane], **attributes)

    def link(self, before: int, after: int) -> None:
        """Make lane ``after`` a successor of lane ``before``."""
        self.change(before, successors=(*self.lanes[before].successors, after))
        self.change(after, predecessors=(*self.lanes[after].predecessors, before))

    def link_neighbours(self, left: int, right: int) -> None:
        """Make two lanes in the same direction neighbours."""
        self.change(left, right=right)
        self.change(right, left=left)

    def mark(self, kind: RoadKind, curve: Curve) -> None:
        """Add a marking along a curve, sampled at about 1 m."""
        self.markings.append(Line(kind, curve.xy[::2]))

    def crosswalk(self, *corners: Pose) -> None:
        """Add the outline of a crosswalk."""
        self.crosswalks.append(Line(RoadKind.CROSSWALK, points(*corners)))

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
    is_new = np.hypot(*(xy - np.roll(xy, 1, axis=0)).T) > 1e-6
    return xy[is_new]


def feature_id(lane: int) -> int:
    """Map feature id of a lane."""
    return lane + 1


@per_roads
def map_features(network: RoadNetwork) -> tuple[MapFeature, ...]:
    """Convert a network to map features: lanes first (ids 1, 2, ...), then edges, markings, crosswalks, stop signs."""
    features = [_lane_feature(index, lane) for index, lane in enumerate(network.lanes)]
    edges = [Line(line.kind, np.concatenate([line.xy, line.xy[:1]])) for line in network.edges]
    for line in (*edges, *network.markings, *network.crosswalks):
        features.append(MapFeature(feature_id=len(features) + 1, kind=line.kind, points=_flat(line.xy)))
    for stop_lane, connectors in _stop_controlled_lanes(network).items():
        features.append(
            MapFeature(
                feature_id=len(features) + 1,
                kind=RoadKind.STOP_SIGN,
                points=_flat(network.lanes[stop_lane].curve.xy[-1:]),
                lanes=tuple(map(feature_id, connectors)),
            )
        )
    return tuple(features)


def _stop_controlled_lanes(network: RoadNetwork) -> dict[int, list[int]]:
    """Lanes that end at a stop sign, each with the connectors to which it applies."""
    signs: dict[int, list[int]] = {}
    for index, lane in enumerate(network.lanes):
        if lane.control in (Control.STOP, Control.ALL_WAY_STOP):
            for before in lane.predecessors:
                signs.setdefault(before, []).append(index)
    return signs


def _lane_feature(index: int, lane: Lane) -> MapFeature:
    xy = lane.curve.xy
    return MapFeature(
        feature_id=feature_id(index),
        kind=lane.kind,
        points=_flat(np.concatenate([xy[:-1:_STRIDE], xy[-1:]])),
        limit_mps=lane.limit_mps,
        width_m=lane.width_m,
        successors=tuple(map(feature_id, lane.successors)),
        predecessors=tuple(map(feature_id, lane.predecessors)),
        left_neighbours=() if lane.left < 0 else (feature_id(lane.left),),
        right_neighbours=() if lane.right < 0 else (feature_id(lane.right),),
        interpolating=lane.connector,
    )


def _flat(xy: Float64[np.ndarray, "point 2"]) -> Float64[np.ndarray, "point 3"]:
    return np.concatenate([xy, np.zeros((len(xy), 1))], axis=1)


@dataclass(frozen=True)
class RoadStyle:
    """Statistics of a domain's roads.

    Attributes:
        width_m, shoulder_m: Width of lanes, and drivable width beyond the outer ones, low and high.
        limits_mps, fast_limits_mps: Speed limits of streets and of highways; repeated ones are drawn more often.
        curvature: Factor on the curvature of streets without junctions.
        sidewalk_share, parking_share: Shares of roads with sidewalks and with bays, where they are optional.
    """

    width_m: tuple[float, float] = (3.35, 3.75)
    limits_mps: tuple[float, ...] = (11.2, 13.4, 15.6, 17.9)
    fast_limits_mps: tuple[float, ...] = (22.4, 24.6, 26.8, 29.1)
    shoulder_m: tuple[float, float] = (0.5, 1.5)
    curvature: float = 1.0
    sidewalk_share: float = 0.8
    parking_share: float = 0.3


#: Wide lanes and higher speeds.
GRID = RoadStyle()
#: Narrow lanes, low speeds, bays along most streets.
RING = RoadStyle(
    width_m=(2.9, 3.3),
    limits_mps=(8.3, 8.3, 11.1, 13.9),
    fast_limits_mps=(19.4, 22.2),
    shoulder_m=(0.25, 0.7),
    curvature=1.3,
    sidewalk_share=0.95,
    parking_share=0.7,
)


def draw_layout(rng: np.random.Generator, layouts: Layouts) -> tuple[int, int]:
    """Draw the numbers of lanes ahead and of opposite lanes."""
    ahead, back, _ = layouts[rng.choice(len(layouts), p=[share for *_, share in layouts])]
    return ahead, back
