"""Traffic at 10 Hz: many vehicles on lane paths, each following its leader, the lights and the bends ahead.

The law of following is the simulator's own (:mod:`drivax.simulator.idm`). All vehicles move at once: one step is a
few dozen array operations over vehicles, whatever their number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int8, Int64

from drivax.scenario.schema import DT_S
from drivax.simulator.idm import idm_acceleration
from drivax.synthetic.drivers import Drivers
from drivax.synthetic.paths import Path
from drivax.synthetic.roads import RoadNetwork
from drivax.synthetic.signals import Colour

#: Where drivers want to come to rest before a stop line, m from the front bumper.
_STOP_SHORT_M = 1.0
#: A driver follows the speed profile with this reaction, s.
_SPEED_TIME_S = 0.6
#: Jerk beyond a driver's own is used when braking harder than this, m/s2.
_EMERGENCY_MPS2 = 3.6
_EMERGENCY_JERK = 25.0


@dataclass(frozen=True)
class Override:
    """A labelled event in the making: from one step to another a vehicle accelerates as told, or less."""

    vehicle: int
    first_step: int
    last_step: int
    acceleration_mps2: float


@dataclass(frozen=True)
class Motion:
    """What everyone did.

    Attributes:
        xy, heading, speed: Pose of the box centre and speed along the heading.
        valid: False before a vehicle exists and after it has left the map.
        distance_m: Position along each vehicle's path.
        acceleration: Acceleration during the step that begins here.
    """

    xy: Float64[np.ndarray, "vehicle time 2"]
    heading: Float64[np.ndarray, "vehicle time"]
    speed: Float64[np.ndarray, "vehicle time"]
    valid: Bool[np.ndarray, "vehicle time"]
    distance_m: Float64[np.ndarray, "vehicle time"]
    acceleration: Float64[np.ndarray, "vehicle time"]


@dataclass(frozen=True)
class _Plans:
    """All paths padded to one shape, with the lookup tables of a step."""

    table: Float64[np.ndarray, "vehicle point 4"]  # x, y, heading, speed profile
    step_m: Float64[np.ndarray, " vehicle"]
    last: Int64[np.ndarray, " vehicle"]
    lane: Int64[np.ndarray, "vehicle point slot"]
    lane_m: Float64[np.ndarray, "vehicle point slot"]
    begin: Float64[np.ndarray, "vehicle lane"]  # path position where a lane begins; nan: not on the path
    scale: Float64[np.ndarray, "vehicle lane"]
    since: Float64[np.ndarray, "vehicle lane"]
    until: Float64[np.ndarray, "vehicle lane"]
    way: Int64[np.ndarray, "vehicle way"]  # connectors on the path, -1 none
    way_begin: Float64[np.ndarray, "vehicle way"]
    way_end: Float64[np.ndarray, "vehicle way"]


def speed_profile(
    path: Path, factor: float, lateral_mps2: float, slowing_mps2: float
) -> Float64[np.ndarray, " p"]:
    """The fastest speed at each sample that respects limits, bends and the braking towards them.

    ``v(s)^2 = min over s' >= s of (vmax(s')^2 + 2 b (s' - s))`` with ``vmax = min(factor x limit, sqrt(a_lat / |k|))``.
    """
    cap = np.minimum((factor * path.limit_mps) ** 2, lateral_mps2 / np.maximum(np.abs(path.curvature), 1e-6))
    ramp = 2 * slowing_mps2 * path.step_m * np.arange(len(cap))
    return np.sqrt(np.minimum.accumulate((cap + ramp)[::-1])[::-1] - ramp)


def _plans(network: RoadNetwork, paths: list[Path], drivers: Drivers) -> _Plans:
    count, points = len(paths), max(len(path.curve.xy) for path in paths)
    lanes, slots = len(network.lanes), paths[0].lane.shape[1]
    ways = [[span for span in path.spans if network.lanes[span.lane].connector] for path in paths]
    width = max(1, max(map(len, ways)))
    table, lane = np.zeros((count, points, 4)), np.full((count, points, slots), -1)
    lane_m = np.zeros((count, points, slots))
    begin, scale = np.full((count, lanes), np.nan), np.ones((count, lanes))
    since, until = np.full((count, lanes), -np.inf), np.full((count, lanes), np.inf)
    way = np.full((count, width), -1)
    way_begin, way_end = np.full((count, width), np.inf), np.full((count, width), np.inf)
    for i, path in enumerate(paths):
        n = len(path.curve.xy)
        fastest = speed_profile(
            path, drivers.speed_factor[i], drivers.lateral_mps2[i], drivers.slowing_mps2[i]
        )
        table[i, :n] = np.column_stack([path.curve.xy, path.curve.heading, fastest])
        table[i, n:] = table[i, n - 1]
        lane[i, :n], lane_m[i, :n] = path.lane, path.lane_m
        for span in path.spans:
            begin[i, span.lane], scale[i, span.lane] = span.begin_m, span.scale
            since[i, span.lane], until[i, span.lane] = span.from_m, span.until_m
        for k, span in enumerate(ways[i]):
            way[i, k], way_begin[i, k] = span.lane, span.begin_m
            way_end[i, k] = span.begin_m + span.scale * network.lanes[span.lane].length_m
    step = np.array([path.step_m for path in paths])
    last = np.array([len(path.curve.xy) - 1 for path in paths])
    return _Plans(table, step, last, lane, lane_m, begin, scale, since, until, way, way_begin, way_end)


class Traffic:
    """Vehicles on their paths, moved step by step.

    Args:
        network: The roads.
        paths: One path per vehicle.
        drivers: One driver per vehicle.
        distance_m: Where on its path each vehicle's centre begins.
        speed_mps: Speeds to begin with.
        times_s: Times of all steps to come, on the clock of the signals.
    """

    def __init__(
        self,
        network: RoadNetwork,
        paths: list[Path],
        drivers: Drivers,
        distance_m: Float64[np.ndarray, " vehicle"],
        speed_mps: Float64[np.ndarray, " vehicle"],
        times_s: Float64[np.ndarray, " time"],
    ) -> None:
        self._network, self._drivers = network, drivers
        self._plans = _plans(network, paths, drivers)
        self._half_m = drivers.size_m[:, 0] / 2
        self._rows = np.arange(len(paths))
        self._colour: Int8[np.ndarray, "time lane"] = np.zeros((len(times_s), len(network.lanes)), np.int8)
        self._to_red = np.zeros((len(times_s), len(network.lanes)))
        if network.signals is not None:
            self._colour, self._to_red = network.signals.colours(times_s, len(network.lanes))
        self._steps = len(times_s)
        self._at, self._speed = distance_m.copy(), speed_mps.copy()
        self._last = np.zeros(len(paths))

    def run(self, overrides: tuple[Override, ...] = ()) -> Motion:
        """Moves everyone through all steps."""
        shape = (len(self._rows), self._steps)
        pose = np.zeros((*shape, 3))
        speed, at, acceleration = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        valid = np.zeros(shape, bool)
        for t in range(self._steps):
            active = self._at + self._half_m < self._plans.last * self._plans.step_m
            pose[:, t], fastest = self._look_up(self._at)
            speed[:, t], at[:, t], valid[:, t] = self._speed, self._at, active
            wanted = self._wanted(t, fastest, active)
            for override in overrides:
                if override.first_step <= t <= override.last_step:
                    who = override.vehicle
                    wanted[who] = min(wanted[who], override.acceleration_mps2)
            acceleration[:, t] = self._advance(wanted, active)
        return Motion(pose[..., :2], pose[..., 2], speed, valid, at, acceleration)

    def _look_up(
        self, at: Float64[np.ndarray, " v"]
    ) -> tuple[Float64[np.ndarray, "v 3"], Float64[np.ndarray, " v"]]:
        """Pose and fastest speed at positions on the own paths."""
        place = at / self._plans.step_m
        index = np.clip(place.astype(int), 0, self._plans.last - 1)
        share = np.clip(place - index, 0.0, 1.0)[:, None]
        low, high = self._plans.table[self._rows, index], self._plans.table[self._rows, index + 1]
        row = low + share * (high - low)
        return row[:, :3], row[:, 3]

    def _wanted(
        self, t: int, fastest: Float64[np.ndarray, " v"], active: Bool[np.ndarray, " v"]
    ) -> Float64[np.ndarray, " v"]:
        """The acceleration that each driver would like: the least that leader, stop line and speed allow."""
        gap, leader_speed = self._leaders(active)
        stop_gap = self._stop_lines(t, active)
        # Drivers stop closer to a line than to a bumper.
        stop_gap = stop_gap + 2.0 - _STOP_SHORT_M
        speed = np.broadcast_to(self._speed, (2, len(self._speed)))
        following = idm_acceleration(
            speed,
            np.broadcast_to(fastest, speed.shape),
            np.stack([gap, stop_gap]),
            np.stack([leader_speed, np.zeros_like(gap)]),
            self._drivers.idm,
        ).min(axis=0)
        ahead = self._look_up(self._at + self._speed * _SPEED_TIME_S)[1]
        return np.minimum(following, (ahead - self._speed) / _SPEED_TIME_S)

    def _leaders(
        self, active: Bool[np.ndarray, " v"]
    ) -> tuple[Float64[np.ndarray, " v"], Float64[np.ndarray, " v"]]:
        """Gap to the nearest vehicle ahead on the own path (infinite: none) and that vehicle's speed."""
        p = self._plans
        index = np.clip(np.rint(self._at / p.step_m).astype(int), 0, p.last)
        lane = p.lane[self._rows, index]
        along = p.lane_m[self._rows, index] + (self._at - index * p.step_m)[:, None]
        # position[i, j, slot]: where vehicle j is on the path of vehicle i.
        position = p.begin[:, lane] + p.scale[:, lane] * along
        own = self._at[:, None, None]
        seen = (lane >= 0) & active[:, None] & (position > own)
        seen &= (p.since[:, lane] <= own) & (own <= p.until[:, lane])
        seen[self._rows, self._rows] = False
        nearest = np.where(seen, position, np.inf).min(axis=2)
        gap = nearest - self._at[:, None] - self._half_m[:, None] - self._half_m
        leader = np.argmin(gap, axis=1)
        return gap[self._rows, leader], self._speed[leader]

    def _stop_lines(self, t: int, active: Bool[np.ndarray, " v"]) -> Float64[np.ndarray, " v"]:
        """Distance from the front bumper to the next line at which to stop (infinite: none)."""
        p, half = self._plans, self._half_m[:, None]
        front, rear = self._at[:, None] + half, self._at[:, None] - half
        inside = (front > p.way_begin) & (rear < p.way_end) & active[:, None]
        taken = np.zeros(len(self._network.lanes), bool)
        taken[p.way[inside]] = True
        blocked = self._network.conflicts @ taken
        distance = np.where((p.way >= 0) & (front <= p.way_begin), p.way_begin - front, np.inf)
        speed = self._speed[:, None]
        needed = speed**2 / (2 * np.maximum(distance, 0.05))
        colour, to_red = self._colour[t, p.way], self._to_red[t, p.way]
        late = distance > speed * to_red
        yellow = (colour == Colour.YELLOW) & (
            (needed <= self._drivers.yellow_mps2[:, None]) | (late & (needed <= 5.0))
        )
        halt = yellow | (((colour == Colour.RED) | blocked[p.way]) & (needed <= 8.0))
        return np.where(halt & np.isfinite(distance), distance, np.inf).min(axis=1)

    def _advance(
        self, wanted: Float64[np.ndarray, " v"], active: Bool[np.ndarray, " v"]
    ) -> Float64[np.ndarray, " v"]:
        """Moves everyone by one step and returns the accelerations; speeds never fall below zero."""
        jerk = np.where(wanted < -_EMERGENCY_MPS2, _EMERGENCY_JERK, self._drivers.jerk_mps3) * DT_S
        a = np.clip(wanted, self._last - jerk, self._last + self._drivers.jerk_mps3 * DT_S)
        after = self._speed + a * DT_S
        halted = after <= 0.0
        # Who stops inside the step travels v^2 / (2 |a|), and stands.
        travelled = np.where(
            halted, self._speed**2 / (2 * np.maximum(-a, 1e-9)), (self._speed + after) * DT_S / 2
        )
        self._at = self._at + np.where(active, travelled, 0.0)
        self._last = np.where(halted, 0.0, a)
        self._speed = np.where(active, np.maximum(after, 0.0), 0.0)
        return a
