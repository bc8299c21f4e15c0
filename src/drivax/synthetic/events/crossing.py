"""Events at junctions: a vehicle that runs a red light, and one that turns left across ego's path."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from drivax.scenario.schema import DT_S, AgentKind
from drivax.synthetic.events.actors import CAR_M, along_curve
from drivax.synthetic.events.adversary import comes_close, first_blocked, in_its_lane, required_by_samples
from drivax.synthetic.events.destinations import Aim
from drivax.synthetic.events.ego_view import EARLIEST, FULL_SWING, LATEST, NOTICED, Scene
from drivax.synthetic.events.kinds import SEVERITY_MPS2, EventKind, Proposal
from drivax.synthetic.roads.curves import Curve, joined
from drivax.synthetic.roads.network import Control, Lane, RoadNetwork
from drivax.synthetic.roads.signals import Colour
from drivax.synthetic.traffic.roles import Scripted, Staging

#: Length of an actor's path before and beyond the junction, m.
_FROM_M, _BEYOND_M = 180.0, 60.0
#: An actor that needs more than this to stop at the line will not stop, m/s2: ego can tell from then on.
_BRAKING_MPS2 = 5.0
#: Braking before bends and lateral acceleration in them, m/s2.
_SLOWING_MPS2, _LATERAL_MPS2 = 2.0, 3.0
#: Smaller changes of heading count as straight, rad; larger cosines of headings count as the same road.
_TURN_RAD, _ALONG = math.radians(45.0), 0.7


@dataclass(frozen=True)
class _Way:
    """Path of an actor: a curve, and the distance along it at which the junction begins."""

    curve: Curve
    line_m: float
    limit_mps: float

    @classmethod
    def through(cls, scene: Scene, way: int, rng: np.random.Generator) -> _Way:
        """Draw a path through a connector."""
        lanes = scene.roles.network.lanes
        before, after = _chain(lanes, way, -1, _FROM_M, rng), _chain(lanes, way, 1, _BEYOND_M, rng)
        ahead = [lanes[i].curve for i in reversed(before)]
        line = sum(float(curve.arc_m[-1]) for curve in ahead)
        curve = joined(*ahead, lanes[way].curve, *(lanes[i].curve for i in after))
        limit = lanes[before[0]].limit_mps if before else lanes[way].limit_mps
        return cls(curve, line, limit)

    @cached_property
    def arc_m(self) -> Float64[np.ndarray, " point"]:
        """Distance along the curve at its samples."""
        return self.curve.arc_m

    def distances(
        self, fastest_mps: float, times_s: Float64[np.ndarray, " time"]
    ) -> Float64[np.ndarray, " time"]:
        """Distance along the path at times; the front reaches the line at time 0, and bends limit the speed."""
        arc = self.arc_m
        rate = np.abs(
            np.gradient(self.curve.heading, np.maximum.accumulate(arc + 1e-9 * np.arange(len(arc))))
        )
        smooth = np.convolve(np.pad(rate, 4, mode="edge"), np.full(9, 1 / 9), mode="valid")
        cap = np.minimum(fastest_mps**2, _LATERAL_MPS2 / np.maximum(smooth, 1e-6))
        ramp = 2 * _SLOWING_MPS2 * arc
        down = np.minimum.accumulate((cap + ramp)[::-1])[::-1] - ramp
        speed = np.sqrt(np.minimum.accumulate(down - ramp) + ramp)
        clock = np.concatenate([[0.0], np.cumsum(np.diff(arc) * 2 / (speed[1:] + speed[:-1]))])
        zero = float(np.interp(self.line_m - CAR_M[0] / 2, arc, clock))
        before = np.minimum(times_s + zero, 0.0) * speed[0]
        beyond = np.maximum(times_s + zero - clock[-1], 0.0) * speed[-1]
        return np.interp(times_s + zero, clock, arc) + before + beyond


def _chain(
    lanes: tuple[Lane, ...], first: int, way: int, length_m: float, rng: np.random.Generator
) -> list[int]:
    """Draw successive lanes before (-1) or after (1) a lane up to a total length."""
    result: list[int] = []
    total, at = 0.0, first
    while total < length_m:
        links = lanes[at].successors if way > 0 else lanes[at].predecessors
        if not links:
            break
        at = int(rng.choice(links))
        result.append(at)
        total += lanes[at].length_m
    return result


def _straight_on(lane: Lane) -> bool:
    return abs(float(lane.curve.heading[-1] - lane.curve.heading[0])) < _TURN_RAD


@dataclass(frozen=True)
class CrossTraffic:
    """A vehicle crosses ego's path in a junction although ego has right of way.

    Attributes:
        turning: An oncoming vehicle turns left without yielding; else a vehicle runs a red light.
        speed_share: Speed of the actor before the junction as a share of its limit, low and high.
        arrival_s: Time of ego's arrival at the junction, low and high.
    """

    turning: bool = False
    speed_share: tuple[float, float] = (0.7, 1.1)
    arrival_s: tuple[float, float] = (2.5, 5.5)

    @property
    def kind(self) -> EventKind:
        """See :class:`EventScript`."""
        return EventKind.TURN_CONFLICT if self.turning else EventKind.RED_LIGHT_RUNNER

    def possible(self, network: RoadNetwork) -> bool:
        """See :class:`EventScript`."""
        return bool(self.aims(network))

    def aims(self, network: RoadNetwork) -> tuple[Aim, ...]:
        """See :class:`AimedScript`: stop lines of connectors that actors may cross."""
        if network.signals is None and not self.turning:
            return ()
        return tuple(
            Aim(index, (0.0, 0.0), self.arrival_s)
            for index, lane in enumerate(network.lanes)
            if lane.connector and lane.predecessors and self._crossing(network, index)
        )

    def propose(self, scene: Scene, severity_mps2: float, rng: np.random.Generator) -> Proposal | None:
        """See :class:`EventScript`."""
        ways = self._ways(scene)
        share = float(rng.uniform(*self.speed_share))
        if not ways:
            return None
        lane = int(rng.choice(ways))
        way = _Way.through(scene, lane, rng)
        fastest = share * way.limit_mps
        # Steps before the entry at which the actor can no longer stop: the event begins.
        decides = max(3, round(float(rng.uniform(0.3, fastest / (2 * _BRAKING_MPS2))) / DT_S))
        found = self._timed(scene, lane, way, (fastest, decides), severity_mps2)
        if found is None:
            return None
        entry, threat, required = found
        leaves = int(np.argmax(~np.isfinite(first_blocked(scene, threat, entry))[8:])) + 8 + entry
        # A queue at its light would block the actor.
        removed = in_its_lane(scene, threat, entry + 5)
        return Proposal(
            Staging(extras=(threat,), removed=removed),
            required,
            threat,
            entry - decides,
            min(max(leaves, entry + 10), scene.last_step),
        )

    def _ways(self, scene: Scene) -> list[int]:
        """Connectors of actors that cross a connector on ego's path."""
        network = scene.roles.network
        return sorted({other for mine in scene.connectors for other in self._crossing(network, mine)})

    def _crossing(self, network: RoadNetwork, mine: int) -> list[int]:
        """Connectors that cross a straight one and have to give way to it."""
        lane = network.lanes[mine]
        if not _straight_on(lane):
            return []
        others = np.flatnonzero(network.conflicts[mine]).tolist()
        return [other for other in others if self._suits(lane, network.lanes[other], mine)]

    def _suits(self, mine: Lane, other: Lane, index: int) -> bool:
        if not other.predecessors or not other.connector:
            return False
        along = math.cos(float(other.curve.heading[0] - mine.curve.heading[0]))
        if self.turning:
            left = not _straight_on(other) and float(other.curve.heading[-1]) > float(other.curve.heading[0])
            return left and along < -_ALONG and index in other.yields_to
        lit = other.control == mine.control == Control.SIGNAL
        return lit and _straight_on(other) and abs(along) < _ALONG

    def _timed(
        self, scene: Scene, lane: int, way: _Way, pace: tuple[float, int], wanted: float
    ) -> tuple[int, Scripted, float] | None:
        """The entry step of the actor at which it requires about this deceleration, its motion, and its severity."""
        (fastest, decides), steps, track = pace, np.arange(scene.steps), scene.track
        first = scene.first_step + EARLIEST + decides
        last = min(scene.first_step + LATEST + decides, scene.last_step - 15)

        def entering(entry: int) -> Scripted:
            distance = way.distances(fastest, DT_S * (steps - entry))
            return along_curve(way.curve, distance, AgentKind.VEHICLE, CAR_M)

        if first > last:
            return None
        # The blocked stations are the same for all entry steps, shifted in time.
        blocked = first_blocked(scene, entering(first), first - decides)
        requires = np.zeros(last + 1)
        for entry in range(first, last + 1):
            begin = entry - decides + NOTICED
            speed = float(scene.motion.speed[0, begin])
            if speed > 4.0:
                room = blocked[NOTICED:][: scene.last_step + 1 - begin] - track.at[begin]
                requires[entry] = required_by_samples(speed, room)
        low, high = SEVERITY_MPS2
        # The step at which the actor blocks ego's path, for each entry step.
        enters = np.arange(last + 1) - decides + int(np.argmax(np.isfinite(blocked)))
        in_time = enters < scene.first_step + FULL_SWING
        fits = np.flatnonzero((requires > low) & (requires < high) & in_time)
        for entry in fits[np.argsort(np.abs(requires[fits] - wanted), kind="stable")[:6]].tolist():
            # An ego that keeps its speed may pass before the actor arrives.
            threat = entering(entry)
            if comes_close(scene, threat, entry - decides) and self._fits_lights(scene, lane, entry):
                return entry, threat, float(requires[entry])
        return None

    def _fits_lights(self, scene: Scene, lane: int, entry: int) -> bool:
        """Whether the light has been red for 1.2 s (red-light runner), or not red (turning vehicle)."""
        network = scene.roles.network
        if network.signals is None:
            return self.turning
        colour, _ = network.signals.colours(scene.times_s, len(network.lanes))
        seen = colour[entry - 12 : entry + 1, lane]
        return bool(np.all(seen != Colour.RED)) if self.turning else bool(np.all(seen == Colour.RED))
