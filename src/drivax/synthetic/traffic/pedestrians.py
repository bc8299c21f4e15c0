"""Pedestrians: they walk along sidewalks, wait at kerbs until it is safe to cross, and cross."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from drivax.geometry.boxes import overlap
from drivax.geometry.vectors import wrap
from drivax.scenario.schema import DT_S, nonzero
from drivax.synthetic.roads.curves import STEP_M, Curve, resample
from drivax.synthetic.roads.network import Control, Crossing, RoadNetwork, per_roads
from drivax.synthetic.roads.signals import Colour
from drivax.synthetic.traffic.obstacles import Boxes
from drivax.synthetic.traffic.path_arrays import PerVehicle, VehicleMask, Worlds, pad_last, pad_steps
from drivax.synthetic.traffic.roles import Pedestrian

#: Distances from the kerb, m, at which pedestrians wait, occupy the crossing, and start to look for a gap.
_WAIT_M, _OCCUPY_M, _GAP_SEARCH_M = 0.4, 1.0, 1.8
#: Acceleration of pedestrians, m/s2.
_ACCELERATION_MPS2 = 1.5
#: Hardest braking with which drivers yield at a crosswalk, m/s2, and distance from it at which they stop, m.
_YIELDING_MPS2, _STOP_SHORT_M = 2.5, 2.0
#: Speed below which vehicles count as standing, m/s.
_STANDING_MPS = 0.3
#: Accepted gap minus the crossing time, s, where drivers yield and where they do not.
_MARGIN_S, _GAP_MARGIN_S = 1.0, 1.5
#: Largest bearing of a crossing from an approaching vehicle, and angle from its heading to the crossed lane's, rad.
_MAX_BEARING, _MAX_HEADING_DIFFERENCE = math.radians(75.0), math.radians(80.0)
#: Distance that pedestrians keep from vehicles, m.
_CLEARANCE_M = 0.4
#: Steps between two decisions.
_DECISION_STEPS = 2
#: Distance of a crossing from the end of a lane within which the adjacent connectors control it, m.
_NEAR_JUNCTION_M = 25.0

#: A number and a flag per pedestrian.
_Values = Float64[np.ndarray, " w"]
_Mask = Bool[np.ndarray, " w"]
_Indices = Int64[np.ndarray, " w"]
_Point = Float64[np.ndarray, " 2"]


@dataclass(frozen=True)
class _CrossingConflicts:
    """Intersections of crossings and lanes.

    Attributes:
        strip: Box of each crossing.
        red: Mask of connectors whose light must be red while pedestrians cross.
    """

    xy: Float64[np.ndarray, "conflict 2"]
    heading: Float64[np.ndarray, " conflict"]
    crossing: Int64[np.ndarray, " conflict"]
    strip: Float64[np.ndarray, "crossing 6"]
    marked: Bool[np.ndarray, " crossing"]
    red: Bool[np.ndarray, "crossing lane"]


@per_roads
def _crossing_conflicts(network: RoadNetwork) -> _CrossingConflicts:
    """Compute the conflicts of all crossings of a network."""
    poses, owner = [], []
    for index, crossing in enumerate(network.crossings):
        for lane, along in crossing.lanes:
            curve = network.lanes[lane].curve
            sample = min(int(np.searchsorted(curve.arc_m, along)), len(curve.xy) - 1)
            poses.append([*curve.xy[sample], curve.heading[sample]])
            owner.append(index)
    pose = np.array(poses, float).reshape(-1, 3)
    axes = np.array([crossing.axis for crossing in network.crossings]).reshape(-1, 2, 2)
    across = axes[:, 1] - axes[:, 0]
    length = np.hypot(*across.T)
    # Pedestrians walk in the middle of the crosswalk, so a vehicle at its edge does not block it.
    strip = np.column_stack([axes.mean(axis=1), across / length[:, None], length, np.ones(len(axes))])
    red = [_must_be_red(network, crossing) for crossing in network.crossings]
    return _CrossingConflicts(
        xy=pose[:, :2],
        heading=pose[:, 2],
        crossing=np.array(owner, int),
        strip=strip,
        marked=np.array([crossing.marked for crossing in network.crossings], bool),
        red=np.array(red, bool).reshape(len(axes), len(network.lanes)),
    )


def _must_be_red(network: RoadNetwork, crossing: Crossing) -> Bool[np.ndarray, " lane"]:
    """Mask of signalised connectors over a crossing, except turns into its road without an arrow, which yield."""
    result = np.zeros(len(network.lanes), bool)
    if network.signals is None:
        return result
    arrows = {lane for group in network.signals.groups if group.arrow for lane in group.lanes}
    for lane, along in crossing.lanes:
        current = network.lanes[lane]
        entering, leaving = (), ()
        if current.connector:
            entering, leaving = ((lane,), ()) if along < current.length_m / 2 else ((), (lane,))
        elif current.length_m - along < _NEAR_JUNCTION_M:
            entering = current.successors
        elif along < _NEAR_JUNCTION_M:
            leaving = current.predecessors
        for connector in (*entering, *leaving):
            curve = network.lanes[connector].curve
            is_straight = abs(float(curve.heading[-1] - curve.heading[0])) < math.radians(45.0)
            is_conflicting = connector in entering or is_straight or connector in arrows
            result[connector] |= is_conflicting and network.lanes[connector].control == Control.SIGNAL
    return result


class Pedestrians:
    """The pedestrians of all worlds, moved step by step; indices of crossings run through all worlds.

    Args:
        worlds: The worlds.
        by_world: Pedestrians of each world.
        times_s: Times of the steps of each world, on the clock of its lights.

    Attributes:
        world: World of each pedestrian.
    """

    def __init__(
        self, worlds: Worlds, by_world: Sequence[Sequence[Pedestrian]],
        times_s: Sequence[Float64[np.ndarray, " _"]],
    ) -> None:  # fmt: skip
        self._worlds, pedestrians = worlds, [pedestrian for group in by_world for pedestrian in group]
        self.world = np.repeat(np.arange(len(worlds)), list(map(len, by_world)))
        self._conflicts = [_crossing_conflicts(network) for network in worlds.networks]
        red_s = [
            _remaining_red_s(network, conflicts.red, times)
            for network, conflicts, times in zip(worlds.networks, self._conflicts, times_s, strict=True)
        ]
        self._remaining_red = np.concatenate(pad_steps(red_s), axis=1)
        curves = [pedestrian.samples for pedestrian in pedestrians]
        self._last = np.array([len(curve.xy) - 1 for curve in curves], int)
        ends = np.cumsum(self._last + 1)
        self._begin, self._table = ends - self._last - 1, np.empty((ends[-1] if curves else 0, 3))
        for curve, begin, end in zip(curves, self._begin.tolist(), ends.tolist(), strict=True):
            self._table[begin:end, :2], self._table[begin:end, 2] = curve.xy, curve.heading
        self._step_m = np.array([float(curve.arc_m[-1]) / (len(curve.xy) - 1) for curve in curves])
        numbers = [[w.start_m, w.speed_mps, w.kerb_m, w.across_m] for w in pedestrians]
        self._position_m, self._free_speed, self._kerb, self._across = (
            np.array(numbers, float).reshape(-1, 4).T.copy()
        )
        self._size_m = np.array([pedestrian.size_m[:2] for pedestrian in pedestrians], float).reshape(-1, 2)
        self._speed = self._free_speed.copy()
        self._crossing = np.array([pedestrian.crossing for pedestrian in pedestrians], int)
        self._has_crossing = self._crossing >= 0
        self._crossing += worlds.first_crossing[self.world]
        self._any_crosses = bool(self._has_crossing.any())
        # Pedestrians expect drivers to yield at marked crossings and lights; at the kerb they have priority only at
        # marked crossings without lights.
        marked = np.concatenate([conflicts.marked for conflicts in self._conflicts])
        lights = np.concatenate([conflicts.red.any(axis=1) for conflicts in self._conflicts])
        self._has_yielding_drivers = marked | lights
        self._has_priority = np.zeros(len(curves), bool)
        self._has_priority[self._has_crossing] = (marked & ~lights)[self._crossing[self._has_crossing]]
        self._is_released, self._is_blocked = np.zeros((2, len(curves)), bool)

    def step(
        self, t: int, vehicles: Boxes, active: VehicleMask
    ) -> tuple[Boxes, Bool[np.ndarray, " crossing"]]:
        """Return all pedestrians at step ``t`` and a mask of occupied crossings, then advance.

        A crossing is occupied if a pedestrian is on it, or within 1 m of it and released or with priority.
        """
        sample = np.minimum(np.maximum(self._position_m / self._step_m, 0.0), self._last)
        index = np.minimum(sample.astype(int), self._last - 1)
        rows = index + self._begin
        low = self._table.take(rows, axis=0)
        pose = low + (sample - index)[:, None] * (self._table.take(rows + 1, axis=0) - low)
        occupied = np.zeros(self._worlds.first_crossing[-1], bool)
        if t % _DECISION_STEPS == 0:
            self._is_blocked = self._blocked_by_vehicles(pose, vehicles, active)
            self._release(t, vehicles, active)
        if self._any_crosses:
            is_on = self._has_crossing & (self._position_m < self._across)
            is_on &= self._position_m > self._kerb - _OCCUPY_M
            is_on &= self._is_released | self._has_priority | (self._position_m > self._kerb)
            occupied[self._crossing[is_on]] = True
        result = Boxes(pose[:, :2], wrap(pose[:, 2]), self._speed, self._size_m)
        self._advance()
        return result, occupied

    def _blocked_by_vehicles(
        self, pose: Float64[np.ndarray, "w 3"], vehicles: Boxes, active: VehicleMask
    ) -> _Mask:
        """Mask of pedestrians that are not too close to a vehicle yet, but would be 0.6 m further on."""
        x, y, angle = pose.T
        is_blocked = self._is_near_vehicle(
            x + 0.6 * np.cos(angle), y + 0.6 * np.sin(angle), self.world, vehicles, active
        )
        rows = is_blocked.nonzero()[0]
        is_blocked[rows] = ~self._is_near_vehicle(x[rows], y[rows], self.world[rows], vehicles, active)
        return is_blocked

    def _is_near_vehicle(
        self, x: _Values, y: _Values, world: _Indices, vehicles: Boxes, active: VehicleMask
    ) -> _Mask:
        """Mask of points too close to an active vehicle of their world."""
        is_near, half = np.zeros(len(x), bool), vehicles.size_m / 2 + _CLEARANCE_M
        # Most pairs are further apart along an axis than the largest box reaches.
        centre = np.where(active[:, None], vehicles.xy, np.inf)
        near_x, near_y = pad_last(centre.T, np.inf).take(self._worlds.rows, axis=1).take(world, axis=1)
        dx, dy, reach = x[:, None] - near_x, y[:, None] - near_y, half.sum(axis=1).max(initial=0.0) + 0.1
        point, column = nonzero((np.abs(dx) < reach) & (np.abs(dy) < reach))
        if len(point):
            row, dx, dy = self._worlds.rows[world[point], column], dx[point, column], dy[point, column]
            cos, sin = (component[row] for component in vehicles.direction)
            along, lateral = dx * cos + dy * sin, dy * cos - dx * sin
            is_near[point[(np.abs(along) < half[row, 0]) & (np.abs(lateral) < half[row, 1])]] = True
        return is_near

    def _release(self, t: int, vehicles: Boxes, active: VehicleMask) -> None:
        """Release pedestrians at the kerb if the crossing stays safe for long enough."""
        to_kerb = self._kerb - self._position_m
        is_waiting = self._has_crossing & ~self._is_released & (to_kerb >= 0) & (to_kerb < _GAP_SEARCH_M)
        waiting = is_waiting.nonzero()[0]
        if not len(waiting):
            return
        crossing_s = (self._across[waiting] - self._position_m[waiting]) / self._free_speed[waiting]
        # Starting from standstill takes v / (2 a) longer.
        crossing_s += self._free_speed[waiting] / (2 * _ACCELERATION_MPS2)
        # Those whose conflicting lights do not stay red for long enough keep waiting.
        stays_red = self._remaining_red[t, self._crossing[waiting]] >= crossing_s
        waiting, crossing_s = waiting[stays_red], crossing_s[stays_red]
        boxes = np.column_stack([vehicles.xy, *vehicles.direction, vehicles.size_m])
        world_of = self.world[waiting]
        for world in sorted(set(world_of.tolist())):
            is_local, rows = world_of == world, self._worlds.vehicles(world)
            rows = np.flatnonzero(active[rows]) + rows.start
            self._release_in(
                world, waiting[is_local], crossing_s[is_local], boxes[rows], vehicles.speed[rows]
            )

    def _release_in(
        self, world: int, waiting: _Indices, crossing_s: _Values, boxes: Float64[np.ndarray, "v 6"],
        speed: PerVehicle,
    ) -> None:  # fmt: skip
        """Release pedestrians of a world if its active vehicles, with these boxes and speeds, leave them a gap."""
        conflicts, crossing = self._conflicts[world], self._crossing[waiting]
        number = crossing - self._worlds.first_crossing[world]
        any_s, hard_s = (s[number] for s in _arrivals(conflicts, number, boxes, speed))
        has_gap_if_yielding, has_gap = hard_s > crossing_s + _MARGIN_S, any_s > crossing_s + _GAP_MARGIN_S
        safe = np.where(self._has_yielding_drivers[crossing], has_gap_if_yielding, has_gap).nonzero()[0]
        # A standing queue blocks the crossing.
        if len(safe):
            is_blocked = overlap(conflicts.strip[number[safe], None], boxes[None]).any(axis=1)
            self._is_released[waiting[safe]] = ~is_blocked

    def _advance(self) -> None:
        """Advance by one step; pedestrians stop before vehicles, and at the kerb unless released."""
        room = self._last * self._step_m - self._position_m
        if self._any_crosses:
            is_waiting = self._has_crossing & ~self._is_released & (self._position_m <= self._kerb)
            kerb = np.where(is_waiting, self._kerb - _WAIT_M - self._position_m, math.inf)
            room = np.minimum(np.maximum(kerb, 0.0), room)
        # The stopping distance is v^2 / (2 a), counted from the end of the step.
        stopping = np.sqrt(2 * _ACCELERATION_MPS2 * np.maximum(room - self._speed * DT_S / 2, 0.0))
        speed = np.minimum(self._free_speed, np.minimum(self._speed + _ACCELERATION_MPS2 * DT_S, stopping))
        speed = np.maximum(speed, 0.0)
        distance = np.minimum((self._speed + speed) / 2 * DT_S, np.maximum(room, 0.0))
        speed[self._is_blocked], distance[self._is_blocked] = 0.0, 0.0
        self._position_m = self._position_m + distance
        self._speed = speed


def _remaining_red_s(
    network: RoadNetwork, red: Bool[np.ndarray, "crossing lane"], times_s: Float64[np.ndarray, " time"]
) -> Float64[np.ndarray, "time crossing"]:
    """Return the time for which all conflicting lights stay red, s, by step and crossing (infinite: no lights)."""
    remaining_s = np.full((len(times_s), len(red)), math.inf)
    if network.signals is None or not red.any():
        return remaining_s
    # One more cycle after the last step: pedestrians know the cycle.
    next_cycle_s = times_s[-1] + DT_S * np.arange(1, math.ceil(network.signals.cycle_s / DT_S) + 1)
    colour, _ = network.signals.colours(np.concatenate([times_s, next_cycle_s]), len(network.lanes))
    for crossing in np.flatnonzero(red.any(axis=1)):
        is_red = (colour[:, red[crossing]] == Colour.RED).all(axis=1)
        steps = np.arange(len(is_red))
        red_end = np.minimum.accumulate(np.where(is_red, len(is_red), steps)[::-1])[::-1]
        remaining_s[:, crossing] = ((red_end - steps) * DT_S)[: len(times_s)]
    return remaining_s


def _arrivals(
    conflicts: _CrossingConflicts, crossings: _Indices, boxes: Float64[np.ndarray, "v 6"], speed: PerVehicle
) -> tuple[Float64[np.ndarray, " crossing"], Float64[np.ndarray, " crossing"]]:
    """Return the time until the next vehicle, and the next that cannot yield, arrives at each crossing, s.

    It is infinite at crossings other than ``crossings``.
    """
    any_s, hard_s = np.full((2, len(conflicts.marked)), math.inf)
    if not len(boxes):
        return any_s, hard_s
    is_requested = np.zeros(len(conflicts.marked), bool)
    is_requested[crossings] = True
    rows = is_requested[conflicts.crossing].nonzero()[0]
    offset = conflicts.xy[rows, None] - boxes[None, :, :2]
    cos, sin = boxes[:, 2], boxes[:, 3]
    ahead = offset[..., 0] * cos + offset[..., 1] * sin
    lateral = np.abs(offset[..., 1] * cos - offset[..., 0] * sin)
    heading = conflicts.heading[rows, None]
    same_direction = np.cos(heading) * cos + np.sin(heading) * sin
    same_direction = same_direction > math.cos(_MAX_HEADING_DIFFERENCE)
    is_approaching = (ahead > -1.0) & (lateral < 2.0 + math.tan(_MAX_BEARING) * np.maximum(ahead, 0.0))
    is_approaching &= same_direction & (speed > _STANDING_MPS)
    distance = np.maximum(np.hypot(ahead, lateral) - boxes[:, 4] / 2, 0.0)
    time = np.where(is_approaching, distance / np.maximum(speed, _STANDING_MPS), math.inf)
    braking = speed**2 / (2 * np.maximum(distance - _STOP_SHORT_M, 0.05))
    of_crossing = conflicts.crossing[rows]
    np.minimum.at(any_s, of_crossing, time.min(axis=1))
    np.minimum.at(hard_s, of_crossing, np.where(braking > _YIELDING_MPS2, time, math.inf).min(axis=1))
    return any_s, hard_s


def place_pedestrians(
    network: RoadNetwork, per_100m: float, rng: np.random.Generator, times_s: Float64[np.ndarray, " time"]
) -> tuple[Pedestrian, ...]:
    """Draw pedestrians along sidewalks, in both directions, and at crossings, ``per_100m / 2`` on average at each.

    Those at crossings reach the kerb between 4 s before and 8 s after time 0 if nothing stops them, or earlier if the
    way to it is short.
    """
    pedestrians = []
    for sidewalk in network.sidewalks:
        length, reverse = float(sidewalk.arc_m[-1]), sidewalk.reverse()
        for _ in range(int(rng.poisson(per_100m * length / 100.0))):
            curve = sidewalk if rng.random() < 0.5 else reverse
            # Pedestrians keep to the right.
            curve = curve.parallel(-float(rng.uniform(0.1, 0.6)))
            pedestrians.append(Pedestrian(curve, float(rng.uniform(0.0, length)), _draw_speed(rng)))
    for index, crossing in enumerate(network.crossings):
        for _ in range(int(rng.poisson(per_100m / 2))):
            pedestrians.append(_draw_crossing_pedestrian(network, index, crossing, float(times_s[0]), rng))
    return tuple(pedestrians)


def _draw_speed(rng: np.random.Generator) -> float:
    """Draw a free walking speed, 1.34 m/s with a standard deviation of 0.26 m/s (Weidmann 1993)."""
    return min(max(rng.normal(1.34, 0.26), 0.7), 2.0)


def _draw_crossing_pedestrian(
    network: RoadNetwork, index: int, crossing: Crossing, begin_s: float, rng: np.random.Generator
) -> Pedestrian:
    """Draw a pedestrian that comes along the sidewalk, crosses, and continues on the other side."""
    near, far = crossing.axis if rng.random() < 0.5 else crossing.axis[::-1]
    lateral = rng.uniform(-0.3, 0.3) * crossing.width_m
    ahead = (far - near) / np.hypot(*(far - near))
    shift = lateral * np.array([-ahead[1], ahead[0]])
    near, far = near + shift, far + shift
    before = _along_sidewalk(network, near, -ahead, rng)
    after = _along_sidewalk(network, far, ahead, rng)
    points = np.concatenate([before[::-1], [near, far], after])
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    kerb_m, across_m = float(arc[len(before)]), float(arc[len(before) + 1])
    speed = _draw_speed(rng)
    start = max(0.0, kerb_m - speed * (rng.uniform(-4.0, 8.0) - begin_s))
    return Pedestrian(_polyline(points), start, speed, index, kerb_m, across_m)


def _along_sidewalk(
    network: RoadNetwork, kerb: _Point, outward: _Point, rng: np.random.Generator
) -> Float64[np.ndarray, "point 2"]:
    """Continue from a kerb: along the nearest sidewalk within 6 m, in either direction, else straight off the road."""
    best: tuple[float, Curve, int] | None = None
    for sidewalk in network.sidewalks:
        gap = np.hypot(*(sidewalk.xy - kerb).T)
        index = int(np.argmin(gap))
        if gap[index] < 6.0 and (best is None or gap[index] < best[0]):
            best = float(gap[index]), sidewalk, index
    if best is None:
        return kerb + np.outer([2.0, 20.0], outward)
    _, sidewalk, index = best
    pieces = [piece for piece in (sidewalk.xy[index:], sidewalk.xy[index::-1]) if len(piece) > 4]
    piece = pieces[int(rng.integers(len(pieces)))]
    return piece[1:81]  # about 40 m


def _polyline(points: Float64[np.ndarray, "point 2"]) -> Curve:
    """Return a curve through points; the heading turns at the corners."""
    points = points[np.append(True, np.hypot(*np.diff(points, axis=0).T) > 1e-6)]
    angle = np.unwrap(np.arctan2(*np.diff(points, axis=0).T[::-1]))
    return resample(Curve(points, np.concatenate([angle, angle[-1:]])), STEP_M)
