"""Pedestrians: they walk along sidewalks, wait at kerbs until it is safe to cross, and then cross."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int8, Int64

from drivax.geometry.boxes import overlap
from drivax.geometry.vectors import wrap
from drivax.scenario.schema import DT_S
from drivax.synthetic.roads.curves import STEP_M, Curve, resample
from drivax.synthetic.roads.network import Control, Crossing, RoadNetwork
from drivax.synthetic.roads.signals import Colour
from drivax.synthetic.traffic.obstacles import Boxes
from drivax.synthetic.traffic.path_arrays import PerVehicle, VehicleMask
from drivax.synthetic.traffic.roles import Walker

#: Where people wait, m before the kerb, how near to it they occupy the crossing, and from where on they look.
_WAIT_M, _CLAIM_M, _LOOK_M = 0.4, 1.0, 1.8
#: How fast a walker gains and loses speed, m/s2.
_ACCELERATION_MPS2 = 1.5
#: A driver who needs less than this to stop before the crosswalk will do so, m/s2, and stops so far before it, m.
_YIELDING_MPS2, _STOP_SHORT_M = 2.5, 2.0
#: Slower vehicles count as standing, m/s.
_STANDING_MPS = 0.3
#: Safety margin of the time to the next vehicle beyond the crossing time, s: where drivers yield, and where they need
#: not.
_MARGIN_S, _GAP_MARGIN_S = 1.0, 1.5
#: Vehicles that see the crossing under a larger angle or head another way do not come to it.
_BEARING, _ASIDE = math.radians(75.0), math.radians(80.0)
#: People keep this distance from the side of a vehicle, m.
_BERTH_M = 0.4
#: Steps between looks at vehicles.
_LOOK_STEPS = 2
#: Lanes that begin or end so near to a crossing have the lights of their neighbours, m.
_NEAR_JUNCTION_M = 25.0


@dataclass(frozen=True)
class _CrossingConflicts:
    """Where crossings meet lanes, one row per meeting, and what the lights say there.

    Attributes:
        red: Per crossing the connectors whose lights must be red while people cross: all but those that turn
            into the crossed road at green and must yield.
    """

    xy: Float64[np.ndarray, "meeting 2"]
    heading: Float64[np.ndarray, " meeting"]
    crossing: Int64[np.ndarray, " meeting"]
    strip: Float64[np.ndarray, "crossing 6"]
    marked: Bool[np.ndarray, " crossing"]
    red: Bool[np.ndarray, "crossing lane"]


def _crossing_conflicts(network: RoadNetwork) -> _CrossingConflicts:
    xy, heading, owner = [], [], []
    for index, crossing in enumerate(network.crossings):
        for lane, along in crossing.lanes:
            curve = network.lanes[lane].curve
            place = min(int(np.searchsorted(curve.arc_m, along)), len(curve.xy) - 1)
            xy.append(curve.xy[place])
            heading.append(curve.heading[place])
            owner.append(index)
    axes = np.array([crossing.axis for crossing in network.crossings]).reshape(-1, 2, 2)
    across = axes[:, 1] - axes[:, 0]
    length = np.hypot(*across.T)
    # People walk in the middle of the crosswalk: who stands on its rim does not block it.
    strip = np.column_stack([axes.mean(axis=1), across / length[:, None], length, np.ones(len(axes))])
    return _CrossingConflicts(
        xy=np.array(xy).reshape(-1, 2),
        heading=np.array(heading, float),
        crossing=np.array(owner, int),
        strip=strip,
        marked=np.array([crossing.marked for crossing in network.crossings], bool),
        red=np.array([_must_be_red(network, c) for c in network.crossings], bool).reshape(
            len(axes), len(network.lanes)
        ),
    )


def _must_be_red(network: RoadNetwork, crossing: Crossing) -> Bool[np.ndarray, " lane"]:
    """See :attr:`_CrossingConflicts.red`."""
    result = np.zeros(len(network.lanes), bool)
    if network.signals is None:
        return result
    arrows = {lane for group in network.signals.groups if group.arrow for lane in group.lanes}
    for lane, along in crossing.lanes:
        this = network.lanes[lane]
        entering: tuple[int, ...] = ()
        leaving: tuple[int, ...] = ()
        if this.connector:
            entering, leaving = ((lane,), ()) if along < this.length_m / 2 else ((), (lane,))
        elif this.length_m - along < _NEAR_JUNCTION_M:
            entering = this.successors
        elif along < _NEAR_JUNCTION_M:
            leaving = this.predecessors
        for connector in (*entering, *leaving):
            curve = network.lanes[connector].curve
            straight = abs(float(curve.heading[-1] - curve.heading[0])) < math.radians(45.0)
            if network.lanes[connector].control == Control.SIGNAL and (
                connector in entering or straight or connector in arrows
            ):
                result[connector] = True
    return result


class Walkers:
    """Pedestrians, moved step by step.

    Args:
        network: The roads.
        walkers: Who walks.
        times_s: Times of all steps to come, on the clock of the signals.
    """

    def __init__(
        self, network: RoadNetwork, walkers: tuple[Walker, ...], times_s: Float64[np.ndarray, " time"]
    ) -> None:
        self._conflicts = _crossing_conflicts(network)
        self._red_left_s = _red_left(network, self._conflicts.red, times_s)
        curves = [resample(walker.curve, STEP_M) for walker in walkers]
        self._last = np.array([len(curve.xy) - 1 for curve in curves], int)
        self._table = np.zeros((len(curves), max([*self._last, 0]) + 1, 3))
        self._begin = np.arange(len(curves)) * self._table.shape[1]
        for row, curve in zip(self._table, curves, strict=True):
            row[: len(curve.xy)] = np.column_stack([curve.xy, curve.heading])
            row[len(curve.xy) :] = row[len(curve.xy) - 1]
        self._step_m = np.array([float(curve.arc_m[-1]) / (len(curve.xy) - 1) for curve in curves])
        self._at = np.array([walker.start_m for walker in walkers], float)
        self._free_speed = np.array([walker.speed_mps for walker in walkers], float)
        self._size_m = np.array([walker.size_m[:2] for walker in walkers], float).reshape(-1, 2)
        self._speed = self._free_speed.copy()
        self._crossing = np.array([walker.crossing for walker in walkers], int)
        self._kerb = np.array([walker.kerb_m for walker in walkers], float)
        self._across = np.array([walker.across_m for walker in walkers], float)
        self._crosses = self._crossing >= 0
        self._any_crosses = bool(self._crosses.any())
        # At lights and unmarked crossings only users on the crossing count.
        asking = self._conflicts.marked & ~self._conflicts.red.any(axis=1)
        self._asking = asking[self._crossing] if len(asking) else np.zeros(len(curves), bool)
        self._released, self._into = np.zeros((2, len(curves)), bool)

    def step(
        self, t: int, vehicles: Boxes, active: VehicleMask, colour_row: Int8[np.ndarray, " lane"]
    ) -> tuple[Boxes, Bool[np.ndarray, " crossing"]]:
        """Return all walkers at step ``t``, then advance them.

        Args:
            t: The step; steps come in order.
            vehicles: All vehicles.
            active: Which of them are there.
            colour_row: What every lane's light shows now.

        Returns:
            The walkers, and which crossings drivers must keep free: a walker is on it or, where drivers must yield,
            about to step on it.
        """
        place = np.minimum(np.maximum(self._at / self._step_m, 0.0), self._last)
        index = np.minimum(place.astype(int), self._last - 1)
        flat, rows = self._table.reshape(-1, 3), index + self._begin
        low = flat.take(rows, axis=0)
        pose = low + (place - index)[:, None] * (flat.take(rows + 1, axis=0) - low)
        occupied = np.zeros(len(self._conflicts.marked), bool)
        if t % _LOOK_STEPS == 0:
            self._into = _walks_into(pose, vehicles, active)
            self._release(t, vehicles, active, colour_row)
        if self._any_crosses:
            self._mark_occupied(occupied)
        result = Boxes(pose[:, :2], wrap(pose[:, 2]), self._speed, self._size_m)
        self._advance()
        return result, occupied

    def _mark_occupied(self, occupied: Bool[np.ndarray, " crossing"]) -> None:
        some = self._crosses & (self._at < self._across) & (self._at > self._kerb - _CLAIM_M)
        some &= self._released | self._asking | (self._at > self._kerb)
        occupied[self._crossing[some]] = True

    def _release(
        self, t: int, vehicles: Boxes, active: VehicleMask, colour_row: Int8[np.ndarray, " lane"]
    ) -> None:
        """Release walkers at the kerb of a crossing that is safe for long enough."""
        before = self._kerb - self._at
        asks = self._crosses & ~self._released & (before >= 0) & (before < _LOOK_M)
        if not np.count_nonzero(asks):
            return
        conflicts, crossing = self._conflicts, self._crossing[asks]
        boxes = np.column_stack([vehicles.xy, *vehicles.direction, vehicles.size_m])[active]
        any_s, hard_s = _arrivals(conflicts, boxes, vehicles.speed[active])
        # Who stands first has to gain speed, which takes v / (2 a) longer.
        start_s = self._free_speed / (2 * _ACCELERATION_MPS2)
        needed = ((self._across - self._at) / self._free_speed + start_s)[asks]
        # A standing queue blocks the crossing.
        free = ~overlap(conflicts.strip[:, None], boxes[None]).any(axis=1)
        red = ~(conflicts.red & (colour_row != Colour.RED)).any(axis=1)
        yielded = conflicts.marked | conflicts.red.any(axis=1)
        gap = np.where(
            yielded[crossing], hard_s[crossing] > needed + _MARGIN_S, any_s[crossing] > needed + _GAP_MARGIN_S
        )
        lasting = self._red_left_s[t, crossing] >= needed
        self._released[asks] = gap & free[crossing] & red[crossing] & lasting

    def _advance(self) -> None:
        """Advance by one step; unreleased walkers stop at the kerb, and none walks into a vehicle."""
        room = self._last * self._step_m - self._at
        if self._any_crosses:
            waits = self._crosses & ~self._released & (self._at <= self._kerb)
            kerb = np.where(waits, self._kerb - _WAIT_M - self._at, math.inf)
            room = np.minimum(np.maximum(kerb, 0.0), room)
        # v^2 / (2 a) is the way to stop; a step ahead, so that the end is not passed.
        stopping = np.sqrt(2 * _ACCELERATION_MPS2 * np.maximum(room - self._speed * DT_S / 2, 0.0))
        after = np.minimum(self._free_speed, np.minimum(self._speed + _ACCELERATION_MPS2 * DT_S, stopping))
        after = np.maximum(after, 0.0)
        moved = np.minimum((self._speed + after) / 2 * DT_S, np.maximum(room, 0.0))
        after[self._into], moved[self._into] = 0.0, 0.0
        self._at = self._at + moved
        self._speed = after


def _red_left(
    network: RoadNetwork, red: Bool[np.ndarray, "crossing lane"], times_s: Float64[np.ndarray, " time"]
) -> Float64[np.ndarray, "time crossing"]:
    """For how long the lights will hold back those who must stand while people cross, s; infinite without lights."""
    left = np.full((len(times_s), len(red)), math.inf)
    if network.signals is None or not red.any():
        return left
    # People see how much time is left: a cycle beyond the end shows when green comes next.
    beyond = times_s[-1] + DT_S * np.arange(1, math.ceil(network.signals.cycle_s / DT_S) + 1)
    colour, _ = network.signals.colours(np.concatenate([times_s, beyond]), len(network.lanes))
    for crossing in np.flatnonzero(red.any(axis=1)):
        go = (colour[:, red[crossing]] != Colour.RED).any(axis=1)
        steps = np.where(go, np.arange(len(go)), len(go))
        following = np.minimum.accumulate(steps[::-1])[::-1]
        left[:, crossing] = ((following - np.arange(len(go))) * DT_S)[: len(times_s)]
    return left


def _arrivals(
    conflicts: _CrossingConflicts, boxes: Float64[np.ndarray, "v 6"], speed: PerVehicle
) -> tuple[Float64[np.ndarray, " crossing"], Float64[np.ndarray, " crossing"]]:
    """When the next vehicle reaches each crossing, s: any that moves, and any that cannot stop with ease."""
    any_s, hard_s = np.full(len(conflicts.marked), math.inf), np.full(len(conflicts.marked), math.inf)
    if not len(boxes):
        return any_s, hard_s
    rel = conflicts.xy[:, None] - boxes[None, :, :2]
    cos, sin = boxes[:, 2], boxes[:, 3]
    ahead = rel[..., 0] * cos + rel[..., 1] * sin
    aside = np.abs(rel[..., 1] * cos - rel[..., 0] * sin)
    same = np.cos(conflicts.heading)[:, None] * cos + np.sin(conflicts.heading)[:, None] * sin > math.cos(
        _ASIDE
    )
    coming = (ahead > -1.0) & (aside < 2.0 + math.tan(_BEARING) * np.maximum(ahead, 0.0))
    coming &= same & (speed > _STANDING_MPS)
    distance = np.maximum(np.hypot(ahead, aside) - boxes[:, 4] / 2, 0.0)
    time = np.where(coming, distance / np.maximum(speed, _STANDING_MPS), math.inf)
    braking = speed**2 / (2 * np.maximum(distance - _STOP_SHORT_M, 0.05))
    np.minimum.at(any_s, conflicts.crossing, time.min(axis=1))
    np.minimum.at(hard_s, conflicts.crossing, np.where(braking > _YIELDING_MPS2, time, math.inf).min(axis=1))
    return any_s, hard_s


def _walks_into(
    pose: Float64[np.ndarray, "w 3"], vehicles: Boxes, active: VehicleMask
) -> Bool[np.ndarray, " w"]:
    """Mask of walkers about to come too near to a vehicle, and not near one already."""
    x, y, angle = pose.T
    into = _within(x + 0.6 * np.cos(angle), y + 0.6 * np.sin(angle), vehicles, active)
    if np.count_nonzero(into):
        into &= ~_within(x, y, vehicles, active)
    return into


def _within(
    x: Float64[np.ndarray, " w"], y: Float64[np.ndarray, " w"], vehicles: Boxes, active: VehicleMask
) -> Bool[np.ndarray, " w"]:
    """Which points lie in any vehicle grown by the berth that people give it."""
    cos, sin = vehicles.direction
    half = vehicles.size_m / 2 + _BERTH_M
    dx, dy = x[:, None] - vehicles.xy[:, 0], y[:, None] - vehicles.xy[:, 1]
    along = np.abs(dx * cos + dy * sin)
    dy *= cos
    dx *= sin
    dy -= dx
    inside = (along < np.where(active, half[:, 0], -1.0)) & (np.abs(dy, out=dy) < half[:, 1])
    return np.logical_or.reduce(inside, axis=1)


def place_walkers(
    network: RoadNetwork, per_100m: float, rng: np.random.Generator, times_s: Float64[np.ndarray, " time"]
) -> tuple[Walker, ...]:
    """Draw walkers: along the sidewalks in both directions, and over the crossings.

    Args:
        network: The roads.
        per_100m: Mean number of people per 100 m of sidewalk; each crossing gets about half as many.
        rng: Source of chance.
        times_s: Times of all steps; people reach their kerbs between 4 s before and 8 s after time 0, where the
            recording begins.
    """
    people = []
    for walk in network.walks:
        length = float(walk.arc_m[-1])
        for _ in range(int(rng.poisson(per_100m * length / 100.0))):
            curve = walk if rng.random() < 0.5 else walk.reversed()
            # People keep to the right of each other.
            curve = curve.shifted(-float(rng.uniform(0.1, 0.6)))
            people.append(Walker(curve, float(rng.uniform(0.0, length)), _pace(rng)))
    for index, crossing in enumerate(network.crossings):
        for _ in range(int(rng.poisson(per_100m / 2))):
            people.append(_crosser(network, index, crossing, float(times_s[0]), rng))
    return tuple(people)


def _pace(rng: np.random.Generator) -> float:
    """Free walking speed: 1.34 m/s on average with a deviation of 0.26 (Weidmann 1993)."""
    return float(np.clip(rng.normal(1.34, 0.26), 0.7, 2.0))


def _crosser(
    network: RoadNetwork, index: int, crossing: Crossing, begin_s: float, rng: np.random.Generator
) -> Walker:
    """Draw a walker that comes along the sidewalk, crosses, and continues on the other side."""
    near, far = crossing.axis if rng.random() < 0.5 else crossing.axis[::-1]
    aside = rng.uniform(-0.3, 0.3) * crossing.width_m
    ahead = (far - near) / np.hypot(*(far - near))
    shift = aside * np.array([-ahead[1], ahead[0]])
    near, far = near + shift, far + shift
    before, after = _along_walk(network, near, -ahead, rng), _along_walk(network, far, ahead, rng)
    points = np.concatenate([before[::-1], [near, far], after])
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    kerb, across = float(arc[len(before)]), float(arc[len(before) + 1])
    pace = _pace(rng)
    # Time 0 is where the recording begins.
    arrives = rng.uniform(-4.0, 8.0)
    start = max(0.0, kerb - pace * (arrives - begin_s))
    return Walker(_polyline(points), start, pace, index, kerb, across)


def _along_walk(
    network: RoadNetwork,
    kerb: Float64[np.ndarray, " 2"],
    out: Float64[np.ndarray, " 2"],
    rng: np.random.Generator,
) -> Float64[np.ndarray, "point 2"]:
    """Where a way goes on from a kerb: along a sidewalk nearby, in either direction, or straight off the road."""
    best: tuple[float, Curve, int] | None = None
    for walk in network.walks:
        gap = np.hypot(*(walk.xy - kerb).T)
        place = int(np.argmin(gap))
        if gap[place] < 6.0 and (best is None or gap[place] < best[0]):
            best = float(gap[place]), walk, place
    if best is None:
        return kerb + np.outer([2.0, 20.0], out)
    _, walk, place = best
    pieces = [piece for piece in (walk.xy[place:], walk.xy[place::-1]) if len(piece) > 4]
    # The crossing's axis is met at a right angle, some way from the kerb.
    piece = pieces[int(rng.integers(len(pieces)))]
    return piece[1:81]


def _polyline(points: Float64[np.ndarray, "point 2"]) -> Curve:
    """Return a curve through points; the heading turns at the corners."""
    steps = np.diff(points, axis=0)
    kept = np.concatenate([[True], np.hypot(*steps.T) > 1e-6])
    points = points[kept]
    angle = np.unwrap(np.arctan2(*np.diff(points, axis=0).T[::-1]))
    return resample(Curve(points, np.concatenate([angle, angle[-1:]])), STEP_M)
