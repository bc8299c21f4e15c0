"""Events with a lane change into ego's lane: a cut-in, and a late merge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from drivax.scenario.schema import DT_S, AgentKind
from drivax.synthetic.events.actors import CAR_M, along_track, speed_change
from drivax.synthetic.events.destinations import Destination, open_road
from drivax.synthetic.events.ego_view import EARLIEST, LATEST, NOTICED_S, EgoView
from drivax.synthetic.events.kinds import EventKind, Proposal
from drivax.synthetic.roads.curves import STEP_M, smooth_step
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.roles import Staging

#: Distance between the stations at which the adjacent lane is sampled, m.
_EVERY_M = 8.0


def cut_in_gap(
    ego_mps: float, actor_mps: float, last_mps: float, braking_mps2: float, severity_mps2: float
) -> float | None:
    """Bumper-to-bumper gap at which an actor that slows ahead requires this deceleration of ego.

    In a frame that moves at the actor's final speed v_f ego loses u = v - v_f within the gap and the actor's own
    distance: u^2 / (2 a) = g + w^2 / (2 b) with w = v_a - v_f; None where ego would reach v_f first.
    """
    u, w = ego_mps - last_mps, actor_mps - last_mps
    if u / severity_mps2 < w / braking_mps2:
        return None
    return u**2 / (2 * severity_mps2) - w**2 / (2 * braking_mps2)


@dataclass(frozen=True)
class CutIn:
    """A slower vehicle in the adjacent lane changes into ego's lane right in front of it and brakes.

    Attributes:
        late_merge: Only where the actor's lane ends or leads off the road, shortly before its end.
        speed_share: Speed of the actor before as a share of ego's, low and high.
        slower_share: Speed of the actor afterwards as a share of ego's, low and high.
        braking_mps2: Deceleration of the actor, low and high.
        lasts_s: Duration of the lane change, low and high.
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

    @property
    def kind(self) -> EventKind:
        """See :class:`EventScript`."""
        return EventKind.LATE_MERGE if self.late_merge else EventKind.CUT_IN

    def possible(self, network: RoadNetwork) -> bool:
        """See :class:`EventScript`."""
        return bool(self.destinations(network))

    def destinations(self, network: RoadNetwork) -> tuple[Destination, ...]:
        """See :class:`DestinationScript`: for a late merge the ends of lanes, on the adjacent lanes."""
        lanes = network.lanes
        if not self.late_merge:
            return open_road(network, has_neighbour=True)
        places = []
        for lane in lanes:
            for neighbour in (lane.left, lane.right) if lane.ends or lane.exit_only else ():
                if neighbour >= 0 and not (lanes[neighbour].ends or lanes[neighbour].exit_only):
                    curve = lanes[neighbour].curve
                    nearest = int(np.argmin(np.hypot(*(curve.xy - lane.curve.xy[-1]).T)))
                    at = float(curve.arc_m[nearest])
                    places.append(Destination(neighbour, (at, at), self.end_after_s))
        return tuple(places)

    def propose(self, view: EgoView, severity_mps2: float, rng: np.random.Generator) -> Proposal | None:
        """See :class:`EventScript`."""
        step, side = view.draw_step(rng), int(rng.choice([-1, 1]))
        if self.late_merge:
            step, side = self._before_an_end(view, rng)
        shares = rng.uniform(*self.speed_share), rng.uniform(*self.slower_share)
        braking, lasts = float(rng.uniform(*self.braking_mps2)), float(rng.uniform(*self.lasts_s))
        if step is None:
            return None
        speed = float(view.motion.speed[0, step])
        before, after = (float(share) * speed for share in shares)
        after = min(after, before)
        slowed = max(after, before - braking * NOTICED_S)
        gap = cut_in_gap(speed, slowed, after, braking, severity_mps2)
        if gap is None:
            return None
        # Ego approaches until it notices.
        gap += NOTICED_S * (speed - (before + slowed) / 2)
        if not 0.5 <= gap <= 40.0:
            return None
        start = float(view.track.at[step]) + gap + (view.ego_size_m[0] + CAR_M[0]) / 2
        times = DT_S * (np.arange(view.steps) - step)
        gone, _ = speed_change(before, after, braking, times)
        station = start + gone
        finish = float(np.interp(lasts, times, station))
        adjacent = self._adjacent_lane(view, station, start, finish, side)
        if adjacent is None or view.meets_junction(start, float(station[view.last_step])):
            return None
        aside, valid = adjacent
        left = side * aside * (1.0 - smooth_step(times / lasts))
        adversary = along_track(view.track, station, left, AgentKind.VEHICLE, CAR_M, valid=valid)
        if not adversary.valid[view.first_step : step + 1].all():
            return None
        # The event ends when the actor has its new speed in the new lane.
        last = step + round(max(lasts, (before - after) / braking) / DT_S)
        last = min(last, view.last_step)
        return Proposal(Staging(extras=(adversary,)), severity_mps2, adversary, step, max(last, step + 1))

    def _before_an_end(self, view: EgoView, rng: np.random.Generator) -> tuple[int | None, int]:
        """Draw a step at which ego is shortly before the end of an adjacent lane, and the side of that lane."""
        ends = view.lane_ends
        if not ends:
            return None, 1
        station, side = ends[int(rng.integers(len(ends)))]
        speed = view.motion.speed[0]
        steps = np.arange(view.first_step + EARLIEST, view.first_step + LATEST + 1)
        # The merge and its gap take about three seconds, and it ends within the last metres of the lane.
        left = station - view.track.at[steps] - 3.0 * speed[steps]
        fits = steps[(left > 0.0) & (left < self.before_end_m) & (speed[steps] > 4.0)]
        return (int(rng.choice(fits)) if len(fits) else None), side

    def _adjacent_lane(
        self, view: EgoView, station: np.ndarray, start: float, finish: float, side: int
    ) -> tuple[float, Bool[np.ndarray, " time"]] | None:
        """Lateral offset of the actor's lane, and the steps at which it exists next to ego's; None without one."""
        low = max(0.0, float(station.min()))
        places = np.arange(finish, low - _EVERY_M, -_EVERY_M).clip(min=0.0)
        lane = -1
        reach = finish
        lanes = view.roles.network.lanes
        for place in places.tolist():
            neighbour = view.neighbour(place, side)
            if neighbour < 0:
                break
            reach = place
            lane = neighbour if lane < 0 else lane
        if lane < 0 or reach > start - _EVERY_M:
            return None
        if self.late_merge:
            if not (lanes[lane].ends or lanes[lane].exit_only):
                return None
            end, _ = view.track.project(lanes[lane].curve.xy[-1:])
            if not finish <= float(end[0]) <= finish + self.before_end_m:
                return None
        here = view.track.place(start)[0]
        apart = float(np.min(np.hypot(*(lanes[view.neighbour(start, side)].curve.xy - here).T)))
        aside = max(apart, STEP_M)
        if not 2.3 < aside < 5.0:
            return None
        return aside, station >= reach
