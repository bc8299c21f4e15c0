"""Events in ego's lane: a leader that brakes hard, with or without a tailgater behind ego, or stalls."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drivax.scenario.schema import DT_S, AgentKind
from drivax.synthetic.events.actors import CAR_M, along_track, brake_to_halt, speed_change
from drivax.synthetic.events.adversary import severity
from drivax.synthetic.events.destinations import Destination, open_road
from drivax.synthetic.events.ego_view import NOTICED, EgoView
from drivax.synthetic.events.kinds import SEVERITY_MPS2, EventKind, Proposal
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.roles import Override, Staging, Tailgate

#: Lowest speed limit of the road, m/s: on slower roads a braking leader requires little of ego.
_LEAST_MPS = 10.0
#: Hard braking, up to locked wheels, m/s2.
_HARD_MPS2, _HARDEST_MPS2 = 3.7, 8.0
#: Time that a leader stands after ego would have reached it at constant speed, s.
_HOLD_S = 1.5
#: Largest distance of a vehicle behind ego that becomes a tailgater, m.
_FOLLOWER_M = 60.0
#: A new leader appears this many steps before the recording, which leaves ego no time to fall back.
_BEFORE = 5


def required_by_leader(speed_mps: float, gap_m: float, leader_mps: float, braking_mps2: float) -> float:
    """Deceleration that a leader braking to a halt requires of ego from the same moment on.

    Ego may move ``gap_m`` further than the leader: v^2 / (2 a) = g + v_l^2 / (2 b). This holds where ego stops after
    the leader, v / a >= v_l / b; else they are closest while both move, and a = b + (v - v_l)^2 / (2 g).
    """
    severity = speed_mps**2 / (2 * (gap_m + leader_mps**2 / (2 * braking_mps2)))
    if speed_mps / severity >= leader_mps / braking_mps2:
        return severity
    return braking_mps2 + max(speed_mps - leader_mps, 0.0) ** 2 / (2 * gap_m)


def draw_braking(
    speed_mps: float, gap_m: float, leader_mps: float, rng: np.random.Generator
) -> tuple[float, float] | None:
    """Draw the leader's deceleration and the severity, uniform over what hard braking can require; None: too little."""
    low, high = (required_by_leader(speed_mps, gap_m, leader_mps, b) for b in (_HARD_MPS2, _HARDEST_MPS2))
    low, high = max(low, SEVERITY_MPS2[0]), min(high, SEVERITY_MPS2[1])
    if high <= low + 0.05:
        return None
    severity = float(rng.uniform(low, high))
    room = speed_mps**2 / (2 * severity) - gap_m
    return (leader_mps**2 / (2 * room), severity) if room > 0 else None


@dataclass(frozen=True)
class LeadBrakes:
    """The vehicle ahead of ego, or a new one, brakes to a halt without visible reason and drives on later.

    Attributes:
        within_s: Largest time gap of an existing leader; else a new vehicle is added.
        headway_s: Time gap of a new leader, low and high.
        tailgater: Whether a vehicle behind ego follows it closely.
        tailgating_s: Time gap of the tailgater, low and high.
    """

    within_s: float = 2.0
    headway_s: tuple[float, float] = (0.9, 1.4)
    tailgater: bool = False
    tailgating_s: tuple[float, float] = (0.4, 0.7)

    @property
    def kind(self) -> EventKind:
        """See :class:`EventScript`."""
        return EventKind.TAILGATER if self.tailgater else EventKind.LEAD_BRAKES

    def possible(self, network: RoadNetwork) -> bool:
        """See :class:`EventScript`."""
        return bool(self.destinations(network))

    def destinations(self, network: RoadNetwork) -> tuple[Destination, ...]:
        """See :class:`DestinationScript`: fast roads only."""
        places = open_road(network, _LEAST_MPS)
        return tuple(replace(place, followed=True) for place in places) if self.tailgater else places

    def propose(self, view: EgoView, severity_mps2: float, rng: np.random.Generator) -> Proposal | None:
        """See :class:`EventScript`; here what is possible is known, and the severity is drawn from that."""
        step, headway = view.draw_step(rng), float(rng.uniform(*self.headway_s))
        tailgating = float(rng.uniform(*self.tailgating_s))
        if step is None:
            return None
        motion, own = view.motion, float(view.track.at[step])
        station, on = view.on_path(step)
        speed = float(motion.speed[0, step])
        followers: tuple[int, ...] = ()
        tailgates: tuple[Tailgate, ...] = ()
        if self.tailgater:
            behind = np.where(on & (station < own), own - station, np.inf)
            follower = int(np.argmin(behind))
            if not behind[follower] < _FOLLOWER_M or motion.kind[follower] != AgentKind.VEHICLE:
                return None
            followers, tailgates = (follower,), (Tailgate(follower, tailgating),)
        length = motion.size_m[: motion.vehicles, 0]
        gap = np.where(on & (station > own), station - own - (length + length[0]) / 2, np.inf)
        leader = int(np.argmin(gap))
        if gap[leader] > self.within_s * speed:
            return _propose_leader(view, step, headway, rng, Staging(tailgates=tailgates), followers)
        lead = float(motion.speed[leader, step])
        drawn = draw_braking(speed, float(gap[leader]), lead, rng) if lead > 3.0 else None
        last = view.last_step if drawn is None else step + _stands_until(speed, drawn[1])
        if drawn is None or last > view.last_step:
            return None
        staging = Staging(overrides=(Override(leader, step, last, -drawn[0]),), tailgates=tailgates)
        adversary = brake_to_halt(motion, leader, step, drawn[0])
        required = severity(view, adversary, step + NOTICED)
        return Proposal(staging, required, adversary, step, last, leader, followers)


@dataclass(frozen=True)
class StalledVehicle:
    """A car ahead of ego loses its power, comes to a halt and stays.

    Attributes:
        headway_s: Time gap to the car, low and high.
    """

    headway_s: tuple[float, float] = (0.9, 1.4)
    kind: EventKind = EventKind.STALLED_VEHICLE

    def possible(self, network: RoadNetwork) -> bool:
        """See :class:`EventScript`."""
        return bool(self.destinations(network))

    def destinations(self, network: RoadNetwork) -> tuple[Destination, ...]:
        """See :class:`DestinationScript`: fast roads only."""
        return open_road(network, _LEAST_MPS)

    def propose(self, view: EgoView, severity_mps2: float, rng: np.random.Generator) -> Proposal | None:
        """See :class:`EventScript`; here what is possible is known, and the severity is drawn from that."""
        step, headway = view.draw_step(rng), float(rng.uniform(*self.headway_s))
        if step is None:
            return None
        return _propose_leader(view, step, headway, rng, None, ())


def _stands_until(speed_mps: float, severity_mps2: float) -> int:
    """Steps that a leader stands: until ego would reach it at constant speed, v / (2 a), and a moment more."""
    return round((speed_mps / (2 * severity_mps2) + _HOLD_S) / DT_S)


def _propose_leader(
    view: EgoView,
    step: int,
    headway_s: float,
    rng: np.random.Generator,
    drives_on: Staging | None,
    others: tuple[int, ...],
) -> Proposal | None:
    """Propose a new leader at ego's speed that brakes to a halt; None near junctions, or where it requires too little.

    Args:
        view: The scenario without it.
        step: First step of braking.
        headway_s: Time gap to an ego in free traffic.
        rng: Source of randomness.
        drives_on: Further staging of a car that drives on later; None: it stays.
        others: Further actors.
    """
    track, lead = view.track, float(view.motion.speed[0, step])
    lengths = (float(view.ego_size_m[0]) + CAR_M[0]) / 2
    cruising = track.at + headway_s * lead + lengths
    if view.meets_junction(float(cruising[view.first_step]), float(cruising[step])):
        return None
    appears = view.first_step - _BEFORE
    after = view.behind(cruising - CAR_M[0] / 2, appears)
    speed, gap = float(after.motion.speed[0, step]), float(cruising[step] - after.track.at[step]) - lengths
    drawn = draw_braking(speed, gap, lead, rng)
    if drawn is None:
        return None
    times = DT_S * (np.arange(view.steps) - step)
    gone, _ = speed_change(lead, 0.0, drawn[0], times)
    last = view.last_step if drives_on is None else step + _stands_until(speed, drawn[1])
    onward, _ = speed_change(0.0, lead, 1.5, np.maximum(times - DT_S * (last - step), 0.0))
    station = np.where(times < 0, cruising, cruising[step] + gone + onward)
    if last > view.last_step or view.meets_junction(float(cruising[step]), float(station[view.last_step])):
        return None
    valid, left = np.arange(view.steps) >= appears, np.zeros(view.steps)
    adversary = along_track(track, station, left, AgentKind.VEHICLE, CAR_M, valid=valid)
    staging = replace(drives_on or Staging(), extras=(adversary,))
    required = severity(after, adversary, step + NOTICED)
    return Proposal(staging, required, adversary, step, last, None, others, after)
