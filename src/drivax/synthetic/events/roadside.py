"""Events from the roadside: pedestrians, cyclists, objects that roll into the lane, reversing cars."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drivax.scenario.schema import DT_S, AgentKind
from drivax.synthetic.events.actors import CAR_M, Size, Times, along_track, gait, scripted_motion, travel_s
from drivax.synthetic.events.adversary import waiting_room
from drivax.synthetic.events.ego_view import EARLIEST, LATEST, NOTICED_S, SLOWEST_MPS, EgoView
from drivax.synthetic.events.kinds import EventScript, Proposal
from drivax.synthetic.roads.curves import smooth_step
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.roles import ScriptedUser, Staging

_PEDESTRIAN_M, _BICYCLE_M, _OBJECT_M = (0.5, 0.6, 1.75), (1.8, 0.65, 1.7), (1.0, 1.0, 0.9)
#: Highest limit of streets with such events, m/s.
_STREET_MPS = 20.0
#: Acceleration of a pedestrian, m/s2.
_START_MPS2 = 3.0
#: Acceleration of an object that falls or is pushed, m/s2.
_ROLLING_MPS2 = 6.0


class _StreetScript(EventScript):
    def possible(self, network: RoadNetwork) -> bool:
        """Return whether the network has a street."""
        return any(lane.limit_mps <= _STREET_MPS for lane in network.lanes)


def _is_open_street(view: EgoView, station: float) -> bool:
    """Return whether a station is on a street away from junctions and crossings."""
    lanes = view.roles.network.lanes
    return view.plain_road(station) and lanes[view.lane_at(station)].limit_mps <= _STREET_MPS


def _blocked_station(view: EgoView, step: int, severity_mps2: float, length_m: float) -> tuple[float, float]:
    """Return the station of a lasting obstacle with this severity, m, and ego's time to it at constant speed, s."""
    ego_station, speed = view.at_step(step)
    room = speed * NOTICED_S + speed**2 / (2 * severity_mps2)
    return ego_station + room + (view.ego_size_m[0] + length_m) / 2, room / speed


def _entry(
    view: EgoView, step: int, distance_m: float, pace_mps: float, rates_mps2: tuple[float, float]
) -> tuple[Times, Times] | None:
    """Return the :func:`gait` of an obstacle that moves into ego's lane; it brakes harder on a short distance."""
    gain_mps2, loss_mps2 = rates_mps2
    times = DT_S * (np.arange(view.steps) - step)
    return gait(distance_m, pace_mps, (gain_mps2, max(loss_mps2, pace_mps**2 / distance_m)), times)


def _crossing_actor(
    view: EgoView, station: float, left_m: Times, kind: AgentKind, size: Size
) -> ScriptedUser:
    """Build an actor that moves at a right angle to ego's path at a station; one that never moves faces the path."""
    xy, heading = view.track.pose(np.full(view.steps, station), left_m)
    toward = heading - math.copysign(math.pi / 2, float(left_m[0]))
    return scripted_motion(xy, toward, kind, size, np.ones(view.steps, bool))


@dataclass(frozen=True)
class Jaywalker(_StreetScript):
    """A pedestrian crosses the road away from crossings: from behind a parked car (``hidden``), or from the kerb."""

    hidden: bool = False
    speed_mps: tuple[float, float] = (1.3, 3.0)

    def possible(self, network: RoadNetwork) -> bool:
        """Return whether the network has bays to hide in, or a street."""
        return bool(network.bays) if self.hidden else super().possible(network)

    def propose(self, view: EgoView, severity_mps2: float, rng: np.random.Generator) -> Proposal | None:
        """Propose a pedestrian that crosses ego's lane."""
        pace_mps = float(rng.uniform(*self.speed_mps))
        draw_origin = self._start_behind_parked if self.hidden else self._start_at_kerb
        origin = draw_origin(view, severity_mps2, pace_mps, rng)
        if origin is None:
            return None
        step, station, offset_m = origin
        if not _is_open_street(view, station):
            return None
        # The walk ends 0.6 m beyond the road's or median's edge on the other side, at most 14.6 m from ego's path.
        side = -int(math.copysign(1, offset_m))
        walk_m = abs(offset_m) + min(view.edge_m(station, side), 14.0) + 0.6
        times = DT_S * (np.arange(view.steps) - step)
        profile = gait(walk_m, pace_mps, (_START_MPS2, 2.0), times)
        if profile is None:
            return None
        adversary = _crossing_actor(
            view, station, offset_m + side * profile[0], AgentKind.PEDESTRIAN, _PEDESTRIAN_M
        )
        last = min(step + round(travel_s(walk_m, pace_mps, _START_MPS2) / DT_S), view.last_step)
        return Proposal(Staging(extras=(adversary,)), severity_mps2, adversary, step, last)

    def _required_room(
        self, view: EgoView, offset_m: float, speed_mps: float, pace_mps: float, severity_mps2: float
    ) -> float | None:
        """Return the distance from ego's front to the pedestrian's line at the first step, m.

        None if ego, at its speed, is past the line or less than 0.5 m before it when the pedestrian enters its path.
        """
        half = (view.ego_size_m[1] + _PEDESTRIAN_M[0]) / 2
        enter_s = travel_s(abs(offset_m) - half, pace_mps, _START_MPS2)
        leave_s = travel_s(abs(offset_m) + half, pace_mps, _START_MPS2)
        room_m = speed_mps * NOTICED_S + waiting_room(speed_mps, severity_mps2, leave_s - NOTICED_S)
        return room_m if room_m > speed_mps * enter_s + 0.5 else None

    def _start_at_kerb(
        self, view: EgoView, severity_mps2: float, pace_mps: float, rng: np.random.Generator
    ) -> tuple[int, float, float] | None:
        """Draw step, station (m) and lateral offset (m) of a pedestrian at the kerb, or None if this draw fails."""
        step = view.draw_step(rng)
        side = -1 if rng.random() < 0.7 else 1
        margin_m = float(rng.uniform(0.1, 0.7))
        if step is None:
            return None
        ego_station, speed_mps = view.at_step(step)
        front = ego_station + (view.ego_size_m[0] + _PEDESTRIAN_M[1]) / 2
        station, offset_m = front + speed_mps, 0.0
        # Station and distance of the kerb depend on each other, so iterate twice.
        for _ in range(2):
            offset_m = view.edge_m(station, side) + margin_m
            if not offset_m < 10.0:
                return None
            room_m = self._required_room(view, offset_m, speed_mps, pace_mps, severity_mps2)
            if room_m is None:
                return None
            station = front + room_m
        return step, station, side * offset_m

    def _start_behind_parked(
        self, view: EgoView, severity_mps2: float, pace_mps: float, rng: np.random.Generator
    ) -> tuple[int, float, float] | None:
        """Draw step, station (m) and lateral offset (m) of a pedestrian behind a parked car, or None if none suits."""
        if not view.roles.parked:
            return None
        station, left_m = view.track.project(np.array([car.xy[0] for car in view.roles.parked]))
        steps = np.arange(view.first_step + EARLIEST, view.first_step + LATEST)
        speed = view.motion.speed[0, steps]
        # Cars next to the path, from 6 m ahead of ego at the first step to 40 m ahead of it at the last one.
        is_near = (np.abs(left_m) > 1.9) & (np.abs(left_m) < 5.0) & (station > view.track.at[steps[0]] + 6.0)
        order = rng.permutation(np.flatnonzero(is_near & (station < view.track.at[steps[-1]] + 40.0)))
        for car in order[:6].tolist():
            # The pedestrian's centre is 0.55 m beyond the car's far end.
            line_m = float(station[car]) + view.roles.parked[car].size_m[0] / 2 + 0.55
            offset_m = float(left_m[car])
            front = view.track.at[steps] + (view.ego_size_m[0] + _PEDESTRIAN_M[1]) / 2
            rooms_m = [self._required_room(view, offset_m, float(v), pace_mps, severity_mps2) for v in speed]
            rooms_m = [math.inf if room is None else room for room in rooms_m]
            error_m = np.where(speed > SLOWEST_MPS, rooms_m, math.inf) - (line_m - front)
            best = int(np.argmin(np.abs(error_m)))
            # Ego is at most 0.08 s of travel from the place at which the requested severity is exact.
            if abs(error_m[best]) < 0.08 * speed[best]:
                return int(steps[best]), line_m, offset_m
        return None


@dataclass(frozen=True)
class LaneBlocked(EventScript):
    """An object rolls from the roadside into ego's lane and stays there."""

    speed_mps: tuple[float, float] = (2.5, 7.0)

    def possible(self, network: RoadNetwork) -> bool:
        """Return whether the network has lanes: the event is possible on all roads."""
        return bool(network.lanes)

    def propose(self, view: EgoView, severity_mps2: float, rng: np.random.Generator) -> Proposal | None:
        """Propose an object that rolls into ego's lane."""
        step, side = view.draw_step(rng), int(rng.choice([-1, 1]))
        pace_mps, deviation_m = float(rng.uniform(*self.speed_mps)), float(rng.uniform(-0.5, 0.5))
        clearance_m = float(rng.uniform(0.1, 0.7))
        if step is None:
            return None
        station, arrival_s = _blocked_station(view, step, severity_mps2, _OBJECT_M[0])
        offset = view.edge_m(station, side) + clearance_m
        half = (view.ego_size_m[1] + _OBJECT_M[1]) / 2
        if not offset < 9.0 or not view.plain_road(station):
            return None
        profile = _entry(view, step, offset - deviation_m, pace_mps, (_ROLLING_MPS2, 3.0))
        if profile is None or travel_s(offset - half, pace_mps, _ROLLING_MPS2) > arrival_s - 0.05:
            return None
        left = side * (offset - profile[0])
        adversary = _crossing_actor(view, station, left, AgentKind.OTHER, _OBJECT_M)
        return Proposal(Staging(extras=(adversary,)), severity_mps2, adversary, step, view.last_step)


@dataclass(frozen=True)
class ReversingCar(_StreetScript):
    """A car backs out of a driveway into ego's lane and stops there."""

    speed_mps: tuple[float, float] = (2.0, 4.0)
    gain_mps2: float = 3.0

    def propose(self, view: EgoView, severity_mps2: float, rng: np.random.Generator) -> Proposal | None:
        """Propose a car that backs out of a driveway."""
        step, pace_mps = view.draw_step(rng), float(rng.uniform(*self.speed_mps))
        overlap_m, margin_m = float(rng.uniform(0.2, 1.2)), float(rng.uniform(-0.6, 0.4))
        if step is None:
            return None
        station, arrival_s = _blocked_station(view, step, severity_mps2, CAR_M[1])
        # The rear bumper starts near the right kerb and ends beyond the middle of ego's path.
        rear_m = view.edge_m(station, -1) + margin_m
        if not 1.3 < rear_m < 7.0 or not _is_open_street(view, station):
            return None
        profile = _entry(view, step, rear_m + overlap_m, pace_mps, (self.gain_mps2, 2.5))
        ego_half_m = view.ego_size_m[1] / 2
        if profile is None or travel_s(rear_m - ego_half_m, pace_mps, self.gain_mps2) > arrival_s - 0.05:
            return None
        xy, heading = view.track.pose(np.full(view.steps, station), profile[0] - (rear_m + CAR_M[0] / 2))
        valid = np.ones(view.steps, bool)
        adversary = ScriptedUser(AgentKind.VEHICLE, CAR_M, xy, heading - math.pi / 2, -profile[1], valid)
        return Proposal(Staging(extras=(adversary,)), severity_mps2, adversary, step, view.last_step)


@dataclass(frozen=True)
class WrongWayCyclist(_StreetScript):
    """An oncoming cyclist at the right edge of the road swings out into ego's lane for a while.

    Attributes:
        out_s: Time from the first step until ego's lane is clear again, low and high.
        swing_s: Duration of each swing.
    """

    speed_mps: tuple[float, float] = (3.5, 6.5)
    out_s: tuple[float, float] = (2.0, 3.2)
    swing_s: float = 1.6

    def propose(self, view: EgoView, severity_mps2: float, rng: np.random.Generator) -> Proposal | None:
        """Propose a cyclist that comes towards ego."""
        step, pace_mps = view.draw_step(rng), float(rng.uniform(*self.speed_mps))
        clear_s, inner_m = float(rng.uniform(*self.out_s)), float(rng.uniform(-0.9, -0.1))
        if step is None:
            return None
        ego_station, speed = view.at_step(step)
        room = speed * NOTICED_S + waiting_room(speed, severity_mps2, clear_s - NOTICED_S)
        start = ego_station + (view.ego_size_m[0] + _BICYCLE_M[0]) / 2 + room + pace_mps * clear_s
        if not _is_open_street(view, ego_station + room) or not _is_open_street(view, start):
            return None
        half = (view.ego_size_m[1] + _BICYCLE_M[1]) / 2
        edge_m = view.edge_m(start - pace_mps * clear_s, -1)
        outer_m = -max(edge_m - 0.45, half + 0.35)
        if not edge_m < 4.5:
            return None
        times = DT_S * (np.arange(view.steps) - step)
        # Share of the swing that remains when ego's lane is clear again.
        share = (half + outer_m) / (outer_m - inner_m) if outer_m < inner_m else 1.0
        back_begin_s = clear_s - _inverse_smooth_step(1.0 - min(max(share, 0.0), 1.0)) * self.swing_s
        swing = smooth_step(times / self.swing_s) - smooth_step((times - back_begin_s) / self.swing_s)
        if back_begin_s < self.swing_s * 0.6:
            return None
        left = outer_m + (inner_m - outer_m) * swing
        station, valid = start - pace_mps * times, np.ones(view.steps, bool)
        adversary = along_track(view.track, station, left, AgentKind.CYCLIST, _BICYCLE_M, valid)
        last = min(step + round((back_begin_s + self.swing_s) / DT_S), view.last_step)
        return Proposal(Staging(extras=(adversary,)), severity_mps2, adversary, step, last)


def _inverse_smooth_step(value: float) -> float:
    """Return the argument at which the smooth step has a value."""
    t = np.linspace(0.0, 1.0, 201)
    return float(np.interp(value, smooth_step(t), t))
