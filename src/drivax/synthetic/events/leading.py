"""Events in ego's lane: a leader that brakes or stalls, a tailgater, a vehicle that cuts in or merges late."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from drivax.scenario.schema import DT_S, AgentKind
from drivax.synthetic.events.actors import CAR_M, along_track, brake_to_halt, speed_change
from drivax.synthetic.events.adversary import severity
from drivax.synthetic.events.destinations import Destination, open_road
from drivax.synthetic.events.ego_view import EARLIEST, LATEST, NOTICED, NOTICED_S, SLOWEST_MPS, EgoView
from drivax.synthetic.events.kinds import SEVERITY_MPS2, EventScript, Proposal
from drivax.synthetic.roads.curves import smooth_step
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.roles import Override, Staging, Tailgate

#: Lowest speed limit of the road, m/s; on slower roads a braking leader requires little of ego.
_LEAST_MPS = 10.0
#: Speed above which an existing leader may brake, m/s.
_LEADER_MPS = 3.0
#: Range of hard braking, up to locked wheels, m/s2.
_HARD_MPS2, _HARDEST_MPS2 = 3.7, 8.0
#: Acceleration of a new leader that drives on, m/s2.
_RESUMING_MPS2 = 1.5
#: Time from when ego would have reached a leader at constant speed until the leader drives on, s.
_HOLD_S = 1.5
#: Largest distance of a vehicle behind ego that becomes a tailgater, m.
_FOLLOWER_M = 60.0
#: A new leader appears this many steps before the recording, which leaves ego no time to fall back.
_BEFORE = 5
#: Distance between the stations at which the adjacent lane is sampled, m.
_EVERY_M = 8.0


def required_by_leader(speed_mps: float, gap_m: float, leader_mps: float, braking_mps2: float) -> float:
    """Return the deceleration that a leader braking to a halt requires of ego from the same moment on, m/s2.

    Ego may move ``gap_m`` further than the leader: v^2 / (2 a) = g + v_l^2 / (2 b). This holds where ego stops after
    the leader, v / a >= v_l / b; else they are closest while both move, and a = b + (v - v_l)^2 / (2 g).
    """
    required_mps2 = speed_mps**2 / (2 * (gap_m + leader_mps**2 / (2 * braking_mps2)))
    if speed_mps / required_mps2 >= leader_mps / braking_mps2:
        return required_mps2
    return braking_mps2 + max(speed_mps - leader_mps, 0.0) ** 2 / (2 * gap_m)


def draw_braking(
    speed_mps: float, gap_m: float, leader_mps: float, rng: np.random.Generator
) -> tuple[float, float] | None:
    """Draw the leader's deceleration, and the severity uniformly from the range that hard braking requires, m/s2.

    The deceleration follows from the formula for a leader that stops before ego; a close and slow one requires more.
    Return None if that range hardly overlaps ``SEVERITY_MPS2``, or the leader would have to stop at once.
    """
    low, high = (required_by_leader(speed_mps, gap_m, leader_mps, b) for b in (_HARD_MPS2, _HARDEST_MPS2))
    low, high = max(low, SEVERITY_MPS2[0]), min(high, SEVERITY_MPS2[1])
    if high <= low + 0.05:
        return None
    severity_mps2 = float(rng.uniform(low, high))
    room_m = speed_mps**2 / (2 * severity_mps2) - gap_m
    return (leader_mps**2 / (2 * room_m), severity_mps2) if room_m > 0 else None


def cut_in_gap(
    ego_mps: float, actor_mps: float, last_mps: float, braking_mps2: float, severity_mps2: float
) -> float | None:
    """Return the bumper-to-bumper gap at which an actor that slows ahead requires this deceleration of ego, m.

    In a frame that moves at the actor's final speed v_f ego loses u = v - v_f within the gap and the actor's own
    distance: u^2 / (2 a) = g + w^2 / (2 b) with w = v_a - v_f; None where ego would reach v_f first.
    """
    u, w = ego_mps - last_mps, actor_mps - last_mps
    if u / severity_mps2 < w / braking_mps2:
        return None
    return u**2 / (2 * severity_mps2) - w**2 / (2 * braking_mps2)


@dataclass(frozen=True)
class LeadBrakes(EventScript):
    """The vehicle ahead of ego, or a new one, brakes to a halt without visible reason and drives on later.

    Attributes:
        within_s: Largest time gap of an existing leader; else a new vehicle is added.
        headway_s, tailgating_s: Time gaps of a new leader and of a tailgater, low and high.
        tailgater: Whether a vehicle behind ego follows it closely.
    """

    within_s: float = 2.0
    headway_s: tuple[float, float] = (0.9, 1.4)
    tailgater: bool = False
    tailgating_s: tuple[float, float] = (0.4, 0.7)

    def destinations(self, network: RoadNetwork) -> tuple[Destination, ...]:
        """Return roads with a limit of at least 10 m/s."""
        places = open_road(network, _LEAST_MPS)
        return tuple(replace(place, followed=True) for place in places) if self.tailgater else places

    def propose(self, view: EgoView, severity_mps2: float, rng: np.random.Generator) -> Proposal | None:
        """Propose a leader that brakes to a halt, at a severity drawn from the possible range."""
        step, headway = view.draw_step(rng), float(rng.uniform(*self.headway_s))
        tailgating = float(rng.uniform(*self.tailgating_s))
        if step is None:
            return None
        motion, (ego_station, speed) = view.motion, view.at_step(step)
        station, is_on_path = view.on_path(step)
        followers: tuple[int, ...] = ()
        tailgates: tuple[Tailgate, ...] = ()
        if self.tailgater:
            distance_m = np.where(is_on_path & (station < ego_station), ego_station - station, np.inf)
            follower = int(np.argmin(distance_m))
            if not distance_m[follower] < _FOLLOWER_M or motion.kind[follower] != AgentKind.VEHICLE:
                return None
            followers, tailgates = (follower,), (Tailgate(follower, tailgating),)
        half_lengths_m = (motion.size_m[: motion.vehicles, 0] + motion.size_m[0, 0]) / 2
        gap = np.where(is_on_path & (station > ego_station), station - ego_station - half_lengths_m, np.inf)
        leader = int(np.argmin(gap))
        if gap[leader] > self.within_s * speed:
            return _propose_leader(view, step, headway, rng, Staging(tailgates=tailgates), followers)
        leader_mps = float(motion.speed[leader, step])
        draft = draw_braking(speed, float(gap[leader]), leader_mps, rng) if leader_mps > _LEADER_MPS else None
        if draft is None:
            return None
        braking_mps2, drawn_severity_mps2 = draft
        last = step + _stop_steps(speed, drawn_severity_mps2)
        if last > view.last_step:
            return None
        staging = Staging(overrides=(Override(leader, step, last, -braking_mps2),), tailgates=tailgates)
        adversary = brake_to_halt(motion, leader, step, braking_mps2)
        required_mps2 = severity(view, adversary, step + NOTICED)
        return Proposal(staging, required_mps2, adversary, step, last, leader, followers)


@dataclass(frozen=True)
class StalledVehicle(EventScript):
    """A car ahead of ego, at a time gap of ``headway_s`` (low and high), brakes to a halt and stays."""

    headway_s: tuple[float, float] = (0.9, 1.4)

    def destinations(self, network: RoadNetwork) -> tuple[Destination, ...]:
        """Return roads with a limit of at least 10 m/s."""
        return open_road(network, _LEAST_MPS)

    def propose(self, view: EgoView, severity_mps2: float, rng: np.random.Generator) -> Proposal | None:
        """Propose a leader that stalls, at a severity drawn from the possible range."""
        step, headway = view.draw_step(rng), float(rng.uniform(*self.headway_s))
        return None if step is None else _propose_leader(view, step, headway, rng, None, ())


def _stop_steps(speed_mps: float, severity_mps2: float) -> int:
    """Return the steps until a leader drives on: ego's time to reach it at constant speed, v / (2 a), and a margin."""
    return round((speed_mps / (2 * severity_mps2) + _HOLD_S) / DT_S)


def _propose_leader(
    view: EgoView, step: int, headway_s: float, rng: np.random.Generator, departure: Staging | None,
    others: tuple[int, ...],
) -> Proposal | None:  # fmt: skip
    """Propose a new leader at ego's speed that brakes to a halt.

    ``headway_s`` is the leader's time gap to ego's motion without the event. With the staging ``departure`` the leader
    drives on later; with None it stays where it stopped.

    Returns:
        The proposal; None near junctions, if :func:`draw_braking` returns None, or if the leader would drive on only
        after the recording.
    """
    track, ego_mps = view.track, float(view.motion.speed[0, step])
    half_lengths_m = (float(view.ego_size_m[0]) + CAR_M[0]) / 2
    cruising = track.at + headway_s * ego_mps + half_lengths_m
    if view.meets_junction(float(cruising[view.first_step]), float(cruising[step])):
        return None
    first_valid = view.first_step - _BEFORE
    following_view = view.behind(cruising - CAR_M[0] / 2, first_valid)
    speed = float(following_view.motion.speed[0, step])
    gap = float(cruising[step] - following_view.track.at[step]) - half_lengths_m
    draft = draw_braking(speed, gap, ego_mps, rng)
    if draft is None:
        return None
    times = DT_S * (np.arange(view.steps) - step)
    braked_m, _ = speed_change(ego_mps, 0.0, draft[0], times)
    last = view.last_step if departure is None else step + _stop_steps(speed, draft[1])
    resumed_m, _ = speed_change(0.0, ego_mps, _RESUMING_MPS2, np.maximum(times - DT_S * (last - step), 0.0))
    station = np.where(times < 0, cruising, cruising[step] + braked_m + resumed_m)
    if last > view.last_step or view.meets_junction(float(cruising[step]), float(station[view.last_step])):
        return None
    valid, left = np.arange(view.steps) >= first_valid, np.zeros(view.steps)
    adversary = along_track(track, station, left, AgentKind.VEHICLE, CAR_M, valid)
    staging = replace(departure or Staging(), extras=(adversary,))
    required_mps2 = severity(following_view, adversary, step + NOTICED)
    return Proposal(staging, required_mps2, adversary, step, last, None, others, following_view)


@dataclass(frozen=True)
class CutIn(EventScript):
    """A slower vehicle in the adjacent lane changes into ego's lane right in front of it and brakes.

    Attributes:
        late_merge: Whether the actor's lane must end or lead off the road shortly after the lane change.
        speed_share, slower_share: Speed of the actor before and afterwards as a share of ego's, low and high.
        braking_mps2, lasts_s: Deceleration of the actor and duration of the lane change, low and high.
        before_end_m: Largest distance from the end of a late merge to the end of the lane.
        end_after_s: Time of ego's arrival at the end of the lane, low and high.
    """

    late_merge: bool = False
    speed_share: tuple[float, float] = (0.8, 1.0)
    slower_share: tuple[float, float] = (0.15, 0.65)
    braking_mps2: tuple[float, float] = (2.5, 6.0)
    lasts_s: tuple[float, float] = (2.0, 3.2)
    before_end_m: float = 80.0
    end_after_s: tuple[float, float] = (5.5, 9.0)

    def destinations(self, network: RoadNetwork) -> tuple[Destination, ...]:
        """Return places next to the ends of lanes for a late merge, else roads with an adjacent lane."""
        if not self.late_merge:
            return open_road(network, has_neighbour=True)
        lanes, places = network.lanes, []
        for lane in lanes:
            for neighbour in (lane.left, lane.right) if lane.ends or lane.exit_only else ():
                if neighbour >= 0 and not (lanes[neighbour].ends or lanes[neighbour].exit_only):
                    curve = lanes[neighbour].curve
                    nearest = int(np.argmin(np.hypot(*(curve.xy - lane.curve.xy[-1]).T)))
                    position = float(curve.arc_m[nearest])
                    places.append(Destination(neighbour, (position, position), self.end_after_s))
        return tuple(places)

    def propose(self, view: EgoView, severity_mps2: float, rng: np.random.Generator) -> Proposal | None:
        """Propose a vehicle that changes into ego's lane and brakes."""
        step, side = view.draw_step(rng), int(rng.choice([-1, 1]))
        if self.late_merge:
            step, side = self._draw_lane_end(view, rng)
        shares = rng.uniform(*self.speed_share), rng.uniform(*self.slower_share)
        braking, lasts_s = float(rng.uniform(*self.braking_mps2)), float(rng.uniform(*self.lasts_s))
        if step is None:
            return None
        ego_station, speed = view.at_step(step)
        before_mps, after_mps = (float(share) * speed for share in shares)
        after_mps = min(after_mps, before_mps)
        slowed_mps = max(after_mps, before_mps - braking * NOTICED_S)
        gap_m = cut_in_gap(speed, slowed_mps, after_mps, braking, severity_mps2)
        if gap_m is None:
            return None
        # Add the distance by which ego approaches until it notices the actor.
        gap_m += NOTICED_S * (speed - (before_mps + slowed_mps) / 2)
        if not 0.5 <= gap_m <= 40.0:
            return None
        start = ego_station + gap_m + (view.ego_size_m[0] + CAR_M[0]) / 2
        times = DT_S * (np.arange(view.steps) - step)
        travelled_m, _ = speed_change(before_mps, after_mps, braking, times)
        station = start + travelled_m
        finish = float(np.interp(lasts_s, times, station))
        adjacent = self._adjacent_lane(view, station, start, finish, side)
        if adjacent is None or view.meets_junction(start, float(station[view.last_step])):
            return None
        lateral, valid = adjacent
        left = side * lateral * (1.0 - smooth_step(times / lasts_s))
        adversary = along_track(view.track, station, left, AgentKind.VEHICLE, CAR_M, valid)
        if not adversary.valid[view.first_step : step + 1].all():
            return None
        # The event ends when the actor has its new speed in the new lane.
        last = min(step + round(max(lasts_s, (before_mps - after_mps) / braking) / DT_S), view.last_step)
        return Proposal(Staging(extras=(adversary,)), severity_mps2, adversary, step, max(last, step + 1))

    def _draw_lane_end(self, view: EgoView, rng: np.random.Generator) -> tuple[int | None, int]:
        """Draw a step (None: none) at which ego is shortly before the end of an adjacent lane, and that lane's side."""
        ends = view.lane_ends
        if not ends:
            return None, 1
        station, side = ends[int(rng.integers(len(ends)))]
        speed = view.motion.speed[0]
        steps = np.arange(view.first_step + EARLIEST, view.first_step + LATEST + 1)
        # The merge and its gap take about three seconds, and it ends within ``before_end_m`` of the lane's end.
        remaining_m = station - view.track.at[steps] - 3.0 * speed[steps]
        is_timely = (remaining_m > 0.0) & (remaining_m < self.before_end_m)
        candidates = steps[is_timely & (speed[steps] > SLOWEST_MPS)]
        return (int(rng.choice(candidates)) if len(candidates) else None), side

    def _adjacent_lane(
        self, view: EgoView, station: np.ndarray, start: float, finish: float, side: int
    ) -> tuple[float, Bool[np.ndarray, " time"]] | None:
        """Return the actor lane's distance from ego's path, m, and a mask of the steps with a lane there, or None."""
        lanes, lane, reach = view.roles.network.lanes, -1, finish
        low = max(0.0, float(station.min()))
        for candidate in np.arange(finish, low - _EVERY_M, -_EVERY_M).clip(min=0.0).tolist():
            neighbour = view.neighbour(candidate, side)
            if neighbour < 0:
                break
            reach = candidate
            lane = neighbour if lane < 0 else lane
        if lane < 0 or reach > start - _EVERY_M:
            return None
        if self.late_merge:
            if not (lanes[lane].ends or lanes[lane].exit_only):
                return None
            end, _ = view.track.project(lanes[lane].curve.xy[-1:])
            if not finish <= float(end[0]) <= finish + self.before_end_m:
                return None
        current = view.track.place(start)[0]
        separation = float(np.min(np.hypot(*(lanes[view.neighbour(start, side)].curve.xy - current).T)))
        return (separation, station >= reach) if 2.3 < separation < 5.0 else None
