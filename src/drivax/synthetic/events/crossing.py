"""Events at junctions: a vehicle that runs a red light, and one that turns left across ego's path."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drivax.scenario.schema import DT_S, AgentKind
from drivax.synthetic.events.actors import CAR_M, Times, along_curve
from drivax.synthetic.events.adversary import (
    comes_close,
    first_blocked_station,
    required_on_samples,
    vehicles_in_lane,
)
from drivax.synthetic.events.destinations import Destination
from drivax.synthetic.events.ego_view import EARLIEST, FULL_SWING, LATEST, NOTICED, SLOWEST_MPS, EgoView
from drivax.synthetic.events.kinds import SEVERITY_MPS2, EventScript, Proposal
from drivax.synthetic.roads.curves import Curve, join_curves
from drivax.synthetic.roads.network import Control, Lane, RoadNetwork
from drivax.synthetic.roads.signals import Colour
from drivax.synthetic.traffic.roles import ScriptedUser, Staging

#: Least length of an actor's path before and beyond the junction, m, where the map is large enough.
_FROM_M, _BEYOND_M = 180.0, 60.0
#: Deceleration for a stop at the line beyond which an actor visibly does not stop, m/s2.
_BRAKING_MPS2 = 5.0
#: Braking before bends and acceleration after them, and lateral acceleration in them, m/s2.
_SLOWING_MPS2, _LATERAL_MPS2 = 2.0, 3.0
#: Largest change of heading of a straight connector, rad, and least absolute cosine of headings on the same road.
_TURN_RAD, _SAME_ROAD_COS = math.radians(45.0), 0.7


@dataclass(frozen=True)
class _ActorPath:
    """Path of an actor; the junction begins ``line_m`` along the curve."""

    curve: Curve
    line_m: float
    limit_mps: float

    @classmethod
    def through(cls, view: EgoView, connector: int, rng: np.random.Generator) -> _ActorPath:
        """Draw a path through a connector."""
        lanes = view.roles.network.lanes
        before = _chain(lanes, connector, -1, _FROM_M, rng)
        after = _chain(lanes, connector, 1, _BEYOND_M, rng)
        approach = [lanes[i].curve for i in reversed(before)]
        line_m = sum(float(curve.arc_m[-1]) for curve in approach)
        curve = join_curves(*approach, lanes[connector].curve, *(lanes[i].curve for i in after))
        limit_mps = lanes[before[0]].limit_mps if before else lanes[connector].limit_mps
        return cls(curve, line_m, limit_mps)

    def distances(self, fastest_mps: float, times_s: Times) -> Times:
        """Distance along the path at times; the front reaches the line at time 0, and bends limit the speed."""
        arc = self.curve.arc_m
        position = np.maximum.accumulate(arc + 1e-9 * np.arange(len(arc)))
        curvature = np.abs(np.gradient(self.curve.heading, position))
        smooth_curvature = np.convolve(np.pad(curvature, 4, mode="edge"), np.full(9, 1 / 9), mode="valid")
        squared_cap = np.minimum(fastest_mps**2, _LATERAL_MPS2 / np.maximum(smooth_curvature, 1e-6))
        ramp = 2 * _SLOWING_MPS2 * arc
        braking_cap = np.minimum.accumulate((squared_cap + ramp)[::-1])[::-1] - ramp
        speed = np.sqrt(np.minimum.accumulate(braking_cap - ramp) + ramp)
        clock = np.concatenate([[0.0], np.cumsum(np.diff(arc) * 2 / (speed[1:] + speed[:-1]))])
        line_s = float(np.interp(self.line_m - CAR_M[0] / 2, arc, clock))
        before_m = np.minimum(times_s + line_s, 0.0) * speed[0]
        after_m = np.maximum(times_s + line_s - clock[-1], 0.0) * speed[-1]
        return np.interp(times_s + line_s, clock, arc) + before_m + after_m


def _chain(
    lanes: tuple[Lane, ...], first: int, direction: int, length_m: float, rng: np.random.Generator
) -> list[int]:
    """Draw successive lanes before (-1) or after (1) a lane until their total length suffices or the map ends."""
    result: list[int] = []
    total, lane = 0.0, lanes[first]
    while total < length_m and (links := lane.successors if direction > 0 else lane.predecessors):
        result.append(int(rng.choice(links)))
        lane = lanes[result[-1]]
        total += lane.length_m
    return result


def _is_straight(lane: Lane) -> bool:
    return abs(float(lane.curve.heading[-1] - lane.curve.heading[0])) < _TURN_RAD


@dataclass(frozen=True)
class CrossTraffic(EventScript):
    """A vehicle crosses ego's path in a junction although ego has right of way.

    Attributes:
        turning: Whether an oncoming vehicle turns left without yielding; else a vehicle runs a red light.
        speed_share: Speed of the actor before the junction as a share of its limit, low and high.
        arrival_s: Time of ego's arrival at the junction, low and high.
    """

    turning: bool = False
    speed_share: tuple[float, float] = (0.7, 1.1)
    arrival_s: tuple[float, float] = (2.5, 5.5)

    def destinations(self, network: RoadNetwork) -> tuple[Destination, ...]:
        """Return the beginnings of connectors that an actor may cross."""
        if network.signals is None and not self.turning:
            return ()
        return tuple(
            Destination(index, (0.0, 0.0), self.arrival_s)
            for index, lane in enumerate(network.lanes)
            if lane.connector and lane.predecessors and self._lower_priority_conflicts(network, index)
        )

    def propose(self, view: EgoView, severity_mps2: float, rng: np.random.Generator) -> Proposal | None:
        """Propose a vehicle that crosses ego's path in a junction."""
        network, share = view.roles.network, float(rng.uniform(*self.speed_share))
        conflicts = [self._lower_priority_conflicts(network, connector) for connector in view.connectors]
        connectors = sorted(set[int]().union(*conflicts))
        if not connectors:
            return None
        lane = int(rng.choice(connectors))
        path = _ActorPath.through(view, lane, rng)
        fastest_mps = share * path.limit_mps
        # Steps from the event's first one to the entry: at constant speed, a stop would require about 5 m/s2 or more.
        lead = max(3, round(float(rng.uniform(0.3, fastest_mps / (2 * _BRAKING_MPS2))) / DT_S))
        schedule = self._schedule(view, lane, path, fastest_mps, lead, severity_mps2)
        if schedule is None:
            return None
        entry, adversary, required_mps2 = schedule
        # The label ends 1 s after the entry, which may be before the actor reaches ego's path. If the actor blocks the
        # path 0.8 s after the entry, the label lasts until the actor leaves it (if before the recording's end).
        is_clear = ~np.isfinite(first_blocked_station(view, adversary, entry))
        exit_step = int(np.argmax(is_clear[8:])) + 8 + entry
        # Remove the queue at the actor's light: up to 0.5 s after the entry, no vehicle may block the actor.
        removed = vehicles_in_lane(view, adversary, entry + 5)
        last = min(max(exit_step, entry + 10), view.last_step)
        staging = Staging(extras=(adversary,), removed=removed)
        return Proposal(staging, required_mps2, adversary, entry - lead, last)

    def _lower_priority_conflicts(self, network: RoadNetwork, connector: int) -> list[int]:
        """Return the connectors that cross this one and must wait for its traffic; none if it is bent."""
        lane = network.lanes[connector]
        if not _is_straight(lane):
            return []
        others = np.flatnonzero(network.conflicts[connector]).tolist()
        return [other for other in others if self._crosses(lane, network.lanes[other], connector)]

    def _crosses(self, lane: Lane, other: Lane, index: int) -> bool:
        """Return whether an actor on the connector ``other`` would cross ego's connector ``lane`` (``index``)."""
        if not other.predecessors or not other.connector:
            return False
        alignment = math.cos(float(other.curve.heading[0] - lane.curve.heading[0]))
        if self.turning:
            left = not _is_straight(other) and float(other.curve.heading[-1]) > float(other.curve.heading[0])
            return left and alignment < -_SAME_ROAD_COS and index in other.yields_to
        is_signalised = other.control == lane.control == Control.SIGNAL
        return is_signalised and _is_straight(other) and abs(alignment) < _SAME_ROAD_COS

    def _schedule(
        self, view: EgoView, lane: int, path: _ActorPath, fastest_mps: float, lead: int, severity_mps2: float
    ) -> tuple[int, ScriptedUser, float] | None:
        """Return the step at which the actor enters for about this severity, its motion, and the severity, or None.

        ``fastest_mps`` is its highest speed, and ``lead`` the number of steps from the event to the entry.
        """
        first = view.first_step + EARLIEST + lead
        # The conflict follows the entry: no entry in the last 1.5 s.
        last = min(view.first_step + LATEST + lead, view.last_step - 15)

        def actor(entry: int) -> ScriptedUser:
            distance = path.distances(fastest_mps, DT_S * (np.arange(view.steps) - entry))
            return along_curve(path.curve, distance, AgentKind.VEHICLE, CAR_M)

        if first > last:
            return None
        # Blocked stations of other entry steps are those of the first one, shifted in time.
        blocked_m = first_blocked_station(view, actor(first), first - lead)
        required_mps2 = np.zeros(last + 1)
        for entry in range(first, last + 1):
            begin = entry - lead + NOTICED
            speed_mps = float(view.motion.speed[0, begin])
            if speed_mps > SLOWEST_MPS:
                room_m = blocked_m[NOTICED:][: view.last_step + 1 - begin] - view.track.at[begin]
                required_mps2[entry] = required_on_samples(speed_mps, room_m)
        low, high = SEVERITY_MPS2
        # The step at which the actor blocks ego's path, for each entry step.
        blocked_at = np.arange(last + 1) - lead + int(np.argmax(np.isfinite(blocked_m)))
        is_in_time = blocked_at < view.first_step + FULL_SWING
        candidates = np.flatnonzero((required_mps2 > low) & (required_mps2 < high) & is_in_time)
        order = np.argsort(np.abs(required_mps2[candidates] - severity_mps2), kind="stable")
        for entry in candidates[order[:6]].tolist():
            # Ego at constant speed may pass before the actor arrives.
            adversary = actor(entry)
            if comes_close(view, adversary, entry - lead) and self._fits_lights(view, lane, entry):
                return entry, adversary, float(required_mps2[entry])
        return None

    def _fits_lights(self, view: EgoView, lane: int, entry: int) -> bool:
        """Return whether the light is red (red-light runner) or never red (turning vehicle) for 1.2 s before the entry.

        Without lights only a turning vehicle fits.
        """
        network = view.roles.network
        if network.signals is None:
            return self.turning
        # On the clock of the lights the recording begins at 0.
        times = (np.arange(view.steps) - view.first_step) * DT_S
        colour, _ = network.signals.colours(times, len(network.lanes))
        is_red = colour[entry - 12 : entry + 1, lane] == Colour.RED
        return not is_red.any() if self.turning else bool(is_red.all())
